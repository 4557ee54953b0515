//! The photographs of a folder, by content: a picture under another extension is one, and what cannot be
//! read is named with the reason.

use super::photograph::probe_photograph;
use super::video::is_video;
use super::{heic, jxl, masks, raw, variants};
use crate::files::poses::assemble::{files, has_extension};
use crate::files::{Error, first_bytes, lower_extension};
use std::path::{Path, PathBuf};

/// Extensions of pictures beside the usual ones and the raw ones; some of the formats are not read.
const OTHER_EXTENSIONS: [&str; 6] = ["gif", "exr", "hdr", "cr3", "raf", "insp"];
/// Names of a line; the others are counted.
const NAMES: usize = 3;
/// Bytes that decide what a file is.
const START: usize = 32;

/// Photographs of a folder.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FolderPhotographs {
    /// By name, with numbers in numeric order.
    pub photographs: Vec<PathBuf>,
    /// Names of pictures that are left out, each with the reason.
    pub left_out: Vec<[String; 2]>,
    /// Videos, which `left_out` names too.
    pub videos: Vec<PathBuf>,
    /// Files `._*`, which macOS writes beside others and which are no pictures.
    pub companions: usize,
}

impl FolderPhotographs {
    /// Lines about what is left out.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let mut reasons: Vec<&str> = Vec::new();
        for [_, reason] in &self.left_out {
            if !reasons.contains(&reason.as_str()) {
                reasons.push(reason);
            }
        }
        for reason in reasons {
            let of_reason = self.left_out.iter().filter(|[_, other]| other == reason);
            let names: Vec<&str> = of_reason.map(|[name, _]| name.as_str()).collect();
            let (few, more) = names.split_at(names.len().min(NAMES));
            let more = match more.len() {
                0 => String::new(),
                n => format!(" and {n} more"),
            };
            notes.push(format!("left out: {}{more}: {reason}", few.join(", ")));
        }
        if self.companions > 0 {
            notes.push(format!("{} files ._* of macOS are no pictures", self.companions));
        }
        notes
    }
}

/// Returns whether `folder` has the name of a folder of masks: `masks`, `mask`, `masks_2`.
pub fn is_folder_of_masks(folder: impl AsRef<Path>) -> bool {
    masks::is_folder_of_masks(folder.as_ref())
}

/// The photographs of a folder; without any, those of its folder `images`.
pub fn find_photographs(folder: impl AsRef<Path>) -> FolderPhotographs {
    let folder = folder.as_ref();
    let own = in_folder(folder);
    if own.photographs.is_empty() && own.left_out.len() == own.videos.len() {
        let mut images = in_folder(&folder.join("images"));
        if own.videos.is_empty() || !images.photographs.is_empty() {
            images.left_out.extend(own.left_out);
            return images;
        }
    }
    own
}

fn in_folder(folder: &Path) -> FolderPhotographs {
    let mut found = FolderPhotographs { companions: companions(folder), ..Default::default() };
    let mut pictures = Vec::new();
    for path in files(folder) {
        let moving = is_moving(&path);
        if !moving && !is_picture(&path) {
            continue;
        }
        let reason = if moving {
            found.videos.push(path.clone());
            "a video; give the video alone to use frames of it".to_owned()
        } else {
            match probe_photograph(&path) {
                Ok(header) => {
                    pictures.push(variants::Found { path, header });
                    continue;
                }
                Err(Error::Format { got, .. }) => got,
                Err(Error::Io { source, .. }) => source.to_string(),
            }
        };
        found.left_out.push([variants::name_of(&path), reason]);
    }
    let (photographs, left_out) = variants::sorted_out(pictures);
    found.photographs = photographs;
    found.left_out.extend(left_out);
    found
}

/// Returns whether a file is a video. A GIF in a folder may be a still picture.
fn is_moving(path: &Path) -> bool {
    let gif = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gif"));
    !gif && is_video(path)
}

/// Returns whether a file is, or is called, a picture.
fn is_picture(path: &Path) -> bool {
    let extension = lower_extension(path);
    has_extension(path)
        || OTHER_EXTENSIONS.contains(&&*extension)
        || raw::EXTENSIONS.contains(&&*extension)
        || first_bytes(path, START).is_ok_and(|start| {
            image::guess_format(&start).is_ok()
                || heic::brand(&start).is_some()
                || jxl::is_jxl(&start)
                || raw::is_raw(&start, path)
        })
}

/// Number of files `._*`.
fn companions(folder: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(folder) else { return 0 };
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name()));
    names.filter(|name| name.to_string_lossy().starts_with("._")).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::image::save_png;
    use crate::scene::pictures::Rgb;

    #[test]
    fn pictures_are_found_by_content_and_others_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for (height, name) in ["b10.png", "b9.jfif", "c"].into_iter().enumerate() {
            save_png(path("x.png"), &Rgb::black(4, 3 + height)).unwrap();
            std::fs::rename(path("x.png"), path(name)).unwrap();
        }
        for (name, bytes) in [
            ("._b10.png", &b"\0\x05\x16\x07"[..]),
            ("empty.jpg", b""),
            ("clip.mov", b"nothing"),
            ("notes.txt", b"text"),
            (".hidden.png", b"x"),
        ] {
            std::fs::write(path(name), bytes).unwrap();
        }
        let found = find_photographs(folder.path());
        assert_eq!(found.photographs, ["b9.jfif", "b10.png", "c"].map(path));
        assert_eq!(found.companions, 1);
        assert_eq!(found.left_out.len(), 2, "{:?}", found.left_out);
        assert_eq!(found.left_out[0][0], "clip.mov");
        assert_eq!(found.left_out[1], ["empty.jpg", "an empty file"]);
        let notes = found.notes();
        assert!(notes.len() == 3 && notes[2].contains("._*"), "{notes:?}");
        let many = FolderPhotographs {
            left_out: ["a", "b", "c", "d"].map(|n| [n.to_owned(), "no".to_owned()]).to_vec(),
            ..Default::default()
        };
        assert_eq!(many.notes(), ["left out: a, b, c and 1 more: no"]);
        // Copies: of equal bytes, the shortest name stays.
        for copy in ["b10 (1).png", "b10 (2).png"] {
            std::fs::copy(path("b10.png"), path(copy)).unwrap();
        }
        let mut cropped = std::fs::read(path("b10.png")).unwrap();
        *cropped.last_mut().unwrap() ^= 1;
        std::fs::write(path("a.png"), cropped).unwrap();
        let found = find_photographs(folder.path());
        assert_eq!(found.photographs, ["a.png", "b9.jfif", "b10.png", "c"].map(path));
        let copies = found.notes().into_iter().find(|note| note.contains("a copy of b10.png"));
        assert!(copies.is_some_and(|n| n.contains("b10 (1).png, b10 (2).png")), "{found:?}");
        for extra in ["a.png", "b10 (1).png", "b10 (2).png"] {
            std::fs::remove_file(path(extra)).unwrap();
        }
        // A folder of nothing but `images`.
        std::fs::create_dir(path("inner")).unwrap();
        std::fs::rename(path("c"), path("inner/c")).unwrap();
        std::fs::create_dir(path("outer")).unwrap();
        std::fs::rename(path("inner"), path("outer/images")).unwrap();
        assert_eq!(find_photographs(path("outer")).photographs, [path("outer/images/c")]);
    }
}
