//! Elements of a strided view, in order.

use super::super::{Error, Result};
use super::source::Source;
use super::value::TensorRef;
use std::path::Path;

/// What an expanded tensor (stride 0) may take beyond its storage, bytes.
const MAX_EXPANDED: u64 = 64 << 20;

/// Least bytes that a gather reads of the file at a time.
const WINDOW: u64 = 16 << 20;

/// Contiguous, little-endian elements of `t`.
pub(super) fn read(source: &Source, path: &Path, t: &TensorRef) -> Result<Vec<u8>> {
    let size = t.dtype.size();
    let count = t.shape.iter().try_fold(size, |n, s| n.checked_mul(*s));
    let limit = t.storage.bytes.saturating_add(MAX_EXPANDED);
    let Some(total) = count.filter(|n| *n as u64 <= limit) else {
        let expected = format!("a tensor of at most {limit} bytes, 64 MiB over its storage's");
        return Err(Error::format(path, expected, format!("shape {:?}, expanded", t.shape)));
    };
    if total == 0 {
        return Ok(Vec::new());
    }
    let (outer, run) = runs(t);
    // Bytes from the first element to behind the last.
    let span = outer.iter().map(|(s, stride)| (s - 1) * stride).sum::<usize>() + run;
    let start = t.storage.at + (t.offset * size) as u64;
    if start.checked_add(span as u64).is_none_or(|end| end > t.storage.at + t.storage.bytes) {
        let got = format!("shape {:?}, strides {:?}, offset {}", t.shape, t.strides, t.offset);
        return Err(Error::format(path, "a tensor inside its storage", got));
    }
    if outer.is_empty() {
        let bytes = source.bytes(start, total as u64, path)?;
        return checked(bytes, path, t);
    }
    let window = (span as u64).min(WINDOW.max(4 * total as u64));
    let mut gather = Gather { source, path, end: start + span as u64, window, at: 0, held: vec![] };
    let mut out = Vec::with_capacity(total);
    let mut index = vec![0; outer.len()];
    let mut at = start;
    loop {
        out.extend_from_slice(gather.bytes(at, run)?);
        let mut dimension = outer.len();
        loop {
            let Some(d) = dimension.checked_sub(1) else { return Ok(out) };
            dimension = d;
            let (Some(i), Some((s, stride))) = (index.get_mut(d), outer.get(d)) else {
                return Ok(out);
            };
            *i += 1;
            at += *stride as u64;
            if *i < *s {
                break;
            }
            at -= (*s * *stride) as u64;
            *i = 0;
        }
    }
}

/// The outer dimensions, (size, stride in bytes), and the bytes of the innermost run that
/// lies in one piece.
fn runs(t: &TensorRef) -> (Vec<(usize, usize)>, usize) {
    let size = t.dtype.size();
    let mut run = size;
    let mut outer = Vec::new();
    for (s, stride) in t.shape.iter().zip(&t.strides).rev() {
        match stride * size {
            // A dimension of one element has a stride of no meaning.
            _ if *s == 1 => {}
            stride if outer.is_empty() && stride == run => run *= s,
            stride => outer.push((*s, stride)),
        }
    }
    outer.reverse();
    (outer, run)
}

/// A whole storage must have the archive's checksum. PyTorch writes 0 where it was told
/// to compute none.
fn checked(bytes: Vec<u8>, path: &Path, t: &TensorRef) -> Result<Vec<u8>> {
    if let Some(crc) = t.storage.crc.filter(|c| *c != 0)
        && bytes.len() as u64 == t.storage.bytes
    {
        let mut sum = flate2::Crc::new();
        sum.update(&bytes);
        if sum.sum() != crc {
            let expected = format!("CRC-32 {crc:08x} of storage `{}`", t.storage.key);
            let got = format!("{:08x} (a damaged file)", sum.sum());
            return Err(Error::format(path, expected, got));
        }
    }
    Ok(bytes)
}

/// A window of the file that moves to where bytes are asked for.
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
