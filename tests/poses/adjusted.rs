//! Cameras that are nearly right come back to where they belong.

use glam::{Mat4, Quat, Vec3};
use subsplat::cameras::estimation::{PosePhoto, adjust_poses, locate_photos, move_along};
use subsplat::files::poses::scene::load_scene;
use subsplat::network::config::{Config, Preset};
use subsplat::{Check, Options, Photo, Poses, Reconstructor};
use subsplat_kernels::camera::Camera;
use subsplat_test_support::pose_errors::aligned_errors;
use subsplat_test_support::posed_photos::{Intrinsics, PosedPhoto, photo_scene};

/// A direction that depends on `i` only.
fn direction(i: usize) -> Vec3 {
    let (a, z) = (2.4 * i as f32, (1.7 * i as f32).sin());
    let r = (1.0 - z * z).sqrt();
    Vec3::new(r * a.cos(), r * a.sin(), z)
}

/// The camera turned by `degrees` and moved by `distance`, in directions of its own.
fn disturbed(camera: &Camera, i: usize, degrees: f32, distance: f32) -> Camera {
    let turn = Quat::from_axis_angle(direction(i), degrees.to_radians());
    let rotation = turn * Quat::from_mat3(&camera.rotation());
    let position = camera.position() + distance * direction(i + 7);
    let matrix = Mat4::from_rotation_translation(rotation, position);
    Camera::new(camera.intrinsics(), matrix).unwrap()
}

/// Features and cameras of five photographs of the fox; `None` where the folder is absent.
fn fox(frames: [usize; 5]) -> Option<(Vec<PosePhoto>, Vec<Camera>)> {
    let scene = photo_scene("fox")?;
    let photos = frames.map(|i| PosedPhoto::load(&scene, i));
    let features = photos.iter().map(|p| p.features(Intrinsics::Known, 4000)).collect();
    Some((features, photos.iter().map(|p| p.camera).collect()))
}

/// 0.5° and 1 % of the depth, which is that of the fox's wall, in five photographs.
#[test]
fn disturbed_cameras_come_back_to_within_a_third() {
    let Some((features, truth)) = fox([2, 5, 9, 13, 17]) else { return };
    let extent = truth.iter().map(|c| c.position().distance(truth[0].position()));
    let distance = 0.01 * extent.fold(0.0, f32::max);
    let given: Vec<Camera> =
        truth.iter().enumerate().map(|(i, c)| disturbed(c, i, 0.5, distance)).collect();
    let before = aligned_errors(&given, &truth);
    let found = adjust_poses(&features, &given, 1).expect("an adjustment");
    let after = aligned_errors(&found.cameras, &truth);
    assert!(after.rotation_deg < before.rotation_deg / 3.0, "{before:?} {after:?}");
    assert!(after.centre < before.centre / 3.0, "{before:?} {after:?}");
    assert!(found.after_px < 0.8 * found.before_px && found.points > 100, "{found:?}");
    assert!(found.turned_deg > 0.2 && found.turned_deg < 1.0, "{found:?}");
    // The frame stays: the mean position and orientation are those of the given cameras.
    let mean = |c: &[Camera]| c.iter().map(Camera::position).sum::<Vec3>() / c.len() as f32;
    assert!(mean(&found.cameras).distance(mean(&given)) < 1e-4, "{found:?}");
    // Another camera of the scene follows: relative to the first one it stands where it stood.
    let other = disturbed(&truth[1], 3, 5.0, distance);
    let moved = move_along(&truth, &found.cameras, &[other]).unwrap()[0];
    let seen =
        |from: &Camera, c: &Camera| from.world_from_camera().inverse() * c.world_from_camera();
    let (want, got) = (seen(&truth[1], &other), seen(&found.cameras[1], &moved));
    assert!(want.abs_diff_eq(got, 0.01), "{want} {got}");
    assert!(move_along(&truth, &found.cameras[1..], &[other]).is_none());
    assert!(move_along(&[], &[], &[other]).is_none());
    // Cameras that fit stay.
    assert!(adjust_poses(&features, &truth, 1).is_none_or(|a| a.turned_deg < 0.15));
    assert!(adjust_poses(&features, &truth[..2], 1).is_none());
}

/// Two photographs whose cameras are off by 1° and 3 % of the extent, among three whose cameras are known.
#[test]
fn photographs_are_located_among_others() {
    let Some((features, truth)) = fox([2, 5, 9, 4, 7]) else { return };
    let extent = truth[0].position().distance(truth[2].position());
    let (known, others) = truth.split_at(3);
    let off = |degrees: f32| -> Vec<Camera> {
        let moved = |(i, c)| disturbed(c, i, degrees, 0.03 * extent);
        others.iter().enumerate().map(moved).collect()
    };
    let found = locate_photos(&features, known, &off(1.0), 1);
    for (found, truth) in found.iter().zip(others) {
        let found = found.expect("a camera");
        let turn = Quat::from_mat3(&(found.rotation().transpose() * truth.rotation()));
        let degrees = 2.0 * turn.xyz().length().asin().to_degrees();
        assert!(degrees < 0.2, "{degrees}");
        let distance = found.position().distance(truth.position());
        assert!(distance < 0.01 * extent, "{distance} of {extent}");
        assert_eq!(found.intrinsics(), truth.intrinsics());
    }
    // A camera that looks elsewhere is no better than the match says.
    assert_eq!(locate_photos(&features, known, &off(6.0), 1), [None, None]);
    assert_eq!(locate_photos(&features[1..], known, &off(1.0), 1), [None, None]);
}

/// By default cameras that points of the photographs contradict are adjusted, and cameras that fit stay.
#[test]
fn a_reconstruction_adjusts_doubted_cameras() {
    let scene = load_scene("examples/room").unwrap();
    let mut photos: Vec<Photo> =
        scene.frames[..2].iter().map(|frame| Photo::from_frame(frame).unwrap()).collect();
    let model = Reconstructor::untrained(&Config::small(Preset::Tuned, 2), 7).unwrap();
    let prepared = |photos: &[Photo], options: Options| {
        let options = options.with_input_size(96, 96);
        let prepared = model.prepare(photos, &options).unwrap();
        // Between the two: a common turn is a matter of the world's axes.
        let relative = prepared.inputs()[0].input_camera.rotation().transpose()
            * prepared.inputs()[1].input_camera.rotation();
        let truth =
            scene.frames[0].camera.rotation().transpose() * scene.frames[1].camera.rotation();
        let error = Quat::from_mat3(&(relative.transpose() * truth));
        let error = 2.0 * error.xyz().length().asin().to_degrees();
        (prepared.pose_adjustment().is_some(), error)
    };
    let (adjusts, error) = prepared(&photos, Options::default());
    assert!(!adjusts && error < 1e-3, "cameras that fit: {error}");
    let wrong = disturbed(photos[1].camera(), 1, 0.8, 0.0);
    photos[1] = photos[1].with_camera(wrong).unwrap();
    let (adjusts, error) = prepared(&photos, Options::default());
    assert!(adjusts && error < 0.2, "{error}");
    for options in [
        Options::default().with_poses(Poses::Given),
        // Without a comparison nothing is doubted.
        Options::default().with_check(Check::Off),
    ] {
        let (adjusts, error) = prepared(&photos, options);
        assert!(!adjusts && (error - 0.8).abs() < 0.01, "{error}");
    }
    let (adjusts, error) =
        prepared(&photos, Options::default().with_poses(Poses::Adjusted).with_check(Check::Off));
    assert!(adjusts && error < 0.2, "{error}");
}
