//! Progress of a reconstruction: stages, fractions, times, cancellation.
//!
//! The callback runs on the caller's thread, so that it need not be `Send`. The network runs on a thread of the
//! pool and calls a checkpoint after each stage and each chunk.

use super::{Error, Result};
use crate::network::model::trace::Checkpoint;
#[cfg(target_family = "wasm")]
use send_wrapper::SendWrapper;
#[cfg(target_family = "wasm")]
use std::cell::RefCell;
use std::fmt;
use std::ops::ControlFlow;
#[cfg(not(target_family = "wasm"))]
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::{AtomicBool, Ordering};
#[cfg(not(target_family = "wasm"))]
use std::sync::mpsc;
use subsplat_kernels::clock::Instant;

/// A stage of a reconstruction, in the order of execution. [`fmt::Display`] gives its description.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Stage {
    /// Given cameras are adjusted by matched points.
    Poses,
    /// Photographs are cropped and resized.
    Crop,
    /// Points are matched between photographs.
    Check,
    /// The small backbone estimates near and far.
    DepthRange,
    /// The backbone predicts depth, density and features.
    Backbone,
    /// Primary Gaussians are made of the backbone's outputs.
    Primaries,
    /// Depth is matched between the photographs.
    Matching,
    /// Primaries are optimised on the photographs of the input's size.
    Parents,
    /// SubSplat divides the primaries into children.
    Subsplat,
    /// Photographs add detail to colours.
    Detail,
    /// Sizes, opacities and colours are fitted to the photographs.
    Fit,
    /// All parameters are refined on the photographs; SH coefficients from three photographs on.
    Refine,
}

impl Stage {
    /// The name in reports, for programs: `crop`, `depth range`, ….
    pub fn name(self) -> &'static str {
        match self {
            Self::Poses => "poses",
            Self::Crop => "crop",
            Self::Check => "check",
            Self::DepthRange => "depth range",
            Self::Backbone => "backbone",
            Self::Primaries => "primaries",
            Self::Matching => "matching",
            Self::Parents => "parents",
            Self::Subsplat => "subsplat",
            Self::Detail => "detail",
            Self::Fit => "fit",
            Self::Refine => "refine",
        }
    }

    /// Description of the stage for people: `cropping the photographs`, ….
    pub fn description(self) -> &'static str {
        match self {
            Self::Poses => "adjusting the cameras",
            Self::Crop => "cropping the photographs",
            Self::Check => "comparing the photographs",
            Self::DepthRange => "finding the nearest and the farthest point",
            Self::Backbone => "estimating distances",
            Self::Primaries => "placing splats",
            Self::Matching => "correcting distances",
            Self::Parents => "adjusting splats",
            Self::Subsplat => "dividing splats",
            Self::Detail => "adding fine texture",
            Self::Fit => "matching sizes and colours",
            Self::Refine => "sharpening new views",
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.description())
    }
}

/// State of a reconstruction, as the callback of
/// [`Reconstructor::run_with`](super::Reconstructor::run_with) receives it.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// The stage that runs now.
    pub stage: Stage,
    /// Estimated share of the time that has passed, 0 to 1; never decreases.
    pub fraction: f32,
}

/// Duration of one stage.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct StageTime {
    /// The stage.
    pub stage: Stage,
    /// Wall-clock time, seconds.
    pub seconds: f64,
}

/// The caller's callback.
pub(super) type Callback<'a> = dyn FnMut(Progress) -> ControlFlow<()> + 'a;

/// Most reports of one stage of the network.
const REPORTS_MAX: usize = 32;

/// Share of one stage in the whole.
#[derive(Clone, Copy, Debug)]
pub(super) struct StageCost {
    pub(super) stage: Stage,
    /// Relative duration, any unit.
    pub(super) cost: f32,
}

/// Measures stages, and reports them to the caller.
#[derive(Debug)]
pub(super) struct Tracker {
    costs: Vec<StageCost>,
    current: Option<(Stage, Instant)>,
    times: Vec<StageTime>,
    fraction: f32,
}

impl Tracker {
    /// A tracker of the stages in `costs`, which are in order of execution.
    pub(super) fn new(costs: Vec<StageCost>) -> Self {
        Self { costs, current: None, times: Vec::new(), fraction: 0.0 }
    }

