//! Any bytes as Metashape's cameras: an answer or an error, never a panic, never more memory than a few times the input.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::poses::metashape::parse("fuzz", bytes);
});
