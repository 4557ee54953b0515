//! MVSplat's cost volume and its refinement (MVSplat 3.1, "Cost volume construction" and
//! "Cost volume refinement"). Rows are (v b).

use super::unet::UNet;
use crate::network::config::Mvsplat as Settings;
use crate::network::model::Views;
use crate::network::model::layers::{Conv2d, ConvShape, GroupNorm, gelu};
use crate::network::model::trace::Trace;
use crate::network::ops::plane_sweep::{Pair, Sweep, pair, warped};
use crate::network::ops::{Array, Backend};
use candle_core::{Device, Result, Tensor};
use candle_nn::VarBuilder;
use glam::Mat4;
use subsplat_kernels::camera::{Camera, NearFar};

/// Smallest camera z that the projection divides by.
const MIN_Z: f32 = 1e-3;

/// Returns the disparity candidates `[V·B][D]`, uniform from 1/far (index 0) to 1/near.
pub fn disparities(views: &Views, candidates: usize) -> Vec<Vec<f32>> {
    let (b, v) = (views.scenes(), views.views());
    let row = |NearFar { near, far }| {
        let (low, high) = (1.0 / f64::from(far), 1.0 / f64::from(near));
        let step = (high - low) / (candidates - 1) as f64;
        (0..candidates).map(|k| (low + k as f64 * step) as f32).collect()
    };
    (0..v * b).map(|r| row(views.near_far[r % b][r / b])).collect()
}

/// Pose of view i in the frame of view j of one scene, with the roundings of MVSplat's
/// code: inv(E_j) to f32, then a product in f32. With two views the second pose is the
/// inverse of the first.
fn relative_pose(cameras: &[Camera], i: usize, j: usize) -> Mat4 {
    let pose = |i: usize, j: usize| {
        cameras[j].world_from_camera().as_dmat4().inverse().as_mat4()
            * cameras[i].world_from_camera()
    };
    match (cameras.len(), i) {
        (2, 1) => pose(j, i).as_dmat4().inverse().as_mat4(),
        _ => pose(i, j),
    }
}

/// Returns the sources of view `i` in MVSplat's order: i + 1, i + 2, … modulo V.
fn ordered_sources(views: &Views, scene: usize, i: usize) -> impl Iterator<Item = usize> {
    let v = views.views();
    let sources = &views.sources()[scene][i];
    (1..v).map(move |offset| (i + offset) % v).filter(|j| sources.contains(j))
}

/// Returns the plane sweep's geometry under MVSplat's conventions: reference view i against
/// those of views i + 1, i + 2, … modulo V that are its sources, at the features' resolution
/// h × w.
///
/// # Errors
/// A camera is not invertible.
pub fn sweep<A: Array>(views: &Views, disparities: &[Vec<f32>], features: &A) -> Result<Sweep> {
    let [_, channels, h, w] = features.sizes()?;
    let (b, v) = (views.scenes(), views.views());
    let mut pairs: Vec<Vec<Pair>> = Vec::with_capacity(v * b);
    for row in 0..v * b {
        let (i, scene) = (row / b, row % b);
        let own = ordered_sources(views, scene, i).map(|j| {
            let cameras = &views.cameras[scene];
            // Both sides take the reference's intrinsics, as in MVSplat's code.
            let k = cameras[i].intrinsics().resized(w, h);
            pair(&k, &k, relative_pose(cameras, i, j), j * b + scene)
        });
        pairs.push(own.collect::<Result<_>>()?);
    }
    Ok(Sweep {
        pairs,
        depths: disparities.iter().map(|d| d.iter().map(|d| 1.0 / d).collect()).collect(),
        centre: 0.0,
        min_z: MIN_Z,
        scale: 1.0 / (channels as f32).sqrt(),
        channels,
        size: [h, w],
    })
}

/// Computes the correlation `[V·B, D, h, w]` of transformer features `[V·B, C, h, w]` on
/// `backend`.
///
/// # Errors
/// A camera is not invertible.
pub fn correlation<A: Array>(
    backend: &Backend,
    views: &Views,
    disparities: &[Vec<f32>],
    features: &A,
    trace: &mut Trace<'_>,
) -> Result<A> {
    let sweep = sweep(views, disparities, features)?;
    if trace.is_on() {
        trace_geometry(views, &sweep, &features.to_host()?, trace)?;
    }
    let volume = features.plane_sweep(features, sweep, backend)?;
    trace.put("cv.raw_correlation_vb", &volume)?;
    Ok(volume)
}

