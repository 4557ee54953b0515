//! Posed photographs: every format of the same folder agrees, the protocol's numbers
//! come out, and pictures are resampled as Pillow does.

mod common;

use common::shared;
use glam::{Mat4, Quat, Vec2, Vec3};
use std::path::{Path, PathBuf};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::data::crop::{CropOptions, CropRule, crop};
use subsplat::data::depth::depth_range;
use subsplat::data::pair::{choose_pair, view_geometry};
use subsplat::io::cameras_json::{CameraFile, NamedCamera, load_cameras_json, save_cameras_json};
use subsplat::io::image::{self, Rgb};
use subsplat::io::matrices::{self, PoseConvention};
use subsplat::io::protocol::{load_index, load_protocol};
use subsplat::io::resize::{Filter, resize};
use subsplat::io::scene::{Scene, SceneFormat, Units, load_scene};
use subsplat::io::undistort::{Distortion, undistort};

const SCENES: [&str; 9] = [
    "fox",
    "hololens_foosball",
    "hololens_table",
    "pair_bananas",
    "re10k_0bf152ef84195293",
    "re10k_0c9b371cc6225682",
    "re10k_0f68374b76390082",
    "re10k_0f68374b76390082_anamorphic",
    "re10k_5aca87f95a9412c6",
];

/// Largest difference of two scenes' cameras: focal and centre in px, pose entries.
fn difference(a: &Scene, b: &Scene) -> (f32, f32) {
    assert_eq!(a.frames.len(), b.frames.len());
    let mut worst = (0.0f32, 0.0f32);
    for (a, b) in a.frames.iter().zip(&b.frames) {
        assert_eq!(a.image.file_name(), b.image.file_name());
        assert_eq!(a.name, b.name);
        let (ka, kb) = (a.camera.intrinsics, b.camera.intrinsics);
        assert_eq!((ka.width, ka.height), (kb.width, kb.height));
        let k = [ka.fx - kb.fx, ka.fy - kb.fy, ka.cx - kb.cx, ka.cy - kb.cy];
        let pose = a.camera.world_from_camera - b.camera.world_from_camera;
        worst.0 = k.iter().fold(worst.0, |m, v| m.max(v.abs()));
        worst.1 = pose.to_cols_array().iter().fold(worst.1, |m, v| m.max(v.abs()));
    }
    worst
}

#[test]
fn every_scene_loads() {
    let Some(photos) = shared("photos") else { return };
    for name in SCENES {
        let scene = load_scene(&photos.join(name)).unwrap();
        assert_eq!(scene.name, name);
        assert_eq!(scene.source, SceneFormat::CamerasJson);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        let units = match name {
            n if n.starts_with("re10k") => Units::RealEstate10k,
            n if n.starts_with("hololens") => Units::Metres,
            _ => Units::Unknown,
        };
        assert_eq!(scene.units, units, "{name}");
        let (picture, camera) = scene.frames[0].load().unwrap();
        assert_eq!(picture.width, camera.intrinsics.width);
        let depth = scene.frames[0].depth.is_some();
        assert_eq!(depth, name.starts_with("hololens"));
    }
}

#[test]
fn formats_of_one_folder_agree() {
    let Some(photos) = shared("photos") else { return };
    // File, px, pose. RE10K: nine digits of the inverse; poses.txt: six digits.
    let cases = [
        ("fox", "transforms.json", SceneFormat::Transforms, 1e-4, 1e-6),
        ("hololens_table", "transforms.json", SceneFormat::Transforms, 1e-4, 1e-6),
        ("hololens_table", "poses.txt", SceneFormat::Matrices, 1e-4, 3e-6),
        ("hololens_foosball", "poses.txt", SceneFormat::Matrices, 1e-4, 3e-6),
        ("re10k_5aca87f95a9412c6", "transforms.json", SceneFormat::Transforms, 1e-4, 1e-6),
        ("re10k_0bf152ef84195293", "0bf152ef84195293.txt", SceneFormat::RealEstate10k, 1e-4, 1e-6),
        ("re10k_0c9b371cc6225682", "0c9b371cc6225682.txt", SceneFormat::RealEstate10k, 1e-4, 1e-6),
        ("re10k_0f68374b76390082", "0f68374b76390082.txt", SceneFormat::RealEstate10k, 1e-4, 1e-6),
        (
            "re10k_0f68374b76390082_anamorphic",
            "0f68374b76390082.txt",
            SceneFormat::RealEstate10k,
            1e-4,
            1e-6,
        ),
    ];
    for (name, file, format, px, pose) in cases {
        let folder = photos.join(name);
        let reference = load_scene(&folder).unwrap();
        let other = load_scene(&folder.join(file)).unwrap();
        assert_eq!(other.source, format);
        let worst = difference(&reference, &other);
        assert!(worst.0 < px && worst.1 < pose, "{name} {file}: {worst:?}");
        if format == SceneFormat::RealEstate10k {
            assert_eq!(other.units, Units::RealEstate10k);
            for (a, b) in reference.frames.iter().zip(&other.frames) {
                assert_eq!(a.timestamp, b.timestamp);
            }
        }
    }
}

