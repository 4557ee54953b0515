//! An interactive camera: around a point (orbit) or through the scene (fly).
//!
//! This module handles no windows and no events; the application passes pixels and seconds.
//!
//! Both modes move the same pose, so a change of mode moves nothing. Rotations are about the
//! world's up vector and the camera's x axis, which keeps the horizon level.

use glam::{Mat4, Quat, Vec2, Vec3};
use std::f32::consts::PI;
use subsplat_kernels::camera::{Camera, CameraError, Intrinsics};

/// Fraction of points outside each end of [`Bounds`], along each axis.
const OUTLIER_FRACTION: f32 = 0.02;
/// Minimum extent of a scene, world units, for scenes of a single point.
const EXTENT_MIN: f32 = 1e-3;
/// Rotation of a drag over the whole height of the picture, radians.
const DRAG_ANGLE: f32 = PI;
/// Maximum elevation, radians. Beyond 90°, left and right would be exchanged.
const ELEVATION_MAX: f32 = 89.0 * PI / 180.0;
/// Factor of the distance to the pivot for one step of the wheel forward.
const WHEEL_DISTANCE: f32 = 0.9;
/// Factor of the speed for one step of the wheel forward.
const WHEEL_SPEED: f32 = 1.25;
/// Initial speed, scene radii per second.
const SPEED: f32 = 0.4;
/// Factor of the speed at [`Pace::Fast`].
const FAST_FACTOR: f32 = 4.0;
/// Limits of the distance to the pivot and of the speed per second, scene radii.
const RANGE: (f32, f32) = (1e-3, 1e3);

/// The box that holds the middle 96 % of points along each axis, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Minimum coordinates.
    pub low: Vec3,
    /// Maximum coordinates.
    pub high: Vec3,
}

impl Bounds {
    /// Computes the bounds of `points` without those that are not finite; `None` where no point
    /// is left.
    pub fn of(points: impl Iterator<Item = [f32; 3]>) -> Option<Self> {
        let mut axes: [Vec<f32>; 3] = Default::default();
        for p in points.filter(|p| p.iter().all(|v| v.is_finite())) {
            axes.iter_mut().zip(p).for_each(|(axis, v)| axis.push(v));
        }
        let mut ends = [Vec3::ZERO; 2];
        for (a, axis) in axes.iter_mut().enumerate() {
            for (end, q) in ends.iter_mut().zip([OUTLIER_FRACTION, 1.0 - OUTLIER_FRACTION]) {
                let index = (q * axis.len().checked_sub(1)? as f32) as usize;
                end[a] = *axis.select_nth_unstable_by(index, f32::total_cmp).1;
            }
        }
        Some(Self { low: ends[0], high: ends[1] })
    }

    /// Returns the centre.
    pub fn middle(&self) -> Vec3 {
        0.5 * (self.low + self.high)
    }

    /// Returns half the diagonal, world units.
    pub fn radius(&self) -> f32 {
        (0.5 * (self.high - self.low).length()).max(EXTENT_MIN)
    }

    /// Returns a camera along +z that sees the whole box: `fov_x` radians horizontally,
    /// `side`×`side` pixels.
    ///
    /// # Errors
    /// A field of view, a side or a box without a valid camera.
    pub fn camera(&self, fov_x: f32, side: usize) -> Result<Camera, CameraError> {
        let extent = self.high - self.low;
        let width = extent.truncate().max_element().max(EXTENT_MIN);
        let distance = 0.5 * width / (0.5 * fov_x).tan() + 0.5 * extent.z;
        Camera::new(
            Intrinsics::from_fov_x(fov_x, side, side),
            Mat4::from_translation(self.middle() - distance * Vec3::Z),
        )
    }
}

