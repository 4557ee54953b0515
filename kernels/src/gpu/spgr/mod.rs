//! Sub-pixel Gaussian reparameterization (SubSplat, section 3.2; supplement A.3).
//!
//! CPU version: [`crate::cpu::spgr`]. WGSL: wgsl/spgr/spgr.wgsl. Tests: tests/gpu/spgr.rs.

pub(crate) mod backward;
pub(crate) mod redistribute;

use crate::camera::Camera;
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::SpgrUniform;
use crate::layout::{
    AMinMode, AreaAt, CHILDREN_MAX, DepthDir, DepthUnit, FRUSTUM_MARGIN, GainSpace, HEAD_STRIDE,
    PrimaryView, Rules, SPLAT_STRIDE, Slide,
};
use std::ops::Range;

/// Floats of a context camera in the table.
pub(crate) const SPGR_CAMERA_STRIDE: usize = 23;

pub(crate) static SPGR: Kernel = Kernel {
    name: "spgr",
    entry: "main",
    source: wgsl!(
        SpgrUniform; "shared/grid", "shared/math", "shared/share", "shared/spgr", "spgr/spgr"
    ),
};

/// Threads of a workgroup.
const THREADS: usize = 64;

/// Arguments of one call.
#[derive(Clone, Copy, Debug)]
pub struct SpgrArgs<'a> {
    /// Rules for the children; K ≤ [`CHILDREN_MAX`].
    pub rules: &'a Rules,
    /// Cameras of the context views; intrinsics in pixels of the input pictures.
    pub cameras: &'a [Camera],
    /// Near plane of each view, world units.
    pub near: &'a [f32],
    /// Parents per view.
    pub per_view: usize,
    /// Index in the scene of the call's first parent.
    pub first: usize,
    /// Head records `[N, K, 11]`.
    pub head: &'a [f32],
    /// `[N, 11]`.
    pub parents: &'a [f32],
}

impl<'a> SpgrArgs<'a> {
    /// Checks the arguments and returns N.
    pub(in crate::gpu) fn check(&self) -> Result<usize, GpuError> {
        self.check_lengths([self.head.len(), self.parents.len()])
    }

    /// Checks the arguments and the lengths of head records and parents; returns N.
    pub(in crate::gpu) fn check_lengths(
        &self,
        [head, parents]: [usize; 2],
    ) -> Result<usize, GpuError> {
        let n = parents / SPLAT_STRIDE;
        let k = self.rules.children();
        let lengths = [
            ("children per parent", k, k.clamp(1, CHILDREN_MAX)),
            ("cameras", self.cameras.len(), self.cameras.len().max(1)),
            ("near planes", self.near.len(), self.cameras.len()),
            ("parents per view", self.per_view, self.per_view.max(1)),
            ("parents", parents, n * SPLAT_STRIDE),
            ("head records", head, n * k * HEAD_STRIDE),
        ];
        GpuError::check_lengths(SPGR.name, lengths).map(|()| n)
    }

    /// Returns the uniform for `parents`.
    pub(in crate::gpu) fn uniform(&self, parents: &Range<usize>) -> SpgrUniform {
        let r = self.rules;
        SpgrUniform {
            parents: parents.len() as u32,
            columns: r.positions.columns,
            rows: r.positions.rows,
            step: r.positions.step,
            zoom: r.zoom() as f32,
            per_view: self.per_view as u32,
            first: (self.first + parents.start) as u32,
            views: self.cameras.len() as u32,
            rule: r.opacity as u32,
            nearest_visible: u32::from(r.primary_view == PrimaryView::NearestVisible),
            bounded: u32::from(r.offset_bound.is_some()),
            ray: u32::from(r.depth_dir == DepthDir::Ray),
            relative_depth: u32::from(r.depth_unit == DepthUnit::Relative),
            disc: u32::from(r.slide == Slide::Disc),
            area_at_parent: u32::from(r.area_at == AreaAt::Parent),
            two_axis: u32::from(r.a_min_mode == AMinMode::TwoAxis),
            rgb_gain: u32::from(r.gain_space == GainSpace::Rgb),
            offset_bound: r.offset_bound.unwrap_or(0.0) as f32,
            beta_z: r.beta_z as f32,
            lambda_s: r.lambda_s as f32,
            dlog_clamp: r.dlog_clamp as f32,
            a_min: r.a_min as f32,
            lowpass_target: r.lowpass_target as f32,
            lowpass_input: r.lowpass_input as f32,
            delta: r.delta as f32,
        }
    }

