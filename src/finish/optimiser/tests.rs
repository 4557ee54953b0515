//! One Gaussian alone, by the formulas, beside the optimiser's blocks.

use super::*;
#[cfg(feature = "gpu")]
use crate::finish::dropout::Dropout;
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
        (drawn, all.splats().sh)
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
            assert!(m.parameter.elements() <= ELEMENTS_MAX && m.rate > 0.0);
            moved.extend(
                (0..m.parameter.numbers())
                    .map(|e| (m.parameter.buffer as u8, m.parameter.first + e)),
            );
        }
        let all = moved.len();
        moved.sort_unstable();
        moved.dedup();
        assert_eq!((moved.len(), all), (numbers, numbers));
    }
}

/// Tolerance of a number after some steps on a GPU, of its distance from 0 or 1, whichever is larger: a dozen
/// roundings a step, and exponentials, roots and quotients that are exact to 3 units in the last place.
#[cfg(feature = "gpu")]
const ON_DEVICE: f32 = 2e-5;

#[cfg(feature = "gpu")]
#[track_caller]
fn assert_near(name: &str, got: &[f32], expected: &[f32]) {
    assert_eq!(got.len(), expected.len(), "{name}");
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        let off = (got - expected).abs() / expected.abs().max(1.0);
        assert!(off < ON_DEVICE, "{name} {i}: {got} {expected}");
    }
}

/// Gradients of `COUNT` Gaussians that are 0 but for those `of`.
#[cfg(feature = "gpu")]
fn spread(part: &Gradients, of: Range<usize>) -> Gradients {
    let mut all = Gradients { rows: vec![0.0; COUNT * SPLAT_STRIDE], ..Gradients::default() };
    all.rows[of.start * SPLAT_STRIDE..of.end * SPLAT_STRIDE].copy_from_slice(&part.rows);
    all
}

#[cfg(feature = "gpu")]
#[test]
fn a_device_refines_as_the_cpu_does() {
    use subsplat_kernels::gpu::{GivenGradients, Rates};
    let Some(gpu) = subsplat_test_support::gpu::gpu() else { return };
    let four = gaussians();
    let sh: Vec<f32> = (0..12 * COUNT).map(|i| 0.01 * (i % 50) as f32).collect();
    let splats = Splats::new(four.rows, sh, four.gain, 1, ShBasis::Standard).unwrap();
    let pixels: Vec<f32> = (0..COUNT).map(|i| 0.01 + 1e-4 * i as f32).collect();
    let spared: Vec<bool> = (0..COUNT).map(|i| i % 5 == 1).collect();
    // Two photographs have a picture across, three move SH coefficients and leave Gaussians out.
    for photographs in [2, 3] {
        let phase = Phase::refine(&RefineOptions::default()).of(&splats, photographs);
        let mut on_cpu = Optimiser::new(&splats, &phase, 1, pixels.clone(), spared.clone());
        let steps = 1..=4;
        let by_all: Vec<Gradients> = (steps.clone())
            .map(|step| {
                let mut by = gradients(COUNT, 10 + step);
                let mut noise = noise(50 + step);
                by.sh =
                    (0..12 * COUNT).map(|i| if i / 12 % 7 == 3 { 0.0 } else { noise() }).collect();
                by
            })
            .collect();
        let by_other: Vec<Gradients> =
            steps.clone().map(|step| gradients(OTHER.len(), 20 + step)).collect();
        let spread: Vec<Gradients> = by_other.iter().map(|by| spread(by, OTHER)).collect();
        let dropouts = steps.clone().map(|step| Dropout::new(0.3, step as usize));
        let dropouts: Vec<Dropout> = dropouts.collect();
        let factor = |step: u64| 1.0 - 0.1 * step as f32;
        let given = steps.clone().map(|step| {
            let i = step as usize - 1;
            let (across, left_out) = match photographs {
                2 => (Some((&spread[i], 0.7)), None),
                _ => (None, Some(dropouts[i].for_device())),
            };
            let given = GivenGradients { all: &by_all[i], across, left_out };
            let corrections = corrections(step as i32);
            (vec![given], Rates { factor: factor(step), corrections })
        });
        let given: Vec<_> = given.collect();
        let [rows, gain, sh] = gpu.optimise(&on_cpu.for_device(), &given).unwrap();
        for step in steps {
            let i = step as usize - 1;
            let mut all = by_all[i].clone();
            let across = match photographs {
                2 => Some(Across { gradients: &by_other[i], gaussians: OTHER, weight: 0.7 }),
                _ => {
                    let mut drawn = Vec::new();
                    dropouts[i].draw(on_cpu.rows(), &mut drawn);
                    dropouts[i].chain(on_cpu.rows(), &drawn, &mut all.rows);
                    None
                }
            };
            on_cpu.step(&PhotographGradients { all: &all, across }, factor(step));
        }
        assert_near("rows", &rows, on_cpu.rows());
        assert_near("gain", &gain, on_cpu.slices().gain);
        assert_near("sh", &sh, &on_cpu.sh);
        assert_eq!(sh.is_empty(), photographs == 2);
        assert_ne!(on_cpu.rows(), splats.rows);
    }
}

#[cfg(feature = "gpu")]
#[test]
fn a_device_fits_as_the_cpu_does() {
    use subsplat_kernels::gpu::{GivenGradients, Rates};
    let Some(gpu) = subsplat_test_support::gpu::gpu() else { return };
    let splats = gaussians();
    let phase = Phase::fit(&FitOptions::default(), true);
    let mut on_cpu = Optimiser::new(&splats, &phase, 2, Vec::new(), Vec::new());
    on_cpu.begin(Some(phase.starts[1]));
    let by: Vec<[Gradients; 2]> =
        (1..=4).map(|step| [30, 40].map(|seed| gradients(COUNT, seed + step))).collect();
    let of = |all| GivenGradients { all, across: None, left_out: None };
    let given = by.iter().zip(1..).map(|(by, step)| {
        let corrections = corrections(step);
        (by.iter().map(of).collect(), Rates { factor: 1.0, corrections })
    });
    let given: Vec<_> = given.collect();
    let [rows, gain, sh] = gpu.optimise(&on_cpu.for_device(), &given).unwrap();
    for [first, last] in &by {
        on_cpu.add(&PhotographGradients { all: first, across: None });
        on_cpu.step(&PhotographGradients { all: last, across: None }, 1.0);
    }
    assert_near("rows", &rows, on_cpu.rows());
    assert_near("gain", &gain, on_cpu.slices().gain);
    assert!(sh.is_empty());
}
