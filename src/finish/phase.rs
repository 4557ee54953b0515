//! The phases of the optimisation of a scene, as data: which parameters move and how far, on which
//! photographs and losses, when the steps end, and by which measure the result is kept.
//!
//! | | [`Phase::fit`] | [`Phase::refine`] |
//! |---|---|---|
//! | moves | opacity, size, colour | opacity, scales, colour, mean, rotation |
//! | a step | on all photographs | on one photograph, in turn |
//! | rates | constant | fall by a cosine |
//! | kept where | the loss falls | the photographs improve, two of them drawn from the other's Gaussians |
//!
//! A new phase is another value of [`Phase`]. A new course of the rates is a variant of [`Schedule`].

use super::fit::FitOptions;
use super::parameters::{
    Buffer, COLOUR, MEAN, Move, OPACITY, Parameter, ROTATION, SCALES, SH_1, SIZE,
};
use super::refine::RefineOptions;
use crate::scene::splats::Splats;
use std::time::Duration;

/// Opacities of a fit are moved into [this, 1 − this], where the logit is finite.
const FIT_OPACITY_MARGIN: f32 = 1e-4;
/// The same for a refinement.
const REFINE_OPACITY_MARGIN: f32 = 1e-3;
/// Least and largest Δ ln σ of a refinement.
const REFINE_SCALE_LIMITS: [f32; 2] = [-2.0, 1.0];
/// The rates of a refinement fall by a cosine from 1 + this to this.
const RATE_FLOOR: f32 = 0.05;
/// Rounds of all photographs between two measurements of a refinement, in the second half.
const ROUNDS_PER_CHECK: usize = 4;
/// A refinement ends where the error has not fallen by this share since the last measurement.
const LEAST_GAIN: f64 = 1e-3;
/// Two photographs are not refined where each shows less than this share of the other, on average:
/// what improves there tells nothing about the rest. Chosen on pairs of `../shared/photos`: the ends of
/// three sequences, with shares of 0.02, 0.14 and 0.24, change by −0.16, +0.04 and −0.28 dB otherwise.
const LEAST_COVERED: f64 = 0.25;

/// Fewest photographs that move SH coefficients: fewer show a surface from too few sides.
const PHOTOGRAPHS_OF_SH: usize = 3;

/// The Gaussians as predicted.
const PREDICTED: Start = Start { scale: 1.0, density: 1.0 };
/// Children of the trained heads are twice as wide and less than half as dense as children that tile
/// their pixel.
const SHARPER: Start = Start { scale: 0.7, density: 2.0 };

/// Factors on σ and on the density −ln(1 − α), with which a phase can start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Start {
    /// Factor on σ.
    pub scale: f32,
    /// Factor on the density.
    pub density: f32,
}

/// Photographs of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Photographs {
    /// All of them. Every Gaussian moves.
    All,
    /// One, each once in a round. The Gaussians that it shows move.
    InTurn,
}

/// Course of the rates over the phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Schedule {
    /// They stay.
    Constant,
    /// They fall by a cosine from 1 + `floor` to `floor`.
    Cosine {
        /// Factor at the end.
        floor: f32,
    },
}

impl Schedule {
    /// Returns the factor of the rates after the share `part` of the phase, 0 to 1.
    pub fn factor(self, part: f32) -> f32 {
        match self {
            Self::Constant => 1.0,
            Self::Cosine { floor } => floor + 0.5 * (1.0 + (std::f32::consts::PI * part).cos()),
        }
    }
}

/// Weights of the loss of a photograph, beside the mean squared difference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LossWeights {
    /// Of (1 − SSIM)/2.
    pub dssim: f64,
    /// Of the same loss of each of two photographs, drawn from the other's Gaussians alone.
    pub across: f32,
}

/// Measure that decides whether a phase improved the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Measure {
    /// The mean loss of the photographs.
    Loss,
    /// The mean squared difference of the photographs: each of two drawn from the other's Gaussians alone,
    /// where these are known; more of them drawn from all Gaussians.
    Difference,
}

/// Rule that ends the steps before their limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Patience {
    /// Rounds of all photographs between two measurements, in the second half.
    pub rounds: usize,
    /// Share by which the error falls from one measurement to the next.
    pub least_gain: f64,
}

