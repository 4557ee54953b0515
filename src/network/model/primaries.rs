//! Primaries in world frame from raw head outputs: MVSplat's Gaussian adapter (MVSplat
//! 3.2), differentiable. The op: [`crate::network::ops::adapter`].
//!
//! In: quaternions xyzw in camera frame; SH colour-major in camera frame. Out: quaternions
//! wxyz in world frame, unit, w ≥ 0; SH in world frame, masked by degree. Tests:
//! tests/network/primaries.rs, tests/network/parity.rs.
//!
//! MVSplat rotates SH coefficients in e3nn's basis and evaluates them in another, so a rotated camera changes
//! its colours. `ShFrame::Mvsplat` reproduces this. `ShFrame::MvsplatExact` (`tuned`) converts to the
//! standard basis and rotates exactly.

use super::trace::Trace;
use super::{BackboneOutput, Primaries, Views};
use crate::network::config::{Primaries as Settings, ShFrame};
use crate::network::ops::Array;
use crate::network::ops::adapter::{Adapter, Placed, Turn, View, place};
use candle_core::{Device, Result, Tensor, bail};
use glam::{DMat3, DQuat};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, ShBasis, sh_coefficients,
};
use subsplat_kernels::sh::{Rotation, RotationBasis, standard_from_mvsplat};

/// Scales are in tenths of a pixel's extent at the Gaussian's depth, summed over both
/// axes: a fifth of a square pixel (MVS).
const PIXEL_SHARE: f64 = 0.1;
/// Degree l ≥ 1 of the colour is damped by 0.1·0.25^l (MVS).
const SH_DAMPING: (f64, f64) = (0.1, 0.25);
/// ε of the quaternion's normalisation (MVS).
const QUAT_EPS: f64 = 1e-8;

/// Returns the factor of every SH coefficient: 1 for degree 0, 0.1·0.25^l for degree l.
pub fn sh_mask(degree: usize) -> Vec<f32> {
    let factor = |l: usize| match l {
        0 => 1.0,
        _ => (SH_DAMPING.0 * SH_DAMPING.1.powi(l as i32)) as f32,
    };
    (0..=degree).flat_map(|l| std::iter::repeat_n(factor(l), 2 * l + 1)).collect()
}

/// All primaries of all scenes as packed rows and SH, which the rasterizer reads directly
/// if SPGR is off.
pub struct Packed {
    placed: Placed,
    scenes: usize,
    /// Basis of the SH coefficients.
    pub sh_basis: ShBasis,
    /// Gaussians per view, H·W·G.
    pub per_view: usize,
}

impl Packed {
    /// Returns the packed rows `[B·N, 11]`; columns as in [`subsplat_kernels::layout`].
    pub fn rows(&self) -> &Tensor {
        &self.placed.rows
    }

    /// Returns the SH in world frame, `[B·N, D, 3]`, RGB innermost.
    ///
    /// # Errors
    /// Those of candle.
    pub fn sh(&self) -> Result<Tensor> {
        self.placed.sh()
    }

    /// `[B·N, …]` to `[B, N, …]`.
    fn by_scene(&self, t: &Tensor) -> Result<Tensor> {
        t.reshape([&[self.scenes, t.dim(0)? / self.scenes], &t.dims()[1..]].concat())
    }

    /// Returns one tensor for each attribute.
    ///
    /// # Errors
    /// Those of candle.
    pub fn split(&self) -> Result<Primaries> {
        let rows = self.by_scene(self.rows())?;
        Ok(Primaries {
            means: rows.narrow(2, MEAN_OFFSET, 3)?,
            quats_wxyz: rows.narrow(2, QUAT_OFFSET, 4)?,
            scales: rows.narrow(2, SCALE_OFFSET, 3)?,
            opacities: rows.narrow(2, OPACITY_OFFSET, 1)?.squeeze(2)?,
            sh: self.by_scene(&self.sh()?)?.transpose(2, 3)?,
            sh_camera: self.by_scene(&self.placed.sh_camera()?)?,
            sh_basis: self.sh_basis,
            per_view: self.per_view,
        })
    }
}

