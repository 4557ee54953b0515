//! Attention without a matrix of logits.
//!
//! WGSL: wgsl/network/attention.wgsl.

use super::{Array, Function, PointwiseFunction, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::AttentionUniform;

pub(crate) static ATTENTION: Kernel = Kernel {
    name: "attention",
    entry: "main",
    source: wgsl!(AttentionUniform; "shared/grid", "network/attention"),
};

/// Queries of a workgroup.
const SIDE: usize = 32;
/// Largest width of the values.
const VALUES_MAX: usize = 256;

/// Constants of one call.
#[derive(Clone, Copy, Debug)]
pub struct AttentionCall<'a> {
    /// Factor of the dot product.
    pub scale: f32,
    /// Term of pairs with different labels.
    pub penalty: f32,
    /// Windows, labels of queries `[windows, L]` and of keys `[windows, M]`.
    pub labels: Option<(usize, &'a [u8], &'a [u8])>,
}

impl AttentionCall<'_> {
    /// Returns the terms of the logits `[L, M]` of each window; `None` where all of them are 0.
    fn masks(&self, [l, m]: [usize; 2]) -> impl Iterator<Item = Option<Vec<f32>>> {
        let (windows, queries, keys) = self.labels.unwrap_or((0, &[], &[]));
        let penalty = self.penalty;
        (0..windows).map(move |window| {
            let (queries, keys) = (&queries[window * l..][..l], &keys[window * m..][..m]);
            let term = move |a: u8| keys.iter().map(move |b| if a == *b { 0.0 } else { penalty });
            let all: Vec<f32> = queries.iter().copied().flat_map(term).collect();
            all.iter().any(|term| *term != 0.0).then_some(all)
        })
    }
}

impl Array {
    /// Computes attention of queries `[R, L, d]` to `k` `[R, M, d]` and `v` `[R, M, e]`, e at most
    /// 256: `[R, L, e]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn attention(&self, k: &Self, v: &Self, call: AttentionCall) -> Result<Self, GpuError> {
        let (&[r, l, d], &[_, m, _], &[.., e]) =
            (self.dims.as_slice(), k.dims.as_slice(), v.dims.as_slice())
        else {
            return Err(misfit(ATTENTION.name, "[R, L, d]".to_owned(), &self.dims));
        };
        let labels_fit = call.labels.is_none_or(|(windows, queries, keys)| {
            windows > 0
                && r.is_multiple_of(windows)
                && [queries.len(), keys.len()] == [windows * l, windows * m]
        });
        if k.dims != [r, m, d] || v.dims != [r, m, e] || e > VALUES_MAX || m == 0 || !labels_fit {
            let expected = format!("keys [{r}, M, {d}], values [{r}, M, e ≤ {VALUES_MAX}], labels");
            return Err(misfit(ATTENTION.name, expected, &v.dims));
        }
        let result = self.recorder.empty(&[r, l, e])?;
        let gpu = &self.recorder.gpu;
        let words = |n: usize| n as u32;
        let (windows, queries, keys) = call.labels.unwrap_or((0, &[], &[]));
        let uniform = AttentionUniform {
            rows: words(r),
            queries: words(l),
            keys: words(m),
            width: words(d),
            value_width: words(e),
            windows: words(windows),
            scale: call.scale,
            penalty: call.penalty,
        };
        let labels: Vec<u32> = queries.iter().chain(keys).map(|label| u32::from(*label)).collect();
        let labels = gpu.upload("labels", &labels)?;
        let bindings =
            [self.binding(), k.binding(), v.binding(), Binding::from(&labels), result.binding()];
        let groups = Groups::of(r * l.div_ceil(SIDE), 1);
        self.recorder.count_flops(&ATTENTION, 2 * r * l * m * (d + e));
        self.recorder.call(&ATTENTION, &[], &uniform, &bindings, groups)?;
        Ok(result)
    }

    /// Computes the gradients of queries, this array, keys and values from the gradient `dy`
    /// `[R, L, e]` of [`Array::attention`], row by row: one matrix `[L, M]` of weights exists
    /// at a time.
    ///
    /// # Errors
    /// As [`Array::attention`].
    pub fn attention_backward(
        &self,
        k: &Self,
        v: &Self,
        call: AttentionCall,
        dy: &Self,
    ) -> Result<[Self; 3], GpuError> {
        let (&[r, l, d], &[_, m, _], &[.., e]) =
            (self.dims.as_slice(), k.dims.as_slice(), v.dims.as_slice())
        else {
            return Err(misfit(ATTENTION.name, "[R, L, d]".to_owned(), &self.dims));
        };
        if dy.dims != [r, l, e] {
            return Err(misfit(ATTENTION.name, format!("a gradient [{r}, {l}, {e}]"), &dy.dims));
        }
        let masks = call.masks([l, m]).map(|mask| match mask {
            Some(mask) => self.recorder.upload(&mask, &[l, m]).map(Some),
            None => Ok(None),
        });
        let masks = masks.collect::<Result<Vec<_>, _>>()?;
        let (mut of_q, mut of_k, mut of_v) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..r {
            let part = |of: &Self, dims: [usize; 2]| of.narrow(0, row, 1)?.reshape(&dims);
            let (q, k, v) = (part(self, [l, d])?, part(k, [m, d])?, part(v, [m, e])?);
            let dy = part(dy, [l, e])?;
            let none = PointwiseFunction::None;
            let logits = q.projected(&k, None, none)?.map(Function::Affine(call.scale, 0.0))?;
            let logits = match masks.get(row % masks.len().max(1)) {
                Some(Some(mask)) => logits.with(mask, Function::Plus)?,
                _ => logits,
            };
            let weights = logits.softmax()?;
            let of_logits = weights.softmax_backward(&dy.projected(&v, None, none)?)?;
            let of_products = of_logits.map(Function::Affine(call.scale, 0.0))?;
            of_q.push(of_products.projected(&k.permuted(&[1, 0])?, None, none)?);
            of_k.push(q.projected_weight_backward(&of_products)?);
            of_v.push(dy.projected_weight_backward(&weights)?);
        }
        let joined = |rows: &[Self], dims: &[usize]| {
            Self::joined(&rows.iter().collect::<Vec<_>>(), 0)?.reshape(dims)
        };
        Ok([joined(&of_q, &self.dims)?, joined(&of_k, &k.dims)?, joined(&of_v, &v.dims)?])
    }
}
