//! Parameters of Gaussians under optimisation ([`crate::layout::parameters`]): gradients by their
//! elements from those by the Gaussians' numbers, and the numbers from the elements.
//!
//! The elements of [`BLOCK`] Gaussians are side by side, `[elements][BLOCK]`, so that Adam's step
//! is one loop over a slice for any selection of parameters. WGSL: wgsl/shared/parameters.wgsl,
//! wgsl/finish/parameter_gradients.wgsl, wgsl/finish/optimise.wgsl. Oracle and tests:
//! `src/finish/optimiser/tests.rs` of the crate `subsplat`.

use crate::layout::SPLAT_STRIDE;
use crate::layout::parameters::{Buffer, Form, GAIN_STRIDE, Parameter};

/// Gaussians whose elements are side by side.
pub const BLOCK: usize = 256;

/// Parts of the buffers for some consecutive Gaussians.
#[derive(Clone, Copy)]
pub struct Part<'a> {
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
pub struct PartMut<'a> {
    /// `[n, 11]`.
    pub rows: &'a mut [f32],
    /// `[n, 4]`.
    pub gain: &'a mut [f32],
    /// `[n, sh_stride]`, or empty where the SH coefficients stay.
    pub sh: &'a mut [f32],
}

impl Parameter {
    /// Writes the gradients by this parameter to `out`, `[elements][BLOCK]`, from those `by` the
    /// numbers of n ≤ [`BLOCK`] Gaussians, at least one. `rows` `[n, 11]` are the Gaussians as
    /// rendered; `pixels` `[n]` the sizes of a pixel, world units (only for [`Form::PixelOffset`]).
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

/// Calls `f` for each Gaussian that moves, with its index, the numbers to write and those before.
/// `to` and `from` begin at the parameter's first number of the first Gaussian.
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
pub struct Before<'a> {
    /// Their numbers.
    pub part: Part<'a>,
    /// Factor of their σ at the start.
    pub scale: f32,
    /// `[n]`: size of a pixel at each, world units; empty where no mean moves.
    pub pixels: &'a [f32],
}
