//! The `.ksplat` file (mkkellogg's GaussianSplats3D), version 0.1: reader.
//!
//! A header of 4096 bytes, section headers of 1024, then each section: lengths of its
//! partly filled buckets (u32), bucket centres (3×f32), Gaussians. Level 0 stores f32;
//! level 1 f16, and means as u16 relative to the centre of their bucket; level 2 also
//! SH as bytes over a range in the header. Colour RGBA is always bytes. SH are grouped
//! by degree, channel-major within each; σ is linear, quaternions wxyz.
//! Source: the layout of GaussianSplats3D's SplatBuffer and splat-transform's file.

use super::gaussians::{Decoded, Incoming, array, dc_from_colour, f32_at, truncated, u32_at};
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use half::f16;
use std::path::Path;
use subsplat_kernels::layout::sh_coefficients;

const HEADER: usize = 4096;
const SECTION_HEADER: usize = 1024;
/// Range of level 2's SH where the header leaves it zero.
const SH_RANGE: f32 = 1.5;
/// Half the steps of a quantised mean where a section leaves it zero.
const STEPS: u32 = 32767;

/// Reads a `.ksplat` from memory. `name` is for errors.
///
/// # Errors
/// Another version or compression level, sections that do not fill the bytes, no Gaussian with
/// finite numbers and a rotation.
pub fn parse_ksplat(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    Ok(decode(bytes, name.as_ref())?.splats)
}

/// The bytes of a file, and the fields of its header that concern every section.
struct File<'a> {
    bytes: &'a [u8],
    path: &'a Path,
    level: u16,
    sh_range: [f32; 2],
}

/// A section header with the positions of the section's parts.
struct Section {
    count: usize,
    sh_degree: usize,
    stride: usize,
    /// World units per step of a quantised mean, and the step at the bucket's centre.
    step: f32,
    middle: f32,
    bucket_capacity: usize,
    full_buckets: usize,
    partial_buckets: usize,
    /// Byte offset of the lengths of partly filled buckets.
    lengths: usize,
    /// Byte offset of the bucket centres.
    centres: usize,
    bucket_count: usize,
    bucket_bytes: usize,
    /// Byte offset of the Gaussians.
    data: usize,
    /// Byte offset after the stored Gaussians.
    used: usize,
    /// Byte offset after the section's capacity.
    end: u128,
}

/// The sections of a file that hold Gaussians.
struct Sections {
    all: Vec<Section>,
    /// Valid lengths of the file: without and with the last section's unused capacity.
    lengths: [u128; 2],
}

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded> {
    if bytes.len() < HEADER {
        return Err(truncated(path, HEADER as u64, bytes.len() as u64));
    }
    if bytes[0] != 0 || bytes[1] < 1 {
        let got = format!("{}.{}", bytes[0], bytes[1]);
        return Err(Error::format(path, "ksplat version 0.1 or later 0.x", got));
    }
    let level = u16::from_le_bytes(array(bytes, 20, path)?);
    if level > 2 {
        return Err(Error::format(path, "compression level 0, 1 or 2", level.to_string()));
    }
    let or = |v: f32, default: f32| if v == 0.0 { default } else { v };
    let sh_range =
        [or(f32_at(bytes, 36, path)?, -SH_RANGE), or(f32_at(bytes, 40, path)?, SH_RANGE)];
    let file = File { bytes, path, level, sh_range };
    let Sections { all: sections, lengths } = file.sections()?;
    let count: usize = sections.iter().map(|s| s.count).sum();
    let declared = u32_at(bytes, 16, path)? as usize;
    if count != declared || count == 0 {
        let expected = format!("{declared} Gaussians in the sections, and at least one");
        return Err(Error::format(path, expected, count.to_string()));
    }
    if !lengths.contains(&(bytes.len() as u128)) {
        let [used, end] = lengths;
        let expected = format!("{used} bytes, or {end} with the last section's capacity");
        return Err(Error::format(path, expected, bytes.len().to_string()));
    }
    let sh_degree = sections.iter().map(|s| s.sh_degree).max().unwrap_or(0);
    let mut incoming = Incoming::with_capacity(count, sh_degree);
    for section in &sections {
        file.read(section, &mut incoming)?;
    }
    let splats = incoming.into_splats(path)?;
    let flavour = format!("ksplat {}.{} level {level}", bytes[0], bytes[1]);
    Decoded::new(splats, flavour, Vec::new(), Vec::new(), path)
}

