//! Plane sweep with fused warp and correlation (MVSplat, cost volume).
//!
//! CPU version: [`crate::cpu::plane_sweep`]. WGSL: wgsl/network/plane_sweep.wgsl. Tests:
//! tests/gpu/network.rs.

use crate::gpu::array::Array;
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::PlaneSweepUniform;
use crate::layout::{Pair, Sweep};
use std::ops::Range;

/// Floats of one [`Pair`] in the table: inverse, rotation, t, k.
pub(crate) const SWEEP_PAIR_STRIDE: usize = 20;

pub(crate) static PLANE_SWEEP: Kernel = Kernel {
    name: "plane_sweep",
    entry: "main",
    source: wgsl!(
        PlaneSweepUniform; "shared/grid", "shared/sweep", "shared/sweep_taps", "network/plane_sweep"
    ),
};

/// Threads of a workgroup.
const THREADS: usize = 64;

/// Arguments of one sweep.
#[derive(Clone, Copy, Debug)]
pub struct PlaneSweepArgs<'a> {
    /// Sizes, pairs and depths.
    pub sweep: &'a Sweep,
    /// `[R, C, h, w]`.
    pub reference: &'a [f32],
    /// `[S, C, h, w]`.
    pub source: &'a [f32],
}

impl<'a> PlaneSweepArgs<'a> {
    /// Returns h·w.
    pub(in crate::gpu) fn plane(&self) -> usize {
        self.sweep.size[0] * self.sweep.size[1]
    }

    /// Returns the floats of one row of features, C·h·w.
    pub(in crate::gpu) fn features(&self) -> usize {
        self.sweep.channels * self.plane()
    }

    /// Checks the arguments and returns R.
    pub(in crate::gpu) fn check(&self) -> Result<usize, GpuError> {
        let s = self.sweep;
        let features = self.features();
        let rows = s.pairs.len();
        let sources = s.pairs.iter().flatten().map(|p| p.source + 1).max().unwrap_or(0);
        let ragged = s.depths.iter().find(|d| d.len() != s.candidates());
        let lengths = [
            ("reference", self.reference.len(), rows * features),
            ("source", self.source.len().min(sources * features), sources * features),
            ("rows of depths", s.depths.len(), rows),
            ("depths of a row", ragged.map_or(s.candidates(), Vec::len), s.candidates()),
        ];
        GpuError::check_lengths(PLANE_SWEEP.name, lengths).map(|()| rows)
    }

    /// Returns the uniform for `rows`.
    pub(in crate::gpu) fn uniform(&self, rows: &Range<usize>) -> PlaneSweepUniform {
        let s = self.sweep;
        PlaneSweepUniform {
            rows: rows.len() as u32,
            channels: s.channels as u32,
            candidates: s.candidates() as u32,
            height: s.size[0] as u32,
            width: s.size[1] as u32,
            pairs: s.pairs.get(rows.clone()).unwrap_or(&[]).iter().flatten().count() as u32,
            sources: (self.source.len() / self.features().max(1)) as u32,
            pad0: 0,
            centre: s.centre,
            min_z: s.min_z,
            scale: s.scale,
            pad1: 0,
        }
    }

    /// Returns the pairs of `rows` as floats; then the first pair of each row and the source row
    /// of each pair.
    pub(in crate::gpu) fn tables(&self, rows: &Range<usize>) -> (Vec<f32>, Vec<u32>) {
        let of_rows = self.sweep.pairs.get(rows.clone()).unwrap_or(&[]);
        let mut floats = Vec::new();
        let (mut starts, mut end) = (vec![0], 0);
        for pairs in of_rows {
            end += pairs.len() as u32;
            starts.push(end);
        }
        for pair in of_rows.iter().flatten() {
            floats.extend(pair_floats(pair));
            starts.push(pair.source as u32);
        }
        (floats, starts)
    }

    /// Returns the candidate depths of `rows`.
    pub(in crate::gpu) fn depths(&self, rows: &Range<usize>) -> Vec<f32> {
        self.sweep.depths.get(rows.clone()).unwrap_or(&[]).concat()
    }

