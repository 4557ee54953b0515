//! Consistency between views: an opacity factor for each pixel's point.
//!
//! The point of a pixel is projected into every other view. A view without a surface before
//! the point should show the pixel's colour there. In another colour the depth of the point is
//! most likely wrong. The colour is compared with the nearest of 3×3 pixels, since depth is
//! exact to a pixel at best. On the photographs of the model card this gains 0.2 dB
//! (src/model/shipped/README.md, "The small backbone").
//!
//! In: pictures, cameras, distance along the unit ray of each pixel. Out: `[V, H·W]`,
//! factors from [`MIN_FACTOR`] (another colour in all views that show it) to 1 (the same
//! colour, or hidden in all views). No gradient: pictures are inputs, and the step of a point
//! across a silhouette has no derivative. Oracle: the same in f64 by matrices (the tests).

use crate::camera::Camera;
use rayon::prelude::*;

/// Factor of a pixel whose inconsistency is 1 in every view that shows its point.
pub const MIN_FACTOR: f32 = 0.1;
/// Σ|ΔRGB| of display values from which inconsistency is 1.
pub const COLOUR: f32 = 1.0;
/// A point is hidden where it lies behind the other view's surface by more than this
/// share of that surface's z.
pub const BEHIND: f32 = 0.05;

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
struct Surface<'a> {
    view: RgbdView<'a>,
    /// `[H·W]`: camera z.
    z: Vec<f32>,
}

impl<'a> Surface<'a> {
    fn new(view: RgbdView<'a>) -> Self {
        let z = (0..view.distances.len()).into_par_iter();
        let z = z.map(|i| view.distances[i] / ray(view.camera, i).length()).collect();
        Self { view, z }
    }

    fn colour(&self, i: usize) -> [f32; 3] {
        let plane = self.z.len();
        [0, 1, 2].map(|c| self.view.rgb[c * plane + i])
    }

