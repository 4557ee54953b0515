//! Source of the splats in the window: a finished scene, or photographs, which can be
//! reconstructed again with another number of children.

use crate::commands::args::view::ViewArgs;
use crate::commands::frames::DepthSpread;
use crate::commands::inputs::{self, Inputs};
use crate::commands::memory::{self, Planned};
use crate::commands::reconstruct::{self, reconstruct};
use crate::commands::{model, pair, render, run, whole};
use crate::report::{Progress, print_line, print_warning};
use anyhow::{Context, Result, bail, ensure};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use subsplat::files::is_splat_file;
use subsplat::files::poses::find::is_own_output;
use subsplat::finish::PhaseRun;
use subsplat::scene::navigation::{Start, up_of};
use subsplat::scene::render::{camera_of_comments, origin_of_comments};
use subsplat::scene::splats::Splats;
use subsplat::{
    Check, Options, Photo, Reconstruction, Reconstructor, Refine, Renderer, Stage, TargetSize,
};
use subsplat_kernels::layout::RasterOptions;

/// Least time between two pictures of a refinement.
const SHOWN_EVERY: Duration = Duration::from_millis(400);
/// Highest SH degree of a finished scene.
const SH_DEGREE: usize = 4;

/// Splats with the rules to render them.
pub struct Made {
    pub splats: Splats,
    pub options: RasterOptions,
    /// r of r×r children per pixel; `None` for a finished scene.
    pub upscale: Option<usize>,
}

/// The initial content of a window.
pub struct Source {
    /// Used in the title and in names of pictures.
    pub name: String,
    pub start: Start,
    pub made: Made,
    /// `None` for a finished scene.
    pub photographs: Option<Photographs>,
}

/// Photographs and options, for further reconstructions.
pub struct Photographs {
    args: ViewArgs,
    photos: Vec<Photo>,
    options: Options,
    /// Width and height of the network's input, px.
    input_size: (usize, usize),
    /// The refinement that goes on while the window shows the scene.
    refine: Refine,
    /// The first reconstruction, until it is refined.
    first: Mutex<Option<Unrefined>>,
}

/// A reconstruction with the rules to render it and its r.
struct Unrefined {
    result: Reconstruction,
    options: RasterOptions,
    upscale: usize,
}

/// Loads or reconstructs the scene of the arguments.
pub fn open(args: &ViewArgs, progress: &mut Progress) -> Result<Source> {
    match args.input.as_slice() {
        [one] if is_scene(one) => finished(args, &render::scene_file(one)?, progress),
        _ => photographs(args, progress),
    }
}

/// Returns whether `path` is a scene file, or a folder that `run` or a training wrote.
fn is_scene(path: &Path) -> bool {
    is_splat_file(path) || is_own_output(path) || render::is_training(path)
}

/// Rejects flags for photographs where the scene is finished.
pub fn check(args: &ViewArgs) -> Result<()> {
    if let ([one], Some(flag)) = (args.input.as_slice(), args.photograph_flag())
        && is_scene(one)
    {
        bail!("{flag}: only with photographs; {} is a finished scene", one.display());
    }
    Ok(())
}

fn finished(args: &ViewArgs, path: &Path, progress: &mut Progress) -> Result<Source> {
    let (splats, comments) =
        progress.stage("scene", |_| render::load(path, args.source.pair.read.strict))?;
    let options =
        render::options(&args.rendering(), args.source.near, SH_DEGREE, &splats, &comments)?;
    let origin = origin_of_comments(&comments);
    let read = args.source.pair.read.options(None);
    let beside = render::cameras_beside(args.cameras.as_deref(), path, origin, &read)?;
    let cameras = match beside {
        Some(cameras) => cameras,
        None => {
            let own = camera_of_comments(&comments);
            vec![(String::new(), own.map_or_else(|| whole::camera(&splats, &comments), Ok)?)]
        }
    };
    // `cameras_beside` refuses a file without any.
    let (_, home) = cameras.first().context("no camera")?;
    let start = Start {
        home: *home,
        up: up_of(cameras.iter().map(|(_, c)| c)),
        distance: render::depths(&splats, home).middle,
        radius: whole::bounds(&splats)?.radius(),
    };
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let made = Made { splats, options, upscale: None };
    Ok(Source { name, start, made, photographs: None })
}

