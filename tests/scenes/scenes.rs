//! Tests on photographs: all formats of one folder agree, the protocols' numbers are reproduced,
//! and MVSplat's crop is exact.

use subsplat_test_support as common;

use common::shared;
use glam::{DMat4, Vec2};
use std::path::Path;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::image;
use subsplat::files::photos::undistort::undistort;
use subsplat::files::poses::protocol::{load_index, load_protocol};
use subsplat::files::poses::scene::{Scene, SceneFormat, Units, load_scene};
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule, crop};
use subsplat::reconstruct::inputs::pair::{choose_pair, view_geometry};
use subsplat::reconstruct::{DepthBounds, DepthRange};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, Intrinsics};

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

/// Returns the largest differences of two scenes' cameras: focal length and centre in px, pose
/// entries.
fn difference(a: &Scene, b: &Scene) -> (f32, f32) {
    assert_eq!(a.frames.len(), b.frames.len());
    let mut worst = (0.0f32, 0.0f32);
    for (a, b) in a.frames.iter().zip(&b.frames) {
        assert_eq!(a.image.file_name(), b.image.file_name());
        assert_eq!(a.name, b.name);
        let (ka, kb) = (a.camera.intrinsics(), b.camera.intrinsics());
        assert_eq!((ka.width, ka.height), (kb.width, kb.height));
        let k = [ka.fx - kb.fx, ka.fy - kb.fy, ka.cx - kb.cx, ka.cy - kb.cy];
        let pose = a.camera.world_from_camera() - b.camera.world_from_camera();
        worst.0 = k.iter().fold(worst.0, |m, v| m.max(v.abs()));
        worst.1 = pose.to_cols_array().iter().fold(worst.1, |m, v| m.max(v.abs()));
    }
    worst
}

#[test]
fn every_scene_loads() {
    let Some(photos) = shared("photos") else { return };
    for name in SCENES {
        let scene = load_scene(photos.join(name)).unwrap();
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
        assert_eq!(picture.width, camera.intrinsics().width);
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
        let other = load_scene(folder.join(file)).unwrap();
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
fn protocol_intrinsics_follow_the_exact_rule() {
    let Some(photos) = shared("photos") else { return };
    for name in SCENES {
        let folder = photos.join(name);
        let protocol = load_protocol(folder.join("protocol.json")).unwrap();
        let scene = load_scene(&folder).unwrap();
        for test in &protocol.tests {
            test.check(&folder, scene.frames.len()).unwrap();
        }
        let (picture, camera) = scene.frames[0].load().unwrap();
        let c = crop(&picture, &camera, &CropOptions::square(256, 1, 16)).unwrap();
        let want = protocol.intrinsics_256.unwrap();
        let got = c.input_camera.intrinsics();
        for (g, w) in [(got.fx, want.fx), (got.fy, want.fy), (got.cx, want.cx), (got.cy, want.cy)] {
            assert!((f64::from(g) - w).abs() < 1e-3, "{name}: {got:?} {want:?}");
        }
    }
}

#[test]
fn protocol_geometry_is_reproduced() {
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
        let scene = load_scene(photos.join(name)).unwrap();
        for t in file.tests {
            let [a, b] = t.context.map(|i| scene.frames[i].camera);
            let g = view_geometry(&a, &b, 1.0, 100.0);
            assert!((g.baseline - t.baseline).abs() < 1e-4 * t.baseline, "{name} {g:?}");
            assert!((g.rotation_deg - t.rot_deg).abs() < 2e-3, "{name} {g:?} {}", t.rot_deg);
            compared += 1;
        }
        let pair = choose_pair(&scene).unwrap();
        eprintln!("{name}: {}", pair.reason);
        let range = DepthBounds::of_frames(&scene, &pair.frames, DepthRange::Auto).unwrap();
        assert_eq!(name.starts_with("re10k"), range.near == 1.0 && range.far == 100.0, "{range:?}");
    }
    assert!(compared >= 13, "{compared}");
}

#[test]
fn an_evaluation_index_is_read_as_it_stands() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/eval_index.json");
    let index = load_index(&path).unwrap();
    let views = |name: &str| {
        let views = index[name].as_ref().unwrap();
        (views.context.as_slice(), views.target.as_slice())
    };
    assert_eq!(index.len(), 4);
    assert_eq!(views("made_up_a"), (&[0, 13, 26, 39][..], &[23][..]));
    assert_eq!(views("made_up_b"), (&[58, 133][..], &[84, 102, 129][..]));
    // The order of targets is the file's.
    assert_eq!(views("made_up_c"), (&[17, 63][..], &[63, 17, 26][..]));
    assert!(index["made_up_without_a_pair"].is_none());
}

#[test]
fn evaluation_indexes_have_the_published_counts() {
    let Some(folder) = shared("fixtures/eval_index") else { return };
    for (file, all, usable) in [
        ("mvsplat_evaluation_index_re10k.json", 7194, 6474),
        ("mvsplat_evaluation_index_acid.json", 1848, 1595),
    ] {
        let index = load_index(folder.join(file)).unwrap();
        assert_eq!(index.len(), all);
        assert_eq!(index.values().flatten().count(), usable);
        assert!(index.values().flatten().all(|v| v.context.len() == 2 && v.target.len() == 3));
    }
    load_index(folder.join("globalsplat_demo_index.json")).unwrap();
}

