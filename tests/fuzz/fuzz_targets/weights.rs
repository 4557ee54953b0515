//! `subsplat::network::model::weights::parse_tensors` on arbitrary bytes: an answer, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let _ = subsplat::network::model::weights::parse_tensors(bytes, std::path::Path::new("fuzz.safetensors"));
});
