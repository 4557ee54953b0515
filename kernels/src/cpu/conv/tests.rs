//! Compares every direction with the definition in f64, at every SIMD level.

use super::algorithm::Algorithm;
use super::*;
use crate::cpu::uninit::as_uninit;

/// Computes y in f64 by nested loops.
fn definition(s: &Sizes, x: &[f32], w: &[f32], bias: &[f32]) -> Vec<f64> {
    let (out, [d, h, wi], taps) = (s.out_size(), s.size, s.taps());
    let images = x.len() / (s.in_channels * s.in_pixels());
    let mut y = Vec::new();
    for b in 0..images {
        for o in 0..s.out_channels {
            for at in 0..s.out_pixels() {
                let place = [at / (out[1] * out[2]), at / out[2] % out[1], at % out[2]];
                let mut sum = bias.get(o).map_or(0.0, |&b| f64::from(b));
                for tap in 0..taps {
                    let k = [
                        tap / (s.kernel[1] * s.kernel[2]),
                        tap / s.kernel[2] % s.kernel[1],
                        tap % s.kernel[2],
                    ];
                    let from: Vec<usize> = (0..3)
                        .filter_map(|a| {
                            (place[a] * s.stride[a] + k[a])
                                .checked_sub(s.padding[a])
                                .filter(|&v| v < s.size[a])
                        })
                        .collect();
                    let [z, y, x_at] = from[..] else { continue };
                    for c in 0..s.in_channels {
                        let i = (((b * s.in_channels + c) * d + z) * h + y) * wi + x_at;
                        let j = (o * s.in_channels + c) * taps + tap;
                        sum += f64::from(x[i]) * f64::from(w[j]);
                    }
                }
                y.push(sum);
            }
        }
    }
    y
}

/// Returns pseudo-random numbers in ±1.
fn noise(n: usize, seed: u32) -> Vec<f32> {
    let mut s = seed.wrapping_mul(2_654_435_761).wrapping_add(1);
    (0..n)
        .map(|_| {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / 8_388_608.0 - 1.0
        })
        .collect()
}

fn conv2d(
    c: usize,
    o: usize,
    k: [usize; 2],
    stride: usize,
    padding: usize,
    size: [usize; 2],
) -> Sizes {
    Sizes::conv2d([c, o], k, stride, padding, size)
}

fn conv3d(c: usize, o: usize, kernel: [usize; 3], padding: usize, size: [usize; 3]) -> Sizes {
    Sizes::conv3d([c, o], kernel, padding, size)
}

/// Returns sizes that cover every case of the code: kernels, strides and remainders, one to
/// nine output channels, several blocks of 48, tiles cut in rows, columns and depths.
fn cases() -> Vec<Sizes> {
    vec![
        conv2d(3, 5, [7, 7], 2, 3, [16, 12]),
        conv2d(40, 7, [3, 3], 1, 1, [9, 11]),
        conv2d(6, 4, [3, 3], 2, 1, [8, 9]),
        conv2d(6, 4, [1, 1], 2, 0, [8, 9]),
        conv2d(37, 8, [1, 1], 1, 0, [5, 7]),
        // Pointwise, with rows and columns left over.
        conv2d(37, 50, [1, 1], 1, 0, [18, 16]),
        conv2d(130, 20, [1, 1], 1, 0, [40, 43]),
        // Pointwise with strides.
        conv2d(37, 50, [1, 1], 2, 0, [36, 73]),
        conv2d(130, 20, [1, 1], 2, 0, [81, 79]),
        conv2d(19, 23, [1, 1], 3, 0, [50, 61]),
        conv2d(2, 3, [3, 1], 1, 1, [1, 1]),
        conv2d(2, 3, [5, 5], 3, 4, [2, 3]),
        conv2d(1, 1, [3, 3], 1, 1, [33, 40]),
        conv2d(5, 17, [5, 5], 2, 2, [20, 33]),
        // Weight gradients in three narrow passes.
        conv2d(3, 23, [5, 5], 2, 2, [20, 31]),
        conv2d(3, 18, [5, 5], 2, 2, [21, 64]),
        conv2d(4, 50, [3, 3], 1, 1, [16, 16]),
        conv2d(21, 110, [3, 3], 2, 1, [13, 10]),
        conv2d(2, 100, [3, 3], 1, 1, [5, 20]),
        conv2d(3, 9, [3, 3], 1, 0, [6, 300]),
        conv2d(3, 8, [3, 3], 1, 1, [6, 288]),
        conv2d(20, 2, [3, 3], 1, 1, [70, 140]),
        conv2d(2, 20, [1, 1], 3, 0, [7, 7]),
        // Winograd, borders within tiles, several blocks along both axes.
        conv2d(24, 30, [3, 3], 1, 1, [30, 33]),
        conv2d(41, 26, [3, 3], 1, 0, [36, 31]),
        conv2d(33, 100, [3, 3], 1, 2, [22, 35]),
        conv2d(25, 24, [3, 3], 1, 1, [70, 141]),
        // Weight gradients in several groups of tiles.
        conv2d(26, 70, [3, 3], 1, 1, [66, 67]),
        // Winograd of stride 2.
        conv2d(24, 30, [3, 3], 2, 1, [60, 66]),
        conv2d(41, 26, [3, 3], 2, 1, [71, 63]),
        conv2d(33, 100, [3, 3], 2, 0, [55, 60]),
        conv2d(25, 24, [3, 3], 2, 1, [139, 280]),
        // Winograd for small images: the tiles of both images together.
        conv2d(41, 26, [3, 3], 1, 1, [16, 16]),
        conv2d(24, 53, [3, 3], 1, 1, [13, 18]),
        conv2d(33, 26, [3, 3], 2, 1, [31, 34]),
        conv3d(5, 8, [3, 3, 3], 1, [6, 7, 9]),
        conv3d(8, 1, [3, 3, 3], 1, [5, 4, 20]),
        // Narrow weight gradients in passes of some rows each, fewer in the last one.
        conv3d(1, 7, [3, 3, 3], 1, [8, 40, 30]),
        conv3d(1, 8, [3, 3, 3], 1, [8, 40, 32]),
        conv3d(2, 11, [3, 1, 2], 1, [3, 4, 5]),
        conv3d(1, 3, [3, 3, 3], 1, [20, 3, 3]),
    ]
}

