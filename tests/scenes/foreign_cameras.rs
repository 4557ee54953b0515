//! Cameras of other programs: known cameras, written in the convention of each program by matrices that are
//! derived by hand here, are read back as they were.

use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use glam::{DMat3, DVec3};
use serde_json::{Value, json};
use std::path::Path;
use subsplat::files::Error;
use subsplat::files::photos::distortion::Distortion;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::bundler;
use subsplat::files::poses::cameras_json::NamedCamera;
use subsplat::files::poses::find::not_read;
use subsplat::files::poses::llff;
use subsplat::files::poses::scene::{
    Scene, SceneFormat, Units, is_scene, load_cameras, load_scene,
};
use subsplat::image::codecs::png::PngEncoder;
use subsplat::image::{ExtendedColorType, ImageEncoder};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// A folder and cameras as [`made_up`] has them, with one focal length and the principal point in the middle.
pub(crate) fn plain(n: usize) -> (tempfile::TempDir, Vec<NamedCamera>) {
    let (folder, mut cameras) = made_up(n);
    for c in &mut cameras {
        let k = c.camera.intrinsics();
        let k = Intrinsics { fy: k.fx, cx: 32.0, cy: 24.0, ..k };
        c.camera = Camera::new(k, c.camera.world_from_camera()).unwrap();
    }
    (folder, cameras)
}

/// Columns of the camera's axes in the world (right, down, forward), and its position.
pub(crate) fn axes(camera: &Camera) -> [DVec3; 4] {
    let m = camera.world_from_camera().as_dmat4();
    [m.x_axis, m.y_axis, m.z_axis, m.w_axis].map(|v| v.truncate())
}

/// Rows of the 3×4 matrix with these columns.
pub(crate) fn rows([a, b, c, t]: [DVec3; 4]) -> [[f64; 4]; 3] {
    [0, 1, 2].map(|i| [a[i], b[i], c[i], t[i]])
}

/// Rows of camera-to-world with the axes right, up, backward.
pub(crate) fn opengl_rows(camera: &Camera) -> [[f64; 4]; 3] {
    let [right, down, forward, t] = axes(camera);
    rows([right, -down, -forward, t])
}

#[track_caller]
pub(crate) fn check(scene: &Scene, source: SceneFormat, cameras: &[NamedCamera]) {
    assert_eq!(scene.source, source);
    assert_eq!(scene.frames.len(), cameras.len(), "{:?}", scene.warnings);
    for (frame, camera) in scene.frames.iter().zip(cameras) {
        let (a, b) = (&frame.camera, &camera.camera);
        let (found, expected) = (a.world_from_camera(), b.world_from_camera());
        let off = (found - expected).to_cols_array().into_iter().fold(0f32, |m, v| m.max(v.abs()));
        assert!(off < 1e-5, "{}: {found} {expected}", frame.name);
        let (a, b) = (a.intrinsics(), b.intrinsics());
        let k = |k: Intrinsics| [k.fx, k.fy, k.cx, k.cy];
        assert!(k(a).iter().zip(k(b)).all(|(a, b)| (a - b).abs() < 1e-3), "{a:?} {b:?}");
        assert_eq!((a.width, a.height), (b.width, b.height));
    }
}

#[track_caller]
pub(crate) fn refused<T>(case: &str, result: Result<T, Error>, words: &[&str]) {
    let error = match result {
        Ok(_) => panic!("{case}: was accepted"),
        Err(error) => error.to_string(),
    };
    words.iter().for_each(|word| assert!(error.contains(word), "{case}: {error}"));
}

pub(crate) fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// Angle times axis of the rotation from the world to the camera, from its matrix: the antisymmetric part is
/// sin(angle) times the axis, the trace is 1 + 2·cos(angle).
fn rotation_vector(camera: &Camera) -> DVec3 {
    let [right, down, forward, _] = axes(camera);
    let r = DMat3::from_cols(right, down, forward).transpose();
    let (a, b, c) = (r.x_axis, r.y_axis, r.z_axis);
    let axis = DVec3::new(b.z - c.y, c.x - a.z, a.y - b.x) * 0.5;
    let angle = axis.length().atan2((a.x + b.y + c.z - 1.0) * 0.5);
    axis.normalize() * angle
}

