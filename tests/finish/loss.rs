//! Losses of pictures: values by their definitions, gradients by finite differences.

use subsplat::finish::loss;
use subsplat::finish::loss::Scored;
use subsplat::scene::metrics;
use subsplat_test_support::finite_differences::{check_gradient, noise};

#[test]
fn mse_follows_its_formula() {
    let (x, t) = (noise(300, 1), noise(300, 2));
    let want: f64 = x.iter().zip(&t).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / 300.0;
    assert!((loss::mse(&x, &t).value - want).abs() < 1e-9);
    check_gradient(&x, 1e-2, 1e-3, |x| loss::mse(x, &t));
}

#[test]
fn dssim_equals_the_metric_and_has_its_gradient() {
    let (w, h) = (23, 17);
    let (x, t) = (noise(3 * w * h, 3), noise(3 * w * h, 4));
    // A target and a perturbed copy: SSIM far from 0.
    let x: Vec<f32> = x.iter().zip(&t).map(|(x, t)| 0.3 * x + 0.7 * t).collect();
    let inner = |p: &[f32]| -> Vec<f32> {
        (0..w * h)
            .flat_map(|i| (0..3).map(move |c| (c, i)))
            .map(|(c, i)| p[c * w * h + i])
            .collect()
    };
    let ssim = metrics::ssim(&inner(&x), &inner(&t), w, h).unwrap();
    let found = loss::dssim(&x, &t, w, h);
    assert!((found.value - 0.5 * (1.0 - ssim)).abs() < 1e-5, "{} {ssim}", found.value);
    check_gradient(&x, 1e-2, 2e-2, |x| loss::dssim(x, &t, w, h));
    // Too small for one window.
    assert_eq!(loss::dssim(&x[..300], &t[..300], 10, 10), Scored::zero(300));
}
