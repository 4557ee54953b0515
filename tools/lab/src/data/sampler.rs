//! Selects the context and target frames of a video for training.
//!
//! The sampler is pixelSplat's bounded sampler, as the paper describes it and as MVSplat's released
//! code runs it. Two context frames lie a gap apart, and the bounds of the gap grow with the
//! training step. The targets lie between the context frames, both included, with replacement. A
//! target may therefore be a context frame.
//!
//! * [`GapMode::Mvs`]: MVSplat's code replaces the upper bound of the gap by the lower one
//!   (`max_gap = min(num_views - 1, min_gap)`, a fault of pixelSplat that MVSplat keeps). The gap
//!   is then exactly the lower bound: 25, growing to 45 over 150,000 steps, and constant
//!   afterwards. The upper bound of 192 is never used.
//! * [`GapMode::Uniform`]: the gap of the papers, uniform between both bounds: 25 to 45 at the
//!   start, 45 to 192 at the end.
//!
//! In both modes the bounds are truncated to whole frames. A video shorter than the lower bound
//! gives no sample.

use super::procedural::rng::Rng;
use serde::{Deserialize, Serialize};

/// Interpretation of the gap between the context frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapMode {
    /// The gap is its lower bound (MVSplat's code).
    #[default]
    Mvs,
    /// Uniform between both bounds (the papers' text).
    Uniform,
}

/// Smallest and largest gap between the context frames, frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GapBounds {
    /// Smallest gap.
    pub low: usize,
    /// Largest gap.
    pub high: usize,
}

/// Samples context and target frames of a video.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewSampler {
    /// Interpretation of the gap.
    pub mode: GapMode,
    /// Bounds of the gap at step 0, frames.
    pub first: GapBounds,
    /// Bounds of the gap from step `steps` on, frames.
    pub last: GapBounds,
    /// Steps over which the bounds grow linearly. With 0, `last` holds from the start.
    pub steps: usize,
    /// Number of targets of an example.
    pub targets: usize,
}

impl ViewSampler {
    /// Returns MVSplat's `re10k` configuration: 25–45 growing to 45–192 frames over 150,000 steps,
    /// 4 targets.
    pub fn re10k(mode: GapMode) -> Self {
        Self {
            mode,
            first: GapBounds { low: 25, high: 45 },
            last: GapBounds { low: 45, high: 192 },
            steps: 150_000,
            targets: 4,
        }
    }

    /// Returns a sampler with gaps of `low` to `high` frames at every step.
    pub fn constant(low: usize, high: usize, targets: usize) -> Self {
        let bounds = GapBounds { low, high };
        Self { mode: GapMode::Uniform, first: bounds, last: bounds, steps: 0, targets }
    }

    /// Returns the bounds of the gap at `step`, without regard to the video's length and the mode.
    pub fn bounds(&self, step: usize) -> GapBounds {
        if self.steps == 0 {
            return self.last;
        }
        let part = step as f64 / self.steps as f64;
        let interpolated = |from: usize, to: usize| {
            // Python's `int()` rounds towards zero.
            let moved = (from as i64).saturating_add(((to as f64 - from as f64) * part) as i64);
            // The reference applies `min()`, which is correct for growing bounds only.
            if to >= from { moved.min(to as i64) } else { moved.max(to as i64) }.max(0) as usize
        };
        let (first, last) = (self.first, self.last);
        GapBounds {
            low: interpolated(first.low, last.low),
            high: interpolated(first.high, last.high),
        }
    }

    /// Samples context and target frames of a video of `frames` frames at training step `step`.
    ///
    /// Returns `None` where the video is too short. Equal seeds give equal frames.
    pub fn sample(&self, frames: usize, step: usize, seed: u64) -> Option<SampledFrames> {
        let GapBounds { low, high } = self.bounds(step);
        let low = low.max(1);
        let high = match self.mode {
            GapMode::Mvs => low,
            GapMode::Uniform => high.max(low),
        }
        .min(frames.checked_sub(1)?);
        if high < low {
            return None;
        }
        let mut rng = Rng::new(seed);
        let gap = rng.count(low, high);
        let left = rng.count(0, frames - gap - 1);
        let right = left + gap;
        let targets = (0..self.targets).map(|_| rng.count(left, right)).collect();
        Some(SampledFrames { context: [left, right], targets })
    }
}

/// Frames of one example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SampledFrames {
    /// The earlier and the later context frame.
    pub context: [usize; 2],
    /// Target frames, in the order of sampling.
    pub targets: Vec<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_samples_exactly_the_lower_bound() {
        let sampler = ViewSampler::re10k(GapMode::Mvs);
        for (step, gap) in [(0, 25), (7_499, 25), (7_500, 26), (75_000, 35), (149_999, 44)] {
            assert_eq!(sampler.bounds(step).low, gap, "step {step}");
            for seed in 0..50 {
                let [left, right] = sampler.sample(200, step, seed).unwrap().context;
                assert_eq!(right - left, gap, "step {step}");
            }
        }
        for step in [150_000, 400_000] {
            assert_eq!(sampler.bounds(step), GapBounds { low: 45, high: 192 });
        }
        let last = GapBounds { low: 45, high: 1 << 40 };
        let endless = ViewSampler { last, steps: 1, ..sampler };
        assert_eq!(endless.bounds(1 << 40), last);
        // The largest gap of n frames is n − 1.
        assert_eq!(sampler.sample(26, 0, 1).unwrap().context, [0, 25]);
        assert_eq!(sampler.sample(25, 0, 1), None);
        assert_eq!(sampler.sample(0, 0, 1), None);
    }

    #[test]
    fn the_uniform_mode_samples_every_gap_equally() {
        let sampler = ViewSampler::re10k(GapMode::Uniform);
        let mut counts = [0usize; 193];
        for seed in 0..20_000 {
            let [left, right] = sampler.sample(400, 150_000, seed).unwrap().context;
            counts[right - left] += 1;
        }
        assert_eq!(counts[..45].iter().sum::<usize>(), 0);
        // 148 gaps, about 135 of each.
        assert!(counts[45..].iter().all(|c| (80..200).contains(c)), "{counts:?}");
        // The length of a short video limits the gap.
        let longest = (0..2_000).map(|s| {
            let [left, right] = sampler.sample(60, 150_000, s).unwrap().context;
            assert!(right < 60);
            right - left
        });
        assert_eq!(longest.max(), Some(59));
        assert_eq!(sampler.sample(45, 150_000, 0), None);
    }

    #[test]
    fn targets_lie_between_the_contexts_with_both_ends() {
        let sampler = ViewSampler { targets: 4, ..ViewSampler::constant(3, 3, 4) };
        let mut ends = [false; 2];
        let mut doubles = false;
        let mut lefts = [false; 7];
        for seed in 0..500 {
            let sampled = sampler.sample(10, 0, seed).unwrap();
            let [left, right] = sampled.context;
            lefts[left] = true;
            assert_eq!(sampled.targets.len(), 4);
            assert!(sampled.targets.iter().all(|t| (left..=right).contains(t)));
            ends[0] |= sampled.targets.contains(&left);
            ends[1] |= sampled.targets.contains(&right);
            doubles |= sampled.targets[0] == sampled.targets[1];
            assert_eq!(sampler.sample(10, 0, seed).unwrap(), sampled);
        }
        assert!(ends == [true; 2] && doubles && lefts == [true; 7]);
    }
}
