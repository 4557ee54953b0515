//! numpy arrays to slices without a copy, and vectors to arrays without one.
//!
//! An array of another type is a `TypeError`; of another shape, of strides, or with NaN or infinity a
//! `ValueError`.

use crate::error;
use crate::numbers::misfit;
use numpy::ndarray::{ArrayD, IxDyn};
use numpy::{
    Element, IntoPyArray, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArray, PyUntypedArrayMethods, dtype,
};
use pyo3::prelude::*;
use rayon::prelude::*;

/// Numbers that one thread looks at in turn.
const PART: usize = 1 << 15;

/// A borrowed, contiguous array.
pub(crate) struct Array<'py, T: Element = f32> {
    name: &'static str,
    array: PyReadonlyArrayDyn<'py, T>,
}

/// Borrows the array `value`; `name` and `shape`, such as `[N, 3]`, are for errors.
///
/// # Errors
/// No numpy array; another type of numbers; an array with strides.
pub(crate) fn borrow<'py, T: Element>(
    name: &'static str,
    shape: &str,
    value: &Bound<'py, PyAny>,
) -> PyResult<Array<'py, T>> {
    let py = value.py();
    let kind = dtype::<T>(py);
    let Ok(array) = value.cast::<PyUntypedArray>() else {
        let got = value.get_type().fully_qualified_name()?.to_string();
        let hint = if got.starts_with("torch.") { "; tensors: subsplat.torch" } else { "" };
        let expected = format!("a numpy array {shape} of {kind}");
        return Err(misfit(name, expected, format!("{got}{hint}")));
    };
    if !array.dtype().is_equiv_to(&kind) {
        return Err(misfit(name, kind, array.dtype()));
    }
    if !array.is_c_contiguous() {
        let got = format!("strides {:?}", array.strides());
        return Err(error::value(
            name,
            "a contiguous array (numpy.ascontiguousarray makes one)",
            got,
        ));
    }
    let Ok(typed) = value.cast::<PyArrayDyn<T>>() else {
        return Err(misfit(name, kind, "another type"));
    };
    match typed.try_readonly() {
        Ok(array) => Ok(Array { name, array }),
        Err(reason) => Err(error::value(name, "an array that nobody writes to", reason)),
    }
}

impl<'py, T: Element> Array<'py, T> {
    /// Its shape.
    pub(crate) fn shape(&self) -> &[usize] {
        self.array.shape()
    }

    /// Its numbers, row-major.
    ///
    /// # Errors
    /// Numbers that do not lie one after the other, or not aligned.
    pub(crate) fn slice(&self) -> PyResult<&[T]> {
        let refused = |reason| error::value(self.name, "an aligned, contiguous array", reason);
        self.array.as_slice().map_err(refused)
    }

    /// A handle that keeps the array alive.
    pub(crate) fn keep(&self) -> Py<PyAny> {
        self.array.as_any().clone().unbind()
    }

    /// Checks the shape: a number stands for itself, `None` for any.
    ///
    /// # Errors
    /// Another shape than `expected`, such as `[N, 3]`.
    pub(crate) fn expect(&self, expected: &str, dims: &[Option<usize>]) -> PyResult<()> {
        let got = self.shape();
        let fits = got.len() == dims.len()
            && got.iter().zip(dims).all(|(got, dim)| dim.is_none_or(|dim| dim == *got));
        if fits { Ok(()) } else { Err(self.misfit(expected)) }
    }

    /// The error of another shape than `expected`.
    pub(crate) fn misfit(&self, expected: &str) -> PyErr {
        error::value(self.name, format!("shape {expected}"), format!("{:?}", self.shape()))
    }
}

/// Position of the first number of `values` that is NaN or infinite.
pub(crate) fn first_not_finite(values: &[f32]) -> Option<usize> {
    const INFINITE: u32 = 0x7f80_0000;
    let bad = |part: &[f32]| {
        let bits = part.iter().map(|v| v.to_bits() & INFINITE);
        bits.fold(false, |bad, exponent| bad | (exponent == INFINITE))
    };
    if !values.par_chunks(PART).any(bad) {
        return None;
    }
    values.iter().position(|v| !v.is_finite())
}

/// Refuses NaN and infinity in the numbers of `name`, of `row` numbers each.
pub(crate) fn finite(name: &str, values: &[f32], row: usize) -> Result<(), String> {
    match first_not_finite(values) {
        None => Ok(()),
        Some(at) => {
            let (i, value) = (at / row.max(1), values[at]);
            Err(format!("{name}: expected finite numbers, got {value} in entry {i}"))
        }
    }
}

/// Refuses a quaternion of length 0, which is no rotation, and an opacity outside 0 to 1.
pub(crate) fn check_gaussians(quats: &[f32], opacities: &[f32]) -> Result<(), String> {
    let zero = |q: &[f32]| q.iter().map(|v| v * v).sum::<f32>() == 0.0;
    if let Some(i) = quats.par_chunks_exact(4).with_min_len(PART / 4).position_first(zero) {
        return Err(format!("quats: expected a length above 0, got 0 in entry {i}"));
    }
    let outside = |opacity: &f32| !(0.0..=1.0).contains(opacity);
    match opacities.par_iter().with_min_len(PART).position_first(outside) {
        None => Ok(()),
        Some(i) => {
            let got = opacities[i];
            Err(format!("opacities: expected 0 to 1, after the sigmoid, got {got} in entry {i}"))
        }
    }
}

/// Makes an array of `shape` of `values`, which move into it.
///
/// # Errors
/// Another number of values than the shape has.
pub(crate) fn array<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let array = ArrayD::from_shape_vec(IxDyn(shape), values)
        .map_err(|reason| error::value("an output", format!("shape {shape:?}"), reason))?;
    Ok(array.into_pyarray(py))
}
