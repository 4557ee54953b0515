//! The small backbone: a plane sweep that a CPU trains and runs in seconds.
//!
//! In: [`Views`]. Out: [`BackboneOutput`], as from MVSplat, and [`DepthMaps`] for depth
//! supervision. Every part is a key of [`crate::network::config::Small`]
//! (src/network/shipped/README.md, "The small backbone").
//!
//! CNN to 1/4 → correlation of unit-length channels and raw matching channels → 3-D stem
//! shared over disparity → 2-D U-Net → logits over D candidates uniform in disparity →
//! convex ×4 upsampling → heads at full resolution.
//!
//! An untrained model is a classical plane sweep: the stem starts as an aggregation of the
//! raw scores, every learned correction at zero, the colour at the pixel's colour.
//! Parameters have the prefix `small.`.
//!
//! A source view counts, pixel by pixel, by its probability mass around the mode (`visible_mean`).

use super::small_parts::{ConvexUpsampling, Stem, Unet, conv_norm_gelu, local_mean};
use crate::network::config::{FeatureLevel, Small};
use crate::network::model::layers::{Activation, Conv2d, ConvShape, GroupNorm, LayerInit, sigmoid};
use crate::network::model::trace::Trace;
use crate::network::model::{BackboneOutput, Levels, Views};
use crate::network::ops::plane_sweep::{Pair, Sweep, pair, relative_pose};
use crate::network::ops::small::{Candidates, MeanOver, SmallArray, Start};
use crate::network::ops::{Array, Backend};
use candle_core::{Result, Tensor, bail};
use candle_nn::{Init, VarBuilder};
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::layout::sh_coefficients;
use subsplat_kernels::sh::C0;

/// 5×5, stride 2, half the size.
const K5S2: ConvShape = ConvShape { kernel: 5, stride: 2, padding: 2 };
/// The raw head starts at σ = 0.6 input px: 0.5 + 14.5·sigmoid(x) = 3 fifths of a
/// pixel ([`crate::network::config::Primaries`]).
const SCALE_BIAS: f32 = -1.57;
/// Slope of the untrained confidence, logit = 6·(mass around the mode) + 1: a pixel with a
/// clear mode is opaque.
const CONFIDENCE_SLOPE: f64 = 6.0;
/// Intercept of the untrained confidence. Pixels with a flat distribution, which lie at the
/// far plane, keep some opacity and cover gaps (on photographs 1 dB better than −1.5).
const CONFIDENCE_SHIFT: f64 = 1.0;

/// Half-width, in candidates, of the window around a source's mode whose mass is the source's
/// visibility.
const VISIBILITY_WINDOW: usize = 1;

/// Views from which they correct one another's depths. Of two views, neither can be outvoted.
const CONSENSUS_VIEWS: usize = 3;

/// Candidates over which a pixel's mean disparity is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DisparityMean {
    /// All candidates, for training.
    AllCandidates,
    /// The candidates around the mode ([`crate::network::config::Small::mode_window`]).
    AroundMode,
}

/// Depth of the small backbone: logits at 1/4 resolution, the others at full resolution.
#[derive(Clone, Debug)]
pub struct DepthMaps<A = Tensor> {
    /// `[B·V, D, h, w]`: logits over candidates, index 0 = far.
    pub logits: A,
    /// `[B·V, 1, H, W]`: disparity (1 / camera z) in candidate indices, 0 to D − 1.
    pub index: A,
    /// `[B·V, 1, H, W]`: confidence in (0, 1).
    pub confidence: A,
}

/// A residual block at 1/4 resolution: GELU(x + GN(conv(GELU(GN(conv x))))).
#[derive(Clone, Debug)]
struct Residual {
    conv1: Conv2d,
    norm1: GroupNorm,
    conv2: Conv2d,
    norm2: GroupNorm,
}

impl Residual {
    fn new(c: usize, vb: VarBuilder) -> Result<Self> {
        Ok(Self {
            conv1: Conv2d::new(c, c, ConvShape::K3, vb.pp("conv1"))?,
            norm1: GroupNorm::new(8, c, vb.pp("norm1"))?,
            conv2: Conv2d::new(c, c, ConvShape::K3, vb.pp("conv2"))?,
            norm2: GroupNorm::new(8, c, vb.pp("norm2"))?,
        })
    }

    fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let y = self.norm1.forward_then(&self.conv1.forward(x)?, Activation::Gelu)?;
        x.add_activation(&self.norm2.forward(&self.conv2.forward(&y)?)?, Activation::Gelu)
    }
}

/// The network.
#[derive(Clone, Debug)]
pub struct SmallBackbone {
    config: Small,
    down2: (Conv2d, GroupNorm),
    down4: (Conv2d, GroupNorm),
    blocks: Vec<Residual>,
    matching: Conv2d,
    stem: Option<Stem>,
    stem_factor: Tensor,
    unet: Unet,
    logits: Conv2d,
    confidence: (Conv2d, Conv2d),
    upsampling: Option<ConvexUpsampling>,
    project: Conv2d,
    head1: Conv2d,
    head2: Conv2d,
    backend: Backend,
}

impl SmallBackbone {
    /// Builds the network; `vb` is at `small`.
    ///
    /// # Errors
    /// A tensor is missing or has another shape; the message names it.
    pub fn new(config: &Small, vb: VarBuilder) -> Result<Self> {
        let [c2, c4] = config.cnn_channels;
        let volume =
            if config.raw_matching { 1 + crate::network::ops::matching::CHANNELS } else { 1 };
        let d = config.depth_candidates;
        let swept = if config.stem_channels > 0 { d } else { d * volume };
        let stem = match config.stem_channels {
            0 => None,
            s => Some(Stem::new(volume, s, vb.pp("stem"))?),
        };
        let unet = Unet::new(swept + c4, &config.unet_channels, vb.pp("unet"))?;
        let top = config.unet_channels[0];
        let upsampling = if config.convex_upsampling {
            Some(ConvexUpsampling::new(top, vb.pp("upsampling"))?)
        } else {
            None
        };
        let hidden = config.head_channels;
        let outputs = 9 + 3 * sh_coefficients(config.primaries.sh_degree) + 1;
        Ok(Self {
            down2: conv_norm(3, c2, K5S2, vb.pp("down2"))?,
            down4: conv_norm(c2, c4, ConvShape::K3S2, vb.pp("down4"))?,
            blocks: (0..config.cnn_blocks)
                .map(|i| Residual::new(c4, vb.pp("blocks").pp(i)))
                .collect::<Result<_>>()?,
            matching: Conv2d::new(c4, config.match_channels, ConvShape::K1, vb.pp("matching"))?,
            stem,
            stem_factor: vb.get_with_hints(1, "stem_factor", Init::Const(1.0))?,
            unet,
            logits: Conv2d::with(top, d, ConvShape::K3, LayerInit::ZERO, vb.pp("logits"))?,
            confidence: (
                Conv2d::new(top + 2, 32, ConvShape::K3, vb.pp("confidence.0"))?,
                Conv2d::with(32, 1, ConvShape::K1, LayerInit::ZERO, vb.pp("confidence.1"))?,
            ),
            upsampling,
            project: Conv2d::new(top, hidden, ConvShape::K1, vb.pp("project"))?,
            head1: Conv2d::new(hidden + 5, hidden, ConvShape::K3, vb.pp("head.0"))?,
            head2: Conv2d::with(hidden, outputs, ConvShape::K3, LayerInit::ZERO, vb.pp("head.1"))?,
            config: config.clone(),
            backend: Backend::Cpu,
        })
    }

