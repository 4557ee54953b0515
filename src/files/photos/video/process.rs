//! The programs `ffmpeg` and `ffprobe`, found in PATH and called without a shell.
//!
//! `ffmpeg` writes frames as PNM pictures, whose headers state their size (after rotation and scaling), to
//! a pipe, and a line for each frame with its presentation time (filter `showinfo`) to another. Two threads read
//! the pipes into one bounded channel. The process is killed when its owner is dropped.
//!
//! The path of a file has the prefix `file:`, so that ffmpeg takes `-x.mp4` and `http:clip` for names of files.
//! The list of protocols keeps a playlist that is called `clip.mp4` from opening addresses.

use crate::files::{Error, Result};
use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Time without any output after which a program counts as hung.
const STALLED: Duration = Duration::from_secs(60);
/// Time between two calls of the caller's function while no frame comes.
const POLL: Duration = Duration::from_millis(200);
/// Frames and lines that wait for the caller.
const WAITING: usize = 4;
/// Frames whose times have not come yet.
const UNTIMED_MAX: usize = 64;
/// Largest frame, px; larger ones are scaled by ffmpeg before.
const FRAME_PIXELS_MAX: usize = 8_000_000;
/// Largest answer of ffprobe, bytes.
const ANSWER_MAX: u64 = 8 << 20;
/// Longest line of messages that is kept, bytes.
const LINE_MAX: u64 = 4096;

/// Returns whether `program` is in PATH and runs.
pub fn is_installed(program: &str) -> bool {
    let mut command = Command::new(program);
    command.arg("-version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// The error for a video without the program that reads it: how to install it, or how to do without.
pub(super) fn check_installed(path: &Path) -> Result<()> {
    let Some(absent) = ["ffmpeg", "ffprobe"].into_iter().find(|program| !is_installed(program))
    else {
        return Ok(());
    };
    let install = if cfg!(target_os = "macos") {
        "brew install ffmpeg"
    } else if cfg!(windows) {
        "winget install ffmpeg"
    } else {
        "sudo apt install ffmpeg"
    };
    Err(Error::format(
        path,
        "the program ffmpeg, which reads videos",
        format!(
            "no `{absent}` in PATH (install it: `{install}`; or save 10 to 60 pictures of the video, in VLC by \
             Video > Take Snapshot, and give their folder)"
        ),
    ))
}

/// Returns whether ffmpeg has all `filters`.
pub(super) fn has_filters(filters: &[&str]) -> bool {
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-filters"]).stdin(Stdio::null()).stderr(Stdio::null());
    let Ok(list) = command.output() else { return false };
    let list = String::from_utf8_lossy(&list.stdout).into_owned();
    let names: Vec<&str> = list.lines().filter_map(|l| l.split_whitespace().nth(1)).collect();
    filters.iter().all(|filter| names.contains(filter))
}

/// The argument by which ffmpeg and ffprobe open a file.
fn source(path: &Path) -> OsString {
    let mut argument = OsString::from("file:");
    argument.push(path);
    argument
}

/// A process that is killed when it is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // A process that has ended cannot be killed: no error of the caller's.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(path: &Path, command: &mut Command) -> Result<(Running, ChildStdout, ChildStderr)> {
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let mut child = Running(child.map_err(|e| Error::io(path, e))?);
    match (child.0.stdout.take(), child.0.stderr.take()) {
        (Some(out), Some(messages)) => Ok((child, out, messages)),
        _ => Err(Error::io(path, std::io::Error::other("no pipes to ffmpeg"))),
    }
}

/// The error of a program that failed with `messages`.
fn failed(path: &Path, program: &str, messages: &[String]) -> Error {
    let last = messages.last().map_or("no message", String::as_str);
    Error::format(path, format!("a video that {program} reads"), format!("its error: {last}"))
}

/// Runs ffprobe and returns its JSON.
///
/// # Errors
/// An exit status other than 0, with the program's last message; no end within a minute; a larger answer than
/// 8 MiB.
pub(super) fn ffprobe(path: &Path) -> Result<Vec<u8>> {
    let mut command = Command::new("ffprobe");
    command
        .args(["-v", "error", "-protocol_whitelist", "file,pipe", "-print_format", "json"])
        .args(["-show_format", "-show_streams", "-i"])
        .arg(source(path));
    let (mut child, out, messages) = start(path, &mut command)?;
    let (send, answer) = sync_channel(2);
    let send_lines = send.clone();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let read = out.take(ANSWER_MAX + 1).read_to_end(&mut bytes).map(|_| bytes);
        // The receiver is gone after a time-out only.
        let _ = send.send((Some(read), Vec::new()));
    });
    std::thread::spawn(move || {
        let mut lines = Vec::new();
        each_line(messages, |line| keep(&mut lines, line));
        let _ = send_lines.send((None, lines));
    });
    let (mut bytes, mut lines) = (Vec::new(), Vec::new());
    let limit = Instant::now() + STALLED;
    for _ in 0..2 {
        let left = limit.saturating_duration_since(Instant::now());
        let Ok((read, messages)) = answer.recv_timeout(left) else {
            return Err(hung(path, "ffprobe"));
        };
        match read {
            Some(read) => bytes = read.map_err(|e| Error::io(path, e))?,
            None => lines = messages,
        }
    }
    if bytes.len() as u64 > ANSWER_MAX {
        return Err(Error::format(
            path,
            "a description of at most 8 MiB by ffprobe",
            "a longer one",
        ));
    }
    let status = child.0.wait().map_err(|e| Error::io(path, e))?;
    if status.success() { Ok(bytes) } else { Err(failed(path, "ffprobe", &lines)) }
}

