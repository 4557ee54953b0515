//! Helpers that the integration tests share.

use std::path::{Path, PathBuf};

/// A file or folder of the fixtures that live beside the checkout (`../shared`, or
/// `SUBSPLAT_SHARED_DIR`). `None`, with a loud line, where they are absent; a panic
/// where `SUBSPLAT_SHARED=require` says that they must be there.
#[allow(dead_code, reason = "not every test binary uses fixtures")]
pub fn shared(rel: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join(rel);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require");
    assert!(!required, "SUBSPLAT_SHARED=require, but {} is absent", path.display());
    eprintln!("SKIP: {} is absent", path.display());
    None
}
