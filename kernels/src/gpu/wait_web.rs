//! Waiting for a device in a browser, where a thread that blocks receives no answer of WebGPU. Other
//! platforms: wait.rs.
//!
//! The program supplies the wait ([`set_gpu_wait`]), because only a program can import functions of
//! its page. No error scope is opened here: each would cost a wait. The device reports an error to
//! [`super::Gpu`]'s handler before it completes a later mapping, so the next read-back returns it.

use crate::gpu::error::GpuError;
use std::future::poll_fn;
use std::pin::pin;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

/// The program's two functions.
static PROGRAM: OnceLock<Program> = OnceLock::new();

#[derive(Clone, Copy)]
struct Program {
    suspend: fn(),
    resume: fn(),
}

impl Wake for Program {
    fn wake(self: Arc<Self>) {
        (self.resume)();
    }
}

/// Sets how this program waits for a GPU in a browser; only the first call counts. Without it no GPU
/// is found.
///
/// `suspend` returns once `resume` was called since its last return. Meanwhile the browser delivers
/// events, as it does for an import wrapped in `WebAssembly.Suspending` (JavaScript Promise
/// Integration).
pub fn set_gpu_wait(suspend: fn(), resume: fn()) {
    PROGRAM.get_or_init(|| Program { suspend, resume });
}

/// Waits for `future`. Returns the reason where this program cannot wait.
pub(super) fn block_on<F: Future>(future: F) -> Result<F::Output, String> {
    let Some(program) = PROGRAM.get() else {
        return Err("this program cannot wait for a GPU: set_gpu_wait was not called".to_owned());
    };
    let waker = Waker::from(Arc::new(*program));
    let mut context = Context::from_waker(&waker);
    let mut future = pin!(future);
    loop {
        match future.as_mut().poll(&mut context) {
            Poll::Ready(result) => return Ok(result),
            Poll::Pending => (program.suspend)(),
        }
    }
}

/// Result of a mapping, and the waker of its reader.
#[derive(Default)]
struct Mapping {
    result: Option<Result<(), wgpu::BufferAsyncError>>,
    waker: Option<Waker>,
}

/// Maps `slice` for reading, after all submitted work. Returns the reason of a failure.
pub(super) fn map(_: &wgpu::Device, slice: &wgpu::BufferSlice) -> Result<(), String> {
    let mapping = Arc::new(Mutex::new(Mapping::default()));
    let done = mapping.clone();
    slice.map_async(wgpu::MapMode::Read, move |result| {
        let mut mapping = done.lock().unwrap_or_else(PoisonError::into_inner);
        mapping.result = Some(result);
        if let Some(waker) = mapping.waker.take() {
            waker.wake();
        }
    });
    let result = block_on(poll_fn(|context| {
        let mut mapping = mapping.lock().unwrap_or_else(PoisonError::into_inner);
        mapping.waker = Some(context.waker().clone());
        mapping.result.take().map_or(Poll::Pending, Poll::Ready)
    }))?;
    result.map_err(|e| e.to_string())
}

/// Returns at once: a browser waits at the next read-back.
pub(super) fn idle(_: &wgpu::Device) -> Result<(), String> {
    Ok(())
}

/// Stands in for the error scopes of other platforms.
pub(super) struct Scopes;

impl Scopes {
    pub(super) fn open(_: &wgpu::Device) -> Self {
        Self
    }

    pub(super) fn close(self, _: &str) -> Result<(), GpuError> {
        Ok(())
    }
}
