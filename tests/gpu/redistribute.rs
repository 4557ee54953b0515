//! Redistribution on the GPU against the CPU version. Every comparison is also checked to fail
//! for a perturbed result.

use subsplat_test_support::cpu_against_gpu::Random;
use subsplat_test_support::gpu as adapter;

use adapter::gpu;
use subsplat_kernels::cpu::redistribute as cpu;
use subsplat_kernels::gpu::{GpuError, RedistributeArgs};
use subsplat_kernels::layout::OpacityRule;

/// Relative tolerance. WGSL allows errors of 3 + 2|x| units in the last place in exp and log,
/// with |x| up to 20 here: 3e-6 of the result, in numerator and sum.
const REDISTRIBUTE: f32 = 1e-5;

/// Tolerance of gradients, relative to the largest.
const REDISTRIBUTE_BACKWARD: f32 = 1e-5;

const RULES: [OpacityRule; 5] = [
    OpacityRule::Linear,
    OpacityRule::OpticalDepth,
    OpacityRule::Transmittance,
    OpacityRule::Area,
    OpacityRule::None,
];

/// Returns the largest |got − expected| / |expected|; NaN where one is.
fn relative(got: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(got.len(), expected.len());
    let pairs = got.iter().zip(expected);
    pairs
        .map(|(g, e)| (g - e).abs() / e.abs().max(f32::MIN_POSITIVE))
        .fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

#[test]
fn redistribute() {
    let Some(gpu) = gpu() else { return };
    let mut random = Random(7);
    for (p, k) in [(1, 1), (3, 4), (1000, 4), (777, 9), (513, 16), (70, 5)] {
        let logits = random.many(p * k, -10.0, 10.0);
        // Areas from far below a pixel to many pixels.
        let areas: Vec<f32> = random.many(p * k, -12.0, 6.0).iter().map(|e| e.exp2()).collect();
        let mut alphas = random.many(p, 0.0, 1.0);
        for (a, special) in alphas.iter_mut().zip([1e-7, 1.0, 0.9999, 1e-3]) {
            *a = special;
        }
        let own: Vec<f32> = random.many(p, -4.0, 6.0).iter().map(|e| e.exp2()).collect();
        for rule in RULES {
            let (logits, areas, alphas, own) = (&logits[..], &areas[..], &alphas[..], &own[..]);
            let expected = cpu::forward(cpu::Args { rule, k, logits, areas, alphas, own });
            let args = RedistributeArgs { rule, k, logits, areas, alphas, own };
            let got = gpu.redistribute(&args).unwrap();
            let off = relative(&got, &expected);
            assert!(off < REDISTRIBUTE, "{rule:?} {p}x{k}: {off:e}");
            // A change of 0.1 % in one number is detected.
            let mut perturbed = got;
            perturbed[p * k / 2] *= 1.001;
            assert!(relative(&perturbed, &expected) > REDISTRIBUTE);
        }
    }
}

/// Returns the largest difference relative to the largest number, or to 1e-3 of the upstream
/// gradient: gradients of the softmax are differences of near-equal numbers.
fn relative_to_largest(got: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(got.len(), expected.len());
    let largest = expected.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
    let pairs = got.iter().zip(expected);
    pairs
        .map(|(g, e)| (g - e).abs() / largest)
        .fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

#[test]
fn redistribute_backward() {
    let Some(gpu) = gpu() else { return };
    let mut random = Random(8);
    for (p, k) in [(1, 1), (3, 4), (1000, 4), (777, 9), (513, 16), (70, 5)] {
        let logits = random.many(p * k, -4.0, 4.0);
        let areas: Vec<f32> = random.many(p * k, -3.0, 3.0).iter().map(|e| e.exp2()).collect();
        let mut alphas = random.many(p, 0.0, 0.99);
        for (a, special) in alphas.iter_mut().zip([1e-7, 1.0, 0.99995, 1e-3]) {
            *a = special;
        }
        let own: Vec<f32> = random.many(p, -1.0, 3.0).iter().map(|e| e.exp2()).collect();
        let grad = random.many(p * k, -1.0, 1.0);
        for rule in RULES {
            let (logits, areas, alphas, own) = (&logits[..], &areas[..], &alphas[..], &own[..]);
            let args = cpu::Args { rule, k, logits, areas, alphas, own };
            let expected = cpu::backward(args, &grad);
            let args = RedistributeArgs { rule, k, logits, areas, alphas, own };
            let got = gpu.redistribute_backward(&args, &grad).unwrap();
            let all = [
                ("logits", got.logits, expected.logits),
                ("areas", got.areas, expected.areas),
                ("alphas", got.alphas, expected.alphas),
                ("own", got.own, expected.own),
            ];
            for (what, mut got, expected) in all {
                let off = relative_to_largest(&got, &expected);
                assert!(off < REDISTRIBUTE_BACKWARD, "{rule:?} {p}x{k} {what}: {off:e}");
                if expected.iter().any(|&v| v != 0.0) {
                    let largest = expected.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
                    got[expected.len() / 2] += 2.0 * REDISTRIBUTE_BACKWARD * largest;
                    assert!(relative_to_largest(&got, &expected) > REDISTRIBUTE_BACKWARD, "{what}");
                }
            }
        }
    }
    let args = RedistributeArgs {
        rule: OpacityRule::Linear,
        k: 2,
        logits: &[0.0; 4],
        areas: &[1.0; 4],
        alphas: &[0.5; 2],
        own: &[],
    };
    let error = gpu.redistribute_backward(&args, &[0.0; 3]).unwrap_err();
    assert!(matches!(error, GpuError::Argument { argument: "gradient", .. }), "{error}");
}

#[test]
fn inconsistent_arguments_are_named() {
    let Some(gpu) = gpu() else { return };
    let args = RedistributeArgs {
        rule: OpacityRule::OpticalDepth,
        k: 2,
        logits: &[0.0; 4],
        areas: &[1.0; 4],
        alphas: &[0.5; 2],
        own: &[1.0],
    };
    let error = gpu.redistribute(&args).unwrap_err();
    assert!(matches!(error, GpuError::Argument { argument: "own areas", .. }), "{error}");
    let error = gpu.redistribute(&RedistributeArgs { k: 0, ..args }).unwrap_err();
    assert!(matches!(error, GpuError::Argument { .. }), "{error}");
}

/// Concurrent read-backs return each thread's own values, although one thread's poll may complete
/// another's mapping.
#[test]
fn threads_read_back_their_own_values() {
    let Some(gpu) = gpu() else { return };
    let gpu = &gpu;
    std::thread::scope(|scope| {
        for thread in 0..16u32 {
            scope.spawn(move || {
                for round in 0..40u32 {
                    // Descending keys whose number depends on thread and round.
                    let count = 1 + (37 * thread + 11 * round) % 300;
                    let keys: Vec<u32> = (0..count).map(|i| 7 * (count - i) + thread).collect();
                    let expected: Vec<u32> = (0..count).rev().collect();
                    let got = gpu.sort_order(&keys);
                    assert!(got.as_ref() == Ok(&expected), "{thread} {round}: {got:?}");
                }
            });
        }
    });
}
