//! Pictures with depth, and where a point lies in them. The views are compared by these
//! ([`super::cross_check`], [`super::depth_consensus`]).

use crate::camera::Camera;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// A view with colours and depth.
#[derive(Clone, Copy, Debug)]
pub struct RgbdView<'a> {
    /// Camera of H × W pixels.
    pub camera: &'a Camera,
    /// `[3, H, W]`, display values.
    pub rgb: &'a [f32],
    /// `[H·W]`: distance along the unit ray, world units.
    pub distances: &'a [f32],
}

/// Position and colour of a view's surface.
pub(super) struct Surface<'a> {
    view: RgbdView<'a>,
    /// `[H·W]`: camera z.
    pub z: Vec<f32>,
}

impl<'a> Surface<'a> {
    pub fn new(view: RgbdView<'a>) -> Self {
        let z = (0..view.distances.len()).into_par_iter();
        let z = z.map(|i| view.distances[i] / ray(view.camera, centre(view.camera, i)).length());
        Self { view, z: z.collect() }
    }

    pub fn colour(&self, i: usize) -> [f32; 3] {
        let plane = self.z.len();
        [0, 1, 2].map(|c| self.view.rgb[c * plane + i])
    }

    /// Distance of pixel `i` along its unit ray.
    pub fn distance(&self, i: usize) -> f32 {
        self.view.distances[i]
    }

    /// Position of the centre of pixel `i`, px.
    pub fn centre(&self, i: usize) -> Vec2 {
        centre(self.view.camera, i)
    }

    /// Length of the ray of pixel `i` from camera z 0 to 1.
    pub fn ray_length(&self, i: usize) -> f32 {
        ray(self.view.camera, self.centre(i)).length()
    }

    /// World point at `position` (px) and camera `z`.
    pub fn point(&self, position: Vec2, z: f32) -> Vec3 {
        let camera = self.view.camera;
        camera.rotation() * (ray(camera, position) * z) + camera.position()
    }

    /// Position (px) and camera z of a world `point`; none outside the picture.
    pub fn project(&self, point: Vec3) -> Option<(Vec2, f32)> {
        let k = self.view.camera.intrinsics;
        let p = self.view.camera.to_camera(point);
        let at = k.project(p);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < k.width as f32 && at.y < k.height as f32;
        (inside && p.z > 0.0).then_some((at, p.z))
    }

    /// Index of the pixel at a `position` inside the picture.
    pub fn pixel(&self, position: Vec2) -> usize {
        position.y as usize * self.view.camera.intrinsics.width + position.x as usize
    }

    /// Σ|ΔRGB| between `colour` and the nearest colour of the 3×3 pixels around `position`.
    pub fn difference(&self, position: Vec2, colour: [f32; 3]) -> f32 {
        let to = |i: usize| {
            let own = self.colour(i);
            (0..3).map(|c| (own[c] - colour[c]).abs()).sum()
        };
        self.around(position).map(to).fold(f32::INFINITY, f32::min)
    }

    /// Indices of the 3×3 pixels around `position`, of those that exist.
    pub fn around(&self, position: Vec2) -> impl Iterator<Item = usize> {
        let k = self.view.camera.intrinsics;
        let (x, y) = (position.x as usize, position.y as usize);
        let columns = x.saturating_sub(1)..(x + 2).min(k.width);
        (y.saturating_sub(1)..(y + 2).min(k.height))
            .flat_map(move |row| columns.clone().map(move |column| row * k.width + column))
    }
}

/// Position of the centre of pixel `i`, px.
fn centre(camera: &Camera, i: usize) -> Vec2 {
    let width = camera.intrinsics.width;
    Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5)
}

/// K⁻¹ (u, v, 1).
fn ray(camera: &Camera, position: Vec2) -> Vec3 {
    camera.intrinsics.unproject(position)
}

/// Views of the kernels' tests.
#[cfg(test)]
pub(super) mod examples {
    use super::{RgbdView, Surface};
    use crate::camera::{Camera, Intrinsics};
    use glam::{DVec2, DVec3, Mat4, Vec3};

    /// Side of [`camera`], px.
    pub const SIDE: usize = 32;

    /// A camera at x that looks along z.
    pub fn camera(x: f32) -> Camera {
        let k = Intrinsics { fx: 32.0, fy: 32.0, cx: 16.0, cy: 16.0, width: SIDE, height: SIDE };
        Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap()
    }

    /// Pictures and distances of a view.
    pub struct Seen {
        pub camera: Camera,
        pub rgb: Vec<f32>,
        pub distances: Vec<f32>,
    }

