//! Tests of training on pictures from disk, and of the lock on a training's folder.

use subsplat_test_support::chunk_files;

use chunk_files::{video, write};
use std::path::Path;
use subsplat::reconstruct::inputs::crop::CropOptions;
use subsplat_kernels::camera::NearFar;
use subsplat_lab::data::dataset::{Dataset, ExampleOptions};
use subsplat_lab::data::sampler::{GapBounds, ViewSampler};
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::files::Pictures;
use subsplat_lab::train::run::Training;
use subsplat_lab::train::source::Source;

/// Configuration of a network of a few thousand parameters, on videos of 96×64 pixels.
const TINY: &str = r#"
seed = 3
steps = 40
batch = 2

[model]
upscale = 2

[model.set]
spgr = { enabled = false }

[model.set.backbone]
cnn_channels = [8, 8]
cnn_blocks = 1
match_channels = 4
depth_candidates = 8
stem_channels = 2
unet_channels = [16, 16]
head_channels = 8
primaries = { sh_degree = 1 }

[data]
seed = 5
input = [32, 32]
targets = 3

[data.files]
path = "videos"
mode = "uniform"
first = [2, 3]
last = [3, 5]
gap_steps = 10
"#;

fn config(folder: &Path, text: &str) -> TrainConfig {
    let file = folder.join("train.toml");
    std::fs::write(&file, text).unwrap();
    TrainConfig::load(&file).unwrap()
}

/// Writes five videos in two chunks into a folder for the configuration.
fn training_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let videos = |keys: &[&str]| keys.iter().map(|k| video(k, 7)).collect::<Vec<_>>();
    let chunks = [videos(&["a", "b", "c"]), videos(&["d", "e"])];
    write(&folder.path().join("videos/train"), &[&chunks[0], &chunks[1]]);
    folder
}

fn losses(training: &mut Training, n: usize) -> Vec<f64> {
    (0..n).map(|_| training.step().unwrap().unwrap().terms.loss).collect()
}

#[test]
fn a_data_set_is_streamed_into_the_step() {
    let folder_guard = training_folder();
    let config = config(folder_guard.path(), TINY);
    let files = config.data.files.clone().unwrap();
    let source = Pictures::open(&files, &config).unwrap();

    // The stream of the data set itself, with the gap of the step that an index belongs to.
    let first = ViewSampler::constant(2, 3, 3);
    let sampler = ViewSampler { last: GapBounds { low: 3, high: 5 }, steps: 10, ..first };
    let crop = CropOptions::square(32, 2, config.model_config().unwrap().stride());
    let options = ExampleOptions { sampler, crop, flip: false, near_far: None };
    let data = Dataset::open(folder_guard.path().join("videos"), options).unwrap();
    for index in [0u64, 1, 7, 30] {
        let want = data.example_from(5, index, index as usize / 2).unwrap().1;
        let got = source.example(index).unwrap();
        assert_eq!((&got.context, &got.targets), (&want.context, &want.targets), "{index}");
        assert_eq!((got.near_far, got.targets.len()), (NearFar::RE10K, 3));
        assert!(got.inverse_depth.is_empty());
    }
    // With three repetitions an index belongs to a step three times as late.
    let mut replayed = config.clone();
    (replayed.data.window, replayed.data.replay) = (4, 3);
    let thrice = Pictures::open(&files, &replayed).unwrap();
    for index in [1u64, 7, 30] {
        let want = data.example_from(5, index, 3 * index as usize / 2).unwrap().1;
        let got = thrice.example(index).unwrap();
        assert_eq!((&got.context, &got.targets), (&want.context, &want.targets), "{index}");
    }
    let differ =
        |i: &u64| thrice.example(*i).unwrap().context != source.example(*i).unwrap().context;
    assert!((0..12).any(|i| differ(&i)), "the repetition has no effect on the gap");

    let wide = (0..40).filter(|&i| {
        let views = source.example(i).unwrap();
        let x = |v: usize| views.context[v].camera.position().x;
        (x(1) - x(0)).abs() > 0.35
    });
    assert!(wide.min().unwrap() >= 2, "gaps of four frames are not allowed in the first step");

    let mut training = Training::open(&config, &folder_guard.path().join("run")).unwrap();
    let report = training.step().unwrap().unwrap();
    assert!(report.terms.psnr() > 3.0 && report.norm > 0.0, "{report:?}");
    // Photographs have no depth, and the configuration has no weights for LPIPS.
    let t = report.terms;
    let unmeasured = [t.cross_entropy, t.disparity, t.confidence, t.lpips];
    assert!(unmeasured.iter().all(|v| v.is_nan()) && t.dssim > 0.0 && t.loss > 0.0, "{t:?}");
}

#[test]
fn a_resumed_training_continues_in_the_data_set() {
    let folder_guard = training_folder();
    let config = config(folder_guard.path(), TINY);
    let whole =
        losses(&mut Training::open(&config, &folder_guard.path().join("whole")).unwrap(), 4);
    let folder = folder_guard.path().join("parts");
    let mut training = Training::open(&config, &folder).unwrap();
    let started = losses(&mut training, 2);
    training.save().unwrap();
    drop(training);
    let continued = losses(&mut Training::open(&config, &folder).unwrap(), 2);
    assert_eq!(whole, [started, continued].concat());
}

#[test]
fn a_folder_holds_one_training_at_a_time() {
    let folder_guard = training_folder();
    let config = config(folder_guard.path(), TINY);
    let folder = folder_guard.path().join("run");
    let first = Training::open(&config, &folder).unwrap();
    let error = Training::open(&config, &folder).err().expect("a second one is refused");
    assert!(error.to_string().contains("in use"), "{error}");
    drop(first);
    Training::open(&config, &folder).unwrap();
}

#[test]
fn errors_name_the_key() {
    let folder_guard = training_folder();
    let rows = [
        ("first = [2, 3]", "first = [3, 2]", "data.files.first"),
        ("last = [3, 5]", "last = [0, 5]", "data.files.last"),
        ("last = [3, 5]", "last = [3, 4294967296]", "data.files.last"),
        ("gap_steps = 10", "near_far = [2.0, 1.0]", "data.files.near_far"),
        ("gap_steps = 10", "gaps = 10", "gaps"),
        ("seed = 3", "phase = \"depth\"", "data.files"),
    ];
    for (old, new, named) in rows {
        let error = TrainConfig::from_toml(&TINY.replace(old, new)).unwrap_err().to_string();
        assert!(error.contains(named), "{new}: expected `{named}` in: {error}");
    }
    let missing = config(folder_guard.path(), &TINY.replace("\"videos\"", "\"nowhere\""));
    let error =
        Training::open(&missing, &folder_guard.path().join("run")).err().unwrap().to_string();
    assert!(error.contains("nowhere"), "{error}");
    // Gaps longer than every video.
    let text = TINY.replace("first = [2, 3]", "first = [9, 9]").replace("[3, 5]", "[9, 9]");
    let long = config(folder_guard.path(), &text);
    let error =
        Training::open(&long, &folder_guard.path().join("long")).unwrap().step().err().unwrap();
    assert!(error.to_string().contains("more than 9 frames"), "{error}");
}
