//! Pictures of a folder that are no photographs of their own: the same one in another format, a copy, an edited
//! version or another exposure of it, its mask, and maps of it such as depths. Names and EXIF suggest them, and the
//! pixels decide.

use super::exif::Shot;
use super::photograph::PhotographHeader;
use super::raw;
use super::shape::correlation;
use crate::files::lower_extension;
use crate::files::photos::image::load;
use crate::scene::pictures::Rgb;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Extensions of pictures that every program reads. Cameras and phones write another format beside one of them, and
/// people convert to them: a file of the same name is the same photograph.
const COMMON_EXTENSIONS: [&str; 7] = ["jpg", "jpeg", "jpe", "jfif", "png", "tif", "tiff"];
/// Characters between the words of a name.
const SEPARATORS: [char; 4] = ['_', '-', '.', ' '];
/// The word of a mask's name.
const MASK: &str = "mask";
/// Extensions of masks.
const MASK_EXTENSIONS: [&str; 5] = ["png", "PNG", "jpg", "JPG", "jpeg"];
/// Words of the names of maps, which renderers, depth cameras and networks write beside a picture.
const MAPS: [&str; 15] = [
    MASK,
    "masks",
    "matte",
    "depth",
    "disparity",
    "disp",
    "normal",
    "normals",
    "confidence",
    "conf",
    "seg",
    "segmentation",
    "semantic",
    "labels",
    "albedo",
];
/// Words of the names of pictures that have maps beside them.
const COLOURS: [&str; 6] = ["rgb", "color", "colour", "image", "img", "frame"];
/// Ends of the names of edited versions: Google, Lightroom, Samsung.
const EDITED: [&str; 7] =
    ["-edited", "_edited", " (edited)", "-edit", "_edit", "-bearbeitet", "~2"];
/// Side of the small pictures that are compared, px.
const SMALL: usize = 48;
/// Least correlation of two small pictures of one view. Exposures two stops apart have 0.92, photographs of somebody who
/// walks 0.73 at most.
const SAME_VIEW: f64 = 0.85;
/// Largest difference of the channels of a grey pixel, and least share of such pixels in a grey picture: a JPEG has noise.
const GREY: (u8, f64) = (12, 0.99);
/// Distance of a mask's values from black or white, and least share of such pixels.
const TWO_VALUES: (u8, f64) = (32, 0.95);
/// Most values of a mask that is neither black nor white, such as labels.
const VALUES_MAX: usize = 32;
/// Mean red, green and blue of a map of normals that face the camera, and the largest difference from them.
const NORMALS: ([f64; 3], f64) = ([128.0, 128.0, 220.0], 45.0);
/// Most colours of a map of labels.
const LABELS_MAX: usize = 256;
/// Longest time between two exposures of one view, seconds: the tag has whole seconds.
const SERIES_SECONDS: f64 = 2.0;
/// Fewest exposures of one view.
const SERIES_LEAST: usize = 3;

/// Reasons, the same for all files of a kind: one line names them.
const IS_MASK: &str = "the mask of a photograph beside it, which it is applied to";
const IS_MAP: &str = "a map of a photograph beside it, such as depths or normals";
const IS_EDITED: &str = "an edited version of a photograph beside it";
const IS_EXPOSURE: &str = "another exposure of a photograph beside it, by EXIF";

/// A picture that can be read.
pub(super) struct Found {
    pub path: PathBuf,
    pub header: PhotographHeader,
}

/// Pictures to leave out: indices with reasons.
type LeftOut = Vec<(usize, String)>;

/// Divides the pictures of a folder into photographs and those that are left out, each with the reason.
pub(super) fn sorted_out(mut all: Vec<Found>) -> (Vec<PathBuf>, Vec<[String; 2]>) {
    let mut left_out = Vec::new();
    for rule in [twins, maps, copies, edited, exposures] {
        let mut out = rule(&all);
        out.sort();
        left_out.extend(out.iter().map(|(i, why)| [name_of(&all[*i].path), why.clone()]));
        out.iter().rev().for_each(|(i, _)| drop(all.remove(*i)));
    }
    (all.into_iter().map(|found| found.path).collect(), left_out)
}

/// Name of a file without its folders.
pub(super) fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase()
}

