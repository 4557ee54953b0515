//! Gaussians under optimisation: the parameters that a phase moves, with Adam's moments, and the rows
//! and gains that follow from them. A step is gradients of one photograph or more, then Adam's step
//! ([`SelectiveAdam`]). Which parameters move is data ([`Phase`]); nothing here depends on it.
//!
//! The same input gives the same bytes on any number of threads.

use super::parameters::{
    BLOCK, Before, Buffer, COLOUR, ELEMENTS_MAX, GAIN_STRIDE, OPACITY, Part, PartMut,
};
use super::phase::{Move, Phase, Photographs, Start};
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
    /// elements of all `moves`; then the sum of the gradients where a step has several photographs.
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
        let elements: usize = phase.moves.iter().map(|m| m.parameter.elements()).sum();
        let moves_sh = phase.moves.iter().any(|m| m.parameter.buffer == Buffer::Sh);
        let mut new = Self {
            before: splats,
            moves: phase.moves.clone(),
            photographs: phase.photographs,
            opacity_margin: phase.opacity_margin,
            scale: 1.0,
            pixels,
            spared,
            states: vec![0.0; splats.len().div_ceil(BLOCK) * parts * elements * BLOCK],
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
        let size = self.block_size();
        let mut at = 0;
        for m in &self.moves {
            if m.parameter == OPACITY {
                let blocks = self.states.par_chunks_exact_mut(size);
                blocks.zip(self.rows.par_chunks(BLOCK * SPLAT_STRIDE)).for_each(|(state, rows)| {
                    let logits = state[at * BLOCK..].iter_mut();
                    for (to, row) in logits.zip(rows.chunks_exact(SPLAT_STRIDE)) {
                        let alpha = row[OPACITY_OFFSET];
                        *to = (alpha / (1.0 - alpha)).ln();
                    }
                });
            }
            at += m.parameter.elements();
        }
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

    /// The Gaussians as they are now.
    pub fn into_splats(self) -> Splats {
        let Self { rows, gain, sh, before, .. } = self;
        let sh = if sh.is_empty() { before.sh.clone() } else { sh };
        Splats { rows, sh, gain, sh_degree: before.sh_degree, sh_basis: before.sh_basis }
    }

    /// SH coefficients of a Gaussian, where each has a set.
    fn sh_stride(&self) -> usize {
        3 * sh_coefficients(self.before.sh_degree)
    }

    /// Adds the gradients of a photograph that is not the last of its step.
    pub fn add(&mut self, photograph: &PhotographGradients<'_>) {
        let size = self.block_size();
        let part = self.elements() * BLOCK;
        let mut states = std::mem::take(&mut self.states);
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
            corrections: BETAS.map(|b| 1.0 - b.powi(self.steps)),
            epsilon: EPSILON,
        };
        let size = self.block_size();
        let part = self.elements() * BLOCK;
        let mut states = std::mem::take(&mut self.states);
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
        let sh_stride = self.sh_stride();
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
mod tests {
    use super::*;
    use crate::finish::{FitOptions, RefineOptions};
    use subsplat_kernels::layout::{MEAN_OFFSET, QUAT_OFFSET, ShBasis};

    /// Two blocks of Gaussians and a part of a third.
    const COUNT: usize = 2 * BLOCK + 77;
    /// Gaussians whose geometry has a second gradient; they begin and end within blocks.
    const OTHER: Range<usize> = 100..BLOCK + 30;

    /// Numbers from −1 to 1.
    fn noise(seed: u64) -> impl FnMut() -> f32 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695);
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        }
    }

    fn gaussians() -> Splats {
        let mut noise = noise(1);
        let mut rows: Vec<f32> = (0..COUNT * SPLAT_STRIDE).map(|_| noise()).collect();
        for row in rows.chunks_exact_mut(SPLAT_STRIDE) {
            row[SCALE_OFFSET..].iter_mut().for_each(|v| *v = v.abs());
        }
        let gain = (0..COUNT * GAIN_STRIDE).map(|_| noise()).collect();
        Splats::new(rows, vec![0.1; 3 * COUNT], gain, 0, ShBasis::Standard).unwrap()
    }

    /// Gradients by `count` Gaussians. Every seventh has none, and one is not a number.
    fn gradients(count: usize, seed: u64) -> Gradients {
        let mut noise = noise(seed);
        let mut new = Gradients::default();
        for i in 0..count {
            let shown = if i % 7 == 3 { 0.0 } else { 1.0 };
            new.rows.extend((0..SPLAT_STRIDE).map(|_| shown * noise()));
            new.gain.extend((0..GAIN_STRIDE).map(|_| shown * noise()));
        }
        new.rows[20 * SPLAT_STRIDE + OPACITY_OFFSET] = f32::NAN;
        new
    }

    /// One Gaussian with 14 parameters: logit, ln σ (3), δ (3), mean (3), quaternion (4).
    struct Alone {
        value: [f32; 14],
        m: [f32; 14],
        v: [f32; 14],
        row: Vec<f32>,
        gain: Vec<f32>,
    }

    impl Alone {
        fn new(row: &[f32], gain: &[f32], alpha: f32) -> Self {
            let (mut row, mut value) = (row.to_vec(), [0.0; 14]);
            row[OPACITY_OFFSET] = alpha;
            value[0] = (alpha / (1.0 - alpha)).ln();
            Self { value, m: [0.0; 14], v: [0.0; 14], row, gain: gain.to_vec() }
        }

        fn gradient(&self, by_row: &[f32], by_gain: &[f32], pixel: f32) -> [f32; 14] {
            let alpha = self.row[OPACITY_OFFSET];
            let mut out = [0.0; 14];
            out[0] = by_row[OPACITY_OFFSET] * alpha * (1.0 - alpha);
            for k in 0..3 {
                out[1 + k] = by_row[SCALE_OFFSET + k] * self.row[SCALE_OFFSET + k];
                out[4 + k] = by_gain[1 + k];
                out[7 + k] = by_row[MEAN_OFFSET + k] * pixel;
            }
            out[10..].copy_from_slice(&by_row[QUAT_OFFSET..QUAT_OFFSET + 4]);
            out
        }

        /// Kingma and Ba 2015, algorithm 1.
        fn advance(&mut self, g: &[f32; 14], rates: &[f32; 14], step: i32, limits: [f32; 2]) {
            for k in 0..14 {
                self.m[k] = 0.9 * self.m[k] + (1.0 - 0.9) * g[k];
                self.v[k] = 0.99 * self.v[k] + (1.0 - 0.99) * g[k] * g[k];
                let m = self.m[k] / (1.0 - 0.9f32.powi(step));
                let v = self.v[k] / (1.0 - 0.99f32.powi(step));
                self.value[k] -= rates[k] * m / (v.sqrt() + 1e-15);
            }
            let scales = self.value[1..4].iter_mut();
            scales.for_each(|v| *v = v.clamp(limits[0], limits[1]));
        }

        fn write(&mut self, before: &[f32], offsets: &[f32], pixel: f32, scale: f32) {
            let value = &self.value;
            self.row[OPACITY_OFFSET] = 1.0 / (1.0 + (-value[0]).exp());
            for k in 0..3 {
                let sigma = before[SCALE_OFFSET + k] * (scale * value[1 + k].exp());
                self.row[SCALE_OFFSET + k] = sigma;
                self.row[MEAN_OFFSET + k] = before[MEAN_OFFSET + k] + pixel * value[7 + k];
                self.gain[1 + k] = offsets[1 + k] + value[4 + k];
            }
            let q: [f32; 4] = std::array::from_fn(|k| before[QUAT_OFFSET + k] + value[10 + k]);
            let length = q.iter().map(|q| q * q).sum::<f32>().sqrt();
            for (k, q) in q.iter().enumerate() {
                self.row[QUAT_OFFSET + k] = q / length;
            }
        }
    }

    fn row_of(values: &[f32], i: usize) -> &[f32] {
        &values[i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE]
    }

    fn gain_of(values: &[f32], i: usize) -> &[f32] {
        &values[i * GAIN_STRIDE..(i + 1) * GAIN_STRIDE]
    }

    #[test]
    fn a_refinement_moves_each_gaussian_as_it_would_alone() {
        let splats = gaussians();
        let pixels: Vec<f32> = (0..COUNT).map(|i| 0.01 + 1e-4 * i as f32).collect();
        let spared: Vec<bool> = (0..COUNT).map(|i| i % 5 == 1).collect();
        let phase = Phase::refine(&RefineOptions::default()).of(&splats, 2);
        let mut all = Optimiser::new(&splats, &phase, 1, pixels.clone(), spared.clone());
        let alpha = |i: usize| row_of(&splats.rows, i)[OPACITY_OFFSET].clamp(1e-3, 1.0 - 1e-3);
        let alone = |i| Alone::new(row_of(&splats.rows, i), gain_of(&splats.gain, i), alpha(i));
        let mut alone: Vec<Alone> = (0..COUNT).map(alone).collect();
        let o = RefineOptions::default();
        let rates = [
            vec![o.opacity_rate],
            vec![o.scale_rate; 3],
            vec![o.colour_rate; 3],
            vec![o.mean_rate; 3],
            vec![o.rotation_rate; 4],
        ]
        .concat();
        for step in 1..=4 {
            let by_all = gradients(COUNT, 10 + step as u64);
            let by_other = gradients(OTHER.len(), 20 + step as u64);
            let across = Across { gradients: &by_other, gaussians: OTHER, weight: 0.7 };
            let gradients = PhotographGradients { all: &by_all, across: Some(across) };
            let factor = 1.0 - 0.1 * step as f32;
            all.step(&gradients, factor);
            let rates: [f32; 14] = std::array::from_fn(|k| factor * rates[k]);
            for (i, alone) in alone.iter_mut().enumerate() {
                let (by_row, by_gain) = (row_of(&by_all.rows, i), gain_of(&by_all.gain, i));
                let mut g = alone.gradient(by_row, by_gain, pixels[i]);
                if OTHER.contains(&i) {
                    let by_row = row_of(&by_other.rows, i - OTHER.start);
                    let second = alone.gradient(by_row, &[0.0; 4], pixels[i]);
                    g.iter_mut().zip(second).for_each(|(g, second)| *g += 0.7 * second);
                }
                if spared[i] {
                    g[..4].fill(0.0);
                    g[7..].fill(0.0);
                }
                if g.iter().any(|g| !g.is_finite()) || g.iter().all(|g| *g == 0.0) {
                    continue;
                }
                alone.advance(&g, &rates, step, [-2.0, 1.0]);
                let (before, offsets) = (row_of(&splats.rows, i), gain_of(&splats.gain, i));
                alone.write(before, offsets, pixels[i], 1.0);
            }
            for (i, alone) in alone.iter().enumerate() {
                assert_eq!(row_of(&all.rows, i), alone.row, "step {step}, Gaussian {i}");
                assert_eq!(gain_of(&all.gain, i), alone.gain, "step {step}, Gaussian {i}");
            }
        }
    }

    #[test]
    fn colours_by_direction_move_for_three_photographs() {
        let four = gaussians();
        let sh: Vec<f32> = (0..12 * COUNT).map(|i| 0.01 * (i % 50) as f32).collect();
        let splats = Splats::new(four.rows, sh.clone(), four.gain, 1, ShBasis::Standard).unwrap();
        let phase = Phase::refine(&RefineOptions::default());
        let mut by = gradients(COUNT, 3);
        let mut noise = noise(4);
        by.sh = (0..12 * COUNT).map(|i| if i / 12 % 7 == 3 { 0.0 } else { noise() }).collect();
        let step = |photographs| {
            let phase = phase.of(&splats, photographs);
            let pixels = vec![0.01; COUNT];
            let mut all = Optimiser::new(&splats, &phase, 1, pixels, Vec::new());
            all.step(&PhotographGradients { all: &by, across: None }, 0.5);
            let drawn = all.slices().sh.to_vec();
            assert_eq!(all.splats().sh, drawn);
            (drawn, all.into_splats().sh)
        };
        let [(two, kept), (drawn, three)] = [2, 3].map(step);
        assert!(two == sh && kept == sh && drawn == three);
        let rate = 0.5 * RefineOptions::default().sh_rate;
        for (i, (after, before)) in three.iter().zip(&sh).enumerate() {
            let (gaussian, coefficient) = (i / 12, i % 12 / 3);
            let moves = coefficient > 0 && gaussian != 20 && by.sh[i] != 0.0;
            // Adam's first step is the rate, against the gradient's sign.
            let expected = if moves { before - rate * by.sh[i].signum() } else { *before };
            assert!((after - expected).abs() < 1e-6, "{i}: {after} {expected}");
        }
        // Gaussians that share a set keep it.
        let shared = Splats::new(
            splats.rows[..11 * 4].to_vec(),
            sh[..24].to_vec(),
            vec![],
            1,
            ShBasis::Standard,
        );
        let moves = phase.of(&shared.unwrap(), 3).moves;
        assert!(moves.iter().all(|m| m.parameter.buffer != Buffer::Sh) && moves.len() == 5);
    }

    #[test]
    fn a_fit_adds_the_photographs_of_a_step() {
        let splats = gaussians();
        let options = FitOptions::default();
        let phase = Phase::fit(&options, true);
        let mut all = Optimiser::new(&splats, &phase, 2, Vec::new(), Vec::new());
        let sharper = phase.starts[1];
        all.begin(Some(sharper));
        let alpha = |i: usize| {
            let free = 1.0 - row_of(&splats.rows, i)[OPACITY_OFFSET];
            (1.0 - free.powf(sharper.density)).clamp(1e-4, 1.0 - 1e-4)
        };
        let alone = |i| Alone::new(row_of(&splats.rows, i), gain_of(&splats.gain, i), alpha(i));
        let mut alone: Vec<Alone> = (0..COUNT).map(alone).collect();
        for alone in &mut alone {
            alone.row[SCALE_OFFSET..OPACITY_OFFSET].iter_mut().for_each(|v| *v *= sharper.scale);
        }
        let mut rates = [0.0; 14];
        rates[0] = options.opacity_rate;
        rates[1..4].fill(options.scale_rate);
        rates[4..7].fill(options.colour_rate);
        for step in 1..=4 {
            let by = [30, 40].map(|seed| gradients(COUNT, seed + step as u64));
            all.add(&PhotographGradients { all: &by[0], across: None });
            all.step(&PhotographGradients { all: &by[1], across: None }, 1.0);
            for (i, alone) in alone.iter_mut().enumerate() {
                let mut sum = [0.0; 14];
                for by in &by {
                    let mut g = alone.gradient(row_of(&by.rows, i), gain_of(&by.gain, i), 0.0);
                    let size: f32 = g[1..4].iter().sum();
                    g[1..4].fill(size);
                    let finite = g.iter().all(|g| g.is_finite());
                    sum.iter_mut().zip(g).for_each(|(s, g)| *s += if finite { g } else { 0.0 });
                }
                alone.advance(&sum, &rates, step, [-0.5, 0.5]);
                let quat = alone.row[QUAT_OFFSET..SCALE_OFFSET].to_vec();
                let mean = 0.0;
                let (before, offsets) = (row_of(&splats.rows, i), gain_of(&splats.gain, i));
                alone.write(before, offsets, mean, sharper.scale);
                alone.row[QUAT_OFFSET..SCALE_OFFSET].copy_from_slice(&quat);
            }
            for (i, alone) in alone.iter().enumerate() {
                assert_eq!(row_of(&all.rows, i), alone.row, "step {step}, Gaussian {i}");
                assert_eq!(gain_of(&all.gain, i), alone.gain, "step {step}, Gaussian {i}");
            }
        }
    }

    /// Nothing of a Gaussian changes but what the phase moves, and each number by one parameter.
    #[test]
    fn a_phase_moves_each_number_once() {
        let fit = Phase::fit(&FitOptions::default(), false);
        let refine = Phase::refine(&RefineOptions::default());
        for (phase, numbers) in [(fit, 7), (refine, 23)] {
            let mut moved = Vec::new();
            for m in &phase.moves {
                let count = match m.parameter.form {
                    crate::finish::parameters::Form::CommonFactor => 3,
                    _ => m.parameter.elements(),
                };
                assert!(m.parameter.elements() <= ELEMENTS_MAX && m.rate > 0.0);
                moved.extend((0..count).map(|e| (m.parameter.buffer as u8, m.parameter.first + e)));
            }
            let all = moved.len();
            moved.sort_unstable();
            moved.dedup();
            assert_eq!((moved.len(), all), (numbers, numbers));
        }
    }
}
