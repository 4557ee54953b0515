//! Errors of the GPU. After each of them the caller can use the CPU kernels instead.

use thiserror::Error;

/// An error of a GPU call. The call has no result.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum GpuError {
    /// No adapter matches the requested device.
    #[error("no GPU: expected {requested}, found {found}")]
    NoAdapter {
        /// The requested device, or the size of the requested memory.
        requested: String,
        /// The adapters of this machine.
        found: String,
    },
    /// The adapter opened no device.
    #[error("GPU {adapter}: no device: {reason}")]
    Device {
        /// Name of the adapter.
        adapter: String,
        /// Message of the driver.
        reason: String,
    },
    /// A call exceeds a limit of the device.
    #[error("GPU too small for {resource}: expected at most {limit}, got {needed}")]
    TooSmall {
        /// Resource and unit.
        resource: &'static str,
        /// Required amount.
        needed: u64,
        /// The device's limit.
        limit: u64,
    },
    /// The device has too little free memory.
    #[error("GPU out of memory: {allocation}")]
    OutOfMemory {
        /// The requested device, or the size of the requested memory.
        allocation: String,
    },
    /// The device is lost: it was reset, unplugged or destroyed.
    #[error("GPU lost: {reason}")]
    Lost {
        /// Message of the driver.
        reason: String,
    },
    /// The device rejected a kernel or a command.
    #[error("GPU refused {operation}: {reason}")]
    Refused {
        /// Rejected kernel or command.
        operation: String,
        /// Message of wgpu.
        reason: String,
    },
    /// Arguments have inconsistent lengths or unsupported values.
    #[error("GPU {kernel}: {argument}: expected {expected}, got {got}")]
    Argument {
        /// Kernel or stage.
        kernel: &'static str,
        /// Name of the argument.
        argument: &'static str,
        /// Expected length or value.
        expected: String,
        /// Length or value found.
        got: String,
    },
}

impl GpuError {
    /// Compares the lengths of arguments of `kernel`: name, length found, length expected.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for the first mismatch.
    pub(crate) fn check_lengths<const N: usize>(
        kernel: &'static str,
        lengths: [(&'static str, usize, usize); N],
    ) -> Result<(), Self> {
        match lengths.into_iter().find(|(_, got, expected)| got != expected) {
            None => Ok(()),
            Some((argument, got, expected)) => {
                let (expected, got) = (expected.to_string(), got.to_string());
                Err(Self::Argument { kernel, argument, expected, got })
            }
        }
    }
}
