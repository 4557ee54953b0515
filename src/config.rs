//! Every hyper-parameter of the method: symbol, source, default. One value of
//! [`Config`] is one model; every ablation of the paper is a value of it.
//!
//! Sources: "paper" and "supp." are SubSplat's main text and supplement, "MVS" is
//! MVSplat (arXiv 2403.14627) with its released `re10k` configuration.
//!
//! A configuration serialises to JSON and travels in the metadata of a weight
//! file (key [`Config::METADATA_KEY`]). Unknown keys are refused by name.

use crate::abi::{Convention, LOWPASS, ShDirection};
use serde::{Deserialize, Serialize};
use std::str::FromStr;
use thiserror::Error;

/// Why a configuration was refused.
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
        /// What would be accepted.
        expected: String,
        /// What came.
        got: String,
    },
    /// A preset nobody defined.
    #[error("preset: expected {expected}, got `{got}`")]
    Preset {
        /// The known names.
        expected: &'static str,
        /// What came.
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
    /// Images and cameras to depth, opacity and raw Gaussian parameters.
    pub backbone: Backbone,
    /// Attribute embeddings of the primaries (paper A.2).
    pub embed: Embed,
    /// Deformable attention over the views' features (paper A.2).
    pub agg: Aggregation,
    /// Sub-pixel Gaussian reparameterization (paper 3, supp. A.3).
    pub spgr: Spgr,
    /// How the result is meant to be rendered.
    pub render: Render,
}

/// Which network gives the primaries.
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
    /// Raw matching channels beside the learned correlation: ZNCC 6×6 at half
    /// resolution, RGB SAD and ZNCC 5×5 at quarter resolution, validity.
    pub raw_matching: bool,
    /// Hidden channels of the 3-D stem shared over disparity (two 3×3×3
    /// convolutions to one channel); 0 leaves the stem out and feeds the volume's
    /// channels to the U-Net as they are.
    pub stem_channels: usize,
    /// Adds the stem's output, times 4 and a learned factor, to the logits.
    pub stem_skip: bool,
    /// Channels of the 2-D U-Net at 1/4, 1/8, 1/16 and 1/32 (64, 80, 96, 96).
    pub unet_channels: Vec<usize>,
    /// Half-width, in candidates, of the window around the mode over which
    /// disparity is averaged at inference; 0 averages over all (3).
    pub mode_window: usize,
    /// Convex ×4 upsampling with learned 3×3 masks; off is bilinear.
    pub convex_upsampling: bool,
    /// Opacity is confidence², from a head of its own; off predicts opacity
    /// directly.
    pub confidence_opacity: bool,
    /// Colour starts as the pixel's own and the head learns a residual.
    pub pixel_colour: bool,
    /// Channels of the full-resolution feature map that the heads read (32).
    pub head_channels: usize,
    /// Shape, colour and frame of the primaries.
    pub primaries: Primaries,
}

/// From raw head outputs to world-frame Gaussians (MVS, Gaussian adapter).
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
    /// What the colour coefficients mean and how they turn into world frame.
    pub sh_frame: ShFrame,
}

/// What the head's colour coefficients multiply, and how they are rotated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShFrame {
    /// As released: rotated in e3nn's basis, evaluated in MVSplat's own
    /// ([`crate::abi::ShBasis::Mvsplat`]). Exact parity, but not an exact rotation.
    Mvsplat,
    /// Coefficients of MVSplat's basis in camera frame, mapped to the standard
    /// basis and rotated exactly: equal to `mvsplat` where the camera is
    /// unrotated, independent of the world frame everywhere.
    MvsplatExact,
    /// Coefficients of the standard basis in camera frame, rotated exactly.
    Standard,
}

/// Which feature maps the attention reads (spec 0).
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

/// Attribute embeddings φ of the primaries, width E (paper A.2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Embed {
    /// E: width of descriptors (supp.: 128).
    pub dim: usize,
    /// Form of the per-attribute MLPs.
    pub mlp: EmbedMlp,
    /// Frame in which mean and quaternion are read.
    pub anchor_frame: AnchorFrame,
    /// Conditioning of the mean.
    pub mu: MuInput,
    /// Conditioning of the scales.
    pub scale: ScaleInput,
    /// Conditioning of the opacity.
    pub alpha: AlphaInput,
    /// Frame of the SH coefficients.
    pub sh: ShInput,
}

