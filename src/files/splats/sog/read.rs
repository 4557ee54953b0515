//! Reader of SOG; `mod.rs` describes the format.

use super::container::{Container, Plane};
use super::{LARGEST_W, OTHERS, PALETTE_LINE};
use crate::files::splats::gaussians::{Decoded, Incoming, sigmoid};
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use serde::Deserialize;
use std::f64::consts::SQRT_2;
use std::path::Path;
use subsplat_kernels::layout::sh_coefficients;

/// Bytes of a file that [`is_meta`] reads.
const PROBE: u64 = 1 << 20;

/// Reads a `.sog` from memory. `name` is for errors.
///
/// # Errors
/// Not a zip with `meta.json`, another version, a picture that is absent, damaged or too small, a
/// decompression bomb, an index beyond its codebook or palette, no Gaussian with finite numbers
/// and a rotation.
pub fn parse_sog(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    Ok(decode(bytes, name.as_ref())?.splats)
}

/// Returns whether `path` is the `meta.json` of a SOG in a folder.
pub fn is_meta(path: impl AsRef<Path>) -> bool {
    let path = path.as_ref();
    if path.file_name().is_none_or(|name| !name.eq_ignore_ascii_case(super::META)) {
        return false;
    }
    let Ok(file) = crate::files::open_regular(path) else { return false };
    let mut text = Vec::new();
    let read = std::io::Read::read_to_end(&mut std::io::Read::take(file, PROBE), &mut text);
    read.is_ok() && serde_json::from_slice::<Meta>(&text).is_ok()
}

#[derive(Deserialize)]
struct Meta {
    version: Option<u64>,
    count: Option<u64>,
    means: Means,
    scales: Codes,
    quats: Files,
    sh0: Codes,
    #[serde(rename = "shN")]
    sh_n: Option<PaletteMeta>,
    /// Read where it has the form of this crate's writer.
    #[serde(default)]
    asset: serde_json::Value,
}

