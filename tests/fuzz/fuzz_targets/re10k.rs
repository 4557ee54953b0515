//! The target `re10k` of `subsplat_fuzz::targets`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| subsplat_fuzz::targets::call("re10k", bytes));
