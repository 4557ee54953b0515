//! `export`, and the HTML of `run`: every format from a folder, and what is refused.

use crate::program::{call_in, call_with, workplace};
use std::path::Path;
use subsplat::files::photos::image::load;
use subsplat::files::{SplatFormat, load_splats, parse_splats};
use subsplat::scene::metrics::psnr;
use subsplat::scene::splats::Splats;
use subsplat_test_support::one_splat::save_one_splat;

/// The contents of the script element `id` of a page.
fn script(page: &str, id: &str) -> String {
    let start = page.find(&format!("<script id=\"{id}\"")).unwrap();
    let body = &page[start..];
    let body = &body[body.find('>').unwrap() + 1..];
    body[..body.find("</script>").unwrap()].to_owned()
}

/// Decodes base64, character by character.
fn from_base64(text: &str) -> Vec<u8> {
    const DIGITS: &str = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let (mut bits, mut held, mut out) = (0u32, 0, Vec::new());
    for c in text.chars().filter(|c| *c != '=') {
        bits = bits << 6 | DIGITS.find(c).unwrap() as u32;
        held += 6;
        if held >= 8 {
            held -= 8;
            out.push((bits >> held) as u8);
            bits &= (1 << held) - 1;
        }
    }
    out
}

fn scene_of(page: &Path) -> (Splats, serde_json::Value) {
    let page = std::fs::read_to_string(page).unwrap();
    let bytes = from_base64(script(&page, "scene").trim());
    assert_eq!(SplatFormat::from_magic(&bytes), Some(SplatFormat::Spz));
    let (splats, _) = parse_splats(&bytes, "scene.spz").unwrap();
    (splats, serde_json::from_str(&script(&page, "settings")).unwrap())
}

#[test]
fn run_writes_a_page_with_its_scene_and_cameras() {
    let place = workplace();
    let quick = "run scene --context 0,2 --input-size 64 --fit 0 --refine off -o out";
    let called = call_in(place.path(), &format!("--json {quick} --save ply,html"));
    assert_eq!(called.code, 0, "{}", called.stderr);
    let report = called.json();
    let file = &report["files"][1];
    assert_eq!(file["format"], "html");
    let path = place.path().join("out/scene.html");
    assert_eq!(file["bytes"].as_u64(), Some(std::fs::metadata(&path).unwrap().len()));
    let (splats, settings) = scene_of(&path);
    let written = load_splats(place.path().join("out/scene.ply")).unwrap();
    assert_eq!(splats.len() as u64, file["count"].as_u64().unwrap());
    assert_eq!(splats.len(), written.len() - file["pruned"].as_u64().unwrap() as usize);
    // The two photographs' own cameras, at the target's size.
    let cameras = settings["cameras"].as_array().unwrap();
    assert_eq!(cameras.len(), 2);
    assert_eq!(cameras[0]["width"], 128);
    assert_eq!(settings["photographs"], true);
    let names = |settings: &serde_json::Value| -> Vec<String> {
        let name = |camera: &serde_json::Value| camera["name"].as_str().unwrap().to_owned();
        settings["cameras"].as_array().unwrap().iter().map(name).collect()
    };
    assert_eq!(names(&settings), ["view0", "view2"]);
    assert!(settings["background"][0].as_f64().unwrap() > 0.0);

    // `export` finds scene.ply in the folder that `run` wrote, and the photographs' cameras in it.
    let called = call_in(place.path(), "--json export out -o again.html");
    assert_eq!(called.code, 0, "{}", called.stderr);
    let (again, settings) = scene_of(&place.path().join("again.html"));
    assert_eq!(again.len(), splats.len());
    assert_eq!(names(&settings), ["view0", "view2"]);
    assert_eq!(settings["photographs"], true);
    assert_eq!(settings["near"].as_f64().unwrap() as f32, 0.01);
    // Other cameras on request: those of the rendered views.
    let other = "export out --cameras out/cameras.json -o other.html";
    assert_eq!(call_in(place.path(), other).code, 0);
    let (_, settings) = scene_of(&place.path().join("other.html"));
    assert_eq!((names(&settings).len(), &settings["photographs"]), (1, &false.into()));

    // Alone, the file still knows the photographs' cameras; turned, it does not.
    let alone = place.path().join("alone");
    std::fs::create_dir(&alone).unwrap();
    std::fs::copy(place.path().join("out/scene.ply"), alone.join("a.ply")).unwrap();
    for (arguments, cameras) in
        [("export alone/a.ply -o b.html", 2), ("export alone/turned.ply -o b.html", 0)]
    {
        let turn = "export alone/a.ply -o alone/turned.ply --up z";
        assert_eq!(call_in(place.path(), turn).code, 0);
        assert_eq!(call_in(place.path(), arguments).code, 0);
        let (_, settings) = scene_of(&place.path().join("b.html"));
        assert_eq!(settings["cameras"].as_array().unwrap().len(), cameras, "{arguments}");
    }
    let called = call_in(place.path(), "--json render alone/a.ply -o view");
    assert!(called.code == 0 && called.stderr.contains("the file's own camera"));
    let view = load(place.path().join("view/view.png")).unwrap();
    let photograph = load(place.path().join("scene/images/view0.png")).unwrap();
    let unit = |v: &[u8]| v.iter().map(|&v| f32::from(v) / 255.0).collect::<Vec<f32>>();
    assert_eq!((view.width, view.height), (128, 128));
    let likeness = psnr(&unit(&view.data), &unit(&photograph.data), 128, 128).unwrap();
    assert!(likeness > 15.0, "the first photograph's view: {likeness:.1} dB");
}

