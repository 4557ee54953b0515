//! `subsplat eval` as a program: what it prints and writes, and how it refuses.

use crate::program;

use program::{Called, call_in, files, workplace};
use serde_json::{Value, json};
use std::path::Path;

const PROTOCOL: &str = r#"{"resolution": [64, 64], "tests": [{"context": [0, 2], "target": [1]}, {"context": [0, 1], "target": [2, 1]}]}"#;

fn room() -> tempfile::TempDir {
    let place = workplace();
    std::fs::write(place.path().join("scene/protocol.json"), PROTOCOL).unwrap();
    place
}

#[track_caller]
fn done(called: &Called) -> Value {
    assert_eq!(called.code, 0, "{}", called.stderr);
    called.json()
}

fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn eval_scores_writes_and_reads_its_own_pictures() {
    let place = room();
    let out = place.path().join("out");
    let report = done(&call_in(place.path(), "--json eval scene --detail photo -o out"));
    let names = [
        "subsplat", "detail", "fit", "refine", "enlarged", "backbone", "lowpass", "bilinear",
        "uniform", "copy", "mean",
    ];
    let methods = report["methods"].as_object().unwrap();
    assert_eq!(methods.len(), names.len());
    for name in names {
        let scores = &methods[name];
        let psnr = scores["psnr"].as_f64().unwrap();
        assert!((6.0..60.0).contains(&psnr), "{name}: {scores}");
        assert!(scores["ssim"].as_f64().unwrap() < 1.0 && scores["lpips"].is_null());
        assert!(scores["sharpness"].as_f64().unwrap() > 0.0);
        assert!((0.0..1.0).contains(&scores["gmsd"].as_f64().unwrap()));
    }
    assert!(report["protocol"]["lpips"].as_str().unwrap().contains("--lpips"));
    let scene = &report["scenes"]["scene"];
    assert_eq!(scene["cases"].as_array().unwrap().len(), 2);
    let case = &scene["cases"][1];
    assert_eq!((&case["context"], &case["input"]), (&json!([0, 1]), &json!([64, 64])));
    // Means: targets, then cases.
    let psnr = |v: &Value| v["methods"]["mean"]["psnr"].as_f64().unwrap();
    let targets = case["targets"].as_array().unwrap();
    let mean = 0.5 * (psnr(&targets[0]) + psnr(&targets[1]));
    assert!((psnr(case) - mean).abs() < 1e-9);
    let mean = 0.5 * (psnr(&scene["cases"][0]) + psnr(case));
    assert!((psnr(scene) - mean).abs() < 1e-9 && (psnr(&report) - mean).abs() < 1e-9);

    // 3 targets of 11 methods and the truth; four tables; nothing else.
    let written = files(&out);
    assert_eq!(written.len(), 3 * 12 + 4, "{written:?}");
    let saved: Value = serde_json::from_str(&text(&out.join("eval.json"))).unwrap();
    assert_eq!((&saved["methods"], &saved["scenes"]), (&report["methods"], &report["scenes"]));
    let csv = text(&out.join("targets.csv"));
    assert_eq!(csv.lines().count(), 1 + 3 * 11);
    assert!(csv.starts_with("scene,context,target,frame,method,psnr,ssim,lpips,sharpness,gmsd\n"));
    assert!(csv.lines().all(|l| l.matches(',').count() == 9), "{csv}");
    let means = text(&out.join("means.csv"));
    assert_eq!(means.lines().count(), 1 + 2 * 11);
    assert!(means.lines().all(|l| l.matches(',').count() == 17), "{means}");
    let page = text(&out.join("index.html"));
    // Two inputs, the photograph and eleven methods, twice; nothing from elsewhere.
    assert_eq!(page.matches("<img ").count(), 28);
    assert_eq!(page.matches("src=\"data:image/png;base64,").count(), 28);
    assert!(!page.contains("http") && page.contains("the weights that ship"));

    // Its own pictures, read back as another program's: 8 bits apart.
    let preds = "--pred again=out/pictures/subsplat --pred same=out/pictures/truth";
    let arguments = format!("--json eval scene --methods copy --upscale 2 {preds}");
    let again = done(&call_in(place.path(), &arguments));
    let of = |name: &str| again["methods"][name]["psnr"].as_f64();
    assert!((of("again").unwrap() - methods["subsplat"]["psnr"].as_f64().unwrap()).abs() < 0.05);
    assert_eq!(again["methods"]["copy"]["psnr"], methods["copy"]["psnr"]);
    assert_eq!((of("same"), &again["methods"]["same"]["ssim"]), (None, &json!(1.0)));
    assert!(again["protocol"]["backbone"].is_null());
}

