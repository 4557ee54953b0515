//! Cameras of photographs with several focal lengths, of which their files say nothing, and with a given one that is
//! wrong. A ray caster draws them (`box_room`).

use glam::{DMat3, DVec2, DVec3};
use subsplat::cameras::estimation::Confidence;
use subsplat::kernels::camera::Camera;
use subsplat::{EstimateOptions, EstimatedScene, KnownLens, estimate_cameras_of_files};
use subsplat_test_support::box_room::{camera_at, picture, save_pictures};
use subsplat_test_support::pose_errors::relative_errors;

const SIZE: [usize; 2] = [800, 600];
/// Focal length of the photographs that are not enlarged, px.
const FOCAL: f64 = 560.0;

/// Axes and positions of five photographs of one corner.
fn places() -> [(DMat3, DVec3); 5] {
    let axes = |yaw: f64, pitch: f64| DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(pitch);
    [
        (axes(0.30, 0.02), DVec3::new(-0.6, 0.1, -0.5)),
        (axes(0.38, -0.03), DVec3::new(-0.2, 0.0, -0.6)),
        (axes(0.22, 0.01), DVec3::new(0.2, 0.12, -0.4)),
        (axes(0.15, 0.04), DVec3::new(0.5, -0.05, -0.7)),
        (axes(0.27, -0.01), DVec3::new(0.0, -0.15, -0.9)),
    ]
}

/// The estimate of photographs with these focal lengths, over [`FOCAL`], of which `lens` is known.
fn estimated(zooms: [f64; 5], lens: Option<KnownLens>) -> EstimatedScene {
    let middle = DVec2::new(SIZE[0] as f64, SIZE[1] as f64) * 0.5;
    let draw = |((axes, from), zoom): ((DMat3, DVec3), f64)| {
        picture(SIZE, from, |px| Some(axes * ((px - middle) / (FOCAL * zoom)).extend(1.0)))
    };
    let pictures: Vec<_> = places().into_iter().zip(zooms).map(draw).collect();
    let folder = tempfile::tempdir().unwrap();
    let files = save_pictures(folder.path(), &pictures);
    let options = EstimateOptions { lens, ..EstimateOptions::default() };
    estimate_cameras_of_files(folder.path(), &files, &options, &mut |_| Ok(())).unwrap()
}

/// Checks rotations, directions and focal lengths of all cameras.
fn check(found: &EstimatedScene, zooms: [f64; 5]) {
    let cameras: Vec<Camera> = found.estimate.cameras.iter().map(|c| c.unwrap()).collect();
    assert_eq!(found.estimate.confidence, Confidence::High, "{:?}", found.estimate.warnings);
    for i in 1..cameras.len() {
        let truth = [0, i].map(|i| camera_at(places()[i], cameras[i].intrinsics()));
        let [turn, direction] = relative_errors([&cameras[0], &cameras[i]], truth.each_ref());
        assert!(turn < 0.4 && direction < 2.0, "{i}: {turn} {direction}");
    }
    for (camera, zoom) in cameras.iter().zip(zooms) {
        let ratio = f64::from(camera.intrinsics().fx) / (FOCAL * zoom);
        assert!((ratio - 1.0).abs() < 0.03, "{ratio} for {zoom}");
    }
}

fn says_zoom(found: &EstimatedScene) -> bool {
    found.scene.warnings.iter().any(|w| w.contains("the focal lengths of the photographs differ"))
}

#[test]
fn each_photograph_of_a_zoom_lens_has_a_focal_length_of_its_own() {
    let zooms = [1.0, 1.4, 1.0, 1.2, 1.0];
    let found = estimated(zooms, None);
    assert!(says_zoom(&found), "{:?}", found.scene.warnings);
    check(&found, zooms);
}

#[test]
fn photographs_of_one_focal_length_share_it() {
    let found = estimated([1.0; 5], None);
    assert!(!says_zoom(&found), "{:?}", found.scene.warnings);
    check(&found, [1.0; 5]);
    let focal = |i: usize| found.estimate.cameras[i].unwrap().intrinsics().fx;
    assert!((1..5).all(|i| focal(i) == focal(0)));
}

#[test]
fn a_given_focal_length_that_the_points_contradict_is_said() {
    let found = |focal: f64| {
        let fov = 2.0 * (0.5 * SIZE[0] as f64 / focal).atan();
        estimated([1.0; 5], Some(KnownLens::FovX(fov as f32)))
    };
    let says = |found: &EstimatedScene| {
        found.scene.warnings.iter().any(|w| w.contains("contradict the focal length"))
    };
    let wrong = found(1.5 * FOCAL);
    assert!(says(&wrong), "{:?}", wrong.scene.warnings);
    assert_eq!(wrong.estimate.confidence, Confidence::Low);
    let right = found(FOCAL);
    assert!(!says(&right), "{:?}", right.scene.warnings);
    check(&right, [1.0; 5]);
}
