//! From a video to JPEG files in a folder.

use super::choose::{FARTHEST, choose, longest_still, progress, shots};
use super::motion::{Motion, motion};
use super::process::{Colours, Frames, Pnm, has_filters};
use super::scan::{Candidate, READ_SIDE, Scan};
use super::{Hdr, VideoInfo, probe_video};
use crate::cameras::matches::features::Features;
use crate::files::photos::folder::find_photographs;
use crate::files::{Error, Result, read, write_atomic};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::io::Write;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Most pixels of a saved frame.
const FRAME_PIXELS: usize = 4_000_000;
/// Quality of the saved JPEG files, of 100: losses are far below those of the video.
const JPEG_QUALITY: u8 = 95;
/// List of the frames of a folder.
const LIST: &str = "frames.json";
/// Longest part of a frame's name that is the video's, characters.
const STEM: usize = 60;
/// Features that are kept while frames are compared.
const FEATURES_KEPT: usize = 6;
/// Share of the stated frames below which a video counts as cut short.
const WHOLE: f64 = 0.9;

/// Options of [`take_frames`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameOptions {
    /// Most frames to take; `None`: as many as the motion needs, 12 to 36.
    pub count: Option<usize>,
}

/// Stage of [`take_frames`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameStage {
    /// All frames are read, small.
    Reading,
    /// Frames are compared.
    Comparing,
    /// The chosen frames are decoded and saved.
    Saving,
}

/// Progress of [`take_frames`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VideoProgress {
    /// The stage.
    pub stage: FrameStage,
    /// Frames that are done.
    pub done: usize,
    /// Frames of the stage, where that is known.
    pub total: Option<usize>,
}

/// A frame that was taken.
#[derive(Clone, Debug, PartialEq)]
pub struct TakenFrame {
    /// The JPEG file.
    pub file: PathBuf,
    /// Presentation time, s.
    pub time: f64,
    /// Number of the frame in the video, from 0.
    pub index: usize,
}

/// Result of [`take_frames`].
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct TakenFrames {
    /// The video.
    pub info: VideoInfo,
    /// The frames, in the order of time.
    pub frames: Vec<TakenFrame>,
    /// Number of frames that were read.
    pub decoded: usize,
    /// Lines for the user: which frames were taken, and why.
    pub notes: Vec<String>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Callback for progress; [`ControlFlow::Break`] stops ffmpeg.
type OnProgress<'a> = &'a mut dyn FnMut(VideoProgress) -> ControlFlow<()>;

/// Chooses frames of the video at `path` and writes them into `folder`, which is created, as JPEG files of at most
/// four megapixels with the list `frames.json`. Frames that an earlier call wrote there are replaced.
///
/// `progress` is called for each frame, and several times a second while ffmpeg works.
///
/// # Errors
/// Those of [`probe_video`]; a video of less than two frames, or of a camera that stands still; pictures in `folder`
/// that `frames.json` does not list; a failed or hung ffmpeg; a break of `progress` (an `Interrupted` system error);
/// system errors.
pub fn take_frames(
    path: impl AsRef<Path>,
    folder: impl AsRef<Path>,
    options: &FrameOptions,
    progress: &mut dyn FnMut(VideoProgress) -> ControlFlow<()>,
) -> Result<TakenFrames> {
    let (path, folder) = (path.as_ref(), folder.as_ref());
    let info = probe_video(path)?;
    check_folder(folder)?;
    let (scan, messages) = read_all(path, &info, progress)?;
    let decoded = scan.frames;
    let end = scan.end;
    let candidates = scan.finish();
    let mut warnings = cut_short(path, &info, decoded, messages.last());
    let expected = "a video of two frames or more";
    if decoded < 2 {
        let got = match (decoded, messages.last()) {
            (0, Some(message)) => format!("no frame: {message}"),
            (0, None) => "no frame".to_owned(),
            _ => "one frame".to_owned(),
        };
        return Err(Error::format(path, expected, got));
    }
    let choice = Choice::of(path, &candidates, end, options.count, progress)?;
    let mut notes = choice.notes;
    if let Some(hdr) = info.hdr {
        notes.extend(hdr_note(hdr));
    }
    let chosen: Vec<&Candidate> = choice.chosen.iter().map(|i| &candidates[*i]).collect();
    let frames = save(path, folder, &info, &chosen, progress)?;
    let list: Vec<String> = frames.iter().map(|frame| clock(frame.time)).collect();
    notes.insert(
        0,
        format!(
            "{}: {} of {decoded} frames are taken, at {}",
            path.display(),
            frames.len(),
            list.join(", ")
        ),
    );
    warnings.extend(choice.warnings);
    Ok(TakenFrames { info, frames, decoded, notes, warnings })
}

/// First pass.
fn read_all(
    path: &Path,
    info: &VideoInfo,
    progress: OnProgress<'_>,
) -> Result<(Scan, Vec<String>)> {
    let factor = format!("min(1,{READ_SIDE}/max(iw*sar,ih))");
    let filters = format!("{}{},format=gray", deinterlace(info), scale(&factor, "area"));
    let mut frames = Frames::start(path, info.stream, &filters, Colours::Grey, None)?;
    let mut scan = Scan::default();
    loop {
        let state =
            VideoProgress { stage: FrameStage::Reading, done: scan.frames, total: info.frames };
        let Some((frame, time)) = frames.next(&mut || progress(state))? else { break };
        let time =
            if time.is_nan() { scan.frames as f64 / info.rate.unwrap_or(25.0) } else { time };
        scan.push(&frame, time);
    }
    Ok((scan, frames.messages))
}

fn deinterlace(info: &VideoInfo) -> &'static str {
    if info.interlaced { "yadif," } else { "" }
}

