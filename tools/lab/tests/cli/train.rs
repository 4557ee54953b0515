//! The training loop on a tiny network: stopping changes nothing, bad steps change
//! nothing, examples are learnt, files are whole.

use subsplat_test_support::made_up;

use std::path::Path;
use subsplat::files::poses::cameras_json::{CameraFile, save_cameras_json};
use subsplat::files::poses::scene::Units;
use subsplat_kernels::camera::NearFar;
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::checkpoint;
use subsplat_lab::train::config::Start;
use subsplat_lab::train::optimizer::State;
use subsplat_lab::train::run::{Event, Limits, Training};
use subsplat_lab::train::validate::Validator;

/// A network of some thousand numbers, pictures of 32², targets of 64².
const TINY: &str = r#"
phase = "PHASE"
seed = 3
steps = 40
batch = 2

[model]
preset = "tuned"

[model.set.embed]
mlp = "lite"
dim = 16

[model.set.agg]
stages_geo = 1
levels = ["trans4"]

[model.set.spgr]
hidden = 16

[model.set.backbone]
cnn_channels = [8, 8]
cnn_blocks = 1
match_channels = 4
depth_candidates = 16
stem_channels = 2
unet_channels = [16, 16]
head_channels = 8
primaries = { sh_degree = 1 }

[data]
input = [32, 32]
scenes = 4
window = 2
replay = 2
photographic = false

[schedule]
kind = "cosine"
rate = 3e-3
warmup = 2

[validate]
scenes = 1
"#;

pub(crate) fn tiny(phase: &str) -> TrainConfig {
    TrainConfig::from_toml(&TINY.replace("PHASE", phase)).unwrap()
}

pub(crate) fn steps(training: &mut Training, n: usize) -> Vec<f64> {
    (0..n).map(|_| training.step().unwrap().unwrap().terms.loss).collect()
}

pub(crate) fn state(training: &Training) -> Vec<(String, Vec<u32>)> {
    let bits = |t: &candle_core::Tensor| -> Vec<u32> {
        t.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().map(|v| v.to_bits()).collect()
    };
    let state: State = training.optimizer().state().unwrap();
    state.iter().map(|(name, t)| (name.clone(), bits(t))).collect()
}

#[test]
fn a_resumed_run_equals_an_unstopped_one_bit_for_bit() {
    for phase in ["depth", "render"] {
        let config = tiny(phase);
        let [whole, cut] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let mut unstopped = Training::open(&config, whole.path()).unwrap();
        let losses = steps(&mut unstopped, 5);
        let mut first = Training::open(&config, cut.path()).unwrap();
        let begun = steps(&mut first, 3);
        first.save().unwrap();
        // Steps after the checkpoint are lost with the process.
        steps(&mut first, 1);
        drop(first);
        let mut second = Training::open(&config, cut.path()).unwrap();
        assert_eq!((second.progress().step, second.progress().examples), (3, 6));
        let rest = steps(&mut second, 2);
        assert_eq!([begun, rest].concat(), losses, "{phase}");
        assert_eq!(state(&second), state(&unstopped), "{phase}");
        // The comparison sees a difference.
        steps(&mut unstopped, 1);
        assert_ne!(state(&second), state(&unstopped));
    }
}

/// Lanes and threads are the machine's business alone.
#[test]
fn the_number_of_lanes_changes_nothing() {
    for phase in ["depth", "render"] {
        let run = |lanes: usize| {
            let config = TrainConfig { parallel_groups: lanes, batch: 3, ..tiny(phase) };
            let folder = tempfile::tempdir().unwrap();
            let mut training = Training::open(&config, folder.path()).unwrap();
            (steps(&mut training, 2), state(&training))
        };
        assert!(run(1) == run(3), "{phase}");
    }
}

