//! Names of other file formats, for messages.

/// Bytes of the file's start that [`name`] reads.
pub(super) const HEAD: u64 = 512;

/// Formats by their first bytes.
const STARTS: &[(&[u8], &str)] = &[
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"\x1f\x8b", "a gzip file"),
    (b"\x28\xb5\x2f\xfd", "a zstd file"),
    (b"7z\xbc\xaf", "a 7z archive"),
    (b"\xfd7zXZ", "an xz file"),
    (b"BZh", "a bzip2 file"),
    (b"\x89HDF", "an HDF5 file"),
    (b"\x93NUMPY", "NumPy's .npy file"),
    (b"GGUF", "a GGUF file"),
    (b"ply\n", "a PLY file"),
    (b"glTF", "a glTF file"),
    (b"RIFF", "a WebP picture or another RIFF file"),
    (b"PK\x05\x06", "an empty zip archive"),
    (b"version https://git-lfs", "a Git LFS pointer, without the file that it points to"),
];

/// Names the format of a file of `length` bytes that starts with `head`.
pub(super) fn name(head: &[u8], length: u64) -> String {
    if head.is_empty() {
        return "an empty file".to_owned();
    }
    if let Some((_, name)) = STARTS.iter().find(|(start, _)| head.starts_with(start)) {
        return (*name).to_owned();
    }
    if head.get(257..262) == Some(b"ustar") {
        return "a tar archive (PyTorch's oldest form: load and save it with a newer PyTorch)"
            .to_owned();
    }
    if let Some((size, rest)) = head.split_first_chunk::<8>()
        && u64::from_le_bytes(*size) < length
        && rest.starts_with(b"{")
    {
        return "a safetensors file, which needs no conversion".to_owned();
    }
    if let [0x80, 2..=5, ..] = head {
        return "a plain pickle, not written by torch.save".to_owned();
    }
    if std::str::from_utf8(head.get(..16).unwrap_or(head)).is_ok_and(|t| !t.contains('\0')) {
        return "text".to_owned();
    }
    let shown: Vec<String> = head.iter().take(8).map(|b| format!("{b:02x}")).collect();
    format!("a file that starts with the bytes {}", shown.join(" "))
}
