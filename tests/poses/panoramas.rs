//! Cameras of panoramas and of fisheye pictures, which a ray caster draws (`box_room`).

use glam::{DMat3, DVec3};
use std::path::Path;
use subsplat::cameras::estimation::Confidence;
use subsplat::image::ExtendedColorType;
use subsplat::image::codecs::jpeg::JpegEncoder;
use subsplat::kernels::camera::Camera;
use subsplat::reconstruct::{FisheyeCurve, FisheyeLens, LensSource, Projection};
use subsplat::{EstimateOptions, EstimatedScene, Result, Rgb, estimate_cameras_of_files, save_png};
use subsplat_test_support::box_room::{
    camera_at, colour, difference, fisheye, median_reprojection, panorama, save_pictures,
};
use subsplat_test_support::pose_errors::relative_errors;

const WIDTH: usize = 1024;

/// Axes and positions of panoramas that look in different directions.
fn places() -> [(DMat3, DVec3); 4] {
    let axes = |yaw: f64, x: f64, z: f64| {
        DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(x) * DMat3::from_rotation_z(z)
    };
    [
        (axes(0.3, 0.02, 0.01), DVec3::new(-0.5, 0.1, -0.3)),
        (axes(2.4, -0.03, 0.02), DVec3::new(0.1, 0.0, -0.1)),
        (axes(-1.2, 0.01, -0.03), DVec3::new(0.5, 0.05, 0.4)),
        (axes(0.9, 0.0, 0.02), DVec3::new(0.2, -0.1, 0.9)),
    ]
}

fn estimated(pictures: &[Rgb], projection: Projection) -> Result<EstimatedScene> {
    let folder = tempfile::tempdir().unwrap();
    let files = save_pictures(folder.path(), pictures);
    let options = EstimateOptions { projection, ..EstimateOptions::default() };
    let scene = estimate_cameras_of_files(folder.path(), &files, &options, &mut |_| Ok(()))?;
    check_frames(&scene, pictures.len());
    Ok(scene)
}

/// The frames show what their cameras see, in the world of the estimate turned to that of the room; points lie
/// where the frames show them.
fn check_frames(found: &EstimatedScene, photographs: usize) {
    let frames = &found.scene.frames;
    let of_each = frames.len() / photographs;
    let first = found.estimate.cameras[0].unwrap().rotation().as_dmat3();
    let room_from_world = places()[0].0 * first.transpose();
    for (i, frame) in frames.iter().enumerate() {
        let (picture, camera) = frame.load().unwrap();
        let axes = room_from_world * camera.rotation().as_dmat3();
        let off = difference(&picture, &camera.intrinsics(), places()[i / of_each].1, axes);
        assert!(off < 6.0, "{}: {off}", frame.name);
    }
    // Views of a panorama leave out what lies above 41 degrees.
    let shared = found.observations.iter().filter(|seen| seen.len() >= 2).count();
    assert!(10 * shared > 8 * found.observations.len(), "{shared}");
    let error = median_reprojection(found);
    assert!(error < 0.5, "{error}");
    let visible: usize = frames.iter().map(|f| f.visible.len()).sum();
    assert_eq!(visible, found.observations.iter().map(Vec::len).sum::<usize>());
}

fn check_cameras(found: &EstimatedScene, turn: f64, direction: f64) {
    assert_eq!(found.estimate.confidence, Confidence::High, "{:?}", found.estimate.warnings);
    let cameras: Vec<Camera> = found.estimate.cameras.iter().map(|c| c.unwrap()).collect();
    for (i, camera) in cameras.iter().enumerate().skip(1) {
        let truth = [0, i].map(|i| camera_at(places()[i], camera.intrinsics()));
        let errors = relative_errors([&cameras[0], camera], truth.each_ref());
        assert!(errors[0] < turn && errors[1] < direction, "{i}: {errors:?}");
    }
}

#[test]
fn two_panoramas_get_their_cameras_and_twelve_frames() {
    let pictures = [0, 1].map(|i| panorama(WIDTH, places()[i].1, places()[i].0));
    let found = estimated(&pictures, Projection::Detected).unwrap();
    check_cameras(&found, 0.1, 0.5);
    assert_eq!(found.scene.frames.len(), 12);
    assert_eq!(found.scene.frames[7].name, "R1_060");
    assert_eq!(found.lenses, [LensSource::Panorama, LensSource::Panorama]);
    let lines: Vec<&String> =
        found.scene.warnings.iter().filter(|w| w.contains("edges continue each other")).collect();
    assert_eq!(lines.len(), 2, "{:?}", found.scene.warnings);
    // The two panoramas have views in the same directions.
    for i in 0..6 {
        let [a, b] = [i, i + 6].map(|i| found.scene.frames[i].camera.rotation());
        assert_eq!(a, b);
    }
}

