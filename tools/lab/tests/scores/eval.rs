//! Scores of `eval`: baselines against published figures, methods against the same steps of
//! the pipeline, and errors for invalid requests.

use subsplat_test_support as common;
use subsplat_test_support::scene_folder as program;
use subsplat_test_support::{chunk_files, made_up};

use chunk_files::{frame, video, write};
use glam::{Mat4, Vec3};
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::FitOptions;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{CameraFile, save_cameras_json};
use subsplat::files::poses::scene::{Units, load_scene};
use subsplat::network::config::{Config, LowpassRef, Preset};
use subsplat::network::model::weights::read_tensors;
use subsplat::reconstruct as pipeline;
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule};
use subsplat::reconstruct::inputs::pair::choose_pair;
use subsplat::reconstruct::{Check, DepthBounds, DepthRange, Detail, Photo, Poses, Reconstructor};
use subsplat::scene::metrics::psnr;
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_lab::eval::{
    Benchmark, CaseResult, Disturbance, Evaluator, InputReport, Method, Options, Preparation,
    Scores,
};
use subsplat_lab::lpips::Lpips;

fn untrained(upscale: usize) -> Reconstructor {
    Reconstructor::untrained(&Config::small(Preset::Tuned, upscale), 0).unwrap()
}

fn options(upscale: usize, methods: &[Method]) -> Options {
    Options { methods: methods.to_vec(), input_size: None, ..Options::new(upscale as f32) }
}

/// Mean colour of a reconstruction's inputs.
fn colour(made: &pipeline::Reconstruction) -> [f32; 3] {
    Rgb::mean_colour(made.inputs().iter().map(|c| &c.input))
}

/// The made-up room of the program's tests, with a protocol: inputs 0 and 2, target 1.
fn room() -> tempfile::TempDir {
    let place = program::workplace();
    let protocol = r#"{"resolution": [64, 64], "tests": [{"context": [0, 2], "target": [1]}]}"#;
    std::fs::write(place.path().join("scene/protocol.json"), protocol).unwrap();
    place
}

/// The photographs' protocol holds scores of the trivial baselines from another program: two
/// decimals of PSNR, four of SSIM.
#[test]
fn trivial_baselines_are_the_protocols() {
    let Some(photos) = common::shared("photos") else { return };
    let data = Benchmark::open(&photos, None).unwrap();
    assert_eq!(data.cases().len(), 16);
    assert!(data.notes().iter().any(|n| n.contains("pair_bananas")), "{:?}", data.notes());
    // The protocol's photographs of fox have their dark frame.
    let options = Options { rule: CropRule::Mvsplat, ..options(1, &[Method::Copy, Method::Mean]) };
    let evaluator = Evaluator::new(options);
    let scores = evaluator.run(None, &data).unwrap();
    let mut compared = 0;
    for (case, given) in scores.cases.iter().zip(data.cases()) {
        assert_eq!((case.sizes, case.enlarged), ([(256, 256); 2], false), "{}", case.scene);
        let file = photos.join(&case.scene).join("protocol.json");
        let protocol: serde_json::Value =
            serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        let tests = protocol["tests"].as_array().unwrap();
        let test = tests.iter().find(|t| t["context"] == serde_json::json!(given.views.context));
        for want in test.unwrap()["scores"].as_array().unwrap() {
            let target = case.targets.iter().find(|t| want["target"] == t.frame as u64).unwrap();
            for (i, name) in ["copy_nearest", "mean"].into_iter().enumerate() {
                let want = |figure: &str| want[format!("{name}_{figure}")].as_f64().unwrap();
                let got = target.scores[i];
                let place = format!("{} {} {name}", case.scene, target.frame);
                let off = (got.psnr - want("psnr")).abs();
                assert!(off <= 0.0101, "{place}: {} dB, {} expected", got.psnr, want("psnr"));
                let off = (got.ssim - want("ssim")).abs();
                assert!(off <= 0.0006, "{place}: {}, {} expected", got.ssim, want("ssim"));
                compared += 1;
            }
        }
    }
    assert_eq!(compared, 96);
    let best = |case: &subsplat_lab::eval::CaseScores| {
        case.mean(0).unwrap().psnr.max(case.mean(1).unwrap().psnr)
    };
    let mean = scores.cases.iter().map(best).sum::<f64>() / 16.0;
    println!("better of both: {mean:.2} dB");
    // The prototype's report says 13.8.
    assert!((mean - 13.8).abs() < 0.05, "{mean}");
}

