//! Common parts of the pose readers: search for pictures, reading of their headers, and
//! conversion of a file's entries to checked [`Frame`]s.

use super::notes::Notes;
use super::panoramas::{self, DraftView};
use super::reading::{Folders, Reading};
use super::rotations::{OrthonormalPose, of_one_world, orthonormal};
use super::scene::{Frame, LeftOut, Pixels, Scene, SceneFormat, Units};
use crate::files::photos::distortion::Distortion;
use crate::files::photos::image::{Probe, probe};
use crate::files::photos::masks;
use crate::files::{Error, Result};
use glam::{DMat4, DVec3};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use subsplat_kernels::camera::{Camera, CameraError, Intrinsics};
use unicode_normalization::UnicodeNormalization;

/// Intrinsics in the form of a pose file.
#[derive(Clone, Copy, Debug)]
pub(super) enum Lens {
    /// fx, fy, cx, cy in pixels of the pose file's size.
    Pixels([f64; 4]),
    /// fx, fy, cx, cy divided by width and height of the picture.
    Normalised([f64; 4]),
    /// One focal length in pixels of the stored picture; the principal point is its middle.
    Centred(f64),
    /// One focal length and the principal point's offset from the picture's middle, divided by its larger side.
    LargerSide([f64; 3]),
}

/// A frame before its picture's header is read.
#[derive(Debug)]
pub(super) struct Draft {
    /// Place in the pose file, in the form of [`Error::at`].
    pub place: String,
    /// Path of the picture in the pose file.
    pub file: String,
    /// Path of the picture on disk, `None` if there is none.
    pub image: Option<PathBuf>,
    /// Reason for which the entry has no camera.
    pub refused: Option<Error>,
    /// Pixels to which the intrinsics refer.
    pub pixels: Pixels,
    /// Intrinsics.
    pub lens: Lens,
    /// Picture size to which the intrinsics belong, if the file has it.
    pub size: Option<(usize, usize)>,
    /// OpenCV pose.
    pub world_from_camera: DMat4,
    /// See [`Frame`]. A panorama becomes several frames ([`panoramas`]).
    pub distortion: Distortion,
    /// View of the picture that is the frame; `None` for the whole picture.
    pub view: Option<DraftView>,
    /// See [`Frame`].
    pub timestamp: Option<i64>,
    /// See [`Frame`].
    pub depth: Option<PathBuf>,
    /// See [`Frame`]. The file may be missing.
    pub mask: Option<PathBuf>,
    /// See [`Frame`].
    pub visible: Vec<u32>,
}

impl Draft {
    pub fn new(place: String, file: String, lens: Lens, world_from_camera: DMat4) -> Self {
        Self {
            place,
            file,
            image: None,
            refused: None,
            pixels: Pixels::Stored,
            lens,
            size: None,
            world_from_camera,
            distortion: Distortion::None,
            view: None,
            timestamp: None,
            depth: None,
            mask: None,
            visible: Vec::new(),
        }
    }

    /// An entry of a pose file that has no camera, because of `error`.
    pub fn refused(file: String, error: Error) -> Self {
        let draft = Self::new(String::new(), file, Lens::Pixels([0.0; 4]), DMat4::IDENTITY);
        Self { refused: Some(error), ..draft }
    }
}

/// Extensions tried where a pose file names a picture without one (NeRF's blender
/// scenes, some nerfstudio exports).
pub(super) const EXTENSIONS: [&str; 21] = [
    "png", "jpg", "jpeg", "PNG", "JPG", "JPEG", "webp", "tif", "tiff", "TIF", "bmp", "BMP", "heic",
    "HEIC", "jfif", "jpe", "heif", "hif", "mpo", "avif", "jxl",
];

/// Searches for a picture below `roots`, with and without a folder of pictures between: `images`, or reduced
/// copies as `images_4`. A name that differs in case, in the form of its accents or in the extension is found
/// where it is the only one.
pub(in crate::files) fn find_image(roots: &[&Path], name: &str) -> Option<PathBuf> {
    find_image_in(&Folders::default(), roots, name)
}

