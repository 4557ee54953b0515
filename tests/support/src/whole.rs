//! Rooms photographed by random cameras, and what the end-to-end tests compare.

use candle_core::{Device, Tensor};
use glam::{EulerRot, Mat4, Quat, Vec3};
use subsplat::FitOptions;
use subsplat::Picture;
use subsplat::network::config::{Backbone, Config, Preset};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::{Weights, save};
use subsplat::reconstruct::{
    Check, Density, DepthRange, Detail, Options, Photo, Reconstruction, Reconstructor,
};
use subsplat::scene::metrics::psnr;
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::layout::RasterOptions;
use subsplat_lab::data::procedural::{CameraSpec, Quality, Room, sample_cameras};

/// The depth range that the rooms are reconstructed with, metres.
pub const NEAR_FAR: NearFar = NearFar::new(0.4, 12.0);

/// A furnished room seen by two cameras and `targets` between them.
pub struct Shoot {
    pub photos: Vec<Photo>,
    pub targets: Vec<Camera>,
}

/// Photographs of `width` × `height` pixels of room `seed`, `views` of them.
pub fn shoot(seed: u64, views: usize, width: usize, height: usize) -> Shoot {
    let room = Room::new(seed);
    let spec = CameraSpec { width, height, targets: views, crop: 0.0, range: Default::default() };
    let rig = sample_cameras(&room, seed, &spec).unwrap();
    let photo = |camera: &Camera| {
        let view = room.render(camera, &Quality::clean(1));
        let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let image = Rgb { width, height, data: view.rgb.iter().map(byte).collect() };
        Photo::new(image, *camera).unwrap()
    };
    let photos = rig.cameras[..views].iter().map(photo).collect();
    Shoot { photos, targets: rig.cameras[2..].to_vec() }
}

/// A rigid motion of the world; none is special.
pub fn motion(i: usize) -> Mat4 {
    let a = i as f32;
    let turn = Quat::from_euler(EulerRot::YXZ, 1.9 + 1.3 * a, -0.7 + 2.1 * a, 2.6 - 0.9 * a);
    Mat4::from_rotation_translation(turn, Vec3::new(1.5 - a, -2.0, 2.5 * a - 1.0))
}

/// The same camera in the moved world.
pub fn moved(camera: &Camera, motion: Mat4) -> Camera {
    Camera::new(camera.intrinsics(), motion * camera.world_from_camera()).unwrap()
}

impl Shoot {
    /// The same photographs in a moved world.
    pub fn moved(&self, motion: Mat4) -> Self {
        let photo = |p: &Photo| Photo::new(p.image().clone(), moved(p.camera(), motion)).unwrap();
        Self {
            photos: self.photos.iter().map(photo).collect(),
            targets: self.targets.iter().map(|c| moved(c, motion)).collect(),
        }
    }
}

/// MVSplat's or the small network with one of the presets.
pub fn plain(mvsplat: bool, preset: Preset, upscale: usize) -> Config {
    if mvsplat { Config::re10k(preset, upscale) } else { Config::small(preset, upscale) }
}

/// Fewer layers where a test needs no particular network: a third of the time.
pub fn light(mut config: Config) -> Config {
    if let Backbone::Mvsplat(b) = &mut config.backbone {
        b.transformer_layers = 2;
        b.depth_candidates = 32;
    }
    config
}

/// Reconstruction with seeded weights, input `size`.
pub fn reconstruct(
    config: &Config,
    photos: &[Photo],
    size: (usize, usize),
    detail: bool,
) -> (Reconstructor, Reconstruction) {
    let model = Reconstructor::untrained(config, 7).unwrap();
    let result = run(&model, photos, size, detail);
    (model, result)
}

pub fn run(
    model: &Reconstructor,
    photos: &[Photo],
    size: (usize, usize),
    detail: bool,
) -> Reconstruction {
    model.run(photos, &options(size, NEAR_FAR, detail)).unwrap()
}

/// A fixed depth range, no check, and no fit: the network's Gaussians.
pub fn options(
    (width, height): (usize, usize),
    NearFar { near, far }: NearFar,
    detail: bool,
) -> Options {
    Options::default()
        .with_input_size(width, height)
        .with_depth_range(DepthRange::Fixed { near, far })
        .with_check(Check::Off)
        .with_detail(if detail { Detail::Photographs } else { Detail::Off })
        .with_density(Density::Full)
        .with_fit(FitOptions::off())
}

/// A seeded model in which nothing is zero any more, out of a weight file: children
/// differ from the plain split in every number, colours depend on direction.
pub fn lively(config: &Config) -> Reconstructor {
    let weights = Weights::seeded(7).trainable();
    SubSplat::new(config, weights.builder()).unwrap();
    let mut random = 1u64;
    let mut noise = || {
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        0.3 * ((random >> 40) as f32 / (1 << 23) as f32 - 1.0)
    };
    let alive = |(name, var): (String, candle_core::Var)| {
        let mut values = var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        if values.iter().all(|v| *v == 0.0) {
            values.iter_mut().for_each(|v| *v = noise());
        }
        let shape = var.shape().clone();
        (name, Tensor::from_vec(values, shape, &Device::Cpu).unwrap())
    };
    let tensors = weights.variables().into_iter().map(alive).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    save(&path, &tensors, config).unwrap();
    let model = Reconstructor::load(&path, None).unwrap();
    assert_eq!(model.config(), config);
    assert!(model.untrained_tensors().is_empty() && model.unexpected_tensors().is_empty());
    model
}

/// Colours hardly depend on direction (MVSplat damps degree l by 0.1·0.25^l), and a
/// wrong rotation of them would hide in rounding: degree l times 2^l·`factor`.
pub fn amplify_view_dependence(splats: &mut Splats, factor: f32) {
    let d = splats.sh_coefficients();
    let mut parts = splats.clone().into_parts();
    for (i, rgb) in parts.sh.chunks_exact_mut(3).enumerate() {
        let degree = ((i % d) as f32).sqrt() as i32;
        if degree > 0 {
            rgb.iter_mut().for_each(|v| *v *= factor * 2f32.powi(degree));
        }
    }
    *splats = Splats::try_from(parts).unwrap();
}

/// Peak signal-to-noise ratio of the colours of two renders, dB.
pub fn decibels(a: &Picture, b: &Picture) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    psnr(&a.rgb, &b.rgb, a.width, a.height).unwrap()
}

/// PSNR of `b` against `a` from `camera`, which must see something.
pub fn compare(a: &Splats, b: &Splats, camera: &Camera, options: &RasterOptions) -> f64 {
    let a = render(a, camera, options);
    assert!(mean(&a.alpha) > 0.2, "nothing to see: mean alpha {}", mean(&a.alpha));
    decibels(&a, &render(b, camera, options))
}

pub fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len().max(1) as f64
}

/// Mean absolute difference.
pub fn mean_difference(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum();
    sum / a.len().max(1) as f64
}