#[test]
fn export_writes_every_format() {
    let place = workplace();
    save_one_splat(&place.path().join("one.ply"));
    let first = load_splats(place.path().join("one.ply")).unwrap();
    for format in ["ply", "glb", "spz", "sog", "splat", "html"] {
        let called = call_in(place.path(), &format!("--json export one.ply -o two.{format}"));
        assert_eq!(called.code, 0, "{}", called.stderr);
        let report = called.json();
        assert_eq!((&report["count"], &report["format"]), (&1.into(), &format.into()));
        let path = place.path().join(format!("two.{format}"));
        let again = match format {
            "html" => scene_of(&path).0,
            _ => load_splats(&path).unwrap(),
        };
        for (a, b) in first.mean(0).iter().zip(again.mean(0)) {
            assert!((a - b).abs() < 1e-4, "{format}");
        }
    }
    let called = call_in(place.path(), "export one.ply -o four.spz --spz-version 4");
    assert_eq!(called.code, 0, "{}", called.stderr);
    let bytes = std::fs::read(place.path().join("four.spz")).unwrap();
    assert_eq!(bytes[..8], *b"NGSP\x04\0\0\0");
    // A view of the whole, where no cameras.json lies beside the scene.
    assert_eq!(scene_of(&place.path().join("two.html")).1["cameras"].as_array().unwrap().len(), 0);

    assert_eq!(call_in(place.path(), "export one.ply -o up.ply --up y").code, 0);
    let up = load_splats(place.path().join("up.ply")).unwrap();
    let ([x, y, z], turned) = (first.mean(0), up.mean(0));
    assert!((turned[0] - x).abs() + (turned[1] + y).abs() + (turned[2] + z).abs() < 1e-5);
    // Its header describes its own axes alone.
    let bytes = std::fs::read(place.path().join("up.ply")).unwrap();
    let head = String::from_utf8_lossy(&bytes[..2000.min(bytes.len())]).into_owned();
    assert_eq!(
        (head.matches("up is ").count(), head.matches("up is +y").count()),
        (1, 1),
        "{head}"
    );
}

/// Each command that loads a scene file says what was left out, applied or not read.
#[test]
fn notes_on_a_scene_file_are_warnings() {
    let place = workplace();
    let mut text = "ply\nformat ascii 1.0\nelement vertex 4\n".to_owned();
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 \
         filter_3D label";
    for name in names.split_whitespace() {
        text += &format!("property float {name}\n");
    }
    text += "end_header\n0 0 3 1 0 0 2 -1 -1 -1 1 0 0 0 0.1 5\n";
    text += &"0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0\n".repeat(2);
    text += "nan 0 3 1 0 0 2 -1 -1 -1 1 0 0 0 0.1 5\n";
    std::fs::write(place.path().join("foreign.ply"), text).unwrap();
    for command in ["info foreign.ply", "render foreign.ply -o view", "export foreign.ply -o a.ply"]
    {
        let called = call_in(place.path(), command);
        assert_eq!(called.code, 0, "{}", called.stderr);
        let all = called.stdout + &called.stderr;
        for note in [
            "warning: the property filter_3D",
            "warning: vertex properties that are not read: label\n",
            "warning: left out: 2 of 4 splats, whose rotation is 0 0 0 0",
            "warning: left out: 1 of 4 splats, which hold numbers that are NaN or infinite",
        ] {
            assert_eq!(all.matches(note).count(), 1, "{command}: {note}\n{all}");
        }
    }
    let info = call_in(place.path(), "--json info foreign.ply").json();
    assert_eq!(info["splats"]["notes"].as_array().unwrap().len(), 4);
    // The copy holds the result, and there is nothing left to say.
    let copy = call_in(place.path(), "--json info a.ply").json();
    assert_eq!(
        (&copy["splats"]["count"], &copy["splats"]["notes"]),
        (&1.into(), &[""; 0][..].into())
    );
}