impl File<'_> {
    /// Reads every section header and compares it with the bytes.
    fn sections(&self) -> Result<Sections> {
        let declared = u32_at(self.bytes, 4, self.path)? as usize;
        let start = declared.checked_mul(SECTION_HEADER).and_then(|n| n.checked_add(HEADER));
        let Some(mut at) = start.filter(|s| *s <= self.bytes.len()) else {
            let expected = format!("{declared} section headers of {SECTION_HEADER} bytes");
            return Err(Error::format(self.path, expected, format!("{} bytes", self.bytes.len())));
        };
        let mut sections = Vec::new();
        let mut lengths = [at as u128; 2];
        for i in 0..declared {
            let section = self.section(HEADER + i * SECTION_HEADER, at).map_err(|e| match e {
                Error::Format { .. } => e.at(format!(" section {i}")),
                Error::Io { .. } => e,
            })?;
            at = section.end.min(self.bytes.len() as u128) as usize;
            lengths = [section.used as u128, section.end];
            if section.count > 0 {
                sections.push(section);
            }
        }
        Ok(Sections { all: sections, lengths })
    }

    fn section(&self, header: usize, start: usize) -> Result<Section> {
        let u32_at = |o: usize| u32_at(self.bytes, header + o, self.path);
        let u16_at = |o: usize| -> Result<u16> {
            Ok(u16::from_le_bytes(array(self.bytes, header + o, self.path)?))
        };
        let (count, most) = (u32_at(0)? as usize, u32_at(4)? as usize);
        let (bucket_capacity, bucket_count) = (u32_at(8)? as usize, u32_at(12)? as usize);
        let bucket_bytes = usize::from(u16_at(20)?);
        let steps = match u32_at(24)? {
            0 => STEPS,
            n => n,
        };
        let (full_buckets, partial_buckets) = (u32_at(32)? as usize, u32_at(36)? as usize);
        let sh_degree = usize::from(u16_at(40)?);
        if sh_degree > 3 {
            return Err(Error::format(self.path, "SH degree 0 to 3", sh_degree.to_string()));
        }
        let rests = 3 * (sh_coefficients(sh_degree) - 1);
        let stride = match self.level {
            0 => 44 + 4 * rests,
            1 => 24 + 2 * rests,
            _ => 24 + rests,
        };
        // Each factor is below 2³², so u128 cannot overflow.
        let centres = start as u128 + 4 * partial_buckets as u128;
        let data = centres + bucket_bytes as u128 * bucket_count as u128;
        let end = data + stride as u128 * most as u128;
        let used = data + stride as u128 * count as u128;
        if used > self.bytes.len() as u128 || count > most {
            let expected = format!("{count} (at most {most}) Gaussians up to byte {used}");
            return Err(Error::format(self.path, expected, format!("{} bytes", self.bytes.len())));
        }
        let block = f32_at(self.bytes, header + 16, self.path)?;
        Ok(Section {
            count,
            sh_degree,
            stride,
            step: block / 2.0 / steps as f32,
            middle: steps as f32,
            bucket_capacity,
            full_buckets,
            partial_buckets,
            lengths: start,
            centres: centres as usize,
            bucket_count,
            bucket_bytes,
            data: data as usize,
            used: used as usize,
            end,
        })
    }

    fn read(&self, s: &Section, incoming: &mut Incoming) -> Result<()> {
        let full = s.full_buckets.saturating_mul(s.bucket_capacity);
        // The current partly filled bucket, and the index of the first Gaussian after it.

        let (mut partial, mut until) = (0, full);
        for i in 0..s.count {
            let at = s.data + i * s.stride;
            let centre = if self.level == 0 {
                [0.0; 3]
            } else {
                while i >= until && partial < s.partial_buckets {
                    let length = u32_at(self.bytes, s.lengths + 4 * partial, self.path)?;
                    until = until.saturating_add(length as usize);
                    partial += 1;
                }
                let bucket = if i < full {
                    i / s.bucket_capacity.max(1)
                } else {
                    (s.full_buckets + partial).saturating_sub(1)
                };
                self.centre(s, bucket, i)?
            };
            self.gaussian(s, at, centre, incoming)?;
        }
        Ok(())
    }

    fn centre(&self, s: &Section, bucket: usize, i: usize) -> Result<[f32; 3]> {
        if bucket >= s.bucket_count || s.bucket_bytes < 12 {
            let expected = format!("a bucket centre for Gaussian {i}");
            let got = format!("{} centres of {} bytes", s.bucket_count, s.bucket_bytes);
            return Err(Error::format(self.path, expected, got));
        }
        let at = s.centres + bucket * s.bucket_bytes;
        let mut centre = [0.0; 3];
        for (c, v) in centre.iter_mut().enumerate() {
            *v = f32_at(self.bytes, at + 4 * c, self.path)?;
        }
        Ok(centre)
    }

    fn gaussian(
        &self,
        s: &Section,
        at: usize,
        centre: [f32; 3],
        incoming: &mut Incoming,
    ) -> Result<()> {
        let record = self
            .bytes
            .get(at..at + s.stride)
            .ok_or_else(|| truncated(self.path, (at + s.stride) as u64, self.bytes.len() as u64))?;
        let full = |o: usize| f32::from_le_bytes([0, 1, 2, 3].map(|b| record[o + b]));
        let half = |o: usize| f16::from_le_bytes([record[o], record[o + 1]]).to_f32();
        let step = |o: usize| f32::from(u16::from_le_bytes([record[o], record[o + 1]]));
        let float = |k: usize| if self.level == 0 { full(12 + 4 * k) } else { half(6 + 2 * k) };
        let mean = std::array::from_fn(|c| match self.level {
            0 => full(4 * c),
            _ => (step(2 * c) - s.middle) * s.step + centre[c],
        });
        let scale = std::array::from_fn(&float);
        let quat = std::array::from_fn(|k| float(3 + k));
        let colour = if self.level == 0 { 40 } else { 20 };
        let set = incoming.push(mean, quat, scale, f32::from(record[colour + 3]) / 255.0);
        for (h, b) in set.iter_mut().zip(&record[colour..]).take(3) {
            *h = dc_from_colour(f64::from(*b) / 255.0);
        }
        let first = colour + 4;
        let [low, high] = self.sh_range;
        let sh = |k: usize| match self.level {
            0 => full(first + 4 * k),
            1 => half(first + 2 * k),
            _ => low + f32::from(record[first + k]) / 255.0 * (high - low),
        };
        for l in 1..=s.sh_degree {
            let (before, n) = (l * l - 1, 2 * l + 1);
            for m in 0..n {
                for c in 0..3 {
                    set[3 * (1 + before + m) + c] = sh(3 * before + c * n + m);
                }
            }
        }
        Ok(())
    }
}
