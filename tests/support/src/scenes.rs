//! Random scenes for the trunk's tests: cameras, views, primaries, feature maps.

use candle_core::{DType, Device, Result, Tensor};
use glam::{EulerRot, Mat4, Quat, Vec3};
use subsplat::network::config::FeatureLevel;
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::{ShBasis, random};

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    pub fn bits(&mut self) -> u64 {
        random::next(&mut self.0)
    }

    /// Uniform in [low, high).
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * ((self.bits() >> 11) as f64 / (1u64 << 53) as f64)
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let r = (-2.0 * (1.0 - self.uniform(0.0, 1.0)).ln()).sqrt();
        r * (std::f64::consts::TAU * self.uniform(0.0, 1.0)).cos()
    }

    pub fn normals(&mut self, n: usize, scale: f64) -> Vec<f64> {
        (0..n).map(|_| scale * self.normal()).collect()
    }

    /// Normal numbers of a given shape.
    pub fn tensor(&mut self, shape: &[usize], scale: f64, dtype: DType) -> Tensor {
        let data = self.normals(shape.iter().product(), scale);
        Tensor::from_vec(data, shape, &Device::Cpu).unwrap().to_dtype(dtype).unwrap()
    }
}

/// Cameras around the origin of view 0, side by side with small turns, looking along +z.
pub fn cameras(views: usize, width: usize, height: usize) -> Vec<Camera> {
    let each = |v: usize| {
        let k = Intrinsics {
            fx: 0.9 * width as f32,
            fy: 0.95 * width as f32,
            cx: 0.51 * width as f32,
            cy: 0.48 * height as f32,
            width,
            height,
        };
        let turn = v as f32 - 0.5;
        let q = Quat::from_euler(EulerRot::XYZ, 0.05 * turn, -0.12 * turn, 0.08 * turn);
        let at = Vec3::new(0.3 * turn, 0.05 * turn, 0.1 * v as f32);
        Camera::new(k, Mat4::from_rotation_translation(q, at)).unwrap()
    };
    (0..views).map(each).collect()
}

/// A rigid motion of the world.
pub fn motion() -> Mat4 {
    Mat4::from_rotation_translation(
        Quat::from_euler(EulerRot::YXZ, 1.9, -0.7, 2.6),
        Vec3::new(3.0, -2.0, 5.0),
    )
}

pub fn views(cameras: &[Camera]) -> Views {
    let k = cameras[0].intrinsics();
    let images =
        Tensor::zeros((1, cameras.len(), 3, k.height, k.width), DType::F32, &Device::Cpu).unwrap();
    Views::new(images, vec![cameras.to_vec()], vec![vec![NearFar::RE10K; cameras.len()]]).unwrap()
}

/// Primaries in camera frame of their source views, as a backbone gives them: one
/// per pixel, MVSplat-like sizes; independent of where the cameras are.
pub struct LocalPrimaries {
    pub rays: Vec<Vec3>,
    pub depths: Vec<f32>,
    pub quats: Vec<Quat>,
    pub scales: Vec<[f32; 3]>,
    pub opacities: Vec<f32>,
    pub sh: Vec<f32>,
    pub per_view: usize,
    pub coefficients: usize,
}

impl LocalPrimaries {
    pub fn random(cameras: &[Camera], coefficients: usize, r: &mut Random) -> Self {
        let k = cameras[0].intrinsics();
        let per_view = k.width * k.height;
        let mut out = Self {
            rays: Vec::new(),
            depths: Vec::new(),
            quats: Vec::new(),
            scales: Vec::new(),
            opacities: Vec::new(),
            sh: Vec::new(),
            per_view,
            coefficients,
        };
        for camera in cameras {
            for i in 0..per_view {
                let px = glam::Vec2::new(
                    (i % k.width) as f32 + 0.5 + r.uniform(-0.4, 0.4) as f32,
                    (i / k.width) as f32 + 0.5 + r.uniform(-0.4, 0.4) as f32,
                );
                let z = r.uniform(2.0, 5.0) as f32;
                out.rays.push(camera.intrinsics().unproject(px));
                out.depths.push(z);
                let q = Quat::from_xyzw(
                    r.normal() as f32,
                    r.normal() as f32,
                    r.normal() as f32,
                    r.normal() as f32,
                );
                out.quats.push(q.normalize());
                let px = z / camera.intrinsics().fx;
                out.scales.push(std::array::from_fn(|_| r.uniform(0.2, 2.5) as f32 * px));
                out.opacities.push(r.uniform(0.02, 0.98) as f32);
                out.sh.extend(r.normals(3 * coefficients, 0.3).iter().map(|&v| v as f32));
            }
        }
        out
    }

