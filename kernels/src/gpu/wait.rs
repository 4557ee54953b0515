//! Waiting for a device, and error scopes around its commands. Browsers: wait_web.rs.

use crate::gpu::device::single_line;
use crate::gpu::error::GpuError;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

/// Maximum wait for the result of a mapping. Another thread's poll may have completed the mapping
/// and still be delivering its result.
const MAPPING_TIMEOUT: Duration = Duration::from_secs(60);

/// Waits for `future`. Returns the reason where this platform cannot wait.
pub(super) fn block_on<F: Future>(future: F) -> Result<F::Output, String> {
    Ok(pollster::block_on(future))
}

/// Maps `slice` for reading, after all submitted work of `device`. Returns the reason of a
/// failure.
pub(super) fn map(device: &wgpu::Device, slice: &wgpu::BufferSlice) -> Result<(), String> {
    let (sender, receiver) = channel();
    slice.map_async(wgpu::MapMode::Read, move |done| {
        // Sending fails only after this read-back was abandoned.
        sender.send(done).ok();
    });
    device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| e.to_string())?;
    match receiver.recv_timeout(MAPPING_TIMEOUT) {
        Ok(done) => done.map_err(|e| e.to_string()),
        Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
            Err("the device did not complete the mapping".to_owned())
        }
    }
}

/// Waits for all submitted work. Returns the reason of a failure.
pub(super) fn idle(device: &wgpu::Device) -> Result<(), String> {
    device.poll(wgpu::PollType::wait_indefinitely()).map(drop).map_err(|e| e.to_string())
}

/// Error scopes around calls to a device.
pub(super) struct Scopes([wgpu::ErrorScopeGuard; 3]);

impl Scopes {
    pub(super) fn open(device: &wgpu::Device) -> Self {
        use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
        Self([Internal, Validation, OutOfMemory].map(|filter| device.push_error_scope(filter)))
    }

    pub(super) fn close(self, operation: &str) -> Result<(), GpuError> {
        let operation = operation.to_owned();
        let [internal, validation, memory] = self.0;
        // Scopes form a stack: the last one opened is popped first.
        let memory = pollster::block_on(memory.pop());
        let validation = pollster::block_on(validation.pop());
        let internal = pollster::block_on(internal.pop());
        match (memory, validation.or(internal)) {
            (Some(_), _) => Err(GpuError::OutOfMemory { allocation: operation }),
            (None, Some(e)) => Err(GpuError::Refused { operation, reason: single_line(&e) }),
            (None, None) => Ok(()),
        }
    }
}