/// Raw, HEIC, AVIF and JPEG XL files beside a JPEG, PNG or TIFF of the same name: two photographs from one place.
fn twins(all: &[Found]) -> LeftOut {
    let is_common = |path: &Path| COMMON_EXTENSIONS.contains(&lower_extension(path).as_str());
    let paths = || all.iter().map(|found| found.path.as_path());
    let common: HashSet<String> = paths().filter(|path| is_common(path)).map(stem).collect();
    // Only formats of cameras and phones, not every other extension.
    let is_twin = |path: &Path| {
        !is_common(path) && has_format_of_its_own(path) && common.contains(&stem(path))
    };
    let reason = || "a JPEG, PNG or TIFF of the same name is read".to_owned();
    paths().enumerate().filter(|(_, path)| is_twin(path)).map(|(i, _)| (i, reason())).collect()
}

/// Returns whether an extension is one of HEIC, AVIF, JPEG XL or a raw format.
fn has_format_of_its_own(path: &Path) -> bool {
    let extension = lower_extension(path);
    ["heic", "heif", "hif", "avif", "jxl", "cr3", "raf"].contains(&extension.as_str())
        || raw::EXTENSIONS.contains(&extension.as_str())
}

/// Files that equal another one byte for byte, such as `a (1).jpg` beside `a.jpg`: they show one place. The one with the
/// shortest name stays.
fn copies(all: &[Found]) -> LeftOut {
    let mut of_size: HashMap<u64, Vec<usize>> = HashMap::new();
    for (i, found) in all.iter().enumerate() {
        // A file without a size is an error of its reader.
        if let Ok(metadata) = found.path.metadata() {
            of_size.entry(metadata.len()).or_default().push(i);
        }
    }
    let name = |i: usize| name_of(&all[i].path);
    let mut copies = LeftOut::new();
    for mut same in of_size.into_values().filter(|same| same.len() > 1) {
        same.sort_by_key(|&i| (name(i).len(), i));
        let mut kept: Vec<(usize, Vec<u8>)> = Vec::new();
        for i in same {
            let Ok(bytes) = std::fs::read(&all[i].path) else { continue };
            match kept.iter().find(|(_, other)| *other == bytes) {
                Some((first, _)) => copies.push((i, format!("a copy of {}", name(*first)))),
                None => kept.push((i, bytes)),
            }
        }
    }
    copies
}

/// Words of a name in lower case, without those of colours; and whether one is that of a map, which is left out too.
fn words(path: &Path) -> (Vec<String>, bool) {
    let stem = stem(path);
    let all = stem.split(SEPARATORS).filter(|word| !word.is_empty() && !COLOURS.contains(word));
    let (maps, others): (Vec<&str>, Vec<&str>) = all.partition(|word| MAPS.contains(word));
    (others.into_iter().map(str::to_owned).collect(), !maps.is_empty())
}

/// Masks and maps: names that become another picture's without one word.
fn maps(all: &[Found]) -> LeftOut {
    let named: Vec<(Vec<String>, bool)> = all.iter().map(|found| words(&found.path)).collect();
    let plain: HashMap<&[String], &Path> = named
        .iter()
        .zip(all)
        .filter(|((words, is_map), _)| !is_map && !words.is_empty())
        .map(|((words, _), found)| (words.as_slice(), found.path.as_path()))
        .collect();
    let of_map = |(i, (words, is_map)): (usize, &(Vec<String>, bool))| {
        let of = plain.get(words.as_slice()).filter(|of| *is_map && is_map_of(&all[i].path, of))?;
        let is_mask = mask_beside(of).is_some_and(|mask| mask == all[i].path);
        Some((i, if is_mask { IS_MASK } else { IS_MAP }.to_owned()))
    };
    named.iter().enumerate().filter_map(of_map).collect()
}

/// Returns whether the pixels of `path` can be those of a map of the photograph `of`: two values, few colours, the colours
/// of normals, or grey beside a photograph with colours.
fn is_map_of(path: &Path, of: &Path) -> bool {
    let Ok(map) = load(path) else { return false };
    let is_other = || is_grey(&map) && load(of).is_ok_and(|photograph| !is_grey(&photograph));
    has_two_values(&map) || has_few_colours(&map) || has_normals(&map) || is_other()
}

fn share(picture: &Rgb, counts: impl Fn(&[u8]) -> bool) -> f64 {
    let pixels = picture.data.chunks_exact(3);
    pixels.filter(|pixel| counts(pixel)).count() as f64 * 3.0 / picture.data.len().max(1) as f64
}

fn is_grey(picture: &Rgb) -> bool {
    let (most, least) = GREY;
    let range = |p: &[u8]| p.iter().max().zip(p.iter().min()).map_or(0, |(high, low)| high - low);
    share(picture, |p| range(p) <= most) >= least
}

