//! Time for reports. WebAssembly without an operating system has no clock: durations are 0 there.

/// True if the platform has a clock. Without one, limits of time have no effect.
pub const HAS_CLOCK: bool = !cfg!(all(target_family = "wasm", target_os = "unknown"));

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub use std::time::Instant;
#[cfg(all(target_family = "wasm", target_os = "unknown"))]
pub use without_clock::Instant;

#[cfg(all(target_family = "wasm", target_os = "unknown"))]
mod without_clock {
    use std::ops::Sub;
    use std::time::Duration;

    /// Stands in for [`std::time::Instant`], whose `now` panics here.
    #[derive(Clone, Copy, Debug)]
    pub struct Instant;

    impl Instant {
        /// The only instant.
        pub fn now() -> Self {
            Self
        }

        /// No duration.
        pub fn elapsed(self) -> Duration {
            Duration::ZERO
        }
    }

    impl Sub for Instant {
        type Output = Duration;

        fn sub(self, _: Self) -> Duration {
            Duration::ZERO
        }
    }
}
