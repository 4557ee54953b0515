//! `subsplat run`: photographs to Gaussians, views and files.

use super::args::{LowpassArg, PathArg, RenderingArgs, RunArgs, SceneFormatArg, SourceArgs};
use super::clip::OfVideo;
use super::curve::{self, Curve};
use super::frames::{self, DepthSpread};
use super::html::Page;
use super::info::print_left_out;
use super::inputs::{self, Inputs};
use super::output::{self, Scored, View, Views};
use super::reconstruct::{self, reconstruct};
use super::{browser, clip, memory, model, pair, render, video};
use crate::report::{Answer, Progress, mebibytes, peak_memory_bytes, print_line, print_warning};
use anyhow::{Result, ensure};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use subsplat::cameras::estimation::move_along;
use subsplat::files::SaveOptions;
use subsplat::files::poses::scene::Scene;
use subsplat::network::config::{Config, LowpassRef};
use subsplat::reconstruct::inputs::crop::{CropOptions, Cropped};
use subsplat::reconstruct::is_mvsplat;
use subsplat::reconstruct::stages::located;
use subsplat::reconstruct::{Assessment, Backend, Trust};
use subsplat::scene::render::{
    comment_of_camera, comment_of_options, comment_of_origin, comment_of_photograph,
};
use subsplat::scene::score::GaussianReport;
use subsplat::scene::splats::{SplatStatistics, Splats};
use subsplat::{
    Detail, InputSize, Options, Photo, Reconstruction, Reconstructor, Refine, SceneSoFar,
    TargetSize, Warning,
};
use subsplat_kernels::camera::{Camera, NearFar, Size};
use subsplat_kernels::layout::{Convention, RasterOptions};

/// Largest number of targets by default.
const DEFAULT_TARGETS: usize = 30;

/// Views of a scene without target frames, where no path was asked for.
const UNASKED_FRAMES: usize = 3;

/// Checked arguments.
struct Plan {
    scene: Scene,
    context: Vec<usize>,
    /// The photographs of `context`.
    photos: Vec<Photo>,
    options: Options,
    /// The cameras are an estimate of low confidence.
    doubtful: bool,
}

