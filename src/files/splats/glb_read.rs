//! Reader of `.glb` files with `KHR_gaussian_splatting`; `glb.rs` describes the layout.
//!
//! Reads every splat primitive of the scene under its node's transform (rotation,
//! translation, uniform scale) and converts glTF's axes (y up, z back) to this crate's.
//! Quantised attributes are read as the extension allows them. Counts, offsets, strides and
//! chunk lengths are compared with the bytes before anything is allocated.
//!
//! `KHR_gaussian_splatting_compression_spz_2` (a draft of 2026) and its two earlier names hold a
//! .spz in a buffer view. The numbers of the .spz are those of the attributes, without a change of
//! axes, as in cesium-native, the draft's one known implementation; both formats are y-up. The
//! draft's sentence on "left, up, front" axes is half a turn about y away from that. The writer
//! leaves the attributes uncompressed, since the draft demands version 2 of .spz.

use super::gaussians::{Decoded, HALF_TURN_X, Incoming, Similarity, transform, truncated, u32_at};
use super::glb::{
    CHUNK_BIN, CHUNK_JSON, EXTENSION, FLOAT, MAGIC, POINTS, SH_DEGREE_MAX, UNSIGNED_SHORT,
};
use super::spz;
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Largest depth of the node hierarchy.
const DEPTH_MAX: usize = 256;

/// Extensions that hold a .spz, newest first. They stand within [`EXTENSION`] or beside it.
const SPZ: [&str; 3] = [
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
];

/// Longest JSON chunk, bytes; the parsed document may take thirty times as much memory.
const JSON_MAX: usize = 16 << 20;

/// Reads a `.glb` from memory. `name` is for errors.
///
/// # Errors
/// Not glTF 2 binary, chunk lengths that do not fill the file, no splats, an accessor beyond
/// its buffer, a compressed or sparse one, a mirrored or sheared node, no Gaussian with finite
/// numbers and a rotation.
pub fn parse_glb(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    Ok(decode(bytes, name.as_ref())?.splats)
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    asset: Asset,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<BufferView>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
    generator: Option<String>,
    /// Read where it has the form of this crate's writer.
    #[serde(default)]
    extras: serde_json::Value,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
// Boxed: a hostile document may have millions of empty nodes.
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<Box<[f64; 16]>>,
    rotation: Option<Box<[f64; 4]>>,
    translation: Option<Box<[f64; 3]>>,
    scale: Option<Box<[f64; 3]>>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    attributes: BTreeMap<String, usize>,
    mode: Option<u64>,
    #[serde(default)]
    extensions: BTreeMap<String, Extension>,
}

/// Gaussians of a primitive.
struct Part {
    splats: Splats,
    /// Version of the .spz that held them.
    spz: Option<u32>,
}

/// The fields that decide whether the attributes are uncompressed.
#[derive(Deserialize)]
struct Extension {
    #[serde(default)]
    extensions: BTreeMap<String, serde_json::Value>,
    #[serde(rename = "bufferView")]
    buffer_view: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: u64,
    component_type: u64,
    #[serde(default)]
    normalized: bool,
    count: u64,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: u64,
    byte_length: u64,
    byte_stride: Option<u64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    uri: Option<String>,
    byte_length: u64,
}

struct File<'a> {
    path: &'a Path,
    document: Document,
    binary: &'a [u8],
}

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded> {
    let (json, binary) = chunks(bytes, path)?;
    let document: Document = serde_json::from_slice(json)
        .map_err(|e| Error::format(path, "a glTF 2.0 document in the JSON chunk", e.to_string()))?;
    let version = &document.asset.version;
    if version.split('.').next() != Some("2") {
        return Err(Error::format(path, "glTF version 2.x", format!("{version:?}")));
    }
    let asset = &document.asset;
    let mut comments: Vec<String> =
        asset.generator.iter().map(|g| format!("generator: {g}")).collect();
    let extras = asset.extras["comments"].as_array();
    comments.extend(extras.into_iter().flatten().filter_map(|c| Some(c.as_str()?.to_owned())));
    let file = File { path, document, binary };
    let (mut parts, mut flavour) = (Vec::new(), format!("glb {EXTENSION}"));
    // A Gaussian takes at least 14 bytes: more than one for each byte are instances without end.
    let mut budget = bytes.len();
    for (mesh, world) in file.instances()? {
        for part in file.mesh(mesh, &mut budget)? {
            let Part { mut splats, spz } = part;
            if let Some(version) = spz.filter(|_| parts.is_empty()) {
                flavour += &format!(", spz {version}");
            }
            transform(&mut splats, &file.similarity(world)?);
            parts.push(splats);
        }
    }
    let splats = join(parts, path)?;
    Decoded::new(splats, flavour, comments, Vec::new(), path)
}

