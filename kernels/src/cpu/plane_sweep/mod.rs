//! Plane sweep: correlation of every reference pixel with the source pixels that it
//! would fall on at each candidate depth. Warp and dot product are one loop; the
//! warped volume (half a gigabyte at two 256² views) never exists.
//!
//! reference `[R, C, h, w]`, source `[S, C, h, w]`, depths `[R, D]`; out
//! `[R, D, h, w]` = scale · mean over the pairs of Σ_c f·bilinear(g), zero outside
//! the source (per tap). Source: MVSplat section 3. Gradient: [`backward`].
//!
//! Each distinct source cell is multiplied once, because a pixel's candidates lie on one epipolar line. Two
//! 64×64×128 maps over 128 depths take 35 ms; warp, then dot product, 1443 ms (`cargo bench --bench sweep`, two threads of an
//! AMD EPYC with AVX-512).

mod backward;

pub use crate::layout::{Pair, Sweep};
pub use backward::backward;

use super::simd::vectorize;
use super::sums::dot;
use rayon::prelude::*;

/// Taps of a sample: index of the upper left tap and the four weights, zero for
/// taps outside.
struct Sample {
    taps: [usize; 4],
    weights: [f32; 4],
}

impl Sweep {
    /// Source index coordinates (0 = centre of the first pixel) and camera z.
    #[inline(always)]
    fn place(&self, p: &Pair, x: usize, y: usize, depth: f32) -> (f32, f32, f32) {
        let (x, y) = (x as f32 + self.centre, y as f32 + self.centre);
        let (x, y) = (p.inverse[0] * x + p.inverse[2], p.inverse[1] * y + p.inverse[3]);
        let r = &p.rotation;
        let px = (r[0] * x + r[1] * y + r[2]) * depth + p.t[0];
        let py = (r[3] * x + r[4] * y + r[5]) * depth + p.t[1];
        let pz = (r[6] * x + r[7] * y + r[8]) * depth + p.t[2];
        let z = if pz > self.min_z { pz } else { self.min_z };
        let [fx, fy, cx, cy] = p.k;
        ((fx * px + cx * pz) / z - self.centre, (fy * py + cy * pz) / z - self.centre, pz)
    }

    /// Bilinear taps at (u, v), or `None` where all four lie outside.
    #[inline(always)]
    fn sample(&self, u: f32, v: f32) -> Option<Sample> {
        let [h, w] = self.size;
        // Also refuses NaN.
        if !(u > -1.0 && v > -1.0 && u < w as f32 && v < h as f32) {
            return None;
        }
        let (left, top) = (u.floor(), v.floor());
        let (fx, fy) = (u - left, v - top);
        let (x0, y0) = (left as isize, top as isize);
        let mut s = Sample { taps: [0; 4], weights: [0.0; 4] };
        for (i, (dy, wy)) in [(0, 1.0 - fy), (1, fy)].into_iter().enumerate() {
            for (j, (dx, wx)) in [(0, 1.0 - fx), (1, fx)].into_iter().enumerate() {
                let (x, y) = (x0 + dx, y0 + dy);
                if x >= 0 && y >= 0 && x < w as isize && y < h as isize {
                    s.taps[2 * i + j] = y as usize * w + x as usize;
                    s.weights[2 * i + j] = wx * wy;
                }
            }
        }
        Some(s)
    }

    /// Returns whether the sample lies inside the source picture and in front of it.
    #[inline(always)]
    fn valid(&self, (u, v, z): (f32, f32, f32)) -> bool {
        let [h, w] = self.size;
        z > self.min_z && u >= 0.0 && v >= 0.0 && u <= (w - 1) as f32 && v <= (h - 1) as f32
    }
}

/// `[rows, C, n]` to `[rows, n, C]`.
fn channels_last(channels: usize, n: usize, x: &[f32]) -> Vec<f32> {
    let mut out = vec![0f32; x.len()];
    let rows = x.par_chunks_exact((channels * n).max(1));
    rows.zip(out.par_chunks_exact_mut((channels * n).max(1))).for_each(|(x, out)| {
        for (c, plane) in x.chunks_exact(n).enumerate() {
            for (v, pixel) in plane.iter().zip(out.chunks_exact_mut(channels)) {
                pixel[c] = *v;
            }
        }
    });
    out
}

/// Working memory of one thread: where the candidates of one reference pixel fall,
/// and the source cells that they touch.
struct Walk {
    /// `[D]`: source index coordinates.
    u: Vec<f32>,
    v: Vec<f32>,
    /// `[h·w]`: the last pixel that touched the cell, and what it left there.
    cells: Vec<Cell>,
    /// Number of the current pixel; 0 is none.
    pixel: u32,
}

/// Values of a source cell for the current pixel.
#[derive(Clone, Copy, Default)]
struct Cell {
    pixel: u32,
    value: f32,
}

impl Walk {
    fn new(s: &Sweep) -> Self {
        let d = s.candidates();
        let n = s.size[0] * s.size[1];
        Self { u: vec![0.0; d], v: vec![0.0; d], cells: vec![Cell::default(); n], pixel: 0 }
    }

