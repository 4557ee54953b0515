//! Splat files of every format: detection, loading, saving, and the report of
//! `subsplat info`.
//!
//! | format | in | out | SH written | axes of the file |
//! |---|---|---|---|---|
//! | `.ply` (INRIA 3DGS) | yes | yes | 3 (4 on demand) | ours, or as `up` says |
//! | `.compressed.ply` (PlayCanvas) | yes | no | | |
//! | `.glb` (KHR_gaussian_splatting) | yes | yes | 3 | y-up by a node's rotation |
//! | `.spz` (Niantic, 1 to 4) | yes | version 3 or 4 | 3 | y-up by definition |
//! | `.sog` (PlayCanvas, 1 and 2) | yes | version 2 | 3 | ours, or as `up` says |
//! | `.splat` (antimatter15) | yes | yes | 0 | ours, or as `up` says |
//! | `.ksplat` (mkkellogg) | yes | no | | |
//!
//! "ours": OpenCV axes, y down; viewers of `.ply`, `.sog` and `.splat` rotate the scene themselves.
//! The pictures of a `.sog` are read from a folder as well, with their `meta.json`.
//! SH of degree 4 are dropped by default, since viewers read 3.
//!
//! What a reader applies, leaves out or does not read, it says in a note ([`SplatFile::notes`]).

pub mod compressed_ply;
mod far;
mod gaussians;
pub mod glb;
mod glb_read;
mod gzip;
pub mod ksplat;
pub mod ply;
mod ply_container;
pub mod sog;
pub mod splat;
pub mod spz;

use crate::files::{Error, Result, first_bytes, open_regular, read, write_atomic};
use crate::scene::splats::Splats;
use gaussians::{Decoded, HALF_TURN_X, Outgoing};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use spz::SpzVersion;
use std::io::{BufReader, Cursor, Seek, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use subsplat_kernels::layout::ALPHA_MIN;

/// A kind of splat file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SplatFormat {
    /// INRIA's `.ply`, or PlayCanvas' packed one.
    Ply,
    /// Binary glTF with KHR_gaussian_splatting.
    Glb,
    /// Niantic's `.spz`.
    Spz,
    /// PlayCanvas' `.sog`.
    Sog,
    /// antimatter15's `.splat`.
    Splat,
    /// mkkellogg's `.ksplat`.
    Ksplat,
}

/// Bytes from the start of a file that decide what it is.
const HEAD: usize = 64;

/// The formats of [`load_splats`], for errors.
const KNOWN: &str = "a .ply, .glb, .spz, .sog, .splat or .ksplat file";

impl SplatFormat {
    /// Detects the format by the file name's extension, in upper or lower case.
    pub fn from_name(path: impl AsRef<Path>) -> Option<Self> {
        let extension = path.as_ref().extension()?.to_string_lossy().to_ascii_lowercase();
        Some(match extension.as_str() {
            "ply" => Self::Ply,
            "glb" => Self::Glb,
            "spz" => Self::Spz,
            "sog" => Self::Sog,
            "splat" => Self::Splat,
            "ksplat" => Self::Ksplat,
            _ => return None,
        })
    }

    /// Detects the format by the first bytes, where it has a magic number. That of `.sog` is the one
    /// of every zip.
    pub fn from_magic(head: &[u8]) -> Option<Self> {
        if head.starts_with(b"ply\n") || head.starts_with(b"ply\r") {
            Some(Self::Ply)
        } else if head.starts_with(&glb::MAGIC) {
            Some(Self::Glb)
        } else if head.starts_with(&spz::MAGIC) || head.starts_with(&[0x1f, 0x8b]) {
            Some(Self::Spz)
        } else if head.starts_with(b"PK\x03\x04") {
            Some(Self::Sog)
        } else {
            None
        }
    }
}

/// The up direction of a written file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Up {
    /// The world's own axes (OpenCV): up is −y.
    #[default]
    Keep,
    /// Rotated by 180° about x: up is +y, −z forward (OpenGL).
    Y,
    /// Rotated by 90° about x: up is +z, +y forward (Blender).
    Z,
}

impl Up {
    /// Returns the rotation from the world's axes to the file's.
    fn rotation(self) -> Option<DMat3> {
        match self {
            Self::Keep => None,
            Self::Y => Some(HALF_TURN_X),
            Self::Z => Some(DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y)),
        }
    }
}

