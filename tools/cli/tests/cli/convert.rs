//! `subsplat-convert` from outside: checkpoints in, weights out, number for number.

use crate::program;
use subsplat_test_support as common;
use subsplat_test_support::checkpoints;

use checkpoints::{Item, floats, saved};
use common::shared;
use half::{bf16, f16};
use program::{Called, called};
use safetensors::Dtype;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use subsplat::Backend;
use subsplat::files::weights::tensors::{TensorFile, TensorSpec, write_tensors};
use subsplat::network::config::{Backbone, Config, Preset, SpgrHead};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::{Weights, read_tensors, save};
use subsplat_lab::compare::compare;
use subsplat_lab::lpips::Lpips;

/// Name to shape and elements.
type Content = BTreeMap<String, (Vec<usize>, Vec<u8>)>;

fn convert(folder: &Path, arguments: &str) -> Called {
    let mut command = Command::new(env!("CARGO_BIN_EXE_subsplat-convert"));
    called(command.args(arguments.split_whitespace()).current_dir(folder))
}

/// The report of a conversion that must work.
#[track_caller]
fn converted(folder: &Path, arguments: &str) -> Value {
    let called = convert(folder, &format!("--json {arguments}"));
    assert_eq!(called.code, 0, "{arguments}: {}", called.stderr);
    called.json()
}

/// All tensors, which must be of this type.
#[track_caller]
fn content(path: &Path, dtype: Dtype) -> Content {
    let file = TensorFile::open(path).unwrap();
    let one = |spec: TensorSpec| {
        assert_eq!(spec.dtype, dtype, "{}", spec.name);
        let bytes = file.read(&spec.name).unwrap();
        (spec.name, (spec.shape, bytes))
    };
    file.specs().into_iter().map(one).collect()
}

fn items<'a>(
    tensors: impl IntoIterator<Item = (&'a String, &'a (Vec<usize>, Vec<u8>))>,
) -> Vec<(String, Item)> {
    let item = |(name, (shape, bytes)): (&String, &(Vec<usize>, Vec<u8>))| {
        (name.clone(), Item::Tensor("torch FloatStorage", shape.clone(), bytes.clone()))
    };
    tensors.into_iter().map(item).collect()
}

/// A checkpoint of Lightning around a state dict, with optimizer states for the first `states`.
fn lightning(weights: Vec<(String, Item)>, states: usize) -> Item {
    let moments = |i: usize| {
        let zeros = || floats(&[2, 2], &[0.0; 4]);
        let state = [("step", floats(&[], &[9.0])), ("exp_avg", zeros()), ("exp_avg_sq", zeros())];
        (i.to_string(), Item::Dict(state.map(|(k, v)| (k.to_owned(), v)).into()))
    };
    let optimizer = Item::Dict(vec![
        ("state".into(), Item::Dict((0..states).map(moments).collect())),
        (
            "param_groups".into(),
            Item::List(vec![Item::Dict(vec![("lr".into(), Item::Float(2e-4))])]),
        ),
    ]);
    let callback = Item::Dict(vec![
        ("dirpath".into(), Item::Object("pathlib PosixPath")),
        ("best_model_score".into(), Item::None),
    ]);
    Item::Dict(vec![
        ("epoch".into(), Item::Int(3)),
        ("global_step".into(), Item::Int(300_000)),
        ("pytorch-lightning_version".into(), Item::Text("2.2.4".into())),
        ("state_dict".into(), Item::StateDict(weights)),
        ("callbacks".into(), Item::Dict(vec![("ModelCheckpoint".into(), callback)])),
        ("optimizer_states".into(), Item::List(vec![optimizer])),
    ])
}

/// MVSplat's reference weights: all 471.
fn mvsplat() -> Option<Content> {
    Some(content(&shared("golden/mvsplat_weights.safetensors")?, Dtype::F32))
}

