//! Scenes as people have them: pose files in other folders, names in other forms, entries that are broken and
//! not needed, coordinates of a survey. One line for each, and the result of a tidy scene.

use subsplat_test_support::colmap_files;
use subsplat_test_support::made_up::made_up;
use subsplat_test_support::noise::noise;

use glam::{DVec3, Mat4, Vec3};
use std::path::Path;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{
    CameraFile, NamedCamera, load_cameras_json, save_cameras_json,
};
use subsplat::files::poses::find::{is_own_output, not_read};
use subsplat::files::poses::scene::{
    Scene, SceneFormat, distinct_names, has_scene, is_scene, load_cameras, load_scene,
};
use subsplat_kernels::camera::Camera;

pub(crate) fn write_text(folder: &Path, cameras: &[NamedCamera]) {
    let files = colmap_files::text(cameras);
    colmap_files::write(folder, "txt", [0, 1, 2].map(|i| files[i].as_bytes()));
}

pub(crate) fn write_transforms(
    path: &Path,
    cameras: &[NamedCamera],
    name: impl Fn(&str) -> String,
) {
    let frames: Vec<_> = cameras
        .iter()
        .map(|c| {
            let k = c.camera.intrinsics();
            let opengl =
                c.camera.world_from_camera() * Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0));
            serde_json::json!({
                "file_path": name(&c.file), "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy,
                "w": 64, "h": 48, "transform_matrix": opengl.transpose().to_cols_array_2d(),
            })
        })
        .collect();
    std::fs::write(path, serde_json::json!({ "frames": frames }).to_string()).unwrap();
}

/// The one warning of a scene.
fn warning(scene: &Scene) -> &str {
    assert_eq!(scene.warnings.len(), 1, "{:?}", scene.warnings);
    &scene.warnings[0]
}

#[test]
fn the_largest_model_is_read_and_the_others_are_named() {
    let (folder, cameras) = made_up(5);
    write_text(&folder.path().join("sparse/0"), &cameras[..2]);
    let binary = colmap_files::binary(&cameras);
    let large = folder.path().join("sparse/1");
    colmap_files::write(&large, "bin", [0, 1, 2].map(|i| &binary[i][..]));
    write_text(&folder.path().join("sparse/2"), &cameras[..3]);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 5);
    let expected =
        "cameras come from sparse/1; not read: sparse/2 (3 cameras), sparse/0 (2 cameras)";
    assert_eq!(warning(&scene), expected);
    assert!(load_scene(&large).unwrap().warnings.is_empty());
    // A scene one level deeper.
    let outer = tempfile::tempdir().unwrap();
    std::fs::rename(folder.path(), outer.path().join("garden")).unwrap();
    assert!(has_scene(outer.path()) && !is_scene(outer.path()));
    let scene = load_scene(outer.path()).unwrap();
    assert_eq!((scene.frames.len(), scene.warnings.len()), (5, 2));
    assert!(scene.warnings[0].contains("garden/sparse/1"), "{:?}", scene.warnings);
    // Photographs of the folder itself come first.
    save_png(outer.path().join("a.png"), &noise(64, 48)).unwrap();
    assert!(!has_scene(outer.path()));
}

#[test]
fn parts_of_synthetic_scenes_are_named() {
    let (folder, cameras) = made_up(4);
    write_transforms(&folder.path().join("transforms_train.json"), &cameras[..3], str::to_owned);
    write_transforms(&folder.path().join("transforms_test.json"), &cameras[3..], str::to_owned);
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!((scene.frames.len(), scene.source), (3, SceneFormat::Transforms));
    assert!(warning(&scene).contains("transforms_test.json (1 cameras)"), "{:?}", scene.warnings);
    // A list of poses without focal lengths is no scene.
    std::fs::write(folder.path().join("transforms_train.json"), "[{\"transform\": []}]").unwrap();
    std::fs::remove_file(folder.path().join("transforms_test.json")).unwrap();
    assert!(!is_scene(folder.path()));
    assert!(not_read(folder.path()).unwrap().contains("transforms_train.json"));
    let error = load_scene(folder.path()).unwrap_err().to_string();
    assert!(error.contains("without focal lengths"), "{error}");
}

