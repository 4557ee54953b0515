//! H.264 in an .mp4 file, by OpenH264 (BSD-2-Clause, compiled from its C++ source) and the container of `muxide`.
//!
//! The feature `mp4` turns this module on: a first build then needs a C++ compiler. Without it `--video` gives the
//! frames to ffmpeg. Baseline profile: every phone and browser plays it. Berlin's clip (150 frames of 512x384, limit
//! 2.4 Mbit/s) has 1.8 MB and 35.5 dB against its frames. OpenH264 encodes up to 3840x2160. It prints a warning to
//! stderr when it starts, because no frame may be skipped; its setting for messages takes effect only afterwards.

use anyhow::{Context, Result};
use muxide::api::{Muxer, MuxerBuilder, VideoCodec};
use openh264::OpenH264API;
use openh264::encoder::{
    BitRate, Complexity, Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, Profile,
    RateControlMode, VuiConfig,
};
use openh264::formats::YUVBuffer;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use subsplat::scene::pictures::Rgb;

/// Bits of a pixel where the file may have any size.
const BITS_OF_PIXEL: f64 = 0.4;
/// Seconds between frames that need no other frame.
const KEY_SECONDS: u32 = 2;

/// An .mp4 file that frames are added to.
pub(super) struct Mp4 {
    stream: Stream,
    muxer: Muxer<BufWriter<File>>,
    fps: u32,
    frames: u32,
}

impl Mp4 {
    /// Begins a file of frames of `size` (width, height), of at most `bits` a second.
    ///
    /// # Errors
    /// Sides or a rate that OpenH264 does not encode; system errors.
    pub(super) fn create(
        path: &Path,
        (w, h): (usize, usize),
        fps: u32,
        bits: Option<u32>,
    ) -> Result<Self> {
        let any = BITS_OF_PIXEL * (w * h) as f64 * f64::from(fps);
        let stream = Stream::new(fps, bits.unwrap_or(any as u32))?;
        let file = BufWriter::new(File::create(path)?);
        let even = |side: usize| u32::try_from(side.next_multiple_of(2));
        let muxer = MuxerBuilder::new(file)
            .video(VideoCodec::H264, even(w)?, even(h)?, f64::from(fps))
            .build()?;
        Ok(Self { stream, muxer, fps, frames: 0 })
    }

    /// Adds a frame.
    ///
    /// # Errors
    /// Errors of the encoder and of the system.
    pub(super) fn push(&mut self, frame: &Rgb) -> Result<()> {
        let (data, key) = self.stream.encode(frame)?;
        self.muxer.write_video(f64::from(self.frames) / f64::from(self.fps), &data, key)?;
        self.frames += 1;
        Ok(())
    }

    /// Completes the file.
    ///
    /// # Errors
    /// System errors.
    pub(super) fn finish(&mut self) -> Result<()> {
        Ok(self.muxer.finish_in_place()?)
    }
}

/// Frames as H.264, each one after its start codes (Annex B).
struct Stream(Encoder);

impl Stream {
    fn new(fps: u32, bits: u32) -> Result<Self> {
        // The matrix is named, because players guess another one by the size. One thread gives the same bytes anywhere.
        let config = EncoderConfig::new()
            .max_frame_rate(FrameRate::from_hz(fps as f32))
            .bitrate(BitRate::from_bps(bits))
            .rate_control_mode(RateControlMode::Bitrate)
            .skip_frames(false)
            .profile(Profile::Baseline)
            .complexity(Complexity::High)
            .intra_frame_period(IntraFramePeriod::from_num_frames(KEY_SECONDS * fps))
            .num_threads(1)
            .vui(VuiConfig::bt709());
        let encoder = Encoder::with_api_config(OpenH264API::from_source(), config);
        Ok(Self(encoder.context("OpenH264")?))
    }

    /// The bytes of a frame, and whether it needs no other frame.
    fn encode(&mut self, frame: &Rgb) -> Result<(Vec<u8>, bool)> {
        let encoded = self.0.encode(&planes(frame)).context("OpenH264")?;
        let key = matches!(encoded.frame_type(), FrameType::IDR);
        Ok((encoded.to_vec(), key))
    }
}

