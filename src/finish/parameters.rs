//! The parameters of a Gaussian that an optimisation can move: how many elements each has, which
//! numbers of the Gaussian it changes, and how.
//!
//! A phase ([`super::phase::Phase`]) names those that move. The optimiser holds the elements of
//! [`BLOCK`] Gaussians side by side, `[elements][BLOCK]`, so that Adam's step is one loop over a slice
//! for any selection of parameters.
//!
//! A new parameter needs a constant here, and a form where none of these fits.

use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};

/// Gaussians whose elements are side by side.
pub(super) const BLOCK: usize = 256;
/// Floats of a Gaussian's gain: γ and δ (RGB).
pub(super) const GAIN_STRIDE: usize = 4;
/// Most elements that one parameter has.
pub(super) const ELEMENTS_MAX: usize = 4;

/// Buffer that holds the numbers of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Buffer {
    /// Packed rows, `[N, 11]`.
    Rows,
    /// γ and δ, `[N, 4]`.
    Gain,
}

/// How an element v of a parameter changes a number of a Gaussian. The elements begin at 0, a logit at
/// the logit of its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// 1/(1 + e⁻ᵛ).
    Logit,
    /// before · eᵛ, each number with an element of its own.
    Factor,
    /// before · eᵛ, all numbers with the same element.
    CommonFactor,
    /// before + v.
    Offset,
    /// before + v · size of a pixel at the Gaussian, world units.
    PixelOffset,
    /// (before + v) / |before + v|.
    Direction,
}

/// One row of the table of parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Parameter {
    /// Elements of the parameter for one Gaussian, at most [`ELEMENTS_MAX`].
    pub elements: usize,
    /// Buffer of the numbers that it changes.
    pub buffer: Buffer,
    /// Offset of the first of them in the Gaussian's part of the buffer.
    pub first: usize,
    /// How it changes them.
    pub form: Form,
}

/// The table of parameters. A phase moves one of [`SIZE`] and [`SCALES`], which change the same numbers.
#[rustfmt::skip]
mod table {
    use super::Buffer::{Gain, Rows};
    use super::Form::{CommonFactor, Direction, Factor, Logit, Offset, PixelOffset};
    use super::{MEAN_OFFSET, OPACITY_OFFSET, Parameter, QUAT_OFFSET, SCALE_OFFSET};

    /// Opacity, as its logit.
    pub const OPACITY:  Parameter = Parameter { elements: 1, buffer: Rows, first: OPACITY_OFFSET, form: Logit };
    /// Factor of the three σ together, as Δ ln σ.
    pub const SIZE:     Parameter = Parameter { elements: 1, buffer: Rows, first: SCALE_OFFSET,   form: CommonFactor };
    /// Factor of each σ, as Δ ln σ.
    pub const SCALES:   Parameter = Parameter { elements: 3, buffer: Rows, first: SCALE_OFFSET,   form: Factor };
    /// Colour offsets δ (RGB), display values.
    pub const COLOUR:   Parameter = Parameter { elements: 3, buffer: Gain, first: 1,              form: Offset };
    /// Mean, in pixels of the photograph that shows the Gaussian at the largest scale.
    pub const MEAN:     Parameter = Parameter { elements: 3, buffer: Rows, first: MEAN_OFFSET,    form: PixelOffset };
    /// Unit quaternion wxyz.
    pub const ROTATION: Parameter = Parameter { elements: 4, buffer: Rows, first: QUAT_OFFSET,    form: Direction };
}
pub(super) use table::*;

/// Parts of the buffers for some consecutive Gaussians.
#[derive(Clone, Copy)]
pub(super) struct Part<'a> {
    /// `[n, 11]`.
    pub rows: &'a [f32],
    /// `[n, 4]`, or empty for zeros.
    pub gain: &'a [f32],
}

