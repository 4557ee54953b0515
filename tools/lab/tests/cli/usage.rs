//! Exit codes and errors of `subsplat-lab`, and `compare`.

use crate::program::{call_in, call_with, files};
use std::path::Path;
use subsplat::network::config::Config;
use subsplat::network::model::weights::save;
use subsplat_test_support::answers::{keys, seconds};
use subsplat_test_support::shared;

#[test]
fn impossible_values_are_wrong_usage() {
    let place = tempfile::tempdir().unwrap();
    let rows = [
        ("eval a --limit 0", "at least 1"),
        ("eval a --input-size 0", "N or WxH"),
        ("eval a --near 3 --far 2", "--near 3: expected less than --far 2"),
        ("train a.toml --minutes 0", "above 0"),
        ("compare --weights w", "--reference"),
    ];
    for (arguments, named) in rows {
        let called = call_in(place.path(), &format!("--json {arguments}"));
        assert_eq!(called.code, 2, "{arguments}: {}", called.stderr);
        let told = called.json();
        let error = told["error"].as_str().unwrap();
        assert!(error.contains(named), "{arguments}: expected `{named}` in: {error}");
        // The object joins clap's lines by semicolons.
        let shown = error.split(';').all(|line| called.stderr.contains(line.trim()));
        assert!(shown, "{arguments}: {}", called.stderr);
    }
    let plain = call_in(place.path(), "compare --weights w");
    assert_eq!((plain.code, plain.stdout.as_str()), (2, ""));
    assert!(files(place.path()).is_empty());
}

#[test]
fn missing_weights_are_named() {
    let place = tempfile::tempdir().unwrap();
    std::fs::write(place.path().join("file"), "x").unwrap();
    let before = files(place.path());
    let called = call_in(place.path(), "--json compare --weights nowhere --reference file");
    assert_eq!(called.code, 1, "{}", called.stderr);
    let error = called.error();
    assert!(error.contains("nowhere"), "{error}");
    assert_eq!(format!("error: {}", called.json()["error"].as_str().unwrap()), error);
    assert!(error.matches("os error").count() <= 1, "told twice: {error}");
    assert!(!called.stderr.contains("panicked"), "{}", called.stderr);
    assert_eq!(files(place.path()), before, "files were left behind");
}

#[test]
fn compare_says_yes_and_no() {
    let (Some(weights), Some(reference)) = (
        shared("golden/mvsplat_weights.safetensors"),
        shared("golden/mvsplat_64x64_b1v2.safetensors"),
    ) else {
        return;
    };
    let place = tempfile::tempdir().unwrap();
    let compare = |reference: &Path| {
        let words = ["--json", "compare", "--weights", weights.to_str().unwrap(), "--reference"];
        let called =
            call_with(place.path(), &[&words[..], &[reference.to_str().unwrap()]].concat(), &[]);
        let report = called.json();
        keys(&report["tensors"][0], &["tensor", "max_abs", "relative", "allowed", "ok"]);
        seconds(&report, &["encoder"]);
        assert_eq!(report["ok"].as_bool().unwrap(), called.code == 0);
        (called.code, report["tensors"].as_array().unwrap().len())
    };
    let (code, tensors) = compare(&reference);
    assert_eq!(code, 0);
    assert!(tensors > 20, "{tensors}");
    // The inputs and one tensor that is a hundredth of its range off.
    let (mut all, _) = subsplat::network::model::weights::read_tensors(&reference).unwrap();
    all.retain(|name, _| name.starts_with("in.") || name == "out.means");
    let off = all["out.means"].affine(1.0, 1.0).unwrap();
    all.insert("out.means".to_owned(), off);
    let wrong = place.path().join("wrong.safetensors");
    save(&wrong, &all, &Config::x2()).unwrap();
    assert_eq!(compare(&wrong), (3, 1));
}
