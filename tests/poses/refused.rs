//! Photographs that determine no cameras: each has its own refusal. The pictures are the
//! generator's, so nothing is skipped.

use glam::{Mat3, Mat4, Vec3};
use std::sync::Arc;
use subsplat::cameras::estimation::Uncertain;
use subsplat::cameras::estimation::{
    Lens, PoseEstimate, PoseOptions, PosePhoto, PosePhotoError, PoseRefusal, estimate_poses,
};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_lab::data::procedural::{Grade, Quality, Room, TextureBank};
use subsplat_test_support::pose_errors::relative_errors;

const FEATURES: usize = 4000;
pub const W: usize = 640;
pub const H: usize = 480;

fn intrinsics() -> Intrinsics {
    Intrinsics::from_fov_x(1.1, W, H)
}

/// A camera at `eye` that looks at the middle of the room of `examples/room`, then turned by `yaw`.
pub fn camera(eye: Vec3, yaw: f32) -> Camera {
    let z = (Vec3::new(0.95, -0.6, -1.15) - EYE).normalize();
    let x = Vec3::Y.cross(z).normalize();
    let turn = Mat3::from_cols(x, z.cross(x), z) * Mat3::from_rotation_y(yaw);
    Camera::new(intrinsics(), Mat4::from_translation(eye) * Mat4::from_mat3(turn)).unwrap()
}

pub const EYE: Vec3 = Vec3::new(-0.48, -1.66, 0.84);
pub const STEP: Vec3 = Vec3::new(0.25, 0.0, 0.16);

/// Bytes of the picture of a room, with the noise of a sensor.
pub fn picture(room: u64, camera: &Camera, noise_seed: u64) -> Vec<u8> {
    let room = Room::with_bank(room, Arc::new(TextureBank::new(0, 512)));
    let grade = Grade { noise: 0.008, seed: noise_seed, ..Grade::default() };
    let view = room.render(camera, &Quality { grade, ..Quality::training(grade) });
    view.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect()
}

fn photo(rgb: &[u8]) -> PosePhoto {
    PosePhoto::from_rgb8(rgb, Lens::known(intrinsics()), FEATURES).unwrap()
}

fn mirrored(rgb: &[u8]) -> Vec<u8> {
    let row = |row: &[u8]| row.chunks_exact(3).rev().flatten().copied().collect::<Vec<u8>>();
    rgb.chunks_exact(3 * W).flat_map(row).collect()
}

fn estimate(a: &[u8], b: &[u8], uncertain: Uncertain) -> Result<PoseEstimate, PoseRefusal> {
    estimate_poses(&[photo(a), photo(b)], &PoseOptions::default().with_uncertain(uncertain))
}

#[test]
fn a_step_aside_gives_the_cameras() {
    let cameras = [camera(EYE, 0.0), camera(EYE + STEP, -0.05)];
    let [a, b] = [0, 1].map(|i| picture(7663, &cameras[i], i as u64));
    let estimate = estimate(&a, &b, Uncertain::Refuse).unwrap();
    let found = [0, 1].map(|i| estimate.cameras[i].unwrap());
    let errors = relative_errors(found.each_ref(), cameras.each_ref());
    assert!(errors[0] < 0.2 && errors[1] < 1.0, "{errors:?}");
}

#[test]
fn the_same_photograph_twice_is_one_view() {
    let a = picture(7663, &camera(EYE, 0.0), 1);
    let refusal = estimate(&a, &a, Uncertain::Refuse).unwrap_err();
    assert_eq!(refusal, PoseRefusal::SameView { shift_px: 0.0 });
    // The same view with other noise, which no flag can turn into two places.
    let again = picture(7663, &camera(EYE, 0.0), 2);
    let refusal = estimate(&a, &again, Uncertain::Refuse).unwrap_err();
    assert!(matches!(refusal, PoseRefusal::SameView { .. }), "{refusal}");
}

#[test]
fn a_camera_that_only_turned_is_refused() {
    for yaw in [0.1, 0.25] {
        let [a, b] = [0.0, yaw].map(|yaw| picture(7663, &camera(EYE, yaw), yaw.to_bits().into()));
        let refusal = estimate(&a, &b, Uncertain::Refuse).unwrap_err();
        let PoseRefusal::PureRotation { degrees, parallax_px } = refusal else {
            panic!("{yaw}: {refusal}")
        };
        assert!((degrees - f64::from(yaw).to_degrees()).abs() < 0.5, "{degrees}");
        assert!(parallax_px < 1.0, "{parallax_px}");
        // Forced, the estimate is there and says what is wrong with it.
        if let Ok(forced) = estimate(&a, &b, Uncertain::Accept) {
            assert!(forced.warnings.iter().any(|w| w.to_string().contains("did not move")));
        }
    }
}

#[test]
fn a_mirrored_photograph_is_named() {
    let [a, b] =
        [(EYE, 0.0), (EYE + STEP, -0.05)].map(|(eye, yaw)| picture(7663, &camera(eye, yaw), 7));
    for other in [&a, &b] {
        let refusal = estimate(&a, &mirrored(other), Uncertain::Refuse).unwrap_err();
        assert!(matches!(refusal, PoseRefusal::Mirrored { consistent } if consistent > 45));
    }
}

#[test]
fn photographs_of_different_rooms_are_refused() {
    for other in [1, 2, 3] {
        let [a, b] = [7663, other].map(|room| picture(room, &camera(EYE, 0.0), room));
        let refusal = estimate(&a, &b, Uncertain::Refuse).unwrap_err();
        assert!(matches!(refusal, PoseRefusal::FewMatches { .. }), "{other}: {refusal}");
    }
}

#[test]
fn photographs_without_texture_are_refused() {
    let grey = vec![128; 3 * W * H];
    let refusal = estimate(&grey, &grey, Uncertain::Accept).unwrap_err();
    assert!(matches!(refusal, PoseRefusal::FewMatches { consistent: 0, matches: 0, .. }));
    let one = [photo(&grey)];
    assert_eq!(
        estimate_poses(&one, &PoseOptions::default()),
        Err(PoseRefusal::TooFew { count: 1 })
    );
    let three = [photo(&grey), photo(&grey), photo(&grey)];
    assert_eq!(estimate_poses(&three, &PoseOptions::default()), Err(PoseRefusal::NoPair));
}

#[test]
fn photographs_and_lenses_out_of_range_are_refused() {
    let grey = vec![128; 3 * W * H];
    let of = |rgb: &[u8], lens: Lens| PosePhoto::from_rgb8(rgb, lens, FEATURES).map(|_| ());
    let known = Lens::known(intrinsics());
    let length = PosePhotoError::Length { width: W, height: H, found: grey.len() - 1 };
    assert_eq!(of(&grey[1..], known), Err(length));
    let zero = Lens::known(Intrinsics { fx: 0.0, ..intrinsics() });
    assert!(matches!(of(&grey, zero), Err(PosePhotoError::Lens(_))));
    let unsure = Lens { deviation: f64::NAN, ..known };
    assert!(matches!(of(&grey, unsure), Err(PosePhotoError::Deviation { .. })));
}