    /// Returns the reference features of `rows`.
    pub(in crate::gpu) fn own(&self, rows: &Range<usize>) -> &'a [f32] {
        let f = self.features();
        self.reference.get(rows.start * f..rows.end * f).unwrap_or(&[])
    }
}

/// Returns a pair in the layout of the kernels.
fn pair_floats(p: &Pair) -> impl Iterator<Item = f32> {
    let all = p.inverse.into_iter().chain(p.rotation).chain(p.t).chain(p.k);
    all.take(SWEEP_PAIR_STRIDE)
}

impl Gpu {
    /// Computes the correlation `[R, D, h, w]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths; errors of the device.
    pub fn plane_sweep(&self, args: &PlaneSweepArgs) -> Result<Vec<f32>, GpuError> {
        let rows = args.check()?;
        let volume = args.sweep.candidates() * args.plane();
        let source = self.upload("source features", args.source)?;
        let mut out = Vec::with_capacity(rows * volume);
        let max_rows = self.rows_per_binding(volume.max(args.features()));
        for rows in Self::chunks(rows, max_rows) {
            let (pairs, starts) = args.tables(&rows);
            let count = rows.len() * volume;
            let uniform = self.uniform(&args.uniform(&rows))?;
            let reference = self.upload("reference features", args.own(&rows))?;
            let pairs = self.upload("pairs of views", &pairs)?;
            let starts = self.upload("starts of pairs", &starts)?;
            let depths = self.upload("candidate depths", &args.depths(&rows))?;
            let correlation = self.empty::<f32>("correlation", count)?;
            let bindings = [&uniform, &reference, &source, &pairs, &starts, &depths, &correlation];
            let mut commands = self.commands("plane_sweep", false);
            let groups = Groups::of(count, THREADS);
            commands.run(&PLANE_SWEEP, &[], &bindings.map(Binding::from), groups)?;
            let reading = commands.read::<f32>(&correlation, count)?;
            commands.submit()?;
            out.extend(reading.take(self)?);
        }
        Ok(out)
    }
}

impl Array {
    /// Computes the correlation `[R, D, h, w]` of this array `[R, C, h, w]` with `source`
    /// `[S, C, h, w]`.
    ///
    /// # Errors
    /// As [`Gpu::plane_sweep`].
    pub fn plane_sweep(&self, source: &Self, sweep: &Sweep) -> Result<Self, GpuError> {
        let args = PlaneSweepArgs { sweep, reference: &[], source: &[] };
        let (rows, d, [h, w]) = (sweep.pairs.len(), sweep.candidates(), sweep.size);
        let pictures = sweep.pairs.iter().flatten().map(|p| p.source + 1).max().unwrap_or(0);
        let lengths = [
            ("reference", self.count(), rows * args.features()),
            ("source", source.count().min(pictures * args.features()), pictures * args.features()),
            ("depths", sweep.depths.iter().map(Vec::len).sum(), rows * d),
        ];
        GpuError::check_lengths(PLANE_SWEEP.name, lengths)?;
        let recorder = self.recorder();
        let gpu = recorder.gpu();
        let all = 0..rows;
        let (pairs, starts) = args.tables(&all);
        let sources = (source.count() / args.features().max(1)) as u32;
        let uniform = PlaneSweepUniform { sources, ..args.uniform(&all) };
        let pairs = gpu.upload("pairs of views", &pairs)?;
        let starts = gpu.upload("starts of pairs", &starts)?;
        let depths = gpu.upload("candidate depths", &args.depths(&all))?;
        let result = recorder.empty(&[rows, d, h, w])?;
        let bindings = [
            self.binding(),
            source.binding(),
            Binding::from(&pairs),
            Binding::from(&starts),
            Binding::from(&depths),
            result.binding(),
        ];
        recorder.call(
            &PLANE_SWEEP,
            &[],
            &uniform,
            &bindings,
            Groups::of(result.count(), THREADS),
        )?;
        Ok(result)
    }
}
