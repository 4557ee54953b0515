//! Single tags of the first directory of a TIFF file, for what the decoder does not tell (TIFF 6.0, section 2).

/// Most values of a tag that are read.
const VALUES: usize = 64;

/// Most directories that are counted.
const PAGES: usize = 1000;

/// Tags.
const NEW_SUBFILE_TYPE: u16 = 254;
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

/// Number of pages: directories of whole pictures, without reduced copies and masks (`NewSubfileType`), 1000 at most; 0
/// for other files.
pub(super) fn pages(bytes: &[u8]) -> usize {
    if !is_tiff(bytes) {
        return 0;
    }
    let file = Reader { bytes, little: bytes[0] == b'I' };
    let mut seen = Vec::new();
    let mut pages = 0;
    let mut next = file.number(4, 4);
    while let Some(directory) = next.map(|at| at as usize).filter(|at| *at > 0)
        && seen.len() < PAGES
        && !seen.contains(&directory)
    {
        seen.push(directory);
        let Some(entries) = file.number(directory, 2).map(|count| count as usize) else { break };
        // A directory that is cut is no page.
        let Some(link) = file.number(directory + 2 + 12 * entries, 4) else { break };
        let tag = |at: &usize| file.number(*at, 2) == Some(u32::from(NEW_SUBFILE_TYPE));
        let kind = (0..entries).map(|i| directory + 2 + 12 * i).find(tag);
        // A page of several has the bit 2, which leaves the others.
        let kind = kind.and_then(|at| file.number(at + 8, 4)).unwrap_or(0);
        pages += usize::from(kind & !2 == 0);
        next = Some(link);
    }
    pages
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
        assert_eq!((pages(&little), pages(b"RIFF")), (1, 0));
        let big = b"MM\0*\0\0\0\x08\0\x01\x01\x52\0\x03\0\0\0\x01\0\x02\0\0";
        assert_eq!(numbers(big, EXTRA_SAMPLES), Some(vec![2]));
        for cut in 0..little.len() {
            let _ = numbers(&little[..cut], MAX_SAMPLE_VALUE);
        }
        // Four directories of one tag: two pages, a reduced copy, and a link back to the first one.
        let directory = |kind: u8, next: u8| {
            let tag = [0xfe, 0, 4, 0, 1, 0, 0, 0, kind, 0, 0, 0];
            [&[1, 0][..], &tag, &[next, 0, 0, 0]].concat()
        };
        let several = [(2, 26), (1, 44), (0, 62), (4, 8)].map(|(kind, next)| directory(kind, next));
        let several = [b"II*\0\x08\0\0\0".to_vec(), several.concat()].concat();
        assert_eq!(pages(&several), 2);
        for cut in 0..several.len() {
            assert!(pages(&several[..cut]) <= 2);
        }
        let hostile = [&b"II*\0\xff\xff\xff\xff"[..], &[0xff; 40]].concat();
        assert_eq!(numbers(&hostile, 256), None);
    }
}
