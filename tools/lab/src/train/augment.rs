//! Augmentation of training examples: mirroring, exchange of channels and views, the differences
//! of two photographs of one scene, and errors of their poses.
//!
//! Views that differ in colour, sharpness, noise and compression halve the error of stereo networks
//! on real pairs (HVT, CVPR 2023; FC-GANet 2024).

use super::source::{Example, InputTargets, hash, uniform};
use crate::data::dataset::Posed;
use crate::data::photographic::{blurred, compress};
use glam::{Mat4, Quat, Vec3};
use half::f16;
use serde::{Deserialize, Serialize};
use subsplat::scene::pictures::Rgb;

/// Transformations of an example. The defaults are those of the training recipe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Probability of mirrored views and poses.
    pub flip: f64,
    /// Probability of permuted colour channels.
    pub permute: f64,
    /// Probability of exchanged context views.
    pub swap: f64,
    /// Probability, for each context view by itself, of other colours and of a vignette, blur or
    /// sharpening, noise, JPEG compression or a covered patch.
    pub photographic: f64,
    /// Standard deviation of the rotation by which the second context view's pose is wrong, degrees.
    pub rotation_error: f64,
    /// Standard deviation of the relative error of the context views' focal length.
    pub focal_error: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            flip: 0.5,
            permute: 0.5,
            swap: 0.5,
            photographic: 0.0,
            rotation_error: 0.0,
            focal_error: 0.0,
        }
    }
}

/// The six orders of three channels.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// Key of the random numbers of pictures.
const PICTURE: u64 = 0xF0_70;
/// Key of the random numbers of poses.
const POSE: u64 = 0x90_5E;

impl Augmentation {
    /// Returns `example` as transformed at position `index` of the sequence of `seed`.
    pub fn apply(&self, example: &Example, seed: u64, index: u64) -> Example {
        let draw = |key: u64| uniform(hash(seed, 0xA0_6E), index * 8 + key);
        let mut out = example.clone();
        if draw(0) < self.flip {
            for view in out.context.iter_mut().chain(&mut out.targets) {
                *view = view.flipped();
            }
            for (map, view) in out.inverse_depth.iter_mut().zip(&out.context) {
                map.chunks_mut(view.image.width.max(1)).for_each(<[f16]>::reverse);
            }
        }
        if draw(1) < self.permute {
            let order = ORDERS[(draw(2) * 6.0) as usize % 6];
            for picture in out.context.iter_mut().chain(&mut out.targets) {
                for px in picture.image.data.chunks_exact_mut(3) {
                    let old = [px[0], px[1], px[2]];
                    px.copy_from_slice(&order.map(|c| old[c]));
                }
            }
        }
        if draw(3) < self.swap {
            out.context.reverse();
            out.inverse_depth.reverse();
            if out.input_targets != InputTargets::Absent {
                let first = out.targets.len().saturating_sub(out.context.len());
                out.targets[first..].reverse();
            }
        }
        for (v, view) in out.context.iter_mut().enumerate() {
            let mut random = Random::new(hash(seed, PICTURE), index * 16 + v as u64);
            if f64::from(random.unit()) < self.photographic {
                rephotograph(&mut view.image, &mut random);
            }
        }
        self.add_pose_errors(&mut out.context, Random::new(hash(seed, POSE), index));
        out
    }

    /// Changes the second view's rotation and the focal length of all views.
    fn add_pose_errors(&self, context: &mut [Posed], mut random: Random) {
        let [x, y, z] = [(); 3].map(|()| self.rotation_error.to_radians() as f32 * random.normal());
        if let Some(view) = context.get_mut(1) {
            let error = Quat::from_scaled_axis(Vec3::new(x, y, z));
            view.camera = view
                .camera
                .with_pose_unchecked(view.camera.world_from_camera() * Mat4::from_quat(error));
        }
        let focal = (self.focal_error as f32 * random.normal()).exp();
        for view in context {
            view.camera = view.camera.zoomed_unchecked(focal, focal);
        }
    }
}

/// Random numbers of one key, in order.
struct Random {
    seed: u64,
    next: u64,
}

impl Random {
    fn new(seed: u64, key: u64) -> Self {
        Self { seed: hash(seed, key), next: 0 }
    }

    /// Uniform in [0, 1).
    fn unit(&mut self) -> f32 {
        self.next += 1;
        uniform(self.seed, self.next) as f32
    }

    fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Approximately normal: the sum of twelve uniform numbers.
    fn normal(&mut self) -> f32 {
        (0..12).map(|_| self.unit()).sum::<f32>() - 6.0
    }
}

/// Changes a picture as another camera would: colour, vignette, sharpness, noise, compression. A
/// patch may be covered.
fn rephotograph(picture: &mut Rgb, random: &mut Random) {
    let (width, height) = (picture.width, picture.height);
    let mut unit = picture.to_unit();
    let exposure = 0.1 * random.normal();
    let gain = [(); 3].map(|()| (exposure + 0.04 * random.normal()).exp());
    let gamma = (0.12 * random.normal()).exp();
    let vignette = if random.unit() < 0.3 { random.range(0.05, 0.4) } else { 0.0 };
    for (i, px) in unit.chunks_exact_mut(3).enumerate() {
        let across = (i % width) as f32 / width as f32 - 0.5;
        let down = (i / width) as f32 / height as f32 - 0.5;
        let shade = 1.0 - vignette * 2.0 * (across * across + down * down);
        for (v, g) in px.iter_mut().zip(gain) {
            *v = (*v * g * shade).clamp(0.0, 1.0).powf(gamma);
        }
    }
    let sharpness = random.unit();
    if sharpness < 0.35 {
        unit = blurred(&unit, width, random.range(0.3, 1.2));
    } else if sharpness < 0.55 {
        let amount = random.range(0.2, 1.0);
        let soft = blurred(&unit, width, 1.0);
        unit.iter_mut().zip(soft).for_each(|(v, s)| *v += amount * (*v - s));
    }
    if random.unit() < 0.6 {
        let sigma = random.range(0.0, 0.03);
        unit.iter_mut().for_each(|v| *v += sigma * random.normal());
    }
    if random.unit() < 0.15 {
        cover_patch(&mut unit, width, height, random);
    }
    if let Some(changed) = Rgb::from_unit(&unit, width, height) {
        *picture = changed;
    }
    if random.unit() < 0.4 {
        compress(picture, random.range(25.0, 90.0) as u8);
    }
}

/// Replaces a rectangle of at most a fifth of either side by noise around one colour.
fn cover_patch(unit: &mut [f32], width: usize, height: usize, random: &mut Random) {
    let colour = [(); 3].map(|()| random.unit());
    let noise = random.range(0.0, 0.2);
    let [w, h] = [width, height].map(|n| ((random.range(0.04, 0.2) * n as f32) as usize).max(1));
    let left = (random.unit() * (width - w.min(width)) as f32) as usize;
    let top = (random.unit() * (height - h.min(height)) as f32) as usize;
    for y in top..(top + h).min(height) {
        for x in left..(left + w).min(width) {
            for (c, mean) in colour.iter().enumerate() {
                unit[3 * (y * width + x) + c] = mean + noise * (random.unit() - 0.5);
            }
        }
    }
}
