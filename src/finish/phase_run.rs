//! One phase of the optimisation of a scene, on its photographs: steps, measure, and the result that
//! is kept.

use super::FinishError;
use super::dropout::{self, Dropout};
use super::on_device::OnDevice;
use super::optimiser::{Across, Optimiser, PhotographGradients};
use super::parameters::MEAN;
use super::phase::{Measure, Phase, Photographs};
use super::refine::RefineOptions;
use super::removal::{Groups, pruned};
use super::targets::{MaskedView, Target, TargetView, beyond, by_planes, pixel_sizes, whole};
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use std::cell::Cell;
use std::ops::{ControlFlow, Range};
use std::time::Duration;
use subsplat_kernels::clock::{HAS_CLOCK, Instant};
use subsplat_kernels::layout::{
    Geometry, Gradients, OPACITY_OFFSET, RasterOptions, SPLAT_STRIDE, SplatSlices, sh_coefficients,
};

/// A phase that goes on step by step, for callers that show it. [`fit`](super::fit()) and
/// [`refine`](super::refine()) run whole ones.
pub struct PhaseRun<'a> {
    phase: Phase,
    targets: Vec<Target<'a>>,
    raster: RasterOptions,
    /// Gaussians of each photograph; empty where they are not known.
    groups: Groups,
    /// Begin of the first step, where time limits the steps.
    begun: Option<Instant>,
    /// The Gaussians, and their state unless `on_device` has it.
    optimiser: Optimiser<'a>,
    /// The state of the Gaussians in the memory of a GPU.
    on_device: Option<OnDevice>,
    gradients: Gradients,
    /// Gradients by the Gaussians of a photograph that the step does not draw, drawn alone.
    across: Gradients,
    /// Rows of the Gaussians that a step draws, where it leaves some out.
    drawn: Vec<f32>,
    step: usize,
    /// Set by [`PhaseRun::end`].
    end: Cell<Option<End>>,
    /// A device lost steps of this phase.
    lost_device: bool,
}

/// Least and largest number of steps after [`PhaseRun::end`]: one round of the photographs, within these.
const END_STEPS: [usize; 2] = [8, 16];

/// Steps of a phase that a caller ends.
#[derive(Clone, Copy)]
struct End {
    /// Steps before the last ones.
    begin: usize,
    /// Number of the last ones.
    steps: usize,
    /// [`PhaseRun::progress`] before them.
    at: f32,
}

/// Result of a phase.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Outcome {
    /// Steps that were taken.
    pub steps: usize,
    /// The measure before the first step.
    pub before: f64,
    /// After the last step; equal to `before` where the Gaussians stayed as they were.
    pub after: f64,
    /// Gaussians that were removed.
    pub removed: usize,
}

impl Outcome {
    /// Gaussians that stayed as they were, with the measure `before`.
    fn unchanged(steps: usize, before: f64) -> Self {
        Self { steps, before, after: before, removed: 0 }
    }
}

