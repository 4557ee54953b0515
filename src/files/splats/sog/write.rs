//! Writer of SOG, version 2 in a zip; `mod.rs` describes the format.
//!
//! Gaussians are sorted along a Morton curve, so that neighbours in a picture are neighbours in
//! space and its lines compress. Codebooks and the palette come from `cluster.rs`; the palette has
//! the size that splat-transform gives it. Pictures are lossless WebP by `image`. Entries are
//! stored: a WebP does not shrink.

use super::cluster::{Codebook, palette};
use super::{LARGEST_W, META, OTHERS, PALETTE_LINE};
use crate::files::splats::gaussians::Outgoing;
use crate::files::splats::splat::unit_byte;
use crate::files::{Error, Result};
use image::ExtendedColorType;
use image::codecs::webp::WebPEncoder;
use rayon::prelude::*;
use serde_json::{Value, json};
use std::f64::consts::SQRT_2;
use std::io::{Seek, Write};
use std::path::Path;
use subsplat_kernels::layout::sh_coefficients;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, DateTime, ZipWriter};

/// Largest side of a WebP, pixels.
const SIDE_MAX: usize = 16384;
/// Least and largest number of rows of a palette.
const PALETTE_MIN: usize = 1024;
const PALETTE_MAX: usize = 65536;

/// A picture before it is encoded.
struct Picture {
    name: &'static str,
    width: usize,
    height: usize,
    /// Channels of a pixel, 3 or 4.
    channels: usize,
    pixels: Vec<u8>,
}

impl Picture {
    /// Makes a picture for `count` Gaussians, filled with zeros.
    fn new(name: &'static str, channels: usize, count: usize) -> Self {
        // As splat-transform: about square, sides multiples of 4.
        let width = ((count as f64).sqrt() / 4.0).ceil() as usize * 4;
        let height = count.div_ceil(width).next_multiple_of(4);
        Self { name, width, height, channels, pixels: vec![0; width * height * channels] }
    }

    fn set(&mut self, i: usize, pixel: &[u8]) {
        self.pixels[i * self.channels..][..self.channels].copy_from_slice(pixel);
    }

    fn encode(&self) -> std::io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let colours =
            if self.channels == 3 { ExtendedColorType::Rgb8 } else { ExtendedColorType::Rgba8 };
        WebPEncoder::new_lossless(&mut bytes)
            .encode(&self.pixels, self.width as u32, self.height as u32, colours)
            .map_err(std::io::Error::other)?;
        Ok(bytes)
    }
}

/// Refuses what the format cannot hold.
///
/// # Errors
/// More Gaussians than the largest WebP has pixels.
pub(in crate::files::splats) fn check(out: &Outgoing, path: &Path) -> Result<()> {
    let most = SIDE_MAX * SIDE_MAX;
    if out.count > most {
        let expected = format!("at most {most} Gaussians in .sog");
        return Err(Error::format(path, expected, out.count.to_string()));
    }
    Ok(())
}

/// The numbers that are clustered, in the order of the file.
struct Numbers {
    log_scales: Vec<f32>,
    dc: Vec<f32>,
    /// `[N, 3·(D − 1)]`.
    rest: Vec<f32>,
}

/// Writes the archive.
pub(in crate::files::splats) fn write<F: Write + Seek>(
    file: &mut F,
    out: &Outgoing,
    comments: &[String],
) -> std::io::Result<()> {
    let ends = out.bounds.map(|end| end.map(|v| symmetric_log(f64::from(v))));
    let mut pictures = [
        ("means_l.webp", 3),
        ("means_u.webp", 3),
        ("quats.webp", 4),
        ("scales.webp", 3),
        ("sh0.webp", 4),
    ]
    .map(|(name, channels)| Picture::new(name, channels, out.count));
    let numbers = fill(out, ends, &mut pictures)?;
    let [_, _, _, scales, sh0] = &mut pictures;
    let (scale_book, dc_book) =
        rayon::join(|| Codebook::of(&numbers.log_scales), || Codebook::of(&numbers.dc));
    let codes = |book: &Codebook, v: &[f32]| [0, 1, 2].map(|c| book.code(v[c]));
    for (i, v) in numbers.log_scales.chunks_exact(3).enumerate() {
        scales.set(i, &codes(&scale_book, v));
    }
    for (i, v) in numbers.dc.chunks_exact(3).enumerate() {
        // The opacity is there already.
        sh0.pixels[4 * i..4 * i + 3].copy_from_slice(&codes(&dc_book, v));
    }
    let mut pictures = Vec::from(pictures);
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": format!("subsplat {}", env!("CARGO_PKG_VERSION")) },
        "count": out.count,
        "antialias": false,
        "means": { "mins": ends[0], "maxs": ends[1], "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": decimals(&scale_book.values), "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": decimals(&dc_book.values), "files": ["sh0.webp"] },
    });
    if !comments.is_empty() {
        meta["asset"]["extras"] = json!({ "comments": comments });
    }
    if out.sh_degree > 0 {
        let (sh_n, more) = palette_of(&numbers.rest, out);
        meta["shN"] = sh_n;
        pictures.extend(more);
    }
    drop(numbers);
    let encoded: Vec<_> = pictures.par_iter().map(Picture::encode).collect();
    let mut zip = ZipWriter::new(file);
    // The same bytes at any time of day.
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Stored)
        .last_modified_time(DateTime::default());
    for (picture, bytes) in pictures.iter().zip(encoded) {
        zip.start_file(picture.name, options).map_err(std::io::Error::other)?;
        zip.write_all(&bytes?)?;
    }
    zip.start_file(META, options).map_err(std::io::Error::other)?;
    zip.write_all(meta.to_string().as_bytes())?;
    zip.finish().map_err(std::io::Error::other)?;
    Ok(())
}

