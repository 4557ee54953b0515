//! Gaussians under optimisation: the parameters that a phase moves, with Adam's moments, and the rows
//! and gains that follow from them. A step is gradients of one photograph or more, then Adam's step
//! ([`SelectiveAdam`]). Which parameters move is data ([`Phase`]); nothing here depends on it.
//!
//! The same input gives the same bytes on any number of threads.

use super::parameters::{
    BLOCK, Before, Buffer, COLOUR, ELEMENTS_MAX, Form, GAIN_STRIDE, Move, OPACITY, Part, PartMut,
};
use super::phase::{Phase, Photographs, Start};
use crate::scene::splats::Splats;
use rayon::prelude::*;
use std::ops::Range;
use subsplat_kernels::cpu::adam::SelectiveAdam;
use subsplat_kernels::cpu::simd::vectorize;
use subsplat_kernels::layout::{
    Geometry, Gradients, OPACITY_OFFSET, SCALE_OFFSET, SPLAT_STRIDE, SplatSlices,
    gain_with_offsets, sh_coefficients,
};

/// Decay rates of Adam's moments.
const BETAS: [f32; 2] = [0.9, 0.99];
/// Keeps the quotient of a Gaussian without gradient finite.
const EPSILON: f32 = 1e-15;
/// Fewest blocks of a parallel task.
const TASK: usize = 4096 / BLOCK;

/// Bias corrections of Adam's moments after a number of steps.
pub(super) fn corrections(steps: i32) -> [f32; 2] {
    BETAS.map(|b| 1.0 - b.powi(steps))
}

/// Gradients of the loss of one photograph.
pub(super) struct PhotographGradients<'a> {
    /// By all Gaussians.
    pub all: &'a Gradients,
    /// By the Gaussians of another photograph, drawn alone.
    pub across: Option<Across<'a>>,
}

/// Gradients by some of the Gaussians, which change their geometry and opacity, not their colours.
pub(super) struct Across<'a> {
    /// By these Gaussians.
    pub gradients: &'a Gradients,
    /// The Gaussians.
    pub gaussians: Range<usize>,
    /// Weight of the gradients.
    pub weight: f32,
}

/// Gaussians that a phase moves.
pub(super) struct Optimiser<'a> {
    before: &'a Splats,
    moves: Vec<Move>,
    photographs: Photographs,
    opacity_margin: f32,
    /// Factor of the σ of `before` at the start.
    scale: f32,
    /// `[N]`: size of a pixel at each Gaussian, world units; empty where no mean moves.
    pixels: Vec<f32>,
    /// `[N]` or empty: Gaussians of which only the colours move.
    spared: Vec<bool>,
    /// For each block of Gaussians: values, first moments and second moments, each `[E][BLOCK]`, E the
    /// elements of all `moves`; then the sum of the gradients where a step has several photographs. Empty
    /// before the first step.
    states: Vec<f32>,
    /// Parts of a block's state: 3, or 4 with the sum.
    parts: usize,
    rows: Vec<f32>,
    /// `[N, 4]`.
    gain: Vec<f32>,
    /// `[N, 3·D]`, or empty where the SH coefficients stay.
    sh: Vec<f32>,
    steps: i32,
}

/// Buffers of a parallel task.
struct Scratch {
    /// `[E][BLOCK]`.
    gradient: Vec<f32>,
    /// `[ELEMENTS_MAX][BLOCK]`: gradients across by one parameter.
    across: Vec<f32>,
    /// `[BLOCK]`: Gaussians with a gradient.
    moves: [bool; BLOCK],
    /// `[BLOCK]`: Gaussians whose gradients are finite.
    finite: [bool; BLOCK],
}

impl Scratch {
    fn new(elements: usize) -> Self {
        Self {
            gradient: vec![0.0; elements * BLOCK],
            across: vec![0.0; ELEMENTS_MAX * BLOCK],
            moves: [true; BLOCK],
            finite: [true; BLOCK],
        }
    }
}

