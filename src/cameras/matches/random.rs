//! Seeded random numbers, so that equal matches give equal estimates.

use subsplat_kernels::layout::random;

/// SplitMix64: a state of 64 bits, equal on every machine.
#[derive(Clone, Debug)]
pub(crate) struct SplitMix(pub(crate) u64);

impl SplitMix {
    /// Returns 64 random bits.
    pub(crate) fn next(&mut self) -> u64 {
        random::next(&mut self.0)
    }

    /// Draws N different indices below `count`, which is N or more.
    pub(crate) fn sample<const N: usize>(&mut self, count: usize) -> [usize; N] {
        let mut out = [usize::MAX; N];
        for i in 0..N {
            loop {
                let candidate = (self.next() % count as u64) as usize;
                if !out[..i].contains(&candidate) {
                    out[i] = candidate;
                    break;
                }
            }
        }
        out
    }

    /// Draws a number in [0, 1).
    #[cfg(test)]
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Draws from the standard normal distribution (Box and Muller).
    #[cfg(test)]
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}
