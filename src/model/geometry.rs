//! Cameras as tensors: frames of the context views, projection of parents into all
//! of them, and quaternions. Scalar twin and conventions: [`crate::camera`].
//!
//! Points are rows `[n, 3]`, so that world to camera is (p − o)·R with R the
//! rotation of `world_from_camera`.

use crate::abi::VISIBLE_Z_MIN;
use crate::camera::Camera;
use crate::config::MaskMode;
use crate::ops::attributes;
use crate::ops::columns::columns;
use crate::ops::linear::linear;
use candle_core::{D, DType, Device, Result, Tensor, bail};

/// Picture position given to points behind a camera: outside by more than any
/// learned offset brings back.
const BEHIND: f64 = -1e3;
/// Largest sampling position under [`MaskMode::PgClamp`] (PixelGaussian).
const CLAMP_MAX: f64 = 0.9999;

/// A run of parents that share their source view.
#[derive(Clone, Debug)]
pub struct ParentChunk {
    /// Index of the first in the scene.
    pub first: usize,
    /// Index of the view that all of them come from.
    pub source: usize,
    /// `[n, 3]`, world.
    pub means: Tensor,
    /// `[n, 4]` wxyz, world.
    pub quats_wxyz: Tensor,
    /// `[n, 3]`: σ, world units.
    pub scales: Tensor,
    /// `[n, 1]`.
    pub opacities: Tensor,
    /// `[n, 3·D]`, colour-major, in the frame that the embedding reads.
    pub sh: Tensor,
}

impl ParentChunk {
    /// `[n, 11]`: packed, lanes in [`crate::abi`].
    pub fn rows(&self) -> Result<Tensor> {
        let most = columns(&self.means, &self.quats_wxyz, Some(&self.scales))?;
        columns(&most, &self.opacities, None)
    }
}

/// One context view.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its camera, pixels of the input picture.
    pub camera: Camera,
    /// `[3, 3]`: rows of R, world from camera.
    pub rotation: Tensor,
    /// `[1, 3]`: the eye, world.
    pub position: Tensor,
    /// `[4, 4]`: q·turn = conj(q_R) ⊗ q for rows q wxyz.
    pub turn: Tensor,
}

/// x·m of `x` `[n, k]` and `m` `[k, k]`. f32 goes round candle's product, which asks the
/// system for the number of processors each time.
fn times(x: &Tensor, m: &Tensor) -> Result<Tensor> {
    if x.dtype() != DType::F32 {
        return x.matmul(m);
    }
    linear(x, &m.t()?, &Tensor::zeros(m.dim(1)?, DType::F32, m.device())?)
}

impl Frame {
    /// Tensors of `camera`.
    pub fn new(camera: Camera, dtype: DType, device: &Device) -> Result<Self> {
        let r = camera.rotation();
        let rows: Vec<f32> = (0..3).flat_map(|i| r.row(i).to_array()).collect();
        let q = glam::Quat::from_mat3(&r).normalize();
        let turn: Vec<f32> = left_product([q.w, -q.x, -q.y, -q.z]).to_vec();
        let tensor = |v: Vec<f32>, shape: (usize, usize)| {
            Tensor::from_vec(v, shape, device)?.to_dtype(dtype)
        };
        Ok(Self {
            camera,
            rotation: tensor(rows, (3, 3))?,
            position: tensor(camera.position().to_array().to_vec(), (1, 3))?,
            turn: tensor(turn, (4, 4))?.t()?.contiguous()?,
        })
    }

    /// The same in numbers.
    pub fn numbers(&self) -> attributes::Frame {
        let r = self.camera.rotation();
        let q = glam::Quat::from_mat3(&r).normalize();
        let turn = left_product([q.w, -q.x, -q.y, -q.z]).map(f64::from);
        attributes::Frame {
            rotation: std::array::from_fn(|i| r.row(i).as_dvec3().to_array()),
            position: self.camera.position().as_dvec3().to_array(),
            turn: std::array::from_fn(|i| std::array::from_fn(|j| turn[4 * i + j])),
        }
    }

    /// World points `[n, 3]` to camera coordinates.
    pub fn to_camera(&self, means: &Tensor) -> Result<Tensor> {
        times(&means.broadcast_sub(&self.position)?, &self.rotation)
    }

    /// World quaternions `[n, 4]` to this camera's frame.
    pub fn quat_to_camera(&self, quats_wxyz: &Tensor) -> Result<Tensor> {
        times(quats_wxyz, &self.turn)
    }
}

/// The context views of one scene.
#[derive(Clone, Debug)]
pub struct Frames(
    /// In view order.
    pub Vec<Frame>,
);

impl Frames {
    /// Tensors of all `cameras`.
    pub fn new(cameras: &[Camera], dtype: DType, device: &Device) -> Result<Self> {
        let frames = cameras.iter().map(|c| Frame::new(*c, dtype, device));
        Ok(Self(frames.collect::<Result<_>>()?))
    }