/// Form of the per-attribute MLPs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EmbedMlp {
    /// Two blocks of Linear, ReLU, LayerNorm (PixelGaussian, GaussianFormer).
    Pg,
    /// Linear to 32, GELU, and one matrix over the four hidden vectors, LayerNorm
    /// at the end: a fifth of the work.
    Lite,
}

/// Frame in which mean and quaternion enter the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AnchorFrame {
    /// World (paper: "world-space position").
    World,
    /// The parent's own source camera: independent of the choice of world.
    SrcCam,
    /// The first context camera.
    View0,
}

/// How the mean enters the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MuInput {
    /// x, y, z.
    Raw,
    /// x/z, y/z, ln z.
    RayLogz,
}

/// How the scales enter the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleInput {
    /// σ in world units.
    Raw,
    /// ln(σ·fx/z): logarithm of input pixels in the source view.
    LogPx,
}

/// How the opacity enters the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlphaInput {
    /// α.
    Raw,
    /// ln(α/(1 − α)), clipped to ±6.
    Logit,
}

/// Frame of the SH coefficients that enter the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShInput {
    /// After the rotation to world.
    World,
    /// Before it, camera frame.
    Camera,
}

/// Deformable attention over the views' features (paper A.2; spec 1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Aggregation {
    /// Off: f^g = f^a = 0 and the heads read the embeddings (paper Table 4).
    pub enabled: bool,
    /// Geometry stages (paper: 3; Table 5: 1, 2, 3).
    pub stages_geo: usize,
    /// Appearance stages (paper: 1).
    pub stages_app: usize,
    /// One set of weights for all geometry stages (supp.: "applied three times")
    /// rather than one each (main: "stack three layers").
    pub share_stage_weights: bool,
    /// Feature maps Φ_{v,ℓ}.
    pub levels: Vec<FeatureLevel>,
    /// Where the attention weights come from.
    pub op: AttentionOp,
    /// Where the maps are sampled.
    pub points: Points,
    /// Fixed key points of the 13-point form: the first of centre, ±x, ±y, ±z at
    /// 0.45 σ (7).
    pub n_fixed: usize,
    /// Learned key points of the 13-point and map-offset forms (6).
    pub n_learned: usize,
    /// Groups of channels with attention weights of their own (1).
    pub groups: usize,
    /// Factor of the dot product.
    pub logit_scale: LogitScale,
    /// Learned projections of keys and values.
    pub kv_proj: bool,
    /// View gates α_v.
    pub gate: Gate,
    /// Most views that learned per-view gates can serve.
    pub gate_views: usize,
    /// How a stage's output joins its input.
    pub residual: Residual,
    /// Normalisation of the stage's query.
    pub norm: StageNorm,
    /// Feed-forward block after each stage.
    pub ffn: bool,
    /// What happens to samples outside a view.
    pub mask: MaskMode,
    /// Probability of dropping an attention weight while training (0; PG 0.15).
    pub attn_drop: f64,
    /// Pixel grid of the feature maps.
    pub sample_convention: SampleConvention,
    /// Stops the gradient from the sampling positions to the means.
    pub detach_points: bool,
    /// Weighs a view down by exp(−max(0, z − D(R) − τ)/τ′), τ = τ′ = 2 % of z, D the
    /// view's own depth map (spec 5.3).
    pub occlusion_gate: bool,
    /// What the heads read.
    pub head_input: HeadInput,
    /// The bare equation A.2: reference point, `trans4`, factor 1, no projection,
    /// no residual, softmax gate, heads read f; overrides the keys above.
    pub strict_literal: bool,
}

/// Where attention weights come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttentionOp {
    /// Dot product of query and sampled key (paper A.2).
    Dot,
    /// A linear map of the query (GaussianFormer, PixelGaussian).
    Linear,
}

