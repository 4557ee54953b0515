//! The weights that ship: the contents of the file, and scores that neither a plain plane sweep
//! nor a copy of an input reaches.

use subsplat_test_support as common;

use candle_core::Tensor;
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::{SUBSPLAT_PREFIX, Weights};
use subsplat::reconstruct::Reconstructor;
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::config::Model;
use subsplat_lab::train::validate::{Found, Validator};

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
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/network/shipped/small.safetensors");
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
    for upscale in 1..=8 {
        let any = Reconstructor::shipped(upscale).unwrap();
        assert_eq!(any.config().children(), upscale * upscale);
        assert!(any.untrained_tensors().is_empty(), "{:?}", any.untrained_tensors());
        assert_eq!(model.config().backbone, any.config().backbone);
    }
    assert!(Reconstructor::shipped(9).is_err());
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

/// The same heads render a room better than equal children, of sixteen as of sixty-four.
#[test]
fn heads_beat_the_plain_split_at_other_upscales() {
    for (upscale, least) in [(4, 0.4), (8, LEAST_AT_8)] {
        let backbone = || learnt(2).into_iter().filter(|(n, _)| !n.starts_with(SUBSPLAT_PREFIX));
        let heads = Weights::seeded(0).trainable();
        SubSplat::new(&shipped(upscale), heads.builder()).unwrap();
        let heads = heads.variables().into_iter().map(|(name, v)| (name, v.as_tensor().clone()));
        let heads = heads.filter(|(n, _)| n.starts_with(SUBSPLAT_PREFIX));
        let [trained, _] = look(learnt(2), &shipped(upscale), None);
        let [plain, _] = look(backbone().chain(heads).collect(), &shipped(upscale), None);
        let (trained, plain) = (trained.unwrap(), plain.unwrap());
        println!("x{upscale}: trained {trained:?}\nplain split {plain:?}");
        assert!(trained.psnr > plain.psnr + least && trained.ssim > plain.ssim, "x{upscale}");
        assert!(trained.psnr > trained.copy_psnr + 2.0, "{trained:?}");
    }
}

#[test]
fn photographs_are_reconstructed() {
    let Some(folder) = common::shared("photos") else { return };
    let [_, photos] = look(learnt(2), &shipped(2), Some(&folder));
    let photos = photos.unwrap();
    println!("{photos:?}");
    assert!(photos.psnr > photos.copy_psnr + 3.5 && photos.ssim > PHOTOS_SSIM, "{photos:?}");
}

/// Gain of PSNR at ×8 over equal children, dB.
const LEAST_AT_8: f64 = 0.2;
/// PSNR in dB and SSIM at ×2, a little below 28.92 and 0.909, which were measured.
const ROOMS: (f64, f64) = (28.6, 0.9);
/// As above, of 0.662.
const PHOTOS_SSIM: f64 = 0.645;
