//! Which model the arguments, and the weight file, ask for.

use super::args::{BackboneArg, ModelArgs, SourceArgs};
use crate::report::{say, warn};
use anyhow::{Context, Result, bail, ensure};
use std::path::Path;
use subsplat::abi::HEAD_GEOMETRY_LEN;
use subsplat::config::{Config, Preset, SpgrHead};
use subsplat::model::weights::{SUBSPLAT_PREFIX, Weights};
use subsplat::pipeline::{self, Reconstructor};

/// Target over input where nothing says otherwise.
const UPSCALE: usize = 2;

/// What a command's arguments say of the model.
pub struct Asked<'a> {
    /// `--weights`.
    pub weights: Option<&'a Path>,
    /// `--seed`: untrained weights.
    pub seed: Option<u64>,
    /// r: side of the children's grid, K = r²; must fit the weights.
    pub upscale: Option<usize>,
    /// Target over input: the least r where the weights leave it open.
    pub ratio: Option<usize>,
    /// `--backbone`, `--preset`, `--config`.
    pub model: &'a ModelArgs,
}

impl<'a> Asked<'a> {
    /// What `run` and `view` are told.
    pub fn of(source: &'a SourceArgs) -> Self {
        Self {
            weights: source.weights.as_deref(),
            seed: source.seed,
            upscale: source.upscale,
            ratio: None,
            model: &source.model,
        }
    }
}

/// The model that the arguments ask for.
pub fn load(args: &Asked) -> Result<Reconstructor> {
    let Some(path) = args.weights else { return unasked(args) };
    let weights = Weights::load(path)?;
    let holds = Holds::of(&weights);
    let config = config(args, Some((&weights, &holds)))?;
    holds.check(path, &config)?;
    let model = Reconstructor::from_weights(weights, Some(&config))
        .with_context(|| format!("{}: does not fit the model", path.display()))?;
    let untrained = model.untrained_tensors().len();
    if untrained > 0 && !holds.subsplat {
        say(format!(
            "{}: holds a backbone alone; SubSplat's {untrained} tensors start untrained: children \
             are the plain split of their parents",
            path.display()
        ));
    } else if untrained > 0 {
        warn(format!("{}: {untrained} of SubSplat's tensors are missing", path.display()));
    }
    let unexpected = model.unexpected_tensors();
    if let Some(first) = unexpected.first() {
        warn(format!(
            "{}: {} tensors are not part of this model, first `{first}`",
            path.display(),
            unexpected.len()
        ));
    }
    Ok(model)
}

/// Without `--weights`: those that ship, or untrained ones where the arguments ask for a
/// model or a start of their own.
fn unasked(args: &Asked) -> Result<Reconstructor> {
    let mvsplat = args.model.backbone == Some(BackboneArg::Re10k);
    if args.seed.is_none() && !mvsplat && args.model.config.is_none() {
        let model = shipped(args)?;
        if !model.untrained_tensors().is_empty() {
            say(
                "SubSplat's heads of the weights that ship start untrained for this --upscale and \
                 preset: children are the plain split of their parents",
            );
        }
        return Ok(model);
    }
    let (config, seed) = (config(args, None)?, args.seed.unwrap_or(0));
    let what = match pipeline::is_mvsplat(&config) {
        true => "MVSplat's network gives noise with them",
        false => "the small network is then a plain plane sweep, without anything learned",
    };
    warn(format!("no --weights: using seeded random weights (seed {seed}); {what}"));
    Ok(Reconstructor::untrained(&config, seed)?)
}

/// The shipped backbone, with SubSplat's heads where the arguments leave them their own
/// preset and r.
fn shipped(args: &Asked) -> Result<Reconstructor> {
    // Children finer than the target's pixels do it no harm, so heads that were trained
    // serve a lower ratio too.
    let least = args.ratio.map(|r| r.max(UPSCALE));
    let upscale = args.upscale.or(least).unwrap_or(UPSCALE);
    let asked = || format!("--upscale {upscale}");
    let Some(preset) = args.model.preset else {
        return Reconstructor::shipped(upscale).with_context(asked);
    };
    let weights = Weights::shipped(upscale)?.without(SUBSPLAT_PREFIX);
    let preset = Preset::from(preset);
    let config = match weights.config() {
        Some(own) => own.with_preset(preset, upscale),
        None => Config::small(preset, upscale),
    };
    Reconstructor::from_weights(weights, Some(&config)).with_context(asked)
}

