//! `subsplat render`: renders pictures of a finished scene.

use super::args::{LowpassArg, PathArg, RenderArgs, RenderingArgs, SceneFormatArg};
use super::depth_colour::colour_depth;
use super::frames::{self, DepthSpread};
use super::memory;
use super::trained::{Trained, finished, folder_of, named, trained};
use super::{video, whole};
use crate::report::{Answer, Progress, mebibytes, peak_memory_bytes, print_line, print_warning};
use anyhow::{Context, Result, bail, ensure};
use clap::ValueEnum;
use glam::{DVec3, Mat4, Vec3};
use serde_json::json;
use std::path::{Path, PathBuf};
use subsplat::files::photos::image::{probe, save_depth_png, save_png};
use subsplat::files::photos::photograph::list_photographs;
use subsplat::files::poses::cameras_json::is_cameras_json;
use subsplat::files::poses::reading::SceneOptions;
use subsplat::files::poses::scene::{self, load_cameras_with, load_scene_with};
use subsplat::files::{is_splat_file, load_splat_file};
use subsplat::scene::pictures::{Depth, Rgb};
use subsplat::scene::render::{
    Renderer, camera_of_comments, options_of_comments, origin_of_comments,
};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{Convention, RasterOptions};

/// Opens the renderer of `--device`; where that fails, prints a warning and uses the CPU.
pub fn open(args: &RenderingArgs) -> Renderer {
    let mut renderer = Renderer::open_or_cpu(&args.device);
    renderer.take_warning().iter().for_each(print_warning);
    renderer
}

/// Runs the command.
pub fn render(args: &RenderArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    args.size.map_or(Ok(()), |size| memory::check_picture("--size", size))?;
    args.motion.video.as_deref().map_or(Ok(()), video::check)?;
    let file = scene_file(&args.scene)?;
    let (splats, comments) = progress.stage("scene", |_| load(&file, args.strict))?;
    let cameras = cameras(args, &file, &splats, &comments)?;
    check_sizes(&cameras)?;
    let options = options(&args.rendering, args.near, args.sh_degree, &splats, &comments)?;
    let folder = if args.depth { args.out.join("depth") } else { args.out.clone() };
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("output folder {}", folder.display()))?;
    if args.depth {
        let folder = args.out.join("depth_colour");
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("output folder {}", folder.display()))?;
    }
    let mut views = Vec::new();
    let mut renderer = open(&args.rendering);
    let mut video = None;
    progress.steps("rendering", cameras.len(), |bar| {
        for (name, camera) in &cameras {
            let picture = renderer.render(&splats, camera, &options);
            renderer.take_warning().iter().for_each(print_warning);
            let (width, height) = (picture.width, picture.height);
            let file = args.out.join(format!("{name}.png"));
            let rgb = Rgb::from(&picture);
            save_png(&file, &rgb)?;
            video::push(&mut video, &args.motion, &rgb)?;
            let file = file.display().to_string();
            let mut view = json!({ "file": file, "width": width, "height": height });
            if args.depth {
                let file = args.out.join(format!("depth/{name}.png"));
                let depth = Depth { width, height, data: picture.depth };
                let unit = save_depth_png(&file, &depth)?;
                let colours = args.out.join(format!("depth_colour/{name}.png"));
                save_png(&colours, &colour_depth(&depth))?;
                view["depth_colour_file"] = json!(colours.display().to_string());
                view["depth_file"] = json!(file.display().to_string());
                view["depth_unit"] = json!(unit);
            }
            views.push(view);
            bar.inc(1);
        }
        anyhow::Ok(())
    })?;
    let video = video::finish(video, &args.motion, answer)?;
    let seconds = progress.seconds();
    let peak = peak_memory_bytes();
    answer.line(format!(
        "{} splats, {} views in {}; {:.1} s{}",
        splats.len(),
        views.len(),
        args.out.display(),
        seconds["total"].as_f64().unwrap_or(0.0),
        peak.map_or(String::new(), |p| format!(", peak memory {}", mebibytes(p)))
    ));
    let mvsplat_rules = options.convention == Convention::Mvsplat;
    answer.finish(&json!({
        "scene": file.display().to_string(),
        "gaussians": splats.len(),
        "device": renderer.device(),
        "convention": if mvsplat_rules { "mvsplat" } else { "standard" },
        "views": views,
        "video": video,
        "seconds": seconds,
        "peak_memory_bytes": peak,
    }))
}

/// Splats and comments of a scene file. Prints as warnings what was left out, applied or not read.
///
/// # Errors
/// Errors of the reader; with `strict` splats that are left out.
pub fn load(file: &Path, strict: bool) -> Result<(Splats, Vec<String>)> {
    let content = load_splat_file(file)?;
    if let (true, Some(left)) = (strict, content.notes.iter().find(|n| n.starts_with("left out"))) {
        bail!("{}: expected splats that can all be drawn (--strict), got {left}", file.display());
    }
    content.notes.iter().for_each(print_warning);
    Ok((content.splats, content.comments))
}

