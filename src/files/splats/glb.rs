//! Binary glTF with `KHR_gaussian_splatting` (ratified 2026): the writer.
//!
//! One POINTS primitive. `POSITION`; `KHR_gaussian_splatting:ROTATION` VEC4 unit, xyzw;
//! `:SCALE` VEC3 linear σ; `:OPACITY` after the sigmoid; `:SH_DEGREE_l_COEF_n` VEC3,
//! 3DGS signs, degrees complete, at most 3. `COLOR_0` is for viewers without the extension:
//! the colour of degree 0 in linear light (the sRGB curve undone), and the opacity as alpha.
//!
//! glTF is y-up, this crate y-down. The data keep this crate's axes and the node rotates
//! them, so that the numbers are exact and viewers show the scene upright. Attributes
//! follow one another, each with a buffer view of its own and without a stride.
//! `glb_read.rs` is the reader. Source: the extension's README, glTF 2.0 sections 3.6, 4.

use super::Up;
use super::gaussians::{Gaussian, Outgoing};
use crate::files::{Error, Result};
use serde_json::{Value, json};
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use subsplat_kernels::layout::sh_coefficients;
use subsplat_kernels::sh::C0;

pub use super::glb_read::parse_glb;

/// `glTF`.
pub(super) const MAGIC: [u8; 4] = *b"glTF";
/// Types of the two chunks, little-endian.
pub(super) const CHUNK_JSON: u32 = 0x4E4F_534A;
pub(super) const CHUNK_BIN: u32 = 0x004E_4942;
/// The extension's name, and the prefix of its attributes.
pub(super) const EXTENSION: &str = "KHR_gaussian_splatting";
/// Component types of glTF.
pub(super) const FLOAT: u64 = 5126;
pub(super) const UNSIGNED_SHORT: u64 = 5123;
/// `mode` of a primitive of points.
pub(super) const POINTS: u64 = 0;
/// Highest degree of the extension.
pub(super) const SH_DEGREE_MAX: usize = 3;
/// Gaussians per write.
const BLOCK: usize = 1 << 14;

/// An attribute to be written.
struct Attribute {
    name: String,
    kind: &'static str,
    component: u64,
    bytes: usize,
    put: fn(&Gaussian, usize, &mut Vec<u8>),
    /// Index of the SH coefficient, for SH attributes.
    index: usize,
}

/// The layout of a file, computed before the first byte is written.
pub(super) struct Plan {
    attributes: Vec<Attribute>,
    /// Offset of each attribute in the binary chunk.
    offsets: Vec<u64>,
    json: Vec<u8>,
    binary: u64,
}

fn floats(values: &[f32], to: &mut Vec<u8>) {
    values.iter().for_each(|v| to.extend(v.to_le_bytes()));
}

fn attributes(sh_degree: usize) -> Vec<Attribute> {
    let extended = |n: &str| format!("{EXTENSION}:{n}");
    let float =
        |name: String, kind, components: usize, put: fn(&Gaussian, usize, &mut Vec<u8>), index| {
            Attribute { name, kind, component: FLOAT, bytes: 4 * components, put, index }
        };
    let mut all = vec![
        float("POSITION".to_owned(), "VEC3", 3, |g, _, b| floats(&g.mean, b), 0),
        float(
            extended("ROTATION"),
            "VEC4",
            4,
            |g, _, b| floats(&[g.quat[1], g.quat[2], g.quat[3], g.quat[0]], b),
            0,
        ),
        float(extended("SCALE"), "VEC3", 3, |g, _, b| floats(&g.scale, b), 0),
        float(extended("OPACITY"), "SCALAR", 1, |g, _, b| floats(&[g.opacity], b), 0),
    ];
    for l in 0..=sh_degree {
        for n in 0..=2 * l {
            let name = extended(&format!("SH_DEGREE_{l}_COEF_{n}"));
            let put = |g: &Gaussian, i: usize, b: &mut Vec<u8>| floats(&g.sh[3 * i..3 * i + 3], b);
            all.push(float(name, "VEC3", 3, put, l * l + n));
        }
    }
    debug_assert_eq!(all.len(), 4 + sh_coefficients(sh_degree));
    all.push(Attribute {
        name: "COLOR_0".to_owned(),
        kind: "VEC4",
        component: UNSIGNED_SHORT,
        bytes: 8,
        put: fallback_colour,
        index: 0,
    });
    all
}

fn fallback_colour(g: &Gaussian, _: usize, to: &mut Vec<u8>) {
    let short = |v: f64| (v.clamp(0.0, 1.0) * 65535.0).round() as u16;
    for c in 0..3 {
        let display = (0.5 + C0 * f64::from(g.sh[c])).clamp(0.0, 1.0);
        to.extend(short(linear_from_srgb(display)).to_le_bytes());
    }
    to.extend(short(f64::from(g.opacity)).to_le_bytes());
}

