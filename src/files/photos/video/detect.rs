//! Recognises videos by their first bytes, and by their extension where the bytes say nothing.

use super::super::heic;
use crate::files::{first_bytes, lower_extension};
use std::path::Path;

/// Extensions of videos.
const EXTENSIONS: [&str; 14] = [
    "mp4", "mov", "m4v", "webm", "mkv", "avi", "mts", "m2ts", "3gp", "3g2", "mpg", "mpeg", "wmv",
    "ogv",
];
/// Bytes that are read: two packets of a transport stream with time codes.
const START: usize = 400;
/// Length of a packet of an MPEG transport stream, bytes, and its first byte.
const PACKET: (usize, u8) = (188, 0x47);

/// Returns whether a file is a video: by content, else by extension. An animated GIF is one.
pub fn is_video(path: impl AsRef<Path>) -> bool {
    let path = path.as_ref();
    let start = start(path);
    if is_picture(&start) {
        return false;
    }
    is_video_content(&start) || (path.is_file() && has_video_extension(path))
}

/// Returns whether a file is a WebP with several frames, which ffmpeg does not read in most versions.
pub fn is_animated_webp(path: impl AsRef<Path>) -> bool {
    /// Bit of the flags of `VP8X` that announces an animation.
    const ANIMATION: u8 = 2;
    let start = start(path.as_ref());
    start.get(8..16) == Some(b"WEBPVP8X")
        && start.get(20).is_some_and(|flags| flags & ANIMATION != 0)
}

/// Returns whether a name ends as those of videos do.
pub(in crate::files) fn has_video_extension(path: &Path) -> bool {
    EXTENSIONS.contains(&lower_extension(path).as_str())
}

fn start(path: &Path) -> Vec<u8> {
    // A file that cannot be read is no video; its reader names the error.
    if path.is_file() { first_bytes(path, START).unwrap_or_default() } else { Vec::new() }
}

fn is_picture(start: &[u8]) -> bool {
    let gif = start.starts_with(b"GIF8");
    !gif && (image::guess_format(start).is_ok() || heic::brand(start).is_some())
}

fn is_video_content(start: &[u8]) -> bool {
    // ISO base media (MP4, MOV, 3GP), and QuickTime before it had brands. CR3 is a raw photograph.
    let boxed = match start.get(4..8) {
        Some(b"ftyp") => start.get(8..12) != Some(b"crx "),
        Some(kind) => [b"moov", b"mdat", b"wide"].iter().any(|k| kind == *k),
        None => false,
    };
    let riff = start.starts_with(b"RIFF") && start.get(8..12) == Some(b"AVI ");
    // Matroska and WebM; ASF; MPEG program streams; Ogg.
    let signatures: [&[u8]; 5] =
        [b"\x1a\x45\xdf\xa3", b"\x30\x26\xb2\x75", b"\0\0\x01\xba", b"OggS", b"GIF8"];
    boxed || riff || is_transport_stream(start) || signatures.iter().any(|s| start.starts_with(s))
}

/// MPEG transport streams: packets of 188 bytes, of camcorders with 4 bytes of time before each.
fn is_transport_stream(start: &[u8]) -> bool {
    let (length, sync) = PACKET;
    let at = |first: usize, step: usize| {
        start.get(first) == Some(&sync) && start.get(first + step) == Some(&sync)
    };
    at(0, length) || at(4, length + 4)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::image::save_png;
    use crate::scene::pictures::Rgb;

    #[test]
    fn content_decides_before_the_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let mut transport = vec![0u8; 400];
        [4, 196].iter().for_each(|i| transport[*i] = 0x47);
        for (name, bytes, expected) in [
            ("clip", &b"\0\0\0\x18ftypmp42\0\0\0\0"[..], true),
            ("clip.dat", b"\0\0\0\x14ftypqt  \0\0\0\0", true),
            ("old.mov", b"\0\0\0\x08wide\0\0\0\0mdat", true),
            ("clip.bin", b"\x1a\x45\xdf\xa3....", true),
            ("a.mts", &transport, true),
            ("a.gif", b"GIF89a......", true),
            ("a.avi", b"RIFF\0\0\0\0AVI LIST", true),
            ("empty.mp4", b"", true),
            ("broken.MP4", b"nonsense", true),
            ("photo.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", false),
            ("photo.mov", b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic", false),
            ("photo.avif", b"\0\0\0\x18ftypavif\0\0\0\0mif1avif", false),
            ("photo.cr3", b"\0\0\0\x18ftypcrx \0\0\0\0crx isom", false),
            ("notes.txt", b"ftyp", false),
            ("a.webp", b"RIFF\0\0\0\0WEBPVP8 ....", false),
        ] {
            std::fs::write(path(name), bytes).unwrap();
            assert_eq!(is_video(path(name)), expected, "{name}");
        }
        save_png(path("a.png"), &Rgb::black(4, 3)).unwrap();
        std::fs::rename(path("a.png"), path("a.mp4")).unwrap();
        assert!(
            !is_video(path("a.mp4")) && !is_video(folder.path()) && !is_video(path("none.mp4"))
        );
        std::fs::write(path("b.webp"), b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\x02\0\0\0").unwrap();
        assert!(is_animated_webp(path("b.webp")) && !is_animated_webp(path("a.webp")));
    }
}
