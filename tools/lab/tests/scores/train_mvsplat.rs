//! Tests MVSplat's training recipe at its smallest size: the backbone from GMDepth's tensors,
//! random heads, L2 and LPIPS, OneCycle.

use candle_core::Tensor;
use candle_nn::init::DEFAULT_KAIMING_NORMAL;
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::architecture::{Kind, expected};
use subsplat::network::model::weights::{Weights, save};
use subsplat_lab::lpips::Lpips;
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::run::Training;

/// Two views of 64² (the smallest size that the transformer's windows allow), a target of 128².
const PAPER: &str = r#"
phase = "render"
seed = 5
steps = 20
batch = 1

[model]
backbone = "re10k"
preset = "paper"

[init]
kind = "weights"
path = "gmdepth.safetensors"

[data]
input = [64, 64]
scenes = 1
window = 1
photographic = false

[data.augment]
flip = 0.0
permute = 0.0
swap = 0.0

[loss]
mse = 1.0
dssim = 0.0
lpips = 0.05
lpips_weights = "lpips.safetensors"

[optimizer]
clip = 0.5

[schedule]
kind = "one_cycle"
rate = 2e-4
warmup = 2
"#;

/// Returns random tensors from `seed`.
fn random_tensors(
    seed: u64,
    names: impl Iterator<Item = (String, Vec<usize>)>,
) -> BTreeMap<String, Tensor> {
    let weights = Weights::seeded(seed);
    let builder = weights.builder();
    names
        .map(|(name, shape)| {
            let tensor = builder.get_with_hints(shape, &name, DEFAULT_KAIMING_NORMAL).unwrap();
            (name, tensor)
        })
        .collect()
}

/// Writes both weight files into `folder` and returns the tensors of GMDepth's file.
fn weights(folder: &Path) -> BTreeMap<String, Tensor> {
    let config = Config::re10k(Preset::Paper, 2);
    let shapes = expected(Kind::Gmdepth, &config).unwrap();
    let start = random_tensors(77, shapes.into_iter());
    save(&folder.join("gmdepth.safetensors"), &start, &config).unwrap();
    let vgg = Weights::seeded(9).trainable();
    Lpips::new(vgg.builder()).unwrap();
    let vgg = vgg.variables().into_iter().map(|(n, v)| (n, v.as_tensor().abs().unwrap()));
    save(&folder.join("lpips.safetensors"), &vgg.collect(), &config).unwrap();
    start
}

fn config(folder: &Path) -> TrainConfig {
    let path = folder.join("train.toml");
    std::fs::write(&path, PAPER).unwrap();
    TrainConfig::load(&path).unwrap()
}

fn bits(t: &Tensor) -> Vec<u32> {
    t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
}

/// Returns the parameters by name, as the optimizer stores them.
fn parameters(training: &Training) -> BTreeMap<String, Vec<u32>> {
    let state = training.optimizer().state().unwrap();
    state.iter().map(|(name, t)| (name.clone(), bits(t))).collect()
}

#[test]
fn mvsplat_learns_from_gmdepth_with_lpips() {
    let folder = tempfile::tempdir().unwrap();
    let start = weights(folder.path());
    let config = config(folder.path());
    let mut training = Training::open(&config, &folder.path().join("run")).unwrap();
    let before = parameters(&training);
    for (name, tensor) in &start {
        let plain = name.strip_prefix("encoder.").unwrap_or(name);
        let key = before.keys().find(|k| k.ends_with(plain)).unwrap_or_else(|| panic!("{name}"));
        assert!(before[key] == bits(tensor), "{name} is not the file's");
    }
    assert!(before.keys().any(|k| k.contains("subsplat.")), "no heads");
    let steps: Vec<_> = (0..6).map(|_| training.step().unwrap().unwrap()).collect();
    let first = steps[0].terms;
    assert!(first.lpips > 0.0 && first.cross_entropy.is_nan(), "{first:?}");
    let loss = first.mse + 0.05 * first.lpips;
    assert!((first.loss / loss - 1.0).abs() < 1e-4, "{first:?}");
    assert!(steps[5].terms.loss < first.loss, "{:?}", steps[5].terms);
    // Every part changes, the tensors of the file included.
    let after = parameters(&training);
    for part in ["backbone.backbone.", "backbone.transformer.", "depth_predictor.", "subsplat."] {
        let own = before.iter().filter(|(name, _)| name.contains(part));
        let (all, moved) =
            own.fold((0, 0), |(n, m), (name, v)| (n + 1, m + usize::from(after[name] != *v)));
        assert!(20 * moved > 19 * all, "{part}: {moved} of {all}");
    }
}
