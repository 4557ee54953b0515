//! Paths, animations and coloured depth.

use crate::program::{call_in, call_with, workplace};
use std::path::Path;
use subsplat::files::photos::image::load;
use subsplat::files::poses::cameras_json::load_cameras_json;
use subsplat::image::AnimationDecoder;
use subsplat::image::codecs::webp::WebPDecoder;
use subsplat_test_support::one_splat::save_one_splat;

#[test]
fn run_without_targets_draws_three_views_and_a_path_draws_what_is_asked() {
    let place = workplace();
    let quick = "--json run scene --context 0,1 --input-size 64 --fit 0 --refine off -o out";
    let called = call_in(place.path(), quick);
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    assert_eq!(report["targets"].as_array().unwrap().len(), 3);
    assert!(report["video"].is_null());
    let depth = load(place.path().join("out/depth_colour/path_0001.png")).unwrap();
    let view = load(place.path().join("out/images/path_0001.png")).unwrap();
    // The scene and a page that shows it, and none of the photographs' own views.
    let files: Vec<&str> =
        report["files"].as_array().unwrap().iter().map(|f| f["format"].as_str().unwrap()).collect();
    assert_eq!(files, ["ply", "html"]);
    assert!(place.path().join("out/scene.html").is_file());
    assert!(called.stderr.contains("to look around in the scene, open out/scene.html"));
    let cameras = load_cameras_json(place.path().join("out/cameras.json")).unwrap().cameras;
    let scene = load_cameras_json(place.path().join("scene/cameras.json")).unwrap().cameras;
    for view in &cameras {
        let nearest =
            scene[..2].iter().map(|c| c.camera.position().distance(view.camera.position()));
        assert!(nearest.fold(f32::INFINITY, f32::min) > 0.01);
    }
    assert!(depth.width > view.width && depth.height == view.height);

    let moving = "--path dolly --frames 4 --orbit-radius 0.1 --fps 10 --video out/dolly.webp";
    let called = call_in(place.path(), &format!("{quick} {moving}"));
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    let file = std::fs::read(place.path().join("out/dolly.webp")).unwrap();
    assert_eq!(report["video"]["frames"], 4);
    assert_eq!(report["video"]["bytes"], file.len());
    let decoder = WebPDecoder::new(std::io::Cursor::new(file)).unwrap();
    let frames = decoder.into_frames().collect_frames().unwrap();
    assert_eq!(frames.len(), 4);
    // The animation shows the pictures.
    for (i, frame) in frames.iter().enumerate() {
        let still = load(place.path().join(format!("out/images/path_{i:04}.png"))).unwrap();
        let rgb: Vec<u8> = frame.buffer().pixels().flat_map(|p| [p[0], p[1], p[2]]).collect();
        assert!(rgb == still.data, "frame {i}");
        assert_eq!(frame.delay().numer_denom_ms(), (100, 1));
    }
    // Towards the scene by twice the radius.
    let cameras = load_cameras_json(place.path().join("out/cameras.json")).unwrap().cameras;
    let step = cameras[1].camera.position().distance(cameras[0].camera.position());
    assert!((step - 0.2).abs() < 1e-4, "{step}");
}

#[test]
fn render_writes_a_gif_of_a_path() {
    let place = workplace();
    save_one_splat(&place.path().join("one.ply"));
    for path in ["orbit", "spiral"] {
        let video = format!("--path {path} --frames 3 --size 48x32 --depth --video {path}.gif");
        let called = call_in(place.path(), &format!("--json render one.ply {video} -o {path}"));
        assert_eq!(called.code, 0, "{}", called.stderr);
        let report = called.json();
        assert_eq!(report["views"].as_array().unwrap().len(), 3);
        let depth = report["views"][2]["depth_colour_file"].as_str().unwrap();
        assert!(load(place.path().join(depth)).unwrap().width > 48);
        let gif = std::fs::read(place.path().join(format!("{path}.gif"))).unwrap();
        assert_eq!(
            (&gif[..6], gif.len() as u64),
            (&b"GIF89a"[..], report["video"]["bytes"].as_u64().unwrap())
        );
    }
}

#[test]
fn animations_are_refused_before_the_work() {
    let place = workplace();
    save_one_splat(&place.path().join("one.ply"));
    for (arguments, code, words) in [
        ("render one.ply --video a.avi", 1, "ends in .mp4, .webm, .gif or .webp, got a.avi"),
        ("run scene --video a.mkv", 1, "ends in .mp4, .webm, .gif or .webp, got a.mkv"),
        ("render one.ply --video none/a.gif", 1, "the folder none does not exist"),
        ("render one.ply --orbit-radius 1", 2, "only with --path orbit, spiral or dolly"),
        ("run scene --path interpolate --orbit-radius 1", 2, "only with --path orbit"),
        ("render one.ply --path orbit --orbit-radius 0", 2, "expected a finite number above 0"),
        ("render one.ply --video a.gif --fps 0", 2, "expected a whole number from 1 to 100"),
    ] {
        let called = call_in(place.path(), arguments);
        assert_eq!(called.code, code, "{arguments}: {}", called.stderr);
        assert!(called.stderr.contains(words), "{arguments}: {}", called.stderr);
    }
    assert!(!place.path().join("out").exists(), "nothing was rendered");
    let all = ["render", "one.ply", "--video", "a.webm"];
    let called = call_with(place.path(), &all, &[("PATH", "/nonexistent")]);
    assert!(called.error().contains("need the program ffmpeg"), "{}", called.stderr);
}