/// Returns whether a picture is grey and nearly all of it black or white.
fn has_two_values(picture: &Rgb) -> bool {
    let (near, least) = TWO_VALUES;
    is_grey(picture) && share(picture, |p| p[1] <= near || p[1] >= u8::MAX - near) >= least
}

/// Returns whether a grey picture has as few values as masks and labels have: photographs have all of them.
fn has_few_values(picture: &Rgb) -> bool {
    let values: HashSet<u8> = picture.data.iter().copied().collect();
    values.len() <= VALUES_MAX
}

fn has_few_colours(picture: &Rgb) -> bool {
    let mut colours = HashSet::new();
    let within = |pixel| {
        colours.insert(pixel);
        colours.len() <= LABELS_MAX
    };
    !is_grey(picture) && picture.data.chunks_exact(3).all(within)
}

fn has_normals(picture: &Rgb) -> bool {
    let pixels = (picture.data.len() / 3).max(1) as f64;
    let mean = |c: usize| {
        picture.data.iter().skip(c).step_by(3).map(|v| f64::from(*v)).sum::<f64>() / pixels
    };
    let (usual, most) = NORMALS;
    (0..3).all(|c| (mean(c) - usual[c]).abs() <= most)
}

/// Returns whether two files show one view, whatever their exposure.
fn show_one_view(a: &Path, b: &Path) -> bool {
    let small = |path: &Path| load(path).ok().map(|picture| small(&picture));
    small(a).zip(small(b)).is_some_and(|(a, b)| correlation(&a, &b) >= SAME_VIEW)
}

/// Grey values of a picture of [`SMALL`] by [`SMALL`] blocks, less their mean.
fn small(picture: &Rgb) -> Vec<f64> {
    let Rgb { width, height, ref data } = *picture;
    let block = |i: usize| {
        let range = |n: usize, side: usize| {
            let from = n * side / SMALL;
            from..((n + 1) * side / SMALL).max(from + 1).min(side.max(1))
        };
        let (columns, rows) = (range(i % SMALL, width), range(i / SMALL, height));
        let count = (columns.len() * rows.len()).max(1) as f64;
        let line = |y: usize| {
            let line = &data[3 * (y * width + columns.start)..3 * (y * width + columns.end)];
            line.iter().map(|v| f64::from(*v)).sum::<f64>()
        };
        rows.map(line).sum::<f64>() / count
    };
    let values: Vec<f64> = (0..SMALL * SMALL).map(block).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.into_iter().map(|v| v - mean).collect()
}

/// The mask of a photograph in its own folder: `a_mask.png` or `mask_a.png` of `a.jpg`, `a_mask.png` of `a_rgb.png`.
pub(super) fn mask_beside(image: &Path) -> Option<PathBuf> {
    let stem = image.file_stem()?.to_string_lossy();
    let mut stems = Vec::new();
    for word in [MASK, "Mask", "MASK"] {
        for separator in SEPARATORS {
            stems.push(format!("{stem}{separator}{word}"));
            stems.push(format!("{word}{separator}{stem}"));
        }
        let parts: Vec<&str> = stem.split(SEPARATORS).collect();
        let colour = |part: &&str| COLOURS.contains(&part.to_lowercase().as_str());
        stems.extend(parts.iter().filter(|part| colour(part)).map(|part| {
            let at = part.as_ptr() as usize - stem.as_ptr() as usize;
            format!("{}{word}{}", &stem[..at], &stem[at + part.len()..])
        }));
    }
    let names = stems
        .iter()
        .flat_map(|stem| MASK_EXTENSIONS.map(|extension| format!("{stem}.{extension}")));
    let is_mask = |path: &PathBuf| {
        let is_one = |mask: &Rgb| has_two_values(mask) || is_grey(mask) && has_few_values(mask);
        path != image && path.is_file() && load(path).is_ok_and(|mask| is_one(&mask))
    };
    names.map(|name| image.with_file_name(name)).find(is_mask)
}

/// Edited versions beside the photograph itself. They may be cropped, and have other colours.
fn edited(all: &[Found]) -> LeftOut {
    let stems: HashMap<String, &Path> =
        all.iter().map(|found| (stem(&found.path), found.path.as_path())).collect();
    let of_version = |(i, found): (usize, &Found)| {
        let original = stems.get(&original(&stem(&found.path))?)?;
        show_one_view(original, &found.path).then(|| (i, IS_EDITED.to_owned()))
    };
    all.iter().enumerate().filter_map(of_version).collect()
}

