//! Description of a video by ffprobe: the stream, its size, rotation, times and colours.

use crate::files::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// Transfer function of a video of high dynamic range (ITU-R BT.2100).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hdr {
    /// Perceptual quantizer: HDR10, Dolby Vision.
    Pq,
    /// Hybrid log-gamma: phones.
    Hlg,
}

/// Description of a video file.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct VideoInfo {
    /// Index of the stream of pictures in the file.
    pub stream: usize,
    /// Width of the upright picture, px; pixels that are no squares are stretched to squares.
    pub width: usize,
    /// Height of the upright picture, px.
    pub height: usize,
    /// Rotation that the metadata ask for and ffmpeg applies, degrees clockwise: 0, 90, 180 or 270.
    pub rotation: u16,
    /// Mean number of frames a second, where the file states it.
    pub rate: Option<f64>,
    /// The frames do not follow one another evenly.
    pub variable_rate: bool,
    /// Duration, s, where the file states it.
    pub duration: Option<f64>,
    /// Number of frames, where the file states it or its duration gives it.
    pub frames: Option<usize>,
    /// High dynamic range; `None` for ordinary colours.
    pub hdr: Option<Hdr>,
    /// Name of the matrix from YUV to RGB, where the file states it (`bt709`).
    pub matrix: Option<String>,
    /// Frames consist of two fields that were taken at different times.
    pub interlaced: bool,
    /// Name of the codec.
    pub codec: String,
}

/// Height from which a video without a stated matrix has that of BT.709.
const HD_HEIGHT: usize = 720;
/// Difference of the smallest common rate and the mean one from which the rate counts as variable.
const VARIABLE: f64 = 0.02;

impl VideoInfo {
    /// Matrix by which ffmpeg reads the colours, in the words of its filter `scale`.
    pub(super) fn colour_matrix(&self) -> &'static str {
        match self.matrix.as_deref() {
            Some("bt2020nc" | "bt2020c") => "bt2020",
            Some("bt470bg" | "smpte170m") => "bt601",
            Some("smpte240m") => "smpte240m",
            Some("fcc") => "fcc",
            Some("bt709") => "bt709",
            _ if self.height.min(self.width) >= HD_HEIGHT => "bt709",
            _ => "bt601",
        }
    }
}

/// Parses the JSON of `ffprobe -show_format -show_streams`; `path` is for messages.
///
/// # Errors
/// No JSON; a file without a video stream; a panorama.
pub fn parse_ffprobe(json: &[u8], path: impl AsRef<Path>) -> Result<VideoInfo> {
    parse(json, path.as_ref())
}

fn parse(json: &[u8], path: &Path) -> Result<VideoInfo> {
    let expected = "a description by ffprobe";
    let root: Value =
        serde_json::from_slice(json).map_err(|e| Error::format(path, expected, e.to_string()))?;
    let streams = root["streams"].as_array().map(Vec::as_slice).unwrap_or_default();
    // The largest; the first of several.
    let videos = streams.iter().filter(|stream| is_video(stream)).rev();
    let Some(stream) = videos.max_by_key(|s| stored_size(s).0 * stored_size(s).1) else {
        return Err(Error::format(path, "a video", no_video(streams)));
    };
    let (width, height) = stored_size(stream);
    if side_data(stream).any(|data| text(&data["side_data_type"]).contains("Spherical")) {
        return Err(Error::format(
            path,
            "a video of an ordinary camera",
            "a 360-degree video (export an ordinary, flat video of it with the camera's program)",
        ));
    }
    let rotation = rotation(stream);
    let stretch = ratio(&stream["sample_aspect_ratio"], ':').filter(|r| (0.1..10.0).contains(r));
    let width = (width as f64 * stretch.unwrap_or(1.0)).round() as usize;
    let (width, height) = if rotation % 180 == 90 { (height, width) } else { (width, height) };
    let rate = ratio(&stream["avg_frame_rate"], '/').filter(|r| r.is_finite() && *r > 0.0);
    let base = ratio(&stream["r_frame_rate"], '/');
    let variable = |(base, rate): (f64, f64)| (base / rate - 1.0).abs() > VARIABLE;
    let durations = [&stream["duration"], &root["format"]["duration"]];
    let duration = durations.into_iter().find_map(number).filter(|d| d.is_finite() && *d > 0.0);
    let stated = number(&stream["nb_frames"]).filter(|n| *n >= 1.0);
    let frames = stated.or_else(|| Some((duration? * rate?).round()));
    Ok(VideoInfo {
        stream: stream["index"].as_u64().unwrap_or(0) as usize,
        width,
        height,
        rotation,
        rate,
        variable_rate: base.zip(rate).is_some_and(variable),
        duration,
        frames: frames.map(|n| n as usize),
        hdr: match text(&stream["color_transfer"]) {
            "smpte2084" => Some(Hdr::Pq),
            "arib-std-b67" => Some(Hdr::Hlg),
            _ => None,
        },
        matrix: stream["color_space"].as_str().filter(|m| *m != "unknown").map(str::to_owned),
        interlaced: ["tt", "bb", "tb", "bt"].contains(&text(&stream["field_order"])),
        codec: text(&stream["codec_name"]).to_owned(),
    })
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

/// A number, which ffprobe writes as text in some fields.
fn number(value: &Value) -> Option<f64> {
    value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())
}

/// `30000/1001` or `16:15` as a number; `None` for `0/0` and `0:1`.
fn ratio(value: &Value, between: char) -> Option<f64> {
    let (over, under) = value.as_str()?.split_once(between)?;
    let (over, under): (f64, f64) = (over.parse().ok()?, under.parse().ok()?);
    (over > 0.0 && under > 0.0).then_some(over / under)
}

