//! Frames of a video as photographs, chosen by sharpness and motion.
//!
//! ffmpeg decodes the video twice (`process.rs`; no decoder for H.264 and HEVC builds on every platform without a C
//! compiler). The first pass reads all frames small and grey (`scan.rs`) and keeps the sharpest of each tenth of a
//! second; their motion is measured (`motion.rs`), and frames are taken at equal distances along it (`choose.rs`).
//! The second pass writes these frames as JPEG files with names by their time, and `frames.json`, which lists them.
//! Files are what every other part of the program reads: a pose file can name them, and a second run finds them.
//!
//! ffmpeg applies the rotation that the metadata state. Times are presentation times, so that a variable rate changes
//! nothing. High dynamic range (PQ, HLG) is mapped to ordinary colours where ffmpeg has the filters `zscale` and
//! `tonemap`.

mod choose;
mod detect;
mod motion;
mod probe;
mod process;
mod scan;
mod take;

pub use detect::{is_animated_webp, is_video};
pub use probe::{Hdr, VideoInfo, parse_ffprobe};
pub use process::is_installed;
pub use take::{FrameOptions, FrameStage, TakenFrame, TakenFrames, VideoProgress, take_frames};

use crate::files::Result;
use std::path::Path;

/// Describes a video by ffprobe.
///
/// # Errors
/// No file; no ffmpeg in PATH; a file that ffprobe does not read, without a video stream, or with a 360-degree video.
pub fn probe_video(path: impl AsRef<Path>) -> Result<VideoInfo> {
    let path = path.as_ref();
    crate::files::open_regular(path).map_err(|e| crate::files::Error::io(path, e))?;
    process::check_installed(path)?;
    parse_ffprobe(&process::ffprobe(path)?, path)
}
