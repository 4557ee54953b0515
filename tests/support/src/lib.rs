//! Oracles, scenes and file writers that several test programs share.

pub mod answers;
pub mod box_room;
pub mod checkpoints;
pub mod chunk_files;
pub mod colmap_files;
pub mod cpu_against_gpu;
pub mod edit;
pub mod finite_differences;
pub mod fit_scene;
pub mod gather;
pub mod gpu;
pub mod made_up;
pub mod noise;
pub mod npy;
pub mod one_splat;
pub mod oracle;
pub mod pose_errors;
pub mod posed_photos;
pub mod primaries_reference;
pub mod raster_case;
pub mod raster_gradients;
pub mod raster_scene;
pub mod same;
pub mod scene_folder;
pub mod scenes;
pub mod spgr_calls;
pub mod spgr_reference;
pub mod splat_scene;
pub mod torch_writer;
pub mod whole;
pub mod witness;

use std::path::PathBuf;

/// The references beside the project.
fn references() -> PathBuf {
    std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map_or_else(|| repository().join("../shared"), PathBuf::from)
}

/// Path of a file or folder of the references beside the project. Where it is absent: the
/// part of it that is committed (`tests/goldens/README.md`), or `None` and a message that
/// cargo does not hide. `SUBSPLAT_SHARED=require` (CI) turns absence into failure.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let path = references().join(relative);
    if path.exists() {
        return Some(path);
    }
    let required = std::env::var("SUBSPLAT_SHARED").is_ok_and(|v| v == "require");
    assert!(!required, "reference {relative} is required and absent");
    if let Some(path) = committed(relative) {
        return Some(path);
    }
    // Not `eprintln!`, which cargo hides for tests that pass.
    let line = format!("SKIP: reference {relative} is absent; this test checked nothing\n");
    std::io::Write::write_all(&mut std::io::stderr(), line.as_bytes()).ok();
    None
}

/// Top folder of the repository.
pub fn repository() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

/// Path of the committed copy of `fixtures/…`.
pub fn committed(relative: &str) -> Option<PathBuf> {
    let goldens = repository().join("tests/goldens");
    let path = goldens.join(relative.strip_prefix("fixtures/")?);
    path.exists().then_some(path)
}

/// The rasterizer cases that are there, in order: all 16 with the references, else the
/// committed ones.
pub fn raster_cases() -> Vec<PathBuf> {
    let folder = shared("fixtures/raster").expect("committed cases");
    let all = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut cases: Vec<_> =
        all.filter(|p| p.extension().is_some_and(|e| e == "safetensors")).collect();
    cases.sort();
    let least = if references().join("fixtures/raster").exists() { 16 } else { 5 };
    assert!(cases.len() >= least, "{} rasterizer cases", cases.len());
    cases
}