/// Returns the JSON chunk and the binary one (empty where there is none).
fn chunks<'a>(bytes: &'a [u8], path: &Path) -> Result<(&'a [u8], &'a [u8])> {
    if !bytes.starts_with(&MAGIC) {
        let got = format!("{:02x?}", &bytes[..bytes.len().min(4)]);
        return Err(Error::format(path, "the magic glTF (.glb)", got));
    }
    let version = u32_at(bytes, 4, path)?;
    let length = u32_at(bytes, 8, path)? as usize;
    if version != 2 {
        return Err(Error::format(path, "glTF binary version 2", version.to_string()));
    }
    if length > bytes.len() {
        return Err(truncated(path, length as u64, bytes.len() as u64));
    }
    if length < bytes.len() {
        let expected = format!("the {length} bytes that the header gives");
        return Err(Error::format(path, expected, bytes.len().to_string()));
    }
    let chunk = |at: usize, kind: Option<(u32, &str)>| -> Result<(&'a [u8], usize)> {
        let size = u32_at(bytes, at, path)? as usize;
        let got = u32_at(bytes, at + 4, path)?;
        if let Some((_, name)) = kind.filter(|(kind, _)| got != *kind) {
            let expected = format!("a {name} chunk");
            let place = format!(" at byte {at}");
            return Err(Error::format(path, expected, format!("type {got:#010x}")).at(place));
        }
        let start = at + 8;
        let body = bytes
            .get(start..start.saturating_add(size))
            .ok_or_else(|| truncated(path, start as u64 + size as u64, bytes.len() as u64))?;
        Ok((body, start + size))
    };
    let (json, mut end) = chunk(12, Some((CHUNK_JSON, "JSON")))?;
    if json.len() > JSON_MAX {
        let got = json.len().to_string();
        return Err(Error::format(path, format!("at most {JSON_MAX} bytes of JSON"), got));
    }
    let mut binary = &[][..];
    if end < length {
        (binary, end) = chunk(end, Some((CHUNK_BIN, "BIN")))?;
    }
    // Chunks of other types follow these two, and readers ignore them (glTF 2.0, section 4.4).
    while end < length {
        (_, end) = chunk(end, None)?;
    }
    Ok((json, binary))
}

