//! `subsplat paper`: the shape of every table and figure, on tiny generated scenes.

use crate::program;

use program::{call_in, files, workplace};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::files::photos::image::load;

const TINY: &str = "--limit 1 --steps 1 --seeds 1 --input-size 32 --frames 3";
const COLUMNS: usize = 19;

/// Rows, settings and rows with our numbers of each table.
const SHAPES: [(&str, [usize; 3]); 18] = [
    ("t1", [8, 4, 16]),
    ("t2", [6, 1, 2]),
    ("t3", [5, 1, 4]),
    ("t4", [3, 2, 6]),
    ("t5", [3, 1, 3]),
    ("tA", [4, 1, 4]),
    ("tB", [5, 1, 5]),
    ("tC", [3, 1, 3]),
    ("tD", [2, 2, 4]),
    ("tE", [13, 1, 5]),
    ("tF", [6, 1, 5]),
    ("f3", [8, 1, 4]),
    ("f4", [8, 1, 4]),
    ("f5", [5, 1, 4]),
    ("f6", [3, 1, 3]),
    ("fA", [6, 1, 5]),
    ("fC", [8, 1, 4]),
    ("fD", [8, 1, 4]),
];

/// Lines of a CSV file as cells by column.
fn lines(file: &Path) -> Vec<BTreeMap<String, String>> {
    let text = std::fs::read_to_string(file).unwrap();
    // Names in quotation marks hold commas.
    let cells = |line: &str| -> Vec<String> {
        let mut cells = vec![String::new()];
        let mut quoted = false;
        for c in line.chars() {
            match c {
                '"' => quoted = !quoted,
                ',' if !quoted => cells.push(String::new()),
                c => cells.last_mut().unwrap().push(c),
            }
        }
        cells
    };
    let mut all = text.lines().map(cells);
    let head = all.next().unwrap();
    let line = |cells: Vec<String>| {
        assert_eq!(cells.len(), head.len(), "{}: {cells:?}", file.display());
        head.iter().cloned().zip(cells).collect()
    };
    all.map(line).collect()
}

#[test]
fn every_table_and_figure_has_its_rows_numbers_and_pictures() {
    let place = tempfile::tempdir().unwrap();
    let called = call_in(place.path(), &format!("--json paper all -o p {TINY}"));
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    let out = place.path().join("p");
    assert_eq!(report["tables"].as_object().unwrap().len(), SHAPES.len() + 1);
    for (id, [rows, settings, measured]) in SHAPES {
        let folder = out.join(id);
        let csv = lines(&folder.join(format!("{id}.csv")));
        assert_eq!(csv.len(), rows * settings, "{id}");
        assert!(csv.iter().all(|l| l.len() == COLUMNS && l["table"] == id), "{id}");
        let ours =
            |l: &&BTreeMap<String, String>| !l["psnr"].is_empty() || !l["seconds"].is_empty();
        assert_eq!(csv.iter().filter(ours).count(), measured, "{id}");
        let cost = ["t2", "tE"].contains(&id);
        let figure = id.starts_with('f');
        for line in csv.iter().filter(ours) {
            assert!(line["data"].starts_with("generated"), "{line:?}");
            let psnr: f64 = line["psnr"].parse().unwrap();
            assert!((5.0..60.0).contains(&psnr) && !line["ssim"].is_empty(), "{line:?}");
            assert!(line["lpips"].is_empty());
            let [input, target] = ["input", "target"].map(|c| line[c].parse::<usize>().unwrap());
            let ratio = if line["setting"].ends_with("1024") { 4 } else { 2 };
            let at_target_size = line["row"].ends_with("(input 512)");
            assert_eq!((input, target), (if at_target_size { 64 } else { 32 }, 32 * ratio));
            assert_eq!(line["gigabytes"].parse::<f64>().is_ok_and(|g| g > 0.001), cost, "{line:?}");
            let timed = cost || ["t3", "tF"].contains(&id);
            assert_eq!(line["seconds"].parse::<f64>().is_ok_and(|s| s > 0.0), timed, "{line:?}");
            // Rows of our own have no number of the paper, as have figures.
            let own = line["row"].contains("low-pass") || line["row"].contains("refined");
            let published = if id == "tE" { "paper_seconds" } else { "paper_psnr" };
            assert_eq!(line[published].is_empty(), own || figure, "{line:?}");
        }
        let text = std::fs::read_to_string(folder.join(format!("{id}.md"))).unwrap();
        assert!(text.contains("* GENERATED SCENES stand in for data sets"), "{text}");
        assert_eq!(text.matches("\n## ").count(), settings, "{text}");
        assert_eq!(text.contains("trained here"), text.contains("1 steps, 1 seed;"), "{text}");
        // One sheet a setting: an input, each measured row and the photograph.
        let sheets: Vec<_> =
            files(&folder).into_iter().filter(|f| f.extension().unwrap() == "png").collect();
        assert_eq!(sheets.len(), settings, "{id}: {sheets:?}");
        assert_eq!(report["tables"][id]["pictures"], json!(settings));
        let sheet = load(folder.join(&sheets[0])).unwrap();
        assert_eq!(sheet.width, (measured / settings + 2) * 262, "{id}");
    }
    // Trained once, and shared by the tables.
    let models = std::fs::read_dir(out.join("models")).unwrap().count();
    assert_eq!(models, 15 + 1, "13 configurations at x2, 2 at x4, the backbone");
    let video = &report["tables"]["fB"];
    assert_eq!((&video["frames"], &video["pictures"]), (&json!(3), &json!(1)));
    assert_eq!(lines(&out.join("fB/fB.csv")).len(), 3);
    assert!(out.join("fB/video.webp").is_file() && out.join("fB/still-000.png").is_file());

    // A second call trains nothing, and gives the same bytes.
    let again = call_in(place.path(), &format!("--json paper t4 -o p {TINY}"));
    assert!(!again.stderr.contains("training"), "{}", again.stderr);
    let t4 = |name: &str| std::fs::read_to_string(out.join("t4").join(name)).unwrap();
    let first = t4("t4.csv");
    call_in(place.path(), &format!("--json paper t4 -o p {TINY}"));
    assert_eq!(t4("t4.csv"), first);
    // Two seeds are two trainings.
    let two = call_in(place.path(), "paper t5 -o p --limit 1 --steps 1 --seeds 2 --input-size 32");
    assert!(two.stderr.contains("training stages-1-x2-32px-1steps-seed1"), "{}", two.stderr);
    assert!(two.stdout.contains("pairs of rows as in the paper (one number a seed)"));
    for line in lines(&out.join("t5/t5.csv")) {
        assert_eq!((line["seeds"].as_str(), line["psnr_by_seed"].split(' ').count()), ("2", 2));
    }
}

