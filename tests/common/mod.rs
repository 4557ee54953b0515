//! What integration tests share.

use std::path::{Path, PathBuf};

/// Path of a fixture beside the project, `../shared/<rel>` (or below the folder
/// that `SUBSPLAT_SHARED_DIR` names). `None`, said aloud, where it is absent; a
/// panic there under `SUBSPLAT_SHARED=require`.
pub fn shared(rel: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"));
    let path = root.join(rel);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require");
    assert!(!required, "{} is required and absent", path.display());
    eprintln!("SKIP: {} is absent", path.display());
    None
}