    /// Sets the backend of the following plane sweeps.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
    }

    /// Returns the number of steps of [`SmallBackbone::forward_on`] at inference, for a scene of
    /// `views` views.
    pub fn steps(views: usize) -> usize {
        4 + views
    }

    /// Runs the network.
    ///
    /// # Errors
    /// A side is not a multiple of the configuration's stride.
    pub fn forward(
        &self,
        views: &Views,
        mean: DisparityMean,
    ) -> Result<(BackboneOutput, DepthMaps)> {
        self.forward_on(views, &views.images, mean, &|_| true, &Trace::off())
    }

    /// [`SmallBackbone::forward`] on the executor of `images`, the views' images, with the feature maps that
    /// `levels` names and a checkpoint after each part. The trace records nothing.
    ///
    /// # Errors
    /// Those of [`SmallBackbone::forward`] and of the checkpoint.
    pub fn forward_on<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        mean: DisparityMean,
        levels: Levels<'_>,
        trace: &Trace<'_>,
    ) -> Result<(BackboneOutput<A>, DepthMaps<A>)> {
        let [b, v, _, h, w] = images.sizes()?;
        let Matched { rgb, feat2, feat4, deep, logits, index, confidence } =
            self.matched(views, images, mean, trace)?;
        let keeps_hidden = levels(FeatureLevel::Refine1);
        let sides = [&index, &confidence];
        let heads = self.heads(&rgb, &deep, sides, (mean, keeps_hidden), trace)?;
        let mut depths = self.ray_distance(views, &index)?;
        let mut densities = heads.density.reshape((b, v, h * w, 1))?;
        let enough = v >= CONSENSUS_VIEWS && mean == DisparityMean::AroundMode;
        if self.config.depth_consensus && enough {
            let maps = [&depths, &densities];
            depths = images.depth_consensus(&views.cameras, &views.near_far, maps)?;
        }
        let pool = |s: usize| -> Result<A> { split_views(&deep.avg_pool2d(s)?, b, v) };
        let mut features = Vec::new();
        for level in FeatureLevel::ALL.into_iter().filter(|level| levels(*level)) {
            let map = match level {
                FeatureLevel::Trans4 => split_views(&deep, b, v)?,
                FeatureLevel::Trans8 => pool(2)?,
                FeatureLevel::Trans16 => pool(4)?,
                FeatureLevel::Cnn4 => split_views(&feat4, b, v)?,
                FeatureLevel::Cnn2 => split_views(&feat2, b, v)?,
                FeatureLevel::Refine1 => match &heads.hidden {
                    Some(hidden) => split_views(hidden, b, v)?,
                    None => continue,
                },
            };
            features.push((level, map));
        }
        if self.config.cross_check {
            densities = densities.mul(&images.cross_check(&views.cameras, &depths)?)?;
        }
        let output = BackboneOutput {
            raw: heads.raw.reshape((b, v, h * w, ()))?,
            depths,
            densities,
            features,
        };
        Ok((output, DepthMaps { logits, index, confidence: sigmoid(&confidence)? }))
    }

    /// Returns D, the number of depth candidates.
    pub fn candidates(&self) -> usize {
        self.config.depth_candidates
    }

    /// Computes depth alone, without the heads at full resolution.
    ///
    /// # Errors
    /// Those of [`SmallBackbone::forward`].
    pub fn depth(&self, views: &Views, mean: DisparityMean) -> Result<DepthMaps> {
        self.depth_on(views, &views.images, mean, &Trace::off())
    }

    /// [`SmallBackbone::depth`] on the executor of `images`, the views' images, with a checkpoint
    /// after each part.
    ///
    /// # Errors
    /// Those of [`SmallBackbone::depth`] and of the checkpoint.
    pub fn depth_on<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        mean: DisparityMean,
        trace: &Trace<'_>,
    ) -> Result<DepthMaps<A>> {
        let Matched { logits, index, confidence, .. } = self.matched(views, images, mean, trace)?;
        Ok(DepthMaps { logits, index, confidence: sigmoid(&confidence)? })
    }

    /// The network up to the heads.
    fn matched<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        mean: DisparityMean,
        trace: &Trace<'_>,
    ) -> Result<Matched<A>> {
        let [b, v, _, h, w] = images.sizes()?;
        let stride = 4 << (self.config.unet_channels.len() - 1);
        if h % stride != 0 || w % stride != 0 {
            bail!("small backbone: expected sides that are multiples of {stride}, got {h}x{w}");
        }
        let rgb = images.reshape((b * v, 3, h, w))?;
        let feat2 = conv_norm_gelu(&rgb.affine(1.0, -0.5)?, &self.down2)?;
        let mut feat4 = conv_norm_gelu(&feat2, &self.down4)?;
        for block in &self.blocks {
            feat4 = block.forward(&feat4)?;
        }
        trace.step()?;
        let stem = self.sweep(views, images, &feat4, mean)?;
        trace.step()?;
        let deep = self.unet.forward(&stem.input.cat_channels(&feat4)?)?;
        trace.step()?;
        let mut logits = self.logits.forward(&deep)?;
        if let Some(scores) = &stem.scores
            && self.config.stem_skip
        {
            logits = logits.add_scores(scores, &self.stem_factor)?;
        }
        let [index, mass] = self.expected_index(&logits, mean)?;
        let rough = index.sub(&local_mean(&index)?)?.abs()?;
        let sides = A::cat(&[&mass, &rough.affine(0.25, 0.0)?], 1)?;
        let hidden = deep.cat_channels(&sides)?;
        let hidden = self.confidence.0.forward_then(&hidden, Activation::Gelu)?;
        let start = mass.affine(CONFIDENCE_SLOPE, CONFIDENCE_SHIFT)?;
        let confidence = self.confidence.1.forward(&hidden)?.add(&start)?;
        let [index, confidence] = match &self.upsampling {
            Some(convex) => convex.apply(&deep, &rgb, [&index, &confidence])?,
            None => [
                index.upsample_bilinear2d([h, w], None)?,
                confidence.upsample_bilinear2d([h, w], None)?,
            ],
        };
        trace.step()?;
        Ok(Matched { rgb, feat2, feat4, deep, logits, index, confidence })
    }

    /// Matching scores of every view, of its sources together.
    fn sweep<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        feat4: &A,
        mean: DisparityMean,
    ) -> Result<Swept<A>> {
        let unit = self.matching.forward(feat4)?.normalize_channels()?;
        let disparities = candidates(views, self.config.depth_candidates);
        let count = views.scenes() * views.views();
        let sources = views.sources_per_view();
        let rows = source_rows(views);
        // The volumes are large: inference computes those of one view at a time, while a
        // training graph keeps all of them anyway.
        let step = match mean {
            DisparityMean::AllCandidates => count,
            DisparityMean::AroundMode => 1,
        };
        let mut parts = Vec::with_capacity(count.div_ceil(step));
        for rows in rows.chunks(step * sources) {
            let volume = self.volume(views, images, &unit, &disparities, rows)?;
            parts.push(match &self.stem {
                Some(stem) => self.visible_mean(&stem.forward(&volume)?, sources)?,
                None => {
                    let [r, c, d, h, w] = volume.sizes()?;
                    mean_of(&volume.reshape((r, c * d, h, w))?, sources)?
                }
            });
        }
        let input = whole(parts)?;
        let scores = self.stem.is_some().then(|| input.clone());
        Ok(Swept { input, scores })
    }

    /// Volume `[R, C, D, h, w]` of the correlation and the raw matching channels, for rows of
    /// (view, source), rows of `unit` `[B·V, C, h, w]`.
    fn volume<A: SmallArray>(
        &self,
        views: &Views,
        images: &A,
        unit: &A,
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<A> {
        let [_, channels, h, w] = unit.sizes()?;
        let d = self.config.depth_candidates;
        let v = views.views();
        let depths = |&[i, _]: &[usize; 2]| {
            disparities[i / v][i % v].iter().map(|d| 1.0 / d).collect::<Vec<f32>>()
        };
        let sweep = Sweep {
            pairs: rows.iter().map(|row| sweep_pairs(views, *row, h, w)).collect::<Result<_>>()?,
            depths: rows.iter().map(depths).collect(),
            centre: 0.5,
            min_z: 1e-3,
            scale: 1.0,
            channels,
            size: [h, w],
        };
        let references: Vec<u32> = rows.iter().map(|r| r[0] as u32).collect();
        let reference = if references.iter().enumerate().all(|(i, r)| i == *r as usize) {
            unit.narrow(0, 0, rows.len())?
        } else {
            unit.index_select(&references, 0)?
        };
        let learned = reference.plane_sweep(unit, sweep, &self.backend)?;
        // [R, 1, D·h, w]
        let learned = learned.reshape((rows.len(), 1, d * h, w))?;
        let volume = if self.config.raw_matching {
            let raw = images.raw_matching(&views.cameras, disparities, rows)?;
            learned.cat_channels(&raw.reshape((rows.len(), (), d * h, w))?)?
        } else {
            learned
        };
        volume.reshape((rows.len(), (), d, h, w))
    }

    /// Mean `[N, D, h, w]` of the stem's scores `[N·S, D, h, w]` over the S sources. A source that
    /// does not show a pixel's surface has no clear match there. Therefore the weight of a source
    /// is the square of its probability mass around the mode (after Zhang et al. 2020, *Visibility-aware
    /// Multi-view Stereo Network*).
    fn visible_mean<A: SmallArray>(&self, scores: &A, sources: usize) -> Result<A> {
        if sources == 1 {
            return Ok(scores.clone());
        }
        let [rows, d, h, w] = scores.sizes()?;
        let zeros = scores.affine(0.0, 0.0)?;
        let logits = zeros.add_scores(scores, &self.stem_factor)?.detach();
        let [_, mass] = logits.expectation(VISIBILITY_WINDOW, MeanOver::All)?;
        let weights = mass.sqr()?.affine(1.0, 1e-6)?;
        let weights = weights.reshape((rows / sources, sources, 1, h, w))?;
        let scores = scores.reshape((rows / sources, sources, d, h, w))?;
        scores.mul(&weights)?.sum(1)?.div(&weights.sum(1)?)
    }

    /// Expected candidate index, and the probability within the window around the mode:
    /// `[B·V, 1, h, w]` each.
    fn expected_index<A: SmallArray>(&self, logits: &A, mean: DisparityMean) -> Result<[A; 2]> {
        let window = self.config.mode_window;
        let over = match mean {
            DisparityMean::AroundMode if window > 0 => MeanOver::Window,
            _ => MeanOver::All,
        };
        logits.expectation(window.max(1), over)
    }

    /// `sides`: candidate index and confidence (a logit), `[B·V, 1, H, W]`. The hidden maps are kept where
    /// `keeps_hidden`.
    fn heads<A: SmallArray>(
        &self,
        rgb: &A,
        deep: &A,
        sides: [&A; 2],
        (mean, keeps_hidden): (DisparityMean, bool),
        trace: &Trace<'_>,
    ) -> Result<Heads<A>> {
        let [views, ..] = rgb.sizes::<4>()?;
        let share = 1.0 / (self.config.depth_candidates - 1) as f32;
        let projected = self.project.forward(deep)?;
        // These are the network's largest tensors: inference computes one view at a time,
        // while a training graph keeps all of them anyway.
        let step = match mean {
            DisparityMean::AllCandidates => views,
            DisparityMean::AroundMode => 1,
        };
        let (mut raws, mut densities, mut hiddens) = (Vec::new(), Vec::new(), Vec::new());
        for i in (0..views).step_by(step) {
            let part = |t: &A| if step == views { Ok(t.clone()) } else { t.narrow(0, i, 1) };
            let rgb = part(rgb)?;
            let index = part(sides[0])?;
            let confidence = part(sides[1])?;
            let input = part(&projected)?.head_input(&rgb, [&index, &confidence], share)?;
            let hidden = self.head1.forward_then(&input, Activation::Gelu)?;
            drop(input);
            let out = self.head2.forward(&hidden)?;
            let [raw, density] = out.head_output(&confidence, &rgb, self.start())?;
            raws.push(raw);
            densities.push(density);
            hiddens.extend(keeps_hidden.then_some(hidden));
            trace.step()?;
        }
        let hidden = if keeps_hidden { Some(whole(hiddens)?) } else { None };
        Ok(Heads { raw: whole(raws)?, density: whole(densities)?, hidden })
    }

    /// Values that the raw head corrects: offset 0, σ of 0.6 px, no rotation, the pixel's
    /// colour (or mid-grey).
    fn start(&self) -> Start {
        let d = sh_coefficients(self.config.primaries.sh_degree);
        let mut row = vec![0.0; 9 + 3 * d];
        row[2..5].fill(SCALE_BIAS);
        row[8] = 1.0;
        let colour = [9, 9 + d, 9 + 2 * d];
        Start {
            row,
            colour: self.config.pixel_colour.then_some((
                colour,
                (1.0 / C0) as f32,
                (-0.5 / C0) as f32,
            )),
            confident: self.config.confidence_opacity,
        }
    }

    /// Distance along the unit ray, `[B, V, H·W, 1]`, from candidate indices.
    fn ray_distance<A: SmallArray>(&self, views: &Views, index: &A) -> Result<A> {
        let (b, v, _, h, w) = views.images.dims5()?;
        let steps = (self.config.depth_candidates - 1) as f32;
        let range = |&NearFar { near, far }: &NearFar| {
            let (low, high) = (1.0 / far, 1.0 / near);
            Candidates { low, step: (high - low) / steps }
        };
        let ranges = views.near_far.iter().flatten().map(range).collect();
        let lengths = views.cameras.iter().flatten().flat_map(ray_lengths).collect();
        index.ray_distance(ranges, lengths)?.reshape((b, v, h * w, 1))
    }
}

