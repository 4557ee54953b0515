//! Files with more than one picture, of which the first one is read: pages of a TIFF, animations.

use super::tiff_tags;

/// A line about a file with more than one picture.
pub(super) fn note(bytes: &[u8]) -> Option<String> {
    match tiff_tags::pages(bytes) {
        0 | 1 if is_animation(bytes) => {
            Some("the file is an animation: its first picture is read".to_owned())
        }
        0 | 1 => None,
        pages => Some(format!("the file has {pages} pages: the first one is read")),
    }
}

/// Returns whether bytes are those of an animated WebP (flag of `VP8X`) or PNG (`acTL` before `IDAT`, PNG 3).
fn is_animation(bytes: &[u8]) -> bool {
    if bytes.starts_with(b"RIFF") && bytes.get(8..16) == Some(b"WEBPVP8X") {
        return bytes.get(20).is_some_and(|flags| flags & 2 != 0);
    }
    let Some(mut rest) = bytes.strip_prefix(b"\x89PNG\r\n\x1a\n") else { return false };
    // A chunk: length, name, data, check sum.
    while let Some(([a, b, c, d, name @ ..], after)) = rest.split_first_chunk::<8>() {
        match name {
            b"acTL" => return true,
            b"IDAT" => return false,
            _ => {}
        }
        let length = u32::from_be_bytes([*a, *b, *c, *d]) as usize;
        let Some(next) = length.checked_add(4).and_then(|n| after.get(n..)) else { return false };
        rest = next;
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_one_picture_is_noted() {
        let png = |chunks: &[&[u8; 4]]| {
            let chunk = |name: &&[u8; 4]| [&[0, 0, 0, 2][..], &name[..], &[0; 6]].concat();
            [b"\x89PNG\r\n\x1a\n".to_vec(), chunks.iter().flat_map(chunk).collect()].concat()
        };
        let webp = |flags: u8| [&b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0"[..], &[flags, 0, 0, 0]].concat();
        for (bytes, animated) in [
            (png(&[b"IHDR", b"acTL", b"IDAT"]), true),
            (png(&[b"IHDR", b"IDAT", b"acTL"]), false),
            (png(&[b"IHDR"]), false),
            (webp(2), true),
            (webp(0x10), false),
            (b"\x89PNG\r\n\x1a\n\xff\xff\xff\xffIHDR".to_vec(), false),
        ] {
            assert_eq!(note(&bytes).is_some(), animated, "{bytes:?}");
        }
    }
}
