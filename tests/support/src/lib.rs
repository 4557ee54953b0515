//! Oracles, scenes and file writers that several test programs share.

pub mod checkpoints;
pub mod chunk_files;
pub mod colmap_files;
pub mod gpu;
pub mod made_up;
pub mod noise;
pub mod one_splat;
pub mod oracle;
pub mod raster_case;
pub mod raster_gradients;
pub mod raster_scene;
pub mod scene_folder;
pub mod scenes;
pub mod spgr_calls;
pub mod splat_scene;
pub mod torch_writer;
pub mod twins;
pub mod whole;
pub mod witness;

use std::path::PathBuf;

/// A file or folder of the references beside the project, or `None`, loudly, where
/// they are absent. `SUBSPLAT_SHARED=require` (CI) turns absence into failure.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map_or_else(|| repository().join("../shared"), PathBuf::from);
    let path = folder.join(relative);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require");
    assert!(!required, "reference {relative} is required and absent");
    // Not `eprintln!`, which cargo hides for tests that pass.
    let line = format!("SKIP: reference {relative} is absent; this test checked nothing\n");
    std::io::Write::write_all(&mut std::io::stderr(), line.as_bytes()).ok();
    None
}

/// Top folder of the repository.
pub fn repository() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}