/// Accents in either Unicode form, case, extension, and reduced copies.
#[test]
fn names_in_other_forms_are_found() {
    let (folder, mut cameras) = made_up(4);
    let images = folder.path().join("images");
    let names = ["Ku\u{308}che.PNG", "Door.png", "plain.png", "shot.0001.png"];
    for (camera, name) in cameras.iter_mut().zip(names) {
        std::fs::rename(folder.path().join(&camera.file), images.join(name)).unwrap();
    }
    for (camera, file) in
        cameras.iter_mut().zip(["K\u{fc}che.png", "door.JPG", "plain", "shot.0001"])
    {
        camera.file = format!("images/{file}");
    }
    let pose_file = folder.path().join("transforms.json");
    write_transforms(&pose_file, &cameras, str::to_owned);
    let scene = load_scene(folder.path()).unwrap();
    for (frame, name) in scene.frames.iter().zip(names) {
        assert_eq!(frame.image, images.join(name));
    }
    let read: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(read, ["K\u{fc}che", "door", "plain", "shot.0001"]);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    // Two pictures with the same name but for the extension: neither.
    save_png(images.join("Door.bmp"), &noise(64, 48)).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames.len(), 3);
    assert!(warning(&scene).contains("images/door.JPG"), "{:?}", scene.warnings);
    // Reduced copies alone.
    std::fs::rename(&images, folder.path().join("images_4")).unwrap();
    save_png(folder.path().join("images_4/plain.png"), &noise(16, 12)).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    let reduced = scene.frames.iter().find(|f| f.name == "plain").unwrap();
    assert_eq!(reduced.image, folder.path().join("images_4/plain.png"));
    assert!(
        (reduced.camera.intrinsics().fx - cameras[2].camera.intrinsics().fx / 4.0).abs() < 1e-4
    );
}

#[test]
fn what_is_broken_and_not_needed_is_left_out() {
    let (folder, cameras) = made_up(5);
    let [lenses, poses, points] = colmap_files::text(&cameras);
    // One picture is empty, one camera has a model that is not read, one pose is no number.
    std::fs::write(folder.path().join("images/000.png"), b"").unwrap();
    let lens = |line: &str| line.starts_with("8 ");
    let lenses: String =
        lenses
            .lines()
            .map(|line| {
                if lens(line) {
                    "8 EUCM 64 48 1 1 1 1 1 1\n".to_owned()
                } else {
                    format!("{line}\n")
                }
            })
            .collect();
    let poses: String = poses
        .lines()
        .map(|line| match line.ends_with("002.png") {
            true => "2 -nan(ind) 0 0 0 0 0 0 9 002.png\n".to_owned(),
            false => format!("{line}\n"),
        })
        .collect();
    let model = folder.path().join("sparse/0");
    colmap_files::write(&model, "txt", [lenses.as_bytes(), poses.as_bytes(), points.as_bytes()]);
    let scene = load_scene(folder.path()).unwrap();
    let names: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["003", "004"]);
    let line = warning(&scene);
    for words in ["3 of 5 frames are left out", "000.png", "an empty file", "got EUCM", "NaN"] {
        assert!(line.contains(words), "{words}: {line}");
    }
    // One frame alone is no scene: the error is the first entry's.
    std::fs::write(folder.path().join("images/003.png"), b"").unwrap();
    let error = load_scene(folder.path()).unwrap_err().to_string();
    assert!(error.contains("000.png") && error.contains("an empty file"), "{error}");
}

#[test]
fn json_of_other_programs_is_read() {
    let (folder, cameras) = made_up(3);
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &cameras, str::to_owned);
    let tidy = load_scene(folder.path()).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let marked = format!("\u{feff}{{\"aabb\": [NaN, -Infinity], {}", &text[1..]);
    std::fs::write(&path, marked).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames, tidy.frames);
    // A pose that is no number is that frame's.
    let row = text.find("transform_matrix\":[[").unwrap() + "transform_matrix\":[[".len();
    let end = row + text[row..].find(',').unwrap();
    std::fs::write(&path, format!("{}NaN{}", &text[..row], &text[end..])).unwrap();
    let scene = load_scene(folder.path()).unwrap();
    assert_eq!(scene.frames, tidy.frames[1..]);
    assert!(warning(&scene).contains("images/000.png"), "{:?}", scene.warnings);
    let error = load_cameras_json_text(folder.path(), "{\"frames\": [{\"fx\": NaN}]}");
    assert!(error.contains("cameras.json:1:"), "{error}");
}

fn load_cameras_json_text(folder: &Path, text: &str) -> String {
    let path = folder.join("cameras.json");
    std::fs::write(&path, text).unwrap();
    let error = load_cameras_json(&path).unwrap_err().to_string();
    std::fs::remove_file(&path).unwrap();
    error
}