/// No gradient is sent through a frozen backbone, and its depth losses are no part of
/// the step.
#[test]
fn a_frozen_backbone_is_left_out_of_the_step() {
    let mut config = tiny("render");
    config.optimizer.freeze_backbone = true;
    let folder = tempfile::tempdir().unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    let before = state(&training);
    let terms = training.step().unwrap().unwrap().terms;
    assert!(terms.loss > 0.0 && terms.mse > 0.0 && terms.cross_entropy.is_nan(), "{terms:?}");
    let after = state(&training);
    let moved = |own: &str| {
        let pairs = before.iter().zip(&after).filter(|((name, _), _)| name.contains(own));
        pairs.fold([0, 0], |[all, moved], (b, a)| [all + 1, moved + usize::from(b != a)])
    };
    let ([backbone, still], [heads, learnt]) = (moved("small."), moved("subsplat."));
    assert!(backbone > 0 && still == 0, "{still} of {backbone}");
    assert!(heads > 0 && learnt > 0, "{learnt} of {heads}");
}

#[test]
fn a_few_scenes_are_learnt() {
    for (phase, share) in [("depth", 0.75), ("render", 0.8)] {
        let mut config = tiny(phase);
        config.data.augment.flip = 0.0;
        config.data.augment.permute = 0.0;
        config.data.augment.swap = 0.0;
        config.data.scenes = 2;
        config.schedule = toml_schedule("kind = \"cosine\"\nrate = 1e-2\nwarmup = 2");
        let folder = tempfile::tempdir().unwrap();
        let mut training = Training::open(&config, folder.path()).unwrap();
        let losses = steps(&mut training, 40);
        let (first, last) = (losses[0], losses[39]);
        println!("{phase}: {first:.4} to {last:.4}");
        assert!(last < share * first, "{phase}: {first} to {last}");
    }
}

fn toml_schedule(text: &str) -> subsplat_lab::train::schedule::Schedule {
    toml::from_str(text).unwrap()
}

/// A checkpoint in which one tensor is as large as f32 goes: everything after it
/// overflows.
#[test]
fn a_step_that_is_not_finite_changes_nothing() {
    let config = tiny("depth");
    let folder = tempfile::tempdir().unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    steps(&mut training, 2);
    let path = training.save().unwrap();
    drop(training);
    let good = checkpoint::load(&path).unwrap();
    let mut bad = good.state.clone();
    let name = "weights/small.down2.conv.weight";
    let huge = (bad[name].ones_like().unwrap() * 3e38).unwrap();
    bad.insert(name.to_owned(), huge);
    checkpoint::save(folder.path(), (&good.progress, &good.config), &bad, 3).unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    let before = state(&training);
    assert!(training.step().unwrap().is_none());
    assert_eq!((training.progress().bad, training.progress().step), (1, 3));
    assert_eq!(training.progress().examples, 6);
    assert_eq!(state(&training), before);
    drop(training);
    checkpoint::save(folder.path(), (&good.progress, &good.config), &good.state, 3).unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    steps(&mut training, 1);
    assert_eq!(training.progress().bad, 0);
    assert_ne!(state(&training), before);
}

/// A killed process leaves rows of lost steps, half a row and no weights.
#[test]
fn a_killed_run_leaves_no_row_twice_and_gets_its_weights() {
    let config = tiny("depth");
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let nothing = Validator::new(&config, None).unwrap();
    let run = |steps: u64| {
        let mut training = Training::open(&config, folder.path()).unwrap();
        let limits = Limits { steps: Some(steps), ..Limits::default() };
        training.run(limits, &nothing, &mut |_| {}).unwrap();
    };
    // Nothing done and nothing to go on from: no weights.
    run(0);
    assert!(!at("weights.safetensors").exists());
    run(12);
    let whole = ["log.csv", "validation.csv"].map(|n| std::fs::read_to_string(at(n)).unwrap());
    assert_eq!(whole.each_ref().map(|t| t.lines().count()), [2, 2], "{whole:?}");
    std::fs::write(at("log.csv"), format!("{}20,1\n2", whole[0])).unwrap();
    std::fs::write(at("validation.csv"), format!("{}13,1,rooms\n", whole[1])).unwrap();
    std::fs::remove_file(at("weights.safetensors")).unwrap();
    run(0);
    let left = ["log.csv", "validation.csv"].map(|n| std::fs::read_to_string(at(n)).unwrap());
    assert_eq!(left, whole);
    assert!(at("weights.safetensors").is_file());
    run(9);
    let log = std::fs::read_to_string(at("log.csv")).unwrap();
    let steps: Vec<&str> = log.lines().skip(1).filter_map(|l| l.split(',').next()).collect();
    assert_eq!(steps, ["10", "20"]);
    // Nothing is rendered in this phase: empty, and not 0.
    let header: Vec<&str> = log.lines().next().unwrap().split(',').collect();
    let row: Vec<&str> = log.lines().nth(1).unwrap().split(',').collect();
    let cell = |name: &str| row[header.iter().position(|h| *h == name).unwrap()];
    assert_eq!(["psnr", "dssim", "lpips"].map(cell), [""; 3]);
    assert!(cell("cross_entropy").parse::<f64>().unwrap() > 0.0);
}

