//! Instruction sets: detection, names, and the calls that enter them.

#[cfg(target_arch = "aarch64")]
use super::neon;
use super::{BASELINE, Simd};
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx512};
use std::fmt;
use std::sync::OnceLock;

/// The environment variable that names a level.
const VARIABLE: &str = "SUBSPLAT_SIMD";

/// A value of `SUBSPLAT_SIMD` that names no level of this processor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownLevel(String);

impl UnknownLevel {
    /// Returns the name of the variable.
    pub fn variable(&self) -> &'static str {
        VARIABLE
    }

    /// Lists the values that are accepted.
    pub fn expected(&self) -> String {
        let names: Vec<&str> = SimdLevel::available().iter().map(|level| level.name()).collect();
        format!("a level of this processor ({})", names.join(", "))
    }

    /// Returns the value that was found.
    pub fn found(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for UnknownLevel {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: expected {}, got {}", self.variable(), self.expected(), self.found())
    }
}

impl std::error::Error for UnknownLevel {}

/// An instruction set that kernels are compiled for.
///
/// A new one needs a variant here, an entry in [`SimdLevel::available`], an arm in
/// `SimdLevel::run`, and a module: beside `avx2` one that implements `Simd`, or, for registers
/// of 128 bits, beside `neon` one that implements `quad::InstructionSet`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimdLevel {
    /// The instructions that every processor of the target has: SSE2 on x86-64, NEON on
    /// AArch64, simd128 on WebAssembly built with it, on others what the compiler makes of
    /// arrays. A vector is four registers. Products round separately.
    Baseline,
    /// x86-64-v3: AVX2 and FMA. A vector is two registers.
    Avx2,
    /// x86-64-v4: AVX-512 F, BW, CD, DQ, VL. A vector is one register.
    Avx512,
    /// AArch64, where NEON and fused multiply-add always exist. A vector is four registers.
    Neon,
}

impl SimdLevel {
    /// All levels, supported here or not.
    const ALL: [SimdLevel; 4] =
        [SimdLevel::Baseline, SimdLevel::Avx2, SimdLevel::Avx512, SimdLevel::Neon];

    /// Lists the levels that this processor supports, slowest first.
    pub fn available() -> &'static [SimdLevel] {
        static FOUND: OnceLock<Vec<SimdLevel>> = OnceLock::new();
        FOUND.get_or_init(|| {
            #[allow(unused_mut, reason = "targets other than these two have one level")]
            let mut found = vec![SimdLevel::Baseline];
            #[cfg(target_arch = "x86_64")]
            {
                if avx2::detected() {
                    found.push(SimdLevel::Avx2);
                }
                if avx512::detected() {
                    found.push(SimdLevel::Avx512);
                }
            }
            #[cfg(target_arch = "aarch64")]
            found.push(SimdLevel::Neon);
            found
        })
    }

    /// Returns the fastest level here, or the one that the environment variable
    /// `SUBSPLAT_SIMD` names ([`SimdLevel::requested`]), which is read once.
    pub fn best() -> SimdLevel {
        static BEST: OnceLock<SimdLevel> = OnceLock::new();
        *BEST.get_or_init(|| {
            let requested = Self::requested().ok().flatten();
            requested.or(Self::available().last().copied()).unwrap_or(SimdLevel::Baseline)
        })
    }

    /// Returns the level that the environment variable `SUBSPLAT_SIMD` names (`baseline`, `avx2`,
    /// `avx512`, `neon`), or `None` where the variable is absent or empty.
    ///
    /// # Errors
    /// The variable names no level that this processor supports. [`SimdLevel::best`] is then the
    /// fastest level.
    pub fn requested() -> Result<Option<SimdLevel>, UnknownLevel> {
        match std::env::var_os(VARIABLE) {
            Some(value) if !value.is_empty() => Self::here(&value.to_string_lossy()).map(Some),
            _ => Ok(None),
        }
    }

    /// Finds a level that this processor supports.
    fn here(name: &str) -> Result<SimdLevel, UnknownLevel> {
        let level = Self::named(name).filter(|level| level.is_available());
        level.ok_or_else(|| UnknownLevel(name.to_owned()))
    }

    /// Finds the level that `SUBSPLAT_SIMD` calls `name`.
    pub fn named(name: &str) -> Option<SimdLevel> {
        Self::ALL.into_iter().find(|level| level.name() == name)
    }

    /// Returns the level's name in `SUBSPLAT_SIMD`.
    pub fn name(self) -> &'static str {
        match self {
            SimdLevel::Baseline => "baseline",
            SimdLevel::Avx2 => "avx2",
            SimdLevel::Avx512 => "avx512",
            SimdLevel::Neon => "neon",
        }
    }

    /// Returns whether this processor supports the level.
    pub fn is_available(self) -> bool {
        Self::available().contains(&self)
    }

    /// Runs `kernel` compiled for this level, or for [`SimdLevel::Baseline`] where the
    /// processor lacks it.
    ///
    /// Call it inside a parallel task, not around one: the compiler builds the code of
    /// other threads' tasks without the level's instructions.
    #[inline]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx512 if self.is_available() => {
                // SAFETY: the guard checked the processor's features.
                unsafe { avx512::run(kernel) }
            }
            #[cfg(target_arch = "x86_64")]
            SimdLevel::Avx2 if self.is_available() => {
                // SAFETY: the guard checked the processor's features.
                unsafe { avx2::run(kernel) }
            }
            #[cfg(target_arch = "aarch64")]
            SimdLevel::Neon => kernel.run(neon::FUSED),
            _ => kernel.run(BASELINE),
        }
    }
}

impl Default for SimdLevel {
    fn default() -> Self {
        SimdLevel::best()
    }
}

/// Work that [`SimdLevel::run`] compiles for a level. Mark `run` `#[inline(always)]`.
pub(crate) trait Kernel {
    /// Result of the work.
    type Output;
    /// Does the work with the vectors of `s`.
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

/// Runs `f` compiled for the best level, so that its plain loops use wide vectors.
///
/// Mark the closure, and the functions that it calls, `#[inline(always)]`.
#[inline(always)]
pub fn vectorize<R>(f: impl FnOnce() -> R) -> R {
    struct Closure<F>(F);
    impl<R, F: FnOnce() -> R> Kernel for Closure<F> {
        type Output = R;
        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> R {
            (self.0)()
        }
    }
    SimdLevel::best().run(Closure(f))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_levels_that_do_not_exist_here_are_errors() {
        for &level in SimdLevel::available() {
            assert_eq!(SimdLevel::here(level.name()), Ok(level));
        }
        let elsewhere = SimdLevel::ALL.into_iter().find(|level| !level.is_available());
        for name in
            [Some("axv2"), Some("AVX2"), elsewhere.map(SimdLevel::name)].into_iter().flatten()
        {
            let error = SimdLevel::here(name).unwrap_err().to_string();
            assert!(error.starts_with("SUBSPLAT_SIMD: expected"), "{error}");
            assert!(error.contains("(baseline"), "{error}");
            assert!(error.ends_with(&format!("got {name}")), "{error}");
        }
    }
}
