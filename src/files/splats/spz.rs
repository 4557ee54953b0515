//! Niantic's `.spz`: about 20 bytes per Gaussian at degree 0 and 64 at degree 3, packed by
//! attribute and compressed. Reads versions 1 to 4, writes version 3 or 4.
//!
//! Header, little-endian: magic `NGSP`, version u32, count u32, SH degree u8,
//! fractional bits u8, flags u8, one byte (4: number of streams). Then, for all
//! Gaussians, mean 3×24-bit fixed point (1: 3×f16), opacity u8, RGB of degree 0 u8 as
//! 0.15·h + ½, ln σ u8 as 16·(ln σ + 10), rotation (1, 2: x y z as u8, w ≥ 0; 3, 4: the
//! three smallest of xyzw, 9 bits and a sign each, under 2 bits of index), SH u8 as
//! 128·h + 128, RGB innermost (|h| beyond 1 is clamped).
//!
//! Versions 1 to 3 are one gzip stream; the uncompressed form is read too. Version 4 has a
//! 32-byte header with the offset of a table of (compressed, uncompressed) u64 pairs, one
//! zstd stream for each attribute. Bit 1 of the flags announces extension records, after
//! the Gaussians (1 to 3) or between header and table (4). The reader skips them. It checks
//! every checksum, and that nothing follows the data. Version 3 is the default of the writer: more
//! viewers read it, and `ruzstd` compresses less than gzip does.
//!
//! Axes: x right, y up, z back; half a turn about x from ours.
//! Source: the README and extensions/README of nianticlabs/spz, splat-transform's files.

use super::gaussians::{
    Decoded, HALF_TURN_X, Incoming, Outgoing, Similarity, transform, truncated, u32_at,
};
use super::gzip;
use super::splat::unit_byte;
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use flate2::bufread::GzDecoder;
use glam::DVec3;
use half::f16;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use serde::{Deserialize, Serialize};
use std::io::{Read, Write};
use std::ops::Range;
use std::path::Path;
use subsplat_kernels::layout::sh_coefficients;

/// `NGSP`.
pub(super) const MAGIC: [u8; 4] = *b"NGSP";
const HEADER: usize = 16;
const HEADER_V4: usize = 32;
/// Gaussians whose numbers of an attribute are compressed by one thread: 64 to 600 KB.
const RUN: usize = 1 << 16;
/// Largest number of Gaussians that a file may declare (the limit of the reference reader).
const COUNT_MAX: u32 = 10_000_000;
/// Inflated size that is always accepted, and the largest ratio of compression beyond it.
/// Real scenes shrink 2 to 20 times.
const INFLATED_FREE: u64 = 64 << 20;
const RATIO_MAX: u64 = 256;
/// Bit of the flags that announces extension records.
const FLAG_EXTENSIONS: u8 = 2;
/// Scale of the colour byte.
const COLOUR_SCALE: f64 = 0.15;
/// Largest fixed-point coordinate: 24 bits with sign.
pub(super) const FIXED_MAX: f64 = 8_388_607.0;
/// Largest number of fractional bits that is written.
const FRACTION_MAX: i32 = 20;

/// Version of a written file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpzVersion {
    /// One gzip stream.
    #[default]
    V3,
    /// One zstd stream for each attribute.
    V4,
}

/// Reads a `.spz` from memory. `name` is for errors.
///
/// # Errors
/// Another magic or version, a truncated file, a wrong checksum, streams that do not inflate
/// to the size that the count gives, bytes after the end, a decompression bomb, no Gaussian with
/// finite numbers and a rotation.
pub fn parse_spz(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    Ok(decode(bytes, name.as_ref())?.splats)
}

struct Header {
    version: u32,
    count: usize,
    sh_degree: usize,
    fraction_bits: u32,
    /// Extension records follow (versions 1 to 3: the Gaussians; 4: the header).
    has_extensions: bool,
    streams: usize,
}

