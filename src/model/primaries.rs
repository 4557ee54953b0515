//! From raw head outputs to Gaussians in world frame: MVSplat's Gaussian adapter
//! (spec 6), differentiable.
//!
//! Foreign layouts end here: quaternions arrive as xyzw in camera frame and leave as
//! wxyz in world frame, unit, w ≥ 0; SH arrives colour-major in camera frame, is masked
//! by degree and leaves in world frame.

use super::layers::sigmoid;
use super::trace::Trace;
use super::{BackboneOutput, Primaries, Views};
use crate::abi::{ShBasis, sh_coefficients};
use crate::camera::Camera;
use crate::config::{Primaries as Settings, ShFrame};
use crate::sh::{Rotation, RotationBasis, standard_from_mvsplat};
use candle_core::{DType, Device, Result, Tensor, bail};
use glam::{DMat3, DQuat};

/// Scales are in tenths of a pixel's extent at the Gaussian's depth, summed over both
/// axes: a fifth of a square pixel (MVS).
const PIXEL_SHARE: f64 = 0.1;
/// Degree l ≥ 1 of the colour is damped by 0.1·0.25^l (MVS).
const SH_DAMPING: (f64, f64) = (0.1, 0.25);
/// ε of the quaternion's normalisation (MVS).
const QUAT_EPS: f64 = 1e-8;

/// Factor of every SH coefficient: 1, then 0.1·0.25^l for degree l.
pub fn sh_mask(degree: usize) -> Vec<f32> {
    let factor = |l: usize| match l {
        0 => 1.0,
        _ => (SH_DAMPING.0 * SH_DAMPING.1.powi(l as i32)) as f32,
    };
    (0..=degree).flat_map(|l| std::iter::repeat_n(factor(l), 2 * l + 1)).collect()
}

/// One view's share of the primaries, G Gaussians for each of P pixels.
struct ViewPart {
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    sh: Tensor,
    sh_camera: Tensor,
    /// For tracing only: `[P, 2]` and `[P, 4]`.
    ray: Tensor,
    rotations: Tensor,
}

/// All primaries of all scenes, in world frame.
///
/// # Errors
/// Shapes of `out` that do not fit `views` or `settings`.
pub fn primaries(
    out: &BackboneOutput,
    views: &Views,
    settings: &Settings,
    trace: &mut Trace<'_>,
) -> Result<Primaries> {
    let (b, v, _, h, w) = views.images.dims5()?;
    let d = sh_coefficients(settings.sh_degree);
    let (rb, rv, pixels, channels) = out.raw.dims4()?;
    let g = out.depths.dim(3)?;
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
    let mut parts = Vec::with_capacity(b * v);
    for scene in 0..b {
        for view in 0..v {
            let raw = out.raw.get(scene)?.get(view)?;
            let depths = out.depths.get(scene)?.get(view)?;
            parts.push(view_part(&raw, &depths, &views.cameras[scene][view], settings)?);
        }
    }
    trace_parts(out, views, settings, &parts, trace)?;
    let join = |f: &dyn Fn(&ViewPart) -> &Tensor| -> Result<Tensor> {
        let all = Tensor::cat(&parts.iter().map(f).collect::<Vec<_>>(), 0)?;
        let mut dims = vec![b, v * pixels * g];
        dims.extend_from_slice(&all.dims()[1..]);
        all.reshape(dims)
    };
    Ok(Primaries {
        means: join(&|p| &p.means)?,
        quats_wxyz: join(&|p| &p.quats)?,
        scales: join(&|p| &p.scales)?,
        opacities: opacities(&out.densities, settings.opacity_exponent)?.reshape((b, ()))?,
        sh: join(&|p| &p.sh)?,
        sh_camera: join(&|p| &p.sh_camera)?,
        sh_basis: match settings.sh_frame {
            ShFrame::Mvsplat => ShBasis::Mvsplat,
            ShFrame::MvsplatExact | ShFrame::Standard => ShBasis::Standard,
        },
        per_view: pixels * g,
    })
}

