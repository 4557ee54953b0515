//! Reading of NumPy's `.npy` format, version 1: C order, little-endian.

/// Returns the elements of `file`, whose header must state `descr`, such as `<f4`, and `N` bytes
/// per element.
fn elements<'a, const N: usize>(file: &'a [u8], descr: &str) -> &'a [[u8; N]] {
    assert_eq!(&file[..8], b"\x93NUMPY\x01\x00", "magic and version of a .npy file");
    let start = 10 + usize::from(u16::from_le_bytes([file[8], file[9]]));
    let header = std::str::from_utf8(&file[10..start]).unwrap();
    let expected = [format!("'descr': '{descr}'"), "'fortran_order': False".to_owned()];
    assert!(expected.iter().all(|part| header.contains(part)), "{expected:?}: {header}");
    let (elements, rest) = file[start..].as_chunks();
    assert!(rest.is_empty(), "{} bytes after the last element", rest.len());
    elements
}

/// Reads an array of `float32`.
pub fn floats(file: &[u8]) -> Vec<f32> {
    elements(file, "<f4").iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// Reads an array of `uint8`.
pub fn bytes(file: &[u8]) -> Vec<u8> {
    elements(file, "|u1").iter().map(|[byte]| *byte).collect()
}