    /// Picture positions `[n, V, m, 2]` in units of each picture's size, and camera z
    /// `[n, V, m]`, of world points `[n, m, 3]`. Under [`MaskMode::Renorm`] points
    /// behind a camera lie far outside; under [`MaskMode::PgClamp`] positions are
    /// clamped to [0, 0.9999].
    pub fn project(&self, points: &Tensor, mask: MaskMode) -> Result<(Tensor, Tensor)> {
        let (n, m, _) = points.dims3()?;
        let flat = points.reshape((n * m, 3))?;
        let mut positions = Vec::with_capacity(self.0.len());
        let mut depths = Vec::with_capacity(self.0.len());
        for frame in &self.0 {
            let p = frame.to_camera(&flat)?;
            let z = p.narrow(1, 2, 1)?;
            let safe = z.maximum(VISIBLE_Z_MIN)?;
            let [fx, fy, cx, cy] = frame.camera.intrinsics.normalised().map(f64::from);
            let u = (p.narrow(1, 0, 1)?.div(&safe)?.affine(fx, cx))?;
            let v = (p.narrow(1, 1, 1)?.div(&safe)?.affine(fy, cy))?;
            let uv = Tensor::cat(&[&u, &v], 1)?;
            let uv = match mask {
                MaskMode::Renorm => {
                    let front = z.gt(VISIBLE_Z_MIN)?.broadcast_as(uv.shape())?;
                    front.where_cond(&uv, &uv.zeros_like()?.affine(1.0, BEHIND)?)?
                }
                MaskMode::PgClamp => uv.clamp(0.0, CLAMP_MAX)?,
            };
            positions.push(uv.reshape((n, m, 2))?);
            depths.push(z.reshape((n, m))?);
        }
        Ok((Tensor::stack(&positions, 1)?, Tensor::stack(&depths, 1)?))
    }

    /// Depth maps `[V, H, W]` made of the parents' own camera z in their source
    /// views, `means` `[V·H·W·G, 3]`: the nearest of the G at each pixel.
    pub fn depth_maps(&self, means: &Tensor, (height, width): (usize, usize)) -> Result<Tensor> {
        let per_view = means.dim(0)? / self.0.len().max(1);
        if height * width == 0 || !per_view.is_multiple_of(height * width) {
            bail!(
                "depth maps: expected a multiple of {height}x{width} parents per view, got {per_view}"
            );
        }
        let maps = self.0.iter().enumerate().map(|(v, frame)| {
            let z = frame.to_camera(&means.narrow(0, v * per_view, per_view)?)?.narrow(1, 2, 1)?;
            z.reshape((height, width, per_view / (height * width)))?.min(D::Minus1)
        });
        Tensor::stack(&maps.collect::<Result<Vec<_>>>()?, 0)
    }
}

/// Rows of L(a) with a ⊗ b = L(a)·b, quaternions wxyz.
fn left_product([w, x, y, z]: [f32; 4]) -> [f32; 16] {
    [
        w, -x, -y, -z, //
        x, w, -z, y, //
        y, z, w, -x, //
        z, -y, x, w,
    ]
}

/// The same rotations with w ≥ 0: `[n, 4]` wxyz.
pub fn canonical(quats_wxyz: &Tensor) -> Result<Tensor> {
    let w = quats_wxyz.narrow(1, 0, 1)?;
    let sign = w.ge(0.0)?.to_dtype(w.dtype())?.affine(2.0, -1.0)?;
    quats_wxyz.broadcast_mul(&sign)
}

/// Offsets `[n, m, 3]` turned by the unit quaternions `[n, 4]` wxyz:
/// v + 2·q⃗×(q⃗×v + w·v).
pub fn rotate(quats_wxyz: &Tensor, offsets: &Tensor) -> Result<Tensor> {
    let q = |i: usize| quats_wxyz.narrow(1, i, 1)?.unsqueeze(2);
    let v = |i: usize| offsets.narrow(2, i, 1);
    let (w, q, v) = (q(0)?, [q(1)?, q(2)?, q(3)?], [v(0)?, v(1)?, v(2)?]);
    let cross = |b: &[Tensor; 3]| -> Result<[Tensor; 3]> {
        let term = |i: usize, j: usize| b[j].broadcast_mul(&q[i])?.sub(&b[i].broadcast_mul(&q[j])?);
        Ok([term(1, 2)?, term(2, 0)?, term(0, 1)?])
    };
    let mut inner = cross(&v)?;
    for (c, v) in inner.iter_mut().zip(&v) {
        *c = c.add(&v.broadcast_mul(&w)?)?;
    }
    let outer = cross(&inner)?;
    let turned = v.iter().zip(&outer).map(|(v, o)| v.add(&o.affine(2.0, 0.0)?));
    Tensor::cat(&turned.collect::<Result<Vec<_>>>()?, 2)
}