/// [`find_image`] among `folders`, which are listed once.
pub(super) fn find_image_in(folders: &Folders, roots: &[&Path], name: &str) -> Option<PathBuf> {
    let name = name.replace('\\', "/");
    let name = name.trim_start_matches("./");
    if name.is_empty() {
        return None;
    }
    let places: Vec<PathBuf> =
        roots.iter().flat_map(|r| [r.join(name), r.join("images").join(name)]).collect();
    // The last test is `exists`: a folder of the picture's name is an error of the probe,
    // not a missing picture.
    let mut candidates = places.iter().filter(|p| p.is_file()).cloned();
    candidates
        .next()
        .or_else(|| places.iter().flat_map(|p| with_extensions(p)).find(|p| p.is_file()))
        .or_else(|| places.iter().find_map(|p| folders.similar(p)))
        .or_else(|| in_reduced_copies(folders, roots, name))
        .or_else(|| places.iter().find(|p| p.exists()).cloned())
}

/// The picture among reduced copies, which COLMAP's and nerfstudio's scenes have in `images_2` to `images_8`.
fn in_reduced_copies(folders: &Folders, roots: &[&Path], name: &str) -> Option<PathBuf> {
    let name = name.trim_start_matches("images/");
    let copies = [2, 4, 8].map(|n| format!("images_{n}"));
    let places = roots.iter().flat_map(|r| copies.iter().map(|copy| r.join(copy).join(name)));
    let places: Vec<PathBuf> = places.collect();
    let found = places.iter().find(|p| p.is_file()).cloned();
    found.or_else(|| places.iter().find_map(|p| folders.similar(p)))
}

/// A file's name without a picture's extension, in lower case and with composed accents.
pub(super) fn similar_key(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name: String = name.nfc().flat_map(char::to_lowercase).collect();
    match name.rsplit_once('.') {
        Some((stem, extension)) if is_extension(extension) => stem.to_owned(),
        _ => name,
    }
}

/// Returns whether `extension` is one of [`EXTENSIONS`], in any case.
fn is_extension(extension: &str) -> bool {
    EXTENSIONS.iter().any(|known| known.eq_ignore_ascii_case(extension))
}

/// Returns whether a file has the extension of a picture.
pub(in crate::files) fn has_extension(path: &Path) -> bool {
    is_extension(&path.extension().unwrap_or_default().to_string_lossy())
}

fn with_extensions(place: &Path) -> impl Iterator<Item = PathBuf> + '_ {
    EXTENSIONS.iter().map(move |e| {
        let mut path = place.as_os_str().to_owned();
        path.push(".");
        path.push(e);
        PathBuf::from(path)
    })
}

/// A part of a file name, in the order of the fields: a character, or a number that sorts
/// as `0` among characters, by its length and then by its digits.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct NamePart {
    first: char,
    digit_count: usize,
    digits: String,
}

/// Makes the sort key of a file name. A run of digits is one number, so that `9.png` comes
/// before `10.png`.
fn numeric_key(path: &Path) -> Vec<NamePart> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let (mut key, mut rest) = (Vec::new(), &*name);
    while let Some(first) = rest.chars().next() {
        let run = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
        if run == 0 {
            key.push(NamePart { first, digit_count: 0, digits: String::new() });
            rest = &rest[first.len_utf8()..];
        } else {
            let digits = rest[..run].trim_start_matches('0').to_owned();
            key.push(NamePart { first: '0', digit_count: digits.len(), digits });
            rest = &rest[run..];
        }
    }
    key
}

/// Lists the files of a folder with a picture's extension, sorted by name with numbers in numeric order;
/// empty if there is no such folder. Files that macOS writes beside others (`._a.jpg`) are none.
pub(in crate::files) fn list_images(folder: &Path) -> Vec<PathBuf> {
    let mut images = files(folder);
    images.retain(|path| has_extension(path));
    images
}

