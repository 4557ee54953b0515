//! Long calls: they run on a thread of their own while the caller's thread waits, hears Ctrl-C and calls the
//! progress callback.
//!
//! After Ctrl-C the call raises `KeyboardInterrupt` at once; the thread ends at its next report.

use crate::error;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use subsplat::Result;

/// Longest wait between two looks for Ctrl-C.
const WAIT: Duration = Duration::from_millis(50);

/// Receives a stage and the share of the work that is done, 0 to 1.
pub(crate) type Report<'a> = dyn FnMut(&str, f32) -> ControlFlow<()> + 'a;

enum Event<T> {
    Progress(String, f32),
    Done(Result<T>),
}

/// Runs `work`; calls `progress(stage, fraction)`.
///
/// # Errors
/// The error of `work`; the exception of `progress`; `KeyboardInterrupt`.
pub(crate) fn run<T: Send + 'static>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&mut Report<'_>) -> Result<T> + Send + 'static,
) -> PyResult<T> {
    let (send, receive) = channel();
    let cancelled = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&cancelled);
    let worker = move || {
        let mut report = |stage: &str, fraction: f32| {
            // The caller may have left after Ctrl-C.
            let left = send.send(Event::Progress(stage.to_owned(), fraction)).is_err();
            if left || flag.load(Relaxed) {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        };
        let result = work(&mut report);
        // As above.
        let _ = send.send(Event::Done(result));
    };
    std::thread::Builder::new().name("subsplat".to_owned()).spawn(worker)?;
    let receive = Mutex::new(receive);
    loop {
        let event = py.detach(|| next(&receive));
        let heard = match event {
            Ok(Event::Done(result)) => return result.map_err(|e| error::of(&e)),
            Ok(Event::Progress(stage, fraction)) => {
                progress.map_or(Ok(()), |call| call.call1((stage, fraction)).map(drop))
            }
            Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(PyRuntimeError::new_err("the work ended without a result"));
            }
        };
        if let Err(exception) = heard.and_then(|()| py.check_signals()) {
            cancelled.store(true, Relaxed);
            return Err(exception);
        }
    }
}

fn next<T>(receive: &Mutex<Receiver<T>>) -> std::result::Result<T, RecvTimeoutError> {
    receive.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(WAIT)
}
