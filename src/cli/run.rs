//! `subsplat run`: photographs to Gaussians, views and files.

use super::args::{
    BackboneArg, DetailArg, LowpassArg, ModelArgs, PathArg, RunArgs, SceneFormatArg,
};
use super::report::{Progress, finish, mebibytes, peak_memory_bytes, say, warn};
use super::{frames, pair};
use anyhow::{Context, Result, bail, ensure};
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use subsplat::abi::RasterOptions;
use subsplat::camera::Camera;
use subsplat::config::{Config, LowpassRef, Preset};
use subsplat::cpu::Rasterizer;
use subsplat::data::depth::{DepthRange, depth_range};
use subsplat::data::pair::choose_pair;
use subsplat::io::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::io::image::{Depth, Rgb, save_depth_png, save_png};
use subsplat::io::scene::{Scene, load_scene};
use subsplat::io::{SaveOptions, save_splats};
use subsplat::metrics::{psnr, ssim};
use subsplat::model::weights::Weights;
use subsplat::pipeline::{self, Photo, Reconstruction, Reconstructor, Request};
use subsplat::render::render_with;

/// A view to render.
struct Target {
    /// File stem.
    name: String,
    camera: Camera,
    /// What a photograph shows there, and whether it had to be enlarged.
    truth: Option<(Rgb, bool)>,
}

/// Runs the command.
pub fn run(args: &RunArgs, as_json: bool) -> Result<()> {
    let mut progress = Progress::new();
    let scene = progress.stage("reading the scene", |_| scene(args))?;
    for line in &scene.warnings {
        warn(line);
    }
    let (context, why) = context(args, &scene)?;
    let range = depth_range(&scene, &context, (args.near, args.far))?;
    say(format!(
        "{}: {} frames ({}); context {}; near {:.4}, far {:.4} ({})",
        scene.name,
        scene.frames.len(),
        scene.source.name(),
        why,
        range.near,
        range.far,
        range.reason
    ));
    let model = progress.stage("loading the model", |_| model(args))?;
    let mut photos = Vec::new();
    progress.steps("photographs", context.len(), |bar| {
        for &i in &context {
            photos.push(Photo::from_frame(&scene.frames[i])?);
            bar.inc(1);
        }
        anyhow::Ok(())
    })?;
    let request = Request {
        input_size: frames::size(&args.input_size)?,
        near_far: (range.near, range.far),
        detail: args.detail == DetailArg::Photo,
    };
    let result = progress.stage("network", |bar: &ProgressBar| {
        model.reconstruct_with(&photos, &request, &mut |name| bar.set_message(name))
    })?;
    drop(photos);
    for (name, seconds) in &result.seconds {
        progress.book(name, *seconds);
    }
    result.warnings.iter().for_each(warn);
    let targets = targets(args, &scene, &context, &model, &result)?;
    let options = raster_options(args, &model, range.near)?;
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("output folder {}", args.out.display()))?;
    let scored = progress.steps("rendering", targets.len(), |bar| {
        render_targets(&args.out, &result, &targets, &options, bar)
    })?;
    let files = progress.stage("writing", |_| write_scene(args, &model, &result, &targets))?;
    let report = report(args, &scene, &context, &range, &model, &result, &scored, &files);
    finish_run(args, as_json, report, progress, &scored)
}

fn scene(args: &RunArgs) -> Result<Scene> {
    match args.input.as_slice() {
        [a, b] => pair::scene(a, b, &args.pair),
        [one] => Ok(load_scene(one)?),
        _ => bail!("run: expected a scene or two photographs"),
    }
}

