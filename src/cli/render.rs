//! `subsplat render`: a finished scene to pictures.

use super::args::{LookArgs, LowpassArg, PathArg, RenderArgs};
use super::frames;
use super::report::{Progress, finish, mebibytes, peak_memory_bytes, say, warn};
use super::run::to_rgb8;
use anyhow::{Context, Result, ensure};
use glam::{Mat4, Vec3};
use serde_json::json;
use std::path::Path;
use subsplat::abi::{Convention, RasterOptions};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::cpu::Rasterizer;
use subsplat::io::cameras_json::load_cameras_json;
use subsplat::io::image::{Depth, save_depth_png, save_png};
use subsplat::io::load_splats;
use subsplat::io::scene::load_scene;
use subsplat::render::render_with;
use subsplat::splats::Splats;

/// Side of a picture where no camera says otherwise, px.
const DEFAULT_SIDE: usize = 512;
/// Horizontal field of view of the view that is made up where there is no camera.
const DEFAULT_FOV_X: f32 = 0.9;

/// The background colour, checked.
pub fn background(look: &LookArgs) -> Result<[f32; 3]> {
    let ok = look.background.len() == 3 && look.background.iter().all(|v| (0.0..=1.0).contains(v));
    ensure!(ok, "--background: expected three numbers in [0, 1], got {:?}", look.background);
    Ok([look.background[0], look.background[1], look.background[2]])
}

/// Runs the command.
pub fn render(args: &RenderArgs, as_json: bool) -> Result<()> {
    let mut progress = Progress::new();
    let splats = progress.stage("reading the scene", |_| load_splats(&args.scene))?;
    let cameras = cameras(args, &splats)?;
    let mut options =
        RasterOptions::new(args.look.convention.map_or(Convention::Standard, Convention::from));
    ensure!(args.sh_degree <= 4, "--sh-degree: expected 0 to 4, got {}", args.sh_degree);
    options.sh_degree = args.sh_degree;
    options.background = background(&args.look)?;
    if let Some(near) = args.near {
        ensure!(near > 0.0 && near.is_finite(), "--near: expected above 0, got {near}");
        options.near = near;
    }
    if matches!(args.look.lowpass_ref, Some(LowpassArg::Input)) {
        warn("--lowpass-ref input: a scene file does not know its input's size; ignored");
    }
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("output folder {}", args.out.display()))?;
    let mut views = Vec::new();
    progress.steps("rendering", cameras.len(), |bar| {
        let mut rasterizer = Rasterizer::new();
        for (name, camera) in &cameras {
            let picture = render_with(&mut rasterizer, &splats, camera, &options);
            let (width, height) = (picture.width, picture.height);
            let file = args.out.join(format!("{name}.png"));
            save_png(&file, &to_rgb8(&picture.rgb, width, height))?;
            let mut view = json!({ "file": file, "width": width, "height": height });
            if args.depth {
                let file = args.out.join(format!("{name}_depth.png"));
                let unit = save_depth_png(&file, &Depth { width, height, data: picture.depth })?;
                view["depth_file"] = json!(file);
                view["depth_unit"] = json!(unit);
            }
            views.push(view);
            bar.inc(1);
        }
        anyhow::Ok(())
    })?;
    let peak = peak_memory_bytes();
    say(format!(
        "{} Gaussians, {} views in {}{}",
        splats.len(),
        views.len(),
        args.out.display(),
        peak.map_or(String::new(), |p| format!("; peak memory {}", mebibytes(p)))
    ));
    let report = json!({
        "scene": args.scene,
        "gaussians": splats.len(),
        "views": views,
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak,
    });
    finish(as_json, &report)
}

