//! The library's call with a progress bar and lines for the user: for `run` and `view`.

use super::args::{CropShapeArg, DetailArg, MatchingArg, SourceArgs, SurroundingsArg};
use super::memory::{self, Planned};
use crate::interrupt::Interrupt;
use crate::pages;
use crate::report::{Progress, print_line, print_warning, show_fraction};
use anyhow::{Result, ensure};
use serde_json::{Value, json};
use std::borrow::Borrow;
use std::cell::LazyCell;
use subsplat::cameras::check::{PairReport, Verdict};
use subsplat::files::poses::scene::Scene;
use subsplat::finish::RefineReport;
use subsplat::finish::{FitOptions, FitReport};
use subsplat::network::config::Config;
use subsplat::network::model::trunk::UPSCALE_MAX;
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::{
    Check, DepthBounds, DepthRange, Detail, InputSize, Matching, Options, Photo, Poses, Prepared,
    Quality, Reconstruction, Reconstructor, SceneSoFar, Surroundings, TargetSize, Warning,
};
use subsplat_kernels::camera::Size;

/// The library's options of the arguments, for photographs of frames `context`.
///
/// # Errors
/// An input size or a depth range out of range; cameras at one place where a guess from their
/// distance is necessary.
pub fn options(args: &SourceArgs, scene: &Scene, context: &[usize]) -> Result<Options> {
    let check = if args.no_check { Check::Off } else { Check::Warn };
    let matching = match args.matching {
        MatchingArg::Photo => Matching::Photographs,
        MatchingArg::Off => Matching::Off,
    };
    let surroundings = match args.surroundings {
        SurroundingsArg::Photo => Surroundings::Photographs,
        SurroundingsArg::Off => Surroundings::Off,
    };
    let detail = match args.detail {
        DetailArg::Photo => Detail::Photographs,
        DetailArg::Off => Detail::Off,
    };
    let mut options = Options::default()
        .with_quality(Quality::from(args.quality))
        .with_density(args.density())
        .with_depth_range(DepthRange::from_ends(args.near, args.far))
        .with_depth_prior(DepthBounds::of_scene(scene, context)?)
        .with_check(check)
        .with_matching(matching)
        .with_surroundings(surroundings)
        .with_detail(detail)
        .with_poses(args.adjust_poses.into());
    options.fit = args.fit.map(|steps| FitOptions::default().with_steps(steps));
    options.refine = args.refine.unwrap_or(options.refine);
    let cameras: Vec<_> = context.iter().map(|&i| scene.frames[i].camera).collect();
    options.initial_depth_range(&cameras)?;
    Ok(options)
}