/// Runs the command.
pub fn run(args: &RunArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    args.motion.video.as_deref().map_or(Ok(()), video::check)?;
    // Before the frames of a video are written into the folder.
    output::check(&args.out, &args.input)?;
    let of_video = clip::of_run(args, &mut progress)?;
    let clip = of_video.as_ref();
    let args = clip.map_or(args, |of_video| &of_video.args);
    // Before the cameras: weights that cannot be read are an error before any work.
    let backend = backend(&args.rendering.device);
    let request = model::ModelRequest::from_source(&args.source);
    let model = progress.stage("model", |_| model::load(&request))?.with_backend(&backend);
    let mut plan = plan(args, clip.map(OfVideo::scene_name), &mut progress)?;
    let source = &args.source;
    let target = args.target_size();
    let context = &plan.context;
    let (mut size, (w, h)) = reconstruct::input_size(source, target, &model, &plan.scene, context)?;
    let target = match target {
        // The number of children follows from the size of the pictures, not the other way round.
        TargetSize::Photographs(_) => {
            size = InputSize::exact(w, h);
            let photos = reconstruct::photo_sizes(&plan.scene, context);
            TargetSize::Exact(target.resolve(Size::new(w, h), model.config().upscale, &photos))
        }
        target => target,
    };
    let model = reconstruct::with_children(source, target, model, context.len(), (w, h))?;
    (plan.options.input_size, plan.options.target_size) = (size, target);
    let Size { width, height } = target.resolve(Size::new(w, h), model.config().upscale, &[]);
    let target_size = (width, height);
    if matches!(args.target_size(), TargetSize::Photographs(_)) {
        print_line(format!("pictures of {width}x{height} pixels"));
    }
    let targets = targets(args, &plan, target_size)?;
    memory::check_picture("the picture size", target_size)?;
    let inputs = plan.context.len();
    let upscale = model.config().upscale;
    let count = plan.options.density.limit(inputs * w * h, inputs, upscale) as u64;
    let degree = model.config().primaries().sh_degree;
    output::check_formats(args, count, degree)?;
    output::prepare(&args.out, &args.input[0], &plan.scene)?;
    let photos = std::mem::take(&mut plan.photos);
    let crop = CropOptions {
        target_size: Size::new(width, height),
        ..model.crop_options(Size::new(w, h))
    };
    let mut curve = curve_of(args, &plan.scene, &targets, &crop)?;
    let mut watch = |scene: &SceneSoFar<'_>| curve.follow(scene);
    let result = reconstruct(&model, photos, &plan.options, &mut progress, &mut watch)?;
    follow_adjustment(&mut plan, &targets, &result, args.source.pair.force, &mut progress)?;
    check_opacity(result.splats(), args.content.min_opacity)?;
    let options = raster_options(&args.rendering, model.config(), &result);
    let views = views(args, &targets, &result)?;
    let mut job = Views {
        out: &args.out,
        scene: &plan.scene,
        load: inputs::load_options(args.source.pair.force),
        named: !args.target.is_empty(),
        left_out: Vec::new(),
        crop,
        options,
        motion: &args.motion,
        video: None,
    };
    // The scene comes first: it is what took the time, and a stop while views are drawn keeps it.
    let files = progress.stage("writing", |_| {
        output::write_config(&args.out, model.config())?;
        let camera = result.inputs().first().map(|c| comment_of_camera(&c.target_camera));
        let origin = comment_of_origin(plan.scene.origin);
        let name = |i: &usize| plan.scene.frames[*i].name.clone();
        let places = result.inputs().iter().map(|c| c.target_camera);
        let cameras: Vec<(String, Camera)> = plan.context.iter().map(name).zip(places).collect();
        let photographs = cameras.iter().map(|(name, camera)| comment_of_photograph(name, camera));
        let comments = std::iter::once(comment_of_options(&options));
        let comments = comments.chain(camera).chain(photographs).chain(origin).collect();
        let save = SaveOptions {
            sh_degree: output::written_degree(args.content.sh, count, degree),
            min_opacity: args.content.min_opacity,
            comments,
            ..SaveOptions::default()
        };
        let page = Page {
            splats: result.splats(),
            cameras: &cameras,
            photographs: true,
            options: &options,
            title: &plan.scene.name,
        };
        output::write_scene(args, &page, &save)
    })?;
    let mut renderer = render::open(&args.rendering);
    let scored = progress
        .steps("rendering", views.len(), |bar| job.render(&mut renderer, &result, &views, bar))?;
    let left_out = std::mem::take(&mut job.left_out);
    let bounds = result.depth_range();
    let near_far = NearFar::new(bounds.near, bounds.far);
    output::write_cameras(&args.out, &scored, &plan.scene, near_far)?;
    let video = video::finish(job.video.take(), &args.motion, answer)?;
    let assessment = progress.stage("inputs", |_| result.assess(&mut renderer, &options))?;
    let clip = clip.map(|of_video| of_video.video.clone());
    let curve = curve.into_points();
    Done { model, result, options, scored, curve, assessment, files, video, clip }
        .finish(args, &plan, progress, answer)?;
    plan.scene.left_out.extend(left_out);
    print_left_out(&plan.scene);
    Ok(())
}

/// The curve of a refinement of which the arguments name the steps or the time, on some of the frames `targets`.
fn curve_of(args: &RunArgs, scene: &Scene, targets: &[usize], crop: &CropOptions) -> Result<Curve> {
    let named = matches!(args.source.refine, Some(Refine::Steps(_) | Refine::Seconds(_)));
    let count = if named { targets.len().min(curve::PHOTOGRAPHS) } else { 0 };
    let frame = |i: usize| &scene.frames[targets[i * targets.len() / count]];
    // The drawing of the views says which cannot be read.
    let photos = (0..count).filter_map(|i| Photo::from_frame(frame(i)).ok());
    Ok(Curve::new(photos.map(|photo| Ok(photo.crop(crop)?)).collect::<Result<_>>()?))
}

