//! Gradients of the plane sweep.
//!
//! CPU version: [`crate::cpu::plane_sweep`]. WGSL: wgsl/network/plane_sweep_taps.wgsl, then
//! wgsl/network/plane_sweep_reference_bwd.wgsl, wgsl/network/invert.wgsl and
//! wgsl/network/plane_sweep_source_bwd.wgsl. Tests: tests/gpu/network.rs.

use crate::gpu::array::Array;
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::network::plane_sweep::PlaneSweepArgs;
use crate::gpu::uniforms::PlaneSweepUniform;
use crate::layout::Sweep;
use std::ops::Range;

pub(crate) static PLANE_SWEEP_TAPS: Kernel = Kernel {
    name: "plane_sweep_taps",
    entry: "main",
    source: wgsl!(
        PlaneSweepUniform; "shared/grid", "shared/sweep", "shared/sweep_taps", "shared/sweep_rows",
        "network/plane_sweep_taps"
    ),
};

pub(crate) static PLANE_SWEEP_REFERENCE_BWD: Kernel = Kernel {
    name: "plane_sweep_reference_bwd",
    entry: "main",
    source: wgsl!(PlaneSweepUniform; "shared/grid", "shared/sweep", "network/plane_sweep_reference_bwd"),
};

pub(crate) static PLANE_SWEEP_SOURCE_BWD: Kernel = Kernel {
    name: "plane_sweep_source_bwd",
    entry: "main",
    source: wgsl!(
        PlaneSweepUniform; "shared/grid", "shared/sweep", "shared/sweep_rows",
        "network/plane_sweep_source_bwd"
    ),
};

/// Threads of a workgroup.
const THREADS: usize = 64;

impl Gpu {
    /// Computes the gradients of reference `[R, C, h, w]` and source `[S, C, h, w]` for `grad`
    /// `[R, D, h, w]`, the gradient of the correlation.
    ///
    /// # Errors
    /// As [`Gpu::plane_sweep`]; [`GpuError::Argument`] for another length of `grad`.
    pub fn plane_sweep_backward(
        &self,
        args: &PlaneSweepArgs,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let rows = args.check()?;
        let volume = args.sweep.candidates() * args.plane();
        let lengths = [("gradient of the correlation", grad.len(), rows * volume)];
        GpuError::check_lengths(PLANE_SWEEP_TAPS.name, lengths)?;
        let source = self.upload("source features", args.source)?;
        let mut d_reference = Vec::with_capacity(args.reference.len());
        let mut d_source = vec![0.0; args.source.len()];
        let pairs = args.sweep.pairs.iter().map(Vec::len).max().unwrap_or(0);
        let max_rows = self.rows_per_binding((4 * pairs.max(1) * volume).max(args.features()));
        for rows in Self::chunks(rows, max_rows) {
            let grad = grad.get(rows.start * volume..rows.end * volume).unwrap_or(&[]);
            let (reference, part) = self.sweep_bwd(args, &source, &rows, grad)?;
            d_reference.extend(reference);
            d_source.iter_mut().zip(part).for_each(|(sum, d)| *sum += d);
        }
        Ok((d_reference, d_source))
    }

    /// Computes the gradients of some rows of the reference, and their contribution to the
    /// gradient of the source.
    fn sweep_bwd(
        &self,
        args: &PlaneSweepArgs,
        source: &Buffer,
        rows: &Range<usize>,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let (pairs, starts) = args.tables(rows);
        let call = args.uniform(rows);
        let taps = call.pairs as usize * args.sweep.candidates() * args.plane();
        let uniform = self.uniform(&call)?;
        let reference = self.upload("reference features", args.own(rows))?;
        let pairs = self.upload("pairs of views", &pairs)?;
        let starts = self.upload("starts of pairs", &starts)?;
        let depths = self.upload("candidate depths", &args.depths(rows))?;
        let grad = self.upload("gradient of the correlation", grad)?;
        let cells_of = self.empty::<u32>("cells of taps", 4 * taps)?;
        let factors = self.empty::<f32>("coefficients", 4 * taps)?;
        let own = rows.len() * args.features();
        let d_reference = self.empty::<f32>("gradient of the reference", own)?;
        let d_source = self.empty::<f32>("gradient of the source", args.source.len())?;
        let mut commands = self.commands("plane_sweep_bwd", false);
        let all =
            [&uniform, &reference, source, &pairs, &starts, &depths, &grad, &cells_of, &factors];
        let groups = Groups::of(taps, THREADS);
        commands.run(&PLANE_SWEEP_TAPS, &[], &all.map(Binding::from), groups)?;
        let all = [&uniform, source, &starts, &cells_of, &factors, &d_reference];
        let groups = Groups::of(own, THREADS);
        commands.run(&PLANE_SWEEP_REFERENCE_BWD, &[], &all.map(Binding::from), groups)?;
        let cells = call.sources as usize * args.plane();
        let lists = self.invert(&mut commands, &cells_of, 4 * taps, cells)?;
        let all = [&uniform, &reference, &starts, &factors, &lists.starts, &lists.list, &d_source];
        let groups = Groups::of(args.source.len(), THREADS);
        commands.run(&PLANE_SWEEP_SOURCE_BWD, &[], &all.map(Binding::from), groups)?;
        let d_reference = commands.read::<f32>(&d_reference, own)?;
        let d_source = commands.read::<f32>(&d_source, args.source.len())?;
        commands.submit()?;
        Ok((d_reference.take(self)?, d_source.take(self)?))
    }
}