#[test]
fn a_thinned_checkpoint_of_lightning() {
    let Some(checkpoint) = shared("golden/mvsplat_lightning_partial.ckpt") else { return };
    let Some(all) = mvsplat() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = checkpoint.display();
    let called = convert(folder.path(), &format!("{path} w.safetensors"));
    assert_eq!(called.code, 1);
    for named in ["471", "137", "mvsplat", "--allow-missing"] {
        assert!(called.error().contains(named), "{}", called.error());
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

    let report = converted(folder.path(), &format!("{path} w.safetensors --allow-missing"));
    let ours = content(&folder.path().join("w.safetensors"), Dtype::F32);
    assert_eq!(ours.len(), 137);
    assert!(ours.iter().all(|(name, tensor)| all.get(name) == Some(tensor)));
    assert_eq!((&report["kind"], &report["recognised"]), (&"mvsplat".into(), &true.into()));
    assert_eq!(report["missing"].as_array().unwrap().len(), 471 - 137);
    assert_eq!(report["unexpected"].as_array().unwrap().len(), 0);
    assert_eq!(report["inputs"][0]["weights_at"], "state_dict");
    // Counted by PyTorch itself.
    let beside = serde_json::json!({ "tensors": 16, "bytes": 468_512 });
    assert_eq!(report["inputs"][0]["beside"], beside);
}

#[test]
fn a_whole_checkpoint_is_the_same_model() {
    let Some(all) = mvsplat() else { return };
    let Some(reference) = shared("golden/mvsplat_64x64_b1v2.safetensors") else { return };
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = saved(&lightning(items(&all), 50));
    std::fs::write(folder.path().join("re10k.ckpt"), &checkpoint).unwrap();
    let report = converted(folder.path(), "re10k.ckpt w.safetensors");
    let out = folder.path().join("w.safetensors");
    assert!(content(&out, Dtype::F32) == all, "not bit for bit the same");
    assert_eq!((&report["tensors"], &report["parameters"]), (&471.into(), &11_955_734.into()));
    assert_eq!(report["dtypes_in"], serde_json::json!({ "f32": 471 }));
    assert_eq!(report["inputs"][0]["beside"], serde_json::json!({ "tensors": 150, "bytes": 1800 }));
    assert_eq!(report["inputs"][0]["opaque_globals"], serde_json::json!(["pathlib.PosixPath"]));
    let config = TensorFile::open(&out).unwrap();
    let config = config.metadata(Config::METADATA_KEY).unwrap();
    assert_eq!(Config::from_json(config).unwrap(), Config::re10k(Preset::Tuned, 2));
    // One tensor at a time: what the process takes is its code and the largest tensor.
    if let Some(peak) = report["peak_memory_bytes"].as_u64() {
        let bytes = checkpoint.len() as u64;
        eprintln!("peak {peak} bytes for a checkpoint of {bytes}");
        assert!(peak < bytes / 2, "{peak} bytes for a checkpoint of {bytes}");
    }

    let weights = Weights::load(&out).unwrap();
    let report = compare(&weights, reference.as_ref(), &Backend::Cpu).unwrap();
    assert!(report.ok());
}

#[test]
fn half_precision_rounds_and_loads() {
    let Some(all) = mvsplat() else { return };
    let weights = shared("golden/mvsplat_weights.safetensors").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let whole = |short: &str| {
        let name = format!("{short}.safetensors");
        let report =
            converted(folder.path(), &format!("{} {name} --dtype {short}", weights.display()));
        assert_eq!(report["dtype"], short);
        let (tensors, _) = read_tensors(&folder.path().join(name)).unwrap();
        assert_eq!(tensors.len(), 471);
        tensors
    };
    let (short, brief) = (whole("f16"), whole("bf16"));
    let mut rounded = 0;
    for (name, (shape, bytes)) in &all {
        assert_eq!((short[name].dims(), brief[name].dims()), (&shape[..], &shape[..]));
        let values = |t: &candle_core::Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (short, brief) = (values(&short[name]), values(&brief[name]));
        for (i, b) in bytes.chunks_exact(4).enumerate() {
            let v = f32::from_le_bytes(b.try_into().unwrap());
            assert_eq!(short[i], f16::from_f32(v).to_f32());
            assert_eq!(brief[i], bf16::from_f32(v).to_f32());
            rounded += usize::from(short[i] != v);
        }
    }
    assert!(rounded > 1_000_000, "{rounded}");
    let length = |n: &str| std::fs::metadata(folder.path().join(n)).unwrap().len();
    assert!(length("f16.safetensors") < 24_000_000 + 200_000);
    assert_eq!(
        Weights::load(&folder.path().join("bf16.safetensors")).unwrap().tensors().len(),
        471
    );
}

#[test]
fn gmdepth_gives_the_start_of_cnn_and_transformer() {
    let Some(mut all) = mvsplat() else { return };
    all.retain(|name, _| name.starts_with("encoder.backbone."));
    let short = |name: &str| name.strip_prefix("encoder.backbone.").unwrap().to_owned();
    let mut model: Vec<_> = items(&all).into_iter().map(|(n, item)| (short(&n), item)).collect();
    model.push(("feature_flow_attn.q_proj.weight".into(), floats(&[2, 2], &[1.0; 4])));
    model.push(("upsampler.0.bias".into(), floats(&[2], &[1.0; 2])));
    let file = Item::Dict(vec![
        ("model".into(), Item::StateDict(model)),
        ("optimizer".into(), Item::Dict(vec![("state".into(), floats(&[3], &[0.0; 3]))])),
    ]);
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("gmdepth.pth"), saved(&file)).unwrap();
    let report = converted(folder.path(), "gmdepth.pth w.safetensors");
    assert!(content(&folder.path().join("w.safetensors"), Dtype::F32) == all);
    assert_eq!((&report["kind"], &report["parameters"]), (&"gmdepth".into(), &4_199_456.into()));
    assert_eq!(report["not_needed"].as_array().unwrap().len(), 2);
    assert_eq!(report["inputs"][0]["weights_at"], "model");
    assert_eq!(report["config"], Value::Null);
    // A converted start is recognised again.
    let again = converted(folder.path(), "w.safetensors again.safetensors");
    assert_eq!(again["kind"], "gmdepth");
    assert!(content(&folder.path().join("again.safetensors"), Dtype::F32) == all);
}