impl FromStr for Up {
    type Err = String;

    fn from_str(s: &str) -> std::result::Result<Self, String> {
        match s {
            "keep" => Ok(Self::Keep),
            "y" => Ok(Self::Y),
            "z" => Ok(Self::Z),
            _ => Err(format!("up axis: expected keep, y or z, got {s:?}")),
        }
    }
}

/// Options of [`save_splats`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SaveOptions {
    /// Highest SH degree written; `None` is 3. The stored degree and the format (`.ply` 4,
    /// `.glb`, `.spz` and `.sog` 3, `.splat` 0) limit it.
    pub sh_degree: Option<usize>,
    /// Gaussians of a lower opacity are left out; 0 keeps all.
    pub min_opacity: f32,
    /// Up direction: rotates means, quaternions and SH. The node of a `.glb` rotates them
    /// back; `.spz` is y-up by definition and refuses `z`.
    pub up: Up,
    /// Lines for the header of a `.ply`, the `asset` of a `.glb`, or the `meta.json` of a `.sog`.
    pub comments: Vec<String>,
    /// Version of a `.spz`.
    pub spz_version: SpzVersion,
}

/// Report of a written file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct SaveReport {
    /// Format.
    pub format: SplatFormat,
    /// Gaussians written.
    pub count: usize,
    /// Gaussians below the least opacity.
    pub pruned: usize,
    /// Gaussians with a coordinate beyond the format's range, which are left out.
    pub out_of_range: usize,
    /// SH degree written.
    pub sh_degree: usize,
    /// SH degree of the splats.
    pub stored_sh_degree: usize,
    /// Gaussians with a σ that was raised to 1e-12.
    pub clamped_scales: usize,
    /// Size of the file.
    pub bytes: u64,
}

impl SaveReport {
    /// Lines for a person about Gaussians that the file does not have.
    pub fn notes(&self) -> Vec<String> {
        let all = self.count + self.out_of_range;
        let line = || {
            format!(
                "left out: {} of {all} splats, whose coordinates are beyond the range of the format \
                 (2^23 units from the origin)",
                self.out_of_range
            )
        };
        (self.out_of_range > 0).then(line).into_iter().collect()
    }
}

/// Content of a splat file.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatFile {
    /// The Gaussians: standard SH basis, K = 1, unit world quaternions, no gain.
    pub splats: Splats,
    /// Comments of the file ([`SaveOptions::comments`]), with that of the origin where the reader has moved splats
    /// far from it ([`comment_of_origin`](crate::scene::render::comment_of_origin)).
    pub comments: Vec<String>,
    /// Lines for a person, without the file's name: Gaussians that were left out with their number
    /// and the reason, properties that were applied (`filter_3D`) or not read.
    pub notes: Vec<String>,
}

/// Reads a splat file. A magic number decides the format, else the file's extension. The
/// result has the standard SH basis, K = 1, unit world quaternions and no gain.
///
/// Gaussians with a number that is NaN or infinite, or with a quaternion of zeros, are left out;
/// [`load_splat_file`] says how many.
///
/// # Errors
/// An unknown format; the errors of the format's reader; no Gaussian left, of one or more.
pub fn load_splats(path: impl AsRef<Path>) -> Result<Splats> {
    Ok(load_with_comments(path)?.0)
}

/// Reads a splat file and its comments ([`SaveOptions::comments`]).
///
/// # Errors
/// As [`load_splats`].
pub fn load_with_comments(path: impl AsRef<Path>) -> Result<(Splats, Vec<String>)> {
    let SplatFile { splats, comments, .. } = load_splat_file(path)?;
    Ok((splats, comments))
}

/// Reads a splat file, its comments and the notes on what was left out, applied or not read.
///
/// # Errors
/// As [`load_splats`].
pub fn load_splat_file(path: impl AsRef<Path>) -> Result<SplatFile> {
    let Decoded { splats, comments, notes, .. } = decode(path.as_ref())?.1;
    Ok(SplatFile { splats, comments, notes })
}

