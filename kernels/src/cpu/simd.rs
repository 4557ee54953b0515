//! SIMD: one source per kernel, compiled for every instruction set and chosen at run time.
//!
//! | item | meaning |
//! |---|---|
//! | [`SimdLevel`] | an instruction set; detects it and runs kernels compiled for it |
//! | [`Vector`] | numbers in lanes: arithmetic, comparison, elementary functions, rows of records |
//! | [`Real`] | `f32` or `f64`: the element of a vector, and a vector of one lane |
//! | [`VectorKernel`] | work on vectors of any element: `f32` on the best level, `f64` one by one |
//! | `Simd` | a level's `f32` vectors with shuffles, masked loads and prefetches |
//! | `Kernel` | work on `Simd`: `f32` only |
//! | [`vectorize`] | plain loops, compiled for the best level |
//! | `elementary` | exp, log, trigonometry and erf of `f32` lanes |
//!
//! A vector of `f32` has 16 lanes at every level, so all levels do the same operations in
//! the same order. Every operation but `approx_sqrt` rounds as IEEE 754 demands. `Avx2`,
//! `Avx512` and `Neon` fuse multiply and add and give the same bits; `Baseline` rounds the
//! product as well and differs in the last bits.
//!
//! Functions and closures that a kernel calls need `#[inline(always)]`. Otherwise the
//! compiler builds them without the level's instructions, which makes them 2 to 5 times
//! slower.
//!
//! Crates that were considered: `fearless_simd` 1.2 has no masked loads, prefetches,
//! exponentials or one-lane f64, and its AVX-512 level needs Ice Lake. `rten-simd` 0.25 has
//! masked loads, prefetches and AVX-512 at run time, but no f64, square root, floor,
//! exponential or shuffle of f32, and its vectors have 4, 8 or 16 lanes, so that the order of
//! a sum, and its bits, would depend on the level.

// Tests compare the vectors of every target with arrays.
#[cfg(any(
    not(any(
        target_arch = "x86_64",
        target_arch = "aarch64",
        all(target_arch = "wasm32", target_feature = "simd128")
    )),
    test
))]
mod array;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
pub(crate) mod elementary;
mod lanes16;
mod level;
#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(any(
    target_arch = "x86_64",
    target_arch = "aarch64",
    all(target_arch = "wasm32", target_feature = "simd128")
))]
mod quad;
mod real;
mod rows;
#[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
mod simd128;
#[cfg(target_arch = "x86_64")]
mod sse2;
#[cfg(test)]
mod tests;
mod vector;

#[cfg(target_arch = "aarch64")]
use neon::BASELINE;
#[cfg(all(target_arch = "wasm32", target_feature = "simd128"))]
use simd128::BASELINE;
#[cfg(target_arch = "x86_64")]
use sse2::BASELINE;

/// The baseline of a target without a module of its own.
#[cfg(not(any(
    target_arch = "x86_64",
    target_arch = "aarch64",
    all(target_arch = "wasm32", target_feature = "simd128")
)))]
const BASELINE: array::Array<false> = array::Array;

pub(crate) use lanes16::{
    APPROX_SQRT_ERROR, F32Vector, IntVector, Simd, all_inside, first_lanes_bits, transpose4x4_index,
};
pub(crate) use level::Kernel;
pub use level::{SimdLevel, UnknownLevel, vectorize};
pub use real::{Real, VectorKernel};
pub use rows::RowLayout;
pub use vector::{Mask, Vector};

/// Lanes of an `f32` vector at every level, and the most lanes of any vector.
pub const LANES: usize = 16;
