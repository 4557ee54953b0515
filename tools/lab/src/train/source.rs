//! Sources of training examples: an infinite sequence indexed by a number, so that a training
//! resumes from an index.

use super::Result;
use crate::data::dataset::Posed;
use crate::data::procedural;
use crate::data::procedural::{ExampleSpec, TargetSpec};
use half::f16;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use subsplat::reconstruct::inputs::pair::quantile;
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::NearFar;
use subsplat_kernels::layout::random::{GOLDEN, mix};

/// One scene as training data.
#[derive(Clone, Debug, PartialEq)]
pub struct Example {
    /// Input views of the network, all of one size.
    pub context: Vec<Posed>,
    /// Views to predict, at target size.
    pub targets: Vec<Posed>,
    /// 1 / camera z of each context view's pixels, 0 without a surface. Empty where depth is
    /// unknown.
    pub inverse_depth: Vec<Vec<f16>>,
    /// Nearest and farthest depth candidate, world units.
    pub near_far: NearFar,
    /// Context views that are targets too. They are the last of `targets`, in order.
    pub input_targets: InputTargets,
}

impl Example {
    /// Returns r: the side of the targets over the side of the context views, at least 1.
    pub fn upscale(&self) -> usize {
        let width = |views: &[Posed]| views.first().map_or(1, |p| p.image.width.max(1));
        (width(&self.targets) / width(&self.context)).max(1)
    }
}

/// Context views among the targets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum InputTargets {
    /// None.
    #[default]
    Absent,
    /// All of them.
    Plain,
    /// All of them, and the children take the detail of these pictures ([`subsplat_kernels::cpu::detail`]).
    WithDetail,
}

/// An infinite sequence of examples. Equal indices give equal examples on any thread.
pub trait Source: Send + Sync {
    /// Returns example number `index`.
    ///
    /// # Errors
    /// A file that cannot be read; generators do not fail.
    fn example(&self, index: u64) -> Result<Arc<Example>>;

    /// Returns the warnings from opening the source, one line each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }
}

/// Returns 64 pseudo-random bits for a seed and a key (SplitMix64's finaliser, twice).
pub(super) fn hash(seed: u64, key: u64) -> u64 {
    mix(mix(seed ^ key.wrapping_add(1).wrapping_mul(GOLDEN)))
}

/// Returns a pseudo-random number in [0, 1).
pub(super) fn uniform(seed: u64, key: u64) -> f64 {
    (hash(seed, key) >> 11) as f64 / (1u64 << 53) as f64
}

/// Size of an example.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExampleSize {
    /// Width and height of the network's input, px.
    pub input: [usize; 2],
    /// r: side of the targets over side of the input.
    pub upscale: usize,
}

/// Procedural rooms ([`procedural`]). A training set is determined by one seed.
#[derive(Clone, Debug)]
pub struct Rooms {
    /// Seed of the rooms.
    pub seed: u64,
    /// Number of distinct scenes, which repeat in order; 0 for unlimited.
    pub scenes: u64,
    /// Context views.
    pub spec: ExampleSpec,
    /// Targets.
    pub targets: TargetSpec,
    /// Sizes of the examples, by turns, instead of those of `spec` and `targets`; may be empty.
    pub sizes: Vec<ExampleSize>,
    /// Share of the examples whose near and far are the visible depth range, slightly widened, as
    /// the depth estimate at inference gives it. The others keep the generator's near and far.
    pub seen_range: f32,
    /// Share of the examples with the context views as targets whose children take their detail.
    pub detail: f32,
}

impl Rooms {
    /// Returns near and far of an example whose context views have these depths. Returns
    /// `None` for the share of examples that keep the generator's range.
    fn visible_range(&self, key: u64, depths: impl Iterator<Item = f32>) -> Option<NearFar> {
        if uniform(key, 1) >= f64::from(self.seen_range) {
            return None;
        }
        let mut depths: Vec<f32> = depths.filter(|z| *z > 0.0).collect();
        let [near, far] = [RANGE_QUANTILE, 1.0 - RANGE_QUANTILE].map(|q| quantile(&mut depths, q));
        let between = |low: f32, high: f32, k: u64| low + (high - low) * uniform(key, k) as f32;
        let near = near * between(NEAR_FACTOR_MIN, 1.0, 2);
        let far = far * between(1.0, FAR_FACTOR_MAX, 3);
        (near > 0.0 && far > near).then_some(NearFar { near, far })
    }
}

