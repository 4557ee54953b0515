//! Lenses that are no pinholes: models of pose files, panoramas and fisheye pictures, and views of them. The
//! pictures are those of a ray caster (`subsplat_test_support::box_room`).

use glam::{DMat3, DMat4, DVec2, DVec3, Vec2};
use std::f64::consts::FRAC_PI_2;
use std::fmt::Write;
use std::path::Path;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::shape::{ImageCircle, edges_meet, image_circle};
use subsplat::files::photos::views::{fisheye_cut, panorama_cut, shared_axes};
use subsplat::kernels::camera::Intrinsics;
use subsplat::scene::mask::Mask;
use subsplat::{Frame, Rgb, Scene, load_scene, save_png};
use subsplat_test_support::box_room::{colour, fisheye, panorama};

const EYES: [DVec3; 2] = [DVec3::new(-0.5, 0.1, -0.2), DVec3::new(0.4, 0.0, 0.3)];

/// A level camera that is turned to the right, then tilted.
fn axes(yaw: f64, roll: f64) -> DMat3 {
    DMat3::from_rotation_y(yaw) * DMat3::from_rotation_z(roll)
}

/// Mean absolute difference of a view's pixels from what its camera sees of the room, 8-bit levels.
fn error(view: &Rgb, k: &Intrinsics, from: DVec3, world_from_view: DMat3) -> f64 {
    let mut sum = 0.0;
    for (i, pixel) in view.data.chunks_exact(3).enumerate() {
        let px = DVec2::new((i % view.width) as f64 + 0.5, (i / view.width) as f64 + 0.5);
        let ray =
            (px - DVec2::new(k.cx.into(), k.cy.into())) / DVec2::new(k.fx.into(), k.fy.into());
        let seen = colour(from, world_from_view * ray.extend(1.0));
        sum += pixel.iter().zip(seen).map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0;
    }
    sum / (view.width * view.height) as f64
}

/// Numbers of the formulas as COLMAP 4.1 states them, computed with numpy; the division model by the roots of its
/// quadratic equation.
#[test]
fn models_of_colmap_have_its_numbers() {
    let rays = [(0.3, -0.2), (-0.5, 0.4), (0.7, 0.1)];
    let k = [0.02, -0.01, 0.005, -0.002];
    let table = [
        (
            Distortion::ThinPrismFisheye { k, p: [0.003, -0.004], s: [0.01, -0.02] },
            [(0.288302754, -0.193758566), (-0.447800678, 0.354283230), (0.612797377, 0.080777924)],
        ),
        (
            Distortion::RadTanThinPrismFisheye {
                k: [0.02, -0.01, 0.005, -0.002, 0.001, -0.0005],
                p: [0.003, -0.004],
                s: [0.01, -0.02, 0.015, 0.005],
            },
            [(0.290797298, -0.191619737), (-0.442624215, 0.359935210), (0.617049954, 0.092814320)],
        ),
        (
            Distortion::Fov { omega: 0.9 },
            [(0.309884754, -0.206589836), (-0.480661830, 0.384529464), (0.659221384, 0.094174483)],
        ),
        (
            Distortion::Division { k: -0.15 },
            [(0.294367601, -0.196245068), (-0.472535370, 0.378028296), (0.654151984, 0.093450283)],
        ),
    ];
    for (lens, seen) in table {
        for ((x, y), want) in rays.into_iter().zip(seen) {
            let got = lens.project(DVec3::new(x, y, 1.0) * 2.5).unwrap();
            assert!(got.distance(want.into()) < 2e-9, "{lens:?} {x} {y}: {got}");
            let got = lens.distort(Vec2::new(x as f32, y as f32)).as_dvec2();
            assert!(got.distance(want.into()) < 1e-6, "{lens:?} {x} {y}: {got}");
        }
        assert!(lens.distort(Vec2::ZERO).length() < 1e-6, "{lens:?}");
    }
    // Without their further terms, the prism models are OPENCV_FISHEYE, at 100 degrees from the axis as well.
    let direction = DVec3::new(0.6, -0.5, -0.14);
    let plain = Distortion::fisheye(k).project(direction).unwrap();
    let prism = Distortion::ThinPrismFisheye { k, p: [0.0; 2], s: [0.0; 2] };
    let more = [k[0], k[1], k[2], k[3], 0.0, 0.0];
    let tangential = Distortion::RadTanThinPrismFisheye { k: more, p: [0.0; 2], s: [0.0; 4] };
    for lens in [prism, tangential] {
        assert!(lens.project(direction).unwrap().distance(plain) < 1e-12);
    }
    let theta = direction.truncate().length().atan2(direction.z);
    let d = theta
        * (1.0 + k.iter().enumerate().map(|(i, k)| k * theta.powi(2 * i as i32 + 2)).sum::<f64>());
    assert!((plain.length() - d).abs() < 1e-12 && theta > 1.7);
    // Other lenses see nothing behind them.
    for lens in [Distortion::None, Distortion::Fov { omega: 0.9 }, Distortion::Division { k: 0.1 }]
    {
        assert_eq!(lens.project(direction), None, "{lens:?}");
    }
}

