//! `subsplat::files::photos::photograph::parse_photograph` on arbitrary bytes: an answer, never a panic.
#![no_main]

use subsplat::files::photos::image::{LoadOptions, Truncated};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let options = LoadOptions { truncated: Truncated::Accept };
    let path = "fuzz.jpg";
    let _ = subsplat::files::photos::photograph::parse_photograph(bytes, &options, path);
});
