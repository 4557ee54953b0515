//! A video as input. The tests with a real ffmpeg skip, with a line, where there is none; the others bring programs
//! of that name along, which answer as ffmpeg does.

use crate::program::{Called, call_in, call_with};
use std::fs;
use std::path::Path;
use std::process::Command;
use subsplat::files::photos::image::{probe, save_png};
use subsplat::scene::pictures::Rgb;

/// Width and height of the clips, px.
const SIZE: (usize, usize) = (320, 240);
/// Frames of a clip, of which the first ones are taken from a tripod.
const FRAMES: (usize, usize) = (105, 60);

/// Smooth noise in [0, 255] with detail of about four pixels.
fn noise(x: f64, y: f64, seed: u64) -> f64 {
    let at = |i: i64, j: i64| {
        let mut h = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (j as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        h = (h ^ seed).wrapping_mul(0xff51_afd7_ed55_8ccd);
        ((h ^ (h >> 33)) % 256) as f64
    };
    let (x, y) = (x / 4.0, y / 4.0);
    let (i, j) = (x.floor(), y.floor());
    let (u, v) = (x - i, y - j);
    let (i, j) = (i as i64, j as i64);
    let top = (1.0 - u) * at(i, j) + u * at(i + 1, j);
    let bottom = (1.0 - u) * at(i, j + 1) + u * at(i + 1, j + 1);
    (1.0 - v) * top + v * bottom
}

/// Two walls, of which the nearer one moves three times as fast, as a camera at `place` sees them. `blurred` frames
/// are the mean over eight pixels.
fn frame(place: f64, blurred: bool, seed: u64) -> Rgb {
    let (width, height) = SIZE;
    let mut picture = Rgb::black(width, height);
    let value = |x: f64, y: f64| {
        let near = (80.0..160.0).contains(&y);
        noise(x + if near { 3.0 } else { 1.0 } * place, y, seed + u64::from(near))
    };
    for (i, pixel) in picture.data.chunks_exact_mut(3).enumerate() {
        let (x, y) = ((i % width) as f64, (i / width) as f64);
        let count = if blurred { 8 } else { 1 };
        let sum: f64 = (0..count).map(|k| value(x + f64::from(k), y)).sum();
        pixel.fill((sum / f64::from(count)) as u8);
    }
    picture
}

/// Writes `clip.mp4` with a cut to another place at its end, by ffmpeg; two of three frames are blurred. Returns
/// `false`, and prints a line, where there is no ffmpeg.
fn clip(folder: &Path, rotate: Option<&str>) -> bool {
    if !subsplat::files::photos::video::is_installed("ffmpeg") {
        eprintln!("SKIPPED: no ffmpeg in PATH, so that no video can be made and read");
        return false;
    }
    fs::create_dir(folder.join("made")).unwrap();
    let (count, still) = FRAMES;
    for i in 0..count + 10 {
        let place = i.saturating_sub(still) as f64;
        let seed = if i < count { 1 } else { 50 };
        let name = folder.join(format!("made/{i:03}.png"));
        save_png(name, &frame(place, i % 3 != 1, seed)).unwrap();
    }
    let run = |arguments: &[&str]| {
        let mut command = Command::new("ffmpeg");
        command.args(["-v", "error", "-y"]).args(arguments).current_dir(folder);
        assert!(command.status().unwrap().success(), "{arguments:?}");
    };
    run(&[
        "-framerate",
        "30",
        "-i",
        "made/%03d.png",
        "-c:v",
        "mpeg4",
        "-q:v",
        "2",
        "-an",
        "plain.mp4",
    ]);
    match rotate {
        Some(turn) => run(&["-i", "plain.mp4", "-c", "copy", "-metadata:s:v", turn, "clip.mp4"]),
        None => fs::rename(folder.join("plain.mp4"), folder.join("clip.mp4")).unwrap(),
    }
    true
}

/// Names in `frames.json`, and the numbers of the frames in the video.
fn listed(folder: &Path) -> Vec<(String, usize)> {
    let text = fs::read_to_string(folder.join("frames.json")).unwrap();
    let list: serde_json::Value = serde_json::from_str(&text).unwrap();
    let frame = |f: &serde_json::Value| {
        (f["file"].as_str().unwrap().to_owned(), f["frame"].as_u64().unwrap() as usize)
    };
    list["frames"].as_array().unwrap().iter().map(frame).collect()
}

#[test]
fn sharp_frames_of_the_motion_are_taken_and_the_rest_is_named() {
    let place = tempfile::tempdir().unwrap();
    if !clip(place.path(), None) {
        return;
    }
    // The cameras of two flat walls may be refused: the frames are there before.
    let called = call_in(place.path(), "poses clip.mp4 --frames 8 -o out");
    let frames = listed(&place.path().join("out/frames"));
    assert!((4..=8).contains(&frames.len()), "{frames:?}\n{}", called.stderr);
    let (count, still) = FRAMES;
    assert!(frames.iter().filter(|(_, i)| *i < still).count() <= 1, "{frames:?}");
    assert!(frames.iter().all(|(_, i)| *i < count), "frames of the other shot: {frames:?}");
    let sharp = frames.iter().filter(|(_, i)| i % 3 == 1).count();
    assert!(sharp + 1 >= frames.len(), "{frames:?}");
    for (name, i) in &frames {
        let milliseconds = (*i as f64 / 0.03).round() as usize;
        let time = format!("{:02}s{:03}", milliseconds / 1000, milliseconds % 1000);
        assert!(name.starts_with("clip_000m") && name.contains(&time), "{name} {i}");
        let size = probe(place.path().join("out/frames").join(name)).unwrap();
        assert_eq!((size.width, size.height), SIZE);
    }
    for words in ["frames are taken, at 0:0", "2 shots", "stands still from 0:00.0", "out/frames"] {
        assert!(called.stderr.contains(words), "{words}: {}", called.stderr);
    }
    // A second call replaces them, and a folder with other pictures is refused.
    call_in(place.path(), "poses clip.mp4 --frames 4 -o out");
    let fewer = listed(&place.path().join("out/frames"));
    let pictures = fs::read_dir(place.path().join("out/frames")).unwrap().count() - 1;
    assert!(fewer.len() <= 4 && pictures == fewer.len(), "{fewer:?} {pictures}");
    fs::copy(place.path().join("made/000.png"), place.path().join("out/frames/mine.png")).unwrap();
    let refused = call_in(place.path(), "poses clip.mp4 -o out");
    assert!(refused.code == 1 && refused.error().contains("mine.png"), "{}", refused.stderr);
}

#[test]
fn the_rotation_of_the_metadata_is_applied_and_a_folder_of_one_video_is_one() {
    let place = tempfile::tempdir().unwrap();
    if !clip(place.path(), Some("rotate=90")) {
        return;
    }
    fs::create_dir(place.path().join("phone")).unwrap();
    fs::rename(place.path().join("clip.mp4"), place.path().join("phone/-clip.mp4")).unwrap();
    let called = call_in(place.path(), "poses phone --frames 4 -o cameras.json");
    let folder = place.path().join("cameras_frames");
    let frames = listed(&folder);
    assert!(frames.len() >= 2, "{}", called.stderr);
    let size = probe(folder.join(&frames[0].0)).unwrap();
    assert_eq!((size.height, size.width), SIZE);
    // Without motion: the tripod's part alone.
    let cut = ["-v", "error", "-i", "plain.mp4", "-t", "1", "-c", "copy", "tripod.mp4"];
    let made = Command::new("ffmpeg").args(cut).current_dir(place.path()).status();
    assert!(made.unwrap().success());
    let still = call_in(place.path(), "run tripod.mp4 -o still");
    assert!(still.code == 1 && still.error().contains("stands still"), "{}", still.stderr);
}

/// Calls the program on `clip.mp4` with programs `ffprobe` and `ffmpeg` of these shell scripts, which are in PATH
/// alone. Beside it lie `programs` and COLMAP's `model`.
#[cfg(unix)]
fn with_programs(ffprobe: &str, ffmpeg: &str, arguments: &[&str]) -> Called {
    use std::os::unix::fs::PermissionsExt;
    let place = tempfile::tempdir().unwrap();
    let programs = place.path().join("programs");
    fs::create_dir(&programs).unwrap();
    for (name, script) in [("ffprobe", ffprobe), ("ffmpeg", ffmpeg)] {
        if !script.is_empty() {
            let file = programs.join(name);
            fs::write(&file, format!("#!/bin/sh\n[ \"$1\" = -version ] && exit 0\n{script}\n"))
                .unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
        }
    }
    let model = place.path().join("model");
    fs::create_dir(&model).unwrap();
    fs::write(model.join("cameras.txt"), "1 PINHOLE 64 48 70 70 32 24\n").unwrap();
    fs::write(model.join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
    fs::write(place.path().join("clip.mp4"), b"\0\0\0\x18ftypmp42\0\0\0\0").unwrap();
    call_with(place.path(), arguments, &[("PATH", programs.to_str().unwrap())])
}

#[cfg(unix)]
#[test]
fn failures_of_ffmpeg_are_one_clear_error() {
    let stream = r#"printf '{"streams":[{"index":0,"codec_type":"video","width":4,"height":2}]}'"#;
    let audio = r#"printf '{"streams":[{"index":0,"codec_type":"audio"}]}'"#;
    let frame = r"printf '[Parsed_showinfo_0 @ 0x1] [info] n: 0 pts: 0 pts_time:0 x\n' >&2; printf 'P5\n4 2\n255\n12345678'";
    let cases = [
        ("", "", "no `ffmpeg` in PATH"),
        ("", "", "install it"),
        ("", "", "save 10 to 60 pictures"),
        ("", "exit 0", "no `ffprobe` in PATH"),
        ("echo 'moov atom not found' >&2; exit 1", "exit 0", "moov atom not found"),
        ("printf nonsense", "exit 0", "description by ffprobe"),
        (audio, "exit 0", "an audio file"),
        (stream, "echo '[x @ 0x1] [error] out of disk' >&2; exit 1", "out of disk"),
        (stream, "exit 0", "no frame"),
        (stream, "echo nonsense and more of it", "no PNM picture"),
        (stream, frame, "one frame"),
    ];
    for (ffprobe, ffmpeg, words) in cases {
        for command in ["run", "poses"] {
            let called = with_programs(ffprobe, ffmpeg, &[command, "clip.mp4", "-o", "out"]);
            let error = called.error();
            assert!(
                called.code == 1 && error.contains("clip.mp4") && error.contains(words),
                "{words}: {error}"
            );
        }
    }
    // An output folder that cannot be used is refused before a frame is written.
    let called = with_programs(stream, frame, &["run", "clip.mp4", "-o", "programs/ffmpeg"]);
    assert!(called.code == 1 && called.error().contains("got a file"), "{}", called.stderr);
    let called = with_programs(stream, frame, &["poses", "clip.mp4", "-o", "programs/ffmpeg"]);
    assert!(called.code == 1 && called.error().contains("another file"), "{}", called.stderr);
    let called = with_programs(stream, frame, &["run", "clip.mp4", "-o", "model"]);
    assert!(called.code == 1 && called.error().contains("holds the poses"), "{}", called.stderr);
    // Flags and inputs that do not fit a video.
    for (arguments, words) in [
        (&["run", "clip.mp4", "--frames", "1"][..], "2 to 100"),
        (&["run", "clip.mp4", "clip.mp4"], "one video alone"),
        (&["check", "clip.mp4"], "subsplat run"),
    ] {
        let called = with_programs(stream, "exit 0", arguments);
        assert!(called.code == 1 && called.error().contains(words), "{}", called.stderr);
    }
}