pub(crate) fn opensfm(cameras: &[NamedCamera]) -> Value {
    let mut one = json!({ "cameras": {}, "shots": {}, "points": {
        "7": { "coordinates": [0.5, 0.25, 4.0], "color": [1, 2, 3] },
        "8": { "coordinates": [f64::NAN, 0.0, 1.0], "color": [1, 2, 3] },
    }});
    for c in cameras {
        let k = c.camera.intrinsics();
        let name = c.file.trim_start_matches("images/");
        // In units of the larger side, 64, and from the middle.
        let of = |v: f32, middle: f64| (f64::from(v) - middle) / 64.0;
        one["cameras"][format!("lens {name}")] = json!({
            "projection_type": "brown", "width": 64, "height": 48,
            "focal_x": of(k.fx, 0.0), "focal_y": of(k.fy, 0.0), "c_x": of(k.cx, 32.0), "c_y": of(k.cy, 24.0),
            "k1": 0.01, "k2": -0.02, "k3": 0.003, "p1": 0.001, "p2": 0.002,
        });
        let [right, down, forward, position] = axes(&c.camera);
        let t = [right, down, forward].map(|axis| -axis.dot(position));
        one["shots"][name] = json!({
            "camera": format!("lens {name}"),
            "rotation": rotation_vector(&c.camera).to_array(),
            "translation": t,
            "orientation": 1,
        });
    }
    one
}

