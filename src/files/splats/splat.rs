//! The `.splat` file (antimatter15): 32 bytes per Gaussian, without a header.
//!
//! Bytes 0–11 mean, 12–23 σ (not logarithms), both f32 little-endian; 24–27 RGBA, the
//! colour of SH degree 0 and the opacity after the sigmoid, 0 to 255; 28–31 quaternion
//! wxyz as (byte − 128) / 128. No view dependence. The writer sorts by volume times
//! opacity, largest first, so that a viewer can show a prefix while it loads. A file cut at
//! the end of a record is indistinguishable from a shorter one.

use super::gaussians::{Decoded, Incoming, Outgoing, array, dc_from_colour, f32_at};
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use std::io::Write;
use std::path::Path;
use subsplat_kernels::sh::C0;

/// Bytes per Gaussian.
const RECORD: usize = 32;
/// Records per write.
const BLOCK: usize = 4096;

/// Reads a `.splat` from memory. `name` is for errors.
///
/// # Errors
/// Not a positive multiple of 32 bytes; a negative scale, which gives most files of another
/// format away; no Gaussian with finite numbers and a rotation.
pub fn parse_splat(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    Ok(decode(bytes, name.as_ref())?.splats)
}

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded> {
    if bytes.is_empty() || !bytes.len().is_multiple_of(RECORD) {
        let got = format!("{} bytes", bytes.len());
        return Err(Error::format(path, "records of 32 bytes (.splat)", got));
    }
    let mut incoming = Incoming::with_capacity(bytes.len() / RECORD, 0);
    for (i, record) in bytes.chunks_exact(RECORD).enumerate() {
        let mut floats = [0.0; 6];
        for (j, v) in floats.iter_mut().enumerate() {
            *v = f32_at(record, 4 * j, path)?;
        }
        let [x, y, z, a, b, c] = floats;
        if [a, b, c].iter().any(|s| *s < 0.0) {
            let got = format!("{a} {b} {c}: is this a .splat file?");
            return Err(Error::format(path, "scales of 0 or more", got).at(format!(" splat {i}")));
        }
        let [red, green, blue, alpha] = array::<4>(record, 24, path)?;
        // Bytes of zero alone are a record that was never written; as a rotation they are
        // (−1, −1, −1, −1).
        let quat = if record.iter().all(|b| *b == 0) {
            [0.0; 4]
        } else {
            array::<4>(record, 28, path)?.map(|b| (f32::from(b) - 128.0) / 128.0)
        };
        let sh = incoming.push([x, y, z], quat, [a, b, c], f32::from(alpha) / 255.0);
        for (h, byte) in sh.iter_mut().zip([red, green, blue]) {
            *h = dc_from_colour(f64::from(byte) / 255.0);
        }
    }
    let splats = incoming.into_splats(path)?;
    Decoded::new(splats, "splat".to_owned(), Vec::new(), Vec::new(), path)
}

/// Writes every Gaussian, sorted by volume times opacity.
pub(super) fn write(file: &mut dyn Write, out: &Outgoing) -> std::io::Result<()> {
    let mut visitor = out.visitor();
    let mut order = Vec::with_capacity(out.count);
    for i in out.kept() {
        let g = visitor.at(i)?;
        let volume: f64 = g.scale.iter().map(|s| f64::from(*s)).product();
        order.push((volume * f64::from(g.opacity), i));
    }
    // A stable sort: equal keys keep the order of the splats.
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut block = Vec::with_capacity(BLOCK * RECORD);
    for (n, &(_, i)) in order.iter().enumerate() {
        let g = visitor.at(i)?;
        for v in g.mean.iter().chain(&g.scale) {
            block.extend_from_slice(&v.to_le_bytes());
        }
        block.extend([0, 1, 2].map(|c| unit_byte(0.5 + C0 * f64::from(g.sh[c]))));
        block.push(unit_byte(f64::from(g.opacity)));
        block.extend(quat_bytes(g.quat));
        if n % BLOCK == BLOCK - 1 {
            file.write_all(&block)?;
            block.clear();
        }
    }
    file.write_all(&block)
}

/// Rounds [0, 1] to 0..=255, clamped.
pub(super) fn unit_byte(v: f64) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Encodes a quaternion. The code reaches −1 but not +1: of q and −q, the one whose largest
/// component is negative keeps length 1, and viewers do not normalise.
fn quat_bytes(q: [f32; 4]) -> [u8; 4] {
    let largest = q.into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0);
    let sign = if largest > 0.0 { -1.0 } else { 1.0 };
    q.map(|v| (sign * v * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8)
}
