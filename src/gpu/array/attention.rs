//! Attention without a matrix of logits.
//!
//! WGSL: kernels/attention.wgsl.

use super::{DeviceArray, misfit};
use crate::abi::AttentionUniform;
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Access, Kernel, wgsl};

pub(crate) static ATTENTION: Kernel = Kernel {
    name: "attention",
    entry: "main",
    source: wgsl!("shared/grid", "attention"),
    bindings: &[
        Access::Uniform,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Write,
    ],
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

impl DeviceArray {
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
}
