//! Disturbed inputs: errors of poses and focal lengths, and photographs that differ in quality.

use super::preparation::photos;
use crate::data::photographic::{blurred, compress, expose};
use glam::{Mat4, Quat, Vec3};
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::reconstruct::stages::check_pairs;
use subsplat::reconstruct::{DepthBounds, Result};
use subsplat::scene::pictures::Rgb;

/// A disturbance of the inputs of every case. Targets stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Disturbance {
    /// The poses of all inputs but the first are rotated by 0.5°, about an axis that depends on the
    /// input.
    Rotation,
    /// The positions of all inputs but the first are moved by 1 % of the depth across their viewing
    /// direction, in a direction that depends on the input.
    Position,
    /// The focal lengths of all inputs are 3 % too large.
    Focal,
    /// All inputs but the first are darker by one stop.
    Dark,
    /// All inputs but the first are blurred by 1.5 px of the target's size.
    Blur,
    /// All inputs are compressed as JPEG of quality 30.
    Jpeg,
}

/// Rotation of a disturbed pose, degrees.
const ROTATION: f32 = 0.5;
/// Shift of a disturbed position over the depth.
const SHIFT: f32 = 0.01;
/// Factor on a disturbed focal length.
const FOCAL: f32 = 1.03;
/// Change of exposure, stops.
const STOPS: f32 = -1.0;
/// σ of the blur, target px.
const BLUR: f32 = 1.5;
/// Quality of the compression.
const QUALITY: u8 = 30;

impl Disturbance {
    /// All disturbances with their names.
    pub const NAMED: [(&str, Self); 6] = [
        ("rotation", Self::Rotation),
        ("position", Self::Position),
        ("focal", Self::Focal),
        ("dark", Self::Dark),
        ("blur", Self::Blur),
        ("jpeg", Self::Jpeg),
    ];

    /// The name.
    pub fn name(self) -> &'static str {
        Self::NAMED.iter().find(|(_, d)| *d == self).map_or("", |(name, _)| name)
    }

    /// Returns true if the pictures change, not the cameras.
    pub(super) fn changes_pictures(self) -> bool {
        match self {
            Self::Dark | Self::Blur | Self::Jpeg => true,
            Self::Rotation | Self::Position | Self::Focal => false,
        }
    }

    /// Disturbs the inputs of a case. Without matched points, the depth of the scene is the geometric
    /// mean of `bounds`.
    ///
    /// # Errors
    /// Pictures of which no features can be taken.
    pub(super) fn apply(self, inputs: &mut [Cropped], bounds: &DepthBounds) -> Result<()> {
        let shift = match self {
            Self::Position => SHIFT * depth(inputs, bounds)?,
            _ => 0.0,
        };
        for (i, c) in inputs.iter_mut().enumerate() {
            let first = i == 0;
            match self {
                Self::Rotation if !first => move_by(c, turn(i)),
                Self::Position if !first => move_by(c, step(i, shift)),
                Self::Focal => {
                    for camera in [&mut c.input_camera, &mut c.target_camera] {
                        *camera = camera.zoomed_unchecked(FOCAL, FOCAL);
                    }
                }
                Self::Dark if !first => change(c, |rgb, _, _| expose(rgb, STOPS)),
                Self::Blur if !first => {
                    change(c, |rgb, width, ratio| *rgb = blurred(rgb, width, BLUR * ratio));
                }
                Self::Jpeg => {
                    compress(&mut c.input, QUALITY);
                    compress(&mut c.target, QUALITY);
                }
                Self::Rotation | Self::Position | Self::Dark | Self::Blur => {}
            }
        }
        Ok(())
    }
}

/// Multiples of the golden angle, rad, spread directions over the circle.
fn direction(i: usize) -> (f32, f32) {
    let angle = 2.4 * i as f32;
    (angle.cos(), angle.sin())
}

/// The rotation of input `i` in its camera's frame.
fn turn(i: usize) -> Mat4 {
    let (pitch, yaw) = direction(i);
    let axis = Vec3::new(pitch, yaw, 0.3).normalize_or(Vec3::X);
    Mat4::from_quat(Quat::from_axis_angle(axis, ROTATION.to_radians()))
}

/// The shift of input `i` by `length` world units in its camera's frame.
fn step(i: usize, length: f32) -> Mat4 {
    let (right, down) = direction(i);
    Mat4::from_translation(length * Vec3::new(right, down, 0.0))
}

/// Moves the cameras of an input.
fn move_by(c: &mut Cropped, motion: Mat4) {
    c.input_camera =
        c.input_camera.with_pose_unchecked(c.input_camera.world_from_camera() * motion);
    c.target_camera =
        c.target_camera.with_pose_unchecked(c.target_camera.world_from_camera() * motion);
}

/// Median depth of the points that are matched between neighbouring inputs, world units.
fn depth(inputs: &[Cropped], bounds: &DepthBounds) -> Result<f32> {
    let reports = check_pairs(&photos(inputs)?, |_| Ok(()))?;
    let [_, _, median, ..] = reports
        .iter()
        .find_map(|r| r.depth)
        .map_or_else(|| [(bounds.near * bounds.far).sqrt(); 5], |depth| depth.quantiles);
    Ok(median)
}

/// Changes both pictures of an input. `of` receives display values, the width, and the picture's
/// width over the target's.
fn change(c: &mut Cropped, of: impl Fn(&mut Vec<f32>, usize, f32)) {
    let target_width = c.target.width.max(1) as f32;
    for picture in [&mut c.input, &mut c.target] {
        let (w, h) = (picture.width, picture.height);
        let mut unit = picture.to_unit();
        of(&mut unit, w, w as f32 / target_width);
        if let Some(changed) = Rgb::from_unit(&unit, w, h) {
            *picture = changed;
        }
    }
}