/// Fills means, quaternions and opacities, and collects the numbers of the codebooks.
fn fill(
    out: &Outgoing,
    ends: [[f64; 3]; 2],
    pictures: &mut [Picture; 5],
) -> std::io::Result<Numbers> {
    let [low, high, quats, _, sh0] = pictures;
    let floats = 3 * sh_coefficients(out.sh_degree);
    let mut numbers = Numbers {
        log_scales: Vec::with_capacity(3 * out.count),
        dc: Vec::with_capacity(3 * out.count),
        rest: Vec::with_capacity((floats - 3) * out.count),
    };
    let mut visitor = out.visitor();
    for (i, splat) in morton_order(out).into_iter().enumerate() {
        let g = visitor.at(splat as usize)?;
        let steps: [[u8; 2]; 3] = std::array::from_fn(|c| {
            let [min, max] = [ends[0][c], ends[1][c]];
            let unit = (symmetric_log(f64::from(g.mean[c])) - min) / (max - min);
            // All means in one plane: 0/0.
            let step =
                if unit.is_finite() { (unit * 65535.0).round().clamp(0.0, 65535.0) } else { 0.0 };
            (step as u16).to_le_bytes()
        });
        low.set(i, &steps.map(|s| s[0]));
        high.set(i, &steps.map(|s| s[1]));
        quats.set(i, &pack_rotation(g.quat));
        sh0.set(i, &[0, 0, 0, unit_byte(f64::from(g.opacity))]);
        numbers.log_scales.extend(g.scale.map(|s| f64::from(s).ln() as f32));
        numbers.dc.extend(&g.sh[..3]);
        numbers.rest.extend(&g.sh[3..floats]);
    }
    Ok(numbers)
}

/// Makes the description and the pictures of SH above degree 0.
fn palette_of(rest: &[f32], out: &Outgoing) -> (Value, [Picture; 2]) {
    let coefficients = sh_coefficients(out.sh_degree) - 1;
    let thousands = (out.count / PALETTE_MIN).max(1);
    let size = (PALETTE_MIN << thousands.ilog2()).min(PALETTE_MAX);
    let found = palette(rest, 3 * coefficients, size);
    let rows = found.centroids.len() / (3 * coefficients);
    let book = Codebook::of(&found.centroids);
    let (width, height) = (PALETTE_LINE * coefficients, rows.div_ceil(PALETTE_LINE));
    let name = "shN_centroids.webp";
    let mut pixels: Vec<u8> = found.centroids.iter().map(|v| book.code(*v)).collect();
    pixels.resize(3 * width * height, 0);
    let centroids = Picture { name, width, height, channels: 3, pixels };
    let mut labels = Picture::new("shN_labels.webp", 3, out.count);
    for (i, label) in found.labels.iter().enumerate() {
        let [low, high] = label.to_le_bytes();
        labels.set(i, &[low, high, 0]);
    }
    let meta = json!({
        "count": rows,
        "bands": out.sh_degree,
        "codebook": decimals(&book.values),
        "files": [centroids.name, labels.name],
    });
    (meta, [centroids, labels])
}

/// Returns the numbers whose shortest decimals are those of `values`.
fn decimals(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| v.to_string().parse().unwrap_or(f64::from(*v))).collect()
}

/// Returns the Gaussians that are written, along a Morton curve through their bounds.
fn morton_order(out: &Outgoing) -> Vec<u32> {
    let [min, max] = out.bounds.map(|end| end.map(f64::from));
    let key = |i: usize| {
        let mean = out.mean(i);
        (0..3).fold(0, |key, c| {
            let unit = (f64::from(mean[c]) - min[c]) / (max[c] - min[c]).max(f64::MIN_POSITIVE);
            // 21 bits an axis.
            key | spread((unit * 2_097_151.0) as u64) << c
        })
    };
    let mut order: Vec<(u64, u32)> = out.kept().map(|i| (key(i), i as u32)).collect();
    order.par_sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// Puts two zeros between the lowest 21 bits.
fn spread(v: u64) -> u64 {
    let mut v = v & 0x1f_ffff;
    for (shift, mask) in [
        (32, 0x1f_0000_0000_ffff),
        (16, 0x1f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        v = (v | v << shift) & mask;
    }
    v
}

fn symmetric_log(v: f64) -> f64 {
    v.signum() * v.abs().ln_1p()
}

fn pack_rotation(q: [f32; 4]) -> [u8; 4] {
    let mut largest = 0;
    for i in 1..4 {
        if q[i].abs() > q[largest].abs() {
            largest = i;
        }
    }
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let [a, b, c] = OTHERS[largest].map(|i| unit_byte(0.5 + 0.5 * SQRT_2 * sign * f64::from(q[i])));
    [a, b, c, LARGEST_W + largest as u8]
}
