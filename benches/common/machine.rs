//! Measured rates of this machine: copied bytes and multiply-adds per second.

use rayon::ThreadPool;
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;
use subsplat_kernels::cpu::SimdLevel;
use subsplat_kernels::cpu::simd::{LANES, Real, Vector, VectorKernel};

/// Floats of each buffer of the copy: 128 MiB, beyond most caches.
const COPY: usize = 32 << 20;
/// Steps of each chain.
const STEPS: usize = 4 << 20;

/// Rates on one thread and on all threads.
pub struct Machine {
    /// GB/s, read and written bytes counted together.
    pub copy: [f64; 2],
    /// GFLOP/s of `f32`; a multiply-add counts as two.
    pub fma: [f64; 2],
}

struct Chains(usize);

impl Chains {
    /// Runs `N` independent chains of multiply-adds. Returns their number, and a sum that
    /// depends on all of them.
    #[inline(always)]
    fn chains<V: Vector<Element = f32>, const N: usize>(self) -> (usize, f32) {
        let (factor, term) = (V::splat(black_box(0.999)), V::splat(black_box(0.001)));
        let mut sums = [V::splat(1.0); N];
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = sum.fma(factor, term);
            }
        }
        let mut lanes = [0.0; LANES];
        let mut total = 0.0;
        for sum in sums {
            sum.store(&mut lanes);
            total += lanes.iter().sum::<f32>();
        }
        (self.0 * N * V::LANES, total)
    }
}

impl VectorKernel<f32> for Chains {
    type Output = (usize, f32);

    /// As many chains as the registers hold and hide the latency: where a vector is two
    /// registers, each chain is two.
    #[inline(always)]
    fn run<V: Vector<Element = f32>>(self) -> (usize, f32) {
        if V::REGISTERS > 16 { self.chains::<V, 12>() } else { self.chains::<V, 6>() }
    }
}

impl Machine {
    /// Measures for about a second and prints the rates.
    pub fn measure(one: &ThreadPool, all: &ThreadPool, quick: bool) -> Self {
        let turns = if quick { 3 } else { 7 };
        let from = vec![1.0f32; COPY];
        let mut to = vec![0.0f32; COPY];
        let mut copy = |pool: &ThreadPool| {
            let piece = COPY.div_ceil(pool.current_num_threads());
            let once = |to: &mut [f32]| {
                let start = Instant::now();
                pool.install(|| {
                    let pieces = to.par_chunks_mut(piece).zip(from.par_chunks(piece));
                    pieces.for_each(|(to, from)| to.copy_from_slice(from));
                });
                black_box(&to);
                8e-9 * COPY as f64 / start.elapsed().as_secs_f64()
            };
            (0..turns).map(|_| once(&mut to)).fold(0.0, f64::max)
        };
        let copy = [copy(one), copy(all)];
        // The copy to pages that are touched for the first time, like those of every tensor that
        // an op returns.
        let copy_new = |pool: &ThreadPool| {
            let once = || {
                let start = Instant::now();
                let new: Vec<f32> = pool.install(|| from.par_iter().copied().collect());
                black_box(&new);
                8e-9 * COPY as f64 / start.elapsed().as_secs_f64()
            };
            (0..turns).map(|_| once()).fold(0.0, f64::max)
        };
        let copy_new = [copy_new(one), copy_new(all)];
        let fma = [one, all].map(|pool| {
            let once = || {
                let start = Instant::now();
                let done = pool.broadcast(|_| black_box(f32::dispatch(Chains(STEPS))).0);
                2e-9 * done.iter().sum::<usize>() as f64 / start.elapsed().as_secs_f64()
            };
            (0..turns).map(|_| once()).fold(0.0, f64::max)
        });
        println!(
            "SIMD level {}; machine: copy {:.1} GB/s on 1 thread, {:.1} on {n} (into new pages \
             {:.1}, {:.1}); multiply-adds {:.0} GFLOP/s on 1, {:.0} on {n} (f32)",
            SimdLevel::best().name(),
            copy[0],
            copy[1],
            copy_new[0],
            copy_new[1],
            fma[0],
            fma[1],
            n = all.current_num_threads()
        );
        Self { copy, fma }
    }
}
