//! Opacity redistribution (SubSplat, "Opacity allocation"; supplement A.3).
//!
//! CPU version: [`crate::cpu::redistribute`]. WGSL: wgsl/spgr/redistribute.wgsl,
//! wgsl/spgr/redistribute_bwd.wgsl. Tests: tests/gpu/redistribute.rs.

use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::RedistributeUniform;
use crate::layout::OpacityRule;
use std::ops::Range;

pub(crate) static REDISTRIBUTE: Kernel = Kernel {
    name: "redistribute",
    entry: "main",
    source: wgsl!(
        RedistributeUniform; "shared/grid", "shared/math", "shared/share", "spgr/redistribute"
    ),
};

pub(crate) static REDISTRIBUTE_BWD: Kernel = Kernel {
    name: "redistribute_bwd",
    entry: "main",
    source: wgsl!(
        RedistributeUniform; "shared/grid", "shared/math", "shared/share", "spgr/redistribute_bwd"
    ),
};

/// Threads of a workgroup.
const THREADS: usize = 64;

/// Arguments of a call with K = `k` children for each of P parents.
#[derive(Clone, Copy, Debug)]
pub struct RedistributeArgs<'a> {
    /// Redistribution rule.
    pub rule: OpacityRule,
    /// K, at least 1.
    pub k: usize,
    /// ℓ, `[P, K]`.
    pub logits: &'a [f32],
    /// `[P, K]`, px².
    pub areas: &'a [f32],
    /// α, `[P]`.
    pub alphas: &'a [f32],
    /// `[P]`, px²: areas of the parents. Read only by the rules whose areas are relative.
    pub own: &'a [f32],
}

impl RedistributeArgs<'_> {
    /// Checks the lengths.
    fn check(&self) -> Result<(), GpuError> {
        let p = self.alphas.len();
        let k = self.k;
        let own = if self.rule.areas_are_relative() { p } else { self.own.len() };
        let lengths = [
            ("logits", self.logits.len(), p * k),
            ("areas", self.areas.len(), p * k),
            ("own areas", self.own.len(), own),
            ("children", k.min(1), 1),
        ];
        GpuError::check_lengths(REDISTRIBUTE.name, lengths)
    }
}

/// Returns `of[range]`; empty for an argument that the kernel does not read.
fn part<'a>(of: &'a [f32], range: &Range<usize>) -> &'a [f32] {
    of.get(range.clone()).unwrap_or(&[])
}

/// Gradients of [`Gpu::redistribute`].
#[derive(Clone, Debug, Default)]
pub struct RedistributeGradients {
    /// `[P, K]`.
    pub logits: Vec<f32>,
    /// `[P, K]`.
    pub areas: Vec<f32>,
    /// `[P]`.
    pub alphas: Vec<f32>,
    /// `[P]`; zeros for the rules that do not read the parents' areas.
    pub own: Vec<f32>,
}

impl RedistributeArgs<'_> {
    /// Uploads the uniform and the inputs of some parents.
    fn upload(&self, gpu: &Gpu, parents: &Range<usize>) -> Result<Vec<Binding>, GpuError> {
        let children = parents.start * self.k..parents.end * self.k;
        let uniform = gpu.uniform(&RedistributeUniform {
            parents: parents.len() as u32,
            children: self.k as u32,
            rule: self.rule as u32,
            pad: 0,
        })?;
        let inputs = [
            uniform,
            gpu.upload("logits", part(self.logits, &children))?,
            gpu.upload("areas", part(self.areas, &children))?,
            gpu.upload("opacities", part(self.alphas, parents))?,
            gpu.upload("own areas", part(self.own, parents))?,
        ];
        Ok(inputs.iter().map(Binding::from).collect())
    }
}

impl Gpu {
    /// Computes the opacities `[P, K]` of the children.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths; errors of the device.
    pub fn redistribute(&self, args: &RedistributeArgs) -> Result<Vec<f32>, GpuError> {
        args.check()?;
        let mut out = Vec::with_capacity(args.logits.len());
        for parents in Self::chunks(args.alphas.len(), self.rows_per_binding(args.k)) {
            let mut bindings = args.upload(self, &parents)?;
            let count = parents.len() * args.k;
            let shared = self.empty::<f32>("children's opacities", count)?;
            bindings.push(Binding::from(&shared));
            let mut commands = self.commands("redistribute", false);
            commands.run(&REDISTRIBUTE, &[], &bindings, Groups::of(parents.len(), THREADS))?;
            let reading = commands.read::<f32>(&shared, count)?;
            commands.submit()?;
            out.extend(reading.take(self)?);
        }
        Ok(out)
    }

    /// Computes the gradients of [`Gpu::redistribute`] for `grad` `[P, K]`, the gradient of its
    /// result.
    ///
    /// # Errors
    /// As [`Gpu::redistribute`].
    pub fn redistribute_backward(
        &self,
        args: &RedistributeArgs,
        grad: &[f32],
    ) -> Result<RedistributeGradients, GpuError> {
        args.check()?;
        let lengths = [("gradient", grad.len(), args.logits.len())];
        GpuError::check_lengths(REDISTRIBUTE_BWD.name, lengths)?;
        let mut out = RedistributeGradients::default();
        for parents in Self::chunks(args.alphas.len(), self.rows_per_binding(args.k.max(2))) {
            let mut bindings = args.upload(self, &parents)?;
            let p = parents.len();
            let count = parents.len() * args.k;
            let grad = part(grad, &(parents.start * args.k..parents.end * args.k));
            let grad = self.upload("gradient of opacities", grad)?;
            let logits = self.empty::<f32>("gradient of logits", count)?;
            let areas = self.empty::<f32>("gradient of areas", count)?;
            let own = self.empty::<f32>("gradient of parents", 2 * p)?;
            bindings.extend([&grad, &logits, &areas, &own].map(Binding::from));
            let mut commands = self.commands("redistribute backward", false);
            commands.run(&REDISTRIBUTE_BWD, &[], &bindings, Groups::of(p, THREADS))?;
            let logits = commands.read::<f32>(&logits, count)?;
            let areas = commands.read::<f32>(&areas, count)?;
            let own = commands.read::<f32>(&own, 2 * p)?;
            commands.submit()?;
            out.logits.extend(logits.take(self)?);
            out.areas.extend(areas.take(self)?);
            let own = own.take(self)?;
            out.alphas.extend(own.iter().step_by(2));
            out.own.extend(own.iter().skip(1).step_by(2));
        }
        Ok(out)
    }
}