/// File stems and cameras.
fn cameras(args: &RenderArgs, splats: &Splats) -> Result<Vec<(String, Camera)>> {
    let named = named_cameras(args, splats)?;
    let sized = |camera: Camera| -> Result<Camera> {
        let Some(text) = &args.size else { return Ok(camera) };
        let (w, h) = frames::size(text)?;
        let k = camera.intrinsics;
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
        Ok(Camera { intrinsics, ..camera })
    };
    let path = |cameras: Vec<Camera>| -> Result<Vec<(String, Camera)>> {
        let name = |i| format!("path_{i:04}");
        cameras.into_iter().enumerate().map(|(i, c)| Ok((name(i), sized(c)?))).collect()
    };
    let through: Vec<Camera> = named.iter().map(|(_, c)| *c).collect();
    match args.path {
        PathArg::Targets => named.into_iter().map(|(n, c)| Ok((n, sized(c)?))).collect(),
        PathArg::Interpolate => path(frames::interpolate(&through, args.frames)?),
        PathArg::Orbit => {
            let depth = median_depth(splats, &through[0]);
            path(frames::orbit(&through, depth, args.frames)?)
        }
    }
}

fn named_cameras(args: &RenderArgs, splats: &Splats) -> Result<Vec<(String, Camera)>> {
    let beside = args.scene.parent().unwrap_or(Path::new("")).join("cameras.json");
    let stem = |file: &str| {
        let stem = Path::new(file).file_stem().unwrap_or_default();
        stem.to_string_lossy().into_owned()
    };
    let source = match &args.cameras {
        Some(path) => path.clone(),
        None if beside.is_file() => beside,
        None => {
            say("no cameras given and no cameras.json beside the scene: a view of the whole");
            return Ok(vec![("view".to_owned(), whole(splats)?)]);
        }
    };
    // A camera list needs no pictures; any other pose file goes through its reader.
    if source.is_file()
        && args.target.is_empty()
        && let Ok(content) = load_cameras_json(&source)
    {
        ensure!(!content.cameras.is_empty(), "{}: expected a camera, got none", source.display());
        return Ok(content.cameras.iter().map(|c| (stem(&c.file), c.camera)).collect());
    }
    let scene = load_scene(&source)?;
    scene.warnings.iter().for_each(warn);
    let chosen = match args.target.is_empty() {
        true => (0..scene.frames.len()).collect(),
        false => frames::indices(&scene, &args.target, "--target")?,
    };
    let named = |i: usize| Ok((stem(&scene.frames[i].name), scene.frames[i].pinhole()?));
    chosen.into_iter().map(named).collect()
}

fn median_depth(splats: &Splats, camera: &Camera) -> f32 {
    let mut z: Vec<f32> = (0..splats.len())
        .map(|i| camera.to_camera(splats.mean(i).into()).z)
        .filter(|z| *z > 0.0)
        .collect();
    z.sort_by(f32::total_cmp);
    z.get(z.len() / 2).copied().unwrap_or(1.0)
}

/// A camera that looks along +z at the middle 96 % of the means.
fn whole(splats: &Splats) -> Result<Camera> {
    ensure!(!splats.is_empty(), "the scene holds no Gaussian");
    let axis = |a: usize| {
        let mut v: Vec<f32> = (0..splats.len()).map(|i| splats.mean(i)[a]).collect();
        v.sort_by(f32::total_cmp);
        let at = |q: f32| v[(q * (v.len() - 1) as f32) as usize];
        (at(0.02), at(0.98))
    };
    let (x, y, z) = (axis(0), axis(1), axis(2));
    let low = Vec3::new(x.0, y.0, z.0);
    let high = Vec3::new(x.1, y.1, z.1);
    let middle = 0.5 * (low + high);
    let extent = (high - low).truncate().max_element().max(1e-3);
    let away = 0.5 * extent / (0.5 * DEFAULT_FOV_X).tan() + 0.5 * (high.z - low.z);
    let intrinsics = Intrinsics::from_fov_x(DEFAULT_FOV_X, DEFAULT_SIDE, DEFAULT_SIDE);
    Ok(Camera::new(intrinsics, Mat4::from_translation(middle - away * Vec3::Z))?)
}
