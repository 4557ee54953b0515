//! What a training is told: one TOML or JSON file, every key with a default, unknown
//! keys refused.

use super::files::Files;
use super::optimizer::Settings;
use super::schedule::Schedule;
use super::source::Augmentation;
use super::{Error, Result};
use crate::config::{Backbone, Config, Preset};
use crate::io;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A whole training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// What is learnt.
    pub phase: Phase,
    /// Seed of the weights' start, of augmentation and of what attention drops.
    pub seed: u64,
    /// Steps in all.
    pub steps: u64,
    /// Scenes whose gradients make one step, `accumulate` times.
    pub batch: usize,
    /// Batches whose gradients make one step.
    pub accumulate: usize,
    /// Scenes that pass through the backbone together: memory against calls. The
    /// rendering phase holds the graphs of so many scenes' backbones.
    pub together: usize,
    /// Groups of `together` scenes that are worked on at the same time, each with its
    /// share of the threads and a graph of its own; 0: one for each thread. The result
    /// does not depend on it.
    pub lanes: usize,
    /// The network.
    pub model: Model,
    /// Weights to begin with.
    pub init: Start,
    /// Examples.
    pub data: Data,
    /// What counts how much.
    pub loss: Weights,
    /// Adam.
    pub optimizer: Settings,
    /// Learning rate.
    pub schedule: Schedule,
    /// Files to go on from.
    pub checkpoint: Checkpoints,
    /// Looks at held-out scenes.
    pub validate: Validation,
}

/// What is learnt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Depth and confidence of the small backbone, from the generator's own; nothing is
    /// rendered.
    Depth,
    /// Pictures at target size, with depth beside them where it is known.
    #[default]
    Render,
}

/// The network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Model {
    /// `small` or `re10k`.
    pub backbone: BackboneName,
    /// `paper` or `tuned`.
    pub preset: Preset,
    /// r: target over input, side over side.
    pub upscale: usize,
    /// Keys of [`Config`] that differ from the preset's, in its JSON's nesting, for
    /// instance `{ embed = { mlp = "lite" } }`.
    pub set: Value,
}

/// Which backbone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BackboneName {
    /// Our own light network.
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

/// Weights to begin with.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Start {
    /// Drawn from the seed.
    #[default]
    Scratch,
    /// A weight file of this crate or converted: `weights.safetensors` of another run,
    /// MVSplat's checkpoint, or GMDepth's. Tensors that it lacks are drawn from the
    /// seed.
    Weights {
        /// The file.
        path: PathBuf,
        /// Added to the logit of the small backbone's opacities at the start. After the
        /// depth phase opacity is an honest confidence, squared, and so a picture dark
        /// with what shines through; 2 makes it cover.
        #[serde(default)]
        opacity: f32,
    },
}

/// Examples. Defaults: `learning.md`'s recipe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Data {
    /// Which rooms: the training set is this number.
    pub seed: u64,
    /// Distinct scenes, repeated in order; 0 for endlessly many.
    pub scenes: u64,
    /// Width and height of the network's input, px.
    pub input: [usize; 2],
    /// Views to predict, per scene.
    pub targets: usize,
    /// Samples along each side of a pixel of the context views.
    pub samples: usize,
    /// Samples along each side of a pixel of the targets.
    pub target_samples: usize,
    /// Share of scenes that are windows of pictures twice as large.
    pub crop: f32,
    /// Exposure, softness and noise of cameras on the context views.
    pub photographic: bool,
    /// Share of scenes with things close before the cameras, half out of the picture.
    pub foreground: f32,
    /// Share of scenes whose near and far are what can be seen
    /// ([`super::source::Rooms::seen_range`]).
    pub seen_range: f32,
    /// Pictures on disk in place of made-up rooms: then `scenes`, `samples`,
    /// `target_samples`, `crop`, `photographic`, `foreground` and `seen_range` mean nothing,
    /// and depth is unknown.
    pub files: Option<Files>,
    /// Scenes that are shown in turns before the next ones are made.
    pub window: u64,
    /// How often each is shown in its window.
    pub replay: u64,
    /// Threads that make examples.
    pub workers: usize,
    /// Examples that they make ahead.
    pub ahead: usize,
    /// Mirror images and the like.
    pub augment: Augmentation,
}

