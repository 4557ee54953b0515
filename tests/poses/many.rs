//! Three and more photographs: in any order, one that does not belong, lenses of which nothing is known.

use subsplat::cameras::estimation::{
    Confidence, PoseEstimate, PoseOptions, PosePhoto, PoseWarning, estimate_poses,
};
use subsplat_kernels::camera::Camera;
use subsplat_test_support::pose_errors::aligned_errors;
use subsplat_test_support::posed_photos::{Intrinsics, MANY_FEATURES, PosedPhoto, photo_scene};

/// Every index below `n` once, in a mixed order: 7 and 20 have no common divisor.
fn shuffled(n: usize) -> Vec<usize> {
    (0..n).map(|i| (7 * i + 3) % n).collect()
}

#[test]
fn twenty_shuffled_photographs_are_placed() {
    let Some(scene) = photo_scene("fox") else { return };
    assert_eq!(scene.frames.len(), 20);
    let photos: Vec<PosedPhoto> =
        shuffled(20).into_iter().map(|i| PosedPhoto::load(&scene, i)).collect();
    let features: Vec<PosePhoto> =
        photos.iter().map(|p| p.features(Intrinsics::Known, MANY_FEATURES)).collect();
    let estimate = estimate_poses(&features, &PoseOptions::default()).unwrap();
    assert_eq!(estimate.left_out, []);
    assert_eq!(estimate.confidence, Confidence::High, "{:?}", estimate.warnings);
    let found: Vec<Camera> = estimate.cameras.iter().map(|c| c.unwrap()).collect();
    let truth: Vec<Camera> = photos.iter().map(|p| p.camera).collect();
    let errors = aligned_errors(&found, &truth);
    assert!(errors.centre < 0.005 && errors.rotation_deg < 0.3, "{errors:?}");
    // Points: seen by their photographs where the cameras say, and half of them before depth 1.
    assert!(estimate.points.len() > 1000, "{}", estimate.points.len());
    let mut depths = Vec::new();
    for point in &estimate.points {
        assert!(point.observations.len() > 1 && point.error_px < 8.0, "{point:?}");
        depths.extend(
            point.observations.iter().map(|(photo, _)| found[*photo].to_camera(point.position).z),
        );
    }
    depths.sort_by(f32::total_cmp);
    assert!((depths[depths.len() / 2] - 1.0).abs() < 0.02, "{}", depths[depths.len() / 2]);
}

#[test]
fn a_photograph_of_another_scene_is_named_and_left_out() {
    let (Some(scene), Some(other)) = (photo_scene("fox"), photo_scene("hololens_table")) else {
        return;
    };
    let mut photos: Vec<PosedPhoto> =
        [0, 2, 4, 6].into_iter().map(|i| PosedPhoto::load(&scene, i)).collect();
    photos.insert(1, PosedPhoto::load(&other, 3));
    let features: Vec<PosePhoto> =
        photos.iter().map(|p| p.features(Intrinsics::Known, MANY_FEATURES)).collect();
    let estimate = estimate_poses(&features, &PoseOptions::default()).unwrap();
    let left_out: Vec<usize> = estimate.left_out.iter().map(|l| l.photo).collect();
    assert_eq!(left_out, [1], "{:?}", estimate.left_out);
    assert_eq!(
        estimate.cameras.iter().map(Option::is_some).collect::<Vec<_>>(),
        [true, false, true, true, true]
    );
}

/// The estimate of photographs of a scene with lenses of which nothing is known, and their true cameras.
fn with_unknown_lens(scene: &str, frames: &[usize]) -> Option<(PoseEstimate, Vec<Camera>)> {
    let scene = photo_scene(scene)?;
    let photos: Vec<PosedPhoto> = frames.iter().map(|&i| PosedPhoto::load(&scene, i)).collect();
    let features: Vec<PosePhoto> =
        photos.iter().map(|p| p.features(Intrinsics::Unknown, MANY_FEATURES)).collect();
    let estimate = estimate_poses(&features, &PoseOptions::default()).unwrap();
    Some((estimate, photos.iter().map(|p| p.camera).collect()))
}

#[test]
fn pairs_tell_the_focal_length_together() {
    // The median of what each pair estimates alone is half of the focal length for the first three: 33 degrees off.
    for frames in [vec![0, 7, 14], vec![2, 7, 12, 17]] {
        let Some((estimate, truth)) = with_unknown_lens("fox", &frames) else { return };
        assert_eq!(estimate.confidence, Confidence::High, "{:?}", estimate.warnings);
        let found: Vec<Camera> = estimate.cameras.iter().map(|c| c.unwrap()).collect();
        let scale = found[0].intrinsics().fx / truth[0].intrinsics().fx;
        assert!((scale - 1.0).abs() < 0.05, "{frames:?}: {scale}");
        let errors = aligned_errors(&found, &truth);
        assert!(errors.centre < 0.02 && errors.rotation_deg < 1.0, "{frames:?}: {errors:?}");
    }
}

#[test]
fn a_focal_length_that_the_photographs_do_not_tell_is_doubtful() {
    // The camera hardly moves: focal lengths from 0.9 to 1.9 times the assumed one explain the points alike.
    let frames: Vec<usize> = (4..14).collect();
    let Some((estimate, _)) = with_unknown_lens("re10k_0c9b371cc6225682", &frames) else { return };
    assert_eq!(estimate.confidence, Confidence::Low);
    let is_focal = |w: &PoseWarning| matches!(w, PoseWarning::UncertainFocal { .. });
    assert!(estimate.warnings.iter().any(is_focal), "{:?}", estimate.warnings);
}
