//! Mask files of photographs: a grey picture whose pixels of value 0 are masked.
//!
//! A pose file names them (nerfstudio's `mask_path`), or they lie in a folder `masks` beside the folder of the
//! photographs, `images` or a reduced copy as `images_4`, or in it: `masks/NAME.jpg.png` (COLMAP) or
//! `masks/NAME.png`. The folder may be called `mask` or `masks_2` too ([`FOLDERS`]). Without one there, a mask lies
//! beside its photograph: `NAME_mask.png` (`variants.rs`). A mask belongs to the stored
//! pixels, as COLMAP and nerfstudio have it; one of the shape of the upright pixels alone belongs to those.
//!
//! Values, by one rule ([`Values::of`]); the second and the third case give a line:
//!
//! | values of the file | masked |
//! |---|---|
//! | black and white with soft edges, a JPEG with noise, 0 and 1 | below half |
//! | labels, in a lossless file: none above 32, or 3 to 32 different ones | 0 |
//! | other greys: on both sides of 128 | below 128 |
//! | other greys: on one side of 128, with a contrast of 32 at least | below the middle of their range |
//!
//! A mask in an alpha channel is read with its picture (`decode.rs`).

use super::decode::decode;
use super::image::{LoadOptions, Probe, probe};
use super::jpeg;
use super::variants;
use crate::files::poses::assemble::find_image;
use crate::files::{Error, Result, read};
use crate::scene::mask::Mask;
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage};
use std::path::{Path, PathBuf};

/// Names of a folder of masks. The first one that exists is read.
const FOLDERS: [&str; 10] = [
    "masks", "mask", "Masks", "Mask", "masks_2", "masks_4", "masks_8", "mask_2", "mask_4", "mask_8",
];
/// Largest relative difference of aspect between a mask and its photograph: reduced copies have sides rounded to whole
/// pixels.
const ASPECT: f64 = 0.02;
/// Least value of a kept pixel in a mask of black and white.
const HALF: u8 = 128;
/// Highest label of a picture of few classes, and most different labels of another one.
const LABELS: (u8, usize) = (32, 32);
/// Largest distance of a value from black or white, in a JPEG, and least share of such pixels in a mask of black and
/// white: the others are soft edges.
const TWO_VALUES: (u8, f64) = (32, 0.9);
/// Least contrast of greys that are divided in the middle of their range.
const CONTRAST: u8 = 32;

/// Mask file of a photograph by the names of the folders, whether it exists or not; that beside it, or `None`, where
/// there is no folder of masks.
pub(in crate::files) fn of_photograph(image: &Path) -> Option<PathBuf> {
    let absolute = std::path::absolute(image).unwrap_or_else(|_| image.to_owned());
    let own = absolute.parent()?;
    let of_images = |folder: &&Path| {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        name == "images" || name.starts_with("images_")
    };
    let images = own.ancestors().find(of_images);
    let beside = images.and_then(|images| Some((images.parent()?, images, true)));
    // A folder of masks among the photographs need not have all of them.
    for (folder, images, whole) in beside.into_iter().chain([(own, own, false)]) {
        let mut masks = FOLDERS.iter().map(|name| folder.join(name));
        let Some(masks) = masks.find(|masks| masks.is_dir()) else { continue };
        let name = absolute.strip_prefix(images).unwrap_or(&absolute);
        let named = masks.join(name.with_extension("png"));
        let found = if named.is_file() {
            Some(named)
        } else {
            find_image(&[&masks], &name.to_string_lossy()).filter(|path| path.is_file())
        };
        let found = found.or_else(|| variants::mask_beside(image));
        if found.is_some() || whole {
            let colmap = format!("{}.png", name.to_string_lossy());
            return Some(found.unwrap_or_else(|| masks.join(colmap)));
        }
    }
    variants::mask_beside(image)
}

/// Returns whether `folder` has the name of a folder of masks.
pub(super) fn is_folder_of_masks(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default();
    FOLDERS.iter().any(|masks| name == *masks)
}

