//! The small backbone's own parts.
//!
//! WGSL: wgsl/network/expectation.wgsl, convex.wgsl, head_output.wgsl, cross_check.wgsl, depth_consensus.wgsl,
//! raw_matching_blocks.wgsl, raw_matching_scores.wgsl.

use super::{Array, Reduction, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{
    ConvexUniform, CrossCheckUniform, DepthConsensusUniform, ExpectationUniform, HeadOutputUniform,
    RawMatchingUniform,
};

pub(crate) static EXPECTATION: Kernel = Kernel {
    name: "expectation",
    entry: "main",
    source: wgsl!(ExpectationUniform; "shared/grid", "shared/expectation", "network/expectation"),
};

pub(crate) static CONVEX: Kernel = Kernel {
    name: "convex",
    entry: "main",
    source: wgsl!(ConvexUniform; "shared/grid", "network/convex"),
};

pub(crate) static HEAD_OUTPUT: Kernel = Kernel {
    name: "head_output",
    entry: "main",
    source: wgsl!(HeadOutputUniform; "shared/grid", "shared/activation", "network/head_output"),
};

pub(crate) static CROSS_CHECK: Kernel = Kernel {
    name: "cross_check",
    entry: "main",
    source: wgsl!(CrossCheckUniform; "shared/grid", "shared/rgbd", "network/cross_check"),
};

pub(crate) static DEPTH_CONSENSUS: Kernel = Kernel {
    name: "depth_consensus",
    entry: "main",
    source: wgsl!(DepthConsensusUniform; "shared/grid", "shared/rgbd", "network/depth_consensus"),
};

pub(crate) static RAW_MATCHING_BLOCKS: Kernel = Kernel {
    name: "raw_matching_blocks",
    entry: "main",
    source: wgsl!(RawMatchingUniform; "shared/grid", "shared/raw_matching", "network/raw_matching_blocks"),
};

pub(crate) static RAW_MATCHING_SCORES: Kernel = Kernel {
    name: "raw_matching_scores",
    entry: "main",
    source: wgsl!(RawMatchingUniform; "shared/grid", "shared/raw_matching", "network/raw_matching_scores"),
};

const THREADS: usize = 64;
/// Sums of a pixel and candidate (wgsl/shared/raw_matching.wgsl).
const PLANES: usize = 13;
/// Channels of the result of a raw matching.
const CHANNELS: usize = 4;

/// Constants of [`Array::head_output`].
#[derive(Clone, Copy, Debug)]
pub struct HeadOutputCall<'a> {
    /// `[R]`: added to every row.
    pub start: &'a [f32],
    /// Places of red, green and blue in a row; factor and summand of the colour.
    pub colour: Option<([usize; 3], f32, f32)>,
    /// Opacity depends on the confidence.
    pub confident: bool,
}

/// Constants of [`Array::cross_check`].
#[derive(Clone, Copy, Debug)]
pub struct CrossCheckCall<'a> {
    /// Views of a scene.
    pub views: usize,
    /// Per view 16 floats: rows of R with the position as fourth column, focal lengths, principal
    /// point, px.
    pub cameras: &'a [f32],
    /// Factor of a pixel that is inconsistent everywhere.
    pub least: f32,
    /// Σ|difference of colour| from which inconsistency is 1.
    pub colour: f32,
    /// Share of z by which a hidden point lies behind a surface.
    pub behind: f32,
}

/// Constants of [`Array::depth_consensus`].
#[derive(Clone, Copy, Debug)]
pub struct DepthConsensusCall<'a> {
    /// Views of a scene.
    pub views: usize,
    /// Per view 16 floats, as in [`CrossCheckCall::cameras`].
    pub cameras: &'a [f32],
    /// Per view: σ of the agreement of two disparities, 1 / world units.
    pub tolerances: &'a [f32],
    /// Weight of a pixel's own depth.
    pub own_weight: f32,
    /// Σ|difference of colour| at which support falls to 1/e.
    pub colour: f32,
    /// Number of σ from which a surface gives no support.
    pub reach: f32,
    /// Term of the weights.
    pub least_weight: f32,
    /// Distance from a ray up to which a surface point is on it, px per axis.
    pub on_ray: f32,
    /// Steps of the search for the intersection of a ray and a surface.
    pub steps: u32,
}

