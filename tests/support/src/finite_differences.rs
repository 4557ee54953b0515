//! Gradients of losses against finite differences.

use subsplat::finish::loss::Scored;

/// Returns reproducible numbers in [0, 1).
pub fn noise(n: usize, seed: u32) -> Vec<f32> {
    let mut s = seed.wrapping_mul(747_796_405).wrapping_add(1);
    let mut next = || {
        s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (s >> 8) as f32 / (1 << 24) as f32
    };
    (0..n).map(|_| next()).collect()
}

/// Compares the gradient of `f` at `x` with central differences of its value, which is f64.
///
/// # Panics
/// They differ by more than `tolerance` times the largest derivative.
pub fn check_gradient(x: &[f32], h: f32, tolerance: f64, f: impl Fn(&[f32]) -> Scored) {
    let gradient = f(x).gradient;
    let largest = gradient.iter().fold(0f32, |a, g| a.max(g.abs()));
    assert!(largest > 0.0);
    for i in (0..x.len()).step_by(1 + x.len() / 41) {
        let at = |d: f32| {
            let mut x = x.to_vec();
            x[i] += d;
            (f64::from(x[i]), f(&x).value)
        };
        let ((a, low), (b, high)) = (at(-h), at(h));
        let numeric = (high - low) / (b - a);
        let off = (numeric - f64::from(gradient[i])).abs();
        assert!(off < tolerance * f64::from(largest), "[{i}]: {numeric} and {}", gradient[i]);
    }
}
