//! The library's call with a progress bar and lines for the user: for `run` and `view`.

use super::args::{CropShapeArg, DetailArg, QualityArg, SourceArgs};
use super::memory::{self, Planned};
use crate::pages;
use crate::report::{Progress, print_line, print_warning, show_fraction};
use anyhow::{Result, ensure};
use serde_json::{Value, json};
use std::borrow::Borrow;
use subsplat::cameras::check::{PairReport, Verdict};
use subsplat::files::scene::Scene;
use subsplat::finish::FitReport;
use subsplat::network::config::Config;
use subsplat::network::model::trunk::UPSCALE_MAX;
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::finish::RefineReport;
use subsplat::{
    Check, DepthBounds, DepthRange, Detail, FitOptions, InputSize, Options, Photo, Poses, Prepared,
    Reconstruction, Reconstructor, TargetSize,
};
use subsplat_kernels::camera::Size;

/// The library's options of the arguments, for photographs of frames `context`.
///
/// # Errors
/// An input size or a depth range out of range; cameras at one place where a guess from their
/// distance is necessary.
pub fn options(args: &SourceArgs, scene: &Scene, context: &[usize]) -> Result<Options> {
    let check = if args.no_check { Check::Off } else { Check::Warn };
    let poses = if args.adjust_poses { Poses::Adjusted } else { Poses::Given };
    let detail = match args.detail {
        DetailArg::Photo => Detail::Photographs,
        DetailArg::Off => Detail::Off,
    };
    let options = Options::default()
        .with_depth_range(DepthRange::from_ends(args.near, args.far))
        .with_depth_prior(DepthBounds::of_scene(scene, context)?)
        .with_check(check)
        .with_detail(detail)
        .with_fit(FitOptions::default().with_steps(args.fit))
        .with_poses(poses)
        .with_density(args.gaussians)
        .with_refine(args.refine);
    let cameras: Vec<_> = context.iter().map(|&i| scene.frames[i].camera).collect();
    options.initial_depth_range(&cameras)?;
    Ok(options)
}

/// Chooses the size of the network's input for frames `context` and pictures of size `target`:
/// `--quality`, else `--input-size`. Returns the width and height that it gives, px, too.
///
/// # Errors
/// A size that is too small for the network or too large for the memory.
pub fn input_size(
    args: &SourceArgs,
    target: TargetSize,
    model: &Reconstructor,
    scene: &Scene,
    context: &[usize],
) -> Result<(InputSize, (usize, usize))> {
    let size = |&i: &usize| {
        let k = scene.frames[i].camera.intrinsics();
        Size::new(k.width, k.height)
    };
    let photos: Vec<Size> = match target {
        TargetSize::Exact(size) => vec![size],
        _ => context.iter().map(size).collect(),
    };
    let config = model.config();
    let (views, density) = (context.len(), args.gaussians);
    let ample = |size: Size| {
        memory::is_ample(&Planned { config, views, input: (size.width, size.height), density })
    };
    let chosen = match args.quality {
        Some(quality) => quality_size(quality, args.crop, &photos, config, ample),
        None => args.input_size(),
    };
    let Size { width: w, height: h } = chosen.resolve(&photos, config.stride());
    let stride = config.stride();
    // An area below one cell of the stride gives one cell; the user asked for less.
    let asked = match chosen {
        InputSize::Area(area) => (area.isqrt(), area.isqrt()),
        _ => (w, h),
    };
    ensure!(
        asked.0 >= stride && asked.1 >= stride,
        "--input-size: expected at least {stride} pixels a side, got {}x{}",
        asked.0,
        asked.1
    );
    Ok((chosen, (w, h)))
}

/// Returns the model with as many children as pictures of size `target` need, for an input of
/// `input` px, and checks the memory of a run with `views` photographs. `--upscale`, and weights
/// for one number of children, leave the model as it is.
///
/// # Errors
/// More memory than there is.
pub fn with_children(
    args: &SourceArgs,
    target: TargetSize,
    model: Reconstructor,
    views: usize,
    input: (usize, usize),
) -> Result<Reconstructor> {
    let any = model.config().spgr.head.serves_any_k() && args.upscale.is_none();
    let model = match target {
        TargetSize::Exact(size) if any => {
            let ratio = size.width.div_ceil(input.0).max(size.height.div_ceil(input.1));
            model.with_upscale(ratio.clamp(1, UPSCALE_MAX))?
        }
        _ => model,
    };
    let (config, density) = (model.config(), args.gaussians);
    memory::check_run(&Planned { config, views, input, density })?;
    Ok(model)
}

