//! The forward pass in f32 for one group and one point a view and level, as every
//! preset has it: a parent's taps fit in registers and on the stack.
//!
//! The same formulas as [`super::forward`], which is its oracle in
//! tests/network/attention_gather.rs.
#![expect(
    clippy::needless_range_loop,
    reason = "counted loops over registers unroll, iterators over them need not"
)]

use super::{BLOCK, Gather};
use crate::cpu::simd::elementary::exp;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel, Vector};
use rayon::prelude::*;

/// Most samples of a parent, and four times as many taps.
const SAMPLES: usize = 32;
const TAPS: usize = 4 * SAMPLES;
/// Taps whose dot products are summed at once, vectors of the result at once: as many chains as
/// hide a product's latency, where a vector is one register.
const WIDE: usize = 8;
/// The same where a vector is more than one register, of which there are fewer.
const NARROW: usize = 4;

/// Returns whether [`forward`] supports `g`.
pub(super) fn suits(g: &Gather) -> bool {
    g.groups == 1
        && g.points == 1
        && !g.points_per_level
        && g.key.is_some()
        && g.drop.is_none()
        && g.samples() <= SAMPLES
        && g.dim.is_multiple_of(WIDE * LANES)
}

/// As [`super::forward`].
pub(super) fn forward(g: &Gather, maps: &[f32], query: &[f32], points: &[f32], out: &mut [f32]) {
    let q_width = g.query_width();
    let p_width = 2 * g.views;
    let key = g.key.unwrap_or(0);
    assert!(key.max(g.value) + g.dim <= g.stride, "attention gather: keys and values in a row");
    let blocks = out.par_chunks_mut(BLOCK * g.dim);
    let blocks = blocks.zip(query.par_chunks(BLOCK * q_width));
    blocks.zip(points.par_chunks(BLOCK * p_width)).for_each(|((out, query), points)| {
        SimdLevel::best().run(Block { g, key, maps, query, points, out });
    });
}

struct Block<'a> {
    g: &'a Gather,
    key: usize,
    maps: &'a [f32],
    query: &'a [f32],
    points: &'a [f32],
    out: &'a mut [f32],
}

/// Taps of one parent, sample after sample.
struct Taps {
    /// First float of the cell's row.
    at: [usize; TAPS],
    /// Bilinear weight, then factor of the value row.
    weight: [f32; TAPS],
    /// Sample of the tap.
    sample: [usize; TAPS],
    count: usize,
    /// True where a sample is in the softmax.
    live: [bool; SAMPLES],
}

impl Taps {
    #[inline(always)]
    fn place(&mut self, g: &Gather, points: &[f32]) {
        self.count = 0;
        let levels = g.levels.len();
        let shift = g.sample_convention.shift() as f32;
        for (v, at) in points.chunks_exact(2).enumerate() {
            let (rx, ry) = (at[0], at[1]);
            let inside = rx > 0.0 && rx < 1.0 && ry > 0.0 && ry < 1.0;
            for (l, level) in g.levels.iter().enumerate() {
                let sample = v * levels + l;
                self.live[sample] = inside || !g.renormalise;
                if !inside {
                    continue;
                }
                let (w, h) = (level.width, level.height);
                let first = level.first_cell + v * h * w;
                let (x, y) = (rx * w as f32 - shift, ry * h as f32 - shift);
                let (x0, y0) = (x.floor(), y.floor());
                let (fx, fy) = (x - x0, y - y0);
                // 0 < R < 1 bounds both by −1 and the map's size; −1 wraps round to
                // more than any size.
                let (x0, y0) = (x0 as isize as usize, y0 as isize as usize);
                for (dy, wy) in [(0usize, 1.0 - fy), (1, fy)] {
                    let cy = y0.wrapping_add(dy);
                    if cy >= h {
                        continue;
                    }
                    for (dx, wx) in [(0usize, 1.0 - fx), (1, fx)] {
                        let cx = x0.wrapping_add(dx);
                        if cx < w {
                            self.at[self.count] = (first + cy * w + cx) * g.stride;
                            self.weight[self.count] = wx * wy;
                            self.sample[self.count] = sample;
                            self.count += 1;
                        }
                    }
                }
            }
        }
    }

