//! Reads the elements of a strided view in order.

use super::source::Source;
use super::value::{TensorRef, extent};
use crate::files::{Error, Result};
use std::path::Path;

/// Largest size of an expanded tensor (stride 0) beyond its storage, bytes.
const MAX_EXPANDED: u64 = 64 << 20;

/// Largest span of a view that is read in one piece, bytes; a view of up to four times its
/// elements is too.
const WINDOW: u64 = 16 << 20;

/// Bytes per read of a larger span. The cost of reads in any order stays proportional to the
/// number of elements.
const PAGE: u64 = 4 << 10;

/// Reads the elements of `t`, contiguous and little-endian.
pub(super) fn read(source: &Source, path: &Path, t: &TensorRef) -> Result<Vec<u8>> {
    let size = t.dtype.size();
    if t.shape.contains(&0) {
        return Ok(Vec::new());
    }
    let inside = extent(t.dtype, &t.shape, &t.strides, t.offset).filter(|e| *e <= t.storage.bytes);
    let Some(end) = inside else {
        let got = format!("shape {:?}, strides {:?}, offset {}", t.shape, t.strides, t.offset);
        return Err(Error::format(path, "a tensor inside its storage", got));
    };
    // No overflow: `extent` has computed the same products.
    let total = size * t.shape.iter().product::<usize>();
    let limit = t.storage.bytes.saturating_add(MAX_EXPANDED);
    if total as u64 > limit {
        let expected = format!("a tensor of at most {limit} bytes, 64 MiB over its storage's");
        return Err(Error::format(path, expected, format!("shape {:?}, expanded", t.shape)));
    }
    let (outer, run) = runs(t);
    let start = t.storage.at + (t.offset * size) as u64;
    let end = t.storage.at + end;
    if outer.is_empty() {
        return source.bytes(start, total as u64, path);
    }
    let span = end - start;
    let whole = span <= WINDOW.max(4 * total as u64);
    let window = if whole { span } else { PAGE };
    let mut gather = Gather { source, path, end, window, at: 0, held: Vec::new() };
    let mut out = Vec::with_capacity(total);
    let mut index = vec![0; outer.len()];
    let mut at = start;
    loop {
        out.extend_from_slice(gather.bytes(at, run)?);
        let mut dimension = outer.len();
        loop {
            let Some(d) = dimension.checked_sub(1) else { return Ok(out) };
            dimension = d;
            let (Some(i), Some(dimension)) = (index.get_mut(d), outer.get(d)) else {
                return Ok(out);
            };
            let Dimension { size, stride_bytes } = *dimension;
            *i += 1;
            at += stride_bytes as u64;
            if *i < size {
                break;
            }
            at -= (size * stride_bytes) as u64;
            *i = 0;
        }
    }
}

/// An outer dimension of a view.
struct Dimension {
    size: usize,
    stride_bytes: usize,
}

/// Splits a view into its outer dimensions and the bytes of the innermost contiguous run.
fn runs(t: &TensorRef) -> (Vec<Dimension>, usize) {
    let size = t.dtype.size();
    let mut run = size;
    let mut outer = Vec::new();
    for (s, stride) in t.shape.iter().zip(&t.strides).rev() {
        // The stride of a dimension of one element is arbitrary.
        if *s == 1 {
            continue;
        }
        match stride * size {
            stride if outer.is_empty() && stride == run => run *= s,
            stride_bytes => outer.push(Dimension { size: *s, stride_bytes }),
        }
    }
    outer.reverse();
    (outer, run)
}

/// A window of the file that moves to the requested bytes.
struct Gather<'a> {
    source: &'a Source,
    path: &'a Path,
    end: u64,
    window: u64,
    at: u64,
    held: Vec<u8>,
}

impl Gather<'_> {
    fn bytes(&mut self, at: u64, length: usize) -> Result<&[u8]> {
        let held = |g: &Self| {
            let from = usize::try_from(at.checked_sub(g.at)?).ok()?;
            let to = from.checked_add(length)?;
            (to <= g.held.len()).then_some(from..to)
        };
        if held(self).is_none() {
            let size = self.window.max(length as u64).min(self.end.saturating_sub(at));
            self.held = self.source.bytes(at, size, self.path)?;
            self.at = at;
        }
        let range = held(self).unwrap_or(0..0);
        Ok(self.held.get(range).unwrap_or_default())
    }
}
