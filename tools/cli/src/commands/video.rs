//! `--video`: the rendered views as an animation.
//!
//! .gif and .webp are written here, so that they need no other program: GIF has 256 colours a
//! frame, WebP all of them without loss (`image` has no other encoder for it). .mp4 (H.264) and .webm (VP9) are
//! ffmpeg's. With the feature `mp4` the program writes .mp4 itself (`mp4.rs`). It is no default: no well-kept encoder
//! of H.264 is pure Rust, and OpenH264's 90 files of C++ need a C++ compiler. rav1e (AV1) is pure Rust, compiles
//! longer than the program, and old phones and chat programs do not play AV1.

#[cfg(feature = "mp4")]
mod mp4;

use super::args::MotionArgs;
use crate::report::Answer;
use anyhow::{Context, Result, anyhow, bail, ensure};
use serde_json::{Value, json};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use subsplat::files::photos::video::is_installed;
use subsplat::image::ExtendedColorType::Rgb8;
use subsplat::image::codecs::webp::WebPEncoder;
use subsplat::scene::pictures::Rgb;

/// Largest side of a GIF, whose header has 16 bits for it, and of a frame of WebP, 24 bits of
/// which its lossless encoder has 14.
const GIF_SIDE_MAX: usize = 65_535;
const WEBP_SIDE_MAX: usize = 16_384;
/// Bits a second of a clip without --frames: 1.8 MB in 6 seconds.
const CLIP_BITS: u32 = 2_400_000;
/// Quantisation of GIF colours, 1 (best) to 30 (fastest).
const GIF_SPEED: i32 = 10;

/// Kind of an animation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Gif,
    Webp,
    Mp4,
    Webm,
}

/// Speed of an animation.
#[derive(Clone, Copy, Debug)]
pub struct Rate(pub u32);

/// An animation that frames are added to. The file appears when it is complete.
pub struct Video {
    path: PathBuf,
    part: PathBuf,
    size: (usize, usize),
    rate: Rate,
    encoder: Encoder,
    frames: usize,
}

enum Encoder {
    Gif(Box<gif::Encoder<BufWriter<File>>>),
    /// Frames of VP8L, one after the other.
    Webp(Vec<Vec<u8>>),
    #[cfg(feature = "mp4")]
    Mp4(Box<mp4::Mp4>),
    Ffmpeg(Child),
}

impl Kind {
    /// Returns true if ffmpeg encodes this kind.
    fn is_of_ffmpeg(self) -> bool {
        match self {
            Self::Gif | Self::Webp => false,
            Self::Mp4 => cfg!(not(feature = "mp4")),
            Self::Webm => true,
        }
    }
}

fn kind(path: &Path) -> Result<Kind> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    Ok(match extension.as_str() {
        "gif" => Kind::Gif,
        "webp" => Kind::Webp,
        "mp4" => Kind::Mp4,
        "webm" => Kind::Webm,
        _ => bail!(
            "--video: expected a name that ends in .mp4, .webm, .gif or .webp, got {}",
            path.display()
        ),
    })
}

/// Checks the name of an animation, and that its encoder exists, before any frame is rendered.
///
/// # Errors
/// An unknown extension; .mp4 or .webm without ffmpeg; no folder of that name.
pub fn check(path: &Path) -> Result<()> {
    if kind(path)?.is_of_ffmpeg() {
        ensure!(
            is_installed("ffmpeg"),
            "--video {}: .mp4 and .webm need the program ffmpeg, which was not found; install it, or \
             write .webp or .gif",
            path.display()
        );
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|f| !f.is_dir()) {
        bail!("--video {}: the folder {} does not exist", path.display(), folder.display());
    }
    Ok(())
}

/// Adds a view to the animation of `--video`, which the first one begins.
pub fn push(video: &mut Option<Video>, args: &MotionArgs, view: &Rgb) -> Result<()> {
    let Some(path) = &args.video else { return Ok(()) };
    let video = match video {
        Some(video) => video,
        None => {
            let size = (view.width, view.height);
            let bits = args.is_clip().then_some(CLIP_BITS);
            video.insert(Video::create_within(path, size, Rate(args.fps), bits)?)
        }
    };
    video.push(view)
}

