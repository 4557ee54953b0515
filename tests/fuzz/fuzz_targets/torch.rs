//! `subsplat::files::torch` on arbitrary bytes, every tensor read: an answer, never a panic.
#![no_main]

use subsplat::files::weights::torch::TorchFile;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Ok(file) = TorchFile::parse(bytes, "fuzz.pt") else { return };
    let mut left = vec![file.root()];
    while let Some(value) = left.pop() {
        if let Some(tensor) = value.as_tensor() {
            let _ = file.read(tensor);
        }
        left.extend(value.items().unwrap_or_default());
        left.extend(value.entries().map(|(_, v)| v));
    }
});