/// Quantile of depth at which a visible range begins; it ends at the opposite quantile.
const RANGE_QUANTILE: f32 = 0.01;
/// Smallest factor on the lower quantile for near: the error of the estimate at inference.
const NEAR_FACTOR_MIN: f32 = 0.75;
/// Largest factor on the upper quantile for far: the error of the estimate at inference.
const FAR_FACTOR_MAX: f32 = 1.4;

impl Source for Rooms {
    fn example(&self, index: u64) -> Result<Arc<Example>> {
        let scene = index.checked_rem(self.scenes).unwrap_or(index);
        let (mut spec, mut targets) = (self.spec, self.targets);
        if let Some(turn) = scene.checked_rem(self.sizes.len() as u64) {
            let size = self.sizes[turn as usize];
            [spec.cameras.width, spec.cameras.height] = size.input;
            targets.ratio = size.upscale;
        }
        let made = procedural::Example::with_targets(hash(self.seed, scene), &spec, &targets);
        let mut pictures = Vec::with_capacity(made.views.len());
        let mut inverse_depth = Vec::new();
        for (i, (view, camera)) in made.views.iter().zip(&made.cameras).enumerate() {
            let data = view.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
            let image = Rgb { width: view.width, height: view.height, data };
            pictures.push(Posed { image, camera: *camera });
            if i < 2 {
                let inverse = |z: &f32| f16::from_f32(if *z > 0.0 { 1.0 / z } else { 0.0 });
                inverse_depth.push(view.depth.iter().map(inverse).collect());
            }
        }
        let targets = pictures.split_off(2.min(pictures.len()));
        let depths = made.views.iter().take(inverse_depth.len()).flat_map(|v| &v.depth);
        let near_far = self.visible_range(hash(made.seed, 0x5EE), depths.copied());
        let near_far = near_far.unwrap_or(NearFar::new(made.near, made.far));
        let input_targets = if !self.targets.inputs {
            InputTargets::Absent
        } else if uniform(hash(made.seed, 0xDE_7A), 0) < f64::from(self.detail) {
            InputTargets::WithDetail
        } else {
            InputTargets::Plain
        };
        let context = pictures;
        Ok(Arc::new(Example { context, targets, inverse_depth, near_far, input_targets }))
    }
}

/// Repeats the examples of `inner` in windows. A window of `window` examples appears `times` times,
/// each time in another order; then the next window follows. Repetition lets a slow source keep up
/// with the training step.
pub struct Replay<S> {
    inner: S,
    window: u64,
    times: u64,
    /// Examples of the windows in use, by index.
    kept: Mutex<BTreeMap<u64, Arc<Example>>>,
}

impl<S: Source> Replay<S> {
    /// Creates a replay; `window` and `times` are clamped to 1..=2³¹.
    pub fn new(inner: S, window: u64, times: u64) -> Self {
        // The clamp keeps their product within 64 bits.
        let [window, times] = [window, times].map(|n| n.clamp(1, 1 << 31));
        Self { inner, window, times, kept: Mutex::default() }
    }

    /// Returns the index in `inner` of the example at `index`.
    pub fn source_index(&self, index: u64) -> u64 {
        let block = index / (self.window * self.times);
        let within = index % (self.window * self.times);
        let pass = within / self.window;
        let i = within % self.window;
        block * self.window + shuffled(i, self.window, hash(block, pass))
    }
}

/// Returns the position of `i` in a random permutation of `0..n`: a Feistel cipher over the next
/// power of four, iterated until the result is below `n`.
fn shuffled(i: u64, n: u64, key: u64) -> u64 {
    let bits = (64 - n.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1u64 << bits) - 1;
    let mut at = i;
    loop {
        let (mut left, mut right) = (at >> bits, at & mask);
        for round in 0..4 {
            (left, right) = (right, left ^ (hash(key, right * 4 + round) & mask));
        }
        at = left << bits | right;
        if at < n {
            return at;
        }
    }
}

impl<S: Source> Source for Replay<S> {
    fn warnings(&self) -> Vec<String> {
        self.inner.warnings()
    }

    fn example(&self, index: u64) -> Result<Arc<Example>> {
        let position = self.source_index(index);
        if self.times == 1 {
            return self.inner.example(position);
        }
        let lock = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(example) = lock().get(&position) {
            return Ok(example.clone());
        }
        let example = self.inner.example(position)?;
        let mut kept = lock();
        // Loading runs ahead, so that the previous window may still be in use.
        let oldest = (position / self.window).saturating_sub(1) * self.window;
        *kept = kept.split_off(&oldest);
        kept.insert(position, example.clone());
        Ok(example)
    }
}
