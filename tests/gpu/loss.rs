//! The loss of a picture on a GPU, against the CPU's and finite differences.

use subsplat::finish::loss::{Scored, dssim, mse, ssim_window};
use subsplat_kernels::gpu::{LossRules, PixelWeights};
use subsplat_test_support::cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_test_support::gpu::gpu;

/// Tolerance of a gradient, of its largest: SSIM subtracts means of squares, which are summed in
/// the same order, from one another; the device's quotients are exact to 3 units in the last place.
const GRADIENT: f32 = 2e-5;
/// Relative tolerance of a value: sums of 1,024 pixels are in f32.
const VALUE: f64 = 2e-5;
/// Coverage from which pixels begin to count.
const COVERAGE_MIN: f32 = 0.7;

fn rules(dssim: f64) -> LossRules {
    LossRules { dssim, window: ssim_window(), coverage_min: COVERAGE_MIN }
}

/// A photograph, its mask and rendered planes `[5, H, W]` near it.
struct Case {
    size: [usize; 2],
    image: Vec<u8>,
    kept: Vec<bool>,
    planes: Vec<f32>,
}

impl Case {
    fn new([width, height]: [usize; 2], seed: u64) -> Self {
        let r = &mut Random(seed);
        let pixels = width * height;
        let image: Vec<u8> = r.many(3 * pixels, 0.0, 255.9).into_iter().map(|v| v as u8).collect();
        let kept = (0..pixels).map(|i| (i % width + i / width) % 9 > 2).collect();
        let noise = r.many(5 * pixels, 0.0, 1.0);
        let truth = Self::planes_of(&image);
        let near = |(i, v): (usize, f32)| truth.get(i).map_or(v, |t| 0.6 * t + 0.4 * v);
        let planes = noise.into_iter().enumerate().map(near).collect();
        Self { size: [width, height], image, kept, planes }
    }

    fn planes_of(image: &[u8]) -> Vec<f32> {
        let channel = |c: usize| image[c..].iter().step_by(3).map(|v| f32::from(*v) / 255.0);
        (0..3).flat_map(channel).collect()
    }

    /// Weight of pixel `i`.
    fn weight(&self, i: usize, masked: bool, weights: PixelWeights) -> f32 {
        let alpha = self.planes[3 * self.kept.len() + i];
        match weights {
            _ if masked && !self.kept[i] => 0.0,
            PixelWeights::Equal => 1.0,
            PixelWeights::Covered => {
                ((alpha - COVERAGE_MIN) / (1.0 - COVERAGE_MIN)).clamp(0.0, 1.0)
            }
        }
    }

    /// Value and gradient by the CPU.
    fn expected(&self, masked: bool, weights: PixelWeights, factor: f64) -> Scored {
        let pixels = self.kept.len();
        let mut truth = Self::planes_of(&self.image);
        for (j, truth) in truth.iter_mut().enumerate() {
            let weight = self.weight(j % pixels, masked, weights);
            *truth = self.planes[j] + weight * (*truth - self.planes[j]);
        }
        let rgb = &self.planes[..3 * pixels];
        let mut loss = mse(rgb, &truth);
        loss.add(&dssim(rgb, &truth, self.size[0], self.size[1]), factor);
        let kept = |i: usize| !masked || self.kept[i % pixels];
        (0..3 * pixels).filter(|i| !kept(*i)).for_each(|i| loss.gradient[i] = 0.0);
        let counted = (0..pixels).filter(|i| kept(*i)).count();
        loss.gradient.resize(5 * pixels, 0.0);
        loss.scaled(pixels as f64 / counted as f64)
    }
}

