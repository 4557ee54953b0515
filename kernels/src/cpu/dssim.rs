//! SSIM of one plane over windows inside the picture, and its derivative (Wang et al.
//! 2004). Reference and conventions: finish/loss.rs, `subsplat::scene::metrics::ssim`.
//!
//! Windowed means are two passes of N taps, each with a block of results in registers.
//! The transpose of a windowed mean is a windowed mean with reversed taps of the map with
//! N − 1 zeros around it.

use super::simd::vectorize;
use super::sums::sum_of;

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

/// A map with N − 1 rows and columns of zeros on every side.
struct Padded {
    data: Vec<f32>,
    width: usize,
    height: usize,
}

impl Padded {
    fn new<const N: usize>(width: usize, height: usize) -> Self {
        let (width, height) = (width + 2 * (N - 1), height + 2 * (N - 1));
        Self { data: vec![0.0; width * height], width, height }
    }

    #[inline(always)]
    fn row<const N: usize>(&mut self, y: usize, width: usize) -> &mut [f32] {
        &mut self.data[(y + N - 1) * self.width + N - 1..][..width]
    }

    /// The transpose of the windowed mean: N − 1 rows and columns more than the map.
    #[inline(always)]
    fn spread<const N: usize>(&self, taps: &[f32; N]) -> Vec<f32> {
        let mut turned = *taps;
        turned.reverse();
        let (width, height) = (self.width + 1 - N, self.height + 1 - N);
        let mut rows = vec![0.0; width * self.height];
        for (row, out) in self.data.chunks_exact(self.width).zip(rows.chunks_exact_mut(width)) {
            pass(&turned, row, 1, out);
        }
        let mut out = vec![0.0; width * height];
        pass(&turned, &rows, width, &mut out);
        out
    }
}

/// Sum of SSIM over one plane's windows; `g` becomes `factor` times its derivative by
/// `x`. Planes `x`, `t` and `g` are `width` wide and at least N in both directions.
pub fn plane<const N: usize>(
    window: &Window<N>,
    [x, t]: [&[f32]; 2],
    width: usize,
    factor: f32,
    g: &mut [f32],
) -> f64 {
    vectorize(
        #[inline(always)]
        || run(window, [x, t], width, factor, g),
    )
}

#[inline(always)]
fn run<const N: usize>(
    window: &Window<N>,
    [x, t]: [&[f32]; 2],
    width: usize,
    factor: f32,
    g: &mut [f32],
) -> f64 {
    let inner = width + 1 - N;
    let height = x.len() / width;
    let rows = height + 1 - N;
    // Means along rows of x, t, x², t² and x·t, side by side.
    let mut across = vec![0f32; 5 * inner * height];
    let mut square = [vec![0f32; width], vec![0f32; width], vec![0f32; width]];
    for (y, out) in across.chunks_exact_mut(5 * inner).enumerate() {
        let (x, t) = (&x[y * width..][..width], &t[y * width..][..width]);
        let [xx, tt, xt] = &mut square;
        for i in 0..width {
            (xx[i], tt[i], xt[i]) = (x[i] * x[i], t[i] * t[i], x[i] * t[i]);
        }
        for (from, out) in [x, t, xx, tt, xt].into_iter().zip(out.chunks_exact_mut(inner)) {
            pass(&window.taps, from, 1, out);
        }
    }
    let [mut by_x, mut by_xx, mut by_xt] = [(); 3].map(|()| Padded::new::<N>(inner, rows));
    let mut means = vec![0f32; 5 * inner];
    let mut scores = vec![0f32; inner];
    let mut sum = 0.0;
    for y in 0..rows {
        pass(&window.taps, &across[y * 5 * inner..], 5 * inner, &mut means);
        let out = [by_x.row::<N>(y, inner), by_xx.row::<N>(y, inner), by_xt.row::<N>(y, inner)];
        row(window, &means, &mut scores, out);
        sum += sum_of(&scores, |v| v);
    }
    let [by_x, by_xx, by_xt] =
        [by_x.spread(&window.taps), by_xx.spread(&window.taps), by_xt.spread(&window.taps)];
    for (i, g) in g.iter_mut().enumerate() {
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