/// Describes the Gaussians of a scene that covers its inputs' pictures by `coverage`.
fn distribution(result: &Reconstruction, coverage: f64) -> Option<GaussianReport> {
    let cameras: Vec<Camera> = result.inputs().iter().map(|c| c.target_camera).collect();
    SplatStatistics::new(result.splats(), &cameras).map(|s| GaussianReport::new(&s, coverage))
}

/// Rejects a least opacity that leaves nothing to save, before any picture is rendered.
fn check_opacity(splats: &Splats, least: f32) -> Result<()> {
    let opacities = (0..splats.len()).map(|i| splats.opacity(i));
    let most = opacities.fold(0.0f32, f32::max);
    ensure!(
        most >= least,
        "--min-opacity: expected at most {most}, the highest opacity of the scene's {} splats, got \
         {least}",
        splats.len()
    );
    Ok(())
}

/// Opens `device`; where that fails, prints a warning and returns the CPU.
fn backend(device: &str) -> Backend {
    Backend::open(device).unwrap_or_else(|e| {
        print_warning(format!("{e}; reconstructing on the CPU"));
        Backend::Cpu
    })
}

/// Checks the arguments and reads the scene, which gets the name `name`.
fn plan(args: &RunArgs, name: Option<String>, progress: &mut Progress) -> Result<Plan> {
    let source = &args.source;
    let wanted = [("--context", source.context.as_slice()), ("--target", args.target.as_slice())];
    let pair::Loaded { mut scene, doubtful } =
        progress.stage("scene", |bar| pair::load(&args.input, &source.pair, &wanted, bar))?;
    scene.name = name.unwrap_or(scene.name);
    scene.warnings.iter().for_each(print_warning);
    let Inputs { context, reason, photos } =
        inputs::choose(&args.source, &args.input[0], &mut scene, progress)?;
    print_line(format!(
        "{}: {} photographs ({}); the scene is made from {reason}",
        scene.name,
        scene.frames.len(),
        scene.source.name(),
    ));
    let options = reconstruct::options(&args.source, &scene, &context)?;
    Ok(Plan { scene, context, photos, options, doubtful })
}

/// Locates the frames `targets` among the photographs of the scene where the cameras of these were adjusted: those of
/// the file belong to the cameras before. A target with too few matches follows them by one similarity.
fn follow_adjustment(
    plan: &mut Plan,
    targets: &[usize],
    result: &Reconstruction,
    force: bool,
    progress: &mut Progress,
) -> Result<()> {
    /// Photographs that are in memory beside those of the scene.
    const TOGETHER: usize = 8;
    let frames = &plan.scene.frames;
    let targets: Vec<usize> =
        targets.iter().copied().filter(|&i| frames[i].cut.is_none()).collect();
    if result.pose_adjustment().is_none() || targets.is_empty() {
        return Ok(());
    }
    let cameras = |of: &[usize]| of.iter().map(|&i| frames[i].camera).collect::<Vec<_>>();
    let adjusted: Vec<Camera> = result.inputs().iter().map(|c| c.input_camera).collect();
    let given = cameras(&targets);
    let mut moved = move_along(&cameras(&plan.context), &adjusted, &given).unwrap_or(given);
    let options = inputs::load_options(force);
    let posed = |(&i, to): (&usize, &Camera)| {
        let photo = Photo::from_frame_with(&frames[i], &options)?;
        photo.with_camera(photo.camera().with_pose_unchecked(to.world_from_camera()))
    };
    let inputs = plan.context.iter().zip(&adjusted).map(posed);
    let inputs = inputs.collect::<subsplat::Result<Vec<_>>>()?;
    for (targets, moved) in targets.chunks(TOGETHER).zip(moved.chunks_mut(TOGETHER)) {
        // One that cannot be read is left out of the views.
        let photos = targets.iter().zip(moved).filter_map(|(i, moved)| {
            let photo = posed((i, moved)).ok()?;
            Some((photo, moved))
        });
        let (photos, moved): (Vec<Photo>, Vec<&mut Camera>) = photos.unzip();
        let found = progress.stage("cameras", |_| located(&inputs, &photos))?;
        for (moved, found) in moved.into_iter().zip(found) {
            *moved = found.unwrap_or(*moved);
        }
    }
    for (i, to) in targets.iter().zip(&moved) {
        let camera = &mut plan.scene.frames[*i].camera;
        *camera = camera.with_pose_unchecked(to.world_from_camera());
    }
    print_line("the photographs to compare with were located among the adjusted cameras");
    Ok(())
}