#[test]
fn data_weights_and_pictures_of_the_user_replace_what_is_generated() {
    let place = workplace();
    let protocol = r#"{"resolution": [64, 64], "tests": [{"context": [0, 2], "target": [1]}]}"#;
    std::fs::write(place.path().join("scene/protocol.json"), protocol).unwrap();
    let folder = place.path().join("sets/re10k");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::rename(place.path().join("scene"), folder.join("scene")).unwrap();
    let paper = |more: &str| {
        let called = call_in(place.path(), &format!("--json paper -o p {TINY} {more}"));
        assert_eq!(called.code, 0, "{}", called.stderr);
        called.json()
    };
    let row = |name: &str, setting: &str| {
        let all = lines(&place.path().join("p/t3/t3.csv"));
        all.into_iter().find(|l| l["row"] == name && l["setting"] == setting).unwrap()
    };
    let report = paper("t3 --data sets");
    assert_eq!(report["tables"]["t3"]["generated"], json!(false));
    let ours = row("SubSplat", "RE10K 512");
    assert_eq!((ours["data"].as_str(), ours["target"].as_str()), ("re10k", "64"));
    // The same weights as a file give the same number; a table without the data set says so.
    let report = paper("t1 --data sets");
    assert_eq!(report["tables"]["t1"]["generated"], json!(true));
    let t1 = lines(&place.path().join("p/t1/t1.csv"));
    let data = |setting: &str| t1.iter().find(|l| l["setting"] == setting).unwrap()["data"].clone();
    assert_eq!(
        (data("RE10K 512"), data("ACID 512")),
        ("re10k".to_owned(), "generated shapes".to_owned())
    );
    // `eval` gives the same number, and its pictures serve as another program's.
    let eval = "--json eval sets/re10k --methods subsplat --upscale 2 --input-size 32 -o e";
    let score: Value = call_in(place.path(), eval).json();
    let psnr = score["methods"]["subsplat"]["psnr"].as_f64().unwrap();
    assert!((ours["psnr"].parse::<f64>().unwrap() - psnr).abs() < 1e-5);
    paper("t3 --data sets --pred MVSplat-HiT-SR=e/pictures/subsplat --pred mine=e/pictures/truth");
    let hit = row("MVSplat + HiT-SR", "RE10K 512");
    assert!((hit["psnr"].parse::<f64>().unwrap() - psnr).abs() < 0.05, "{hit:?}");
    assert_eq!(
        (row("mine", "RE10K 512")["psnr"].as_str(), hit["paper_psnr"].as_str()),
        ("inf", "23.88")
    );
    // Weights of the user: the file that a table trained before, under the name of a row.
    paper("t5");
    std::fs::create_dir(place.path().join("own")).unwrap();
    let trained = place.path().join("p/models/stages-1-x2-32px-1steps-seed0/weights.safetensors");
    std::fs::copy(trained, place.path().join("own/subsplat-x2.safetensors")).unwrap();
    paper("t3 --data sets --ckpts own");
    assert_ne!(row("SubSplat", "RE10K 512")["psnr"], ours["psnr"]);
    assert_eq!(row("MVSplat + bilinear", "RE10K 512")["data"], "re10k");
}

#[test]
fn refusals_name_the_argument() {
    let place = tempfile::tempdir().unwrap();
    for (arguments, code, words) in [
        ("paper", 2, "ID"),
        ("paper t6", 2, "expected one of t1, t2"),
        ("paper t1 --limit 0", 2, "--limit"),
        ("paper t1 --seeds 0", 2, "--seeds"),
        ("paper t1 --pred copy", 1, "--pred: expected NAME=DIR, got `copy`"),
        ("paper t1 --data nowhere", 1, "nowhere"),
    ] {
        let called = call_in(place.path(), arguments);
        assert!(
            called.code == code && called.stderr.contains(words),
            "{arguments}: {}",
            called.stderr
        );
    }
    let help = call_in(place.path(), "paper --help").stdout;
    for words in ["Table 6", "re10k-1080", "no-aggregation", "generated"] {
        assert!(help.contains(words), "{words}");
    }
}
