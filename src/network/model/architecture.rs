//! Names and shapes of every tensor of a model, and the names of the same tensors in files
//! of other programs. `subsplat-convert` uses them.
//!
//! Lightning and converted files name MVSplat's tensors `encoder.…`. UniMatch's GMDepth
//! names them `backbone.…` and `transformer.…`; MVSplat's CNN and transformer start from
//! these two and use nothing else of GMDepth. LPIPS' trunk is torchvision's VGG16
//! (`features.N`) or the `lpips` package's copy of it (`net.sliceK.N`).

use super::subsplat::SubSplat;
use super::weights::SUBSPLAT_PREFIX;
use crate::network::config::{Backbone, Config, Preset};
use candle_core::{DType, Device, Result, Shape, Tensor, bail};
use candle_nn::var_builder::SimpleBackend;
use candle_nn::{Init, VarBuilder};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Names and shapes of tensors.
pub type Shapes = BTreeMap<String, Vec<usize>>;

/// Lightning's name of the encoder inside the whole module.
const ENCODER: &str = "encoder.";
/// Prefix of the small backbone.
const SMALL_PREFIX: &str = "small.";
/// Prefixes of MVSplat's CNN and transformer in converted files.
const CNN_AND_TRANSFORMER: [&str; 2] =
    ["encoder.backbone.backbone.", "encoder.backbone.transformer."];
/// Blocks of LPIPS' VGG16: torchvision's indices of the convolutions, and their channels.
pub const LPIPS_BLOCKS: [(&[usize], usize); 5] = [
    (&[0, 2], 64),
    (&[5, 7], 128),
    (&[10, 12, 14], 256),
    (&[17, 19, 21], 512),
    (&[24, 26, 28], 512),
];
/// Candidates of [`guess_config`] for r, in this order.
const UPSCALES: [usize; 4] = [2, 4, 3, 1];

/// Purpose of a weight file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// MVSplat's encoder, whole.
    Mvsplat,
    /// A whole model with SubSplat's tensors, on MVSplat or on the small backbone.
    Subsplat,
    /// The initial values of MVSplat's CNN and transformer (UniMatch's GMDepth).
    Gmdepth,
    /// The perceptual distance.
    Lpips,
}

impl Kind {
    /// Returns the spelling on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mvsplat => "mvsplat",
            Self::Subsplat => "subsplat",
            Self::Gmdepth => "gmdepth",
            Self::Lpips => "lpips",
        }
    }

    /// Returns the kind of a file with these names; `None` if no name is characteristic.
    pub fn recognise<'a>(names: impl IntoIterator<Item = &'a str>) -> Option<Self> {
        let (mut predictor, mut start, mut lpips) = (false, false, false);
        for name in names {
            let plain = name.strip_prefix(ENCODER).unwrap_or(name);
            if plain.starts_with(SUBSPLAT_PREFIX) || plain.starts_with(SMALL_PREFIX) {
                return Some(Self::Subsplat);
            }
            predictor |= plain.starts_with("depth_predictor.");
            start |= ["backbone.", "transformer.layers."].iter().any(|p| plain.starts_with(p));
            lpips |= vgg_index(name).is_some()
                || name.starts_with("net.slice")
                || (name.starts_with("lin") && name.ends_with(".model.1.weight"));
        }
        match (predictor, start, lpips) {
            (true, ..) => Some(Self::Mvsplat),
            (_, true, _) => Some(Self::Gmdepth),
            (.., true) => Some(Self::Lpips),
            _ => None,
        }
    }

    /// Returns the name in a converted file of the source's tensor `name`.
    pub fn canonical(self, name: &str) -> String {
        let plain = name.strip_prefix(ENCODER).unwrap_or(name);
        match self {
            Self::Mvsplat | Self::Subsplat => {
                let own = [SUBSPLAT_PREFIX, SMALL_PREFIX].iter().any(|p| plain.starts_with(p));
                if own { plain.to_owned() } else { format!("{ENCODER}{plain}") }
            }
            Self::Gmdepth => {
                let whole = ["backbone.backbone.", "backbone.transformer."];
                if whole.iter().any(|p| plain.starts_with(p)) {
                    format!("{ENCODER}{plain}")
                } else {
                    format!("{ENCODER}backbone.{plain}")
                }
            }
            Self::Lpips => vgg_name(name).unwrap_or_else(|| name.to_owned()),
        }
    }

    /// Returns true if files of this kind usually hold `name` although no model here needs
    /// it: GMDepth's layers after the transformer, VGG16's classifier, the constants and
    /// second names of the `lpips` package.
    pub fn leaves_out(self, name: &str) -> bool {
        let prefixes: &[&str] = match self {
            Self::Mvsplat | Self::Subsplat => &[],
            Self::Gmdepth => {
                &["feature_flow_attn.", "upsampler.", "refine_proj.", "refine.", "depth_predictor."]
            }
            Self::Lpips => &["classifier.", "lins.", "scaling_layer."],
        };
        let plain = name.strip_prefix(ENCODER).unwrap_or(name);
        prefixes.iter().any(|p| plain.starts_with(p))
    }
}

