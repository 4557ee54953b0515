//! SplitMix64's arithmetic, from which all seeded random numbers derive: equal on every machine.
//!
//! Source: Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
//! WGSL: `kernels/wgsl/shared/wide.wgsl`.

/// Increment of SplitMix64's state: 2⁶⁴ over the golden ratio, odd.
pub const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// Applies SplitMix64's finaliser: every bit of `z` affects every bit of the result.
#[inline]
pub fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Returns SplitMix64's next number and advances its `state`.
#[inline]
pub fn next(state: &mut u64) -> u64 {
    *state = state.wrapping_add(GOLDEN);
    mix(*state)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_the_reference() {
        // First numbers of seed 1234567 by Vigna's splitmix64.c.
        let mut state = 1_234_567;
        let numbers = [(); 3].map(|()| next(&mut state));
        let expected =
            [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423];
        assert_eq!(numbers, expected);
    }
}
