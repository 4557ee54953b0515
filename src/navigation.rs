//! A camera that is moved by hand: around a point (orbit) or through the scene (fly).
//! No window and no events here; an application says what was dragged and for how long.
//!
//! Both modes move the same pose, so that changing the mode never jumps. Turning goes about
//! the world's up and the camera's own x axis, which keeps the horizon as it was.

use crate::camera::{Camera, Intrinsics};
use glam::{Mat4, Quat, Vec2, Vec3};
use std::f32::consts::PI;

/// Share of points beyond each end of [`Bounds`], along each axis.
const OUTLIERS: f32 = 0.02;
/// Smallest extent of a scene, world units: a single point has one, too.
const EXTENT_MIN: f32 = 1e-3;
/// Angle of a drag over the picture's whole height, radians.
const TURN: f32 = PI;
/// Steepest look up or down that turning reaches, radians: beyond, left and right would
/// change places.
const ELEVATION_MAX: f32 = 89.0 * PI / 180.0;
/// Distance to the pivot after one step of the wheel forward, over that before.
const DOLLY: f32 = 0.9;
/// Speed after one step of the wheel forward, over that before.
const FASTER: f32 = 1.25;
/// Scene radii a second at first.
const SPEED: f32 = 0.4;
/// How much faster in haste.
const HASTE: f32 = 4.0;
/// Nearest and farthest pivot, and slowest and fastest flight a second, in scene radii.
const RANGE: (f32, f32) = (1e-3, 1e3);

/// The box that holds the middle 96 % of points along each axis, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Least coordinates.
    pub low: Vec3,
    /// Greatest coordinates.
    pub high: Vec3,
}

impl Bounds {
    /// Of `points`, those that are not finite left out; `None` where none is left.
    pub fn of(points: impl Iterator<Item = [f32; 3]>) -> Option<Self> {
        let mut axes: [Vec<f32>; 3] = Default::default();
        for p in points.filter(|p| p.iter().all(|v| v.is_finite())) {
            axes.iter_mut().zip(p).for_each(|(axis, v)| axis.push(v));
        }
        let mut ends = [Vec3::ZERO; 2];
        for (a, axis) in axes.iter_mut().enumerate() {
            for (end, q) in ends.iter_mut().zip([OUTLIERS, 1.0 - OUTLIERS]) {
                let place = (q * axis.len().checked_sub(1)? as f32) as usize;
                end[a] = *axis.select_nth_unstable_by(place, f32::total_cmp).1;
            }
        }
        Some(Self { low: ends[0], high: ends[1] })
    }

    /// Half way between the ends.
    pub fn middle(&self) -> Vec3 {
        0.5 * (self.low + self.high)
    }

    /// Half the diagonal, world units.
    pub fn radius(&self) -> f32 {
        (0.5 * (self.high - self.low).length()).max(EXTENT_MIN)
    }

    /// A camera that looks along +z at all of it: `fov_x` radians from left to right,
    /// `side`×`side` pixels.
    pub fn camera(&self, fov_x: f32, side: usize) -> Camera {
        let extent = self.high - self.low;
        let wide = extent.truncate().max_element().max(EXTENT_MIN);
        let away = 0.5 * wide / (0.5 * fov_x).tan() + 0.5 * extent.z;
        Camera {
            intrinsics: Intrinsics::from_fov_x(fov_x, side, side),
            world_from_camera: Mat4::from_translation(self.middle() - away * Vec3::Z),
        }
    }
}

/// The direction that `cameras` hold upwards on average: their mean −y, world frame, unit
/// length. −y of the world where there is none, or where they cancel.
pub fn up_of<'a>(cameras: impl Iterator<Item = &'a Camera>) -> Vec3 {
    cameras.map(|c| -c.rotation().y_axis).sum::<Vec3>().try_normalize().unwrap_or(Vec3::NEG_Y)
}

/// `k` for a picture of `width`×`height` px: square pixels stay square and all that was
/// in the picture stays in it, so that a picture of another shape shows more at two sides.
pub fn fitted(k: &Intrinsics, width: usize, height: usize) -> Intrinsics {
    let sides = Vec2::new(width as f32, height as f32);
    let before = Vec2::new(k.width as f32, k.height as f32);
    let scale = (sides / before).min_element();
    let principal = 0.5 * sides + scale * (Vec2::new(k.cx, k.cy) - 0.5 * before);
    let (cx, cy) = (principal.x, principal.y);
    Intrinsics { fx: scale * k.fx, fy: scale * k.fy, cx, cy, width, height }
}

/// How a drag and the wheel are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Around a point in front of the camera.
    Orbit,
    /// The eye stays where it is, and keys move it.
    Fly,
}

/// What a navigation starts from.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Camera to begin with and to come back to.
    pub home: Camera,
    /// The world's up; of any length.
    pub up: Vec3,
    /// From the eye of `home` to the point that it turns around, world units.
    pub distance: f32,
    /// Half the scene's size, world units: steps go by it.
    pub radius: f32,
}

