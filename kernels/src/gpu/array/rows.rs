//! Reductions over an axis, softmax, and chosen indices.
//!
//! WGSL: wgsl/network/reduce.wgsl, wgsl/network/softmax.wgsl, wgsl/network/select_rows.wgsl,
//! wgsl/network/resize.wgsl.

use super::{Array, PointwiseFunction, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{ReduceUniform, ResizeUniform, RowsUniform, SelectUniform};

pub(crate) static REDUCE: Kernel = Kernel {
    name: "reduce",
    entry: "main",
    source: wgsl!(ReduceUniform; "shared/grid", "network/reduce"),
};

pub(crate) static SOFTMAX: Kernel = Kernel {
    name: "softmax",
    entry: "main",
    source: wgsl!(
        RowsUniform; "shared/grid", "shared/rows", "shared/sum",
        ["shared/place" | "shared/place_subgroups"], "network/softmax"
    ),
};

pub(crate) static SELECT_ROWS: Kernel = Kernel {
    name: "select_rows",
    entry: "main",
    source: wgsl!(SelectUniform; "shared/grid", "network/select_rows"),
};

pub(crate) static RESIZE: Kernel = Kernel {
    name: "resize",
    entry: "main",
    source: wgsl!(ResizeUniform; "shared/grid", "shared/activation", "shared/resize", "network/resize"),
};

const THREADS: usize = 64;

/// A reduction over an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduction {
    /// Sum.
    Sum,
    /// Mean.
    Mean,
    /// Maximum.
    Maximum,
}

impl Array {
    /// Reduces dimension `dim`, whose size becomes 1.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an empty dimension; errors of the device.
    pub fn reduced(&self, dim: usize, reduction: Reduction) -> Result<Self, GpuError> {
        let [outer, length, inner] = self.around(dim)?;
        if length == 0 {
            return Err(misfit(REDUCE.name, "a size of at least 1".to_owned(), &self.dims));
        }
        let (number, factor) = match reduction {
            Reduction::Sum => (0.0, 1.0),
            Reduction::Mean => (0.0, 1.0 / length as f32),
            Reduction::Maximum => (1.0, 1.0),
        };
        let mut dims = self.dims.clone();
        dims[dim] = 1;
        let result = self.recorder.empty(&dims)?;
        let [outer_words, length, inner_words] = [outer, length, inner].map(|n| n as u32);
        let uniform = ReduceUniform { outer: outer_words, length, inner: inner_words, factor };
        let bindings = [self.binding(), result.binding()];
        let groups = Groups::of(outer * inner, THREADS);
        self.recorder.call(&REDUCE, &[("FUNCTION", number)], &uniform, &bindings, groups)?;
        Ok(result)
    }

    /// Computes the softmax over the last dimension.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an empty dimension; errors of the device.
    pub fn softmax(&self) -> Result<Self, GpuError> {
        let length = self.dims.last().copied().unwrap_or(0);
        if length == 0 {
            return Err(misfit(SOFTMAX.name, "[.., n]".to_owned(), &self.dims));
        }
        let rows = self.count() / length;
        let result = self.recorder.empty(&self.dims)?;
        let uniform =
            RowsUniform { rows: rows as u32, length: length as u32, ..RowsUniform::default() };
        let bindings = [self.binding(), result.binding()];
        self.recorder.call(&SOFTMAX, &[], &uniform, &bindings, Groups::of(rows, 1))?;
        Ok(result)
    }

    /// Returns the given indices of dimension `dim`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an index outside the dimension; errors of the device.
    pub fn selected(&self, dim: usize, indices: &[u32]) -> Result<Self, GpuError> {
        let [outer, length, inner] = self.around(dim)?;
        if let Some(index) = indices.iter().find(|i| **i as usize >= length) {
            let expected = format!("indices below {length}");
            return Err(misfit(SELECT_ROWS.name, expected, &[*index as usize]));
        }
        let mut dims = self.dims.clone();
        dims[dim] = indices.len();
        let result = self.recorder.empty(&dims)?;
        let [outer_words, length, inner, chosen] =
            [outer, length, inner, indices.len()].map(|n| n as u32);
        let gpu = &self.recorder.gpu;
        let uniform = SelectUniform { outer: outer_words, length, inner, chosen };
        let indices = gpu.upload("indices", indices)?;
        let bindings = [self.binding(), (&indices).into(), result.binding()];
        let groups = Groups::of(result.count(), THREADS);
        self.recorder.call(&SELECT_ROWS, &[], &uniform, &bindings, groups)?;
        Ok(result)
    }

    /// Resizes planes `[…, h, w]` bilinearly, corners aligned, then applies `activation`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an empty size; errors of the device.
    pub fn resized(&self, to: [usize; 2], activation: PointwiseFunction) -> Result<Self, GpuError> {
        let rank = self.dims.len();
        if rank < 2 || self.count() == 0 || to.contains(&0) {
            return Err(misfit(RESIZE.name, "[.., h, w]".to_owned(), &self.dims));
        }
        let mut dims = self.dims.clone();
        let from = [dims[rank - 2], dims[rank - 1]];
        dims[rank - 2..].copy_from_slice(&to);
        let result = self.recorder.empty(&dims)?;
        let uniform = ResizeUniform {
            input_size: from.map(|n| n as u32),
            output_size: to.map(|n| n as u32),
            planes: (self.count() / (from[0] * from[1])) as u32,
            pad: 0,
        };
        let bindings = [self.binding(), result.binding()];
        let constants = [("ACTIVATION_KIND", f64::from(activation as u32))];
        let groups = Groups::of(result.count(), THREADS);
        self.recorder.call(&RESIZE, &constants, &uniform, &bindings, groups)?;
        Ok(result)
    }

    /// Computes the mean of blocks of `s` × `s` pixels of `[…, h, w]`; a remainder at the right
    /// and the lower edge is left out.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sides below `s`; errors of the device.
    pub fn pooled(&self, s: usize) -> Result<Self, GpuError> {
        let rank = self.dims.len();
        let (h, w) = match self.dims.as_slice() {
            &[.., h, w] if s > 0 && h >= s && w >= s => (h / s, w / s),
            _ => return Err(misfit("pool", format!("sides of at least {s}"), &self.dims)),
        };
        let cut = self.narrow(rank - 1, 0, w * s)?.narrow(rank - 2, 0, h * s)?;
        let planes = cut.count() / (h * s * w * s);
        let mut dims = self.dims.clone();
        dims[rank - 2..].copy_from_slice(&[h, w]);
        cut.reshape(&[planes * h, s, w, s])?
            .reduced(3, Reduction::Mean)?
            .reduced(1, Reduction::Mean)?
            .reshape(&dims)
    }
}
