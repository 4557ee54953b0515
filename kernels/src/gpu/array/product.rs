//! Convolution and linear layer.
//!
//! WGSL: wgsl/network/convolution.wgsl, wgsl/network/linear.wgsl.

use super::{Array, PointwiseFunction, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{ConvolutionUniform, LinearUniform};

pub(crate) static CONVOLUTION: Kernel = Kernel {
    name: "convolution",
    entry: "main",
    source: wgsl!(ConvolutionUniform; "shared/activation", "shared/product", "network/convolution"),
};

pub(crate) static LINEAR: Kernel = Kernel {
    name: "linear",
    entry: "main",
    source: wgsl!(LinearUniform; "shared/activation", "shared/grid", "shared/product", "network/linear"),
};

/// Rows and columns of the result that a workgroup computes.
pub(super) const SIDE: usize = 64;

/// Strides and padding of a convolution, the same on every axis, px.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvolutionCall {
    /// Distance between outputs.
    pub stride: usize,
    /// Zeros on either side.
    pub padding: usize,
}

/// Three sizes of two or three axes.
pub(super) fn volume(dims: &[usize]) -> Option<[usize; 3]> {
    match *dims {
        [h, w] => Some([1, h, w]),
        [d, h, w] => Some([d, h, w]),
        _ => None,
    }
}

/// `sizes` as words, then `last`.
pub(super) fn words([a, b, c]: [usize; 3], last: usize) -> [u32; 4] {
    [a, b, c, last].map(|n| n as u32)
}

impl Array {
    /// Convolves `[B, C, (D,) H, W]` with `weight` `[O, C, (kd,) kh, kw]`, then applies `activation`; `bias`
    /// `[O]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn convolved(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        call: ConvolutionCall,
        activation: PointwiseFunction,
    ) -> Result<Self, GpuError> {
        let expected = || format!("weight [O, C, ..] and bias [O] for {:?}", self.dims);
        let refused = || misfit(CONVOLUTION.name, expected(), &weight.dims);
        let (&[b, c, ref size @ ..], &[o, wc, ref kernel @ ..]) =
            (self.dims.as_slice(), weight.dims.as_slice())
        else {
            return Err(refused());
        };
        let (Some(from), Some(taps)) = (volume(size), volume(kernel)) else {
            return Err(refused());
        };
        let flat = size.len() == 2;
        let per_axis =
            |value: usize, unused: usize| if flat { [unused, value, value] } else { [value; 3] };
        let (stride, padding) = (per_axis(call.stride, 1), per_axis(call.padding, 0));
        let inside = (0..3).all(|i| taps[i] > 0 && from[i] + 2 * padding[i] >= taps[i]);
        let fits = wc == c
            && size.len() == kernel.len()
            && call.stride > 0
            && inside
            && bias.is_none_or(|bias| bias.count() == o);
        if !fits || self.count() == 0 || weight.count() == 0 {
            return Err(refused());
        }
        let to: [usize; 3] =
            std::array::from_fn(|i| (from[i] + 2 * padding[i] - taps[i]) / stride[i] + 1);
        let mut dims = vec![b, o];
        dims.extend_from_slice(&to[usize::from(flat)..]);
        let result = self.recorder.empty(&dims)?;
        let pixels: usize = to.iter().product();
        let uniform = ConvolutionUniform {
            channels: c as u32,
            outputs: o as u32,
            terms: (c * taps.iter().product::<usize>()) as u32,
            pixels: pixels as u32,
            input_size: words(from, 0),
            output_size: words(to, 0),
            kernel: words(taps, 0),
            stride: words(stride, 0),
            padding: words(padding, usize::from(bias.is_some())),
        };
        let bindings =
            [self.binding(), weight.binding(), bias.unwrap_or(weight).binding(), result.binding()];
        let groups = [pixels.div_ceil(SIDE), o.div_ceil(SIDE), b].map(|n| n as u32);
        self.recorder.count_flops(&CONVOLUTION, 2 * result.count() * weight.count() / o);
        let constants = [("ACTIVATION_KIND", f64::from(activation as u32))];
        self.recorder.call(&CONVOLUTION, &constants, &uniform, &bindings, Groups::Of(groups))?;
        Ok(result)
    }

    /// Computes x·Wᵀ + b of `[N, C]`, then applies `activation`; `weight` `[O, C]`, `bias` `[O]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn projected(
        &self,
        weight: &Self,
        bias: Option<&Self>,
        activation: PointwiseFunction,
    ) -> Result<Self, GpuError> {
        let (&[rows, c], &[o, wc]) = (self.dims.as_slice(), weight.dims.as_slice()) else {
            return Err(misfit(LINEAR.name, "matrices".to_owned(), &self.dims));
        };
        if c != wc || bias.is_some_and(|bias| bias.count() != o) {
            let expected = format!("weight [O, {c}] and bias [O]");
            return Err(misfit(LINEAR.name, expected, &weight.dims));
        }
        let result = self.recorder.empty(&[rows, o])?;
        let uniform = LinearUniform {
            rows: rows as u32,
            outputs: o as u32,
            terms: c as u32,
            has_bias: u32::from(bias.is_some()),
        };
        let bindings =
            [self.binding(), weight.binding(), bias.unwrap_or(weight).binding(), result.binding()];
        let groups = Groups::of(rows.div_ceil(SIDE) * o.div_ceil(SIDE), 1);
        self.recorder.count_flops(&LINEAR, 2 * rows * o * c);
        let constants = [("ACTIVATION_KIND", f64::from(activation as u32))];
        self.recorder.call(&LINEAR, &constants, &uniform, &bindings, groups)?;
        Ok(result)
    }
}