#[test]
fn protocol_intrinsics_are_the_exact_rule() {
    let Some(photos) = shared("photos") else { return };
    for name in SCENES {
        let folder = photos.join(name);
        let protocol = load_protocol(&folder.join("protocol.json")).unwrap();
        let scene = load_scene(&folder).unwrap();
        for test in &protocol.tests {
            test.check(&folder, scene.frames.len()).unwrap();
        }
        let (picture, camera) = scene.frames[0].load().unwrap();
        let c = crop(&picture, &camera, &CropOptions::square(256, 1, 16)).unwrap();
        let want = protocol.intrinsics_256.unwrap();
        let got = c.input_camera.intrinsics;
        for (g, w) in [(got.fx, want.fx), (got.fy, want.fy), (got.cx, want.cx), (got.cy, want.cy)] {
            assert!((f64::from(g) - w).abs() < 1e-3, "{name}: {got:?} {want:?}");
        }
    }
}

#[test]
fn protocol_geometry_is_ours() {
    let Some(photos) = shared("photos") else { return };
    #[derive(serde::Deserialize)]
    struct Test {
        context: [usize; 2],
        baseline: f32,
        rot_deg: f32,
    }
    #[derive(serde::Deserialize)]
    struct File {
        #[serde(default)]
        tests: Vec<Test>,
    }
    let mut compared = 0;
    for name in SCENES {
        let text = std::fs::read(photos.join(name).join("protocol.json")).unwrap();
        let file: File = serde_json::from_slice(&text).unwrap();
        let scene = load_scene(&photos.join(name)).unwrap();
        for t in file.tests {
            let [a, b] = t.context.map(|i| scene.frames[i].camera);
            let g = view_geometry(&a, &b, 1.0, 100.0);
            assert!((g.baseline - t.baseline).abs() < 1e-4 * t.baseline, "{name} {g:?}");
            assert!((g.rotation_deg - t.rot_deg).abs() < 2e-3, "{name} {g:?} {}", t.rot_deg);
            compared += 1;
        }
        let pair = choose_pair(&scene).unwrap();
        eprintln!("{name}: {}", pair.reason);
        let range = depth_range(&scene, &pair.frames, (None, None)).unwrap();
        assert_eq!(name.starts_with("re10k"), range.near == 1.0 && range.far == 100.0, "{range:?}");
    }
    assert!(compared >= 13, "{compared}");
}

#[test]
fn evaluation_indexes_have_the_published_counts() {
    let Some(folder) = shared("fixtures/eval_index") else { return };
    for (file, all, usable) in [
        ("mvsplat_evaluation_index_re10k.json", 7194, 6474),
        ("mvsplat_evaluation_index_acid.json", 1848, 1595),
    ] {
        let index = load_index(&folder.join(file)).unwrap();
        assert_eq!(index.len(), all);
        assert_eq!(index.values().flatten().count(), usable);
        assert!(index.values().flatten().all(|v| v.context.len() == 2 && v.target.len() == 3));
    }
    load_index(&folder.join("globalsplat_demo_index.json")).unwrap();
}

#[test]
fn distorted_fox_is_straightened() {
    let Some(fox) = shared("photos/fox") else { return };
    // This file lists all 50 frames of the source, 20 of which are here, with the lens
    // of the unprocessed photographs.
    let bent = load_scene(&fox.join("transforms_original_distorted_1080x1920.json")).unwrap();
    let straight = load_scene(&fox).unwrap();
    assert_eq!(bent.frames.len(), straight.frames.len());
    assert!(bent.warnings.iter().any(|w| w.contains("of 50 frames have no picture")));
    assert_eq!(difference(&bent, &straight).1, 0.0);
    let frame = &bent.frames[0];
    let Distortion::Brown { k, p } = frame.distortion else { panic!("{:?}", frame.distortion) };
    assert_eq!((k[0], k[1], p), (0.0578421, -0.0805099, [-0.000980296, 0.00015575]));

    // The stored pictures are straight already; their distorted originals are not here.
    // So bend a stored picture with this lens, straighten it again, and compare.
    let lens = &frame.distortion;
    let photo = image::load(&frame.image).unwrap();
    let k = frame.camera.intrinsics;
    let bend = Bend { lens, k };
    let bent_photo = bend.apply(&photo);
    let new = frame.pinhole().unwrap().intrinsics;
    assert!(new.fx / k.fx > 0.95 && new.fx / k.fx < 1.05, "{new:?}");
    let back = undistort(&bent_photo, &k, lens, &k);
    let untouched = psnr_inside(&bent_photo, &photo, 60);
    let restored = psnr_inside(&back, &photo, 60);
    eprintln!("fox: bent {untouched:.1} dB, straightened {restored:.1} dB");
    assert!(restored > 33.0 && untouched < restored - 8.0, "{untouched} {restored}");
}