/// Returns whether `path` is a splat file by its first bytes or its name, the `meta.json` of a SOG in
/// a folder, or such a folder.
pub fn is_splat_file(path: impl AsRef<Path>) -> bool {
    let path = path.as_ref();
    if sog_meta(path).is_some() {
        return true;
    }
    // The name decides for a file that cannot be read, and the reader says why.
    let head = first_bytes(path, 4).unwrap_or_default();
    path.is_file() && format_of(&head, path).is_ok()
}

/// Returns the `meta.json` of a SOG in a folder: `path` itself, or the one in it.
fn sog_meta(path: &Path) -> Option<PathBuf> {
    let meta = if path.is_dir() { path.join(sog::META) } else { path.to_owned() };
    sog::is_meta(&meta).then_some(meta)
}

fn decode(path: &Path) -> Result<(SplatFormat, Decoded, u64)> {
    if let Some(meta) = sog_meta(path) {
        let (decoded, bytes) = sog::decode_unpacked(&meta)?;
        return Ok((SplatFormat::Sog, decoded, bytes));
    }
    let io = |e| Error::io(path, e);
    let head = first_bytes(path, HEAD).map_err(io)?;
    let format = format_of(&head, path)?;
    // The largest files are .ply: they are streamed.
    if format == SplatFormat::Ply {
        let file = open_regular(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut reader = BufReader::with_capacity(1 << 16, file);
        let decoded = ply::decode(&mut reader, length, path)?;
        return Ok((format, decoded, length));
    }
    let bytes = read(path)?;
    Ok((format, decode_bytes(format, &bytes, path)?, bytes.len() as u64))
}

/// Detects the format of a file by its first bytes, else by its name.
fn format_of(head: &[u8], path: &Path) -> Result<SplatFormat> {
    if let Some(other) = not_the_file(head) {
        return Err(Error::format(path, KNOWN, other));
    }
    let head = &head[..head.len().min(4)];
    SplatFormat::from_magic(head)
        .or_else(|| SplatFormat::from_name(path))
        .ok_or_else(|| Error::format(path, KNOWN, format!("first bytes {head:02x?}")))
}

/// Names what a download gives in place of a file.
fn not_the_file(head: &[u8]) -> Option<&'static str> {
    let start = String::from_utf8_lossy(&head[..head.len().min(HEAD)]).to_lowercase();
    let start = start.trim_start_matches(|c: char| c.is_whitespace() || c == '\u{feff}');
    if start.starts_with("<!doctype html") || start.starts_with("<html") {
        return Some(
            "a web page (HTML): download the scene's file itself, not the page that shows it",
        );
    }
    let pointer = start.starts_with("version https://git-lfs");
    pointer.then_some("a pointer of git-lfs in place of the file: fetch the file by `git lfs pull`")
}

fn decode_bytes(format: SplatFormat, bytes: &[u8], path: &Path) -> Result<Decoded> {
    match format {
        SplatFormat::Ply => ply::decode(&mut { bytes }, bytes.len() as u64, path),
        SplatFormat::Glb => glb_read::decode(bytes, path),
        SplatFormat::Spz => spz::decode(bytes, path),
        SplatFormat::Sog => sog::decode(bytes, path),
        SplatFormat::Splat => splat::decode(bytes, path),
        SplatFormat::Ksplat => ksplat::decode(bytes, path),
    }
}

/// Reads a splat file in memory and its comments ([`SaveOptions::comments`]). `name` is for errors,
/// and gives the format of a file without a magic number.
///
/// # Errors
/// As [`load_splats`].
pub fn parse_splats(bytes: &[u8], name: impl AsRef<Path>) -> Result<(Splats, Vec<String>)> {
    let name = name.as_ref();
    let decoded = decode_bytes(format_of(bytes, name)?, bytes, name)?;
    Ok((decoded.splats, decoded.comments))
}

impl Splats {
    /// Reads a splat file, as [`load_splats`] does.
    ///
    /// # Errors
    /// Those of [`load_splats`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        load_splats(path)
    }

    /// Writes a splat file in the format of its extension with the default options of
    /// [`save_splats`].
    ///
    /// # Errors
    /// Those of [`save_splats`].
    pub fn save(&self, path: impl AsRef<Path>) -> Result<SaveReport> {
        save_splats(path, self, &SaveOptions::default())
    }
}