/// Rows of numbers that nothing measured would draw a line at 0.
#[test]
fn terms_that_are_not_measured_are_not_numbers() {
    let mut config = tiny("render");
    config.loss.dssim = 0.0;
    let folder = tempfile::tempdir().unwrap();
    let terms = Training::open(&config, folder.path()).unwrap().step().unwrap().unwrap().terms;
    assert!(terms.dssim.is_nan() && terms.lpips.is_nan(), "{terms:?}");
    assert!(terms.mse > 0.0 && terms.loss > 0.0 && terms.disparity > 0.0, "{terms:?}");
}

/// A test without a picture to compare with is no 0 dB.
#[test]
fn photographs_without_targets_are_refused() {
    let (made, cameras) = made_up::made_up(3);
    let content = CameraFile {
        cameras,
        units: Units::Unknown,
        near_far: Some(NearFar::new(1.0, 9.0)),
        ..Default::default()
    };
    save_cameras_json(made.path().join("cameras.json"), &content).unwrap();
    let refused = |tests: &str| {
        let file = made.path().join("protocol.json");
        std::fs::write(file, format!(r#"{{"tests": [{tests}]}}"#)).unwrap();
        let found = Validator::new(&tiny("render"), Some(made.path()));
        found.err().map(|e| e.to_string()).unwrap_or_default()
    };
    for test in [r#"{"context": [0, 2], "target": []}"#, r#"{"context": [0], "target": [1]}"#] {
        let error = refused(test);
        assert!(error.contains("protocol.json") && error.contains("and a target"), "{error}");
    }
    assert_eq!(refused(r#"{"context": [0, 2], "target": [1]}"#), "");
}

#[test]
fn many_bad_steps_end_the_run() {
    let mut config = tiny("depth");
    config.schedule = toml_schedule("kind = \"cosine\"\nrate = 1e30");
    config.checkpoint.bad_steps = 3;
    let folder = tempfile::tempdir().unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    let mut skipped = 0;
    let mut count = |event: &Event| skipped += usize::from(matches!(event, Event::Skipped { .. }));
    let nothing = Validator::new(&config, None).unwrap();
    let error = training.run(Limits::default(), &nothing, &mut count).unwrap_err().to_string();
    assert!(error.contains("3 steps in a row"), "{error}");
    assert_eq!(skipped, 2);
}

#[test]
fn checkpoints_are_whole_and_few() {
    let config = tiny("depth");
    let folder = tempfile::tempdir().unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    for _ in 0..5 {
        steps(&mut training, 1);
        training.save().unwrap();
    }
    assert_eq!(checkpoint::steps(folder.path()), [3, 4, 5]);
    drop(training);
    // The file of an interrupted write is not a checkpoint.
    std::fs::write(folder.path().join("step-00000009.safetensors.1.part"), "half").unwrap();
    assert_eq!(Training::open(&config, folder.path()).unwrap().progress().step, 5);
    let newest = checkpoint::path(folder.path(), 5);
    let bytes = std::fs::read(&newest).unwrap();
    std::fs::write(&newest, &bytes[..bytes.len() - 9]).unwrap();
    let error = refused(&config, folder.path());
    assert!(error.contains("step-00000005") && error.contains("safetensors"), "{error}");
    std::fs::write(&newest, bytes).unwrap();
    let mut other = config;
    other.model.upscale = 3;
    let error = refused(&other, folder.path());
    assert!(error.contains("the same model"), "{error}");
}

fn refused(config: &TrainConfig, folder: &Path) -> String {
    match Training::open(config, folder) {
        Ok(_) => panic!("accepted"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn the_weights_that_are_written_are_a_model() {
    let config = tiny("render");
    let folder = tempfile::tempdir().unwrap();
    let mut training = Training::open(&config, folder.path()).unwrap();
    steps(&mut training, 2);
    training.save().unwrap();
    let path = folder.path().join("weights.safetensors");
    let model = subsplat::reconstruct::Reconstructor::load(&path, None).unwrap();
    assert_eq!(*model.config(), config.model_config().unwrap());
    assert!(model.untrained_tensors().is_empty() && model.unexpected_tensors().is_empty());
    // And a start for another training.
    let mut next = tiny("render");
    next.init = subsplat_lab::train::config::Start::Weights { path, opacity: 2.0 };
    let begun = tempfile::tempdir().unwrap();
    let begun = Training::open(&next, begun.path()).unwrap().optimizer().averaged().unwrap();
    for (name, tensor) in training.optimizer().averaged().unwrap() {
        let flat = |t: &candle_core::Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (mut want, got) = (flat(&tensor), flat(&begun[&name]));
        if name == "small.head.1.bias" {
            *want.last_mut().unwrap() += 2.0;
        }
        assert_eq!(want, got, "{name}");
    }
    // But not for one whose parts have other shapes.
    next.model.set = serde_json::from_str(
        &serde_json::to_string(&next.model.set)
            .unwrap()
            .replace("\"hidden\":16", "\"hidden\":16,\"head\":\"pg\""),
    )
    .unwrap();
    let other = tempfile::tempdir().unwrap();
    let begun = Training::open(&next, other.path());
    assert!(begun.is_err(), "a head of another shape must be named");
}

#[test]
fn errors_name_key_and_value() {
    let rows = [
        ("seed = 3", "sed = 3", "sed"),
        ("steps = 40", "steps = 0", "steps"),
        ("steps = 40", "steps = \"many\"", "line 4"),
        ("input = [32, 32]", "input = [30, 32]", "data.input"),
        ("hidden = 16", "hiden = 16", "hiden"),
        ("rate = 3e-3", "rate = -1.0", "schedule.rate"),
        ("rate = 3e-3", "rate = 1.0\npeak = 3", "peak"),
        ("batch = 2", "batch = 2\n[loss]\nlpips = 0.05", "lpips_weights"),
        ("batch = 2", "batch = 2\n[optimizer]\naverage = 1.5", "optimizer.average"),
        ("batch = 2", "batch = 2\n[optimizer]\nfreeze_backbone = true", "freeze_backbone"),
        ("batch = 2", "batch = 2\n[optimizer]\nbetas = [1.0, 0.9]", "optimizer.betas"),
        ("batch = 2", "batch = 2\n[optimizer]\nbetas = [nan, 0.9]", "optimizer.betas"),
        ("batch = 2", "batch = 2\n[optimizer]\nepsilon = 0.0", "optimizer.epsilon"),
        ("batch = 2", "batch = 2\n[optimizer]\nepsilon = nan", "optimizer.epsilon"),
        ("batch = 2", "batch = 2\n[loss]\nopacity_start = inf", "loss.opacity_start"),
        ("rate = 3e-3", "rate = 3e-3\nfloor = nan", "schedule.floor"),
        ("batch = 2", "batch = 4294967296", "batch"),
        ("batch = 2", "batch = 2\nlanes = 4294967296", "lanes"),
        ("input = [32, 32]", "input = [4294967296, 32]", "data.input"),
        ("input = [32, 32]", "input = [32, 32]\ntargets = 4294967296", "data.targets"),
        ("window = 2", "window = 4294967296", "data.window"),
        ("replay = 2", "replay = 4294967296", "data.replay"),
        ("[validate]\nscenes = 1", "[validate]\nscenes = 4294967296", "validate.scenes"),
    ];
    for (old, new, named) in rows {
        let text = TINY.replace("PHASE", "depth").replace(old, new);
        let error = TrainConfig::from_toml(&text).unwrap_err().to_string();
        assert!(error.contains(named), "{new}: expected `{named}` in: {error}");
        assert!(!error.contains('\n'), "{error}");
    }
    let mvsplat = "phase = \"depth\"\n[model]\nbackbone = \"re10k\"";
    let error = TrainConfig::from_toml(mvsplat).unwrap_err().to_string();
    assert!(error.contains("phase"), "{error}");
    let config = tiny("depth");
    let again = TrainConfig::from_json(&config.to_json().unwrap()).unwrap();
    assert_eq!(config, again);
}

#[test]
fn every_preset_file_is_a_configuration() {
    let folder = subsplat_test_support::repository().join("tools/lab/train");
    let mut count = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            let config = TrainConfig::load(&path).unwrap();
            // Weights that the repository ships, or those of another training from its root.
            if let Start::Weights { path: weights, .. } = &config.init {
                let made = weights.starts_with(folder.join("../../../out"));
                assert!(made || weights.is_file(), "{}: no {}", path.display(), weights.display());
            }
            count += 1;
        }
    }
    assert!(count >= 3, "{count}");
}

/// Exit code, stdout and stderr of the program in `folder`.
fn call(folder: &Path, arguments: &str) -> (i32, String, String) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_subsplat-lab"));
    let output = command.args(arguments.split_whitespace()).current_dir(folder).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

/// TensorFlow's checksum of a record, bit by bit: CRC-32C (Castagnoli), turned and moved.
fn masked_crc(bytes: &[u8]) -> u32 {
    let mut crc = !0u32;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0x82F6_3B78 } else { crc >> 1 };
        }
    }
    (!crc).rotate_right(15).wrapping_add(0xA282_EAD8)
}

/// Messages of a TensorBoard file, their framing checked.
fn records(mut bytes: &[u8]) -> Vec<&[u8]> {
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let length = word(0) as usize;
        assert_eq!((word(4), word(8)), (0, masked_crc(&bytes[..8])));
        let message = &bytes[12..12 + length];
        assert_eq!(word(12 + length), masked_crc(message));
        found.push(message);
        bytes = &bytes[16 + length..];
    }
    found
}

#[test]
fn the_program_trains_and_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("t.toml"), TINY.replace("PHASE", "render")).unwrap();
    let step =
        |stdout: &str| serde_json::from_str::<serde_json::Value>(stdout).unwrap()["step"].clone();
    let (code, stdout, stderr) = call(folder.path(), "--json train t.toml --out run --steps 2");
    assert_eq!(code, 0, "{stderr}");
    assert_eq!(step(&stdout), 2);
    let (_, stdout, stderr) = call(folder.path(), "--json train t.toml --out run --steps 1");
    assert_eq!(step(&stdout), 3);
    assert!(stderr.contains("continuing from"), "{stderr}");
    for name in ["weights.safetensors", "validation.csv", "sheet-00000003-rooms.png", "log.csv"] {
        assert!(folder.path().join("run").join(name).is_file(), "{name}");
    }
    let mut events: Vec<_> = std::fs::read_dir(folder.path().join("run")).unwrap().collect();
    events.retain(|e| e.as_ref().unwrap().file_name().to_string_lossy().contains(".tfevents."));
    assert_eq!(events.len(), 2, "one a call");
    let bytes = std::fs::read(events[0].as_ref().unwrap().path()).unwrap();
    let records = records(&bytes);
    let of = |text: &str| {
        records.iter().filter(|r| r.windows(text.len()).any(|w| w == text.as_bytes())).count()
    };
    assert!(records[0].ends_with(b"brain.Event:2"));
    let steps = of("loss/total");
    assert!(steps == 1 || steps == 2, "{steps}");
    assert_eq!((of("train/psnr"), of("rooms/psnr"), of("photos/psnr")), (steps, 1, 0));
    assert!(of("rooms/sheet") == 1 && of("IEND") == 1);
    // No step, no weights to name.
    let (_, stdout, stderr) = call(folder.path(), "--json train t.toml --out none --steps 0");
    let report = serde_json::from_str::<serde_json::Value>(&stdout).unwrap();
    assert!(report["weights"].is_null() && !stderr.contains("weights.safe"), "{report} {stderr}");
    let (code, _, stderr) = call(folder.path(), "train t.toml --out run --minutes 0");
    assert!(code == 2 && stderr.contains("--minutes"), "{stderr}");
}