/// A program in place of ffmpeg, which writes what it reads to its last argument.
#[cfg(unix)]
fn stand_in(folder: &Path, body: &str) {
    use std::os::unix::fs::PermissionsExt;
    let file = folder.join("ffmpeg");
    std::fs::write(&file, format!("#!/bin/sh\n{body}\n")).unwrap();
    std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// Ending and codec of a video that ffmpeg writes.
#[cfg(unix)]
const OF_FFMPEG: (&str, &str) =
    if cfg!(feature = "mp4") { ("webm", "libvpx-vp9") } else { ("mp4", "libx264") };

#[cfg(unix)]
#[test]
fn ffmpeg_gets_every_frame() {
    let (kind, codec) = OF_FFMPEG;
    let file = format!("a.{kind}");
    let place = workplace();
    save_one_splat(&place.path().join("one.ply"));
    let bin = place.path().join("bin");
    std::fs::create_dir(&bin).unwrap();
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let command = "--json render one.ply --path orbit --size 20x10 --frames 3 --video";
    let all: Vec<&str> = command.split(' ').chain([file.as_str()]).collect();
    let keep = r#"[ "$1" = -version ] && exit 0; for last; do :; done; echo "$@" > arguments; cat > "$last""#;
    stand_in(&bin, keep);
    let called = call_with(place.path(), &all, &[("PATH", &path)]);
    assert_eq!(called.code, 0, "{}", called.stderr);
    let written = std::fs::read(place.path().join(&file)).unwrap();
    assert_eq!(written.len(), 3 * 20 * 10 * 3);
    let still = load(place.path().join("out/path_0002.png")).unwrap();
    assert!(written.ends_with(&still.data));
    let arguments = std::fs::read_to_string(place.path().join("arguments")).unwrap();
    for expected in ["-pix_fmt rgb24 -s 20x10 -r 25 -i -", codec, &format!("-f {kind}")] {
        assert!(arguments.contains(expected), "{arguments}");
    }
    assert!(!arguments.contains("2400000"), "{arguments}");

    // A clip of the default length takes 6 seconds and has a limit.
    let clip: Vec<&str> = all.iter().copied().filter(|a| !["--frames", "3"].contains(a)).collect();
    let called = call_with(place.path(), &clip, &[("PATH", &path)]);
    assert_eq!(called.json()["video"]["frames"], 150, "{}", called.stderr);
    let arguments = std::fs::read_to_string(place.path().join("arguments")).unwrap();
    assert!(arguments.contains("2400000"), "{arguments}");

    // Its message is the error, and no half of a file stays.
    stand_in(
        &bin,
        r#"[ "$1" = -version ] && exit 0; cat > /dev/null; echo "no such codec" >&2; exit 1"#,
    );
    std::fs::remove_file(place.path().join(&file)).unwrap();
    let called = call_with(place.path(), &all[1..], &[("PATH", &path)]);
    assert_eq!(called.code, 1);
    assert!(called.error().contains("ffmpeg failed: no such codec"), "{}", called.stderr);
    assert!(!place.path().join(&file).exists());
}

#[test]
fn a_second_run_leaves_no_picture_of_the_first() {
    let place = workplace();
    let quick = "run scene --context 0,1 --input-size 64 --fit 0 --refine off -o out";
    let first = format!("{quick} --path orbit --frames 4 --save ply,splat");
    assert_eq!(call_in(place.path(), &first).code, 0);
    let out = place.path().join("out");
    std::fs::write(out.join("images/mine.png"), "kept").unwrap();
    assert_eq!(call_in(place.path(), &format!("{quick} --frames 2 --sh 0")).code, 0);
    let names = |folder: &str| {
        let mut all: Vec<String> = std::fs::read_dir(out.join(folder))
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        all.sort();
        all
    };
    assert_eq!(names("images"), ["mine.png", "path_0000.png", "path_0001.png"]);
    assert_eq!(names("depth"), ["path_0000.png", "path_0001.png"]);
    assert_eq!(names("depth_colour"), ["path_0000.png", "path_0001.png"]);
    assert!(!out.join("scene.splat").exists());
    let ply = std::fs::read(out.join("scene.ply")).unwrap();
    let head = String::from_utf8_lossy(&ply[..2000]).into_owned();
    assert!(!head.contains("float f_rest") && head.contains("f_dc_2"), "--sh 0");
}
