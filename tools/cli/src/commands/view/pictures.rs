//! Pictures of the window as files.

use anyhow::{Context, Result, bail};
use std::fs::OpenOptions;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use subsplat::io::image::{Rgb, save_png};

/// Most pictures of one name in a folder.
const MOST: usize = 9999;

/// Writes `picture` as the first NAME-0001.png, NAME-0002.png … that is free.
///
/// # Errors
/// The folder cannot be made or written to; it holds all the numbers.
pub fn save_next(folder: &Path, name: &str, picture: &Rgb) -> Result<PathBuf> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let name = name.replace(['/', '\\', ':'], "_");
    for number in 1..=MOST {
        let path = folder.join(format!("{name}-{number:04}.png"));
        // An empty file holds the name until the picture is whole.
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(_) => {}
            Err(e) if e.kind() == ErrorKind::AlreadyExists => continue,
            Err(e) => return Err(e).with_context(|| path.display().to_string()),
        }
        if let Err(e) = save_png(&path, picture) {
            // Best effort: the first error is the one worth telling.
            let _ = std::fs::remove_file(&path);
            return Err(e.into());
        }
        return Ok(path);
    }
    bail!("{}: holds {MOST} pictures {name}-*.png already", folder.display())
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
        let whole = subsplat::io::image::load(&deep.join("s-0003.png")).unwrap();
        assert_eq!((whole.width, whole.height), (2, 1));
        // A picture that cannot be written leaves no file.
        let none = Rgb { width: 2, height: 1, data: Vec::new() };
        assert!(save_next(&deep, "s", &none).is_err());
        assert_eq!(std::fs::read_dir(&deep).unwrap().count(), 4);
    }
}