/// Numbers of optimised Gaussians.
pub(super) struct Numbers {
    rows: Vec<f32>,
    /// `[N, 4]`.
    gain: Vec<f32>,
    /// `[N, 3·D]`, or empty where the SH coefficients stayed.
    sh: Vec<f32>,
}

/// Rows, gains and SH coefficients.
impl From<[Vec<f32>; 3]> for Numbers {
    fn from([rows, gain, sh]: [Vec<f32>; 3]) -> Self {
        Self { rows, gain, sh }
    }
}

impl Numbers {
    /// Writes the numbers to the Gaussians that they were optimised from.
    pub fn write_to(self, splats: &mut Splats) {
        (splats.rows, splats.gain) = (self.rows, self.gain);
        if !self.sh.is_empty() {
            splats.sh = self.sh;
        }
    }
}

impl<'a> Optimiser<'a> {
    /// Prepares `splats` for the phase, whose steps have `photographs` photographs. `pixels` and
    /// `spared` are those of the fields.
    pub fn new(
        splats: &'a Splats,
        phase: &Phase,
        photographs: usize,
        pixels: Vec<f32>,
        spared: Vec<bool>,
    ) -> Self {
        let parts = if photographs > 1 { 4 } else { 3 };
        let moves_sh = phase.moves.iter().any(|m| m.parameter.buffer == Buffer::Sh);
        let mut new = Self {
            before: splats,
            moves: phase.moves.clone(),
            photographs: phase.photographs,
            opacity_margin: phase.opacity_margin,
            scale: 1.0,
            pixels,
            spared,
            states: Vec::new(),
            parts,
            rows: splats.rows.clone(),
            gain: gain_with_offsets(&splats.gain, splats.len()),
            sh: if moves_sh { splats.sh.clone() } else { Vec::new() },
            steps: 0,
        };
        new.begin(phase.starts.first().copied());
        new
    }

    /// Elements of the parameters that move.
    fn elements(&self) -> usize {
        self.moves.iter().map(|m| m.parameter.elements()).sum()
    }

    /// Floats of a block's state.
    fn block_size(&self) -> usize {
        self.parts * self.elements() * BLOCK
    }

    /// Changes σ and opacities of the Gaussians by `start`, before the first step, and moves opacities
    /// into their limits.
    pub fn begin(&mut self, start: Option<Start>) {
        self.scale = start.map_or(1.0, |start| start.scale);
        let (scale, margin) = (self.scale, self.opacity_margin);
        let moves_opacity = self.moves.iter().any(|m| m.parameter == OPACITY);
        let rows = self.rows.par_chunks_exact_mut(SPLAT_STRIDE);
        rows.zip(self.before.rows.par_chunks_exact(SPLAT_STRIDE)).for_each(|(row, before)| {
            for i in SCALE_OFFSET..SCALE_OFFSET + 3 {
                row[i] = before[i] * scale;
            }
            row[OPACITY_OFFSET] = before[OPACITY_OFFSET];
            if let Some(start) = start {
                let free = 1.0 - before[OPACITY_OFFSET].clamp(0.0, 1.0);
                row[OPACITY_OFFSET] = 1.0 - free.powf(start.density);
            }
            if moves_opacity {
                row[OPACITY_OFFSET] = row[OPACITY_OFFSET].clamp(margin, 1.0 - margin);
            }
        });
        self.states = Vec::new();
    }

