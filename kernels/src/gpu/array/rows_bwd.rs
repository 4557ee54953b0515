//! Sums in a fixed order, and gradients of resizes and of chosen indices.
//!
//! CPU versions: [`crate::cpu::sums`], [`crate::cpu::resize`], tensor operations. WGSL:
//! wgsl/network/sum_parts.wgsl, wgsl/network/resize_bwd.wgsl, wgsl/network/select_rows_bwd.wgsl. Tests:
//! tests/gpu/array_gradients.rs.

use super::{Array, Function, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{ResizeUniform, SelectUniform, SumPartsUniform};

pub(crate) static SUM_PARTS: Kernel = Kernel {
    name: "sum_parts",
    entry: "main",
    source: wgsl!(SumPartsUniform; "shared/grid", "network/sum_parts"),
};

pub(crate) static RESIZE_BWD: Kernel = Kernel {
    name: "resize_bwd",
    entry: "main",
    source: wgsl!(ResizeUniform; "shared/grid", "shared/resize", "network/resize_bwd"),
};

pub(crate) static SELECT_ROWS_BWD: Kernel = Kernel {
    name: "select_rows_bwd",
    entry: "main",
    source: wgsl!(SelectUniform; "shared/grid", "network/select_rows_bwd"),
};

const THREADS: usize = 64;
/// Elements that one thread adds.
const TERMS: usize = 64;

impl Array {
    /// Sums over dimension `dim`, whose size becomes 1, in several passes. The order of the sum
    /// depends on the sizes alone.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an empty dimension; errors of the device.
    pub fn sum_over(&self, dim: usize) -> Result<Self, GpuError> {
        let mut sum = self.clone();
        loop {
            let [outer, length, inner] = sum.around(dim)?;
            if length == 0 {
                return Err(misfit(SUM_PARTS.name, "a size of at least 1".to_owned(), &self.dims));
            }
            if length == 1 {
                return Ok(sum);
            }
            let parts = length.div_ceil(TERMS);
            let mut dims = sum.dims.clone();
            dims[dim] = parts;
            let next = sum.recorder.empty(&dims)?;
            let [outer_words, length, inner_words, parts_words] =
                [outer, length, inner, parts].map(|n| n as u32);
            let uniform = SumPartsUniform {
                outer: outer_words,
                length,
                inner: inner_words,
                parts: parts_words,
            };
            let bindings = [sum.binding(), next.binding()];
            let groups = Groups::of(outer * parts * inner, THREADS);
            sum.recorder.call(&SUM_PARTS, &[], &uniform, &bindings, groups)?;
            sum = next;
        }
    }

    /// Sums over the dimensions whose size in `dims` is 1: the gradient of a repetition.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn sum_to(&self, dims: &[usize]) -> Result<Self, GpuError> {
        let fits = self.dims.len() == dims.len()
            && self.dims.iter().zip(dims).all(|(own, to)| own == to || *to == 1);
        if !fits {
            return Err(misfit(SUM_PARTS.name, format!("{dims:?} repeated"), &self.dims));
        }
        // Inner dimensions first: neighbouring threads then read neighbouring elements.
        let repeated = (0..dims.len()).rev().filter(|i| self.dims[*i] != dims[*i]);
        repeated.into_iter().try_fold(self.clone(), |sum, dim| sum.sum_over(dim))
    }

    /// Computes the gradient of the planes `[…, h, w]` of sizes `from` of a resize without
    /// activation from that of the result, this array.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn resized_backward(&self, from: [usize; 2]) -> Result<Self, GpuError> {
        let rank = self.dims.len();
        if rank < 2 || self.count() == 0 || from.contains(&0) {
            return Err(misfit(RESIZE_BWD.name, "[.., h, w]".to_owned(), &self.dims));
        }
        let to = [self.dims[rank - 2], self.dims[rank - 1]];
        let mut dims = self.dims.clone();
        dims[rank - 2..].copy_from_slice(&from);
        let dx = self.recorder.empty(&dims)?;
        let uniform = ResizeUniform {
            input_size: from.map(|n| n as u32),
            output_size: to.map(|n| n as u32),
            planes: (self.count() / (to[0] * to[1])) as u32,
            pad: 0,
        };
        let bindings = [self.binding(), dx.binding()];
        let groups = Groups::of(dx.count(), THREADS);
        self.recorder.call(&RESIZE_BWD, &[], &uniform, &bindings, groups)?;
        Ok(dx)
    }

    /// Computes the gradient of an array whose indices `indices` of dimension `dim`, of size
    /// `length`, were chosen, from that of the result, this array.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for an index outside the dimension; errors of the device.
    pub fn selected_backward(
        &self,
        dim: usize,
        length: usize,
        indices: &[u32],
    ) -> Result<Self, GpuError> {
        let [outer, chosen, inner] = self.around(dim)?;
        if indices.len() != chosen || indices.iter().any(|i| *i as usize >= length) {
            let expected = format!("{chosen} indices below {length}");
            return Err(misfit(SELECT_ROWS_BWD.name, expected, &[indices.len()]));
        }
        let mut places: Vec<u32> = vec![0; length + 1];
        indices.iter().for_each(|i| places[*i as usize + 1] += 1);
        (0..length).for_each(|i| places[i + 1] += places[i]);
        let mut order: Vec<u32> = (0..chosen as u32).collect();
        order.sort_by_key(|place| indices[*place as usize]);
        places.extend(order);
        let mut dims = self.dims.clone();
        dims[dim] = length;
        let dx = self.recorder.empty(&dims)?;
        let [outer, length, inner, chosen] = [outer, length, inner, chosen].map(|n| n as u32);
        let uniform = SelectUniform { outer, length, inner, chosen };
        let places = self.recorder.gpu.upload("places of indices", &places)?;
        let bindings = [self.binding(), (&places).into(), dx.binding()];
        let groups = Groups::of(dx.count(), THREADS);
        self.recorder.call(&SELECT_ROWS_BWD, &[], &uniform, &bindings, groups)?;
        Ok(dx)
    }

    /// Computes the gradient of a part of dimension `dim` that starts at `start`, of size `length`,
    /// from that of the part, this array: zeros outside the part.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for a part outside the dimension; errors of the device.
    pub fn narrow_backward(
        &self,
        dim: usize,
        start: usize,
        length: usize,
    ) -> Result<Self, GpuError> {
        self.around(dim)?;
        let mut dims = self.dims.clone();
        dims[dim] = length;
        let mut first = vec![0; dims.len()];
        first[dim] = start;
        self.spread(&dims, &vec![1; dims.len()], &first)
    }

    /// Computes the gradient of a softmax over the last dimension from the result, this array, and
    /// its gradient `dy`: y·(dy − Σ dy·y).
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn softmax_backward(&self, dy: &Self) -> Result<Self, GpuError> {
        let last = self.dims.len().saturating_sub(1);
        let weighted = dy.with(self, Function::Times)?;
        let sum = weighted.sum_over(last)?;
        dy.with(&sum, Function::Minus)?.with(self, Function::Times)
    }

    /// Computes the gradient of [`Array::repeated`] from that of the result, this array.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn repeated_backward(&self, s: usize) -> Result<Self, GpuError> {
        let (b, c, h, w) = match self.dims.as_slice() {
            &[b, c, h, w] if s > 0 && h.is_multiple_of(s) && w.is_multiple_of(s) => {
                (b, c, h / s, w / s)
            }
            _ => return Err(misfit("repeat", format!("sides that {s} divides"), &self.dims)),
        };
        let blocks = self.reshape(&[b * c * h, s, w, s])?;
        blocks.sum_over(3)?.sum_over(1)?.reshape(&[b, c, h, w])
    }

    /// Computes the gradient of [`Array::pooled`] of an array of sizes `dims` from that of
    /// the result, this array.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn pooled_backward(&self, s: usize, dims: &[usize]) -> Result<Self, GpuError> {
        let rank = dims.len();
        let planes = self.dims.iter().rev().skip(2).product();
        let (h, w) = match self.dims.as_slice() {
            &[.., h, w] if rank >= 2 => (h, w),
            _ => return Err(misfit("pool", "[.., h, w]".to_owned(), &self.dims)),
        };
        let shared = self.map(Function::Affine(1.0 / (s * s) as f32, 0.0))?;
        let whole = shared.reshape(&[1, planes, h, w])?.repeated(s)?;
        // A remainder at the right and the lower edge has no gradient.
        let padded = whole.narrow_backward(3, 0, dims[rank - 1])?;
        padded.narrow_backward(2, 0, dims[rank - 2])?.reshape(dims)
    }
}
