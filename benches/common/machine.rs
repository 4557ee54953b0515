//! Measured rates of this machine: copied bytes and multiply-adds per second.

use pulp::{Arch, Simd, WithSimd};
use rayon::ThreadPool;
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

/// Floats of each buffer of the copy: 128 MiB, beyond most caches.
const COPY: usize = 32 << 20;
/// Independent multiply-add chains: more than latency × units of any present core.
const CHAINS: usize = 12;
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

impl WithSimd for Chains {
    /// Number of multiply-adds, and a sum that depends on all of them.
    type Output = (usize, f32);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let (factor, term) = (simd.splat_f32s(black_box(0.999)), simd.splat_f32s(black_box(0.001)));
        let mut sums = [simd.splat_f32s(1.0); CHAINS];
        for _ in 0..self.0 {
            for sum in &mut sums {
                *sum = simd.mul_add_f32s(*sum, factor, term);
            }
        }
        let total = sums.into_iter().map(|s| simd.reduce_sum_f32s(s)).sum();
        (self.0 * CHAINS * S::F32_LANES, total)
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
                let done = pool.broadcast(|_| black_box(Arch::new().dispatch(Chains(STEPS))).0);
                2e-9 * done.iter().sum::<usize>() as f64 / start.elapsed().as_secs_f64()
            };
            (0..turns).map(|_| once()).fold(0.0, f64::max)
        });
        println!(
            "machine: copy {:.1} GB/s on 1 thread, {:.1} on {n} (into new pages {:.1}, {:.1}); \
             multiply-adds {:.0} GFLOP/s on 1, {:.0} on {n} (f32)",
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
