//! The photographs that a scene is made from: the choice among those of a scene, and their pixels.

use super::args::SourceArgs;
use super::frames;
use crate::report::{Progress, print_warning};
use anyhow::{Result, bail, ensure};
use std::path::{Path, PathBuf};
use subsplat::Photo;
use subsplat::files::Error as FileError;
use subsplat::files::photos::image::{LoadOptions, Truncated};
use subsplat::files::photos::notes::grouped;
use subsplat::files::poses::scene::{Scene, SceneFormat};
use subsplat::reconstruct::inputs::pair::choose_photographs;

/// Photographs that were chosen and read.
pub struct Inputs {
    /// Their frames in the scene.
    pub context: Vec<usize>,
    /// Reason for the choice, the end of a sentence "the scene is made from …".
    pub reason: String,
    /// The photographs.
    pub photos: Vec<Photo>,
}

/// Frames that a scene is made from.
struct Choice {
    frames: Vec<usize>,
    reason: String,
    /// The person or the scene's protocol names them: each is needed.
    named: bool,
}

/// Chooses the photographs of the scene at `input` that `args` name, or a default, and reads them. One that cannot be
/// read and that nobody named is taken from the scene, and the choice is made again.
///
/// # Errors
/// Those of the choice; a photograph that cannot be read and is needed, or any with `--strict`.
pub fn choose(
    args: &SourceArgs,
    input: &Path,
    scene: &mut Scene,
    progress: &mut Progress,
) -> Result<Inputs> {
    loop {
        let Choice { frames, reason, named } = choice(args, input, scene)?;
        let (photos, unread) = photographs(scene, &frames, args.pair.force, progress)?;
        let left = scene.usable().len() - unread.len();
        let needed = named || args.pair.read.strict || left < 2;
        let names: Vec<String> = unread
            .iter()
            .map(|(frame, error)| {
                format!("{} ({})", scene.frames[*frame].image.display(), error.reason())
            })
            .collect();
        let mut first = None;
        // From the last one on, so that the indices of the others stay.
        for (frame, error) in unread.into_iter().rev() {
            scene.leave_out(frame, &error);
            first = Some(error);
        }
        match first {
            None => return Ok(Inputs { context: frames, reason, photos }),
            Some(error) if needed => return Err(error.into()),
            Some(_) => {
                print_warning(format!("left out, for they cannot be used: {}", names.join(", ")))
            }
        }
    }
}

/// Frames that cannot be read, in their order.
type Unread = Vec<(usize, FileError)>;

/// Loads the photographs of a scene's `context` frames; `force` accepts truncated files. Prints the warnings about
/// their files, where the estimation of cameras has not and where all can be read.
fn photographs(
    scene: &Scene,
    context: &[usize],
    force: bool,
    progress: &mut Progress,
) -> Result<(Vec<Photo>, Unread)> {
    let options = load_options(force);
    let mut warnings: Vec<(PathBuf, Vec<String>)> = Vec::new();
    let mut unread = Unread::new();
    let photos = progress.steps("photographs", context.len(), |bar| {
        let mut photos = Vec::with_capacity(context.len());
        for &i in context {
            bar.inc(1);
            let frame = &scene.frames[i];
            match frame.load_with(&options) {
                Ok(mut loaded) => {
                    warnings.push((frame.image.clone(), std::mem::take(&mut loaded.warnings)));
                    photos.push(Photo::from_loaded(loaded));
                }
                Err(error) => unread.push((i, error)),
            }
        }
        Ok::<_, anyhow::Error>(photos)
    })?;
    unread.sort_by_key(|(frame, _)| *frame);
    if unread.is_empty() && scene.source != SceneFormat::Photographs {
        let lines = warnings.iter().map(|(path, lines)| (path.as_path(), lines.as_slice()));
        grouped(lines).iter().for_each(print_warning);
    }
    Ok((photos, unread))
}

/// Options of the decoding; `force` accepts truncated files.
pub fn load_options(force: bool) -> LoadOptions {
    LoadOptions { truncated: if force { Truncated::Accept } else { Truncated::Refuse } }
}

/// Chooses the frames of the scene at `input`: those that `args` name, or a default.
fn choice(args: &SourceArgs, input: &Path, scene: &Scene) -> Result<Choice> {
    let (named, most) = (&args.context, args.photographs_max());
    let entry = |&i: &usize| scene.frames[i].entry.to_string();
    let list = |frames: &[usize]| frames.iter().map(entry).collect::<Vec<_>>().join(",");
    let default = |frames: Vec<usize>, reason: String| Choice { frames, reason, named: false };
    if !named.is_empty() {
        let chosen = frames::indices(scene, named, "--context")?;
        ensure!(
            chosen.len() >= 2,
            "--context: expected at least 2 photographs, got {}",
            chosen.len()
        );
        for (n, i) in chosen.iter().enumerate() {
            let name = &scene.frames[*i].name;
            ensure!(
                !chosen[..n].contains(i),
                "--context: expected different photographs, got {name} twice"
            );
        }
        let reason = format!("{}, as given", named.join(","));
        return Ok(Choice { frames: chosen, reason, named: true });
    }
    if scene.frames.len() == 2 {
        return Ok(default(vec![0, 1], "both".to_owned()));
    }
    if let Some(test) = frames::protocol(input, scene)?.into_iter().next()
        && test.context.len() >= 2
    {
        let reason = format!("{}, as protocol.json says", list(&test.context));
        return Ok(Choice { frames: test.context, reason, named: true });
    }
    let count = scene.frames.len();
    if scene.source == SceneFormat::Photographs && count <= most {
        return Ok(default((0..count).collect(), "all of them".to_owned()));
    }
    let Some(chosen) = choose_photographs(scene, most) else {
        bail!(
            "{}: expected two photographs taken from different places, got {} from one place",
            scene.name,
            scene.frames.len()
        )
    };
    let reason = if chosen.len() == count {
        "all of them".to_owned()
    } else {
        let from = format!("{} of them ({})", chosen.len(), list(&chosen));
        if chosen.len() < most {
            format!("{from}: the others show other places")
        } else {
            format!("{from}, which overlap; --context names others")
        }
    };
    Ok(default(chosen, reason))
}