fn hung(path: &Path, program: &str) -> Error {
    let seconds = STALLED.as_secs();
    let got = format!("no output of {program} for {seconds} seconds (it was stopped)");
    Error::format(path, format!("a video that {program} reads"), got)
}

/// Calls `each` with every line, cut at 4096 bytes.
fn each_line(input: impl Read, mut each: impl FnMut(&str)) {
    let mut input = BufReader::new(input);
    let mut line = Vec::new();
    loop {
        line.clear();
        match input.by_ref().take(LINE_MAX).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => return,
            Ok(_) => each(String::from_utf8_lossy(&line).trim_end()),
        }
    }
}

/// Keeps the last messages.
fn keep(lines: &mut Vec<String>, line: &str) {
    const KEPT: usize = 20;
    if lines.len() == KEPT {
        lines.remove(0);
    }
    if !line.trim().is_empty() {
        lines.push(line.trim().to_owned());
    }
}

/// A frame as ffmpeg writes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Pnm {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// 8-bit values, row by row: one a pixel of grey, three of RGB.
    pub data: Vec<u8>,
}

/// A line of ffmpeg.
#[derive(Clone, Debug, PartialEq)]
enum Line {
    /// Presentation time of the next frame, s; NaN where the file has none.
    Time(f64),
    Error(String),
    Other,
}

impl Line {
    /// Parses a line of `-loglevel level+info`.
    fn parse(line: &str) -> Self {
        if line.contains("showinfo") && line.contains(" n:") {
            let time = line.split("pts_time:").nth(1).map(str::trim_start);
            let time = time.and_then(|rest| rest.split_whitespace().next());
            // Without presentation times: NOPTS.
            return Self::Time(time.and_then(|t| t.parse().ok()).unwrap_or(f64::NAN));
        }
        match ["[error] ", "[fatal] "].iter().find_map(|level| line.split(level).nth(1)) {
            Some(message) => Self::Error(message.to_owned()),
            None => Self::Other,
        }
    }
}

enum Event {
    Frame(std::io::Result<Pnm>),
    Line(Line),
    FramesEnd,
    LinesEnd,
}

/// Frames of a video by ffmpeg, one after the other, with their times.
pub(super) struct Frames {
    path: PathBuf,
    child: Running,
    events: Receiver<Event>,
    frames: VecDeque<Pnm>,
    times: VecDeque<f64>,
    ends: usize,
    broken: Option<std::io::Error>,
    /// The last messages about errors.
    pub messages: Vec<String>,
}

/// Colours of decoded frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Colours {
    Grey,
    Rgb,
}