    /// Ends the current stage. A stage that runs again has the sum of its times.
    pub(super) fn close(&mut self) {
        if let Some((stage, start)) = self.current.take() {
            let seconds = start.elapsed().as_secs_f64();
            match self.times.iter_mut().find(|time| time.stage == stage) {
                Some(time) => time.seconds += seconds,
                None => self.times.push(StageTime { stage, seconds }),
            }
        }
    }

    /// Ends the current stage and begins `stage`.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub(super) fn begin(&mut self, stage: Stage, callback: &mut Callback<'_>) -> Result<()> {
        self.close();
        self.current = Some((stage, Instant::now()));
        self.advance(0.0, callback)
    }

    /// A callback for the current stage that receives the part of it that is done, 0 to 1.
    pub(super) fn parts<'a>(
        &'a mut self,
        callback: &'a mut Callback<'_>,
    ) -> impl FnMut(f32) -> ControlFlow<()> + 'a {
        move |part| match self.advance(part, callback) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }

    /// Reports that `part` of the current stage is done, 0 to 1.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub(super) fn advance(&mut self, part: f32, callback: &mut Callback<'_>) -> Result<()> {
        let Some((stage, _)) = self.current else { return Ok(()) };
        let total: f32 = self.costs.iter().map(|c| c.cost).sum();
        let before: f32 = self.costs.iter().filter(|c| c.stage < stage).map(|c| c.cost).sum();
        let own = self.costs.iter().find(|c| c.stage == stage).map_or(0.0, |c| c.cost);
        if total > 0.0 {
            let fraction = ((before + part * own) / total).clamp(0.0, 1.0);
            self.fraction = self.fraction.max(fraction);
        }
        report(Progress { stage, fraction: self.fraction }, callback)
    }

    /// Runs `work` on a thread of rayon's pool, where parallel calls start without a wake-up, and
    /// reports its steps. `work` calls its checkpoint after each of about `steps` steps, on any
    /// thread; the callback runs on this thread. On a thread of the pool `work` runs without
    /// reports, because waiting for them would hold up the pool.
    ///
    /// # Errors
    /// [`Error::Cancelled`]; those of `work`.
    #[cfg(not(target_family = "wasm"))]
    pub(super) fn run_steps<T: Send>(
        &mut self,
        steps: usize,
        callback: &mut Callback<'_>,
        work: impl FnOnce(Checkpoint<'_>) -> candle_core::Result<T> + Send,
    ) -> Result<T> {
        if rayon::current_thread_index().is_some() {
            return Ok(work(&|| Ok(()))?);
        }
        let cancelled = AtomicBool::new(false);
        let stride = steps.div_ceil(REPORTS_MAX).max(1);
        let (sender, receiver) = mpsc::channel();
        let mut outcome = None;
        let (slot, stop) = (&mut outcome, &cancelled);
        let reported = rayon::in_place_scope(|scope| {
            scope.spawn(move |_| {
                let count = AtomicUsize::new(0);
                let checkpoint = || {
                    let done = 1 + count.fetch_add(1, Ordering::Relaxed);
                    if done.is_multiple_of(stride) {
                        // The receiver is gone after a cancellation only.
                        let _ = sender.send(done);
                    }
                    if stop.load(Ordering::Relaxed) {
                        candle_core::bail!("cancelled")
                    } else {
                        Ok(())
                    }
                };
                *slot = Some(work(&checkpoint));
            });
            // Ends when `work` has dropped the sender.
            for done in receiver {
                let part = (done as f32 / steps.max(1) as f32).min(1.0);
                if let Err(error) = self.advance(part, callback) {
                    cancelled.store(true, Ordering::Relaxed);
                    return Err(error);
                }
            }
            Ok(())
        });
        reported?;
        match outcome {
            Some(result) => Ok(result?),
            None => Err(Error::Cancelled),
        }
    }

    /// Runs `work`, and calls `callback` within its checkpoints: WebAssembly has one thread.
    ///
    /// # Errors
    /// [`Error::Cancelled`]; those of `work`.
    #[cfg(target_family = "wasm")]
    pub(super) fn run_steps<T: Send>(
        &mut self,
        steps: usize,
        callback: &mut Callback<'_>,
        work: impl FnOnce(Checkpoint<'_>) -> candle_core::Result<T> + Send,
    ) -> Result<T> {
        let stride = steps.div_ceil(REPORTS_MAX).max(1);
        // A checkpoint may be called on any thread, which the wrapper checks.
        let state = SendWrapper::new(RefCell::new((0usize, self, callback)));
        let cancelled = AtomicBool::new(false);
        let checkpoint = || {
            let (done, tracker, callback) = &mut *state.borrow_mut();
            *done += 1;
            let part = (*done as f32 / steps.max(1) as f32).min(1.0);
            if done.is_multiple_of(stride) && tracker.advance(part, *callback).is_err() {
                cancelled.store(true, Ordering::Relaxed);
                candle_core::bail!("cancelled");
            }
            Ok(())
        };
        let result = work(&checkpoint);
        if cancelled.load(Ordering::Relaxed) { Err(Error::Cancelled) } else { Ok(result?) }
    }

    /// Ends the last stage, reports fraction 1 and returns the times.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub(super) fn finish(mut self, callback: &mut Callback<'_>) -> Result<Vec<StageTime>> {
        let last = self.current.map(|(stage, _)| stage);
        self.close();
        if let Some(stage) = last {
            report(Progress { stage, fraction: 1.0 }, callback)?;
        }
        Ok(self.times)
    }
}

