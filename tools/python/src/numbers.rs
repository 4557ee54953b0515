//! Numbers of a call, with one clear exception for each misfit.
//!
//! Another type is a `TypeError`, a number out of range a `ValueError`.

use crate::error;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use std::ops::RangeInclusive;

/// Reads a whole number of `range`; `name` is for errors.
///
/// # Errors
/// No whole number; one out of the range.
pub(crate) fn whole(
    name: &str,
    value: &Bound<'_, PyAny>,
    range: RangeInclusive<usize>,
) -> PyResult<usize> {
    let expected = match (*range.start(), *range.end()) {
        (least, usize::MAX) => format!("a whole number of at least {least}"),
        (least, most) => format!("a whole number from {least} to {most}"),
    };
    let got = value.repr()?.to_string();
    match value.extract::<usize>() {
        Ok(number) if range.contains(&number) => Ok(number),
        Err(e) if e.is_instance_of::<PyTypeError>(value.py()) => Err(misfit(name, expected, got)),
        _ => Err(error::value(name, expected, got)),
    }
}

/// Reads an optional whole number of `range`.
///
/// # Errors
/// As [`whole`].
pub(crate) fn optional_whole(
    name: &str,
    value: Option<&Bound<'_, PyAny>>,
    range: RangeInclusive<usize>,
) -> PyResult<Option<usize>> {
    value.map(|value| whole(name, value, range)).transpose()
}

/// Reads a number of f32.
///
/// # Errors
/// No number.
pub(crate) fn real(name: &str, value: &Bound<'_, PyAny>) -> PyResult<f32> {
    value.extract().or_else(|_| Err(misfit(name, "a number", value.repr()?)))
}

/// A `TypeError` that names a thing, what was expected and what was found.
pub(crate) fn misfit(
    what: &str,
    expected: impl std::fmt::Display,
    got: impl std::fmt::Display,
) -> PyErr {
    PyTypeError::new_err(format!("{what}: expected {expected}, got {got}"))
}
