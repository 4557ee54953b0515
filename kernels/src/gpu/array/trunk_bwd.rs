//! Gradients of parts of the trunk: attributes, SPGR.
//!
//! CPU versions: [`crate::cpu::attributes`], [`crate::cpu::spgr`]. WGSL:
//! wgsl/network/attributes_bwd.wgsl; SPGR's kernels are those of [`crate::gpu::spgr::backward`]. Tests:
//! tests/gpu/array_gradients.rs.

use super::{Array, Function, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::spgr::SpgrArgs;
use crate::gpu::spgr::backward::{SPGR_BWD, SPGR_GAINS_BWD};
use crate::gpu::uniforms::{AttributesUniform, SpgrGainsBwdUniform};
use crate::layout::SPLAT_STRIDE;

pub(crate) static ATTRIBUTES_BWD: Kernel = Kernel {
    name: "attributes_bwd",
    entry: "main",
    source: wgsl!(AttributesUniform; "shared/grid", "shared/attributes", "network/attributes_bwd"),
};

const THREADS: usize = 64;

impl Array {
    /// Computes the gradient of the packed rows of [`Array::attributes`], this array, from
    /// the gradient `dy` of the attributes.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for other sizes; errors of the device.
    pub fn attributes_backward(
        &self,
        call: AttributesUniform,
        dy: &Self,
    ) -> Result<Self, GpuError> {
        let n = match self.dims.as_slice() {
            &[n, SPLAT_STRIDE] if dy.dims == self.dims => n,
            _ => {
                let expected = format!("[N, {SPLAT_STRIDE}] and its gradient");
                return Err(misfit(ATTRIBUTES_BWD.name, expected, &dy.dims));
            }
        };
        let dx = self.recorder.empty(&self.dims)?;
        let uniform = AttributesUniform { parents: n as u32, ..call };
        let bindings = [self.binding(), dy.binding(), dx.binding()];
        self.recorder.call(&ATTRIBUTES_BWD, &[], &uniform, &bindings, Groups::of(n, THREADS))?;
        Ok(dx)
    }

    /// Computes the gradients of head records `[N, K, 11]`, this array, and of `parents` `[N, 11]`
    /// from those of the children: `rows` `[N·K, 11]` and `gains`. `args.head` and `args.parents`
    /// are ignored.
    ///
    /// # Errors
    /// As [`crate::gpu::Gpu::spgr_backward`].
    pub fn spgr_backward(
        &self,
        parents: &Self,
        args: &SpgrArgs,
        [rows, gains]: [&Self; 2],
    ) -> Result<[Self; 2], GpuError> {
        let n = args.check_lengths([self.count(), parents.count()])?;
        let (k, gain_stride) = (args.rules.children(), args.rules.gain_channels());
        let lengths = [
            ("gradient of the children", rows.count(), n * k * SPLAT_STRIDE),
            ("gradient of the gains", gains.count(), n * k * gain_stride),
        ];
        GpuError::check_lengths(SPGR_BWD.name, lengths)?;
        let cameras = self.recorder.gpu.upload("context cameras", &args.cameras())?;
        let d_head = self.recorder.empty(&self.dims)?;
        let d_parents = self.recorder.empty(&parents.dims)?;
        let bindings = [
            self.binding(),
            parents.binding(),
            Binding::from(&cameras),
            rows.binding(),
            d_head.binding(),
            d_parents.binding(),
        ];
        let uniform = args.uniform(&(0..n));
        let groups = Groups::of(n, THREADS);
        self.recorder.call(&SPGR_BWD, &[], &uniform, &bindings, groups)?;
        let of_gains = self.recorder.empty(&self.dims)?;
        let uniform = SpgrGainsBwdUniform {
            records: (n * k) as u32,
            lanes: gain_stride as u32,
            delta: args.rules.delta as f32,
            pad: 0,
        };
        let bindings = [self.binding(), gains.binding(), of_gains.binding()];
        let groups = Groups::of(n * k, THREADS);
        self.recorder.call(&SPGR_GAINS_BWD, &[], &uniform, &bindings, groups)?;
        Ok([d_head.with(&of_gains, Function::Plus)?, d_parents])
    }
}