/// Disturbances change what their names say, and leave the rest.
#[test]
fn disturbed_inputs_differ_by_name() {
    let place = room();
    let data = Benchmark::open(place.path(), None).unwrap();
    let model = untrained(2);
    let case = &data.cases()[0];
    let run = |disturbances: Vec<Disturbance>| {
        let options = Options { disturbances, ..options(2, &[Method::Backbone, Method::Mean]) };
        Evaluator::new(options).case(Some(&model), case, data.load(case).unwrap()).unwrap()
    };
    let psnr = |r: &CaseResult, m: usize| r.scores.targets[0].scores[m].psnr;
    let plain = run(Vec::new());
    for (name, disturbance) in Disturbance::NAMED {
        assert_eq!(disturbance.name(), name);
        let found = run(vec![disturbance]);
        assert_eq!(found.pictures[0].truth, plain.pictures[0].truth, "{name}");
        assert!((psnr(&found, 0) - psnr(&plain, 0)).abs() > 1e-3, "{name}: the Gaussians");
        let changed = [0, 1].map(|i| found.inputs[i] != plain.inputs[i]);
        let expected = match disturbance {
            Disturbance::Rotation | Disturbance::Position | Disturbance::Focal => [false, false],
            Disturbance::Jpeg => [true, true],
            _ => [false, true],
        };
        assert_eq!(changed, expected, "{name}");
        assert_eq!((psnr(&found, 1) - psnr(&plain, 1)).abs() > 1e-9, expected[1], "{name}");
    }
    let mean = |p: &Rgb| p.data.iter().map(|v| f64::from(*v)).sum::<f64>();
    let dark = run(vec![Disturbance::Dark]);
    let ratio = mean(&dark.inputs[1]) / mean(&plain.inputs[1]);
    // Half the light at exponent 2.2.
    assert!((ratio - 0.7297).abs() < 0.01, "{ratio}");
}

/// Inputs that are prepared as `run` prepares them come back from a wrong pose and a dark photograph.
#[test]
fn prepared_inputs_come_back_from_disturbances() {
    let data = Benchmark::open("../../examples/room".as_ref(), None).unwrap();
    let model = untrained(1);
    let case = &data.cases()[0];
    let run = |disturbance: Option<Disturbance>, preparation: Preparation| {
        let disturbances = disturbance.into_iter().collect();
        let input_size = Some((256, 256));
        let options =
            Options { disturbances, preparation, input_size, ..options(1, &[Method::Backbone]) };
        Evaluator::new(options).case(Some(&model), case, data.load(case).unwrap()).unwrap()
    };
    let psnr = |r: &CaseResult| r.scores.targets[0].scores[0].psnr;
    let grey = |p: &Rgb| p.data.iter().map(|v| f64::from(*v)).sum::<f64>() / p.data.len() as f64;
    let given = Preparation { poses: Poses::Given, equal_exposure: false };
    let adjusted = Preparation { poses: Poses::Adjusted, ..given };
    let equal = Preparation { equal_exposure: true, ..given };
    let plain = run(None, given);
    let loss = |disturbance: Disturbance, preparation: Preparation| {
        let found = run(Some(disturbance), preparation);
        (psnr(&plain) - psnr(&found), (grey(&plain.inputs[1]) - grey(&found.inputs[1])).abs())
    };
    let (wrong, back) = (loss(Disturbance::Rotation, given), loss(Disturbance::Rotation, adjusted));
    assert!(wrong.0 > 0.3 && back.0 < 0.6 * wrong.0, "rotation: {wrong:?} dB, {back:?}");
    let (wrong, back) = (loss(Disturbance::Position, given), loss(Disturbance::Position, adjusted));
    eprintln!("position: {wrong:?} dB, {back:?}");
    assert!(wrong.0 > 0.02 && back.0 < 0.6 * wrong.0, "position: {wrong:?} dB, {back:?}");
    let (wrong, back) = (loss(Disturbance::Dark, given), loss(Disturbance::Dark, equal));
    assert!(wrong.0 > 0.5 && back.0 < 0.2 * wrong.0, "dark: {wrong:?} dB, {back:?}");
    assert!(wrong.1 > 20.0 && back.1 < 2.0, "dark: {wrong:?}, {back:?} levels");
}