#[test]
fn four_panoramas_are_placed_together() {
    let pictures = [0, 1, 2, 3].map(|i| panorama(WIDTH, places()[i].1, places()[i].0));
    let found = estimated(&pictures, Projection::Panorama).unwrap();
    check_cameras(&found, 0.1, 0.5);
    assert_eq!(found.scene.frames.len(), 24);
    assert!(
        !found.scene.warnings.iter().any(|w| w.contains("edges")),
        "{:?}",
        found.scene.warnings
    );
}

/// Two pictures of a circular fisheye lens, from steps of the first place.
fn fisheyes(curve: FisheyeCurve, degrees: f64) -> [Rgb; 2] {
    let half = 0.5 * degrees.to_radians();
    let angle = move |r: f64| match curve {
        FisheyeCurve::Equidistant => r * half,
        FisheyeCurve::Equisolid => 2.0 * (r * (0.5 * half).sin()).asin(),
        FisheyeCurve::Stereographic => 2.0 * (r * (0.5 * half).tan()).atan(),
    };
    [0, 1].map(|i| {
        let (axes, from) = fisheye_place(i);
        fisheye([900, 840], 400.0, from, axes, angle)
    })
}

fn fisheye_place(i: usize) -> (DMat3, DVec3) {
    let (axes, from) = places()[0];
    let turn = DMat3::from_rotation_y(-0.15 * i as f64);
    (axes * turn, from + axes * DVec3::new(0.4, 0.02, 0.1) * i as f64)
}

#[test]
fn fisheye_pictures_are_cut_and_get_their_cameras() {
    for (curve, degrees) in [(FisheyeCurve::Equidistant, 180.0), (FisheyeCurve::Equisolid, 200.0)] {
        let folder = tempfile::tempdir().unwrap();
        let files = ["a.png", "b.png"].map(|name| folder.path().join(name));
        for (file, picture) in files.iter().zip(fisheyes(curve, degrees)) {
            save_png(file, &picture).unwrap();
        }
        let lens = FisheyeLens { angle: f64::to_radians(degrees), curve };
        let options =
            EstimateOptions { projection: Projection::Fisheye(lens), ..EstimateOptions::default() };
        let found =
            estimate_cameras_of_files(folder.path(), &files, &options, &mut |_| Ok(())).unwrap();
        let cameras = [0, 1].map(|i| found.estimate.cameras[i].unwrap());
        let truth = [0, 1].map(|i| camera_at(fisheye_place(i), cameras[i].intrinsics()));
        let errors = relative_errors(cameras.each_ref(), truth.each_ref());
        assert!(errors[0] < 0.2 && errors[1] < 1.5, "{curve:?}: {errors:?}");
        assert_eq!(found.scene.frames[1].name, "b");
        assert_eq!(found.lenses, [LensSource::Fisheye, LensSource::Fisheye]);
        for (i, frame) in found.scene.frames.iter().enumerate() {
            let (picture, camera) = frame.load().unwrap();
            let k = camera.intrinsics();
            let half = (0.5 * f64::from(k.fov_x())).to_degrees();
            assert!((half - 45.0).abs() < 1.5, "{half}");
            let (axes, from) = fisheye_place(i);
            let middle = colour(from, axes.z_axis);
            let at = 3 * ((k.height / 2) * k.width + k.width / 2);
            for (a, b) in picture.data[at..at + 3].iter().zip(middle) {
                assert!(a.abs_diff(b) < 25, "{a} {b}");
            }
        }
    }
}

#[test]
fn what_a_picture_looks_like_is_said_where_the_cameras_fail() {
    // The same picture twice has no cameras.
    let [circle, _] = fisheyes(FisheyeCurve::Equidistant, 180.0);
    let error = estimated(&[circle.clone(), circle], Projection::Detected).unwrap_err().to_string();
    assert!(error.contains("same view") && error.contains("--lens fisheye"), "{error}");
    // Two to one, with edges that do not meet.
    let whole = panorama(4 * WIDTH, places()[0].1, places()[0].0);
    let rows = whole.data.chunks_exact(12 * WIDTH).skip(600).take(512);
    let data = rows.flat_map(|row| row[..3 * WIDTH].to_vec()).collect();
    let part = Rgb { width: WIDTH, height: 512, data };
    let error = estimated(&[part.clone(), part], Projection::Detected).unwrap_err().to_string();
    assert!(error.contains("shape of a panorama") && error.contains("1 more"), "{error}");
    // Neither is a panorama by force.
    let square = panorama(WIDTH, places()[0].1, places()[0].0);
    let square = Rgb { height: 300, data: square.data[..3 * WIDTH * 300].to_vec(), ..square };
    let error = estimated(&[square.clone(), square], Projection::Panorama).unwrap_err().to_string();
    assert!(error.contains("twice as wide as high") && error.contains("1024x300"), "{error}");
}

