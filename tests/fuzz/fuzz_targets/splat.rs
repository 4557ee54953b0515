//! `subsplat::files::splats::splat::parse_splat` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::splat::parse_splat(bytes, "fuzz.splat");
});