fn trace_geometry(
    views: &Views,
    sweep: &Sweep,
    features: &Tensor,
    trace: &mut Trace<'_>,
) -> Result<()> {
    let b = views.scenes();
    let v = views.views();
    let [h, w] = sweep.size;
    let d = sweep.candidates();
    let dev = &Device::Cpu;
    let candidates: Vec<f32> = sweep.depths.iter().flatten().map(|z| 1.0 / z).collect();
    trace.put("cv.disp_candidates_vb", &Tensor::from_vec(candidates, (v * b, d), dev)?)?;
    for at in 0..views.sources_per_view() {
        let (mut k, mut poses) = (Vec::new(), Vec::new());
        for row in 0..v * b {
            let (i, scene) = (row / b, row % b);
            let cameras = &views.cameras[scene];
            let own = cameras[i].intrinsics().resized(w, h).matrix().transpose();
            k.extend_from_slice(&own.to_cols_array());
            for j in ordered_sources(views, scene, i).skip(at).take(1) {
                poses.extend(relative_pose(cameras, i, j).transpose().to_cols_array());
            }
        }
        trace.put(&format!("cv.K_px.{at}"), &Tensor::from_vec(k, (v * b, 3, 3), dev)?)?;
        trace.put(&format!("cv.pose.{at}"), &Tensor::from_vec(poses, (v * b, 4, 4), dev)?)?;
        let some = [0, d / 2, d - 1];
        let name = format!("cv.warped_d{}_d{}_d{}.{at}", some[0], some[1], some[2]);
        trace.put_with(&name, || warped(features, sweep, at, &some))?;
    }
    Ok(())
}

/// Stem, U-Net and last convolution over [correlation ; features], plus a pointwise
/// convolution of the same input.
#[derive(Clone, Debug)]
pub struct Refinement {
    stem: (Conv2d, GroupNorm),
    unet: UNet,
    last: Conv2d,
    residual: Conv2d,
}

impl Refinement {
    /// Builds the refinement; `vb` is at the depth predictor.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(s: &Settings, vb: VarBuilder) -> Result<Self> {
        let (d, c) = (s.depth_candidates, s.costvolume_channels);
        let c_in = d + s.cnn_channels[2];
        let net = vb.pp("corr_refine_net");
        Ok(Self {
            stem: (
                Conv2d::new(c_in, c, ConvShape::K3, net.pp("0"))?,
                GroupNorm::new(8, c, net.pp("1"))?,
            ),
            unet: UNet::new(c, s.costvolume_levels, net.pp("3"))?,
            last: Conv2d::new(c, d, ConvShape::K3, net.pp("4"))?,
            residual: Conv2d::new(c_in, d, ConvShape::K1, vb.pp("regressor_residual"))?,
        })
    }

    /// Maps `volume` `[V·B, D, h, w]` and `features` `[V·B, C, h, w]` to the refined volume
    /// `[V·B, D, h, w]`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn forward<A: Array>(
        &self,
        volume: &A,
        features: &A,
        views: usize,
        trace: &mut Trace<'_>,
    ) -> Result<A> {
        let name = "cv.corr_refine_net";
        let input = volume.cat_channels(features)?;
        let x = self.stem.0.forward(&input)?;
        trace.put(&format!("{name}.0"), &x)?;
        let x = self.stem.1.forward(&x)?;
        trace.put(&format!("{name}.1"), &x)?;
        let x = gelu(&x)?;
        trace.put(&format!("{name}.2"), &x)?;
        let x = self.unet.forward(&x, views, trace, &format!("{name}.3"))?;
        let x = self.last.forward(&x)?;
        trace.put(&format!("{name}.out_vb"), &x)?;
        let residual = self.residual.forward(&input)?;
        trace.put("cv.regressor_residual_vb", &residual)?;
        let x = x.add(&residual)?;
        trace.put("cv.refined_correlation_vb", &x)?;
        Ok(x)
    }
}
