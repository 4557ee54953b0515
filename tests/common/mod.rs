//! What several integration tests share.

use std::path::PathBuf;

/// A file or folder of the references beside the project, or `None`, loudly, where
/// they are absent. `SUBSPLAT_SHARED=require` (CI) turns absence into failure.
#[allow(dead_code, reason = "not every test binary uses every helper")]
pub fn shared(relative: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("SUBSPLAT_SHARED_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
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
