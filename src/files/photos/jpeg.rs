//! Structure of a JPEG file: its segments and its end (ITU-T T.81, annex B).
//!
//! The decoder (`zune-jpeg` through `image`) accepts a file that ends inside its scan data and
//! fills the rest with grey. Its strict mode cannot be chosen through `image` and accepts a cut
//! in the last row. This module walks over the segments up to the end-of-image marker.
//!
//! Segments are skipped by their lengths, so the marker of a thumbnail inside EXIF does not
//! count. Bytes after the marker (trailing bytes, the further pictures of an MPO file) are not
//! read. In scan data every 0xFF byte is stuffed, so a marker there is a real one.

/// Parts of a JPEG file that decide whether it is accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    /// Number of colour components of the frame header.
    pub components: Option<u8>,
    /// The file has an APP14 segment of Adobe, which says that CMYK is inverted.
    pub adobe: bool,
    /// Part inside which the file ends; `None` if it has its end-of-image marker.
    pub cut_inside: Option<&'static str>,
}

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
const SOS: u8 = 0xda;
const APP14: u8 = 0xee;

/// Reports whether `bytes` begin as a JPEG file does.
pub(super) fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0xff, SOI, 0xff])
}

/// Walks over the segments of a JPEG file.
pub(super) fn layout(bytes: &[u8]) -> Layout {
    let mut layout = Layout { components: None, adobe: false, cut_inside: None };
    let mut inside = "its header";
    let mut at = 2;
    while let Some(Marker { code, after }) = next_marker(bytes, at) {
        at = after;
        match code {
            EOI => return layout,
            // Markers without a segment: SOI, TEM and the restart markers.
            SOI | 0x01 | 0xd0..=0xd7 => continue,
            _ => {}
        }
        let Some(length) = bytes.get(at..at + 2) else { break };
        // The length counts its own two bytes.
        let length = usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
        let Some(segment) = bytes.get(at + 2..at + length) else { break };
        match code {
            // Frame headers: all SOF but DHT (C4), JPG (C8) and DAC (CC).
            0xc0..=0xcf if ![0xc4, 0xc8, 0xcc].contains(&code) => {
                layout.components = segment.get(5).copied();
            }
            APP14 if segment.starts_with(b"Adobe") => layout.adobe = true,
            SOS => inside = "its pixels",
            _ => {}
        }
        at += length;
    }
    layout.cut_inside = Some(inside);
    layout
}

/// A marker and the position after it.
struct Marker {
    code: u8,
    after: usize,
}

/// Finds the next marker from `at`: 0xFF, any number of fill bytes 0xFF, and a code other than
/// 0. Other bytes are scan data.
fn next_marker(bytes: &[u8], mut at: usize) -> Option<Marker> {
    loop {
        at += bytes.get(at..)?.iter().position(|&b| b == 0xff)?;
        at += bytes[at..].iter().position(|&b| b != 0xff)?;
        let code = bytes[at];
        at += 1;
        if code != 0 {
            return Some(Marker { code, after: at });
        }
    }
}