/// f32 has steps of half a unit at five millions.
#[test]
fn coordinates_of_a_survey_lose_nothing() {
    let (folder, cameras) = made_up(4);
    write_text(&folder.path().join("sparse/0"), &cameras);
    let near = load_scene(folder.path()).unwrap();
    assert_eq!(near.origin, DVec3::ZERO);
    let [lenses, poses, points] = colmap_files::text(&cameras);
    let offset = DVec3::new(448_260.0, 5_411_933.0, 36.0);
    let poses: String = poses
        .lines()
        .map(|line| {
            let words: Vec<&str> = line.split(' ').collect();
            if words.len() != 10 {
                return format!("{line}\n");
            }
            let v: Vec<f64> = words[1..8].iter().map(|w| w.parse().unwrap()).collect();
            let rotation = glam::DQuat::from_xyzw(v[1], v[2], v[3], v[0]).normalize();
            let t = DVec3::new(v[4], v[5], v[6]) - rotation * offset;
            let t = format!("{} {} {}", t.x, t.y, t.z);
            format!("{} {t} {}\n", words[..5].join(" "), words[8..].join(" "))
        })
        .collect();
    let points: String = points
        .lines()
        .map(|line| {
            let words: Vec<&str> = line.split(' ').collect();
            if line.starts_with('#') {
                return String::new();
            }
            let v: Vec<f64> = words[1..4].iter().map(|w| w.parse().unwrap()).collect();
            let p = DVec3::new(v[0], v[1], v[2]) + offset;
            format!("{} {} {} {} {}\n", words[0], p.x, p.y, p.z, words[4..].join(" "))
        })
        .collect();
    let model = folder.path().join("sparse/0");
    colmap_files::write(&model, "txt", [lenses.as_bytes(), poses.as_bytes(), points.as_bytes()]);
    let far = load_scene(folder.path()).unwrap();
    assert!(far.origin.distance(offset) < 10.0, "{}", far.origin);
    assert!(warning(&far).contains("relative to"), "{:?}", far.warnings);
    let moved = (far.origin - offset).as_vec3();
    for (a, b) in near.frames.iter().zip(&far.frames) {
        let shift = a.camera.position() - b.camera.position() - moved;
        assert!(shift.length() < 1e-5, "{shift}");
    }
    let all = near.points.unwrap().into_iter().zip(far.points.unwrap());
    assert!(all.into_iter().all(|(a, b)| (a - b - moved).length() < 1e-5));
    // A cameras.json keeps the origin, its own far coordinates included.
    let named = |frame: &subsplat::files::poses::scene::Frame| {
        NamedCamera::of_frame(frame, format!("images/{}.png", frame.name))
    };
    let cameras: Vec<NamedCamera> = far.frames.iter().map(named).collect();
    let content = CameraFile { cameras, origin: far.origin, ..Default::default() };
    let path = folder.path().join("cameras.json");
    save_cameras_json(&path, &content).unwrap();
    assert_eq!(load_cameras_json(&path).unwrap(), content);
    let again = load_scene(folder.path()).unwrap();
    assert_eq!(again.origin, far.origin);
    let mut moved = content;
    for camera in &mut moved.cameras {
        let pose = Mat4::from_translation(Vec3::X * 4096.0) * camera.camera.world_from_camera();
        camera.camera = Camera::new(camera.camera.intrinsics(), pose).unwrap();
    }
    save_cameras_json(&path, &moved).unwrap();
    let origin = load_scene(folder.path()).unwrap().origin;
    assert!((origin - far.origin - DVec3::X * 4096.0).length() < 10.0, "{origin}");
    assert_eq!(load_cameras_json(&path).unwrap().origin, origin);
}

#[test]
fn cameras_need_no_pictures() {
    let (folder, cameras) = made_up(3);
    write_text(&folder.path().join("colmap/sparse/0"), &cameras);
    write_transforms(&folder.path().join("transforms.json"), &cameras, str::to_owned);
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    let missing = load_scene(folder.path()).unwrap_err().to_string();
    assert!(missing.contains("pictures on disk"), "{missing}");
    for path in ["transforms.json", "colmap/sparse/0"] {
        let scene = load_cameras(folder.path().join(path)).unwrap();
        assert!(scene.warnings.is_empty(), "{path}: {:?}", scene.warnings);
        for (frame, camera) in scene.frames.iter().zip(&cameras) {
            let shift = frame.camera.position().distance(camera.camera.position());
            assert!(shift < 1e-4, "{path}: {shift}");
            assert_eq!(frame.camera.intrinsics(), camera.camera.intrinsics(), "{path}");
        }
    }
}

#[test]
fn rendered_pictures_are_no_photographs() {
    let (folder, _) = made_up(2);
    assert!(!is_own_output(folder.path()));
    let report = r#"{"peak_memory_bytes": 1, "gaussians": 2, "near_far_from": "given"}"#;
    std::fs::write(folder.path().join("metrics.json"), report).unwrap();
    assert!(is_own_output(folder.path()));
    // A scene below a folder is not looked for there.
    let outer = tempfile::tempdir().unwrap();
    let (inner, cameras) = made_up(2);
    write_text(&inner.path().join("sparse/0"), &cameras);
    std::fs::write(inner.path().join("metrics.json"), report).unwrap();
    std::fs::rename(inner.path(), outer.path().join("out")).unwrap();
    assert!(!has_scene(outer.path()));
}

#[test]
fn photographs_of_one_name_keep_their_folders() {
    let names = |paths: &[&str]| -> Vec<String> {
        let names = distinct_names(paths.iter().map(|p| Path::new(*p)));
        names.into_iter().map(|name| name.to_string_lossy().into_owned()).collect()
    };
    assert_eq!(names(&["a/1.jpg", "b/2.jpg"]), ["1.jpg", "2.jpg"]);
    assert_eq!(names(&["s/left/1.jpg", "s/right/1.jpg"]), ["left/1.jpg", "right/1.jpg"]);
    assert_eq!(names(&["s/1.jpg", "s/b/1.jpg"]), ["1.jpg", "b/1.jpg"]);
}