/// Lists the files of a folder without hidden ones, sorted by name with numbers in numeric order.
pub(in crate::files) fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files = entries(folder);
    files.retain(|path| path.is_file());
    // The path decides between `01.png` and `1.png`.
    files.sort_by_cached_key(|p| (numeric_key(p), p.clone()));
    files
}

/// Lists what is in a folder, without hidden files and folders; empty if there is no such folder.
pub(super) fn entries(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let hidden =
        |path: &Path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    paths.filter(|path| !hidden(path)).collect()
}

/// Intrinsics in pixels of a picture on disk.
struct StoredIntrinsics {
    intrinsics: Intrinsics,
    /// They were scaled from the pose file's size.
    rescaled: bool,
}

/// A picture on disk of another shape than the pose file's.
struct Misfit {
    /// Intrinsics of the pose file's size.
    intrinsics: Intrinsics,
    /// The picture's size.
    got: String,
}

/// Computes the intrinsics of the picture on disk.
fn stored_intrinsics(
    draft: &Draft,
    stored: &Probe,
) -> std::result::Result<StoredIntrinsics, Misfit> {
    let (w, h) = (stored.width as f64, stored.height as f64);
    let (k, rescaled) = match draft.lens {
        Lens::Centred(focal) => ([focal, focal, 0.5 * w, 0.5 * h], false),
        Lens::LargerSide([focal, x, y]) => {
            let side = w.max(h);
            ([focal * side, focal * side, 0.5 * w + x * side, 0.5 * h + y * side], false)
        }
        Lens::Normalised(k) => ([k[0] * w, k[1] * h, k[2] * w, k[3] * h], false),
        Lens::Pixels(k) => {
            let (given_w, given_h) = draft.size.unwrap_or((stored.width, stored.height));
            let (sx, sy) = (w / given_w as f64, h / given_h as f64);
            // A reduced copy (images_2, images_4) has sides rounded to whole pixels.
            if (sx / sy - 1.0).abs() > 0.02 {
                let turned = match stored.orientation {
                    Some(o) => format!(" (EXIF orientation {o} is not applied)"),
                    None => String::new(),
                };
                let got = format!("{}x{}{turned}", stored.width, stored.height);
                let [fx, fy, cx, cy] = k.map(|v| v as f32);
                let intrinsics = Intrinsics { fx, fy, cx, cy, width: given_w, height: given_h };
                return Err(Misfit { intrinsics, got });
            }
            ([k[0] * sx, k[1] * sy, k[2] * sx, k[3] * sy], (sx, sy) != (1.0, 1.0))
        }
    };
    let [fx, fy, cx, cy] = k.map(|v| v as f32);
    let intrinsics = Intrinsics { fx, fy, cx, cy, width: stored.width, height: stored.height };
    Ok(StoredIntrinsics { intrinsics, rescaled })
}

/// Makes an error of a refused camera at its place in a file.
pub(super) fn camera_error(path: &Path, place: &str, error: &CameraError) -> Error {
    // Messages have the form "part: expected this, got that".
    let text = error.to_string();
    let parts = || {
        let (part, rest) = text.split_once(": expected ")?;
        let (expected, got) = rest.split_once(", got ")?;
        Some((format!("a {part} with {expected}"), got.to_owned()))
    };
    let (expected, got) = parts().unwrap_or(("a camera".to_owned(), text.clone()));
    Error::format(path, expected, got).at(place)
}