#[test]
fn a_scene_without_a_protocol_is_scored_and_the_choice_is_printed() {
    let place = workplace();
    let called = call_in(place.path(), "--json eval scene --methods copy --input-size 64");
    let report = done(&called);
    assert_eq!((&report["cases"], &report["targets"]), (&json!(1), &json!(1)));
    assert!(called.stderr.contains("note: scene has no protocol.json: inputs are frames"));
    assert_eq!(report["notes"].as_array().unwrap().len(), 1);
    // Other inputs need no such note.
    let called = call_in(place.path(), "--json eval scene --methods copy --contexts 2");
    assert!(done(&called)["notes"].as_array().unwrap().is_empty(), "{}", called.stderr);
}

#[test]
fn a_folder_of_scenes_and_an_index_choose_the_cases() {
    let place = room();
    let folder = place.path().join("many");
    std::fs::create_dir(&folder).unwrap();
    std::fs::rename(place.path().join("scene"), folder.join("b")).unwrap();
    let other = room();
    std::fs::create_dir(folder.join("c")).unwrap();
    std::fs::rename(other.path().join("scene"), folder.join("a")).unwrap();
    let eval = |more: &str| {
        done(&call_in(place.path(), &format!("--json eval many --methods copy,mean {more}")))
    };
    let all = eval("");
    assert_eq!((&all["cases"], all["scenes"].as_object().unwrap().len()), (&json!(4), 2));
    let first = eval("--limit 1");
    assert_eq!(first["scenes"].as_object().unwrap().keys().collect::<Vec<_>>(), ["a"]);
    let index = r#"{"b": {"context": [0, 2], "target": [1]}, "a": null}"#;
    std::fs::write(place.path().join("index.json"), index).unwrap();
    let chosen = eval("--index index.json --input-size 32");
    assert_eq!((&chosen["cases"], &chosen["targets"]), (&json!(1), &json!(1)));
    assert_eq!(chosen["scenes"]["b"]["cases"][0]["target"], json!([64, 64]));
}

