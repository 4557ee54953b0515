//! Entries that the assembly of frames leaves out, ignores and corrects.

use super::scene::LeftOut;
use crate::files::Error;
use std::path::Path;

/// Files that give warnings, one line for each kind.
#[derive(Debug, Default)]
pub(super) struct Notes {
    /// Entries that cannot be loaded, in the order of the file.
    pub left_out: Vec<LeftOut>,
    /// Entries without a frame, with the reason.
    pub refused: Vec<String>,
    /// Error of the first of them.
    pub refused_error: Option<Error>,
    /// Entries without a picture on disk.
    pub missing: Vec<String>,
    /// Entries with a picture of another shape.
    pub other_shape: Vec<String>,
    /// Error of the first frame of `other_shape`.
    pub other_shape_error: Option<Error>,
    /// Pictures with an EXIF orientation.
    pub with_orientation: Vec<String>,
    /// Pictures of another size.
    pub rescaled: Vec<String>,
    /// Poses with a rotation that was corrected.
    pub skewed: Vec<String>,
    /// Pictures whose mask is not used.
    pub unmasked: Vec<String>,
    /// Pictures without a mask, where others have one.
    pub without_mask: Vec<String>,
}

impl Notes {
    /// Notes an entry without a camera or with a picture that cannot be read.
    pub fn refuse(&mut self, entry: usize, file: &str, error: Error) {
        let reason = match &error {
            Error::Format { path, at, expected, got } => {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                let place = if at.is_empty() { String::new() } else { format!("{name}{at}: ") };
                format!("{place}expected {expected}, got {got}")
            }
            Error::Io { source, .. } => source.to_string(),
        };
        self.refused.push(format!("{file} ({reason})"));
        self.refused_error.get_or_insert(error);
        self.left_out.push(LeftOut { entry, name: file.to_owned(), reason });
    }

    /// Notes an entry without a picture on disk.
    pub fn miss(&mut self, entry: usize, file: String) {
        self.missing.push(file.clone());
        let reason = "no picture on disk".to_owned();
        self.left_out.push(LeftOut { entry, name: file, reason });
    }

    /// The error of a strict reading where an entry of `count` or a mask is left out.
    pub fn strict_error(&self, path: &Path, count: usize) -> Option<Error> {
        let bad = self.left_out.len() + self.unmasked.len();
        let first = match (self.left_out.first(), self.unmasked.first()) {
            (Some(first), _) => format!("{} ({})", first.name, first.reason),
            (None, Some(first)) => format!("{first} (a mask that cannot be used)"),
            (None, None) => return None,
        };
        let expected = format!("all of {count} entries with their pictures and masks (strict)");
        Some(Error::format(
            path,
            expected,
            format!("{bad} that are not used: the first is {first}"),
        ))
    }

    /// One line for each kind of note about `count` entries.
    pub fn lines(&self, count: usize) -> Vec<String> {
        let kinds = [
            (&self.refused, "are left out"),
            (&self.missing, "have no picture on disk and are left out"),
            (
                &self.other_shape,
                "have pictures of another shape than the cameras' and cannot be used",
            ),
            (
                &self.with_orientation,
                "have an EXIF orientation: ignored, pose files refer to the stored pixels",
            ),
            (&self.rescaled, "are stored at another size than the pose file's: intrinsics scaled"),
            (&self.skewed, "have a rotation that is not orthonormal (0.1 % to 1 %): corrected"),
            (
                &self.unmasked,
                "have a mask that is missing, cannot be read or has another shape: all of their \
                 pixels are used",
            ),
            (&self.without_mask, "have no mask, as the others have: all of their pixels are used"),
        ];
        let line = |(files, what): (&Vec<String>, &str)| {
            let few: Vec<&str> = files.iter().take(3).map(String::as_str).collect();
            let more = if files.len() > 3 { ", …" } else { "" };
            format!("{} of {count} frames {what}: {}{more}", files.len(), few.join(", "))
        };
        kinds.into_iter().filter(|(files, _)| !files.is_empty()).map(line).collect()
    }
}
