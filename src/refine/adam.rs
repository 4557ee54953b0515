//! Parameters of a Gaussian in a refinement, and Adam's step of them (Kingma and Ba 2015,
//! algorithm 1). Tests: tests/raster/refine.rs.

use super::{CHUNK, RefineOptions};
use crate::scene::splats::Splats;
use rayon::prelude::*;
use std::ops::Range;
use subsplat_kernels::cpu::simd::vectorize;
use subsplat_kernels::layout::{
    Gradients, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};

/// The rates fall by a cosine from 1 + this to this.
const RATE_FLOOR: f32 = 0.05;
/// Decay rates of Adam's means of the gradient and of its square.
pub(super) const BETAS: [f32; 2] = [0.9, 0.99];
/// Keeps the quotient of a Gaussian without gradient finite.
const EPSILON: f32 = 1e-15;
/// Opacities are moved into [this, 1 − this], where the logit is finite.
const OPACITY_MARGIN: f32 = 1e-3;
/// Least and largest Δ ln σ.
const LOG_SCALE_LIMITS: [f32; 2] = [-2.0, 1.0];

/// Parameters of one Gaussian: logit of the opacity; as differences from the predicted ones, ln σ
/// (3), colour offset (3), mean in [`Step::units`] (3), quaternion (4).
const PARAMETERS: usize = 14;
const LOGIT: usize = 0;
const LOG_SCALE: usize = 1;
const COLOUR: usize = 4;
const MEAN: usize = 7;
const ROTATION: usize = 10;

/// One Gaussian's parameters with Adam's state.
#[derive(Clone, Copy, Default)]
pub(super) struct State {
    value: [f32; PARAMETERS],
    mean: [f32; PARAMETERS],
    square: [f32; PARAMETERS],
}

/// Step sizes of the parameters after the share `part` of the refinement.
pub(super) fn rates(options: &RefineOptions, part: f32) -> [f32; PARAMETERS] {
    let factor = RATE_FLOOR + 0.5 * (1.0 + (std::f32::consts::PI * part).cos());
    let mut rates = [0.0; PARAMETERS];
    rates[LOGIT] = options.opacity_rate;
    rates[LOG_SCALE..COLOUR].fill(options.scale_rate);
    rates[COLOUR..MEAN].fill(options.colour_rate);
    rates[MEAN..ROTATION].fill(options.mean_rate);
    rates[ROTATION..].fill(options.rotation_rate);
    rates.map(|rate| factor * rate)
}

/// One step of all Gaussians.
pub(super) struct Step<'a> {
    /// The Gaussians before the refinement.
    pub predicted: &'a Splats,
    /// `[N]`: unit of a mean's parameters, world units.
    pub units: &'a [f32],
    /// `[N]` or empty: Gaussians of which only the colours change.
    pub beyond: &'a [bool],
    /// Gradients by all Gaussians.
    pub gradients: &'a Gradients,
    /// More gradients by rows, the Gaussians that they belong to, and their weight.
    pub across: (&'a [f32], Range<usize>, f32),
    /// Step sizes.
    pub rates: [f32; PARAMETERS],
    /// 1 − βⁿ of both means.
    pub correction: [f32; 2],
}

impl Step<'_> {
    /// Takes the step: updates `states`, `rows` and `gain` `[N, 4]`.
    pub fn take(&self, states: &mut [State], rows: &mut [f32], gain: &mut [f32]) {
        let rows = rows.par_chunks_mut(CHUNK * SPLAT_STRIDE).zip(gain.par_chunks_mut(CHUNK * 4));
        let parts = states.par_chunks_mut(CHUNK).zip(rows).enumerate();
        parts.for_each(|(part, (states, (rows, gain)))| {
            vectorize(
                #[inline(always)]
                || {
                    let rows = rows.chunks_exact_mut(SPLAT_STRIDE).zip(gain.chunks_exact_mut(4));
                    for (i, (state, (row, gain))) in states.iter_mut().zip(rows).enumerate() {
                        self.update(part * CHUNK + i, state, row, gain);
                    }
                },
            );
        });
    }

    /// Updates Gaussian `i`.
    #[inline(always)]
    fn update(&self, i: usize, state: &mut State, row: &mut [f32], gain: &mut [f32]) {
        let (at, unit) = (i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE, self.units[i]);
        let Gradients { rows: by_rows, gain: by_gains, .. } = self.gradients;
        let by_gain = &by_gains[4 * i..4 * i + 4];
        let mut gradient = by_parameters(row, &by_rows[at.clone()], by_gain, unit);
        let (across, other, weight) = &self.across;
        if other.contains(&i) {
            let by_row = &across[(i - other.start) * SPLAT_STRIDE..][..SPLAT_STRIDE];
            let second = by_parameters(row, by_row, &[0.0; 4], unit);
            for (sum, g) in gradient.iter_mut().zip(second) {
                *sum += weight * g;
            }
        }
        if self.beyond.get(i) == Some(&true) {
            gradient[..COLOUR].fill(0.0);
            gradient[MEAN..].fill(0.0);
        }
        // Adam's state of a Gaussian that no pixel shows stays as it is.
        if gradient.iter().all(|g| *g == 0.0) || gradient.iter().any(|g| !g.is_finite()) {
            return;
        }
        state.advance(&gradient, &self.rates, self.correction);
        let offsets: [f32; 3] = match self.predicted.gain_channels() {
            4 => std::array::from_fn(|c| self.predicted.gain[4 * i + 1 + c]),
            _ => [0.0; 3],
        };
        state.write(&self.predicted.rows[at], offsets, unit, row, gain);
    }
}

