//! Gradients of the attention gather.
//!
//! CPU version: [`crate::cpu::attention_gather`]. WGSL: wgsl/network/attention_gather_bwd.wgsl,
//! wgsl/network/invert.wgsl and wgsl/network/attention_gather_scatter.wgsl. Tests: tests/gpu/network.rs.

use crate::gpu::array::Array;
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::network::attention_gather::AttentionGatherArgs;
use crate::layout::Gather;
use std::ops::Range;

pub(crate) static ATTENTION_GATHER_BWD: Kernel = Kernel {
    name: "attention_gather_bwd",
    entry: "main",
    source: wgsl!(
        AttentionGatherUniform; "shared/grid", "shared/wide", "shared/gather",
        "shared/gather_samples", "network/attention_gather_bwd"
    ),
};

pub(crate) static ATTENTION_GATHER_SCATTER: Kernel = Kernel {
    name: "attention_gather_scatter",
    entry: "main",
    source: wgsl!(AttentionGatherUniform; "shared/grid", "shared/gather", "network/attention_gather_scatter"),
};

/// Threads of a workgroup of the scatter kernel.
const THREADS: usize = 64;

/// Gradients of the attention gather.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AttentionGatherGradients {
    /// `[cells, stride]`.
    pub maps: Vec<f32>,
    /// `[N, Q]`.
    pub query: Vec<f32>,
    /// `[N, V, M or L·M, 2]`; zeros where [`crate::layout::Gather::point_gradient`] is off.
    pub points: Vec<f32>,
}

impl Gpu {
    /// Computes the gradients for `grad` `[N, E]`, the gradient of the output.
    ///
    /// # Errors
    /// As [`Gpu::attention_gather`]; [`GpuError::Argument`] for another length of `grad`.
    pub fn attention_gather_backward(
        &self,
        args: &AttentionGatherArgs,
        grad: &[f32],
    ) -> Result<AttentionGatherGradients, GpuError> {
        let n = args.check()?;
        let g = args.gather;
        let lengths = [("gradient of the output", grad.len(), n * g.dim)];
        GpuError::check_lengths(ATTENTION_GATHER_BWD.name, lengths)?;
        let maps = self.upload("feature maps", args.maps)?;
        let levels = self.upload("feature levels", &args.levels())?;
        let mut sum =
            AttentionGatherGradients { maps: vec![0.0; args.maps.len()], ..Default::default() };
        let row = g.query_width() + args.points_row();
        let widest = row.max(g.samples() * (4 + 2 * g.groups)).max(g.dim);
        for parents in Self::chunks(n, args.parents_per_call(self, widest)) {
            let grad = grad.get(parents.start * g.dim..parents.end * g.dim).unwrap_or(&[]);
            let (d_maps, rows) = self.gather_bwd(args, &maps, &levels, &parents, grad)?;
            for row in rows.chunks_exact(row) {
                let (query, points) = row.split_at(g.query_width());
                sum.query.extend_from_slice(query);
                sum.points.extend_from_slice(points);
            }
            sum.maps.iter_mut().zip(d_maps).for_each(|(sum, d)| *sum += d);
        }
        Ok(sum)
    }