/// A picture as the lens would have shown it: the inverse of the straightening, by
/// iteration and bilinear sampling.
struct Bend<'a> {
    lens: &'a Distortion,
    k: Intrinsics,
}

impl Bend<'_> {
    fn apply(&self, photo: &Rgb) -> Rgb {
        let mut out = Rgb::black(photo.width, photo.height);
        for y in 0..photo.height {
            for x in 0..photo.width {
                let seen = self.k.unproject(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).truncate();
                let mut ray = seen;
                for _ in 0..8 {
                    ray += seen - self.lens.distort(ray);
                }
                let px = self.k.project(ray.extend(1.0)) - 0.5;
                let p = 3 * (y * photo.width + x);
                let pixel = bilinear(photo, px);
                out.data[p..p + 3].copy_from_slice(&pixel);
            }
        }
        out
    }
}

fn bilinear(photo: &Rgb, px: Vec2) -> [u8; 3] {
    let (x, y) = (px.x.floor(), px.y.floor());
    let (fx, fy) = (px.x - x, px.y - y);
    let at = |x: f32, y: f32, c: usize| {
        let x = (x.max(0.0) as usize).min(photo.width - 1);
        let y = (y.max(0.0) as usize).min(photo.height - 1);
        f32::from(photo.data[3 * (y * photo.width + x) + c])
    };
    std::array::from_fn(|c| {
        let top = at(x, y, c) * (1.0 - fx) + at(x + 1.0, y, c) * fx;
        let bottom = at(x, y + 1.0, c) * (1.0 - fx) + at(x + 1.0, y + 1.0, c) * fx;
        (top * (1.0 - fy) + bottom * fy + 0.5) as u8
    })
}

fn psnr_inside(a: &Rgb, b: &Rgb, border: usize) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for y in border..a.height - border {
        for x in border..a.width - border {
            for c in 0..3 {
                let p = 3 * (y * a.width + x) + c;
                sum += (f64::from(a.data[p]) - f64::from(b.data[p])).powi(2);
                n += 1;
            }
        }
    }
    10.0 * (255.0f64.powi(2) * f64::from(n) / sum).log10()
}

/// The generator of tools/make_resize_golden.py.
fn noise(width: usize, height: usize) -> Rgb {
    let mut state = 12345u32;
    let data = (0..width * height * 3)
        .map(|i| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let value = (state >> 24) as u8;
            match (i / 3 % 7, value) {
                (0, 128..) => 255,
                (0, _) => 0,
                _ => value,
            }
        })
        .collect();
    Rgb { width, height, data }
}

#[test]
fn resampling_is_pillows() {
    let size = |s: &str| -> (usize, usize) {
        let (w, h) = s.split_once('x').unwrap();
        (w.parse().unwrap(), h.parse().unwrap())
    };
    let mut lines = 0;
    for line in include_str!("goldens/resize.txt").lines().filter(|l| !l.starts_with('#')) {
        let words: Vec<&str> = line.split(' ').collect();
        let filter = match words[0] {
            "box" => Filter::Box,
            "bilinear" => Filter::Bilinear,
            "bicubic" => Filter::Bicubic,
            "lanczos" => Filter::Lanczos,
            other => panic!("{other}"),
        };
        let ((w, h), (to_w, to_h)) = (size(words[1]), size(words[2]));
        let out = resize(&noise(w, h), to_w, to_h, filter);
        if words[3] == "crc" {
            let mut crc = flate2::Crc::new();
            crc.update(&out.data);
            assert_eq!(crc.sum(), words[4].parse::<u32>().unwrap(), "{}", &line[..30]);
        } else {
            let hex: String = out.data.iter().map(|b| format!("{b:02x}")).collect();
            assert_eq!(hex, words[3], "{} {} {}", words[0], words[1], words[2]);
        }
        lines += 1;
    }
    assert_eq!(lines, 56);
}

