//! The files of a SOG: entries of a zip, or files of a folder, and pictures of bytes.
//!
//! [`archive::entry`] reads an entry. A picture's size is compared with the bytes of all files so far before it is
//! decoded.

use super::META;
use crate::files::{Error, Result, archive, read};
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader};
use std::io::Cursor;
use std::path::{Component, Path};
use zip::ZipArchive;

/// Longest `meta.json`, bytes: three codebooks of 256 numbers are 20 KB.
const META_MAX: u64 = 4 << 20;
/// Most entries of an archive; a SOG has eight, and the folders of a Mac a few more.
const ENTRIES_MAX: usize = 4096;
/// Decoded size that is always accepted, and the largest ratio of compression beyond it.
const DECODED_FREE: u64 = 64 << 20;
const RATIO_MAX: u64 = 256;

/// Place of the files.
enum Place<'a> {
    /// Entries whose names begin with the prefix.
    Zip { archive: ZipArchive<Cursor<&'a [u8]>>, prefix: String },
    /// Files beside `meta.json`.
    Folder(&'a Path),
}

/// The files of a SOG.
pub(super) struct Container<'a> {
    place: Place<'a>,
    /// The archive or `meta.json`, for errors.
    pub path: &'a Path,
    /// Bytes read so far.
    pub bytes: u64,
    /// Bytes decoded so far.
    decoded: u64,
}

/// A decoded picture.
pub(super) struct Plane {
    name: String,
    width: usize,
    height: usize,
    rgba: Vec<u8>,
    /// Compressed with losses, which change the numbers.
    pub is_lossy: bool,
}

impl<'a> Container<'a> {
    /// Opens an archive.
    pub fn zip(bytes: &'a [u8], path: &'a Path) -> Result<Self> {
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| {
            Error::format(path, "a whole zip archive (.sog)", format!("{e}: cut short?"))
        })?;
        if archive.len() > ENTRIES_MAX {
            let expected = format!("at most {ENTRIES_MAX} entries");
            return Err(Error::format(path, expected, archive.len().to_string()));
        }
        // A folder that was packed by hand stands in the archive itself.
        let suffix = format!("/{META}");
        let metas = archive.file_names().filter_map(|name| {
            let name = name.ok()?;
            let ours = name == META || name.ends_with(&suffix) && !name.starts_with("__MACOSX");
            ours.then(|| name[..name.len() - META.len()].to_owned())
        });
        let prefix = metas.min_by_key(String::len).ok_or_else(|| {
            Error::format(
                path,
                format!("{META} in the archive (.sog)"),
                "none: another kind of zip?",
            )
        })?;
        let place = Place::Zip { archive, prefix };
        Ok(Self { place, path, bytes: bytes.len() as u64, decoded: 0 })
    }

    /// Opens the folder of `path`, which is `meta.json`.
    pub fn folder(path: &'a Path) -> Self {
        let folder = path.parent().unwrap_or(Path::new(""));
        Self { place: Place::Folder(folder), path, bytes: 0, decoded: 0 }
    }

    /// Makes an error about file `name`.
    pub fn bad(&self, name: &str, expected: impl Into<String>, got: impl Into<String>) -> Error {
        let shown: String = name.chars().take(80).flat_map(char::escape_debug).collect();
        Error::format(self.path, expected, got).at(format!(" {shown}"))
    }

    /// Reads `meta.json`.
    pub fn meta(&mut self) -> Result<Vec<u8>> {
        match self.place {
            Place::Zip { .. } => self.file(META, META_MAX),
            Place::Folder(_) => {
                let length =
                    std::fs::metadata(self.path).map_err(|e| Error::io(self.path, e))?.len();
                if length > META_MAX {
                    let expected = format!("at most {META_MAX} bytes of JSON");
                    return Err(Error::format(self.path, expected, length.to_string()));
                }
                self.bytes += length;
                read(self.path)
            }
        }
    }

    /// Reads file `name`, at most `limit` bytes.
    fn file(&mut self, name: &str, limit: u64) -> Result<Vec<u8>> {
        let plain = Path::new(name).components().all(|c| matches!(c, Component::Normal(_)));
        if name.is_empty() || !plain || name.contains('\\') {
            return Err(self.bad(name, "the name of a file beside meta.json", "a path elsewhere"));
        }
        if let Place::Folder(folder) = self.place {
            let content = read(folder.join(name))?;
            self.bytes += content.len() as u64;
            return Ok(content);
        }
        self.entry(name, limit).map_err(|(expected, got)| self.bad(name, expected, got))
    }

    /// Reads an entry; errors are what is expected and what is found.
    fn entry(&mut self, name: &str, limit: u64) -> std::result::Result<Vec<u8>, (String, String)> {
        let Place::Zip { archive, prefix } = &mut self.place else {
            return Err(("an archive".to_owned(), "a folder".to_owned()));
        };
        archive::entry(archive, &format!("{prefix}{name}"), limit)
    }

    /// Counts `size` decoded bytes, and refuses what no picture of real numbers shrinks to.
    pub fn count_decoded(&mut self, name: &str, size: u64) -> Result<()> {
        self.decoded = self.decoded.saturating_add(size);
        let limit = DECODED_FREE.max(RATIO_MAX.saturating_mul(self.bytes));
        if self.decoded > limit {
            let got = format!("{} or more from {}", self.decoded, self.bytes);
            return Err(self.bad(name, format!("at most {limit} decoded bytes"), got));
        }
        Ok(())
    }

    /// Reads and decodes picture `name`.
    pub fn plane(&mut self, name: &str) -> Result<Plane> {
        // The archive limits the size of an entry that is stored; one that is deflated may be a bomb.
        let limit = DECODED_FREE.max(RATIO_MAX.saturating_mul(self.bytes));
        let bytes = self.file(name, limit)?;
        let wrong = |e: &dyn std::fmt::Display| {
            self.bad(name, "a whole picture (.webp or .png)", e.to_string())
        };
        let reader = ImageReader::new(Cursor::new(&bytes[..]));
        let reader = reader.with_guessed_format().map_err(|e| wrong(&e))?;
        if !matches!(reader.format(), Some(ImageFormat::WebP | ImageFormat::Png)) {
            return Err(wrong(&"another format"));
        }
        let decoder = reader.into_decoder().map_err(|e| wrong(&e))?;
        let (width, height) = decoder.dimensions();
        self.count_decoded(name, 4 * u64::from(width) * u64::from(height))?;
        let picture = DynamicImage::from_decoder(decoder)
            .map_err(|e| self.bad(name, "a whole picture (.webp or .png)", e.to_string()))?;
        Ok(Plane {
            name: name.to_owned(),
            width: width as usize,
            height: height as usize,
            rgba: picture.into_rgba8().into_raw(),
            is_lossy: bytes.get(12..16) == Some(b"VP8 "),
        })
    }

    /// [`Self::plane`] with a pixel for each of `count` Gaussians.
    pub fn plane_of(&mut self, name: &str, count: usize) -> Result<Plane> {
        let plane = self.plane(name)?;
        if plane.width * plane.height < count {
            let got = format!("{}x{}", plane.width, plane.height);
            return Err(self.bad(name, format!("{count} pixels or more"), got));
        }
        Ok(plane)
    }
}

impl Plane {
    /// Returns RGBA of pixel `i` in the order of the lines.
    pub fn pixel(&self, i: usize) -> [u8; 4] {
        std::array::from_fn(|c| self.rgba[4 * i + c])
    }

    /// Returns name, width and height.
    pub fn shape(&self) -> (&str, usize, usize) {
        (&self.name, self.width, self.height)
    }
}