    /// In world frame of `cameras`. `sh` world = camera frame (rotation is the
    /// backbone's business).
    pub fn place(&self, cameras: &[Camera]) -> Primaries {
        let n = self.rays.len();
        let (mut means, mut quats) = (Vec::new(), Vec::new());
        for i in 0..n {
            let camera = &cameras[i / self.per_view];
            let r = camera.rotation();
            means.extend((camera.position() + r * (self.rays[i] * self.depths[i])).to_array());
            let mut q = (Quat::from_mat3(&r) * self.quats[i]).normalize();
            if q.w < 0.0 {
                q = -q;
            }
            quats.extend([q.w, q.x, q.y, q.z]);
        }
        let t = |v: Vec<f32>, shape: &[usize]| Tensor::from_vec(v, shape, &Device::Cpu).unwrap();
        let sh = t(self.sh.clone(), &[1, n, 3, self.coefficients]);
        Primaries {
            means: t(means, &[1, n, 3]),
            quats_wxyz: t(quats, &[1, n, 4]),
            scales: t(self.scales.iter().flatten().copied().collect(), &[1, n, 3]),
            opacities: t(self.opacities.clone(), &[1, n]),
            sh: sh.clone(),
            sh_camera: sh,
            sh_basis: ShBasis::Standard,
            per_view: self.per_view,
        }
    }
}

/// Every level of a backbone of `width` × `height` pictures, with narrow channels.
pub fn backbone(views: usize, width: usize, height: usize, r: &mut Random) -> BackboneOutput {
    let map = |r: &mut Random, level: FeatureLevel| {
        let (c, stride) = level_shape(level);
        let shape = [1, views, c, height / stride, width / stride];
        (level, r.tensor(&shape, 1.0, DType::F32))
    };
    let none = Tensor::zeros((1, views, 1, 1), DType::F32, &Device::Cpu).unwrap();
    BackboneOutput {
        raw: none.clone(),
        depths: none.clone(),
        densities: none,
        features: LEVELS.iter().map(|&l| map(r, l)).collect(),
    }
}

pub const LEVELS: [FeatureLevel; 6] = [
    FeatureLevel::Trans4,
    FeatureLevel::Trans8,
    FeatureLevel::Trans16,
    FeatureLevel::Cnn4,
    FeatureLevel::Cnn2,
    FeatureLevel::Refine1,
];

/// Channels and stride of the test backbone's levels (E = 32 in the tests).
pub fn level_shape(level: FeatureLevel) -> (usize, usize) {
    match level {
        FeatureLevel::Trans4 => (32, 4),
        FeatureLevel::Trans8 => (32, 8),
        FeatureLevel::Trans16 => (32, 16),
        FeatureLevel::Cnn4 => (32, 4),
        FeatureLevel::Cnn2 => (16, 2),
        FeatureLevel::Refine1 => (8, 1),
    }
}

pub fn channels() -> Vec<(FeatureLevel, usize)> {
    LEVELS.iter().map(|&l| (l, level_shape(l).0)).collect()
}

/// Largest absolute difference, and the largest absolute value of `b`.
pub fn difference(a: &Tensor, b: &Tensor) -> (f64, f64) {
    let host = |t: &Tensor| -> Result<Vec<f64>> {
        t.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()
    };
    assert_eq!(a.dims(), b.dims());
    let (a, b) = (host(a).unwrap(), host(b).unwrap());
    assert!(a.iter().chain(&b).all(|v| v.is_finite()), "not finite");
    let d = a.iter().zip(&b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs()));
    (d, b.iter().fold(0.0f64, |m, v| m.max(v.abs())))
}

#[track_caller]
pub fn assert_close(a: &Tensor, b: &Tensor, tolerance: f64) {
    let (d, scale) = difference(a, b);
    assert!(d <= tolerance * scale.max(1e-30), "difference {d:.3e} of {scale:.3e}");
}

/// Checks analytic gradients of Σ w·f(x) by central differences in f64 at `count`
/// random entries of every input. Relative to the largest gradient entry.
pub fn check_gradients(
    inputs: &[Tensor],
    f: &dyn Fn(&[Tensor]) -> Result<Tensor>,
    count: usize,
    tolerance: f64,
    r: &mut Random,
) {
    let vars: Vec<candle_core::Var> =
        inputs.iter().map(|t| candle_core::Var::from_tensor(t).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let y = f(&tensors).unwrap();
    let w = r.tensor(y.dims(), 1.0, DType::F64);
    let loss = |x: &[Tensor]| -> f64 {
        (f(x).unwrap() * &w).unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap()
    };
    let grads = (y * &w).unwrap().sum_all().unwrap().backward().unwrap();
    for (i, input) in inputs.iter().enumerate() {
        let g = grads.get(&vars[i]).unwrap_or_else(|| panic!("input {i} has no gradient"));
        assert_eq!(g.dims(), input.dims());
        let g = g.flatten_all().unwrap().to_vec1::<f64>().unwrap();
        let x = input.flatten_all().unwrap().to_vec1::<f64>().unwrap();
        let scale = g.iter().fold(1e-12f64, |m, v| m.max(v.abs()));
        for _ in 0..count {
            let at = (r.bits() % x.len() as u64) as usize;
            let h = 1e-6 * x[at].abs().max(1.0);
            let shifted = |d: f64| {
                let mut x = x.clone();
                x[at] += d;
                let mut all = inputs.to_vec();
                all[i] = Tensor::from_vec(x, input.dims(), &Device::Cpu).unwrap();
                loss(&all)
            };
            let numeric = (shifted(h) - shifted(-h)) / (2.0 * h);
            let error = (numeric - g[at]).abs() / scale;
            assert!(
                error < tolerance,
                "input {i} entry {at}: analytic {:.8e}, numeric {numeric:.8e}, scale {scale:.3e}",
                g[at]
            );
        }
    }
}