    /// Starts reference pixel (x, y): clears the cells and places all candidates.
    #[inline(always)]
    fn begin(&mut self, s: &Sweep, pair: &Pair, (x, y): (usize, usize), depths: &[f32]) {
        self.pixel = self.pixel.wrapping_add(1);
        if self.pixel == 0 {
            self.cells.fill(Cell::default());
            self.pixel = 1;
        }
        for ((u, v), &depth) in self.u.iter_mut().zip(&mut self.v).zip(depths) {
            (*u, *v, _) = s.place(pair, x, y, depth);
        }
    }

    /// The cell's value for the current pixel; `first` gives it at the first touch.
    #[inline(always)]
    fn value(&mut self, cell: usize, first: impl FnOnce() -> f32) -> &mut f32 {
        let slot = &mut self.cells[cell];
        if slot.pixel != self.pixel {
            *slot = Cell { pixel: self.pixel, value: first() };
        }
        &mut slot.value
    }
}

/// Correlation `[R, D, h, w]`.
///
/// Candidates of one pixel lie on one epipolar line and share most of their taps, so
/// each distinct source cell is multiplied with the pixel's features once.
pub fn correlation(s: &Sweep, reference: &[f32], source: &[f32], out: &mut [f32]) {
    let ([h, w], c, d) = (s.size, s.channels, s.candidates());
    if out.is_empty() {
        return;
    }
    let n = h * w;
    let reference = channels_last(c, n, reference);
    let source = channels_last(c, n, source);
    // `[R, h, D, w]`: the results of one task are contiguous.
    let mut rows = vec![0f32; out.len()];
    rows.par_chunks_exact_mut(d * w).enumerate().for_each_init(
        || Walk::new(s),
        |walk, (row, out)| {
            let (r, y) = (row / h, row % h);
            let factor = s.scale / s.pairs[r].len().max(1) as f32;
            for pair in &s.pairs[r] {
                let other = &source[pair.source * n * c..(pair.source + 1) * n * c];
                let own = &reference[(r * n + y * w) * c..(r * n + (y + 1) * w) * c];
                vectorize(
                    #[inline(always)]
                    || {
                        for (x, f) in own.chunks_exact(c).enumerate() {
                            walk.begin(s, pair, (x, y), &s.depths[r]);
                            for k in 0..d {
                                let Some(at) = s.sample(walk.u[k], walk.v[k]) else { continue };
                                for (tap, weight) in at.taps.into_iter().zip(at.weights) {
                                    if weight != 0.0 {
                                        let g = &other[tap * c..(tap + 1) * c];
                                        let dot = *walk.value(tap, || dot(f, g));
                                        out[k * w + x] += weight * factor * dot;
                                    }
                                }
                            }
                        }
                    },
                );
            }
        },
    );
    out.par_chunks_exact_mut(n).enumerate().for_each(|(plane, out)| {
        let (r, k) = (plane / d, plane % d);
        for (y, out) in out.chunks_exact_mut(w).enumerate() {
            out.copy_from_slice(&rows[((r * h + y) * d + k) * w..][..w]);
        }
    });
}

/// Share of the pairs whose sample lies inside the source and in front of its
/// camera, `[R, D, h, w]`.
pub fn validity(s: &Sweep, out: &mut [f32]) {
    let ([h, w], d) = (s.size, s.candidates());
    if out.is_empty() {
        return;
    }
    out.par_chunks_exact_mut(h * w).enumerate().for_each(|(plane, out)| {
        let (r, k) = (plane / d, plane % d);
        let share = 1.0 / s.pairs[r].len().max(1) as f32;
        for (i, out) in out.iter_mut().enumerate() {
            let inside = |p: &&Pair| s.valid(s.place(p, i % w, i / w, s.depths[r][k]));
            *out = share * s.pairs[r].iter().filter(inside).count() as f32;
        }
    });
}

/// The warped source features themselves, for tracing: candidate `k` of reference
/// row `r` and its pair number `pair`, `[C, h, w]`.
pub fn warp(s: &Sweep, r: usize, pair: usize, k: usize, source: &[f32]) -> Vec<f32> {
    let ([h, w], c) = (s.size, s.channels);
    let mut out = vec![0f32; c * h * w];
    let Some(pair) = s.pairs.get(r).and_then(|p| p.get(pair)) else { return out };
    let other = &source[pair.source * c * h * w..(pair.source + 1) * c * h * w];
    for i in 0..h * w {
        let (u, v, _) = s.place(pair, i % w, i / w, s.depths[r][k]);
        let Some(sample) = s.sample(u, v) else { continue };
        for (plane, out) in other.chunks_exact(h * w).zip(out.chunks_exact_mut(h * w)) {
            let taps = sample.taps.into_iter().zip(sample.weights);
            out[i] = taps.map(|(tap, weight)| weight * plane[tap]).sum();
        }
    }
    out
}