fn photographs(args: &ViewArgs, progress: &mut Progress) -> Result<Source> {
    ensure!(args.cameras.is_none(), "--cameras: only with a finished scene");
    let wanted = [("--context", args.source.context.as_slice())];
    let pair::Loaded { mut scene, .. } =
        progress.stage("scene", |bar| pair::load(&args.input, &args.source.pair, &wanted, bar))?;
    scene.warnings.iter().for_each(print_warning);
    let first = args.input.first().context("no input")?;
    let Inputs { context, reason, photos } =
        inputs::choose(&args.source, first, &mut scene, progress)?;
    print_line(format!(
        "{}: {} photographs; the scene is made from {reason}",
        scene.name,
        scene.frames.len()
    ));
    let mut options = reconstruct::options(&args.source, &scene, &context)?;
    let model = progress.stage("model", |_| load_model(args, args.source.children_side()))?;
    let (source, target) = (&args.source, args.source.target_size());
    let (size, sides) = reconstruct::input_size(source, target, &model, &scene, &context)?;
    let model = reconstruct::with_children(source, target, model, context.len(), sides)?;
    (options.input_size, options.target_size) = (size, target);
    // The window shows the scene while it is refined. A fixed number of frames shows the result.
    options.parents = Some(options.refine);
    let refine = match args.frames {
        None => std::mem::replace(&mut options.refine, Refine::Off),
        Some(_) => Refine::Off,
    };
    let result = reconstruct(&model, photos.as_slice(), &options, progress, &mut |_| Ok(()))?;
    // Later calls use the depth range of this check.
    let prior = result.initial_depth_range().clone();
    let options = options.with_depth_prior(prior).with_check(Check::Off);
    let cameras: Vec<_> = scene.frames.iter().map(|f| f.camera).collect();
    let (Some(input), Some(depth)) = (result.inputs().first(), result.depths().first()) else {
        bail!("{}: expected photographs, got none", scene.name)
    };
    let start = Start {
        home: input.target_camera,
        up: up_of(cameras.iter()),
        distance: DepthSpread::of(depth.data.iter().copied()).middle,
        radius: whole::bounds(result.splats())?.radius(),
    };
    let photographs = Photographs {
        args: args.clone(),
        photos,
        options,
        input_size: sides,
        refine,
        first: Mutex::default(),
    };
    let first = photographs.unrefined(&model, result);
    let made = first.made(first.result.splats().clone());
    if refine != Refine::Off {
        *photographs.first() = Some(first);
    }
    Ok(Source { name: scene.name, start, made, photographs: Some(photographs) })
}

fn load_model(args: &ViewArgs, upscale: Option<usize>) -> Result<Reconstructor> {
    let source = model::ModelRequest::from_source(&args.source);
    model::load(&model::ModelRequest { upscale, ..source })
}

impl Photographs {
    /// Returns whether the first reconstruction waits for its refinement.
    pub fn is_unrefined(&self) -> bool {
        self.first().is_some()
    }