/// A photograph that cannot be used is left out, and the indices of the others stay.
#[test]
fn one_bad_photograph_is_left_out_of_several() {
    let folder = tempfile::tempdir().unwrap();
    let pictures = [0, 1].map(|i| panorama(WIDTH, places()[i].1, places()[i].0));
    let mut files = save_pictures(folder.path(), &pictures);
    let cut = folder.path().join("cut.png");
    let bytes = std::fs::read(&files[0]).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    files.insert(1, cut);
    let mut options = EstimateOptions::default();
    let read = |files: &[std::path::PathBuf], options: &EstimateOptions| {
        estimate_cameras_of_files(folder.path(), files, options, &mut |_| Ok(()))
    };
    let found = read(&files, &options).unwrap();
    let estimate = &found.estimate;
    let placed: Vec<bool> = estimate.cameras.iter().map(Option::is_some).collect();
    assert_eq!(placed, [true, false, true]);
    assert_eq!((found.lenses.len(), estimate.left_out.len()), (3, 1));
    assert_eq!((estimate.left_out[0].photo, found.scene.frames.len()), (1, 12));
    let photos = estimate.points.iter().flat_map(|p| p.observations.iter().map(|o| o.0));
    assert!(photos.clone().any(|photo| photo == 2) && photos.clone().all(|photo| photo != 1));
    let line = found.scene.warnings.iter().find(|w| w.contains("cut.png is left out: expected"));
    assert!(line.is_some(), "{:?}", found.scene.warnings);
    // It is needed, or a strict reading refuses it.
    assert!(read(&files[..2], &options).unwrap_err().to_string().contains("cut.png: expected"));
    options.strict = true;
    assert!(read(&files, &options).unwrap_err().to_string().contains("cut.png: expected"));
}

/// A part of a panorama as a JPEG with GPano's properties.
fn save_part(file: &Path, whole: &Rgb, [left, top]: [usize; 2], [width, height]: [usize; 2]) {
    let row = |y: usize| &whole.data[3 * (y * whole.width + left)..][..3 * width];
    let data: Vec<u8> = (top..top + height).flat_map(row).copied().collect();
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 96);
    encoder.encode(&data, width as u32, height as u32, ExtendedColorType::Rgb8).unwrap();
    let xmp = format!(
        "http://ns.adobe.com/xap/1.0/\0<x GPano:ProjectionType=\"equirectangular\" \
         GPano:FullPanoWidthPixels=\"{}\" GPano:FullPanoHeightPixels=\"{}\" \
         GPano:CroppedAreaLeftPixels=\"{left}\" GPano:CroppedAreaTopPixels=\"{top}\" \
         GPano:CroppedAreaImageWidthPixels=\"{width}\" GPano:CroppedAreaImageHeightPixels=\"{height}\"/>",
        whole.width, whole.height
    );
    let length = (xmp.len() as u16 + 2).to_be_bytes();
    let segment = [&[0xff, 0xe1], &length[..], xmp.as_bytes()].concat();
    bytes.splice(2..2, segment);
    std::fs::write(file, bytes).unwrap();
}

/// Parts of panoramas are cut into the views that they fill.
#[test]
fn parts_of_panoramas_get_their_cameras() {
    let folder = tempfile::tempdir().unwrap();
    let files = ["a.jpg", "b.jpg"].map(|name| folder.path().join(name));
    let save = |[left, top]: [usize; 2], size: [usize; 2]| {
        for (i, file) in files.iter().enumerate() {
            let whole = panorama(WIDTH, places()[i].1, places()[i].0);
            save_part(file, &whole, [left, top], size);
        }
    };
    let read = || {
        let options = EstimateOptions::default();
        estimate_cameras_of_files(folder.path(), &files, &options, &mut |_| Ok(()))
    };
    // 240 by 127 degrees: at least one view of each lies in the gap.
    save([170, 70], [683, 360]);
    let found = read().unwrap();
    check_cameras(&found, 0.3, 1.0);
    let frames = &found.scene.frames;
    assert!((6..=10).contains(&frames.len()), "{}", frames.len());
    let first = found.estimate.cameras[0].unwrap().rotation().as_dmat3();
    let room_from_world = places()[0].0 * first.transpose();
    let mut whole = 0;
    for frame in frames {
        let loaded = frame.load_with(&subsplat::LoadOptions::default()).unwrap();
        let share = loaded
            .mask
            .as_ref()
            .map_or(1.0, |mask| mask.count() as f64 / (mask.width() * mask.height()) as f64);
        assert!(share > 0.2, "{}: {share}", frame.name);
        if loaded.mask.is_none() {
            let place = places()[usize::from(frame.image == files[1])].1;
            let axes = room_from_world * loaded.camera.rotation().as_dmat3();
            let off = difference(&loaded.picture, &loaded.camera.intrinsics(), place, axes);
            assert!(off < 8.0, "{}: {off}", frame.name);
            whole += 1;
        }
    }
    assert!(whole >= 4, "{whole}");
    for (frame, px) in found.observations.iter().flatten() {
        let k = frames[*frame].camera.intrinsics();
        assert!(px[0] <= k.width as f32 && px[1] <= k.height as f32);
    }
    assert!(median_reprojection(&found) < 0.5);
    // 46 by 53 degrees.
    save([450, 180], [130, 150]);
    let error = read().unwrap_err().to_string();
    assert!(error.contains("two views of 90 degrees, got one of 46x53 degrees"), "{error}");
}
