//! Normalisation over groups of channels and over the last axis.
//!
//! WGSL: wgsl/network/norm_statistics.wgsl, wgsl/network/norm_apply.wgsl, wgsl/network/layer_norm.wgsl.

use super::{Array, PointwiseFunction, check_residual, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{NormUniform, RowsUniform};

pub(crate) static NORM_STATISTICS: Kernel = Kernel {
    name: "norm_statistics",
    entry: "main",
    source: wgsl!(
        NormUniform; "shared/grid", "shared/norm", "shared/sum",
        ["shared/place" | "shared/place_subgroups"], "network/norm_statistics"
    ),
};

pub(crate) static NORM_APPLY: Kernel = Kernel {
    name: "norm_apply",
    entry: "main",
    source: wgsl!(
        NormUniform; "shared/grid", "shared/activation", "shared/norm", "shared/norm_read",
        "network/norm_apply"
    ),
};

pub(crate) static LAYER_NORM: Kernel = Kernel {
    name: "layer_norm",
    entry: "main",
    source: wgsl!(
        RowsUniform; "shared/grid", "shared/rows", "shared/sum",
        ["shared/place" | "shared/place_subgroups"], "network/layer_norm"
    ),
};

/// ε of every normalisation (PyTorch's default).
pub(super) const EPSILON: f32 = 1e-5;
/// Numbers of a part of a row (wgsl/shared/norm.wgsl).
pub(super) const PART: usize = 8192;

/// Array of the same sizes that [`Array::layer_norm`] adds.
#[derive(Clone, Copy, Debug)]
pub enum NormSum<'a> {
    /// None.
    None,
    /// The sum is normalised.
    Before(&'a Array),
    /// The norm's result is added to it.
    After(&'a Array),
}

impl Array {
    /// Normalises groups of channels of `[B, C, …]`, multiplies and adds `affine`, `[C]` each,
    /// applies `activation`, and adds `residual` of the same sizes.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn group_norm(
        &self,
        groups: usize,
        affine: Option<[&Self; 2]>,
        activation: PointwiseFunction,
        residual: Option<&Self>,
    ) -> Result<Self, GpuError> {
        check_residual(NORM_APPLY.name, &self.dims, residual)?;
        let (b, c) = match self.dims.as_slice() {
            &[b, c, _, ..] if groups > 0 && c.is_multiple_of(groups) => (b, c),
            _ => {
                let expected = format!("[B, C, ..] with C a multiple of {groups}");
                return Err(misfit(NORM_APPLY.name, expected, &self.dims));
            }
        };
        if self.count() == 0 || affine.is_some_and(|a| a.iter().any(|a| a.count() != c)) {
            let expected = format!("elements, and {c} factors and summands");
            return Err(misfit(NORM_APPLY.name, expected, &self.dims));
        }
        let rows = b * groups;
        let length = self.count() / rows;
        let parts = length.div_ceil(PART);
        let words = |n: usize| n as u32;
        let uniform = NormUniform {
            rows: words(rows),
            length: words(length),
            run: words(self.count() / (b * c)),
            groups: words(groups),
            parts: words(parts),
            has_affine: u32::from(affine.is_some()),
            epsilon: EPSILON,
            channel_parts: 0,
        };
        let statistics = self.recorder.empty(&[rows * parts, 2])?;
        let result = self.recorder.empty(&self.dims)?;
        let workgroups = || Groups::of(rows * parts, 1);
        let bindings = [self.binding(), statistics.binding()];
        self.recorder.call(&NORM_STATISTICS, &[], &uniform, &bindings, workgroups())?;
        let [factors, summands] = affine.unwrap_or([self, self]).map(Array::binding);
        let (has_residual, residual) = self.residual_argument(residual);
        let bindings =
            [self.binding(), statistics.binding(), factors, summands, residual, result.binding()];
        let constants = [("ACTIVATION_KIND", f64::from(activation as u32)), has_residual];
        self.recorder.call(&NORM_APPLY, &constants, &uniform, &bindings, workgroups())?;
        Ok(result)
    }

    /// Normalises the last dimension, multiplies and adds `affine`, with `sum` before or after.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn layer_norm(&self, affine: [&Self; 2], sum: NormSum<'_>) -> Result<Self, GpuError> {
        let (place, other) = match sum {
            NormSum::None => (0, None),
            NormSum::Before(other) => (1, Some(other)),
            NormSum::After(other) => (2, Some(other)),
        };
        check_residual(LAYER_NORM.name, &self.dims, other)?;
        let length = self.dims.last().copied().unwrap_or(0);
        if length == 0 || affine.iter().any(|a| a.count() != length) {
            let expected = format!("[.., {}]", affine[0].count());
            return Err(misfit(LAYER_NORM.name, expected, &self.dims));
        }
        let rows = self.count() / length;
        let result = self.recorder.empty(&self.dims)?;
        let uniform =
            RowsUniform { rows: rows as u32, length: length as u32, epsilon: EPSILON, pad: 0 };
        let [factors, summands] = affine.map(Array::binding);
        let other = other.map_or_else(|| self.first_binding(), Self::binding);
        let bindings = [self.binding(), factors, summands, other, result.binding()];
        let constants = [("SUM", f64::from(place))];
        self.recorder.call(&LAYER_NORM, &constants, &uniform, &bindings, Groups::of(rows, 1))?;
        Ok(result)
    }
}
