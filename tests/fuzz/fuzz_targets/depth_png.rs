//! `subsplat::files::photos::image::parse_depth_png` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::photos::image::parse_depth_png(bytes, 0.001, "fuzz.png");
});