/// The reference's LPIPS weights under the package's names, as f32.
fn lpips() -> Option<Content> {
    let (tensors, _) = read_tensors(&shared("golden/metrics_lpips_randvgg.safetensors")?).unwrap();
    let plain = tensors.into_iter().filter_map(|(name, t)| {
        let name = name.strip_prefix("w.")?.to_owned();
        let values = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Some((name, (t.dims().to_vec(), bytes)))
    });
    Some(plain.collect())
}

#[test]
fn lpips_comes_from_vgg_and_linear_weights_or_whole() {
    let Some(mut all) = lpips() else { return };
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let save = |name: &str, tensors: Vec<(String, Item)>| {
        std::fs::write(place.join(name), saved(&Item::StateDict(tensors))).unwrap();
    };
    // The package's own, with its constants and the second names of its linear weights.
    let mut whole = items(&all);
    whole.push(("lins.0.model.1.weight".into(), floats(&[1, 64, 1, 1], &[0.5; 64])));
    save("lpips.pth", whole);
    let report = converted(place, "lpips.pth whole.safetensors");
    assert_eq!(report["not_needed"].as_array().unwrap().len(), 3);
    all.retain(|name, _| !name.starts_with("scaling_layer"));
    assert!(content(&place.join("whole.safetensors"), Dtype::F32) == all);

    // torchvision's trunk and the published linear weights.
    let linear: Vec<_> = items(all.iter().filter(|(n, _)| n.starts_with("lin")));
    let trunk = items(all.iter().filter(|(n, _)| n.starts_with("net.")));
    let theirs = |name: &str| format!("features.{}", name.splitn(3, '.').nth(2).unwrap());
    let mut trunk: Vec<_> = trunk.into_iter().map(|(n, item)| (theirs(&n), item)).collect();
    trunk.push(("classifier.6.bias".into(), floats(&[3], &[0.0; 3])));
    save("vgg16.pth", trunk);
    save("vgg.pth", linear);
    let refused = convert(place, "vgg16.pth w.safetensors");
    assert!(refused.code == 1 && refused.error().contains("--lpips-linear"), "{}", refused.stderr);
    let report = converted(place, "vgg16.pth w.safetensors --lpips-linear vgg.pth");
    assert!(content(&place.join("w.safetensors"), Dtype::F32) == all);
    assert_eq!(
        (&report["kind"], &report["not_needed"][0]),
        (&"lpips".into(), &"classifier.6.bias".into())
    );
    assert_eq!(report["inputs"].as_array().unwrap().len(), 2);
    let weights = Weights::load(&place.join("w.safetensors")).unwrap();
    Lpips::new(weights.builder()).unwrap();
    assert_eq!(weights.unexpected(), [""; 0]);

    // A trunk in f16 beside linear weights in f32, behind a prefix.
    let golden = shared("golden/metrics_lpips_randvgg.safetensors").unwrap();
    let report = converted(place, &format!("{} p.safetensors --prefix w.", golden.display()));
    assert_eq!(report["dtypes_in"], serde_json::json!({ "f16": 26, "f32": 5 }));
    assert!(content(&place.join("p.safetensors"), Dtype::F32) == all);
}

