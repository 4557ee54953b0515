//! Random scenes, plain and nasty, for the rasterizer's gradients, and their loss by the
//! naive oracle.

use crate::oracle::{self, Shape, Splat};
use glam::{EulerRot, Mat4, Quat, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Geometry, Gradients, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{
    Convention, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, ShBasis,
    ShDirection, sh_coefficients,
};

/// xorshift64*.
pub struct Random(pub u64);

impl Random {
    /// Uniform in [from, to).
    pub fn range(&mut self, from: f32, to: f32) -> f32 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let unit = (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 40) as f32 / (1u64 << 24) as f32;
        from + (to - from) * unit
    }

    pub fn array<const N: usize>(&mut self, from: f32, to: f32) -> [f32; N] {
        std::array::from_fn(|_| self.range(from, to))
    }

    pub fn many(&mut self, count: usize, from: f32, to: f32) -> Vec<f32> {
        (0..count).map(|_| self.range(from, to)).collect()
    }
}

/// Splats of a random scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    Plain,
    /// Opacities to 1 on splats that cover much: early stops, capped alphas.
    Saturated,
    /// Axes 1 : 200.
    Needles,
    /// A third behind the camera, a third just past the near plane.
    Behind,
    /// Centres far outside the picture, where the Jacobian's slope is clamped.
    OffScreen,
    /// σ = 0 in one, two or three axes.
    Flat,
}

pub const KINDS: [Kind; 6] =
    [Kind::Plain, Kind::Saturated, Kind::Needles, Kind::Behind, Kind::OffScreen, Kind::Flat];
pub const CHILDREN: usize = 4;
pub const SIZE: (usize, usize) = (33, 22);

#[derive(Clone)]
pub struct Scene {
    pub rows: Vec<f32>,
    /// Instead of the rows' quaternions and σ, where not empty.
    pub cov6: Vec<f32>,
    pub sh: Vec<f32>,
    pub gain: Vec<f32>,
    pub degree: usize,
    pub camera: Camera,
}

impl Scene {
    pub fn new(kind: Kind, seed: u64, parents: usize, degree: usize, gain_channels: usize) -> Self {
        let mut r = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let (width, height) = SIZE;
        let (w, h) = (width as f32, height as f32);
        let k = Intrinsics { fx: w, fy: 1.1 * w, cx: w / 2.0, cy: h / 2.0, width, height };
        let [a, b, c] = r.array(-3.0, 3.0);
        let turn = Quat::from_euler(EulerRot::XYZ, a, b, c);
        let pose = Mat4::from_rotation_translation(turn, Vec3::new(b, c, a));
        let camera = Camera::new(k, pose).unwrap();
        let (mut rows, mut sh, mut gain) = (Vec::new(), Vec::new(), Vec::new());
        for p in 0..parents {
            let z = r.range(1.5, 6.0);
            let centre = Vec3::new(r.range(-0.4, 0.4) * z, r.range(-0.3, 0.3) * z, z);
            let px = z / w;
            for child in 0..CHILDREN {
                let mut at = centre + Vec3::from_array(r.array(-3.0, 3.0)) * px;
                let mut scale = r.array(0.5, 4.0).map(|s: f32| s * px);
                let mut opacity = r.range(0.05, 0.95);
                match (kind, (p + child) % 3) {
                    (Kind::Saturated, i) => {
                        scale = r.array(2.0, 12.0).map(|s: f32| s * px);
                        opacity = [0.9, 0.96, 1.0][i];
                    }
                    (Kind::Needles, i) => {
                        scale = [0.1 * px; 3];
                        scale[i] = 20.0 * px;
                    }
                    (Kind::Behind, 0) => at.z = -at.z,
                    (Kind::Behind, 1) => {
                        at = Vec3::new(0.01, -0.02, 0.25 + 0.01 * (4 * p + child) as f32);
                        scale = r.array(0.01, 0.02);
                    }
                    (Kind::OffScreen, 0) => {
                        at.x = [-1.2, 1.3][child % 2] * z;
                        scale = r.array(0.2, 0.6).map(|s: f32| s * z);
                    }
                    (Kind::OffScreen, 1) => {
                        at.y = [-1.1, 0.9][child % 2] * z;
                        scale = r.array(0.2, 0.6).map(|s: f32| s * z);
                    }
                    (Kind::Flat, i) => scale[..=i].fill(0.0),
                    _ => {}
                }
                rows.extend(camera.world_from_camera().transform_point3(at).to_array());
                rows.extend(r.array::<4>(-1.0, 1.0));
                rows.extend(scale);
                rows.push(opacity);
                match gain_channels {
                    1 => gain.push(r.range(-0.5, 1.5)),
                    4 => gain.extend([r.range(0.5, 1.5), r.range(-0.2, 0.2), 0.1, -0.3]),
                    _ => {}
                }
            }
            let set = 3 * sh_coefficients(degree);
            sh.extend((0..set).map(|i| r.range(-1.0, 1.0) * if i < 3 { 1.0 } else { 0.4 }));
        }
        Self { rows, cov6: Vec::new(), sh, gain, degree, camera }
    }