/// Returns the mean up direction (−y) of `cameras`, world frame, unit length; −y of the world for
/// no cameras or for a mean of zero.
pub fn up_of<'a>(cameras: impl Iterator<Item = &'a Camera>) -> Vec3 {
    cameras.map(|c| -c.rotation().y_axis).sum::<Vec3>().try_normalize().unwrap_or(Vec3::NEG_Y)
}

/// Returns `k` adapted to a picture of `width`×`height` px. Square pixels stay square and the
/// whole former picture stays visible, so a picture of another aspect ratio shows more at two
/// sides.
pub fn fitted(k: &Intrinsics, width: usize, height: usize) -> Intrinsics {
    let sides = Vec2::new(width as f32, height as f32);
    let old_sides = Vec2::new(k.width as f32, k.height as f32);
    let scale = (sides / old_sides).min_element();
    let principal = 0.5 * sides + scale * (Vec2::new(k.cx, k.cy) - 0.5 * old_sides);
    let (cx, cy) = (principal.x, principal.y);
    Intrinsics { fx: scale * k.fx, fy: scale * k.fy, cx, cy, width, height }
}

/// Meaning of drags and of the wheel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Drags rotate around a point in front of the camera; the wheel changes the distance to it.
    Orbit,
    /// Drags rotate about the eye; the wheel changes the speed of [`Navigator::fly`].
    Fly,
}

/// Speed of [`Navigator::fly`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// The speed set by the wheel.
    #[default]
    Normal,
    /// Four times the speed set by the wheel.
    Fast,
}

/// Initial state of a [`Navigator`].
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Initial camera, and the camera after [`Navigator::reset`].
    pub home: Camera,
    /// Up vector of the world, of any length.
    pub up: Vec3,
    /// Distance from the eye of `home` to the pivot, world units.
    pub distance: f32,
    /// Half the scene's size, world units. Speeds are proportional to it.
    pub radius: f32,
}

/// An interactive camera. Inputs that would make its pose infinite or NaN are ignored.
#[derive(Clone, Debug)]
pub struct Navigator {
    start: Start,
    mode: Mode,
    eye: Vec3,
    /// From camera to world, unit length.
    rotation: Quat,
    /// Distance from the eye to the pivot, which lies on the optical axis, world units.
    distance: f32,
    /// World units per second.
    speed: f32,
    /// Width and height of the picture, px.
    window: (usize, usize),
}

/// Returns `v` where it is positive and finite, else `default`.
fn positive(v: f32, default: f32) -> f32 {
    if v > 0.0 && v.is_finite() { v } else { default }
}

impl Navigator {
    /// Starts in orbit mode at `home`, for a picture of home's size. A `radius` that is not
    /// positive and finite is replaced by 1, a `distance` by the radius, and an `up` without
    /// direction by home's −y.
    pub fn new(start: Start) -> Self {
        let radius = positive(start.radius, 1.0);
        let distance = positive(start.distance, radius);
        let up = start.up.try_normalize().unwrap_or(-start.home.rotation().y_axis);
        let k = start.home.intrinsics();
        let mut new = Self {
            start: Start { up, distance, radius, ..start },
            mode: Mode::Orbit,
            eye: Vec3::ZERO,
            rotation: Quat::IDENTITY,
            distance,
            speed: SPEED * radius,
            window: (k.width, k.height),
        };
        new.reset();
        new
    }

    /// Returns the mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Switches to the other mode at the same pose.
    pub fn toggle(&mut self) {
        self.mode = match self.mode {
            Mode::Orbit => Mode::Fly,
            Mode::Fly => Mode::Orbit,
        };
    }

    /// Returns to `home` and to the initial speed. The mode is kept.
    pub fn reset(&mut self) {
        let home = &self.start.home;
        self.eye = home.position();
        self.rotation = Quat::from_mat3(&home.rotation()).normalize();
        self.distance = self.start.distance;
        self.speed = SPEED * self.start.radius;
    }

