//! Cameras as tensors: context views, projection of parents into all of them, and
//! quaternions. Scalar version and conventions: [`subsplat_kernels::camera`].
//!
//! Points are rows `[n, 3]`: world to camera is (p − o)·R, with R the rotation of
//! `world_from_camera`.

use crate::network::config::MaskMode;
use crate::network::ops::{Array, attributes};
use candle_core::{DType, Device, Result, Tensor, bail};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::VISIBLE_Z_MIN;

/// Image position of points behind a camera: farther outside than any learned offset
/// reaches.
const BEHIND: f64 = -1e3;
/// Largest sampling position under [`MaskMode::PgClamp`] (PixelGaussian).
const CLAMP_MAX: f64 = 0.9999;

/// Consecutive parents of one source view.
#[derive(Clone, Debug)]
pub struct ParentChunk<A = Tensor> {
    /// Index of the first parent in the scene.
    pub first: usize,
    /// Index of the source view.
    pub source: usize,
    /// `[n, 3]`, world.
    pub means: A,
    /// `[n, 4]` wxyz, world.
    pub quats_wxyz: A,
    /// `[n, 3]`: σ, world units.
    pub scales: A,
    /// `[n, 1]`.
    pub opacities: A,
    /// `[n, 3·D]`, colour-major, in the frame of [`crate::network::config::Embed::sh`].
    pub sh: A,
}

impl<A: Array> ParentChunk<A> {
    /// Returns the packed rows `[n, 11]`; columns as in [`subsplat_kernels::layout`].
    ///
    /// # Errors
    /// Shapes do not fit one another.
    pub fn rows(&self) -> Result<A> {
        let all_but_opacity = self.means.cat_columns(&self.quats_wxyz, Some(&self.scales))?;
        all_but_opacity.cat_columns(&self.opacities, None)
    }
}

/// One context view.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its camera; intrinsics in pixels of the input image.
    pub camera: Camera,
    /// `[3, 3]`: rows of R, world from camera.
    pub rotation: Tensor,
    /// `[1, 3]`: the camera's centre, world.
    pub position: Tensor,
    /// `[4, 4]`: q·M = conj(q_R) ⊗ q for rows q wxyz.
    pub quat_from_world: Tensor,
}

/// Computes x·m of `x` `[n, k]` and `m` `[k, k]`.
fn matmul<A: Array>(x: &A, m: &Tensor) -> Result<A> {
    x.linear(&x.upload(&m.t()?.contiguous()?)?, None, None)
}

impl Frame {
    /// Returns the tensors of `camera`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(camera: Camera, dtype: DType, device: &Device) -> Result<Self> {
        let r = camera.rotation();
        let rows: Vec<f32> = (0..3).flat_map(|i| r.row(i).to_array()).collect();
        let q = glam::Quat::from_mat3(&r).normalize();
        let quat_from_world = left_product([q.w, -q.x, -q.y, -q.z]).to_vec();
        let tensor = |v: Vec<f32>, shape: (usize, usize)| {
            Tensor::from_vec(v, shape, device)?.to_dtype(dtype)
        };
        Ok(Self {
            camera,
            rotation: tensor(rows, (3, 3))?,
            position: tensor(camera.position().to_array().to_vec(), (1, 3))?,
            quat_from_world: tensor(quat_from_world, (4, 4))?.t()?.contiguous()?,
        })
    }

    /// Returns the same numbers for the fused op of the attributes.
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

    /// Maps world points `[n, 3]` to camera coordinates.
    ///
    /// # Errors
    /// Another shape.
    pub fn to_camera<A: Array>(&self, means: &A) -> Result<A> {
        matmul(&means.sub(&means.upload(&self.position)?)?, &self.rotation)
    }

    /// Maps world quaternions `[n, 4]` wxyz to this camera's frame.
    ///
    /// # Errors
    /// Another shape.
    pub fn quat_to_camera(&self, quats_wxyz: &Tensor) -> Result<Tensor> {
        matmul(quats_wxyz, &self.quat_from_world)
    }
}

/// The context views of one scene.
#[derive(Clone, Debug)]
pub struct Frames(
    /// In view order.
    pub Vec<Frame>,
);

