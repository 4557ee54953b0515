//! Candidate corrections of the usual mistakes in camera files.
//!
//! Each *reading* undoes one mistake. The reading whose cameras fit the matches shows the
//! required change.
//!
//! Two views determine the relative pose only, without its length. The check cannot see mistakes
//! that leave the relative pose unchanged, such as a wrong scale or OpenGL axes under a sideways
//! motion without rotation. Those mistakes do not harm a reconstruction from the pair.

use glam::{Mat3, Mat4, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// An alternative interpretation of the two cameras.
#[derive(Clone, Debug)]
pub(super) struct Reading {
    /// Short identifier for programs.
    pub name: String,
    /// Completes "the poses fit if …".
    pub clause: String,
    /// 0: a usual mistake; 1: a focal length from a search; 2: unusual axes. A reading is reported
    /// only if no reading of a lower rank fits.
    pub rank: u8,
    /// Factor of the focal length, for readings that change it.
    pub factor: Option<f32>,
    /// The two cameras of this reading.
    pub cameras: [Camera; 2],
}

impl Reading {
    /// The largest rank.
    pub(super) const LAST_RANK: u8 = 2;
}

/// Returns all alternative readings of two cameras for photographs of `sizes` px.
pub(super) fn readings(cameras: &[Camera; 2], sizes: [(usize, usize); 2]) -> Vec<Reading> {
    let mut all = pose_readings(cameras);
    all.extend(rotated_readings(cameras, sizes));
    all.extend(intrinsics_readings(cameras));
    all.extend(focal_readings(cameras));
    all.extend(axes_readings(cameras));
    all
}

/// Builds a usual mistake (rank 0) that applies `change` to both cameras.
fn reading(
    name: impl Into<String>,
    clause: impl Into<String>,
    cameras: &[Camera; 2],
    change: impl Fn(&Camera) -> Camera,
) -> Reading {
    let cameras = cameras.each_ref().map(change);
    Reading { name: name.into(), clause: clause.into(), rank: 0, factor: None, cameras }
}

/// Returns the camera with another pose.
fn posed(camera: &Camera, world_from_camera: Mat4) -> Camera {
    camera.with_pose_unchecked(world_from_camera)
}

/// Returns the camera-from-world matrix.
fn inverse(camera: &Camera) -> Mat4 {
    camera.camera_from_world()
}

/// Returns diag(1, −1, −1): OpenGL's axes to OpenCV's and back.
fn opengl() -> Mat4 {
    Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0))
}

/// Returns the readings that change the direction or the axes of the poses.
fn pose_readings(cameras: &[Camera; 2]) -> Vec<Reading> {
    let with = |rotation: Mat3, eye: Vec3| {
        Mat4::from_cols(
            rotation.x_axis.extend(0.0),
            rotation.y_axis.extend(0.0),
            rotation.z_axis.extend(0.0),
            eye.extend(1.0),
        )
    };
    let mut all = vec![
        reading(
            "opengl",
            "the y and z axes of their cameras are turned round: the file has OpenGL's axes (x right, y up, \
             z back; nerfstudio, Blender) where its format has OpenCV's, or the reverse",
            cameras,
            |c| posed(c, c.world_from_camera() * opengl()),
        ),
        reading(
            "world_to_camera",
            "the matrices are read as world-to-camera (COLMAP, RealEstate10K) and inverted",
            cameras,
            |c| posed(c, inverse(c)),
        ),
        reading(
            "world_to_camera_opengl",
            "the matrices are read as world-to-camera with OpenGL axes",
            cameras,
            |c| posed(c, inverse(c) * opengl()),
        ),
        reading(
            "rotation_transposed",
            "the rotations are transposed (world-to-camera rotation beside the camera's position)",
            cameras,
            |c| posed(c, with(c.rotation().transpose(), c.position())),
        ),
        reading(
            "translation_world_to_camera",
            "the translations are read as world-to-camera (the rotations are right)",
            cameras,
            |c| posed(c, with(c.rotation(), -(c.rotation() * c.position()))),
        ),
    ];
    let exchanged = [
        posed(&cameras[0], cameras[1].world_from_camera()),
        posed(&cameras[1], cameras[0].world_from_camera()),
    ];
    all.push(Reading {
        name: "exchanged".into(),
        clause: "the two photographs' cameras are exchanged (file order?)".into(),
        rank: 0,
        factor: None,
        cameras: exchanged,
    });
    all
}

/// Returns the readings for photographs that were rotated without their cameras, as EXIF
/// orientation does.
fn rotated_readings(cameras: &[Camera; 2], sizes: [(usize, usize); 2]) -> Vec<Reading> {
    let turns = [
        (1, "turned_clockwise", "the photographs are turned back by 90° counter-clockwise"),
        (2, "turned_half", "the photographs are turned by 180°"),
        (3, "turned_counter_clockwise", "the photographs are turned back by 90° clockwise"),
    ];
    let build = |(quarters, name, clause): (usize, &str, &str)| {
        let turn = |i: usize| {
            let mut camera = cameras[i];
            (0..quarters).for_each(|_| camera = rotated_clockwise(&camera));
            camera.resized_unchecked(sizes[i].0, sizes[i].1)
        };
        let clause = format!("{clause} (EXIF orientation?)");
        Reading { name: name.into(), clause, rank: 0, factor: None, cameras: [turn(0), turn(1)] }
    };
    turns.into_iter().map(build).collect()
}