impl Header {
    fn parse(b: &[u8], path: &Path) -> Result<Self> {
        if b.len() < HEADER {
            return Err(truncated(path, HEADER as u64, b.len() as u64));
        }
        if b.starts_with(b"ply\n") || b.starts_with(b"ply\r") {
            let got = "a .ply compressed by gzip: unpack it first (gunzip)";
            return Err(Error::format(path, "a .ply that is not compressed", got));
        }
        if b[..4] != MAGIC {
            return Err(Error::format(path, "the magic NGSP (.spz)", format!("{:02x?}", &b[..4])));
        }
        let (version, count) = (u32_at(b, 4, path)?, u32_at(b, 8, path)?);
        let at = |what: &str| format!(" header, {what}");
        if !(1..=4).contains(&version) {
            let got = version.to_string();
            return Err(Error::format(path, "spz version 1 to 4", got).at(at("version")));
        }
        if count > COUNT_MAX {
            let got = count.to_string();
            let expected = format!("at most {COUNT_MAX} Gaussians");
            return Err(Error::format(path, expected, got).at(at("count")));
        }
        if b[12] > 4 {
            return Err(Error::format(path, "SH degree 0 to 4", b[12].to_string()).at(at("degree")));
        }
        if b[13] > 24 {
            let got = b[13].to_string();
            return Err(Error::format(path, "0 to 24 fractional bits", got).at(at("fraction")));
        }
        Ok(Self {
            version,
            count: count as usize,
            sh_degree: usize::from(b[12]),
            fraction_bits: u32::from(b[13]),
            has_extensions: b[14] & FLAG_EXTENSIONS != 0,
            streams: usize::from(b[15]),
        })
    }

    /// Bytes of positions, opacities, colours, scales, rotations, SH.
    fn sizes(&self) -> [usize; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version >= 3 { 4 } else { 3 };
        let sh = 3 * (sh_coefficients(self.sh_degree) - 1);
        [position, 1, 3, 3, rotation, sh].map(|n| n * self.count)
    }
}

/// Attributes in the order of [`Header::sizes`].
type Columns = [Vec<u8>; 6];

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded> {
    let (mut splats, version) = decode_as_stored(bytes, path)?;
    let by = Similarity { scale: 1.0, rotation: HALF_TURN_X, translation: DVec3::ZERO };
    transform(&mut splats, &by);
    Decoded::new(splats, format!("spz {version}"), Vec::new(), Vec::new(), path)
}

/// Reads the Gaussians in the file's axes, and its version.
pub(super) fn decode_as_stored(bytes: &[u8], path: &Path) -> Result<(Splats, u32)> {
    let (header, columns) = if bytes.starts_with(&[0x1f, 0x8b]) {
        inflate_gzip(bytes, path)?
    } else {
        let header = Header::parse(bytes, path)?;
        let columns = if header.version == 4 {
            inflate_streams(bytes, &header, path)?
        } else {
            let needed = HEADER + header.sizes().iter().sum::<usize>();
            let Some(mut rest) = bytes.get(needed..) else {
                return Err(truncated(path, needed as u64, bytes.len() as u64));
            };
            read_end(&mut rest, &header, bytes.len() as u64, path)?;
            split(&bytes[HEADER..needed], &header)
        };
        (header, columns)
    };
    Ok((gaussians(&header, &columns).into_splats(path)?, header.version))
}

/// Reads what follows the Gaussians of versions 1 to 3 to its end, at most `limit` bytes:
/// nothing, or the extension records that the header announces.
fn read_end(rest: &mut dyn Read, header: &Header, limit: u64, path: &Path) -> Result<()> {
    let wrong = |e| unreadable(path, &e);
    if header.has_extensions {
        return skip_extensions(rest, limit, path);
    }
    let mut byte = [0];
    if rest.read(&mut byte).map_err(wrong)? > 0 {
        let expected = format!("the end of the data after {} Gaussians", header.count);
        return Err(Error::format(path, expected, "more bytes"));
    }
    Ok(())
}

