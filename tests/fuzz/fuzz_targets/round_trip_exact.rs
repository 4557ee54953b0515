//! The target `round_trip_exact` of `subsplat_fuzz::targets`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| subsplat_fuzz::targets::call("round_trip_exact", bytes));
