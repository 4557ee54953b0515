//! Random numbers that are equal on every platform and for any number of threads: SplitMix64 as a
//! counter.
//!
//! A stream is a 64-bit state. [`Rng::fork`] opens an independent stream, so that an additional
//! number in one stream leaves all others unchanged.

use subsplat_kernels::layout::random::{GOLDEN, mix, next};

/// Returns 64 random bits for a position. Jitter and noise use them, because those must not depend
/// on the order of evaluation.
pub(in crate::data) fn hash(seed: u64, x: u64, y: u64) -> u64 {
    let row = mix(seed.wrapping_add(GOLDEN.wrapping_mul(y.wrapping_add(1))));
    mix(row.wrapping_add(GOLDEN.wrapping_mul(x.wrapping_add(1))))
}

/// Returns the upper 24 of `bits` as a number in [0, 1), exact in f32.
pub(in crate::data) fn unit(bits: u64) -> f32 {
    (bits >> 40) as f32 * (1.0 / (1 << 24) as f32)
}

/// Returns two numbers in [0, 1) from one hash.
pub(in crate::data) fn unit_pair(bits: u64) -> (f32, f32) {
    (unit(bits), unit(bits << 24))
}

/// Returns an approximately normal number of mean 0 and variance 1 from the four 16-bit quarters of
/// `bits` (Irwin-Hall of order 4, within ±3.46). It needs no logarithm and therefore has the same
/// digits on every platform.
pub(in crate::data) fn normal(bits: u64) -> f32 {
    let sum = (0..4).map(|i| (bits >> (16 * i)) & 0xFFFF).sum::<u64>();
    // The sum of four quarters with mean 32767.5 and variance (2³² − 1)/12.
    (sum as f32 - 131_070.0) * (1.732_050_8 / 65_536.0)
}

/// A stream of random numbers.
#[derive(Clone, Debug)]
pub(in crate::data) struct Rng {
    state: u64,
}

impl Rng {
    /// Opens the stream of a seed.
    pub(in crate::data) fn new(seed: u64) -> Self {
        Self { state: mix(seed ^ 0x5355_4253_504C_4154) }
    }

    /// Opens an independent stream for `key`; the state of `self` does not change.
    pub(in crate::data) fn fork(&self, key: u64) -> Self {
        Self { state: hash(self.state, key, 0x0F0F) }
    }

    /// Returns 64 random bits.
    pub(in crate::data) fn bits(&mut self) -> u64 {
        next(&mut self.state)
    }

    /// Returns a number in [0, 1).
    pub(in crate::data) fn unit(&mut self) -> f32 {
        unit(self.bits())
    }

    /// Returns a number in [low, high).
    pub(in crate::data) fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Returns a number in [low, high), uniform in the logarithm. Both bounds are positive.
    pub(in crate::data) fn log_range(&mut self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.unit())
    }

    /// Returns one of low, low + 1, …, high with equal probability.
    pub(in crate::data) fn count(&mut self, low: usize, high: usize) -> usize {
        low + (self.bits() >> 32) as usize % (high - low + 1)
    }

    /// Returns true with probability `p`.
    pub(in crate::data) fn chance(&mut self, p: f32) -> bool {
        self.unit() < p
    }

    /// Returns a number of mean 0 and variance 1, within ±3.46.
    pub(in crate::data) fn normal(&mut self) -> f32 {
        normal(self.bits())
    }

    /// Returns −1 or 1.
    pub(in crate::data) fn sign(&mut self) -> f32 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stream_is_splitmix64() {
        // First outputs for state 0 of Vigna's reference C program.
        let mut rng = Rng { state: 0 };
        assert_eq!(rng.bits(), 0xE220_A839_7B1D_CDAF);
        assert_eq!(rng.bits(), 0x6E78_9E6A_A1B9_65F4);
    }

    #[test]
    fn moments() {
        let mut rng = Rng::new(1);
        let n = 100_000;
        let (mut unit, mut mean, mut square) = (0.0f64, 0.0f64, 0.0f64);
        let mut counts = [0; 3];
        for _ in 0..n {
            unit += f64::from(rng.unit());
            let v = f64::from(rng.normal());
            mean += v;
            square += v * v;
            counts[rng.count(2, 4) - 2] += 1;
        }
        let n = f64::from(n);
        assert!((unit / n - 0.5).abs() < 0.005);
        assert!((mean / n).abs() < 0.015 && (square / n - 1.0).abs() < 0.02);
        assert!(counts.iter().all(|c| (f64::from(*c) / n - 1.0 / 3.0).abs() < 0.01));
    }

    #[test]
    fn forks_differ_and_leave_the_parent_alone() {
        let mut a = Rng::new(7);
        let mut b = a.clone();
        let (mut c, mut d) = (a.fork(0), a.fork(1));
        assert_ne!(c.bits(), d.bits());
        assert_eq!(a.bits(), b.bits());
        assert_eq!(unit_pair(u64::MAX), (1.0 - f32::EPSILON / 2.0, 1.0 - f32::EPSILON / 2.0));
    }
}
