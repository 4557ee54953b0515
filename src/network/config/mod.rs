//! Hyper-parameters of the model: symbol, source, default. One [`Config`] describes one
//! model. The two presets are [`Preset`]; the paper's ablations are groups of their own
//! ([`AggregationAblations`], [`SpgrAblations`]).
//!
//! Sources: "paper" and "supp." are SubSplat's main text and supplement, "MVS" is
//! MVSplat (arXiv 2403.14627) with its released `re10k` configuration.
//!
//! A configuration serialises to JSON, which a weight file holds in its metadata (key
//! [`Config::METADATA_KEY`]). An unknown key is an error that names the key.

mod aggregation;
mod backbone;
mod check;
mod spgr;

pub use aggregation::*;
pub use backbone::*;
pub use spgr::*;

use serde::{Deserialize, Serialize};
use std::str::FromStr;
use subsplat_kernels::layout::{Convention, LOWPASS, RasterOptions, ShDirection};
use thiserror::Error;

/// The reason that a configuration is invalid.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// Not JSON, an unknown key, or a value of the wrong type.
    #[error("configuration: {0}")]
    Parse(#[from] serde_json::Error),
    /// A value outside its range, or two that do not fit each other.
    #[error("configuration key `{key}`: expected {expected}, got {got}")]
    Value {
        /// Dotted path of the key.
        key: &'static str,
        /// Accepted values.
        expected: String,
        /// The value found.
        got: String,
    },
    /// An unknown preset.
    #[error("preset: expected {expected}, got `{got}`")]
    Preset {
        /// The known names.
        expected: &'static str,
        /// The name found.
        got: String,
    },
}

/// The whole model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// r: side of the target picture over side of the input; K = r² children per
    /// primary (paper: 2 and 4).
    pub upscale: usize,
    /// The network from images and cameras to depth, opacity and raw Gaussian
    /// parameters.
    pub backbone: Backbone,
    /// Attribute embeddings of the primaries (SubSplat A.2).
    pub embed: Embed,
    /// Deformable attention over the views' features (SubSplat A.2).
    pub agg: Aggregation,
    /// Sub-pixel Gaussian reparameterization (SubSplat 3.2, supp. A.3).
    pub spgr: Spgr,
    /// Options for rendering the result.
    pub render: Render,
}

/// Options for rendering the result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Render {
    /// Rules of the rasterizer.
    pub convention: Convention,
    /// Low-pass, px² (3DGS: 0.3).
    pub lowpass: f32,
    /// The image whose pixels `lowpass` counts.
    pub lowpass_ref: LowpassRef,
    /// Highest SH degree evaluated (3DGS: 3).
    pub sh_degree: usize,
    /// Direction of view-dependent colour.
    pub sh_dir: ShDirection,
    /// Colour of pixels without a Gaussian.
    #[serde(default)]
    pub background: Background,
}

impl Render {
    /// Returns the low-pass, px², of an image whose side is `ratio` times the side of the
    /// network's input.
    pub fn lowpass_px2(&self, ratio: f32) -> f32 {
        match self.lowpass_ref {
            LowpassRef::Target => self.lowpass,
            LowpassRef::Input => self.lowpass * ratio * ratio,
        }
    }
}

/// Colour of pixels without a Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// Black (MVSplat).
    #[default]
    Black,
    /// The mean colour of the network's input images, since a black hole costs more than a grey
    /// one. Not for MVSplat, whose weights were trained over black.
    Inputs,
}

/// The image whose pixels the low-pass counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LowpassRef {
    /// The rendered image (3DGS).
    Target,
    /// The network's input: a low-pass r² times as large, which gives the coverage of a
    /// render at the input's size.
    Input,
}

/// SubSplat's part of the configuration: as the paper describes it, or corrected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// The paper's equations, for its tables and for weights trained with them.
    #[default]
    Paper,
    /// `paper` with the corrections of ARCHITECTURE.md, "Where the paper is silent".
    Tuned,
}

impl FromStr for Preset {
    type Err = ConfigError;

    fn from_str(s: &str) -> Result<Self, ConfigError> {
        match s {
            "paper" => Ok(Preset::Paper),
            "tuned" => Ok(Preset::Tuned),
            _ => Err(ConfigError::Preset { expected: "`paper` or `tuned`", got: s.to_owned() }),
        }
    }
}

impl Config {
    /// Key of the JSON form in the metadata of a safetensors file.
    pub const METADATA_KEY: &'static str = "subsplat.config";

