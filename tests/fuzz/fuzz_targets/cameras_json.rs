//! The target `cameras_json` of `subsplat_fuzz::targets`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| subsplat_fuzz::targets::call("cameras_json", bytes));