/// Makes frames of drafts: reads the header of every picture and checks every camera. An entry without a
/// camera, or whose picture is missing or cannot be read, gives a warning and no frame. A picture of another
/// shape than its camera's gives a warning and a frame that cannot be loaded, so that the indices of the others
/// stay. Fewer than two frames that can be loaded are an error where an entry is to blame.
pub(super) fn assemble(
    path: &Path,
    source: SceneFormat,
    reading: &Reading<'_>,
    mut drafts: Vec<Draft>,
) -> Result<Scene> {
    let Reading { pictures, strict, .. } = *reading;
    if drafts.is_empty() {
        return Err(Error::format(path, "at least one frame", "none"));
    }
    reading.settle(&mut drafts);
    let scaled = if source.has_file() { of_one_world(path, &mut drafts)? } else { None };
    let origin = origin_of(&drafts);
    drafts.iter_mut().for_each(|d| d.world_from_camera.w_axis -= origin.extend(0.0));
    let probe = |d: &Draft| match (&d.image, pictures, d.size) {
        (Some(image), Pictures::Needed, _) => Some(size(image, d.pixels)),
        (_, Pictures::Unread, Some((width, height))) => {
            Some(Ok(Probe { width, height, orientation: None }))
        }
        _ => None,
    };
    let probes: Vec<Option<Result<Probe>>> = drafts.par_iter().map(probe).collect();
    let entries = panoramas::expanded(path, drafts.into_iter().zip(probes).collect());
    let count = entries.len();
    let files: Vec<String> = entries.iter().map(|(draft, _)| draft.file.clone()).collect();
    let mut notes = Notes::default();
    let mut frames: Vec<Frame> = Vec::with_capacity(count);
    // A pose file may have masks of some of its frames alone.
    let named_masks = entries.iter().any(|(draft, _)| draft.mask.is_some());
    for (entry, (mut draft, stored)) in entries.into_iter().enumerate() {
        let file = draft.file.clone();
        let made = match (draft.refused.take(), stored) {
            (Some(error), _) | (None, Some(Err(error))) => Err(error),
            (None, Some(Ok(stored))) => {
                let image = draft.image.clone().unwrap_or_default();
                frame(path, draft, image, &stored, &mut notes)
            }
            (None, None) => {
                notes.miss(entry, file);
                continue;
            }
        };
        match made {
            Ok(mut frame) => {
                frame.entry = entry;
                if let Some(got) = &frame.other_shape {
                    let reason = format!("a picture of another shape than the camera's: {got}");
                    notes.left_out.push(LeftOut { entry, name: file, reason });
                }
                frames.push(frame);
            }
            Err(error) => notes.refuse(entry, &file, error),
        }
    }
    if strict && let Some(error) = notes.strict_error(path, count) {
        return Err(error);
    }
    if !named_masks && frames.iter().any(|frame| frame.mask.is_some()) {
        let without = frames.iter().filter(|frame| frame.mask.is_none() && frame.cut.is_none());
        let files = without.map(|frame| files[frame.entry].clone());
        notes.without_mask = files.filter(|file| !notes.unmasked.contains(file)).collect();
    }
    if source == SceneFormat::Photographs {
        // The photographs' loader has said so.
        notes.unmasked.clear();
    }
    // A reconstruction needs two, and every camera of a command line is meant to be used.
    let usable = frames.iter().filter(|f| f.other_shape.is_none()).count();
    let enough = usable > 1 || (usable > 0 && pictures == Pictures::Unread);
    if (!enough || !source.has_file())
        && let Some(error) = notes.refused_error.take().or(notes.other_shape_error.take())
    {
        return Err(error);
    }
    if frames.is_empty() {
        let first = notes.missing.first().cloned().unwrap_or_default();
        let (expected, searched) = match pictures {
            Pictures::Needed => ("pictures on disk", reading.searched()),
            Pictures::Unread => ("cameras with the size of their pictures", String::new()),
        };
        let got = format!("none of {count} (the first is `{first}`){searched}");
        return Err(Error::format(path, expected, got));
    }
    shorten_names(&mut frames);
    let mut warnings = notes.lines(count);
    warnings.extend(scaled);
    if origin != DVec3::ZERO {
        let [x, y, z] = origin.to_array();
        warnings.push(format!(
            "the cameras lie far from the origin of their world, where 32-bit numbers are too coarse: the \
             coordinates of this scene are relative to ({x}, {y}, {z})"
        ));
    }
    Ok(Scene {
        name: scene_name(path),
        frames,
        points: None,
        source,
        units: Units::Unknown,
        near_far: None,
        origin,
        warnings,
        left_out: notes.left_out,
        other_sources: Vec::new(),
    })
}

