//! What the integration tests share.

#![allow(dead_code, reason = "each test binary uses its own part")]

use std::path::PathBuf;

/// `rel` inside the folder of shared fixtures that lies beside the project
/// (`SUBSPLAT_SHARED_DIR` names another). `None`, with a loud line, where it is
/// absent; a failure with `SUBSPLAT_SHARED=require`.
pub fn shared(rel: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join(rel);
    if path.exists() {
        return Some(path);
    }
    if std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require") {
        panic!("SUBSPLAT_SHARED=require, but {} is absent", path.display());
    }
    eprintln!("SKIP: {} is absent", path.display());
    None
}