fn trace_parts(
    out: &BackboneOutput,
    views: &Views,
    settings: &Settings,
    parts: &[ViewPart],
    trace: &mut Trace<'_>,
) -> Result<()> {
    if !trace.is_on() {
        return Ok(());
    }
    let (b, v) = (views.scenes(), views.views());
    let join = |f: &dyn Fn(&ViewPart) -> &Tensor| -> Result<Tensor> {
        let all = Tensor::stack(&parts.iter().map(f).collect::<Vec<_>>(), 0)?;
        let dims = [&[b, v], &all.dims()[1..]].concat();
        all.reshape(dims)
    };
    let d = sh_coefficients(settings.sh_degree);
    trace.put("gauss.depths", &out.depths.flatten_from(2)?)?;
    trace.put("gauss.opacities_in", &out.densities.flatten_from(2)?)?;
    trace.put("gauss.raw82", &out.raw.narrow(3, 2, out.raw.dim(3)? - 2)?)?;
    trace.put("gauss.xy_ray", &join(&|p| &p.ray)?)?;
    trace.put("gauss.scales", &join(&|p| &p.scales)?)?;
    trace.put("gauss.rotations_xyzw", &join(&|p| &p.rotations)?)?;
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

/// (α, β, γ) with R = Ry(α)·Rx(β)·Ry(γ), as e3nn computes them: to look at only, the
/// rotation itself does without.
fn e3nn_angles(r: DMat3) -> [f64; 3] {
    let at = |row: usize, col: usize| r.col(col)[row];
    let beta = at(1, 1).clamp(-1.0, 1.0).acos();
    let alpha = at(0, 1).atan2(at(2, 1));
    let m = (DMat3::from_rotation_y(alpha) * DMat3::from_rotation_x(beta)).transpose() * r;
    [alpha, beta, m.col(2)[0].atan2(m.col(0)[0])]
}

fn view_part(raw: &Tensor, depths: &Tensor, camera: &Camera, s: &Settings) -> Result<ViewPart> {
    let (pixels, g) = depths.dims2()?;
    let k = camera.intrinsics;
    let n = pixels * g;
    let ray = ray_positions(&raw.narrow(1, 0, 2)?, k.width, k.height)?;
    let depth = depths.reshape((pixels, g, 1))?;

    let size = Tensor::new(&[k.width as f32, k.height as f32], &Device::Cpu)?;
    let focal = Tensor::new(&[k.fx, k.fy], &Device::Cpu)?;
    let centre = Tensor::new(&[k.cx, k.cy], &Device::Cpu)?;
    let plane = ray.broadcast_mul(&size)?.broadcast_sub(&centre)?.broadcast_div(&focal)?;
    let direction =
        Tensor::cat(&[&plane, &Tensor::ones((pixels, 1), DType::F32, &Device::Cpu)?], 1)?;
    let direction = direction.broadcast_div(&norm(&direction)?)?;
    let rotation = camera.rotation().as_dmat3();
    let direction = direction.matmul(&matrix3(rotation)?)?.reshape((pixels, 1, 3))?;
    let origin = Tensor::new(&camera.position().to_array(), &Device::Cpu)?;
    let means = direction.broadcast_mul(&depth)?.broadcast_add(&origin)?;

    let pixel = PIXEL_SHARE * (1.0 / f64::from(k.fx) + 1.0 / f64::from(k.fy));
    let scales = sigmoid(&raw.narrow(1, 2, 3)?)?
        .affine((s.scale_max - s.scale_min) * pixel, s.scale_min * pixel)?;
    let scales = scales.reshape((pixels, 1, 3))?.broadcast_mul(&depth)?;

    let q = raw.narrow(1, 5, 4)?;
    let rotations = q.broadcast_div(&(norm(&q)? + QUAT_EPS)?)?;
    let quats = world_quaternions(&rotations, rotation)?;

    let d = sh_coefficients(s.sh_degree);
    let mask = Tensor::new(sh_mask(s.sh_degree), &Device::Cpu)?;
    let sh = raw.narrow(1, 9, 3 * d)?.contiguous()?.reshape((pixels * 3, d))?;
    let sh = sh.broadcast_mul(&mask)?;
    let sh_camera = match s.sh_frame {
        ShFrame::MvsplatExact => sh.matmul(&mvsplat_map_transposed(d)?)?,
        ShFrame::Mvsplat | ShFrame::Standard => sh,
    };
    let basis = match s.sh_frame {
        ShFrame::Mvsplat => RotationBasis::E3nn,
        ShFrame::MvsplatExact | ShFrame::Standard => RotationBasis::Standard,
    };
    let turn = Rotation::new(rotation, basis).matrix(s.sh_degree);
    let turn: Vec<f32> = turn.into_iter().map(|v| v as f32).collect();
    let turn = Tensor::from_vec(turn, (d, d), &Device::Cpu)?;
    let sh = sh_camera.matmul(&turn.t()?)?;
    // Per pixel to per Gaussian: shape and colour are shared by the G of a pixel.
    let shared = |x: Tensor, dims: &[usize]| -> Result<Tensor> {
        let pixel = x.reshape([&[pixels, 1], dims].concat())?;
        let all = pixel.broadcast_as([&[pixels, g], dims].concat())?.contiguous()?;
        all.reshape([&[n], dims].concat())
    };
    Ok(ViewPart {
        means: means.reshape((n, 3))?,
        quats: shared(quats, &[4])?,
        scales: scales.reshape((n, 3))?,
        sh: shared(sh, &[3, d])?,
        sh_camera: shared(sh_camera, &[3, d])?,
        ray,
        rotations: shared(rotations, &[4])?,
    })
}

/// `[P, 2]`: pixel centres over the picture's size, moved by at most half a pixel.
fn ray_positions(offsets: &Tensor, width: usize, height: usize) -> Result<Tensor> {
    let (w, h) = (width as f32, height as f32);
    let centres: Vec<f32> = (0..height)
        .flat_map(|row| {
            (0..width).flat_map(move |col| [(col as f32 + 0.5) / w, (row as f32 + 0.5) / h])
        })
        .collect();
    let centres = Tensor::from_vec(centres, (width * height, 2), &Device::Cpu)?;
    let pixel = Tensor::new(&[1.0 / w, 1.0 / h], &Device::Cpu)?;
    let offsets = (sigmoid(offsets)? - 0.5)?;
    centres + offsets.broadcast_mul(&pixel)?
}

/// `[P, n]` to `[P, 1]`: Euclidean norms, with a finite gradient at zero.
fn norm(x: &Tensor) -> Result<Tensor> {
    (x.sqr()?.sum_keepdim(1)? + 1e-30)?.sqrt()
}

/// For row vectors: x·matrix3(R) is R·x.
fn matrix3(r: DMat3) -> Result<Tensor> {
    // Column-major storage of R is row-major storage of Rᵀ.
    Tensor::from_vec(r.to_cols_array().map(|v| v as f32).to_vec(), (3, 3), &Device::Cpu)
}

/// Camera-frame xyzw `[P, 4]` to world-frame wxyz, unit, w ≥ 0: quat(R) ⊗ q, which is
/// linear in q. A zero quaternion is no rotation.
fn world_quaternions(xyzw: &Tensor, rotation: DMat3) -> Result<Tensor> {
    let a = DQuat::from_mat3(&rotation);
    let column = |q: DQuat| {
        let p = a * q;
        [p.w, p.x, p.y, p.z].map(|v| v as f32)
    };
    // Row i: where the i-th of x, y, z, w goes.
    let map = [
        column(DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)),
        column(DQuat::from_xyzw(0.0, 1.0, 0.0, 0.0)),
        column(DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0)),
        column(DQuat::from_xyzw(0.0, 0.0, 0.0, 1.0)),
    ];
    let squared = xyzw.detach().sqr()?.sum_keepdim(1)?;
    let zero = squared.lt(1e-12)?.to_dtype(DType::F32)?;
    let identity = Tensor::new(&[[0f32, 0.0, 0.0, 1.0]], &Device::Cpu)?;
    let q = (xyzw + zero.matmul(&identity)?)?.matmul(&Tensor::new(&map, &Device::Cpu)?)?;
    let negative = q.detach().narrow(1, 0, 1)?.lt(0.0)?.to_dtype(DType::F32)?;
    let sign = negative.affine(-2.0, 1.0)?;
    q.broadcast_mul(&sign)?.broadcast_div(&norm(&q)?)
}

/// Transposed map from MVSplat's basis to the standard one, `[D, D]`; degree 4, which
/// MVSplat never evaluates, maps to zero.
fn mvsplat_map_transposed(d: usize) -> Result<Tensor> {
    let m = standard_from_mvsplat();
    let used = d.min(16);
    let mut t = vec![0f32; d * d];
    for i in 0..used {
        for j in 0..used {
            t[j * d + i] = m[i * 16 + j] as f32;
        }
    }
    Tensor::from_vec(t, (d, d), &Device::Cpu)
}

/// α = ½(1 − (1 − p)^e + p^{1/e})/G, e = 2^x; x = 0 is α = p/G.
fn opacities(p: &Tensor, exponent: f64) -> Result<Tensor> {
    let g = p.dim(3)? as f64;
    if exponent == 0.0 {
        return p / g;
    }
    let e = exponent.exp2();
    let low = p.affine(-1.0, 1.0)?.powf(e)?;
    ((p.powf(1.0 / e)? - low)? + 1.0)? * (0.5 / g)
}

impl Primaries {
    /// World covariances R·diag(σ²)·Rᵀ, `[B, N, 3, 3]`.
    ///
    /// # Errors
    /// Whatever candle says.
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