/// Need of a scene's pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pictures {
    /// Frames without a picture are left out.
    Needed,
    /// No picture is read: cameras have the sizes that the file states.
    Unread,
}

/// Distance of the cameras' middle from the origin of their world, in units of their spread, from which on the
/// middle becomes the origin. At this distance an f32 is wrong by 1.2e-5 of the spread.
const FAR: f64 = 200.0;

/// The origin of a scene, world units: zero, or the middle of the cameras in whole units where it is [`FAR`]
/// away, as in the coordinates of a survey (UTM).
pub(super) fn origin_of(drafts: &[Draft]) -> DVec3 {
    let cameras = drafts.iter().filter(|d| d.refused.is_none());
    let at: Vec<DVec3> = cameras
        .map(|d| d.world_from_camera.w_axis.truncate())
        .filter(|position| position.is_finite())
        .collect();
    let middle = at.iter().sum::<DVec3>() / at.len().max(1) as f64;
    let spread = at.iter().map(|p| p.distance(middle)).fold(0.0, f64::max);
    // One camera, or several at one place, have no spread.
    let unit = if spread > 0.0 { spread } else { FAR };
    if middle.length() > FAR * unit { middle.round() } else { DVec3::ZERO }
}

/// Reads the size of the pixels to which a camera refers.
fn size(image: &Path, pixels: Pixels) -> Result<Probe> {
    let stored = probe(image)?;
    Ok(match pixels {
        Pixels::Stored => stored,
        Pixels::Upright => stored.upright(),
    })
}

fn frame(
    path: &Path,
    mut draft: Draft,
    image: PathBuf,
    stored: &Probe,
    notes: &mut Notes,
) -> Result<Frame> {
    let bad = |expected: String, got: String| {
        Err(Error::format(path, expected, got).at(draft.place.clone()))
    };
    if stored.orientation.is_some() {
        notes.with_orientation.push(draft.file.clone());
    }
    let mut other_shape = None;
    let view = draft.view.take();
    let found = match &view {
        Some(view) => {
            Ok(StoredIntrinsics { intrinsics: view_intrinsics(&draft, view), rescaled: false })
        }
        None => stored_intrinsics(&draft, stored),
    };
    let StoredIntrinsics { intrinsics, rescaled } = match found {
        Ok(k) => k,
        Err(misfit) => {
            let Misfit { intrinsics, got } = misfit;
            let Intrinsics { width: w, height: h, .. } = intrinsics;
            let expected = format!("{} of {w}x{h}, or of the same shape", image.display());
            notes.other_shape.push(draft.file.clone());
            notes.other_shape_error.get_or_insert_with(|| {
                Error::format(path, expected, got.clone()).at(draft.place.clone())
            });
            other_shape = Some(got);
            StoredIntrinsics { intrinsics, rescaled: false }
        }
    };
    if rescaled {
        notes.rescaled.push(draft.file.clone());
    }
    let OrthonormalPose { pose, error } = orthonormal(draft.world_from_camera);
    if error > 1e-3 && error <= f64::from(Camera::RIGID_TOLERANCE) {
        notes.skewed.push(draft.file.clone());
    }
    let camera = match Camera::new(intrinsics, pose.as_mat4()) {
        Ok(camera) => camera,
        Err(e) => return Err(camera_error(path, &draft.place, &e)),
    };
    if let Err(e) = draft.distortion.check() {
        return bad("finite distortion coefficients".to_owned(), e);
    }
    let mask = mask(&draft, &image, stored, notes);
    let label = view.as_ref().map_or("", |view| &view.label);
    Ok(Frame {
        name: frame_name(&draft.file) + label,
        entry: 0,
        image,
        pixels: draft.pixels,
        camera,
        distortion: draft.distortion,
        cut: view.map(|view| view.cut),
        other_shape,
        timestamp: draft.timestamp,
        depth: draft.depth,
        mask,
        visible: draft.visible,
    })
}

