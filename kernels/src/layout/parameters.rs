//! The parameters of a Gaussian that an optimisation can move, as data: how many elements each has,
//! which numbers of the Gaussian it changes, and by which formula. CPU: `cpu/parameters.rs`. WGSL:
//! `wgsl/finish`.

/// Floats of a Gaussian's gain: γ and δ (RGB).
pub const GAIN_STRIDE: usize = 4;
/// Most elements that one parameter has.
pub const ELEMENTS_MAX: usize = 4;

/// Buffer that holds the numbers of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Buffer {
    /// Packed rows, `[N, 11]`.
    Rows,
    /// γ and δ, `[N, 4]`.
    Gain,
    /// SH coefficients, `[N, 3·D]`, of Gaussians with a set each.
    Sh,
}

/// Formula by which an element v of a parameter changes a number of a Gaussian. The elements begin
/// at 0, a logit at the logit of its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// 1/(1 + e⁻ᵛ), one number.
    Logit,
    /// before · eᵛ, three numbers, each with an element of its own.
    Factor,
    /// before · eᵛ, three numbers with the same element.
    CommonFactor,
    /// before + v, three numbers.
    Offset,
    /// before + v · size of a pixel at the Gaussian (world units), three numbers.
    PixelOffset,
    /// (before + v) / |before + v|, four numbers.
    Direction,
}

impl Form {
    /// Returns an element before the first step, whose number is `number`.
    pub fn first_value(self, number: f32) -> f32 {
        match self {
            Self::Logit => (number / (1.0 - number)).ln(),
            Self::Factor
            | Self::CommonFactor
            | Self::Offset
            | Self::PixelOffset
            | Self::Direction => 0.0,
        }
    }
}

/// A parameter of a Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// Buffer of the numbers that it changes.
    pub buffer: Buffer,
    /// Offset of the first of them in the Gaussian's part of the buffer.
    pub first: usize,
    /// Formula of the change.
    pub form: Form,
}

impl Parameter {
    /// Elements of the parameter for one Gaussian, at most [`ELEMENTS_MAX`].
    pub const fn elements(&self) -> usize {
        match self.form {
            Form::Logit | Form::CommonFactor => 1,
            Form::Factor | Form::Offset | Form::PixelOffset => 3,
            Form::Direction => 4,
        }
    }

    /// Numbers of the Gaussian that the parameter changes.
    pub const fn numbers(&self) -> usize {
        match self.form {
            Form::Logit => 1,
            Form::Factor | Form::CommonFactor | Form::Offset | Form::PixelOffset => 3,
            Form::Direction => 4,
        }
    }
}

/// A parameter that moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// The parameter.
    pub parameter: Parameter,
    /// Step of its elements, in their own unit.
    pub rate: f32,
    /// Least and largest value of its elements.
    pub limits: Option<[f32; 2]>,
}

impl Move {
    /// Without limits.
    pub fn free(parameter: Parameter, rate: f32) -> Self {
        Self { parameter, rate, limits: None }
    }

    /// With the limits `least` and `largest`.
    pub fn within(parameter: Parameter, rate: f32, limits: [f32; 2]) -> Self {
        Self { parameter, rate, limits: Some(limits) }
    }
}