/// A whole seeded model, saved by the library.
fn own(folder: &Path, config: &Config) -> BTreeMap<String, candle_core::Tensor> {
    let weights = Weights::seeded(3).trainable();
    SubSplat::new(config, weights.builder()).unwrap();
    let tensors: BTreeMap<_, _> =
        weights.variables().into_iter().map(|(n, v)| (n, v.as_detached_tensor())).collect();
    save(&folder.join("own.safetensors"), &tensors, config).unwrap();
    tensors
}

#[test]
fn our_own_weights_pass_through_with_their_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let mut config = Config::small(Preset::Paper, 4);
    config.spgr.beta_z = 0.125;
    let tensors = own(place, &config);
    let report = converted(place, "own.safetensors w.safetensors --strict");
    assert_eq!(report["kind"], "subsplat");
    let weights = Weights::load(&place.join("w.safetensors")).unwrap();
    assert_eq!(weights.config(), Some(&config));
    let before = content(&place.join("own.safetensors"), Dtype::F32);
    assert!(
        content(&place.join("w.safetensors"), Dtype::F32) == before
            && before.len() == tensors.len()
    );

    // A PyTorch file says nothing of a configuration: it is told from names and shapes.
    std::fs::write(place.join("own.pt"), saved(&Item::StateDict(items(&before)))).unwrap();
    let told = |arguments: &str| {
        let report = converted(place, &format!("own.pt told.safetensors --force {arguments}"));
        Config::from_json(&report["config"].to_string()).unwrap()
    };
    assert_eq!(told(""), Config::small(Preset::Paper, 4));
    std::fs::write(place.join("c.json"), config.to_json().unwrap()).unwrap();
    assert_eq!(told("--config c.json"), config);
    // Another preset has other tensors, another r another head.
    for arguments in ["--preset tuned", "--upscale 2"] {
        let called = convert(place, &format!("own.pt told.safetensors --force {arguments}"));
        assert!(called.code == 1 && called.error().contains("expected"), "{}", called.stderr);
    }
}

/// `--upscale` and `--preset` change what they say, and nothing else of what IN says.
#[test]
fn a_configuration_that_comes_along_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let mut config = Config::small(Preset::Tuned, 2);
    config.spgr.beta_z = 0.125;
    if let Backbone::Small(b) = &mut config.backbone {
        (b.mode_window, b.cross_check, b.primaries.scale_max) = (5, !b.cross_check, 11.0);
    }
    let told = |arguments: &str| {
        let report = converted(place, &format!("own.safetensors told.safetensors {arguments}"));
        Config::from_json(&report["config"].to_string()).unwrap()
    };
    own(place, &config);
    assert_eq!(told("--upscale 2"), config);
    let preset = told("--preset tuned --force");
    assert_eq!(preset, config.with_preset(Preset::Tuned, 2));
    assert!(preset.backbone == config.backbone && preset.spgr.beta_z != 0.125);
    // One head for any K.
    config.spgr.head = SpgrHead::Coord;
    own(place, &config);
    assert_eq!(told("--upscale 4 --force"), Config { upscale: 4, ..config });
}

#[test]
fn a_bare_backbone_becomes_a_model_only_when_asked() {
    let Some(weights) = shared("golden/mvsplat_weights.safetensors") else { return };
    let folder = tempfile::tempdir().unwrap();
    let arguments = format!("{} w.safetensors --kind subsplat", weights.display());
    let called = convert(folder.path(), &arguments);
    assert!(called.code == 1 && called.error().contains("`subsplat."), "{}", called.stderr);
    let allowed = format!("{arguments} --allow-missing --preset paper --upscale 4");
    let report = converted(folder.path(), &allowed);
    assert_eq!((&report["tensors"], &report["recognised"]), (&471.into(), &false.into()));
    let missing = report["missing"].as_array().unwrap();
    assert!(
        !missing.is_empty() && missing.iter().all(|n| n.as_str().unwrap().starts_with("subsplat."))
    );
    let weights = Weights::load(&folder.path().join("w.safetensors")).unwrap();
    assert_eq!(weights.config(), Some(&Config::x4()));
}