/// Filter that scales by `factor` to even sides and square pixels.
fn scale(factor: &str, filter: &str) -> String {
    format!(
        "scale=w='max(2,2*trunc(0.5*iw*sar*{factor}+0.001))':h='max(2,2*trunc(0.5*ih*{factor}+0.001))':flags={filter}"
    )
}

/// A warning about a file that ends early.
fn cut_short(
    path: &Path,
    info: &VideoInfo,
    decoded: usize,
    message: Option<&String>,
) -> Vec<String> {
    let short = info.frames.filter(|frames| (decoded as f64) < WHOLE * *frames as f64);
    let line = |frames: usize| {
        let reason = message.map_or(String::new(), |message| format!(" ({message})"));
        format!(
            "{}: {decoded} of {frames} frames could be read{reason}: the file may be incomplete; copy it again",
            path.display()
        )
    };
    short.map(line).into_iter().collect()
}

fn hdr_note(hdr: Hdr) -> Option<String> {
    let name = match hdr {
        Hdr::Pq => "PQ",
        Hdr::Hlg => "HLG",
    };
    Some(if has_filters(&["zscale", "tonemap"]) {
        format!("its high dynamic range ({name}) is mapped to ordinary colours")
    } else {
        format!(
            "its colours stay pale: they have a high dynamic range ({name}), and this ffmpeg lacks the filters \
             zscale and tonemap; install a full build of ffmpeg"
        )
    })
}

/// Minutes and seconds: `1:05.25`.
fn clock(seconds: f64) -> String {
    let hundredths = (100.0 * seconds).round() as u64;
    format!("{}:{:02}.{:02}", hundredths / 6000, hundredths / 100 % 60, hundredths % 100)
}

/// Frames that are chosen, with lines about the choice.
struct Choice {
    /// Indices of candidates.
    chosen: Vec<usize>,
    notes: Vec<String>,
    warnings: Vec<String>,
}

