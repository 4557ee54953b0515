//! Cameras of photographs whose lens bends straight lines, which a ray caster draws (`box_room`).

use glam::{DMat3, DVec2, DVec3};
use subsplat::cameras::estimation::Confidence;
use subsplat::kernels::camera::Camera;
use subsplat::reconstruct::{EstimatedPhotos, Projection};
use subsplat::{
    EstimateOptions, EstimatedScene, KnownLens, LoadOptions, Photograph, Rgb, estimate_cameras,
    estimate_cameras_of_files, load_photograph,
};
use subsplat_test_support::box_room::{
    camera_at, difference, median_reprojection, picture, save_pictures,
};
use subsplat_test_support::pose_errors::relative_errors;

const SIZE: [usize; 2] = [800, 600];
/// Focal length of the middle of the pictures, px: 83 degrees wide as a pinhole.
const FOCAL: f64 = 450.0;

/// A lens: the ray of a position, focal lengths from the middle.
type Ray = fn(DVec2) -> DVec3;

fn pinhole(at: DVec2) -> DVec3 {
    at.extend(1.0)
}

fn barrel(at: DVec2) -> DVec3 {
    at.extend(1.0 - 0.15 * at.length_squared())
}

fn pincushion(at: DVec2) -> DVec3 {
    at.extend(1.0 + 0.12 * at.length_squared())
}

/// A fisheye lens without a circle: 127 degrees across the diagonal.
fn full_frame_fisheye(at: DVec2) -> DVec3 {
    let theta = at.length();
    (at.normalize_or_zero() * theta.sin()).extend(theta.cos())
}

/// Axes and positions of four photographs of one corner.
fn places() -> [(DMat3, DVec3); 4] {
    let axes = |yaw: f64, pitch: f64| DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(pitch);
    [
        (axes(0.30, 0.02), DVec3::new(-0.6, 0.1, -0.5)),
        (axes(0.38, -0.03), DVec3::new(-0.2, 0.0, -0.6)),
        (axes(0.22, 0.01), DVec3::new(0.2, 0.12, -0.4)),
        (axes(0.15, 0.04), DVec3::new(0.5, -0.05, -0.7)),
    ]
}

fn photographs(ray: Ray) -> Vec<Rgb> {
    let middle = DVec2::new(SIZE[0] as f64, SIZE[1] as f64) * 0.5;
    let one = |(axes, from): (DMat3, DVec3)| {
        picture(SIZE, from, |px| Some(axes * ray((px - middle) / FOCAL)))
    };
    places().map(one).to_vec()
}

/// The estimate, and pictures and cameras of its frames.
fn estimated(pictures: &[Rgb], projection: Projection) -> (EstimatedScene, Vec<(Rgb, Camera)>) {
    estimated_with(pictures, &EstimateOptions { projection, ..EstimateOptions::default() })
}

/// [`estimated`] with all options.
fn estimated_with(
    pictures: &[Rgb],
    options: &EstimateOptions,
) -> (EstimatedScene, Vec<(Rgb, Camera)>) {
    let folder = tempfile::tempdir().unwrap();
    let files = save_pictures(folder.path(), pictures);
    let found = estimate_cameras_of_files(folder.path(), &files, options, &mut |_| Ok(())).unwrap();
    let loaded = found.scene.frames.iter().map(|frame| frame.load().unwrap()).collect();
    (found, loaded)
}

/// Largest errors of rotations and directions against the first camera, degrees.
fn errors(cameras: &[Option<Camera>]) -> [f64; 2] {
    let cameras: Vec<Camera> = cameras.iter().map(|camera| camera.unwrap()).collect();
    let of = |i: usize| {
        let truth = [0, i].map(|i| camera_at(places()[i], cameras[i].intrinsics()));
        relative_errors([&cameras[0], &cameras[i]], truth.each_ref())
    };
    let largest = |a: [f64; 2], b: [f64; 2]| [a[0].max(b[0]), a[1].max(b[1])];
    (1..cameras.len()).map(of).fold([0.0; 2], largest)
}