#[test]
fn opensfm_is_read() {
    let (folder, cameras) = made_up(4);
    let path = folder.path().join("reconstruction.json");
    let all = json!([opensfm(&cameras[..1]), opensfm(&cameras)]);
    write(&path, all.to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::OpenSfm, &cameras);
    let brown = Distortion::brown([0.01, -0.02, 0.003, 0.0, 0.0, 0.0], [0.001, 0.002]);
    assert!(scene.frames.iter().all(|f| f.distortion == brown));
    assert_eq!(scene.points.as_deref(), Some(&[glam::Vec3::new(0.5, 0.25, 4.0)][..]));
    let line = "the largest of 2 reconstructions is read, with 4 pictures; the others have 1";
    assert!(scene.warnings.len() == 1 && scene.warnings[0].contains(line), "{:?}", scene.warnings);
    // The other models, with the principal point in the middle.
    for (model, more, expected) in [
        (
            "perspective",
            json!({"k1": 0.1, "k2": 0.2}),
            Distortion::brown([0.1, 0.2, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        ),
        ("fisheye", json!({"k1": 0.1, "k2": 0.2}), Distortion::fisheye([0.1, 0.2, 0.0, 0.0])),
        (
            "fisheye_opencv",
            json!({"k1": 0.1, "k4": 0.2}),
            Distortion::fisheye([0.1, 0.0, 0.0, 0.2]),
        ),
        (
            "simple_radial",
            json!({"k1": 0.1}),
            Distortion::brown([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        ),
    ] {
        let mut one = opensfm(&cameras);
        let mut lens = json!({"projection_type": model, "width": 64, "height": 48, "focal": 1.25});
        more.as_object().unwrap().iter().for_each(|(key, value)| lens[key] = value.clone());
        one["cameras"]["lens 000.png"] = lens;
        write(&path, json!([one]).to_string());
        let frame = &load_scene(folder.path()).unwrap().frames[0];
        assert_eq!(frame.distortion, expected, "{model}");
        let k = frame.camera.intrinsics();
        assert_eq!([k.fx, k.fy, k.cx, k.cy], [80.0, 80.0, 32.0, 24.0], "{model}");
    }
}

#[test]
fn broken_shots_of_opensfm_are_left_out() {
    let (folder, cameras) = made_up(4);
    let path = folder.path().join("reconstruction.json");
    let mut one = opensfm(&cameras);
    one["cameras"]["lens 000.png"]["projection_type"] = json!("spherical");
    one["shots"]["001.png"]["rotation"] = json!([null, 0.0, 0.0]);
    write(&path, json!([one]).to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::OpenSfm, &cameras[2..]);
    let left: Vec<(usize, &str)> =
        scene.left_out.iter().map(|l| (l.entry, l.name.as_str())).collect();
    assert_eq!(left, [(0, "000.png"), (1, "001.png")]);
    assert!(scene.left_out[0].reason.contains("`spherical`"), "{:?}", scene.left_out);
    assert!(scene.left_out[1].reason.contains("three finite numbers"), "{:?}", scene.left_out);
    one["cameras"]["lens 002.png"]["focal_x"] = json!(0.0);
    one["shots"]["003.png"]["camera"] = json!("none");
    write(&path, json!([one]).to_string());
    refused("all", load_scene(folder.path()), &["spherical"]);
    write(&path, "[]");
    refused("empty", load_scene(&path), &["reconstruction.json"]);
}

fn llff_array(cameras: &[NamedCamera]) -> Vec<u8> {
    let mut numbers = Vec::new();
    for c in cameras {
        let k = c.camera.intrinsics();
        let [right, down, forward, position] = axes(&c.camera);
        let size = [48.0, 64.0, f64::from(k.fx)];
        for i in 0..3 {
            numbers.extend([down[i], right[i], -forward[i], position[i], size[i]]);
        }
        numbers.extend([1.5, 20.0 + f64::from(k.fx)]);
    }
    npy("'<f8'", &format!("({}, 17)", cameras.len()), &numbers)
}

pub(crate) fn npy(kind: &str, shape: &str, numbers: &[f64]) -> Vec<u8> {
    let header = format!("{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    for n in numbers {
        match kind {
            "'<f4'" => bytes.extend((*n as f32).to_le_bytes()),
            _ => bytes.extend(n.to_le_bytes()),
        }
    }
    bytes
}

#[test]
fn llff_is_read() {
    let (folder, cameras) = plain(3);
    let images = folder.path().join("images");
    // Python sorts `10` before `9`.
    for (old, new) in [("000", "10"), ("001", "11"), ("002", "9")] {
        std::fs::rename(images.join(format!("{old}.png")), images.join(format!("{new}.png")))
            .unwrap();
    }
    let path = folder.path().join("poses_bounds.npy");
    write(&path, llff_array(&cameras));
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Llff, &cameras);
    let names: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["10", "11", "9"]);
    let range = scene.near_far.unwrap();
    assert!(range.near == 1.5 && (range.far - 92.1).abs() < 1e-4, "{range:?}");
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    // Reduced copies alone, as LLFF's program names them.
    std::fs::remove_dir_all(&images).unwrap();
    std::fs::create_dir(folder.path().join("images_4")).unwrap();
    for i in 0..3 {
        save_png(folder.path().join(format!("images_4/image{i:03}.png")), &noise(16, 12)).unwrap();
    }
    let scene = load_scene(folder.path()).unwrap();
    let k = scene.frames[1].camera.intrinsics();
    assert!((k.fx - cameras[1].camera.intrinsics().fx / 4.0).abs() < 1e-4 && k.cx == 8.0, "{k:?}");
    // Cameras without pictures, and f32.
    std::fs::remove_dir_all(folder.path().join("images_4")).unwrap();
    refused("no pictures", load_scene(folder.path()), &["3 pictures in images", "0, 0, 0, 0"]);
    check(&load_cameras(folder.path()).unwrap(), SceneFormat::Llff, &cameras);
    let row: Vec<f64> = (0..17).map(f64::from).collect();
    let read = llff::parse("a.npy", &npy("'<f4'", "(1, 17)", &row)).unwrap();
    assert_eq!(read, [<[f64; 17]>::try_from(row).unwrap()]);
}

#[test]
fn hostile_arrays() {
    let (_folder, cameras) = plain(3);
    let good = llff_array(&cameras);
    assert_eq!(llff::parse("a.npy", &good).unwrap().len(), 3);
    for cut in 0..good.len() {
        refused(&format!("cut at {cut}"), llff::parse("a.npy", &good[..cut]), &["a.npy"]);
    }
    let row = [1.0; 17];
    let long = [&b"\x93NUMPY\x02\x00\xff\xff\xff\xff"[..], b"x"].concat();
    for (case, bytes, words) in [
        ("one byte more", [&good[..], &[0]].concat(), &["3 rows of 17"][..]),
        ("a row more", [&good[..], &[0; 17 * 8]].concat(), &["3 rows of 17"]),
        ("columns", npy("'<f8'", "(1, 15)", &row[..15]), &["N x 17", "(1, 15)"]),
        ("one side", npy("'<f8'", "(17,)", &row), &["N x 17"]),
        (
            "2^60 rows",
            npy("'<f8'", "(1152921504606846976, 17)", &row),
            &["1152921504606846976 rows"],
        ),
        ("no rows", npy("'<f8'", "(0, 17)", &[]), &["at least one row"]),
        ("three sides", npy("'<f8'", "(1, 1, 17)", &row), &["one or two dimensions"]),
        ("big-endian", npy("'>f8'", "(1, 17)", &row), &["`<f8` or `<f4`"]),
        ("integers", npy("'<i8'", "(1, 17)", &row), &["`<f8` or `<f4`"]),
        ("long header", long, &["at most 4096", "4294967295"]),
        ("text", b"a,b,c".to_vec(), &["NumPy"]),
    ] {
        refused(case, llff::parse("a.npy", &bytes), words);
    }
    // The same array by columns.
    let numbers: Vec<f64> = llff::parse("a.npy", &good).unwrap().concat();
    let columns: Vec<f64> = (0..3 * 17).map(|i| numbers[i % 3 * 17 + i / 3]).collect();
    let mut by_columns = npy("'<f8'", "(3, 17)", &columns);
    let at = by_columns.windows(5).position(|w| w == b"False").unwrap();
    by_columns[at..at + 5].copy_from_slice(b"True ");
    assert_eq!(llff::parse("a.npy", &by_columns).unwrap().concat(), numbers);
}

/// A row that is no camera is left out; no range of depths is no error.
#[test]
fn broken_rows_of_llff_are_left_out() {
    let (folder, cameras) = plain(5);
    let mut bytes = llff_array(&cameras);
    let start = bytes.len() - 5 * 17 * 8;
    let mut put = |row: usize, column: usize, value: f64| {
        let at = start + (row * 17 + column) * 8;
        bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
    };
    put(0, 0, f64::NAN);
    put(1, 14, 0.0);
    put(2, 4, 48.5);
    put(3, 15, -1.0);
    write(&folder.path().join("poses_bounds.npy"), bytes);
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Llff, &cameras[3..]);
    assert_eq!(scene.near_far, None);
    assert_eq!(scene.left_out.iter().map(|l| l.entry).collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(scene.frames[0].entry, 3);
}

pub(crate) fn bundle(cameras: &[NamedCamera]) -> String {
    let mut text = format!("# Bundle file v0.3\n{} 2\n", cameras.len());
    let line = |v: [f64; 3]| format!("{} {} {}\n", v[0], v[1], v[2]);
    for c in cameras {
        // Rows of the rotation are the camera's axes right, up, backward.
        let [right, down, forward, position] = axes(&c.camera);
        let r = [right, -down, -forward];
        text += &line([f64::from(c.camera.intrinsics().fx), -0.1, 0.02]);
        r.iter().for_each(|row| text += &line(row.to_array()));
        text += &line(r.map(|row| -row.dot(position)));
    }
    text + "1 2 3\n255 0 0\n2 0 17 1.5 -2.5 2 4 0 0\n4 5 6\n0 0 0\n1 2 5 0 0\n"
}

#[test]
fn bundler_is_read() {
    let (folder, cameras) = plain(4);
    let at = |name: &str| folder.path().join(name);
    std::fs::rename(at("images/001.png"), at("images/with 2 words.png")).unwrap();
    let text = bundle(&cameras);
    // The fourth camera was not placed.
    let mut lines: Vec<&str> = text.lines().collect();
    lines.splice(17..22, ["0 0 0"; 5]);
    write(&at("bundle/bundle.out"), lines.join("\n"));
    let list = "./000.png 0 532.1\nimages/with 2 words.png 0 70\n002.png\n003.png 0 5\n";
    write(&at("list.txt"), list);
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Bundler, &cameras[..3]);
    assert_eq!(scene.frames[1].image, at("images/with 2 words.png"));
    let radial = Distortion::brown([-0.1, 0.02, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
    assert!(scene.frames.iter().all(|f| f.distortion == radial));
    assert_eq!(scene.points.as_ref().unwrap()[1], glam::Vec3::new(4.0, 5.0, 6.0));
    let visible: Vec<&[u32]> = scene.frames.iter().map(|f| &f.visible[..]).collect();
    assert_eq!(visible, [&[0][..], &[], &[0, 1]]);
    assert_eq!(scene.left_out.len(), 1);
    assert!(scene.left_out[0].reason.contains("a focal length above 0"), "{:?}", scene.left_out);
    write(&at("list.txt"), "000.png\n");
    refused("list", load_scene(folder.path()), &["4 pictures", "got 1"]);
    std::fs::remove_file(at("list.txt")).unwrap();
    refused("no list", load_scene(folder.path()), &["list.txt"]);
}

#[test]
fn hostile_bundles() {
    let (_folder, cameras) = plain(2);
    let text = bundle(&cameras).replace("2 4 0 0", "1 4 0 0").replace("1 2 5 0 0", "1 1 5 0 0");
    let parse = |text: &str| bundler::parse("b.out", text.as_bytes());
    assert_eq!(parse(&text).unwrap().cameras.len(), 2);
    for cut in 0..text.trim_end().rfind(' ').unwrap() {
        refused(&format!("cut at {cut}"), parse(&text[..cut]), &["b.out"]);
    }
    for (case, from, to, words) in [
        ("another start", "# Bundle", "# Camera", &["`# Bundle file"][..]),
        ("10^15 cameras", "\n2 2\n", "\n1000000000000000 2\n", &["b.out:2", "1000000000000000"]),
        ("4·10^9 points", "\n2 2\n", "\n2 4000000000\n", &["the end of the file"]),
        ("less than none", "\n2 2\n", "\n-2 2\n", &["b.out:2", "-2"]),
        ("a word", "\n2 2\n", "\n2 two\n", &["b.out:2", "`two`"]),
        ("camera 9", "1 1 5 0 0", "1 9 5 0 0", &["one of 2 cameras", "got 9"]),
    ] {
        assert!(text.contains(from), "{case}");
        refused(case, parse(&text.replacen(from, to, 1)), words);
    }
}

/// Quaternion xyzw of axes right, up, backward, from the matrix's entries (Shepperd).
fn quaternion(camera: &Camera) -> [f64; 4] {
    let m = opengl_rows(camera);
    let w2 = (1.0 + m[0][0] + m[1][1] + m[2][2]).max(1e-9);
    let w = 0.5 * w2.sqrt();
    let by = |a: f64, b: f64| (a - b) / (4.0 * w);
    [by(m[2][1], m[1][2]), by(m[0][2], m[2][0]), by(m[1][0], m[0][1]), w]
}

#[test]
fn record3d_is_read() {
    let (folder, cameras) = made_up(3);
    let at = |name: &str| folder.path().join(name);
    std::fs::rename(at("images"), at("rgbd")).unwrap();
    for i in 0..3 {
        std::fs::rename(at(&format!("rgbd/00{i}.png")), at(&format!("rgbd/{i}.png"))).unwrap();
    }
    std::fs::copy(at("rgbd/0.png"), at("rgbd/0(1).png")).unwrap();
    let poses: Vec<Vec<f64>> = cameras
        .iter()
        .map(|c| [&quaternion(&c.camera)[..], &axes(&c.camera)[3].to_array()].concat())
        .collect();
    let k = cameras[0].camera.intrinsics();
    let own: Vec<[f32; 4]> =
        cameras.iter().map(|c| c.camera.intrinsics()).map(|k| [k.fx, k.fy, k.cx, k.cy]).collect();
    let mut file = json!({
        "w": 64, "h": 48, "fps": 60, "poses": poses,
        "K": [k.fx, 0.0, 0.0, 0.0, k.fy, 0.0, k.cx, k.cy, 1.0],
        "perFrameIntrinsicCoeffs": own,
    });
    write(&at("metadata"), file.to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Record3d, &cameras);
    assert_eq!(scene.units, Units::Metres);
    assert!(load_scene(at("metadata")).unwrap().frames == scene.frames);
    // One K for all frames; a pose that is broken; a picture that is missing.
    file.as_object_mut().unwrap().remove("perFrameIntrinsicCoeffs");
    file["poses"][1] = json!([0, 0, 0, 0, 1, 2, 3]);
    std::fs::rename(at("metadata"), at("metadata.json")).unwrap();
    write(&at("metadata.json"), file.to_string());
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.iter().map(|f| f.entry).collect::<Vec<_>>(), [0, 2]);
    assert!(scene.frames.iter().all(|f| f.camera.intrinsics() == k));
    assert!(scene.left_out[0].reason.contains("a quaternion xyzw above 0"));
    for (key, value, words) in [
        ("K", json!([1, 2, 3]), &["K of 9 numbers", "got 3"][..]),
        ("w", json!(0), &["w and h", "0x48"]),
        ("poses", json!([]), &["at least one frame"]),
        ("poses", json!({}), &["metadata.json"]),
    ] {
        let mut bad = file.clone();
        bad[key] = value;
        write(&at("metadata.json"), bad.to_string());
        refused(key, load_scene(folder.path()), words);
    }
}

fn polycam(camera: &Camera) -> Value {
    let k = camera.intrinsics();
    let mut file = json!({
        "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": 64, "height": 48, "blur_score": 12.5,
    });
    for (i, row) in opengl_rows(camera).iter().enumerate() {
        row.iter().enumerate().for_each(|(j, v)| file[format!("t_{i}{j}")] = json!(v));
    }
    file
}

#[test]
fn polycam_is_read() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("keyframes")).unwrap();
    std::fs::rename(at("images"), at("keyframes/images")).unwrap();
    for (i, c) in cameras.iter().enumerate() {
        write(&at(&format!("keyframes/cameras/00{i}.json")), polycam(&c.camera).to_string());
    }
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Polycam, &cameras);
    assert_eq!(scene.units, Units::Metres);
    assert_eq!(scene.name, folder.path().file_name().unwrap().to_string_lossy());
    assert!(scene.warnings.is_empty() && not_read(folder.path()).is_none());
    // Corrected cameras with their pictures go first; one is broken.
    let (_, other) = plain(4);
    for (i, c) in other.iter().enumerate() {
        write(
            &at(&format!("keyframes/corrected_cameras/00{i}.json")),
            polycam(&c.camera).to_string(),
        );
    }
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Polycam, &cameras);
    std::fs::create_dir(at("keyframes/corrected_images")).unwrap();
    for i in 0..4 {
        save_png(at(&format!("keyframes/corrected_images/00{i}.png")), &noise(64, 48)).unwrap();
    }
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Polycam, &other);
    check(&load_scene(at("keyframes")).unwrap(), SceneFormat::Polycam, &other);
    let mut bad = polycam(&cameras[0].camera);
    bad.as_object_mut().unwrap().remove("t_21");
    write(&at("keyframes/corrected_cameras/000.json"), bad.to_string());
    write(&at("keyframes/corrected_cameras/001.json"), "{");
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Polycam, &other[2..]);
    assert!(scene.left_out[0].reason.contains("`t_21`"), "{:?}", scene.left_out);
}