/// N of torchvision's `features.N.weight` or `features.N.bias`.
fn vgg_index(name: &str) -> Option<(usize, &str)> {
    let (index, part) = name.strip_prefix("features.")?.split_once('.')?;
    Some((index.parse().ok()?, part)).filter(|(_, part)| ["weight", "bias"].contains(part))
}

fn vgg_name(name: &str) -> Option<String> {
    let (index, part) = vgg_index(name)?;
    let block = LPIPS_BLOCKS.iter().position(|(indices, _)| indices.contains(&index))?;
    Some(format!("net.slice{}.{index}.{part}", block + 1))
}

/// Returns every tensor of a file of this kind, under its canonical name.
///
/// # Errors
/// The configuration is invalid, or has the small backbone where `kind` needs MVSplat's.
pub fn expected(kind: Kind, config: &Config) -> Result<Shapes> {
    let mvsplat = matches!(config.backbone, Backbone::Mvsplat(_));
    if matches!(kind, Kind::Mvsplat | Kind::Gmdepth) && !mvsplat {
        bail!("configuration key `backbone`: expected `mvsplat`, got `small`");
    }
    let all = match kind {
        Kind::Lpips => lpips_shapes(),
        _ => recorded(|vb| SubSplat::new(config, vb).map(drop))?,
    };
    let wanted = |name: &String| match kind {
        Kind::Lpips | Kind::Subsplat => true,
        Kind::Mvsplat => name.starts_with(ENCODER),
        Kind::Gmdepth => CNN_AND_TRANSFORMER.iter().any(|p| name.starts_with(p)),
    };
    let all = all.into_iter().map(|(name, shape)| (kind.canonical(&name), shape));
    Ok(all.filter(|(name, _)| wanted(name)).collect())
}

/// Names and shapes of LPIPS' 13 convolutions of 3×3 and its five linear weights.
fn lpips_shapes() -> Shapes {
    let mut shapes = Shapes::new();
    let mut c_in = 3;
    for (i, (indices, channels)) in LPIPS_BLOCKS.into_iter().enumerate() {
        for index in indices {
            let name = format!("net.slice{}.{index}", i + 1);
            shapes.insert(format!("{name}.weight"), vec![channels, c_in, 3, 3]);
            shapes.insert(format!("{name}.bias"), vec![channels]);
            c_in = channels;
        }
        shapes.insert(format!("lin{i}.model.1.weight"), vec![1, channels, 1, 1]);
    }
    shapes
}

/// Guesses the configuration of a model with these tensors (canonical names), for a file
/// without one: the preset and r whose tensors fit best, `tuned` and 2 first. Without
/// SubSplat's tensors the result is `tuned` and 2, as in [`crate::reconstruct`].
///
/// # Errors
/// None in practice: presets are valid.
pub fn guess_config(shapes: &Shapes) -> Result<Config> {
    let small = shapes.keys().any(|n| n.starts_with(SMALL_PREFIX));
    let make = if small { Config::small } else { Config::re10k };
    let first = make(Preset::Tuned, 2);
    if !shapes.keys().any(|n| n.starts_with(SUBSPLAT_PREFIX)) {
        return Ok(first);
    }
    let mut best = (usize::MAX, first);
    for preset in [Preset::Tuned, Preset::Paper] {
        for upscale in UPSCALES {
            let config = make(preset, upscale);
            let wanted = expected(Kind::Subsplat, &config)?;
            let misfits = wanted.iter().filter(|(n, s)| shapes.get(*n) != Some(*s)).count()
                + shapes.keys().filter(|n| !wanted.contains_key(*n)).count();
            if misfits < best.0 {
                best = (misfits, config);
            }
        }
    }
    Ok(best.1)
}

/// Names and shapes of the tensors that `build` requests.
fn recorded(build: impl FnOnce(VarBuilder) -> Result<()>) -> Result<Shapes> {
    let requested = Arc::new(Mutex::new(Shapes::new()));
    let recorder = Recorder(Arc::clone(&requested));
    build(VarBuilder::from_backend(Box::new(recorder), DType::F32, Device::Cpu))?;
    let shapes = std::mem::take(&mut *requested.lock().unwrap_or_else(PoisonError::into_inner));
    Ok(shapes)
}

/// Records every request and answers with zeros that take no memory.
struct Recorder(Arc<Mutex<Shapes>>);