/// Chooses the size of the network's input for frames `context` and pictures of size `target`:
/// `--input-size`, else that of `--quality`. Returns the width and height that it gives, px, too.
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
    let photos = match target {
        TargetSize::Exact(size) => vec![size],
        _ => photo_sizes(scene, context),
    };
    let config = model.config();
    let (views, density) = (context.len(), args.density());
    let ample = |size: Size| {
        memory::is_ample(&Planned { config, views, input: (size.width, size.height), density })
    };
    let chosen = match args.input_size() {
        InputSize::Exact { width, height, .. } => InputSize::exact(width, height),
        size => size_within(size, args.crop, &photos, config, ample),
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

/// Sizes of the photographs of frames `context`, px.
pub fn photo_sizes(scene: &Scene, context: &[usize]) -> Vec<Size> {
    let size = |&i: &usize| {
        let k = scene.frames[i].camera.intrinsics();
        Size::new(k.width, k.height)
    };
    context.iter().map(size).collect()
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
    let (config, density) = (model.config(), args.density());
    memory::check_run(&Planned { config, views, input, density })?;
    Ok(model)
}

/// The size for photographs of the sizes `photos`: an area, in the shape that `crop` says. What
/// [`InputSize::AtMost`] allows is limited by the photographs and by the memory.
fn size_within(
    size: InputSize,
    crop: CropShapeArg,
    photos: &[Size],
    config: &Config,
    ample: impl Fn(Size) -> bool,
) -> InputSize {
    let of_area = |area: usize| match crop {
        CropShapeArg::Whole => InputSize::Area(area),
        CropShapeArg::Square => InputSize::exact(area.isqrt(), area.isqrt()),
    };
    let may_shrink = matches!(size, InputSize::AtMost(_));
    let used = |photo: &Size| match crop {
        CropShapeArg::Whole => *photo,
        CropShapeArg::Square => {
            let side = photo.width.min(photo.height);
            Size::new(side, side)
        }
    };
    let used: Vec<Size> = photos.iter().map(used).collect();
    let InputSize::Area(mut area) = size.limited_to(&used, config.upscale) else { return size };
    let InputSize::Area(normal) = InputSize::default() else { return size };
    let fits = |area: usize| ample(of_area(area).resolve(photos, config.stride()));
    while may_shrink && area > normal && !fits(area) {
        area = (area / 2).max(normal);
    }
    of_area(area)
}

/// Reconstructs `photos` under a progress bar, and prints warnings and depth ranges. Photographs
/// that are passed by value are freed before the network runs. Ctrl-C during a refinement ends it and keeps the scene
/// so far. `watch` receives the scene after each step of a refinement, unless its cameras were adjusted: those of other
/// photographs do not belong to them.
///
/// # Errors
/// Those of the library and of `watch`.
pub fn reconstruct(
    model: &Reconstructor,
    photos: impl Borrow<[Photo]>,
    options: &Options,
    progress: &mut Progress,
    watch: &mut dyn FnMut(&SceneSoFar<'_>) -> Result<()>,
) -> Result<Reconstruction> {
    let result = progress.fraction("reconstruction", |bar| -> Result<_> {
        let mut show = |progress| show_fraction(bar, progress);
        let prepared = model.prepare_with(photos.borrow(), options, &mut show)?;
        drop(photos);
        pages::trim();
        bar.suspend(|| print_prepared(&prepared, options.poses));
        let printed = prepared.warnings().len();
        let adjusted = prepared.pose_adjustment().is_some();
        // From the first step on.
        let interrupt = LazyCell::new(Interrupt::watch);
        let mut failure = None;
        let result = prepared.reconstruct_showing(&mut show, &mut |scene| {
            let is_noted = interrupt.is_noted();
            if !adjusted && let Err(e) = watch(scene) {
                failure = Some(e);
            }
            if failure.is_some() || is_noted {
                scene.end();
            }
        })?;
        if let Some(e) = failure {
            return Err(e);
        }
        pages::trim();
        bar.suspend(|| {
            print_reconstruction(&result, printed);
            if interrupt.is_noted() {
                print_line("Ctrl-C ended the refinement; the scene is what its steps gave so far");
            }
        });
        Ok(result)
    })?;
    progress.split_last(result.stage_times());
    Ok(result)
}

fn print_prepared(prepared: &Prepared<'_>, poses: Poses) {
    print_line(crop_line(prepared.inputs(), prepared.cut_shares()));
    match prepared.pose_adjustment() {
        Some(a) => print_line(format!(
            "the cameras were adjusted to {} points that the photographs share: turned by {:.2} degrees \
             at most; median error of the points {:.2} px before, {:.2} px now (--adjust-poses=never keeps them)",
            a.points, a.turned_deg, a.before_px, a.after_px
        )),
        None if poses == Poses::Adjusted => {
            print_line(
                "the cameras were not adjusted: they agree with the photographs, or too few points are \
                 shared to decide",
            );
        }
        None => {}
    }
    Warning::sentences(prepared.warnings()).iter().for_each(print_warning);
    if prepared.reports().iter().any(|r| r.verdict == Verdict::Bad) {
        print_warning(
            "these cameras disagree with the photographs, so the scene will be smeared; `subsplat check` \
             draws the disagreement",
        );
    }
    print_depth_range(prepared.depth_range());
}

/// Prints the network's depth range where it estimated one, and the warnings after the first
/// `printed` ones.
fn print_reconstruction(result: &Reconstruction, printed: usize) {
    if result.depth_range() != result.initial_depth_range() {
        print_depth_range(result.depth_range());
    }
    let rest = result.warnings().get(printed..).unwrap_or_default();
    Warning::sentences(rest).iter().for_each(print_warning);
    if result.detail() == Detail::Photographs {
        print_line("fine texture comes from the full photographs (--detail off leaves it out)");
    }
    if let Some(fit) = result.fit() {
        let FitReport { before, after, .. } = fit;
        print_line(format!(
            "sizes, opacities and colours of the splats were matched to the photographs: their \
             difference was {before:.5} and is {after:.5} (0: equal; --fit 0 leaves this out)"
        ));
    }
    if let Some(refinement) = result.refinement() {
        let RefineReport { steps, before, after, removed, .. } = refinement;
        let removed = match removed {
            0 => String::new(),
            n => format!("; {n} splats that hardly show were removed"),
        };
        let drawn_from = match result.inputs().len() {
            2 => "the splats of the other one",
            _ => "all splats",
        };
        print_line(format!(
            "{steps} steps moved and reshaped the splats to sharpen new views: each photograph, drawn from \
             {drawn_from}, differed by {before:.5} and now by {after:.5} (0: equal; --refine off leaves this \
             out){removed}"
        ));
    }
}

/// Says how many pixels the network reads, and what the crop leaves out of the photographs.
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
    format!("the network reads {w}x{h} pixels: {cut}")
}

fn print_depth_range(bounds: &DepthBounds) {
    let DepthBounds { near, far, source } = bounds;
    print_line(format!("the scene lies at distances from {near:.4} to {far:.4}: {source}"));
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
    use subsplat::reconstruct::inputs::crop::{CropOptions, crop};
    use subsplat::scene::pictures::Rgb;
    use subsplat_kernels::camera::{Camera, Intrinsics};

    #[test]
    fn high_quality_is_limited_by_photographs_and_memory() {
        let config = Config::small(subsplat::network::config::Preset::Tuned, 2);
        let size = |quality: Quality, crop, (width, height): (usize, usize), ample: bool| {
            let photos = [Size { width, height }; 2];
            let wanted = quality.settings().input_size;
            let chosen = size_within(wanted, crop, &photos, &config, |_| ample);
            let size = chosen.resolve(&photos, 32);
            (size.width, size.height)
        };
        use CropShapeArg::{Square, Whole};
        use Quality::{Best, Fast, High, Normal};
        assert_eq!(size(Fast, Whole, (4000, 4000), true), (192, 192));
        // A size that is asked for stays where the memory is short: the run is refused instead.
        assert_eq!(size(Fast, Whole, (4000, 4000), false), (192, 192));
        assert_eq!(size(Normal, Whole, (4000, 4000), true), (256, 256));
        assert_eq!(size(Normal, Square, (4000, 2000), true), (256, 256));
        assert_eq!(size(High, Whole, (4000, 4000), true), (512, 512));
        assert_eq!(size(Best, Whole, (4000, 4000), true), (512, 512));
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
            ([0.0, 0.004], "the network reads 32x32 pixels: the whole photographs"),
            (
                [0.25, 0.25],
                "the network reads 32x32 pixels: 25 % of each photograph is cut at its edges",
            ),
            (
                [0.1, 0.33],
                "the network reads 32x32 pixels: the photographs differ in shape: 10 % to 33 % of each \
                 is cut at its edges",
            ),
        ] {
            assert_eq!(crop_line(&inputs, &shares), expected);
        }
    }
}