/// Constants of [`Array::raw_matching`].
#[derive(Clone, Copy, Debug)]
pub struct RawMatchingCall<'a> {
    /// Reference and source picture of each row.
    pub rows: &'a [[u32; 2]],
    /// Per row 32 floats: at half and at quarter resolution three columns of the homography and
    /// the shift, each filled up to four.
    pub warps: &'a [f32],
    /// `[rows, D]`.
    pub disparities: &'a [f32],
    /// Smallest z of a source point, as a share of the reference depth.
    pub z_min: f32,
    /// Term of the variances.
    pub variance_floor: f32,
}

impl Array {
    /// Computes expected candidate, then mass within `window` of the mode, of logits `[B, D, h, w]`:
    /// `[2, B, 1, h, w]`. `window_alone`: the mean is taken over the window.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for another rank; errors of the device.
    pub fn expectation(&self, window: usize, window_alone: bool) -> Result<Self, GpuError> {
        let &[b, d, h, w] = self.dims.as_slice() else {
            return Err(misfit(EXPECTATION.name, "[B, D, h, w]".to_owned(), &self.dims));
        };
        let result = self.recorder.empty(&[2, b, 1, h, w])?;
        let uniform = ExpectationUniform {
            pictures: b as u32,
            candidates: d as u32,
            pixels: (h * w) as u32,
            window: window as u32,
            window_alone: u32::from(window_alone),
            ..ExpectationUniform::default()
        };
        let bindings = [self.binding(), result.binding()];
        self.recorder.call(
            &EXPECTATION,
            &[],
            &uniform,
            &bindings,
            Groups::of(b * h * w, THREADS),
        )?;
        Ok(result)
    }

    /// Returns the two halves of the first dimension under `dims`.
    pub(super) fn halves(&self, dims: &[usize]) -> Result<[Self; 2], GpuError> {
        Ok([self.narrow(0, 0, 1)?.reshape(dims)?, self.narrow(0, 1, 1)?.reshape(dims)?])
    }

