//! Gradients of sub-pixel Gaussian reparameterization.
//!
//! CPU version: [`crate::cpu::spgr`]. WGSL: wgsl/spgr/spgr_bwd.wgsl, wgsl/spgr/spgr_gains_bwd.wgsl.
//! Tests: tests/gpu/spgr.rs.

use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::spgr::SpgrArgs;
use crate::gpu::uniforms::SpgrGainsBwdUniform;
use crate::layout::{HEAD_STRIDE, Rules, SPLAT_STRIDE};

pub(crate) static SPGR_BWD: Kernel = Kernel {
    name: "spgr_bwd",
    entry: "main",
    source: wgsl!(
        SpgrUniform; "shared/grid", "shared/math", "shared/share", "shared/spgr", "spgr/spgr_bwd"
    ),
};

pub(crate) static SPGR_GAINS_BWD: Kernel = Kernel {
    name: "spgr_gains_bwd",
    entry: "main",
    source: wgsl!(SpgrGainsBwdUniform; "shared/grid", "shared/math", "spgr/spgr_gains_bwd"),
};

/// Threads of a workgroup.
const THREADS: usize = 64;

impl Gpu {
    /// Computes the gradients of head records `[N, K, 11]` and parents `[N, 11]` for `grad`
    /// `[N·K, 11]`, the gradient of the children. The gain of each head record has gradient 0
    /// here.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths; errors of the device.
    pub fn spgr_backward(
        &self,
        args: &SpgrArgs,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let n = args.check()?;
        let k = args.rules.children();
        let lengths = [("gradient of the children", grad.len(), n * k * SPLAT_STRIDE)];
        GpuError::check_lengths(SPGR_BWD.name, lengths)?;
        let cameras = self.upload("context cameras", &args.cameras())?;
        let (mut head_gradients, mut parent_gradients) = (Vec::new(), Vec::new());
        for parents in Self::chunks(n, self.rows_per_binding(k * HEAD_STRIDE.max(SPLAT_STRIDE))) {
            let count = parents.len() * k;
            let from = parents.start * k * SPLAT_STRIDE;
            let uniform = self.uniform(&args.uniform(&parents))?;
            let [head, own] = args.rows(&parents);
            let head = self.upload("head records", head)?;
            let own = self.upload("parents", own)?;
            let grad = grad.get(from..from + count * SPLAT_STRIDE).unwrap_or(&[]);
            let grad = self.upload("gradient of the children", grad)?;
            let d_head = self.empty::<f32>("gradient of the head", count * HEAD_STRIDE)?;
            let floats = parents.len() * SPLAT_STRIDE;
            let d_parents = self.empty::<f32>("gradient of the parents", floats)?;
            let bindings = [&uniform, &head, &own, &cameras, &grad, &d_head, &d_parents];
            let mut commands = self.commands("spgr_bwd", false);
            let groups = Groups::of(parents.len(), THREADS);
            commands.run(&SPGR_BWD, &[], &bindings.map(Binding::from), groups)?;
            let d_head = commands.read::<f32>(&d_head, count * HEAD_STRIDE)?;
            let d_parents = commands.read::<f32>(&d_parents, floats)?;
            commands.submit()?;
            head_gradients.extend(d_head.take(self)?);
            parent_gradients.extend(d_parents.take(self)?);
        }
        Ok((head_gradients, parent_gradients))
    }

    /// Computes the gradient `[N, K, 11]` of the head records for `grad` `[N·K]` or `[N·K, 4]`,
    /// the gradient of the gains. It is zero except for the gain of each record.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths; errors of the device.
    pub fn spgr_gains_backward(
        &self,
        rules: &Rules,
        head: &[f32],
        grad: &[f32],
    ) -> Result<Vec<f32>, GpuError> {
        let records = head.len() / HEAD_STRIDE;
        let gain_stride = rules.gain_channels();
        let lengths = [
            ("head records", head.len(), records * HEAD_STRIDE),
            ("gradient of the gains", grad.len(), records * gain_stride),
        ];
        GpuError::check_lengths(SPGR_GAINS_BWD.name, lengths)?;
        let mut out = Vec::with_capacity(head.len());
        for part in Self::chunks(records, self.rows_per_binding(HEAD_STRIDE)) {
            let uniform = self.uniform(&SpgrGainsBwdUniform {
                records: part.len() as u32,
                lanes: gain_stride as u32,
                delta: rules.delta as f32,
                pad: 0,
            })?;
            let rows = |of: &[f32], width: usize| {
                of.get(part.start * width..part.end * width).unwrap_or(&[]).to_vec()
            };
            let head = self.upload("head records", &rows(head, HEAD_STRIDE))?;
            let grad = self.upload("gradient of the gains", &rows(grad, gain_stride))?;
            let floats = part.len() * HEAD_STRIDE;
            let d_head = self.empty::<f32>("gradient of the head", floats)?;
            let bindings = [&uniform, &head, &grad, &d_head].map(Binding::from);
            let mut commands = self.commands("spgr_gains_bwd", false);
            commands.run(&SPGR_GAINS_BWD, &[], &bindings, Groups::of(part.len(), THREADS))?;
            let reading = commands.read::<f32>(&d_head, floats)?;
            commands.submit()?;
            out.extend(reading.take(self)?);
        }
        Ok(out)
    }
}
