//! The table of the parameters of a Gaussian that an optimisation can move. A phase
//! ([`super::phase::Phase`]) names those that move.
//!
//! A new parameter needs a constant here, and a form (`subsplat_kernels::layout::parameters`) where
//! none of these fits.

pub(super) use subsplat_kernels::cpu::parameters::{BLOCK, Before, Part, PartMut};
pub(super) use subsplat_kernels::layout::parameters::{
    Buffer, ELEMENTS_MAX, Form, GAIN_STRIDE, Move, Parameter,
};

/// The table of parameters. A phase moves one of [`SIZE`] and [`SCALES`], which change the same
/// numbers.
#[rustfmt::skip]
mod table {
    use super::Buffer::{Gain, Rows, Sh};
    use super::Form::{CommonFactor, Direction, Factor, Logit, Offset, PixelOffset};
    use super::Parameter;
    use subsplat_kernels::layout::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET};

    /// Opacity, as its logit.
    pub const OPACITY:  Parameter = Parameter { buffer: Rows, first: OPACITY_OFFSET, form: Logit };
    /// Factor of the three σ together, as Δ ln σ.
    pub const SIZE:     Parameter = Parameter { buffer: Rows, first: SCALE_OFFSET,   form: CommonFactor };
    /// Factor of each σ, as Δ ln σ.
    pub const SCALES:   Parameter = Parameter { buffer: Rows, first: SCALE_OFFSET,   form: Factor };
    /// Colour offsets δ (RGB), display values.
    pub const COLOUR:   Parameter = Parameter { buffer: Gain, first: 1,              form: Offset };
    /// Mean, in pixels of the photograph that shows the Gaussian at the largest scale.
    pub const MEAN:     Parameter = Parameter { buffer: Rows, first: MEAN_OFFSET,    form: PixelOffset };
    /// Unit quaternion wxyz.
    pub const ROTATION: Parameter = Parameter { buffer: Rows, first: QUAT_OFFSET,    form: Direction };
    /// SH coefficients of degree 1 (RGB), one parameter for each of the three functions.
    pub const SH_1: [Parameter; 3] = [
        Parameter { buffer: Sh, first: 3, form: Offset },
        Parameter { buffer: Sh, first: 6, form: Offset },
        Parameter { buffer: Sh, first: 9, form: Offset },
    ];
}
pub(super) use table::*;
