//! Reader of PlayCanvas' `.compressed.ply` (SuperSplat, splat-transform): 16 bytes per
//! Gaussian, quantised within the bounds of its chunk of 256.
//!
//! Element `chunk`: bounds of position, ln σ and (newer files) colour. Element
//! `vertex`: `packed_position` and `packed_scale` 11+10+11 bits, `packed_rotation` 2
//! bits for the largest component (order wxyz) and 3×10 for the others, scaled by
//! √2; `packed_color` RGBA bytes, A the opacity after the sigmoid. Optional element
//! `sh`: one byte per coefficient over [−4, 4], channel-major as `f_rest_*`.

use super::gaussians::{Decoded, Incoming, dc_from_colour};
use super::ply::{REST_COUNTS, note_of_unread, rest_to_set};
use super::ply_container::{Element, Header, Scalar, Source};
use crate::files::{Error, Result};

/// Gaussians per chunk.
const CHUNK: usize = 256;

const BOUNDS: [&str; 12] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
];
const COLOUR_BOUNDS: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
const PACKED: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// Reports whether `header` is of this kind.
pub(super) fn is_compressed(header: &Header) -> bool {
    header.elements.iter().any(|e| e.name == "vertex" && e.position(PACKED[0]).is_some())
}

/// Bounds of a chunk: smallest and largest position, ln σ, colour.
struct Chunk {
    position: [[f64; 3]; 2],
    log_scale: [[f64; 3]; 2],
    colour: [[f64; 3]; 2],
}

/// Reads the data after `header`.
pub(super) fn decode(header: Header, source: &mut Source) -> Result<Decoded> {
    let path = source.path;
    let mut chunks = Vec::new();
    let mut incoming: Option<Incoming> = None;
    let rests = match header.elements.iter().find(|e| e.name == "sh") {
        None => 0,
        Some(e) => (0..).take_while(|i| e.position(&format!("f_rest_{i}")).is_some()).count(),
    };
    let Some(sh_degree) = REST_COUNTS.iter().position(|&n| n == rests) else {
        let got = rests.to_string();
        return Err(Error::format(path, "0, 9, 24, 45 or 72 `f_rest` properties", got));
    };
    for element in &header.elements {
        match element.name.as_str() {
            "chunk" => chunks = read_chunks(&header, element, source)?,
            "vertex" => {
                incoming = Some(read_vertices(&header, element, source, &chunks, sh_degree)?)
            }
            "sh" => read_sh(&header, element, source, incoming.as_mut(), rests)?,
            _ => header.rows(element, source, |_, _| Ok(()))?,
        }
    }
    let after = source.finish(header.encoding)?;
    let incoming = incoming.ok_or_else(|| Error::format(path, "an element `vertex`", "none"))?;
    let splats = incoming.into_splats(path)?;
    let flavour = format!("compressed ply {}", header.encoding.name());
    let vertex = header.elements.iter().find(|e| e.name == "vertex");
    let packed = |i: usize, e: &Element| PACKED.contains(&e.properties[i].name.as_str());
    let unread = vertex.and_then(|e| note_of_unread(e, |i| packed(i, e)));
    let notes = [unread, after].into_iter().flatten().collect();
    Decoded::new(splats, flavour, header.comments, notes, path)
}

fn need(element: &Element, name: &str, kinds: &[Scalar], source: &Source) -> Result<usize> {
    let found = element.position(name).filter(|&i| kinds.contains(&element.properties[i].kind));
    found.ok_or_else(|| {
        let expected = format!("property `{name}` ({:?}) of element `{}`", kinds, element.name);
        Error::format(source.path, expected, "none of that type")
    })
}

fn read_chunks(header: &Header, element: &Element, source: &mut Source) -> Result<Vec<Chunk>> {
    let float = [Scalar::F32, Scalar::F64];
    let mut at = [0; 12];
    for (slot, name) in at.iter_mut().zip(BOUNDS) {
        *slot = need(element, name, &float, source)?;
    }
    let mut colour = None;
    if element.position(COLOUR_BOUNDS[0]).is_some() {
        let mut slots = [0; 6];
        for (slot, name) in slots.iter_mut().zip(COLOUR_BOUNDS) {
            *slot = need(element, name, &float, source)?;
        }
        colour = Some(slots);
    }
    let mut chunks = Vec::with_capacity(header.checked_count(element, source)?);
    header.rows(element, source, |_, v| {
        let triple = |slots: &[usize]| [v[slots[0]], v[slots[1]], v[slots[2]]];
        chunks.push(Chunk {
            position: [triple(&at[..3]), triple(&at[3..6])],
            log_scale: [triple(&at[6..9]), triple(&at[9..])],
            colour: colour.map_or([[0.0; 3], [1.0; 3]], |c| [triple(&c[..3]), triple(&c[3..])]),
        });
        Ok(())
    })?;
    Ok(chunks)
}