impl Default for Data {
    fn default() -> Self {
        Self {
            seed: 1,
            scenes: 0,
            input: [128, 128],
            targets: 1,
            samples: 2,
            target_samples: 1,
            crop: 0.5,
            photographic: true,
            foreground: 0.0,
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

/// What counts how much.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Weights {
    /// Mean squared difference of display values.
    pub mse: f64,
    /// (1 − SSIM)/2.
    pub dssim: f64,
    /// LPIPS with VGG16 (paper: 0.05); needs `lpips_weights`.
    pub lpips: f64,
    /// VGG16 and LPIPS's linear layers, converted by `subsplat-convert`.
    pub lpips_weights: Option<PathBuf>,
    /// Cross-entropy of the depth candidates to the true one.
    pub cross_entropy: f64,
    /// Smooth L1 of full-resolution disparity, in candidates.
    pub disparity: f64,
    /// Cross-entropy of confidence to exp(−error/1.5 candidates).
    pub confidence: f64,
    /// Disparity averaged around the mode, as at inference, rather than over all
    /// candidates.
    pub around_mode: bool,
    /// x of the opacity mapping (MVSplat's `opacity_mapping`) at the first step; it runs
    /// to the model's own over `opacity_steps`.
    pub opacity_start: f64,
    /// Steps of that; 0 for the model's own from the beginning.
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

/// Files to go on from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Checkpoints {
    /// Minutes between two.
    pub minutes: f64,
    /// Newest ones that stay.
    pub keep: usize,
    /// Steps in a row whose loss or gradient is not finite before the run gives up.
    pub bad_steps: usize,
}

impl Default for Checkpoints {
    fn default() -> Self {
        Self { minutes: 5.0, keep: 3, bad_steps: 10 }
    }
}

/// Looks at held-out scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Validation {
    /// Minutes between two.
    pub minutes: f64,
    /// Made-up scenes, from another seed than any that is trained on.
    pub scenes: usize,
}

impl Default for Validation {
    fn default() -> Self {
        Self { minutes: 15.0, scenes: 8 }
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
            lanes: 0,
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

/// Longest side of a training's input, px.
const INPUT_MAX: usize = 4096;

/// Puts the keys of `change` into `base`, tables into tables.
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
    /// Reads a file: JSON by its extension, else TOML. A relative path in it is taken
    /// from the file's folder.
    ///
    /// # Errors
    /// Missing; not of this form; an unknown key; a value out of range.
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

    /// From TOML, checked.
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

    /// From JSON, checked.
    ///
    /// # Errors
    /// As [`TrainConfig::load`].
    pub fn from_json(text: &str) -> Result<Self> {
        let config: Self = serde_json::from_str(text).map_err(|e| Error::Parse(e.to_string()))?;
        config.check()?;
        Ok(config)
    }

    /// JSON, for the metadata of a checkpoint.
    ///
    /// # Errors
    /// None in practice.
    pub fn to_json(&self) -> Result<String> {
        serde_json::to_string(self).map_err(|e| Error::Parse(e.to_string()))
    }

    /// The model's configuration: the preset with `model.set` put in.
    ///
    /// # Errors
    /// Keys that [`Config`] lacks, values out of range.
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

    /// Examples of one step.
    pub fn examples_per_step(&self) -> u64 {
        (self.batch * self.accumulate) as u64
    }

    /// Checks ranges, and that the parts fit one another.
    ///
    /// # Errors
    /// The first key that does not.
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
        ];
        for (key, value) in not_negative {
            if !(value >= 0.0 && value.is_finite()) {
                return Err(Error::value(key, "0 or more", value));
            }
        }
        for beta in o.betas {
            // 1 would never take a gradient in, and divides by 1 - 1.
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
            ("data.augment.flip", a.flip),
            ("data.augment.permute", a.permute),
            ("data.augment.swap", a.swap),
        ];
        for (key, value) in shares {
            if !(0.0..=1.0).contains(&value) {
                return Err(Error::value(key, "0 to 1", value));
            }
        }
        self.check_together()
    }

    /// Whole numbers. The upper ends are far beyond use; they keep products from running
    /// over, and a slip of the pen from asking for more memory or threads than there are.
    fn check_counts(&self) -> Result<()> {
        let d = &self.data;
        let counts = [
            ("steps", self.steps, 1, 1 << 32),
            ("batch", self.batch as u64, 1, 1 << 16),
            ("accumulate", self.accumulate as u64, 1, 1 << 16),
            ("together", self.together as u64, 1, 1 << 16),
            ("lanes", self.lanes as u64, 0, 1 << 10),
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

    fn check_together(&self) -> Result<()> {
        let config = self.model_config()?;
        let small = matches!(config.backbone, Backbone::Small(_));
        let stride = config.stride();
        let [w, h] = self.data.input;
        let side = |n: usize| (1..=INPUT_MAX).contains(&n) && n.is_multiple_of(stride);
        if !(side(w) && side(h)) {
            let expected = format!("multiples of {stride}, at most {INPUT_MAX}");
            return Err(Error::value("data.input", expected, format!("{w}x{h}")));
        }
        if let Start::Weights { opacity, .. } = &self.init
            && (!opacity.is_finite() || (!small && *opacity != 0.0))
        {
            let expected = "a finite number, and 0 but for the small backbone";
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
                let expected = "none in the depth phase, which needs the generator's own depth";
                return Err(Error::value("data.files", expected, files.path.display()));
            }
        }
        let learns_more = self.phase == Phase::Render && config.spgr.enabled;
        if self.optimizer.freeze_backbone && !learns_more {
            let expected = "false where nothing but the backbone is learnt";
            return Err(Error::value("optimizer.freeze_backbone", expected, true));
        }
        if self.phase == Phase::Depth && !small {
            return Err(Error::value("phase", "`render` for MVSplat's backbone", "depth"));
        }
        Ok(())
    }
}