/// Every method that renders, against the pipeline's own functions by hand.
#[test]
fn methods_are_what_they_say() {
    let place = room();
    let data = Benchmark::open(place.path(), None).unwrap();
    let methods = [
        Method::Subsplat,
        Method::Detail,
        Method::Backbone,
        Method::Lowpass,
        Method::Bilinear,
        Method::Uniform,
        Method::Copy,
    ];
    let model = untrained(2);
    let evaluator = Evaluator::new(options(2, &methods));
    let case = &data.cases()[0];
    let result = evaluator.case(Some(&model), case, data.load(case).unwrap()).unwrap();
    assert_eq!(result.scores.sizes, [(64, 64), (128, 128)]);
    let got: Vec<f64> = result.scores.targets[0].scores.iter().map(|s| s.psnr).collect();
    println!("{got:?}");

    let scene = load_scene(place.path().join("scene")).unwrap();
    let photo = |i: usize| Photo::from_frame(&scene.frames[i]).unwrap();
    let crop = CropOptions::square(64, 2, 32);
    let truth = photo(1).crop(&crop).unwrap();
    let near = scene.near_far.unwrap().near;
    let request = |detail| {
        pipeline::Options::default()
            .with_input_size(64, 64)
            .with_depth_prior(DepthBounds::of_scene(&scene, &[0, 2]).unwrap())
            .with_check(Check::Off)
            .with_detail(detail)
            .with_fit(FitOptions::off())
    };
    let photos = [photo(0), photo(2)];
    let seen = |model: &Reconstructor, detail: Detail, lowpass: LowpassRef| {
        let made = model.run(&photos, &request(detail)).unwrap();
        let mut config = model.config().clone();
        config.upscale = 2;
        config.render.lowpass_ref = lowpass;
        let options = config.raster_options(2.0, near, colour(&made));
        let picture = render(made.splats(), &truth.target_camera, &options);
        psnr(&picture.rgb, &truth.target.to_unit(), 128, 128).unwrap()
    };
    let mut alone = Config::small(Preset::Tuned, 2);
    alone.spgr.enabled = false;
    let alone = Reconstructor::untrained(&alone, 0).unwrap();
    let expected = [
        seen(&model, Detail::Off, LowpassRef::Target),
        seen(&model, Detail::Photographs, LowpassRef::Target),
        seen(&alone, Detail::Off, LowpassRef::Target),
        seen(&alone, Detail::Off, LowpassRef::Input),
    ];
    for (i, want) in expected.iter().enumerate() {
        assert!((got[i] - want).abs() < 1e-6, "{}: {} {want}", methods[i].name(), got[i]);
    }
    // Four times a pixel's middle is ¾ of it and ¼ of the neighbour's, each way.
    let made = alone.run(&photos, &request(Detail::Off)).unwrap();
    let rules = alone.config().raster_options(1.0, near, colour(&made));
    let small = render(made.splats(), &truth.input_camera, &rules).rgb;
    let mut large = Vec::new();
    for i in 0..128usize * 128 {
        let (x, y) = (i % 128, i / 128);
        let beside = |v: usize| {
            if v.is_multiple_of(2) { (v / 2).saturating_sub(1) } else { (v / 2 + 1).min(63) }
        };
        for c in 0..3 {
            let at = |x: usize, y: usize| small[3 * (64 * y + x) + c];
            let row = |y: usize| 0.75 * at(x / 2, y) + 0.25 * at(beside(x), y);
            large.push(0.75 * row(y / 2) + 0.25 * row(beside(y)));
        }
    }
    let want = psnr(&large, &truth.target.to_unit(), 128, 128).unwrap();
    assert!((got[4] - want).abs() < 1e-4, "{} {want}", got[4]);
    // Untrained heads are closed: the model is the even split.
    assert!((got[5] - got[0]).abs() < 1e-6);
    // All others differ from one another.
    for i in 0..got.len() {
        for j in 0..i {
            let same = (got[i] - got[j]).abs() < 1e-3;
            assert_eq!(same, (i, j) == (5, 0), "{} {}", methods[i].name(), methods[j].name());
        }
    }
    let sharp: Vec<f64> =
        result.scores.targets[0].scores.iter().map(|s| s.sharpness.unwrap()).collect();
    println!("sharpness {sharp:?}");
    // The inputs' own cameras, by hand.
    let made = model.run(&photos, &request(Detail::Photographs)).unwrap();
    let rules = model.config().raster_options(2.0, near, colour(&made));
    let (mut want, mut alpha) = (0.0, 0.0f64);
    for input in made.inputs() {
        let picture = render(made.splats(), &input.target_camera, &rules);
        want += psnr(&picture.rgb, &input.target.to_unit(), 128, 128).unwrap() / 2.0;
        let sum: f64 = picture.alpha.iter().copied().map(f64::from).sum();
        alpha += sum / (2.0 * 128.0 * 128.0);
    }
    let reports = &result.scores.inputs;
    assert!((reports[1].inputs.unwrap().psnr - want).abs() < 1e-6);
    let [children, parents] = [1, 2].map(|m| reports[m].gaussians.unwrap());
    assert!((children.coverage - alpha).abs() < 1e-9, "{children:?} {alpha}");
    assert_eq!((children.count, parents.count), (4.0 * 2.0 * 4096.0, 2.0 * 4096.0));
    // Children of the even split have half the size of their parents.
    let ratio = parents.sigma_px[1] / children.sigma_px[1];
    assert!((1.9..2.1).contains(&ratio), "{ratio}");
    assert_eq!(reports[6], InputReport::default());
    assert!(sharp[1] > sharp[0] && sharp[4] < 1.0, "{sharp:?}");

    // At ×1 one Gaussian a pixel is all there is.
    let one =
        [Method::Subsplat, Method::Backbone, Method::Lowpass, Method::Bilinear, Method::Uniform];
    let scores = Evaluator::new(options(1, &one)).run(Some(&untrained(1)), &data).unwrap();
    let first = scores.mean("backbone").unwrap().psnr;
    assert!(one.iter().all(|m| (scores.mean(m.name()).unwrap().psnr - first).abs() < 1e-3));
    // A model for ×2 serves a target of the input's size, and one four times as large.
    for (r, side) in [(1, 64), (4, 128)] {
        let scores =
            Evaluator::new(options(r, &[Method::Subsplat])).run(Some(&model), &data).unwrap();
        assert_eq!(scores.cases[0].sizes[1], (side, side));
        assert!(scores.mean("subsplat").unwrap().psnr > 8.0);
    }
}