/// Reads extension records (u32 type, u32 length, payload) up to the end of `rest`, at
/// most `limit` bytes. No type is interpreted.
fn skip_extensions(rest: &mut dyn Read, limit: u64, path: &Path) -> Result<()> {
    let wrong = |e| unreadable(path, &e);
    let short = |wanted: u64, got: u64| {
        let expected = format!("{wanted} bytes of an extension record");
        Err(Error::format(path, expected, got.to_string()))
    };
    let mut left = limit;
    loop {
        let mut head = Vec::new();
        Read::take(&mut *rest, 8).read_to_end(&mut head).map_err(wrong)?;
        let &[_, _, _, _, a, b, c, d] = head.as_slice() else {
            return if head.is_empty() { Ok(()) } else { short(8, head.len() as u64) };
        };
        let length = u64::from(u32::from_le_bytes([a, b, c, d]));
        left = left.checked_sub(8 + length).ok_or_else(|| {
            let expected = format!("extension records of at most {limit} bytes");
            Error::format(path, expected, format!("{length} bytes or more"))
        })?;
        let payload = &mut Read::take(&mut *rest, length);
        let got = std::io::copy(payload, &mut std::io::sink()).map_err(wrong)?;
        if got < length {
            return short(length, got);
        }
    }
}

fn unreadable(path: &Path, e: &std::io::Error) -> Error {
    Error::format(path, "a whole gzip stream (.spz)", e.to_string())
}

fn split(mut body: &[u8], header: &Header) -> Columns {
    header.sizes().map(|n| {
        let (column, rest) = body.split_at(n.min(body.len()));
        body = rest;
        column.to_vec()
    })
}

/// Refuses a decompression bomb by its declared size, before any byte is inflated.
fn check_ratio(inflated: u64, compressed: u64, path: &Path) -> Result<()> {
    if inflated > INFLATED_FREE.max(RATIO_MAX.saturating_mul(compressed)) {
        let expected = format!("{inflated} bytes, as the count demands");
        let got = format!("{compressed} compressed ones, a decompression bomb");
        return Err(Error::format(path, expected, got));
    }
    Ok(())
}

fn inflate_gzip(bytes: &[u8], path: &Path) -> Result<(Header, Columns)> {
    let wrong = |e| unreadable(path, &e);
    let mut decoder = GzDecoder::new(bytes);
    let mut head = Vec::new();
    Read::take(&mut decoder, HEADER as u64).read_to_end(&mut head).map_err(wrong)?;
    let header = Header::parse(&head, path)?;
    if header.version == 4 {
        return Err(Error::format(path, "version 1 to 3 inside gzip", "version 4"));
    }
    let needed = header.sizes().iter().sum::<usize>();
    check_ratio(needed as u64, bytes.len() as u64, path)?;
    let mut body = Vec::new();
    Read::take(&mut decoder, needed as u64).read_to_end(&mut body).map_err(wrong)?;
    if body.len() < needed {
        return Err(truncated(path, (HEADER + needed) as u64, (HEADER + body.len()) as u64));
    }
    // The read that meets the end of the stream compares CRC-32 and length.
    let limit = INFLATED_FREE.max(RATIO_MAX.saturating_mul(bytes.len() as u64));
    read_end(&mut decoder, &header, limit, path)?;
    let after = decoder.into_inner().len();
    if after > 0 {
        let expected = "the end of the file after the gzip stream";
        return Err(Error::format(path, expected, format!("{after} more bytes")));
    }
    let columns = split(&body, &header);
    Ok((header, columns))
}