#[test]
fn a_view_of_a_panorama_is_the_pinhole_picture() {
    let room = axes(0.7, 0.1);
    let picture = panorama(1440, EYES[0], room);
    // Ahead, across the seam behind, and up.
    for turn in [DMat3::IDENTITY, axes(3.0, 0.0), DMat3::from_rotation_x(0.6), axes(-2.0, 0.3)] {
        let cut = panorama_cut(1440, 720, turn);
        let (view, mask) = cut.apply(&picture, None);
        let k = cut.view;
        assert!((k.fov_x() - FRAC_PI_2 as f32).abs() < 1e-5 && mask.is_none(), "{k:?}");
        assert_eq!((k.width, k.height), (458, 458));
        let off = error(&view, &k, EYES[0], room * turn);
        assert!(off < 2.5, "{turn}: {off}");
        // Another direction is another picture.
        assert!(error(&view, &k, EYES[0], room * turn * axes(0.02, 0.0)) > 2.0 * off);
    }
}

#[test]
fn a_mask_follows_its_view() {
    let picture = panorama(720, EYES[0], DMat3::IDENTITY);
    // The right half of the panorama is masked: longitudes from 0 to 180 degrees.
    let kept = (0..720 * 360).map(|i| i % 720 < 360).collect();
    let mask = Mask::new(720, 360, kept).unwrap();
    let (_, mask) = panorama_cut(720, 360, DMat3::IDENTITY).apply(&picture, Some(&mask));
    let mask = mask.unwrap();
    let middle = mask.width() / 2;
    for (i, kept) in mask.kept().iter().enumerate() {
        let x = i % mask.width();
        assert!(x.abs_diff(middle) < 2 || *kept == (x < middle), "{i}");
    }
}

#[test]
fn views_of_panoramas_share_level_directions_across_their_line() {
    let poses = [(axes(0.3, 0.02), DVec3::ZERO), (axes(2.0, -0.02), DVec3::new(1.0, 0.1, 1.0))];
    let views = shared_axes(&poses);
    for (i, view) in views.iter().enumerate() {
        assert!((view.determinant() - 1.0).abs() < 1e-9);
        assert!(view.y_axis.distance(DVec3::Y) < 0.05, "{view}");
        let turn = view.z_axis.angle_between(views[0].z_axis).to_degrees();
        let want = [0.0, 60.0, 120.0, 180.0, 120.0, 60.0][i];
        assert!((turn - want).abs() < 1e-6, "{i}: {turn}");
    }
    let line = DVec3::new(1.0, 0.0, 1.0).normalize();
    assert!(views[0].z_axis.dot(line).abs() < 0.03, "{}", views[0].z_axis);
    // One panorama looks ahead.
    let own = shared_axes(&poses[..1])[0];
    assert!(own.z_axis.dot(poses[0].0.z_axis) > 0.9999);
}

