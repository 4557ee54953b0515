//! The configuration of a training: one TOML or JSON file. Every key has a default, and unknown
//! keys are refused.

use super::augment::Augmentation;
use super::files::Files;
use super::optimizer::Settings;
use super::schedule::Schedule;
use super::source::ExampleSize;
use super::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};
use subsplat::files as io;
use subsplat::network::config::{Backbone, Config, Preset};
use subsplat::network::model::trunk::UPSCALE_MAX;

/// Configuration of a training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Objective of the training.
    pub phase: Phase,
    /// Seed of the initial weights, of augmentation and of dropout in attention.
    pub seed: u64,
    /// Total number of steps.
    pub steps: u64,
    /// Scenes of a batch.
    pub batch: usize,
    /// Batches whose gradients form one step.
    pub accumulate: usize,
    /// Scenes that pass through the backbone together. More scenes need fewer calls and more
    /// memory; the rendering phase holds the graphs of that many backbones.
    pub together: usize,
    /// Groups of `together` scenes that are processed in parallel, each with its share of the
    /// threads and a separate graph; 0: one group per thread. The result does not depend on it. A
    /// GPU takes one group at a time.
    #[serde(rename = "lanes")]
    pub parallel_groups: usize,
    /// Device of network and rasterizer: `cpu`, `auto`, `gpu`, or a part of an adapter's name.
    /// Losses, placement of the primaries and summation of gradients run on the CPU. A
    /// training can go on with another device.
    pub device: String,
    /// Configuration of the network.
    pub model: Model,
    /// Initial weights.
    pub init: Start,
    /// Training examples.
    pub data: Data,
    /// Weights of the loss terms.
    pub loss: Weights,
    /// Options of Adam.
    pub optimizer: Settings,
    /// Learning rate.
    pub schedule: Schedule,
    /// Options of the checkpoints.
    pub checkpoint: Checkpoints,
    /// Options of the validation.
    pub validate: Validation,
}

/// Objective of a training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Depth and confidence of the small backbone, supervised by the generator's depth. Nothing is
    /// rendered.
    Depth,
    /// Pictures at target size, with depth losses where depth is known.
    #[default]
    Render,
}

/// Configuration of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Model {
    /// `small` or `re10k`.
    pub backbone: BackboneName,
    /// `paper` or `tuned`.
    pub preset: Preset,
    /// Upscale factor r: side of the target over side of the input.
    pub upscale: usize,
    /// Keys of [`Config`] that differ from the preset, nested as in its JSON, for instance `{ embed
    /// = { mlp = "lite" } }`.
    pub set: Value,
}

/// Name of a backbone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BackboneName {
    /// The small backbone of this crate.
    Small,
    /// MVSplat.
    Re10k,
}

impl Default for Model {
    fn default() -> Self {
        Self {
            backbone: BackboneName::Small,
            preset: Preset::Tuned,
            upscale: 2,
            set: Value::Object(serde_json::Map::new()),
        }
    }
}

/// Initial weights.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Start {
    /// Random weights from the seed.
    #[default]
    Scratch,
    /// A weight file of this crate or a converted one: `weights.safetensors` of another training,
    /// MVSplat's checkpoint, or GMDepth's. Missing tensors take random values from the seed.
    Weights {
        /// Path of the file.
        path: PathBuf,
        /// Offset of the small backbone's opacity logits at the start. After the depth phase the
        /// opacity is the squared confidence, and rendered pictures are dark and transparent. An
        /// offset of 2 makes surfaces opaque.
        #[serde(default)]
        opacity: f32,
    },
}