/// Where the maps are sampled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Points {
    /// The parent's projected centre.
    Ref,
    /// Fixed and learned key points on the Gaussian, in units of its σ.
    Pixelgaussian,
    /// The centre and learned offsets in map pixels (Deformable DETR).
    MapOffsets,
}

/// Factor of the dot product.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LogitScale {
    /// 1/√(E / groups).
    InvSqrt,
    /// 1 (A.2 as written).
    One,
}

/// View gates α_v (paper: "weight the importance of each viewpoint").
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gate {
    /// V·softmax(β): 1 at initialisation.
    #[serde(rename = "softmaxV")]
    SoftmaxV,
    /// softmax(β): 1/V at initialisation.
    Softmax,
    /// 2·sigmoid(w·q + c): the same for any number and order of views.
    Query,
    /// 1.
    Off,
}

/// How a stage's output joins its input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Residual {
    /// f + o.
    Add,
    /// o.
    None,
    /// Linear(2E → E) of [f, o] (GaussianFormer's concatenation).
    Cat,
}

/// Normalisation of a stage's query.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StageNorm {
    /// None.
    None,
    /// LayerNorm of f + z.
    Pre,
}

/// What happens to samples outside a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskMode {
    /// Their logits are −∞; nothing visible gives 0 (GaussianFormer).
    Renorm,
    /// Positions clamped to [0, 0.9999], no renormalisation (PixelGaussian).
    PgClamp,
}

/// Pixel grid of the feature maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleConvention {
    /// x_ℓ = R·W_ℓ − ½ (`grid_sample`, `align_corners = false`).
    HalfPixel,
    /// x_ℓ = R·W_ℓ (MVSplat's cost volume).
    Integer,
}

/// What the heads read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HeadInput {
    /// f + z (PixelGaussian, GaussianFormer).
    FPlusZ,
    /// f.
    F,
}

/// Sub-pixel Gaussian reparameterization (paper 3.2; spec 2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spgr {
    /// Off: the primaries themselves are rendered (MVSplat).
    pub enabled: bool,
    /// Form of the two heads.
    pub head: SpgrHead,
    /// Hidden width of the heads (128).
    pub hidden: usize,
    /// Last layers start at zero: every child begins as the deterministic split.
    pub zero_init: bool,
    /// v*: the camera in whose frame children are placed.
    pub primary_view: PrimaryView,
    /// ρ: bound of the learned offset, in sub-pixels; `None` is unbounded (paper).
    pub offset_bound: Option<f64>,
    /// β_z: bound of the depth residual (supp.: 0.25).
    pub beta_z: f64,
    /// Direction of the depth residual.
    pub depth_dir: DepthDir,
    /// Unit of β_z.
    pub depth_unit: DepthUnit,
    /// How a child moves sideways.
    pub slide: Slide,
    /// λ_s: factor of the child's σ (supp.: 0.60 for all K).
    pub lambda_s: LambdaS,
    /// Soft bound of Δlog s, c·tanh(x/c) (3).
    pub dlog_clamp: f64,
    /// Where the footprint's Jacobian is taken (supp.: at the child).
    pub area_at: AreaAt,
    /// A_min: least footprint σ₁σ₂, target px² (paper: 1/K).
    pub a_min: AMin,
    /// How a child that is too small grows.
    pub a_min_mode: AMinMode,
    /// Opacity rule.
    pub opacity: OpacityRule,
    /// δ: colour gain lies in [1 − δ, 1 + δ] (supp.: 0.25).
    pub delta: f64,
    /// What the gain multiplies.
    pub gain_space: GainSpace,
}

/// Form of the SPGR heads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpgrHead {
    /// LayerNorm, Linear, GELU, Linear to K·9 and K·2.
    Mlp2,
    /// (Linear, ReLU, Linear, ReLU, LayerNorm) twice, Linear (PixelGaussian).
    Pg,
    /// One output layer for all children, told apart by an embedding of their
    /// sub-pixel coordinate: any K at inference.
    Coord,
}

/// v*: in whose frame children are placed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PrimaryView {
    /// The least positive depth among the views that see the parent; the source
    /// view if none does (paper).
    NearestVisible,
    /// The view that the parent came from: exact tiling of its pixel.
    Source,
}