#[test]
fn photographs_of_a_lens_that_bends_are_straightened() {
    for (ray, sign) in [(barrel as Ray, -1.0), (full_frame_fisheye, -1.0), (pincushion, 1.0)] {
        let pictures = photographs(ray);
        let (found, loaded) = estimated(&pictures, Projection::Detected);
        let first = found.scene.frames[0].camera.rotation().as_dmat3();
        let room_from_world = places()[0].0 * first.transpose();
        for ((picture, camera), place) in loaded.iter().zip(places()) {
            let axes = room_from_world * camera.rotation().as_dmat3();
            let off = difference(picture, &camera.intrinsics(), place.1, axes);
            assert!(off < 8.0, "{off}");
        }
        let lens = found.straightened.unwrap();
        assert!(sign * lens.k > 0.05, "{lens:?}");
        let right = errors(&found.estimate.cameras);
        assert!(right[0] < 0.3 && right[1] < 1.5, "{right:?}");
        assert_eq!(found.estimate.confidence, Confidence::High, "{:?}", found.estimate.warnings);
        let said = |w: &&String| w.contains("4 of 4 photographs: the lens bends straight lines");
        assert_eq!(
            found.scene.warnings.iter().filter(said).count(),
            1,
            "{:?}",
            found.scene.warnings
        );
        // Points lie where the straight frames show them.
        let error = median_reprojection(&found);
        assert!(error < 0.5, "{error}");
        let (as_pinholes, _) = estimated(&pictures, Projection::Pinhole);
        assert_eq!(as_pinholes.straightened, None);
        let wrong = errors(&as_pinholes.estimate.cameras);
        assert!(wrong[0] > 2.0 * right[0] && wrong[1] > 2.0 * right[1], "{wrong:?} {right:?}");
    }
}

#[test]
fn photographs_in_memory_are_straightened_alike() {
    let folder = tempfile::tempdir().unwrap();
    let pictures = photographs(barrel);
    let (of_files, loaded) = estimated(&pictures, Projection::Detected);
    let photographs: Vec<Photograph> = save_pictures(folder.path(), &pictures)
        .iter()
        .map(|file| load_photograph(file, &LoadOptions::default()).unwrap())
        .collect();
    let found: EstimatedPhotos =
        estimate_cameras(photographs, &EstimateOptions::default()).unwrap();
    assert_eq!(found.straightened, of_files.straightened);
    assert_eq!(found.estimate, of_files.estimate);
    let in_memory: Vec<(Rgb, Camera)> =
        found.photos.iter().map(|photo| (photo.image().clone(), *photo.camera())).collect();
    assert!(in_memory == loaded, "pictures or cameras differ");
}

#[test]
fn photographs_of_a_pinhole_stay_as_they_are() {
    let (found, _) = estimated(&photographs(pinhole), Projection::Detected);
    assert_eq!(found.straightened, None);
    assert!(found.scene.frames.iter().all(|frame| frame.cut.is_none()));
    let errors = errors(&found.estimate.cameras);
    assert!(errors[0] < 0.3 && errors[1] < 1.5, "{errors:?}");
}

/// A focal length that a person gives is that of the middle of the picture.
#[test]
fn a_given_focal_length_leaves_the_bend_to_be_found() {
    let fov = 2.0 * (0.5 * SIZE[0] as f64 / FOCAL).atan();
    let lens = Some(KnownLens::FovX(fov as f32));
    let options = EstimateOptions { lens, ..EstimateOptions::default() };
    let (found, _) = estimated_with(&photographs(barrel), &options);
    assert!(found.straightened.unwrap().k < -0.05, "{:?}", found.straightened);
    let right = errors(&found.estimate.cameras);
    assert!(right[0] < 0.3 && right[1] < 1.5, "{right:?}");
    let (found, _) = estimated_with(&photographs(pinhole), &options);
    assert_eq!(found.straightened, None);
}