/// A PNG whose EXIF block states 35 mm on film, big-endian TIFF.
fn png_35_mm() -> Vec<u8> {
    let mut exif = b"MM\0\x2a\0\0\0\x08\0\x01".to_vec();
    exif.extend([0x87, 0x69, 0, 4, 0, 0, 0, 1, 0, 0, 0, 26, 0, 0, 0, 0]);
    exif.extend([0, 1, 0xa4, 0x05, 0, 3, 0, 0, 0, 1, 0, 35, 0, 0, 0, 0, 0, 0]);
    let (mut bytes, picture) = (Vec::new(), noise(64, 48));
    let mut encoder = PngEncoder::new(&mut bytes);
    encoder.set_exif_metadata(exif).unwrap();
    encoder.write_image(&picture.data, 64, 48, ExtendedColorType::Rgb8).unwrap();
    bytes
}

#[test]
fn exports_of_nerfstudio_are_read() {
    let (folder, mut cameras) = plain(3);
    let list: Vec<Value> = cameras
        .iter()
        .map(|c| json!({ "file_path": c.file, "transform": opengl_rows(&c.camera) }))
        .collect();
    let path = folder.path().join("transforms_train.json");
    write(&path, json!(list).to_string());
    // Without focal lengths the list is no scene.
    assert!(!is_scene(folder.path()));
    assert!(not_read(folder.path()).unwrap().contains("without focal lengths"));
    refused("no EXIF", load_scene(&path), &["EXIF data of the picture"]);
    let focal = 35.0 * 80.0 / 36f64.hypot(24.0);
    for c in &mut cameras {
        write(&folder.path().join(&c.file), png_35_mm());
        let k = Intrinsics { fx: focal as f32, fy: focal as f32, ..c.camera.intrinsics() };
        c.camera = Camera::new(k, c.camera.world_from_camera()).unwrap();
    }
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Nerfstudio, &cameras);
    // The second file of the export alone.
    std::fs::rename(&path, folder.path().join("transforms_eval.json")).unwrap();
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Nerfstudio, &cameras);
    // A path of the viewer: the angle of view is that from top to bottom.
    let fov = 2.0 * (24.0 / focal).atan().to_degrees();
    let through: Vec<Value> = cameras
        .iter()
        .map(|c| {
            let rows = opengl_rows(&c.camera);
            let m = [&rows.concat()[..], &[0.0, 0.0, 0.0, 1.0]].concat();
            json!({ "camera_to_world": m, "fov": fov, "aspect": 1.3 })
        })
        .collect();
    let mut file = json!({ "render_height": 48, "render_width": 64, "camera_path": through });
    let path = folder.path().join("camera_path.json");
    write(&path, file.to_string());
    check(&load_cameras(&path).unwrap(), SceneFormat::Nerfstudio, &cameras);
    file["camera_type"] = json!("equirectangular");
    write(&path, file.to_string());
    refused("a panorama", load_cameras(&path), &["camera_type perspective", "`equirectangular`"]);
    file["camera_type"] = json!("perspective");
    file["camera_path"][0]["fov"] = json!(180);
    file["camera_path"][1]["camera_to_world"] = json!([1, 2, 3]);
    write(&path, file.to_string());
    let scene = load_cameras(&path).unwrap();
    check(&scene, SceneFormat::Nerfstudio, &cameras[2..]);
    assert!(scene.left_out[0].reason.contains("between 0 and 180"), "{:?}", scene.left_out);
    assert!(scene.left_out[1].reason.contains("16 numbers"), "{:?}", scene.left_out);
}