/// Direction of the depth residual.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthDir {
    /// The optical axis (both equations).
    Axis,
    /// The viewing ray (the prose): the projection does not move.
    Ray,
}

/// Unit of β_z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthUnit {
    /// World units (paper).
    World,
    /// Of the parent's depth.
    Relative,
}

/// How a child moves sideways.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Slide {
    /// At constant camera z (paper).
    ZConst,
    /// Along the parent's own disc: Σ Jᵀ (J Σ Jᵀ)⁻¹ Δu.
    Disc,
}

/// λ_s: factor of the child's σ.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LambdaS {
    /// The same for every K (supp.: 0.60).
    Value(f64),
    /// c/√K (`tuned`: c = 1; the supplement's 0.60 at K = 4 is c = 1.2).
    OverSqrtK(f64),
}

impl LambdaS {
    /// λ_s for `children` children.
    pub fn value(self, children: usize) -> f64 {
        match self {
            LambdaS::Value(v) => v,
            LambdaS::OverSqrtK(c) => c / (children as f64).sqrt(),
        }
    }
}

/// Where the footprint's Jacobian is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AreaAt {
    /// At the child's mean (supp.: "matches our implementation").
    Child,
    /// At the parent's (main text).
    Parent,
}

/// A_min: least footprint σ₁σ₂.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AMin {
    /// 1/K target px² (paper), off at K = 1 so that the only child is its parent.
    OverK,
    /// This many target px².
    TargetPx(f64),
    /// This many input px².
    InputPx(f64),
    /// No clamp.
    Off,
}

/// How a child that is too small grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AMinMode {
    /// All three σ by √(A_min/A), at most 50-fold.
    Iso,
    /// The two axes that make the footprint.
    TwoAxis,
}

/// How the parent's opacity is shared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OpacityRule {
    /// α_k = α_p·softmax(ℓ_k − ln A_k): sums to the parent's (paper).
    Linear,
    /// Conserves Σ Ã_k τ_k, τ = −ln(1 − α), Ã with the low-pass (spec 2.8).
    OpticalDepth,
    /// 1 − (1 − α_p)^{w_k}: conserves transmittance through all children.
    Transmittance,
    /// min(0.99, α_p·A_p·w_k/A_k): conserves integrated opacity.
    Area,
    /// α_p.
    None,
}

/// What the colour gain multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GainSpace {
    /// The SH sum: contrast about mid-grey (paper).
    Sh,
    /// The colour ½ + Σ: intensity.
    Rgb,
}

/// How the result is meant to be rendered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Render {
    /// Rules of the rasterizer.
    pub convention: Convention,
    /// Low-pass, px² (3DGS: 0.3).
    pub lowpass: f32,
    /// Of which picture's pixels.
    pub lowpass_ref: LowpassRef,
    /// Highest SH degree evaluated (3DGS: 3).
    pub sh_degree: usize,
    /// Direction of view-dependent colour.
    pub sh_dir: ShDirection,
}

impl Render {
    /// The low-pass in px² of a picture `ratio` times as large (side over side)
    /// as the network's input.
    pub fn lowpass_px2(&self, ratio: f32) -> f32 {
        match self.lowpass_ref {
            LowpassRef::Target => self.lowpass,
            LowpassRef::Input => self.lowpass * ratio * ratio,
        }
    }
}

/// Of which picture's pixels the low-pass is measured in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LowpassRef {
    /// The rendered picture's (3DGS).
    Target,
    /// The input's: r² times as much, so that coverage is that of a native render.
    Input,
}

/// What SubSplat adds to the backbone: as written, or as recommended.
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

impl Primaries {
    fn with(sh_frame: ShFrame) -> Self {
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
    /// The network of ARCHITECTURE.md, "The small backbone".
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
            primaries: Primaries::with(ShFrame::Standard),
        }
    }
}

