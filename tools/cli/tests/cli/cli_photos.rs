//! Every command on every scene of real photographs.

use crate::program;
use subsplat_test_support as common;

use program::{call_with, files};
use std::path::{Path, PathBuf};

fn scenes() -> Vec<PathBuf> {
    let Some(photos) = common::shared("photos") else { return Vec::new() };
    let entries = std::fs::read_dir(photos).unwrap();
    let mut scenes: Vec<PathBuf> =
        entries.map(|e| e.unwrap().path()).filter(|p| p.join("cameras.json").is_file()).collect();
    scenes.sort();
    assert!(scenes.len() >= 9, "{scenes:?}");
    scenes
}

fn call(folder: &Path, words: &str, path: &Path) -> serde_json::Value {
    let arguments: Vec<&str> = words
        .split_whitespace()
        .map(|w| if w == "@" { path.to_str().unwrap() } else { w })
        .collect();
    let called = call_with(folder, &arguments, &[]);
    assert_eq!(called.code, 0, "{words} {}: {}", path.display(), called.stderr);
    called.json()
}

#[test]
fn run_render_and_info_take_every_scene() {
    let place = tempfile::tempdir().unwrap();
    for scene in scenes() {
        let name = scene.file_name().unwrap().to_str().unwrap();
        let frames =
            call(place.path(), "--json info @", &scene)["frames"].as_array().unwrap().len();
        assert!(frames >= 2);
        let words = format!(
            "--json run @ --input-size 64 --frames 2 --no-check --surroundings off -o {name}"
        );
        let report = call(place.path(), &words, &scene);
        assert_eq!(report["gaussians"], 2 * 64 * 64 * 4, "{name}");
        let targets = report["targets"].as_array().unwrap();
        for target in targets {
            // The pair of bananas has no frame to compare with.
            let psnr = target["psnr"].as_f64();
            assert_eq!(psnr.is_some(), frames > 2, "{name}: {target}");
            assert!(psnr.is_none_or(|p| p > 5.0), "{name}: {target}");
        }
        let out = place.path().join(name);
        assert_eq!(
            call(place.path(), "--json info @", &out)["frames"].as_array().unwrap().len(),
            targets.len()
        );
        let words = format!("--json render @ --size 32 -o {name}_again");
        let views = call(place.path(), &words, &out.join("scene.ply"));
        assert_eq!(views["views"].as_array().unwrap().len(), targets.len());
        assert!(!files(place.path()).iter().any(|f| f.to_string_lossy().contains(".part")));
    }
}

/// The poses of all scenes are right: nothing is judged bad. What is merely imprecise
/// or badly lit may be warned about.
#[test]
fn check_believes_every_scene() {
    let place = tempfile::tempdir().unwrap();
    for scene in scenes() {
        let report = call(place.path(), "--json check @", &scene);
        assert_eq!(report["ok"], true);
        for pair in report["pairs"].as_array().unwrap() {
            assert!(pair["epipolar"]["median_px"].as_f64().unwrap() < 3.0, "{pair}");
        }
    }
}

/// 1.7 cm between the eyes, and the scene a hundred times as far: thirty baselines would
/// end long before it, and an estimate from there would find nothing.
#[test]
fn matched_points_find_the_depth_that_the_baseline_misses() {
    let Some(bananas) = common::shared("photos/pair_bananas") else { return };
    let place = tempfile::tempdir().unwrap();
    let run = "--json run @ --input-size 64 --frames 1 -o out";
    let report = call(place.path(), run, &bananas);
    let (near, far) = (report["near"].as_f64().unwrap(), report["far"].as_f64().unwrap());
    assert!((0.3..3.0).contains(&near) && (3.0..20.0).contains(&far), "{near} {far}");
    let from = report["near_far_from"].as_str().unwrap();
    assert!(from.contains("estimated by the network") && from.contains("points matched"), "{from}");
    assert!(!report["check"][0]["findings"].as_array().unwrap().is_empty());
    let report = call(place.path(), &format!("{run} --near 0.5 --far 30"), &bananas);
    assert_eq!((report["near"].as_f64(), report["far"].as_f64()), (Some(0.5), Some(30.0)));
}

#[test]
fn a_finished_scene_of_others_is_rendered() {
    let Some(ply) =
        common::shared("photos/re10k_5aca87f95a9412c6/5aca87f95a9412c6.globalsplat16k.ply")
    else {
        return;
    };
    let place = tempfile::tempdir().unwrap();
    let report = call(place.path(), "--json render @ --target 006,7 --size 64 -o out", &ply);
    assert_eq!(report["gaussians"], 16384);
    assert_eq!(report["convention"], "standard");
    assert_eq!(files(&place.path().join("out")), [Path::new("006.png"), Path::new("007.png")]);
}