    /// Reconstructs the same scene with r×r children per pixel, and refines it. The first
    /// reconstruction is refined only. `begin` receives the name of each stage, and `show` the
    /// splats, again and again until they are refined.
    pub fn make(
        &self,
        upscale: usize,
        begin: &mut dyn FnMut(&'static str),
        show: &mut dyn FnMut(Made) -> Result<()>,
    ) -> Result<()> {
        let first = self.first().take();
        let made = match first.filter(|f| f.upscale == upscale) {
            Some(first) => first,
            None => {
                begin("reading the network");
                let model = load_model(&self.args, Some(upscale))?;
                memory::check_run(&Planned {
                    config: model.config(),
                    views: self.photos.len(),
                    input: self.input_size,
                    density: self.options.density,
                })?;
                let mut progress = |progress: subsplat::Progress| {
                    begin(progress.stage.description());
                    ControlFlow::Continue(())
                };
                // The sizes of --upscale are those of the first scene.
                let options = self.options.clone().with_target_size(TargetSize::Upscaled);
                let result = model.run_with(&self.photos, &options, &mut progress)?;
                let made = self.unrefined(&model, result);
                show(made.made(made.result.splats().clone()))?;
                made
            }
        };
        if self.refine == Refine::Off {
            return Ok(());
        }
        begin(Stage::Refine.description());
        made.refine(self.refine, show)
    }

    /// The first reconstruction. A thread that panicked leaves it usable.
    fn first(&self) -> MutexGuard<'_, Option<Unrefined>> {
        self.first.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn unrefined(&self, model: &Reconstructor, result: Reconstruction) -> Unrefined {
        let config = model.config();
        let options = run::raster_options(&self.args.rendering(), config, &result);
        Unrefined { result, options, upscale: config.upscale }
    }
}

impl Unrefined {
    /// `splats` with the rules of this scene.
    fn made(&self, splats: Splats) -> Made {
        Made { splats, options: self.options, upscale: Some(self.upscale) }
    }

    fn refine(mut self, refine: Refine, show: &mut dyn FnMut(Made) -> Result<()>) -> Result<()> {
        let options = self.options;
        let upscale = Some(self.upscale);
        let (mut shown, mut failure) = (Instant::now(), None);
        let mut progress = |phase: &PhaseRun<'_>| {
            if shown.elapsed() >= SHOWN_EVERY {
                failure = show(Made { splats: phase.splats(), options, upscale }).err();
                shown = Instant::now();
            }
            match failure {
                Some(_) => ControlFlow::Break(()),
                None => ControlFlow::Continue(()),
            }
        };
        let refined = self.result.refine(refine, &mut Renderer::default(), &mut progress);
        if let Some(failure) = failure {
            return Err(failure);
        }
        refined?;
        let splats = self.result.splats().clone();
        show(self.made(splats))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use subsplat_test_support::repository;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        view: ViewArgs,
    }

    /// The scene as the window opens it and as the background thread shows it.
    fn shown(flags: &[&str]) -> (Source, Vec<Splats>) {
        let room = repository().join("examples/room");
        let line = ["view", room.to_str().unwrap(), "--input-size", "64"];
        let args = Line::parse_from(line.iter().chain(flags)).view;
        let source = open(&args, &mut Progress::new()).unwrap();
        let photographs = source.photographs.as_ref().unwrap();
        let (mut all, mut stages) = (Vec::new(), Vec::new());
        if photographs.is_unrefined() {
            let mut show = |made: Made| {
                all.push(made.splats);
                Ok(())
            };
            photographs.make(2, &mut |stage| stages.push(stage), &mut show).unwrap();
            assert_eq!(stages, [Stage::Refine.description()]);
        }
        (source, all)
    }

    #[test]
    fn the_first_scene_is_refined_while_it_is_shown() {
        let (source, shown_splats) = shown(&["--refine", "4"]);
        let last = shown_splats.last().unwrap();
        assert!(last.len() == source.made.splats.len() && *last != source.made.splats);
        // A fixed number of frames begins with the refined scene.
        let (fixed, none) = shown(&["--refine", "4", "--frames", "1"]);
        assert!(none.is_empty() && fixed.made.splats == *last);
        let (_, none) = shown(&["--refine", "off"]);
        assert!(none.is_empty());
    }

    #[test]
    fn a_window_that_cannot_show_ends_the_refinement() {
        let room = repository().join("examples/room");
        let line = ["view", room.to_str().unwrap(), "--input-size", "64", "--refine", "2"];
        let source = open(&Line::parse_from(line).view, &mut Progress::new()).unwrap();
        let mut show = |_: Made| bail!("no memory");
        let photographs = source.photographs.unwrap();
        let error = photographs.make(2, &mut |_| {}, &mut show).unwrap_err();
        assert_eq!(error.to_string(), "no memory");
    }
}