    /// Takes the states of all blocks out of [`Optimiser::states`]. Before the first step they are new:
    /// values of 0, but for the logits of the opacities.
    fn take_states(&mut self) -> Vec<f32> {
        let mut states = std::mem::take(&mut self.states);
        if !states.is_empty() {
            return states;
        }
        let size = self.block_size();
        states = vec![0.0; self.rows.len().div_ceil(BLOCK * SPLAT_STRIDE) * size];
        let mut at = 0;
        for m in &self.moves {
            if m.parameter.form == Form::Logit {
                let first = m.parameter.first;
                let blocks = states.par_chunks_exact_mut(size);
                blocks.zip(self.rows.par_chunks(BLOCK * SPLAT_STRIDE)).for_each(|(state, rows)| {
                    let logits = state[at * BLOCK..].iter_mut();
                    for (to, row) in logits.zip(rows.chunks_exact(SPLAT_STRIDE)) {
                        *to = m.parameter.form.first_value(row[first]);
                    }
                });
            }
            at += m.parameter.elements();
        }
        states
    }

    /// The Gaussians as they are now, as the rasterizer reads them.
    pub fn slices(&self) -> SplatSlices<'_> {
        self.slices_of(&self.rows)
    }

    /// [`Optimiser::slices`] with other `rows`.
    pub fn slices_of<'s>(&'s self, rows: &'s [f32]) -> SplatSlices<'s> {
        SplatSlices {
            geometry: Geometry::Packed(rows),
            sh: if self.sh.is_empty() { &self.before.sh } else { &self.sh },
            gain: &self.gain,
            sh_degree: self.before.sh_degree,
        }
    }

    /// Rows of the Gaussians as they are now, `[N, 11]`.
    pub fn rows(&self) -> &[f32] {
        &self.rows
    }

    /// The Gaussians as they are now.
    pub fn splats(&self) -> Splats {
        let SplatSlices { sh, sh_degree, .. } = self.slices();
        let (rows, sh, gain) = (self.rows.clone(), sh.to_vec(), self.gain.clone());
        Splats { rows, sh, gain, sh_degree, sh_basis: self.before.sh_basis }
    }

    /// The numbers of the Gaussians as they are now, without those that stayed.
    pub fn into_numbers(self) -> Numbers {
        let Self { rows, gain, sh, .. } = self;
        Numbers { rows, gain, sh }
    }

    /// Takes the numbers that a device gave the Gaussians.
    pub fn set_numbers(&mut self, Numbers { rows, gain, sh }: Numbers) {
        (self.rows, self.gain, self.sh) = (rows, gain, sh);
    }

    /// The Gaussians before the first step, and how they move, for a GPU.
    #[cfg(feature = "gpu")]
    pub fn for_device(&self) -> subsplat_kernels::gpu::OptimisedSplats<'_> {
        subsplat_kernels::gpu::OptimisedSplats {
            splats: self.slices(),
            origin_rows: &self.before.rows,
            pixels: &self.pixels,
            spared: &self.spared,
            scale: self.scale,
            moves: &self.moves,
            all_move: self.photographs == Photographs::All,
            betas: BETAS,
            epsilon: EPSILON,
        }
    }

    /// SH coefficients of a Gaussian, where each has a set.
    fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.before.sh_degree)
    }

    /// Adds the gradients of a photograph that is not the last of its step.
    pub fn add(&mut self, photograph: &PhotographGradients<'_>) {
        let size = self.block_size();
        let part = self.elements() * BLOCK;
        let mut states = self.take_states();
        let rows = self.rows.par_chunks(BLOCK * SPLAT_STRIDE);
        states.par_chunks_exact_mut(size).zip(rows).enumerate().with_min_len(TASK).for_each_init(
            || Scratch::new(part / BLOCK),
            |scratch, (block, (state, rows))| {
                self.gather(block * BLOCK, rows, photograph, scratch);
                let sums = state[3 * part..].iter_mut();
                sums.zip(&scratch.gradient).for_each(|(sum, g)| *sum += g);
            },
        );
        self.states = states;
    }

    /// Takes a step with the gradients of its last photograph and those added before. `factor`
    /// multiplies all rates.
    pub fn step(&mut self, photograph: &PhotographGradients<'_>, factor: f32) {
        self.steps = self.steps.saturating_add(1);
        let adam = SelectiveAdam {
            betas: BETAS,
            rate: factor,
            corrections: corrections(self.steps),
            epsilon: EPSILON,
        };
        let size = self.block_size();
        let part = self.elements() * BLOCK;
        let mut states = self.take_states();
        let (mut rows, mut gain) = (std::mem::take(&mut self.rows), std::mem::take(&mut self.gain));
        let mut sh = std::mem::take(&mut self.sh);
        let mut sh_of_blocks: Vec<&mut [f32]> = sh.chunks_mut(BLOCK * self.sh_stride()).collect();
        sh_of_blocks.resize_with(rows.len().div_ceil(BLOCK * SPLAT_STRIDE), Default::default);
        let numbers = rows
            .par_chunks_mut(BLOCK * SPLAT_STRIDE)
            .zip(gain.par_chunks_mut(BLOCK * GAIN_STRIDE))
            .zip(sh_of_blocks);
        states
            .par_chunks_exact_mut(size)
            .zip(numbers)
            .enumerate()
            .with_min_len(TASK)
            .for_each_init(
                || Scratch::new(part / BLOCK),
                |scratch, (block, (state, ((rows, gain), sh)))| {
                    self.gather(block * BLOCK, rows, photograph, scratch);
                    if let Some(sums) = state.get_mut(3 * part..) {
                        for (g, sum) in scratch.gradient.iter_mut().zip(sums) {
                            *g += *sum;
                            *sum = 0.0;
                        }
                    }
                    let mut numbers = PartMut { rows, gain, sh };
                    self.update(block * BLOCK, &adam, state, scratch, &mut numbers);
                },
            );
        (self.states, self.rows, self.gain, self.sh) = (states, rows, gain, sh);
    }

    /// Writes the gradients by the parameters of a block of Gaussians, the first of them `first`, to
    /// [`Scratch::gradient`]. Those of a Gaussian that are not all finite count as 0.
    fn gather(
        &self,
        first: usize,
        rows: &[f32],
        photograph: &PhotographGradients<'_>,
        scratch: &mut Scratch,
    ) {
        let n = rows.len() / SPLAT_STRIDE;
        let block = first..first + n;
        let pixels = self.pixels.get(block.clone()).unwrap_or_default();
        let mut at = 0;
        for m in &self.moves {
            let out = &mut scratch.gradient[at * BLOCK..][..m.parameter.elements() * BLOCK];
            let by = self.part_of(photograph.all, block.clone());
            m.parameter.gradients(rows, by, pixels, out);
            if let (Some(across), Buffer::Rows) = (&photograph.across, m.parameter.buffer) {
                let Across { gradients, gaussians, weight } = across;
                let both = block.start.max(gaussians.start)..block.end.min(gaussians.end);
                if !both.is_empty() {
                    let own = both.start - first..both.end - first;
                    let of = both.start - gaussians.start..both.end - gaussians.start;
                    let rows = &rows[own.start * SPLAT_STRIDE..own.end * SPLAT_STRIDE];
                    let pixels = pixels.get(own.clone()).unwrap_or_default();
                    let second = &mut scratch.across[..out.len()];
                    let by = self.part_of(gradients, of);
                    m.parameter.gradients(rows, by, pixels, second);
                    for (out, second) in out.chunks_exact_mut(BLOCK).zip(second.chunks_exact(BLOCK))
                    {
                        let sums = out[own.clone()].iter_mut().zip(second);
                        sums.for_each(|(sum, g)| *sum += weight * g);
                    }
                }
            }
            if m.parameter != COLOUR
                && let Some(spared) = self.spared.get(block.clone())
            {
                for out in out.chunks_exact_mut(BLOCK) {
                    let spared = out.iter_mut().zip(spared).filter(|(_, spared)| **spared);
                    spared.for_each(|(g, _)| *g = 0.0);
                }
            }
            at += m.parameter.elements();
        }
        let Scratch { gradient, finite, .. } = scratch;
        let finite = &mut finite[..n];
        finite.fill(true);
        vectorize(
            #[inline(always)]
            || {
                for element in gradient.chunks_exact(BLOCK) {
                    for (finite, g) in finite.iter_mut().zip(element) {
                        *finite &= g.is_finite();
                    }
                }
            },
        );
        if finite.contains(&false) {
            for element in gradient.chunks_exact_mut(BLOCK) {
                let not = element.iter_mut().zip(&*finite).filter(|(_, finite)| !**finite);
                not.for_each(|(g, _)| *g = 0.0);
            }
        }
    }

    /// Adam's step of a block of Gaussians with the gradients of `scratch`. The state of a Gaussian that
    /// the photograph of a step does not show stays as it is. `adam` has the factor of all rates.
    fn update(
        &self,
        first: usize,
        adam: &SelectiveAdam,
        state: &mut [f32],
        scratch: &mut Scratch,
        numbers: &mut PartMut<'_>,
    ) {
        let n = numbers.rows.len() / SPLAT_STRIDE;
        let Scratch { gradient, moves, .. } = scratch;
        let moves = &mut moves[..n];
        match self.photographs {
            Photographs::All => moves.fill(true),
            Photographs::InTurn => {
                moves.fill(false);
                vectorize(
                    #[inline(always)]
                    || {
                        for element in gradient.chunks_exact(BLOCK) {
                            for (moves, g) in moves.iter_mut().zip(element) {
                                *moves |= *g != 0.0;
                            }
                        }
                    },
                );
            }
        }
        let part = gradient.len();
        let (values, rest) = state.split_at_mut(part);
        let (m, rest) = rest.split_at_mut(part);
        let v = &mut rest[..part];
        let before = self.before_of(first..first + n);
        let mut at = 0;
        for movement in &self.moves {
            let parameter = &movement.parameter;
            let adam = SelectiveAdam { rate: adam.rate * movement.rate, ..*adam };
            for e in at..at + parameter.elements() {
                let element = e * BLOCK..e * BLOCK + n;
                let moments = [&mut m[element.clone()], &mut v[element.clone()]];
                let value = &mut values[element.clone()];
                adam.run(&gradient[element], moves, value, moments);
                if let Some([least, largest]) = movement.limits {
                    value.iter_mut().for_each(|v| *v = v.clamp(least, largest));
                }
            }
            let values = &values[at * BLOCK..(at + parameter.elements()) * BLOCK];
            vectorize(
                #[inline(always)]
                || parameter.write(values, moves, &before, numbers),
            );
            at += parameter.elements();
        }
    }

    /// The Gaussians `range` before the phase.
    fn before_of(&self, range: Range<usize>) -> Before<'_> {
        let rows = &self.before.rows[range.start * SPLAT_STRIDE..range.end * SPLAT_STRIDE];
        let gain = match self.before.gain_channels() {
            GAIN_STRIDE => &self.before.gain[range.start * GAIN_STRIDE..range.end * GAIN_STRIDE],
            _ => &[],
        };
        let sh_stride = self.sh_stride();
        let sh = &self.before.sh;
        let sh = sh.get(range.start * sh_stride..range.end * sh_stride).unwrap_or_default();
        let pixels = self.pixels.get(range).unwrap_or_default();
        Before { part: Part { rows, gain, sh, sh_stride }, scale: self.scale, pixels }
    }

    /// The gradients by the Gaussians `range`.
    fn part_of<'g>(&self, gradients: &'g Gradients, range: Range<usize>) -> Part<'g> {
        let sh_stride = 3 * gradients.coefficients(self.before.sh_degree);
        let sh = gradients.sh.get(range.start * sh_stride..range.end * sh_stride);
        Part {
            rows: &gradients.rows[range.start * SPLAT_STRIDE..range.end * SPLAT_STRIDE],
            gain: &gradients.gain[range.start * GAIN_STRIDE..range.end * GAIN_STRIDE],
            sh: sh.unwrap_or_default(),
            sh_stride,
        }
    }
}

#[cfg(test)]
mod tests;
