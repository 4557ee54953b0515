//! The `.ply` of 3DGS (INRIA): writer, and reader of every variant in use.
//!
//! Layout: one element `vertex` with float properties `x y z`, `nx ny nz` (zero),
//! `f_dc_0..2`, `f_rest_*` channel-major (all of R, then G, then B), `opacity` before
//! the sigmoid, `scale_0..2` = ln σ, `rot_0..3` = wxyz. World frame throughout.
//!
//! SH degree: 3 by default, since viewers expect 45 `f_rest`: lower degrees are padded with
//! zeros, which the reader drops again, and the network's degree 4 is dropped. Gains and residuals of children are folded into their coefficients
//! (`gaussians.rs`).
//!
//! The reader accepts ascii and both byte orders, any property order and number type, 0, 9,
//! 24, 45 or 72 `f_rest`, and `red green blue` in place of `f_dc` (nerfstudio). It applies
//! `filter_3D` (Mip-Splatting), skips other elements, and says in notes which vertex properties
//! and how many bytes at the end it does not read. Dialects:
//!
//! * Without `scale_2`: the discs of 2DGS. σ₂ = 1e-6, the value that its authors give for other
//!   viewers (hbb1/2d-gaussian-splatting, issue 94).
//! * Elements `vertex_0`, `vertex_1`, …: one for each SH degree (graphdeco-inria/reduced-3dgs).
//!   Its 16-bit files declare halves as `short`, since plyfile has no half type: where all of `x y
//!   z`, `opacity`, `scale_*` and `rot_*` are 16-bit integers, they are the bits of halves. Its files
//!   with codebooks are refused.
//!
//! Positions of doubles or text far from the origin become relative to their middle (`far.rs`).
//!
//! `compressed_ply.rs` reads PlayCanvas' packed files.

use super::gaussians::{Decoded, Incoming, Outgoing, dc_from_colour, logit, sigmoid};
use super::ply_container::{Element, Encoding, Header, Scalar, Source};
use super::{SaveOptions, Up, compressed_ply, far};
use crate::files::{Error, Result};
use crate::scene::splats::Splats;
use glam::DVec3;
use half::f16;
use std::io::{BufRead, Write};
use std::path::Path;

/// Number of `f_rest` properties by SH degree.
pub(super) const REST_COUNTS: [usize; 5] = [0, 9, 24, 45, 72];
/// σ of the third axis of 2DGS, world units.
const DISC: f64 = 1e-6;
/// Element of files with codebooks (reduced-3dgs).
const CODEBOOKS: &str = "codebook_centers";
/// Gaussians per write: about 250 KiB at degree 3.
const BLOCK: usize = 1024;
/// Property of Mip-Splatting: standard deviation of the filter of each Gaussian, world units.
const FILTER: &str = "filter_3D";
/// Properties without a note: normals, which files of 3DGS leave zero, and colours for viewers
/// of points, beside `f_dc` and `opacity`.
const REDUNDANT: [&str; 7] = ["nx", "ny", "nz", "red", "green", "blue", "alpha"];
/// Most names in a note, and the characters of a name.
const NAMES_MAX: usize = 12;
const NAME_CHARS_MAX: usize = 40;

/// Reads a `.ply` from memory: the plain layout of 3DGS or PlayCanvas' packed one.
/// `name` is for errors.
///
/// # Errors
/// Not a PLY, not a splat file, a truncated file, a count that the bytes do not bear out, no
/// Gaussian with finite numbers and a rotation.
pub fn parse_ply(bytes: &[u8], name: impl AsRef<Path>) -> Result<Splats> {
    let mut reader = bytes;
    Ok(decode(&mut reader, bytes.len() as u64, name.as_ref())?.splats)
}

