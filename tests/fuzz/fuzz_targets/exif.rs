//! `subsplat::files::photos::exif::parse_exif` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::files::photos::exif::parse_exif(bytes, 4000, 3000);
});