/// Bound of [`worst`] for Winograd's algorithm.
const WINOGRAD_BOUND: f64 = 3e-6;
/// Bound of [`worst`] for the other algorithms.
const DIRECT_BOUND: f64 = 1.5e-6;

/// Returns the bound of [`worst`] for the algorithm that `plan` is computed with.
fn bound(plan: &Plan) -> f64 {
    match choose_algorithm(plan) {
        Algorithm::Winograd(_) | Algorithm::WinogradSmallImages(_) => WINOGRAD_BOUND,
        Algorithm::Pointwise | Algorithm::Direct => DIRECT_BOUND,
    }
}

/// Returns the largest difference, divided by `scale`.
fn worst(got: &[f32], want: &[f64], scale: f64) -> f64 {
    assert_eq!(got.len(), want.len());
    let differences = got.iter().zip(want).map(|(a, b)| (f64::from(*a) - b).abs());
    differences.fold(0.0, |m: f64, d| if d <= m { m } else { d }) / scale
}

/// Convolves into memory full of NaN, so that a place that is not written shows.
fn over_nan(level: SimdLevel, plan: &Plan, x: &[f32], w: &[f32], bias: &[f32]) -> Vec<f32> {
    let images = x.len() / (plan.src_channels * plan.src_pixels());
    let mut y = vec![f32::NAN; images * plan.dst_channels * plan.dst_pixels()];
    // SAFETY: `convolve_into` writes numbers only.
    convolve_into(&ConvolveArgs { level, plan, x, w, bias }, unsafe { as_uninit(&mut y) });
    y
}

#[test]
fn forward_agrees_with_the_definition() {
    for s in cases() {
        let x = noise(2 * s.in_channels * s.in_pixels(), 1);
        let w = noise(s.out_channels * s.in_channels * s.taps(), 2);
        let scale = ((s.in_channels * s.taps()) as f64).sqrt();
        for bias in [vec![], noise(s.out_channels, 3)] {
            let want = definition(&s, &x, &w, &bias);
            for &level in SimdLevel::available() {
                let y = over_nan(level, &Plan::forward(&s), &x, &w, &bias);
                let worst = worst(&y, &want, scale);
                assert!(worst < bound(&Plan::forward(&s)), "{level:?} {s:?}: {worst:e}");
            }
        }
    }
}

