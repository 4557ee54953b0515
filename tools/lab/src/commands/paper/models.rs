//! Weights of the rows: files, the shipped ones, or heads that are trained here.

use super::tables::{Source, Variant};
use crate::train::TrainConfig;
use crate::train::config::Start;
use crate::train::run::{Limits, Training};
use crate::train::validate::Validator;
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};
use subsplat::network::model::weights::{SUBSPLAT_PREFIX, Weights, save};
use subsplat::reconstruct::Reconstructor;
use subsplat_cli::commands::args::ModelArgs;
use subsplat_cli::commands::model::{self, ModelRequest};
use subsplat_cli::report::print_line;

/// Seed of the rooms of the first training; further trainings take the next ones.
const DATA_SEED: u64 = 500;
/// Smallest side of an input in a training, px: the stride of the small backbone.
const INPUT_LEAST: usize = 32;

/// Sources of weights.
pub struct Models<'a> {
    /// `--ckpts`.
    pub folder: Option<&'a Path>,
    /// Folder of the trainings.
    pub trained: PathBuf,
    /// Steps of a training.
    pub steps: u64,
    /// Side of the targets of a training, px.
    pub target: usize,
}

/// Weights of a row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Chosen {
    /// The weights that ship.
    Shipped,
    /// A file.
    File(PathBuf),
}

impl Models<'_> {
    /// The weights of a row at an upscale; trains them where no file has them. `None` for rows
    /// without a model.
    ///
    /// # Errors
    /// A training that fails.
    pub fn choose(&self, source: &Source, upscale: usize, seed: u64) -> Result<Option<Chosen>> {
        Ok(match source {
            Source::Imported => None,
            Source::Method(weights, _) | Source::MethodAtTargetSize(weights, _) => {
                Some(self.file(weights.name(), upscale).map_or(Chosen::Shipped, Chosen::File))
            }
            Source::Trained(variant) => {
                Some(Chosen::File(match self.file(variant.name, upscale) {
                    Some(file) => file,
                    None => self.train(variant, upscale, seed)?,
                }))
            }
        })
    }

    /// Returns whether `--ckpts` has the weights `name`.
    pub fn has(&self, name: &str, upscale: usize) -> bool {
        self.file(name, upscale).is_some()
    }

    /// The first of `NAME-xR.safetensors` and `NAME.safetensors` in the folder of `--ckpts`.
    fn file(&self, name: &str, upscale: usize) -> Option<PathBuf> {
        let names = [format!("{name}-x{upscale}.safetensors"), format!("{name}.safetensors")];
        let folder = self.folder?;
        names.iter().map(|name| folder.join(name)).find(|file| file.is_file())
    }

    /// Trains a variant, unless its folder holds the trained weights. Returns their file.
    fn train(&self, variant: &Variant, upscale: usize, seed: u64) -> Result<PathBuf> {
        let name =
            format!("{}-x{upscale}-{}px-{}steps-seed{seed}", variant.name, self.target, self.steps);
        let folder = self.trained.join(&name);
        let file = folder.join("weights.safetensors");
        let config = self.config(variant, upscale, seed)?;
        let mut training = Training::open(&config, &folder).with_context(|| name.clone())?;
        if training.progress().step < self.steps {
            print_line(format!("training {name}"));
        }
        let validator = Validator::new(&config, None)?;
        training.run(Limits::default(), &validator, &mut |_| ()).with_context(|| name.clone())?;
        Ok(file)
    }

    /// The training of a variant. The input of ×4 has half of the side of that of ×2, as in the
    /// paper.
    fn config(&self, variant: &Variant, upscale: usize, seed: u64) -> Result<TrainConfig> {
        let mut config = TrainConfig::from_toml(include_str!("train.toml"))?;
        (config.seed, config.steps, config.model.upscale) = (seed, self.steps, upscale);
        config.data.seed = DATA_SEED + seed;
        config.data.input = [(self.target / upscale).max(INPUT_LEAST); 2];
        let change = serde_json::from_str(variant.change).context(variant.name)?;
        config.change_model(&change);
        config.init = Start::Weights { path: self.backbone()?, opacity: 0.0 };
        config.check()?;
        config.model_config().context(variant.name)?;
        Ok(config)
    }

    /// Writes the shipped backbone without SubSplat's heads, and returns its file.
    fn backbone(&self) -> Result<PathBuf> {
        let file = self.trained.join("backbone.safetensors");
        if !file.is_file() {
            std::fs::create_dir_all(&self.trained)
                .with_context(|| self.trained.display().to_string())?;
            let weights = Weights::shipped(2)?.without(SUBSPLAT_PREFIX);
            let config = weights.config().context("the shipped weights hold no configuration")?;
            save(&file, weights.tensors(), config)?;
        }
        Ok(file)
    }
}

impl Chosen {
    /// Loads the model for an upscale.
    ///
    /// # Errors
    /// A file that does not fit.
    pub fn load(&self, upscale: usize) -> Result<Reconstructor> {
        let model = ModelArgs { backbone: None, preset: None, config: None };
        let (weights, ratio) = (self.file(), Some(upscale));
        model::load(&ModelRequest { weights, seed: None, upscale: None, ratio, model: &model })
    }

    /// The file, if it is one.
    pub fn file(&self) -> Option<&Path> {
        match self {
            Self::Shipped => None,
            Self::File(file) => Some(file),
        }
    }
}
