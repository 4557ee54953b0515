//! Sums of plain slices in 16 lanes, for loops under [`super::simd::vectorize`]. The order of
//! summation depends on lengths only.
//!
//! In all kernels the order of summation depends on tensor sizes only, so any number of threads gives
//! the same bytes. GPU kernels use no float atomics: each pair stores its sums, and a later pass adds them in
//! order. Code outside the vectors may differ in the last bits between kinds of processors, because the
//! functions of glam and of the standard library do. One scene file gave the same pictures with NEON and AVX-512.
//! The Gaussians of `subsplat run examples/room --fit 0` differed by 2e-6 at most.

/// Returns Σ aᵢ·bᵢ from 16 partial sums.
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

/// Adds 16 lanes pairwise.
#[inline(always)]
fn fold(mut lanes: [f32; 16]) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
    }
    lanes[0]
}

/// Returns Σ f(xᵢ) from f32 lanes within blocks of 512 and f64 between blocks, so that sums
/// over a million pixels keep their digits.
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

/// Returns two sums over pairs, Σ f(aᵢ, bᵢ), as [`sum_of`].
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
