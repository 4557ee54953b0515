//! Judges a finished scene by its photographs alone, without any view that was held back.
//!
//! A scene gives its own photographs back whether or not its shapes are right, because it was optimised on them.
//! Two things tell more. The surface that a photograph shows must lie where the other photographs show theirs
//! ([`Agreement::consistent`]), and the colours of the photographs must match better over this surface than at equal
//! places of the pictures ([`Agreement::gain`]). Both compare rendered depths with photographs; rendered colours do
//! not enter.

use super::{Error, Reconstruction, Result, SceneVerdict};
use crate::reconstruct::inputs::crop::Cropped;
use crate::reconstruct::inputs::pair::choose_sources;
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use crate::scene::render::{Picture, Renderer};
use crate::scene::score::Score;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use subsplat_kernels::camera::{Camera, Size};
use subsplat_kernels::layout::RasterOptions;

/// Longest side of the grid of points at which photographs are compared.
const GRID: usize = 256;
/// Other photographs with which each one is compared.
const SOURCES: usize = 2;
/// Largest distance of a consistent point from its pixel, there and back, as a share of the picture's width:
/// 1.3 px of 256.
const CONSISTENT: f32 = 0.005;
/// One of so many points measures the parallax.
const PARALLAX_STEP: usize = 17;
/// Least alpha of a pixel whose depth counts.
const OPAQUE: f32 = 0.5;

/// Agreement of the photographs over the scene's surface, means over pairs of photographs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Agreement {
    /// Share of the photographs' pixels whose surface another photograph shows, in [0, 1].
    pub shared: f64,
    /// Share of the shared pixels whose point, moved to the other photograph and back by its surface, returns
    /// within 0.5 % of the picture's width, in [0, 1].
    pub consistent: f64,
    /// PSNR of the other photograph's colours, fetched over the surface, dB.
    pub over_surface: f64,
    /// PSNR of the other photograph's colours at the same places, dB.
    pub at_same_place: f64,
    /// Displacement of a point by the distance between the cameras, share of the picture's width: median over the
    /// points, each with the photograph in which it moves most.
    pub parallax: f64,
}

impl Agreement {
    /// Decibels that the surface gains over a copy of the other photograph.
    pub fn gain(&self) -> f64 {
        self.over_surface - self.at_same_place
    }
}

/// A scene as its photographs' own cameras see it, and its judgement.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Assessment {
    /// Scores of the pictures at the inputs' own cameras, at the target's size.
    pub inputs: Option<Score>,
    /// Mean alpha of these pictures.
    pub coverage: f64,
    /// Agreement of the photographs.
    pub agreement: Agreement,
    /// The verdict.
    pub verdict: SceneVerdict,
}

/// Camera z of the surface at pixel `i` of `picture`; 0 where the picture is not opaque enough, or where `mask` leaves
/// the pixel out.
pub(super) fn surface_depth(picture: &Picture, i: usize, mask: Option<&Mask>) -> f32 {
    let kept = mask.is_none_or(|mask| mask.kept().get(i) != Some(&false));
    if kept && picture.alpha[i] >= OPAQUE { picture.depth[i] } else { 0.0 }
}

/// Depths of a picture on a grid.
struct Surface<'a> {
    camera: Camera,
    photograph: &'a Rgb,
    /// Points across and down.
    grid: Size,
    /// Camera z of each point; 0 where there is none.
    depth: Vec<f32>,
}

impl<'a> Surface<'a> {
    fn new(input: &'a Cropped, picture: &Picture) -> Self {
        let size = Size::new(picture.width, picture.height);
        let step = size.width.max(size.height).div_ceil(GRID).max(1);
        let grid = Size::new(size.width / step, size.height / step);
        let mask = input.target_mask.as_ref();
        let depth = |i: usize| {
            let at =
                (i / grid.width * step + step / 2) * size.width + i % grid.width * step + step / 2;
            surface_depth(picture, at, mask)
        };
        let depth = (0..grid.width * grid.height).map(depth).collect();
        Self { camera: input.target_camera, photograph: &input.target, grid, depth }
    }

    fn size(&self) -> Vec2 {
        Vec2::new(self.photograph.width as f32, self.photograph.height as f32)
    }

    /// Centre of point `i` in the picture, px.
    fn place(&self, i: usize) -> Vec2 {
        let (x, y) = (i % self.grid.width, i / self.grid.width);
        let share = Vec2::new(
            (x as f32 + 0.5) / self.grid.width as f32,
            (y as f32 + 0.5) / self.grid.height as f32,
        );
        share * self.size()
    }