    /// One of six scenes of `kind` for each `seed`, with 12 parents, and options: every
    /// option that projection knows, in some scene.
    pub fn variant(kind: Kind, seed: u64, variant: usize) -> (Self, RasterOptions) {
        let (degree, lanes) = (variant % 5, [0, 1, 4][variant % 3]);
        let scene = Self::new(kind, 10 * seed + variant as u64, 12, degree, lanes);
        let scene = if variant == 4 { scene.with_covariances() } else { scene };
        let convention = if variant % 2 == 1 { Convention::Mvsplat } else { Convention::Standard };
        let options = RasterOptions {
            antialiased: variant == 2,
            sh_direction: [ShDirection::Child, ShDirection::Parent][variant / 3],
            sh_basis: [ShBasis::Standard, ShBasis::Mvsplat][variant % 2],
            near: if convention == Convention::Mvsplat { 1.0 } else { 0.2 },
            background: [0.2, -0.1, 0.7],
            ..RasterOptions::new(convention)
        };
        (scene, options)
    }

    pub fn len(&self) -> usize {
        self.rows.len() / SPLAT_STRIDE
    }

    /// The same splats by covariance.
    pub fn with_covariances(mut self) -> Self {
        self.cov6 = (0..self.len())
            .flat_map(|i| {
                let row = &self.rows[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE];
                let [w, x, y, z]: [f32; 4] = row[QUAT_OFFSET..SCALE_OFFSET].try_into().unwrap();
                let r = glam::Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
                let s = Vec3::from_slice(&row[SCALE_OFFSET..]);
                let c = r * glam::Mat3::from_diagonal(s * s) * r.transpose();
                let e = |i: usize, j: usize| c.col(j)[i];
                [e(0, 0), e(0, 1), e(0, 2), e(1, 1), e(1, 2), e(2, 2)]
            })
            .collect();
        self
    }

    /// Runs `f` on the kernels' view of the scene.
    pub fn with_slices<R>(&self, f: impl FnOnce(SplatSlices) -> R) -> R {
        let pick = |from: usize, n: usize| -> Vec<f32> {
            self.rows.chunks(SPLAT_STRIDE).flat_map(|r| r[from..from + n].to_vec()).collect()
        };
        let (means, opacities) = (pick(0, 3), pick(OPACITY_OFFSET, 1));
        let geometry = if self.cov6.is_empty() {
            Geometry::Packed(&self.rows)
        } else {
            Geometry::Cov6 { means: &means, cov6: &self.cov6, opacities: &opacities }
        };
        f(SplatSlices { geometry, sh: &self.sh, gain: &self.gain, sh_degree: self.degree })
    }

    pub fn gradients(&self, o: &RasterOptions, v: &[f32]) -> Gradients {
        let mut out = Gradients::default();
        self.with_slices(|s| Rasterizer::new().backward(&s, &self.camera, o, v, &mut out));
        out
    }

    pub fn for_oracle(&self) -> Vec<Splat> {
        let set = 3 * sh_coefficients(self.degree);
        let lanes = self.gain.len() / self.len();
        let row = |i: usize| &self.rows[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE];
        let one = |i: usize| {
            let family = i / CHILDREN * CHILDREN..(i / CHILDREN + 1) * CHILDREN;
            let parent_mean = std::array::from_fn(|c| {
                family.clone().map(|j| f64::from(row(j)[c])).sum::<f64>() / CHILDREN as f64
            });
            let r = row(i);
            let shape = if self.cov6.is_empty() {
                let scale = r[SCALE_OFFSET..OPACITY_OFFSET].try_into().unwrap();
                Shape::Quat(r[QUAT_OFFSET..SCALE_OFFSET].try_into().unwrap(), scale)
            } else {
                Shape::Cov6(self.cov6[6 * i..6 * i + 6].try_into().unwrap())
            };
            let g = |c: usize| if c < lanes { self.gain[lanes * i + c] } else { 0.0 };
            Splat {
                mean: r[..3].try_into().unwrap(),
                shape,
                opacity: r[OPACITY_OFFSET],
                sh: self.sh[i / CHILDREN * set..][..set]
                    .chunks_exact(3)
                    .map(|c| c.try_into().unwrap())
                    .collect(),
                gain: if lanes > 0 { g(0) } else { 1.0 },
                residual: [g(1), g(2), g(3)],
                parent_mean,
            }
        };
        (0..self.len()).map(one).collect()
    }

    /// Σ planes·v by the oracle.
    pub fn loss(&self, o: &RasterOptions, v: &[f32]) -> f64 {
        let p = oracle::render(&self.for_oracle(), &self.camera, o);
        let n = p.alpha.len();
        let v = |i: usize| f64::from(v[i]);
        (0..n)
            .map(|i| {
                let rgb: f64 = (0..3).map(|c| p.rgb[3 * i + c] * v(c * n + i)).sum();
                rgb + p.alpha[i] * v(3 * n + i) + p.depth_sum[i] * v(4 * n + i)
            })
            .sum()
    }

    /// Random gradients of the five planes, 0 on the oracle's boundary pixels.
    pub fn upstream(&self, o: &RasterOptions, seed: u64) -> Vec<f32> {
        let mut r = Random(seed | 1);
        let p = oracle::render(&self.for_oracle(), &self.camera, o);
        let n = p.alpha.len();
        let mut v: Vec<f32> = (0..5 * n).map(|_| r.range(-1.0, 1.0)).collect();
        for i in (0..n).filter(|&i| p.boundary[i]) {
            (0..5).for_each(|c| v[c * n + i] = 0.0);
        }
        v
    }
}
