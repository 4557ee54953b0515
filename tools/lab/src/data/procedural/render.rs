//! Renders a picture and its depth from a camera by ray tracing.
//!
//! Each pixel has a lattice of `samples`² cells with one jittered ray each. The jitter is a
//! function of the cell, and the tone curve is applied to each sample before the pixel's mean. A
//! picture of W×H with 4n samples per side is therefore the 4×4 box mean of the picture of 4W×4H
//! with n. Views of one scene at ×1, ×2 and ×4 agree exactly, as a photograph and its reduction do.

use super::light::Shading;
use super::rng::{hash, normal, unit_pair};
use super::shape::{Primitive, Ray};
use super::{Form, Rng, Room};
use crate::data::photographic::blurred;
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;

/// Side of the square tiles of pixels that share a list of visible solids, px.
const TILE: usize = 16;

/// A rendered picture.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `[H, W, 3]` display values in [0, 1].
    pub rgb: Vec<f32>,
    /// `[H, W]` camera z of the surface at the pixel's centre.
    pub depth: Vec<f32>,
}

/// Conversion of light to display values, and the effects of a sensor. The default has no sensor
/// effects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grade {
    /// Linear gain per channel: scene gain, exposure and white balance together.
    pub gain: [f32; 3],
    /// Exponent of the display curve.
    pub gamma: f32,
    /// σ of a Gaussian blur of the finished picture, px; 0 for none.
    pub softness: f32,
    /// σ of additive noise, display values; 0 for none.
    pub noise: f32,
    /// Seed of the noise.
    pub seed: u64,
}

impl Default for Grade {
    fn default() -> Self {
        Self { gain: [1.0; 3], gamma: 2.2, softness: 0.0, noise: 0.0, seed: 0 }
    }
}

impl Grade {
    /// Samples the properties that all views of a scene share: gain and gamma.
    pub(super) fn sample_scene(rng: &mut Rng) -> Self {
        let gain = rng.log_range(0.7, 1.6);
        Self { gain: [gain; 3], gamma: rng.range(1.8, 2.5), ..Self::default() }
    }

    /// Adds the properties of one view: exposure σ 5 %, white balance σ 1.2 %, video softness in 30
    /// % of scenes (`soft`), noise σ up to 0.02.
    pub(super) fn sample_view(mut self, soft: bool, rng: &mut Rng) -> Self {
        let exposure = 1.0 + 0.05 * rng.normal();
        self.gain = self.gain.map(|g| g * exposure * (1.0 + 0.012 * rng.normal()));
        self.softness = if soft { rng.range(0.35, 0.9) } else { 0.0 };
        self.noise = rng.range(0.0, 0.02);
        self.seed = rng.bits();
        self
    }
}

/// Options of a rendered picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// Samples along each side of a pixel; at least 1. The number of samples is the square.
    pub samples: usize,
    /// Gives all lamps an extent and shadows, which are noisy below about 16 samples per pixel. If
    /// false, one lamp casts hard shadows, in half of the rooms.
    pub soft_shadows: bool,
    /// Enables highlights and mirrors.
    pub view_dependent: bool,
    /// Display curve and sensor.
    pub grade: Grade,
}

impl Quality {
    /// Returns soft shadows, equal exposure for every view, no blur and no noise.
    pub fn clean(samples: usize) -> Self {
        Self { samples, soft_shadows: true, view_dependent: true, grade: Grade::default() }
    }

    /// Returns the fast settings for training: hard shadows, 4 samples per pixel.
    pub fn training(grade: Grade) -> Self {
        Self { samples: 2, soft_shadows: false, view_dependent: true, grade }
    }
}

/// A solid that a tile may show.
struct Candidate<'a> {
    solid: &'a Primitive,
    /// Lower bound of the depth of its hits, camera z.
    min_depth: f32,
}

/// Generator of the rays of one camera.
struct RayGenerator {
    origin: Vec3,
    rotation: Mat3,
    focal: Vec2,
    middle: Vec2,
}

