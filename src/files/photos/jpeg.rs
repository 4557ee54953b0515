//! Structure of a JPEG file: its segments and its end (ITU-T T.81, annex B).
//!
//! The decoder (`zune-jpeg` through `image`) accepts a file that ends inside its scan data and
//! fills the rest with grey. Its strict mode cannot be chosen through `image` and accepts a cut
//! in the last row. This module walks over the segments up to the end-of-image marker.
//!
//! Segments are skipped by their lengths, so the marker of a thumbnail inside EXIF does not
//! count. Bytes after the marker (trailing bytes, the further pictures of an MPO file) are not
//! decoded. In scan data every 0xFF byte is stuffed, so a marker there is a real one.

/// Parts of a JPEG file that decide whether it is accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    /// Number of colour components of the frame header.
    pub components: Option<u8>,
    /// Width and height of the frame header, px.
    pub size: Option<[u32; 2]>,
    /// The frame is baseline, extended or progressive, with samples of 8 bits.
    pub lossy: bool,
    /// The frame is progressive: all coefficients are read before the first pixel is known.
    pub progressive: bool,
    /// Bytes up to and with the end-of-image marker.
    pub end: usize,
    /// A second start of a file stands between the segments: the first one is none.
    pub restarted: bool,
    /// The file says that further pictures follow (an APP2 segment `MPF`, CIPA DC-007).
    pub several: bool,
    /// The file has an APP14 segment of Adobe, which says that CMYK is inverted.
    pub adobe: bool,
    /// Part inside which the file ends; `None` if it has its end-of-image marker.
    pub cut_inside: Option<&'static str>,
}

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
const SOS: u8 = 0xda;
const APP2: u8 = 0xe2;
const APP14: u8 = 0xee;

/// Reports whether `bytes` begin as a JPEG file does.
pub(super) fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0xff, SOI, 0xff])
}

/// Walks over the segments of a JPEG file.
pub(super) fn layout(bytes: &[u8]) -> Layout {
    let mut layout = Layout {
        components: None,
        size: None,
        lossy: false,
        progressive: false,
        end: bytes.len(),
        restarted: false,
        several: false,
        adobe: false,
        cut_inside: None,
    };
    let mut inside = "its header";
    let mut at = 2;
    while let Some(Marker { code, after }) = next_marker(bytes, at) {
        at = after;
        match code {
            EOI => {
                layout.end = at;
                return layout;
            }
            SOI => {
                layout.restarted = true;
                continue;
            }
            // Markers without a segment: TEM and the restart markers.
            0x01 | 0xd0..=0xd7 => continue,
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
                let side = |at: usize| {
                    Some(u32::from(u16::from_be_bytes(segment.get(at..at + 2)?.try_into().ok()?)))
                };
                layout.size = side(3).zip(side(1)).map(|(width, height)| [width, height]);
                layout.lossy = code <= 0xc2 && segment.first() == Some(&8);
                layout.progressive = code == 0xc2;
            }
            APP2 if segment.starts_with(b"MPF\0") => layout.several = true,
            APP14 if segment.starts_with(b"Adobe") => layout.adobe = true,
            SOS => inside = "its pixels",
            _ => {}
        }
        at += length;
    }
    layout.cut_inside = Some(inside);
    layout
}

/// Largest distance between two pictures of an MPO file, bytes: writers fill up to whole blocks.
const BETWEEN: usize = 1 << 16;

/// Returns whether another picture of the same size follows the first one: the second eye of a stereo camera. The
/// smaller pictures that phones add (previews, gain maps) do not count.
pub(super) fn second_of_size(bytes: &[u8], first: &Layout) -> bool {
    let rest = bytes.get(first.end..).unwrap_or_default();
    let near = &rest[..rest.len().min(BETWEEN)];
    let Some(start) = near.windows(3).position(is_jpeg) else { return false };
    layout(&rest[start..]).size == first.size
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
