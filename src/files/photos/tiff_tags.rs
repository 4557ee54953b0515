//! Single tags of the first directory of a TIFF file, for what the decoder does not tell (TIFF 6.0, section 2).

/// Most values of a tag that are read.
const VALUES: usize = 64;

/// Tags.
pub(super) const ORIENTATION: u16 = 274;
pub(super) const MAX_SAMPLE_VALUE: u16 = 281;
pub(super) const EXTRA_SAMPLES: u16 = 338;
pub(super) const DNG_VERSION: u16 = 0xc612;

/// Returns whether `start` begins as a TIFF file does; not so a BigTIFF.
pub(super) fn is_tiff(start: &[u8]) -> bool {
    start.starts_with(b"II*\0") || start.starts_with(b"MM\0*")
}

/// Bytes of a file with the order of its numbers.
struct Reader<'a> {
    bytes: &'a [u8],
    little: bool,
}

impl Reader<'_> {
    fn number(&self, at: usize, count: usize) -> Option<u32> {
        let bytes = self.bytes.get(at..at.checked_add(count)?)?;
        let add = |value: u32, byte: &u8| value << 8 | u32::from(*byte);
        Some(if self.little { bytes.iter().rev().fold(0, add) } else { bytes.iter().fold(0, add) })
    }
}

/// Reads the whole numbers of a tag, at most 64; `None` without the tag, for other types and for a
/// directory that is cut.
pub(super) fn numbers(bytes: &[u8], tag: u16) -> Option<Vec<u32>> {
    if !is_tiff(bytes) {
        return None;
    }
    let file = Reader { bytes, little: bytes[0] == b'I' };
    let directory = file.number(4, 4)? as usize;
    let entries = file.number(directory, 2)? as usize;
    // The number of entries has 16 bits.
    let mut places = (0..entries).map(|i| directory + 2 + 12 * i);
    let entry = places.find(|at| file.number(*at, 2) == Some(u32::from(tag)))?;
    // BYTE, SHORT, LONG.
    let size = match file.number(entry + 2, 2)? {
        1 => 1,
        3 => 2,
        4 => 4,
        _ => return None,
    };
    let count = (file.number(entry + 4, 4)? as usize).min(VALUES);
    let inline = entry + 8;
    let at = if count * size <= 4 { inline } else { file.number(inline, 4)? as usize };
    (0..count).map(|i| file.number(at.checked_add(i * size)?, size)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tags_of_both_orders_are_read() {
        let little = [
            &b"II*\0\x08\0\0\0\x03\0"[..],
            &[0x00, 1, 3, 0, 1, 0, 0, 0, 8, 0, 0, 0],
            &[0x19, 1, 3, 0, 3, 0, 0, 0, 50, 0, 0, 0],
            &[0x12, 0xc6, 1, 0, 4, 0, 0, 0, 1, 4, 0, 0],
            &[0; 4],
            &[0xff, 0x0f, 0xff, 0x0f, 2, 0],
        ]
        .concat();
        assert_eq!(numbers(&little, 256), Some(vec![8]));
        assert_eq!(numbers(&little, DNG_VERSION), Some(vec![1, 4, 0, 0]));
        // The three values lie behind the directory of 42 bytes and its link.
        assert_eq!(little.len(), 56);
        assert_eq!(numbers(&little, MAX_SAMPLE_VALUE), Some(vec![4095, 4095, 2]));
        assert_eq!(numbers(&little, EXTRA_SAMPLES), None);
        let big = b"MM\0*\0\0\0\x08\0\x01\x01\x52\0\x03\0\0\0\x01\0\x02\0\0";
        assert_eq!(numbers(big, EXTRA_SAMPLES), Some(vec![2]));
        for cut in 0..little.len() {
            let _ = numbers(&little[..cut], MAX_SAMPLE_VALUE);
        }
        let hostile = [&b"II*\0\xff\xff\xff\xff"[..], &[0xff; 40]].concat();
        assert_eq!(numbers(&hostile, 256), None);
    }
}