/// Training examples. The defaults are those of the training recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Data {
    /// Seed of the rooms, which determines the training set.
    pub seed: u64,
    /// Number of distinct scenes, which repeat in order; 0 for unlimited.
    pub scenes: u64,
    /// Width and height of the network's input, px.
    pub input: [usize; 2],
    /// Sizes of the scenes, by turns, instead of `input` and `model.upscale`. Upscales that differ
    /// need heads that serve any K, and inputs that differ need `together = 1`.
    pub sizes: Vec<ExampleSize>,
    /// Views to predict per scene.
    pub targets: usize,
    /// Samples along each side of a pixel of the context views.
    pub samples: usize,
    /// Samples along each side of a pixel of the targets.
    pub target_samples: usize,
    /// Share of scenes whose pictures are windows of pictures twice as large.
    pub crop: f32,
    /// Applies exposure, softness and noise of cameras to the context views.
    pub photographic: bool,
    /// Share of scenes with objects close to the cameras, partly outside the picture.
    pub foreground: f32,
    /// Share of scenes that show shapes at random places, indoors or outdoors, instead of a
    /// furnished room.
    pub scattered: f32,
    /// Share of furnished rooms with objects in the air.
    pub floating: f32,
    /// Share of scenes with baselines of uniform logarithm
    /// ([`crate::data::procedural::CameraRange::LogBaseline`]).
    pub log_baseline: f32,
    /// Share of scenes with a wide range of fields of view, baselines and rotations
    /// ([`crate::data::procedural::CameraRange::Wide`]).
    pub wide: f32,
    /// Adds the context views, at the targets' size, to the targets. The render phase only.
    pub input_targets: bool,
    /// Share of the scenes with `input_targets` whose children take the detail of these pictures, as
    /// `subsplat run` does with photographs larger than the input.
    pub detail: f32,
    /// Share of scenes whose near and far are the visible depth range
    /// ([`super::source::Rooms::seen_range`]).
    pub seen_range: f32,
    /// Pictures on disk instead of procedural rooms. `scenes`, `samples`, `target_samples`, `crop`,
    /// `photographic`, `foreground`, `scattered`, `floating`, `log_baseline`, `wide`,
    /// `input_targets`, `detail` and `seen_range` are then ignored, and depth is unknown.
    pub files: Option<Files>,
    /// Scenes that are repeated before the next ones are made.
    pub window: u64,
    /// Repetitions of each scene of a window.
    pub replay: u64,
    /// Threads that make examples.
    pub workers: usize,
    /// Examples made ahead.
    pub ahead: usize,
    /// Mirroring and other augmentation.
    pub augment: Augmentation,
}

impl Default for Data {
    fn default() -> Self {
        Self {
            seed: 1,
            scenes: 0,
            input: [128, 128],
            sizes: Vec::new(),
            targets: 1,
            samples: 2,
            target_samples: 1,
            crop: 0.5,
            photographic: true,
            foreground: 0.0,
            scattered: 0.0,
            floating: 0.0,
            log_baseline: 0.0,
            wide: 0.0,
            input_targets: false,
            detail: 0.0,
            seen_range: 0.0,
            files: None,
            window: 256,
            replay: 1,
            workers: 1,
            ahead: 16,
            augment: Augmentation::default(),
        }
    }
}

/// Weights of the loss terms.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Weights {
    /// Mean squared difference of display values.
    pub mse: f64,
    /// (1 − SSIM)/2.
    pub dssim: f64,
    /// LPIPS with VGG16 (SubSplat: 0.05); needs `lpips_weights`.
    pub lpips: f64,
    /// VGG16 and LPIPS's linear layers, converted by `subsplat-convert`.
    pub lpips_weights: Option<PathBuf>,
    /// Cross-entropy of the depth candidates.
    pub cross_entropy: f64,
    /// Smooth L1 of full-resolution disparity, in candidates.
    pub disparity: f64,
    /// Cross-entropy of confidence to exp(−error/1.5 candidates).
    pub confidence: f64,
    /// Averages disparity around the mode, as at inference, instead of over all candidates.
    pub around_mode: bool,
    /// Exponent x of the opacity mapping (MVSplat's `opacity_mapping`) at the first step. It
    /// changes linearly to the model's own value over `opacity_steps`.
    pub opacity_start: f64,
    /// Steps of that change; with 0 the model's own value applies from the start.
    pub opacity_steps: u64,
}

impl Default for Weights {
    fn default() -> Self {
        Self {
            mse: 1.0,
            dssim: 0.05,
            lpips: 0.0,
            lpips_weights: None,
            cross_entropy: 0.25,
            disparity: 0.1,
            confidence: 0.1,
            around_mode: false,
            opacity_start: 0.0,
            opacity_steps: 0,
        }
    }
}

