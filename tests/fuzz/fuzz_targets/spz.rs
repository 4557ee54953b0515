//! `subsplat::files::splats::spz::parse_spz` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::spz::parse_spz(bytes, "fuzz.spz");
});
