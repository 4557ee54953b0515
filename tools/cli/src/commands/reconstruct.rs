//! The library's call with a progress bar and lines for the user: for `run` and `view`.

use super::args::{DetailArg, SourceArgs};
use super::frames;
use crate::pages;
use crate::report::{Progress, print_line, print_warning, show_fraction};
use anyhow::Result;
use serde_json::{Value, json};
use std::borrow::Borrow;
use subsplat::check::{PairReport, Verdict};
use subsplat::io::scene::Scene;
use subsplat::{
    Check, DepthBounds, DepthRange, Detail, FitOptions, FitReport, Options, Photo, Prepared,
    Reconstruction, Reconstructor,
};

/// The library's options of the arguments, for photographs of frames `context`.
///
/// # Errors
/// An input size or a depth range out of range; cameras at one place where a guess from their
/// distance is necessary.
pub fn options(args: &SourceArgs, scene: &Scene, context: &[usize]) -> Result<Options> {
    let (width, height) = frames::size(&args.input_size)?;
    let check = if args.no_check { Check::Off } else { Check::Warn };
    let detail = match args.detail {
        DetailArg::Photo => Detail::Photographs,
        DetailArg::Off => Detail::Off,
    };
    let options = Options::default()
        .with_input_size(width, height)
        .with_depth_range(DepthRange::from_ends(args.near, args.far))
        .with_depth_prior(DepthBounds::of_scene(scene, context)?)
        .with_check(check)
        .with_detail(detail)
        .with_fit(FitOptions::default().with_steps(args.fit));
    let cameras: Vec<_> = context.iter().map(|&i| scene.frames[i].camera).collect();
    options.initial_depth_range(&cameras)?;
    Ok(options)
}

/// Reconstructs `photos` under a progress bar, and prints warnings and depth ranges. Photographs
/// that are passed by value are freed before the network runs.
pub fn reconstruct(
    model: &Reconstructor,
    photos: impl Borrow<[Photo]>,
    options: &Options,
    progress: &mut Progress,
) -> Result<Reconstruction> {
    let result = progress.fraction("reconstruction", |bar| -> Result<_> {
        let mut show = |progress| show_fraction(bar, progress);
        let prepared = model.prepare_with(photos.borrow(), options, &mut show)?;
        drop(photos);
        pages::trim_small_blocks();
        bar.suspend(|| print_prepared(&prepared));
        let printed = prepared.warnings().len();
        let result = prepared.reconstruct_with(&mut show)?;
        bar.suspend(|| print_reconstruction(&result, printed));
        Ok(result)
    })?;
    progress.split_last(result.stage_times());
    Ok(result)
}

fn print_prepared(prepared: &Prepared<'_>) {
    prepared.warnings().iter().for_each(print_warning);
    if prepared.reports().iter().any(|r| r.verdict == Verdict::Bad) {
        print_warning("these poses look wrong, and so will the result; `subsplat check` says more");
    }
    print_depth_range(prepared.depth_range());
}

/// Prints the network's depth range where it estimated one, and the warnings after the first
/// `printed` ones.
fn print_reconstruction(result: &Reconstruction, printed: usize) {
    if result.depth_range() != result.initial_depth_range() {
        print_depth_range(result.depth_range());
    }
    result.warnings().iter().skip(printed).for_each(print_warning);
    if result.detail() == Detail::Photographs {
        print_line("the photographs add detail to colours (--detail off: the network alone)");
    }
    if let Some(fit) = result.fit() {
        let FitReport { before, after, .. } = fit;
        print_line(format!(
            "the fit to the photographs changed their loss from {before:.5} to {after:.5} (--fit 0: \
             the network's Gaussians)"
        ));
    }
}

fn print_depth_range(bounds: &DepthBounds) {
    let DepthBounds { near, far, source } = bounds;
    print_line(format!("near {near:.4}, far {far:.4}: {source}"));
}

/// Formats the reports of the check as JSON.
pub fn report(reports: &[PairReport]) -> Vec<Value> {
    let one = |r: &PairReport| {
        json!({
            "verdict": r.verdict,
            "matches": r.matches,
            "median_epipolar_px": r.epipolar.and_then(|e| e.median_px),
            "findings": r.findings,
        })
    };
    reports.iter().map(one).collect()
}
