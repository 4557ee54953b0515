//! The pinhole camera, and the one definition of every geometric convention of the crate.
//!
//! * Camera axes are OpenCV's: +x right, +y down, +z forward (into the scene).
//! * `world_from_camera` maps camera coordinates to world coordinates (c2w in the paper);
//!   it is rigid.
//! * Intrinsics are in pixels of the picture they belong to. Pixel (i, j), column
//!   i and row j, has its centre at (i + 0.5, j + 0.5): the picture covers
//!   [0, width] × [0, height].
//! * A point projects to u = fx·x/z + cx, v = fy·y/z + cy.
//! * Quaternions are (w, x, y, z). Those of `glam` are (x, y, z, w), converted at the call.
//!
//! Normalised intrinsics (divided by the picture's size) appear in file formats and network
//! inputs only; [`Intrinsics::from_normalised`] and [`Intrinsics::normalised`] convert them.

use glam::{Mat3, Mat4, Vec2, Vec3};
use serde::ser::{Serialize, SerializeStruct, Serializer};
use std::fmt;
use thiserror::Error;

/// Width and height of a picture, px.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Size {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
}

impl Size {
    /// A size of `width` and `height`, px.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// Reason for which a camera is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("camera {what}: expected finite numbers, got {got}")]
    NotFinite {
        /// Part of the camera.
        what: &'static str,
        /// The offending values.
        got: String,
    },
    /// A focal length is zero or negative.
    #[error("camera focal length: expected fx > 0 and fy > 0 (pixels), got fx = {fx}, fy = {fy}")]
    Focal {
        /// Horizontal focal length, px.
        fx: f32,
        /// Vertical focal length, px.
        fy: f32,
    },
    /// The picture has no pixels, or a side longer than [`Intrinsics::SIDE_MAX`].
    #[error(
        "camera picture size: expected 1 to {} pixels a side, got {width}x{height}",
        Intrinsics::SIDE_MAX
    )]
    Size {
        /// Width, px.
        width: usize,
        /// Height, px.
        height: usize,
    },
    /// The pose is not a rotation and a translation.
    #[error(
        "camera pose: expected a rigid world_from_camera matrix (orthonormal rotation, determinant \
         +1, last row 0 0 0 1), got determinant {determinant:.4} and orthonormality error {error:.2e}"
    )]
    NotRigid {
        /// Determinant of the upper-left 3×3 block.
        determinant: f32,
        /// Largest entry of |RᵀR − I|, or of the last row's difference.
        error: f32,
    },
}

/// Pinhole intrinsics, in pixels of a `width` × `height` picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length, px.
    pub fx: f32,
    /// Vertical focal length, px.
    pub fy: f32,
    /// Principal point, px from the left edge (pixel centres at +0.5).
    pub cx: f32,
    /// Principal point, px from the top edge.
    pub cy: f32,
    /// Picture width, px.
    pub width: usize,
    /// Picture height, px.
    pub height: usize,
}

impl Intrinsics {
    /// Largest number of pixels along a side of a picture.
    pub const SIDE_MAX: usize = 32_768;

    /// Converts intrinsics divided by the picture's size, (fx/W, fy/H, cx/W, cy/H).
    pub fn from_normalised(k: [f32; 4], width: usize, height: usize) -> Self {
        let (w, h) = (width as f32, height as f32);
        Self { fx: k[0] * w, fy: k[1] * h, cx: k[2] * w, cy: k[3] * h, width, height }
    }

    /// Returns (fx/W, fy/H, cx/W, cy/H), the form of MVSplat and RealEstate10K.
    pub fn normalised(&self) -> [f32; 4] {
        let (w, h) = (self.width as f32, self.height as f32);
        [self.fx / w, self.fy / h, self.cx / w, self.cy / h]
    }

    /// Returns a camera with square pixels, the principal point in the middle, and `fov_x`
    /// radians from the left edge to the right.
    pub fn from_fov_x(fov_x: f32, width: usize, height: usize) -> Self {
        let f = 0.5 * width as f32 / (0.5 * fov_x).tan();
        Self { fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32, width, height }
    }