impl Choice {
    /// Chooses among `candidates` of a video that ends at `end` s.
    fn of(
        path: &Path,
        candidates: &[Candidate],
        end: f64,
        asked: Option<usize>,
        progress_of: OnProgress<'_>,
    ) -> Result<Self> {
        let mut comparer = Comparer { candidates, kept: VecDeque::new() };
        let cuts: Vec<bool> = candidates.iter().map(|c| c.after_cut).collect();
        let times: Vec<f64> = candidates.iter().map(|c| c.time).collect();
        let all = shots(&cuts, &times, |a, b| comparer.motion(a, b).is_some());
        let last_time = |shot: usize| all.get(shot + 1).map_or(end, |next| times[next[0]]);
        let length = |shot: usize| last_time(shot) - times[all[shot][0]];
        // The first of the longest.
        let longest = (0..all.len()).rev().max_by(|a, b| length(*a).total_cmp(&length(*b)));
        let shot = longest.map(|i| all[i].as_slice()).unwrap_or_default();
        let mut broken = false;
        let moved = progress(0..shot.len(), |a, b| {
            let state =
                VideoProgress { stage: FrameStage::Comparing, done: b, total: Some(shot.len()) };
            broken = broken || progress_of(state).is_break();
            if broken { None } else { comparer.motion(shot[a], shot[b]) }
        });
        if broken {
            let cancelled = std::io::Error::new(std::io::ErrorKind::Interrupted, "cancelled");
            return Err(Error::io(path, cancelled));
        }
        let sharpness: Vec<f64> = shot.iter().map(|i| candidates[*i].sharpness).collect();
        let shot_times: Vec<f64> = shot.iter().map(|i| times[*i]).collect();
        let chosen = choose(&moved, &sharpness, asked);
        if chosen.len() < 2 {
            return Err(Error::format(
                path,
                "a video of a camera that moves, which shows the place from several sides",
                "a camera that stands still",
            ));
        }
        let gaps = chosen.windows(2).map(|pair| moved[pair[1]] - moved[pair[0]]);
        let widest = gaps.fold(0.0, f64::max);
        let mut choice = Self {
            chosen: chosen.iter().map(|i| shot[*i]).collect(),
            notes: Vec::new(),
            warnings: Vec::new(),
        };
        if all.len() > 1 {
            let span = |i: usize| format!("{} to {}", clock(times[all[i][0]]), clock(last_time(i)));
            let used = longest.unwrap_or(0);
            let others: Vec<String> = (0..all.len()).filter(|i| *i != used).map(span).collect();
            choice.notes.push(format!(
                "the video has {} shots: frames are of the longest, {}; left out: {}",
                all.len(),
                span(used),
                few(&others)
            ));
        }
        if let Some([from, to]) = longest_still(&moved, &shot_times) {
            let [from, to] = [from, to].map(clock);
            choice.notes.push(format!(
                "the camera stands still from {from} to {to}: this part gives one frame"
            ));
        }
        if let Some(asked) = asked.filter(|asked| chosen.len() < *asked) {
            choice.notes.push(format!(
                "{} frames instead of {asked}: others would show the same from the same place",
                chosen.len()
            ));
        }
        if widest > FARTHEST {
            choice.warnings.push(format!(
                "{}: the camera moves far between the frames that are taken, which may share too little: take \
                 more of them (--frames {}), or give a shorter part of the video",
                path.display(),
                (2 * chosen.len()).min(100)
            ));
        }
        Ok(choice)
    }
}

/// The first names of a list, and the number of the others.
fn few(names: &[String]) -> String {
    const NAMES: usize = 5;
    let (first, more) = names.split_at(names.len().min(NAMES));
    let more = if more.is_empty() { String::new() } else { format!(" and {} more", more.len()) };
    format!("{}{more}", first.join(", "))
}

/// Compares candidates; features of the last few are kept.
struct Comparer<'a> {
    candidates: &'a [Candidate],
    kept: VecDeque<(usize, Features)>,
}