/// Options of the checkpoints.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Checkpoints {
    /// Minutes between two checkpoints or validations.
    pub minutes: f64,
    /// Number of newest checkpoints to keep.
    pub keep: usize,
    /// Consecutive steps with a loss or gradient that is not finite before the training stops.
    pub bad_steps: usize,
}

impl Default for Checkpoints {
    fn default() -> Self {
        Self { minutes: 5.0, keep: 3, bad_steps: 10 }
    }
}

/// Options of the validation on held-out scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Validation {
    /// Minutes between two checkpoints or validations.
    pub minutes: f64,
    /// Steps between two validations, instead of `minutes`; 0: `minutes` decides.
    pub steps: u64,
    /// Number of procedural scenes, from a seed that training does not use.
    pub scenes: usize,
}

impl Default for Validation {
    fn default() -> Self {
        Self { minutes: 15.0, steps: 0, scenes: 8 }
    }
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            phase: Phase::Render,
            seed: 0,
            steps: 20_000,
            batch: 4,
            accumulate: 1,
            together: 1,
            parallel_groups: 0,
            device: "cpu".to_owned(),
            model: Model::default(),
            init: Start::Scratch,
            data: Data::default(),
            loss: Weights::default(),
            optimizer: Settings::default(),
            schedule: Schedule::Cosine { rate: 1.5e-3, warmup: 100, hold: 0, floor: 0.0 },
            checkpoint: Checkpoints::default(),
            validate: Validation::default(),
        }
    }
}

/// Largest side of the network's input in a training, px.
const INPUT_MAX: usize = 4096;

/// Merges the keys of `change` into `base`, recursively for tables.
fn merge(base: &mut Value, change: &Value) {
    match (base, change) {
        (Value::Object(base), Value::Object(change)) => {
            for (key, value) in change {
                merge(base.entry(key.clone()).or_insert(Value::Null), value);
            }
        }
        (base, change) => *base = change.clone(),
    }
}