impl Primaries {
    /// The primaries of one scene with the attributes of packed rows `[N, 11]`.
    ///
    /// # Errors
    /// Those of candle.
    pub(super) fn with_rows(&self, rows: &Tensor) -> Result<Self> {
        let part = |first: usize, count: usize| rows.narrow(1, first, count)?.unsqueeze(0);
        Ok(Self {
            means: part(MEAN_OFFSET, 3)?,
            quats_wxyz: part(QUAT_OFFSET, 4)?,
            scales: part(SCALE_OFFSET, 3)?,
            opacities: part(OPACITY_OFFSET, 1)?.squeeze(2)?,
            ..self.clone()
        })
    }
}

/// Computes all primaries of all scenes, in world frame.
///
/// # Errors
/// Shapes of `out` do not fit `views` or `settings`.
pub fn primaries(
    out: &BackboneOutput,
    views: &Views,
    settings: &Settings,
    trace: &mut Trace<'_>,
) -> Result<Primaries> {
    let all = packed(out, views, settings)?.split()?;
    trace_parts(out, views, settings, &all, trace)?;
    Ok(all)
}

/// Computes [`primaries`] as packed rows.
///
/// # Errors
/// Those of [`primaries`].
pub fn packed(out: &BackboneOutput, views: &Views, settings: &Settings) -> Result<Packed> {
    let adapter = adapter_of(out, views, settings)?;
    let [h, w] = adapter.size;
    let g = adapter.per_pixel;
    Ok(Packed {
        placed: place(&out.raw, &out.depths, &out.densities, adapter)?,
        scenes: views.scenes(),
        sh_basis: basis_of(settings),
        per_view: h * w * g,
    })
}

/// Returns the basis of the SH that the adapter computes.
pub(super) fn basis_of(settings: &Settings) -> ShBasis {
    match settings.sh_frame {
        ShFrame::Mvsplat => ShBasis::Mvsplat,
        ShFrame::MvsplatExact | ShFrame::Standard => ShBasis::Standard,
    }
}

/// Returns the constants of the adapter for `out`, on any executor.
///
/// # Errors
/// Those of [`primaries`].
pub fn adapter_of<A: Array>(
    out: &BackboneOutput<A>,
    views: &Views,
    settings: &Settings,
) -> Result<Adapter> {
    let (b, v, _, h, w) = views.images.dims5()?;
    let d = sh_coefficients(settings.sh_degree);
    let [rb, rv, pixels, channels] = out.raw.sizes()?;
    let [_, _, _, g] = out.depths.sizes()?;
    if [rb, rv, pixels, channels] != [b, v, h * w, 9 + 3 * d] {
        let expected = [b, v, h * w, 9 + 3 * d];
        bail!("primaries raw: expected {expected:?}, got {:?}", out.raw.dims());
    }
    if out.depths.dims() != out.densities.dims() || out.depths.dims()[..3] != [b, v, pixels] {
        let (depths, densities) = (out.depths.dims(), out.densities.dims());
        bail!(
            "primaries depths, densities: expected [{b}, {v}, {pixels}, G], got {depths:?}, {densities:?}"
        );
    }
    Ok(Adapter {
        views: views.cameras.iter().flatten().map(|camera| view(camera, settings)).collect(),
        size: [h, w],
        per_pixel: g,
        functions: d,
        exponent: settings.opacity_exponent,
        camera: Turn::new(&masked(settings), d),
    })
}