/// Computes ∂L/∂x and ∂L/∂w in f64. The convolution is linear in x and in w, so both follow
/// from its definition: ∂⟨dy, y⟩/∂w[j] = ⟨dy, y of the j-th unit w⟩.
fn gradients(s: &Sizes, x: &[f32], w: &[f32], dy: &[f32]) -> [Vec<f64>; 2] {
    let (out, taps) = (s.out_size(), s.taps());
    let images = x.len() / (s.in_channels * s.in_pixels());
    let (mut dx, mut dw) = (vec![0.0; x.len()], vec![0.0; w.len()]);
    for (i, &dy) in dy.iter().enumerate() {
        let at = i % s.out_pixels();
        let (o, b) = (i / s.out_pixels() % s.out_channels, i / s.out_pixels() / s.out_channels);
        assert!(b < images);
        let place = [at / (out[1] * out[2]), at / out[2] % out[1], at % out[2]];
        for tap in 0..taps {
            let k = [
                tap / (s.kernel[1] * s.kernel[2]),
                tap / s.kernel[2] % s.kernel[1],
                tap % s.kernel[2],
            ];
            let from: [Option<usize>; 3] = std::array::from_fn(|a| {
                (place[a] * s.stride[a] + k[a]).checked_sub(s.padding[a]).filter(|&v| v < s.size[a])
            });
            let [Some(z), Some(y), Some(x_at)] = from else { continue };
            for c in 0..s.in_channels {
                let i = (((b * s.in_channels + c) * s.size[0] + z) * s.size[1] + y) * s.size[2];
                let j = (o * s.in_channels + c) * taps + tap;
                dx[i + x_at] += f64::from(dy) * f64::from(w[j]);
                dw[j] += f64::from(dy) * f64::from(x[i + x_at]);
            }
        }
    }
    [dx, dw]
}

#[test]
fn gradients_agree_with_the_definition() {
    for s in cases() {
        let x = noise(2 * s.in_channels * s.in_pixels(), 4);
        let w = noise(s.out_channels * s.in_channels * s.taps(), 5);
        let dy = noise(2 * s.out_channels * s.out_pixels(), 6);
        let [want_x, want_w] = gradients(&s, &x, &w, &dy);
        for &level in SimdLevel::available() {
            let mut dw = vec![f32::NAN; w.len()];
            let dx = over_nan(level, &Plan::input_grad(&s), &dy, &w, &[]);
            weight_grad(level, &s, &x, &dy, &mut dw);
            let worst_x = worst(&dx, &want_x, ((s.out_channels * s.taps()) as f64).sqrt());
            let worst_w = worst(&dw, &want_w, ((2 * s.out_pixels()) as f64).sqrt());
            assert!(worst_x < bound(&Plan::input_grad(&s)), "{level:?} {s:?}: dx {worst_x:e}");
            assert!(worst_w < bound(&Plan::forward(&s)), "{level:?} {s:?}: dw {worst_w:e}");
        }
    }
}