/// Context frames, and how they were chosen.
fn context(args: &RunArgs, scene: &Scene) -> Result<(Vec<usize>, String)> {
    let list = |frames: &[usize]| frames.iter().map(usize::to_string).collect::<Vec<_>>().join(",");
    if !args.context.is_empty() {
        let chosen = frames::indices(scene, &args.context, "--context")?;
        ensure!(chosen.len() >= 2, "--context: expected at least 2 frames, got {}", chosen.len());
        let mut distinct = chosen.clone();
        distinct.sort_unstable();
        distinct.dedup();
        ensure!(distinct.len() == chosen.len(), "--context: expected different frames");
        let text = format!("{} as given", list(&chosen));
        return Ok((chosen, text));
    }
    if scene.frames.len() == 2 {
        return Ok((vec![0, 1], "0,1: the only two".to_owned()));
    }
    if let Some(test) = frames::protocol(&args.input[0], scene)?.into_iter().next()
        && test.context.len() >= 2
    {
        let text = format!("{} from protocol.json", list(&test.context));
        return Ok((test.context, text));
    }
    let Some(pair) = choose_pair(scene) else {
        bail!(
            "{}: expected two photographs taken from different places, got {} frames at one",
            scene.name,
            scene.frames.len()
        )
    };
    let text = format!("{}: {}", list(&pair.frames), pair.reason);
    Ok((pair.frames.to_vec(), text))
}

/// The model that the arguments ask for.
fn model(args: &RunArgs) -> Result<Reconstructor> {
    let Some(path) = &args.weights else {
        let config = config(&args.model, None, args.upscale)?;
        let what = match pipeline::is_mvsplat(&config) {
            true => "MVSplat's network gives noise with them",
            false => "the small network is then a plain plane sweep, without anything learned",
        };
        warn(format!("no --weights: using seeded random weights (seed {}); {what}", args.seed));
        return Ok(Reconstructor::untrained(&config, args.seed)?);
    };
    let stored = Weights::load(path)?.config().cloned();
    let config = config(&args.model, Some(stored), args.upscale)?;
    let model = Reconstructor::load(path, Some(&config))?;
    let untrained = model.untrained_tensors();
    if !untrained.is_empty() {
        say(format!(
            "{}: holds no SubSplat tensors ({} start untrained, so children follow the plain \
             split of their parents)",
            path.display(),
            untrained.len()
        ));
    }
    let unexpected = model.unexpected_tensors();
    if !unexpected.is_empty() {
        warn(format!(
            "{}: {} tensors are not part of this model, first `{}`",
            path.display(),
            unexpected.len(),
            unexpected[0]
        ));
    }
    Ok(model)
}

/// `stored` is `None` without weights, `Some(None)` for weights that carry no
/// configuration.
fn config(
    args: &ModelArgs,
    stored: Option<Option<Config>>,
    upscale: Option<usize>,
) -> Result<Config> {
    if let Some(path) = &args.config {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let mut config = Config::from_json(&text).with_context(|| path.display().to_string())?;
        config.upscale = upscale.unwrap_or(config.upscale);
        config.check()?;
        return Ok(config);
    }
    let bare = stored.is_some();
    let mvsplat = match (args.backbone, stored.as_ref().and_then(Option::as_ref)) {
        (Some(backbone), _) => backbone == BackboneArg::Re10k,
        (None, Some(config)) => pipeline::is_mvsplat(config),
        (None, None) => bare,
    };
    let mut config = match (stored.flatten(), args.preset) {
        (Some(config), None) if pipeline::is_mvsplat(&config) == mvsplat => config,
        (_, preset) => {
            let preset = preset.map_or(Preset::Tuned, Preset::from);
            pipeline::preset(mvsplat, preset, upscale.unwrap_or(2))
        }
    };
    config.upscale = upscale.unwrap_or(config.upscale);
    config.check()?;
    Ok(config)
}

fn targets(
    args: &RunArgs,
    scene: &Scene,
    context: &[usize],
    model: &Reconstructor,
    result: &Reconstruction,
) -> Result<Vec<Target>> {
    let inputs: Vec<Camera> = result.inputs.iter().map(|c| c.target_camera).collect();
    let path = |cameras: Vec<Camera>| {
        let name = |i| format!("path_{i:04}");
        let target = |(i, camera)| Target { name: name(i), camera, truth: None };
        cameras.into_iter().enumerate().map(target).collect::<Vec<_>>()
    };
    match args.path {
        PathArg::Interpolate => return Ok(path(frames::interpolate(&inputs, args.frames)?)),
        PathArg::Orbit => {
            let depth = median(&result.depths[0].data);
            return Ok(path(frames::orbit(&inputs, depth, args.frames)?));
        }
        PathArg::Targets => {}
    }
    let chosen = match args.target.is_empty() {
        false => frames::indices(scene, &args.target, "--target")?,
        true => default_targets(&args.input[0], scene, context)?,
    };
    if chosen.is_empty() {
        return Ok(path(frames::interpolate(&inputs, args.frames)?));
    }
    let options = model.crop_options(frames::size(&args.input_size)?);
    chosen
        .iter()
        .map(|&i| {
            let frame = &scene.frames[i];
            let cropped = Photo::from_frame(frame)?.crop(&options)?;
            let name = frame.name.replace(['/', '\\', ':'], "_");
            let enlarged = !cropped.warnings.is_empty();
            let truth = Some((cropped.target, enlarged));
            Ok(Target { name, camera: cropped.target_camera, truth })
        })
        .collect()
}