    /// Returns the same camera for a picture resampled to `width` × `height`.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        Self::from_normalised(self.normalised(), width, height)
    }

    /// Returns the same camera for the window of `width` × `height` pixels whose corner lies
    /// `left`, `top` pixels from this picture's.
    pub fn cropped(&self, left: f32, top: f32, width: usize, height: usize) -> Self {
        Self { cx: self.cx - left, cy: self.cy - top, width, height, ..*self }
    }

    /// Returns the horizontal field of view, radians.
    pub fn fov_x(&self) -> f32 {
        (self.cx / self.fx).atan() + ((self.width as f32 - self.cx) / self.fx).atan()
    }

    /// Returns the vertical field of view, radians.
    pub fn fov_y(&self) -> f32 {
        (self.cy / self.fy).atan() + ((self.height as f32 - self.cy) / self.fy).atan()
    }

    /// Returns the 3×3 matrix K, pixels.
    pub fn matrix(&self) -> Mat3 {
        Mat3::from_cols(
            Vec3::new(self.fx, 0.0, 0.0),
            Vec3::new(0.0, self.fy, 0.0),
            Vec3::new(self.cx, self.cy, 1.0),
        )
    }

    /// Projects a point in camera coordinates to pixels; z must be above 0.
    pub fn project(&self, in_camera: Vec3) -> Vec2 {
        Vec2::new(
            self.fx * in_camera.x / in_camera.z + self.cx,
            self.fy * in_camera.y / in_camera.z + self.cy,
        )
    }

    /// Returns the point at camera z = 1 on the ray of a pixel position.
    pub fn unproject(&self, px: Vec2) -> Vec3 {
        Vec3::new((px.x - self.cx) / self.fx, (px.y - self.cy) / self.fy, 1.0)
    }

    /// Returns the rows of ∂(u, v)/∂(x, y, z) at a point in camera coordinates, px per unit.
    pub fn jacobian(&self, in_camera: Vec3) -> [Vec3; 2] {
        let Vec3 { x, y, z } = in_camera;
        [
            Vec3::new(self.fx / z, 0.0, -self.fx * x / (z * z)),
            Vec3::new(0.0, self.fy / z, -self.fy * y / (z * z)),
        ]
    }

    /// Checks that the numbers are finite, the focal lengths positive and the sides of the
    /// picture within 1 to [`Intrinsics::SIDE_MAX`].
    ///
    /// # Errors
    /// [`CameraError`] names the part.
    pub fn check(&self) -> Result<(), CameraError> {
        let k = [self.fx, self.fy, self.cx, self.cy];
        if k.iter().any(|v| !v.is_finite()) {
            return Err(CameraError::NotFinite { what: "intrinsics", got: format!("{k:?}") });
        }
        // A side of 0 makes the focal length of a resized picture 0: the size is the cause.
        let side = 1..=Self::SIDE_MAX;
        if !side.contains(&self.width) || !side.contains(&self.height) {
            return Err(CameraError::Size { width: self.width, height: self.height });
        }
        if self.fx <= 0.0 || self.fy <= 0.0 {
            return Err(CameraError::Focal { fx: self.fx, fy: self.fy });
        }
        Ok(())
    }
}

/// Nearest and farthest depth: camera z, world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearFar {
    /// Nearest depth.
    pub near: f32,
    /// Farthest depth.
    pub far: f32,
}

impl NearFar {
    /// Depth range of every RealEstate10K view in pixelSplat and MVSplat.
    pub const RE10K: Self = Self::new(1.0, 100.0);

    /// Combines two depths, which may be invalid ([`NearFar::is_valid`]).
    pub const fn new(near: f32, far: f32) -> Self {
        Self { near, far }
    }

    /// Reports whether 0 < near < far, both finite.
    pub fn is_valid(self) -> bool {
        self.near > 0.0 && self.far > self.near && self.far.is_finite()
    }
}

/// A posed pinhole camera. [`Camera::new`] checks its numbers, and no later change of a camera
/// omits the check.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Intrinsics, px.
    pub(crate) intrinsics: Intrinsics,
    /// Camera to world, rigid.
    pub(crate) world_from_camera: Mat4,
}

/// An object with width, height, fx, fy, cx and cy, px, and `world_from_camera`: the upper three
/// rows of the matrix, row by row.
impl Serialize for Camera {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let k = &self.intrinsics;
        let mut object = serializer.serialize_struct("Camera", 7)?;
        object.serialize_field("width", &k.width)?;
        object.serialize_field("height", &k.height)?;
        object.serialize_field("fx", &k.fx)?;
        object.serialize_field("fy", &k.fy)?;
        object.serialize_field("cx", &k.cx)?;
        object.serialize_field("cy", &k.cy)?;
        let rows = self.world_from_camera.transpose().to_cols_array();
        object.serialize_field("world_from_camera", &rows[..12])?;
        object.end()
    }
}

impl Camera {
    /// Largest entry of |RᵀR − I| of a rotation. Pose files with six digits reach 1e-5;
    /// hand-edited ones more.
    pub const RIGID_TOLERANCE: f32 = 1e-2;