/// Converts a display value to linear light (IEC 61966-2-1).
fn linear_from_srgb(v: f64) -> f64 {
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Returns the node's quaternion xyzw, from the data's axes to glTF's (y up, z back).
fn node_rotation(up: Up) -> Option<[f64; 4]> {
    match up {
        Up::Keep => Some([1.0, 0.0, 0.0, 0.0]),
        Up::Y => None,
        Up::Z => {
            Some([-std::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0, std::f64::consts::FRAC_1_SQRT_2])
        }
    }
}

impl Plan {
    /// Computes the layout of the file.
    ///
    /// # Errors
    /// More than 4 GiB, the limit of glTF.
    pub fn new(out: &Outgoing, up: Up, comments: &[String], path: &Path) -> Result<Self> {
        let attributes = attributes(out.sh_degree);
        let (mut offsets, mut binary) = (Vec::new(), 0u64);
        for a in &attributes {
            offsets.push(binary);
            // Every size is a multiple of 4, hence every offset.
            binary += a.bytes as u64 * out.count as u64;
        }
        let json = document(&attributes, &offsets, binary, out, up, comments);
        let mut json = json.to_string().into_bytes();
        while !json.len().is_multiple_of(4) {
            json.push(b' ');
        }
        let plan = Self { attributes, offsets, json, binary };
        if u32::try_from(plan.length()).is_err() {
            let got = format!("{} bytes for {} Gaussians", plan.length(), out.count);
            return Err(Error::format(path, "less than 4 GiB for .glb", got));
        }
        Ok(plan)
    }

    fn length(&self) -> u64 {
        12 + 8 + self.json.len() as u64 + 8 + self.binary
    }

    /// Writes the file in blocks of Gaussians, each attribute at its offset.
    pub fn write<F: Write + Seek>(&self, file: &mut F, out: &Outgoing) -> std::io::Result<()> {
        // `new` has checked that the lengths fit.
        let word = |v: u64| (v as u32).to_le_bytes();
        let mut head = MAGIC.to_vec();
        head.extend(word(2));
        head.extend(word(self.length()));
        head.extend(word(self.json.len() as u64));
        head.extend(CHUNK_JSON.to_le_bytes());
        head.extend(&self.json);
        head.extend(word(self.binary));
        head.extend(CHUNK_BIN.to_le_bytes());
        file.write_all(&head)?;
        let start = head.len() as u64;
        let mut visitor = out.visitor();
        let mut columns: Vec<Vec<u8>> = self.attributes.iter().map(|_| Vec::new()).collect();
        let (mut first, mut held) = (0u64, 0u64);
        for i in out.kept() {
            let g = visitor.at(i)?;
            for (a, column) in self.attributes.iter().zip(&mut columns) {
                (a.put)(g, a.index, column);
            }
            held += 1;
            if held == BLOCK as u64 || first + held == out.count as u64 {
                for ((a, column), offset) in
                    self.attributes.iter().zip(&mut columns).zip(&self.offsets)
                {
                    let at = start + offset + first * a.bytes as u64;
                    file.seek(SeekFrom::Start(at))?;
                    file.write_all(column)?;
                    column.clear();
                }
                (first, held) = (first + held, 0);
            }
        }
        Ok(())
    }
}

/// Makes buffer views, accessors, and the indices of the attributes.
fn layout(
    attributes: &[Attribute],
    offsets: &[u64],
    out: &Outgoing,
) -> (Vec<Value>, Vec<Value>, serde_json::Map<String, Value>) {
    const ARRAY_BUFFER: u32 = 34962;
    let (mut views, mut accessors) = (Vec::new(), Vec::new());
    let mut named = serde_json::Map::new();
    for (i, (a, offset)) in attributes.iter().zip(offsets).enumerate() {
        let length = a.bytes as u64 * out.count as u64;
        views.push(json!({
            "buffer": 0, "byteOffset": offset, "byteLength": length, "target": ARRAY_BUFFER
        }));
        let mut accessor = json!({
            "bufferView": i, "componentType": a.component, "count": out.count, "type": a.kind
        });
        if a.component != FLOAT {
            accessor["normalized"] = json!(true);
        }
        if i == 0 {
            // As f64, so that the decimal is exactly the stored f32.

            let wide = |v: [f32; 3]| v.map(f64::from);
            accessor["min"] = json!(wide(out.bounds[0]));
            accessor["max"] = json!(wide(out.bounds[1]));
        }
        accessors.push(accessor);
        named.insert(a.name.clone(), json!(i));
    }
    (views, accessors, named)
}

fn document(
    attributes: &[Attribute],
    offsets: &[u64],
    binary: u64,
    out: &Outgoing,
    up: Up,
    comments: &[String],
) -> Value {
    let (views, accessors, named) = layout(attributes, offsets, out);
    let mut node = json!({ "mesh": 0, "name": "splats" });
    if let Some(rotation) = node_rotation(up) {
        node["rotation"] = json!(rotation);
    }
    let mut asset = json!({
        "version": "2.0", "generator": format!("subsplat {}", env!("CARGO_PKG_VERSION"))
    });
    if !comments.is_empty() {
        asset["extras"] = json!({ "comments": comments });
    }
    json!({
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{
            "attributes": named,
            "mode": POINTS,
            "extensions": { EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance"
            } }
        }] }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": binary }]
    })
}
