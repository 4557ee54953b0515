//! Raw files of cameras (DNG, CR2, CR3, NEF, ARW, RAF, …): their kind, and the camera's own JPEG inside them.
//!
//! A camera stores its own development of the shot as a JPEG, usually at the full size, beside the raw data. This
//! JPEG is read: it needs no program, all pictures have the same tones, and cameras are estimated from it as from
//! any other photograph. Without one of [`LEAST_SIDE`] px, a program develops the file (`programs.rs`).
//!
//! No crate develops raw files here: `rawler`, `rawloader` and `quickraw` are LGPL-2.1 and `imagepipe` is
//! LGPL-3.0, which a static program under Apache-2.0 cannot contain without giving its object files away.

use super::jpeg;
use super::tiff_tags::{DNG_VERSION, is_tiff, numbers};
use crate::files::lower_extension;
use std::path::Path;

/// Extensions of raw files that begin as a TIFF does.
pub(super) const EXTENSIONS: [&str; 20] = [
    "dng", "cr2", "nef", "nrw", "arw", "sr2", "srf", "srw", "pef", "orf", "rw2", "rwl", "3fr",
    "fff", "iiq", "erf", "kdc", "dcr", "mos", "mef",
];
/// Least longer side of a JPEG that is read in place of the raw data, px. Those of early Sony files have 1616 px.
const LEAST_SIDE: u32 = 1600;
/// Most places that look like a JPEG and are none.
const FALSE_STARTS: usize = 32;

/// Returns whether a file is a raw file. A TIFF is one by its extension, by Canon's mark or by DNG's version tag.
pub(super) fn is_raw(bytes: &[u8], path: &Path) -> bool {
    const STARTS: [&[u8]; 5] = [b"FUJIFILMCCD-RAW", b"IIU\0", b"IIRO", b"IIRS", b"MMOR"];
    if STARTS.iter().any(|start| bytes.starts_with(start)) || is_cr3(bytes) {
        return true;
    }
    if !is_tiff(bytes) {
        return false;
    }
    let extension = lower_extension(path);
    EXTENSIONS.contains(&extension.as_str())
        || bytes.get(8..10) == Some(b"CR")
        || numbers(bytes, DNG_VERSION).is_some()
}

/// CR3 keeps its orientation where neither the JPEG nor the readers of EXIF look.
fn is_cr3(bytes: &[u8]) -> bool {
    bytes.get(4..12) == Some(b"ftypcrx ")
}

/// The largest JPEG inside a raw file, where it is large enough.
pub(super) fn embedded(bytes: &[u8]) -> Option<&[u8]> {
    if is_cr3(bytes) {
        return None;
    }
    let mut largest: Option<(u64, &[u8])> = None;
    let (mut at, mut false_starts) = (0, 0);
    while let Some(start) = bytes[at..].windows(3).position(|w| w == [0xff, 0xd8, 0xff]) {
        let jpeg = &bytes[at + start..];
        at += start + 3;
        // Tables, a frame header, an application's segment or a comment follow the start of a JPEG.
        let is_start = matches!(jpeg.get(3), Some(0xc0..=0xc4 | 0xdb | 0xdd | 0xe0..=0xef | 0xfe));
        let layout = is_start.then(|| jpeg::layout(jpeg));
        let whole = layout.filter(|layout| layout.cut_inside.is_none() && !layout.restarted);
        let Some((layout, [w, h])) = whole.and_then(|layout| Some((layout, layout.size?))) else {
            false_starts += 1;
            if false_starts > FALSE_STARTS {
                break;
            }
            continue;
        };
        at += layout.end - 3;
        let area = u64::from(w) * u64::from(h);
        let is_picture = layout.lossy && layout.components == Some(3) && w.max(h) >= LEAST_SIDE;
        if is_picture && largest.is_none_or(|(other, _)| area > other) {
            largest = Some((area, &jpeg[..layout.end]));
        }
    }
    largest.map(|(_, jpeg)| jpeg)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG of grey stripes.
    fn jpeg(width: u16, height: u16) -> Vec<u8> {
        let mut bytes = Vec::new();
        let encoder = jpeg_encoder::Encoder::new(&mut bytes, 90);
        let data: Vec<u8> = (0..usize::from(width) * usize::from(height))
            .flat_map(|i| [(i % 250) as u8; 3])
            .collect();
        encoder.encode(&data, width, height, jpeg_encoder::ColorType::Rgb).unwrap();
        bytes
    }

    #[test]
    fn the_largest_jpeg_of_a_raw_file_is_found() {
        let (thumb, large, half) = (jpeg(160, 120), jpeg(1700, 40), jpeg(1600, 30));
        // A frame of lossless JPEG (SOF3), as raw data has it.
        let mut lossless = large.clone();
        let sof = lossless.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        lossless[sof + 1] = 0xc3;
        lossless[sof + 5..sof + 7].copy_from_slice(&4000u16.to_be_bytes());
        let noise = [0xff, 0xd8, 0xff, 0x11, 0, 3];
        let head = b"II*\0\x08\0\0\0\0\0\0\0\0\0";
        let file = [&head[..], &thumb, &noise, &half, &lossless, &large, &noise].concat();
        assert_eq!(embedded(&file), Some(&large[..]));
        assert_eq!(embedded(&[&head[..], &thumb, &lossless].concat()), None);
        // A cut one is none, and many false starts end the search.
        assert_eq!(embedded(&file[..file.len() - 100]), Some(&half[..]));
        assert_eq!(embedded(&[&noise.repeat(100)[..], &large].concat()), None);
        assert_eq!(embedded(b""), None);
    }

    #[test]
    fn raw_files_are_recognised() {
        let tiff = b"II*\0\x08\0\0\0\0\0\0\0\0\0";
        assert!(!is_raw(tiff, Path::new("a.tif")) && is_raw(tiff, Path::new("DSC1.NEF")));
        assert!(is_raw(b"II*\0\x10\0\0\0CR\x02\0", Path::new("a")));
        assert!(is_raw(
            b"MM\0*\0\0\0\x08\0\x01\xc6\x12\0\x01\0\0\0\x04\x01\x04\0\0",
            Path::new("a")
        ));
        assert!(is_raw(b"FUJIFILMCCD-RAW 0201", Path::new("a.raf")));
        assert!(is_raw(b"\0\0\0\x18ftypcrx \0\0\0\x01", Path::new("a.cr3")));
        // A picture under the extension of a raw file.
        assert!(!is_raw(b"\xff\xd8\xff\xe0", Path::new("a.nef")));
    }
}