/// Checks that a mask can be used for a photograph.
///
/// # Errors
/// A mask that is missing, that is no picture, or of another shape than the photograph's stored and upright
/// pixels.
pub(in crate::files) fn check(path: &Path, photograph: &Probe) -> Result<()> {
    let mask = probe(path)?;
    placement([mask.width, mask.height], photograph, path).map(|_| ())
}

/// Reads a mask of the stored pixels of a photograph, at their size, with a line about values that are neither black
/// nor white.
///
/// # Errors
/// Those of [`check`]; a file that cannot be decoded.
pub(in crate::files) fn load(path: &Path, photograph: &Probe) -> Result<(Mask, Option<String>)> {
    let bytes = read(path)?;
    let decoded = decode(&bytes, &LoadOptions::default(), path)?;
    let picture = decoded.picture;
    let values = picture.data.chunks_exact(3).map(|p| p.iter().copied().max().unwrap_or(0));
    let values: Vec<u8> = values.collect();
    let of = Values::of(&values, !jpeg::is_jpeg(&bytes));
    let kept = values.iter().map(|value| *value >= of.least).collect();
    let invalid = || Error::format(path, "a mask with pixels", "none");
    let mask = Mask::new(picture.width, picture.height, kept).ok_or_else(invalid)?;
    // Programs that cut out write white with an alpha.
    let mask = decoded.mask.and_then(|alpha| alpha.and(&mask)).unwrap_or(mask);
    let mask = match placement([mask.width(), mask.height()], photograph, path)? {
        Placement::Stored => mask,
        Placement::Upright(back) => oriented(&mask, back).ok_or_else(invalid)?,
    };
    Ok((mask.nearest(photograph.width, photograph.height), of.line))
}

/// Meaning of the values of a mask file.
struct Values {
    /// Least value of a kept pixel.
    least: u8,
    /// A line about values that are neither black nor white.
    line: Option<String>,
}

impl Values {
    fn of(values: &[u8], lossless: bool) -> Self {
        let mut counts = [0_usize; 256];
        values.iter().for_each(|value| counts[usize::from(*value)] += 1);
        let used: Vec<u8> = (0..=u8::MAX).filter(|value| counts[usize::from(*value)] > 0).collect();
        let (low, high) = (used.first().copied().unwrap_or(0), used.last().copied().unwrap_or(0));
        let near = if lossless { 0 } else { TWO_VALUES.0 };
        let ends = used.iter().filter(|value| **value <= near || **value >= u8::MAX - near);
        let extreme: usize = ends.map(|value| counts[usize::from(*value)]).sum();
        let (highest, most) = LABELS;
        if high <= 1 {
            return Self { least: 1, line: None };
        }
        if extreme as f64 >= TWO_VALUES.1 * values.len() as f64 {
            return Self { least: HALF, line: None };
        }
        if lossless && (high <= highest || used.len() == 1 || (3..=most).contains(&used.len())) {
            let few: Vec<String> = used.iter().take(4).map(u8::to_string).collect();
            let more = if used.len() > few.len() { ", …" } else { "" };
            let masked = if low == 0 {
                "what is 0 is left out, and all else is used"
            } else {
                "what is 0 would be left out, and none is: make it 0 to leave it out"
            };
            let line = format!(
                "its mask has the values {}{more}, which are read as labels: {masked}",
                few.join(", ")
            );
            return Self { least: 1, line: Some(line) };
        }
        let one_side = low >= HALF || high < HALF;
        let least = match (one_side, high - low >= CONTRAST) {
            (true, true) => low.midpoint(high) + 1,
            _ => HALF,
        };
        let line = format!(
            "its mask has greys from {low} to {high} that are neither black nor white: what is below {least} is left out"
        );
        Self { least, line: Some(line) }
    }
}

/// Pixels to which a mask belongs.
enum Placement {
    Stored,
    /// The upright ones, with the way back.
    Upright(Orientation),
}