    /// Sets the size of the picture, px. A side outside 1 to [`Intrinsics::SIDE_MAX`] is ignored.
    pub fn resize(&mut self, width: usize, height: usize) {
        let sides = 1..=Intrinsics::SIDE_MAX;
        if sides.contains(&width) && sides.contains(&height) {
            self.window = (width, height);
        }
    }

    /// Returns the current camera, for a picture of the last size set.
    pub fn camera(&self) -> Camera {
        let (width, height) = self.window;
        let intrinsics = fitted(&self.start.home.intrinsics(), width, height);
        Camera::new_unchecked(intrinsics, Mat4::from_rotation_translation(self.rotation, self.eye))
    }

    /// Returns the pivot of orbit mode, world frame.
    pub fn pivot(&self) -> Vec3 {
        self.eye + self.distance * self.forward()
    }

    fn forward(&self) -> Vec3 {
        self.rotation * Vec3::Z
    }

    /// Changes the pose, unless the new one is not finite.
    fn set_pose(&mut self, rotation: Quat, eye: Vec3) {
        if rotation.is_finite() && eye.is_finite() {
            (self.rotation, self.eye) = (rotation, eye);
        }
    }

    /// Rotates the camera by a drag of `px` (x right, y down). In orbit mode the scene in front
    /// of the pivot follows the cursor; in fly mode the view direction does.
    pub fn rotate(&mut self, px: Vec2) {
        let pivot = self.pivot();
        let angle = px * (DRAG_ANGLE / self.window.1 as f32);
        let elevation = self.forward().dot(self.start.up).clamp(-1.0, 1.0).asin();
        // A home that is steeper than the limit keeps its elevation as the limit.
        let limit = ELEVATION_MAX.max(elevation.abs());
        let raise = (elevation - angle.y).clamp(-limit, limit) - elevation;
        let about_up = Quat::from_axis_angle(self.start.up, -angle.x);
        let rotation = (about_up * self.rotation * Quat::from_rotation_x(raise)).normalize();
        let eye = match self.mode {
            Mode::Orbit => pivot - self.distance * (rotation * Vec3::Z),
            Mode::Fly => self.eye,
        };
        self.set_pose(rotation, eye);
    }

    /// Shifts the camera by a drag of `px` (x right, y down). Points at the distance of the pivot
    /// follow the cursor.
    pub fn pan(&mut self, px: Vec2) {
        let k = self.camera().intrinsics();
        let shift = Vec3::new(px.x / k.fx, px.y / k.fy, 0.0) * self.distance;
        self.set_pose(self.rotation, self.eye - self.rotation * shift);
    }

    /// Applies steps of the wheel, positive forward: nearer to the pivot in orbit mode, faster in
    /// fly mode.
    pub fn wheel(&mut self, steps: f32) {
        if steps.is_nan() {
            return;
        }
        let within = |v: f32| v.clamp(RANGE.0 * self.start.radius, RANGE.1 * self.start.radius);
        match self.mode {
            Mode::Orbit => {
                let pivot = self.pivot();
                self.distance = within(self.distance * WHEEL_DISTANCE.powf(steps));
                self.set_pose(self.rotation, pivot - self.distance * self.forward());
            }
            Mode::Fly => self.speed = within(self.speed * WHEEL_SPEED.powf(steps)),
        }
    }

    /// Moves the camera and the pivot for `seconds` along `direction`: right, up (of the world)
    /// and forward, each −1 to 1. The speed is the same in diagonal directions.
    pub fn fly(&mut self, direction: [f32; 3], seconds: f32, pace: Pace) {
        let [right, up, forward] = direction;
        let along = self.rotation * Vec3::new(right, 0.0, forward) + up * self.start.up;
        let speed = match pace {
            Pace::Normal => self.speed,
            Pace::Fast => FAST_FACTOR * self.speed,
        };
        let step = along.clamp_length_max(1.0) * (speed * seconds);
        self.set_pose(self.rotation, self.eye + step);
    }
}