impl Array {
    /// Computes the gradients of [`Array::plane_sweep`] with respect to this array and to
    /// `source` for `grad` `[R, D, h, w]`, the gradient of the correlation.
    ///
    /// # Errors
    /// As [`Gpu::plane_sweep_backward`].
    pub fn plane_sweep_backward(
        &self,
        source: &Self,
        sweep: &Sweep,
        grad: &Self,
    ) -> Result<[Self; 2], GpuError> {
        let args = PlaneSweepArgs { sweep, reference: &[], source: &[] };
        let (rows, features) = (sweep.pairs.len(), args.features());
        let pictures = sweep.pairs.iter().flatten().map(|p| p.source + 1).max().unwrap_or(0);
        let lengths = [
            ("reference", self.count(), rows * features),
            ("source", source.count().min(pictures * features), pictures * features),
            ("gradient", grad.count(), rows * sweep.candidates() * args.plane()),
        ];
        GpuError::check_lengths(PLANE_SWEEP_TAPS.name, lengths)?;
        let recorder = self.recorder();
        let all = 0..rows;
        let gpu = recorder.gpu();
        let (pairs, starts) = args.tables(&all);
        let sources = source.count() / features.max(1);
        let call = PlaneSweepUniform { sources: sources as u32, ..args.uniform(&all) };
        let taps = call.pairs as usize * sweep.candidates() * args.plane();
        let uniform = gpu.uniform(&call)?;
        let pairs = gpu.upload("pairs of views", &pairs)?;
        let starts = gpu.upload("starts of pairs", &starts)?;
        let depths = gpu.upload("candidate depths", &args.depths(&all))?;
        let cells_of = gpu.empty::<u32>("cells of taps", 4 * taps)?;
        let factors = gpu.empty::<f32>("coefficients", 4 * taps)?;
        let d_reference = recorder.empty(self.dims())?;
        let d_source = recorder.empty(source.dims())?;
        recorder.record(cells_of.bytes() + factors.bytes(), |commands| {
            let [own, other, of_own, of_other] =
                [self, source, &d_reference, &d_source].map(Array::binding);
            let [uniform, pairs, starts, depths, cells, factors] =
                [&uniform, &pairs, &starts, &depths, &cells_of, &factors].map(Binding::from);
            let bindings = [
                uniform.clone(),
                own.clone(),
                other.clone(),
                pairs,
                starts.clone(),
                depths,
                grad.binding(),
                cells.clone(),
                factors.clone(),
            ];
            commands.run(&PLANE_SWEEP_TAPS, &[], &bindings, Groups::of(taps, THREADS))?;
            let bindings = [uniform.clone(), other, starts.clone(), cells, factors.clone(), of_own];
            let groups = Groups::of(self.count(), THREADS);
            commands.run(&PLANE_SWEEP_REFERENCE_BWD, &[], &bindings, groups)?;
            let lists = gpu.invert(commands, &cells_of, 4 * taps, sources * args.plane())?;
            let [list_starts, list] = [&lists.starts, &lists.list].map(Binding::from);
            let bindings = [uniform, own, starts, factors, list_starts, list, of_other];
            let groups = Groups::of(source.count(), THREADS);
            commands.run(&PLANE_SWEEP_SOURCE_BWD, &[], &bindings, groups)
        })?;
        Ok([d_reference, d_source])
    }
}
