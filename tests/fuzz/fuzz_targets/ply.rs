//! `subsplat::files::splats::ply::parse_ply` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::ply::parse_ply(bytes, "fuzz.ply");
});