/// Reads a file of `length` bytes from `reader`.
pub(super) fn decode(reader: &mut dyn BufRead, length: u64, path: &Path) -> Result<Decoded> {
    let mut source = Source::new(reader, length, path);
    let header = Header::read(&mut source)?;
    if compressed_ply::is_compressed(&header) {
        return compressed_ply::decode(header, &mut source);
    }
    let parts = vertex_elements(&header, path)?;
    let (mut incoming, mut notes) = (None, Vec::new());
    let is_exact = header.encoding == Encoding::Ascii
        || parts.iter().any(|&i| has_double_positions(&header.elements[i]));
    let mut places = is_exact.then(Vec::new);
    for (i, element) in header.elements.iter().enumerate() {
        if !parts.contains(&i) {
            header.rows(element, &mut source, |_, _| Ok(()))?;
            continue;
        }
        let layout = Layout::of(element, path)?;
        let count = header.checked_count(element, &source)?;
        let incoming = incoming.get_or_insert_with(|| Incoming::with_capacity(count, 0));
        read_vertices(&header, element, &layout, &mut source, incoming, places.as_mut())?;
        for note in layout.notes(element) {
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    }
    notes.extend(source.finish(header.encoding)?);
    let incoming = incoming.ok_or_else(|| Error::format(path, "an element `vertex`", "none"))?;
    let mut splats = incoming.into_splats(path)?;
    let mut comments = header.comments;
    notes.extend(match places {
        Some(places) => far::move_to_origin(&mut splats, &places, &mut comments),
        None => far::note_of_lost_digits(&splats),
    });
    let flavour = format!("ply {}", header.encoding.name());
    Decoded::new(splats, flavour, comments, notes, path)
}

/// Returns whether an element has positions of 64 bits.
fn has_double_positions(element: &Element) -> bool {
    let position = |name: &&str| element.position(name).map(|i| element.properties[i].kind);
    ["x", "y", "z"].iter().filter_map(position).any(|kind| kind == Scalar::F64)
}

/// Returns the indices of the elements with Gaussians: the first `vertex`, else all of `vertex_0`,
/// `vertex_1`, ….
fn vertex_elements(header: &Header, path: &Path) -> Result<Vec<usize>> {
    if let Some(i) = header.elements.iter().position(|e| e.name == "vertex") {
        return Ok(vec![i]);
    }
    if header.elements.iter().any(|e| e.name == CODEBOOKS) {
        let expected = "numbers, not indices into codebooks: save the file without quantisation";
        return Err(Error::format(path, expected, format!("an element `{CODEBOOKS}`")));
    }
    let group = |name: &str| {
        name.strip_prefix("vertex_").is_some_and(|degree| degree.parse::<u32>().is_ok())
    };
    let all = header.elements.iter().enumerate();
    Ok(all.filter(|(_, e)| group(&e.name)).map(|(i, _)| i).collect())
}

/// Names the properties of `element` that are neither read nor redundant, for a note.
pub(super) fn note_of_unread(element: &Element, is_read: impl Fn(usize) -> bool) -> Option<String> {
    let all = element.properties.iter().enumerate();
    let mut names = all.filter_map(|(i, p)| {
        let unread = !is_read(i) && !REDUNDANT.contains(&p.name.as_str());
        unread.then(|| p.name.chars().take(NAME_CHARS_MAX).flat_map(char::escape_debug))
    });
    let shown: Vec<String> = names.by_ref().take(NAMES_MAX).map(String::from_iter).collect();
    let more = match names.count() {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    (!shown.is_empty())
        .then(|| format!("vertex properties that are not read: {}{more}", shown.join(", ")))
}

/// Applies Mip-Splatting's filter of standard deviation `filter`, world units: σ' = √(σ² + f²) on
/// each axis. Returns σ' and the factor Πσ / Πσ' of the opacity, which keeps the Gaussian's
/// integral. Source: Yu et al., "Mip-Splatting", 2024, section 5.1, and the authors' program,
/// which stores σ and the opacity without the filter and applies it when it renders.
fn filtered(scale: [f64; 3], filter: f64) -> ([f64; 3], f64) {
    // The same bits as without the property; also no 0/0 where σ is zero.
    if filter == 0.0 {
        return (scale, 1.0);
    }
    let wide = scale.map(|s| (s * s + filter * filter).sqrt());
    let factor = scale.iter().zip(wide).map(|(s, w)| s / w).product();
    (wide, factor)
}

/// Indices of the properties of a row.
struct Layout {
    mean: [usize; 3],
    scale: [usize; 2],
    /// `scale_2`; without it the Gaussians are discs.
    thickness: Option<usize>,
    quat: [usize; 4],
    opacity: usize,
    dc: [usize; 3],
    /// Divisor to [0, 1] where `red green blue` stand in place of `f_dc`.
    colour_range: Option<f64>,
    rest: Vec<usize>,
    /// [`FILTER`].
    filter: Option<usize>,
    /// The 16-bit integers are the bits of halves.
    half_bits: bool,
}

impl Layout {
    fn of(element: &Element, path: &Path) -> Result<Self> {
        let mut missing = Vec::new();
        let mut find = |name: &str| {
            element.position(name).unwrap_or_else(|| {
                missing.push(name.to_owned());
                0
            })
        };
        let mean = ["x", "y", "z"].map(&mut find);
        let scale = ["scale_0", "scale_1"].map(&mut find);
        let quat = ["rot_0", "rot_1", "rot_2", "rot_3"].map(&mut find);
        let opacity = find("opacity");
        let colours = ["red", "green", "blue"].map(|n| element.position(n));
        let (dc, colour_range) = match colours {
            [Some(r), Some(g), Some(b)] if element.position("f_dc_0").is_none() => {
                let range = match element.properties[r].kind {
                    Scalar::F16 | Scalar::F32 | Scalar::F64 => 1.0,
                    Scalar::U16 => 65535.0,
                    _ => 255.0,
                };
                ([r, g, b], Some(range))
            }
            _ => (["f_dc_0", "f_dc_1", "f_dc_2"].map(&mut find), None),
        };
        if !missing.is_empty() {
            let what = if missing.len() >= 7 { "; a point cloud or mesh, not splats?" } else { "" };
            let got = format!("a vertex without {}{what}", missing.join(", "));
            return Err(Error::format(path, "the properties of a Gaussian splat file", got));
        }
        let is_rest = |n: &str| n.strip_prefix("f_rest_").is_some_and(|k| k.parse::<u32>().is_ok());
        let named = element.properties.iter().filter(|p| is_rest(&p.name)).count();
        let rest: Vec<usize> =
            (0..named).map_while(|i| element.position(&format!("f_rest_{i}"))).collect();
        if !REST_COUNTS.contains(&named) || named != rest.len() {
            let got = format!("{named}, of which {} in sequence", rest.len());
            return Err(Error::format(path, "0, 9, 24, 45 or 72 properties f_rest_0, …", got));
        }
        let filter = element.position(FILTER);
        let thickness = element.position("scale_2");
        let is_16_bit =
            |i: &usize| matches!(element.properties[*i].kind, Scalar::I16 | Scalar::U16);
        let half_bits = [&mean[..], &scale, &quat, &[opacity]].concat().iter().all(is_16_bit);
        Ok(Self {
            mean,
            scale,
            thickness,
            quat,
            opacity,
            dc,
            colour_range,
            rest,
            filter,
            half_bits,
        })
    }

    fn reads(&self, i: usize) -> bool {
        let Self { mean, scale, thickness, quat, opacity, dc, rest, filter, .. } = self;
        [&mean[..], scale, quat, dc, rest].iter().any(|all| all.contains(&i))
            || *opacity == i
            || [filter, thickness].contains(&&Some(i))
    }

    /// Returns property `i` of a row `v`.
    fn value(&self, element: &Element, v: &[f64], i: usize) -> f64 {
        if !self.half_bits {
            return v[i];
        }
        match element.properties[i].kind {
            Scalar::I16 => f64::from(f16::from_bits(v[i] as i16 as u16)),
            Scalar::U16 => f64::from(f16::from_bits(v[i] as u16)),
            _ => v[i],
        }
    }

    /// Notes on what is applied and what is not read.
    fn notes(&self, element: &Element) -> Vec<String> {
        let filter = self.filter.map(|_| {
            format!("the property {FILTER} (Mip-Splatting) is applied to sizes and opacities")
        });
        let disc = self.thickness.is_none().then(|| {
            format!(
                "without scale_2 the splats are flat discs (2DGS); they get a thickness of {DISC} of \
                 the scene's unit"
            )
        });
        let halves = self.half_bits.then(|| {
            "the 16-bit integers of x, y, z, scale, rot and opacity are read as half-precision \
             floats, which reduced-3dgs stores in this way"
                .to_owned()
        });
        let codes = self.note_of_codes(element);
        let notes = [filter, disc, halves, codes, note_of_unread(element, |i| self.reads(i))];
        notes.into_iter().flatten().collect()
    }

    /// Names the properties whose integers are more likely codes than values.
    fn note_of_codes(&self, element: &Element) -> Option<String> {
        let Self { scale, thickness, quat, opacity, rest, .. } = self;
        let dc = if self.colour_range.is_none() { &self.dc[..] } else { &[] };
        let all = [&scale[..], quat, dc, rest, &[*opacity]].concat();
        let is_code = |i: &&usize| match element.properties[**i].kind {
            Scalar::F16 | Scalar::F32 | Scalar::F64 => false,
            Scalar::I16 | Scalar::U16 => !self.half_bits,
            _ => true,
        };
        let mut codes = all.iter().chain(thickness).filter(is_code);
        let first = &element.properties[*codes.next()?].name;
        let more = match codes.count() {
            0 => String::new(),
            n => format!(" and {n} more"),
        };
        Some(format!("the integers of {first}{more} are taken as values, not as codes"))
    }
}

/// Reads the rows of `element` into `incoming`, and the positions with all their digits into `places`.
fn read_vertices(
    header: &Header,
    element: &Element,
    layout: &Layout,
    source: &mut Source,
    incoming: &mut Incoming,
    mut places: Option<&mut Vec<DVec3>>,
) -> Result<()> {
    let mut rest = vec![0.0f32; layout.rest.len()];
    header.rows(element, source, |_, row| {
        let v = |i: usize| layout.value(element, row, i);
        for (r, &i) in rest.iter_mut().zip(&layout.rest) {
            *r = v(i) as f32;
        }
        // Degrees that are zero in every row take no memory and no time.
        incoming.raise_degree(used_degree(&rest));
        let [a, b] = layout.scale.map(|i| v(i).exp());
        let c = layout.thickness.map_or_else(|| DISC.min(a).min(b), |i| v(i).exp());
        let (scale, factor) = filtered([a, b, c], layout.filter.map_or(0.0, v));
        if let Some(places) = &mut places {
            places.push(DVec3::from(layout.mean.map(v)));
        }
        let sh = incoming.push(
            layout.mean.map(|i| v(i) as f32),
            layout.quat.map(|i| v(i) as f32),
            scale.map(|s| s as f32),
            (sigmoid(v(layout.opacity) as f32) * factor) as f32,
        );
        for (h, i) in sh.iter_mut().zip(layout.dc) {
            *h = match layout.colour_range {
                None => v(i) as f32,
                Some(range) => dc_from_colour(v(i) / range),
            };
        }
        rest_to_set(&rest, sh);
        Ok(())
    })
}

/// Lowest SH degree that holds all of channel-major `f_rest` that is not zero.
fn used_degree(rest: &[f32]) -> usize {
    let per_channel = rest.len() / 3;
    let last = (0..per_channel).rev().find(|j| (0..3).any(|c| rest[c * per_channel + j] != 0.0));
    last.map_or(0, |j| (j + 1).isqrt())
}

/// Writes channel-major `f_rest[3, D − 1]` to a set `[D, 3]` after its constant term.
pub(super) fn rest_to_set(rest: &[f32], set: &mut [f32]) {
    let per_channel = rest.len() / 3;
    for (j, h) in set[3..].chunks_exact_mut(3).enumerate().take(per_channel) {
        for (c, v) in h.iter_mut().enumerate() {
            *v = rest[c * per_channel + j];
        }
    }
}

/// Writes the header and every Gaussian, block by block.
pub(super) fn write(
    file: &mut dyn Write,
    out: &Outgoing,
    options: &SaveOptions,
) -> std::io::Result<()> {
    // Readers assert the 45 values of degree 3, so a lower degree is padded with zeros unless the
    // caller asks for it.
    let rests = REST_COUNTS[out.sh_degree.max(options.sh_degree.unwrap_or(3).min(3))];
    file.write_all(header(out.count, rests, options).as_bytes())?;
    let mut block = Vec::with_capacity(BLOCK * 4 * (17 + rests));
    let mut visitor = out.visitor();
    for (n, i) in out.kept().enumerate() {
        let g = visitor.at(i)?;
        let mut put = |v: f32| block.extend_from_slice(&v.to_le_bytes());
        g.mean.into_iter().chain([0.0; 3]).for_each(&mut put);
        g.sh[..3].iter().for_each(|v| put(*v));
        for c in 0..3 {
            (1..=rests / 3).for_each(|j| put(g.sh[3 * j + c]));
        }
        put(logit(g.opacity));
        g.scale.into_iter().for_each(|s| put(f64::from(s).ln() as f32));
        g.quat.into_iter().for_each(&mut put);
        if n % BLOCK == BLOCK - 1 {
            file.write_all(&block)?;
            block.clear();
        }
    }
    file.write_all(&block)
}

/// Returns whether a comment is one of those that every written file begins with. They describe that file
/// alone, and a copy of the scene gets its own.
pub fn is_own_comment(comment: &str) -> bool {
    let version = |text: &str| text.starts_with(|c: char| c.is_ascii_digit());
    ["axes: ", "units: ", "rot = "].iter().any(|key| comment.starts_with(key))
        || comment.strip_prefix("subsplat ").is_some_and(version)
}

fn header(count: usize, rests: usize, options: &SaveOptions) -> String {
    let axes = match options.up {
        Up::Keep => "+x right, +y down, +z forward (OpenCV); up is -y",
        Up::Y => "+x right, +y up, +z backward (OpenGL); up is +y",
        Up::Z => "+x right, +y forward, +z up; up is +z",
    };
    let mut lines = vec![
        "ply".to_owned(),
        "format binary_little_endian 1.0".to_owned(),
        format!("comment subsplat {}", env!("CARGO_PKG_VERSION")),
        format!("comment axes: {axes}"),
        "comment units: those of the input poses; scale = ln sigma, opacity = logit".to_owned(),
        "comment rot = wxyz, world; SH standard 3DGS signs, f_rest channel-major".to_owned(),
    ];
    for comment in &options.comments {
        lines.extend(comment.split(['\n', '\r']).map(|l| format!("comment {l}")));
    }
    lines.push(format!("element vertex {count}"));
    let mut property = |name: &str| lines.push(format!("property float {name}"));
    for name in ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] {
        property(name);
    }
    (0..rests).for_each(|i| property(&format!("f_rest_{i}")));
    for name in ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"] {
        property(name);
    }
    lines.push("end_header\n".to_owned());
    lines.join("\n")
}