/// Returns whether a training of 3D Gaussian Splatting wrote the folder `path`.
pub fn is_training(path: &Path) -> bool {
    trained(path).is_some()
}

/// Finds the scene file of `path`: the path itself, or the file in a folder that `run`, or a training of 3D Gaussian
/// Splatting, wrote.
pub fn scene_file(path: &Path) -> Result<PathBuf> {
    if !path.is_dir() {
        ensure!(
            probe(path).is_err(),
            "{}: expected a scene file, got a photograph: reconstruct two or more by `subsplat run \
             PHOTOGRAPH…`, then render its output folder",
            path.display()
        );
        return Ok(path.to_owned());
    }
    // The pictures of a .sog.
    if is_splat_file(path) {
        return Ok(path.join("meta.json"));
    }
    let readable = SceneFormatArg::value_variants().iter().filter(|f| **f != SceneFormatArg::Html);
    let files = readable.map(|f| path.join(f.file_name()));
    if let Some(file) = files.into_iter().find(|f| f.is_file()) {
        return Ok(file);
    }
    if let Some(Trained { file, note }) = trained(path) {
        note.iter().for_each(print_warning);
        return Ok(file);
    }
    let name = path.display();
    let scenes = finished(path);
    if let [one] = scenes.as_slice() {
        print_line(format!("{name}: the scene is {}", one.display()));
        return if one.is_dir() { scene_file(one) } else { Ok(one.clone()) };
    }
    ensure!(
        scenes.is_empty(),
        "{name}: expected one scene, got {}: give one of {}",
        scenes.len(),
        named(&scenes)
    );
    let hint = if scene::is_scene(path) || list_photographs(path).len() >= 2 {
        format!("; it holds photographs: reconstruct them by `subsplat run {name}`")
    } else {
        String::new()
    };
    bail!(
        "{name}: expected a scene file, or a folder with scene.ply as `subsplat run` writes it, \
         got a folder without one{hint}"
    )
}

/// Rejects cameras whose pictures exceed the memory, with the frame's name.
fn check_sizes(cameras: &[(String, Camera)]) -> Result<()> {
    let mut fits = None;
    for (name, camera) in cameras {
        let size = (camera.intrinsics().width, camera.intrinsics().height);
        // A path has thousands of cameras of one size.
        if fits != Some(size) {
            memory::check_picture(&format!("frame {name}:"), size)?;
            fits = Some(size);
        }
    }
    Ok(())
}

/// Nearest plane of a scene without rules of its own, at most, in units of half the diagonal of its splats:
/// the standard plane of 0.01 would cut a scene in kilometres.
const NEAR_SHARE: f32 = 0.02;

/// Rules to render the splats of a file: the arguments, then the comment that `run` wrote, then the
/// standard.
pub fn options(
    args: &RenderingArgs,
    near: Option<f32>,
    sh_degree: usize,
    splats: &Splats,
    comments: &[String],
) -> Result<RasterOptions> {
    let stored = options_of_comments(comments);
    let wanted = args.convention.map(Convention::from);
    // Options of one convention do not apply to the other.
    let mut options = match stored.filter(|s| wanted.is_none_or(|w| w == s.convention)) {
        Some(stored) => stored,
        None => {
            let standard = RasterOptions::new(wanted.unwrap_or(Convention::Standard));
            let most = whole::bounds(splats).map_or(f32::INFINITY, |b| NEAR_SHARE * b.radius());
            RasterOptions { near: standard.near.min(most), ..standard }
        }
    };
    options.near = near.unwrap_or(options.near);
    options.sh_degree = sh_degree;
    options.background = args.background.unwrap_or(options.background);
    if matches!(args.lowpass_ref, Some(LowpassArg::Input)) {
        print_warning(
            "--lowpass-ref input: ignored, since a scene file does not say how many pixels the network read",
        );
    }
    Ok(options)
}

