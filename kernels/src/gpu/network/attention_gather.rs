//! Attention over bilinear samples of feature maps (SubSplat, supplement A.2).
//!
//! CPU version: [`crate::cpu::attention_gather`]. WGSL: wgsl/network/attention_gather.wgsl. Tests:
//! tests/gpu/network.rs.

use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::AttentionGatherUniform;
use crate::layout::Gather;
use std::ops::Range;

/// Largest number of samples per parent, V·L·M.
pub(crate) const GATHER_SAMPLES_MAX: usize = 128;
/// Largest number of samples × groups per parent.
pub(crate) const GATHER_WEIGHTS_MAX: usize = 1024;

pub(crate) static ATTENTION_GATHER: Kernel = Kernel {
    name: "attention_gather",
    entry: "main",
    source: wgsl!(
        AttentionGatherUniform; "shared/grid", "shared/wide", "shared/gather",
        "shared/gather_samples", "network/attention_gather"
    ),
};

/// Arguments of one call, in the layout of [`crate::cpu::attention_gather`].
#[derive(Clone, Copy, Debug)]
pub struct AttentionGatherArgs<'a> {
    /// Sizes and options; at most 128 samples per parent and 1,024 samples × groups.
    pub gather: &'a Gather,
    /// `[cells, stride]`.
    pub maps: &'a [f32],
    /// `[N, Q]`.
    pub query: &'a [f32],
    /// `[N, V, M or L·M, 2]`.
    pub points: &'a [f32],
}

impl<'a> AttentionGatherArgs<'a> {
    /// Returns the floats of one parent's points.
    pub(in crate::gpu) fn points_row(&self) -> usize {
        2 * self.gather.views * self.gather.points_width()
    }

    /// Checks the arguments and returns N.
    pub(in crate::gpu) fn check(&self) -> Result<usize, GpuError> {
        self.check_lengths([self.maps.len(), self.query.len(), self.points.len()])
    }

    /// Checks the options and the lengths of maps, query and points; returns N.
    pub(in crate::gpu) fn check_lengths(
        &self,
        [maps, query, points]: [usize; 3],
    ) -> Result<usize, GpuError> {
        let g = self.gather;
        let n = query / g.query_width().max(1);
        let divides = g.groups > 0 && g.dim.is_multiple_of(g.groups);
        let channels = g.dim + g.value.max(g.key.unwrap_or(0));
        let end = |l: &crate::layout::Level| l.first_cell + g.views * l.height * l.width;
        let cells = g.levels.iter().map(end).max().unwrap_or(0);
        let refuse = |argument, expected: String, got: String| {
            Err(GpuError::Argument { kernel: ATTENTION_GATHER.name, argument, expected, got })
        };
        if g.samples() == 0 || g.samples() > GATHER_SAMPLES_MAX {
            let expected = format!("1 to {GATHER_SAMPLES_MAX}");
            return refuse("samples per parent", expected, g.samples().to_string());
        }
        if !divides || g.samples() * g.groups > GATHER_WEIGHTS_MAX {
            let expected = format!("a divisor of E, at most {}", GATHER_WEIGHTS_MAX / g.samples());
            return refuse("groups", expected, g.groups.to_string());
        }
        if g.stride < channels {
            return refuse(
                "stride of the maps",
                format!("{channels} floats"),
                g.stride.to_string(),
            );
        }
        let lengths = [
            ("query", query, n * g.query_width()),
            ("points", points, n * self.points_row()),
            ("maps", maps.min(cells * g.stride), cells * g.stride),
        ];
        GpuError::check_lengths(ATTENTION_GATHER.name, lengths).map(|()| n)
    }

    /// Returns how many parents one call takes: the rows of the widest argument that one binding
    /// holds.
    pub(in crate::gpu) fn parents_per_call(&self, gpu: &Gpu, floats: usize) -> usize {
        let widest = self.gather.query_width().max(self.points_row()).max(floats);
        gpu.rows_per_binding(widest)
    }

    /// Returns the uniform for `parents`.
    pub(in crate::gpu) fn uniform(&self, parents: &Range<usize>) -> AttentionGatherUniform {
        let g = self.gather;
        let word = |v: usize| v as u32;
        let mut u = AttentionGatherUniform {
            parents: word(parents.len()),
            views: word(g.views),
            levels: word(g.levels.len()),
            points: word(g.points),
            points_width: word(2 * g.points_width()),
            dim: word(g.dim),
            groups: word(g.groups),
            stride: word(g.stride),
            key: word(g.key.unwrap_or(0)),
            has_key: u32::from(g.key.is_some()),
            value: word(g.value),
            renormalise: u32::from(g.renormalise),
            points_per_level: u32::from(g.points_per_level),
            half_pixel: g.sample_convention.shift() as f32,
            logit_scale: g.logit_scale as f32,
            cells: word(self.maps.len() / g.stride.max(1)),
            point_gradient: u32::from(g.point_gradient),
            ..Default::default()
        };
        if let Some(drop) = g.drop {
            let dropped = (drop.probability * (1u64 << 53) as f64).ceil() as u64;
            u.drops = 1;
            u.kept_factor = (1.0 / (1.0 - drop.probability)) as f32;
            u.first_parent = word(drop.first_parent + parents.start);
            (u.seed_low, u.seed_high) = (drop.seed as u32, (drop.seed >> 32) as u32);
            (u.dropped_low, u.dropped_high) = (dropped as u32, (dropped >> 32) as u32);
        }
        u
    }

    /// Returns height, width and first cell of each level.
    pub(in crate::gpu) fn levels(&self) -> Vec<u32> {
        let levels = self.gather.levels.iter();
        levels.flat_map(|l| [l.height, l.width, l.first_cell].map(|v| v as u32)).collect()
    }

    /// Returns the query and points of `parents`.
    pub(in crate::gpu) fn rows(&self, parents: &Range<usize>) -> [&'a [f32]; 2] {
        let part = |of: &'a [f32], width: usize| {
            of.get(parents.start * width..parents.end * width).unwrap_or(&[])
        };
        [part(self.query, self.gather.query_width()), part(self.points, self.points_row())]
    }
}

impl Gpu {
    /// Computes the attention output `[N, E]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths, or for more samples or groups than the
    /// kernel supports; errors of the device.
    pub fn attention_gather(&self, args: &AttentionGatherArgs) -> Result<Vec<f32>, GpuError> {
        let n = args.check()?;
        let dim = args.gather.dim;
        let maps = self.upload("feature maps", args.maps)?;
        let levels = self.upload("feature levels", &args.levels())?;
        let mut out = Vec::with_capacity(n * dim);
        for parents in Self::chunks(n, args.parents_per_call(self, dim)) {
            let uniform = self.uniform(&args.uniform(&parents))?;
            let [query, points] = args.rows(&parents);
            let query = self.upload("queries", query)?;
            let points = self.upload("sample points", points)?;
            let attended = self.empty::<f32>("attention output", parents.len() * dim)?;
            // The query takes the place of the residual, which is not read.
            let bindings = [&uniform, &maps, &query, &points, &levels, &query, &attended];
            let mut commands = self.commands("attention_gather", false);
            let groups = Groups::of(parents.len(), 1);
            commands.run(&ATTENTION_GATHER, &[], &bindings.map(Binding::from), groups)?;
            let reading = commands.read::<f32>(&attended, parents.len() * dim)?;
            commands.submit()?;
            out.extend(reading.take(self)?);
        }
        Ok(out)
    }
}
