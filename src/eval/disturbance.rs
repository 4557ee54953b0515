//! Disturbed inputs: errors of poses and focal lengths, and photographs that differ in quality.

use crate::data::crop::Cropped;
use crate::data::photographic::{blurred, compress, expose};
use crate::io::image::Rgb;
use glam::{Mat4, Quat, Vec3};

/// A disturbance of the inputs of every case. Targets stay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Disturbance {
    /// The poses of all inputs but the first are rotated by 0.5°, about an axis that depends on the
    /// input.
    Rotation,
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
    pub const NAMED: [(&str, Self); 5] = [
        ("rotation", Self::Rotation),
        ("focal", Self::Focal),
        ("dark", Self::Dark),
        ("blur", Self::Blur),
        ("jpeg", Self::Jpeg),
    ];

    /// The name.
    pub fn name(self) -> &'static str {
        Self::NAMED.iter().find(|(_, d)| *d == self).map_or("", |(name, _)| name)
    }

    /// Disturbs the inputs of a case.
    pub(super) fn apply(self, inputs: &mut [Cropped]) {
        for (i, c) in inputs.iter_mut().enumerate() {
            let first = i == 0;
            match self {
                Self::Rotation if !first => rotate(c, i),
                Self::Focal => {
                    for camera in [&mut c.input_camera, &mut c.target_camera] {
                        camera.intrinsics.fx *= FOCAL;
                        camera.intrinsics.fy *= FOCAL;
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
                Self::Rotation | Self::Dark | Self::Blur => {}
            }
        }
    }
}

/// Rotates the cameras of input `i`.
fn rotate(c: &mut Cropped, i: usize) {
    // Multiples of the golden angle spread the axes over the circle of pitch and yaw.
    let angle = 2.4 * i as f32;
    let axis = Vec3::new(angle.cos(), angle.sin(), 0.3).normalize_or(Vec3::X);
    let rotation = Mat4::from_quat(Quat::from_axis_angle(axis, ROTATION.to_radians()));
    c.input_camera.world_from_camera *= rotation;
    c.target_camera.world_from_camera *= rotation;
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