#[derive(Deserialize)]
struct Means {
    /// Version 1: count of Gaussians and of axes.
    shape: Option<Vec<u64>>,
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Files {
    files: [String; 1],
}

/// Codes of a channel: a codebook (version 2), or the ends of a uniform scale for each channel.
#[derive(Deserialize)]
struct Codes {
    #[serde(default)]
    codebook: Vec<f64>,
    #[serde(default)]
    mins: Vec<f64>,
    #[serde(default)]
    maxs: Vec<f64>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct PaletteMeta {
    count: Option<u64>,
    bands: Option<usize>,
    #[serde(default)]
    codebook: Vec<f64>,
    mins: Option<f64>,
    maxs: Option<f64>,
    files: [String; 2],
}

/// Values of the 256 codes of a channel; NaN where the file gives none.
type Table = [f64; 256];

fn codebook(values: &[f64]) -> Table {
    std::array::from_fn(|i| values.get(i).copied().unwrap_or(f64::NAN))
}

fn uniform(min: f64, max: f64) -> Table {
    std::array::from_fn(|i| min + (max - min) * i as f64 / 255.0)
}

impl Codes {
    /// Returns the tables of `channels`.
    fn tables(&self, channels: usize, version: u64) -> Option<Vec<Table>> {
        if version == 2 {
            return (!self.codebook.is_empty()).then(|| vec![codebook(&self.codebook); channels]);
        }
        (0..channels).map(|c| Some(uniform(*self.mins.get(c)?, *self.maxs.get(c)?))).collect()
    }
}

/// Reads an archive.
pub(in crate::files::splats) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded> {
    Ok(decode_from(Container::zip(bytes, path)?)?.0)
}

/// Reads the pictures beside `path`, which is `meta.json`; returns the size of all files too.
pub(in crate::files::splats) fn decode_unpacked(path: &Path) -> Result<(Decoded, u64)> {
    decode_from(Container::folder(path))
}

fn decode_from(mut container: Container) -> Result<(Decoded, u64)> {
    let path = container.path;
    let text = container.meta()?;
    let meta: Meta = serde_json::from_slice(&text)
        .map_err(|e| Error::format(path, "the meta.json of a SOG", e.to_string()))?;
    let version = meta.version.unwrap_or(1);
    if !(1..=2).contains(&version) {
        return Err(Error::format(path, "SOG version 1 or 2", version.to_string()));
    }
    let count = meta.count.or_else(|| meta.means.shape.as_ref()?.first().copied());
    let count = count
        .and_then(|n| usize::try_from(n).ok())
        .ok_or_else(|| Error::format(path, "a count of Gaussians in meta.json", "none"))?;
    let planes = Planes::read(&mut container, &meta, version, count)?;
    let incoming = planes.gaussians(&container, count)?;
    let splats = incoming.into_splats(path)?;
    let lossy = planes.lossy();
    let notes = (!lossy.is_empty()).then(|| {
        format!("compressed with losses, which change positions and colours: {}", lossy.join(", "))
    });
    let generator = meta.asset["generator"].as_str().map(|g| format!("generator: {g}"));
    let extras = meta.asset["extras"]["comments"].as_array();
    let own = extras.into_iter().flatten().filter_map(|c| Some(c.as_str()?.to_owned()));
    let comments = generator.into_iter().chain(own).collect();
    let flavour = format!("sog {version}");
    let decoded = Decoded::new(splats, flavour, comments, notes.into_iter().collect(), path)?;
    Ok((decoded, container.bytes))
}

/// SH above degree 0: a label for each Gaussian, and the rows of the palette.
struct Palette {
    degree: usize,
    count: usize,
    table: Table,
    centroids: Plane,
    labels: Plane,
}

struct Planes {
    version: u64,
    ends: [[f64; 3]; 2],
    means: [Plane; 2],
    scales: Plane,
    scale_tables: Vec<Table>,
    quats: Plane,
    sh0: Plane,
    sh0_tables: Vec<Table>,
    palette: Option<Palette>,
}

impl Planes {
    fn read(container: &mut Container, meta: &Meta, version: u64, count: usize) -> Result<Self> {
        let path = container.path;
        let tables = |codes: &Codes, channels: usize, what: &str| {
            codes.tables(channels, version).ok_or_else(|| {
                let expected = format!("codebook (version 2) or mins and maxs of {what}");
                Error::format(path, expected, "none")
            })
        };
        let scale_tables = tables(&meta.scales, 3, "scales")?;
        // The alpha of version 2 is the opacity itself.
        let sh0_tables = tables(&meta.sh0, 4, "sh0")?;
        let [low, high] = &meta.means.files;
        let means = [container.plane_of(low, count)?, container.plane_of(high, count)?];
        let scales = container.plane_of(&meta.scales.files[0], count)?;
        let quats = container.plane_of(&meta.quats.files[0], count)?;
        let sh0 = container.plane_of(&meta.sh0.files[0], count)?;
        let palette = match &meta.sh_n {
            None => None,
            Some(palette) => Palette::read(container, palette, version, count)?,
        };
        let ends = [meta.means.mins, meta.means.maxs];
        Ok(Self { version, ends, means, scales, scale_tables, quats, sh0, sh0_tables, palette })
    }

    fn lossy(&self) -> Vec<&str> {
        let palette = self.palette.iter().flat_map(|p| [&p.centroids, &p.labels]);
        let all = self.means.iter().chain([&self.scales, &self.quats, &self.sh0]).chain(palette);
        all.filter(|plane| plane.is_lossy).map(|plane| plane.shape().0).collect()
    }

