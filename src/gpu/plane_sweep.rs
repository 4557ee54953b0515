//! Plane sweep, warp and correlation in one: twin of [`crate::cpu::plane_sweep`].
//! Kernel: kernels/plane_sweep.wgsl.

use crate::abi::{Pair, PlaneSweepUniform, SWEEP_PAIR_STRIDE, Sweep};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Access, Kernel, wgsl};
use std::ops::Range;

pub(crate) static PLANE_SWEEP: Kernel = Kernel {
    name: "plane_sweep",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/sweep", "shared/sweep_taps", "plane_sweep"),
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
    /// h·w.
    pub(super) fn plane(&self) -> usize {
        self.sweep.size[0] * self.sweep.size[1]
    }

    /// Floats of one row of features.
    pub(super) fn features(&self) -> usize {
        self.sweep.channels * self.plane()
    }

    /// R, where all fits together.
    pub(super) fn check(&self) -> Result<usize, GpuError> {
        let (s, features) = (self.sweep, self.features());
        let rows = s.pairs.len();
        let sources = s.pairs.iter().flatten().map(|p| p.source + 1).max().unwrap_or(0);
        let ragged = s.depths.iter().find(|d| d.len() != s.candidates());
        let lengths = [
            ("reference", self.reference.len(), rows * features),
            ("source", self.source.len().min(sources * features), sources * features),
            ("rows of depths", s.depths.len(), rows),
            ("depths of a row", ragged.map_or(s.candidates(), Vec::len), s.candidates()),
        ];
        GpuError::unless_fitting(PLANE_SWEEP.name, lengths).map(|()| rows)
    }

    /// What the kernels are told of `rows`.
    pub(super) fn uniform(&self, rows: &Range<usize>) -> PlaneSweepUniform {
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

    /// Pairs of `rows` in floats; where each row's begin, and the pairs' source rows.
    pub(super) fn tables(&self, rows: &Range<usize>) -> (Vec<f32>, Vec<u32>) {
        let of_rows = self.sweep.pairs.get(rows.clone()).unwrap_or(&[]);
        let mut floats = Vec::new();
        let (mut heads, mut end) = (vec![0], 0);
        for pairs in of_rows {
            end += pairs.len() as u32;
            heads.push(end);
        }
        for pair in of_rows.iter().flatten() {
            floats.extend(lanes(pair));
            heads.push(pair.source as u32);
        }
        (floats, heads)
    }

    /// Candidate depths of `rows`.
    pub(super) fn depths(&self, rows: &Range<usize>) -> Vec<f32> {
        self.sweep.depths.get(rows.clone()).unwrap_or(&[]).concat()
    }

    /// Reference features of `rows`.
    pub(super) fn own(&self, rows: &Range<usize>) -> &'a [f32] {
        let f = self.features();
        self.reference.get(rows.start * f..rows.end * f).unwrap_or(&[])
    }
}

/// A pair as the kernels read it.
fn lanes(p: &Pair) -> impl Iterator<Item = f32> {
    let all = p.inverse.into_iter().chain(p.rotation).chain(p.t).chain(p.k);
    all.take(SWEEP_PAIR_STRIDE)
}

impl Gpu {
    /// Correlation `[R, D, h, w]`.
    ///
    /// # Errors
    /// Lengths that do not fit; anything the device refuses.
    pub fn plane_sweep(&self, args: &PlaneSweepArgs) -> Result<Vec<f32>, GpuError> {
        let rows = args.check()?;
        let volume = args.sweep.candidates() * args.plane();
        let source = self.upload("source features", args.source)?;
        let mut out = Vec::with_capacity(rows * volume);
        let most = self.rows_per_binding(volume.max(args.features()));
        for rows in Self::chunks(rows, most) {
            let (pairs, heads) = args.tables(&rows);
            let count = rows.len() * volume;
            let uniform = self.uniform(&args.uniform(&rows))?;
            let reference = self.upload("reference features", args.own(&rows))?;
            let pairs = self.upload("pairs of views", &pairs)?;
            let heads = self.upload("rows of pairs", &heads)?;
            let depths = self.upload("candidate depths", &args.depths(&rows))?;
            let correlation = self.empty::<f32>("correlation", count)?;
            let bindings = [&uniform, &reference, &source, &pairs, &heads, &depths, &correlation];
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
