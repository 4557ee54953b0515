//! The backbones: the network that gives the primaries, and its shape.

use serde::{Deserialize, Serialize};

/// The network that gives the primaries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Backbone {
    /// MVSplat, parameter for parameter.
    Mvsplat(Mvsplat),
    /// Our own light network, for training and running on a CPU.
    Small(Small),
}

/// MVSplat's hyper-parameters (defaults: its released `re10k` configuration).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mvsplat {
    /// Channels of CNN stages 1, 2, 3; the last is also the transformer's width
    /// and the feature dimension (MVS: 64, 96, 128).
    pub cnn_channels: [usize; 3],
    /// Transformer layers, each self- plus cross-attention (MVS: 6).
    pub transformer_layers: usize,
    /// Hidden width of the transformer's FFN over (2 × width) (MVS: 4).
    pub ffn_expansion: usize,
    /// Attention windows per side (MVS: 2).
    pub window_splits: usize,
    /// D: depth candidates, uniform in disparity from 1/far to 1/near (MVS: 128).
    pub depth_candidates: usize,
    /// Channels of the cost-volume U-Net (MVS: 128).
    pub costvolume_channels: usize,
    /// Levels of the cost-volume U-Net, attention at the lowest (MVS: 3).
    pub costvolume_levels: usize,
    /// Channels of the depth-refinement U-Net (MVS: 32).
    pub refine_channels: usize,
    /// Levels of the depth-refinement U-Net, attention at the lowest (MVS: 5).
    pub refine_levels: usize,
    /// Gaussians per input pixel with depth and opacity of their own and shared
    /// shape and colour (MVS: 1; paper Table D: K).
    pub gaussians_per_pixel: usize,
    /// Shape, colour and frame of the primaries.
    pub primaries: Primaries,
}

/// The light backbone: a plane sweep with raw matching channels beside learned
/// ones, a 3-D stem shared over disparity, a 2-D U-Net, convex upsampling and a
/// confidence head.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Small {
    /// Channels at 1/2 and 1/4 of the CNN (24, 48).
    pub cnn_channels: [usize; 2],
    /// Residual blocks at 1/4 (2).
    pub cnn_blocks: usize,
    /// Unit-length channels that the learned correlation compares (8).
    pub match_channels: usize,
    /// D: depth candidates, uniform in disparity from 1/far to 1/near (64).
    pub depth_candidates: usize,
    /// Adds raw matching channels to the learned correlation: ZNCC 6×6 at half
    /// resolution, RGB SAD and ZNCC 5×5 at quarter resolution, validity.
    pub raw_matching: bool,
    /// Hidden channels of the 3-D stem shared over disparity (two 3×3×3 convolutions to
    /// one channel). 0 removes the stem: the U-Net then reads the volume's channels.
    pub stem_channels: usize,
    /// Adds the stem's output, times 4 and a learned factor, to the logits.
    pub stem_skip: bool,
    /// Channels of the 2-D U-Net at 1/4, 1/8, 1/16 and 1/32 (64, 80, 96, 96).
    pub unet_channels: Vec<usize>,
    /// Half-width, in candidates, of the window around the mode for the mean disparity
    /// at inference; 0 averages over all candidates (3).
    pub mode_window: usize,
    /// True: convex ×4 upsampling with learned 3×3 masks. False: bilinear.
    pub convex_upsampling: bool,
    /// True: opacity is confidence², from a head of its own. False: a head predicts
    /// opacity directly.
    pub confidence_opacity: bool,
    /// The colour starts as the pixel's colour and the head learns a residual.
    pub pixel_colour: bool,
    /// Channels of the full-resolution feature map that the heads read (32).
    pub head_channels: usize,
    /// Lowers the opacity of a point where another view that sees it has another colour
    /// ([`subsplat_kernels::cpu::small::cross_check`]). Files without the key mean true.
    #[serde(default = "yes")]
    pub cross_check: bool,
    /// From three views on, each pixel takes the depth that most views support
    /// ([`subsplat_kernels::cpu::small::depth_consensus`]). Files without the key mean true.
    #[serde(default = "yes")]
    pub depth_consensus: bool,
    /// Estimates near and far depth from half-size images
    /// ([`crate::network::model::subsplat::SubSplat::estimate_depth_range`]). Serialised as
    /// `first_look`; files without the key mean true.
    #[serde(default = "yes", rename = "first_look")]
    pub estimate_depth_range: bool,
    /// Shape, colour and frame of the primaries.
    pub primaries: Primaries,
}