    impl Seen {
        pub fn view(&self) -> RgbdView<'_> {
            RgbdView { camera: &self.camera, rgb: &self.rgb, distances: &self.distances }
        }
    }

    /// A wall at z = 2 whose left half is dark, seen from x.
    pub fn wall(x: f32) -> Seen {
        let camera = camera(x);
        let (mut grey, mut distances) = (Vec::new(), Vec::new());
        let empty = RgbdView { camera: &camera, rgb: &[], distances: &[] };
        let surface = Surface::new(empty);
        for i in 0..SIDE * SIDE {
            let point = surface.point(surface.centre(i), 2.0);
            grey.push(if point.x < 0.0 { 0.1 } else { 0.9 });
            distances.push(2.0 * surface.ray_length(i));
        }
        Seen { camera, rgb: grey.repeat(3), distances }
    }

    /// Numbers between 0 and 1.
    pub fn noise(n: usize, seed: f32) -> Vec<f32> {
        (0..n).map(|i| 0.5 + 0.5 * ((i as f32 + seed) * 12.9898).sin()).collect()
    }

    /// Three turned views of 24 × 24 px; distances from 1.5 to 2.
    pub fn turned() -> Vec<Seen> {
        let side = 24;
        let n = side * side;
        let view = |v: u8| {
            let v = f32::from(v);
            let turn = Mat4::from_rotation_y(0.1 * v - 0.1) * Mat4::from_rotation_z(0.05 * v);
            let at = Mat4::from_translation(Vec3::new(0.2 * v, 0.1, 0.0));
            let k =
                Intrinsics { fx: 26.0, fy: 25.0, cx: 11.7, cy: 12.4, width: side, height: side };
            Seen {
                camera: Camera::new(k, at * turn).unwrap(),
                rgb: noise(3 * n, 7.0 * v),
                distances: noise(n, 100.0 + v).iter().map(|d| 1.5 + 0.5 * d).collect(),
            }
        };
        (0..3).map(view).collect()
    }

    /// Position of the centre of a pixel, px.
    pub fn centre(view: &RgbdView<'_>, i: usize) -> DVec2 {
        let width = view.camera.intrinsics.width;
        DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5)
    }

    /// Camera z of a pixel's surface, in f64.
    pub fn z_of(view: &RgbdView<'_>, i: usize) -> f64 {
        f64::from(view.distances[i]) / in_camera(view, centre(view, i)).length()
    }

    /// Length of the ray of pixel `i` from camera z 0 to 1, in f64.
    pub fn ray_length(view: &RgbdView<'_>, i: usize) -> f64 {
        in_camera(view, centre(view, i)).length()
    }

    /// K⁻¹ (u, v, 1), in f64.
    fn in_camera(view: &RgbdView<'_>, position: DVec2) -> DVec3 {
        let k = view.camera.intrinsics;
        let x = (position.x - f64::from(k.cx)) / f64::from(k.fx);
        let y = (position.y - f64::from(k.cy)) / f64::from(k.fy);
        DVec3::new(x, y, 1.0)
    }

    /// World point at a position (px) and camera z, by a 4×4 matrix in f64.
    pub fn place(view: &RgbdView<'_>, position: DVec2, z: f64) -> DVec3 {
        let world = view.camera.world_from_camera.as_dmat4();
        world.transform_point3(in_camera(view, position) * z)
    }

    /// Position (px) and camera z of a point inside the picture, by a 4×4 matrix in f64.
    pub fn project(view: &RgbdView<'_>, point: DVec3) -> Option<(DVec2, f64)> {
        let k = view.camera.intrinsics;
        let p = view.camera.world_from_camera.as_dmat4().inverse().transform_point3(point);
        let x = f64::from(k.fx) * p.x / p.z + f64::from(k.cx);
        let y = f64::from(k.fy) * p.y / p.z + f64::from(k.cy);
        let inside = x >= 0.0 && y >= 0.0 && x < k.width as f64 && y < k.height as f64;
        (inside && p.z > 0.0).then_some((DVec2::new(x, y), p.z))
    }

    /// Pixels of the picture at most one from the pixel at `position` in either axis.
    pub fn around(view: &RgbdView<'_>, position: DVec2) -> Vec<usize> {
        let k = view.camera.intrinsics;
        let near = |a: usize, b: f64| (a as f64 - b.floor()).abs() <= 1.0;
        let inside = |i: &usize| near(i / k.width, position.y) && near(i % k.width, position.x);
        (0..k.width * k.height).filter(inside).collect()
    }

    /// Σ|ΔRGB| between the nearest of the pixels `around` and `wanted`.
    pub fn difference(view: &RgbdView<'_>, around: &[usize], wanted: [f64; 3]) -> f64 {
        let to = |i: &usize| {
            let own = colour(view, *i);
            (0..3).map(|c| (own[c] - wanted[c]).abs()).sum::<f64>()
        };
        around.iter().map(to).fold(f64::INFINITY, f64::min)
    }

    pub fn colour(view: &RgbdView<'_>, i: usize) -> [f64; 3] {
        [0, 1, 2].map(|c| f64::from(view.rgb[c * view.distances.len() + i]))
    }
}