/// Returns whether a stream has moving pictures: cover pictures of audio files are video streams too.
fn is_video(stream: &Value) -> bool {
    let still = ["attached_pic", "timed_thumbnails", "still_image"];
    let is_still = still.iter().any(|kind| stream["disposition"][kind].as_i64() == Some(1));
    let (width, height) = stored_size(stream);
    text(&stream["codec_type"]) == "video" && !is_still && width > 0 && height > 0
}

fn stored_size(stream: &Value) -> (usize, usize) {
    let side = |name: &str| {
        let side = stream[name].as_u64().unwrap_or(0);
        usize::try_from(side).ok().filter(|side| *side <= 1 << 16).unwrap_or(0)
    };
    (side("width"), side("height"))
}

fn side_data(stream: &Value) -> impl Iterator<Item = &Value> {
    stream["side_data_list"].as_array().map(Vec::as_slice).unwrap_or_default().iter()
}

/// Rotation of a stream, degrees clockwise, in quarter turns. The display matrix counts counter-clockwise, the tag
/// of older versions of ffprobe clockwise.
fn rotation(stream: &Value) -> u16 {
    let matrix = side_data(stream).find_map(|data| number(&data["rotation"])).map(|r| -r);
    let degrees = matrix.or_else(|| number(&stream["tags"]["rotate"])).unwrap_or(0.0);
    let quarter = (degrees / 90.0).round().rem_euclid(4.0);
    if quarter.is_finite() { 90 * quarter as u16 } else { 0 }
}

/// Content of a file without moving pictures.
fn no_video(streams: &[Value]) -> String {
    let has = |kind: &str| streams.iter().any(|s| text(&s["codec_type"]) == kind);
    match (has("video"), has("audio")) {
        (true, true) => "an audio file with a cover picture".to_owned(),
        (false, true) => "an audio file".to_owned(),
        (true, false) => "a file of still pictures".to_owned(),
        _ => "a file without pictures".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(json: &str) -> Result<VideoInfo> {
        parse_ffprobe(json.as_bytes(), "clip.mp4")
    }

    /// Fields of a phone's portrait video, as ffprobe 5.1 prints them.
    const PHONE: &str = r#"{"streams": [
        {"index": 0, "codec_type": "audio", "codec_name": "aac"},
        {"index": 1, "codec_name": "hevc", "codec_type": "video", "width": 1920, "height": 1080,
         "sample_aspect_ratio": "1:1", "field_order": "progressive", "color_space": "bt2020nc",
         "color_transfer": "arib-std-b67", "r_frame_rate": "600/1", "avg_frame_rate": "30000/1001",
         "duration": "10.01", "nb_frames": "300", "disposition": {"attached_pic": 0},
         "side_data_list": [{"side_data_type": "Display Matrix", "rotation": -90}]}],
        "format": {"duration": "10.1"}}"#;

    #[test]
    fn a_phones_video() {
        let info = parsed(PHONE).unwrap();
        assert_eq!((info.stream, info.width, info.height, info.rotation), (1, 1080, 1920, 90));
        assert_eq!(
            (info.frames, info.duration, info.hdr),
            (Some(300), Some(10.01), Some(Hdr::Hlg))
        );
        assert!(info.variable_rate && !info.interlaced);
        assert!((info.rate.unwrap() - 29.97).abs() < 0.001);
        assert_eq!(info.colour_matrix(), "bt2020");
        let older = PHONE.replace(r#""side_data_list""#, r#""tags": {"rotate": "270"}, "x""#);
        assert_eq!(parsed(&older).unwrap().rotation, 270);
    }

    #[test]
    fn stretched_pixels_fields_and_missing_numbers() {
        let info = parsed(
            r#"{"streams": [{"index": 0, "codec_type": "video", "width": 720, "height": 576,
            "sample_aspect_ratio": "16:15", "field_order": "tt", "color_transfer": "smpte2084",
            "r_frame_rate": "25/1", "avg_frame_rate": "25/1", "disposition": {}}],
            "format": {"duration": "4.0"}}"#,
        )
        .unwrap();
        assert_eq!((info.width, info.height, info.frames), (768, 576, Some(100)));
        assert!(info.interlaced && !info.variable_rate && info.hdr == Some(Hdr::Pq));
        assert_eq!(info.colour_matrix(), "bt601");
        let bare = parsed(
            r#"{"streams": [{"codec_type": "video", "width": 1280, "height": 720, "avg_frame_rate": "0/0"}]}"#,
        )
        .unwrap();
        assert_eq!((bare.rate, bare.duration, bare.frames, bare.rotation), (None, None, None, 0));
        assert_eq!(bare.colour_matrix(), "bt709");
    }

    #[test]
    fn files_without_moving_pictures_are_named() {
        let cover = r#"{"streams": [{"codec_type": "audio"}, {"codec_type": "video", "width": 9,
            "height": 9, "disposition": {"attached_pic": 1}}]}"#;
        let spherical = PHONE.replace("Display Matrix", "Spherical Mapping");
        for (json, got) in [
            (r#"{"streams": [{"codec_type": "audio"}]}"#, "an audio file"),
            (cover, "an audio file with a cover picture"),
            (r#"{"streams": []}"#, "a file without pictures"),
            ("{}", "a file without pictures"),
            (r#"{"streams": [{"codec_type": "video", "width": 99999999, "height": 2}]}"#, "still"),
            ("no JSON", "ffprobe"),
            (spherical.as_str(), "360-degree"),
        ] {
            let error = parsed(json).unwrap_err().to_string();
            assert!(error.starts_with("clip.mp4") && error.contains(got), "{error}");
        }
    }
}
