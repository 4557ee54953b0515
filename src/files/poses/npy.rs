//! NumPy's arrays (.npy) of one or two dimensions, of f32 or f64, little-endian, by rows or by columns.
//!
//! Source: NumPy, `numpy/lib/format.py` (NEP 1). The crates that read .npy parse any Python literal; the headers of
//! these arrays need few lines.

use crate::files::{Error, Result};
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header, bytes. NumPy's own is about 118.
const HEADER_MAX: usize = 4096;

/// An array of numbers.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Array {
    pub rows: usize,
    /// 1 for an array of one dimension.
    pub columns: usize,
    /// Row by row.
    pub numbers: Vec<f64>,
}

impl Array {
    /// For messages.
    pub fn shape(&self) -> String {
        format!("({}, {})", self.rows, self.columns)
    }
}

/// Reads an array; `path` is for messages.
///
/// # Errors
/// No .npy, numbers that are not f32 or f64 (little-endian), another number of dimensions, another length.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Array> {
    let bad = |expected: &str, got: String| Error::format(path, expected, got);
    let Some(rest) = bytes.strip_prefix(MAGIC) else {
        return Err(bad("a NumPy array (.npy)", format!("{} other bytes", bytes.len())));
    };
    // Major and minor version, then the header's length: 2 bytes in version 1, else 4.
    let (length, start) = match *rest {
        [1, _, a, b, ..] => (usize::from(u16::from_le_bytes([a, b])), 4),
        [2 | 3, _, a, b, c, d, ..] => (u32::from_le_bytes([a, b, c, d]) as usize, 6),
        _ => return Err(bad("a NumPy array of version 1, 2 or 3", "another version".to_owned())),
    };
    let header = rest.get(start..).and_then(|rest| rest.get(..length.min(HEADER_MAX)));
    let Some(header) = header.filter(|_| length <= HEADER_MAX) else {
        let expected = format!("a header of at most {HEADER_MAX} bytes, all there");
        return Err(bad(&expected, format!("{length} of {}", rest.len())));
    };
    let header = String::from_utf8_lossy(header);
    let bytes = &rest[start + length..];
    let Some((rows, columns)) = shape(&header) else {
        return Err(bad("an array of one or two dimensions", header.trim_end().to_owned()));
    };
    let (numbers, width): (Vec<f64>, usize) = if header.contains("'<f8'") {
        let number = |b: &[u8]| b.try_into().map_or(f64::NAN, f64::from_le_bytes);
        (bytes.chunks_exact(8).map(number).collect(), 8)
    } else if header.contains("'<f4'") {
        let number = |b: &[u8]| b.try_into().map_or(f64::NAN, |b| f64::from(f32::from_le_bytes(b)));
        (bytes.chunks_exact(4).map(number).collect(), 4)
    } else {
        return Err(bad("numbers `<f8` or `<f4`", header.trim_end().to_owned()));
    };
    let stated = rows.checked_mul(columns).and_then(|count| count.checked_mul(width));
    if stated != Some(bytes.len()) {
        let expected = format!("{rows} rows of {columns} numbers");
        return Err(bad(&expected, format!("{} bytes of numbers", bytes.len())));
    }
    let by_columns = header.contains("'fortran_order': True");
    let numbers = if by_columns {
        (0..rows * columns).map(|i| numbers[i % columns * rows + i / columns]).collect()
    } else {
        numbers
    };
    Ok(Array { rows, columns, numbers })
}

/// Rows and columns of the header's shape `(N, M)` or `(N,)`.
fn shape(header: &str) -> Option<(usize, usize)> {
    let (_, rest) = header.split_once("'shape': (")?;
    let (inside, _) = rest.split_once(')')?;
    let sides: Vec<&str> = inside.split(',').map(str::trim).filter(|s| !s.is_empty()).collect();
    match *sides.as_slice() {
        [rows] => Some((rows.parse().ok()?, 1)),
        [rows, columns] => Some((rows.parse().ok()?, columns.parse().ok()?)),
        _ => None,
    }
}