/// Intrinsics of a view: its lens, which an estimation may have changed, with its size.
fn view_intrinsics(draft: &Draft, view: &DraftView) -> Intrinsics {
    let k = view.cut.view;
    match draft.lens {
        Lens::Pixels(lens) => {
            let [fx, fy, cx, cy] = lens.map(|v| v as f32);
            Intrinsics { fx, fy, cx, cy, ..k }
        }
        Lens::Normalised(_) | Lens::Centred(_) | Lens::LargerSide(_) => k,
    }
}

/// The mask of a picture; `None` without one that can be used.
fn mask(draft: &Draft, image: &Path, stored: &Probe, notes: &mut Notes) -> Option<PathBuf> {
    let file = draft.mask.clone().or_else(|| masks::of_photograph(image))?;
    // A camera alone needs no mask.
    if !image.is_file() {
        return None;
    }
    let checked = match draft.pixels {
        Pixels::Stored => masks::check(&file, stored),
        Pixels::Upright => probe(image).and_then(|stored| masks::check(&file, &stored)),
    };
    if checked.is_err() {
        notes.unmasked.push(draft.file.clone());
    }
    checked.is_ok().then_some(file)
}

/// A picture's path in a pose file without `images/` and without the extension of a picture: a name without
/// one may have dots.
pub(super) fn frame_name(file: &str) -> String {
    let name = file.replace('\\', "/");
    let name = name.trim_start_matches("./").trim_start_matches("images/");
    match name.rsplit_once('.') {
        Some((stem, extension)) if is_extension(extension) && !stem.is_empty() => stem.to_owned(),
        _ => name.to_owned(),
    }
}

/// Takes the folder that all frames share from their names where these lead out of the scene's folder: results are
/// files of these names.
fn shorten_names(frames: &mut [Frame]) {
    let leads_out = |name: &str| {
        let drive = name.as_bytes().get(1) == Some(&b':');
        name.starts_with('/') || name.starts_with("../") || drive
    };
    if !frames.iter().any(|frame| leads_out(&frame.name)) {
        return;
    }
    let folder = |frame: &Frame| frame.name.rfind('/').map_or(0, |end| end + 1);
    let Some((first, others)) = frames.split_first() else { return };
    let mut shared = first.name[..folder(first)].to_owned();
    for frame in others {
        while !frame.name.starts_with(&shared) {
            let end = shared.trim_end_matches('/').rfind('/').map_or(0, |end| end + 1);
            shared.truncate(end);
        }
    }
    frames.iter_mut().for_each(|frame| frame.name.replace_range(..shared.len(), ""));
}

/// Derives the scene's name from the nearest folder that is not part of a format's layout.
pub(super) fn scene_name(pose_file: &Path) -> String {
    let absolute = std::fs::canonicalize(pose_file).unwrap_or_else(|_| pose_file.to_owned());
    let mut folder = if absolute.is_dir() { Some(absolute.as_path()) } else { absolute.parent() };
    while let Some(f) = folder {
        let name = f.file_name().unwrap_or_default().to_string_lossy();
        let inner = ["sparse", "colmap", "images"].contains(&name.as_ref())
            || name.chars().all(|c| c.is_ascii_digit())
                && f.parent().is_some_and(|p| p.ends_with("sparse"));
        if !inner && !name.is_empty() {
            return name.into_owned();
        }
        folder = f.parent();
    }
    "scene".to_owned()
}
