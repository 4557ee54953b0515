//! Pinhole views of panoramas and of fisheye pictures, which no pinhole can show whole.
//!
//! A [`Cut`] is a pinhole view in a direction of the lens. Its pixels are sampled from the picture (bicubic,
//! across the seam of a panorama), its mask follows.
//!
//! A panorama gives [`YAWS`] square views of 90° around the horizon, of which neighbours share 30°. The
//! directions are the same in the world for all panoramas of a scene ([`shared_axes`]): views of two panoramas
//! in one direction are a stereo pair. Two views look across the line on which most panoramas lie, where the
//! parallax is largest. Fewer views would leave gaps at their overlap, more would exceed the number of
//! photographs of which a scene is made. What lies above 45° and below −45° is not used.
//!
//! A view has the panorama's pixels per degree in its middle.

use super::distortion::Distortion;
use super::undistort::{Edge, border, ray, resample, resample_masked};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::{DMat3, DVec2, DVec3};
use std::f64::consts::{FRAC_PI_4, PI, TAU};
use subsplat_kernels::camera::Intrinsics;

/// Number of views of a panorama.
pub const YAWS: usize = 6;
/// Half of the angle of a view, radians.
const HALF_VIEW: f64 = FRAC_PI_4;
/// Largest difference of a panorama's aspect from 2, relative.
const ASPECT: f64 = 0.01;

/// A pinhole view of a picture of another lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cut {
    /// Intrinsics of the picture, px.
    pub lens: Intrinsics,
    /// Projection of the picture's lens.
    pub distortion: Distortion,
    /// Rotation from the axes of the view to those of the lens.
    pub lens_from_view: DMat3,
    /// Intrinsics of the view, px.
    pub view: Intrinsics,
}

impl Cut {
    /// Position in the picture that pixel position `px` of the view shows, px; `None` outside the picture.
    fn source(&self, px: DVec2) -> Option<[f64; 2]> {
        let direction = self.lens_from_view * ray(&self.view, px).extend(1.0);
        let k = &self.lens;
        let seen = self.distortion.project(direction)?;
        let u = f64::from(k.fx) * seen.x + f64::from(k.cx);
        let v = f64::from(k.fy) * seen.y + f64::from(k.cy);
        let inside = (0.0..=k.width as f64).contains(&u) && (0.0..=k.height as f64).contains(&v);
        inside.then_some([u, v])
    }

    /// Share of the view that shows what lies between the left and top corner `low` and the right and bottom corner
    /// `high` of the picture, px; 0 to 1.
    pub fn share_of(&self, low: [f64; 2], high: [f64; 2]) -> f64 {
        /// Positions on each side that are tried.
        const SIDE: usize = 16;
        let Intrinsics { width, height, .. } = self.view;
        let at = |i: usize, side: usize| (i as f64 + 0.5) / SIDE as f64 * side as f64;
        let places =
            (0..SIDE * SIDE).map(|i| DVec2::new(at(i % SIDE, width), at(i / SIDE, height)));
        let inside = |px: &DVec2| {
            let source = self.source(*px);
            source.is_some_and(|px| (0..2).all(|i| (low[i]..=high[i]).contains(&px[i])))
        };
        places.filter(inside).count() as f64 / (SIDE * SIDE) as f64
    }

    /// Samples the view from its picture, whose pixels `mask` keeps (all without one). The mask of the result
    /// excludes pixels that the picture does not show; `None` where all count.
    pub fn apply(&self, picture: &Rgb, mask: Option<&Mask>) -> (Rgb, Option<Mask>) {
        let edge = match self.distortion {
            Distortion::Equirectangular => Edge::Wrapped,
            _ => Edge::Clamped,
        };
        let source = |px| self.source(px);
        let Some(mask) = mask else {
            let view = resample(picture, &self.view, edge, source);
            let Intrinsics { width, height, .. } = self.view;
            let at = |i: usize| DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let kept: Vec<bool> = (0..width * height).map(|i| source(at(i)).is_some()).collect();
            let mask = Mask::new(width, height, kept).filter(|mask| !mask.keeps_all());
            return (view, mask);
        };
        let (view, mask) = resample_masked(picture, mask, &self.view, edge, source);
        (view, mask.filter(|mask| !mask.keeps_all()))
    }
}

/// fx, fy, cx, cy of a whole panorama of `width` and `height` px: px per radian, and its middle.
pub fn panorama_intrinsics(width: f64, height: f64) -> [f64; 4] {
    [width / TAU, height / PI, 0.5 * width, 0.5 * height]
}

/// Returns whether a picture has the shape of a whole panorama: two to one.
pub fn has_panorama_shape(width: usize, height: usize) -> bool {
    (width as f64 / height as f64 / 2.0 - 1.0).abs() <= ASPECT
}