#[test]
fn losses_and_gradients_are_those_of_the_cpu() {
    let Some(gpu) = gpu() else { return };
    // Below a window, one window, squares of windows with and without a rest, more of them than
    // one.
    for (seed, size) in [[9, 30], [11, 11], [26, 26], [70, 45]].into_iter().enumerate() {
        let case = Case::new(size, seed as u64 + 1);
        let pixels = size[0] * size[1];
        for masked in [false, true] {
            let kept = masked.then_some(&case.kept[..]);
            let target = gpu.target_picture(&case.image, kept, size).unwrap();
            for weights in [PixelWeights::Equal, PixelWeights::Covered] {
                for factor in [0.0, 0.2] {
                    let name = format!("{size:?} {masked} {weights:?} {factor}");
                    let rules = rules(factor);
                    let loss = || gpu.picture_loss(&case.planes, &target, &rules, weights).unwrap();
                    let (got, gradient) = loss();
                    let expected = case.expected(masked, weights, factor);
                    // Alpha and Σ w·z have no gradient, but are part of the planes.
                    let rgb = 3 * pixels;
                    assert_matches_cpu(
                        &name,
                        &gradient[..rgb],
                        &expected.gradient[..rgb],
                        GRADIENT,
                    );
                    assert!(gradient[rgb..].iter().all(|g| *g == 0.0), "{name}");
                    let off = (got.value / expected.value - 1.0).abs();
                    assert!(off < VALUE, "{name}: {} {}", got.value, expected.value);
                    assert_eq!(loss(), (got, gradient), "{name}: the same bytes again");
                }
            }
        }
    }
}

#[test]
fn errors_count_pixels_by_their_weight() {
    let Some(gpu) = gpu() else { return };
    let size = [70, 45];
    let case = Case::new(size, 7);
    let pixels = size[0] * size[1];
    let truth = Case::planes_of(&case.image);
    for masked in [false, true] {
        let kept = masked.then_some(&case.kept[..]);
        let target = gpu.target_picture(&case.image, kept, size).unwrap();
        for weights in [PixelWeights::Equal, PixelWeights::Covered] {
            let (mut sum, mut all, mut counted) = (0.0, 0.0, 0.0);
            for i in 0..pixels {
                let weight = f64::from(case.weight(i, masked, weights));
                let square = |j: usize| f64::from(case.planes[j] - truth[j]).powi(2);
                sum += weight * [i, i + pixels, i + 2 * pixels].map(square).iter().sum::<f64>();
                all += weight;
                counted += f64::from(u8::from(!masked || case.kept[i]));
            }
            let (got, _) = gpu.picture_loss(&case.planes, &target, &rules(0.0), weights).unwrap();
            for (got, expected) in [(got.error, sum / (3.0 * all)), (got.covered, all / counted)] {
                assert!((got / expected - 1.0).abs() < VALUE, "{got} {expected}");
            }
        }
    }
}

/// The gradient is the derivative of the device's own value, where all pixels count.
#[test]
fn gradients_are_finite_differences() {
    let Some(gpu) = gpu() else { return };
    let size = [24, 18];
    let case = Case::new(size, 5);
    let target = gpu.target_picture(&case.image, None, size).unwrap();
    let loss = |planes: &[f32]| {
        gpu.picture_loss(planes, &target, &rules(0.2), PixelWeights::Equal).unwrap()
    };
    let (_, gradient) = loss(&case.planes);
    for i in (0..3 * size[0] * size[1]).step_by(37) {
        let at = |step: f32| {
            let mut moved = case.planes.clone();
            moved[i] += step;
            loss(&moved).0.value
        };
        let slope = (at(1e-2) - at(-1e-2)) / 2e-2;
        let got = f64::from(gradient[i]);
        // A difference of two f32 sums of 0.1 has an error of about 1e-8.
        assert!((got - slope).abs() < 2e-2 * slope.abs().max(2e-4), "{i}: {got} {slope}");
    }
}

#[test]
fn other_sizes_are_named() {
    let Some(gpu) = gpu() else { return };
    let error = gpu.target_picture(&[0; 11], None, [2, 2]).unwrap_err().to_string();
    assert!(error.contains("image: expected 12, got 11"), "{error}");
    let error = gpu.target_picture(&[0; 12], Some(&[true; 3]), [2, 2]).unwrap_err().to_string();
    assert!(error.contains("mask: expected 4, got 3"), "{error}");
    let target = gpu.target_picture(&[0; 12], None, [2, 2]).unwrap();
    let loss = gpu.picture_loss(&[0.0; 19], &target, &rules(0.2), PixelWeights::Equal);
    let error = loss.unwrap_err().to_string();
    assert!(error.contains("planes: expected 20, got 19"), "{error}");
}