impl Embed {
    fn preset(preset: Preset) -> Self {
        let tuned = preset == Preset::Tuned;
        Self {
            dim: 128,
            mlp: if tuned { EmbedMlp::Lite } else { EmbedMlp::Pg },
            anchor_frame: if tuned { AnchorFrame::SrcCam } else { AnchorFrame::World },
            mu: if tuned { MuInput::RayLogz } else { MuInput::Raw },
            scale: if tuned { ScaleInput::LogPx } else { ScaleInput::Raw },
            alpha: if tuned { AlphaInput::Logit } else { AlphaInput::Raw },
            sh: if tuned { ShInput::Camera } else { ShInput::World },
        }
    }
}

impl Aggregation {
    fn preset(preset: Preset) -> Self {
        let tuned = preset == Preset::Tuned;
        let mut levels = vec![FeatureLevel::Trans4];
        if tuned {
            levels.push(FeatureLevel::Cnn2);
        }
        Self {
            enabled: true,
            stages_geo: 3,
            stages_app: 1,
            share_stage_weights: false,
            levels,
            op: AttentionOp::Dot,
            points: Points::Ref,
            n_fixed: 7,
            n_learned: 6,
            groups: 1,
            logit_scale: LogitScale::InvSqrt,
            kv_proj: true,
            gate: Gate::SoftmaxV,
            gate_views: 2,
            residual: Residual::Add,
            norm: if tuned { StageNorm::Pre } else { StageNorm::None },
            ffn: false,
            mask: MaskMode::Renorm,
            attn_drop: 0.0,
            sample_convention: SampleConvention::HalfPixel,
            detach_points: false,
            occlusion_gate: tuned,
            head_input: HeadInput::FPlusZ,
            strict_literal: false,
        }
    }

    /// The keys in force: `strict_literal` spelled out.
    pub fn resolved(&self) -> Self {
        if !self.strict_literal {
            return self.clone();
        }
        Self {
            levels: vec![FeatureLevel::Trans4],
            op: AttentionOp::Dot,
            points: Points::Ref,
            groups: 1,
            logit_scale: LogitScale::One,
            kv_proj: false,
            gate: Gate::Softmax,
            residual: Residual::None,
            norm: StageNorm::None,
            ffn: false,
            head_input: HeadInput::F,
            occlusion_gate: false,
            ..self.clone()
        }
    }
}

impl Spgr {
    fn preset(preset: Preset) -> Self {
        let paper = Self {
            enabled: true,
            head: SpgrHead::Mlp2,
            hidden: 128,
            zero_init: true,
            primary_view: PrimaryView::NearestVisible,
            offset_bound: None,
            beta_z: 0.25,
            depth_dir: DepthDir::Axis,
            depth_unit: DepthUnit::World,
            slide: Slide::ZConst,
            lambda_s: LambdaS::Value(0.60),
            dlog_clamp: 3.0,
            area_at: AreaAt::Child,
            a_min: AMin::OverK,
            a_min_mode: AMinMode::Iso,
            opacity: OpacityRule::Linear,
            delta: 0.25,
            gain_space: GainSpace::Sh,
        };
        match preset {
            Preset::Paper => paper,
            Preset::Tuned => Self {
                primary_view: PrimaryView::Source,
                offset_bound: Some(0.5),
                beta_z: 0.1,
                depth_dir: DepthDir::Ray,
                depth_unit: DepthUnit::Relative,
                lambda_s: LambdaS::OverSqrtK(1.0),
                opacity: OpacityRule::OpticalDepth,
                ..paper
            },
        }
    }
}

impl Config {
    /// Key of the JSON form in the metadata of a safetensors file.
    pub const METADATA_KEY: &'static str = "subsplat.config";

