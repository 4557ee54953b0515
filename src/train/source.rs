//! Where examples come from: an endless sequence that an index determines, so that a
//! training is resumed by a number.

use super::Result;
use crate::data::dataset::Posed;
use crate::data::pair::quantile;
use crate::data::procedural::{self, ExampleSpec, TargetSpec};
use crate::io::image::Rgb;
use half::f16;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// What one step learns from, of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Example {
    /// Views that the network sees; all of one size.
    pub context: Vec<Posed>,
    /// Views that it is to predict, at target size.
    pub targets: Vec<Posed>,
    /// 1 / camera z of each context view's pixels, 0 where there is no surface. Empty
    /// where depth is unknown.
    pub inverse_depth: Vec<Vec<f16>>,
    /// Nearest and farthest depth candidate.
    pub near_far: (f32, f32),
}

/// An endless sequence of examples. The same index gives the same example, on any
/// thread.
pub trait Source: Send + Sync {
    /// Example number `index`.
    ///
    /// # Errors
    /// What a file says; nothing in a generator.
    fn example(&self, index: u64) -> Result<Arc<Example>>;

    /// Harmless oddities that opening it found, one line each.
    fn warnings(&self) -> Vec<String> {
        Vec::new()
    }
}

/// Words that belong to a seed and a place (SplitMix64's finaliser).
pub(super) fn word(seed: u64, key: u64) -> u64 {
    let mut z = seed ^ key.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    for _ in 0..2 {
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
    }
    z
}

/// In [0, 1).
fn share(seed: u64, key: u64) -> f64 {
    (word(seed, key) >> 11) as f64 / (1u64 << 53) as f64
}

/// Made-up rooms ([`procedural`]): a training set is one seed.
#[derive(Clone, Debug)]
pub struct Rooms {
    /// Which rooms.
    pub seed: u64,
    /// Distinct scenes, repeated in order; 0 for any number.
    pub scenes: u64,
    /// Context views.
    pub spec: ExampleSpec,
    /// Targets.
    pub targets: TargetSpec,
    /// Share of the examples whose near and far are what the context views show, a
    /// little wider: what a first look finds at inference
    /// ([`crate::model::subsplat::SubSplat::look`]). The others keep the habits of data
    /// sets.
    pub seen_range: f32,
}

impl Rooms {
    /// near and far of an example whose context views have these depths, from `key`; none
    /// for the share that keeps its own.
    fn seen(&self, key: u64, depths: impl Iterator<Item = f32>) -> Option<(f32, f32)> {
        if share(key, 1) >= f64::from(self.seen_range) {
            return None;
        }
        let mut depths: Vec<f32> = depths.filter(|z| *z > 0.0).collect();
        let [near, far] = [SEEN.0, 1.0 - SEEN.0].map(|q| quantile(&mut depths, q));
        let between = |low: f32, high: f32, k: u64| low + (high - low) * share(key, k) as f32;
        let range = (near * between(SEEN.1, 1.0, 2), far * between(1.0, SEEN.2, 3));
        (range.0 > 0.0 && range.1 > range.0).then_some(range)
    }
}

/// Quantile of depth that a seen range begins at, and the least share of it and the most
/// multiple of its counterpart that near and far are: a first look errs by so much.
const SEEN: (f32, f32, f32) = (0.01, 0.75, 1.4);

impl Source for Rooms {
    fn example(&self, index: u64) -> Result<Arc<Example>> {
        let scene = index.checked_rem(self.scenes).unwrap_or(index);
        let made =
            procedural::Example::with_targets(word(self.seed, scene), &self.spec, &self.targets);
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
        let shown = made.views.iter().take(inverse_depth.len()).flat_map(|v| &v.depth);
        let near_far = self.seen(word(made.seed, 0x5EE), shown.copied());
        let near_far = near_far.unwrap_or((made.near, made.far));
        Ok(Arc::new(Example { context: pictures, targets, inverse_depth, near_far }))
    }
}

/// Shows each example of `inner` several times, in windows: `window` examples in one
/// order, then again in another, `times` in all, then the next window. Making an
/// example once and using it often is what keeps a slow source ahead of the step.
pub struct Replay<S> {
    inner: S,
    window: u64,
    times: u64,
    /// Of the windows in use.
    kept: Mutex<BTreeMap<u64, Arc<Example>>>,
}

impl<S: Source> Replay<S> {
    /// `window` and `times` from 1 to 2³¹: more is that.
    pub fn new(inner: S, window: u64, times: u64) -> Self {
        // Their product is a number of examples.
        let [window, times] = [window, times].map(|n| n.clamp(1, 1 << 31));
        Self { inner, window, times, kept: Mutex::default() }
    }

    /// Which of `inner`'s examples stands at `index`.
    pub fn place(&self, index: u64) -> u64 {
        let block = index / (self.window * self.times);
        let within = index % (self.window * self.times);
        let (pass, i) = (within / self.window, within % self.window);
        block * self.window + shuffled(i, self.window, word(block, pass))
    }
}

/// Place of `i` in a random order of `0..n`: a Feistel cipher over the next power of
/// four, walked until it lands inside.
fn shuffled(i: u64, n: u64, key: u64) -> u64 {
    let bits = (64 - n.saturating_sub(1).leading_zeros()).div_ceil(2).max(1);
    let mask = (1u64 << bits) - 1;
    let mut at = i;
    loop {
        let (mut left, mut right) = (at >> bits, at & mask);
        for round in 0..4 {
            (left, right) = (right, left ^ (word(key, right * 4 + round) & mask));
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
        let place = self.place(index);
        if self.times == 1 {
            return self.inner.example(place);
        }
        let lock = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(example) = lock().get(&place) {
            return Ok(example.clone());
        }
        let example = self.inner.example(place)?;
        let mut kept = lock();
        // Loading runs ahead: the window before may still be wanted.
        let oldest = (place / self.window).saturating_sub(1) * self.window;
        *kept = kept.split_off(&oldest);
        kept.insert(place, example.clone());
        Ok(example)
    }
}

/// Changes that leave an example true. Defaults: those of `learning.md`'s recipe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Chance of a mirror image of views and poses.
    pub flip: f64,
    /// Chance of another order of the colour channels.
    pub permute: f64,
    /// Chance that the context views change places.
    pub swap: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self { flip: 0.5, permute: 0.5, swap: 0.5 }
    }
}

/// The six orders of three channels.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

impl Augmentation {
    /// `example` as it is shown at place `index` of the sequence of `seed`.
    pub fn apply(&self, example: &Example, seed: u64, index: u64) -> Example {
        let draw = |what: u64| share(word(seed, 0xA0_6E), index * 8 + what);
        let mut out = example.clone();
        if draw(0) < self.flip {
            for view in out.context.iter_mut().chain(&mut out.targets) {
                *view = view.flipped();
            }
            for (map, view) in out.inverse_depth.iter_mut().zip(&out.context) {
                map.chunks_mut(view.image.width.max(1)).for_each(<[f16]>::reverse);
            }
        }
        if draw(1) < self.permute {
            let order = ORDERS[(draw(2) * 6.0) as usize % 6];
            for picture in out.context.iter_mut().chain(&mut out.targets) {
                for px in picture.image.data.chunks_exact_mut(3) {
                    let old = [px[0], px[1], px[2]];
                    px.copy_from_slice(&order.map(|c| old[c]));
                }
            }
        }
        if draw(3) < self.swap {
            out.context.reverse();
            out.inverse_depth.reverse();
        }
        out
    }
}