    fn preset(backbone: Backbone, preset: Preset, upscale: usize) -> Self {
        let (convention, background) = match &backbone {
            Backbone::Mvsplat(_) => (Convention::Mvsplat, Background::Black),
            Backbone::Small(_) => (Convention::Standard, Background::Inputs),
        };
        Self {
            upscale,
            backbone,
            embed: Embed::preset(preset),
            agg: Aggregation::preset(preset),
            spgr: Spgr::preset(preset),
            render: Render {
                convention,
                lowpass: LOWPASS,
                lowpass_ref: LowpassRef::Target,
                sh_degree: 3,
                sh_dir: ShDirection::Child,
                background,
            },
        }
    }

    /// Returns MVSplat's `re10k` backbone with SubSplat's additions. `tuned` also rotates
    /// the colour coefficients exactly ([`ShFrame::MvsplatExact`]).
    pub fn re10k(preset: Preset, upscale: usize) -> Self {
        let mut backbone = Mvsplat::re10k();
        if preset == Preset::Tuned {
            backbone.primaries.sh_frame = ShFrame::MvsplatExact;
        }
        Self::preset(Backbone::Mvsplat(backbone), preset, upscale)
    }

    /// Returns the small backbone with SubSplat's additions.
    pub fn small(preset: Preset, upscale: usize) -> Self {
        Self::preset(Backbone::Small(Small::standard()), preset, upscale)
    }

    /// Returns another preset and r for the same backbone. The backbone's shape stays; its
    /// SH frame becomes the preset's.
    #[must_use]
    pub fn with_preset(&self, preset: Preset, upscale: usize) -> Self {
        match self.backbone.clone() {
            Backbone::Mvsplat(mut b) => {
                let mut config = Self::re10k(preset, upscale);
                b.primaries.sh_frame = config.primaries().sh_frame;
                config.backbone = Backbone::Mvsplat(b);
                config
            }
            small => Self::preset(small, preset, upscale),
        }
    }

    /// Returns the paper's ×2 model: 256 → 512, K = 4.
    pub fn x2() -> Self {
        Self::re10k(Preset::Paper, 2)
    }

    /// Returns the paper's ×4 model: 256 → 1024, K = 16.
    pub fn x4() -> Self {
        Self::re10k(Preset::Paper, 4)
    }

    /// Returns the rasterizer's options for an image whose side is `ratio` times the side
    /// of the network's input. `near`: the nearest depth candidate, world units; `inputs`:
    /// mean RGB of the network's input images.
    pub fn raster_options(&self, ratio: f32, near: f32, inputs: [f32; 3]) -> RasterOptions {
        let render = &self.render;
        let mut options = RasterOptions::new(render.convention);
        options.sh_degree = render.sh_degree;
        options.sh_direction = render.sh_dir;
        options.lowpass = render.lowpass_px2(ratio);
        if render.convention == Convention::Mvsplat {
            options.near = near;
        }
        if render.background == Background::Inputs {
            options.background = inputs;
        }
        options
    }

    /// Returns K, the children per primary: r².
    pub fn children(&self) -> usize {
        self.upscale * self.upscale
    }

    /// Returns shape, colour and frame of the backbone's primaries.
    pub fn primaries(&self) -> &Primaries {
        match &self.backbone {
            Backbone::Mvsplat(b) => &b.primaries,
            Backbone::Small(b) => &b.primaries,
        }
    }

    /// Returns the number, px, of which the input's side lengths must be multiples.
    pub fn stride(&self) -> usize {
        match &self.backbone {
            Backbone::Mvsplat(b) => Self::stride_of(b),
            Backbone::Small(b) => 4 << (b.unet_channels.len() - 1),
        }
    }

    /// Returns [`Config::stride`] of MVSplat: the least common multiple of patch size 4 ×
    /// downscale 4 (MVS patch shim), the halvings of the refinement U-Net, and the windows
    /// and the cost-volume U-Net's halvings of the 1/4 map.
    pub fn stride_of(b: &Mvsplat) -> usize {
        let common = |a: usize, b: usize| {
            let (mut x, mut y) = (a, b);
            while y > 0 {
                (x, y) = (y, x % y);
            }
            a / x.max(1) * b
        };
        let halvings = 16usize.max(1 << (b.refine_levels - 1)).max(4 << (b.costvolume_levels - 1));
        common(halvings, 4 * b.window_splits)
    }

    /// Returns the JSON for the metadata of a weight file.
    ///
    /// # Errors
    /// None in practice: every configuration can be serialised.
    pub fn to_json(&self) -> Result<String, ConfigError> {
        Ok(serde_json::to_string(self)?)
    }