/// Constants of one view.
fn view(camera: &Camera, s: &Settings) -> View {
    let k = camera.intrinsics();
    let rotation = camera.rotation().as_dmat3();
    let pixel = PIXEL_SHARE * (1.0 / f64::from(k.fx) + 1.0 / f64::from(k.fy));
    let d = sh_coefficients(s.sh_degree);
    let basis = match s.sh_frame {
        ShFrame::Mvsplat => RotationBasis::E3nn,
        ShFrame::MvsplatExact | ShFrame::Standard => RotationBasis::Standard,
    };
    let sh_to_world = product(&Rotation::new(rotation, basis).matrix(s.sh_degree), &masked(s), d);
    View {
        focal: [k.fx, k.fy].map(f64::from),
        centre: [k.cx, k.cy].map(f64::from),
        rotation: rotation.transpose().to_cols_array_2d(),
        origin: camera.position().as_dvec3().to_array(),
        quat: world_quaternions(rotation),
        scale: [s.scale_min * pixel, (s.scale_max - s.scale_min) * pixel],
        turn: Turn::new(&sh_to_world, d),
    }
}

/// The linear map q ↦ quat(R) ⊗ q. Row i is the world-frame image, wxyz, of the i-th of
/// x, y, z, w of a camera-frame quaternion.
fn world_quaternions(rotation: DMat3) -> [[f64; 4]; 4] {
    let a = DQuat::from_mat3(&rotation);
    let units = [
        DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0),
        DQuat::from_xyzw(0.0, 1.0, 0.0, 0.0),
        DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0),
        DQuat::from_xyzw(0.0, 0.0, 0.0, 1.0),
    ];
    units.map(|q| {
        let p = a * q;
        [p.w, p.x, p.y, p.z]
    })
}

/// Map from raw SH to camera-frame SH, `[D, D]` row-major: the mask by degree, and for
/// [`ShFrame::MvsplatExact`] the map from MVSplat's basis to the standard one. That map is
/// zero for degree 4, which MVSplat never evaluates.
fn masked(s: &Settings) -> Vec<f64> {
    let d = sh_coefficients(s.sh_degree);
    let map = standard_from_mvsplat();
    let mask = sh_mask(s.sh_degree);
    let at = |i: usize, j: usize| match s.sh_frame {
        ShFrame::MvsplatExact if i < 16 && j < 16 => map[i * 16 + j],
        ShFrame::MvsplatExact => 0.0,
        ShFrame::Mvsplat | ShFrame::Standard if i == j => 1.0,
        ShFrame::Mvsplat | ShFrame::Standard => 0.0,
    };
    (0..d * d).map(|i| at(i / d, i % d) * f64::from(mask[i % d])).collect()
}

/// a·b of row-major `[d, d]` matrices.
fn product(a: &[f64], b: &[f64], d: usize) -> Vec<f64> {
    let at = |i: usize, j: usize| (0..d).map(|k| a[i * d + k] * b[k * d + j]).sum();
    (0..d * d).map(|i| at(i / d, i % d)).collect()
}