impl Comparer<'_> {
    /// Motion from one candidate to another; `None` where they show no common place.
    fn motion(&mut self, a: usize, b: usize) -> Option<Motion> {
        let size = |i: usize| {
            let image = &self.candidates[i].thumbnail;
            [image.width, image.height]
        };
        if size(a) != size(b) {
            return None;
        }
        for i in [a, b] {
            // The one that was asked for last stays longest.
            match self.kept.iter().position(|(of, _)| *of == i) {
                Some(at) => {
                    let found = self.kept.remove(at);
                    self.kept.extend(found);
                }
                None => {
                    if self.kept.len() == FEATURES_KEPT {
                        self.kept.pop_front();
                    }
                    self.kept.push_back((i, self.candidates[i].thumbnail.features()));
                }
            }
        }
        let find =
            |i: usize| self.kept.iter().find(|(of, _)| *of == i).map(|(_, features)| features);
        motion(find(a)?, find(b)?, size(a))
    }
}

/// Refuses a folder with pictures that no earlier call wrote.
fn check_folder(folder: &Path) -> Result<()> {
    let own = listed(folder);
    let other = find_photographs(folder).photographs.into_iter().find(|photograph| {
        let name = photograph.file_name().unwrap_or_default().to_string_lossy();
        !own.iter().any(|own| *own == name)
    });
    match other {
        None => Ok(()),
        Some(other) => Err(Error::format(
            folder,
            "an empty folder for the frames of the video, or one of an earlier run",
            format!("the picture {} (choose another output folder)", other.display()),
        )),
    }
}

/// Names of the frames that an earlier call wrote into `folder`.
fn listed(folder: &Path) -> Vec<String> {
    let bytes = read(folder.join(LIST)).unwrap_or_default();
    let list: Value = serde_json::from_slice(&bytes).unwrap_or_default();
    let frames = list["frames"].as_array().cloned().unwrap_or_default();
    let name = |frame: &Value| {
        let name = frame["file"].as_str()?;
        // Names alone: a list from elsewhere does not reach other folders.
        (Path::new(name).file_name()?.to_str()? == name).then(|| name.to_owned())
    };
    frames.iter().filter_map(name).collect()
}

/// Name of a frame: the video's, and the time, so that names sort by time.
fn frame_name(path: &Path, time: f64) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let plain = |c: char| if c.is_alphanumeric() || c == '-' { c } else { '_' };
    let stem: String = stem.trim_start_matches(['.', '-']).chars().take(STEM).map(plain).collect();
    let milliseconds = (1000.0 * time.max(0.0)).round() as u64;
    let (minutes, seconds) = (milliseconds / 60_000, milliseconds / 1000 % 60);
    format!("{stem}_{minutes:03}m{seconds:02}s{:03}.jpg", milliseconds % 1000)
}

/// Second pass: decodes the chosen frames and writes them.
fn save(
    path: &Path,
    folder: &Path,
    info: &VideoInfo,
    chosen: &[&Candidate],
    progress: OnProgress<'_>,
) -> Result<Vec<TakenFrame>> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    for name in listed(folder) {
        // One that is gone already does not stop the run.
        let _ = std::fs::remove_file(folder.join(name));
    }
    let frames: Vec<TakenFrame> = chosen
        .iter()
        .map(|c| TakenFrame {
            file: folder.join(frame_name(path, c.time)),
            time: c.time,
            index: c.index,
        })
        .collect();
    // The list comes first, so that a stopped run leaves no picture that the next one would refuse.
    write_list(path, folder, info, &frames)?;
    let filters = filters_of_chosen(info, &frames);
    let mut decoder = Frames::start(path, info.stream, &filters, Colours::Rgb, Some(frames.len()))?;
    for (done, frame) in frames.iter().enumerate() {
        let state = VideoProgress { stage: FrameStage::Saving, done, total: Some(frames.len()) };
        let Some((picture, _)) = decoder.next(&mut || progress(state))? else {
            let got = format!("{done} of them in the second pass");
            return Err(Error::format(path, format!("{} frames", frames.len()), got));
        };
        write_jpeg(&frame.file, &picture)?;
    }
    Ok(frames)
}