impl File<'_> {
    fn bad(&self, expected: impl Into<String>, got: impl Into<String>) -> Error {
        Error::format(self.path, expected, got)
    }

    fn item<'b, T>(&self, all: &'b [T], i: usize, what: &str) -> Result<&'b T> {
        all.get(i).ok_or_else(|| self.bad(format!("{what} 0 to {}", all.len()), i.to_string()))
    }

    /// Lists the meshes of the default scene with their world matrices.
    fn instances(&self) -> Result<Vec<(usize, DMat4)>> {
        let d = &self.document;
        let roots = if d.scenes.is_empty() {
            let mut root = vec![true; d.nodes.len()];
            for &child in d.nodes.iter().flat_map(|n| &n.children) {
                if let Some(r) = root.get_mut(child) {
                    *r = false;
                }
            }
            (0..d.nodes.len()).filter(|&n| root[n]).collect()
        } else {
            self.item(&d.scenes, d.scene.unwrap_or(0), "scene")?.nodes.clone()
        };
        let mut seen = vec![false; d.nodes.len()];
        let mut open: Vec<(usize, DMat4, usize)> =
            roots.into_iter().rev().map(|n| (n, DMat4::IDENTITY, 0)).collect();
        let mut found = Vec::new();
        while let Some((n, parent, depth)) = open.pop() {
            let node = self.item(&d.nodes, n, "node")?;
            if std::mem::replace(&mut seen[n], true) || depth > DEPTH_MAX {
                let expected = format!("a tree of nodes, at most {DEPTH_MAX} deep");
                return Err(self.bad(expected, format!("node {n} again, or deeper")));
            }
            let world = parent * self.local(node)?;
            found.extend(node.mesh.map(|m| (m, world)));
            open.extend(node.children.iter().rev().map(|&c| (c, world, depth + 1)));
        }
        Ok(found)
    }

    fn local(&self, node: &Node) -> Result<DMat4> {
        if let Some(matrix) = &node.matrix {
            return Ok(DMat4::from_cols_array(matrix));
        }
        let [x, y, z, w] = node.rotation.as_deref().copied().unwrap_or([0.0, 0.0, 0.0, 1.0]);
        let rotation = DQuat::from_xyzw(x, y, z, w);
        if !(0.99..=1.01).contains(&rotation.length()) {
            let got = format!("{x} {y} {z} {w}");
            return Err(self.bad("nodes rotated by a unit quaternion", got));
        }
        let vector = |v: &Option<Box<[f64; 3]>>, default: DVec3| {
            v.as_deref().map_or(default, |v| DVec3::from(*v))
        };
        Ok(DMat4::from_scale_rotation_translation(
            vector(&node.scale, DVec3::ONE),
            rotation.normalize(),
            vector(&node.translation, DVec3::ZERO),
        ))
    }

    /// Composes a node's matrix with the conversion to this crate's axes.
    fn similarity(&self, world: DMat4) -> Result<Similarity> {
        let linear = DMat3::from_mat4(world);
        let scale = linear.determinant().cbrt();
        let rotation = linear * scale.recip();
        let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
        let error = gram.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let translation = world.w_axis.truncate();
        if !(scale > 0.0 && error < 1e-4 && scale.is_finite() && translation.is_finite()) {
            let got = format!("scale {scale}, distance from a rotation {error:.1e}");
            return Err(self.bad("nodes that rotate, move and scale uniformly", got));
        }
        // The SH rotation needs a matrix that is orthonormal to rounding.
        let rotation = DMat3::from_quat(DQuat::from_mat3(&rotation).normalize());
        Ok(Similarity {
            // The cube root rounds a unit scale.
            scale: if (scale - 1.0).abs() < 1e-9 { 1.0 } else { scale },
            rotation: HALF_TURN_X * rotation,
            translation: HALF_TURN_X * translation,
        })
    }

    fn mesh(&self, mesh: usize, budget: &mut usize) -> Result<Vec<Part>> {
        let mesh = self.item(&self.document.meshes, mesh, "mesh")?;
        let mut parts = Vec::new();
        for primitive in &mesh.primitives {
            if let Some(view) = self.spz_view(primitive)? {
                let (splats, version) = spz::decode_as_stored(self.view_bytes(view)?, self.path)
                    .map_err(|e| e.at(" the .spz within"))?;
                self.spend(splats.len(), budget)?;
                parts.push(Part { splats, spz: Some(version) });
                continue;
            }
            let Some(extension) = primitive.extensions.get(EXTENSION) else { continue };
            if let Some(nested) = extension.extensions.keys().next() {
                return Err(self.bad("attributes without compression", nested.clone()));
            }
            if primitive.mode != Some(POINTS) {
                let got = format!("mode {:?}", primitive.mode);
                return Err(self.bad("splats in a primitive of points", got));
            }
            parts.push(Part { splats: self.primitive(primitive, budget)?, spz: None });
        }
        Ok(parts)
    }

    /// Returns the buffer view with the .spz of `primitive`, if one of [`SPZ`] names it.
    fn spz_view(&self, primitive: &Primitive) -> Result<Option<usize>> {
        let base = primitive.extensions.get(EXTENSION);
        for name in SPZ {
            let nested = base.and_then(|e| e.extensions.get(name));
            let view = match (nested, primitive.extensions.get(name)) {
                (Some(own), _) => own["bufferView"].as_u64().and_then(|i| usize::try_from(i).ok()),
                (None, Some(own)) => own.buffer_view,
                (None, None) => continue,
            };
            let view = view.ok_or_else(|| self.bad(format!("a bufferView of {name}"), "none"))?;
            return Ok(Some(view));
        }
        Ok(None)
    }

    /// Returns buffer view `i` with the length of its buffer, which is the file's own BIN chunk.
    fn view(&self, i: usize) -> Result<(&BufferView, u64)> {
        let view = self.item(&self.document.buffer_views, i, "bufferView")?;
        let buffer = self.item(&self.document.buffers, view.buffer, "buffer")?;
        if view.buffer != 0 || buffer.uri.is_some() {
            return Err(self.bad("data in the file's own BIN chunk", "another buffer"));
        }
        // The chunk is padded to a multiple of 4 (glTF 2.0, section 3.6.1.2).
        let have = buffer.byte_length;
        if (self.binary.len() as u64).checked_sub(have).is_none_or(|padding| padding > 3) {
            let got = self.binary.len().to_string();
            return Err(self.bad(format!("{have} bytes in the BIN chunk"), got));
        }
        Ok((view, have))
    }

    fn view_bytes(&self, i: usize) -> Result<&[u8]> {
        let (view, have) = self.view(i)?;
        let end = view.byte_offset.checked_add(view.byte_length).filter(|end| *end <= have);
        let end = end.ok_or_else(|| {
            let got = format!("{} bytes at byte {}", view.byte_length, view.byte_offset);
            self.bad(format!("bufferView {i} within {have} bytes"), got)
        })?;
        Ok(&self.binary[view.byte_offset as usize..end as usize])
    }

    /// Takes `count` Gaussians from `budget`.
    fn spend(&self, count: usize, budget: &mut usize) -> Result<()> {
        *budget = budget
            .checked_sub(count)
            .ok_or_else(|| self.bad("fewer Gaussians than bytes", "instances of instances"))?;
        Ok(())
    }

    fn primitive(&self, primitive: &Primitive, budget: &mut usize) -> Result<Splats> {
        let find = |name: &str, components: usize| -> Result<Column> {
            let i = primitive.attributes.get(name).copied();
            let i = i.ok_or_else(|| self.bad(format!("attribute {name}"), "none"))?;
            self.column(i, name, components)
        };
        let own = |n: &str| format!("{EXTENSION}:{n}");
        let position = find("POSITION", 3)?;
        let quat = find(&own("ROTATION"), 4)?;
        let scale = find(&own("SCALE"), 3)?;
        let opacity = find(&own("OPACITY"), 1)?;
        let has = |l: usize| {
            (0..=2 * l).any(|n| {
                primitive.attributes.contains_key(&own(&format!("SH_DEGREE_{l}_COEF_{n}")))
            })
        };
        let sh_degree = (0..=SH_DEGREE_MAX).rev().find(|&l| has(l)).unwrap_or(0);
        let mut sh = Vec::new();
        for l in 0..=sh_degree {
            for n in 0..=2 * l {
                sh.push(find(&own(&format!("SH_DEGREE_{l}_COEF_{n}")), 3)?);
            }
        }
        let count = position.count;
        for column in [&quat, &scale, &opacity].into_iter().chain(&sh) {
            if column.count != count {
                let got = column.count.to_string();
                return Err(self.bad(format!("{count} elements in each attribute"), got));
            }
        }
        self.spend(count, budget)?;
        let mut incoming = Incoming::with_capacity(count, sh_degree);
        for i in 0..count {
            let [x, y, z, w] = quat.get(i);
            let [px, py, pz, _] = position.get(i);
            let [a, b, c, _] = scale.get(i);
            let [alpha, ..] = opacity.get(i);
            if !(0.0..=1.0).contains(&alpha) && alpha.is_finite() {
                let place = format!(" splat {i}");
                return Err(self.bad("an opacity in [0, 1]", alpha.to_string()).at(place));
            }
            if [a, b, c].iter().any(|s| *s < 0.0) {
                let got = format!("{a} {b} {c}: logarithms, as early drafts had?");
                let place = format!(" splat {i}");
                return Err(self.bad("scales of 0 or more, linear", got).at(place));
            }
            let set = incoming.push([px, py, pz], [w, x, y, z], [a, b, c], alpha);
            for (h, column) in set.chunks_exact_mut(3).zip(&sh) {
                h.copy_from_slice(&column.get(i)[..3]);
            }
        }
        incoming.into_splats(self.path)
    }

    /// Returns an accessor after a check that every element lies within the binary chunk.
    fn column(&self, accessor: usize, name: &str, components: usize) -> Result<Column<'_>> {
        let d = &self.document;
        let a = self.item(&d.accessors, accessor, "accessor")?;
        let at = |e: Error| e.at(format!(" attribute {name}"));
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"].get(components - 1).copied().unwrap_or("");
        if a.kind != kind || a.sparse.is_some() {
            let got = if a.sparse.is_some() { "a sparse one" } else { a.kind.as_str() };
            return Err(at(self.bad(format!("a plain accessor of {kind}"), got)));
        }
        let component = Component::of(a).ok_or_else(|| {
            at(self
                .bad("floats, or bytes and shorts of 8 or 16 bits", a.component_type.to_string()))
        })?;
        let view = a.buffer_view.ok_or_else(|| at(self.bad("a bufferView", "none")))?;
        let (view, have) = self.view(view).map_err(at)?;
        let element = (component.size() * components) as u64;
        let stride = view.byte_stride.unwrap_or(element);
        let start = u128::from(view.byte_offset) + u128::from(a.byte_offset);
        let last = u128::from(stride) * u128::from(a.count.saturating_sub(1));
        let end = start + last + u128::from(element);
        let view_end = u128::from(view.byte_offset) + u128::from(view.byte_length);
        if stride < element || a.count == 0 || end > view_end || view_end > u128::from(have) {
            let expected = format!("1 or more elements of {element} bytes within {have}");
            let got = format!("{} with stride {stride} up to byte {end}", a.count);
            return Err(at(self.bad(expected, got)));
        }
        Ok(Column {
            bytes: &self.binary[start as usize..],
            stride: stride as usize,
            count: a.count as usize,
            components,
            component,
        })
    }
}