impl SimpleBackend for Recorder {
    fn get(&self, s: Shape, name: &str, _: Init, dtype: DType, device: &Device) -> Result<Tensor> {
        let mut requested = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        requested.insert(name.to_owned(), s.dims().to_vec());
        Tensor::zeros((), dtype, device)?.broadcast_as(s)
    }

    fn get_unchecked(&self, name: &str, _: DType, _: &Device) -> Result<Tensor> {
        bail!("cannot list weight `{name}`: it was requested without a shape")
    }

    fn contains_tensor(&self, _: &str) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mvsplat_has_471_tensors_and_gmdepth_its_first_two_parts() {
        let config = Config::re10k(Preset::Tuned, 2);
        let count = |shapes: &Shapes| -> usize {
            shapes.values().map(|s| s.iter().product::<usize>()).sum()
        };
        let all = expected(Kind::Mvsplat, &config).unwrap();
        assert_eq!((all.len(), count(&all)), (471, 11_955_734));
        assert_eq!(all["encoder.depth_predictor.to_gaussians.2.weight"], [84, 168, 3, 3]);
        let start = expected(Kind::Gmdepth, &config).unwrap();
        assert_eq!(count(&start), 1_049_120 + 3_150_336);
        assert!(start.keys().all(|n| all.contains_key(n)));
        let whole = expected(Kind::Subsplat, &config).unwrap();
        assert!(all.keys().all(|n| whole.contains_key(n)) && whole.len() > all.len());
        let lpips = expected(Kind::Lpips, &config).unwrap();
        assert_eq!((lpips.len(), count(&lpips)), (31, 14_714_688 + 1_472));
        assert!(expected(Kind::Mvsplat, &Config::small(Preset::Tuned, 2)).is_err());
    }

    #[test]
    fn names_of_other_programs() {
        for (kind, theirs, ours) in [
            (
                Kind::Mvsplat,
                "backbone.backbone.conv1.weight",
                "encoder.backbone.backbone.conv1.weight",
            ),
            (Kind::Mvsplat, "encoder.depth_predictor.a", "encoder.depth_predictor.a"),
            (Kind::Subsplat, "encoder.subsplat.geo.lin0.bias", "subsplat.geo.lin0.bias"),
            (Kind::Subsplat, "small.stem.weight", "small.stem.weight"),
            (Kind::Gmdepth, "backbone.conv1.weight", "encoder.backbone.backbone.conv1.weight"),
            (Kind::Gmdepth, "transformer.layers.0.a", "encoder.backbone.transformer.layers.0.a"),
            (Kind::Gmdepth, "encoder.backbone.backbone.a", "encoder.backbone.backbone.a"),
            (Kind::Lpips, "features.28.bias", "net.slice5.28.bias"),
            (Kind::Lpips, "features.10.weight", "net.slice3.10.weight"),
            (Kind::Lpips, "features.11.weight", "features.11.weight"),
            (Kind::Lpips, "lin0.model.1.weight", "lin0.model.1.weight"),
        ] {
            assert_eq!(kind.canonical(theirs), ours);
            assert_eq!(kind.canonical(ours), ours, "not stable");
        }
    }

    #[test]
    fn kinds_are_recognised() {
        for (names, kind) in [
            (
                &["encoder.backbone.backbone.a", "encoder.depth_predictor.b"][..],
                Some(Kind::Mvsplat),
            ),
            (&["depth_predictor.b", "subsplat.geo.a"], Some(Kind::Subsplat)),
            (&["small.a"], Some(Kind::Subsplat)),
            (&["upsampler.0.weight", "transformer.layers.0.a"], Some(Kind::Gmdepth)),
            (&["classifier.0.weight", "features.0.weight"], Some(Kind::Lpips)),
            (&["lin3.model.1.weight"], Some(Kind::Lpips)),
            (&["features.x.weight", "fc.weight"], None),
            (&[], None),
        ] {
            assert_eq!(Kind::recognise(names.iter().copied()), kind, "{names:?}");
        }
    }

    #[test]
    fn configurations_are_guessed_from_shapes() {
        for small in [false, true] {
            let make = if small { Config::small } else { Config::re10k };
            for (preset, upscale) in [(Preset::Tuned, 2), (Preset::Paper, 4), (Preset::Tuned, 3)] {
                let config = make(preset, upscale);
                let shapes = expected(Kind::Subsplat, &config).unwrap();
                assert_eq!(guess_config(&shapes).unwrap(), config);
            }
            let config = make(Preset::Tuned, 2);
            let mut bare = expected(Kind::Subsplat, &config).unwrap();
            bare.retain(|n, _| !n.starts_with(SUBSPLAT_PREFIX));
            assert_eq!(guess_config(&bare).unwrap(), config);
        }
    }
}