/// A camera that is moved by hand.
#[derive(Clone, Debug)]
pub struct Navigator {
    start: Start,
    mode: Mode,
    eye: Vec3,
    /// From camera to world, unit length.
    rotation: Quat,
    /// From the eye to the pivot, which lies on the optical axis, world units.
    distance: f32,
    /// World units a second.
    speed: f32,
    /// Width and height of the picture, px.
    window: (usize, usize),
}

fn positive(v: f32, otherwise: f32) -> f32 {
    if v > 0.0 && v.is_finite() { v } else { otherwise }
}

impl Navigator {
    /// In orbit, at home, for a picture of home's size. A `radius` or `distance` that is
    /// not above 0 and finite counts as 1 and as the radius, an `up` without direction as
    /// home's −y.
    pub fn new(start: Start) -> Self {
        let radius = positive(start.radius, 1.0);
        let distance = positive(start.distance, radius);
        let up = start.up.try_normalize().unwrap_or(-start.home.rotation().y_axis);
        let k = start.home.intrinsics;
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

    /// How drags and the wheel are taken.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// The other mode, from the same place.
    pub fn toggle(&mut self) {
        self.mode = match self.mode {
            Mode::Orbit => Mode::Fly,
            Mode::Fly => Mode::Orbit,
        };
    }

    /// Home, at the first speed; the mode stays.
    pub fn reset(&mut self) {
        let home = &self.start.home;
        self.eye = home.position();
        self.rotation = Quat::from_mat3(&home.rotation()).normalize();
        self.distance = self.start.distance;
        self.speed = SPEED * self.start.radius;
    }

    /// For a picture of `width`×`height` px; one without pixels changes nothing.
    pub fn resize(&mut self, width: usize, height: usize) {
        if width > 0 && height > 0 {
            self.window = (width, height);
        }
    }

    /// The camera as it stands, for a picture of the size that was said last.
    pub fn camera(&self) -> Camera {
        let (width, height) = self.window;
        Camera {
            intrinsics: fitted(&self.start.home.intrinsics, width, height),
            world_from_camera: Mat4::from_rotation_translation(self.rotation, self.eye),
        }
    }

    /// The point that orbit turns around, world.
    pub fn pivot(&self) -> Vec3 {
        self.eye + self.distance * self.forward()
    }

    fn forward(&self) -> Vec3 {
        self.rotation * Vec3::Z
    }

    /// A drag of `px` (x right, y down) turns: in orbit what lies before the pivot goes
    /// with the cursor, in flight the look does.
    pub fn turn(&mut self, px: Vec2) {
        let pivot = self.pivot();
        let angle = px * (TURN / self.window.1 as f32);
        let elevation = self.forward().dot(self.start.up).clamp(-1.0, 1.0).asin();
        // A home that looks steeper than the limit may go back, and no farther.
        let limit = ELEVATION_MAX.max(elevation.abs());
        let raise = (elevation - angle.y).clamp(-limit, limit) - elevation;
        let about_up = Quat::from_axis_angle(self.start.up, -angle.x);
        self.rotation = (about_up * self.rotation * Quat::from_rotation_x(raise)).normalize();
        if self.mode == Mode::Orbit {
            self.eye = pivot - self.distance * self.forward();
        }
    }

    /// A drag of `px` (x right, y down) shifts the camera so that what is as far as the
    /// pivot goes with the cursor.
    pub fn pan(&mut self, px: Vec2) {
        let k = self.camera().intrinsics;
        let shift = Vec3::new(px.x / k.fx, px.y / k.fy, 0.0) * self.distance;
        self.eye -= self.rotation * shift;
    }

    /// The wheel, in steps forward: towards the pivot in orbit, faster in flight.
    pub fn wheel(&mut self, steps: f32) {
        let within = |v: f32| v.clamp(RANGE.0 * self.start.radius, RANGE.1 * self.start.radius);
        match self.mode {
            Mode::Orbit => {
                let pivot = self.pivot();
                self.distance = within(self.distance * DOLLY.powf(steps));
                self.eye = pivot - self.distance * self.forward();
            }
            Mode::Fly => self.speed = within(self.speed * FASTER.powf(steps)),
        }
    }

    /// Moves for `seconds` towards `right`, `up` (the world's) and `forward`, each −1 to 1,
    /// the pivot too; no faster aslant. `haste` is four times as fast.
    pub fn fly(&mut self, [right, up, forward]: [f32; 3], seconds: f32, haste: bool) {
        let along = self.rotation * Vec3::new(right, 0.0, forward) + up * self.start.up;
        let pace = if haste { HASTE * self.speed } else { self.speed };
        self.eye += along.clamp_length_max(1.0) * (pace * seconds);
    }
}