/// A folder with `n` pictures of 64×48 and cameras that nothing is special about.
fn made_up(n: usize) -> (tempfile::TempDir, Vec<NamedCamera>) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    let cameras = (0..n).map(|i| {
        let file = format!("images/{i:03}.png");
        image::save_png(&folder.path().join(&file), &noise(64, 48)).unwrap();
        let t = i as f32;
        let k = Intrinsics {
            fx: 70.1 + t,
            fy: 71.3 + t,
            cx: 31.7 - 0.1 * t,
            cy: 24.9,
            width: 64,
            height: 48,
        };
        let rotation = Quat::from_euler(glam::EulerRot::XYZ, 0.1 * t, 0.7 - 0.2 * t, 0.3 + t);
        let pose = Mat4::from_rotation_translation(rotation, Vec3::new(t, 0.3, -0.7 * t));
        let camera = Camera::new(k, pose).unwrap();
        NamedCamera { file, camera, timestamp: (i % 2 == 0).then_some(i as i64), depth: None }
    });
    let cameras = cameras.collect();
    (folder, cameras)
}

#[test]
fn cameras_json_reads_back_what_was_written() {
    let (folder, mut cameras) = made_up(5);
    cameras[3].depth = Some("depth/003.png".to_owned());
    for units in [Units::Unknown, Units::Metres, Units::RealEstate10k] {
        let path = folder.path().join("cameras.json");
        let content = CameraFile { cameras: cameras.clone(), units };
        save_cameras_json(&path, &content).unwrap();
        assert_eq!(load_cameras_json(&path).unwrap(), content);
        let scene = load_scene(folder.path()).unwrap();
        assert_eq!(scene.units, units);
        for (frame, camera) in scene.frames.iter().zip(&cameras) {
            assert_eq!(frame.camera, camera.camera);
            assert_eq!(frame.timestamp, camera.timestamp);
            assert_eq!(frame.image, folder.path().join(&camera.file));
            assert_eq!(NamedCamera::of_frame(frame, &*camera.file).camera, camera.camera);
        }
    }
}

#[test]
fn three_dgs_camera_lists_are_read() {
    let (folder, cameras) = made_up(2);
    let list: Vec<_> = cameras
        .iter()
        .map(|c| {
            let rows = c.camera.rotation().transpose().to_cols_array_2d();
            let k = c.camera.intrinsics;
            serde_json::json!({
                "id": 0, "img_name": c.file.trim_start_matches("images/").trim_end_matches(".png"),
                "width": 64, "height": 48, "fx": k.fx, "fy": k.fy,
                "rotation": rows, "position": c.camera.position().to_array(),
            })
        })
        .collect();
    std::fs::write(folder.path().join("cameras.json"), serde_json::to_vec(&list).unwrap()).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    for (frame, c) in scene.frames.iter().zip(&cameras) {
        assert_eq!(frame.camera.world_from_camera, c.camera.world_from_camera);
        assert_eq!((frame.camera.intrinsics.cx, frame.camera.intrinsics.cy), (32.0, 24.0));
    }
}

mod colmap_files {
    //! A COLMAP model of the made-up cameras, in both forms.
    use super::*;