/// Frames to render as pictures of `size`; empty for a path.
fn targets(args: &RunArgs, plan: &Plan, size: (usize, usize)) -> Result<Vec<usize>> {
    if args.path != PathArg::Targets {
        return Ok(Vec::new());
    }
    let chosen = if args.target.is_empty() {
        default_targets(&args.input[0], plan, size)?
    } else {
        let named = frames::indices(&plan.scene, &args.target, "--target")?;
        // An error before the work: these are needed.
        let load = inputs::load_options(args.source.pair.force);
        named.iter().try_for_each(|&i| plan.scene.frames[i].load_with(&load).map(|_| ()))?;
        named
    };
    if chosen.is_empty() {
        print_line(format!(
            "no photographs are left to compare with: {} views are drawn between the photographs",
            path_frames(args)
        ));
    }
    Ok(chosen)
}

/// The protocol's targets for these contexts; without any, frames between the contexts, spread
/// evenly. Among a protocol's targets of several sizes, the smallest photographs that are no
/// smaller than `size` are chosen, or else the largest.
fn default_targets(input: &Path, plan: &Plan, size: (usize, usize)) -> Result<Vec<usize>> {
    let Plan { scene, context, .. } = plan;
    let misfit = |targets: &[usize]| {
        let k = targets.first().map(|&i| scene.frames[i].camera.intrinsics());
        let area = k.map_or(0, |k| k.width * k.height);
        let small = k.is_none_or(|k| k.width < size.0 || k.height < size.1);
        (small, if small { usize::MAX - area } else { area })
    };
    let tests = frames::protocol(input, scene)?.into_iter().filter(|t| t.context == *context);
    if let Some(test) = tests.min_by_key(|t| misfit(&t.target)) {
        return Ok(test.target);
    }
    let (first, last) = (context.iter().min(), context.iter().max());
    let (Some(&first), Some(&last)) = (first, last) else { return Ok(Vec::new()) };
    let between = |i: &usize| (first + 1..last).contains(i) && !context.contains(i);
    let all: Vec<usize> = scene.usable().into_iter().filter(between).collect();
    let count = all.len().min(DEFAULT_TARGETS);
    Ok((0..count).map(|i| all[i * all.len() / count]).collect())
}

/// Views of a path: few where none was asked for.
fn path_frames(args: &RunArgs) -> usize {
    match args.path {
        PathArg::Targets if args.motion.video.is_none() => {
            args.motion.frames.unwrap_or(UNASKED_FRAMES)
        }
        _ => args.motion.path_frames(),
    }
}