impl Frames {
    /// Starts to decode stream `stream` through `filters`. At most `limit` frames are decoded, where it is given.
    pub fn start(
        path: &Path,
        stream: usize,
        filters: &str,
        colours: Colours,
        limit: Option<usize>,
    ) -> Result<Self> {
        let (codec, pixels) = match colours {
            Colours::Grey => ("pgm", "gray"),
            Colours::Rgb => ("ppm", "rgb24"),
        };
        // Frames go to the pipe as they are: even times, 25 a second, give ffmpeg no reason to repeat or to drop
        // one (`-fps_mode` and `-vsync` do not exist in all its versions).
        let filters = format!("{filters},showinfo,settb=1/25,setpts=N");
        let mut command = Command::new("ffmpeg");
        command
            .args(["-hide_banner", "-nostdin", "-nostats", "-progress", "pipe:2"])
            .args(["-loglevel", "repeat+level+info", "-protocol_whitelist", "file,pipe", "-i"])
            .arg(source(path))
            .args(["-map", &format!("0:{stream}"), "-an", "-sn", "-dn", "-vf", &filters])
            .args(["-r", "25", "-pix_fmt", pixels, "-c:v", codec, "-f", "image2pipe"]);
        if let Some(limit) = limit {
            command.args(["-frames:v", &limit.to_string()]);
        }
        command.arg("pipe:1");
        let (child, out, messages) = start(path, &mut command)?;
        let (send, events) = sync_channel(WAITING);
        let send_lines = send.clone();
        std::thread::spawn(move || read_frames(out, &send));
        std::thread::spawn(move || {
            let mut open = true;
            each_line(messages, |line| {
                // Without a receiver the lines are read on, so that the process can end.
                open = open && send_lines.send(Event::Line(Line::parse(line))).is_ok();
            });
            let _ = send_lines.send(Event::LinesEnd);
        });
        Ok(Self {
            path: path.to_owned(),
            child,
            events,
            frames: VecDeque::new(),
            times: VecDeque::new(),
            ends: 0,
            broken: None,
            messages: Vec::new(),
        })
    }