impl Frames {
    /// Returns the tensors of all `cameras`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(cameras: &[Camera], dtype: DType, device: &Device) -> Result<Self> {
        let frames = cameras.iter().map(|c| Frame::new(*c, dtype, device));
        Ok(Self(frames.collect::<Result<_>>()?))
    }

    /// Projects world points `[n, m, 3]` into every view. Returns image positions
    /// `[n, V, m, 2]`, in units of each image's size, and camera z `[n, V, m]`. Under
    /// [`MaskMode::Renorm`] points behind a camera lie far outside; under
    /// [`MaskMode::PgClamp`] positions are clamped to [0, 0.9999].
    ///
    /// # Errors
    /// Another shape.
    pub fn project<A: Array>(&self, points: &A, mask: MaskMode) -> Result<(A, A)> {
        let [n, m, _] = points.sizes()?;
        let flat = points.reshape((n * m, 3))?;
        let mut positions = Vec::with_capacity(self.0.len());
        let mut depths = Vec::with_capacity(self.0.len());
        for frame in &self.0 {
            let p = frame.to_camera(&flat)?;
            let z = p.narrow(1, 2, 1)?;
            let safe = z.clamp(VISIBLE_Z_MIN, f64::INFINITY)?;
            let [fx, fy, cx, cy] = frame.camera.intrinsics().normalised().map(f64::from);
            let u = p.narrow(1, 0, 1)?.div(&safe)?.affine(fx, cx)?;
            let v = p.narrow(1, 1, 1)?.div(&safe)?.affine(fy, cy)?;
            let uv = A::cat(&[&u, &v], 1)?;
            let uv = match mask {
                MaskMode::Renorm => uv.where_gt(&z, VISIBLE_Z_MIN, BEHIND)?,
                MaskMode::PgClamp => uv.clamp(0.0, CLAMP_MAX)?,
            };
            positions.push(uv.reshape((n, 1, m, 2))?);
            depths.push(z.reshape((n, 1, m))?);
        }
        let joined = |parts: &[A]| A::cat(&parts.iter().collect::<Vec<_>>(), 1);
        Ok((joined(&positions)?, joined(&depths)?))
    }

    /// Returns depth maps `[V, H, W]`: at each pixel the smallest camera z of its G
    /// parents in their source view. `means`: `[V·H·W·G, 3]`.
    ///
    /// # Errors
    /// The number of parents per view is not a multiple of H·W.
    pub fn depth_maps<A: Array>(&self, means: &A, (height, width): (usize, usize)) -> Result<A> {
        let [all, _] = means.sizes()?;
        let per_view = all / self.0.len().max(1);
        if height * width == 0 || !per_view.is_multiple_of(height * width) {
            bail!(
                "depth maps: expected a multiple of {height}x{width} parents per view, got {per_view}"
            );
        }
        let maps = self.0.iter().enumerate().map(|(v, frame)| {
            let z = frame.to_camera(&means.narrow(0, v * per_view, per_view)?)?.narrow(1, 2, 1)?;
            // The minimum.
            let z = z.reshape((height, width, per_view / (height * width)))?.affine(-1.0, 0.0)?;
            z.max_keepdim(2)?.affine(-1.0, 0.0)?.reshape((1, height, width))
        });
        A::cat(&maps.collect::<Result<Vec<_>>>()?.iter().collect::<Vec<_>>(), 0)
    }
}

/// Row-major L(a) with a ⊗ b = L(a)·b, quaternions wxyz.
fn left_product([w, x, y, z]: [f32; 4]) -> [f32; 16] {
    [
        w, -x, -y, -z, //
        x, w, -z, y, //
        y, z, w, -x, //
        z, -y, x, w,
    ]
}

/// Rotates offsets `[n, m, 3]` by unit quaternions `[n, 4]` wxyz:
/// v + 2·q⃗×(q⃗×v + w·v).
///
/// # Errors
/// Shapes do not fit one another.
pub fn rotate(quats_wxyz: &Tensor, offsets: &Tensor) -> Result<Tensor> {
    let q = |i: usize| quats_wxyz.narrow(1, i, 1)?.unsqueeze(2);
    let v = |i: usize| offsets.narrow(2, i, 1);
    let w = q(0)?;
    let q = [q(1)?, q(2)?, q(3)?];
    let v = [v(0)?, v(1)?, v(2)?];
    let cross = |b: &[Tensor; 3]| -> Result<[Tensor; 3]> {
        let term = |i: usize, j: usize| b[j].broadcast_mul(&q[i])?.sub(&b[i].broadcast_mul(&q[j])?);
        Ok([term(1, 2)?, term(2, 0)?, term(0, 1)?])
    };
    let mut inner = cross(&v)?;
    for (c, v) in inner.iter_mut().zip(&v) {
        *c = c.add(&v.broadcast_mul(&w)?)?;
    }
    let outer = cross(&inner)?;
    let rotated = v.iter().zip(&outer).map(|(v, o)| v.add(&o.affine(2.0, 0.0)?));
    Tensor::cat(&rotated.collect::<Result<Vec<_>>>()?, 2)
}
