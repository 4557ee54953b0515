//! `subsplat::files::splats::sog::parse_sog` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::splats::sog::parse_sog(bytes, "fuzz.sog");
});