    fn preset(backbone: Backbone, preset: Preset, upscale: usize) -> Self {
        let convention = match &backbone {
            Backbone::Mvsplat(_) => Convention::Mvsplat,
            Backbone::Small(_) => Convention::Standard,
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
            },
        }
    }

    /// MVSplat's `re10k` backbone with SubSplat's additions. `tuned` also turns
    /// the colour coefficients exactly ([`ShFrame::MvsplatExact`]).
    pub fn re10k(preset: Preset, upscale: usize) -> Self {
        let mut backbone = Mvsplat::re10k();
        if preset == Preset::Tuned {
            backbone.primaries.sh_frame = ShFrame::MvsplatExact;
        }
        Self::preset(Backbone::Mvsplat(backbone), preset, upscale)
    }

    /// The light backbone with SubSplat's additions.
    pub fn small(preset: Preset, upscale: usize) -> Self {
        Self::preset(Backbone::Small(Small::standard()), preset, upscale)
    }

    /// The paper's ×2 model: 256 → 512, K = 4.
    pub fn x2() -> Self {
        Self::re10k(Preset::Paper, 2)
    }

    /// The paper's ×4 model: 256 → 1024, K = 16.
    pub fn x4() -> Self {
        Self::re10k(Preset::Paper, 4)
    }

    /// K: children per primary, r².
    pub fn children(&self) -> usize {
        self.upscale * self.upscale
    }

    /// Shape, colour and frame of the backbone's primaries.
    pub fn primaries(&self) -> &Primaries {
        match &self.backbone {
            Backbone::Mvsplat(b) => &b.primaries,
            Backbone::Small(b) => &b.primaries,
        }
    }

    /// Side lengths of the input must be multiples of this, px.
    pub fn stride(&self) -> usize {
        match &self.backbone {
            Backbone::Mvsplat(b) => Self::stride_of(b),
            Backbone::Small(b) => 4 << (b.unet_channels.len() - 1),
        }
    }

    /// [`Config::stride`] of MVSplat: patch size 4 × downscale 4 (MVS patch shim); the
    /// refinement U-Net halves, the windows split and the cost volume's U-Net halves
    /// the 1/4 map.
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

    /// JSON for the metadata of a weight file.
    ///
    /// # Errors
    /// None in practice; kept because serialisation is fallible.
    pub fn to_json(&self) -> Result<String, ConfigError> {
        Ok(serde_json::to_string(self)?)
    }

    /// Reads [`Config::to_json`]'s form and checks it.
    ///
    /// # Errors
    /// Unknown or missing keys, values of the wrong type or range.
    pub fn from_json(json: &str) -> Result<Self, ConfigError> {
        let config: Self = serde_json::from_str(json)?;
        config.check()?;
        Ok(config)
    }

    /// Checks every range and every pair of keys that must fit.
    ///
    /// # Errors
    /// [`ConfigError::Value`] names the key.
    pub fn check(&self) -> Result<(), ConfigError> {
        fn need(
            ok: bool,
            key: &'static str,
            expected: &str,
            got: impl std::fmt::Debug,
        ) -> Result<(), ConfigError> {
            if ok {
                return Ok(());
            }
            Err(ConfigError::Value { key, expected: expected.to_owned(), got: format!("{got:?}") })
        }
        need((1..=8).contains(&self.upscale), "upscale", "1 to 8", self.upscale)?;
        match &self.backbone {
            Backbone::Mvsplat(b) => check_mvsplat(b, need)?,
            Backbone::Small(b) => check_small(b, need)?,
        }
        let p = self.primaries();
        need(p.sh_degree <= 4, "backbone.primaries.sh_degree", "0 to 4", p.sh_degree)?;
        need(
            p.scale_min > 0.0 && p.scale_max > p.scale_min && p.scale_max.is_finite(),
            "backbone.primaries.scale_max",
            "0 < scale_min < scale_max",
            (p.scale_min, p.scale_max),
        )?;
        let a = self.agg.resolved();
        need(self.embed.dim > 0, "embed.dim", "at least 1", self.embed.dim)?;
        need(
            a.groups > 0 && self.embed.dim.is_multiple_of(a.groups),
            "agg.groups",
            "a divisor of embed.dim",
            a.groups,
        )?;
        need(!a.levels.is_empty(), "agg.levels", "at least one level", &a.levels)?;
        need(
            a.stages_geo <= 8 && a.stages_app <= 8,
            "agg.stages_geo",
            "0 to 8 stages",
            (a.stages_geo, a.stages_app),
        )?;
        need(a.n_fixed <= 7, "agg.n_fixed", "0 to 7", a.n_fixed)?;
        need(
            a.points == Points::Ref || a.n_fixed + a.n_learned > 0,
            "agg.n_learned",
            "at least one point",
            a.n_learned,
        )?;
        need((0.0..1.0).contains(&a.attn_drop), "agg.attn_drop", "in [0, 1)", a.attn_drop)?;
        let s = &self.spgr;
        need(s.hidden > 0, "spgr.hidden", "at least 1", s.hidden)?;
        need(s.beta_z >= 0.0 && s.beta_z.is_finite(), "spgr.beta_z", "at least 0", s.beta_z)?;
        let lambda = s.lambda_s.value(self.children());
        need(lambda > 0.0 && lambda.is_finite(), "spgr.lambda_s", "above 0", lambda)?;
        need((0.0..=1.0).contains(&s.delta), "spgr.delta", "in [0, 1]", s.delta)?;
        need(s.dlog_clamp > 0.0, "spgr.dlog_clamp", "above 0", s.dlog_clamp)?;
        let r = &self.render;
        need(r.lowpass >= 0.0 && r.lowpass.is_finite(), "render.lowpass", "at least 0", r.lowpass)?;
        need(r.sh_degree <= 4, "render.sh_degree", "0 to 4", r.sh_degree)
    }
}