/// Stem of the photograph of which an edited version has this stem, in lower case.
fn original(stem: &str) -> Option<String> {
    // Phones of Apple: IMG_E1234 beside IMG_1234.
    let number = stem.strip_prefix("img_e").filter(|rest| rest.bytes().all(|b| b.is_ascii_digit()));
    let of_apple = number.filter(|number| !number.is_empty()).map(|n| format!("img_{n}"));
    of_apple.or_else(|| EDITED.iter().find_map(|end| Some(stem.strip_suffix(end)?.to_owned())))
}

/// Series of exposures from one place: the one nearest to the measured exposure stays.
fn exposures(all: &[Found]) -> LeftOut {
    exposures_where(all, |i, j| show_one_view(&all[i].path, &all[j].path))
}

/// [`exposures`] of photographs of which `same_view` tells those from one place.
fn exposures_where(all: &[Found], same_view: impl Fn(usize, usize) -> bool) -> LeftOut {
    let shot = |i: usize| all[i].header.shot;
    let timed = all.iter().enumerate().filter_map(|(i, found)| Some((i, found.header.shot?)));
    let mut timed: Vec<(usize, Shot)> = timed.collect();
    timed.sort_by(|(i, a), (j, b)| a.seconds.total_cmp(&b.seconds).then(i.cmp(j)));
    let like = |i: usize, j: usize| {
        let of = |i: usize| {
            let header = &all[i].header;
            let camera = &header.camera;
            (header.width, header.height, camera.make.as_deref(), camera.model.as_deref())
        };
        of(i) == of(j)
    };
    let mut series: Vec<Vec<usize>> = Vec::new();
    for (i, own) in timed {
        let goes_on = series.last().is_some_and(|series: &Vec<usize>| {
            let last = series.last().and_then(|&last| Some((last, shot(last)?)));
            let soon = |(last, shot): (usize, Shot)| {
                own.seconds - shot.seconds <= SERIES_SECONDS && like(last, i)
            };
            last.is_some_and(soon)
                && series.iter().all(|&j| shot(j).is_some_and(|other| other.bias != own.bias))
        });
        match series.last_mut().filter(|_| goes_on) {
            Some(series) => series.push(i),
            None => series.push(vec![i]),
        }
    }
    let bias = |i: usize| shot(i).map_or(0.0, |shot| shot.bias);
    let mut out = LeftOut::new();
    for series in series.iter().filter(|series| series.len() >= SERIES_LEAST) {
        let middle = series.iter().min_by(|&&i, &&j| bias(i).abs().total_cmp(&bias(j).abs()));
        let Some(&middle) = middle else { continue };
        let mut others = series.iter().copied().filter(|i| *i != middle);
        // Somebody who walks changes the exposure too.
        if others.clone().all(|i| same_view(middle, i)) {
            out.extend(others.by_ref().map(|i| (i, IS_EXPOSURE.to_owned())));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::exif::ExifCamera;
    use crate::files::photos::image::save_png;

    /// Names, and those that are left out with the reason.
    type Case<'a> = (&'a [&'a str], &'a [(&'a str, &'a str)]);

    fn found(path: &Path, shot: Option<Shot>) -> Found {
        let header = PhotographHeader {
            width: 6,
            height: 4,
            orientation: None,
            camera: ExifCamera::default(),
            shot,
            panorama: false,
            warnings: Vec::new(),
        };
        Found { path: path.to_owned(), header }
    }

    /// A picture whose content its name tells: a mask of two values, normals, labels, a grey map, else a photograph
    /// with colours; of each first letter another one, edited ones a little brighter; `d-edit` is another photograph
    /// than `d`.
    fn picture(name: &str) -> Rgb {
        let name = name.to_lowercase();
        let own = name.trim_start_matches("rgb_").bytes().find(u8::is_ascii_alphanumeric);
        let own = usize::from(own.unwrap_or(0))
            + 60 * usize::from(name.contains("photo") || name.starts_with("d-"));
        let is = |word: &str| name.contains(word) && !name.contains("photo");
        let light = if is("edited") || name.starts_with("img_e") { 25 } else { 0 };
        let value = |i: usize| {
            let (x, y) = (i % 24, i / 24);
            let of = |n: usize| ((x * (own + n) + y * (2 * own + n) + x * y * own) % 200) as u8;
            match () {
                // Files of equal bytes are copies.
                () if i == 0 => [name.len() as u8; 3],
                () if is("mask") => [u8::from(x > 9) * 255; 3],
                () if is("normal") => [120, 130, 230],
                () if is("seg") => [[200, 10, 40], [10, 200, 90]][x % 2],
                () if is("depth") => [(10 * x) as u8; 3],
                () => [of(1) + light, of(3) + light, of(7) + light],
            }
        };
        Rgb { width: 24, height: 18, data: (0..24 * 18).flat_map(value).collect() }
    }

    /// Those of files of these names that are left out.
    fn left_out(names: &[&str]) -> Vec<[String; 2]> {
        let folder = tempfile::tempdir().unwrap();
        let files = names.iter().map(|name| {
            let path = folder.path().join(name);
            save_png(folder.path().join("x.png"), &picture(name)).unwrap();
            std::fs::rename(folder.path().join("x.png"), &path).unwrap();
            found(&path, None)
        });
        sorted_out(files.collect()).1
    }

    #[test]
    fn masks_maps_and_edited_versions_are_told_by_their_names() {
        let cases: &[Case<'_>] = &[
            (
                &["a.jpg", "a_mask.png", "A-Depth.png", "b.jpg", "b.normals.jpg"],
                &[("a_mask.png", IS_MASK), ("A-Depth.png", IS_MAP), ("b.normals.jpg", IS_MAP)],
            ),
            (
                &["0001_rgb.png", "0001_depth.png", "0001_Mask.png", "rgb_2.png", "depth_2.png"],
                &[("0001_depth.png", IS_MAP), ("0001_Mask.png", IS_MASK), ("depth_2.png", IS_MAP)],
            ),
            // Masks that have words of their own: not the one that is read.
            (&["a.jpg", "a_dog_mask.png", "b_mask.tif", "b.jpg"], &[("b_mask.tif", IS_MAP)]),
            // Photographs with such names.
            (&["a.jpg", "a_mask photo.jpg", "mask photo_a.jpg", "b.jpg", "b_depth_photo.jpg"], &[]),
            // Another photograph under the name of an edited version.
            (
                &["img_12.jpg", "c.jpg", "c-edited.jpg", "img_e12.jpg", "d-edit.jpg", "d.jpg"],
                &[("c-edited.jpg", IS_EDITED), ("img_e12.jpg", IS_EDITED)],
            ),
            // Labels.
            (&["a.jpg", "a_seg.png"], &[("a_seg.png", IS_MAP)]),
            // Photographs of masks, and a map alone.
            (&["mask.jpg", "mask 2.jpg", "a_depth.png", "IMG_1.jpg", "img.jpg"], &[]),
            (
                &["IMG_1234.HEIC", "IMG_E1234.JPG", "IMG_E77.JPG", "c-edited.jpg", "c.jpg"],
                &[("IMG_E1234.JPG", IS_EDITED), ("c-edited.jpg", IS_EDITED)],
            ),
        ];
        for (names, expected) in cases {
            let expected: Vec<[String; 2]> =
                expected.iter().map(|(name, why)| [*name, *why].map(str::to_owned)).collect();
            assert_eq!(left_out(names), expected, "{names:?}");
        }
    }

    #[test]
    fn of_a_series_of_exposures_one_stays() {
        let series = |shots: &[(f64, f64)]| {
            let shot = |(i, (seconds, bias)): (usize, &(f64, f64))| {
                let name = format!("{i}.jpg");
                found(Path::new(&name), Some(Shot { seconds: *seconds, bias: *bias }))
            };
            let all: Vec<Found> = shots.iter().enumerate().map(shot).collect();
            let one_place = exposures_where(&all, |_, _| true);
            assert!(exposures_where(&all, |i, j| i.max(j) < 2).len() < one_place.len().max(1));
            one_place.into_iter().map(|(i, _)| i).collect::<Vec<_>>()
        };
        // Two series, the second one right behind the first one.
        let two = [(0.0, 0.0), (0.0, -2.0), (1.0, 2.0), (2.0, 0.0), (3.0, -2.0), (3.0, 2.0)];
        assert_eq!(series(&two), [1, 2, 4, 5]);
        // A pair, other times, and one exposure for all.
        assert!(series(&[(0.0, 0.0), (1.0, 1.0)]).is_empty());
        assert!(series(&[(0.0, 0.0), (5.0, 1.0), (10.0, 2.0)]).is_empty());
        assert!(series(&[(0.0, 0.7), (1.0, 0.7), (2.0, 0.7), (3.0, 0.7)]).is_empty());
        // The one nearest to the measured exposure.
        assert_eq!(series(&[(0.0, -3.0), (0.0, -1.0), (0.0, 2.0)]), [0, 2]);
    }
}