impl RayGenerator {
    fn new(camera: &Camera) -> Self {
        let k = &camera.intrinsics();
        Self {
            origin: camera.position(),
            rotation: camera.rotation(),
            focal: Vec2::new(k.fx, k.fy),
            middle: Vec2::new(k.cx, k.cy),
        }
    }

    /// Returns the ray through a pixel position; its parameter is camera z.
    fn ray(&self, px: Vec2) -> Ray {
        let direction = self.rotation * ((px - self.middle) / self.focal).extend(1.0);
        Ray { origin: self.origin, direction }
    }

    /// Returns the solids whose bounding spheres intersect the pixels from `low` to `high`, nearest
    /// first.
    fn candidates<'a>(&self, solids: &'a [Primitive], low: Vec2, high: Vec2) -> Vec<Candidate<'a>> {
        let unit = |x: f32, y: f32| self.ray(Vec2::new(x, y)).direction.normalize_or(Vec3::Z);
        let corners =
            [unit(low.x, low.y), unit(high.x, low.y), unit(low.x, high.y), unit(high.x, high.y)];
        let axis = corners.iter().sum::<Vec3>().normalize_or(Vec3::Z);
        // The largest angle of the corners bounds the tile, whose outline is convex around the
        // axis.
        let angle = |v: Vec3| axis.dot(v).clamp(-1.0, 1.0).acos();
        let half = corners.iter().map(|c| angle(*c)).fold(0.0, f32::max);
        let forward = self.rotation.z_axis;
        let visible = solids.iter().filter_map(|solid| {
            let offset = solid.centre - self.origin;
            let distance = offset.length();
            if solid.form == Form::Shell || distance <= solid.radius {
                return Some(Candidate { solid, min_depth: 0.0 });
            }
            let reach = half + (solid.radius / distance).asin() + 1e-4;
            let seen = angle(offset / distance) <= reach;
            let min_depth = (forward.dot(offset) - solid.radius).max(0.0);
            seen.then_some(Candidate { solid, min_depth })
        });
        let mut list: Vec<Candidate> = visible.collect();
        list.sort_by(|a, b| a.min_depth.total_cmp(&b.min_depth));
        list
    }
}

/// Returns the first solid along a ray, and the depth of the hit.
fn first_hit<'a>(list: &[Candidate<'a>], ray: &Ray) -> Option<(&'a Primitive, f32)> {
    let mut best: Option<(&Primitive, f32)> = None;
    let mut limit = f32::INFINITY;
    for candidate in list {
        if candidate.min_depth > limit {
            break;
        }
        if let Some(t) = candidate.solid.intersect(ray, limit) {
            (best, limit) = (Some((candidate.solid, t)), t);
        }
    }
    best
}

/// Converts linear light to display values: a shoulder (Reinhard et al. 2002, eq. 4) that reaches
/// white at 1.6, then the gamma.
fn display(linear: Vec3, grade: &Grade) -> Vec3 {
    const WHITE: f32 = 1.6;
    let x = (linear * Vec3::from(grade.gain)).max(Vec3::ZERO);
    let shouldered = x * (Vec3::ONE + x / (WHITE * WHITE)) / (Vec3::ONE + x);
    shouldered.min(Vec3::ONE).powf(1.0 / grade.gamma)
}

impl Room {
    /// Renders picture and depth of `camera`. A solid that contains the camera is not visible.
    pub fn render(&self, camera: &Camera, quality: &Quality) -> View {
        let (width, height) = (camera.intrinsics().width, camera.intrinsics().height);
        let mut rgb = vec![0.0; width * height * 3];
        let mut depth = vec![0.0; width * height];
        let rays = RayGenerator::new(camera);
        rgb.par_chunks_mut((width * 3 * TILE).max(1))
            .zip(depth.par_chunks_mut((width * TILE).max(1)))
            .enumerate()
            .for_each(|(band, (rgb, depth))| {
                for left in (0..width).step_by(TILE) {
                    self.render_tile(&rays, quality, [left, band * TILE], width, rgb, depth);
                }
            });
        if quality.grade.softness > 0.0 {
            rgb = blurred(&rgb, width, quality.grade.softness);
        }
        add_noise(&mut rgb, &quality.grade);
        View { width, height, rgb, depth }
    }