/// Joins rows; a single part is not copied.
fn whole<A: Array>(mut parts: Vec<A>) -> Result<A> {
    match parts.len() {
        1 => Ok(parts.swap_remove(0)),
        _ => A::cat(&parts.iter().collect::<Vec<_>>(), 0),
    }
}

/// Features and depth before the heads. `confidence` is a logit; `index` and `confidence`
/// are at full resolution.
struct Matched<A> {
    rgb: A,
    feat2: A,
    feat4: A,
    deep: A,
    logits: A,
    index: A,
    confidence: A,
}

struct Swept<A> {
    input: A,
    scores: Option<A>,
}

struct Heads<A> {
    raw: A,
    density: A,
    hidden: Option<A>,
}

fn conv_norm(c: usize, o: usize, s: ConvShape, vb: VarBuilder) -> Result<(Conv2d, GroupNorm)> {
    Ok((Conv2d::new(c, o, s, vb.pp("conv"))?, GroupNorm::new(8, o, vb.pp("norm"))?))
}

fn split_views<A: Array>(t: &A, b: usize, v: usize) -> Result<A> {
    let [_, c, h, w] = t.sizes()?;
    t.reshape((b, v, c, h, w))
}

/// (view, source) for each view and each of its sources, as rows of `[B·V]`.
fn source_rows(views: &Views) -> Vec<[usize; 2]> {
    let v = views.views();
    let of_view = |(i, list): (usize, &Vec<usize>)| -> Vec<[usize; 2]> {
        list.iter().map(|j| [i, i / v * v + j]).collect()
    };
    views.sources().iter().flatten().enumerate().flat_map(of_view).collect()
}

