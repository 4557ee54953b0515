//! Attribute embeddings and attention over views (SubSplat A.2).
//!
//! Both presets use one form of the attention; they differ in `levels`, `norm` and
//! `occlusion_gate` only. Every other choice belongs to [`AggregationAblations`].

pub use subsplat_kernels::layout::{MuInput, SampleConvention};

use super::{FeatureLevel, Preset};
use serde::{Deserialize, Serialize};

/// Attribute embeddings φ of the primaries (SubSplat A.2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Embed {
    /// E: width of the descriptors (supp.: 128).
    pub dim: usize,
    /// Form of the per-attribute MLPs.
    pub mlp: EmbedMlp,
    /// Frame of the mean and the quaternion.
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
    /// Linear to 32, GELU, one matrix over the four hidden vectors, LayerNorm: a fifth
    /// of the work.
    Lite,
}

/// Frame in which the embedding reads mean and quaternion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AnchorFrame {
    /// World ("world-space position", SubSplat A.2).
    World,
    /// The parent's own source camera: independent of the choice of world.
    SrcCam,
    /// The first context camera.
    View0,
}

/// Form of the scales in the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleInput {
    /// σ in world units.
    Raw,
    /// ln(σ·fx/z): logarithm of input pixels in the source view.
    LogPx,
}

/// Form of the opacity in the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlphaInput {
    /// α.
    Raw,
    /// ln(α/(1 − α)), clipped to ±6.
    Logit,
}

/// Frame of the SH coefficients in the embedding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ShInput {
    /// After the rotation to world.
    World,
    /// Before the rotation: the source camera's frame.
    Camera,
}

/// Deformable attention over the views' features (SubSplat A.2).
///
/// The serialised form holds these keys and those of [`AggregationAblations`] side by
/// side, without nesting.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "FlatKeys", into = "FlatKeys")]
pub struct Aggregation {
    /// False: f^g = f^a = 0 and the heads read the embeddings (SubSplat Table 4).
    pub enabled: bool,
    /// Geometry stages (SubSplat A.2: 3; Table 5: 1, 2, 3).
    pub stages_geo: usize,
    /// Appearance stages (SubSplat A.2: 1).
    pub stages_app: usize,
    /// Feature maps Φ_{v,ℓ}.
    pub levels: Vec<FeatureLevel>,
    /// Normalisation of the stage's query.
    pub norm: StageNorm,
    /// Weighs a view down by exp(−max(0, z − D(R) − τ)/τ′), with τ = τ′ = 2 % of z and D
    /// the view's own depth map.
    pub occlusion_gate: bool,
    /// Largest number of views that learned per-view parameters serve. Scenes with fewer
    /// views use the first parameters (8).
    pub gate_views: usize,
    /// Choices that neither preset makes.
    pub ablations: AggregationAblations,
}

/// Choices of the attention that neither preset makes. [`Default`] is the form of both
/// presets; with it the model contains no code of the ablations.
#[derive(Clone, Debug, PartialEq)]
pub struct AggregationAblations {
    /// True: one set of weights for all geometry stages ("applied three times", supp.).
    /// False: one set for each ("stack three layers", main text).
    pub share_stage_weights: bool,
    /// Source of the attention weights.
    pub op: AttentionOp,
    /// Positions at which the maps are sampled.
    pub points: Points,
    /// Fixed key points of [`Points::Pixelgaussian`]: the first of centre, ±x, ±y, ±z at
    /// 0.45 σ (7).
    pub n_fixed: usize,
    /// Learned points of [`Points::Pixelgaussian`] and [`Points::MapOffsets`] (6).
    pub n_learned: usize,
    /// Groups of channels with attention weights of their own (1).
    pub groups: usize,
    /// Factor of the dot product.
    pub logit_scale: LogitScale,
    /// Learned projections of keys and values.
    pub kv_proj: bool,
    /// View gates α_v.
    pub gate: Gate,
    /// Combination of a stage's output with its input.
    pub residual: Residual,
    /// Feed-forward block after each stage.
    pub ffn: bool,
    /// Treatment of samples outside a view.
    pub mask: MaskMode,
    /// Probability of dropping an attention weight in training (0; PixelGaussian 0.15).
    pub attn_drop: f64,
    /// Pixel grid of the feature maps.
    pub sample_convention: SampleConvention,
    /// Stops the gradient from the sampling positions to the means.
    pub detach_points: bool,
    /// Input of the heads.
    pub head_input: HeadInput,
    /// Equation A.2 as printed: reference point, level `trans4`, factor 1, no projection,
    /// no residual, softmax gate, heads read f. Overrides every other key.
    pub strict_literal: bool,
}

/// Source of the attention weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttentionOp {
    /// Dot product of query and sampled key (SubSplat A.2).
    Dot,
    /// A linear map of the query (GaussianFormer, PixelGaussian).
    Linear,
}

/// Positions at which the maps are sampled.
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
    /// 1 (SubSplat A.2 as printed).
    One,
}

/// View gates α_v ("weight the importance of each viewpoint", SubSplat A.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gate {
    /// V·softmax(β): 1 at initialisation.
    #[serde(rename = "softmaxV")]
    SoftmaxV,
    /// softmax(β): 1/V at initialisation.
    Softmax,
    /// 2·sigmoid(w·q + c): independent of the number and order of views.
    Query,
    /// 1.
    Off,
}

