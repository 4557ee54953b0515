//! Errors of the program: exit code 1, one line that starts with `error:` and names the cause,
//! the same text in the one object of `--json`, and no partly written file.

use crate::program;
use subsplat_test_support::one_splat;

use one_splat::save_one_splat;
use program::{call_in, call_with, files, workplace};
use std::path::Path;

/// A table's row: the arguments, and what the error names.
type Row = (&'static str, &'static str);

#[track_caller]
fn refused(folder: &Path, rows: &[Row]) {
    let before = files(folder);
    for (arguments, named) in rows {
        let called = call_in(folder, &format!("--json {arguments}"));
        assert_eq!(called.code, 1, "{arguments}: {}", called.stderr);
        let error = called.error();
        assert!(error.contains(named), "{arguments}: expected `{named}` in: {error}");
        assert_eq!(format!("error: {}", called.json()["error"].as_str().unwrap()), error);
        assert!(error.matches("os error").count() <= 1, "told twice: {error}");
        assert!(!called.stderr.contains("panicked"), "{arguments}: {}", called.stderr);
    }
    let after = files(folder);
    assert_eq!(after, before, "files were left behind");
}

#[test]
fn bad_arguments() {
    let place = workplace();
    std::fs::write(place.path().join("file"), "text").unwrap();
    let rows: [Row; 28] = [
        ("run nowhere", "nowhere"),
        ("check nowhere", "nowhere"),
        ("info nowhere", "nowhere"),
        ("render nowhere.ply", "nowhere.ply"),
        ("render scene", "scene.ply"),
        ("render scene", "subsplat run scene"),
        ("render scene/images", "subsplat run scene/images"),
        ("render scene/images/view0.png", "subsplat run PHOTOGRAPH"),
        ("run scene --context 0,9", "`9`"),
        ("run scene --context 0,view7", "`view7`"),
        ("run scene --context 0", "at least 2"),
        ("run scene --context 0,0", "view0 twice"),
        ("run scene --context 0,2 --target 3", "--target"),
        ("run scene --context 0,2 --input-size 16", "--input-size"),
        ("run scene --context 0,2 --input-size 32768", "memory"),
        ("run scene --pose-convention opengl-c2w", "--pose-convention"),
        (
            "run scene/images/view0.png scene/images/view2.png --fov 50 --move 1,0,0 \
             --pose-convention opengl-c2w",
            "--pose-a or --pose-b",
        ),
        ("run scene --fov 50", "--fov"),
        ("run scene -o file", "file"),
        ("run scene -o file/below", "below"),
        ("check scene -o file", "file"),
        ("run scene/images/view0.png", "one photograph"),
        ("run scene/images/view0.png scene/images/view2.png --move 1,0,0", "--fov"),
        ("run scene/images/view0.png scene/images/view2.png --fov 50 --turn 0,3,0", "--move"),
        (
            "run scene/images/view0.png scene/images/view2.png --fov 50 --move 0,0,0",
            "different places",
        ),
        ("run scene/images/view0.png file --fov 50 --move 1,0,0", "file"),
        ("run scene --context 0,2 --weights file", "safetensors"),
        ("run scene --context 0,2 --config file", "file"),
    ];
    refused(place.path(), &rows);
}

