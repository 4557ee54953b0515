//! The container of HEIC and AVIF pictures (HEIF, ISO/IEC 23008-12; its boxes are those of ISO/IEC 14496-12): size,
//! rotation and colours of the primary picture, without its pixels.
//!
//! Programs that convert such a picture are checked against this size (`converted.rs`): a photograph of an iPhone
//! is a grid of tiles of 512 px, of which some programs decode only the first one.
//!
//! Every count of the file is compared with the bytes that follow it, and nothing is allocated for it.

use image::DynamicImage;
use image::metadata::Orientation;
use std::io::Cursor;
use std::path::Path;

/// Codes of ITU-T H.273.
pub(super) const PRIMARIES_DISPLAY_P3: u16 = 12;
/// Transfer functions of HDR: PQ and HLG.
pub(super) const TRANSFER_HDR: [u16; 2] = [16, 18];

/// A change of the decoded pixels, in the order of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// Rotation by quarter turns, anticlockwise (`irot`).
    Turn(u8),
    /// Exchange of top and bottom, or of left and right (`imir`).
    Mirror { left_right: bool },
    /// Crop to a size (`clap`).
    Crop([u32; 2]),
}

/// The primary picture of a container.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Primary {
    /// Size of the decoded pixels, px: the whole grid of tiles.
    pub coded: [u32; 2],
    /// Size after the crop, px.
    pub unturned: [u32; 2],
    /// Size after the crop, the rotation and the mirroring, px.
    pub upright: [u32; 2],
    /// ICC profile.
    pub profile: Option<Vec<u8>>,
    /// Codes of the colour primaries and of the transfer function.
    pub coding: Option<[u16; 2]>,
    steps: Vec<Step>,
}

impl Primary {
    /// Returns whether the container neither rotates nor mirrors the pixels.
    pub fn is_plain(&self) -> bool {
        self.steps.iter().all(|step| matches!(step, Step::Crop(_)))
    }

    /// Returns whether the size of a picture tells the pixels before the rotation from the upright ones.
    pub fn size_tells(&self) -> bool {
        self.unturned != self.upright
    }

    /// Turns the pixels of [`Self::unturned`] upright.
    pub fn turn(&self, mut pixels: DynamicImage) -> DynamicImage {
        for step in &self.steps {
            // Turns of `Orientation` are clockwise.
            let orientation = match step {
                Step::Turn(1) => Orientation::Rotate270,
                Step::Turn(2) => Orientation::Rotate180,
                Step::Turn(3) => Orientation::Rotate90,
                Step::Mirror { left_right: true } => Orientation::FlipHorizontal,
                Step::Mirror { left_right: false } => Orientation::FlipVertical,
                Step::Turn(_) | Step::Crop(_) => Orientation::NoTransforms,
            };
            pixels.apply_orientation(orientation);
        }
        pixels
    }
}

/// A box: its type and its content.
#[derive(Clone, Copy)]
struct Part<'a> {
    kind: &'a [u8],
    body: &'a [u8],
}

/// Walks over the boxes of `bytes`, and ends at one that is cut.
struct Parts<'a>(&'a [u8]);

impl<'a> Iterator for Parts<'a> {
    type Item = Part<'a>;

    fn next(&mut self) -> Option<Part<'a>> {
        let bytes = self.0;
        let (head, size) = match number(bytes, 4)? {
            0 => (8, bytes.len()),
            1 => (16, usize::try_from(number(bytes.get(8..)?, 8)?).ok()?),
            size => (8, usize::try_from(size).ok()?),
        };
        let part = Part { kind: bytes.get(4..8)?, body: bytes.get(head..size)? };
        self.0 = &bytes[size..];
        Some(part)
    }
}

/// Reads a number of `count` bytes, most significant first.
fn number(bytes: &[u8], count: usize) -> Option<u64> {
    Some(bytes.get(..count)?.iter().fold(0, |value, byte| value << 8 | u64::from(*byte)))
}

fn number_u32(bytes: &[u8], at: usize) -> Option<u32> {
    u32::try_from(number(bytes.get(at..)?, 4)?).ok()
}

/// Content of the first box of a kind.
pub(super) fn find<'a>(bytes: &'a [u8], kind: &[u8; 4]) -> Option<&'a [u8]> {
    Parts(bytes).find(|part| part.kind == kind).map(|part| part.body)
}