    /// Returns the inconsistency of a `point` (world) of `colour` with this view, 0 to 1; none
    /// where the view does not show the point.
    fn inconsistency(&self, point: glam::Vec3, colour: [f32; 3]) -> Option<f32> {
        let k = self.view.camera.intrinsics;
        let p = self.view.camera.to_camera(point);
        let at = k.project(p);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < k.width as f32 && at.y < k.height as f32;
        if !(inside && p.z > 0.0) {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let (mut surface, mut apart) = (0.0f32, COLOUR);
        for row in y.saturating_sub(1)..(y + 2).min(k.height) {
            for i in row * k.width + x.saturating_sub(1)..row * k.width + (x + 2).min(k.width) {
                surface = surface.max(self.z[i]);
                let own = self.colour(i);
                apart = apart.min((0..3).map(|c| (own[c] - colour[c]).abs()).sum());
            }
        }
        (p.z <= surface * (1.0 + BEHIND)).then_some(apart / COLOUR)
    }
}

fn ray(camera: &Camera, i: usize) -> glam::Vec3 {
    let k = camera.intrinsics;
    k.unproject(glam::Vec2::new((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5))
}

/// The factors of all views' pixels, `[V, H·W]`: 1 minus the mean inconsistency of
/// the other views that show the pixel's point.
pub fn cross_check(views: &[RgbdView<'_>]) -> Vec<f32> {
    let surfaces: Vec<Surface> = views.iter().map(|v| Surface::new(*v)).collect();
    let mut out: Vec<f32> = Vec::with_capacity(views.iter().map(|v| v.distances.len()).sum());
    for (v, own) in surfaces.iter().enumerate() {
        let camera = own.view.camera;
        let factor = |i: usize| {
            let in_camera = ray(camera, i) * own.z[i];
            let point = camera.rotation() * in_camera + camera.position();
            let others = surfaces.iter().enumerate().filter(|(u, _)| *u != v);
            let inconsistencies = others.filter_map(|(_, u)| u.inconsistency(point, own.colour(i)));
            let (sum, count) = inconsistencies.fold((0.0, 0u32), |(s, n), d| (s + d, n + 1));
            1.0 - (1.0 - MIN_FACTOR) * sum / count.max(1) as f32
        };
        let factors = (0..own.z.len()).into_par_iter().with_min_len(1024).map(factor);
        out.par_extend(factors);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::{DVec3, Mat4, Vec3};

    const SIDE: usize = 32;

    fn camera(x: f32) -> Camera {
        let k = Intrinsics { fx: 32.0, fy: 32.0, cx: 16.0, cy: 16.0, width: SIDE, height: SIDE };
        Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap()
    }

    /// A wall at z = 2 whose left half is dark, seen from x: `[3, H, W]` and distances.
    fn wall(camera: &Camera) -> (Vec<f32>, Vec<f32>) {
        let (mut grey, mut distances) = (Vec::new(), Vec::new());
        for i in 0..SIDE * SIDE {
            let ray = ray(camera, i);
            let x = camera.position().x + 2.0 * ray.x;
            grey.push(if x < 0.0 { 0.1 } else { 0.9 });
            distances.push(2.0 * ray.length());
        }
        (grey.repeat(3), distances)
    }

    fn factors(change: impl Fn(&mut [f32])) -> Vec<f32> {
        let cameras = [camera(0.0), camera(0.5)];
        let [a, b] = [wall(&cameras[0]), wall(&cameras[1])];
        let mut distances = a.1;
        change(&mut distances);
        cross_check(&[
            RgbdView { camera: &cameras[0], rgb: &a.0, distances: &distances },
            RgbdView { camera: &cameras[1], rgb: &b.0, distances: &b.1 },
        ])
    }

    #[test]
    fn consistent_pixels_keep_their_opacity() {
        assert!(factors(|_| ()).iter().all(|f| *f == 1.0));
    }

    #[test]
    fn a_bright_point_before_the_dark_half_is_inconsistent() {
        // Pixel (17, 16) of the first view shows the bright half, 1.5 px right of the
        // edge at x = 0. At z = 1 its point lies at x = 0.047, which the second view
        // (8 px of parallax at z = 2, 16 at z = 1) shows 7 px left of the edge.
        let at = 16 * SIDE + 17;
        let all = factors(|d| d[at] *= 0.5);
        let expected = 1.0 - (1.0 - MIN_FACTOR) * 1.0;
        assert!((all[at] - expected).abs() < 1e-6, "{}", all[at]);
        // No other pixel of the first view; the second view has its own points before them.
        assert!(all[..SIDE * SIDE].iter().enumerate().all(|(i, f)| i == at || *f == 1.0));
    }

    #[test]
    fn hidden_points_and_points_outside_are_not_compared() {
        let at = 16 * SIDE + 17;
        // Behind the second view's wall by half; beyond its border (64 px of parallax).
        assert_eq!(factors(|d| d[at] *= 1.5)[at], 1.0);
        assert_eq!(factors(|d| d[at] *= 0.125)[at], 1.0);
        // A distance that is NaN has no point.
        assert_eq!(factors(|d| d[at] = f32::NAN)[at], 1.0);
    }

    /// The same in f64 by 4×4 matrices, one pixel after the other.
    fn oracle(views: &[RgbdView<'_>]) -> Vec<f64> {
        let mut out = Vec::new();
        for (v, own) in views.iter().enumerate() {
            for i in 0..own.distances.len() {
                let point = place(own, i);
                let inconsistencies: Vec<f64> = (0..views.len())
                    .filter(|u| *u != v)
                    .filter_map(|u| inconsistency(&views[u], point, colour(own, i)))
                    .collect();
                let mean =
                    inconsistencies.iter().sum::<f64>() / inconsistencies.len().max(1) as f64;
                out.push(1.0 - (1.0 - f64::from(MIN_FACTOR)) * mean);
            }
        }
        out
    }

    fn colour(view: &RgbdView<'_>, i: usize) -> [f64; 3] {
        [0, 1, 2].map(|c| f64::from(view.rgb[c * view.distances.len() + i]))
    }

    /// World point of a pixel.
    fn place(view: &RgbdView<'_>, i: usize) -> DVec3 {
        let k = view.camera.intrinsics;
        let x = ((i % k.width) as f64 + 0.5 - f64::from(k.cx)) / f64::from(k.fx);
        let y = ((i / k.width) as f64 + 0.5 - f64::from(k.cy)) / f64::from(k.fy);
        let ray = DVec3::new(x, y, 1.0);
        let in_camera = ray * (f64::from(view.distances[i]) / ray.length());
        view.camera.world_from_camera.as_dmat4().transform_point3(in_camera)
    }

    fn inconsistency(view: &RgbdView<'_>, point: DVec3, wanted: [f64; 3]) -> Option<f64> {
        let (k, world) = (view.camera.intrinsics, view.camera.world_from_camera.as_dmat4());
        let p = world.inverse().transform_point3(point);
        let x = f64::from(k.fx) * p.x / p.z + f64::from(k.cx);
        let y = f64::from(k.fy) * p.y / p.z + f64::from(k.cy);
        if p.z <= 0.0 || x < 0.0 || y < 0.0 || x >= k.width as f64 || y >= k.height as f64 {
            return None;
        }
        let (mut surface, mut apart) = (0.0f64, f64::from(COLOUR));
        for row in 0..k.height {
            for column in 0..k.width {
                let near = |a: usize, b: f64| (a as f64 - b.floor()).abs() <= 1.0;
                if near(row, y) && near(column, x) {
                    let i = row * k.width + column;
                    let seen = world.inverse().transform_point3(place(view, i));
                    surface = surface.max(seen.z);
                    let own = colour(view, i);
                    apart = apart.min((0..3).map(|c| (own[c] - wanted[c]).abs()).sum());
                }
            }
        }
        let hidden = p.z > surface * (1.0 + f64::from(BEHIND));
        (!hidden).then_some(apart / f64::from(COLOUR))
    }

    #[test]
    fn three_turned_views_agree_with_the_oracle() {
        let noise = |n: usize, seed: f32| -> Vec<f32> {
            (0..n).map(|i| 0.5 + 0.5 * ((i as f32 + seed) * 12.9898).sin()).collect()
        };
        let cameras: Vec<Camera> = (0..3u8)
            .map(|v| {
                let turn = Mat4::from_rotation_y(0.1 * f32::from(v) - 0.1)
                    * Mat4::from_rotation_z(0.05 * f32::from(v));
                let at = Mat4::from_translation(Vec3::new(0.2 * f32::from(v), 0.1, 0.0));
                let side = 24;
                let k = Intrinsics {
                    fx: 26.0,
                    fy: 25.0,
                    cx: 11.7,
                    cy: 12.4,
                    width: side,
                    height: side,
                };
                Camera::new(k, at * turn).unwrap()
            })
            .collect();
        let n = 24 * 24;
        let pictures: Vec<Vec<f32>> = (0..3u8).map(|v| noise(3 * n, 7.0 * f32::from(v))).collect();
        let depths: Vec<Vec<f32>> = (0..3u8)
            .map(|v| noise(n, 100.0 + f32::from(v)).iter().map(|d| 1.5 + 0.5 * d).collect())
            .collect();
        let views: Vec<RgbdView> = (0..3)
            .map(|v| RgbdView { camera: &cameras[v], rgb: &pictures[v], distances: &depths[v] })
            .collect();
        let (got, want) = (cross_check(&views), oracle(&views));
        assert_eq!(got.len(), want.len());
        // Pixels that round, or surfaces that hide, the other way.
        let off = got.iter().zip(&want).filter(|(a, b)| (f64::from(**a) - **b).abs() > 1e-4);
        let off = off.count();
        assert!(off * 200 <= got.len(), "{off} of {}", got.len());
        let doubted = want.iter().filter(|w| **w < 0.9).count();
        assert!(doubted * 10 > want.len() && doubted < want.len(), "{doubted}: nothing to see");
    }
}