/// The five linear weights of LPIPS: a small file of a known kind.
fn small() -> Vec<(String, Item)> {
    let one = |(i, c): (usize, usize)| {
        (format!("lin{i}.model.1.weight"), floats(&[1, c, 1, 1], &vec![0.25; c]))
    };
    [64, 128, 256, 512, 512].into_iter().enumerate().map(one).collect()
}

/// The same with `name` replaced, or added.
fn changed(name: &str, item: Item) -> Item {
    let mut tensors = small();
    tensors.retain(|(n, _)| n != name);
    tensors.push((name.to_owned(), item));
    Item::StateDict(tensors)
}

#[test]
fn bad_input_gets_one_clear_error() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let first = "lin0.model.1.weight";
    let of = |value: f32| {
        let mut values = vec![0.5; 64];
        values[63] = value;
        floats(&[1, 64, 1, 1], &values)
    };
    let put = |name: &str, item: &Item| std::fs::write(place.join(name), saved(item)).unwrap();
    put("good.pt", &Item::StateDict(small()));
    put("nan.pt", &changed(first, of(f32::NAN)));
    put("big.pt", &changed(first, of(1e5)));
    put("shape.pt", &changed(first, floats(&[64, 1], &[0.5; 64])));
    put(
        "int.pt",
        &changed(first, Item::Tensor("torch LongStorage", vec![1, 64, 1, 1], vec![0; 512])),
    );
    put("object.pt", &changed(first, Item::Object("os system")));
    put("extra.pt", &changed("head.weight", floats(&[1], &[0.0])));
    put("module.pt", &Item::Object("torchvision.models.vgg VGG"));
    put("other.pt", &changed(first, of(0.0)));
    put("foreign.pt", &Item::StateDict(vec![("fc.weight".into(), floats(&[1], &[0.0]))]));
    put("list.pt", &Item::List(vec![floats(&[1], &[0.0])]));
    put("trunk.pt", &Item::StateDict(vec![("features.0.bias".into(), floats(&[64], &[0.0; 64]))]));
    std::fs::write(place.join("text.ckpt"), "this is no checkpoint").unwrap();
    std::fs::write(place.join("bad.safetensors"), [9; 40]).unwrap();
    std::fs::write(place.join("old.safetensors"), "old").unwrap();
    std::fs::write(place.join("c.json"), "{}").unwrap();
    let good = std::fs::read(place.join("good.pt")).unwrap();
    std::fs::write(place.join("cut.pt"), &good[..good.len() - 700]).unwrap();

    let before = program::files(place);
    let rows = [
        ("nowhere.ckpt w.safetensors", "nowhere.ckpt"),
        ("good.pt w.ckpt", ".safetensors"),
        ("good.pt old.safetensors --allow-missing", "--force"),
        ("old.safetensors old.safetensors --force", "the input"),
        ("good.pt missing/w.safetensors --allow-missing", "missing/w.safetensors"),
        ("good.pt good.pt/w.safetensors --allow-missing", "good.pt/w.safetensors"),
        ("good.pt w.safetensors", "`net.slice1.0.bias`"),
        ("good.pt w.safetensors --kind mvsplat", "look like lpips"),
        ("good.pt w.safetensors --kind gmdepth --allow-missing", "look like lpips"),
        ("good.pt w.safetensors --prefix module.", "--prefix"),
        ("good.pt w.safetensors --allow-missing --preset paper", "--preset"),
        ("good.pt w.safetensors --kind mvsplat --config c.json", "c.json"),
        ("good.pt w.safetensors --kind mvsplat --upscale 99", "--upscale"),
        (
            "nan.pt w.safetensors --allow-missing",
            "`lin0.model.1.weight`: expected finite numbers, got NaN at element 63",
        ),
        (
            "big.pt w.safetensors --allow-missing --dtype f16",
            "the range of f16, got 1e5 at element 63",
        ),
        ("shape.pt w.safetensors --allow-missing", "expected shape [1, 64, 1, 1], got [64, 1]"),
        ("int.pt w.safetensors --allow-missing", "int64"),
        ("object.pt w.safetensors --allow-missing", "an object of os.system"),
        ("extra.pt w.safetensors --allow-missing --strict", "`head.weight`"),
        ("module.pt w.safetensors", "state_dict()"),
        ("foreign.pt w.safetensors", "`fc.weight`"),
        ("list.pt w.safetensors", "a list of 1"),
        ("trunk.pt w.safetensors --allow-missing --lpips-linear nowhere", "nowhere"),
        ("good.pt w.safetensors --allow-missing --lpips-linear other.pt", "again"),
        ("text.ckpt w.safetensors", "text.ckpt"),
        ("cut.pt w.safetensors", "cut.pt"),
        ("bad.safetensors w.safetensors", "a safetensors file"),
    ];
    for (arguments, named) in rows {
        let called = convert(place, &format!("--json {arguments}"));
        assert_eq!(called.code, 1, "{arguments}: {}", called.stderr);
        let error = called.error();
        assert!(error.contains(named), "{arguments}: expected `{named}` in: {error}");
        assert_eq!(format!("error: {}", called.json()["error"].as_str().unwrap()), error);
        assert!(!called.stderr.contains("panicked"), "{arguments}: {}", called.stderr);
    }
    assert_eq!(program::files(place), before, "files were left behind");
    assert_eq!(std::fs::read(place.join("old.safetensors")).unwrap(), b"old");
    for usage in
        ["", "good.pt", "good.pt w.safetensors --dtype f64", "good.pt w.safetensors --kind x"]
    {
        assert_eq!(convert(place, usage).code, 2, "{usage}");
    }
}

