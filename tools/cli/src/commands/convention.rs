//! Cameras of a pose file that contradict its photographs: matrices that fit them in another convention than the format's,
//! and other sources of cameras that fit them.

use super::args::PoseConventionArg;
use anyhow::Result;
use clap::ValueEnum;
use std::path::{Path, PathBuf};
use subsplat::cameras::check::{CheckOptions, GrayImage, PairReport, Verdict, check_pair};
use subsplat::files::photos::image::LoadOptions;
use subsplat::files::poses::matrices::PoseConvention;
use subsplat::files::poses::reading::SceneOptions;
use subsplat::files::poses::scene::{Scene, load_scene_with};

/// Half the resolution of `subsplat check`: turned axes miss the points by many pixels.
const OPTIONS: CheckOptions = CheckOptions { longest_side: 480, features: 1200, seed: 1 };

/// Returns the scene at `path` in the one convention, else from the first other source of cameras, that fits the points
/// which two photographs share, where the cameras of `scene` contradict them; else `scene`. A warning of the returned
/// scene says so. Conventions are tried where `may_turn`: the format has matrices.
///
/// A pair at the beginning and one in the middle decide. Where the first one does not contradict, no other is looked at,
/// so that an ordinary scene costs the check of two small pictures.
///
/// # Errors
/// The pose file cannot be read again.
pub fn fitting(path: &Path, scene: Scene, options: &SceneOptions, may_turn: bool) -> Result<Scene> {
    let count = scene.frames.len();
    // Neighbours in a video are too close together to contradict.
    let apart = (count / 5).clamp(1, 3);
    let firsts = if count < 4 { vec![0] } else { vec![0, count / 2] };
    let mut pairs = Vec::with_capacity(firsts.len());
    for first in firsts {
        // A photograph that is missing or broken is an error of the commands that need it.
        let frames = [first, (first + apart).min(count.saturating_sub(1))];
        let Some(pair) = Pair::load(&scene, frames) else { return Ok(scene) };
        if !pair.contradicts(&scene) {
            return Ok(scene);
        }
        pairs.push(pair);
    }
    let (at, format) = (path.display(), scene.source.name());
    if may_turn && let Some((mut other, name)) = turned(path, count, &pairs, options)? {
        other.warnings.push(format!(
            "{at}: the photographs contradict its cameras in the convention of {format} files, and fit them as {name}, \
             so they are read as {name} (--pose-convention names another one)"
        ));
        return Ok(other);
    }
    for name in &scene.other_sources {
        let options = SceneOptions { model: Some(name.into()), ..options.clone() };
        // One that cannot be read is no better.
        let Ok(mut other) = load_scene_with(path, &options) else { continue };
        if pairs.iter().all(|pair| pair.fits(&other)) {
            other.warnings.push(format!(
                "{at}: the photographs contradict the cameras of {format}, and fit those of {name}, which are read \
                 instead (--model names another source)"
            ));
            return Ok(other);
        }
    }
    Ok(scene)
}

/// The scene in the one convention that fits all `pairs`, and the convention's name.
///
/// # Errors
/// The pose file cannot be read again.
fn turned(
    path: &Path,
    count: usize,
    pairs: &[Pair],
    options: &SceneOptions,
) -> Result<Option<(Scene, String)>> {
    let mut fitting = Vec::new();
    for convention in PoseConventionArg::value_variants() {
        let read = PoseConvention::from(*convention);
        let options = SceneOptions { convention: Some(read), ..options.clone() };
        let other = load_scene_with(path, &options)?;
        if other.frames.len() == count && pairs.iter().all(|pair| pair.fits(&other)) {
            fitting.push((convention.to_possible_value(), other));
        }
    }
    let one = <[_; 1]>::try_from(fitting).ok();
    Ok(one.and_then(|[(name, other)]| Some((other, name?.get_name().to_owned()))))
}

/// Two photographs of a scene, grey.
struct Pair {
    files: [PathBuf; 2],
    images: [GrayImage; 2],
}

impl Pair {
    /// The photographs of two frames. `None` where they are one frame, or one cannot be loaded.
    fn load(scene: &Scene, frames: [usize; 2]) -> Option<Self> {
        let grey = |i: usize| {
            let frame = scene.frames.get(i).filter(|frame| frame.cut.is_none())?;
            let loaded = frame.load_with(&LoadOptions::default()).ok()?;
            GrayImage::from_picture(&loaded.picture, loaded.mask.as_ref())
        };
        let [i, j] = frames;
        let (a, b) = if i == j { (None, None) } else { rayon::join(|| grey(i), || grey(j)) };
        let files = frames.map(|i| scene.frames[i].image.clone());
        Some(Self { files, images: [a?, b?] })
    }

    /// Check of the cameras of `scene`. `None` where it lacks one of them, or a lens distortion cannot be removed.
    fn report(&self, scene: &Scene) -> Option<PairReport> {
        let camera =
            |file: &PathBuf| scene.frames.iter().find(|frame| frame.image == *file)?.pinhole().ok();
        let [a, b] = self.files.each_ref().map(camera);
        let [image_a, image_b] = &self.images;
        Some(check_pair(image_a, &a?, image_b, &b?, &OPTIONS))
    }

    /// Enough points are matched, and the cameras are wrong.
    fn contradicts(&self, scene: &Scene) -> bool {
        self.report(scene).is_some_and(|report| report.has("poses_wrong"))
    }

    /// Enough points are matched, and the cameras are not wrong.
    fn fits(&self, scene: &Scene) -> bool {
        self.report(scene)
            .is_some_and(|report| report.epipolar.is_some() && report.verdict != Verdict::Bad)
    }
}