/// Default of keys that older files lack.
fn yes() -> bool {
    true
}

/// Conversion of raw head outputs to world-frame Gaussians (MVS, Gaussian adapter).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Primaries {
    /// SH degree of the colour (MVS: 4).
    pub sh_degree: usize,
    /// Smallest projected scale, in fifths of an input pixel (MVS: 0.5).
    pub scale_min: f64,
    /// Largest projected scale, in fifths of an input pixel (MVS: 15).
    pub scale_max: f64,
    /// x of the opacity mapping α = ½(1 − (1 − p)^e + p^{1/e}), e = 2^x (MVS: 0,
    /// which is α = p).
    pub opacity_exponent: f64,
    /// Basis of the colour coefficients and their rotation to world frame.
    pub sh_frame: ShFrame,
}

/// Basis of the head's colour coefficients and their rotation to world frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShFrame {
    /// As released: rotated in e3nn's basis, evaluated in MVSplat's own
    /// ([`subsplat_kernels::layout::ShBasis::Mvsplat`]). Exact parity, but not an exact rotation.
    Mvsplat,
    /// Coefficients of MVSplat's basis in camera frame, mapped to the standard
    /// basis and rotated exactly: equal to `mvsplat` where the camera is
    /// unrotated, independent of the world frame everywhere.
    MvsplatExact,
    /// Coefficients of the standard basis in camera frame, rotated exactly.
    Standard,
}

/// A feature map that the attention can read, with its scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FeatureLevel {
    /// Transformer output, 1/4 (`small`: U-Net output, 1/4).
    Trans4,
    /// `trans4` after 2×2 mean pooling, 1/8.
    Trans8,
    /// `trans4` after 4×4 mean pooling, 1/16.
    Trans16,
    /// CNN output, 1/4.
    Cnn4,
    /// CNN's first stage, 1/2.
    Cnn2,
    /// Depth-refinement U-Net output (`small`: the heads' input), full resolution.
    Refine1,
}

impl FeatureLevel {
    /// All levels.
    pub const ALL: [Self; 6] =
        [Self::Trans4, Self::Trans8, Self::Trans16, Self::Cnn4, Self::Cnn2, Self::Refine1];
}

impl Primaries {
    pub(super) fn with(sh_frame: ShFrame) -> Self {
        Self { sh_degree: 4, scale_min: 0.5, scale_max: 15.0, opacity_exponent: 0.0, sh_frame }
    }
}

impl Mvsplat {
    /// The released `re10k` configuration: 471 tensors, 11,955,734 parameters.
    pub fn re10k() -> Self {
        Self {
            cnn_channels: [64, 96, 128],
            transformer_layers: 6,
            ffn_expansion: 4,
            window_splits: 2,
            depth_candidates: 128,
            costvolume_channels: 128,
            costvolume_levels: 3,
            refine_channels: 32,
            refine_levels: 5,
            gaussians_per_pixel: 1,
            primaries: Primaries::with(ShFrame::Mvsplat),
        }
    }
}

impl Small {
    /// The network of the weights that ship (`src/network/shipped/README.md`).
    pub fn standard() -> Self {
        Self {
            cnn_channels: [24, 48],
            cnn_blocks: 2,
            match_channels: 8,
            depth_candidates: 64,
            raw_matching: true,
            stem_channels: 8,
            stem_skip: true,
            unet_channels: vec![64, 80, 96, 96],
            mode_window: 3,
            convex_upsampling: true,
            confidence_opacity: true,
            pixel_colour: true,
            head_channels: 32,
            cross_check: true,
            depth_consensus: true,
            estimate_depth_range: true,
            primaries: Primaries::with(ShFrame::Standard),
        }
    }
}
