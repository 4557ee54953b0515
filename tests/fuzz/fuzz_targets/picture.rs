//! `subsplat::files::photos::image::parse_picture` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::photos::image::parse_picture(bytes, "fuzz.png");
});