/// What a weight file holds, by its names.
struct Holds {
    mvsplat: bool,
    small: bool,
    subsplat: bool,
    /// K of a head that serves one K only.
    children: Option<usize>,
}

impl Holds {
    fn of(weights: &Weights) -> Self {
        let names = weights.tensors();
        let plain = |n: &'_ String| n.strip_prefix("encoder.").unwrap_or(n).to_owned();
        let any = |prefix: &str| names.keys().any(|n| plain(n).starts_with(prefix));
        // Rows of the geometry head's last layer: K times its lanes. The `coord` head
        // has one lane set for any K, and a layer for places besides.
        let rows = |layer: &str| {
            let name = format!("subsplat.geo.{layer}.weight");
            names
                .iter()
                .find(|(n, _)| plain(n) == name)
                .and_then(|(_, t)| t.dims().first().copied())
        };
        let fixed = !any("subsplat.geo.pos0.");
        let children = rows("lin4").or_else(|| rows("lin1")).map(|r| r / HEAD_GEOMETRY_LEN);
        Self {
            mvsplat: any("backbone.") || any("depth_predictor."),
            small: any("small."),
            subsplat: any("subsplat."),
            children: children.filter(|_| fixed),
        }
    }

    /// Refuses what cannot fit `config`, in the user's words.
    fn check(&self, path: &Path, config: &Config) -> Result<()> {
        let path = path.display();
        let wants = pipeline::is_mvsplat(config);
        ensure!(
            self.mvsplat || self.small,
            "{path}: expected the weights of a backbone (re10k or small), got a file without one"
        );
        if !(if wants { self.mvsplat } else { self.small }) {
            let name = |mvsplat| if mvsplat { "re10k" } else { "small" };
            bail!(
                "{path}: expected weights of the {} backbone, got the {} one",
                name(wants),
                name(!wants)
            );
        }
        let Some(children) = self.children.filter(|_| config.spgr.enabled) else { return Ok(()) };
        let fixed = config.spgr.head != SpgrHead::Coord;
        ensure!(
            !fixed || children == config.children(),
            "{path}: expected weights for --upscale {} ({} children per pixel), got weights for \
             --upscale {} ({children} children)",
            config.upscale,
            config.children(),
            children.isqrt()
        );
        Ok(())
    }
}

fn config(args: &Asked, file: Option<(&Weights, &Holds)>) -> Result<Config> {
    let open = file.is_none_or(|(_, holds)| holds.children.is_none());
    let upscale = args.upscale.or(args.ratio.filter(|_| open));
    if let Some(path) = &args.model.config {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let mut config = Config::from_json(&text).with_context(|| path.display().to_string())?;
        config.upscale = upscale.unwrap_or(config.upscale);
        config.check()?;
        return Ok(config);
    }
    let stored = file.and_then(|(weights, _)| weights.config());
    let mvsplat = match (args.model.backbone, stored, file) {
        (Some(backbone), ..) => backbone == BackboneArg::Re10k,
        (None, Some(config), _) => pipeline::is_mvsplat(config),
        (None, None, Some((_, holds))) => !holds.small,
        (None, None, None) => false,
    };
    // What the weights were made for, even where a preset replaces the rest.
    let known =
        stored.map(|c| c.upscale).or_else(|| file.and_then(|(_, h)| h.children).map(usize::isqrt));
    let wanted = upscale.or(known).unwrap_or(UPSCALE);
    let mut config = match (stored, args.model.preset) {
        (Some(config), None) if pipeline::is_mvsplat(config) == mvsplat => config.clone(),
        (stored, preset) => {
            let preset = preset.map_or(Preset::Tuned, Preset::from);
            match stored.filter(|c| pipeline::is_mvsplat(c) == mvsplat) {
                Some(stored) => stored.with_preset(preset, wanted),
                None => pipeline::preset(mvsplat, preset, wanted),
            }
        }
    };
    config.upscale = wanted;
    config.check().with_context(|| match upscale {
        Some(r) => format!("--upscale {r}"),
        None => "model".to_owned(),
    })?;
    Ok(config)
}