fn trace_parts(
    out: &BackboneOutput,
    views: &Views,
    settings: &Settings,
    all: &Primaries,
    trace: &mut Trace<'_>,
) -> Result<()> {
    if !trace.is_on() {
        return Ok(());
    }
    let (b, v) = (views.scenes(), views.views());
    let rays = |camera: &Camera, raw: &[f32]| -> Vec<f32> {
        let k = camera.intrinsics();
        let size = [k.width as f32, k.height as f32];
        let at = |i: usize| [i % k.width, i / k.width].map(|p| p as f32);
        let channels = raw.len() / (k.width * k.height);
        let ray = |(i, row): (usize, &[f32])| {
            let pixel = at(i);
            [0, 1].map(|j| (pixel[j] + 1.0 / (1.0 + (-row[j]).exp())) / size[j])
        };
        raw.chunks(channels).enumerate().flat_map(ray).collect()
    };
    let mut xy = Vec::new();
    for (camera, raw) in views.cameras.iter().flatten().zip(out.raw.flatten(0, 1)?.to_vec3()?) {
        xy.extend(rays(camera, &raw.concat()));
    }
    let q = out.raw.narrow(3, 5, 4)?;
    let rotations = q.broadcast_div(&(q.sqr()?.sum_keepdim(3)?.sqrt()? + QUAT_EPS)?)?;
    let g = out.depths.dim(3)?;
    let n = all.per_view;
    let pixels = all.per_view / g;
    let rotations = rotations.unsqueeze(3)?.broadcast_as((b, v, pixels, g, 4))?;
    let d = sh_coefficients(settings.sh_degree);
    trace.put("gauss.depths", &out.depths.flatten_from(2)?)?;
    trace.put("gauss.opacities_in", &out.densities.flatten_from(2)?)?;
    trace.put("gauss.raw82", &out.raw.narrow(3, 2, out.raw.dim(3)? - 2)?)?;
    trace.put("gauss.xy_ray", &Tensor::from_vec(xy, (b, v, pixels, 2), &Device::Cpu)?)?;
    trace.put("gauss.scales", &all.scales.reshape((b, v, n, 3))?)?;
    trace.put("gauss.rotations_xyzw", &rotations.reshape((b, v, n, 4))?)?;
    trace.put("gauss.sh_mask", &Tensor::new(sh_mask(settings.sh_degree), &Device::Cpu)?)?;
    let (mut wigner, mut angles) = (Vec::new(), Vec::new());
    for camera in views.cameras.iter().flatten() {
        let r = camera.rotation().as_dmat3();
        let m = Rotation::new(r, RotationBasis::E3nn).matrix(settings.sh_degree);
        wigner.extend(m.into_iter().map(|v| v as f32));
        angles.extend(e3nn_angles(r).map(|v| v as f32));
    }
    trace.put("gauss.sh_wigner_D", &Tensor::from_vec(wigner, (b, v, d, d), &Device::Cpu)?)?;
    trace.put("gauss.sh_angles_abg", &Tensor::from_vec(angles, (b, v, 3), &Device::Cpu)?)
}

/// (α, β, γ) with R = Ry(α)·Rx(β)·Ry(γ), as e3nn computes them. The trace alone uses them;
/// the rotation of SH does not need angles.
fn e3nn_angles(r: DMat3) -> [f64; 3] {
    let at = |row: usize, col: usize| r.col(col)[row];
    let beta = at(1, 1).clamp(-1.0, 1.0).acos();
    let alpha = at(0, 1).atan2(at(2, 1));
    let m = (DMat3::from_rotation_y(alpha) * DMat3::from_rotation_x(beta)).transpose() * r;
    [alpha, beta, m.col(2)[0].atan2(m.col(0)[0])]
}

impl Primaries {
    /// Returns the world covariances R·diag(σ²)·Rᵀ, `[B, N, 3, 3]`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn covariances(&self) -> Result<Tensor> {
        let (b, n, _) = self.scales.dims3()?;
        let q = |i: usize| self.quats_wxyz.narrow(2, i, 1);
        let (w, x, y, z) = (q(0)?, q(1)?, q(2)?, q(3)?);
        let twice = |a: &Tensor, b: &Tensor, c: &Tensor, d: &Tensor, sign: f64| -> Result<Tensor> {
            ((a * b)? + ((c * d)? * sign)?)? * 2.0
        };
        let diagonal =
            |a: &Tensor, b: &Tensor| -> Result<Tensor> { (a.sqr()? + b.sqr()?)?.affine(-2.0, 1.0) };
        let rows = [
            diagonal(&y, &z)?,
            twice(&x, &y, &w, &z, -1.0)?,
            twice(&x, &z, &w, &y, 1.0)?,
            twice(&x, &y, &w, &z, 1.0)?,
            diagonal(&x, &z)?,
            twice(&y, &z, &w, &x, -1.0)?,
            twice(&x, &z, &w, &y, -1.0)?,
            twice(&y, &z, &w, &x, 1.0)?,
            diagonal(&x, &y)?,
        ];
        let r = Tensor::cat(&rows, 2)?.reshape((b * n, 3, 3))?;
        let scaled = r.broadcast_mul(&self.scales.reshape((b * n, 1, 3))?)?;
        scaled.matmul(&scaled.transpose(1, 2)?.contiguous()?)?.reshape((b, n, 3, 3))
    }
}