/// Combination of a stage's output with its input.
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

/// Treatment of samples outside a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskMode {
    /// Their logits are −∞; the output is 0 if all samples are outside (GaussianFormer).
    Renorm,
    /// Positions are clamped to [0, 0.9999], without renormalisation (PixelGaussian).
    PgClamp,
}

/// Input of the heads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HeadInput {
    /// f + z (PixelGaussian, GaussianFormer).
    FPlusZ,
    /// f.
    F,
}

impl Embed {
    pub(super) fn preset(preset: Preset) -> Self {
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
    pub(super) fn preset(preset: Preset) -> Self {
        let tuned = preset == Preset::Tuned;
        let mut levels = vec![FeatureLevel::Trans4];
        if tuned {
            levels.push(FeatureLevel::Cnn2);
        }
        Self {
            enabled: true,
            stages_geo: 3,
            stages_app: 1,
            levels,
            norm: if tuned { StageNorm::Pre } else { StageNorm::None },
            occlusion_gate: tuned,
            gate_views: 8,
            ablations: AggregationAblations::default(),
        }
    }

    /// Returns the keys in force: those that `strict_literal` implies, if it is set.
    pub fn resolved(&self) -> Self {
        if !self.ablations.strict_literal {
            return self.clone();
        }
        Self {
            levels: vec![FeatureLevel::Trans4],
            norm: StageNorm::None,
            occlusion_gate: false,
            ablations: AggregationAblations {
                op: AttentionOp::Dot,
                points: Points::Ref,
                groups: 1,
                logit_scale: LogitScale::One,
                kv_proj: false,
                gate: Gate::Softmax,
                residual: Residual::None,
                ffn: false,
                head_input: HeadInput::F,
                ..self.ablations.clone()
            },
            ..self.clone()
        }
    }
}

impl Default for AggregationAblations {
    fn default() -> Self {
        Self {
            share_stage_weights: false,
            op: AttentionOp::Dot,
            points: Points::Ref,
            n_fixed: 7,
            n_learned: 6,
            groups: 1,
            logit_scale: LogitScale::InvSqrt,
            kv_proj: true,
            gate: Gate::SoftmaxV,
            residual: Residual::Add,
            ffn: false,
            mask: MaskMode::Renorm,
            attn_drop: 0.0,
            sample_convention: SampleConvention::HalfPixel,
            detach_points: false,
            head_input: HeadInput::FPlusZ,
            strict_literal: false,
        }
    }
}

/// The serialised form of [`Aggregation`]: all keys on one level. Weight files and
/// training configurations hold it, so keys and their order stay as they are.
#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Aggregation")]
struct FlatKeys {
    enabled: bool,
    stages_geo: usize,
    stages_app: usize,
    share_stage_weights: bool,
    levels: Vec<FeatureLevel>,
    op: AttentionOp,
    points: Points,
    n_fixed: usize,
    n_learned: usize,
    groups: usize,
    logit_scale: LogitScale,
    kv_proj: bool,
    gate: Gate,
    gate_views: usize,
    residual: Residual,
    norm: StageNorm,
    ffn: bool,
    mask: MaskMode,
    attn_drop: f64,
    sample_convention: SampleConvention,
    detach_points: bool,
    occlusion_gate: bool,
    head_input: HeadInput,
    strict_literal: bool,
}

impl From<FlatKeys> for Aggregation {
    fn from(k: FlatKeys) -> Self {
        Self {
            enabled: k.enabled,
            stages_geo: k.stages_geo,
            stages_app: k.stages_app,
            levels: k.levels,
            norm: k.norm,
            occlusion_gate: k.occlusion_gate,
            gate_views: k.gate_views,
            ablations: AggregationAblations {
                share_stage_weights: k.share_stage_weights,
                op: k.op,
                points: k.points,
                n_fixed: k.n_fixed,
                n_learned: k.n_learned,
                groups: k.groups,
                logit_scale: k.logit_scale,
                kv_proj: k.kv_proj,
                gate: k.gate,
                residual: k.residual,
                ffn: k.ffn,
                mask: k.mask,
                attn_drop: k.attn_drop,
                sample_convention: k.sample_convention,
                detach_points: k.detach_points,
                head_input: k.head_input,
                strict_literal: k.strict_literal,
            },
        }
    }
}

impl From<Aggregation> for FlatKeys {
    fn from(a: Aggregation) -> Self {
        let b = a.ablations;
        Self {
            enabled: a.enabled,
            stages_geo: a.stages_geo,
            stages_app: a.stages_app,
            share_stage_weights: b.share_stage_weights,
            levels: a.levels,
            op: b.op,
            points: b.points,
            n_fixed: b.n_fixed,
            n_learned: b.n_learned,
            groups: b.groups,
            logit_scale: b.logit_scale,
            kv_proj: b.kv_proj,
            gate: b.gate,
            gate_views: a.gate_views,
            residual: b.residual,
            norm: a.norm,
            ffn: b.ffn,
            mask: b.mask,
            attn_drop: b.attn_drop,
            sample_convention: b.sample_convention,
            detach_points: b.detach_points,
            occlusion_gate: a.occlusion_gate,
            head_input: b.head_input,
            strict_literal: b.strict_literal,
        }
    }
}
