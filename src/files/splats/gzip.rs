//! A gzip stream (RFC 1952) that all threads compress.
//!
//! Each part is compressed by itself and ends at a byte (an empty stored block of deflate, RFC 1951), so that the
//! parts follow one another in one stream, as `pigz` writes it. Decoders see one member. The parts do not refer to
//! one another. The number of threads does not change a byte.

use flate2::{Compress, Compression, Crc, FlushCompress};
use rayon::prelude::*;
use std::io::{Error, Result, Write};

/// Magic, deflate, no flags, no time, no level, unknown system.
const HEAD: [u8; 10] = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255];
/// Parts that are in memory at a time.
const BATCH: usize = 16;
/// Bytes that a compressed part may be longer than the part, at least: blocks of incompressible bytes and the end.
const ROOM: usize = 1024;

/// Writes `head` and then the bytes that `fill` gives for each of `parts`, compressed.
///
/// # Errors
/// Those of `file` and of `fill`.
pub(super) fn write<T: Sync>(
    file: &mut dyn Write,
    head: &[u8],
    parts: &[T],
    fill: impl Fn(&T, &mut Vec<u8>) -> Result<()> + Sync,
) -> Result<()> {
    let mut checksum = Crc::new();
    file.write_all(&HEAD)?;
    let mut put = |part: Part| {
        checksum.combine(&part.checksum);
        file.write_all(&part.compressed)
    };
    put(Part::new(head, FlushCompress::Sync)?)?;
    for batch in parts.chunks(BATCH) {
        let compressed = batch.par_iter().map(|part| {
            let mut bytes = Vec::new();
            fill(part, &mut bytes)?;
            Part::new(&bytes, FlushCompress::Sync)
        });
        compressed.collect::<Result<Vec<_>>>()?.into_iter().try_for_each(&mut put)?;
    }
    put(Part::new(&[], FlushCompress::Finish)?)?;
    file.write_all(&checksum.sum().to_le_bytes())?;
    file.write_all(&checksum.amount().to_le_bytes())
}

/// A part of the stream.
struct Part {
    compressed: Vec<u8>,
    checksum: Crc,
}

impl Part {
    fn new(bytes: &[u8], flush: FlushCompress) -> Result<Self> {
        let mut checksum = Crc::new();
        checksum.update(bytes);
        let mut deflate = Compress::new(Compression::default(), false);
        let mut compressed = Vec::with_capacity(bytes.len() / 2 + ROOM);
        loop {
            let read = deflate.total_in() as usize;
            deflate.compress_vec(&bytes[read..], &mut compressed, flush).map_err(Error::other)?;
            // Room that is left shows that nothing is held back.
            if compressed.len() < compressed.capacity() {
                return Ok(Self { compressed, checksum });
            }
            compressed.reserve(bytes.len() / 4 + ROOM);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::bufread::GzDecoder;
    use std::io::Read;

    /// Bytes without a pattern, then a run of zeros.
    fn noise(n: usize, seed: u32) -> Vec<u8> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        (0..n).map(|_| next()).chain(std::iter::repeat_n(0, n / 3)).collect()
    }

    #[test]
    fn the_stream_is_one_member_of_all_parts() {
        for lengths in [vec![], vec![0], vec![1, 0, 70_000], vec![3000; 2 * BATCH + 1]] {
            let parts: Vec<Vec<u8>> =
                lengths.iter().enumerate().map(|(i, n)| noise(*n, i as u32)).collect();
            let mut file = Vec::new();
            write(&mut file, b"head", &parts, |part, bytes| {
                bytes.extend(part);
                Ok(())
            })
            .unwrap();
            let expected = [b"head".to_vec(), parts.concat()].concat();
            let mut decoder = GzDecoder::new(&file[..]);
            let mut found = Vec::new();
            decoder.read_to_end(&mut found).unwrap();
            assert!(found == expected, "{lengths:?}");
            assert!(decoder.into_inner().is_empty(), "bytes after the member");
            let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            let mut again = Vec::new();
            let fill = |part: &Vec<u8>, bytes: &mut Vec<u8>| {
                bytes.extend(part);
                Ok(())
            };
            one.install(|| write(&mut again, b"head", &parts, fill)).unwrap();
            assert!(again == file);
        }
    }

    #[test]
    fn an_error_of_a_part_is_that_of_the_stream() {
        let mut file = Vec::new();
        let fill = |i: &usize, _: &mut Vec<u8>| match i {
            3 => Err(Error::other("the fourth")),
            _ => Ok(()),
        };
        let error = write(&mut file, b"", &[0, 1, 2, 3], fill).unwrap_err();
        assert_eq!(error.to_string(), "the fourth");
    }
}
