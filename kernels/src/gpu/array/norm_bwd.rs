//! Gradients of the normalisations.
//!
//! CPU version: [`crate::cpu::norm`]. WGSL: wgsl/network/norm_sums_bwd.wgsl, wgsl/network/norm_bwd.wgsl,
//! wgsl/network/layer_norm_bwd.wgsl. Tests: tests/gpu/array_gradients.rs.

use super::norm::{EPSILON, NORM_STATISTICS, PART};
use super::{Array, PointwiseFunction, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{NormUniform, RowsUniform};

pub(crate) static NORM_SUMS_BWD: Kernel = Kernel {
    name: "norm_sums_bwd",
    entry: "main",
    source: wgsl!(
        NormUniform; "shared/grid", "shared/activation", "shared/norm", "shared/norm_read",
        "shared/norm_channel", "shared/sum", ["shared/place" | "shared/place_subgroups"],
        "network/norm_sums_bwd"
    ),
};

pub(crate) static NORM_BWD: Kernel = Kernel {
    name: "norm_bwd",
    entry: "main",
    source: wgsl!(
        NormUniform; "shared/grid", "shared/activation", "shared/norm", "shared/norm_read",
        "shared/norm_channel", "network/norm_bwd"
    ),
};

pub(crate) static LAYER_NORM_BWD: Kernel = Kernel {
    name: "layer_norm_bwd",
    entry: "main",
    source: wgsl!(
        RowsUniform; "shared/grid", "shared/rows", "shared/sum",
        ["shared/place" | "shared/place_subgroups"], "network/layer_norm_bwd"
    ),
};

impl Array {
    /// Computes the gradients of the array, of the factors and of the summands of
    /// [`Array::group_norm`] from the gradient `dy` of the result. Without `affine` the last
    /// two are those of factors 1 and summands 0.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn group_norm_backward(
        &self,
        groups: usize,
        affine: Option<[&Self; 2]>,
        activation: PointwiseFunction,
        dy: &Self,
    ) -> Result<[Self; 3], GpuError> {
        let (b, c) = match self.dims.as_slice() {
            &[b, c, _, ..] if dy.dims == self.dims && groups > 0 && c.is_multiple_of(groups) => {
                (b, c)
            }
            _ => return Err(misfit(NORM_BWD.name, format!("{:?}", self.dims), &dy.dims)),
        };
        if self.count() == 0 || affine.is_some_and(|a| a.iter().any(|a| a.count() != c)) {
            let expected = format!("elements, and {c} factors and summands");
            return Err(misfit(NORM_BWD.name, expected, &self.dims));
        }
        let rows = b * groups;
        let length = self.count() / rows;
        let run = self.count() / (b * c);
        let (parts, channel_parts) = (length.div_ceil(PART), run.div_ceil(PART));
        let uniform = NormUniform {
            rows: rows as u32,
            length: length as u32,
            run: run as u32,
            groups: groups as u32,
            parts: parts as u32,
            has_affine: u32::from(affine.is_some()),
            epsilon: EPSILON,
            channel_parts: channel_parts as u32,
        };
        // Recomputed: the forward pass does not keep them.
        let statistics = self.recorder.empty(&[rows * parts, 2])?;
        let bindings = [self.binding(), statistics.binding()];
        let workgroups = Groups::of(rows * parts, 1);
        self.recorder.call(&NORM_STATISTICS, &[], &uniform, &bindings, workgroups)?;
        let sums = self.recorder.empty(&[b * c, channel_parts, 2])?;
        let [factors, summands] = affine.unwrap_or([self, self]).map(Array::binding);
        let all = [self.binding(), statistics.binding(), factors, summands, dy.binding()];
        let constants = [("ACTIVATION_KIND", f64::from(activation as u32))];
        let workgroups = || Groups::of(b * c * channel_parts, 1);
        let bindings = [&all[..], &[sums.binding()]].concat();
        self.recorder.call(&NORM_SUMS_BWD, &constants, &uniform, &bindings, workgroups())?;
        let sums = sums.sum_over(1)?;
        let dx = self.recorder.empty(&self.dims)?;
        let bindings = [&all[..], &[sums.binding(), dx.binding()]].concat();
        self.recorder.call(&NORM_BWD, &constants, &uniform, &bindings, workgroups())?;
        let of_affine = sums.reshape(&[b, c, 2])?.sum_over(0)?;
        let column = |i: usize| of_affine.narrow(2, i, 1)?.reshape(&[c]);
        Ok([dx, column(1)?, column(0)?])
    }

    /// Computes the gradients of the array, of the factors and of the summands of
    /// [`Array::layer_norm`] from the gradient `dy` of the result.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn layer_norm_backward(&self, factors: &Self, dy: &Self) -> Result<[Self; 3], GpuError> {
        let length = self.dims.last().copied().unwrap_or(0);
        if length == 0 || factors.count() != length || dy.dims != self.dims {
            let expected = format!("{:?} and {length} factors", self.dims);
            return Err(misfit(LAYER_NORM_BWD.name, expected, &dy.dims));
        }
        let rows = self.count() / length;
        let dx = self.recorder.empty(&self.dims)?;
        let products = self.recorder.empty(&[rows, length])?;
        let uniform =
            RowsUniform { rows: rows as u32, length: length as u32, epsilon: EPSILON, pad: 0 };
        let bindings =
            [self.binding(), factors.binding(), dy.binding(), dx.binding(), products.binding()];
        self.recorder.call(&LAYER_NORM_BWD, &[], &uniform, &bindings, Groups::of(rows, 1))?;
        let summands = dy.reshape(&[rows, length])?;
        let over_rows = |of: &Self| of.sum_over(0)?.reshape(&[length]);
        Ok([dx, over_rows(&products)?, over_rows(&summands)?])
    }
}
