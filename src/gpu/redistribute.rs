//! How a parent's opacity is shared among its children: twin of
//! [`crate::cpu::redistribute`]. Kernel: kernels/redistribute.wgsl.

use crate::abi::{RedistributeUniform, Rule};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Access, Kernel, wgsl};
use std::ops::Range;

pub(crate) static REDISTRIBUTE: Kernel = Kernel {
    name: "redistribute",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/math", "shared/share", "redistribute"),
    bindings: &[
        Access::Uniform,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Write,
    ],
};

/// Threads of a workgroup.
const THREADS: usize = 64;

/// Arguments of the whole rule, K = `k` children for each of P parents.
#[derive(Clone, Copy, Debug)]
pub struct RedistributeArgs<'a> {
    /// How.
    pub rule: Rule,
    /// K, at least 1.
    pub k: usize,
    /// ℓ, `[P, K]`.
    pub logits: &'a [f32],
    /// `[P, K]`, px².
    pub areas: &'a [f32],
    /// α, `[P]`.
    pub alphas: &'a [f32],
    /// `[P]` for the rules whose areas are relative; else not read.
    pub own: &'a [f32],
}

impl RedistributeArgs<'_> {
    fn check(&self) -> Result<(), GpuError> {
        let (p, k) = (self.alphas.len(), self.k);
        let own = if self.rule.areas_are_relative() { p } else { self.own.len() };
        let lengths = [
            ("logits", self.logits.len(), p * k),
            ("areas", self.areas.len(), p * k),
            ("own areas", self.own.len(), own),
            ("children", k.min(1), 1),
        ];
        match lengths.into_iter().find(|(_, got, expected)| got != expected) {
            None => Ok(()),
            Some((what, got, expected)) => Err(GpuError::Argument {
                kernel: REDISTRIBUTE.name,
                what,
                expected: expected.to_string(),
                got: got.to_string(),
            }),
        }
    }
}

/// `of[range]`; empty where the kernel reads none of it.
fn part<'a>(of: &'a [f32], range: &Range<usize>) -> &'a [f32] {
    of.get(range.clone()).unwrap_or(&[])
}

impl Gpu {
    /// Opacities `[P, K]` of the children.
    ///
    /// # Errors
    /// Lengths that do not fit one another; anything the device refuses.
    pub fn redistribute(&self, args: &RedistributeArgs) -> Result<Vec<f32>, GpuError> {
        args.check()?;
        let k = args.k;
        let most = self.rows_per_binding(k);
        let mut out = Vec::with_capacity(args.logits.len());
        for parents in Self::chunks(args.alphas.len(), most) {
            let children = parents.start * k..parents.end * k;
            let uniform = self.uniform(&RedistributeUniform {
                parents: parents.len() as u32,
                children: k as u32,
                rule: args.rule as u32,
                pad: 0,
            })?;
            let inputs = [
                self.upload("logits", part(args.logits, &children))?,
                self.upload("areas", part(args.areas, &children))?,
                self.upload("opacities", part(args.alphas, &parents))?,
                self.upload("own areas", part(args.own, &parents))?,
            ];
            let shared = self.empty::<f32>("children's opacities", children.len())?;
            let mut bindings = vec![Binding::from(&uniform)];
            bindings.extend(inputs.iter().chain([&shared]).map(Binding::from));
            let mut commands = self.commands("redistribute", false);
            commands.run(&REDISTRIBUTE, &[], &bindings, Groups::of(parents.len(), THREADS))?;
            let reading = commands.read::<f32>(&shared, children.len())?;
            commands.submit()?;
            out.extend(reading.take(self)?);
        }
        Ok(out)
    }
}