/// Completes the animation of `--video`, prints a line, and returns its report.
pub fn finish(video: Option<Video>, args: &MotionArgs, answer: Answer) -> Result<Value> {
    let (Some(video), Some(path)) = (video, &args.video) else { return Ok(Value::Null) };
    let frames = video.frames;
    let bytes = video.finish()?;
    let size = bytes as f64 / 1e6;
    answer.line(format!("{}: {frames} frames, {size:.1} MB", path.display()));
    Ok(json!({ "file": path.display().to_string(), "frames": frames, "bytes": bytes }))
}

impl Video {
    /// Begins an animation of frames of `size`.
    ///
    /// # Errors
    /// Those of [`check`]; sides beyond the format's; system errors.
    pub fn create(path: &Path, size: (usize, usize), rate: Rate) -> Result<Self> {
        Self::create_within(path, size, rate, None)
    }

    /// Begins an animation that takes about `bits` a second at most, where its format can (.mp4, .webm).
    fn create_within(
        path: &Path,
        size: (usize, usize),
        rate: Rate,
        bits: Option<u32>,
    ) -> Result<Self> {
        check(path)?;
        let (w, h) = size;
        let kind = kind(path)?;
        let most = match kind {
            Kind::Gif => GIF_SIDE_MAX,
            _ => WEBP_SIDE_MAX,
        };
        ensure!(
            w.max(h) <= most,
            "--video {}: expected sides of at most {most} px, got {w}x{h}",
            path.display()
        );
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{}.part", std::process::id()));
        let part = path.with_file_name(name);
        let encoder = match kind {
            Kind::Gif => {
                let file = File::create(&part).with_context(|| path.display().to_string())?;
                let (w, h) = (u16::try_from(w)?, u16::try_from(h)?);
                let mut encoder = gif::Encoder::new(BufWriter::new(file), w, h, &[])?;
                encoder.set_repeat(gif::Repeat::Infinite)?;
                Encoder::Gif(Box::new(encoder))
            }
            Kind::Webp => Encoder::Webp(Vec::new()),
            #[cfg(feature = "mp4")]
            Kind::Mp4 => {
                let file = mp4::Mp4::create(&part, size, rate.0, bits);
                Encoder::Mp4(Box::new(file.with_context(|| path.display().to_string())?))
            }
            _ => Encoder::Ffmpeg(ffmpeg(kind, &part, size, rate, bits)?),
        };
        Ok(Self { path: path.to_owned(), part, size, rate, encoder, frames: 0 })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// A frame of another size; errors of the encoder and of the system.
    pub fn push(&mut self, frame: &Rgb) -> Result<()> {
        let (w, h) = self.size;
        let path = self.path.display();
        ensure!(
            (frame.width, frame.height) == self.size,
            "--video {path}: expected frames of one size, {w}x{h}, got {}x{}; give --size",
            frame.width,
            frame.height
        );
        self.frames += 1;
        match &mut self.encoder {
            Encoder::Gif(encoder) => {
                let (w, h) = (u16::try_from(w)?, u16::try_from(h)?);
                let mut out = gif::Frame::from_rgb_speed(w, h, &frame.data, GIF_SPEED);
                out.delay = u16::try_from((100 / self.rate.0).max(1))?;
                encoder.write_frame(&out)?;
            }
            Encoder::Webp(frames) => {
                let mut still = Vec::new();
                WebPEncoder::new_lossless(&mut still).encode(
                    &frame.data,
                    u32::try_from(w)?,
                    u32::try_from(h)?,
                    Rgb8,
                )?;
                frames.push(bitstream(&still)?.to_vec());
            }
            #[cfg(feature = "mp4")]
            Encoder::Mp4(file) => file.push(frame)?,
            Encoder::Ffmpeg(child) => {
                let written = child.stdin.as_mut().map(|pipe| pipe.write_all(&frame.data));
                if !matches!(written, Some(Ok(()))) {
                    return Err(self.failure());
                }
            }
        }
        Ok(())
    }

    /// Completes the file and returns its size, bytes.
    ///
    /// # Errors
    /// No frame; errors of the encoder and of the system.
    pub fn finish(mut self) -> Result<u64> {
        ensure!(self.frames > 0, "--video {}: expected a frame, got none", self.path.display());
        match &mut self.encoder {
            // The trailer is written when the encoder goes.
            Encoder::Gif(encoder) => encoder.get_mut().flush()?,
            Encoder::Webp(frames) => {
                let file = animation(frames, self.size, 1000 / self.rate.0.max(1));
                std::fs::write(&self.part, file)
                    .with_context(|| self.path.display().to_string())?;
            }
            #[cfg(feature = "mp4")]
            Encoder::Mp4(file) => file.finish()?,
            Encoder::Ffmpeg(child) => {
                drop(child.stdin.take());
                if !child.wait()?.success() {
                    return Err(self.failure());
                }
            }
        }
        let Self { path, part, encoder, .. } = self;
        drop(encoder);
        std::fs::rename(&part, &path).with_context(|| path.display().to_string())?;
        Ok(std::fs::metadata(&path)?.len())
    }

    /// Ends ffmpeg and returns the last line of its messages.
    fn failure(&mut self) -> anyhow::Error {
        let mut text = String::new();
        if let Encoder::Ffmpeg(child) = &mut self.encoder {
            drop(child.stdin.take());
            if let Some(mut messages) = child.stderr.take() {
                // The error below is reported with or without them.
                let _ = std::io::Read::read_to_string(&mut messages, &mut text);
            }
            let _ = child.wait();
        }
        let _ = std::fs::remove_file(&self.part);
        let last = text.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("no message");
        anyhow!("--video {}: ffmpeg failed: {last}", self.path.display())
    }
}

/// Starts ffmpeg, which reads raw RGB.
fn ffmpeg(
    kind: Kind,
    part: &Path,
    (w, h): (usize, usize),
    rate: Rate,
    bits: Option<u32>,
) -> Result<Child> {
    let codec: &[&str] = match kind {
        Kind::Webm => &["-c:v", "libvpx-vp9", "-crf", "24", "-f", "webm"],
        _ => &["-c:v", "libx264", "-crf", "16", "-movflags", "+faststart", "-f", "mp4"],
    };
    let limits: Vec<String> = match (kind, bits) {
        (Kind::Webm, bits) => vec!["-b:v".to_owned(), bits.unwrap_or(0).to_string()],
        (_, Some(bits)) => ["-maxrate", "-bufsize"]
            .into_iter()
            .flat_map(|name| [name.to_owned(), bits.to_string()])
            .collect(),
        (_, None) => Vec::new(),
    };
    Command::new("ffmpeg")
        .args(["-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"])
        .args(["-s", &format!("{w}x{h}"), "-r", &rate.0.to_string(), "-i", "-"])
        // Both codecs halve the colours' resolution, which needs even sides. The matrix is named,
        // because players guess another one by the size.
        .args(["-vf", "scale=out_color_matrix=bt709:out_range=tv,pad=ceil(iw/2)*2:ceil(ih/2)*2"])
        .args(["-pix_fmt", "yuv420p", "-colorspace", "bt709", "-color_primaries", "bt709"])
        .args(["-color_trc", "bt709"])
        .args(codec)
        .args(limits)
        .arg(part)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .context("--video: starting ffmpeg")
}

/// The VP8L chunk of a still WebP, with its header.
fn bitstream(still: &[u8]) -> Result<&[u8]> {
    let mut at = 12;
    while let Some((head, body)) = still.get(at..).and_then(|rest| rest.split_at_checked(8)) {
        let length = u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as usize;
        let padded = length + length % 2;
        if &head[..4] == b"VP8L" && padded <= body.len() {
            return Ok(&still[at..at + 8 + padded]);
        }
        at += 8 + padded;
    }
    bail!("--video: the WebP encoder gave no VP8L data")
}

/// An animated WebP (RIFF: VP8X, ANIM, one ANMF a frame) that repeats for ever.
fn animation(frames: &[Vec<u8>], (w, h): (usize, usize), milliseconds: u32) -> Vec<u8> {
    let three = |v: usize| (v as u32).to_le_bytes();
    let chunk = |out: &mut Vec<u8>, name: &[u8; 4], body: &[&[u8]]| {
        let length: usize = body.iter().map(|b| b.len()).sum();
        out.extend(name);
        out.extend((length as u32).to_le_bytes());
        body.iter().for_each(|b| out.extend(*b));
        out.extend(std::iter::repeat_n(0, length % 2));
    };
    let mut chunks = Vec::new();
    let (width, height) = (three(w - 1), three(h - 1));
    /// Bit of the flags that announces an animation.
    const ANIMATED: u8 = 2;
    chunk(&mut chunks, b"VP8X", &[&[ANIMATED, 0, 0, 0], &width[..3], &height[..3]]);
    // Background, then 0 repetitions: no end.
    chunk(&mut chunks, b"ANIM", &[&[0; 6]]);
    let time = milliseconds.max(1).to_le_bytes();
    for frame in frames {
        // At (0, 0); drawn over the last frame without blending.
        let head: [&[u8]; 6] =
            [&[0; 6], &width[..3], &height[..3], &time[..3], &[2], frame.as_slice()];
        chunk(&mut chunks, b"ANMF", &head);
    }
    let mut out = Vec::with_capacity(chunks.len() + 12);
    out.extend(b"RIFF");
    out.extend((chunks.len() as u32 + 4).to_le_bytes());
    out.extend(b"WEBP");
    out.extend(chunks);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat::image::AnimationDecoder;
    use subsplat::image::codecs::webp::WebPDecoder;

    /// Frames of noise-free colour, one brighter than the other.
    fn frames() -> Vec<Rgb> {
        let frame = |k: u8| {
            let mut frame = Rgb::black(7, 5);
            for (i, v) in frame.data.iter_mut().enumerate() {
                *v = (i as u8).wrapping_mul(2) / 2 + 40 * k;
            }
            frame
        };
        (0..3).map(frame).collect()
    }

    #[test]
    fn webp_keeps_every_pixel_and_the_time() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("a.webp");
        let mut video = Video::create(&path, (7, 5), Rate(25)).unwrap();
        frames().iter().for_each(|f| video.push(f).unwrap());
        let bytes = video.finish().unwrap();
        let file = std::fs::read(&path).unwrap();
        assert_eq!(bytes, file.len() as u64);
        let decoder = WebPDecoder::new(std::io::Cursor::new(file)).unwrap();
        let read: Vec<_> = decoder.into_frames().collect_frames().unwrap().into_iter().collect();
        assert_eq!(read.len(), 3);
        for (got, expected) in read.iter().zip(frames()) {
            assert_eq!(got.delay().numer_denom_ms(), (40, 1));
            let rgb: Vec<u8> = got.buffer().pixels().flat_map(|p| [p[0], p[1], p[2]]).collect();
            assert_eq!(rgb, expected.data);
        }
    }