fn inflate_streams(bytes: &[u8], header: &Header, path: &Path) -> Result<Columns> {
    let length = bytes.len() as u64;
    if length < HEADER_V4 as u64 {
        return Err(truncated(path, HEADER_V4 as u64, length));
    }
    let sizes = header.sizes();
    let expected = if header.sh_degree == 0 { 5 } else { 6 };
    if header.streams != expected {
        let got = header.streams.to_string();
        return Err(Error::format(path, format!("{expected} streams (spz 4)"), got));
    }
    let table = u64::from(u32_at(bytes, HEADER, path)?);
    let mut at = table + 16 * header.streams as u64;
    if table < HEADER_V4 as u64 || at > length {
        let wanted = format!("a stream table within {length} bytes");
        return Err(Error::format(path, wanted, format!("one at byte {table}")));
    }
    let mut extensions = &bytes[HEADER_V4..table as usize];
    if header.has_extensions {
        skip_extensions(&mut extensions, length, path)?;
    } else if !extensions.is_empty() {
        let wanted = format!("the stream table at byte {HEADER_V4}, without extensions");
        return Err(Error::format(path, wanted, format!("one at byte {table}")));
    }
    let mut columns = Columns::default();
    for (i, (column, size)) in columns.iter_mut().zip(sizes).take(expected).enumerate() {
        let entry = (table as usize) + 16 * i;
        let compressed = u64_at(bytes, entry, path)?;
        let inflated = u64_at(bytes, entry + 8, path)?;
        let place = format!(" stream {i}");
        if inflated != size as u64 {
            let wanted = format!("{size} bytes, as the count demands");
            return Err(Error::format(path, wanted, inflated.to_string()).at(place));
        }
        if compressed > length - at {
            let wanted = format!("{compressed} bytes at byte {at}");
            return Err(Error::format(path, wanted, format!("{}", length - at)).at(place));
        }
        check_ratio(inflated, compressed, path)?;
        let stream = &bytes[at as usize..(at + compressed) as usize];
        *column = zstd(stream, size).map_err(|got| {
            Error::format(path, format!("a zstd stream of {size} bytes"), got).at(place)
        })?;
        at += compressed;
    }
    if at < length {
        let expected = "the end of the file after the last stream";
        return Err(Error::format(path, expected, format!("{} more bytes", length - at)));
    }
    Ok(columns)
}

fn u64_at(bytes: &[u8], at: usize, path: &Path) -> Result<u64> {
    Ok(u64::from_le_bytes(super::gaussians::array(bytes, at, path)?))
}

/// Inflates one zstd frame that fills `stream` and holds exactly `size` bytes; compares its
/// checksum, where it has one.
fn zstd(stream: &[u8], size: usize) -> std::result::Result<Vec<u8>, String> {
    let mut out = Vec::new();
    // No Gaussians: an absent stream.
    if size == 0 && stream.is_empty() {
        return Ok(out);
    }
    let mut decoder = ruzstd::decoding::StreamingDecoder::new(stream).map_err(|e| e.to_string())?;
    let mut limited = Read::take(&mut decoder, size as u64 + 1);
    limited.read_to_end(&mut out).map_err(|e| e.to_string())?;
    if out.len() != size {
        return Err(format!("{} bytes or more", out.len()));
    }
    let (rest, frame) = decoder.into_parts();
    // 0 is the size of a frame that declares none, too.
    if ![0, size as u64].contains(&frame.content_size()) {
        return Err(format!("a frame that declares {} bytes", frame.content_size()));
    }
    if !rest.is_empty() {
        return Err(format!("{} bytes after the frame", rest.len()));
    }
    match (frame.get_checksum_from_data(), frame.get_calculated_checksum()) {
        (Some(stored), Some(found)) if stored != found => {
            Err(format!("checksum {found:08x} where the frame says {stored:08x}"))
        }
        _ => Ok(out),
    }
}