fn views(args: &RunArgs, targets: &[usize], result: &Reconstruction) -> Result<Vec<View>> {
    let inputs: Vec<Camera> = result.inputs().iter().map(|c| c.target_camera).collect();
    let frames = path_frames(args);
    let path = match args.path {
        PathArg::Orbit | PathArg::Spiral | PathArg::Dolly => {
            let shape = args.path.closed().unwrap_or(frames::Loop::Orbit);
            let depths = DepthSpread::of(result.depths()[0].data.iter().copied());
            frames::closed_path(shape, &inputs, depths, frames, args.motion.orbit_radius)?
        }
        PathArg::Targets if !targets.is_empty() => {
            return Ok(targets.iter().map(|&i| View::Frame(i)).collect());
        }
        // The photographs themselves show the other views.
        PathArg::Targets if args.motion.video.is_none() => frames::between(&inputs, frames)?,
        PathArg::Targets | PathArg::Interpolate if args.motion.is_clip() => {
            frames::there_and_back(&inputs, frames)?
        }
        PathArg::Targets | PathArg::Interpolate => frames::interpolate(&inputs, frames)?,
    };
    Ok(path.into_iter().map(View::Path).collect())
}

/// Rules to render a reconstruction of a model with `config`, with the arguments in place of the
/// model's own.
pub fn raster_options(
    args: &RenderingArgs,
    config: &Config,
    result: &Reconstruction,
) -> RasterOptions {
    let mut config = config.clone();
    if let Some(convention) = args.convention {
        config.render.convention = convention.into();
    }
    if let Some(reference) = args.lowpass_ref {
        config.render.lowpass_ref = match reference {
            LowpassArg::Target => LowpassRef::Target,
            LowpassArg::Input => LowpassRef::Input,
        };
    }
    let colour = Cropped::mean_colour(result.inputs());
    let near = result.depth_range().near;
    let ratio = result.inputs().first().map_or(1.0, Cropped::ratio);
    let mut options = config.raster_options(ratio, near, colour);
    let own = result.raster_options();
    if own.convention == options.convention {
        // A scene in kilometres has a nearer plane.
        options.near = own.near;
    }
    options.background = args.background.unwrap_or(options.background);
    options
}

/// The results of a run.
struct Done {
    model: Reconstructor,
    result: Reconstruction,
    options: RasterOptions,
    scored: Vec<Scored>,
    curve: Vec<curve::Point>,
    assessment: Assessment,
    files: Vec<Value>,
    video: Value,
    /// The video of which the photographs are frames.
    clip: Option<PathBuf>,
}

impl Done {
    /// Mean over the views that have a finite value.
    fn mean(&self, value: fn(&Scored) -> Option<f64>) -> Option<f64> {
        let all: Vec<f64> =
            self.scored.iter().filter_map(value).filter(|v| v.is_finite()).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    }

