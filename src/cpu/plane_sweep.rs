//! Plane sweep: correlation of every reference pixel with the source pixels that it
//! would fall on at each candidate depth. Warp and dot product are one loop; the
//! warped volume (half a gigabyte at two 256² views) never exists.
//!
//! reference `[R, C, h, w]`, source `[S, C, h, w]`, depths `[R, D]`; out
//! `[R, D, h, w]` = scale · mean over the pairs of Σ_c f·bilinear(g), zero outside
//! the source (per tap). Source: MVSplat section 3.

use super::math::{dot, vectorised};
use rayon::prelude::*;

/// Reference pixel and depth to source pixel: p = a·(x, y, 1)·depth + b,
/// (u, v) = (p.x, p.y)/max(p.z, min_z).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Row of the source features.
    pub source: usize,
    /// K_s·R·K_r⁻¹, row-major.
    pub a: [f32; 9],
    /// K_s·t.
    pub b: [f32; 3],
}

/// Sizes and rules of one sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// For each reference row, whom it is compared with.
    pub pairs: Vec<Vec<Pair>>,
    /// `[R][D]`: candidate depths (camera z of the reference), world units.
    pub depths: Vec<Vec<f32>>,
    /// Coordinate of the centre of pixel 0: 0 (MVSplat) or ½ (`camera.rs`).
    pub centre: f32,
    /// Least z that the division sees.
    pub min_z: f32,
    /// Factor of the correlation (MVSplat: 1/√C).
    pub scale: f32,
    /// C.
    pub channels: usize,
    /// h, w of both feature maps.
    pub size: [usize; 2],
}

/// Where a sample falls: index of the upper left tap and the four weights, zero for
/// taps outside.
struct Sample {
    taps: [usize; 4],
    weights: [f32; 4],
}

impl Sweep {
    /// D.
    pub fn candidates(&self) -> usize {
        self.depths.first().map_or(0, Vec::len)
    }

    /// Source index coordinates (0 = centre of the first pixel) and camera z.
    #[inline(always)]
    fn place(&self, p: &Pair, x: usize, y: usize, depth: f32) -> (f32, f32, f32) {
        let (x, y) = (x as f32 + self.centre, y as f32 + self.centre);
        let a = &p.a;
        let px = (a[0] * x + a[1] * y + a[2]) * depth + p.b[0];
        let py = (a[3] * x + a[4] * y + a[5]) * depth + p.b[1];
        let pz = (a[6] * x + a[7] * y + a[8]) * depth + p.b[2];
        let z = if pz > self.min_z { pz } else { self.min_z };
        (px / z - self.centre, py / z - self.centre, pz)
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

    /// Whether the sample lies inside the source picture and in front of it.
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

/// Correlation `[R, D, h, w]`.
pub fn correlation(s: &Sweep, reference: &[f32], source: &[f32], out: &mut [f32]) {
    let ([h, w], c, d) = (s.size, s.channels, s.candidates());
    if out.is_empty() {
        return;
    }
    let reference = channels_last(c, h * w, reference);
    let source = channels_last(c, h * w, source);
    out.par_chunks_exact_mut(h * w).enumerate().for_each(|(plane, out)| {
        let (r, k) = (plane / d, plane % d);
        let own = &reference[r * h * w * c..(r + 1) * h * w * c];
        let factor = s.scale / s.pairs[r].len().max(1) as f32;
        out.fill(0.0);
        for pair in &s.pairs[r] {
            let other = &source[pair.source * h * w * c..(pair.source + 1) * h * w * c];
            vectorised(
                #[inline(always)]
                || {
                    for (i, out) in out.iter_mut().enumerate() {
                        let (u, v, _) = s.place(pair, i % w, i / w, s.depths[r][k]);
                        let Some(sample) = s.sample(u, v) else { continue };
                        let f = &own[i * c..(i + 1) * c];
                        for (tap, weight) in sample.taps.into_iter().zip(sample.weights) {
                            if weight != 0.0 {
                                *out += weight * factor * dot(f, &other[tap * c..(tap + 1) * c]);
                            }
                        }
                    }
                },
            );
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