/// Returns the camera of the photograph rotated clockwise by 90°: new x is old −y, new y is old x.
fn rotated_clockwise(camera: &Camera) -> Camera {
    let k = camera.intrinsics();
    let old_from_new = Mat4::from_mat3(Mat3::from_cols(Vec3::NEG_Y, Vec3::X, Vec3::Z));
    let intrinsics = Intrinsics {
        fx: k.fy,
        fy: k.fx,
        cx: k.height as f32 - k.cy,
        cy: k.cx,
        width: k.height,
        height: k.width,
    };
    Camera::new_unchecked(intrinsics, camera.world_from_camera() * old_from_new)
}

/// Returns the readings that change focal lengths or principal points.
fn intrinsics_readings(cameras: &[Camera; 2]) -> Vec<Reading> {
    /// Smallest relative difference that makes changed intrinsics a separate reading.
    const DIFFERS: f32 = 0.02;
    let change = |name: &str, clause: &str, f: &dyn Fn(Intrinsics) -> Intrinsics| {
        reading(name, clause, cameras, |c| {
            Camera::new_unchecked(f(c.intrinsics()), c.world_from_camera())
        })
    };
    let size = |k: &Intrinsics| (k.width as f32, k.height as f32);
    let differs = |a: f32, b: f32| (a / b - 1.0).abs() > DIFFERS;
    let mut all = Vec::new();
    if cameras.iter().any(|c| differs(c.intrinsics().fx, c.intrinsics().fy)) {
        all.push(change("focal_swapped", "fx and fy are exchanged", &|k| Intrinsics {
            fx: k.fy,
            fy: k.fx,
            ..k
        }));
    }
    let middle = |k: &Intrinsics| {
        let (w, h) = size(k);
        !differs(2.0 * k.cx, w) && !differs(2.0 * k.cy, h)
    };
    if !cameras.iter().all(|c| middle(&c.intrinsics())) {
        all.push(change(
            "principal_point_mirrored",
            "the principal point is mirrored (width − cx, height − cy)",
            &|k| Intrinsics { cx: size(&k).0 - k.cx, cy: size(&k).1 - k.cy, ..k },
        ));
        all.push(change(
            "principal_point_centred",
            "the principal point is put into the middle of the photograph",
            &|k| Intrinsics { cx: 0.5 * size(&k).0, cy: 0.5 * size(&k).1, ..k },
        ));
        all.push(change(
            "other_size",
            "the intrinsics are scaled so that the principal point is in the middle: they belong \
             to another picture size",
            &|k| {
                let ((w, h), positive) = (size(&k), |v: f32| v.max(1e-6));
                let (sx, sy) = (0.5 * w / positive(k.cx), 0.5 * h / positive(k.cy));
                Intrinsics { fx: k.fx * sx, fy: k.fy * sy, cx: 0.5 * w, cy: 0.5 * h, ..k }
            },
        ));
    }
    if cameras.iter().all(|c| c.intrinsics().fx < NORMALISED_FOCAL) {
        all.push(change(
            "normalised",
            "the intrinsics are multiplied by the picture's size: they are normalised, not pixels",
            &|k| Intrinsics::from_normalised([k.fx, k.fy, k.cx, k.cy], k.width, k.height),
        ));
    }
    all
}

/// A focal length below this many px is normalised by the picture's width. A field of view of 170°
/// in 100 px has 4.4 px; a normalised long lens has 8.
pub(super) const NORMALISED_FOCAL: f32 = 10.0;

/// Returns the readings with focal lengths scaled in steps of 5 %, both axes together or x alone.
fn focal_readings(cameras: &[Camera; 2]) -> Vec<Reading> {
    /// Steps of 5 % in each direction: factors 0.4 to 2.5.
    const STEPS: i32 = 19;
    let both = (-STEPS..=STEPS).filter(|s| *s != 0).map(|s| (s, true));
    let x_only = (-STEPS..=STEPS).filter(|s| *s != 0).map(|s| (s, false));
    both.chain(x_only)
        .map(|(step, scale_fy)| {
            let factor = 1.05f32.powi(step);
            let (name, what) = if scale_fy {
                ("focal_scaled", "fx and fy are")
            } else {
                ("fx_scaled", "fx alone is")
            };
            let clause = format!("{what} multiplied by about {factor:.2}");
            let mut scaled = reading(name, clause, cameras, |c| {
                let k = c.intrinsics();
                let fy = if scale_fy { k.fy * factor } else { k.fy };
                let scaled = Intrinsics { fx: k.fx * factor, fy, ..k };
                Camera::new_unchecked(scaled, c.world_from_camera())
            });
            (scaled.rank, scaled.factor) = (1, Some(factor));
            scaled
        })
        .collect()
}