#[test]
fn broken_files() {
    let place = workplace();
    let at = |name: &str| place.path().join(name);
    let copy = |name: &str| {
        let (to, from) = (at(name), at("scene"));
        std::fs::create_dir_all(to.join("images")).unwrap();
        for file in files(&from) {
            std::fs::copy(from.join(&file), to.join(&file)).unwrap();
        }
        to
    };
    let cut = copy("cut").join("images/view2.png");
    let bytes = std::fs::read(&cut).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(at("cut/images/broken.png"), "").unwrap();
    std::fs::remove_file(copy("poseless").join("cameras.json")).unwrap();
    let listed = std::fs::read_to_string(at("scene/cameras.json")).unwrap();
    let edit = |name: &str, from: &str, to: &str| {
        let changed = listed.replacen(from, to, 1);
        assert_ne!(changed, listed);
        std::fs::write(copy(name).join("cameras.json"), changed).unwrap();
    };
    edit("sizes", "\"width\": 128", "\"width\": 120");
    edit("nan", "\"fx\": ", "\"fx\": -");
    edit("unclosed", "}", "");
    std::fs::write(at("scene.ply"), "ply\nformat binary_little_endian 1.0\n").unwrap();
    std::fs::write(at("empty.spz"), "").unwrap();
    let rows: [Row; 21] = [
        ("run cut --context 0,2", "view2.png"),
        ("check cut --context 0,2", "view2.png"),
        ("info poseless", "cameras.json"),
        ("run sizes --context 0,2", "128x128"),
        // Numbers are those of the file's entries, of which the first is left out.
        (
            "run nan --context 0,2",
            "got 0 (images/view0.png, which is left out: cameras.json frame 0",
        ),
        ("run nan --context 1,3", "--context: expected a number below 3"),
        ("check nan --strict", "got 1 that are not used: the first is images/view0.png"),
        ("check scene --model nowhere.json", "nowhere.json"),
        ("check scene --images nowhere", "nowhere: expected a folder of pictures"),
        ("check scene/images --images scene", "--images: expected one scene with cameras"),
        ("poses cut/images --strict", "got 1: the first is broken.png (an empty file)"),
        // Before cameras are estimated.
        (
            "run cut/images --context view9,0",
            "--context: expected a number below 3 or a photograph's name, got `view9`",
        ),
        ("run cut/images --target 3", "--target: expected a number below 3"),
        ("run cut/images --weights scene.ply", "scene.ply"),
        ("run scene/images -o scene/images", "scene/images: holds the photographs that are read"),
        (
            "run scene/images/view0.png scene/images/view1.png -o scene.ply/out",
            "scene.ply/out: expected a folder, got a file",
        ),
        ("info unclosed", "cameras.json:"),
        ("render scene.ply", "scene.ply"),
        ("info scene.ply", "scene.ply"),
        ("info empty.spz", "empty.spz"),
        ("render scene.ply --cameras poseless", "scene.ply"),
    ];
    refused(place.path(), &rows);
}

/// Errors name the fault of a camera list, though another reader might accept the file, and a
/// picture that exceeds the memory.
#[test]
fn cameras_of_a_finished_scene() {
    let place = workplace();
    let at = |name: &str| place.path().join(name);
    save_one_splat(&at("one.ply"));
    let listed = std::fs::read_to_string(at("scene/cameras.json")).unwrap();
    let mut json: serde_json::Value = serde_json::from_str(&listed).unwrap();
    json["frames"][1]["file"] = "images/nowhere.png".into();
    for frame in json["frames"].as_array_mut().unwrap() {
        frame["fx"] = 0.0.into();
    }
    std::fs::write(at("scene/cameras.json"), json.to_string()).unwrap();
    std::fs::write(at("list.json"), json.to_string()).unwrap();
    std::fs::write(at("cut.json"), &listed[..listed.len() / 2]).unwrap();
    for frame in json["frames"].as_array_mut().unwrap() {
        frame["fx"] = 9.0.into();
    }
    json["frames"][1]["width"] = 32768.into();
    json["frames"][1]["height"] = 32768.into();
    std::fs::write(at("huge.json"), json.to_string()).unwrap();
    let mut rows: Vec<Row> = vec![
        ("render one.ply --cameras scene", "cameras.json frame 0: expected a camera focal length"),
        ("render one.ply --cameras list.json", "list.json frame 0"),
        ("render one.ply --cameras cut.json", "cut.json:"),
    ];
    // 32768 x 32768 pixels of 30 bytes; some machines have that.
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let kib = |key: &str| -> u64 {
        let line = text.lines().find(|l| l.starts_with(key));
        line.and_then(|l| l.split_whitespace().nth(1)?.parse().ok()).unwrap_or(u64::MAX / 4)
    };
    if kib("MemAvailable:") + kib("SwapFree:") < 30 << 20 {
        rows.push(("render one.ply --cameras huge.json", "frame nowhere: 32768x32768: needs"));
    }
    refused(place.path(), &rows);
}

#[test]
fn wrong_usage_is_exit_code_2() {
    let place = tempfile::tempdir().unwrap();
    let rows = [
        "",
        "walk",
        "run",
        "run scene --walk",
        "run a b --move 1,2",
        "run scene --upscale two",
        "run scene --preset paper --config x",
        "render",
    ];
    for arguments in rows {
        let called = call_in(place.path(), arguments);
        assert_eq!((called.code, called.stdout.as_str()), (2, ""), "{arguments}");
        let called = call_in(place.path(), &format!("{arguments} --json"));
        assert_eq!(called.code, 2);
        assert!(!called.json()["error"].as_str().unwrap().is_empty());
    }
    for arguments in ["--help", "run --help", "--version"] {
        let called = call_in(place.path(), arguments);
        assert_eq!((called.code, called.stderr.as_str()), (0, ""), "{arguments}");
    }
    assert!(call_in(place.path(), "--help").stdout.contains("Exit codes"));
}