/// A phase of the optimisation of a scene on its photographs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Phase {
    /// Parameters that move; the others stay.
    pub moves: Vec<Move>,
    /// Opacities are moved into [this, 1 − this] where they move.
    pub opacity_margin: f32,
    /// Starts, the first as given; a later one is taken where it decreases the measure. Empty: the
    /// Gaussians as they are.
    pub starts: &'static [Start],
    /// Photographs of a step.
    pub photographs: Photographs,
    /// Weights of the loss.
    pub loss: LossWeights,
    /// Course of the rates.
    pub schedule: Schedule,
    /// Most steps.
    pub steps: usize,
    /// Longest duration of the steps; the rates then fall over it.
    pub time: Option<Duration>,
    /// Rule that ends the steps earlier.
    pub patience: Option<Patience>,
    /// Measure that decides whether the result is kept.
    pub measure: Measure,
    /// Of two photographs, only the colours of Gaussians move that reach beyond both.
    pub spares_edges: bool,
    /// Two photographs stay as they are where each shows less than this share of the other.
    pub least_covered: f64,
    /// Parents with a smaller share of three photographs or more are removed first.
    pub least_share: f32,
    /// Share of the Gaussians that a step leaves out, times the number of photographs
    /// ([`super::dropout::share`]).
    pub dropout: f32,
}

impl Phase {
    /// Sizes, opacities and colours, on all photographs. `tries_sharper` names another start.
    pub fn fit(options: &FitOptions, tries_sharper: bool) -> Self {
        let limit = options.scale_limit;
        Self {
            moves: vec![
                Move::free(OPACITY, options.opacity_rate),
                Move::within(SIZE, options.scale_rate, [-limit, limit]),
                Move::free(COLOUR, options.colour_rate),
            ],
            opacity_margin: FIT_OPACITY_MARGIN,
            starts: if tries_sharper { &[PREDICTED, SHARPER] } else { &[PREDICTED] },
            photographs: Photographs::All,
            loss: LossWeights { dssim: options.dssim, across: 0.0 },
            schedule: Schedule::Constant,
            steps: options.steps,
            time: None,
            patience: None,
            measure: Measure::Loss,
            spares_edges: false,
            least_covered: 0.0,
            least_share: 0.0,
            dropout: 0.0,
        }
    }

    /// All parameters, on one photograph after the other.
    pub fn refine(options: &RefineOptions) -> Self {
        Self {
            moves: vec![
                Move::free(OPACITY, options.opacity_rate),
                Move::within(SCALES, options.scale_rate, REFINE_SCALE_LIMITS),
                Move::free(COLOUR, options.colour_rate),
                Move::free(MEAN, options.mean_rate),
                Move::free(ROTATION, options.rotation_rate),
                Move::free(SH_1[0], options.sh_rate),
                Move::free(SH_1[1], options.sh_rate),
                Move::free(SH_1[2], options.sh_rate),
            ],
            opacity_margin: REFINE_OPACITY_MARGIN,
            starts: &[],
            photographs: Photographs::InTurn,
            loss: LossWeights { dssim: options.dssim, across: options.across },
            schedule: Schedule::Cosine { floor: RATE_FLOOR },
            steps: options.steps,
            time: options.time,
            patience: Some(Patience { rounds: ROUNDS_PER_CHECK, least_gain: LEAST_GAIN }),
            measure: Measure::Difference,
            spares_edges: true,
            least_covered: LEAST_COVERED,
            least_share: options.least_share,
            dropout: options.dropout,
        }
    }

    /// The phase without parameters that `splats` do not have, or that a number of photographs does not move.
    pub fn of(&self, splats: &Splats, photographs: usize) -> Self {
        let mut phase = self.clone();
        let own_sets = splats.sh_degree > 0 && splats.children_per_parent() == 1;
        if !own_sets || photographs < PHOTOGRAPHS_OF_SH {
            phase.moves.retain(|m| m.parameter.buffer != Buffer::Sh);
        }
        phase.moves.retain(|m| m.rate > 0.0);
        phase
    }

    /// SH coefficients of each channel that move, with those before them.
    pub fn sh_coefficients(&self) -> usize {
        let sh = self.moves.iter().map(|m| m.parameter).filter(|p| p.buffer == Buffer::Sh);
        sh.map(|p| (p.first + p.elements()).div_ceil(3)).max().unwrap_or(0)
    }

    /// Returns whether `parameter` moves.
    pub fn moves(&self, parameter: Parameter) -> bool {
        self.moves.iter().any(|m| m.parameter == parameter)
    }
}