#[test]
fn lpips_is_the_references() {
    let Some(golden) = common::shared("golden/metrics_lpips_randvgg.safetensors") else { return };
    let (tensors, _) = read_tensors(&golden).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vgg.safetensors");
    let data: BTreeMap<String, (Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .filter(|(n, _)| n.starts_with("w.net.") || n.starts_with("w.lin"))
        .map(|(name, t)| {
            let values = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            (name[2..].to_owned(), (t.dims().to_vec(), bytes))
        })
        .collect();
    let views = data.iter().map(|(name, (shape, bytes))| {
        let kind = safetensors::Dtype::F32;
        (name, safetensors::tensor::TensorView::new(kind, shape.clone(), bytes).unwrap())
    });
    std::fs::write(&file, safetensors::serialize(views, None).unwrap()).unwrap();
    let lpips = Lpips::load(&file).unwrap();
    let (_, _, h, w) = tensors["pred"].dims4().unwrap();
    let wanted = tensors["lpips"].to_vec1::<f32>().unwrap();
    for (i, want) in wanted.iter().enumerate() {
        let picture = |name: &str| {
            let t = tensors[name].get(i).unwrap().permute((1, 2, 0)).unwrap();
            t.contiguous().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let got = lpips.distance(&picture("pred"), &picture("gt"), w, h).unwrap();
        assert!((got - f64::from(*want)).abs() < 1e-5 * f64::from(*want), "{got} {want}");
    }
    // And in the evaluator; without it the figure is missing.
    let place = room();
    let data = Benchmark::open(place.path(), None).unwrap();
    let evaluator = || Evaluator::new(options(1, &[Method::Copy]));
    let with = evaluator().with_lpips(&file).unwrap().run(None, &data).unwrap();
    assert!(with.mean("copy").unwrap().lpips.unwrap() > 0.0);
    assert_eq!(evaluator().run(None, &data).unwrap().mean("copy").unwrap().lpips, None);
    let e = evaluator().with_lpips(&folder.path().join("none")).err().unwrap().to_string();
    assert!(e.contains("none"), "{e}");
    let weights = folder.path().join("other.safetensors");
    std::fs::write(&weights, safetensors::serialize([("a", &Scalar)], None).unwrap()).unwrap();
    let e = evaluator().with_lpips(&weights).err().unwrap().to_string();
    assert!(e.contains("other.safetensors") && e.contains("net.slice1"), "{e}");
}

struct Scalar;

impl safetensors::View for &Scalar {
    fn dtype(&self) -> safetensors::Dtype {
        safetensors::Dtype::F32
    }
    fn shape(&self) -> &[usize] {
        &[1]
    }
    fn data(&self) -> std::borrow::Cow<'_, [u8]> {
        std::borrow::Cow::Borrowed(&[0; 4])
    }
    fn data_len(&self) -> usize {
        4
    }
}

fn chunks(index: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write(&folder.path().join("test"), &[&[video("m", 6)], &[video("b", 8), video("c", 4)]]);
    std::fs::write(folder.path().join("views.json"), index).unwrap();
    folder
}

/// Only copying, inputs of 32 pixels.
fn copying(folder: &Path, methods: &[Method]) -> Result<Scores, String> {
    let index = folder.join("views.json");
    let data = Benchmark::open(folder, Some(&index)).map_err(|e| e.to_string())?;
    let options = Options { input_size: Some((32, 32)), ..options(1, methods) };
    Evaluator::new(options).run(None, &data).map_err(|e| e.to_string())
}

#[test]
fn chunks_with_an_index_are_cases() {
    let folder = chunks(
        r#"{"c": {"context": [0, 3], "target": [1, 2]}, "x": {"context": [0, 1], "target": [0]},
            "b": null, "m": {"context": [0, 5], "target": [1, 5]}}"#,
    );
    let index = folder.path().join("views.json");
    let mut data = Benchmark::open(folder.path(), Some(&index)).unwrap();
    // Chunk by chunk.
    let names = |d: &Benchmark| d.cases().iter().map(|c| c.scene.clone()).collect::<Vec<_>>();
    assert_eq!((names(&data), data.is_chunks()), (vec!["m".to_owned(), "c".to_owned()], true));
    assert_eq!(
        data.notes(),
        ["of 4 entries of the index 1 have no views and 1 are not in the data; 2 are evaluated"]
    );
    let loaded = data.load(&data.cases()[0]).unwrap();
    assert_eq!((loaded.bounds.near, loaded.bounds.far), (1.0, 100.0));
    assert_eq!(*loaded.targets[1].image(), frame(&video("m", 6), 5));
    data.set_depth_range(DepthRange::Near(0.5));
    assert_eq!(data.load(&data.cases()[1]).unwrap().bounds.near, 0.5);
    data.set_depth_range(DepthRange::Near(500.0));
    assert!(data.load(&data.cases()[1]).err().unwrap().to_string().contains("near < far"));
    data.limit(1);
    assert_eq!(names(&data), ["m"]);
    let scores = copying(folder.path(), &[Method::Copy, Method::Mean]).unwrap();
    // Target 5 is an input: its copy is itself.
    assert_eq!(scores.cases[0].targets[1].scores[0].psnr, f64::INFINITY);
    assert_eq!(scores.cases[0].targets[1].scores[0].sharpness, Some(1.0));
    assert!(scores.cases[0].targets[0].scores[0].psnr < 40.0);
}