#[test]
fn what_is_left_out_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let mut tensors = small();
    tensors.push(("head.weight".into(), floats(&[1], &[f32::NAN])));
    tensors.push(("tracked".into(), Item::Tensor("torch LongStorage", vec![], vec![0; 8])));
    tensors.push(("version".into(), Item::Text("3".into())));
    std::fs::write(place.join("extra.pt"), saved(&Item::StateDict(tensors))).unwrap();
    let report = converted(place, "extra.pt w.safetensors --allow-missing");
    assert_eq!(report["unexpected"], serde_json::json!(["head.weight", "version"]));
    assert_eq!(report["integers"], serde_json::json!(["tracked"]));
    assert_eq!(content(&place.join("w.safetensors"), Dtype::F32).len(), 5);
    let plain = convert(place, "extra.pt v.safetensors --allow-missing");
    assert_eq!(plain.code, 0);
    assert!(
        plain.stdout.contains("kind lpips (by its names), 5 tensors, 1472 parameters"),
        "{}",
        plain.stdout
    );
    assert!(
        plain.stderr.contains("warning: 2 tensors are not of the architecture"),
        "{}",
        plain.stderr
    );
    // The same input gives the same bytes.
    let bytes = |n: &str| std::fs::read(place.join(n)).unwrap();
    assert_eq!(bytes("v.safetensors"), bytes("w.safetensors"));
}

#[test]
fn the_file_says_where_it_comes_from() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path();
    let spec = |i: usize, c: usize| TensorSpec {
        name: format!("lin{i}.model.1.weight"),
        dtype: Dtype::F64,
        shape: vec![1, c, 1, 1],
    };
    let specs: Vec<_> =
        [64, 128, 256, 512, 512].into_iter().enumerate().map(|(i, c)| spec(i, c)).collect();
    let third = (1.0f64 / 3.0).to_le_bytes();
    std::fs::create_dir(place.join("deep")).unwrap();
    let source = place.join("deep/in.safetensors");
    let data = |i: usize| Ok(third.repeat(specs[i].elements().unwrap()));
    write_tensors(&source, &specs, &BTreeMap::new(), data).unwrap();
    let report = converted(place, "deep/in.safetensors w.safetensors --allow-missing");
    assert_eq!(report["dtypes_in"], serde_json::json!({ "f64": 5 }));
    let out = TensorFile::open(place.join("w.safetensors")).unwrap();
    assert_eq!(out.read("lin0.model.1.weight").unwrap(), (1.0f32 / 3.0).to_le_bytes().repeat(64));
    assert_eq!(out.metadata("subsplat.kind"), Some("lpips"));
    assert_eq!(out.metadata("subsplat.source"), Some("in.safetensors"));
    let version = concat!("subsplat-convert ", env!("CARGO_PKG_VERSION"));
    assert_eq!(out.metadata("subsplat.converter"), Some(version));
    // `sha256sum` of the same bytes.
    assert_eq!(out.metadata("subsplat.source_sha256"), Some(SOURCE_SHA256));
    assert_eq!(out.metadata(Config::METADATA_KEY), None);
}

const SOURCE_SHA256: &str = "5d9131e2e498a1909a5e5196d13fe70ec0db5bb6af9494ea3ddad3a086d79fc1";
