//! Gradients of the plane sweep: twin of the backward half of [`crate::cpu::plane_sweep`].
//! Kernels: kernels/plane_sweep_taps.wgsl, then kernels/plane_sweep_reference_bwd.wgsl, and
//! invert and kernels/plane_sweep_source_bwd.wgsl.

use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Access, Kernel, wgsl};
use crate::gpu::plane_sweep::PlaneSweepArgs;
use std::ops::Range;

pub(crate) static PLANE_SWEEP_TAPS: Kernel = Kernel {
    name: "plane_sweep_taps",
    entry: "main",
    source: wgsl!(
        "shared/abi",
        "shared/grid",
        "shared/sweep",
        "shared/sweep_taps",
        "shared/sweep_rows",
        "plane_sweep_taps"
    ),
    bindings: &[
        Access::Uniform,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Write,
        Access::Write,
    ],
};

pub(crate) static PLANE_SWEEP_REFERENCE_BWD: Kernel = Kernel {
    name: "plane_sweep_reference_bwd",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/sweep", "plane_sweep_reference_bwd"),
    bindings: &[
        Access::Uniform,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Write,
    ],
};

pub(crate) static PLANE_SWEEP_SOURCE_BWD: Kernel = Kernel {
    name: "plane_sweep_source_bwd",
    entry: "main",
    source: wgsl!(
        "shared/abi",
        "shared/grid",
        "shared/sweep",
        "shared/sweep_rows",
        "plane_sweep_source_bwd"
    ),
    bindings: &[
        Access::Uniform,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Read,
        Access::Write,
    ],
};

/// Threads of a workgroup.
const THREADS: usize = 64;

impl Gpu {
    /// Gradients `([R, C, h, w], [S, C, h, w])` for that of the correlation, `grad`
    /// `[R, D, h, w]`.
    ///
    /// # Errors
    /// Those of [`Gpu::plane_sweep`]; another length of `grad`.
    pub fn plane_sweep_backward(
        &self,
        args: &PlaneSweepArgs,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let rows = args.check()?;
        let volume = args.sweep.candidates() * args.plane();
        let lengths = [("gradient of the correlation", grad.len(), rows * volume)];
        GpuError::unless_fitting(PLANE_SWEEP_TAPS.name, lengths)?;
        let source = self.upload("source features", args.source)?;
        let mut d_reference = Vec::with_capacity(args.reference.len());
        let mut d_source = vec![0.0; args.source.len()];
        let pairs = args.sweep.pairs.iter().map(Vec::len).max().unwrap_or(0);
        let most = self.rows_per_binding((4 * pairs.max(1) * volume).max(args.features()));
        for rows in Self::chunks(rows, most) {
            let grad = grad.get(rows.start * volume..rows.end * volume).unwrap_or(&[]);
            let (reference, part) = self.sweep_bwd(args, &source, &rows, grad)?;
            d_reference.extend(reference);
            d_source.iter_mut().zip(part).for_each(|(sum, d)| *sum += d);
        }
        Ok((d_reference, d_source))
    }

    /// Gradients of some rows of the reference, and what they add to the source's.
    fn sweep_bwd(
        &self,
        args: &PlaneSweepArgs,
        source: &Buffer,
        rows: &Range<usize>,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let (pairs, heads) = args.tables(rows);
        let told = args.uniform(rows);
        let taps = told.pairs as usize * args.sweep.candidates() * args.plane();
        let uniform = self.uniform(&told)?;
        let reference = self.upload("reference features", args.own(rows))?;
        let pairs = self.upload("pairs of views", &pairs)?;
        let heads = self.upload("rows of pairs", &heads)?;
        let depths = self.upload("candidate depths", &args.depths(rows))?;
        let grad = self.upload("gradient of the correlation", grad)?;
        let cells_of = self.empty::<u32>("cells of taps", 4 * taps)?;
        let factors = self.empty::<f32>("coefficients", 4 * taps)?;
        let own = rows.len() * args.features();
        let d_reference = self.empty::<f32>("gradient of the reference", own)?;
        let d_source = self.empty::<f32>("gradient of the source", args.source.len())?;
        let mut commands = self.commands("plane_sweep_bwd", false);
        let all =
            [&uniform, &reference, source, &pairs, &heads, &depths, &grad, &cells_of, &factors];
        let groups = Groups::of(taps, THREADS);
        commands.run(&PLANE_SWEEP_TAPS, &[], &all.map(Binding::from), groups)?;
        let all = [&uniform, source, &heads, &cells_of, &factors, &d_reference];
        let groups = Groups::of(own, THREADS);
        commands.run(&PLANE_SWEEP_REFERENCE_BWD, &[], &all.map(Binding::from), groups)?;
        let cells = told.sources as usize * args.plane();
        let lists = self.invert(&mut commands, &cells_of, 4 * taps, cells)?;
        let all = [&uniform, &reference, &heads, &factors, &lists.starts, &lists.list, &d_source];
        let groups = Groups::of(args.source.len(), THREADS);
        commands.run(&PLANE_SWEEP_SOURCE_BWD, &[], &all.map(Binding::from), groups)?;
        let d_reference = commands.read::<f32>(&d_reference, own)?;
        let d_source = commands.read::<f32>(&d_source, args.source.len())?;
        commands.submit()?;
        Ok((d_reference.take(self)?, d_source.take(self)?))
    }
}