/// Writes a splat file in the format of its extension, atomically.
///
/// `.ply` and `.glb` are lossless (float) but for SH above the degree written; `.spz`, `.sog` and
/// `.splat` quantise ([`self::spz`], [`self::sog`], [`self::splat`]).
///
/// # Errors
/// An extension of no writable format, numbers that are not finite (the first Gaussian is
/// named), an opacity out of [0, 1], no Gaussian left to write, a `.spz` of splats of which more than half have
/// coordinates beyond 2²³ units, system errors.
pub fn save_splats(
    path: impl AsRef<Path>,
    splats: &Splats,
    options: &SaveOptions,
) -> Result<SaveReport> {
    write_splats(path.as_ref(), splats, options)
}

fn write_splats(path: &Path, splats: &Splats, options: &SaveOptions) -> Result<SaveReport> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let format = SplatFormat::from_name(path)
        .filter(|f| *f != SplatFormat::Ksplat && !name.ends_with(".compressed.ply"))
        .ok_or_else(|| {
            let expected = "a name that ends in .ply, .glb, .spz, .sog or .splat";
            Error::format(path, expected, name.clone())
        })?;
    let plan = Plan::new(format, splats, options, path)?;
    write_atomic(path, |f| plan.write(f, options))?;
    let bytes = std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
    Ok(plan.report(splats, bytes))
}

/// Writes a splat file into memory, as [`save_splats`] writes one of `format`.
///
/// # Errors
/// Those of [`save_splats`]; a format that is read only.
pub fn encode_splats(
    format: SplatFormat,
    splats: &Splats,
    options: &SaveOptions,
) -> Result<Vec<u8>> {
    Ok(encode_splats_with(format, splats, options, "scene")?.0)
}

/// [`encode_splats`] with the report of [`save_splats`]; `name` is for errors.
///
/// # Errors
/// Those of [`encode_splats`].
pub fn encode_splats_with(
    format: SplatFormat,
    splats: &Splats,
    options: &SaveOptions,
    name: impl AsRef<Path>,
) -> Result<(Vec<u8>, SaveReport)> {
    encode(format, splats, options, name.as_ref())
}

fn encode(
    format: SplatFormat,
    splats: &Splats,
    options: &SaveOptions,
    name: &Path,
) -> Result<(Vec<u8>, SaveReport)> {
    if format == SplatFormat::Ksplat {
        return Err(Error::format(name, "a format that is written", "ksplat"));
    }
    let mut bytes = Cursor::new(Vec::new());
    let plan = Plan::new(format, splats, options, name)?;
    plan.write(&mut bytes, options).map_err(|e| Error::io(name, e))?;
    let bytes = bytes.into_inner();
    let report = plan.report(splats, bytes.len() as u64);
    Ok((bytes, report))
}

/// A file before its first byte is written.
struct Plan<'a> {
    format: SplatFormat,
    out: Outgoing<'a>,
    glb: Option<glb::Plan>,
    /// Fractional bits of coordinates in .spz.
    fraction_bits: u32,
}

impl<'a> Plan<'a> {
    fn new(
        format: SplatFormat,
        splats: &'a Splats,
        options: &SaveOptions,
        path: &Path,
    ) -> Result<Self> {
        let reach = match format {
            SplatFormat::Spz => spz::FIXED_MAX,
            _ => f64::INFINITY,
        };
        let survey = |rotation, limit| Outgoing::new(splats, options, rotation, limit, reach, path);
        let rotation = options.up.rotation();
        let out = match format {
            SplatFormat::Ply => survey(rotation, 4)?,
            SplatFormat::Glb => survey(rotation, glb::SH_DEGREE_MAX)?,
            SplatFormat::Splat => survey(rotation, 0)?,
            SplatFormat::Sog => survey(rotation, sog::SH_DEGREE_MAX)?,
            SplatFormat::Spz | SplatFormat::Ksplat if options.up == Up::Z => {
                return Err(Error::format(path, "up keep or y (.spz is y-up by definition)", "z"));
            }
            SplatFormat::Spz | SplatFormat::Ksplat => survey(Some(HALF_TURN_X), 3)?,
        };
        let glb = match format {
            SplatFormat::Glb => Some(glb::Plan::new(&out, options.up, &options.comments, path)?),
            _ => None,
        };
        if format == SplatFormat::Sog {
            sog::check(&out, path)?;
        }
        let fraction_bits = match format {
            SplatFormat::Spz => spz::fraction_bits(&out, path)?,
            _ => 0,
        };
        Ok(Self { format, out, glb, fraction_bits })
    }