#[test]
fn any_upscale_of_run_is_scored_at_its_size() {
    let place = room();
    for (upscale, side, gaussians) in [("1.5", 96, 4), ("3", 96, 9)] {
        // 32 px at x3: the photographs have 128.
        let input = if upscale == "3" { 32 } else { 64 };
        let methods = "subsplat,backbone,bilinear,uniform,copy,mean";
        let arguments = format!(
            "--json eval scene --upscale {upscale} --input-size {input} --methods {methods}"
        );
        let report = done(&call_in(place.path(), &arguments));
        let case = &report["scenes"]["scene"]["cases"][0];
        assert_eq!(case["input"], json!([input, input]));
        assert_eq!(case["target"], json!([side, side]), "{upscale}");
        assert_eq!(report["protocol"]["upscale"].to_string(), upscale);
        for method in methods.split(',') {
            let psnr = report["methods"][method]["psnr"].as_f64().unwrap();
            assert!((6.0..60.0).contains(&psnr), "{upscale} {method}: {psnr}");
        }
        // The children fill the grid of the next whole upscale.
        for method in ["subsplat", "uniform"] {
            let count = report["inputs"][method]["gaussians"]["count"].as_f64();
            assert_eq!(count, Some(f64::from(2 * input * input * gaussians)), "{upscale} {method}");
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_figures() {
    let place = room();
    for (threads, out) in [(1, "one"), (2, "two")] {
        let arguments =
            format!("--threads {threads} eval scene --methods subsplat,bilinear,mean -o {out}");
        let called = call_in(place.path(), &arguments);
        assert_eq!(called.code, 0, "{}", called.stderr);
        for words in ["3 targets, 2 cases, 1 scenes, x2", "64x64 to 128x128 (2 cases)"] {
            assert!(called.stdout.contains(words), "{}", called.stdout);
        }
    }
    let read = |f: &Path| std::fs::read(f).unwrap();
    for file in files(&place.path().join("one")) {
        let [one, two] = ["one", "two"].map(|o| read(&place.path().join(o).join(&file)));
        assert!(one == two, "{}", file.display());
    }
}

/// The recipe of tools/lab/train/README.md, "Several processes".
#[test]
fn two_processes_share_an_evaluation() {
    let place = room();
    let eval = |more: &str| {
        let called =
            call_in(place.path(), &format!("eval scene --methods subsplat,fit,mean {more}"));
        assert_eq!(called.code, 0, "{}", called.stderr);
    };
    eval("-o whole");
    std::thread::scope(|scope| {
        for part in ["0", "1"] {
            scope.spawn(move || eval(&format!("--shard {part}/2 -o part{part}")));
        }
    });
    let csv = |out: &str| text(&place.path().join(out).join("targets.csv"));
    let (first, second) = (csv("part0"), csv("part1"));
    let head = second.lines().next().unwrap();
    let joined = first.clone() + &second[head.len() + 1..];
    assert!(first.lines().count() > 1 && second.lines().count() > 1);
    assert_eq!(joined, csv("whole"));
    // Both folders together hold the pictures of one process.
    let pictures = |out: &str| files(&place.path().join(out).join("pictures"));
    let mut both = [pictures("part0"), pictures("part1")].concat();
    both.sort();
    assert_eq!(both, pictures("whole"));
    for file in both {
        let read =
            |out: &str| std::fs::read(place.path().join(out).join("pictures").join(&file)).ok();
        assert_eq!(read("part0").or(read("part1")), read("whole"), "{}", file.display());
    }
    for (shard, code, words) in
        [("2/2", 2, "expected I/N"), ("x", 2, "expected I/N"), ("1/9", 1, "part of the cases")]
    {
        let called = call_in(place.path(), &format!("eval scene --methods copy --shard {shard}"));
        assert!(called.code == code && called.stderr.contains(words), "{shard}: {}", called.stderr);
    }
}

#[test]
fn refusals_are_one_line_and_leave_no_tables() {
    let place = room();
    std::fs::create_dir(place.path().join("empty")).unwrap();
    for (arguments, words) in [
        ("eval empty", &["empty", "a folder of scenes"][..]),
        ("eval none", &["none", "No such file"]),
        ("eval scene --index none.json", &["none.json"]),
        ("eval scene --methods copy --pred x=empty", &["empty", "000001.png"]),
        ("eval scene --methods copy --pred x=nowhere", &["nowhere", "a folder of pictures"]),
        ("eval scene --methods copy,copy", &["--methods", "`copy` twice"]),
        ("eval scene --methods copy --pred mean", &["--pred", "NAME=DIR"]),
        ("eval scene --input-size 8", &["input", "32"]),
        ("eval scene --lpips scene/cameras.json --methods copy", &["cameras.json"]),
        ("eval scene --weights none.safetensors", &["none.safetensors"]),
    ] {
        let called = call_in(place.path(), &format!("{arguments} -o out"));
        assert_eq!(called.code, 1, "{arguments}: {}", called.stderr);
        for word in words {
            assert!(called.error().contains(word), "{arguments}: {}", called.error());
        }
        let tables = ["eval.json", "targets.csv", "means.csv", "index.html"];
        assert!(!tables.iter().any(|t| place.path().join("out").join(t).exists()), "{arguments}");
    }
    for (arguments, words) in [
        ("eval scene --methods best", "expected one of subsplat, detail"),
        ("eval scene --upscale 9", "expected a number from 1 to 8"),
        ("eval scene --near 9 --far 2 --methods copy", "--near 9"),
        ("eval scene --limit 0", "--limit"),
        ("eval", "DATA"),
    ] {
        let called = call_in(place.path(), arguments);
        assert!(called.code == 2 && called.stderr.contains(words), "{}", called.stderr);
    }
    let help = call_in(place.path(), "eval --help").stdout;
    assert!(help.contains("sharpness") && help.contains("protocol.json"));
}
