//! Which frames of a video are context and which are targets in training: pixelSplat's
//! bounded sampler, as the paper states it and as MVSplat's released code runs it.
//!
//! Two context frames lie a gap apart; the gap's bounds grow with the training step.
//! The targets are drawn between the contexts, both included, with replacement: a
//! target may be a context frame.
//!
//! * [`GapMode::Mvs`]: MVSplat's code overwrites the upper bound of the gap with the
//!   lower one (`max_gap = min(num_views - 1, min_gap)`, a bug of pixelSplat's that it
//!   keeps on purpose), so the gap is exactly the lower bound: 25 growing to 45 over
//!   150,000 steps, and then always 45. The upper bound of 192 is never used.
//! * [`GapMode::Uniform`]: what the papers say: uniform between both bounds, 25 to 45
//!   at the start, 45 to 192 at the end.
//!
//! In both, bounds are truncated to whole frames, and a video that is shorter than the
//! lower bound gives nothing.

use super::procedural::rng::Rng;
use serde::{Deserialize, Serialize};

/// Reading of the gap between the context frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapMode {
    /// The gap is its lower bound (MVSplat's code).
    #[default]
    Mvs,
    /// Uniform between both bounds (the papers' text).
    Uniform,
}

/// Draws context and target frames of a video.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewSampler {
    /// Reading of the gap.
    pub mode: GapMode,
    /// Bounds of the gap at step 0, frames.
    pub first: (usize, usize),
    /// Bounds of the gap from step `steps` on, frames.
    pub last: (usize, usize),
    /// Steps over which the bounds grow, linearly; 0: `last` from the start.
    pub steps: usize,
    /// Targets of an example.
    pub targets: usize,
}

impl ViewSampler {
    /// MVSplat's `re10k` configuration: 25–45 growing to 45–192 frames over 150,000
    /// steps, 4 targets.
    pub fn re10k(mode: GapMode) -> Self {
        Self { mode, first: (25, 45), last: (45, 192), steps: 150_000, targets: 4 }
    }

    /// Gaps of `low` to `high` frames throughout.
    pub fn constant(low: usize, high: usize, targets: usize) -> Self {
        let bounds = (low, high);
        Self { mode: GapMode::Uniform, first: bounds, last: bounds, steps: 0, targets }
    }

    /// Bounds of the gap at `step`, before the video's length and the mode.
    pub fn bounds(&self, step: usize) -> (usize, usize) {
        if self.steps == 0 {
            return self.last;
        }
        let part = step as f64 / self.steps as f64;
        let grown = |from: usize, to: usize| {
            // Python's int(): towards zero.
            let moved = (from as i64).saturating_add(((to as f64 - from as f64) * part) as i64);
            // The reference stops at the end by min(), for bounds that grow.
            if to >= from { moved.min(to as i64) } else { moved.max(to as i64) }.max(0) as usize
        };
        (grown(self.first.0, self.last.0), grown(self.first.1, self.last.1))
    }

    /// Context and target frames of a video of `frames` frames at training step `step`;
    /// `None` where it is too short. The same `seed` gives the same frames.
    pub fn draw(&self, frames: usize, step: usize, seed: u64) -> Option<Drawn> {
        let (low, high) = self.bounds(step);
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
        Some(Drawn { context: [left, right], targets })
    }
}

/// Frames of one example.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// The earlier and the later context frame.
    pub context: [usize; 2],
    /// Frames to render, in the order drawn.
    pub targets: Vec<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_draws_exactly_the_lower_bound() {
        let sampler = ViewSampler::re10k(GapMode::Mvs);
        for (step, gap) in [(0, 25), (7_499, 25), (7_500, 26), (75_000, 35), (149_999, 44)] {
            assert_eq!(sampler.bounds(step).0, gap, "step {step}");
            for seed in 0..50 {
                let [left, right] = sampler.draw(200, step, seed).unwrap().context;
                assert_eq!(right - left, gap, "step {step}");
            }
        }
        for step in [150_000, 400_000] {
            assert_eq!(sampler.bounds(step), (45, 192));
        }
        let endless = ViewSampler { last: (45, 1 << 40), steps: 1, ..sampler };
        assert_eq!(endless.bounds(1 << 40), (45, 1 << 40));
        // n − 1 frames apart is the most that n frames allow.
        assert_eq!(sampler.draw(26, 0, 1).unwrap().context, [0, 25]);
        assert_eq!(sampler.draw(25, 0, 1), None);
        assert_eq!(sampler.draw(0, 0, 1), None);
    }

    #[test]
    fn the_text_draws_every_gap_alike() {
        let sampler = ViewSampler::re10k(GapMode::Uniform);
        let mut counts = [0usize; 193];
        for seed in 0..20_000 {
            let [left, right] = sampler.draw(400, 150_000, seed).unwrap().context;
            counts[right - left] += 1;
        }
        assert_eq!(counts[..45].iter().sum::<usize>(), 0);
        // 148 gaps, about 135 of each.
        assert!(counts[45..].iter().all(|c| (80..200).contains(c)), "{counts:?}");
        // A short video ends the range.
        let longest = (0..2_000).map(|s| {
            let [left, right] = sampler.draw(60, 150_000, s).unwrap().context;
            assert!(right < 60);
            right - left
        });
        assert_eq!(longest.max(), Some(59));
        assert_eq!(sampler.draw(45, 150_000, 0), None);
    }

    #[test]
    fn targets_lie_between_the_contexts_with_both_ends() {
        let sampler = ViewSampler { targets: 4, ..ViewSampler::constant(3, 3, 4) };
        let (mut ends, mut doubles, mut lefts) = ([false; 2], false, [false; 7]);
        for seed in 0..500 {
            let drawn = sampler.draw(10, 0, seed).unwrap();
            let [left, right] = drawn.context;
            lefts[left] = true;
            assert_eq!(drawn.targets.len(), 4);
            assert!(drawn.targets.iter().all(|t| (left..=right).contains(t)));
            ends[0] |= drawn.targets.contains(&left);
            ends[1] |= drawn.targets.contains(&right);
            doubles |= drawn.targets[0] == drawn.targets[1];
            assert_eq!(sampler.draw(10, 0, seed).unwrap(), drawn);
        }
        assert!(ends == [true; 2] && doubles && lefts == [true; 7]);
    }
}
