//! Parts of the trunk: attributes, visibility, attention gather, SPGR.
//!
//! WGSL: wgsl/network/attributes.wgsl, wgsl/network/occlusion.wgsl; attention gather and SPGR are those of
//! [`crate::gpu::network::attention_gather`] and [`crate::gpu::spgr`].

use super::{Array, check_residual, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::network::attention_gather::{ATTENTION_GATHER, AttentionGatherArgs};
use crate::gpu::spgr::{SPGR, SpgrArgs};
use crate::gpu::uniforms::{AttributesUniform, OcclusionUniform};
use crate::layout::{Gather, SPLAT_STRIDE};

pub(crate) static ATTRIBUTES: Kernel = Kernel {
    name: "attributes",
    entry: "main",
    source: wgsl!(AttributesUniform; "shared/grid", "shared/attributes", "network/attributes"),
};

pub(crate) static OCCLUSION: Kernel = Kernel {
    name: "occlusion",
    entry: "main",
    source: wgsl!(OcclusionUniform; "shared/grid", "network/occlusion"),
};

const THREADS: usize = 64;

impl Array {
    /// Computes the attributes `[N, 11]` of packed rows `[N, 11]`; `call.parents` is ignored.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for another shape; errors of the device.
    pub fn attributes(&self, call: AttributesUniform) -> Result<Self, GpuError> {
        let &[n, SPLAT_STRIDE] = self.dims.as_slice() else {
            return Err(misfit(ATTRIBUTES.name, format!("[N, {SPLAT_STRIDE}]"), &self.dims));
        };
        let result = self.recorder.empty(&[n, SPLAT_STRIDE])?;
        let uniform = AttributesUniform { parents: n as u32, ..call };
        let bindings = [self.binding(), result.binding()];
        self.recorder.call(&ATTRIBUTES, &[], &uniform, &bindings, Groups::of(n, THREADS))?;
        Ok(result)
    }

    /// Computes the visibility `[N, V]` of points `[N, V, 2]` with camera z `z` `[N, V]` before
    /// surfaces `[V, H, W]`; `tolerance` is a share of z.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for other shapes; errors of the device.
    pub fn occlusion(&self, z: &Self, surfaces: &Self, tolerance: f32) -> Result<Self, GpuError> {
        let (n, v, h, w) = match (self.dims.as_slice(), surfaces.dims.as_slice()) {
            (&[n, v, 2], &[views, h, w]) if views == v && z.dims == [n, v] => (n, v, h, w),
            _ => {
                let expected = "points [N, V, 2], z [N, V], surfaces [V, H, W]".to_owned();
                return Err(misfit(OCCLUSION.name, expected, &self.dims));
            }
        };
        let result = self.recorder.empty(&[n, v])?;
        let [points, views, height, width] = [n, v, h, w].map(|n| n as u32);
        let uniform = OcclusionUniform {
            points,
            views,
            height,
            width,
            tolerance,
            ..OcclusionUniform::default()
        };
        let bindings = [self.binding(), z.binding(), surfaces.binding(), result.binding()];
        self.recorder.call(&OCCLUSION, &[], &uniform, &bindings, Groups::of(n * v, THREADS))?;
        Ok(result)
    }

    /// Computes the attention output `[N, E]` from maps `[cells, stride]`, `query` `[N, Q]` and
    /// `points`, and adds `residual` `[N, E]`.
    ///
    /// # Errors
    /// As [`crate::gpu::Gpu::attention_gather`]; a residual of other sizes.
    pub fn gather(
        &self,
        query: &Self,
        points: &Self,
        gather: &Gather,
        residual: Option<&Self>,
    ) -> Result<Self, GpuError> {
        let args = AttentionGatherArgs { gather, maps: &[], query: &[], points: &[] };
        args.check_lengths([self.count(), query.count(), points.count()])?;
        let n = query.count() / gather.query_width().max(1);
        check_residual(ATTENTION_GATHER.name, &[n, gather.dim], residual)?;
        let gpu = &self.recorder.gpu;
        let mut uniform = args.uniform(&(0..n));
        uniform.cells = (self.count() / gather.stride.max(1)) as u32;
        let levels = gpu.upload("feature levels", &args.levels())?;
        let result = self.recorder.empty(&[n, gather.dim])?;
        let (has_residual, residual) = self.residual_argument(residual);
        let bindings = [
            self.binding(),
            query.binding(),
            points.binding(),
            Binding::from(&levels),
            residual,
            result.binding(),
        ];
        let constants = [has_residual];
        self.recorder.call(&ATTENTION_GATHER, &constants, &uniform, &bindings, Groups::of(n, 1))?;
        Ok(result)
    }

    /// Computes the children `[N·K, 11]` and gains of head records `[N, K, 11]` and `parents`
    /// `[N, 11]`; `args.head` and `args.parents` are ignored.
    ///
    /// # Errors
    /// As [`crate::gpu::Gpu::spgr`].
    pub fn spgr(&self, parents: &Self, args: &SpgrArgs) -> Result<[Self; 2], GpuError> {
        let n = args.check_lengths([self.count(), parents.count()])?;
        let (k, gain_stride) = (args.rules.children(), args.rules.gain_channels());
        let gpu = &self.recorder.gpu;
        let uniform = args.uniform(&(0..n));
        let cameras = gpu.upload("context cameras", &args.cameras())?;
        let rows = self.recorder.empty(&[n * k, SPLAT_STRIDE])?;
        let gains = self.recorder.empty(&[n * k, gain_stride])?;
        let bindings = [
            self.binding(),
            parents.binding(),
            Binding::from(&cameras),
            rows.binding(),
            gains.binding(),
        ];
        self.recorder.call(&SPGR, &[], &uniform, &bindings, Groups::of(n, THREADS))?;
        Ok([rows, gains])
    }
}