/// Reads the primary picture.
///
/// # Errors
/// The part of the container that is missing or cut.
pub(super) fn primary(bytes: &[u8]) -> Result<Primary, &'static str> {
    // `meta`, `pitm` and `ipma` begin with a version and 3 bytes of flags.
    let meta = find(bytes, b"meta").and_then(|meta| meta.get(4..));
    let meta = meta.ok_or("a file that ends before the description of its pictures")?;
    let item = find(meta, b"pitm").and_then(|body| match body.first()? {
        0 => number(body.get(4..)?, 2),
        _ => number(body.get(4..)?, 4),
    });
    let item = item.ok_or("a container without a primary picture")?;
    let properties = find(meta, b"iprp").ok_or("a container without properties")?;
    let list = find(properties, b"ipco").ok_or("a container without properties")?;
    let list: Vec<Part> = Parts(list).collect();
    let mut found = Primary::default();
    for part in Parts(properties).filter(|part| part.kind == b"ipma") {
        for index in associated(part.body, item).unwrap_or_default() {
            if let Some(property) = index.checked_sub(1).and_then(|i| list.get(i)) {
                found.add(property).ok_or("a property of the picture that is cut")?;
            }
        }
    }
    if found.coded.contains(&0) {
        return Err("a primary picture without a size");
    }
    [found.unturned, found.upright] = [found.coded; 2];
    for (i, step) in found.steps.iter().enumerate() {
        match step {
            Step::Turn(1 | 3) => found.upright.reverse(),
            Step::Crop(size) => {
                // A crop of turned pixels is read, and then no size tells.
                found.upright = *size;
                found.unturned = *size;
                if i > 0 && found.steps.iter().any(|step| matches!(step, Step::Turn(1 | 3))) {
                    found.unturned = [0; 2];
                }
            }
            Step::Turn(_) | Step::Mirror { .. } => {}
        }
    }
    if found.unturned == [0; 2] {
        found.unturned = found.upright;
    }
    Ok(found)
}

/// Indices, from 1, of the properties of an item; `None` for a list that is cut.
fn associated(body: &[u8], item: u64) -> Option<Vec<usize>> {
    let item_bytes = if *body.first()? == 0 { 2 } else { 4 };
    let index_bytes = 1 + usize::from(body.get(3)? & 1);
    let mut rest = body.get(8..)?;
    for _ in 0..number(body.get(4..)?, 4)? {
        let id = number(rest, item_bytes)?;
        let count = usize::from(*rest.get(item_bytes)?);
        let indices = rest.get(item_bytes + 1..item_bytes + 1 + count * index_bytes)?;
        if id == item {
            // The highest bit marks a property that a reader must know.
            let mask = if index_bytes == 1 { 0x7f } else { 0x7fff };
            let index = |bytes: &[u8]| Some((number(bytes, index_bytes)? & mask) as usize);
            return indices.chunks_exact(index_bytes).map(index).collect();
        }
        rest = &rest[item_bytes + 1 + count * index_bytes..];
    }
    Some(Vec::new())
}

impl Primary {
    /// Takes a property over; `None` for one that is cut.
    fn add(&mut self, property: &Part<'_>) -> Option<()> {
        let body = property.body;
        match property.kind {
            b"ispe" => self.coded = [number_u32(body, 4)?, number_u32(body, 8)?],
            b"irot" => match body.first()? & 3 {
                0 => {}
                turns => self.steps.push(Step::Turn(turns)),
            },
            // ISO/IEC 23008-12:2022: axis 0 exchanges top and bottom.
            b"imir" => self.steps.push(Step::Mirror { left_right: body.first()? & 1 == 1 }),
            b"clap" => {
                let side = |at: usize| {
                    let [over, under] = [number_u32(body, at)?, number_u32(body, at + 4)?];
                    over.checked_div(under).filter(|side| *side > 0)
                };
                let size = [side(0)?, side(8)?];
                if size != self.coded {
                    self.steps.push(Step::Crop(size));
                }
            }
            b"colr" => match body.get(..4)? {
                b"nclx" => {
                    let code = |at: usize| Some(number(body.get(at..)?, 2)? as u16);
                    self.coding = Some([code(4)?, code(6)?]);
                }
                b"prof" | b"rICC" => self.profile = Some(body[4..].to_vec()),
                _ => {}
            },
            _ => {}
        }
        Some(())
    }
}

/// EXIF block of a container: a TIFF structure. `None` without one that can be read.
pub(super) fn exif(bytes: &[u8]) -> Option<Vec<u8>> {
    let exif = exif::Reader::new().read_from_container(&mut Cursor::new(bytes)).ok()?;
    Some(exif.buf().to_vec())
}

/// The profile of Display P3, for pictures that state its primaries alone.
pub(super) fn display_p3() -> Option<Vec<u8>> {
    moxcms::ColorProfile::new_display_p3().encode().ok()
}

/// Warning of a transfer function of HDR.
pub(super) fn hdr_warning(transfer: u16, path: &Path) -> Option<String> {
    TRANSFER_HDR.contains(&transfer).then(|| {
        format!(
            "{}: the picture is HDR (transfer characteristics {transfer}) and is read as if it were SDR: its tones \
             are wrong",
            path.display()
        )
    })
}