    fn report(&self, args: &RunArgs, plan: &Plan) -> Value {
        let camera = |c: &Camera| {
            let k = c.intrinsics();
            json!({ "width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy })
        };
        let result = &self.result;
        let bounds = result.depth_range();
        let name = |i: &usize| plan.scene.frames[*i].name.clone();
        let config = self.model.config();
        let mvsplat_rules = self.options.convention == Convention::Mvsplat;
        json!({
            "scene": plan.scene.name,
            "input_video": self.clip.as_ref().map(|clip| clip.display().to_string()),
            "context": plan.context.iter().map(name).collect::<Vec<_>>(),
            "near": bounds.near,
            "far": bounds.far,
            "near_far_from": bounds.source.to_string(),
            "check": reconstruct::report(result.reports()),
            "pose_adjustment": result.pose_adjustment().map(|a| json!({
                "points": a.points,
                "error_before_px": a.before_px,
                "error_after_px": a.after_px,
                "turned_deg": a.turned_deg,
            })),
            "cut_shares": result.cut_shares(),
            "input_intrinsics": result.inputs().iter().map(|c| camera(&c.input_camera)).collect::<Vec<_>>(),
            "backbone": if is_mvsplat(config) { "re10k" } else { "small" },
            "upscale": config.upscale,
            "quality": args.source.quality.name(),
            "target_size": result.inputs().first().map(|c| [c.target.width, c.target.height]),
            "convention": if mvsplat_rules { "mvsplat" } else { "standard" },
            "weights": args.source.weights.as_ref().map(|p| p.display().to_string()),
            "seed": args.source.seed,
            "untrained_tensors": self.model.untrained_tensors().len(),
            "detail": result.detail() == Detail::Photographs,
            "fit": result.fit().map(|f| json!({ "loss_before": f.before, "loss_after": f.after })),
            "refine": result.refinement().map(
                |r| json!({
                    "steps": r.steps,
                    "error_before": r.before,
                    "error_after": r.after,
                    "removed": r.removed,
                    "curve": self.curve,
                })
            ),
            "gaussians": result.splats().len(),
            "inputs": self.assessment.inputs,
            "agreement": self.assessment.agreement,
            "coverage": self.assessment.coverage,
            "verdict": self.assessment.verdict,
            "distribution": distribution(result, self.assessment.coverage),
            "targets": self.scored.iter().map(Scored::json).collect::<Vec<_>>(),
            "psnr": self.mean(|s| s.psnr),
            "ssim": self.mean(|s| s.ssim),
            "warnings": result.warnings().iter().map(Warning::to_string).collect::<Vec<_>>(),
            "files": self.files,
            "video": self.video,
        })
    }

    fn finish(self, args: &RunArgs, plan: &Plan, progress: Progress, answer: Answer) -> Result<()> {
        let mut report = self.report(args, plan);
        let seconds = progress.seconds();
        let total = seconds["total"].as_f64().unwrap_or(0.0);
        let peak = peak_memory_bytes();
        report["seconds"] = Value::Object(seconds);
        report["peak_memory_bytes"] = json!(peak);
        let path = args.out.join("metrics.json");
        let text = serde_json::to_string_pretty(&report)?;
        subsplat::files::write_atomic(&path, |f| std::io::Write::write_all(f, text.as_bytes()))?;
        self.print_scores(answer);
        answer.line(format!(
            "{} splats, {} views in {}; {total:.1} s{}",
            self.result.splats().len(),
            self.scored.len(),
            args.out.display(),
            peak.map_or(String::new(), |p| format!(", peak memory {}", mebibytes(p)))
        ));
        answer.line(&self.assessment.verdict);
        let SourceArgs { near, far, .. } = &args.source;
        if self.assessment.verdict.trust != Trust::Good && (near.is_some() || far.is_some()) {
            print_warning(
                "--near and --far may be the cause: without them the distances are estimated from the photographs",
            );
        }
        if plan.doubtful {
            print_warning(
                "the estimated cameras are doubtful, and with them every view of the scene",
            );
        }
        let others = &plan.scene.other_sources;
        if self.assessment.verdict.trust == Trust::Wrong && !others.is_empty() {
            let others = others.join(", ");
            print_warning(format!(
                "the scene has other cameras too: {others} (--model reads them)"
            ));
        }
        if args.formats().contains(&SceneFormatArg::Html) {
            let page = args.out.join(SceneFormatArg::Html.file_name());
            answer.line(format!("to look around in the scene, open {}", page.display()));
            if args.open {
                browser::open(&page);
            }
        }
        answer.finish(&report)
    }

    fn print_scores(&self, answer: Answer) {
        let cell = |v: Option<f64>, digits: usize| {
            v.map_or_else(|| format!("{:>6}", "-"), |v| format!("{v:6.digits$}"))
        };
        let compared: Vec<&Scored> = self.scored.iter().filter(|s| s.psnr.is_some()).collect();
        for s in &compared {
            let note = if s.enlarged { "  (photograph smaller than the picture)" } else { "" };
            let (psnr, ssim) = (cell(s.psnr, 2), cell(s.ssim, 4));
            answer.line(format!("  {:<12} PSNR {psnr}  SSIM {ssim}{note}", s.name));
        }
        if compared.len() > 1 {
            let (psnr, ssim) = (cell(self.mean(|s| s.psnr), 2), cell(self.mean(|s| s.ssim), 4));
            answer.line(format!("  {:<12} PSNR {psnr}  SSIM {ssim}", "mean"));
        }
    }
}
