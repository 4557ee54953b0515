//! SSIM of one plane over windows inside the picture, and its derivative (Wang et al.
//! 2004). Reference and conventions: finish/loss.rs, `subsplat::scene::metrics::ssim`.
//!
//! Windowed means are two passes of N taps, each with a block of results in registers.
//! The transpose of a windowed mean is a windowed mean with reversed taps of the map with
//! N − 1 zeros around it. A plane is computed in bands of rows, which threads share. WGSL:
//! wgsl/finish/dssim_windows.wgsl, wgsl/finish/loss_gradient.wgsl.

use super::simd::vectorize;
use super::sums::sum_of;
use std::ops::Range;

/// Taps of the window's one axis, and the constants of SSIM.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window<const N: usize> {
    /// Sum 1.
    pub taps: [f32; N],
    /// C₁ and C₂.
    pub c: [f32; 2],
    /// Factor of variances and covariances (n/(n − 1) for the sample's).
    pub covariance: f32,
}

/// Results that a pass holds in registers.
const BLOCK: usize = 64;

/// out[i] = Σₖ taps[k]·from[i + k·step], for every i of `out`.
#[inline(always)]
fn pass<const N: usize>(taps: &[f32; N], from: &[f32], step: usize, out: &mut [f32]) {
    let (whole, rest) = out.split_at_mut(out.len() / BLOCK * BLOCK);
    for (i, out) in whole.chunks_exact_mut(BLOCK).enumerate() {
        let mut sums = [0f32; BLOCK];
        for (k, tap) in taps.iter().enumerate() {
            let from = &from[i * BLOCK + k * step..][..BLOCK];
            for j in 0..BLOCK {
                sums[j] += tap * from[j];
            }
        }
        out.copy_from_slice(&sums);
    }
    rest.fill(0.0);
    for (k, tap) in taps.iter().enumerate() {
        let from = &from[whole.len() + k * step..];
        for (sum, v) in rest.iter_mut().zip(from) {
            *sum += tap * v;
        }
    }
}

/// Buffers of [`band`], for one band after the other.
#[derive(Debug, Default)]
pub struct Scratch {
    /// Means along rows of x, t, x², t² and x·t, side by side.
    across: Vec<f32>,
    /// x², t² and x·t of a row.
    squares: Vec<f32>,
    /// The same means over windows of a row, then the scores.
    means: Vec<f32>,
    /// Derivatives by the windows' means of x, x² and x·t, with N − 1 zeros on both sides, and rows of zeros where there
    /// are no windows.
    maps: [Vec<f32>; 3],
    /// A map after the pass along its rows.
    rows: Vec<f32>,
    /// The transposes of the windowed means.
    spread: [Vec<f32>; 3],
}

/// Sum of SSIM over the windows of one plane whose first row is in `rows`; `g`, the pixels of these rows, becomes
/// `factor` times the derivative of the whole plane's sum by `x`. Planes `x` and `t` are `width` wide and at least N in
/// both directions.
///
/// Bands of a plane have the same `g` as the whole plane. Each repeats N − 1 rows of windows of the one before.
pub fn band<const N: usize>(
    window: &Window<N>,
    [x, t]: [&[f32]; 2],
    width: usize,
    rows: Range<usize>,
    factor: f32,
    g: &mut [f32],
    scratch: &mut Scratch,
) -> f64 {
    vectorize(
        #[inline(always)]
        || run(window, [x, t], width, rows, factor, g, scratch),
    )
}