    fn gaussians(&self, container: &Container, count: usize) -> Result<Incoming> {
        let degree = self.palette.as_ref().map_or(0, |p| p.degree);
        let mut incoming = Incoming::with_capacity(count, degree);
        for i in 0..count {
            let [low, high] = [self.means[0].pixel(i), self.means[1].pixel(i)];
            let mean = std::array::from_fn(|c| {
                let step = f64::from(u16::from_le_bytes([low[c], high[c]])) / 65535.0;
                let [min, max] = self.ends.map(|end| end[c]);
                let log = min + (max - min) * step;
                (log.signum() * log.abs().exp_m1()) as f32
            });
            let quat = unpack_rotation(self.quats.pixel(i)).ok_or_else(|| {
                let got = format!("{} (pixel {i})", self.quats.pixel(i)[3]);
                container.bad(self.quats.shape().0, "alpha of 252 to 255", got)
            })?;
            let codes = self.scales.pixel(i);
            let scale =
                std::array::from_fn(|c| self.scale_tables[c][usize::from(codes[c])].exp() as f32);
            let codes = self.sh0.pixel(i);
            let [red, green, blue, alpha] =
                std::array::from_fn(|c| self.sh0_tables[c][usize::from(codes[c])]);
            let opacity = match self.version {
                2 => f64::from(codes[3]) / 255.0,
                _ => sigmoid(alpha as f32),
            };
            let set = incoming.push(mean, quat, scale, opacity as f32);
            set[..3].copy_from_slice(&[red, green, blue].map(|v| v as f32));
            if let Some(palette) = &self.palette {
                palette.fill(i, &mut set[3..], container)?;
            }
        }
        Ok(incoming)
    }
}

impl Palette {
    /// Reads the palette; `None` where it has no coefficient.
    fn read(
        container: &mut Container,
        meta: &PaletteMeta,
        version: u64,
        count: usize,
    ) -> Result<Option<Self>> {
        let path = container.path;
        let [centroids, labels] = &meta.files;
        let centroids = container.plane(centroids)?;
        let (name, width, height) = centroids.shape();
        let by_width = (1..=super::SH_DEGREE_MAX).find(|d| line_width(*d) == width);
        let degree = match (version, meta.bands) {
            (2, Some(0)) => return Ok(None),
            (2, Some(bands)) => Some(bands).filter(|b| by_width == Some(*b)),
            (2, None) => None,
            _ => by_width,
        };
        let degree = degree.ok_or_else(|| {
            let expected = "1, 2 or 3 bands and a width of 192, 512 or 960 pixels accordingly";
            let got = format!("{:?} bands and {width} pixels", meta.bands);
            container.bad(name, expected, got)
        })?;
        let table = match (version, meta.mins, meta.maxs) {
            (2, ..) if !meta.codebook.is_empty() => codebook(&meta.codebook),
            (1, Some(min), Some(max)) => uniform(min, max),
            _ => {
                let expected = "codebook (version 2) or mins and maxs of shN";
                return Err(Error::format(path, expected, "none"));
            }
        };
        let rows = height * PALETTE_LINE;
        let rows = meta.count.map_or(rows, |n| usize::try_from(n).unwrap_or(rows).min(rows));
        let labels = container.plane_of(labels, count)?;
        // A set of SH takes more memory than its label.
        let numbers = 3 * (sh_coefficients(degree) - 1);
        container.count_decoded(labels.shape().0, (numbers * count) as u64)?;
        Ok(Some(Self { degree, count: rows, table, centroids, labels }))
    }

    /// Writes the coefficients of Gaussian `i` to `set`, `[D − 1, 3]`.
    fn fill(&self, i: usize, set: &mut [f32], container: &Container) -> Result<()> {
        let [low, high, ..] = self.labels.pixel(i);
        let label = usize::from(u16::from_le_bytes([low, high]));
        if label >= self.count {
            let expected = format!("a label below {}", self.count);
            let got = format!("{label} (pixel {i})");
            return Err(container.bad(self.labels.shape().0, expected, got));
        }
        // Lines are full, so that rows follow one another.
        let first = label * (sh_coefficients(self.degree) - 1);
        for (k, h) in set.chunks_exact_mut(3).enumerate() {
            let codes = self.centroids.pixel(first + k);
            for (v, code) in h.iter_mut().zip(codes) {
                *v = self.table[usize::from(code)] as f32;
            }
        }
        Ok(())
    }
}

/// Returns the width of the palette's picture, pixels.
fn line_width(degree: usize) -> usize {
    PALETTE_LINE * (sh_coefficients(degree) - 1)
}

/// Decodes a quaternion wxyz; `None` for an alpha that names no component.
fn unpack_rotation(pixel: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(pixel[3].checked_sub(LARGEST_W)?);
    let mut q = [0.0f32; 4];
    let mut squares = 0.0;
    for (code, at) in pixel.into_iter().zip(OTHERS[largest]) {
        let v = (f64::from(code) / 255.0 * 2.0 - 1.0) / SQRT_2;
        squares += v * v;
        q[at] = v as f32;
    }
    q[largest] = (1.0 - squares).max(0.0).sqrt() as f32;
    Some(q)
}