    /// Renders one tile of a band of `rgb` and `depth` whose first row is `top`.
    fn render_tile(
        &self,
        rays: &RayGenerator,
        quality: &Quality,
        [left, top]: [usize; 2],
        width: usize,
        rgb: &mut [f32],
        depth: &mut [f32],
    ) {
        let right = (left + TILE).min(width);
        let rows = depth.len() / width;
        let low = Vec2::new(left as f32, top as f32);
        let high = Vec2::new(right as f32, (top + rows) as f32);
        let list = rays.candidates(&self.primitives, low, high);
        for row in 0..rows {
            for x in left..right {
                let y = top + row;
                let centre = rays.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                let i = row * width + x;
                depth[i] = first_hit(&list, &centre).map_or(0.0, |hit| hit.1);
                let colour = self.pixel(rays, quality, &list, [x, y]);
                rgb[i * 3..i * 3 + 3].copy_from_slice(&colour.to_array());
            }
        }
    }

    /// Returns the mean display value over the samples of one pixel.
    fn pixel(
        &self,
        rays: &RayGenerator,
        quality: &Quality,
        list: &[Candidate],
        [x, y]: [usize; 2],
    ) -> Vec3 {
        let n = quality.samples.max(1);
        let cell = 1.0 / n as f32;
        let mut shading = Shading {
            spread: cell / (rays.focal.x * rays.focal.y).sqrt(),
            view_dependent: quality.view_dependent,
            lamp_shift: None,
        };
        let mut sum = Vec3::ZERO;
        for j in 0..n {
            for i in 0..n {
                let (cx, cy) = (x * n + i, y * n + j);
                let bits = hash(0, cx as u64, cy as u64);
                let (u, v) = unit_pair(bits);
                let ray = rays.ray(Vec2::new(cx as f32 + u, cy as f32 + v) * cell);
                let Some((solid, t)) = first_hit(list, &ray) else { continue };
                if quality.soft_shadows {
                    shading.lamp_shift = Some(lamp_shift(cx, cy));
                }
                let light = self.radiance(solid, &ray, t, &shading) * self.exposure;
                sum += display(light, &quality.grade);
            }
        }
        sum * (cell * cell)
    }
}

/// Returns the point of the unit sphere at which a sample evaluates a lamp.
///
/// The two coordinates come from an additive recurrence over the lattice (multiples of irrational
/// numbers, modulo 1). Neighbouring samples therefore cover different parts of a lamp, and a
/// pixel's mean has much less noise than with independent samples.
fn lamp_shift(cx: usize, cy: usize) -> Vec3 {
    // Powers of the inverse of the root of x⁵ = x + 1 (Roberts' R4 sequence).
    const STEP: [f64; 4] = [
        0.856_674_883_854_502_8,
        0.733_891_856_627_126,
        0.628_706_721_037_808_4,
        0.538_597_257_223_612_4,
    ];
    let along = |i: usize| (cx as f64 * STEP[i] + cy as f64 * STEP[i + 1]).fract() as f32;
    let (a, b) = (along(0), along(2));
    let y = 2.0 * a - 1.0;
    let r = (1.0 - y * y).max(0.0).sqrt();
    let (sin, cos) = (std::f32::consts::TAU * b).sin_cos();
    Vec3::new(r * cos, y, r * sin)
}

/// Adds Gaussian noise to the display values.
fn add_noise(rgb: &mut [f32], grade: &Grade) {
    if grade.noise > 0.0 {
        rgb.par_iter_mut().enumerate().for_each(|(i, v)| {
            *v = (*v + grade.noise * normal(hash(grade.seed, i as u64, 2))).clamp(0.0, 1.0);
        });
    }
}
