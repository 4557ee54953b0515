//! `subsplat::files::splats::glb::parse_glb` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::glb::parse_glb(bytes, "fuzz.glb");
});