/// Values that can be judged without a file: the one line names the flag and what it accepts.
#[test]
fn impossible_values_are_wrong_usage() {
    let place = tempfile::tempdir().unwrap();
    let rows: [Row; 29] = [
        ("run scene --upscale 0", "--upscale <R>': expected a number from 1 to 8"),
        ("run scene --upscale 9", "from 1 to 8"),
        ("run scene --frames 0 --path orbit", "from 1 to 100000"),
        ("run scene --input-size 0", "--input-size"),
        ("run scene --input-size 12x", "--input-size"),
        ("run scene --input-size big", "--input-size"),
        ("run scene --input-size 99999999999999999999", "--input-size"),
        ("run scene --min-opacity nan", "0 to below 1"),
        ("run scene --min-opacity 1", "0 to below 1"),
        ("run scene --min-opacity 2", "0 to below 1"),
        ("run scene --min-opacity -1", "0 to below 1"),
        ("run scene --near -1", "--near <NEAR>': expected a finite number above 0"),
        ("run scene --near nan", "above 0"),
        ("run scene --far inf", "above 0"),
        ("run scene --near 5 --far 1", "--near 5: expected less than --far 1"),
        ("run scene --target 1 --path orbit", "only with --path targets"),
        ("run scene --background 0,2,0", "three numbers in [0, 1]"),
        ("run scene --background -1,0,0", "three numbers in [0, 1]"),
        ("run a b --fov 0 --move 1,0,0", "above 0 and below 180"),
        ("run a b --fov 180 --move 1,0,0", "above 0 and below 180"),
        ("run a b --fov -5 --move 1,0,0", "above 0 and below 180"),
        ("run a b --fov 50 --move nan,0,0", "three numbers"),
        ("run scene --threads 0", "from 1 to 1024"),
        ("run scene --threads 100000000", "from 1 to 1024"),
        ("render a.ply --sh-degree 5", "from 0 to 4"),
        ("render a.ply --near 0", "above 0"),
        ("render a.ply --size 0x5", "N or WxH"),
        ("run scene --size huge", "N or WxH, 11 to 32768 pixels a side, or `photo`"),
        ("render a.ply --frames 0", "from 1 to 100000"),
    ];
    for (arguments, named) in rows {
        let called = call_in(place.path(), &format!("--json {arguments}"));
        assert_eq!(called.code, 2, "{arguments}: {}", called.stderr);
        let told = called.json();
        let error = told["error"].as_str().unwrap();
        assert!(error.contains(named), "{arguments}: expected `{named}` in: {error}");
        assert!(called.stderr.contains(error), "{arguments}: {}", called.stderr);
    }
    assert!(files(place.path()).is_empty());
}

/// candle appends a backtrace to its errors where it is asked for; people get a line.
#[test]
fn backtraces_stay_out_of_errors() {
    let place = workplace();
    let (weights, words) =
        (place.path().join("w.safetensors"), "run scene --context 0,2 --weights");
    let one = candle_core::Tensor::ones(1, candle_core::DType::F32, &candle_core::Device::Cpu);
    let tensors = [("small.x".to_owned(), one.unwrap())].into_iter().collect();
    let config =
        subsplat::network::config::Config::small(subsplat::network::config::Preset::Tuned, 2);
    subsplat::network::model::weights::save(&weights, &tensors, &config).unwrap();
    let mut arguments: Vec<&str> = words.split(' ').collect();
    arguments.push("w.safetensors");
    let called = call_with(place.path(), &arguments, &[("RUST_BACKTRACE", "1")]);
    assert_eq!(called.code, 1);
    let (last, error) = (called.stderr.lines().last().unwrap(), called.error());
    assert!(last == error && error.contains("w.safetensors"), "{}", called.stderr);
    // It ends with the shape that is missing.
    assert!(error.ends_with("got no such tensor"), "{error}");
}

#[test]
fn an_unknown_simd_level() {
    let place = workplace();
    for arguments in [&["--json", "run", "scene"][..], &["--json", "info", "scene"]] {
        let called = call_with(place.path(), arguments, &[("SUBSPLAT_SIMD", "axv2")]);
        assert_eq!(called.code, 1, "{}", called.stderr);
        let error = called.error();
        assert!(error.starts_with("error: SUBSPLAT_SIMD: expected "), "{error}");
        assert!(error.contains("baseline") && error.ends_with("got axv2"), "{error}");
        assert_eq!(format!("error: {}", called.json()["error"].as_str().unwrap()), error);
    }
    let called = call_with(place.path(), &["info", "scene"], &[("SUBSPLAT_SIMD", "baseline")]);
    assert_eq!(called.code, 0, "{}", called.stderr);
}