fn gaussians(header: &Header, columns: &Columns) -> Incoming {
    let [positions, opacities, colours, scales, rotations, sh] = columns;
    let mut incoming = Incoming::with_capacity(header.count, header.sh_degree);
    let unit = 1.0 / f64::from(1u32 << header.fraction_bits);
    let rests = sh.len().checked_div(header.count).unwrap_or(0);
    let rotation_size = rotations.len().checked_div(header.count).unwrap_or(0);
    for i in 0..header.count {
        let mean = std::array::from_fn(|c| {
            let k = 3 * i + c;
            if header.version == 1 {
                f16::from_le_bytes([positions[2 * k], positions[2 * k + 1]]).to_f32()
            } else {
                // The arithmetic shift extends the sign of the upper three bytes.
                let p = &positions[3 * k..3 * k + 3];
                let fixed = i32::from_le_bytes([0, p[0], p[1], p[2]]) >> 8;
                (f64::from(fixed) * unit) as f32
            }
        });
        let scale =
            std::array::from_fn(|c| (f64::from(scales[3 * i + c]) / 16.0 - 10.0).exp() as f32);
        let rotation = &rotations[rotation_size * i..rotation_size * (i + 1)];
        let opacity = f32::from(opacities[i]) / 255.0;
        let set = incoming.push(mean, unpack_rotation(rotation), scale, opacity);
        for (h, b) in set.iter_mut().zip(&colours[3 * i..3 * i + 3]) {
            *h = ((f64::from(*b) / 255.0 - 0.5) / COLOUR_SCALE) as f32;
        }
        for (h, b) in set[3..].iter_mut().zip(&sh[rests * i..rests * (i + 1)]) {
            *h = (f32::from(*b) - 128.0) / 128.0;
        }
    }
    incoming
}

/// Decodes a quaternion wxyz from three bytes (version 2) or from four bytes of the
/// smallest-three code (version 3).
fn unpack_rotation(b: &[u8]) -> [f32; 4] {
    if let &[b0, b1, b2, b3] = b {
        let mut code = u32::from_le_bytes([b0, b1, b2, b3]);
        let largest = (code >> 30) as usize;
        let mut xyzw = [0.0f64; 4];
        let mut squares = 0.0;
        for i in (0..4).rev().filter(|i| *i != largest) {
            let size = std::f64::consts::FRAC_1_SQRT_2 * f64::from(code & 511) / 511.0;
            xyzw[i] = if code & 512 != 0 { -size } else { size };
            squares += size * size;
            code >>= 10;
        }
        xyzw[largest] = (1.0 - squares).max(0.0).sqrt();
        let [x, y, z, w] = xyzw.map(|v| v as f32);
        return [w, x, y, z];
    }
    let mut q = [0.0; 4];
    for (v, byte) in q[1..].iter_mut().zip(b) {
        *v = f32::from(*byte) / 127.5 - 1.0;
    }
    q[0] = (1.0 - q[1] * q[1] - q[2] * q[2] - q[3] * q[3]).max(0.0).sqrt();
    q
}

fn pack_rotation(q: [f32; 4]) -> [u8; 4] {
    let [w, x, y, z] = q;
    let xyzw = [x, y, z, w];
    let mut largest = 0;
    for i in 1..4 {
        if xyzw[i].abs() > xyzw[largest].abs() {
            largest = i;
        }
    }
    let mut code = largest as u32;
    for (i, v) in xyzw.into_iter().enumerate().filter(|(i, _)| *i != largest) {
        let negative = (v < 0.0) != (xyzw[largest] < 0.0) && i != largest;
        let size = (f64::from(v.abs()) * std::f64::consts::SQRT_2 * 511.0).round().min(511.0);
        code = (code << 10) | (u32::from(negative) << 9) | size as u32;
    }
    code.to_le_bytes()
}

