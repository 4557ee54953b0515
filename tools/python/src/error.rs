//! The library's errors as Python exceptions.
//!
//! | the library | Python |
//! |---|---|
//! | the system refuses a file | `OSError`, `FileNotFoundError`, `PermissionError` |
//! | a file, an argument, a camera or a number is refused | `ValueError` |
//! | the photographs do not determine their cameras | `ValueError` |
//! | cancelled | `KeyboardInterrupt` |
//! | anything else | `RuntimeError` |

use pyo3::PyErr;
use pyo3::exceptions::{
    PyFileNotFoundError, PyKeyboardInterrupt, PyOSError, PyPermissionError, PyRuntimeError,
    PyValueError,
};
use std::io::ErrorKind;
use subsplat::{Error, FileError};

/// Converts an error of a file.
pub(crate) fn of_file(error: &FileError) -> PyErr {
    let text = error.to_string();
    match error {
        FileError::Io { source, .. } => match source.kind() {
            ErrorKind::NotFound => PyFileNotFoundError::new_err(text),
            ErrorKind::PermissionDenied => PyPermissionError::new_err(text),
            _ => PyOSError::new_err(text),
        },
        FileError::Format { .. } => PyValueError::new_err(text),
    }
}

/// Converts an error of the library.
pub(crate) fn of(error: &Error) -> PyErr {
    match error {
        Error::Io(error) => of_file(error),
        Error::Cancelled => PyKeyboardInterrupt::new_err("cancelled"),
        Error::Argument { .. }
        | Error::Camera(_)
        | Error::Splats(_)
        | Error::Config(_)
        | Error::Poses(_)
        | Error::PosePhoto(_)
        | Error::NoPoses { .. } => PyValueError::new_err(error.to_string()),
        _ => PyRuntimeError::new_err(error.to_string()),
    }
}

/// A `ValueError` that names a thing, what was expected and what was found.
pub(crate) fn value(
    what: impl std::fmt::Display,
    expected: impl std::fmt::Display,
    got: impl std::fmt::Display,
) -> PyErr {
    PyValueError::new_err(format!("{what}: expected {expected}, got {got}"))
}
