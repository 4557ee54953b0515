//! Files of pictures of the window.

use anyhow::{Context, Result, bail};
use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use subsplat::files::photos::image::save_png;
use subsplat::scene::pictures::Rgb;

/// Largest number of pictures of one name in a folder.
const NUMBER_MAX: usize = 9999;

/// Writes `picture` to the first free file of NAME-0001.png, NAME-0002.png, ….
///
/// # Errors
/// The folder cannot be created or written; it holds all numbers.
pub fn save_next(folder: &Path, name: &str, picture: &Rgb) -> Result<PathBuf> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let name = name.replace(['/', '\\', ':'], "_");
    for number in 1..=NUMBER_MAX {
        let path = folder.join(format!("{name}-{number:04}.png"));
        // An empty file reserves the name until the picture is complete.
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(_) => {}
            Err(e) if e.kind() == ErrorKind::AlreadyExists => continue,
            Err(e) => return Err(e).with_context(|| path.display().to_string()),
        }
        if let Err(e) = save_png(&path, picture) {
            // The first error is reported; removal may fail.
            let _ = std::fs::remove_file(&path);
            return Err(e.into());
        }
        return Ok(path);
    }
    bail!("{}: holds {NUMBER_MAX} pictures {name}-*.png already", folder.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_take_the_next_free_number() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("a/b");
        let picture = Rgb::black(2, 1);
        let name = |path: PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
        assert_eq!(name(save_next(&deep, "s", &picture).unwrap()), "s-0001.png");
        std::fs::write(deep.join("s-0002.png"), b"mine").unwrap();
        assert_eq!(name(save_next(&deep, "s", &picture).unwrap()), "s-0003.png");
        assert_eq!(name(save_next(&deep, "x/y", &picture).unwrap()), "x_y-0001.png");
        assert_eq!(std::fs::read(deep.join("s-0002.png")).unwrap(), b"mine");
        let whole = subsplat::files::photos::image::load(deep.join("s-0003.png")).unwrap();
        assert_eq!((whole.width, whole.height), (2, 1));
        // A picture that cannot be written leaves no file.
        let none = Rgb { width: 2, height: 1, data: Vec::new() };
        assert!(save_next(&deep, "s", &none).is_err());
        assert_eq!(std::fs::read_dir(&deep).unwrap().count(), 4);
    }
}