/// Warning of an EXIF orientation of a container that has no rotation of its own (`is_plain`).
pub(super) fn orientation_warning(
    exif: Option<&[u8]>,
    is_plain: bool,
    path: &Path,
) -> Option<String> {
    let orientation = exif.and_then(Orientation::from_exif_chunk)?;
    (is_plain && orientation != Orientation::NoTransforms).then(|| {
        format!(
            "{}: EXIF orientation {} is ignored: HEIC keeps its rotation outside EXIF, and the file has none there",
            path.display(),
            orientation.to_exif()
        )
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A golden file.
    pub fn file(name: &str) -> Vec<u8> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/goldens/heic");
        std::fs::read(std::path::Path::new(folder).join(name)).unwrap()
    }

    /// A box.
    pub fn part(kind: &[u8; 4], body: &[u8]) -> Vec<u8> {
        [&(8 + body.len() as u32).to_be_bytes()[..], kind, body].concat()
    }

    /// A container of one picture of `size` with further properties.
    pub fn container(size: [u32; 2], more: &[Vec<u8>]) -> Vec<u8> {
        let sides = [&[0; 4][..], &size[0].to_be_bytes(), &size[1].to_be_bytes()].concat();
        let list = [part(b"ispe", &sides), more.concat()].concat();
        let indices: Vec<u8> = (0..=more.len()).map(|i| 0x80 | (i + 1) as u8).collect();
        let count = [indices.len() as u8];
        let map = [&[0, 0, 0, 0, 0, 0, 0, 1, 0, 7][..], &count, &indices].concat();
        let properties = part(b"iprp", &[part(b"ipco", &list), part(b"ipma", &map)].concat());
        let meta = [vec![0; 4], part(b"pitm", &[0, 0, 0, 0, 0, 7]), properties, part(b"free", b"")];
        [part(b"ftyp", b"heic\0\0\0\0mif1heic"), part(b"meta", &meta.concat())].concat()
    }

    #[test]
    fn sizes_and_turns_are_read() {
        for (name, upright) in [
            ("colour.heic", [64, 48]),
            ("colour.avif", [64, 48]),
            ("rotated.heic", [48, 64]),
            ("mirrored.heic", [48, 64]),
        ] {
            let found = primary(&file(name)).unwrap();
            assert_eq!((found.unturned, found.upright), ([64, 48], upright), "{name}");
            assert_eq!(found.is_plain(), [64, 48] == upright, "{name}");
        }
        let clap: Vec<u8> =
            [30u32, 1, 20, 1, 0, 1, 0, 1].iter().flat_map(|v| v.to_be_bytes()).collect();
        let found =
            primary(&container([40, 30], &[part(b"clap", &clap), part(b"irot", &[3])])).unwrap();
        assert_eq!((found.coded, found.unturned, found.upright), ([40, 30], [30, 20], [20, 30]));
        let crop_last = [part(b"irot", &[3]), part(b"clap", &clap)];
        assert!(!primary(&container([40, 30], &crop_last)).unwrap().size_tells());
        let colours = part(b"colr", b"nclx\0\x0c\0\x10\0\x06\x80");
        let found = primary(&container([40, 30], &[colours, part(b"colr", b"profICC")])).unwrap();
        assert_eq!(found.coding, Some([PRIMARIES_DISPLAY_P3, 16]));
        assert_eq!(found.profile.as_deref(), Some(&b"ICC"[..]));
    }

    #[test]
    fn pixels_turn_as_the_file_says() {
        let pixels = image::GrayImage::from_raw(2, 1, vec![1, 2]).unwrap();
        let turned = |steps: &[Vec<u8>]| {
            let found = primary(&container([2, 1], steps)).unwrap();
            let turned = found.turn(DynamicImage::ImageLuma8(pixels.clone())).into_luma8();
            assert_eq!([turned.width(), turned.height()], found.upright);
            turned.into_raw()
        };
        // A quarter turn anticlockwise brings the right side to the top.
        assert_eq!(turned(&[part(b"irot", &[1])]), [2, 1]);
        assert_eq!(turned(&[part(b"irot", &[3])]), [1, 2]);
        assert_eq!(turned(&[part(b"irot", &[2])]), [2, 1]);
        assert_eq!(turned(&[part(b"imir", &[1])]), [2, 1]);
        assert_eq!(turned(&[part(b"imir", &[0])]), [1, 2]);
        // The order of the file: mirrored, then turned.
        assert_eq!(turned(&[part(b"imir", &[1]), part(b"irot", &[1])]), [1, 2]);
    }

    #[test]
    fn damaged_containers_are_errors() {
        let whole = file("rotated.heic");
        let end = whole.windows(4).position(|w| w == b"mdat").unwrap();
        for cut in 0..whole.len() {
            let found = primary(&whole[..cut]);
            assert!(found.is_err() || cut + 4 >= end, "cut at {cut}");
        }
        for at in 0..whole.len() {
            for flip in [0x55, 0xff] {
                let mut damaged = whole.clone();
                damaged[at] ^= flip;
                let _ = primary(&damaged);
            }
        }
        assert!(primary(&container([0, 30], &[])).is_err());
        assert!(primary(&container([40, 30], &[part(b"irot", b"")])).is_err());
        assert!(primary(b"").is_err());
    }
}