    /// The next frame with its time, s (NaN where the file states none); `None` at the end. `poll` is called while
    /// the program works; [`ControlFlow::Break`] stops it.
    ///
    /// # Errors
    /// A failed or hung program; a malformed frame; a break (`Interrupted`).
    pub fn next(
        &mut self,
        poll: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<Option<(Pnm, f64)>> {
        let mut heard = Instant::now();
        loop {
            if !self.times.is_empty()
                && let Some(frame) = self.frames.pop_front()
            {
                return Ok(Some((frame, self.times.pop_front().unwrap_or(f64::NAN))));
            }
            if self.ends == 2 {
                return self.end();
            }
            if poll().is_break() {
                let cancelled = std::io::Error::new(std::io::ErrorKind::Interrupted, "cancelled");
                return Err(Error::io(&self.path, cancelled));
            }
            match self.events.recv_timeout(POLL) {
                Ok(event) => {
                    heard = Instant::now();
                    self.take(event)?;
                }
                Err(RecvTimeoutError::Timeout) if heard.elapsed() < STALLED => {}
                Err(RecvTimeoutError::Timeout) => return Err(hung(&self.path, "ffmpeg")),
                Err(RecvTimeoutError::Disconnected) => self.ends = 2,
            }
        }
    }

    fn take(&mut self, event: Event) -> Result<()> {
        match event {
            Event::Frame(Ok(frame)) => self.frames.push_back(frame),
            // The program's own message, if it failed, says more.
            Event::Frame(Err(e)) => {
                self.broken = Some(e);
                self.ends += 1;
            }
            Event::Line(Line::Time(time)) => self.times.push_back(time),
            Event::Line(Line::Error(message)) => keep(&mut self.messages, &message),
            Event::Line(Line::Other) => {}
            Event::FramesEnd | Event::LinesEnd => self.ends += 1,
        }
        if self.frames.len() > UNTIMED_MAX {
            return Err(Error::format(
                &self.path,
                "a time of each frame by ffmpeg",
                "frames without times",
            ));
        }
        Ok(())
    }

    /// Waits for the end of the program.
    fn end(&mut self) -> Result<Option<(Pnm, f64)>> {
        let status = self.child.0.wait().map_err(|e| Error::io(&self.path, e))?;
        if !status.success() {
            return Err(failed(&self.path, "ffmpeg", &self.messages));
        }
        if let Some(broken) = self.broken.take() {
            return Err(Error::io(&self.path, broken));
        }
        // A frame whose line did not come has no time.
        Ok(self.frames.pop_front().map(|frame| (frame, f64::NAN)))
    }
}

/// Sends all frames of a pipe.
fn read_frames(out: impl Read, send: &SyncSender<Event>) {
    let mut out = BufReader::with_capacity(1 << 20, out);
    while let Some(frame) = read_pnm(&mut out).transpose() {
        let failed = frame.is_err();
        if send.send(Event::Frame(frame)).is_err() || failed {
            return;
        }
    }
    let _ = send.send(Event::FramesEnd);
}

/// Reads a binary PNM picture of 8 bits, P5 or P6; `None` at the end of the pipe.
fn read_pnm(input: &mut impl BufRead) -> std::io::Result<Option<Pnm>> {
    let malformed = |what: String| std::io::Error::new(std::io::ErrorKind::InvalidData, what);
    if input.fill_buf()?.is_empty() {
        return Ok(None);
    }
    // Kind, width, height, largest value: words, each ended by one character.
    let mut words: [String; 4] = Default::default();
    for word in &mut words {
        let mut bytes = Vec::new();
        loop {
            let mut byte = [0];
            input.read_exact(&mut byte)?;
            if byte[0].is_ascii_whitespace() {
                break;
            }
            bytes.push(byte[0]);
            if bytes.len() > 12 {
                return Err(malformed("ffmpeg wrote no PNM header".to_owned()));
            }
        }
        *word = String::from_utf8_lossy(&bytes).into_owned();
    }
    let channels = match words[0].as_str() {
        "P5" => 1,
        "P6" => 3,
        _ => return Err(malformed("ffmpeg wrote no PNM picture".to_owned())),
    };
    let side = |text: &str| text.parse::<usize>().ok().filter(|n| (1..=65_535).contains(n));
    let (Some(width), Some(height)) = (side(&words[1]), side(&words[2])) else {
        return Err(malformed(format!("ffmpeg wrote a frame of {}x{} px", words[1], words[2])));
    };
    if width * height > FRAME_PIXELS_MAX || words[3] != "255" {
        return Err(malformed(format!(
            "ffmpeg wrote a frame of {width}x{height} px, {} values",
            words[3]
        )));
    }
    let mut data = vec![0; width * height * channels];
    input.read_exact(&mut data)?;
    Ok(Some(Pnm { width, height, data }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pnm_pictures_follow_one_another() {
        let mut bytes = b"P5\n2 1\n255\n\x07\x08".to_vec();
        bytes.extend(b"P6\n1 1\n255\n\n12");
        let mut input = &bytes[..];
        let grey = read_pnm(&mut input).unwrap().unwrap();
        assert_eq!((grey.width, grey.height, grey.data), (2, 1, vec![7, 8]));
        assert_eq!(read_pnm(&mut input).unwrap().unwrap().data, b"\n12");
        assert!(read_pnm(&mut input).unwrap().is_none());
        for bad in [
            &b"P5\n2 1\n255\n\x07"[..],
            b"P5\n99999 99999\n255\n",
            b"P5\n60000 60000\n255\n",
            b"P5\n0 1\n255\n",
            b"P4\n2 1\n255\n",
            b"P5\n2 1\n65535\n12",
            b"not a picture at all",
        ] {
            assert!(read_pnm(&mut &bad[..]).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn lines_give_times_and_errors() {
        let time =
            "[Parsed_showinfo_1 @ 0x55] [info] n:   3 pts:   3072 pts_time:0.2     duration: 1";
        assert_eq!(Line::parse(time), Line::Time(0.2));
        let Line::Time(none) =
            Line::parse("[Parsed_showinfo_1 @ 0x5] n: 3 pts:NOPTS pts_time:NOPTS")
        else {
            panic!("no time")
        };
        assert!(none.is_nan());
        assert_eq!(Line::parse("[mov @ 0x1] [error] moov"), Line::Error("moov".to_owned()));
        assert_eq!(
            Line::parse("[Parsed_showinfo_1 @ 0x5] [info] config in time_base: 1/4"),
            Line::Other
        );
    }
}