fn read_vertices(
    header: &Header,
    element: &Element,
    source: &mut Source,
    chunks: &[Chunk],
    sh_degree: usize,
) -> Result<Incoming> {
    let mut at = [0; 4];
    for (slot, name) in at.iter_mut().zip(PACKED) {
        *slot = need(element, name, &[Scalar::U32], source)?;
    }
    let path = source.path;
    let count = header.checked_count(element, source)?;
    if chunks.len() < count.div_ceil(CHUNK) {
        let expected = format!("{} chunks before {count} vertices", count.div_ceil(CHUNK));
        return Err(Error::format(path, expected, chunks.len().to_string()));
    }
    // The `sh` rows follow; their size is checked before any memory is allocated for them.
    if let Some(sh) = header.elements.iter().find(|e| e.name == "sh") {
        header.checked_count(sh, source)?;
        if sh.count != element.count {
            let expected = format!("as many rows of `sh` as vertices, {count}");
            return Err(Error::format(path, expected, sh.count.to_string()));
        }
    }
    let mut incoming = Incoming::with_capacity(count, sh_degree);
    header.rows(element, source, |i, v| {
        let chunk = &chunks[i / CHUNK];
        let [position, rotation, scale, colour] = at.map(|slot| v[slot] as u32);
        let mean = lerp(chunk.position, unpack_11_10_11(position));
        let log_scale = lerp(chunk.log_scale, unpack_11_10_11(scale));
        let byte = |shift: u32| f64::from((colour >> shift) & 255) / 255.0;
        let rgb = lerp(chunk.colour, [byte(24), byte(16), byte(8)]);
        let sh = incoming.push(
            mean.map(|m| m as f32),
            unpack_rotation(rotation),
            log_scale.map(|s| s.exp() as f32),
            byte(0) as f32,
        );
        for (h, c) in sh.iter_mut().zip(rgb) {
            *h = dc_from_colour(c);
        }
        Ok(())
    })?;
    Ok(incoming)
}

fn read_sh(
    header: &Header,
    element: &Element,
    source: &mut Source,
    incoming: Option<&mut Incoming>,
    rests: usize,
) -> Result<()> {
    let path = source.path;
    let incoming = incoming
        .ok_or_else(|| Error::format(path, "element `vertex` before element `sh`", "`sh` first"))?;
    let mut at = Vec::with_capacity(rests);
    for i in 0..rests {
        at.push(need(element, &format!("f_rest_{i}"), &[Scalar::U8], source)?);
    }
    let mut rest = vec![0.0; rests];
    header.rows(element, source, |i, v| {
        for (r, &slot) in rest.iter_mut().zip(&at) {
            // Bytes 0 and 255 are the ends of the range, the others centres of bins.

            let unit = match v[slot] as u8 {
                0 => 0.0,
                255 => 1.0,
                b => (f64::from(b) + 0.5) / 256.0,
            };
            *r = ((unit - 0.5) * 8.0) as f32;
        }
        if let Some(set) = incoming.sh_mut(i) {
            rest_to_set(&rest, set);
        }
        Ok(())
    })
}

fn lerp(range: [[f64; 3]; 2], t: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| range[0][c] * (1.0 - t[c]) + range[1][c] * t[c])
}

fn unpack_11_10_11(v: u32) -> [f64; 3] {
    let unit = |shift: u32, bits: u32| {
        let top = (1u32 << bits) - 1;
        f64::from((v >> shift) & top) / f64::from(top)
    };
    [unit(21, 11), unit(11, 10), unit(0, 11)]
}

fn unpack_rotation(v: u32) -> [f32; 4] {
    let part =
        |shift: u32| (f64::from((v >> shift) & 1023) / 1023.0 - 0.5) * std::f64::consts::SQRT_2;
    let others = [part(20), part(10), part(0)];
    let largest = (1.0 - others.iter().map(|o| o * o).sum::<f64>()).max(0.0).sqrt();
    let mut q = [0.0f32; 4];
    let mut rest = others.into_iter();
    for (i, c) in q.iter_mut().enumerate() {
        *c = if i == (v >> 30) as usize { largest } else { rest.next().unwrap_or(0.0) } as f32;
    }
    q
}
