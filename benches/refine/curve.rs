//! `cargo bench --bench refine -- curve FOLDER… [--holdout K] [--refine N] [--csv FILE]…`: the score of new
//! views over the seconds of a refinement. Every K-th photograph of each folder (default 8) is held out; the
//! rest of the run and the scoring are not in the seconds.
//!
//! One line of CSV for each score: `program,scene,seconds,psnr`. Lines of other programs, read from `--csv`,
//! come first, so that one file has all curves of the same photographs.

use anyhow::{Context, Result, bail, ensure};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use subsplat::finish::PhaseRun;
use subsplat::reconstruct::inputs::crop::{CropOptions, Cropped};
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::render;
use subsplat::{Options, Photo, Reconstructor, Refine, Renderer, Size, Splats, load_scene};

/// Columns of the CSV files.
const HEADER: &str = "program,scene,seconds,psnr";
/// Scores of a curve, about, beside that of the start.
const SCORES: usize = 8;

/// Words after `curve`.
struct Args {
    folders: Vec<PathBuf>,
    holdout: usize,
    refine: Refine,
    others: Vec<PathBuf>,
}

impl Args {
    fn parse(words: &[String]) -> Result<Self> {
        let mut out =
            Self { folders: Vec::new(), holdout: 8, refine: Refine::Auto, others: Vec::new() };
        let mut words = words.iter();
        while let Some(word) = words.next() {
            let mut value = || words.next().with_context(|| format!("{word}: expected a value"));
            match word.as_str() {
                "--holdout" => out.holdout = value()?.parse().context("--holdout")?,
                "--refine" => out.refine = Refine::Steps(value()?.parse().context("--refine")?),
                "--csv" => out.others.push(value()?.into()),
                other if other.starts_with('-') => bail!("unknown option {other}"),
                folder => out.folders.push(folder.into()),
            }
        }
        ensure!(!out.folders.is_empty(), "curve: expected a folder of photographs with cameras");
        ensure!(out.holdout > 1, "--holdout: expected 2 or more, got {}", out.holdout);
        Ok(out)
    }
}

/// Prints the curves.
pub fn print(words: &[String]) -> Result<()> {
    let args = Args::parse(words)?;
    println!("{HEADER}");
    for path in &args.others {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let (header, lines) = text.split_once('\n').unwrap_or((&text, ""));
        let found = header.trim_end();
        ensure!(found == HEADER, "{}: expected the line {HEADER}, got {found}", path.display());
        print!("{lines}");
    }
    args.folders.iter().try_for_each(|folder| print_scene(folder, &args))
}

fn print_scene(folder: &Path, args: &Args) -> Result<()> {
    let scene = load_scene(folder)?;
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let photos = scene.frames.iter().map(Photo::from_frame).collect::<Result<Vec<_>, _>>()?;
    let (mut held, mut contexts) = (Vec::new(), Vec::new());
    for (i, photo) in photos.into_iter().enumerate() {
        let to = if i % args.holdout == args.holdout / 2 { &mut held } else { &mut contexts };
        to.push(photo);
    }
    ensure!(!held.is_empty() && contexts.len() > 1, "{name}: too few photographs");
    let model = Reconstructor::shipped(2)?;
    // Parents are refined as in a run with this refinement.
    let options = Options::default().with_refine(Refine::Off).with_parents(args.refine);
    let mut result = model.run(&contexts, &options)?;
    let Some(first) = result.inputs().first() else { bail!("{name}: no photograph") };
    let crop = CropOptions {
        target_size: Size::new(first.target.width, first.target.height),
        ..model.crop_options(Size::new(first.input.width, first.input.height))
    };
    let held = held.iter().map(|photo| photo.crop(&crop)).collect::<Result<Vec<_>, _>>()?;
    let raster = *result.raster_options();
    let score = |splats: &Splats| -> Result<f64> {
        let one = |view: &Cropped| {
            let picture = render(splats, &view.target_camera, &raster);
            let (width, height) = (view.target.width, view.target.height);
            psnr(&picture.rgb, &view.target.to_unit(), width, height)
        };
        let scores = held.iter().map(one).collect::<Result<Vec<_>, _>>()?;
        Ok(scores.iter().sum::<f64>() / scores.len() as f64)
    };
    let print = |seconds: f64, psnr: f64| println!("subsplat,{name},{seconds:.2},{psnr:.3}");
    print(0.0, score(result.splats())?);
    let steps = args.refine.options_for(contexts.len(), true).steps;
    let between = steps.div_ceil(SCORES).max(1);
    let (begun, mut scoring, mut failure) = (Instant::now(), Duration::ZERO, None);
    let mut scored = |phase: &PhaseRun<'_>| {
        if !phase.steps().is_multiple_of(between) && phase.steps() != steps {
            return ControlFlow::Continue(());
        }
        let now = Instant::now();
        let seconds = (now - begun).saturating_sub(scoring).as_secs_f64();
        match score(&phase.splats()) {
            Ok(score) => print(seconds, score),
            Err(e) => {
                failure = Some(e);
                return ControlFlow::Break(());
            }
        }
        scoring += now.elapsed();
        ControlFlow::Continue(())
    };
    let done = result.refine(args.refine, &mut Renderer::default(), &mut scored);
    if let Some(failure) = failure {
        return Err(failure);
    }
    done?;
    Ok(())
}