    /// Checks the intrinsics, and that the pose is finite and rigid.
    ///
    /// # Errors
    /// [`CameraError`] names the part, the expected value and the one found.
    pub fn new(intrinsics: Intrinsics, world_from_camera: Mat4) -> Result<Self, CameraError> {
        intrinsics.check()?;
        if !world_from_camera.is_finite() {
            let got = format!("{:?}", world_from_camera.transpose().to_cols_array_2d());
            return Err(CameraError::NotFinite { what: "pose", got });
        }
        let rotation = Mat3::from_mat4(world_from_camera);
        let gram = rotation.transpose() * rotation - Mat3::IDENTITY;
        let last = world_from_camera.row(3) - glam::Vec4::W;
        let error = gram
            .to_cols_array()
            .into_iter()
            .chain(last.to_array())
            .fold(0.0f32, |m, v| m.max(v.abs()));
        let determinant = rotation.determinant();
        if error > Self::RIGID_TOLERANCE || determinant < 0.0 {
            return Err(CameraError::NotRigid { determinant, error });
        }
        Ok(Self { intrinsics, world_from_camera })
    }

    /// Returns a camera without the checks of [`Camera::new`]: for values that were derived from a
    /// checked camera.
    pub fn new_unchecked(intrinsics: Intrinsics, world_from_camera: Mat4) -> Self {
        Self { intrinsics, world_from_camera }
    }

    /// Returns the same intrinsics with another pose, without the checks of [`Camera::new`].
    #[must_use]
    pub fn with_pose_unchecked(&self, world_from_camera: Mat4) -> Self {
        Self { world_from_camera, ..*self }
    }

    /// Returns the same pose with focal lengths multiplied by `fx` and `fy`, without a check.
    #[must_use]
    pub fn zoomed_unchecked(&self, fx: f32, fy: f32) -> Self {
        let k = self.intrinsics;
        Self { intrinsics: Intrinsics { fx: k.fx * fx, fy: k.fy * fy, ..k }, ..*self }
    }

    /// Returns the intrinsics, px.
    pub fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    /// Returns the pose, camera to world.
    pub fn world_from_camera(&self) -> Mat4 {
        self.world_from_camera
    }

    /// Returns the same pose with other intrinsics.
    ///
    /// # Errors
    /// Those of [`Intrinsics::check`].
    pub fn with_intrinsics(&self, intrinsics: Intrinsics) -> Result<Self, CameraError> {
        intrinsics.check()?;
        Ok(Self { intrinsics, ..*self })
    }

    /// Returns the inverse of the pose, (Rᵀ, −Rᵀt): world to camera.
    pub fn camera_from_world(&self) -> Mat4 {
        let r = self.rotation().transpose();
        let t = -(r * self.position());
        Mat4::from_cols(
            r.x_axis.extend(0.0),
            r.y_axis.extend(0.0),
            r.z_axis.extend(0.0),
            t.extend(1.0),
        )
    }

    /// Returns the rotation from camera to world.
    pub fn rotation(&self) -> Mat3 {
        Mat3::from_mat4(self.world_from_camera)
    }

    /// Returns the position of the camera, world coordinates.
    pub fn position(&self) -> Vec3 {
        self.world_from_camera.w_axis.truncate()
    }

    /// Maps a world point to camera coordinates as Rᵀ(p − t), which cancels less than
    /// Rᵀp − Rᵀt far from the origin.
    pub fn to_camera(&self, in_world: Vec3) -> Vec3 {
        self.rotation().transpose() * (in_world - self.position())
    }

    /// Projects a world point to pixels; `None` where its camera z is 0 or less.
    pub fn project(&self, in_world: Vec3) -> Option<Vec2> {
        let p = self.to_camera(in_world);
        (p.z > 0.0).then(|| self.intrinsics.project(p))
    }

    /// Returns the world point at camera z `depth` on the ray of a pixel position.
    pub fn unproject(&self, px: Vec2, depth: f32) -> Vec3 {
        self.world_from_camera.transform_point3(self.intrinsics.unproject(px) * depth)
    }

    /// Returns the same pose with the intrinsics of a picture resampled to `width` × `height`.
    ///
    /// # Errors
    /// A side outside 1 to [`Intrinsics::SIDE_MAX`]; a focal length that overflows or becomes 0.
    pub fn resized(&self, width: usize, height: usize) -> Result<Self, CameraError> {
        self.with_intrinsics(self.intrinsics.resized(width, height))
    }