/// Two panoramas in a folder with `file` of cameras.
fn panorama_scene(folder: &Path, size: [usize; 2], cameras: &str) -> Vec<DMat3> {
    let turns = vec![axes(0.3, 0.02), axes(2.0, -0.03)];
    std::fs::create_dir_all(folder.join("images")).unwrap();
    for (i, turn) in turns.iter().enumerate() {
        let mut picture = panorama(size[0], EYES[i], *turn);
        picture.data.truncate(3 * size[0] * size[1]);
        picture.height = size[1];
        save_png(folder.join(format!("images/{i}.png")), &picture).unwrap();
    }
    if cameras == "transforms" {
        let frame = |i: usize| {
            // OpenGL axes: y up, z back.
            let m = DMat4::from_mat3_translation(turns[i], EYES[i])
                * DMat4::from_diagonal(DVec3::new(1.0, -1.0, -1.0).extend(1.0));
            let rows: Vec<String> = (0..4).map(|r| format!("{:?}", m.row(r).to_array())).collect();
            format!(
                r#"{{"file_path": "images/{i}.png", "transform_matrix": [{}]}}"#,
                rows.join(",")
            )
        };
        let json = format!(
            r#"{{"camera_model": "EQUIRECTANGULAR", "w": 1440, "h": 720, "fl_x": 720, "fl_y": 360,
                "cx": 720, "cy": 360, "frames": [{},{}]}}"#,
            frame(0),
            frame(1)
        );
        std::fs::write(folder.join("transforms.json"), json).unwrap();
    } else {
        let model = folder.join("sparse/0");
        std::fs::create_dir_all(&model).unwrap();
        std::fs::write(model.join("cameras.txt"), "1 EQUIRECTANGULAR 1440 720 1440 720\n").unwrap();
        let mut images = String::new();
        for (i, turn) in turns.iter().enumerate() {
            let q = glam::DQuat::from_mat3(&turn.transpose());
            let t = -(turn.transpose() * EYES[i]);
            writeln!(
                images,
                "{} {} {} {} {} {} {} {} 1 {i}.png\n",
                i + 1,
                q.w,
                q.x,
                q.y,
                q.z,
                t.x,
                t.y,
                t.z
            )
            .unwrap();
        }
        std::fs::write(model.join("images.txt"), images).unwrap();
        std::fs::write(model.join("points3D.txt"), "1 0 0 2 9 9 9 0.1\n").unwrap();
    }
    turns
}

fn load(frame: &Frame) -> (Rgb, Intrinsics, DVec3, DMat3) {
    let (picture, camera) = frame.load().unwrap();
    let (position, rotation) = (camera.position().as_dvec3(), camera.rotation().as_dmat3());
    (picture, camera.intrinsics(), position, rotation)
}

#[test]
fn panoramas_of_pose_files_become_pinhole_frames() {
    for format in ["transforms", "colmap"] {
        let folder = tempfile::tempdir().unwrap();
        panorama_scene(folder.path(), [1440, 720], format);
        let scene: Scene = load_scene(folder.path()).unwrap();
        let names: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
        assert_eq!(names.len(), 12, "{format}: {names:?}");
        assert_eq!((names[0], names[1], names[11]), ("0_000", "0_060", "1_300"));
        for (i, frame) in scene.frames.iter().enumerate() {
            let (picture, k, position, rotation) = load(frame);
            assert!(position.distance(EYES[i / 6]) < 1e-5, "{format} {i}");
            let off = error(&picture, &k, position, rotation);
            assert!(off < 2.5, "{format} {i}: {off}");
            // Frames of one direction have the same axes.
            assert_eq!(frame.camera.rotation(), scene.frames[i % 6].camera.rotation());
        }
    }
}

#[test]
fn a_reduced_copy_is_read_and_another_shape_refused() {
    let folder = tempfile::tempdir().unwrap();
    panorama_scene(folder.path(), [720, 360], "transforms");
    let scene = load_scene(folder.path()).unwrap();
    let (picture, k, position, rotation) = load(&scene.frames[7]);
    assert_eq!(k.width, 229);
    assert!(error(&picture, &k, position, rotation) < 5.0);
    // A mask beside the photographs, above the horizon.
    let row = |y: usize| [if y < 180 { 255u8 } else { 0 }; 3 * 720];
    let mask = Rgb { width: 720, height: 360, data: (0..360).flat_map(row).collect() };
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    save_png(folder.path().join("masks/1.png"), &mask).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    let loaded = scene.frames[7].load_with(&subsplat::LoadOptions::default()).unwrap();
    let share = loaded.mask.unwrap().count() as f64 / (229.0 * 229.0);
    assert!((share - 0.5).abs() < 0.1, "{share}");
    // Without its lower part a panorama is no whole one.
    let folder = tempfile::tempdir().unwrap();
    panorama_scene(folder.path(), [720, 300], "transforms");
    let error = load_scene(folder.path()).unwrap_err().to_string();
    for word in ["twice as wide as high", "720x300", "frame 0"] {
        assert!(error.contains(word), "{word}: {error}");
    }
}

