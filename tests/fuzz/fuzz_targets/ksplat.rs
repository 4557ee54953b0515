//! `subsplat::files::splats::ksplat::parse_ksplat` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::ksplat::parse_ksplat(bytes, "fuzz.ksplat");
});