/// The size of `quality` for photographs of the sizes `photos`. `High` is limited by the
/// photographs, whose pixels a target need not exceed, and by the memory.
fn quality_size(
    quality: QualityArg,
    crop: CropShapeArg,
    photos: &[Size],
    config: &Config,
    ample: impl Fn(Size) -> bool,
) -> InputSize {
    let of_area = |area: usize| match crop {
        CropShapeArg::Whole => InputSize::Area(area),
        CropShapeArg::Square => InputSize::exact(area.isqrt(), area.isqrt()),
    };
    let normal = QualityArg::Normal.area();
    if quality != QualityArg::High {
        return of_area(quality.area());
    }
    let pixels = |photo: &Size| match crop {
        CropShapeArg::Whole => photo.width * photo.height,
        CropShapeArg::Square => photo.width.min(photo.height).pow(2),
    };
    let photo = photos.iter().map(pixels).min().unwrap_or(0) / config.children();
    let mut area = quality.area().min(photo).max(normal);
    while area > normal && !ample(of_area(area).resolve(photos, config.stride())) {
        area = (area / 2).max(normal);
    }
    of_area(area)
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
        bar.suspend(|| print_prepared(&prepared, options.poses));
        let printed = prepared.warnings().len();
        let result = prepared.reconstruct_with(&mut show)?;
        bar.suspend(|| print_reconstruction(&result, printed));
        Ok(result)
    })?;
    progress.split_last(result.stage_times());
    Ok(result)
}

fn print_prepared(prepared: &Prepared<'_>, poses: Poses) {
    print_line(crop_line(prepared.inputs(), prepared.cut_shares()));
    match prepared.pose_adjustment() {
        Some(a) => print_line(format!(
            "the poses were adjusted by {} points, the largest change of a rotation is {:.2} degrees; \
             the points' median error was {:.2} px and is {:.2} px",
            a.points, a.turned_deg, a.before_px, a.after_px
        )),
        None if poses == Poses::Adjusted => {
            print_line("the poses stay: they fit the photographs, or too few points are matched");
        }
        None => {}
    }
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
    if let Some(refinement) = result.refinement() {
        let RefineReport { steps, before, after, removed, .. } = refinement;
        let removed = match removed {
            0 => String::new(),
            n => format!("; {n} Gaussians that the photographs hardly show were removed"),
        };
        print_line(format!(
            "{steps} steps of refinement changed the error of photographs drawn from the others' \
             Gaussians from {before:.5} to {after:.5} (--refine off: none){removed}"
        ));
    }
}

/// Describes the network's input and what the crop leaves out of the photographs.
fn crop_line(inputs: &[Cropped], cut_shares: &[f32]) -> String {
    let (w, h) = inputs.first().map_or((0, 0), |c| (c.input.width, c.input.height));
    let percent = |share: f32| format!("{:.0} %", 100.0 * share);
    let most = cut_shares.iter().copied().fold(0.0f32, f32::max);
    let least = cut_shares.iter().copied().fold(most, f32::min);
    let cut = match (percent(least), percent(most)) {
        _ if most < 0.005 => "the whole photographs".to_owned(),
        (least, most) if least == most => format!("{most} of each photograph is cut at its edges"),
        (least, most) => {
            format!(
                "the photographs differ in shape: {least} to {most} of each is cut at its edges"
            )
        }
    };
    format!("input {w}x{h}: {cut}")
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

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;
    use subsplat::files::image::Rgb;
    use subsplat::reconstruct::inputs::crop::{CropOptions, crop};
    use subsplat_kernels::camera::{Camera, Intrinsics};

    #[test]
    fn high_quality_is_limited_by_photographs_and_memory() {
        let config = Config::small(subsplat::network::config::Preset::Tuned, 2);
        let size = |quality, crop, (width, height): (usize, usize), ample: bool| {
            let photos = [Size { width, height }; 2];
            let chosen = quality_size(quality, crop, &photos, &config, |_| ample);
            let size = chosen.resolve(&photos, 32);
            (size.width, size.height)
        };
        use CropShapeArg::{Square, Whole};
        use QualityArg::{Fast, High, Normal};
        assert_eq!(size(Fast, Whole, (4000, 4000), true), (192, 192));
        assert_eq!(size(Normal, Whole, (4000, 4000), true), (256, 256));
        assert_eq!(size(High, Whole, (4000, 4000), true), (512, 512));
        assert_eq!(size(High, Whole, (4000, 4000), false), (256, 256));
        assert_eq!(size(High, Whole, (800, 800), true), (416, 416));
        assert_eq!(size(High, Whole, (300, 300), true), (256, 256));
        assert_eq!(size(High, Square, (4000, 800), true), (400, 400));
    }

    #[test]
    fn the_line_says_what_is_cut() {
        let camera = Camera::new(Intrinsics::from_fov_x(1.0, 64, 48), Mat4::IDENTITY).unwrap();
        let inputs = [crop(&Rgb::black(64, 48), &camera, &CropOptions::square(32, 1, 32)).unwrap()];
        for (shares, expected) in [
            ([0.0, 0.004], "input 32x32: the whole photographs"),
            ([0.25, 0.25], "input 32x32: 25 % of each photograph is cut at its edges"),
            (
                [0.1, 0.33],
                "input 32x32: the photographs differ in shape: 10 % to 33 % of each is cut at its \
                 edges",
            ),
        ] {
            assert_eq!(crop_line(&inputs, &shares), expected);
        }
    }
}