/// Storage type of a component.
#[derive(Clone, Copy)]
enum ComponentType {
    Float,
    Byte,
    UnsignedByte,
    Short,
    UnsignedShort,
}

/// Storage type of a component, and the divisor of its values.
#[derive(Clone, Copy)]
struct Component {
    kind: ComponentType,
    /// Value of 1.0 in a normalised accessor; 1 in others.
    one: f32,
}

impl Component {
    fn of(a: &Accessor) -> Option<Self> {
        let (kind, one) = match a.component_type {
            FLOAT => (ComponentType::Float, 1.0),
            5120 => (ComponentType::Byte, 127.0),
            5121 => (ComponentType::UnsignedByte, 255.0),
            5122 => (ComponentType::Short, 32767.0),
            UNSIGNED_SHORT => (ComponentType::UnsignedShort, 65535.0),
            _ => return None,
        };
        Some(Self { kind, one: if a.normalized { one } else { 1.0 } })
    }

    fn size(self) -> usize {
        match self.kind {
            ComponentType::Float => 4,
            ComponentType::Byte | ComponentType::UnsignedByte => 1,
            ComponentType::Short | ComponentType::UnsignedShort => 2,
        }
    }

    /// Decodes a value. Two codes of a signed normalised type mean −1 (glTF 2.0, section
    /// 3.11).
    fn value(self, b: &[u8]) -> f32 {
        let v = match self.kind {
            ComponentType::Float => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            ComponentType::Byte => f32::from(b[0] as i8),
            ComponentType::UnsignedByte => f32::from(b[0]),
            ComponentType::Short => f32::from(i16::from_le_bytes([b[0], b[1]])),
            ComponentType::UnsignedShort => f32::from(u16::from_le_bytes([b[0], b[1]])),
        };
        if self.one == 1.0 { v } else { (v / self.one).max(-1.0) }
    }
}

