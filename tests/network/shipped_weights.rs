//! The weights that ship: the contents of the file, and scores that neither a plain plane sweep
//! nor a copy of an input reaches.

use subsplat_test_support as common;

use candle_core::Tensor;
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::config::{Config, Preset};
use subsplat::model::subsplat::SubSplat;
use subsplat::model::weights::{SUBSPLAT_PREFIX, Weights};
use subsplat::pipeline::Reconstructor;
use subsplat::train::TrainConfig;
use subsplat::train::config::Model;
use subsplat::train::validate::{Found, Validator};

/// The shipped model's configuration.
fn shipped(upscale: usize) -> Config {
    Weights::shipped(upscale).unwrap().config().unwrap().clone()
}

/// The same model as it begins, at ×2: a plane sweep.
fn untrained() -> BTreeMap<String, Tensor> {
    let weights = Weights::seeded(0).trainable();
    SubSplat::new(&shipped(2), weights.builder()).unwrap();
    weights.variables().into_iter().map(|(name, v)| (name, v.as_tensor().clone())).collect()
}

/// Scores a model as training does: on held-out rooms of a seed that no training used, and on
/// photographs.
fn look(
    tensors: BTreeMap<String, Tensor>,
    model: &Config,
    photos: Option<&Path>,
) -> [Option<Found>; 2] {
    let set = serde_json::from_str(&model.to_json().unwrap()).unwrap();
    let own = Model { set, upscale: model.upscale, ..Model::default() };
    let mut config = TrainConfig { model: own, ..TrainConfig::default() };
    // Both to 256².
    config.data.input = [256 / model.upscale; 2];
    config.data.seed = 77;
    config.validate.scenes = 6;
    Validator::new(&config, photos).unwrap().evaluate(tensors, None).unwrap()
}

fn learnt(upscale: usize) -> BTreeMap<String, Tensor> {
    Weights::shipped(upscale).unwrap().tensors().clone()
}

#[test]
fn the_file_is_small_and_whole() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/model/shipped/small.safetensors");
    let bytes = std::fs::metadata(&file).unwrap().len();
    assert!((500_000..6 << 20).contains(&bytes), "{bytes}");
    let model = Reconstructor::shipped(2).unwrap();
    assert_eq!((model.config().upscale, model.config().children()), (2, 4));
    assert!(model.unexpected_tensors().is_empty(), "{:?}", model.unexpected_tensors());
    let heads = model.untrained_tensors();
    assert!(heads.iter().all(|n| n.starts_with(SUBSPLAT_PREFIX)), "{heads:?}");
    let finer = Reconstructor::shipped(4).unwrap();
    assert_eq!((finer.config().upscale, finer.config().children()), (4, 16));
    assert!(finer.unexpected_tensors().is_empty() && finer.untrained_tensors().is_empty());
    let plain = Reconstructor::shipped(3).unwrap();
    assert_eq!(plain.config().children(), 9);
    let heads = plain.untrained_tensors();
    assert!(!heads.is_empty() && heads.iter().all(|n| n.starts_with(SUBSPLAT_PREFIX)), "{heads:?}");
    assert!(Reconstructor::shipped(9).is_err());
    for other in [finer.config(), plain.config()] {
        assert_eq!(model.config().backbone, other.backbone);
    }
    assert_ne!(*model.config(), Config::small(Preset::Paper, 2));
}

#[test]
fn rooms_that_were_never_trained_on_are_reconstructed() {
    let [rooms, _] = look(learnt(2), &shipped(2), None);
    let [plain, _] = look(untrained(), &shipped(2), None);
    let (rooms, plain) = (rooms.unwrap(), plain.unwrap());
    println!("shipped {rooms:?}\nplane sweep {plain:?}");
    assert!(rooms.psnr > ROOMS.0 && rooms.ssim > ROOMS.1, "{rooms:?}");
    assert!(rooms.psnr > rooms.copy_psnr + 4.0 && rooms.psnr > plain.psnr + 2.5);
    assert!(rooms.disparity < 0.5 * plain.disparity, "{rooms:?} {plain:?}");
}

/// Sixteen trained children render a room better than sixteen equal ones.
#[test]
fn heads_for_four_times_the_size_beat_the_plain_split() {
    let backbone = || learnt(4).into_iter().filter(|(n, _)| !n.starts_with(SUBSPLAT_PREFIX));
    let heads = Weights::seeded(0).trainable();
    SubSplat::new(&shipped(4), heads.builder()).unwrap();
    let heads = heads.variables().into_iter().map(|(name, v)| (name, v.as_tensor().clone()));
    let heads = heads.filter(|(n, _)| n.starts_with(SUBSPLAT_PREFIX));
    let [trained, _] = look(learnt(4), &shipped(4), None);
    let [plain, _] = look(backbone().chain(heads).collect(), &shipped(4), None);
    let (trained, plain) = (trained.unwrap(), plain.unwrap());
    println!("trained {trained:?}\nplain split {plain:?}");
    assert!(trained.psnr > plain.psnr + 0.4 && trained.ssim > plain.ssim + 0.005);
    assert!(trained.psnr > trained.copy_psnr + 3.0, "{trained:?}");
}

#[test]
fn photographs_are_reconstructed() {
    let Some(folder) = common::shared("photos") else { return };
    let [_, photos] = look(learnt(2), &shipped(2), Some(&folder));
    let photos = photos.unwrap();
    println!("{photos:?}");
    assert!(photos.psnr > photos.copy_psnr + 3.5 && photos.ssim > PHOTOS_SSIM, "{photos:?}");
}

/// PSNR in dB and SSIM at ×2, a little below 28.92 and 0.909, which were measured.
const ROOMS: (f64, f64) = (28.6, 0.9);
/// As above, of 0.662.
const PHOTOS_SSIM: f64 = 0.645;