/// SIGKILL at moments that are spread over a training: each call goes on from the newest checkpoint, and the weights are
/// those of a call that nothing stopped. `SUBSPLAT_KILLS` sets the number of kills.
#[test]
fn killed_trainings_get_the_weights_of_an_unstopped_one() {
    let folder = tempfile::tempdir().unwrap();
    // A checkpoint after every step.
    let text = TINY.replace("PHASE", "depth") + "\n[checkpoint]\nminutes = 1e-6\n";
    std::fs::write(folder.path().join("t.toml"), text).unwrap();
    let weights =
        |out: &str| std::fs::read(folder.path().join(out).join("weights.safetensors")).unwrap();
    let start = std::time::Instant::now();
    let (code, _, stderr) = call(folder.path(), "train t.toml --out whole");
    assert_eq!(code, 0, "{stderr}");
    let time = start.elapsed().as_secs_f64();
    let kills: u32 = std::env::var("SUBSPLAT_KILLS").map_or(4, |n| n.parse().unwrap());
    let mut reached: Vec<u64> = Vec::new();
    for kill in 0..kills {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_subsplat-lab"));
        command.args("train t.toml --out killed".split_whitespace()).current_dir(folder.path());
        let nowhere = std::process::Stdio::null;
        let mut child = command.stdout(nowhere()).stderr(nowhere()).spawn().unwrap();
        // Parts of a whole training that are not multiples of each other.
        let part = (0.15 + 0.618 * f64::from(kill)).fract() * 0.4;
        std::thread::sleep(std::time::Duration::from_secs_f64(time * part));
        child.kill().unwrap();
        child.wait().unwrap();
        reached.extend(checkpoint::steps(&folder.path().join("killed")).last());
    }
    assert!(
        reached.is_sorted() && reached.iter().any(|step| (1..40).contains(step)),
        "{reached:?}"
    );
    println!("{kills} kills, checkpoints of the steps {reached:?}");
    let (code, _, stderr) = call(folder.path(), "train t.toml --out killed");
    assert_eq!(code, 0, "{stderr}");
    assert!(weights("killed") == weights("whole"));
}