    /// Computes the contribution of some parents to the gradient of the maps, and the gradients
    /// of their rows of query and points.
    fn gather_bwd(
        &self,
        args: &AttentionGatherArgs,
        maps: &Buffer,
        levels: &Buffer,
        parents: &Range<usize>,
        grad: &[f32],
    ) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let (g, n) = (args.gather, parents.len());
        let samples = n * g.samples();
        let floats = n * (g.query_width() + args.points_row());
        let uniform = self.uniform(&args.uniform(parents))?;
        let [query, points] = args.rows(parents);
        let query = self.upload("queries", query)?;
        let points = self.upload("sample points", points)?;
        let grad = self.upload("gradient of the output", grad)?;
        let d_rows = self.empty::<f32>("gradient of the queries", floats)?;
        let cells_of = self.empty::<u32>("cells of samples", 4 * samples)?;
        let factors = self.empty::<f32>("factors", samples * (4 + 2 * g.groups))?;
        let d_maps = self.empty::<f32>("gradient of the maps", args.maps.len())?;
        let mut commands = self.commands("attention_gather_bwd", false);
        let all = [&uniform, maps, &query, &points, levels, &grad, &d_rows, &cells_of, &factors];
        commands.run(&ATTENTION_GATHER_BWD, &[], &all.map(Binding::from), Groups::of(n, 1))?;
        let cells = args.maps.len() / g.stride;
        let lists = self.invert(&mut commands, &cells_of, 4 * samples, cells)?;
        let all = [&uniform, &query, &grad, &factors, &lists.starts, &lists.list, &d_maps];
        let groups = Groups::of(args.maps.len(), THREADS);
        commands.run(&ATTENTION_GATHER_SCATTER, &[], &all.map(Binding::from), groups)?;
        let d_maps = commands.read::<f32>(&d_maps, args.maps.len())?;
        let d_rows = commands.read::<f32>(&d_rows, floats)?;
        commands.submit()?;
        Ok((d_maps.take(self)?, d_rows.take(self)?))
    }
}

impl Array {
    /// Computes the gradients of maps, this array, `query` and `points` from the gradient `dy`
    /// `[N, E]` of [`Array::gather`].
    ///
    /// # Errors
    /// As [`Gpu::attention_gather_backward`].
    pub fn gather_backward(
        &self,
        query: &Self,
        points: &Self,
        gather: &Gather,
        dy: &Self,
    ) -> Result<[Self; 3], GpuError> {
        let args = AttentionGatherArgs { gather, maps: &[], query: &[], points: &[] };
        let n = args.check_lengths([self.count(), query.count(), points.count()])?;
        let lengths = [("gradient of the output", dy.count(), n * gather.dim)];
        GpuError::check_lengths(ATTENTION_GATHER_BWD.name, lengths)?;
        let recorder = self.recorder();
        let gpu = recorder.gpu();
        let cells = self.count() / gather.stride.max(1);
        let samples = n * gather.samples();
        let width = gather.query_width();
        let row = gather.query_width() + args.points_row();
        let mut uniform = args.uniform(&(0..n));
        uniform.cells = cells as u32;
        let uniform = gpu.uniform(&uniform)?;
        let levels = gpu.upload("feature levels", &args.levels())?;
        let cells_of = gpu.empty::<u32>("cells of samples", 4 * samples)?;
        let factors = gpu.empty::<f32>("factors", samples * (4 + 2 * gather.groups))?;
        let rows = recorder.empty(&[n, row])?;
        let of_maps = recorder.empty(self.dims())?;
        recorder.record(cells_of.bytes() + factors.bytes(), |commands| {
            let [maps, query, points, dy, rows, of_maps] =
                [self, query, points, dy, &rows, &of_maps].map(Self::binding);
            let [uniform, levels, cells_binding, factors] =
                [&uniform, &levels, &cells_of, &factors].map(Binding::from);
            let bindings = [
                uniform.clone(),
                maps,
                query.clone(),
                points,
                levels,
                dy.clone(),
                rows,
                cells_binding,
                factors.clone(),
            ];
            commands.run(&ATTENTION_GATHER_BWD, &[], &bindings, Groups::of(n, 1))?;
            let lists = gpu.invert(commands, &cells_of, 4 * samples, cells)?;
            let [starts, list] = [&lists.starts, &lists.list].map(Binding::from);
            let bindings = [uniform, query, dy, factors, starts, list, of_maps];
            let groups = Groups::of(self.count(), THREADS);
            commands.run(&ATTENTION_GATHER_SCATTER, &[], &bindings, groups)
        })?;
        let of_query = rows.narrow(1, 0, width)?.reshape(query.dims())?;
        let of_points = rows.narrow(1, width, row - width)?.reshape(points.dims())?;
        Ok([of_maps, of_query, of_points])
    }
}