    /// Returns the same as [`Camera::resized`] without the check, for the size of a picture that
    /// exists.
    pub fn resized_unchecked(&self, width: usize, height: usize) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn camera() -> Camera {
        let k = Intrinsics { fx: 300.0, fy: 310.0, cx: 130.0, cy: 120.0, width: 256, height: 240 };
        let pose = Mat4::from_rotation_translation(
            Quat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1),
            Vec3::new(1.0, -2.0, 0.5),
        );
        Camera::new(k, pose).unwrap()
    }

    #[test]
    fn json_has_intrinsics_and_the_rows_of_the_pose() {
        let c = camera();
        let json = serde_json::to_value(c).unwrap();
        assert_eq!((&json["width"], &json["height"]), (&256.into(), &240.into()));
        let number = |v: &serde_json::Value| v.as_f64().unwrap() as f32;
        let k = ["fx", "fy", "cx", "cy"].map(|key| number(&json[key]));
        assert_eq!(k, [300.0, 310.0, 130.0, 120.0]);
        let rows: Vec<f32> =
            json["world_from_camera"].as_array().unwrap().iter().map(number).collect();
        assert_eq!((rows.len(), rows[3], rows[7], rows[11]), (12, 1.0, -2.0, 0.5));
        assert_eq!(rows[1], c.world_from_camera.y_axis.x);
    }

    #[test]
    fn unproject_then_project_is_identity() {
        let c = camera();
        let px = Vec2::new(17.25, 200.5);
        let p = c.intrinsics.unproject(px) * 3.7;
        let world = c.world_from_camera.transform_point3(p);
        assert!((c.project(world).unwrap() - px).length() < 1e-3);
        assert!(c.project(c.world_from_camera.transform_point3(-p)).is_none());
    }

    #[test]
    fn jacobian_is_the_derivative_of_projection() {
        let c = camera().intrinsics;
        let p = Vec3::new(0.4, -0.3, 2.0);
        let j = c.jacobian(p);
        for axis in 0..3 {
            let mut d = Vec3::ZERO;
            d[axis] = 1e-2;
            let numeric = (c.project(p + d) - c.project(p - d)) / 2e-2;
            assert!((numeric.x - j[0][axis]).abs() < 0.02, "{numeric} {:?}", j);
            assert!((numeric.y - j[1][axis]).abs() < 0.02, "{numeric} {:?}", j);
        }
    }

    #[test]
    fn camera_from_world_inverts() {
        let c = camera();
        let e = c.camera_from_world() * c.world_from_camera - Mat4::IDENTITY;
        assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-6));
    }

    #[test]
    fn bad_cameras_are_refused_by_name() {
        let good = camera();
        let mut k = good.intrinsics;
        k.fx = 0.0;
        assert!(matches!(Camera::new(k, good.world_from_camera), Err(CameraError::Focal { .. })));
        k.fx = f32::NAN;
        assert!(matches!(
            Camera::new(k, good.world_from_camera),
            Err(CameraError::NotFinite { .. })
        ));
        let flipped = good.world_from_camera * Mat4::from_scale(Vec3::new(1.0, 1.0, -1.0));
        assert!(matches!(Camera::new(good.intrinsics, flipped), Err(CameraError::NotRigid { .. })));
        let scaled = good.world_from_camera * Mat4::from_scale(Vec3::splat(2.0));
        assert!(matches!(Camera::new(good.intrinsics, scaled), Err(CameraError::NotRigid { .. })));
        for bad in [f32::NAN, f32::INFINITY] {
            let mut pose = good.world_from_camera;
            pose.w_axis.y = bad;
            let error = Camera::new(good.intrinsics, pose).unwrap_err();
            assert!(matches!(error, CameraError::NotFinite { what: "pose", .. }), "{error}");
        }
    }

    #[test]
    fn changed_intrinsics_are_checked() {
        let good = camera();
        let k = good.intrinsics();
        let larger = good.resized(512, 480).unwrap();
        assert_eq!(larger.intrinsics(), k.resized(512, 480));
        assert_eq!(larger.world_from_camera(), good.world_from_camera());
        assert_eq!(larger.with_intrinsics(k), Ok(good));
        for (width, height) in [(0, 48), (64, 0), (1_000_000, 1_000_000)] {
            let message = good.resized(width, height).unwrap_err().to_string();
            assert!(message.contains("1 to 32768 pixels"), "{message}");
            assert!(message.contains(&format!("{width}x{height}")), "{message}");
        }
        for fy in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(good.with_intrinsics(Intrinsics { fy, ..k }).is_err(), "{fy}");
        }
    }

    #[test]
    fn resize_and_crop_follow_the_pixels() {
        let k = camera().intrinsics;
        let p = Vec3::new(0.1, 0.2, 1.0);
        let full = k.project(p);
        let half = k.resized(128, 120).project(p);
        assert!((full * 0.5 - half).length() < 1e-4);
        let crop = k.cropped(10.0, 20.0, 64, 64).project(p);
        assert!((full - Vec2::new(10.0, 20.0) - crop).length() < 1e-4);
    }
}