/// SIGINT ends the program after a step, with a checkpoint and weights.
#[cfg(unix)]
#[test]
fn ctrl_c_saves_a_checkpoint() {
    use std::io::{BufRead, BufReader};
    let folder = tempfile::tempdir().unwrap();
    let endless = TINY.replace("PHASE", "depth").replace("steps = 40", "steps = 1000000");
    std::fs::write(folder.path().join("t.toml"), endless).unwrap();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_subsplat-lab"));
    command.args("--json train t.toml --out run --minutes 5".split_whitespace());
    command.current_dir(folder.path());
    command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let step = lines.by_ref().map(Result::unwrap).find(|l| l.starts_with("step ")).unwrap();
    // A million steps take longer than the five minutes of this call.
    assert!(step.contains(" left 5 min") || step.contains(" left 4 min"), "{step}");
    let interrupted = std::process::Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(interrupted.success());
    let rest: Vec<String> = lines.map(Result::unwrap).collect();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{rest:?}");
    assert!(rest.iter().any(|l| l.starts_with("stopped by Ctrl-C, ")), "{rest:?}");
    assert!(!rest.iter().any(|l| l.contains("held-out rooms")), "{rest:?}");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["stopped"], true);
    let done = report["step"].as_u64().unwrap();
    let run = folder.path().join("run");
    assert_eq!(checkpoint::steps(&run), [done]);
    assert!(run.join("weights.safetensors").is_file());
    // It goes on from there.
    let (code, stdout, stderr) = call(folder.path(), "--json train t.toml --out run --steps 1");
    assert_eq!(code, 0, "{stderr}");
    let report: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!((&report["step"], &report["stopped"]), (&(done + 1).into(), &false.into()));
}