fn filters_of_chosen(info: &VideoInfo, frames: &[TakenFrame]) -> String {
    let numbers: Vec<String> =
        frames.iter().map(|frame| format!("eq(n,{})", frame.index)).collect();
    let select = format!("select='{}'", numbers.join("+"));
    let factor = format!("min(1,sqrt({FRAME_PIXELS}/(iw*sar*ih)))");
    let scale = scale(&factor, "lanczos+accurate_rnd+full_chroma_int");
    let colours = match info.hdr {
        Some(hdr) if has_filters(&["zscale", "tonemap"]) => tone_mapping(hdr),
        _ => format!(":in_color_matrix={},format=rgb24", info.colour_matrix()),
    };
    format!("{}{select},{scale}{colours}", deinterlace(info))
}

/// Filters from PQ or HLG of BT.2020 to sRGB. Linear light of 203 cd/m² counts as 1: diffuse white (ITU-R BT.2408);
/// 1000 cd/m² are the peak. Mobius keeps dark and middle values and compresses bright ones. An ordinary picture that
/// was converted to HLG comes back at 26 dB (with 100 cd/m² as 1: 21 dB; with the curve `hable`: 13 to 18 dB).
fn tone_mapping(hdr: Hdr) -> String {
    let transfer = match hdr {
        Hdr::Pq => "smpte2084",
        Hdr::Hlg => "arib-std-b67",
    };
    format!(
        ",zscale=tin={transfer}:min=2020_ncl:pin=2020:t=linear:npl=203,format=gbrpf32le,zscale=p=709,\
         tonemap=tonemap=mobius:desat=0:peak=5,zscale=t=iec61966-2-1:r=full,format=gbrp"
    )
}

fn write_list(path: &Path, folder: &Path, info: &VideoInfo, frames: &[TakenFrame]) -> Result<()> {
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let frame =
        |f: &TakenFrame| json!({ "file": name(&f.file), "time_s": f.time, "frame": f.index });
    let list = json!({
        "video": path.display().to_string(),
        "codec": info.codec,
        "frames": frames.iter().map(frame).collect::<Vec<_>>(),
    });
    let text = serde_json::to_string_pretty(&list).unwrap_or_default();
    write_atomic(folder.join(LIST), |f| f.write_all(text.as_bytes()))
}

fn write_jpeg(file: &Path, picture: &Pnm) -> Result<()> {
    let Pnm { width, height, data } = picture;
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
        .encode(data, *width as u32, *height as u32, image::ExtendedColorType::Rgb8)
        .map_err(|e| Error::io(file, std::io::Error::other(e)))?;
    write_atomic(file, |f| f.write_all(&bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_by_time_and_hold_no_odd_characters() {
        let name = |path: &str, time| frame_name(Path::new(path), time);
        assert_eq!(name("a/My clip.v2.mp4", 65.0004), "My_clip_v2_001m05s000.jpg");
        assert_eq!(name("-x\n.mp4", -0.1), "x__000m00s000.jpg");
        assert!(name("a.mp4", 9.999) < name("a.mp4", 10.0));
        assert!(name(&format!("{}.mp4", "é".repeat(300)), 1.0).len() < 255);
        assert_eq!(
            (clock(65.25), clock(0.0), clock(59.999)),
            ("1:05.25".into(), "0:00.00".into(), "1:00.00".into())
        );
    }

    #[test]
    fn lists_name_files_of_their_folder_alone() {
        let folder = tempfile::tempdir().unwrap();
        let list =
            r#"{"frames": [{"file": "a.jpg"}, {"file": "../b.jpg"}, {"file": "/c.jpg"}, {}]}"#;
        std::fs::write(folder.path().join(LIST), list).unwrap();
        assert_eq!(listed(folder.path()), ["a.jpg"]);
        assert!(listed(&folder.path().join("none")).is_empty());
    }

    #[test]
    fn a_folder_with_other_pictures_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.png");
        check_folder(folder.path()).unwrap();
        crate::files::photos::image::save_png(&path, &crate::scene::pictures::Rgb::black(4, 3))
            .unwrap();
        assert!(check_folder(folder.path()).unwrap_err().to_string().contains("mine.png"));
        std::fs::write(folder.path().join(LIST), r#"{"frames": [{"file": "mine.png"}]}"#).unwrap();
        check_folder(folder.path()).unwrap();
    }
}