    fn write<F: Write + Seek>(&self, f: &mut F, options: &SaveOptions) -> std::io::Result<()> {
        match (self.format, &self.glb) {
            (_, Some(glb)) => glb.write(f, &self.out),
            (SplatFormat::Ply | SplatFormat::Glb, None) => ply::write(f, &self.out, options),
            (SplatFormat::Splat, None) => splat::write(f, &self.out),
            (SplatFormat::Sog, None) => sog::write(f, &self.out, &options.comments),
            (SplatFormat::Spz | SplatFormat::Ksplat, None) => {
                spz::write(f, &self.out, self.fraction_bits, options.spz_version)
            }
        }
    }

    fn report(&self, splats: &Splats, bytes: u64) -> SaveReport {
        SaveReport {
            format: self.format,
            count: self.out.count,
            pruned: self.out.pruned,
            out_of_range: self.out.out_of_range,
            sh_degree: self.out.sh_degree,
            stored_sh_degree: splats.sh_degree,
            clamped_scales: self.out.clamped_scales,
            bytes,
        }
    }
}

/// Description of a splat file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SplatInfo {
    /// Format.
    pub format: SplatFormat,
    /// Format with its version or encoding: `ply binary_little_endian`, `spz 3`.
    pub flavour: String,
    /// Size of the file.
    pub bytes: u64,
    /// Number of Gaussians that are read, without the two kinds below.
    pub count: usize,
    /// SH degree.
    pub sh_degree: usize,
    /// Gaussians that are left out because a number is NaN or infinite.
    pub non_finite: usize,
    /// Gaussians that are left out because their quaternion is zero: rows that were never written.
    pub zero_rows: usize,
    /// Gaussians that no pixel shows (opacity below 1/255).
    pub invisible: usize,
    /// Smallest and largest mean, world axes; `None` without a Gaussian.
    pub bounds: Option<[[f32; 3]; 2]>,
    /// [`SplatInfo::QUANTILES`] of the opacity.
    pub opacity: Vec<f32>,
    /// [`SplatInfo::QUANTILES`] of σ, all three axes together, world units.
    pub scale: Vec<f32>,
    /// Comments of the file.
    pub comments: Vec<String>,
    /// As [`SplatFile::notes`].
    pub notes: Vec<String>,
}

impl SplatInfo {
    /// The quantiles of the report: minimum, 1 %, quartiles, 99 %, maximum.
    pub const QUANTILES: [f64; 7] = [0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0];

    fn of(format: SplatFormat, decoded: Decoded, bytes: u64) -> Self {
        let s = &decoded.splats;
        let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
        let (mut opacity, mut scale) = (Vec::new(), Vec::new());
        for i in 0..s.len() {
            for (axis, m) in s.mean(i).into_iter().enumerate() {
                bounds[0][axis] = bounds[0][axis].min(m);
                bounds[1][axis] = bounds[1][axis].max(m);
            }
            opacity.push(s.opacity(i));
            scale.extend(s.scale(i));
        }
        Self {
            format,
            flavour: decoded.flavour,
            bytes,
            count: s.len(),
            sh_degree: s.sh_degree,
            non_finite: decoded.non_finite,
            zero_rows: decoded.zero_rows,
            invisible: opacity.iter().filter(|o| **o < ALPHA_MIN).count(),
            bounds: (!opacity.is_empty()).then_some(bounds),
            opacity: quantiles(opacity),
            scale: quantiles(scale),
            comments: decoded.comments,
            notes: decoded.notes,
        }
    }
}

/// Returns the value at the nearest rank of each quantile; empty for no values.
fn quantiles(mut values: Vec<f32>) -> Vec<f32> {
    values.sort_by(f32::total_cmp);
    let rank = |q: f64| (q * (values.len() as f64 - 1.0)).round() as usize;
    SplatInfo::QUANTILES.iter().filter_map(|q| values.get(rank(*q)).copied()).collect()
}

/// Reads a splat file and describes it.
///
/// # Errors
/// As [`load_splats`].
pub fn splat_info(path: impl AsRef<Path>) -> Result<SplatInfo> {
    let (format, decoded, bytes) = decode(path.as_ref())?;
    Ok(SplatInfo::of(format, decoded, bytes))
}