    /// Weights to factors of the value rows, from the taps' q·k; false where every sample
    /// is masked.
    #[inline(always)]
    fn attend(&mut self, g: &Gather, dots: &[f32; TAPS], bias: &[f32], gates: &[f32]) -> bool {
        let mut logits = [0f32; SAMPLES];
        let samples = bias.len();
        logits[..samples].copy_from_slice(bias);
        let scale = g.logit_scale as f32;
        for t in 0..self.count {
            logits[self.sample[t]] += scale * self.weight[t] * dots[t];
        }
        let mut top = f32::NEG_INFINITY;
        for (logit, &live) in logits[..samples].iter().zip(&self.live) {
            top = if live && !(*logit <= top) { *logit } else { top };
        }
        if !self.live[..samples].contains(&true) {
            return false;
        }
        let mut sum = 0.0;
        for (logit, &live) in logits[..samples].iter_mut().zip(&self.live) {
            *logit = if live { exp(*logit - top) } else { 0.0 };
            sum += *logit;
        }
        let (inverse, levels) = (1.0 / sum, g.levels.len());
        for (logits, gate) in logits[..samples].chunks_exact_mut(levels).zip(gates) {
            logits.iter_mut().for_each(|p| *p *= inverse * gate);
        }
        for t in 0..self.count {
            self.weight[t] *= logits[self.sample[t]];
        }
        true
    }
}

/// # Safety
/// Sixteen floats at `p`.
#[inline(always)]
unsafe fn lanes<S: Simd>(s: S, p: *const f32) -> S::F {
    // SAFETY: as the caller's; an array has the alignment of its elements.
    s.load(unsafe { &*p.cast::<[f32; LANES]>() })
}

/// q·k of the taps, `N` at once; `N` divides [`TAPS`].
///
/// # Safety
/// Rows of `dim` keys at every one of `taps`, `dim` floats in `q`; `dim` in whole vectors.
#[inline(always)]
unsafe fn products<S: Simd, const N: usize>(
    s: S,
    q: &[f32],
    keys: *const f32,
    taps: &Taps,
    dots: &mut [f32; TAPS],
) {
    for first in (0..taps.count).step_by(N) {
        let mut rows = [keys; N];
        for (row, at) in rows.iter_mut().zip(&taps.at[first..taps.count]) {
            *row = keys.wrapping_add(*at);
        }
        let mut sums = [s.splat(0.0); N];
        for c in (0..q.len()).step_by(LANES) {
            // SAFETY: as the caller's; rows past the last tap are the first of the maps.
            unsafe {
                let q = lanes(s, q.as_ptr().add(c));
                for t in 0..N {
                    sums[t] = q.fma(lanes(s, rows[t].add(c)), sums[t]);
                }
            }
        }
        dots[first..first + N].copy_from_slice(&s.sums(sums));
    }
}

/// Σ weight · value row into `out`, `N` vectors at once.
///
/// # Safety
/// As [`products`], of values and `out`.
#[inline(always)]
unsafe fn blend<S: Simd, const N: usize>(s: S, values: *const f32, taps: &Taps, out: &mut [f32]) {
    for c in (0..out.len()).step_by(N * LANES) {
        let mut sums = [s.splat(0.0); N];
        for (at, weight) in taps.at[..taps.count].iter().zip(&taps.weight) {
            let row = values.wrapping_add(at + c);
            let weight = s.splat(*weight);
            for i in 0..N {
                // SAFETY: the caller's.
                sums[i] = weight.fma(unsafe { lanes(s, row.add(i * LANES)) }, sums[i]);
            }
        }
        for i in 0..N {
            // SAFETY: the caller's.
            let to = unsafe { &mut *out.as_mut_ptr().add(c + i * LANES).cast::<[f32; LANES]>() };
            s.store(sums[i], to);
        }
    }
}

impl Kernel for Block<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        if S::REGISTERS >= 32 { self.gather::<S, WIDE>(s) } else { self.gather::<S, NARROW>(s) }
    }
}

impl Block<'_> {
    #[inline(always)]
    fn gather<S: Simd, const N: usize>(self, s: S) {
        let Self { g, key, maps, query, points, out } = self;
        let mut taps = Taps {
            at: [0; TAPS],
            weight: [0.0; TAPS],
            sample: [0; TAPS],
            count: 0,
            live: [false; SAMPLES],
        };
        let mut dots = [0f32; TAPS];
        let samples = g.samples();
        let parents = query.chunks_exact(g.query_width()).zip(points.chunks_exact(2 * g.views));
        for ((query, points), out) in parents.zip(out.chunks_exact_mut(g.dim)) {
            taps.place(g, points);
            let (q, rest) = query.split_at(g.dim);
            let last = taps.at[..taps.count].iter().fold(0, |a, &b| a.max(b));
            assert!(last + g.stride <= maps.len(), "attention gather: a tap past the maps");
            // SAFETY: rows of `stride` floats lie inside the maps, as checked above; keys and
            // values inside a row ([`forward`]); `dim` is in whole vectors ([`suits`]).
            unsafe { products::<S, N>(s, q, maps.as_ptr().add(key), &taps, &mut dots) };
            if !taps.attend(g, &dots, &rest[..samples], &rest[samples..]) {
                out.fill(0.0);
                continue;
            }
            // SAFETY: as above.
            unsafe { blend::<S, N>(s, maps.as_ptr().add(g.value), &taps, out) };
        }
    }
}