impl Parameter {
    /// Writes the gradients by this parameter to `out`, `[elements][BLOCK]`, from those `by` the numbers
    /// of n ≤ [`BLOCK`] Gaussians. `rows` `[n, 11]` are the Gaussians as rendered; `pixels` `[n]` the
    /// sizes of a pixel, world units (only for [`Form::PixelOffset`]).
    pub fn gradients(&self, rows: &[f32], by: Part<'_>, pixels: &[f32], out: &mut [f32]) {
        let (by, stride) = match self.buffer {
            Buffer::Rows => (by.rows, SPLAT_STRIDE),
            Buffer::Gain => (by.gain, GAIN_STRIDE),
        };
        for (e, out) in out.chunks_exact_mut(BLOCK).enumerate() {
            let at = self.first + e;
            let by = by.chunks_exact(stride);
            match self.form {
                Form::Logit => {
                    for ((to, g), row) in
                        out.iter_mut().zip(by).zip(rows.chunks_exact(SPLAT_STRIDE))
                    {
                        *to = g[at] * row[at] * (1.0 - row[at]);
                    }
                }
                Form::Factor => {
                    for ((to, g), row) in
                        out.iter_mut().zip(by).zip(rows.chunks_exact(SPLAT_STRIDE))
                    {
                        *to = g[at] * row[at];
                    }
                }
                Form::CommonFactor => {
                    for ((to, g), row) in
                        out.iter_mut().zip(by).zip(rows.chunks_exact(SPLAT_STRIDE))
                    {
                        *to = (at..at + 3).map(|i| g[i] * row[i]).sum();
                    }
                }
                Form::PixelOffset => {
                    for ((to, g), pixel) in out.iter_mut().zip(by).zip(pixels) {
                        *to = g[at] * pixel;
                    }
                }
                Form::Offset | Form::Direction => {
                    for (to, g) in out.iter_mut().zip(by) {
                        *to = g[at];
                    }
                }
            }
        }
    }

    /// Writes the numbers that this parameter changes, of the Gaussians that move (`moves`, `[n]`).
    /// `values` `[elements][BLOCK]`; `before` the Gaussians before the phase, whose σ have the factor
    /// `scale`; `pixels` as in [`Parameter::gradients`]; `rows` `[n, 11]` and `gain` `[n, 4]` receive them.
    pub fn write(
        &self,
        values: &[f32],
        moves: &[bool],
        before: &Before<'_>,
        rows: &mut [f32],
        gain: &mut [f32],
    ) {
        let (to, stride, from) = match self.buffer {
            Buffer::Rows => (rows, SPLAT_STRIDE, before.part.rows),
            Buffer::Gain => (gain, GAIN_STRIDE, before.part.gain),
        };
        let numbers = to.chunks_exact_mut(stride).zip(moves).enumerate().filter(|(_, (_, m))| **m);
        for (j, (to, _)) in numbers {
            let value = |e: usize| values[e * BLOCK + j];
            let from = |at: usize| from.get(j * stride + at).copied().unwrap_or(0.0);
            match self.form {
                Form::Logit => to[self.first] = 1.0 / (1.0 + (-value(0)).exp()),
                Form::Factor => {
                    for e in 0..self.elements {
                        let at = self.first + e;
                        to[at] = from(at) * (before.scale * value(e).exp());
                    }
                }
                Form::CommonFactor => {
                    let factor = before.scale * value(0).exp();
                    for at in self.first..self.first + 3 {
                        to[at] = from(at) * factor;
                    }
                }
                Form::Offset => {
                    for e in 0..self.elements {
                        to[self.first + e] = from(self.first + e) + value(e);
                    }
                }
                Form::PixelOffset => {
                    for e in 0..self.elements {
                        to[self.first + e] = from(self.first + e) + before.pixels[j] * value(e);
                    }
                }
                Form::Direction => {
                    let q: [f32; 4] = std::array::from_fn(|e| from(self.first + e) + value(e));
                    let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
                    // A quaternion of zero has no direction: the last one stays.
                    if length > 0.0 {
                        for (to, q) in to[self.first..].iter_mut().zip(q) {
                            *to = q / length;
                        }
                    }
                }
            }
        }
    }
}

/// Some consecutive Gaussians before a phase.
pub(super) struct Before<'a> {
    /// Their numbers.
    pub part: Part<'a>,
    /// Factor of their σ at the start.
    pub scale: f32,
    /// `[n]`: size of a pixel at each, world units; empty where no mean moves.
    pub pixels: &'a [f32],
}