/// The plane sweep's map of one row of [`source_rows`], at the features' resolution h × w.
fn sweep_pairs(views: &Views, [i, j]: [usize; 2], h: usize, w: usize) -> Result<Vec<Pair>> {
    let v = views.views();
    let [r, s] = [i, j].map(|k| views.cameras[k / v][k % v].resized_unchecked(w, h));
    Ok(vec![pair(&r.intrinsics(), &s.intrinsics(), relative_pose(&r, &s), j)?])
}

/// Mean of `[N·S, …]` over the S sources.
fn mean_of<A: Array>(volume: &A, sources: usize) -> Result<A> {
    match volume.sizes()? {
        _ if sources == 1 => Ok(volume.clone()),
        [rows, c, h, w] => volume.reshape((rows / sources, sources, c, h, w))?.mean(1),
    }
}

/// Disparity candidates (1 / camera z), `[B][V][D]`; index 0 is far.
fn candidates(views: &Views, d: usize) -> Vec<Vec<Vec<f32>>> {
    let list = |&NearFar { near, far }: &NearFar| {
        let (lo, hi) = (1.0 / far, 1.0 / near);
        (0..d).map(|k| lo + (hi - lo) * k as f32 / (d - 1) as f32).collect()
    };
    views.near_far.iter().map(|scene| scene.iter().map(list).collect()).collect()
}

/// Length of K⁻¹(u, v, 1) at each pixel centre: the distance along the ray over camera z.
fn ray_lengths(camera: &Camera) -> Vec<f32> {
    let k = camera.intrinsics();
    let at = |i: usize| {
        let x = (i % k.width) as f32 + 0.5;
        let y = (i / k.width) as f32 + 0.5;
        k.unproject(glam::Vec2::new(x, y)).length()
    };
    (0..k.width * k.height).map(at).collect()
}