/// The protocol's targets for these contexts, else the frames between them.
fn default_targets(input: &Path, scene: &Scene, context: &[usize]) -> Result<Vec<usize>> {
    if let Some(test) = frames::protocol(input, scene)?.into_iter().find(|t| t.context == context) {
        return Ok(test.target);
    }
    let (first, last) = (context.iter().min(), context.iter().max());
    let (Some(&first), Some(&last)) = (first, last) else { return Ok(Vec::new()) };
    Ok((first + 1..last).filter(|i| !context.contains(i)).collect())
}

fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(1.0)
}

fn raster_options(args: &RunArgs, model: &Reconstructor, near: f32) -> Result<RasterOptions> {
    let mut config = model.config().clone();
    if let Some(convention) = args.look.convention {
        config.render.convention = convention.into();
    }
    if let Some(reference) = args.look.lowpass_ref {
        config.render.lowpass_ref = match reference {
            LowpassArg::Target => LowpassRef::Target,
            LowpassArg::Input => LowpassRef::Input,
        };
    }
    let mut options = pipeline::raster_options(&config, near);
    options.background = super::render::background(&args.look)?;
    Ok(options)
}

/// One rendered target with its scores.
struct Scored {
    name: String,
    psnr: Option<f64>,
    ssim: Option<f64>,
    /// The photograph was smaller than the target and had to be enlarged.
    enlarged: bool,
}

