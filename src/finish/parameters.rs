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
    /// SH coefficients, `[N, 3·D]`, of Gaussians with a set each.
    Sh,
}

/// Formula by which an element v of a parameter changes a number of a Gaussian. The elements begin at 0, a logit at
/// the logit of its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
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

/// One row of the table of parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Parameter {
    /// Buffer of the numbers that it changes.
    pub buffer: Buffer,
    /// Offset of the first of them in the Gaussian's part of the buffer.
    pub first: usize,
    /// Formula of the change.
    pub form: Form,
}

/// The table of parameters. A phase moves one of [`SIZE`] and [`SCALES`], which change the same numbers.
#[rustfmt::skip]
mod table {
    use super::Buffer::{Gain, Rows, Sh};
    use super::Form::{CommonFactor, Direction, Factor, Logit, Offset, PixelOffset};
    use super::{MEAN_OFFSET, OPACITY_OFFSET, Parameter, QUAT_OFFSET, SCALE_OFFSET};

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

/// Parts of the buffers for some consecutive Gaussians.
#[derive(Clone, Copy)]
pub(super) struct Part<'a> {
    /// `[n, 11]`.
    pub rows: &'a [f32],
    /// `[n, 4]`, or empty for zeros.
    pub gain: &'a [f32],
    /// `[n, sh_stride]`, or empty where the SH coefficients stay.
    pub sh: &'a [f32],
    /// SH coefficients of a Gaussian, 3·D.
    pub sh_stride: usize,
}

/// Numbers of some consecutive Gaussians, to write.
pub(super) struct PartMut<'a> {
    /// `[n, 11]`.
    pub rows: &'a mut [f32],
    /// `[n, 4]`.
    pub gain: &'a mut [f32],
    /// `[n, sh_stride]`, or empty where the SH coefficients stay.
    pub sh: &'a mut [f32],
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

    /// Writes the gradients by this parameter to `out`, `[elements][BLOCK]`, from those `by` the numbers
    /// of n ≤ [`BLOCK`] Gaussians, at least one. `rows` `[n, 11]` are the Gaussians as rendered; `pixels`
    /// `[n]` the sizes of a pixel, world units (only for [`Form::PixelOffset`]).
    pub fn gradients(&self, rows: &[f32], by: Part<'_>, pixels: &[f32], out: &mut [f32]) {
        let (by, stride) = match self.buffer {
            Buffer::Rows => (by.rows, SPLAT_STRIDE),
            Buffer::Gain => (by.gain, GAIN_STRIDE),
            Buffer::Sh => (by.sh, by.sh_stride),
        };
        for (e, out) in out.chunks_exact_mut(BLOCK).enumerate() {
            let at = self.first + e;
            let pairs = out.iter_mut().zip(by[at..].iter().step_by(stride));
            let numbers = rows[at..].iter().step_by(SPLAT_STRIDE);
            match self.form {
                Form::Logit => {
                    pairs.zip(numbers).for_each(|((to, g), alpha)| *to = g * alpha * (1.0 - alpha));
                }
                Form::Factor => pairs.zip(numbers).for_each(|((to, g), sigma)| *to = g * sigma),
                Form::CommonFactor => {
                    let pairs = by[at..].chunks(stride).zip(rows[at..].chunks(SPLAT_STRIDE));
                    for (to, (g, sigma)) in out.iter_mut().zip(pairs) {
                        *to = g.iter().zip(sigma).take(3).map(|(g, sigma)| g * sigma).sum();
                    }
                }
                Form::PixelOffset => pairs.zip(pixels).for_each(|((to, g), pixel)| *to = g * pixel),
                Form::Offset | Form::Direction => pairs.for_each(|(to, g)| *to = *g),
            }
        }
    }

    /// Writes the numbers that this parameter changes, of the Gaussians that move (`moves`, `[n]`).
    /// `values` `[elements][BLOCK]`; `to` receives the numbers.
    #[inline(always)]
    pub fn write(&self, values: &[f32], moves: &[bool], before: &Before<'_>, to: &mut PartMut<'_>) {
        let (to, from, stride) = match self.buffer {
            Buffer::Rows => (&mut *to.rows, before.part.rows, SPLAT_STRIDE),
            Buffer::Gain => (&mut *to.gain, before.part.gain, GAIN_STRIDE),
            Buffer::Sh => (&mut *to.sh, before.part.sh, before.part.sh_stride),
        };
        // Gaussians without offsets of their own have offsets of 0.
        let from = if from.is_empty() { &ZEROS[..to.len()] } else { from };
        let (to, from) = (&mut to[self.first..], &from[self.first..]);
        let (scale, pixels) = (before.scale, before.pixels);
        let (columns, _) = values.as_chunks::<BLOCK>();
        match (self.form, columns) {
            (Form::Logit, [value]) => {
                each::<1>(to, from, stride, moves, |j, [to], _| {
                    *to = 1.0 / (1.0 + (-value[j]).exp());
                });
            }
            (Form::Factor, [x, y, z]) => {
                each::<3>(to, from, stride, moves, |j, to, from| {
                    let value = [x[j], y[j], z[j]];
                    *to = std::array::from_fn(|k| from[k] * (scale * value[k].exp()));
                });
            }
            (Form::CommonFactor, [value]) => {
                each::<3>(to, from, stride, moves, |j, to, from| {
                    let factor = scale * value[j].exp();
                    *to = from.map(|sigma| sigma * factor);
                });
            }
            (Form::PixelOffset, [x, y, z]) => {
                each::<3>(to, from, stride, moves, |j, to, from| {
                    let value = [x[j], y[j], z[j]];
                    let pixel = pixels[j];
                    *to = std::array::from_fn(|k| from[k] + pixel * value[k]);
                });
            }
            (Form::Offset, [x, y, z]) => {
                each::<3>(to, from, stride, moves, |j, to, from| {
                    let value = [x[j], y[j], z[j]];
                    *to = std::array::from_fn(|k| from[k] + value[k]);
                });
            }
            (Form::Direction, [w, x, y, z]) => {
                each::<4>(to, from, stride, moves, |j, to, from| {
                    let value = [w[j], x[j], y[j], z[j]];
                    let q: [f32; 4] = std::array::from_fn(|k| from[k] + value[k]);
                    let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
                    // A quaternion of zero has no direction: the last one stays.
                    if length > 0.0 {
                        *to = q.map(|q| q / length);
                    }
                });
            }
            _ => debug_assert!(false, "{self:?} has {} elements", columns.len()),
        }
    }
}

/// Offsets of a block of Gaussians without offsets.
static ZEROS: [f32; BLOCK * GAIN_STRIDE] = [0.0; BLOCK * GAIN_STRIDE];

/// Calls `f` for each Gaussian that moves, with its index, the numbers to write and those before. `to` and
/// `from` begin at the parameter's first number of the first Gaussian.
#[inline(always)]
fn each<const N: usize>(
    to: &mut [f32],
    from: &[f32],
    stride: usize,
    moves: &[bool],
    f: impl Fn(usize, &mut [f32; N], &[f32; N]),
) {
    let numbers = to.chunks_mut(stride).zip(from.chunks(stride));
    for (j, ((to, from), moves)) in numbers.zip(moves).enumerate() {
        if let (true, Some(to), Some(from)) = (*moves, to.first_chunk_mut(), from.first_chunk()) {
            f(j, to, from);
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
