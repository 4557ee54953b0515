//! A video as input: frames of it become a folder of photographs, which the command then reads.

use super::args::{PathArg, PosesArgs, RunArgs};
use crate::report::{Progress, print_line, print_warning};
use anyhow::{Result, bail, ensure};
use indicatif::ProgressBar;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use subsplat::files::photos::folder::find_photographs;
use subsplat::files::photos::video::{
    FrameOptions, FrameStage, TakenFrames, VideoProgress, is_animated_webp, is_video, take_frames,
};
use subsplat::files::poses::find::is_own_output;
use subsplat::files::poses::scene::has_scene;

/// Fewest and most frames of a video.
const FRAMES: (usize, usize) = (2, 100);
/// Folder of the frames in the output folder.
const FOLDER: &str = "frames";

/// Arguments that read the frames of a video.
pub struct OfVideo<A> {
    /// The arguments.
    pub args: A,
    /// The video.
    pub video: PathBuf,
}

impl<A> OfVideo<A> {
    /// Name of the scene: that of the video.
    pub fn scene_name(&self) -> String {
        self.video.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    }
}

/// Arguments of `run` that read the frames of a video, where the input is one.
///
/// # Errors
/// Those of [`video_of`] and of the library's `take_frames`; `--take` without a video; a number out of its range.
pub fn of_run(args: &RunArgs, progress: &mut Progress) -> Result<Option<OfVideo<RunArgs>>> {
    let Some(video) = video_of(&args.input)? else {
        ensure!(args.take.is_none(), "--take: only with a video, got photographs or a scene");
        return Ok(None);
    };
    let mut frames = args.clone();
    let count = match args.take {
        // Without a path, --frames has no other meaning for a video.
        None if args.path == PathArg::Targets && args.motion.video.is_none() => {
            frames.motion.frames.take().map(|count| ("--frames", count))
        }
        take => take.map(|count| ("--take", count)),
    };
    frames.input = vec![take(&video, &args.out.join(FOLDER), count, progress)?];
    Ok(Some(OfVideo { args: frames, video }))
}

/// Arguments of `poses` that read the frames of a video, where the input is one.
///
/// # Errors
/// As [`of_run`].
pub fn of_poses(args: &PosesArgs, progress: &mut Progress) -> Result<Option<OfVideo<PosesArgs>>> {
    let Some(video) = video_of(&args.input)? else {
        ensure!(args.frames.is_none(), "--frames: only with a video, got photographs");
        return Ok(None);
    };
    let is_file = args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    ensure!(
        is_file || !args.out.is_file(),
        "--out {}: expected a folder or a .json file, got another file",
        args.out.display()
    );
    let folder = if is_file {
        let stem = args.out.file_stem().unwrap_or_default().to_string_lossy();
        args.out.with_file_name(format!("{stem}_{FOLDER}"))
    } else {
        args.out.join(FOLDER)
    };
    let count = args.frames.map(|count| ("--frames", count));
    let input = vec![take(&video, &folder, count, progress)?];
    Ok(Some(OfVideo { args: PosesArgs { input, ..args.clone() }, video }))
}

/// The video that `input` names: the file, or the only one of a folder without photographs.
///
/// # Errors
/// Several videos, or a video beside photographs; an animated WebP.
fn video_of(input: &[PathBuf]) -> Result<Option<PathBuf>> {
    let [one] = input else {
        let video = input.iter().find(|path| is_video(path));
        return video.map_or(Ok(None), |video| {
            bail!(
                "{}: expected photographs, or one video alone, got a video among {} inputs",
                video.display(),
                input.len()
            )
        });
    };
    ensure!(
        !is_animated_webp(one),
        "{}: expected photographs or a video, got an animated WebP (convert it to .mp4 first)",
        one.display()
    );
    if is_video(one) {
        return Ok(Some(one.clone()));
    }
    if !one.is_dir() || is_own_output(one) || has_scene(one) {
        return Ok(None);
    }
    let found = find_photographs(one);
    match found.videos.as_slice() {
        [video] if found.photographs.is_empty() => Ok(Some(video.clone())),
        [_, _, ..] if found.photographs.is_empty() => {
            let names = found.videos.iter().filter_map(|path| path.file_name());
            let names: Vec<String> = names.map(|n| n.to_string_lossy().into_owned()).collect();
            bail!(
                "{}: expected photographs or one video, got {} videos: give one of them: {}",
                one.display(),
                names.len(),
                names.join(", ")
            )
        }
        _ => Ok(None),
    }
}

/// Takes frames of `video`, at most as many as a flag says, and prints which. Returns their folder.
fn take(
    video: &Path,
    folder: &Path,
    count: Option<(&str, usize)>,
    progress: &mut Progress,
) -> Result<PathBuf> {
    let (least, most) = FRAMES;
    if let Some((flag, count)) = count {
        ensure!(
            (least..=most).contains(&count),
            "{flag}: expected {least} to {most} frames of a video (10 to 60 do best), got {count}"
        );
    }
    let options = FrameOptions { count: count.map(|(_, count)| count) };
    let taken = progress
        .stage("video", |bar| take_frames(video, folder, &options, &mut |p| show(bar, p)))?;
    print(&taken, folder);
    Ok(folder.to_owned())
}

fn show(bar: &ProgressBar, progress: VideoProgress) -> ControlFlow<()> {
    let VideoProgress { stage, done, total } = progress;
    let what = match stage {
        FrameStage::Reading => "frames are read",
        FrameStage::Comparing => "frames are compared",
        FrameStage::Saving => "frames are saved",
    };
    let total = total.map_or(String::new(), |total| format!(" of {total}"));
    bar.set_message(format!("{what}: {done}{total}"));
    ControlFlow::Continue(())
}

fn print(taken: &TakenFrames, folder: &Path) {
    taken.warnings.iter().for_each(print_warning);
    taken.notes.iter().for_each(print_line);
    print_line(format!("the frames are in {}", folder.display()));
}