/// Chooses the fractional bits, at most 20, with which `out` fits 24 bits with sign.
///
/// Gaussians beyond 2²³ units are not in `out` ([`Outgoing::new`]).
///
/// # Errors
/// More Gaussians than readers accept.
pub(super) fn fraction_bits(out: &Outgoing, path: &Path) -> Result<u32> {
    if out.count > COUNT_MAX as usize {
        let expected = format!("at most {COUNT_MAX} Gaussians in .spz");
        return Err(Error::format(path, expected, out.count.to_string()));
    }
    let reach = out.bounds.iter().flatten().fold(0.0f64, |m, v| m.max(f64::from(v.abs())));
    let bits = (FIXED_MAX / reach.max(1e-9)).log2().floor() as i32;
    Ok(bits.clamp(0, FRACTION_MAX) as u32)
}

/// Writes a file, in one pass over `out` for each attribute; all threads compress (version 3).
///
/// SH coefficients have all 8 bits; the reference encoder rounds to 5 and 4 bits for size.
pub(super) fn write(
    file: &mut dyn Write,
    out: &Outgoing,
    bits: u32,
    version: SpzVersion,
) -> std::io::Result<()> {
    let attributes = if out.sh_degree == 0 { 5 } else { 6 };
    let mut head = MAGIC.to_vec();
    let (number, streams) = match version {
        SpzVersion::V3 => (3u32, 0),
        SpzVersion::V4 => (4, attributes),
    };
    head.extend(number.to_le_bytes());
    // `fraction_bits` has checked the count.

    head.extend((out.count as u32).to_le_bytes());
    head.extend([out.sh_degree as u8, bits as u8, 0, streams]);
    match version {
        SpzVersion::V3 => {
            let parts = (0..attributes).flat_map(|a| out.runs(RUN).map(move |run| (a, run)));
            gzip::write(file, &head, &parts.collect::<Vec<_>>(), |(attribute, run), bytes| {
                write_attribute(bytes, out, run.clone(), bits, *attribute)
            })
        }
        SpzVersion::V4 => {
            head.extend((HEADER_V4 as u32).to_le_bytes());
            head.resize(HEADER_V4, 0);
            let (mut table, mut streams) = (Vec::new(), Vec::new());
            for attribute in 0..attributes {
                let mut column = Vec::new();
                write_attribute(&mut column, out, 0..out.len(), bits, attribute)?;
                let stream = compress_to_vec(&column[..], CompressionLevel::Fastest);
                table.extend((stream.len() as u64).to_le_bytes());
                table.extend((column.len() as u64).to_le_bytes());
                streams.push(stream);
            }
            file.write_all(&head)?;
            file.write_all(&table)?;
            streams.iter().try_for_each(|stream| file.write_all(stream))
        }
    }
}

/// Writes one attribute of those of the Gaussians `range` that are kept, in the order of [`Header::sizes`].
fn write_attribute(
    to: &mut Vec<u8>,
    out: &Outgoing,
    range: Range<usize>,
    bits: u32,
    attribute: u8,
) -> std::io::Result<()> {
    let scale = f64::from(1u32 << bits);
    let byte = |v: f64| v.round().clamp(0.0, 255.0) as u8;
    let floats = 3 * sh_coefficients(out.sh_degree);
    let mut visitor = out.visitor();
    for i in out.kept_of(range) {
        let g = visitor.at(i)?;
        match attribute {
            0 => {
                for v in g.mean {
                    let fixed = (f64::from(v) * scale).round().clamp(-FIXED_MAX, FIXED_MAX);
                    to.extend_from_slice(&(fixed as i32).to_le_bytes()[..3]);
                }
            }
            1 => to.push(unit_byte(f64::from(g.opacity))),
            2 => to.extend([0, 1, 2].map(|c| unit_byte(COLOUR_SCALE * f64::from(g.sh[c]) + 0.5))),
            3 => to.extend(g.scale.map(|s| byte(16.0 * (f64::from(s).ln() + 10.0)))),
            4 => to.extend(pack_rotation(g.quat)),
            _ => to.extend(g.sh[3..floats].iter().map(|v| byte(f64::from(*v) * 128.0 + 128.0))),
        }
    }
    Ok(())
}
