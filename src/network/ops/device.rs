//! Arguments of the [`Executor`](super::Executor) and its results, with and without the feature `gpu`.

use super::TapeArray;

/// SH of primaries in device memory ([`TapeArray::placed_colours`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColourLayout {
    /// World frame, `[N, D, 3]`.
    World,
    /// World frame, colour-major `[N, 3, D]`.
    WorldByColour,
    /// Frame of the source view, `[N, 3, D]`.
    Camera,
}

/// Consecutive Gaussians of one scene in device memory.
#[derive(Clone, Debug)]
pub struct DeviceSplats {
    /// `[n·K, 11]`, columns as in [`subsplat_kernels::layout`].
    pub rows: TapeArray,
    /// `[n, D, 3]`: the parents' SH, world frame.
    pub sh: TapeArray,
    /// `[n·K, 1]` or `[n·K, 4]`; `None` for gains of 1.
    pub gain: Option<TapeArray>,
}

/// Constants of a step ([`subsplat_kernels::cpu::adam::AdamStep`]) that all parameters share.
#[derive(Clone, Copy, Debug)]
pub struct SharedStep {
    /// Factor of the gradients.
    pub clip: f32,
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// Term added to the root of the second moment.
    pub epsilon: f32,
    /// Decay of the moving average.
    pub average: f32,
}

/// Constants of a step for one parameter that changes.
#[derive(Clone, Copy, Debug)]
pub struct ParameterStep {
    /// Learning rate with bias correction.
    pub rate: f32,
    /// Factor of the root of the second moment.
    pub root: f32,
    /// Factor of the values.
    pub keep: f32,
}