#[test]
fn edges_of_panoramas_meet_and_those_of_photographs_do_not() {
    for (i, eye) in EYES.into_iter().enumerate() {
        let whole = panorama(1024, eye, axes(i as f64, 0.05));
        assert!(edges_meet(&whole));
        // Nearly a whole panorama: twenty degrees are missing.
        let part = |w: usize| {
            let rows = whole.data.chunks_exact(3 * 1024);
            let data = rows.flat_map(|row| row[..3 * w].to_vec()).collect();
            Rgb { width: w, height: 512, data }
        };
        assert!(edges_meet(&part(1023)) && !edges_meet(&part(967)) && !edges_meet(&part(512)));
    }
    // A plain background, and one that grows darker towards the floor.
    let shade = |y: usize| [(200 - y / 4) as u8; 3 * 1024];
    let plain = Rgb { width: 1024, height: 512, data: (0..512).flat_map(shade).collect() };
    assert!(!edges_meet(&plain) && !edges_meet(&Rgb::black(2, 1)));
}

fn disc(r: f64) -> f64 {
    r * FRAC_PI_2
}

#[test]
fn the_circle_of_a_fisheye_lens_is_found() {
    let mut picture = fisheye([640, 480], 230.0, EYES[0], axes(0.5, 0.0), disc);
    // A dark window at the rim and one inside.
    for (i, pixel) in picture.data.chunks_exact_mut(3).enumerate() {
        let (x, y) = (i % 640, i / 640);
        if (300..360).contains(&x) && (y < 60 || (200..260).contains(&y)) {
            pixel.fill(3);
        }
    }
    let ImageCircle { centre, radius } = image_circle(&picture).unwrap();
    let off = DVec2::from(centre).distance(DVec2::new(320.0, 240.0));
    assert!(off < 1.5 && (radius - 230.0).abs() < 1.5, "{centre:?} {radius}");
    // Cut at its top and bottom.
    let cut = fisheye([640, 400], 230.0, EYES[0], axes(0.5, 0.0), disc);
    let ImageCircle { radius, .. } = image_circle(&cut).unwrap();
    assert!((radius - 230.0).abs() < 3.0, "{radius}");
    // A photograph, black, and a bright square on black.
    let photograph = panorama(640, EYES[0], DMat3::IDENTITY);
    let square = |i: usize| {
        let (x, y) = (i % 640, i / 640);
        [if (170..470).contains(&x) && (90..390).contains(&y) { 200u8 } else { 0 }; 3]
    };
    let square = Rgb { width: 640, height: 480, data: (0..640 * 480).flat_map(square).collect() };
    for other in [photograph, Rgb::black(640, 480), square] {
        assert_eq!(image_circle(&other), None);
    }
}

#[test]
fn a_view_of_a_fisheye_picture_is_the_pinhole_picture() {
    let room = axes(-0.4, 0.1);
    let size = [640, 480];
    for (lens, inverse) in [
        (Distortion::fisheye([0.0; 4]), (|f: f64| f) as fn(f64) -> f64),
        (
            Distortion::Fov { omega: 1.2 },
            (|d: f64| ((d * 1.2).tan() / (2.0 * 0.6f64.tan())).atan()) as fn(f64) -> f64,
        ),
    ] {
        // 230 px for 80 degrees from the axis.
        let focal = 230.0 / lens.project(DVec3::new(80f64.to_radians().tan(), 0.0, 1.0)).unwrap().x;
        let picture = fisheye(size, 230.0, EYES[1], room, |r| inverse(r * 230.0 / focal));
        let f = focal as f32;
        let k = Intrinsics { fx: f, fy: f, cx: 320.0, cy: 240.0, width: 640, height: 480 };
        for radius in [Some(230.0), Some(100.0), None] {
            let cut = fisheye_cut(&k, &lens, radius).unwrap();
            let (view, mask) = cut.apply(&picture, None);
            assert!(mask.is_none() && cut.view.fov_x() <= 1.5709, "{:?}", cut.view);
            assert!(radius != Some(230.0) || cut.view.fov_x() > 1.57);
            assert!(radius.is_none() || cut.view.width == cut.view.height);
            let off = error(&view, &cut.view, EYES[1], room);
            assert!(off < 4.0, "{lens:?} {radius:?}: {off}");
        }
        assert!(fisheye_cut(&k, &lens, Some(3.0)).is_none());
    }
}