    /// Model number, name, and parameters of a camera of 64×48 pixels.
    pub type Model = (i32, &'static str, Vec<f64>);

    pub fn model(k: &Intrinsics) -> Model {
        let p = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
        (4, "OPENCV", [&p[..], &[0.01, -0.02, 0.001, 0.002]].concat())
    }

    /// Quaternion wxyz and translation, camera from world.
    fn pose(c: &Camera) -> ([f64; 4], [f64; 3]) {
        let m = c.world_from_camera.as_dmat4().inverse();
        let q = glam::DQuat::from_mat4(&m);
        ([q.w, q.x, q.y, q.z], m.w_axis.truncate().to_array())
    }

    pub fn points() -> Vec<[f64; 3]> {
        (0..40).map(|i| [0.1 * f64::from(i), 0.2, 3.0 + 0.01 * f64::from(i)]).collect()
    }

    pub fn binary(cameras: &[NamedCamera]) -> [Vec<u8>; 3] {
        let count = |n: usize| (n as u64).to_le_bytes().to_vec();
        let (mut cams, mut images, mut pts) =
            (count(cameras.len()), count(cameras.len()), count(points().len()));
        for (i, c) in cameras.iter().enumerate() {
            let (number, _, parameters) = model(&c.camera.intrinsics);
            cams.extend((i as u32 + 7).to_le_bytes());
            cams.extend(number.to_le_bytes());
            cams.extend(64u64.to_le_bytes());
            cams.extend(48u64.to_le_bytes());
            parameters.iter().for_each(|p| cams.extend(p.to_le_bytes()));

            images.extend((i as u32).to_le_bytes());
            let (q, t) = pose(&c.camera);
            q.iter().chain(&t).for_each(|v| images.extend(v.to_le_bytes()));
            images.extend((i as u32 + 7).to_le_bytes());
            images.extend(c.file.trim_start_matches("images/").bytes());
            images.push(0);
            images.extend(3u64.to_le_bytes());
            for id in [1000u64, u64::MAX, 1001 + i as u64] {
                images.extend(1.5f64.to_le_bytes());
                images.extend(2.5f64.to_le_bytes());
                images.extend(id.to_le_bytes());
            }
        }
        for (i, p) in points().iter().enumerate() {
            pts.extend((1000 + i as u64).to_le_bytes());
            p.iter().for_each(|v| pts.extend(v.to_le_bytes()));
            pts.extend([1, 2, 3]);
            pts.extend(0.5f64.to_le_bytes());
            pts.extend(1u64.to_le_bytes());
            pts.extend([0; 8]);
        }
        [cams, images, pts]
    }

    pub fn text(cameras: &[NamedCamera]) -> [String; 3] {
        let mut out = [(); 3].map(|()| "# comment\n".to_owned());
        for (i, c) in cameras.iter().enumerate() {
            let (_, name, parameters) = model(&c.camera.intrinsics);
            let join = |v: &[f64]| v.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
            out[0] += &format!("{} {name} 64 48 {}\n", i + 7, join(&parameters));
            let (q, t) = pose(&c.camera);
            let file = c.file.trim_start_matches("images/");
            out[1] += &format!("{i} {} {} {} {file}\n", join(&q), join(&t), i + 7);
            out[1] += &format!("1.5 2.5 1000 1.5 2.5 -1 1.5 2.5 {}\n", 1001 + i);
        }
        for (i, [x, y, z]) in points().iter().enumerate() {
            out[2] += &format!("{} {x} {y} {z} 1 2 3 0.5 0 0\n", 1000 + i);
        }
        out
    }

    pub fn write(folder: &Path, extension: &str, files: [&[u8]; 3]) {
        std::fs::create_dir_all(folder).unwrap();
        for (stem, bytes) in ["cameras", "images", "points3D"].iter().zip(files) {
            std::fs::write(folder.join(format!("{stem}.{extension}")), bytes).unwrap();
        }
    }
}

fn check_colmap(scene: &Scene, cameras: &[NamedCamera]) {
    assert_eq!(scene.source, SceneFormat::Colmap);
    assert_eq!(scene.frames.len(), cameras.len());
    let points = scene.points.as_ref().unwrap();
    assert_eq!(points.len(), 40);
    assert_eq!(points[0], Vec3::new(0.0, 0.2, 3.0));
    for (i, (f, c)) in scene.frames.iter().zip(cameras).enumerate() {
        let error = f.camera.world_from_camera - c.camera.world_from_camera;
        assert!(error.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{error}");
        assert_eq!(f.camera.intrinsics, c.camera.intrinsics);
        assert_eq!(f.visible, [0, 1 + i as u32]);
        let Distortion::Brown { k, p } = f.distortion else { panic!() };
        assert_eq!((k[0], k[1], p), (0.01, -0.02, [0.001, 0.002]));
        let (picture, camera) = f.load().unwrap();
        assert_eq!((picture.width, picture.height), (64, 48));
        assert_ne!(camera.intrinsics.fx, f.camera.intrinsics.fx);
    }
}

#[test]
fn colmap_binary_and_text_agree_wherever_the_model_lies() {
    for place in ["sparse/0", "sparse", "colmap/sparse/0", "."] {
        let (folder, cameras) = made_up(4);
        let model = folder.path().join(place);
        let files = colmap_files::binary(&cameras);
        colmap_files::write(&model, "bin", [&files[0], &files[1], &files[2]]);
        // COLMAP 4's extra files.
        std::fs::write(model.join("rigs.bin"), [1, 2]).unwrap();
        std::fs::write(model.join("frames.bin"), [1, 2]).unwrap();
        check_colmap(&load_scene(folder.path()).unwrap(), &cameras);
        let name = folder.path().file_name().unwrap().to_string_lossy().into_owned();
        assert_eq!(load_scene(&model.join("images.bin")).unwrap().name, name);

        let (folder, cameras) = made_up(4);
        let model = folder.path().join(place);
        let files = colmap_files::text(&cameras);
        let files = [files[0].as_bytes(), files[1].as_bytes(), files[2].as_bytes()];
        colmap_files::write(&model, "txt", files);
        let scene = load_scene(folder.path()).unwrap();
        check_colmap(&scene, &cameras);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        check_colmap(&load_scene(&model.join("cameras.txt")).unwrap(), &cameras);
    }
}

#[test]
fn colmap_text_without_point_lines_or_points_file() {
    let (folder, cameras) = made_up(3);
    let [cams, images, _] = colmap_files::text(&cameras);
    for empty_lines in [true, false] {
        let images: String = images
            .lines()
            .filter(|l| !l.starts_with("1.5"))
            .map(|l| format!("{l}\n{}", if empty_lines { "\n" } else { "" }))
            .collect();
        colmap_files::write(
            &folder.path().join("sparse/0"),
            "txt",
            [cams.as_bytes(), images.as_bytes(), b""],
        );
        std::fs::remove_file(folder.path().join("sparse/0/points3D.txt")).unwrap();
        let scene = load_scene(folder.path()).unwrap();
        assert_eq!(scene.frames.len(), 3);
        assert!(scene.points.is_none());
        assert_eq!(scene.warnings.len(), if empty_lines { 1 } else { 2 }, "{:?}", scene.warnings);
    }
}

#[test]
fn colmap_points_give_the_depth_range() {
    let (folder, cameras) = made_up(1);
    let files = colmap_files::binary(&cameras);
    colmap_files::write(&folder.path().join("sparse"), "bin", [&files[0], &files[1], &files[2]]);
    let mut scene = load_scene(folder.path()).unwrap();
    // Replace pose and points: a wall at depths 2 to 4 in front of the camera.
    scene.frames[0].camera.world_from_camera = Mat4::IDENTITY;
    scene.points = Some((0..101).map(|i| Vec3::new(0.0, 0.0, 2.0 + 0.02 * i as f32)).collect());
    let range = depth_range(&scene, &[0], (None, None)).unwrap();
    assert!((range.near - 2.04 / 1.5).abs() < 1e-4 && (range.far - 2.0 * 3.96).abs() < 1e-4);
    assert!(range.reason.contains("101"), "{}", range.reason);
    let given = depth_range(&scene, &[0], (Some(0.5), None)).unwrap();
    assert_eq!((given.near, given.far), (0.5, range.far));
    assert!(depth_range(&scene, &[0], (Some(50.0), None)).is_err());
    assert!(depth_range(&scene, &[0], (Some(f32::NAN), Some(2.0))).is_err());
    assert!(depth_range(&scene, &[7], (None, None)).is_err());
    scene.points = None;
    assert!(depth_range(&scene, &[0], (None, None)).unwrap_err().to_string().contains("baseline"));
}

#[test]
fn transforms_json_in_its_many_forms() {
    let (folder, cameras) = made_up(3);
    let gl = |c: &Camera| {
        let m = c.world_from_camera * Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
        m.transpose().to_cols_array_2d()
    };
    let frames = |name: &dyn Fn(&str) -> String| -> Vec<serde_json::Value> {
        let frame = |c: &NamedCamera| {
            serde_json::json!({"file_path": name(&c.file), "transform_matrix": gl(&c.camera),
                "sharpness": 3})
        };
        cameras.iter().map(frame).collect()
    };
    let load = |json: serde_json::Value| {
        std::fs::write(folder.path().join("transforms.json"), json.to_string()).unwrap();
        load_scene(folder.path()).unwrap()
    };
    // NeRF's blender scenes: an angle, no size, names without extension.
    let bare = |f: &str| format!("./{}", f.trim_end_matches(".png"));
    let scene = load(serde_json::json!({"camera_angle_x": 0.8, "frames": frames(&bare)}));
    let f = 32.0 / (0.4f32).tan();
    for (frame, c) in scene.frames.iter().zip(&cameras) {
        assert_eq!(frame.camera.world_from_camera, c.camera.world_from_camera);
        let k = frame.camera.intrinsics;
        assert!((k.fx - f).abs() < 1e-4 && k.fy == k.fx && (k.cx, k.cy) == (32.0, 24.0), "{k:?}");
        assert_eq!(frame.name, c.file[7..].trim_end_matches(".png"));
    }
    // Per-frame intrinsics win; Windows separators; a model; half-size pictures.
    let mut with_own = frames(&|f: &str| f.replace('/', "\\"));
    with_own[1]["fl_x"] = 200.0.into();
    with_own[1]["cx"] = 60.0.into();
    let scene = load(serde_json::json!({
        "fl_x": 140.0, "fl_y": 142.0, "cx": 64.0, "cy": 48.0, "w": 128.0, "h": 96,
        "camera_model": "OPENCV", "k1": 0.01, "aabb_scale": 16, "frames": with_own}));
    let k = |i: usize| scene.frames[i].camera.intrinsics;
    assert_eq!((k(0).fx, k(0).fy, k(0).cx), (70.0, 71.0, 32.0));
    assert_eq!((k(1).fx, k(1).fy, k(1).cx), (100.0, 71.0, 30.0));
    assert!(scene.warnings.iter().any(|w| w.contains("another size")), "{:?}", scene.warnings);
    assert_eq!(
        scene.frames[0].distortion,
        Distortion::Brown { k: [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }
    );
    // PINHOLE, and a frame that is listed but not there.
    let mut list = frames(&str::to_owned);
    list[2]["file_path"] = "images/nowhere.png".into();
    let scene = load(serde_json::json!({"camera_model": "PINHOLE", "fl_x": 70, "frames": list}));
    assert_eq!(scene.frames.len(), 2);
    assert_eq!(scene.warnings.len(), 1);
    assert!(scene.warnings[0].contains("images/nowhere.png"));
    // Fisheye by both spellings.
    for (key, value) in
        [("camera_model", serde_json::json!("OPENCV_FISHEYE")), ("is_fisheye", true.into())]
    {
        let scene = load(
            serde_json::json!({key: value, "fl_x": 70, "k4": 0.1, "frames": frames(&str::to_owned)}),
        );
        assert_eq!(scene.frames[0].distortion, Distortion::Fisheye { k: [0.0, 0.0, 0.0, 0.1] });
    }
}

#[test]
fn precedence_of_pose_files() {
    let (folder, cameras) = made_up(2);
    let at = |name: &str| folder.path().join(name);
    let line = |v: &[f32]| v.iter().map(f32::to_string).collect::<Vec<_>>().join(" ");
    let pose = |c: &NamedCamera| c.camera.world_from_camera.transpose().to_cols_array();
    let poses: Vec<String> = cameras.iter().map(|c| line(&pose(c))).collect();
    std::fs::write(at("poses.txt"), poses.join("\n")).unwrap();
    std::fs::write(at("K.txt"), "70 0 32\n0 71 24\n0 0 1\n").unwrap();
    let source = || load_scene(folder.path()).unwrap().source;
    assert_eq!(source(), SceneFormat::Matrices);
    let w2c = |c: &NamedCamera| c.camera.camera_from_world().transpose().to_cols_array();
    let cams: Vec<String> =
        cameras.iter().map(|c| format!("1 1.1 1.4 .5 .5 0 0 {}", line(&w2c(c)[..12]))).collect();
    std::fs::write(at("abc.txt"), format!("https://a.b/c\n{}", cams.join("\n"))).unwrap();
    assert_eq!(source(), SceneFormat::RealEstate10k);
    let bin = colmap_files::binary(&cameras);
    colmap_files::write(&at("sparse/0"), "bin", [&bin[0], &bin[1], &bin[2]]);
    assert_eq!(source(), SceneFormat::Colmap);
    let gl = Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
    let frames: Vec<_> = cameras
        .iter()
        .map(|c| {
            let m = (c.camera.world_from_camera * gl).transpose().to_cols_array_2d();
            serde_json::json!({"file_path": c.file, "transform_matrix": m})
        })
        .collect();
    let json = serde_json::json!({"fl_x": 70, "frames": frames}).to_string();
    std::fs::write(at("transforms.json"), json).unwrap();
    assert_eq!(source(), SceneFormat::Transforms);
    save_cameras_json(
        &at("cameras.json"),
        &CameraFile { cameras: cameras.clone(), units: Units::Unknown },
    )
    .unwrap();
    assert_eq!(source(), SceneFormat::CamerasJson);
    // All five say the same, and any can be asked for by name.
    let reference = load_scene(folder.path()).unwrap();
    for (file, format) in [
        ("transforms.json", SceneFormat::Transforms),
        ("sparse/0/cameras.bin", SceneFormat::Colmap),
        ("abc.txt", SceneFormat::RealEstate10k),
        ("poses.txt", SceneFormat::Matrices),
    ] {
        let scene = load_scene(&at(file)).unwrap();
        assert_eq!(scene.source, format);
        for (a, b) in scene.frames.iter().zip(&reference.frames) {
            assert_eq!((&a.name, &a.image), (&b.name, &b.image));
            let e = a.camera.world_from_camera - b.camera.world_from_camera;
            assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{file} {e}");
        }
    }
    assert_eq!(load_scene(&at("sparse/0")).unwrap().source, SceneFormat::Colmap);
    // Matrices by any convention, from the same numbers.
    for (convention, want) in [
        (PoseConvention::WorldFromCameraOpenGl, cameras[0].camera.world_from_camera * gl),
        (PoseConvention::CameraFromWorldOpenCv, cameras[0].camera.camera_from_world()),
    ] {
        let scene = matrices::load(folder.path(), convention).unwrap();
        let e = scene.frames[0].camera.world_from_camera - want;
        assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{convention:?} {e}");
    }
}

#[test]
fn re10k_frames_are_matched_by_time_order_or_number() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let lines: Vec<String> = (0..4)
        .map(|i| format!("{} 1 1.5 .5 .5 0 0 1 0 0 {i} 0 1 0 0 0 0 1 0", 1000 * i + 500))
        .collect();
    std::fs::write(folder.path().join("a.txt"), format!("url://x\n{}\n", lines.join("\n")))
        .unwrap();
    let put = |names: &[&str]| -> Vec<PathBuf> {
        std::fs::remove_dir_all(&images).unwrap();
        std::fs::create_dir(&images).unwrap();
        let path = |n: &&str| images.join(n);
        names.iter().for_each(|n| image::save_png(&path(n), &noise(12, 8)).unwrap());
        names.iter().map(path).collect()
    };
    let x = |scene: &Scene| -> Vec<f32> {
        scene.frames.iter().map(|f| -f.camera.position().x).collect()
    };
    put(&["3500.png", "500.png"]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(x(&scene), [0.0, 3.0]);
    assert_eq!(scene.warnings.len(), 1);
    put(&["a.png", "b.png", "c.png", "d.png"]);
    assert_eq!(x(&load_scene(folder.path()).unwrap()), [0.0, 1.0, 2.0, 3.0]);
    put(&["01.png", "02.png"]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(x(&scene), [1.0, 2.0]);
    // Intrinsics are those of the stored size.
    let k = scene.frames[0].camera.intrinsics;
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (12.0, 12.0, 6.0, 4.0));
    put(&["p.png", "q.png"]);
    let e = load_scene(folder.path()).unwrap_err().to_string();
    assert!(e.contains("4 pictures"), "{e}");
}

#[test]
fn pairs_and_exif() {
    let (folder, cameras) = made_up(2);
    let path = |i: usize| folder.path().join(&cameras[i].file);
    let scene = Scene::from_pair(&path(0), &path(1), cameras[0].camera, cameras[1].camera).unwrap();
    assert_eq!(scene.frames[1].camera, cameras[1].camera);
    assert!(scene.warnings.is_empty());
    let mut wrong = cameras[0].camera;
    wrong.intrinsics.width = 48;
    wrong.intrinsics.height = 64;
    let e = Scene::from_pair(&path(0), &path(1), wrong, cameras[1].camera).unwrap_err();
    assert!(e.to_string().contains("48x64"), "{e}");

    // A PNG eXIf chunk with orientation 6, big-endian TIFF.
    let mut exif = b"MM\0\x2a\0\0\0\x08\0\x01".to_vec();
    exif.extend([0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, 6, 0, 0, 0, 0, 0, 0]);
    let mut chunk = (exif.len() as u32).to_be_bytes().to_vec();
    chunk.extend(b"eXIf");
    chunk.extend(&exif);
    let mut crc = flate2::Crc::new();
    crc.update(&chunk[4..]);
    chunk.extend(crc.sum().to_be_bytes());
    let mut png = std::fs::read(path(0)).unwrap();
    png.splice(33..33, chunk);
    std::fs::write(path(0), png).unwrap();
    assert_eq!(image::probe(&path(0)).unwrap().orientation, Some(6));
    let before = image::load(&path(1)).unwrap();
    assert_eq!(image::load(&path(0)).unwrap(), before, "the orientation is not applied");
    let scene = Scene::from_pair(&path(0), &path(1), cameras[0].camera, cameras[1].camera).unwrap();
    assert!(scene.warnings[0].contains("EXIF"), "{:?}", scene.warnings);
    let e = Scene::from_pair(&path(0), &path(1), wrong, cameras[1].camera).unwrap_err();
    assert!(e.to_string().contains("EXIF orientation 6"), "{e}");
}

#[test]
fn mvsplat_rule_on_real_estate_is_its_published_crop() {
    let Some(photos) = shared("photos") else { return };
    let scene = load_scene(&photos.join("re10k_0bf152ef84195293")).unwrap();
    let (picture, camera) = scene.frames[0].load().unwrap();
    let options = CropOptions { rule: CropRule::Mvsplat, ..CropOptions::square(256, 1, 16) };
    let c = crop(&picture, &camera, &options).unwrap();
    let [fx, fy, cx, cy] = c.input_camera.intrinsics.normalised();
    let [fx_photo, fy_photo, ..] = camera.intrinsics.normalised();
    // 576x320 covers 256x256 at 461x256.
    assert!((fx - fx_photo * 461.0 / 256.0).abs() < 1e-6 && (fy - fy_photo).abs() < 1e-6);
    assert_eq!((cx, cy), (0.5, 0.5));
}