#[test]
fn pictures_of_other_programs_are_found_in_their_layouts() {
    let folder = chunks(r#"{"c": {"context": [0, 3], "target": [1]}}"#);
    let other = folder.path().join("other");
    let method = || Method::Other { name: "x".to_owned(), folder: other.clone() };
    let e = copying(folder.path(), &[method()]).unwrap_err();
    assert!(e.contains("000001.png") && e.contains("0_3"), "{e}");
    let white = Rgb { width: 32, height: 32, data: vec![255; 3 * 32 * 32] };
    let mut found = Vec::new();
    // The last place first: each further file stands before it.
    for (i, place) in ["c/000001.png", "c/color/000001.png", "c/0_3/000001.png"].iter().enumerate()
    {
        let file = other.join(place);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        let mut picture = white.clone();
        picture.data[..300 * i].fill(0);
        save_png(&file, &picture).unwrap();
        found.push(copying(folder.path(), &[method()]).unwrap().mean("x").unwrap().psnr);
    }
    assert!(found[0] != found[1] && found[1] != found[2], "{found:?}");
    save_png(other.join("c/0_3/000001.png"), &Rgb::black(31, 32)).unwrap();
    let e = copying(folder.path(), &[method()]).unwrap_err();
    assert!(e.contains("expected 32x32, got 31x32"), "{e}");
}

#[test]
fn what_cannot_be_evaluated_is_named() {
    let refused = |index: &str, words: &[&str]| {
        let folder = chunks(index);
        let e = copying(folder.path(), &[Method::Copy]).unwrap_err();
        for word in words {
            assert!(e.contains(word), "`{word}` is not in: {e}");
        }
    };
    refused(r#"{"m": {"context": [0, 6], "target": [1]}}"#, &["000000.torch", "`m`", "below 6"]);
    refused(r#"{"m": {"context": [0], "target": [1]}}"#, &["scene m", "at least 2 context"]);
    refused(r#"{"m": {"context": [0, 1], "target": []}}"#, &["scene m", "a target"]);
    refused(r#"{"x": {"context": [0, 1], "target": [2]}}"#, &["scenes that", "views.json", "none"]);
    refused("[]", &["views.json", "an evaluation index"]);
    let folder = chunks("{}");
    let e = Benchmark::open(folder.path(), None).unwrap_err().to_string();
    assert!(e.contains("an evaluation index") && e.contains("--index"), "{e}");
    // Two frames leave no target.
    let place = program::workplace();
    let cameras = place.path().join("scene/cameras.json");
    let mut json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&cameras).unwrap()).unwrap();
    json["frames"].as_array_mut().unwrap().pop();
    std::fs::write(&cameras, json.to_string()).unwrap();
    let e = Benchmark::open(place.path(), None).unwrap_err().to_string();
    assert!(e.contains("protocol.json") && e.contains("at least 3 frames"), "{e}");
    let place = room();
    let data = Benchmark::open(place.path(), None).unwrap();
    let e = Evaluator::new(Options::new(2.0)).run(None, &data).unwrap_err().to_string();
    assert!(e.contains("subsplat: expected a model"), "{e}");
    let protocol = r#"{"tests": [{"context": [0, 2], "target": [3]}]}"#;
    std::fs::write(place.path().join("scene/protocol.json"), protocol).unwrap();
    let e = Benchmark::open(place.path(), None).unwrap_err().to_string();
    assert!(e.contains("protocol.json") && e.contains("below 3"), "{e}");
}

/// Without a protocol: the pair that `run` chooses, and every k-th frame between the two.
#[test]
fn a_scene_without_a_protocol_gets_a_case() {
    let place = program::workplace();
    let scene = load_scene(place.path().join("scene")).unwrap();
    let pair = choose_pair(&scene).unwrap().frames;
    let data = Benchmark::open(place.path(), None).unwrap();
    let [case] = data.cases() else { panic!("{:?}", data.cases()) };
    assert_eq!(case.views.context, pair);
    let other = (0..3).find(|i| !pair.contains(i)).unwrap();
    assert_eq!(case.views.target, [other]);
    let notes = data.notes();
    assert!(notes.len() == 1 && notes[0].contains("scene has no protocol.json"), "{notes:?}");
    assert!(notes[0].contains(&format!("inputs are frames {} and {}", pair[0], pair[1])));
    // A protocol of another scene: this one is skipped, as before.
    let both = room();
    let folder = both.path().join("other");
    std::fs::rename(place.path().join("scene"), &folder).unwrap();
    let data = Benchmark::open(both.path(), None).unwrap();
    assert_eq!(data.cases().len(), 1);
    assert_eq!(data.notes(), ["skipped, without tests: other"]);
    // Twenty frames along a line: targets are 1 in 2 to 3 between the two inputs, none beside them.
    let (folder, mut cameras) = made_up::made_up(20);
    for (i, c) in cameras.iter_mut().enumerate() {
        let pose = Mat4::from_translation(Vec3::new(0.02 * i as f32, 0.0, 0.0));
        c.camera = Camera::new(cameras_intrinsics(), pose).unwrap();
    }
    let near_far = Some(NearFar::new(1.0, 4.0));
    let content =
        CameraFile { cameras, units: Units::RealEstate10k, near_far, ..Default::default() };
    save_cameras_json(folder.path().join("cameras.json"), &content).unwrap();
    let data = Benchmark::open(folder.path(), None).unwrap();
    let views = &data.cases()[0].views;
    let between = views.context[1] - views.context[0] - 1;
    let step = between.div_ceil(8);
    assert!(between > 8, "{views:?}");
    let steps: Vec<usize> = views.target.windows(2).map(|t| t[1] - t[0]).collect();
    assert!(steps.iter().all(|s| *s == step), "{views:?}");
    assert!(views.target[0] > views.context[0] && *views.target.last().unwrap() < views.context[1]);
    assert_eq!(views.target.len(), (between - (step - 1) / 2).div_ceil(step));
}

fn cameras_intrinsics() -> Intrinsics {
    Intrinsics { fx: 70.0, fy: 70.0, cx: 32.0, cy: 24.0, width: 64, height: 48 }
}

/// The reference's own synthetic data set, through its own index.
#[test]
fn the_synthetic_re10k_is_evaluated() {
    let Some(folder) = common::shared("golden/re10k_synth") else { return };
    let index = folder.join("evaluation_index_synth.json");
    let data = Benchmark::open(&folder, Some(&index)).unwrap();
    assert_eq!(data.cases().len(), 1);
    let scores =
        Evaluator::new(options(1, &[Method::Copy, Method::Mean])).run(None, &data).unwrap();
    assert_eq!(scores.cases[0].targets.len(), 3);
    println!("{:?} {:?}", scores.mean("copy"), scores.mean("mean"));
    assert!(scores.mean("mean").unwrap().psnr > 8.0);
}