impl<'a> PhaseRun<'a> {
    /// Prepares a refinement of `splats` on `views`, which are rendered by the rules `raster` in
    /// the splats' own SH basis.
    ///
    /// # Errors
    /// A picture of another size than its camera; a limit of time where there is no clock.
    pub fn new(
        splats: &'a Splats,
        views: &[TargetView<'a>],
        raster: &RasterOptions,
        options: &RefineOptions,
    ) -> Result<Self, FinishError> {
        let groups = Groups::equal(splats, views.len(), options.grouped);
        Self::of_phase(splats, groups, &whole(views), raster, &Phase::refine(options))
    }

    /// Prepares a phase of `splats`, whose Gaussians of each photograph are in `groups`.
    fn of_phase(
        splats: &'a Splats,
        groups: Groups,
        views: &[MaskedView<'a>],
        raster: &RasterOptions,
        phase: &Phase,
    ) -> Result<Self, FinishError> {
        check_time(phase.time, HAS_CLOCK)?;
        let target = |(i, view): (usize, &MaskedView<'a>)| Target::new(i, view, phase.loss);
        let targets = views.iter().enumerate().map(target).collect::<Result<_, _>>()?;
        let pixels = if phase.moves(MEAN) { pixel_sizes(splats, views) } else { Vec::new() };
        let spares = phase.spares_edges && views.len() == 2;
        let spared = if spares { beyond(splats, views) } else { Vec::new() };
        let photographs = match phase.photographs {
            Photographs::All => views.len(),
            Photographs::InTurn => 1,
        };
        let phase = phase.of(splats, views.len());
        let gradients =
            Gradients { sh_limit: Some(phase.sh_coefficients()), ..Gradients::default() };
        Ok(Self {
            targets,
            raster: RasterOptions { sh_basis: splats.sh_basis, ..*raster },
            groups,
            begun: None,
            optimiser: Optimiser::new(splats, &phase, photographs, pixels, spared),
            on_device: None,
            phase,
            across: Gradients { sh_limit: Some(0), ..Gradients::default() },
            gradients,
            drawn: Vec::new(),
            step: 0,
            end: Cell::new(None),
            lost_device: false,
        })
    }

    /// Number of steps so far.
    pub fn steps(&self) -> usize {
        self.step
    }

    /// The Gaussians after the steps so far.
    pub fn splats(&self) -> Splats {
        let mut splats = self.optimiser.splats();
        if let Some(numbers) = self.on_device.as_ref().and_then(OnDevice::numbers) {
            numbers.write_to(&mut splats);
        }
        splats
    }

    /// Ends the steps of a whole phase ([`refine`](super::refine())) that shows itself to its caller, after one more
    /// round of the photographs, in which the rates fall to their end: steps at high rates leave noise.
    pub fn end(&self) {
        if self.end.get().is_none() {
            let steps = self.targets.len().clamp(END_STEPS[0], END_STEPS[1]);
            self.end.set(Some(End { begin: self.step, steps, at: self.progress() }));
        }
    }

    /// Takes one step. Does nothing without photographs or Gaussians.
    ///
    /// The first step decides where all are taken: in the memory of the renderer's GPU, or in that of the CPU with
    /// the renderer. A device that fails loses the steps; the phase then begins again with this one.
    pub fn step(&mut self, renderer: &mut Renderer) {
        let views = self.targets.len();
        if views == 0 || self.optimiser.rows().is_empty() {
            return;
        }
        if self.begun.is_none() && self.phase.time.is_some() {
            self.begun = Some(Instant::now());
        }
        if self.step == 0 && !self.lost_device {
            self.on_device = self.copied(renderer);
        }
        let photographs = match self.phase.photographs {
            Photographs::All => 0..views,
            Photographs::InTurn => {
                let view = view_of_step(self.step, views);
                view..view + 1
            }
        };
        let share = dropout::share(self.phase.dropout, views);
        let dropout = (share > 0.0).then(|| Dropout::new(share, self.step));
        self.step += 1;
        let factor = self.phase.schedule.factor(self.course());
        if let Some(on_device) = &mut self.on_device {
            if !on_device.step(photographs, factor, dropout.as_ref()) {
                self.begin_again();
                self.step(renderer);
            }
            return;
        }
        let last = photographs.end - 1;
        for view in photographs.start..last {
            let other = self.add_gradients(view, dropout.as_ref(), renderer);
            let gradients = gradients_of(&self.gradients, &self.across, other, &self.phase);
            self.optimiser.add(&gradients);
        }
        let other = self.add_gradients(last, dropout.as_ref(), renderer);
        let gradients = gradients_of(&self.gradients, &self.across, other, &self.phase);
        self.optimiser.step(&gradients, factor);
    }

    /// Copies the Gaussians to the renderer's GPU.
    fn copied(&self, renderer: &Renderer) -> Option<OnDevice> {
        let (optimiser, targets, raster) = (&self.optimiser, &self.targets, &self.raster);
        let across = |view| self.other(view);
        OnDevice::new(renderer, optimiser, targets, across, raster, self.phase.loss)
    }

    /// Goes back to the Gaussians before the first step, after the device has lost the others.
    fn begin_again(&mut self) {
        (self.on_device, self.lost_device, self.step) = (None, true, 0);
        self.end.set(self.end.get().map(|end| End { begin: 0, ..end }));
    }

    /// Reads the Gaussians after the last step. Returns whether the device had them; else the phase begins again.
    fn collect(&mut self) -> bool {
        let Some(on_device) = &self.on_device else { return true };
        let Some(numbers) = on_device.numbers() else {
            self.begin_again();
            return false;
        };
        self.optimiser.set_numbers(numbers);
        true
    }

    /// The Gaussians of the other one of two photographs, where photograph `view` draws these alone as well.
    fn other(&self, view: usize) -> Range<usize> {
        if !(self.phase.loss.across > 0.0) || self.targets.len() != 2 {
            return 0..0;
        }
        self.group(1 - view).unwrap_or(0..0)
    }

    /// Computes the gradients of the loss of photograph `view`. Returns the Gaussians of the other one of
    /// two photographs, where these are drawn alone as well.
    fn add_gradients(
        &mut self,
        view: usize,
        dropout: Option<&Dropout>,
        renderer: &mut Renderer,
    ) -> Range<usize> {
        let target = &self.targets[view];
        let rows = self.optimiser.rows();
        if let Some(dropout) = dropout {
            dropout.draw(rows, &mut self.drawn);
        }
        let rows = if dropout.is_some() { &self.drawn } else { rows };
        let slices = self.optimiser.slices_of(rows);
        let (camera, raster) = (target.camera, &self.raster);
        renderer.gradients_of(&slices, camera, raster, &mut self.gradients, &mut |planes| {
            by_planes(target.loss(planes), planes)
        });
        if let Some(dropout) = dropout {
            dropout.chain(self.optimiser.rows(), &self.drawn, &mut self.gradients.rows);
        }
        let other = self.other(view);
        if !other.is_empty() {
            let slices = part_of(self.optimiser.slices(), &other);
            renderer.gradients_of(&slices, camera, raster, &mut self.across, &mut |planes| {
                by_planes(target.loss_where_covered(planes), planes)
            });
        }
        other
    }

    /// The Gaussians of photograph `view`; `None` where they are not known.
    fn group(&self, view: usize) -> Option<Range<usize>> {
        self.groups.ranges.get(view).cloned()
    }

    /// Share of the phase that is done, 0 to 1.
    pub fn progress(&self) -> f32 {
        let of_steps = self.step as f32 / self.phase.steps.max(1) as f32;
        let part = match (self.phase.time, self.begun) {
            (Some(time), Some(begun)) => {
                of_steps.max(begun.elapsed().as_secs_f32() / time.as_secs_f32())
            }
            _ => of_steps,
        };
        part.clamp(0.0, 1.0)
    }

    /// Place in the course of the rates, 0 to 1.
    fn course(&self) -> f32 {
        let Some(end) = self.end.get() else { return self.progress() };
        let part = (self.step - end.begin) as f32 / end.steps as f32;
        end.at + (1.0 - end.at) * part.min(1.0)
    }

    /// Returns whether the limit of steps or of time is reached, or the caller ended the steps.
    fn is_done(&self) -> bool {
        let ended = self.end.get().is_some_and(|end| self.step >= end.begin + end.steps);
        ended || self.step >= self.phase.steps || self.progress() >= 1.0
    }

    /// Takes the steps of the whole phase.
    ///
    /// # Errors
    /// [`FinishError::Cancelled`].
    fn take_steps(
        &mut self,
        renderer: &mut Renderer,
        progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
    ) -> Result<(), FinishError> {
        let mut last = None;
        while !self.is_done() {
            self.step(renderer);
            if progress(self).is_break() {
                return Err(FinishError::Cancelled);
            }
            let Some(patience) = self.phase.patience else { continue };
            let between = patience.rounds * self.targets.len();
            // High rates at the beginning can raise the error for a while.
            let settled = self.progress() >= 0.5 && self.steps() + between < self.phase.steps;
            if settled && self.steps().is_multiple_of(between) {
                let error = self.error(renderer);
                if last.is_some_and(|last| !(error < last * (1.0 - patience.least_gain))) {
                    break;
                }
                last = Some(error);
            }
        }
        Ok(())
    }

    /// The measure of the phase ([`RefineReport`](super::RefineReport)): mean over the photographs.
    pub fn error(&self, renderer: &mut Renderer) -> f64 {
        let [error, _] = self.measure(renderer);
        error
    }

    /// [`PhaseRun::error`], and the mean share of the photographs on which it was measured.
    fn measure(&self, renderer: &mut Renderer) -> [f64; 2] {
        let mut sum = [0.0; 2];
        for view in 0..self.targets.len() {
            let own = match self.phase.measure {
                Measure::Difference if self.targets.len() == 2 => self.group(view),
                Measure::Difference | Measure::Loss => None,
            };
            let on_device = self.on_device.as_ref();
            let measured = on_device.and_then(|d| d.measure(view, self.phase.measure, own.clone()));
            let [error, covered] = measured.unwrap_or_else(|| self.measure_of(view, own, renderer));
            sum = [sum[0] + error, sum[1] + covered];
        }
        sum.map(|s| s / self.targets.len().max(1) as f64)
    }

    /// The measure of photograph `view` and the share of it that counts; without the Gaussians `own`, where these
    /// are given.
    fn measure_of(
        &self,
        view: usize,
        own: Option<Range<usize>>,
        renderer: &mut Renderer,
    ) -> [f64; 2] {
        let target = &self.targets[view];
        let mut draw = |rows: &[f32]| {
            let slices = self.optimiser.slices_of(rows);
            renderer.render_planes(&slices, target.camera, &self.raster)
        };
        let rows = self.optimiser.rows();
        match (self.phase.measure, own) {
            (Measure::Loss, _) => [target.loss(&draw(rows)).value, 1.0],
            (Measure::Difference, Some(own)) => {
                let mut rows = rows.to_vec();
                let own = &mut rows[own.start * SPLAT_STRIDE..own.end * SPLAT_STRIDE];
                own.chunks_exact_mut(SPLAT_STRIDE).for_each(|row| row[OPACITY_OFFSET] = 0.0);
                target.error_where_covered(&draw(&rows))
            }
            (Measure::Difference, None) => [target.error(&draw(rows)), 1.0],
        }
    }

    /// Takes the start of the phase with the smallest measure. The first one has the measure `first`.
    fn choose_start(&mut self, first: f64, renderer: &mut Renderer) {
        let mut best = first;
        let starts = self.phase.starts;
        let mut chosen = starts.first();
        for start in starts.iter().skip(1) {
            self.optimiser.begin(Some(*start));
            let error = self.error(renderer);
            if error < best {
                (best, chosen) = (error, Some(start));
            }
        }
        if chosen != starts.last() {
            self.optimiser.begin(chosen.copied());
        }
    }
}

/// The gradients of a photograph, and those by the Gaussians `other`, drawn alone.
fn gradients_of<'g>(
    all: &'g Gradients,
    across: &'g Gradients,
    other: Range<usize>,
    phase: &Phase,
) -> PhotographGradients<'g> {
    let weight = phase.loss.across;
    let across = Across { gradients: across, weight, gaussians: other };
    let across = if across.gaussians.is_empty() { None } else { Some(across) };
    PhotographGradients { all, across }
}

/// Runs `phase` on `splats` in place; `groups` are the Gaussians of each photograph, which follow the
/// removal. `progress` receives the phase after each step.
///
/// # Errors
/// A picture of another size than its camera; a limit of time where there is no clock; a phase that was
/// cancelled. The Gaussians are then unchanged.
pub(super) fn run(
    splats: &mut Splats,
    groups: &mut Groups,
    views: &[MaskedView<'_>],
    raster: &RasterOptions,
    phase: &Phase,
    renderer: &mut Renderer,
    progress: &mut dyn FnMut(&PhaseRun<'_>) -> ControlFlow<()>,
) -> Result<Outcome, FinishError> {
    check_time(phase.time, HAS_CLOCK)?;
    for (i, view) in views.iter().enumerate() {
        Target::check(i, view)?;
    }
    if phase.steps == 0 || views.is_empty() || splats.is_empty() {
        return Ok(Outcome::unchanged(0, 0.0));
    }
    let pruned = pruned(splats, groups, views, raster, phase.least_share, renderer);
    let (kept, kept_groups) = match &pruned {
        Some((kept, groups)) => (kept, groups),
        None => (&*splats, &*groups),
    };
    let mut phase_run = PhaseRun::of_phase(kept, kept_groups.clone(), views, raster, phase)?;
    let [before, covered] = phase_run.measure(renderer);
    if views.len() == 2 && covered < phase.least_covered {
        return Ok(Outcome::unchanged(0, before));
    }
    phase_run.choose_start(before, renderer);
    loop {
        phase_run.take_steps(renderer, progress)?;
        if phase_run.collect() {
            break;
        }
    }
    let steps = phase_run.steps();
    let after = phase_run.error(renderer);
    // An error that is not a number fails the comparison as well.
    if !(after < before) {
        return Ok(Outcome::unchanged(steps, before));
    }
    let optimised = phase_run.optimiser.into_numbers();
    let before_removal = splats.len();
    if let Some((kept, kept_groups)) = pruned {
        (*splats, *groups) = (kept, kept_groups);
    }
    let removed = before_removal - splats.len();
    optimised.write_to(splats);
    Ok(Outcome { steps, before, after, removed })
}

/// Refuses a limit of time where there is no clock.
pub(crate) fn check_time(time: Option<Duration>, has_clock: bool) -> Result<(), FinishError> {
    if time.is_some() && !has_clock {
        return Err(FinishError::NoClock);
    }
    Ok(())
}

/// The photograph of a step, counted from 0: all of them once in each round.
fn view_of_step(step: usize, views: usize) -> usize {
    // Neighbours in the list are often neighbours in space; the stride separates them.
    let stride = (views / 2 + 1..=views).find(|s| coprime(*s, views)).unwrap_or(1);
    step * stride % views
}

fn coprime(a: usize, b: usize) -> bool {
    if b == 0 { a == 1 } else { coprime(b, a % b) }
}

/// The Gaussians `range` of `slices`, whole families of packed rows.
fn part_of<'s>(slices: SplatSlices<'s>, range: &Range<usize>) -> SplatSlices<'s> {
    let Geometry::Packed(rows) = slices.geometry else { return slices };
    let children = slices.children_per_parent();
    let set = 3 * sh_coefficients(slices.sh_degree);
    let parents = range.start / children..range.end / children;
    SplatSlices {
        geometry: Geometry::Packed(&rows[range.start * SPLAT_STRIDE..range.end * SPLAT_STRIDE]),
        sh: &slices.sh[parents.start * set..parents.end * set],
        gain: &slices.gain[4 * range.start..4 * range.end],
        sh_degree: slices.sh_degree,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_shows_every_photograph_once() {
        for views in 1..12 {
            let mut seen: Vec<usize> = (0..views).map(|s| view_of_step(s, views)).collect();
            seen.sort_unstable();
            assert_eq!(seen, (0..views).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_limit_of_time_needs_a_clock() {
        let second = Some(Duration::from_secs(1));
        assert!(check_time(second, true).is_ok() && check_time(None, false).is_ok());
        let error = check_time(second, false).unwrap_err();
        assert!(matches!(error, FinishError::NoClock));
        assert!(error.to_string().contains("number of steps"), "{error}");
    }
}