struct Column<'a> {
    bytes: &'a [u8],
    stride: usize,
    count: usize,
    /// Components per element, 1 to 4.
    components: usize,
    component: Component,
}

impl Column<'_> {
    /// Decodes element `i`; further components are zero.
    fn get(&self, i: usize) -> [f32; 4] {
        let mut out = [0.0; 4];
        let at = i * self.stride;
        for (c, v) in out.iter_mut().enumerate().take(self.components) {
            *v = self.component.value(&self.bytes[at + c * self.component.size()..]);
        }
        out
    }
}

/// Joins all parts to one set of the highest SH degree among them.
fn join(mut parts: Vec<Splats>, path: &Path) -> Result<Splats> {
    if parts.len() == 1 {
        return Ok(parts.remove(0));
    }
    let Some(sh_degree) = parts.iter().map(|p| p.sh_degree).max() else {
        let expected = format!("a primitive with {EXTENSION} in the scene");
        return Err(Error::format(path, expected, "none"));
    };
    let mut incoming = Incoming::with_capacity(parts.iter().map(Splats::len).sum(), sh_degree);
    for part in &parts {
        for i in 0..part.len() {
            let set =
                incoming.push(part.mean(i), part.quat_wxyz(i), part.scale(i), part.opacity(i));
            let own = part.sh_of(i);
            set[..own.len()].copy_from_slice(own);
        }
    }
    incoming.into_splats(path)
}