fn report(progress: Progress, callback: &mut Callback<'_>) -> Result<()> {
    match callback(progress) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(Error::Cancelled),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn tracker() -> Tracker {
        let costs = [(Stage::Crop, 1.0), (Stage::Check, 2.0), (Stage::Backbone, 5.0)];
        Tracker::new(costs.map(|(stage, cost)| StageCost { stage, cost }).to_vec())
    }

    #[test]
    fn fractions_rise_from_zero_to_one() {
        let (mut tracker, mut seen) = (tracker(), Vec::new());
        let mut callback = |p: Progress| {
            seen.push((p.stage, p.fraction));
            ControlFlow::Continue(())
        };
        tracker.begin(Stage::Crop, &mut callback).unwrap();
        tracker.begin(Stage::Check, &mut callback).unwrap();
        tracker.advance(0.5, &mut callback).unwrap();
        tracker.advance(0.25, &mut callback).unwrap();
        tracker.begin(Stage::Backbone, &mut callback).unwrap();
        let times = tracker.finish(&mut callback).unwrap();
        let expected = [
            (Stage::Crop, 0.0),
            (Stage::Check, 0.125),
            (Stage::Check, 0.25),
            (Stage::Check, 0.25),
            (Stage::Backbone, 0.375),
            (Stage::Backbone, 1.0),
        ];
        assert_eq!(seen, expected);
        let stages: Vec<Stage> = times.iter().map(|t| t.stage).collect();
        assert_eq!(stages, [Stage::Crop, Stage::Check, Stage::Backbone]);
    }

    /// Without the flag that a break sets, the work would run to its end before the call returns.
    #[test]
    fn a_break_ends_the_work_at_its_next_checkpoint() {
        let mut tracker = tracker();
        let ended_early = AtomicBool::new(false);
        tracker.begin(Stage::Backbone, &mut |_| ControlFlow::Continue(())).unwrap();
        let mut stop = |_: Progress| ControlFlow::Break(());
        let result = tracker.run_steps(4, &mut stop, |checkpoint| {
            for _ in 0..5_000 {
                let checked = checkpoint();
                ended_early.fetch_or(checked.is_err(), Ordering::Relaxed);
                checked?;
                std::thread::sleep(Duration::from_millis(1));
            }
            Ok(())
        });
        assert!(matches!(result, Err(Error::Cancelled)));
        assert!(ended_early.into_inner());
    }

    #[test]
    fn a_break_cancels() {
        let mut stop = |_: Progress| ControlFlow::Break(());
        assert!(matches!(tracker().begin(Stage::Crop, &mut stop), Err(Error::Cancelled)));
        assert_eq!(Stage::DepthRange.name(), "depth range");
        assert_eq!(Stage::Crop.to_string(), "cropping the photographs");
    }
}
