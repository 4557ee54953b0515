//! Gradients of convolution and linear layer.
//!
//! The gradient of an input is the same operation with the transposed weight. The gradient of a
//! weight is a matrix product over parts of the pixels or rows, whose results are added in order.
//! CPU versions: [`crate::cpu::conv`], [`crate::cpu::gemm`]. WGSL:
//! wgsl/network/convolution_weight_bwd.wgsl, wgsl/network/linear_weight_bwd.wgsl. Tests:
//! tests/gpu/array_gradients.rs.

use super::product::{SIDE, volume, words};
use super::{Array, ConvolutionCall, PointwiseFunction, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{ConvolutionUniform, LinearWeightBwdUniform};

pub(crate) static CONVOLUTION_WEIGHT_BWD: Kernel = Kernel {
    name: "convolution_weight_bwd",
    entry: "main",
    source: wgsl!(ConvolutionUniform; "shared/product", "network/convolution_weight_bwd"),
};

pub(crate) static LINEAR_WEIGHT_BWD: Kernel = Kernel {
    name: "linear_weight_bwd",
    entry: "main",
    source: wgsl!(LinearWeightBwdUniform; "shared/product", "network/linear_weight_bwd"),
};

/// Smallest number of pixels or rows of a part.
const PART_MIN: usize = 1024;
/// Largest number of floats of all parts' results.
const SUMS_MAX: usize = 1 << 22;

/// Returns the size of each of at least one part of `length`, if the results of all parts have
/// `floats` floats a part. It depends on sizes alone, and so does the order of the sums.
fn part_size(length: usize, floats: usize) -> usize {
    let parts = (SUMS_MAX / floats.max(1)).max(1);
    length.div_ceil(parts).max(PART_MIN)
}

impl Array {
    /// Computes the gradient of the input of [`Array::convolved`] from that of the result,
    /// this array; `dims` are the dimensions of the input.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn convolved_input_backward(
        &self,
        weight: &Self,
        dims: &[usize],
        call: ConvolutionCall,
    ) -> Result<Self, GpuError> {
        let (&[o, c, ref kernel @ ..], &[_, _, ref size @ ..], &[_, _, ref to @ ..]) =
            (weight.dims.as_slice(), dims, self.dims.as_slice())
        else {
            return Err(misfit(CONVOLUTION_WEIGHT_BWD.name, "[B, C, ..]".to_owned(), dims));
        };
        let ConvolutionCall { stride, padding } = call;
        let side = kernel.first().copied().unwrap_or(0);
        let square = kernel.iter().all(|k| *k == side) && side > padding;
        if !square || size.len() != kernel.len() || to.len() != kernel.len() {
            let expected = "a kernel of equal sides above the padding".to_owned();
            return Err(misfit(CONVOLUTION_WEIGHT_BWD.name, expected, &weight.dims));
        }
        // Zeros between the gradients, and after the last one where the stride leaves pixels out.
        let spread = |(size, _): (&usize, &usize)| size + 2 * padding + 1 - side;
        let inside: Vec<usize> = size.iter().zip(to).map(spread).collect();
        let spread_dims = [&self.dims[..2], &inside[..]].concat();
        let whole = if spread_dims == self.dims {
            self.clone()
        } else {
            let steps = [&[1, 1], &vec![stride; to.len()][..]].concat();
            self.spread(&spread_dims, &steps, &vec![0; spread_dims.len()])?
        };
        let taps: usize = kernel.iter().product();
        let mirrored: Vec<u32> = (0..taps as u32).rev().collect();
        let turned = weight.reshape(&[o, c, taps])?.permuted(&[1, 0, 2])?;
        let turned = match taps {
            1 => turned,
            _ => turned.selected(2, &mirrored)?,
        };
        let turned = turned.reshape(&[&[c, o], kernel].concat())?;
        let call = ConvolutionCall { stride: 1, padding: side - 1 - padding };
        whole.convolved(&turned, None, call, PointwiseFunction::None)
    }

    /// Computes the gradient of the weight of [`Array::convolved`], whose dimensions are
    /// `dims`, from the input, this array, and the gradient `dy` of the result.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn convolved_weight_backward(
        &self,
        dy: &Self,
        dims: &[usize],
        call: ConvolutionCall,
    ) -> Result<Self, GpuError> {
        let refused = || misfit(CONVOLUTION_WEIGHT_BWD.name, format!("{dims:?}"), &self.dims);
        let (&[b, c, ref size @ ..], &[o, _, ref kernel @ ..], &[_, _, ref to @ ..]) =
            (self.dims.as_slice(), dims, dy.dims.as_slice())
        else {
            return Err(refused());
        };
        let (Some(from), Some(taps), Some(to)) = (volume(size), volume(kernel), volume(to)) else {
            return Err(refused());
        };
        let flat = size.len() == 2;
        let per_axis =
            |value: usize, unused: usize| if flat { [unused, value, value] } else { [value; 3] };
        let terms = c * taps.iter().product::<usize>();
        let pixels: usize = to.iter().product();
        if dy.dims[..2] != [b, o] || dims[1] != c || pixels * terms == 0 {
            return Err(refused());
        }
        let part = part_size(pixels, b * o * terms);
        let parts = pixels.div_ceil(part);
        let uniform = ConvolutionUniform {
            channels: c as u32,
            outputs: o as u32,
            terms: terms as u32,
            pixels: pixels as u32,
            input_size: words(from, 0),
            output_size: words(to, parts),
            kernel: words(taps, part),
            stride: words(per_axis(call.stride, 1), 0),
            padding: words(per_axis(call.padding, 0), 0),
        };
        let sums = self.recorder.empty(&[b * parts, o, terms])?;
        let bindings = [self.binding(), dy.binding(), sums.binding()];
        let groups = [terms.div_ceil(SIDE), o.div_ceil(SIDE), b * parts].map(|n| n as u32);
        self.recorder.count_flops(&CONVOLUTION_WEIGHT_BWD, 2 * dy.count() * terms);
        let kernel = &CONVOLUTION_WEIGHT_BWD;
        self.recorder.call(kernel, &[], &uniform, &bindings, Groups::Of(groups))?;
        sums.sum_over(0)?.reshape(dims)
    }

    /// Computes the gradient `[O, C]` of a linear layer's weight from the input, this array
    /// `[N, C]`, and the gradient `dy` `[N, O]` of the result.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn projected_weight_backward(&self, dy: &Self) -> Result<Self, GpuError> {
        let (&[rows, terms], &[own, outputs]) = (self.dims.as_slice(), dy.dims.as_slice()) else {
            return Err(misfit(LINEAR_WEIGHT_BWD.name, "matrices".to_owned(), &self.dims));
        };
        if rows != own || rows * terms * outputs == 0 {
            let expected = format!("a gradient [{rows}, O]");
            return Err(misfit(LINEAR_WEIGHT_BWD.name, expected, &dy.dims));
        }
        let part = part_size(rows, outputs * terms);
        let parts = rows.div_ceil(part);
        let uniform = LinearWeightBwdUniform {
            rows: rows as u32,
            outputs: outputs as u32,
            terms: terms as u32,
            part: part as u32,
        };
        let sums = self.recorder.empty(&[parts, outputs, terms])?;
        let bindings = [dy.binding(), self.binding(), sums.binding()];
        let groups = [terms.div_ceil(SIDE), outputs.div_ceil(SIDE), parts].map(|n| n as u32);
        self.recorder.count_flops(&LINEAR_WEIGHT_BWD, 2 * rows * outputs * terms);
        let kernel = &LINEAR_WEIGHT_BWD;
        self.recorder.call(kernel, &[], &uniform, &bindings, Groups::Of(groups))?;
        sums.sum_over(0)?.reshape(&[outputs, terms])
    }
}