    /// Camera z at a place of the picture; `None` outside the picture and where there is no surface.
    fn depth_at(&self, at: Vec2) -> Option<f32> {
        let share = at / self.size();
        if !(share.min_element() >= 0.0 && share.max_element() < 1.0) {
            return None;
        }
        let (x, y) = (share.x * self.grid.width as f32, share.y * self.grid.height as f32);
        let depth = self.depth[y as usize * self.grid.width + x as usize];
        (depth > 0.0).then_some(depth)
    }

    /// Colour at a place of the picture, between the four nearest pixels.
    fn colour(&self, at: Vec2) -> Vec3 {
        let Rgb { width, height, data } = self.photograph;
        let at = at - 0.5;
        let low = at.floor();
        let part = at - low;
        let pixel = |dx: f32, dy: f32| {
            let x = ((low.x + dx).max(0.0) as usize).min(width - 1);
            let y = ((low.y + dy).max(0.0) as usize).min(height - 1);
            let i = 3 * (y * width + x);
            Vec3::new(f32::from(data[i]), f32::from(data[i + 1]), f32::from(data[i + 2])) / 255.0
        };
        pixel(0.0, 0.0)
            .lerp(pixel(1.0, 0.0), part.x)
            .lerp(pixel(0.0, 1.0).lerp(pixel(1.0, 1.0), part.x), part.y)
    }
}

/// One shared point of two photographs.
struct Shared {
    consistent: bool,
    /// Squared differences of colour, sums over the channels: over the surface, at the same place.
    differences: [f64; 2],
}

/// Compares the point `i` of `from` with the photograph `to`; `None` where `to` does not show it.
fn compare(from: &Surface<'_>, to: &Surface<'_>, i: usize) -> Option<Shared> {
    let depth = from.depth[i];
    if !(depth > 0.0) {
        return None;
    }
    let at = from.place(i);
    let point = from.camera.unproject(at, depth);
    let there = to.camera.project(point)?;
    let other = to.depth_at(there)?;
    let back = from.camera.project(to.camera.unproject(there, other));
    let width = from.size().x;
    let colour = from.colour(at);
    let difference = |other: Vec3| f64::from((colour - other).length_squared());
    Some(Shared {
        consistent: back.is_some_and(|back| back.distance(at) <= CONSISTENT * width),
        differences: [
            difference(to.colour(there)),
            difference(to.colour(at / from.size() * to.size())),
        ],
    })
}

/// Displacement of a point of `from` in the picture of `to` by the distance between the cameras, share of its width;
/// 0 behind the camera.
fn displacement(from: &Camera, to: &Camera, point: Vec3) -> f32 {
    // The direction alone, which a turned camera would show there.
    let turned = to.project(to.position() + (point - from.position()));
    let width = to.intrinsics().width as f32;
    match (to.project(point), turned) {
        (Some(there), Some(turned)) => there.distance(turned) / width,
        _ => 0.0,
    }
}

