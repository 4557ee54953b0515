//! MVSplat's Gaussian adapter in tensor operations: the reference for the fused op
//! `subsplat::network::ops::adapter`, with candle's gradients.

use candle_core::{DType, Device, Result, Tensor, bail};
use glam::{DMat3, DQuat};
use subsplat::network::config::{Primaries as Settings, ShFrame};
use subsplat::network::model::layers::sigmoid;
use subsplat::network::model::primaries::sh_mask;
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{ShBasis, sh_coefficients};
use subsplat_kernels::sh::{Rotation, RotationBasis, standard_from_mvsplat};

/// Scales are in tenths of a pixel's extent at the Gaussian's depth, summed over both
/// axes: a fifth of a square pixel (MVSplat).
const PIXEL_SHARE: f64 = 0.1;
/// ε of the quaternion's normalisation (MVSplat).
const QUAT_EPS: f64 = 1e-8;

/// One view's share of the primaries, G Gaussians for each of P pixels.
struct ViewPart {
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    sh: Tensor,
    sh_camera: Tensor,
}

/// All primaries of all scenes, in world frame.
///
/// # Errors
/// Shapes of `out` that do not fit `views` or `settings`.
pub fn primaries(out: &BackboneOutput, views: &Views, settings: &Settings) -> Result<Primaries> {
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

fn view_part(raw: &Tensor, depths: &Tensor, camera: &Camera, s: &Settings) -> Result<ViewPart> {
    let (pixels, g) = depths.dims2()?;
    let k = camera.intrinsics();
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