/// Returns all 24 right-handed orders of camera axes, for either direction of the matrices.
fn axes_readings(cameras: &[Camera; 2]) -> Vec<Reading> {
    let units = [Vec3::X, Vec3::Y, Vec3::Z];
    let mut all = Vec::new();
    for (i, signs) in (0..3).flat_map(|i| (0..4).map(move |s| (i, s))) {
        for swap in [false, true] {
            let sign = |bit: usize| if signs >> bit & 1 == 0 { 1.0 } else { -1.0 };
            let x = units[i] * sign(0);
            let y = units[(i + if swap { 2 } else { 1 }) % 3] * sign(1);
            // Rows: the file's axes in OpenCV's.
            let file_from_camera = Mat3::from_cols(x, y, x.cross(y)).transpose();
            if x == Vec3::X && y.y.abs() == 1.0 {
                // `pose_readings` covers the axes of OpenCV and of OpenGL.
                continue;
            }
            let axes = [x, y, x.cross(y)].map(direction).join(", ");
            let axes_name = axes.replace(", ", "_");
            let change = Mat4::from_mat3(file_from_camera);
            let mut forward = reading(
                format!("axes_{axes_name}"),
                format!("their camera axes are read as ({axes})"),
                cameras,
                |c| posed(c, c.world_from_camera() * change),
            );
            // LLFF's poses_bounds.npy stores (down, right, back).
            forward.rank = if axes_name == "down_right_back" { 0 } else { 2 };
            let mut backward = reading(
                format!("world_to_camera_axes_{axes_name}"),
                format!("the matrices are read as world-to-camera with camera axes ({axes})"),
                cameras,
                |c| posed(c, inverse(c) * change),
            );
            backward.rank = 2;
            all.extend([forward, backward]);
        }
    }
    all
}

/// Returns OpenCV's name for the direction of a signed unit vector.
fn direction(v: Vec3) -> &'static str {
    let names = [("right", "left"), ("down", "up"), ("forward", "back")];
    let axis = if v.x != 0.0 {
        0
    } else if v.y != 0.0 {
        1
    } else {
        2
    };
    if v[axis] > 0.0 { names[axis].0 } else { names[axis].1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn cameras() -> [Camera; 2] {
        let k = Intrinsics { fx: 300.0, fy: 310.0, cx: 130.0, cy: 120.0, width: 256, height: 240 };
        [0.2, -0.3].map(|t: f32| {
            let turn = Quat::from_euler(glam::EulerRot::XYZ, t, 0.4 - t, 0.1);
            let eye = Vec3::new(t, 2.0, 1.0 - t);
            Camera::new(k, Mat4::from_rotation_translation(turn, eye)).unwrap()
        })
    }

    #[test]
    fn every_order_of_axes_is_corrected() {
        let truth = cameras();
        let vector = |name: &str| match name {
            "right" => Vec3::X,
            "left" => Vec3::NEG_X,
            "down" => Vec3::Y,
            "up" => Vec3::NEG_Y,
            "forward" => Vec3::Z,
            _ => Vec3::NEG_Z,
        };
        let readings = axes_readings(&truth);
        // 24 right-handed orders less OpenCV's and OpenGL's, in either direction.
        assert_eq!(readings.len(), 44);
        for r in &readings {
            let inverted = r.name.starts_with("world_to_camera_");
            let words: Vec<&str> = r.name.rsplit('_').take(3).collect();
            // Columns of camera_from_file are the file's axes.
            let axes = Mat3::from_cols(vector(words[2]), vector(words[1]), vector(words[0]));
            assert!((axes.determinant() - 1.0).abs() < 1e-6);
            let as_filed = truth.map(|c| {
                let pose = c.world_from_camera() * Mat4::from_mat3(axes);
                posed(&c, if inverted { pose.inverse() } else { pose })
            });
            let read = axes_readings(&as_filed).into_iter().find(|o| o.name == r.name).unwrap();
            for (c, t) in read.cameras.iter().zip(&truth) {
                assert!(
                    c.world_from_camera().abs_diff_eq(t.world_from_camera(), 1e-4),
                    "{}",
                    r.name
                );
            }
        }
    }

    #[test]
    fn rotating_the_photograph_rotates_its_points() {
        let camera = cameras()[0];
        let rotated = rotated_clockwise(&camera);
        let p = camera.world_from_camera().transform_point3(Vec3::new(0.3, -0.2, 2.0));
        let (old, new) = (camera.project(p).unwrap(), rotated.project(p).unwrap());
        assert!((new.x - (240.0 - old.y)).abs() < 1e-3 && (new.y - old.x).abs() < 1e-3);
        let mut round = camera;
        (0..4).for_each(|_| round = rotated_clockwise(&round));
        assert!(round.world_from_camera().abs_diff_eq(camera.world_from_camera(), 1e-5));
        assert_eq!(round.intrinsics(), camera.intrinsics());
    }
}