/// Cameras of any name are found by content; another format with more cameras is named.
#[test]
fn cameras_are_found_by_content() {
    let (folder, cameras) = made_up(4);
    let at = |name: &str| folder.path().join(name);
    std::fs::remove_file(at("images/003.png")).unwrap();
    let frames: Vec<Value> = cameras[..3]
        .iter()
        .map(|c| {
            let k = c.camera.intrinsics();
            json!({ "file_path": c.file, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": 64, "h": 48,
                    "transform_matrix": opengl_rows(&c.camera) })
        })
        .collect();
    write(&at("notes.json"), "{\"frames\": [{\"a\": 1}]}");
    assert!(!is_scene(folder.path()));
    write(&at("my cameras.json"), json!({ "frames": frames }).to_string());
    write(&at("one.json"), json!({ "frames": frames[..1] }).to_string());
    check(&load_scene(folder.path()).unwrap(), SceneFormat::Transforms, &cameras[..3]);
    write(&at("transforms.json"), json!({ "frames": frames }).to_string());
    assert!(load_scene(folder.path()).unwrap().warnings.is_empty());
    write(&at("reconstruction.json"), json!([opensfm(&cameras)]).to_string());
    let scene = load_scene(folder.path()).unwrap();
    check(&scene, SceneFormat::Transforms, &cameras[..3]);
    let line = "cameras come from transforms.json; not read: reconstruction.json (4 cameras)";
    assert_eq!(scene.warnings, [line]);
    write(&at("reconstruction.json"), json!([opensfm(&cameras[..3])]).to_string());
    assert!(load_scene(folder.path()).unwrap().warnings.is_empty());
    // The matrices of this file: OpenGL's third column is the direction backward.
    let third = cameras[0].camera.world_from_camera().as_dmat4().z_axis;
    assert_eq!(opengl_rows(&cameras[0].camera)[0][2], -third.x);
}