/// A frame as luma and colour differences of half the size: BT.709, 16 to 235. Odd sides repeat their last pixels.
fn planes(frame: &Rgb) -> YUVBuffer {
    let (w, h) = (frame.width.next_multiple_of(2), frame.height.next_multiple_of(2));
    let pixel = |x: usize, y: usize| {
        let at = 3 * (y.min(frame.height - 1) * frame.width + x.min(frame.width - 1));
        [0, 1, 2].map(|c| f32::from(frame.data[at + c]) / 255.0)
    };
    let luma = |[r, g, b]: [f32; 3]| 0.2126 * r + 0.7152 * g + 0.0722 * b;
    let mut data = Vec::with_capacity(w * h * 3 / 2);
    for y in 0..h {
        data.extend((0..w).map(|x| (16.5 + 219.0 * luma(pixel(x, y))) as u8));
    }
    let (mut blue, mut red) = (Vec::new(), Vec::new());
    for y in (0..h).step_by(2) {
        for x in (0..w).step_by(2) {
            let four = [pixel(x, y), pixel(x + 1, y), pixel(x, y + 1), pixel(x + 1, y + 1)];
            let mean = [0, 1, 2].map(|c| four.iter().map(|p| p[c]).sum::<f32>() / 4.0);
            blue.push((128.5 + 224.0 * (mean[2] - luma(mean)) / 1.8556) as u8);
            red.push((128.5 + 224.0 * (mean[0] - luma(mean)) / 1.5748) as u8);
        }
    }
    data.extend(blue);
    data.extend(red);
    YUVBuffer::from_vec(data, w, h)
}

#[cfg(test)]
mod tests {
    use super::*;
    use openh264::decoder::Decoder;
    use openh264::formats::YUVSource;

    /// A smooth picture that moves with `k`.
    fn frame(k: usize) -> Rgb {
        let (width, height) = (63, 47);
        let wave = |v: usize, c: f32| (127.0 + 90.0 * ((v + k) as f32 / 9.0 + c).sin()) as u8;
        let pixel = |i: usize| [wave(i % width, 0.0), wave(i / width, 1.0), 200 - 2 * k as u8];
        Rgb { width, height, data: (0..width * height).flat_map(pixel).collect() }
    }

    #[test]
    fn frames_come_back_in_their_colours() {
        let (mut stream, mut decoder) =
            (Stream::new(25, 600_000).unwrap(), Decoder::new().unwrap());
        for k in 0..8 {
            let (data, key) = stream.encode(&frame(k)).unwrap();
            assert_eq!(key, k == 0);
            let read = decoder.decode(&data).unwrap().unwrap();
            assert_eq!(read.dimensions(), (64, 48));
            let (strides, source) = (read.strides(), frame(k));
            let differences = (0..63 * 47).map(|i| {
                let (x, y) = (i % 63, i / 63);
                let chroma = |plane: &[u8]| f32::from(plane[y / 2 * strides.1 + x / 2]) - 128.0;
                let luma = (f32::from(read.y()[y * strides.0 + x]) - 16.0) / 219.0;
                let (blue, red) = (chroma(read.u()) / 224.0, chroma(read.v()) / 224.0);
                let (r, b) = (luma + 1.5748 * red, luma + 1.8556 * blue);
                let g = (luma - 0.2126 * r - 0.0722 * b) / 0.7152;
                let own = |c: usize| f32::from(source.data[3 * i + c]) / 255.0;
                (r - own(0)).abs() + (g - own(1)).abs() + (b - own(2)).abs()
            });
            let mean = differences.sum::<f32>() / (3 * 63 * 47) as f32;
            assert!(mean < 0.02, "frame {k}: {mean}");
        }
    }

    #[test]
    fn the_file_begins_with_its_index_and_keeps_to_its_size() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("a.mp4");
        let mut file = Mp4::create(&path, (63, 47), 25, Some(100_000)).unwrap();
        (0..50).for_each(|k| file.push(&frame(k)).unwrap());
        file.finish().unwrap();
        drop(file);
        let bytes = std::fs::read(&path).unwrap();
        let place = |name: &[u8]| bytes.windows(4).position(|w| w == name);
        assert_eq!(place(b"ftyp"), Some(4));
        assert!(place(b"avc1") < place(b"mdat") && place(b"moov") < place(b"mdat"));
        // 2 s of 100 kbit/s, and half as much again for the rate control.
        assert!(bytes.len() < 37_500, "{}", bytes.len());
    }
}
