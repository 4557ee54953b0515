//! What can go wrong on a GPU, each case one that a caller can act upon: all of them
//! leave the CPU kernels to fall back on.

use thiserror::Error;

/// Why work was not done on a GPU.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum GpuError {
    /// No adapter answers to what was asked for.
    #[error("no GPU: expected {asked}, found {found}")]
    NoAdapter {
        /// What was asked for.
        asked: String,
        /// What there is.
        found: String,
    },
    /// The adapter gave no device.
    #[error("GPU {adapter}: no device: {reason}")]
    Device {
        /// The adapter's own name.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// Something is larger than the device takes.
    #[error("GPU too small for {what}: expected at most {limit}, got {needed}")]
    TooSmall {
        /// What, with its unit.
        what: &'static str,
        /// How much.
        needed: u64,
        /// The device's limit.
        limit: u64,
    },
    /// The device's memory is full.
    #[error("GPU out of memory: {what}")]
    OutOfMemory {
        /// What was asked for.
        what: String,
    },
    /// The device went away: a reset, an unplugged or a destroyed device.
    #[error("GPU lost: {reason}")]
    Lost {
        /// What the driver said.
        reason: String,
    },
    /// The device refused a kernel or a command.
    #[error("GPU refused {what}: {reason}")]
    Refused {
        /// Kernel or command.
        what: String,
        /// What wgpu said.
        reason: String,
    },
    /// Arguments that do not fit one another.
    #[error("GPU {kernel}: {what}: expected {expected}, got {got}")]
    Argument {
        /// Kernel or stage.
        kernel: &'static str,
        /// Argument.
        what: &'static str,
        /// What would fit.
        expected: String,
        /// What came.
        got: String,
    },
}

impl GpuError {
    /// Whether arguments of `kernel` fit one another: each with what came and what would fit.
    ///
    /// # Errors
    /// [`GpuError::Argument`] of the first that does not.
    pub(crate) fn unless_fitting<const N: usize>(
        kernel: &'static str,
        lengths: [(&'static str, usize, usize); N],
    ) -> Result<(), Self> {
        match lengths.into_iter().find(|(_, got, expected)| got != expected) {
            None => Ok(()),
            Some((what, got, expected)) => {
                let (expected, got) = (expected.to_string(), got.to_string());
                Err(Self::Argument { kernel, what, expected, got })
            }
        }
    }
}