fn render_targets(
    out: &Path,
    result: &Reconstruction,
    targets: &[Target],
    options: &RasterOptions,
    bar: &ProgressBar,
) -> Result<Vec<Scored>> {
    let (images, depths) = (out.join("images"), out.join("depth"));
    for folder in [&images, &depths, &out.join("inputs")] {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    for (i, (input, depth)) in result.inputs.iter().zip(&result.depths).enumerate() {
        save_png(&out.join(format!("inputs/{i}.png")), &input.input)?;
        save_depth_png(&out.join(format!("inputs/{i}_depth.png")), depth)?;
    }
    let mut rasterizer = Rasterizer::new();
    let mut scored = Vec::with_capacity(targets.len());
    for target in targets {
        let picture = render_with(&mut rasterizer, &result.splats, &target.camera, options);
        let (width, height) = (picture.width, picture.height);
        save_png(
            &images.join(format!("{}.png", target.name)),
            &to_rgb8(&picture.rgb, width, height),
        )?;
        let depth = Depth { width, height, data: picture.depth };
        save_depth_png(&depths.join(format!("{}.png", target.name)), &depth)?;
        let mut score =
            Scored { name: target.name.clone(), psnr: None, ssim: None, enlarged: false };
        if let Some((truth, enlarged)) = &target.truth {
            let truth: Vec<f32> = truth.data.iter().map(|&v| f32::from(v) / 255.0).collect();
            score.psnr = Some(psnr(&picture.rgb, &truth, width, height)?);
            score.ssim = ssim(&picture.rgb, &truth, width, height).ok();
            score.enlarged = *enlarged;
        }
        scored.push(score);
        bar.inc(1);
    }
    Ok(scored)
}

/// Linear values to 8 bits, rounded.
pub fn to_rgb8(rgb: &[f32], width: usize, height: usize) -> Rgb {
    let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    Rgb { width, height, data: rgb.iter().map(byte).collect() }
}

fn write_scene(
    args: &RunArgs,
    model: &Reconstructor,
    result: &Reconstruction,
    targets: &[Target],
) -> Result<Vec<Value>> {
    let cameras = targets
        .iter()
        .map(|t| NamedCamera {
            file: format!("images/{}.png", t.name),
            camera: t.camera,
            timestamp: None,
            depth: Some(format!("depth/{}.png", t.name)),
        })
        .collect();
    let content = CameraFile { cameras, units: Default::default(), near_far: None };
    save_cameras_json(&args.out.join("cameras.json"), &content)?;
    let convention = format!("{:?}", model.config().render.convention).to_lowercase();
    let options = SaveOptions {
        min_opacity: args.min_opacity,
        comments: vec![format!("render convention: {convention}")],
        ..SaveOptions::default()
    };
    let mut formats = args.save.clone();
    formats.dedup();
    let mut files = Vec::new();
    for format in formats {
        let name = match format {
            SceneFormatArg::Ply => "scene.ply",
            SceneFormatArg::Glb => "scene.glb",
            SceneFormatArg::Splat => "scene.splat",
            SceneFormatArg::Spz => "scene.spz",
        };
        let path: PathBuf = args.out.join(name);
        let saved = save_splats(&path, &result.splats, &options)?;
        files.push(json!({ "file": path, "report": saved }));
    }
    Ok(files)
}

#[allow(clippy::too_many_arguments, reason = "one call, everything that the report names")]
fn report(
    args: &RunArgs,
    scene: &Scene,
    context: &[usize],
    range: &DepthRange,
    model: &Reconstructor,
    result: &Reconstruction,
    scored: &[Scored],
    files: &[Value],
) -> Value {
    let target = |s: &Scored| {
        json!({
            "frame": s.name,
            "psnr": s.psnr.filter(|v| v.is_finite()),
            "ssim": s.ssim,
            "photograph_enlarged": s.enlarged,
        })
    };
    let names = |i: &usize| scene.frames[*i].name.clone();
    let camera = |c: &Camera| {
        let k = c.intrinsics;
        json!({ "width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy })
    };
    json!({
        "scene": scene.name,
        "context": context.iter().map(names).collect::<Vec<_>>(),
        "near": range.near,
        "far": range.far,
        "input_intrinsics": result.inputs.iter().map(|c| camera(&c.input_camera)).collect::<Vec<_>>(),
        "upscale": model.config().upscale,
        "trained": args.weights.is_some(),
        "detail": args.detail == DetailArg::Photo,
        "gaussians": result.splats.len(),
        "targets": scored.iter().map(target).collect::<Vec<_>>(),
        "files": files,
    })
}

fn finish_run(
    args: &RunArgs,
    as_json: bool,
    mut report: Value,
    progress: Progress,
    scored: &[Scored],
) -> Result<()> {
    let peak = peak_memory_bytes();
    let seconds = progress.seconds();
    let mean = |f: fn(&Scored) -> Option<f64>| {
        let all: Vec<f64> = scored.iter().filter_map(f).filter(|v| v.is_finite()).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    };
    let (psnr, ssim) = (mean(|s| s.psnr), mean(|s| s.ssim));
    if let Some(map) = report.as_object_mut() {
        map.insert("psnr".to_owned(), json!(psnr));
        map.insert("ssim".to_owned(), json!(ssim));
        map.insert("seconds".to_owned(), json!(seconds));
        map.insert("peak_memory_bytes".to_owned(), json!(peak));
    }
    if scored.iter().any(|s| s.psnr.is_some()) {
        let path = args.out.join("metrics.json");
        let text = serde_json::to_string_pretty(&report)?;
        subsplat::io::write_atomic(&path, |f| std::io::Write::write_all(f, text.as_bytes()))?;
        for s in scored {
            let note = if s.enlarged { "  (photograph smaller than the target)" } else { "" };
            say(format!(
                "  {:<12} PSNR {:6.2}  SSIM {:.4}{note}",
                s.name,
                s.psnr.unwrap_or(f64::NAN),
                s.ssim.unwrap_or(f64::NAN)
            ));
        }
    }
    say(format!(
        "{} Gaussians, {} views in {}; {:.1} s{}",
        report["gaussians"],
        scored.len(),
        args.out.display(),
        seconds["total"].as_f64().unwrap_or(0.0),
        peak.map_or(String::new(), |p| format!(", peak memory {}", mebibytes(p)))
    ));
    finish(as_json, &report)
}