#[inline(always)]
fn run<const N: usize>(
    window: &Window<N>,
    [x, t]: [&[f32]; 2],
    width: usize,
    rows: Range<usize>,
    factor: f32,
    g: &mut [f32],
    scratch: &mut Scratch,
) -> f64 {
    let inner = width + 1 - N;
    let windows = rows.start.saturating_sub(N - 1)..rows.end.min(x.len() / width + 1 - N);
    let Scratch { across, squares, means, maps, rows: passed, spread } = scratch;
    across.resize(5 * inner * (windows.len() + N - 1), 0.0);
    squares.resize(3 * width, 0.0);
    for (y, out) in across.chunks_exact_mut(5 * inner).enumerate() {
        let y = windows.start + y;
        let (x, t) = (&x[y * width..][..width], &t[y * width..][..width]);
        let (xx, rest) = squares.split_at_mut(width);
        let (tt, xt) = rest.split_at_mut(width);
        for i in 0..width {
            (xx[i], tt[i], xt[i]) = (x[i] * x[i], t[i] * t[i], x[i] * t[i]);
        }
        for (from, out) in [x, t, xx, tt, xt].into_iter().zip(out.chunks_exact_mut(inner)) {
            pass(&window.taps, from, 1, out);
        }
    }
    // Row 0 of a map is the window that begins N − 1 rows above the band.
    let (padded, count) = (inner + 2 * (N - 1), rows.len() + N - 1);
    for map in &mut *maps {
        map.clear();
        map.resize(padded * count, 0.0);
    }
    means.resize(6 * inner, 0.0);
    let (means, scores) = means.split_at_mut(5 * inner);
    let mut sum = 0.0;
    for y in windows.clone() {
        pass(&window.taps, &across[(y - windows.start) * 5 * inner..], 5 * inner, means);
        let at = (y + N - 1 - rows.start) * padded + N - 1;
        row(window, means, scores, maps.each_mut().map(|map| &mut map[at..at + inner]));
        if rows.contains(&y) {
            sum += sum_of(scores, |v| v);
        }
    }
    // The transpose of a windowed mean.
    let mut turned = window.taps;
    turned.reverse();
    passed.resize(width * count, 0.0);
    for (map, out) in maps.iter().zip(&mut *spread) {
        for (row, out) in map.chunks_exact(padded).zip(passed.chunks_exact_mut(width)) {
            pass(&turned, row, 1, out);
        }
        out.resize(width * rows.len(), 0.0);
        pass(&turned, passed, width, out);
    }
    let pixels = rows.start * width..rows.end * width;
    let (x, t) = (&x[pixels.clone()], &t[pixels]);
    let [by_x, by_xx, by_xt] = spread.each_ref().map(|map| &map[..x.len()]);
    for (i, g) in g[..x.len()].iter_mut().enumerate() {
        *g = factor * (by_x[i] + 2.0 * x[i] * by_xx[i] + t[i] * by_xt[i]);
    }
    sum
}

/// SSIM of one row of windows, and its derivatives by the windows' means of x, of x² and
/// of x·t; `means`: of x, t, x², t² and x·t, one after the other.
#[inline(always)]
fn row<const N: usize>(
    window: &Window<N>,
    means: &[f32],
    scores: &mut [f32],
    [by_x, by_xx, by_xt]: [&mut [f32]; 3],
) {
    let n = scores.len();
    let (ux, rest) = means.split_at(n);
    let (ut, rest) = rest.split_at(n);
    let (mxx, rest) = rest.split_at(n);
    let (mtt, mxt) = rest.split_at(n);
    let (mxt, by_x, by_xx, by_xt) = (&mxt[..n], &mut by_x[..n], &mut by_xx[..n], &mut by_xt[..n]);
    let ([c1, c2], cov) = (window.c, window.covariance);
    for i in 0..n {
        let (ux, ut) = (ux[i], ut[i]);
        let variances = cov * (mxx[i] - ux * ux + mtt[i] - ut * ut) + c2;
        let covariance = 2.0 * cov * (mxt[i] - ux * ut) + c2;
        let light = 2.0 * ux * ut + c1;
        let lights = ux * ux + ut * ut + c1;
        let s = light * covariance / (lights * variances);
        let by_light = 2.0 * ut / light - 2.0 * ux / lights;
        let by_structure = 2.0 * cov * (ux / variances - ut / covariance);
        scores[i] = s;
        by_x[i] = s * (by_light + by_structure);
        by_xx[i] = -s * cov / variances;
        by_xt[i] = 2.0 * s * cov / covariance;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::random;

    #[test]
    fn bands_are_parts_of_the_plane() {
        let (width, height) = (23, 50);
        let value = |i: usize| (random::mix(i as u64 + 1) >> 40) as f32 / 2f32.powi(24);
        let x: Vec<f32> = (0..width * height).map(value).collect();
        let t: Vec<f32> =
            x.iter().enumerate().map(|(i, x)| 0.6 * x + 0.4 * value(i + 9000)).collect();
        let shape = Window { taps: [0.1, 0.2, 0.4, 0.2, 0.1], c: [1e-4, 9e-4], covariance: 1.04 };
        let mut scratch = Scratch::default();
        let mut whole = vec![0.0; x.len()];
        let sum = band(&shape, [&x, &t], width, 0..height, -0.3, &mut whole, &mut scratch);
        assert!(sum.abs() > 1.0 && whole.iter().all(|g| *g != 0.0));
        for rows in [1, 3, 4, 17, 49] {
            let (mut parts, mut sum_of_parts) = (vec![0.0; x.len()], 0.0);
            for (i, g) in parts.chunks_mut(rows * width).enumerate() {
                let band_rows = i * rows..i * rows + g.len() / width;
                sum_of_parts += band(&shape, [&x, &t], width, band_rows, -0.3, g, &mut scratch);
            }
            assert_eq!(parts, whole, "{rows}");
            assert!((sum_of_parts / sum - 1.0).abs() < 1e-12, "{rows}: {sum_of_parts} {sum}");
        }
    }
}
