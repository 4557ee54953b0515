//! What several integration tests need.

use std::path::PathBuf;

/// The file or folder `rel` of the fixtures that live beside the project, or `None`
/// (and a loud line) where they are absent. `SUBSPLAT_SHARED_DIR` names another
/// folder; `SUBSPLAT_SHARED=require` turns absence into failure.
pub fn shared(rel: &str) -> Option<PathBuf> {
    let folder = match std::env::var_os("SUBSPLAT_SHARED_DIR") {
        Some(folder) => PathBuf::from(folder),
        None => PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"),
    };
    let path = folder.join(rel);
    if path.exists() {
        return Some(path);
    }
    let require = std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require");
    assert!(!require, "SUBSPLAT_SHARED=require, but {} is absent", path.display());
    eprintln!("SKIP: {} is absent", path.display());
    None
}