#[test]
fn the_distortion_of_the_fox_is_removed() {
    let Some(fox) = shared("photos/fox") else { return };
    // This file lists all 67 frames of the source, 20 of which are stored, with the lens of the
    // unprocessed photographs.
    let distorted = load_scene(fox.join("transforms_original_distorted_1080x1920.json")).unwrap();
    let undistorted = load_scene(&fox).unwrap();
    assert_eq!(distorted.frames.len(), undistorted.frames.len());
    assert!(distorted.warnings.iter().any(|w| w.contains("of 67 frames have no picture")));
    assert_eq!(difference(&distorted, &undistorted).1, 0.0);
    let frame = &distorted.frames[0];
    let Distortion::Brown { k, p } = frame.distortion else { panic!("{:?}", frame.distortion) };
    assert_eq!((k[0], k[1], p), (0.0578421, -0.0805099, [-0.000980296, 0.00015575]));

    // The stored pictures have no distortion, and their distorted originals are not stored. The
    // test distorts a stored picture with this lens, removes the distortion again, and compares.
    let lens = &frame.distortion;
    let photo = image::load(&frame.image).unwrap();
    let k = frame.camera.intrinsics();
    let distorter = Distorter { lens, k };
    let distorted_photo = distorter.apply(&photo);
    let new = frame.pinhole().unwrap().intrinsics();
    assert!(new.fx / k.fx > 0.95 && new.fx / k.fx < 1.05, "{new:?}");
    let back = undistort(&distorted_photo, &k, lens, &k);
    let untouched = psnr_inside(&distorted_photo, &photo, 60);
    let restored = psnr_inside(&back, &photo, 60);
    eprintln!("fox: distorted {untouched:.1} dB, undistorted {restored:.1} dB");
    assert!(restored > 33.0 && untouched < restored - 8.0, "{untouched} {restored}");
}

/// Applies a lens to a picture: the inverse of `undistort`, by iteration and bilinear sampling.
struct Distorter<'a> {
    lens: &'a Distortion,
    k: Intrinsics,
}

impl Distorter<'_> {
    fn apply(&self, photo: &Rgb) -> Rgb {
        let mut out = Rgb::black(photo.width, photo.height);
        for y in 0..photo.height {
            for x in 0..photo.width {
                let distorted =
                    self.k.unproject(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).truncate();
                let mut ray = distorted;
                for _ in 0..8 {
                    ray += distorted - self.lens.distort(ray);
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

#[test]
fn mvsplat_rule_on_real_estate_gives_its_published_crop() {
    let Some(photos) = shared("photos") else { return };
    let scene = load_scene(photos.join("re10k_0bf152ef84195293")).unwrap();
    let (picture, camera) = scene.frames[0].load().unwrap();
    let options = CropOptions { rule: CropRule::Mvsplat, ..CropOptions::square(256, 1, 16) };
    let c = crop(&picture, &camera, &options).unwrap();
    let [fx, fy, cx, cy] = c.input_camera.intrinsics().normalised();
    let [fx_photo, fy_photo, ..] = camera.intrinsics().normalised();
    // 576x320 covers 256x256 at 461x256.
    assert!((fx - fx_photo * 461.0 / 256.0).abs() < 1e-6 && (fy - fy_photo).abs() < 1e-6);
    assert_eq!((cx, cy), (0.5, 0.5));
}

/// The crop equals the tensors of MVSplat's loader and crop shim for a synthetic scene, to the last
/// bit. The file holds the decoded pictures.
#[test]
fn the_mvsplat_crop_equals_the_crop_shim() {
    let Some(path) = shared("golden/re10k_synth_expected.safetensors") else { return };
    let bytes = std::fs::read(path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let floats = |name: &str| -> Vec<f32> {
        let data = file.tensor(name).unwrap().data().to_vec();
        data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    let indices = file.tensor("context.index").unwrap().data().to_vec();
    let (images, ks) = (floats("context.image"), floats("context.intrinsics"));
    let (poses, cameras) = (floats("context.extrinsics"), floats("cameras"));
    for view in 0..2 {
        let frame = i64::from_le_bytes(indices[8 * view..][..8].try_into().unwrap()) as usize;
        let decoded = file.tensor(&format!("decoded_u8_hwc.{frame}")).unwrap();
        let photo = Rgb { width: 640, height: 360, data: decoded.data().to_vec() };
        let row = &cameras[18 * frame..][..18];
        let k = Intrinsics::from_normalised([row[0], row[1], row[2], row[3]], 640, 360);
        let w2c: Vec<f64> =
            row[6..].iter().chain(&[0.0, 0.0, 0.0, 1.0]).map(|v| f64::from(*v)).collect();
        let c2w = DMat4::from_cols_slice(&w2c).transpose().inverse();
        let camera = Camera::new(k, c2w.as_mat4()).unwrap();
        let options = CropOptions { rule: CropRule::Mvsplat, ..CropOptions::square(256, 1, 16) };
        let c = crop(&photo, &camera, &options).unwrap();

        let area = 3 * 256 * 256;
        assert_eq!(c.input.to_planes(), images[area * view..area * (view + 1)]);
        let [fx, fy, cx, cy] = c.input_camera.intrinsics().normalised();
        let want = &ks[9 * view..];
        for (got, want) in [(fx, want[0]), (fy, want[4]), (cx, want[2]), (cy, want[5])] {
            assert!((got - want).abs() < 1e-6, "{got} {want}");
        }
        let pose = c.input_camera.world_from_camera().transpose().to_cols_array();
        for (got, want) in pose.iter().zip(&poses[16 * view..]) {
            assert!((got - want).abs() < 1e-5, "{got} {want}");
        }
    }
}