    #[test]
    fn gif_holds_the_frames() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("a.gif");
        let mut video = Video::create(&path, (7, 5), Rate(25)).unwrap();
        frames().iter().for_each(|f| video.push(f).unwrap());
        video.finish().unwrap();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(File::open(&path).unwrap()).unwrap();
        for expected in frames() {
            let frame = decoder.read_next_frame().unwrap().unwrap();
            assert_eq!((frame.delay, frame.width, frame.height), (4, 7, 5));
            let pairs = frame.buffer.chunks_exact(4).zip(expected.data.chunks_exact(3));
            for (got, want) in pairs {
                assert!(got[..3].iter().zip(want).all(|(a, b)| a.abs_diff(*b) <= 8));
            }
        }
        assert!(decoder.read_next_frame().unwrap().is_none());
        assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 1, "no temporary file stays");
    }

    #[test]
    fn refusals() {
        let place = tempfile::tempdir().unwrap();
        let error = |result: Result<()>| result.unwrap_err().to_string();
        assert!(error(check(Path::new("a.avi"))).contains(".mp4, .webm, .gif or .webp"));
        assert!(error(check(&place.path().join("none/a.gif"))).contains("does not exist"));
        let path = place.path().join("a.gif");
        assert!(Video::create(&path, (70_000, 5), Rate(25)).is_err());
        let mut video = Video::create(&path, (7, 5), Rate(25)).unwrap();
        assert!(error(video.push(&Rgb::black(5, 7))).contains("frames of one size, 7x5, got 5x7"));
        let webp = place.path().join("a.webp");
        let none = Video::create(&webp, (7, 5), Rate(25)).unwrap().finish();
        assert!(none.unwrap_err().to_string().contains("got none"));
        assert!(!webp.exists());
    }
}
