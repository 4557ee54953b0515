//! Learning rates as functions of the step. Resuming needs no state, and a longer schedule needs
//! only another number of steps.

use serde::{Deserialize, Serialize};

/// Learning rate over a training. Steps count from 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// Linear from 0 over `warmup` steps, constant for `hold` more, then half a cosine down to
    /// `floor` times the rate at the last step.
    Cosine {
        /// Largest rate.
        rate: f64,
        /// Steps of the linear increase.
        #[serde(default)]
        warmup: u64,
        /// Steps of constant rate before the decrease.
        #[serde(default)]
        hold: u64,
        /// Last rate over the largest, 0 to 1.
        #[serde(default)]
        floor: f64,
    },
    /// PyTorch's OneCycleLR with cosine annealing: from rate/25 up, then down to
    /// rate/250,000 at the last step (MVSplat's trainer).
    OneCycle {
        /// Largest rate.
        rate: f64,
        /// Warm-up of MVSplat.
        #[serde(default)]
        warmup: Warmup,
    },
}

/// The two versions of MVSplat's warm-up. Its configuration says 2,000 steps; its released code
/// ignores that number and takes 1 % of (steps of the training + 10).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Warmup {
    /// Number of steps.
    Steps(u64),
    /// The warm-up of the released code.
    Named(NamedWarmup),
}

/// Named versions of the warm-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NamedWarmup {
    /// 1 % of (steps of the training + 10).
    Released,
}

impl Default for Warmup {
    fn default() -> Self {
        Self::Steps(2000)
    }
}

/// Steps that MVSplat's released trainer adds to the schedule's length.
const RELEASED_EXTRA: u64 = 10;
/// Share of the schedule with increasing rate.
const RELEASED_RISE: f64 = 0.01;
/// Ratio of the largest to the first rate (PyTorch's default).
const START_DIVISOR: f64 = 25.0;
/// Ratio of the first to the last rate (PyTorch's default).
const END_DIVISOR: f64 = 1e4;

/// Returns half a cosine from `from` (share 0) to `to` (share 1).
fn anneal(from: f64, to: f64, share: f64) -> f64 {
    to + (from - to) / 2.0 * (1.0 + (std::f64::consts::PI * share).cos())
}

impl Schedule {
    /// Returns the largest rate.
    pub fn peak(&self) -> f64 {
        match self {
            Self::Cosine { rate, .. } | Self::OneCycle { rate, .. } => *rate,
        }
    }

    /// Returns the learning rate of step `step` of a training of `steps`.
    pub fn rate(&self, step: u64, steps: u64) -> f64 {
        match *self {
            Self::Cosine { rate, warmup, hold, floor } => {
                if step < warmup {
                    return rate * (step + 1) as f64 / warmup as f64;
                }
                let from = warmup.saturating_add(hold);
                let fall = steps.saturating_sub(from).saturating_sub(1).max(1) as f64;
                let share = (step.saturating_sub(from) as f64 / fall).min(1.0);
                anneal(rate, floor * rate, share)
            }
            Self::OneCycle { rate, warmup } => {
                let (total, rise) = match warmup {
                    Warmup::Steps(n) => (steps, n as f64),
                    Warmup::Named(NamedWarmup::Released) => {
                        let total = steps + RELEASED_EXTRA;
                        (total, RELEASED_RISE * total as f64)
                    }
                };
                one_cycle(rate, step as f64, total as f64, rise)
            }
        }
    }
}

/// Returns the rate of PyTorch's OneCycleLR, which counts both phases from step 0 and ends them one
/// step early: the first at `rise` − 1, which need not be whole.
fn one_cycle(rate: f64, step: f64, total: f64, rise: f64) -> f64 {
    let start = rate / START_DIVISOR;
    let (top, last) = (rise - 1.0, total - 1.0);
    if step <= top {
        anneal(start, rate, if top > 0.0 { step / top } else { 1.0 })
    } else {
        let share = (step - top) / (last - top).max(1.0);
        anneal(rate, start / END_DIVISOR, share.min(1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cosine_increases_holds_and_decreases() {
        let s = Schedule::Cosine { rate: 2.0, warmup: 4, hold: 3, floor: 0.1 };
        let at = |i| s.rate(i, 20);
        assert_eq!([at(0), at(3), at(4), at(7)], [0.5, 2.0, 2.0, 2.0]);
        assert!((at(13) - 1.1).abs() < 1e-12, "{}", at(13));
        assert!((at(19) - 0.2).abs() < 1e-12 && (at(50) - 0.2).abs() < 1e-12);
        assert!((7..19).all(|i| at(i + 1) < at(i)));
        // The hold never ends, and no addition overflows.
        let s = Schedule::Cosine { rate: 2.0, warmup: 4, hold: u64::MAX, floor: 0.1 };
        assert_eq!(s.rate(19, 20), 2.0);
    }

    #[test]
    fn one_cycle_ends() {
        let s = Schedule::OneCycle { rate: 1.0, warmup: Warmup::Steps(10) };
        assert!((s.rate(0, 100) - 0.04).abs() < 1e-12);
        assert!((s.rate(9, 100) - 1.0).abs() < 1e-12);
        assert!((s.rate(99, 100) - 0.04e-4).abs() < 1e-12);
        assert!((s.rate(1000, 100) - 0.04e-4).abs() < 1e-12);
    }
}