/// [`Agreement::parallax`].
fn parallax(surfaces: &[Surface<'_>]) -> f32 {
    let mut all = Vec::new();
    for (i, from) in surfaces.iter().enumerate() {
        for p in (0..from.depth.len()).step_by(PARALLAX_STEP).filter(|&p| from.depth[p] > 0.0) {
            let point = from.camera.unproject(from.place(p), from.depth[p]);
            let others = surfaces.iter().enumerate().filter(|(j, _)| *j != i);
            let of = |(_, to): (usize, &Surface<'_>)| displacement(&from.camera, &to.camera, point);
            all.push(others.map(of).fold(0.0, f32::max));
        }
    }
    all.sort_by(f32::total_cmp);
    all.get(all.len() / 2).copied().unwrap_or(0.0)
}

fn agreement(surfaces: &[Surface<'_>], sources: &[Vec<usize>]) -> Agreement {
    let mut points = 0;
    let mut shared: Vec<Shared> = Vec::new();
    for (i, from) in surfaces.iter().enumerate() {
        for &j in &sources[i] {
            let count = from.depth.len();
            let found: Vec<Shared> =
                (0..count).into_par_iter().filter_map(|p| compare(from, &surfaces[j], p)).collect();
            points += count;
            shared.extend(found);
        }
    }
    let n = shared.len() as f64;
    if shared.is_empty() {
        return Agreement::default();
    }
    let decibels = |k: usize| {
        let sum: f64 = shared.iter().map(|s| s.differences[k]).sum();
        -10.0 * (sum / (3.0 * n)).max(1e-10).log10()
    };
    Agreement {
        shared: n / points as f64,
        consistent: shared.iter().filter(|s| s.consistent).count() as f64 / n,
        over_surface: decibels(0),
        at_same_place: decibels(1),
        parallax: f64::from(parallax(surfaces)),
    }
}

impl Reconstruction {
    /// Draws the scene at its inputs' own cameras by the rules `options`, and judges it.
    ///
    /// # Errors
    /// A picture that cannot be scored: fewer than 11 pixels a side.
    pub fn assess(&self, renderer: &mut Renderer, options: &RasterOptions) -> Result<Assessment> {
        let (mut scores, mut surfaces, mut coverage) = (Vec::new(), Vec::new(), 0.0);
        for (i, input) in self.inputs.iter().enumerate() {
            let picture = renderer.render(&self.splats, &input.target_camera, options);
            let score = Score::of_kept(&picture.rgb, &input.target, input.target_mask.as_ref());
            let place = || format!("photograph {i}");
            scores.push(score.map_err(|source| Error::Score { place: place(), source })?);
            let alpha: f64 = picture.alpha.iter().copied().map(f64::from).sum();
            coverage += alpha / (picture.alpha.len() * self.inputs.len()) as f64;
            surfaces.push(Surface::new(input, &picture));
        }
        let cameras: Vec<Camera> = self.inputs.iter().map(|c| c.target_camera).collect();
        let sources = choose_sources(&cameras, self.bounds.near_far(), SOURCES);
        let agreement = agreement(&surfaces, &sources);
        let verdict = SceneVerdict::new(&agreement, coverage, &self.reports);
        Ok(Assessment { inputs: Score::mean(&scores), coverage, agreement, verdict })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;
    use subsplat_kernels::camera::Intrinsics;

    const SIDE: usize = 64;

    /// A camera at `x` that looks along +z.
    fn camera(x: f32) -> Camera {
        let k = Intrinsics::from_fov_x(0.9, SIDE, SIDE);
        Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap()
    }

    /// The photograph of a smooth texture on the plane z = 2.
    fn photograph(camera: &Camera) -> Rgb {
        let mut data = Vec::new();
        for i in 0..SIDE * SIDE {
            let at = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
            let p = camera.unproject(at, 2.0);
            let wave = |f: f32| (127.0 + 120.0 * (f * p.x + 0.3 * f * p.y).sin()) as u8;
            data.extend([wave(9.0), wave(13.0), wave(17.0)]);
        }
        Rgb { width: SIDE, height: SIDE, data }
    }

    /// The agreement of two photographs 0.3 apart whose surfaces lie at these depths.
    fn agreement_at(depths: [&dyn Fn(usize) -> f32; 2]) -> Agreement {
        let cameras = [camera(0.0), camera(0.3)];
        let photographs = cameras.each_ref().map(photograph);
        let surface = |i: usize| Surface {
            camera: cameras[i],
            photograph: &photographs[i],
            grid: Size::new(SIDE, SIDE),
            depth: (0..SIDE * SIDE).map(depths[i]).collect(),
        };
        agreement(&[surface(0), surface(1)], &[vec![1], vec![0]])
    }

    #[test]
    fn the_true_surface_agrees_and_others_do_not() {
        let plane = |_: usize| 2.0;
        let truth = agreement_at([&plane, &plane]);
        assert!(truth.consistent > 0.999 && truth.gain() > 15.0, "{truth:?}");
        // f·b/z px of 64, and what both see of the plane.
        let shift = f64::from(camera(0.0).intrinsics().fx * 0.3 / 2.0) / SIDE as f64;
        assert!((truth.parallax - shift).abs() < 1e-3, "{truth:?}");
        assert!((truth.shared - (1.0 - shift)).abs() < 0.02, "{truth:?}");
        // Equal wrong planes agree with each other, not with the colours.
        let far = |_: usize| 4.0;
        let wrong = agreement_at([&far, &far]);
        assert!(wrong.consistent > 0.999 && wrong.gain() < 3.0, "{wrong:?}");
        // Distances of noise agree in neither way.
        let noise = |i: usize| 1.0 + (i * 7919 % 101) as f32 / 50.0;
        let noisy = agreement_at([&noise, &noise]);
        assert!(noisy.consistent < 0.3 && noisy.gain() < truth.gain() - 10.0, "{noisy:?}");
        // A point returns 0.5 % of the width from its pixel, 0.32 px, where the other surface changes the disparity
        // 0.3·f/z by as much.
        let other = |share: f32| 1.0 / (0.5 + share * 0.32 / (0.3 * camera(0.0).intrinsics().fx));
        let consistent = |share| agreement_at([&plane, &|_| other(share)]).consistent;
        assert_eq!([0.98, 1.02].map(consistent), [1.0, 0.0]);
        // No surface at all.
        let none = agreement_at([&|_| 0.0, &|_| 0.0]);
        assert_eq!(none, Agreement::default());
    }
}