/// File stems and cameras.
fn cameras(
    args: &RenderArgs,
    file: &Path,
    splats: &Splats,
    comments: &[String],
) -> Result<Vec<(String, Camera)>> {
    let named = named_cameras(args, file, splats, comments)?;
    let sized = |camera: Camera| -> Result<Camera> {
        let Some((w, h)) = args.size else { return Ok(camera) };
        let k = camera.intrinsics();
        // Square pixels stay square: the picture is fitted, then widened or cropped.
        let scale = (w as f32 / k.width as f32).max(h as f32 / k.height as f32);
        let intrinsics = Intrinsics {
            fx: k.fx * scale,
            fy: k.fy * scale,
            cx: w as f32 * 0.5 + (k.cx - 0.5 * k.width as f32) * scale,
            cy: h as f32 * 0.5 + (k.cy - 0.5 * k.height as f32) * scale,
            width: w,
            height: h,
        };
        Ok(camera.with_intrinsics(intrinsics)?)
    };
    let path = |cameras: Vec<Camera>| -> Result<Vec<(String, Camera)>> {
        let name = |i| format!("path_{i:04}");
        cameras.into_iter().enumerate().map(|(i, c)| Ok((name(i), sized(c)?))).collect()
    };
    let through: Vec<Camera> = named.iter().map(|(_, c)| *c).collect();
    let count = args.motion.path_frames();
    match args.path {
        PathArg::Targets => named.into_iter().map(|(n, c)| Ok((n, sized(c)?))).collect(),
        PathArg::Interpolate if args.motion.is_clip() => {
            path(frames::there_and_back(&through, count)?)
        }
        PathArg::Interpolate => path(frames::interpolate(&through, count)?),
        PathArg::Orbit | PathArg::Spiral | PathArg::Dolly => {
            let shape = args.path.closed().unwrap_or(frames::Loop::Orbit);
            let depths = depths(splats, &through[0]);
            path(frames::closed_path(shape, &through, depths, count, args.motion.orbit_radius)?)
        }
    }
}

fn named_cameras(
    args: &RenderArgs,
    file: &Path,
    splats: &Splats,
    comments: &[String],
) -> Result<Vec<(String, Camera)>> {
    let origin = origin_of_comments(comments);
    let options =
        SceneOptions { model: args.model.clone(), strict: args.strict, ..SceneOptions::default() };
    let Some(all) = cameras_beside(args.cameras.as_deref(), file, origin, &options)? else {
        ensure!(
            args.target.is_empty(),
            "--target: expected --cameras, or cameras.json beside the scene, got neither"
        );
        let camera = camera_of_comments(comments);
        print_line(match camera {
            Some(_) => {
                "no --cameras and no cameras.json beside the scene: drawn from the file's own camera"
            }
            None => {
                "no --cameras and no cameras.json beside the scene: a view of the whole, from the side on \
                 which it was probably photographed"
            }
        });
        return Ok(vec![(
            "view".to_owned(),
            camera.map_or_else(|| whole::camera(splats, comments), Ok)?,
        )]);
    };
    let names: Vec<&str> = all.iter().map(|(n, _)| n.as_str()).collect();
    let chosen = if args.target.is_empty() {
        (0..all.len()).collect()
    } else {
        frames::pick(&names, &args.target, "--target")?
    };
    let (names, cameras): (Vec<String>, Vec<Camera>) =
        chosen.into_iter().map(|i| all[i].clone()).unzip();
    Ok(frames::file_stems(&names).into_iter().zip(cameras).collect())
}

/// Names and cameras of `given`, else of cameras.json beside the scene `file` or its training, in the world of the splats
/// ([`read_cameras`]); `None` without either.
pub fn cameras_beside(
    given: Option<&Path>,
    file: &Path,
    origin: DVec3,
    options: &SceneOptions,
) -> Result<Option<Vec<(String, Camera)>>> {
    let beside = folder_of(file).join("cameras.json");
    let source = match given {
        Some(path) => path,
        None if beside.is_file() => &beside,
        None => return Ok(None),
    };
    let all = read_cameras(source, origin, options)?;
    ensure!(!all.is_empty(), "{}: expected a camera, got none", source.display());
    Ok(Some(all))
}

/// Names and cameras of a pose file or scene folder, whose pictures need not exist. They are moved to the
/// world whose origin is `origin`, that of the splats.
pub fn read_cameras(
    source: &Path,
    origin: DVec3,
    options: &SceneOptions,
) -> Result<Vec<(String, Camera)>> {
    let inside = source.join("cameras.json");
    let list = if inside.is_file() { &inside } else { source };
    // A camera list needs no pictures; another pose file may have pictures of another size.
    let scene = if options.model.is_none() && list.is_file() && is_cameras_json(list)? {
        load_cameras_with(list, options)?
    } else {
        load_scene_with(source, options).or_else(|_| load_cameras_with(source, options))?
    };
    scene.warnings.iter().for_each(print_warning);
    let by = (scene.origin - origin).as_vec3();
    let moved = |camera: Camera| -> Result<Camera> {
        let pose = Mat4::from_translation(by) * camera.world_from_camera();
        Ok(if by == Vec3::ZERO { camera } else { Camera::new(camera.intrinsics(), pose)? })
    };
    scene.frames.iter().map(|f| Ok((f.name.clone(), moved(f.pinhole()?)?))).collect()
}

/// Spread of the splats in front of `camera`.
pub fn depths(splats: &Splats, camera: &Camera) -> DepthSpread {
    DepthSpread::of((0..splats.len()).map(|i| camera.to_camera(splats.mean(i).into()).z))
}