    /// Reads the form of [`Config::to_json`] and checks it.
    ///
    /// # Errors
    /// Unknown or missing keys, values of the wrong type or range.
    pub fn from_json(json: &str) -> Result<Self, ConfigError> {
        let config: Self = serde_json::from_str(json)?;
        config.check()?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> Vec<Config> {
        let mut all = Vec::new();
        for preset in [Preset::Paper, Preset::Tuned] {
            for upscale in [1, 2, 3, 4] {
                all.push(Config::re10k(preset, upscale));
                all.push(Config::small(preset, upscale));
            }
        }
        all
    }

    #[test]
    fn presets_are_valid_and_survive_json() {
        for config in all() {
            config.check().unwrap();
            let back = Config::from_json(&config.to_json().unwrap()).unwrap();
            assert_eq!(config, back);
        }
    }

    #[test]
    fn bad_values_are_refused_by_key() {
        let mut c = Config::x2();
        c.spgr.delta = 1.5;
        assert!(c.check().unwrap_err().to_string().contains("spgr.delta"));
        let mut c = Config::x2();
        c.upscale = 0;
        assert!(c.check().unwrap_err().to_string().contains("upscale"));
        let json = Config::x2().to_json().unwrap().replace("\"beta_z\"", "\"betaz\"");
        assert!(Config::from_json(&json).unwrap_err().to_string().contains("betaz"));
    }

    /// JSON from a weight file or `--config` causes no overflow, no division by zero and
    /// no huge allocation.
    #[test]
    fn numbers_beyond_all_use_are_refused_by_key() {
        let one = |config: &Config, pointer: &str, value: serde_json::Value| {
            let mut json = serde_json::to_value(config).unwrap();
            *json.pointer_mut(pointer).unwrap() = value.clone();
            let key = pointer.split('/').rfind(|k| k.parse::<usize>().is_err()).unwrap();
            let refused = Config::from_json(&json.to_string());
            let error = refused.expect_err(&format!("{pointer} {value}")).to_string();
            // One error names both lists of the small backbone.
            let named = [key, "unet_channels"].iter().any(|k| error.contains(k));
            assert!(named, "{pointer} {value}: {error}");
        };
        let huge = [1u64 << 31, 1 << 62];
        let mvsplat = Config::x2();
        let small = Config::small(Preset::Tuned, 2);
        let both = ["/embed/dim", "/agg/n_learned", "/agg/gate_views", "/spgr/hidden"];
        let of_mvsplat = "cnn_channels/0 cnn_channels/2 transformer_layers ffn_expansion \
             window_splits depth_candidates costvolume_channels costvolume_levels \
             refine_channels refine_levels gaussians_per_pixel";
        let of_small = "cnn_channels/0 cnn_blocks match_channels depth_candidates stem_channels \
             unet_channels/1 mode_window head_channels";
        for value in huge {
            for pointer in both {
                one(&mvsplat, pointer, value.into());
                one(&small, pointer, value.into());
            }
            for (config, keys) in [(&mvsplat, of_mvsplat), (&small, of_small)] {
                for key in keys.split_whitespace() {
                    one(config, &format!("/backbone/{key}"), value.into());
                }
            }
        }
        for key in ["cnn_channels/0", "cnn_channels/1", "ffn_expansion", "window_splits"] {
            one(&mvsplat, &format!("/backbone/{key}"), 0.into());
        }
        one(&mvsplat, "/agg/gate_views", 0.into());
        one(&small, "/spgr/offset_bound", (-1.0).into());
    }

    /// Serialised forms of releases before the ablations became groups of their own.
    #[test]
    fn keys_of_the_groups_stay_on_one_level() {
        let mut config = Config::x2();
        config.agg.ablations.groups = 4;
        config.spgr.ablations.gain_space = GainSpace::Rgb;
        let json = config.to_json().unwrap();
        let value: serde_json::Value = serde_json::from_str(&json).unwrap();
        let keys = |section: &str| value[section].as_object().unwrap().len();
        assert_eq!((keys("agg"), keys("spgr"), keys("embed")), (24, 18, 7));
        assert_eq!(value["agg"]["groups"], 4);
        assert_eq!(value["spgr"]["gain_space"], "rgb");
        assert_eq!(Config::from_json(&json).unwrap(), config);
        let small = Config::small(Preset::Tuned, 2).to_json().unwrap();
        assert!(small.contains("\"first_look\":true"), "{small}");
        for (section, known) in [("agg", "groups"), ("spgr", "slide")] {
            let unknown = json.replace(&format!("\"{known}\""), "\"unheard_of\"");
            let error = Config::from_json(&unknown).unwrap_err().to_string();
            assert!(error.contains("unheard_of"), "{section}: {error}");
        }
    }

    #[test]
    fn paper_values() {
        let c = Config::x4();
        assert_eq!(c.children(), 16);
        assert_eq!(c.spgr.lambda_s.value(16), 0.60);
        assert_eq!(Config::re10k(Preset::Tuned, 4).spgr.lambda_s.value(16), 0.25);
        assert_eq!(c.stride(), 16);
    }
}