fn placement([w, h]: [usize; 2], photograph: &Probe, path: &Path) -> Result<Placement> {
    let is_of = |probe: &Probe| {
        let aspect = |w: usize, h: usize| w as f64 / h as f64;
        (aspect(w, h) / aspect(probe.width, probe.height) - 1.0).abs() <= ASPECT
    };
    if is_of(photograph) {
        return Ok(Placement::Stored);
    }
    // Orientations that exchange the sides. Those of a quarter turn are the inverse of each other.
    let back = match photograph.orientation {
        Some(6) => Some(Orientation::Rotate270),
        Some(8) => Some(Orientation::Rotate90),
        Some(orientation @ (5 | 7)) => Orientation::from_exif(orientation),
        _ => None,
    };
    match back {
        Some(back) if is_of(&photograph.upright()) => Ok(Placement::Upright(back)),
        _ => {
            let Probe { width, height, .. } = photograph;
            let expected = format!("a mask of {width}x{height}, or of the same shape");
            Err(Error::format(path, expected, format!("{w}x{h}")))
        }
    }
}

/// Applies an EXIF orientation to a mask; `None` for sides above 2³².
pub(super) fn oriented(mask: &Mask, orientation: Orientation) -> Option<Mask> {
    let values = mask.kept().iter().map(|kept| u8::from(*kept)).collect();
    let (width, height) = (u32::try_from(mask.width()).ok()?, u32::try_from(mask.height()).ok()?);
    let mut pixels = DynamicImage::ImageLuma8(GrayImage::from_raw(width, height, values)?);
    pixels.apply_orientation(orientation);
    let pixels = pixels.into_luma8();
    let (width, height) = (pixels.width() as usize, pixels.height() as usize);
    Mask::new(width, height, pixels.into_raw().into_iter().map(|v| v > 0).collect())
}

/// `mask` with the masked pixels of `other`, of the same size.
pub(in crate::files) fn both(mask: Option<Mask>, other: Option<Mask>) -> Option<Mask> {
    match (mask, other) {
        (Some(mask), Some(other)) => Some(mask.and(&other).unwrap_or(mask)),
        (mask, other) => mask.or(other),
    }
}