#[test]
fn export_merges_gaussians_to_half_and_a_quarter() {
    let place = workplace();
    let run = "run scene --context 0,2 --target 1 --input-size 64 --refine off -o out";
    assert_eq!(call_in(place.path(), run).code, 0);
    let all = load_splats(place.path().join("out/scene.ply")).unwrap().len();
    let size = |name: &str| std::fs::metadata(place.path().join(name)).unwrap().len() as f64;
    let view = |name: &str| {
        let render = format!("render {name} --cameras scene -o view-{}", name.replace('/', "-"));
        assert_eq!(call_in(place.path(), &render).code, 0);
        let folder = place.path().join(format!("view-{}", name.replace('/', "-")));
        // The frame between the inputs, and the inputs.
        ["view1.png", "view0.png", "view2.png"].map(|f| load(folder.join(f)).unwrap().to_unit())
    };
    let whole = view("out/scene.ply");
    for (wanted, share, likeness) in [("50%", 0.5, 38.0), ("2048", 2048.0 / all as f64, 33.0)] {
        let export = format!("--json export out -o less.ply --gaussians {wanted}");
        let called = call_in(place.path(), &export);
        assert_eq!(called.code, 0, "{}", called.stderr);
        let report = called.json();
        assert_eq!(report["all"], all);
        assert_eq!(report["count"], (share * all as f64).round() as usize);
        assert!((size("less.ply") / size("out/scene.ply") - share).abs() < 0.02);
        for (got, expected) in view("less.ply").iter().zip(&whole) {
            let psnr = psnr(got, expected, 128, 128).unwrap();
            assert!(psnr > likeness, "{wanted}: {psnr:.1} dB");
        }
        let again = call_in(place.path(), "--threads 1 export out -o again.ply --gaussians 50%");
        assert_eq!(again.code, 0);
        let read = |name: &str| std::fs::read(place.path().join(name)).unwrap();
        assert!(wanted != "50%" || read("less.ply") == read("again.ply"), "bytes by threads");
    }
    // More than there are: nothing is merged.
    let called = call_in(place.path(), "--json export out -o all.splat --gaussians 99999999");
    assert_eq!(called.json()["count"], all);
}

/// The folder of a training of 3D Gaussian Splatting: its last state, and its cameras.
#[test]
fn the_folder_of_a_training_is_a_scene() {
    let place = tempfile::tempdir().unwrap();
    let model = place.path().join("model");
    for steps in ["7000", "30000"] {
        let state = model.join(format!("point_cloud/iteration_{steps}"));
        std::fs::create_dir_all(&state).unwrap();
        save_one_splat(&state.join("point_cloud.ply"));
    }
    // A state that was stopped while it was written.
    std::fs::create_dir_all(model.join("point_cloud/iteration_40000")).unwrap();
    let cameras = r#"[{"id": 0, "img_name": "a", "width": 24, "height": 16, "position": [0, 0, 0],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 20, "fy": 20}]"#;
    std::fs::write(model.join("cameras.json"), cameras).unwrap();
    let info = call_in(place.path(), "--json info model").json();
    let file = info["file"].as_str().unwrap();
    assert!(info["kind"] == "splats" && file.contains("iteration_30000"), "{info}");
    let drawn = call_in(place.path(), "--json render model -o drawn");
    assert_eq!(drawn.code, 0, "{}", drawn.stderr);
    let view = &drawn.json()["views"][0];
    assert_eq!((&view["width"], &view["height"]), (&24.into(), &16.into()));
    assert_eq!(call_in(place.path(), "export model -o a.spz").code, 0);
    std::fs::remove_dir_all(model.join("point_cloud")).unwrap();
    let called = call_in(place.path(), "render model -o drawn");
    assert!(called.error().contains("a folder with scene.ply"), "{}", called.stderr);
}

#[test]
fn export_refuses_what_it_cannot_write() {
    let place = workplace();
    save_one_splat(&place.path().join("one.ply"));
    for (arguments, words) in [
        (
            "export one.ply -o two.obj",
            "two.obj: expected a name that ends in .ply, .glb, .spz, .sog, .splat or .html",
        ),
        ("export one.ply -o two.ply --cameras scene", "--cameras: only .html files"),
        ("export one.ply -o two.ply --cameras none --gaussians 50%", "none"),
        ("export one.ply -o two.html --up y", "--up: a .html file"),
        ("export one.ply -o two.spz --up z", "y-up by definition"),
        ("export one.ply -o two.html --spz-version 4", "--spz-version: only with a .spz"),
        ("export nothing.ply -o two.html", "nothing.ply"),
        ("export one.ply -o none/two.html", "none/two.html"),
        ("export one.ply -o two.html --min-opacity 0.95", "at least one Gaussian to write"),
    ] {
        let called = call_in(place.path(), arguments);
        assert_eq!(called.code, 1, "{arguments}");
        assert!(called.error().contains(words), "{arguments}: {}", called.stderr);
    }
    assert!(!place.path().join("two.html").exists());
    let numbers = [["--gaussians", "auto"], ["--gaussians", "0"], ["--gaussians", "0%"]];
    for arguments in [["--sh", "4"], ["--min-opacity", "2"]].iter().chain(&numbers) {
        let all = [&["export", "one.ply", "-o", "two.ply"][..], arguments].concat();
        assert_eq!(call_with(place.path(), &all, &[]).code, 2, "{arguments:?}");
    }
}
