//! The target `metashape_scene` of `subsplat_fuzz::targets`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| subsplat_fuzz::targets::call("metashape_scene", bytes));