/// Gradients by a Gaussian's parameters from those by its row and its gain.
#[inline(always)]
fn by_parameters(row: &[f32], by_row: &[f32], by_gain: &[f32], unit: f32) -> [f32; PARAMETERS] {
    let alpha = row[OPACITY_OFFSET];
    let mut out = [0.0; PARAMETERS];
    out[LOGIT] = by_row[OPACITY_OFFSET] * alpha * (1.0 - alpha);
    for k in 0..3 {
        out[LOG_SCALE + k] = by_row[SCALE_OFFSET + k] * row[SCALE_OFFSET + k];
        out[COLOUR + k] = by_gain[1 + k];
        out[MEAN + k] = by_row[MEAN_OFFSET + k] * unit;
    }
    out[ROTATION..].copy_from_slice(&by_row[QUAT_OFFSET..QUAT_OFFSET + 4]);
    out
}

impl State {
    /// The state before the first step. Moves the opacity of `row` into its limits.
    pub fn of(row: &mut [f32]) -> Self {
        let alpha = row[OPACITY_OFFSET].clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
        row[OPACITY_OFFSET] = alpha;
        let mut state = Self::default();
        state.value[LOGIT] = (alpha / (1.0 - alpha)).ln();
        state
    }

    /// One step of Adam. `correction`: 1 − βⁿ of both means.
    #[inline(always)]
    fn advance(
        &mut self,
        gradient: &[f32; PARAMETERS],
        rates: &[f32; PARAMETERS],
        correction: [f32; 2],
    ) {
        let [b1, b2] = BETAS;
        for k in 0..PARAMETERS {
            let g = gradient[k];
            self.mean[k] = b1 * self.mean[k] + (1.0 - b1) * g;
            self.square[k] = b2 * self.square[k] + (1.0 - b2) * g * g;
            let root = (self.square[k] / correction[1]).sqrt() + EPSILON;
            self.value[k] -= rates[k] * (self.mean[k] / correction[0]) / root;
        }
        let [low, high] = LOG_SCALE_LIMITS;
        for v in &mut self.value[LOG_SCALE..COLOUR] {
            *v = v.clamp(low, high);
        }
    }

    /// Writes the Gaussian: the row `before` and its colour `offsets`, changed by the parameters.
    #[inline(always)]
    fn write(
        &self,
        before: &[f32],
        offsets: [f32; 3],
        unit: f32,
        row: &mut [f32],
        gain: &mut [f32],
    ) {
        let value = &self.value;
        row[OPACITY_OFFSET] = 1.0 / (1.0 + (-value[LOGIT]).exp());
        for k in 0..3 {
            row[SCALE_OFFSET + k] = before[SCALE_OFFSET + k] * value[LOG_SCALE + k].exp();
            row[MEAN_OFFSET + k] = before[MEAN_OFFSET + k] + unit * value[MEAN + k];
            gain[1 + k] = offsets[k] + value[COLOUR + k];
        }
        let quat: [f32; 4] = std::array::from_fn(|k| before[QUAT_OFFSET + k] + value[ROTATION + k]);
        let length = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
        // A quaternion of zero has no direction: the last one stays.
        if length > 0.0 {
            for (to, q) in row[QUAT_OFFSET..QUAT_OFFSET + 4].iter_mut().zip(quat) {
                *to = q / length;
            }
        }
    }
}
