//! Elementary functions without branches, so that plain loops over them vectorise,
//! and the run-time choice of instruction set.

/// Runs `f` compiled for the widest vectors that the processor has. What `f` calls
/// must be inlined into it to profit.
#[inline(always)]
pub fn vectorised<R>(f: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(f)
}

/// eˣ to 2 ulp for |x| ≤ 87.3; 0 below (no denormals leave this function), e⁸⁸
/// above 88; NaN for NaN. Range reduction by ln 2 in two parts and a polynomial of
/// degree 7 (Cephes' coefficients).
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // 1.5·2²³: adding it rounds to an integer that stands in the low mantissa bits.
    const MAGIC: f32 = 12_582_912.0;
    let c = x.clamp(-87.3, 88.0);
    let shifted = c * std::f32::consts::LOG2_E + MAGIC;
    let n = shifted - MAGIC;
    let r = c - n * 0.693_359_4 - n * -2.121_944_4e-4;
    let mut p = 1.987_569_1e-4f32;
    p = p * r + 1.398_199_9e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_6e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 0.5;
    let y = p * r * r + r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(MAGIC.to_bits()).wrapping_add(127) << 23;
    let y = y * f32::from_bits(exponent);
    if x < -87.3 { 0.0 } else { y }
}

/// Error function to 4 ulp: odd rational approximation on |x| ≤ 4 (Eigen's
/// coefficients), ±1 beyond.
#[inline(always)]
pub fn erf(x: f32) -> f32 {
    let x = x.clamp(-4.0, 4.0);
    let s = x * x;
    let mut p = -2.726_142_3e-10f32;
    p = p * s + 2.770_681_4e-8;
    p = p * s - 2.101_024e-6;
    p = p * s - 5.692_506_4e-5;
    p = p * s - 7.349_906_3e-4;
    p = p * s - 2.954_6e-3;
    p = p * s - 1.609_603_4e-2;
    let mut q = -1.456_607_2e-5f32;
    q = q * s - 2.133_740_6e-4;
    q = q * s - 1.682_827e-3;
    q = q * s - 7.373_329e-3;
    q = q * s - 1.426_473_9e-2;
    x * p / q
}

/// Σ aᵢ·bᵢ in 16 running sums.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0f32; 16];
    let (ac, bc) = (a.chunks_exact(16), b.chunks_exact(16));
    let tail: f32 = ac.remainder().iter().zip(bc.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in ac.zip(bc) {
        for i in 0..16 {
            lanes[i] += x[i] * y[i];
        }
    }
    fold(lanes) + tail
}

/// Sum of 16 lanes, pairwise.
#[inline(always)]
fn fold(mut lanes: [f32; 16]) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
    }
    lanes[0]
}

/// Σ f(xᵢ): f32 lanes within blocks of 512, f64 between them, so that sums over a
/// million pixels keep their digits.
#[inline(always)]
pub fn sum_of(x: &[f32], f: impl Fn(f32) -> f32) -> f64 {
    let mut total = 0f64;
    for block in x.chunks(512) {
        let mut lanes = [0f32; 16];
        let chunks = block.chunks_exact(16);
        let tail: f32 = chunks.remainder().iter().map(|&v| f(v)).sum();
        for c in chunks {
            for i in 0..16 {
                lanes[i] += f(c[i]);
            }
        }
        total += f64::from(fold(lanes)) + f64::from(tail);
    }
    total
}

/// Two sums over pairs, Σ f(aᵢ, bᵢ), as [`sum_of`].
#[inline(always)]
pub fn sums_of(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> [f32; 2]) -> [f64; 2] {
    let mut total = [0f64; 2];
    for (a, b) in a.chunks(512).zip(b.chunks(512)) {
        let (mut first, mut second) = ([0f32; 16], [0f32; 16]);
        let (ac, bc) = (a.chunks_exact(16), b.chunks_exact(16));
        for (a, b) in ac.remainder().iter().zip(bc.remainder()) {
            let [p, q] = f(*a, *b);
            total[0] += f64::from(p);
            total[1] += f64::from(q);
        }
        for (a, b) in ac.zip(bc) {
            for i in 0..16 {
                let [p, q] = f(a[i], b[i]);
                first[i] += p;
                second[i] += q;
            }
        }
        total[0] += f64::from(fold(first));
        total[1] += f64::from(fold(second));
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_exact_to_two_ulp() {
        for i in -8730..=8800 {
            let x = i as f32 * 0.01;
            let want = f64::from(x).exp();
            assert!((f64::from(exp(x)) / want - 1.0).abs() < 2.4e-7, "{x}");
        }
        assert_eq!(exp(-100.0), 0.0);
        assert_eq!(exp(0.0), 1.0);
        assert!(exp(f32::NAN).is_nan() && exp(f32::INFINITY).is_finite());
    }

    /// erf by its Taylor series in f64, good to 1e-12 for |x| ≤ 4.
    fn erf_series(x: f64) -> f64 {
        let (mut term, mut sum) = (x, x);
        for n in 1..200 {
            term *= -x * x / n as f64;
            sum += term / (2 * n + 1) as f64;
        }
        sum * 2.0 / std::f64::consts::PI.sqrt()
    }

    #[test]
    fn erf_is_exact_to_four_ulp() {
        for i in -400..=400 {
            let x = i as f32 * 0.01;
            let want = erf_series(f64::from(x));
            let got = f64::from(erf(x));
            assert!((got - want).abs() <= 4.8e-7 * want.abs().max(1e-30), "{x}: {got} {want}");
        }
        assert!((erf(9.0) - 1.0).abs() < 2.4e-7 && erf(f32::NAN).is_nan());
    }

    #[test]
    fn sums_keep_their_digits() {
        let x: Vec<f32> = (0..1_000_003).map(|i| 0.1 + (i % 7) as f32).collect();
        let want: f64 = x.iter().map(|&v| f64::from(v)).sum();
        let got = sum_of(&x, |v| v);
        assert!((got / want - 1.0).abs() < 1e-6, "{got} {want}");
        let y: Vec<f32> = x[..37].iter().map(|v| v * 0.5).collect();
        let want: f32 = x.iter().zip(&y).map(|(a, b)| a * b).sum();
        assert!((dot(&x[..37], &y) / want - 1.0).abs() < 1e-5);
    }
}
