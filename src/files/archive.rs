//! Entries of zip archives: stored or deflated, with their size and CRC-32 compared.

use flate2::Crc;
use flate2::read::DeflateDecoder;
use std::io::{Cursor, Read};
use zip::{CompressionMethod, ZipArchive};

/// Reads the entry `name`, at most `limit` bytes.
///
/// # Errors
/// The expected and the found: no such entry, one that is encrypted, too large, cut short or changed.
pub(super) fn entry(
    archive: &mut ZipArchive<Cursor<&[u8]>>,
    name: &str,
    limit: u64,
) -> Result<Vec<u8>, (String, String)> {
    let whole = |e: &dyn std::fmt::Display| ("a whole entry".to_owned(), e.to_string());
    let index = archive
        .index_for_name(name)
        .ok_or_else(|| ("an entry of the archive".to_owned(), "none".to_owned()))?;
    let mut entry = archive.by_index_raw(index).map_err(|e| whole(&e))?;
    let (size, crc, method) = (entry.size(), entry.crc32(), entry.compression());
    if size > limit {
        return Err((format!("at most {limit} bytes"), size.to_string()));
    }
    let mut content = Vec::new();
    let mut source: Box<dyn Read> = match method {
        CompressionMethod::Stored => Box::new(&mut entry),
        CompressionMethod::DEFLATE => Box::new(DeflateDecoder::new(&mut entry)),
        other => return Err(("a stored or deflated entry".to_owned(), other.to_string())),
    };
    Read::take(&mut source, size + 1).read_to_end(&mut content).map_err(|e| whole(&e))?;
    if content.len() as u64 != size {
        let got = format!("{} or more", content.len());
        return Err((format!("{size} bytes, as the archive says"), got));
    }
    let mut sum = Crc::new();
    sum.update(&content);
    if sum.sum() != crc {
        return Err((format!("checksum {crc:08x}"), format!("{:08x}", sum.sum())));
    }
    Ok(content)
}