type Need<T> = fn(bool, &'static str, &str, T) -> Result<(), ConfigError>;

fn check_mvsplat(b: &Mvsplat, need: Need<usize>) -> Result<(), ConfigError> {
    let width = b.cnn_channels[2];
    need(
        width > 0 && width.is_multiple_of(4),
        "backbone.cnn_channels",
        "a last stage that is a multiple of 4",
        width,
    )?;
    need(
        (1..=64).contains(&b.transformer_layers),
        "backbone.transformer_layers",
        "1 to 64",
        b.transformer_layers,
    )?;
    need(b.window_splits >= 1, "backbone.window_splits", "at least 1", b.window_splits)?;
    need(b.depth_candidates >= 2, "backbone.depth_candidates", "at least 2", b.depth_candidates)?;
    need(
        b.costvolume_channels > 0 && b.costvolume_channels.is_multiple_of(32),
        "backbone.costvolume_channels",
        "a multiple of 32",
        b.costvolume_channels,
    )?;
    need(
        (1..=3).contains(&b.costvolume_levels),
        "backbone.costvolume_levels",
        "1 to 3",
        b.costvolume_levels,
    )?;
    need(
        b.refine_channels > 0 && b.refine_channels.is_multiple_of(32),
        "backbone.refine_channels",
        "a multiple of 32",
        b.refine_channels,
    )?;
    need((1..=6).contains(&b.refine_levels), "backbone.refine_levels", "1 to 6", b.refine_levels)?;
    need(
        (1..=64).contains(&b.gaussians_per_pixel),
        "backbone.gaussians_per_pixel",
        "1 to 64",
        b.gaussians_per_pixel,
    )
}

fn check_small(b: &Small, need: Need<usize>) -> Result<(), ConfigError> {
    for c in b.cnn_channels.into_iter().chain(b.unet_channels.iter().copied()) {
        need(
            c > 0 && c % 8 == 0,
            "backbone.unet_channels",
            "multiples of 8 (GroupNorm) in cnn_channels and unet_channels",
            c,
        )?;
    }
    need(
        (1..=5).contains(&b.unet_channels.len()),
        "backbone.unet_channels",
        "1 to 5 levels",
        b.unet_channels.len(),
    )?;
    need(b.depth_candidates >= 2, "backbone.depth_candidates", "at least 2", b.depth_candidates)?;
    need(b.match_channels > 0, "backbone.match_channels", "at least 1", b.match_channels)?;
    need(
        b.head_channels > 0 && b.head_channels.is_multiple_of(8),
        "backbone.head_channels",
        "a multiple of 8",
        b.head_channels,
    )
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

    #[test]
    fn paper_values() {
        let c = Config::x4();
        assert_eq!(c.children(), 16);
        assert_eq!(c.spgr.lambda_s.value(16), 0.60);
        assert_eq!(Config::re10k(Preset::Tuned, 4).spgr.lambda_s.value(16), 0.25);
        assert_eq!(c.stride(), 16);
    }
}
