//! Attribute embeddings and attention over views (paper A.2; spec 1).

use super::{FeatureLevel, Preset};
use serde::{Deserialize, Serialize};

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
    /// Most views that learned per-view gates (and the weights of op `linear`) can
    /// serve; fewer views use the first of them (8).
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
            gate_views: 8,
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