impl TrainConfig {
    /// Reads a file: JSON by its extension, otherwise TOML. Relative paths in it are relative to
    /// the file's folder.
    ///
    /// # Errors
    /// A missing file; another format; an unknown key; a value out of range.
    pub fn load(path: &Path) -> Result<Self> {
        let bytes = io::read(path)?;
        let text = String::from_utf8(bytes)
            .map_err(|_| io::Error::format(path, "text", "bytes that are not UTF-8"))?;
        let json = path.extension().is_some_and(|e| e == "json");
        let parsed = if json { Self::from_json(&text) } else { Self::from_toml(&text) };
        let mut config = parsed.map_err(|e| match e {
            Error::Parse(got) => io::Error::format(path, "a training configuration", got).into(),
            other => other,
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        if let Start::Weights { path, .. } = &mut config.init {
            *path = folder.join(&*path);
        }
        if let Some(files) = &mut config.data.files {
            files.path = folder.join(&files.path);
        }
        if let Some(path) = &mut config.loss.lpips_weights {
            *path = folder.join(&*path);
        }
        Ok(config)
    }

    /// Parses and validates TOML.
    ///
    /// # Errors
    /// As [`TrainConfig::load`].
    pub fn from_toml(text: &str) -> Result<Self> {
        let config: Self = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |s| 1 + text[..s.start].matches('\n').count());
            Error::Parse(format!("line {line}: {}", e.message()))
        })?;
        config.check()?;
        Ok(config)
    }

    /// Parses and validates JSON.
    ///
    /// # Errors
    /// As [`TrainConfig::load`].
    pub fn from_json(text: &str) -> Result<Self> {
        let config: Self = serde_json::from_str(text).map_err(|e| Error::Parse(e.to_string()))?;
        config.check()?;
        Ok(config)
    }

    /// Serialises to JSON, for the metadata of a checkpoint.
    ///
    /// # Errors
    /// None in practice.
    pub fn to_json(&self) -> Result<String> {
        serde_json::to_string(self).map_err(|e| Error::Parse(e.to_string()))
    }

    /// Returns the model's configuration: the preset with the keys of `model.set`.
    ///
    /// # Errors
    /// Unknown keys of [`Config`]; values out of range.
    pub fn model_config(&self) -> Result<Config> {
        let m = &self.model;
        let preset = match m.backbone {
            BackboneName::Small => Config::small(m.preset, m.upscale),
            BackboneName::Re10k => Config::re10k(m.preset, m.upscale),
        };
        let mut json = serde_json::to_value(preset).map_err(|e| Error::Parse(e.to_string()))?;
        merge(&mut json, &m.set);
        Ok(Config::from_json(&json.to_string())?)
    }

    /// Changes keys of the model's configuration, nested as in its JSON.
    pub fn change_model(&mut self, change: &Value) {
        merge(&mut self.model.set, change);
    }

    /// Returns the number of examples of one step.
    pub fn examples_per_step(&self) -> u64 {
        (self.batch * self.accumulate) as u64
    }

    /// Validates the ranges, and the combinations of options.
    ///
    /// # Errors
    /// The first invalid key.
    pub fn check(&self) -> Result<()> {
        self.check_counts()?;
        let o = &self.optimizer;
        let l = &self.loss;
        let not_negative = [
            ("optimizer.weight_decay", o.weight_decay),
            ("optimizer.clip", o.clip),
            ("optimizer.backbone_rate", o.backbone_rate),
            ("schedule.rate", self.schedule.peak()),
            ("loss.mse", l.mse),
            ("loss.dssim", l.dssim),
            ("loss.lpips", l.lpips),
            ("loss.cross_entropy", l.cross_entropy),
            ("loss.disparity", l.disparity),
            ("loss.confidence", l.confidence),
            ("checkpoint.minutes", self.checkpoint.minutes),
            ("validate.minutes", self.validate.minutes),
            ("data.augment.rotation_error", self.data.augment.rotation_error),
        ];
        for (key, value) in not_negative {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(Error::value(key, "0 or more", value));
            }
        }
        for beta in o.betas {
            // 1 would ignore all gradients and divide by 0.
            if !(0.0..1.0).contains(&beta) {
                return Err(Error::value("optimizer.betas", "two numbers in [0, 1)", beta));
            }
        }
        if !(o.epsilon > 0.0 && o.epsilon.is_finite()) {
            return Err(Error::value("optimizer.epsilon", "above 0", o.epsilon));
        }
        if !l.opacity_start.is_finite() {
            return Err(Error::value("loss.opacity_start", "a finite number", l.opacity_start));
        }
        let floor = match self.schedule {
            Schedule::Cosine { floor, .. } => floor,
            Schedule::OneCycle { .. } => 0.0,
        };
        let a = &self.data.augment;
        let shares = [
            ("optimizer.average", o.average),
            ("schedule.floor", floor),
            ("data.crop", f64::from(self.data.crop)),
            ("data.seen_range", f64::from(self.data.seen_range)),
            ("data.foreground", f64::from(self.data.foreground)),
            ("data.scattered", f64::from(self.data.scattered)),
            ("data.floating", f64::from(self.data.floating)),
            ("data.log_baseline", f64::from(self.data.log_baseline)),
            ("data.wide", f64::from(self.data.wide)),
            ("data.detail", f64::from(self.data.detail)),
            ("data.augment.flip", a.flip),
            ("data.augment.permute", a.permute),
            ("data.augment.swap", a.swap),
            ("data.augment.photographic", a.photographic),
            ("data.augment.focal_error", a.focal_error),
        ];
        for (key, value) in shares {
            if !(0.0..=1.0).contains(&value) {
                return Err(Error::value(key, "0 to 1", value));
            }
        }
        self.check_combinations()
    }

    /// Validates the whole numbers. The upper bounds are far beyond practical values. They prevent
    /// overflow of products, and a mistyped number from requesting excessive memory or threads.
    fn check_counts(&self) -> Result<()> {
        let d = &self.data;
        let counts = [
            ("steps", self.steps, 1, 1 << 32),
            ("batch", self.batch as u64, 1, 1 << 16),
            ("accumulate", self.accumulate as u64, 1, 1 << 16),
            ("together", self.together as u64, 1, 1 << 16),
            ("lanes", self.parallel_groups as u64, 0, 1 << 10),
            ("data.targets", d.targets as u64, 1, 1 << 10),
            ("data.samples", d.samples as u64, 1, 1 << 6),
            ("data.target_samples", d.target_samples as u64, 1, 1 << 6),
            ("data.window", d.window, 1, 1 << 31),
            ("data.replay", d.replay, 1, 1 << 31),
            ("data.workers", d.workers as u64, 1, 1 << 10),
            ("data.ahead", d.ahead as u64, 1, 1 << 16),
            ("checkpoint.keep", self.checkpoint.keep as u64, 1, 1 << 32),
            ("checkpoint.bad_steps", self.checkpoint.bad_steps as u64, 1, 1 << 32),
            ("validate.scenes", self.validate.scenes as u64, 0, 1 << 16),
        ];
        match counts.into_iter().find(|(_, value, low, high)| !(low..=high).contains(&value)) {
            Some((key, value, low, high)) => {
                Err(Error::value(key, format!("{low} to {high}"), value))
            }
            None => Ok(()),
        }
    }

    /// Validates the sizes of the scenes.
    fn check_sizes(&self, config: &Config) -> Result<()> {
        let sizes = &self.data.sizes;
        let any = config.spgr.enabled && config.spgr.head.serves_any_k();
        for size in sizes {
            let r = size.upscale;
            let fits = any || size.upscale == config.upscale;
            if !(1..=UPSCALE_MAX).contains(&r) || !fits {
                let expected = if any {
                    format!("an upscale of 1 to {UPSCALE_MAX}")
                } else {
                    format!("the model's upscale, {}", config.upscale)
                };
                return Err(Error::value("data.sizes", expected, r));
            }
        }
        let differ = sizes.iter().any(|s| s.input != sizes[0].input);
        if differ && self.together > 1 {
            let expected = "1, since the inputs of data.sizes differ";
            return Err(Error::value("together", expected, self.together));
        }
        Ok(())
    }

    /// Validates options that depend on one another.
    fn check_combinations(&self) -> Result<()> {
        let config = self.model_config()?;
        let small = matches!(config.backbone, Backbone::Small(_));
        let stride = config.stride();
        let side = |n: usize| (1..=INPUT_MAX).contains(&n) && n.is_multiple_of(stride);
        let inputs = self.data.sizes.iter().map(|s| ("data.sizes", s.input));
        for (key, [w, h]) in inputs.chain([("data.input", self.data.input)]) {
            if !(side(w) && side(h)) {
                let expected = format!("multiples of {stride}, at most {INPUT_MAX}");
                return Err(Error::value(key, expected, format!("{w}x{h}")));
            }
        }
        self.check_sizes(&config)?;
        if let Start::Weights { opacity, .. } = &self.init
            && (!opacity.is_finite() || (!small && *opacity != 0.0))
        {
            let expected = "a finite number; 0 for MVSplat's backbone";
            return Err(Error::value("init.opacity", expected, opacity));
        }
        if self.loss.lpips > 0.0 && self.loss.lpips_weights.is_none() {
            return Err(Error::value(
                "loss.lpips",
                "0, or loss.lpips_weights with a file",
                self.loss.lpips,
            ));
        }
        if let Some(files) = &self.data.files {
            files.check()?;
            if self.phase == Phase::Depth {
                let expected = "no files in the depth phase, which needs the generator's depth";
                return Err(Error::value("data.files", expected, files.path.display()));
            }
        }
        let updates_heads = self.phase == Phase::Render && config.spgr.enabled;
        if self.optimizer.freeze_backbone && !updates_heads {
            let expected = "false, since this training updates the backbone only";
            return Err(Error::value("optimizer.freeze_backbone", expected, true));
        }
        if self.phase == Phase::Depth && !small {
            return Err(Error::value("phase", "`render` for MVSplat's backbone", "depth"));
        }
        Ok(())
    }
}
