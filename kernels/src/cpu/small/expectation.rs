//! Expected candidate of a softmax over candidates, and the probability near its mode.
//!
//! Logits `[B, D, n]`, out `[2, B, n]`: the mean of k under p = softmax(logits), and
//! the mass Σ p over |k − mode| ≤ window. The mean is over all candidates, or over the
//! window alone (divided by its mass). The mode is a constant to gradients.

use crate::cpu::simd::elementary::exp;
use crate::cpu::simd::vectorize;
use rayon::prelude::*;

/// Pixels per step of a loop.
const LANES: usize = 16;

/// Candidates over which a mean is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeanOver {
    /// All candidates.
    All,
    /// Those of the window alone.
    Window,
}

/// Sizes and rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expectation {
    /// D.
    pub candidates: usize,
    /// n: pixels of a map.
    pub pixels: usize,
    /// Half-width of the window around the mode, in candidates.
    pub window: usize,
    /// Candidates over which the mean is taken.
    pub mean: MeanOver,
}

/// Results of the softmax of one pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Pixel {
    /// Largest logit, and 1 / Σ e^{logit − max}.
    max: f32,
    inverse: f32,
    /// First candidate with the largest logit.
    mode: f32,
    mean: f32,
    mass: f32,
}

impl Expectation {
    /// Up to [`LANES`] pixels from `at` of one map's `logits` `[D, n]`.
    #[inline(always)]
    fn pixels(&self, logits: &[f32], at: usize, count: usize) -> [Pixel; LANES] {
        let (n, d) = (self.pixels, self.candidates);
        let row = |k: usize| -> [f32; LANES] {
            let from = &logits[k * n + at..][..count];
            match from.try_into() {
                Ok(whole) => whole,
                Err(_) => std::array::from_fn(|l| from.get(l).copied().unwrap_or(0.0)),
            }
        };
        let mut max = [f32::NEG_INFINITY; LANES];
        let mut mode = [0f32; LANES];
        for k in 0..d {
            let x = row(k);
            for l in 0..LANES {
                mode[l] = if x[l] > max[l] { k as f32 } else { mode[l] };
                max[l] = if x[l] > max[l] { x[l] } else { max[l] };
            }
        }
        let reach = self.window as f32 + 0.5;
        let (mut all, mut near) = ([0f32; LANES], [0f32; LANES]);
        let (mut first, mut first_near) = ([0f32; LANES], [0f32; LANES]);
        for k in 0..d {
            let x = row(k);
            // Indices count from the mode, so that sums do not lose digits to large ones.
            for l in 0..LANES {
                let e = exp(x[l] - max[l]);
                let away = k as f32 - mode[l];
                let inside = if away.abs() <= reach { e } else { 0.0 };
                all[l] += e;
                near[l] += inside;
                first[l] += away * e;
                first_near[l] += away * inside;
            }
        }
        std::array::from_fn(|l| {
            let inverse = 1.0 / all[l];
            let away = match self.mean {
                MeanOver::Window => first_near[l] / near[l],
                MeanOver::All => first[l] * inverse,
            };
            let mean = mode[l] + away;
            let mass = near[l] * inverse;
            Pixel { max: max[l], inverse, mode: mode[l], mean, mass }
        })
    }
}

/// Mean and mass.
pub fn forward(e: &Expectation, logits: &[f32], out: &mut [f32]) {
    let (n, d) = (e.pixels, e.candidates);
    let (means, masses) = out.split_at_mut(out.len() / 2);
    let maps = means.par_chunks_exact_mut(n).zip(masses.par_chunks_exact_mut(n));
    maps.zip(logits.par_chunks_exact(d * n)).for_each(|((means, masses), logits)| {
        let parts = means.par_chunks_mut(LANES).zip(masses.par_chunks_mut(LANES));
        parts.enumerate().with_min_len(8).for_each(|(i, (means, masses))| {
            let pixels = vectorize(
                #[inline(always)]
                || e.pixels(logits, i * LANES, means.len()),
            );
            for ((mean, mass), p) in means.iter_mut().zip(masses).zip(pixels) {
                (*mean, *mass) = (p.mean, p.mass);
            }
        });
    });
}

/// Gradient of the logits for `grad` `[2, B, n]`.
pub fn backward(e: &Expectation, logits: &[f32], grad: &[f32], out: &mut [f32]) {
    let (n, d) = (e.pixels, e.candidates);
    let (d_means, d_masses) = grad.split_at(grad.len() / 2);
    let mut pixels = vec![Pixel::default(); d_means.len()];
    pixels.par_chunks_exact_mut(n).zip(logits.par_chunks_exact(d * n)).for_each(|(all, logits)| {
        all.par_chunks_mut(LANES).enumerate().with_min_len(8).for_each(|(i, part)| {
            let found = vectorize(
                #[inline(always)]
                || e.pixels(logits, i * LANES, part.len()),
            );
            let count = part.len();
            part.copy_from_slice(&found[..count]);
        });
    });
    // dp/dlogit: p·(c_k − Σ p·c), c_k the gradient with respect to p_k.
    let reach = e.window as f32 + 0.5;
    out.par_chunks_exact_mut(n).enumerate().for_each(|(plane, out)| {
        let b = plane / d;
        let k = (plane % d) as f32;
        let (pixels, x) = (&pixels[b * n..(b + 1) * n], &logits[plane * n..(plane + 1) * n]);
        let grads = d_means[b * n..(b + 1) * n].iter().zip(&d_masses[b * n..(b + 1) * n]);
        vectorize(
            #[inline(always)]
            || {
                for (((out, x), p), (g, m)) in out.iter_mut().zip(x).zip(pixels).zip(grads) {
                    let inside = if (k - p.mode).abs() <= reach { 1.0 } else { 0.0 };
                    let share = exp(x - p.max) * p.inverse;
                    let of_mean = match e.mean {
                        MeanOver::Window => inside * (k - p.mean) / p.mass,
                        MeanOver::All => k - p.mean,
                    };
                    *out = share * (of_mean * g + (inside - p.mass) * m);
                }
            },
        );
    });
}
