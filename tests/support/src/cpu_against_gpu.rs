//! Inputs and comparisons for tests of WGSL kernels against their CPU versions.

pub use crate::raster_scene::Random;

/// Largest |got − expected| in units of the largest |expected|; NaN where one is.
pub fn of_largest(got: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(got.len(), expected.len());
    let largest = expected.iter().fold(0f32, |m, v| m.max(v.abs())).max(f32::MIN_POSITIVE);
    let pairs = got.iter().zip(expected);
    let off = pairs.map(|(g, e)| (g - e).abs() / largest);
    off.fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

/// [`of_largest`] is below `allowed`, and is not once one number in the middle is off by
/// twice that.
#[track_caller]
pub fn assert_matches_cpu(name: &str, got: &[f32], expected: &[f32], allowed: f32) {
    let off = of_largest(got, expected);
    if std::env::var_os("SUBSPLAT_SHOW").is_some() {
        eprintln!("{name}: {off:e}");
    }
    assert!(off < allowed, "{name}: {off:e}");
    let largest = expected.iter().fold(0f32, |m, v| m.max(v.abs())).max(f32::MIN_POSITIVE);
    let mut perturbed = got.to_vec();
    let middle = got.len() / 2;
    perturbed[middle] = expected[middle] + 2.0 * allowed * largest;
    assert!(of_largest(&perturbed, expected) > allowed, "{name}: a perturbed side passes");
}