/// A mask that masks a pixel, of the photograph `path`; `None` for one that keeps all.
///
/// # Errors
/// No pixel is kept.
pub(in crate::files) fn checked(mask: Option<Mask>, path: &Path) -> Result<Option<Mask>> {
    match mask {
        Some(mask) if mask.keeps_none() => Err(Error::format(
            path,
            "a photograph with pixels that are not masked",
            "a mask (or an alpha channel) over all of it",
        )),
        mask => Ok(mask.filter(|mask| !mask.keeps_all())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::image::save_png;
    use crate::files::photos::photograph::{Photograph, load_photograph};
    use crate::files::poses::scene::{Scene, load_scene};
    use crate::scene::pictures::Rgb;
    use image::{RgbImage, RgbaImage};
    use std::fs;

    /// Pixels of a photograph of 8x6 that are kept in these tests.
    fn left(x: u32, y: u32) -> bool {
        x < 5 || y == 0
    }

    /// Writes a grey mask of `size`, `value` for each pixel.
    fn save_mask(path: &Path, [w, h]: [u32; 2], value: impl Fn(u32, u32) -> u8) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        GrayImage::from_fn(w, h, |x, y| image::Luma([value(x, y)])).save(path).unwrap();
    }

    fn grey(x: u32, y: u32) -> u8 {
        u8::from(left(x, y)) * 255
    }

    fn expected() -> Mask {
        let kept = (0..48).map(|i| left(i % 8, i / 8)).collect();
        Mask::new(8, 6, kept).unwrap()
    }

    fn photograph(path: &Path) -> Photograph {
        load_photograph(path, &LoadOptions::default()).unwrap()
    }

    /// A folder with `images/NAME` and a transforms.json of two frames, the second one without a mask.
    fn scene(folder: &Path, mask_path: &str) -> Scene {
        fs::create_dir_all(folder.join("images")).unwrap();
        let frame = |name: &str, x: f32, more: &str| {
            let file = folder.join("images").join(name);
            if !file.exists() {
                save_png(file, &Rgb { data: vec![90; 144], ..Rgb::black(8, 6) }).unwrap();
            }
            format!(
                r#"{{"file_path": "images/{name}", {more} "transform_matrix":
                   [[1,0,0,{x}],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}"#
            )
        };
        let more = match mask_path {
            "" => String::new(),
            path => format!(r#""mask_path": "{path}","#),
        };
        let frames = [frame("a.png", 0.0, &more), frame("b.png", 1.0, "")];
        let json = format!(r#"{{"fl_x": 8, "w": 8, "h": 6, "frames": [{}]}}"#, frames.join(","));
        fs::write(folder.join("transforms.json"), json).unwrap();
        load_scene(folder).unwrap()
    }

    fn mask_of(scene: &Scene, frame: usize) -> Option<Mask> {
        scene.frames[frame].load_with(&LoadOptions::default()).unwrap().mask
    }

    #[test]
    fn an_alpha_channel_is_a_mask() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let save = |alpha: &dyn Fn(u32, u32) -> u8| {
            let pixel = |x, y| image::Rgba([200, 100, 40, alpha(x, y)]);
            RgbaImage::from_fn(8, 6, pixel).save(&path).unwrap();
        };
        // The rim of an object keeps its colour; what is masked is blended with black.
        save(&|x, y| {
            if !left(x, y) {
                127
            } else if x == 4 {
                128
            } else {
                255
            }
        });
        let found = photograph(&path);
        assert_eq!(found.mask, Some(expected()));
        for (i, pixel) in found.image.data.chunks_exact(3).enumerate() {
            let kept = left(i as u32 % 8, i as u32 / 8);
            assert_eq!(pixel, if kept { [200, 100, 40] } else { [100, 50, 20] });
        }
        // One alpha for all pixels is no mask, nor is one that masks none.
        for alpha in [0, 90, 255] {
            save(&|_, _| alpha);
            assert_eq!(photograph(&path).mask, None, "{alpha}");
        }
        save(&|x, _| 128 + x as u8);
        assert_eq!(photograph(&path).mask, None);
        save(&|x, _| x as u8);
        let error = load_photograph(&path, &LoadOptions::default()).unwrap_err().to_string();
        assert!(error.contains("a.png") && error.contains("over all of it"), "{error}");
    }

    #[test]
    fn folders_of_masks_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| folder.path().join(path);
        fs::create_dir_all(at("images/day 1")).unwrap();
        fs::create_dir_all(at("plain")).unwrap();
        let jpeg = RgbImage::from_pixel(8, 6, image::Rgb([90; 3]));
        for file in ["images/a.jpg", "images/day 1/b.jpg", "images/c.jpg", "plain/d.jpg"] {
            jpeg.save(at(file)).unwrap();
        }
        assert_eq!(photograph(&at("images/a.jpg")).mask, None);
        // One beside the photograph, without a folder of masks.
        let beside = at("images/a-Mask.png");
        save_mask(&beside, [8, 6], grey);
        assert_eq!(photograph(&at("images/a.jpg")).mask, Some(expected()));
        fs::remove_file(beside).unwrap();
        // COLMAP, the stem alone, a JPEG among the photographs, and another size.
        save_mask(&at("masks/a.jpg.png"), [8, 6], |x, y| grey(x, y).min(1));
        save_mask(&at("masks/day 1/b.png"), [16, 12], |x, y| grey(x / 2, y / 2));
        save_mask(&at("plain/masks/d.jpg"), [80, 60], |x, y| grey(x / 10, y / 10));
        for file in ["images/a.jpg", "images/day 1/b.jpg", "plain/d.jpg"] {
            let found = photograph(&at(file));
            assert_eq!((found.mask, found.warnings), (Some(expected()), vec![]), "{file}");
        }
        // One that is missing gives a line.
        let found = photograph(&at("images/c.jpg"));
        assert_eq!((found.mask, found.warnings.len()), (None, 1));
        assert!(found.warnings[0].contains("c.jpg.png"), "{:?}", found.warnings);
        // One beside the photograph, which the folder lacks.
        let beside = at("images/c_mask.png");
        save_mask(&beside, [8, 6], grey);
        assert_eq!(photograph(&at("images/c.jpg")).mask, Some(expected()));
        fs::remove_file(beside).unwrap();
        // So does another shape.
        save_mask(&at("masks/c.jpg.png"), [6, 8], |_, _| 0);
        let found = photograph(&at("images/c.jpg"));
        assert_eq!((found.mask, found.warnings.len()), (None, 1));
        assert!(found.warnings[0].contains("8x6, or of the same shape, got 6x8"));
        // A mask over everything is an error.
        save_mask(&at("masks/c.jpg.png"), [8, 6], |_, _| 0);
        assert!(load_photograph(at("images/c.jpg"), &LoadOptions::default()).is_err());
    }

    #[test]
    fn masks_of_pose_files_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        assert_eq!(mask_of(&scene(folder, ""), 0), None);
        // Missing, and the photograph's own name: one line, and all pixels.
        for named in ["dynamic/a.png", "a.png"] {
            let missing = scene(folder, named);
            assert_eq!(missing.warnings.len(), 1, "{:?}", missing.warnings);
            assert!(missing.warnings[0].starts_with("1 of 2 frames have a mask that is missing"));
            assert_eq!(mask_of(&missing, 0), None);
        }
        save_mask(&folder.join("dynamic/a.png"), [8, 6], grey);
        let read = scene(folder, "./dynamic/a.png");
        assert!(read.warnings.is_empty() && read.frames[1].mask.is_none(), "{:?}", read.warnings);
        assert_eq!((mask_of(&read, 0), mask_of(&read, 1)), (Some(expected()), None));
        assert_eq!(read.frames[0].load().unwrap().0.data, vec![90; 144]);
        // A folder beside the photographs; a file's own mask goes before it.
        save_mask(&folder.join("masks/a.png"), [8, 6], |x, _| u8::from(x > 0));
        save_mask(&folder.join("masks/b.png.png"), [4, 3], |x, _| u8::from(x > 0));
        let both = scene(folder, "dynamic/a.png");
        assert_eq!(mask_of(&both, 0), Some(expected()));
        assert_eq!(mask_of(&both, 1).unwrap().count(), 36);
        assert_eq!(mask_of(&scene(folder, ""), 0).unwrap().count(), 42);
        // The alpha of the picture masks as well.
        let pixel = |_, y| image::Rgba([90, 90, 90, if y < 3 { 255 } else { 0 }]);
        RgbaImage::from_fn(8, 6, pixel).save(folder.join("images/a.png")).unwrap();
        let kept = mask_of(&scene(folder, "dynamic/a.png"), 0).unwrap();
        assert_eq!(kept.count(), 8 + 2 * 5);
    }

    #[test]
    fn values_of_a_mask_have_one_rule() {
        let of = |parts: &[(u8, usize)], lossless: bool| {
            let values: Vec<u8> = parts.iter().flat_map(|(v, n)| vec![*v; *n]).collect();
            let Values { least, line } = Values::of(&values, lossless);
            (least, line.unwrap_or_default())
        };
        let silent = |least: u8| (least, String::new());
        // Black and white, with soft edges, with the noise of a JPEG, and of one value.
        assert_eq!(of(&[(0, 50), (255, 50)], true), silent(128));
        assert_eq!(of(&[(0, 50), (90, 5), (200, 5), (255, 40)], true), silent(128));
        assert_eq!(of(&[(0, 30), (7, 20), (240, 40), (100, 9)], false), silent(128));
        assert_eq!((of(&[(255, 9)], true), of(&[(0, 9)], true)), (silent(128), silent(1)));
        assert_eq!(of(&[(0, 5), (1, 5)], true), silent(1));
        // Labels: few classes, many of which some are high, and without 0.
        for labels in [vec![(0, 5), (2, 5)], vec![(0, 5), (11, 9), (140, 9), (255, 3)]] {
            let (least, line) = of(&labels, true);
            assert!(least == 1 && line.contains("labels: what is 0 is left out"), "{line}");
        }
        let (least, line) = of(&[(3, 5), (17, 5)], true);
        assert!(least == 1 && line.contains("values 3, 17,") && line.contains("and none is"));
        // Two greys, and greys on both sides of the middle.
        let (least, line) = of(&[(60, 5), (120, 5)], true);
        assert!(least == 91 && line.contains("from 60 to 120") && line.contains("below 91"));
        assert_eq!(of(&[(140, 5), (254, 5)], true).0, 198);
        assert_eq!(of(&[(140, 5), (150, 5)], true).0, 128);
        assert_eq!(of(&[(0, 5), (100, 5)], true).0, 51);
        let soft: Vec<(u8, usize)> = (0..=250).map(|v| (v, 1)).collect();
        assert_eq!(of(&soft, true).0, 128);
        assert_eq!(of(&soft[..90], false).0, 45);
    }

    #[test]
    fn labels_and_a_missing_mask_give_lines() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        scene(folder, "");
        save_mask(&folder.join("images/a_mask.png"), [8, 6], |x, y| 3 * u8::from(left(x, y)));
        let one = scene(folder, "");
        assert_eq!(one.warnings.len(), 1, "{:?}", one.warnings);
        let start =
            "1 of 2 frames have no mask, as the others have: all of their pixels are used: ";
        assert_eq!(one.warnings[0], format!("{start}images/b.png"));
        let loaded = one.frames[0].load_with(&LoadOptions::default()).unwrap();
        assert_eq!(loaded.mask, Some(expected()));
        assert_eq!(loaded.warnings.len(), 1, "{:?}", loaded.warnings);
        assert!(loaded.warnings[0].contains("a.png: its mask has the values 0, 3, which"));
        let path = folder.join("images/a.png");
        let warnings = photograph(&path).warnings;
        assert!(warnings.len() == 1 && warnings[0].contains("labels"), "{warnings:?}");
    }

    #[test]
    fn a_mask_turns_with_its_photograph() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mask.png");
        for orientation in 1..=8 {
            let turn = Orientation::from_exif(orientation).unwrap();
            let turned = (orientation > 1).then_some(orientation);
            let probe = Probe { width: 8, height: 6, orientation: turned };
            save_mask(&path, [8, 6], grey);
            let stored = load(&path, &probe).unwrap().0;
            assert_eq!(stored, expected(), "{orientation}");
            let upright = oriented(&stored, turn).unwrap();
            let size = probe.upright();
            assert_eq!((upright.width(), upright.height()), (size.width, size.height));
            if orientation < 5 {
                continue;
            }
            // A mask of the upright pixels has another shape.
            let value = |x: u32, y: u32| u8::from(upright.kept()[(y * 6 + x) as usize]);
            save_mask(&path, [6, 8], value);
            assert_eq!(load(&path, &probe).unwrap().0, expected(), "{orientation}");
        }
        // The photograph's own rotation.
        let picture = Rgb {
            data: (0..48).flat_map(|i| [u8::from(left(i % 8, i / 8)); 3]).collect(),
            ..Rgb::black(8, 6)
        };
        let mut pixels = DynamicImage::ImageRgb8(RgbImage::try_from(picture).unwrap());
        pixels.apply_orientation(Orientation::Rotate90);
        let pixels: Vec<bool> = pixels.into_rgb8().pixels().map(|p| p.0[0] > 0).collect();
        let turned = oriented(&expected(), Orientation::Rotate90).unwrap();
        assert_eq!(turned.kept(), pixels);
    }
}
