//! The model of the arguments and of the weight file.

use super::args::{BackboneArg, ModelArgs, SourceArgs};
use crate::report::print_warning;
use anyhow::{Context, Result, bail, ensure};
use std::path::Path;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::weights::{SUBSPLAT_PREFIX, Weights};
use subsplat::reconstruct::{Reconstructor, is_mvsplat};
use subsplat_kernels::layout::HEAD_GEOMETRY_LEN;

/// Default ratio of target to input.
const UPSCALE: usize = 2;

/// A command's arguments about the model.
pub struct ModelRequest<'a> {
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

impl<'a> ModelRequest<'a> {
    /// The arguments of `run` and `view`.
    pub fn from_source(source: &'a SourceArgs) -> Self {
        Self {
            weights: source.weights.as_deref(),
            seed: source.seed,
            upscale: source.children_side(),
            ratio: None,
            model: &source.model,
        }
    }
}

/// Loads the model of the arguments.
pub fn load(args: &ModelRequest) -> Result<Reconstructor> {
    let Some(path) = args.weights else { return load_default(args) };
    let weights = Weights::load(path)?;
    let contents = Contents::of(&weights);
    let config = config(args, Some((&weights, &contents)))?;
    contents.check(path, &config)?;
    let model = Reconstructor::from_weights(weights, Some(&config))
        .with_context(|| format!("{}: these weights are not of this network", path.display()))?;
    let unexpected = model.unexpected_tensors();
    if let Some(first) = unexpected.first() {
        print_warning(format!(
            "{}: {} tensors are not part of this network and are ignored, first `{first}`",
            path.display(),
            unexpected.len()
        ));
    }
    Ok(model)
}

/// Loads the model without `--weights`: the shipped one, or an untrained one where the arguments
/// name a seed, a backbone or a configuration.
fn load_default(args: &ModelRequest) -> Result<Reconstructor> {
    let mvsplat = args.model.backbone == Some(BackboneArg::Re10k);
    if args.seed.is_none() && !mvsplat && args.model.config.is_none() {
        return shipped(args);
    }
    let config = config(args, None)?;
    let seed = args.seed.unwrap_or(0);
    let effect = if is_mvsplat(&config) {
        "pictures will be noise"
    } else {
        "distances come from colours alone, and pictures will be coarse"
    };
    print_warning(format!(
        "the network is untrained (random weights of seed {seed}): {effect}; --weights names trained ones"
    ));
    Ok(Reconstructor::untrained(&config, seed)?)
}

/// Loads the shipped backbone; with SubSplat's heads unless the arguments name another preset.
fn shipped(args: &ModelRequest) -> Result<Reconstructor> {
    // Children may be finer than the target's pixels, so trained heads serve a lower ratio too.
    let least = args.ratio.map(|r| r.max(UPSCALE));
    let upscale = args.upscale.or(least).unwrap_or(UPSCALE);
    let flag = || format!("--upscale {upscale}");
    let Some(preset) = args.model.preset else {
        return Reconstructor::shipped(upscale).with_context(flag);
    };
    let weights = Weights::shipped(upscale)?.without(SUBSPLAT_PREFIX);
    let preset = Preset::from(preset);
    let config = match weights.config() {
        Some(own) => own.with_preset(preset, upscale),
        None => Config::small(preset, upscale),
    };
    Reconstructor::from_weights(weights, Some(&config)).with_context(flag)
}

/// Contents of a weight file, by its names.
struct Contents {
    mvsplat: bool,
    small: bool,
    /// K of a head that serves one K only.
    children: Option<usize>,
}

impl Contents {
    fn of(weights: &Weights) -> Self {
        let names = weights.tensors();
        let plain = |n: &'_ String| n.strip_prefix("encoder.").unwrap_or(n).to_owned();
        let any = |prefix: &str| names.keys().any(|n| plain(n).starts_with(prefix));
        // The geometry head's last layer has K times as many rows as a record, unless it serves
        // any K. Files without a configuration are converted ones; of their heads, `coord` has a
        // layer for positions besides.
        let rows = |layer: &str| {
            let name = format!("subsplat.geo.{layer}.weight");
            names
                .iter()
                .find(|(n, _)| plain(n) == name)
                .and_then(|(_, t)| t.dims().first().copied())
        };
        let any_k = weights.config().is_some_and(|c| c.spgr.head.serves_any_k());
        let fixed = !any_k && !any("subsplat.geo.pos0.");
        let children = rows("lin4").or_else(|| rows("lin1")).map(|r| r / HEAD_GEOMETRY_LEN);
        Self {
            mvsplat: any("backbone.") || any("depth_predictor."),
            small: any("small."),
            children: children.filter(|_| fixed),
        }
    }

    /// Rejects contents that cannot fit `config`, in terms of the flags.
    fn check(&self, path: &Path, config: &Config) -> Result<()> {
        let path = path.display();
        let mvsplat = is_mvsplat(config);
        ensure!(
            self.mvsplat || self.small,
            "{path}: expected the weights of a whole network (re10k or small), got a file without the part \
             that estimates distances"
        );
        if !(if mvsplat { self.mvsplat } else { self.small }) {
            let name = |mvsplat| if mvsplat { "re10k" } else { "small" };
            bail!(
                "{path}: expected weights of the network {}, got those of {}; choose it by --backbone",
                name(mvsplat),
                name(!mvsplat)
            );
        }
        let Some(children) = self.children.filter(|_| config.spgr.enabled) else { return Ok(()) };
        let fixed = !config.spgr.head.serves_any_k();
        ensure!(
            !fixed || children == config.children(),
            "{path}: expected weights for --upscale {} ({} splats a pixel), got weights for --upscale \
             {} ({children} splats a pixel); leave --upscale out, or choose other weights",
            config.upscale,
            config.children(),
            children.isqrt()
        );
        Ok(())
    }
}

fn config(args: &ModelRequest, file: Option<(&Weights, &Contents)>) -> Result<Config> {
    let open = file.is_none_or(|(_, contents)| contents.children.is_none());
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
        (None, Some(config), _) => is_mvsplat(config),
        (None, None, Some((_, contents))) => !contents.small,
        (None, None, None) => false,
    };
    // The ratio of the weights holds even where a preset replaces the rest.
    let known =
        stored.map(|c| c.upscale).or_else(|| file.and_then(|(_, c)| c.children).map(usize::isqrt));
    let wanted = upscale.or(known).unwrap_or(UPSCALE);
    let mut config = match (stored, args.model.preset) {
        (Some(config), None) if is_mvsplat(config) == mvsplat => config.clone(),
        (stored, preset) => {
            let preset = preset.map_or(Preset::Tuned, Preset::from);
            match stored.filter(|c| is_mvsplat(c) == mvsplat) {
                Some(stored) => stored.with_preset(preset, wanted),
                None if mvsplat => Config::re10k(preset, wanted),
                None => Config::small(preset, wanted),
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