#[test]
fn bias_gradients_are_sums() {
    for pixels in [1, 63, 64, 5000] {
        let dy = noise(2 * 3 * pixels, 7);
        let mut db = [f32::NAN; 3];
        bias_grad(pixels, &dy, &mut db);
        for (o, got) in db.into_iter().enumerate() {
            let rows = dy.chunks_exact(pixels).skip(o).step_by(3);
            let want: f64 = rows.flatten().map(|&v| f64::from(v)).sum();
            assert!((f64::from(got) - want).abs() < 1e-6 * (pixels as f64), "{got} {want}");
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_byte() {
    for s in [
        conv2d(24, 40, [3, 3], 1, 1, [48, 48]),
        conv2d(40, 150, [3, 3], 1, 1, [64, 64]),
        conv2d(40, 50, [3, 3], 2, 1, [64, 64]),
        conv2d(70, 40, [1, 1], 2, 0, [64, 70]),
    ] {
        check_threads(&s);
    }
}

fn check_threads(s: &Sizes) {
    let x = noise(2 * s.in_channels * s.in_pixels(), 8);
    let w = noise(s.out_channels * s.in_channels * s.taps(), 9);
    let dy = noise(2 * s.out_channels * s.out_pixels(), 10);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok();
        pool.map(|pool| {
            pool.install(|| {
                let mut dw = w.clone();
                let y = forward(SimdLevel::best(), s, 2, &x, &w, &[]);
                let dx = input_grad(SimdLevel::best(), s, 2, &dy, &w);
                weight_grad(SimdLevel::best(), s, &x, &dy, &mut dw);
                [y, dx, dw].concat().iter().map(|v| v.to_bits()).collect::<Vec<_>>()
            })
        })
    };
    let one = run(1);
    assert!(one.is_some() && one == run(2) && one == run(5), "{s:?}");
}

/// An image of a batch gives the same bytes as the image alone, also where its tiles share
/// vectors with tiles of other images.
#[test]
fn images_of_a_batch_are_independent() {
    for s in [conv2d(24, 30, [3, 3], 1, 1, [16, 20]), conv2d(24, 30, [3, 3], 2, 1, [32, 32])] {
        let w = noise(s.out_channels * s.in_channels * s.taps(), 11);
        let x = noise(3 * s.in_channels * s.in_pixels(), 12);
        let together = forward(SimdLevel::best(), &s, 3, &x, &w, &[]);
        let one = s.in_channels * s.in_pixels();
        let apart = x.chunks(one).flat_map(|x| forward(SimdLevel::best(), &s, 1, x, &w, &[]));
        assert!(together.iter().map(|v| v.to_bits()).eq(apart.map(f32::to_bits)), "{s:?}");
    }
}

/// The weight gradient of a batch is the sum of the weight gradients of its images, also
/// where a block of tiles holds several images.
#[test]
fn weight_gradients_of_images_add_up() {
    for s in [
        conv2d(24, 30, [3, 3], 1, 1, [13, 18]),
        conv2d(25, 26, [3, 3], 2, 1, [8, 66]),
        conv2d(24, 26, [3, 3], 1, 1, [4, 3]),
        Sizes { size: [3, 5, 9], ..conv2d(24, 25, [3, 3], 1, 1, [5, 9]) },
    ] {
        let [one, out] = [s.in_channels * s.in_pixels(), s.out_channels * s.out_pixels()];
        let [x, dy] = [noise(17 * one, 13), noise(17 * out, 14)];
        let mut together = vec![f32::NAN; s.out_channels * s.in_channels * s.taps()];
        weight_grad(SimdLevel::best(), &s, &x, &dy, &mut together);
        let mut sum = vec![0.0; together.len()];
        for (x, dy) in x.chunks(one).zip(dy.chunks(out)) {
            let mut dw = together.clone();
            weight_grad(SimdLevel::best(), &s, x, dy, &mut dw);
            sum.iter_mut().zip(dw).for_each(|(sum, v)| *sum += f64::from(v));
        }
        let worst = worst(&together, &sum, ((17 * s.out_pixels()) as f64).sqrt());
        assert!(worst < WINOGRAD_BOUND, "{s:?}: {worst:e}");
    }
}

#[test]
fn empty_tensors_are_accepted() {
    let s = conv2d(0, 3, [3, 3], 1, 1, [4, 4]);
    let y = forward(SimdLevel::best(), &s, 1, &[], &[], &[1.0, 2.0, 3.0]);
    assert_eq!(y.len(), 3 * 16);
    assert!(y.chunks(16).zip([1.0, 2.0, 3.0]).all(|(row, b)| row.iter().all(|v| *v == b)));
    weight_grad(SimdLevel::best(), &s, &[], &y, &mut []);
    assert!(input_grad(SimdLevel::best(), &s, 1, &y, &[]).is_empty());
    let s = conv2d(2, 0, [3, 3], 1, 1, [4, 4]);
    assert_eq!(input_grad(SimdLevel::best(), &s, 1, &[], &[]), [0.0; 32]);
}

/// The choice for layers of each kind, so that a change of a threshold shows.
#[test]
fn algorithms_are_chosen_by_size() {
    use algorithm::WeightGradAlgorithm as Grad;
    use winograd::Kind::{Stride1, Stride2, Stride2InputGrad};
    let choose = |s: &Sizes, images: usize| {
        let (forward, input) = (Plan::forward(s), Plan::input_grad(s));
        let weights = choose_weight_grad_algorithm(&forward, images);
        (choose_algorithm(&forward), choose_algorithm(&input), weights)
    };
    let wide = |stride: usize, side: usize| conv2d(64, 96, [3, 3], stride, 1, [side, side]);
    let expected =
        (Algorithm::Winograd(Stride1), Algorithm::Winograd(Stride1), Grad::Winograd(Stride1));
    assert_eq!(choose(&wide(1, 64), 1), expected);
    let expected = (
        Algorithm::Winograd(Stride2),
        Algorithm::Winograd(Stride2InputGrad),
        Grad::Winograd(Stride2),
    );
    assert_eq!(choose(&wide(2, 64), 1), expected);
    let small = Algorithm::WinogradSmallImages(Stride1);
    assert_eq!(choose(&wide(1, 16), 1), (small, small, Grad::Winograd(Stride1)));
    assert_eq!(choose(&wide(1, 8), 1), (small, small, Grad::DirectWide));
    let pointwise = conv2d(64, 96, [1, 1], 2, 0, [64, 64]);
    let expected = (Algorithm::Pointwise, Algorithm::Pointwise, Grad::Pointwise);
    assert_eq!(choose(&pointwise, 1), expected);
    let narrow = conv2d(64, 20, [3, 3], 1, 1, [64, 64]);
    let expected = (Algorithm::Direct, Algorithm::Direct, Grad::DirectNarrow);
    assert_eq!(choose(&narrow, 1), expected);
}
