//! Plane sweep in two steps: all source features are warped to every candidate depth, then
//! multiplied by the reference and summed over channels. The warped volume is `[C, D, h, w]` per
//! pair, as from `grid_sample`; planes are distributed over rayon's current pool.

use rayon::prelude::*;
use subsplat::network::ops::plane_sweep::{Pair, Sweep};

/// Correlation `[R, D, h, w]`; `reference` `[R, C, h, w]`, `source` `[S, C, h, w]`.
pub fn correlation(s: &Sweep, reference: &[f32], source: &[f32]) -> Vec<f32> {
    let ([h, w], c, d) = (s.size, s.channels, s.depths[0].len());
    let n = h * w;
    let mut out = vec![0.0; s.pairs.len() * d * n];
    let mut volume = vec![0.0; c * d * n];
    for (r, out) in out.chunks_exact_mut(d * n).enumerate() {
        let factor = s.scale / s.pairs[r].len() as f32;
        let own = &reference[r * c * n..(r + 1) * c * n];
        for pair in &s.pairs[r] {
            let grid = grid(s, pair, &s.depths[r]);
            let planes = &source[pair.source * c * n..(pair.source + 1) * c * n];
            warp([h, w], planes, &grid, &mut volume);
            out.par_chunks_exact_mut(n).enumerate().for_each(|(k, out)| {
                for channel in 0..c {
                    let warped = &volume[(channel * d + k) * n..(channel * d + k + 1) * n];
                    let own = &own[channel * n..(channel + 1) * n];
                    for i in 0..n {
                        out[i] += factor * own[i] * warped[i];
                    }
                }
            });
        }
    }
    out
}

/// Returns the gradients of reference and source for `grad` `[R, D, h, w]`. The volume is warped
/// again, overwritten by its own gradient, and scattered back.
pub fn backward(
    s: &Sweep,
    reference: &[f32],
    source: &[f32],
    grad: &[f32],
) -> (Vec<f32>, Vec<f32>) {
    let ([h, w], c, d) = (s.size, s.channels, s.depths[0].len());
    let n = h * w;
    let (mut by_reference, mut by_source) = (vec![0.0; reference.len()], vec![0.0; source.len()]);
    let mut volume = vec![0.0; c * d * n];
    for (r, grad) in grad.chunks_exact(d * n).enumerate() {
        let factor = s.scale / s.pairs[r].len() as f32;
        let own = &reference[r * c * n..(r + 1) * c * n];
        let by_own = &mut by_reference[r * c * n..(r + 1) * c * n];
        for pair in &s.pairs[r] {
            let grid = grid(s, pair, &s.depths[r]);
            let at = pair.source * c * n..(pair.source + 1) * c * n;
            warp([h, w], &source[at.clone()], &grid, &mut volume);
            let channels = volume.par_chunks_exact_mut(d * n);
            let channels = channels.zip(own.par_chunks_exact(n));
            let channels = channels.zip(by_own.par_chunks_exact_mut(n));
            let channels = channels.zip(by_source[at].par_chunks_exact_mut(n));
            channels.for_each(|(((warped, own), by_own), by_plane)| {
                for (warped, grad) in warped.chunks_exact_mut(n).zip(grad.chunks_exact(n)) {
                    for i in 0..n {
                        by_own[i] += factor * grad[i] * warped[i];
                        warped[i] = factor * grad[i] * own[i];
                    }
                }
                scatter([h, w], warped, &grid, by_plane);
            });
        }
    }
    (by_reference, by_source)
}

/// Adds `warped` `[D, h, w]` to its taps.
fn scatter([h, w]: [usize; 2], warped: &[f32], grid: &[[f32; 2]], plane: &mut [f32]) {
    for (g, &[u, v]) in warped.iter().zip(grid) {
        let (left, top) = (u.floor(), v.floor());
        let (fx, fy) = (u - left, v - top);
        let (x, y) = (left as i32, top as i32);
        let mut add = |x: i32, y: i32, weight: f32| {
            if x >= 0 && y >= 0 && x < w as i32 && y < h as i32 {
                plane[y as usize * w + x as usize] += g * weight;
            }
        };
        let (right, below) = (x.wrapping_add(1), y.wrapping_add(1));
        add(x, y, (1.0 - fx) * (1.0 - fy));
        add(right, y, fx * (1.0 - fy));
        add(x, below, (1.0 - fx) * fy);
        add(right, below, fx * fy);
    }
}

/// Returns source columns and rows (0 = centre of the first pixel) `[D, h, w]`.
fn grid(s: &Sweep, p: &Pair, depths: &[f32]) -> Vec<[f32; 2]> {
    let [h, w] = s.size;
    let r = &p.rotation;
    let mut grid = Vec::with_capacity(depths.len() * h * w);
    for depth in depths {
        for y in 0..h {
            for x in 0..w {
                let x = p.inverse[0] * (x as f32 + s.centre) + p.inverse[2];
                let y = p.inverse[1] * (y as f32 + s.centre) + p.inverse[3];
                let px = (r[0] * x + r[1] * y + r[2]) * depth + p.t[0];
                let py = (r[3] * x + r[4] * y + r[5]) * depth + p.t[1];
                let pz = (r[6] * x + r[7] * y + r[8]) * depth + p.t[2];
                let z = pz.max(s.min_z);
                let [fx, fy, cx, cy] = p.k;
                grid.push([(fx * px + cx * pz) / z - s.centre, (fy * py + cy * pz) / z - s.centre]);
            }
        }
    }
    grid
}

/// Samples `planes` `[C, h, w]` at `grid` `[D, h, w]` into `volume` `[C, D, h, w]`; bilinear,
/// zeros outside.
fn warp([h, w]: [usize; 2], planes: &[f32], grid: &[[f32; 2]], volume: &mut [f32]) {
    let planes = planes.par_chunks_exact(h * w);
    planes.zip(volume.par_chunks_exact_mut(grid.len())).for_each(|(plane, out)| {
        for (out, &[u, v]) in out.iter_mut().zip(grid) {
            let (left, top) = (u.floor(), v.floor());
            let (fx, fy) = (u - left, v - top);
            let (x, y) = (left as i32, top as i32);
            let tap = |x: i32, y: i32| {
                let inside = x >= 0 && y >= 0 && x < w as i32 && y < h as i32;
                if inside { plane[y as usize * w + x as usize] } else { 0.0 }
            };
            *out = (1.0 - fy) * ((1.0 - fx) * tap(x, y) + fx * tap(x.wrapping_add(1), y))
                + fy * ((1.0 - fx) * tap(x, y.wrapping_add(1))
                    + fx * tap(x.wrapping_add(1), y.wrapping_add(1)));
        }
    });
}
