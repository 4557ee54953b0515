//! Losses of pictures as functions of slices: a value, and its analytic gradient. Training and
//! the fit of a scene to its photographs use them.

use crate::scene::metrics::{SSIM_C1, SSIM_C2, SSIM_COVARIANCE, SSIM_WINDOW, window};
use rayon::prelude::*;
use subsplat_kernels::cpu::dssim::{Scratch, Window, band};

/// A loss and its gradient with respect to one of its arguments.
#[derive(Clone, Debug, PartialEq)]
pub struct Scored {
    /// Value of the loss.
    pub value: f64,
    /// Derivative with respect to each element.
    pub gradient: Vec<f32>,
}

impl Scored {
    /// Returns a loss of 0 with zero gradients for `n` elements.
    pub fn zero(n: usize) -> Self {
        Self { value: 0.0, gradient: vec![0.0; n] }
    }

    /// Multiplies value and gradient by `factor`.
    #[must_use]
    pub fn scaled(mut self, factor: f64) -> Self {
        self.value *= factor;
        self.gradient.par_iter_mut().for_each(|g| *g *= factor as f32);
        self
    }

    /// Adds `factor` times `other`, a loss of the same argument.
    pub fn add(&mut self, other: &Self, factor: f64) {
        self.value += factor * other.value;
        let pairs = self.gradient.par_iter_mut().zip(&other.gradient);
        pairs.for_each(|(a, b)| *a += factor as f32 * b);
    }
}

/// Returns the mean squared difference of `x` and `target`.
pub fn mse(x: &[f32], target: &[f32]) -> Scored {
    let n = x.len().max(1) as f64;
    let sums: Vec<f64> = x
        .par_chunks(CHUNK)
        .zip(target.par_chunks(CHUNK))
        .map(|(x, t)| x.iter().zip(t).map(|(x, t)| f64::from(x - t).powi(2)).sum())
        .collect();
    let factor = (2.0 / n) as f32;
    let gradient = x.par_iter().zip(target).map(|(x, t)| factor * (x - t)).collect();
    Scored { value: sums.iter().sum::<f64>() / n, gradient }
}

/// Number of elements summed together. The fixed size makes the sums independent of the number of
/// threads.
const CHUNK: usize = 4096;
/// Rows of a parallel task of [`dssim`].
const BAND: usize = 64;

/// Returns the window and the constants of SSIM.
pub fn ssim_window() -> Window<SSIM_WINDOW> {
    Window {
        taps: window().map(|t| t as f32),
        c: [SSIM_C1 as f32, SSIM_C2 as f32],
        covariance: SSIM_COVARIANCE as f32,
    }
}

/// Returns the structural dissimilarity (1 − SSIM)/2 of planes `[C, height, width]` in [0, 1], with
/// its gradient by `x`.
///
/// SSIM is that of [`crate::scene::metrics::ssim`]: 11×11 Gaussian windows of σ = 1.5 inside the picture,
/// sample covariance.
pub fn dssim(x: &[f32], target: &[f32], width: usize, height: usize) -> Scored {
    if width < SSIM_WINDOW || height < SSIM_WINDOW {
        return Scored::zero(x.len());
    }
    let pixels = width * height;
    let channels = (x.len() / pixels).max(1);
    let windows = (width - SSIM_WINDOW + 1) * (height - SSIM_WINDOW + 1) * channels;
    let shape = ssim_window();
    let factor = (-0.5 / windows as f64) as f32;
    let mut gradient = vec![0.0; x.len()];
    let planes =
        gradient.par_chunks_mut(pixels).zip(x.par_chunks(pixels)).zip(target.par_chunks(pixels));
    let bands = planes.flat_map(|((g, x), t)| {
        let bands = g.par_chunks_mut(BAND * width).enumerate();
        bands.map_init(Scratch::default, move |scratch, (i, g)| {
            let rows = i * BAND..i * BAND + g.len() / width;
            band(&shape, [x, t], width, rows, factor, g, scratch)
        })
    });
    let sums: Vec<f64> = bands.collect();
    Scored { value: 0.5 * (1.0 - sums.iter().sum::<f64>() / windows as f64), gradient }
}