/// Square intrinsics of a view of `half` the angle, radians, with `focal` px.
fn square(half: f64, focal: f64) -> Intrinsics {
    let side = ((2.0 * focal * half.tan()).round() as usize).max(1);
    let focal = (0.5 * side as f64 / half.tan()) as f32;
    let middle = 0.5 * side as f32;
    Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, width: side, height: side }
}

/// Intrinsics of the views of a panorama of `width` px.
pub fn panorama_view(width: usize) -> Intrinsics {
    square(HALF_VIEW, width as f64 / TAU)
}

/// The cut of a panorama of `width` × `height` px in a direction.
pub fn panorama_cut(width: usize, height: usize, lens_from_view: DMat3) -> Cut {
    let [fx, fy, cx, cy] = panorama_intrinsics(width as f64, height as f64).map(|v| v as f32);
    Cut {
        lens: Intrinsics { fx, fy, cx, cy, width, height },
        distortion: Distortion::Equirectangular,
        lens_from_view,
        view: panorama_view(width),
    }
}

/// Axes of the views of all panoramas of a scene, each as a rotation from the view to the world. `panoramas` have
/// rotations to the world (OpenCV axes) and positions. The views are level with the panoramas' mean vertical. The
/// first one looks across the line on which the panoramas lie, or straight ahead of the first panorama where they
/// lie at one place.
pub fn shared_axes(panoramas: &[(DMat3, DVec3)]) -> [DMat3; YAWS] {
    let first = panoramas.first().map_or(DMat3::IDENTITY, |p| p.0);
    let down: DVec3 = panoramas.iter().map(|(rotation, _)| rotation.y_axis).sum();
    let down = down.normalize_or(first.y_axis);
    let level = |v: DVec3| (v - down * v.dot(down)).normalize_or(down.any_orthonormal_vector());
    let ahead = level(first.z_axis);
    let side = down.cross(ahead);
    let middle = panoramas.iter().map(|p| p.1).sum::<DVec3>() / panoramas.len().max(1) as f64;
    // Second moments of the positions on the horizontal plane, and the angle of their main axis.
    let (mut xx, mut xz, mut zz) = (0.0, 0.0, 0.0);
    for (_, position) in panoramas {
        let (x, z) = ((*position - middle).dot(side), (*position - middle).dot(ahead));
        (xx, xz, zz) = (xx + x * x, xz + x * z, zz + z * z);
    }
    // Of the two directions across the line, the one nearer to the first panorama's own.
    let across = if xx + zz > 0.0 { 0.5 * (2.0 * xz).atan2(xx - zz) } else { 0.0 };
    std::array::from_fn(|i| {
        let yaw = -across + TAU * i as f64 / YAWS as f64;
        let forward = side * yaw.sin() + ahead * yaw.cos();
        DMat3::from_cols(down.cross(forward), down, forward)
    })
}

/// End of the name of view `i` of a panorama: its angle from the first one, degrees.
pub fn view_label(i: usize) -> String {
    format!("_{:03}", 360 * i / YAWS)
}

/// Axes of the views of one panorama in its own frame: level, the first one straight ahead.
pub fn own_axes() -> [DMat3; YAWS] {
    shared_axes(&[(DMat3::IDENTITY, DVec3::ZERO)])
}

/// The largest pinhole view straight ahead of a fisheye picture, at most 90° wide: square in an image circle of
/// `radius` px, else of the picture's aspect. `None` where not even 11° lie inside.
pub fn fisheye_cut(lens: &Intrinsics, distortion: &Distortion, radius: Option<f64>) -> Option<Cut> {
    let aspect = match radius {
        Some(_) => 1.0,
        None => lens.height as f64 / lens.width as f64,
    };
    // The longer side has the angle.
    let view = |half: f64| {
        let long = 2.0 * f64::from(lens.fx) * half.tan();
        let (w, h) = if aspect > 1.0 { (long / aspect, long) } else { (long, long * aspect) };
        let (width, height) = ((w.round() as usize).max(1), (h.round() as usize).max(1));
        let focal = (0.5 * width.max(height) as f64 / half.tan()) as f32;
        let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
        Intrinsics { fx: focal, fy: focal, cx, cy, width, height }
    };
    let cut = |half| Cut {
        lens: *lens,
        distortion: *distortion,
        lens_from_view: DMat3::IDENTITY,
        view: view(half),
    };
    let centre = DVec2::new(f64::from(lens.cx), f64::from(lens.cy));
    let inside = |half: f64| {
        let cut = cut(half);
        border(&cut.view).all(|px| {
            cut.source(px)
                .is_some_and(|at| radius.is_none_or(|r| DVec2::from(at).distance(centre) <= r))
        })
    };
    let (mut low, mut high) = (0.1, HALF_VIEW);
    if inside(high) {
        return Some(cut(high));
    }
    if !inside(low) {
        return None;
    }
    for _ in 0..20 {
        let middle = 0.5 * (low + high);
        if inside(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    Some(cut(low))
}