    /// Upsamples two maps `[B, 1, h, w]` by 4 with masks `[B, 144, h, w]`: `[2, B, 1, 4h, 4w]`;
    /// `start` `[16, 9]` is added to the masks' logits.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<Self, GpuError> {
        let (b, h, w) = match self.dims.as_slice() {
            &[b, 144, h, w] if maps.iter().all(|m| m.dims == [b, 1, h, w]) => (b, h, w),
            _ => return Err(misfit(CONVEX.name, "masks [B, 144, h, w]".to_owned(), &self.dims)),
        };
        GpuError::check_lengths(CONVEX.name, [("start", start.len(), 144)])?;
        let result = self.recorder.empty(&[2, b, 1, 4 * h, 4 * w])?;
        let gpu = &self.recorder.gpu;
        let [pictures, height, width] = [b, h, w].map(|n| n as u32);
        let uniform = ConvexUniform { pictures, height, width, pad: 0 };
        let start = gpu.upload("start", start)?;
        let bindings = [
            self.binding(),
            maps[0].binding(),
            maps[1].binding(),
            Binding::from(&start),
            result.binding(),
        ];
        self.recorder.call(
            &CONVEX,
            &[],
            &uniform,
            &bindings,
            Groups::of(result.count() / 2, THREADS),
        )?;
        Ok(result)
    }

    /// Computes raw rows `[B, H·W, R]` and opacities `[B, 1, H, W]` of `[B, R + 1, H, W]`,
    /// `confidence` `[B, 1, H, W]` and `rgb` `[B, 3, H, W]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn head_output(
        &self,
        confidence: &Self,
        rgb: &Self,
        call: HeadOutputCall,
    ) -> Result<[Self; 2], GpuError> {
        let r = call.start.len();
        let (b, h, w) = match self.dims.as_slice() {
            &[b, c, h, w] if c == r + 1 => (b, h, w),
            _ => {
                let expected = format!("[B, {}, H, W]", r + 1);
                return Err(misfit(HEAD_OUTPUT.name, expected, &self.dims));
            }
        };
        if confidence.dims != [b, 1, h, w] || rgb.dims != [b, 3, h, w] {
            let expected = format!("confidence [{b}, 1, {h}, {w}] and a picture");
            return Err(misfit(HEAD_OUTPUT.name, expected, &confidence.dims));
        }
        let rows = self.recorder.empty(&[b, h * w, r])?;
        let opacity = self.recorder.empty(&[b, 1, h, w])?;
        let gpu = &self.recorder.gpu;
        let (places, factor, offset) = call.colour.unwrap_or_default();
        let [red, green, blue] = places.map(|p| p as u32);
        let uniform = HeadOutputUniform {
            pictures: b as u32,
            pixels: (h * w) as u32,
            raw: r as u32,
            coloured: u32::from(call.colour.is_some()),
            places: [red, green, blue, 0],
            factor,
            offset,
            confident: u32::from(call.confident),
            pad: 0,
        };
        let start = gpu.upload("start", call.start)?;
        let bindings = [
            self.binding(),
            confidence.binding(),
            rgb.binding(),
            Binding::from(&start),
            rows.binding(),
            opacity.binding(),
        ];
        self.recorder.call(
            &HEAD_OUTPUT,
            &[],
            &uniform,
            &bindings,
            Groups::of(b * h * w, THREADS),
        )?;
        Ok([rows, opacity])
    }

    /// Computes opacity factors `[B, V, H·W, 1]` of images `[B, V, 3, H, W]` and `distances` along
    /// the unit rays.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn cross_check(&self, distances: &Self, call: CrossCheckCall) -> Result<Self, GpuError> {
        let &[b, v, 3, h, w] = self.dims.as_slice() else {
            return Err(misfit(CROSS_CHECK.name, "[B, V, 3, H, W]".to_owned(), &self.dims));
        };
        let lengths = [
            ("distances", distances.count(), b * v * h * w),
            ("cameras", call.cameras.len(), 16 * b * v),
            ("views", call.views, v),
        ];
        GpuError::check_lengths(CROSS_CHECK.name, lengths)?;
        let result = self.recorder.empty(&[b, v, h * w, 1])?;
        let gpu = &self.recorder.gpu;
        let [scenes, views, height, width] = [b, v, h, w].map(|n| n as u32);
        let CrossCheckCall { least, colour, behind, .. } = call;
        let uniform =
            CrossCheckUniform { scenes, views, height, width, least, colour, behind, pad: 0.0 };
        let cameras = gpu.upload("cameras", call.cameras)?;
        let bindings =
            [self.binding(), distances.binding(), Binding::from(&cameras), result.binding()];
        self.recorder.call(
            &CROSS_CHECK,
            &[],
            &uniform,
            &bindings,
            Groups::of(result.count(), THREADS),
        )?;
        Ok(result)
    }

    /// Computes the distances `[B, V, H·W, 1]` that most views support, of images
    /// `[B, V, 3, H, W]`, `distances` along the unit rays and `confidences`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn depth_consensus(
        &self,
        [distances, confidences]: [&Self; 2],
        call: DepthConsensusCall,
    ) -> Result<Self, GpuError> {
        let &[b, v, 3, h, w] = self.dims.as_slice() else {
            return Err(misfit(DEPTH_CONSENSUS.name, "[B, V, 3, H, W]".to_owned(), &self.dims));
        };
        let lengths = [
            ("distances", distances.count(), b * v * h * w),
            ("confidences", confidences.count(), b * v * h * w),
            ("cameras", call.cameras.len(), 16 * b * v),
            ("tolerances", call.tolerances.len(), b * v),
            ("views", call.views, v),
        ];
        GpuError::check_lengths(DEPTH_CONSENSUS.name, lengths)?;
        let result = self.recorder.empty(&[b, v, h * w, 1])?;
        let gpu = &self.recorder.gpu;
        let [scenes, views, height, width] = [b, v, h, w].map(|n| n as u32);
        let uniform = DepthConsensusUniform {
            scenes,
            views,
            height,
            width,
            own_weight: call.own_weight,
            colour: call.colour,
            reach: call.reach,
            least_weight: call.least_weight,
            on_ray: call.on_ray,
            steps: call.steps,
            pad_a: 0,
            pad_b: 0,
        };
        let cameras = gpu.upload("cameras", call.cameras)?;
        let tolerances = gpu.upload("tolerances", call.tolerances)?;
        let bindings = [
            self.binding(),
            distances.binding(),
            confidences.binding(),
            Binding::from(&cameras),
            Binding::from(&tolerances),
            result.binding(),
        ];
        self.recorder.call(
            &DEPTH_CONSENSUS,
            &[],
            &uniform,
            &bindings,
            Groups::of(result.count(), THREADS),
        )?;
        Ok(result)
    }

    /// Computes the raw matching channels `[rows, 4, D, h, w]` of images `[B, V, 3, 4h, 4w]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn raw_matching(&self, call: RawMatchingCall) -> Result<Self, GpuError> {
        let (b, v, h, w) = match self.dims.as_slice() {
            &[b, v, 3, h, w] if h.is_multiple_of(4) && w.is_multiple_of(4) => (b, v, h / 4, w / 4),
            _ => {
                let expected = "[B, V, 3, 4h, 4w]".to_owned();
                return Err(misfit(RAW_MATCHING_BLOCKS.name, expected, &self.dims));
            }
        };
        let rows = call.rows.len();
        let d = call.disparities.len() / rows.max(1);
        let lengths = [
            ("warps", call.warps.len(), 32 * rows),
            ("disparities", call.disparities.len(), d * rows),
        ];
        GpuError::check_lengths(RAW_MATCHING_BLOCKS.name, lengths)?;
        if let Some(row) = call.rows.iter().find(|r| r.iter().any(|i| *i as usize >= b * v)) {
            let expected = format!("pictures below {}", b * v);
            return Err(misfit(RAW_MATCHING_BLOCKS.name, expected, &row.map(|i| i as usize)));
        }
        let rgb = self.reshape(&[b * v, 3, 4 * h, 4 * w])?;
        let grey = rgb.reduced(1, Reduction::Mean)?.pooled(2)?;
        let rgb = rgb.pooled(4)?;
        let gpu = &self.recorder.gpu;
        let uniform = RawMatchingUniform {
            rows: rows as u32,
            candidates: d as u32,
            height: h as u32,
            width: w as u32,
            z_min: call.z_min,
            variance_floor: call.variance_floor,
            pad0: 0.0,
            pad1: 0.0,
        };
        let pictures = gpu.upload("pairs of pictures", call.rows)?;
        let warps = gpu.upload("warps", call.warps)?;
        let disparities = gpu.upload("disparities", call.disparities)?;
        let sums = self.recorder.empty(&[rows, d, PLANES, h, w])?;
        let result = self.recorder.empty(&[rows, CHANNELS, d, h, w])?;
        let groups = || Groups::of(rows * d * h * w, THREADS);
        let bindings = [
            grey.binding(),
            rgb.binding(),
            Binding::from(&pictures),
            Binding::from(&warps),
            Binding::from(&disparities),
            sums.binding(),
        ];
        self.recorder.call(&RAW_MATCHING_BLOCKS, &[], &uniform, &bindings, groups())?;
        let bindings = [sums.binding(), result.binding()];
        self.recorder.call(&RAW_MATCHING_SCORES, &[], &uniform, &bindings, groups())?;
        Ok(result)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_of_a_raw_matching_have_as_many_planes() {
        let declared = format!("const PLANES: u32 = {PLANES}u;");
        for kernel in [&RAW_MATCHING_BLOCKS, &RAW_MATCHING_SCORES] {
            assert!(kernel.source.text(false).contains(&declared), "{}: {declared}", kernel.name);
        }
    }
}