    /// Returns the context cameras in the layout of the kernels.
    pub(in crate::gpu) fn cameras(&self) -> Vec<f32> {
        let rows = self.cameras.iter().zip(self.near);
        rows.flat_map(|(camera, &near)| camera_floats(camera, near)).collect()
    }

    /// Returns the head records and rows of `parents`.
    pub(in crate::gpu) fn rows(&self, parents: &Range<usize>) -> [&'a [f32]; 2] {
        let part = |of: &'a [f32], width: usize| {
            of.get(parents.start * width..parents.end * width).unwrap_or(&[])
        };
        [part(self.head, self.rules.children() * HEAD_STRIDE), part(self.parents, SPLAT_STRIDE)]
    }
}

/// Returns a camera in the order of wgsl/shared/spgr.wgsl; bounds are computed in f64, as on
/// the CPU.
fn camera_floats(camera: &Camera, near: f32) -> [f32; SPGR_CAMERA_STRIDE] {
    let k = camera.intrinsics;
    let focal = [f64::from(k.fx), f64::from(k.fy)];
    let centre = [f64::from(k.cx), f64::from(k.cy)];
    let size = [k.width as f64, k.height as f64];
    let r = camera.rotation();
    let rotation = (0..3).flat_map(|i| r.row(i).to_array().map(f64::from));
    let position = camera.position().to_array().map(f64::from);
    let margin = |i: usize| FRUSTUM_MARGIN * 0.5 * size[i] / focal[i];
    let bounds = [
        -centre[0] / focal[0] - margin(0),
        -centre[1] / focal[1] - margin(1),
        (size[0] - centre[0]) / focal[0] + margin(0),
        (size[1] - centre[1]) / focal[1] + margin(1),
    ];
    let min_z = (0.01 * f64::from(near)).max(1e-3);
    let all = rotation.chain(position).chain(focal).chain(centre).chain(size);
    let mut floats = [0.0; SPGR_CAMERA_STRIDE];
    for (to, v) in floats.iter_mut().zip(all.chain([min_z]).chain(bounds)) {
        *to = v as f32;
    }
    floats
}

impl Gpu {
    /// Computes the children `[N·K, 11]` and the gains `[N·K]` or `[N·K, 4]`. The caller checks
    /// inputs and outputs for numbers that are not finite.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for inconsistent lengths; errors of the device.
    pub fn spgr(&self, args: &SpgrArgs) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        let n = args.check()?;
        let (k, gain_stride) = (args.rules.children(), args.rules.gain_channels());
        let cameras = self.upload("context cameras", &args.cameras())?;
        let (mut rows, mut gains) = (Vec::new(), Vec::new());
        for parents in Self::chunks(n, self.rows_per_binding(k * HEAD_STRIDE.max(SPLAT_STRIDE))) {
            let count = parents.len() * k;
            let uniform = self.uniform(&args.uniform(&parents))?;
            let [head, own] = args.rows(&parents);
            let head = self.upload("head records", head)?;
            let own = self.upload("parents", own)?;
            let children = self.empty::<f32>("children", count * SPLAT_STRIDE)?;
            let gain = self.empty::<f32>("gains", count * gain_stride)?;
            let bindings = [&uniform, &head, &own, &cameras, &children, &gain];
            let mut commands = self.commands("spgr", false);
            let groups = Groups::of(parents.len(), THREADS);
            commands.run(&SPGR, &[], &bindings.map(Binding::from), groups)?;
            let children = commands.read::<f32>(&children, count * SPLAT_STRIDE)?;
            let gain = commands.read::<f32>(&gain, count * gain_stride)?;
            commands.submit()?;
            rows.extend(children.take(self)?);
            gains.extend(gain.take(self)?);
        }
        Ok((rows, gains))
    }
}
