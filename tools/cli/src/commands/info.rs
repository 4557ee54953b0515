//! `subsplat info`: describes a file or a scene.

use super::args::InfoArgs;
use super::render;
use crate::report::{Answer, print_line};
use anyhow::{Context, Result, bail};
use serde_json::{Value, json};
use std::path::Path;
use subsplat::files::photos::image::probe;
use subsplat::files::photos::photograph::probe_photograph;
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::files::{SplatInfo, is_splat_file, splat_info};
use subsplat::network::config::Config;
use subsplat::network::model::weights::Weights;

/// Runs the command.
pub fn info(args: &InfoArgs, answer: Answer) -> Result<()> {
    let path = args.file.as_path();
    let metadata = std::fs::metadata(path).with_context(|| path.display().to_string())?;
    let report = if is_splat_file(path) {
        splats(path, answer)?
    } else if render::is_training(path) {
        splats(&render::scene_file(path)?, answer)?
    } else if metadata.is_dir() {
        scene(path, answer)?
    } else {
        file(path, answer)?
    };
    answer.finish(&report)
}

fn file(path: &Path, answer: Answer) -> Result<Value> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match extension.as_str() {
        "safetensors" => weights(path, answer),
        "json" | "txt" | "bin" => scene(path, answer),
        "png" | "jpg" | "jpeg" | "webp" | "bmp" | "tif" | "tiff" | "heic" | "heif" | "hif"
        | "jfif" | "jpe" | "mpo" | "avif" | "jxl" | "dng" | "cr2" | "nef" | "arw" | "raf" => {
            picture(path, answer)
        }
        _ => bail!(
            "{}: expected a splat file (.ply .glb .spz .sog .splat .ksplat), weights (.safetensors), a \
             picture, a pose file or a scene folder, got `.{extension}`",
            path.display()
        ),
    }
}

fn splats(path: &Path, answer: Answer) -> Result<Value> {
    let info = splat_info(path)?;
    answer.line(format!(
        "{}: {}, {} splats, colours of degree {} (0: the same from all sides), {} bytes",
        path.display(),
        info.flavour,
        info.count,
        info.sh_degree,
        info.bytes
    ));
    if let Some([low, high]) = info.bounds {
        answer.line(format!("  positions from {low:?} to {high:?}"));
    }
    answer.line(format!("  quantiles over the splats: {:?}", SplatInfo::QUANTILES));
    answer.line(format!("  opacity (1: opaque):       {:?}", info.opacity));
    answer.line(format!("  size (the scene's unit):   {:?}", info.scale));
    answer.line(format!(
        "  {} splats are invisible, {} have numbers that are not finite",
        info.invisible, info.non_finite
    ));
    info.notes.iter().for_each(|note| answer.line(format!("  warning: {note}")));
    info.comments.iter().for_each(|c| answer.line(format!("  comment: {c}")));
    Ok(json!({ "kind": "splats", "file": path.display().to_string(), "splats": info }))
}

fn weights(path: &Path, answer: Answer) -> Result<Value> {
    let weights = Weights::load(path)?;
    let tensors = weights.tensors();
    let parameters: usize = tensors.values().map(|t| t.elem_count()).sum();
    let config: Option<Value> = match weights.config() {
        Some(config) => Some(serde_json::to_value(config)?),
        None => None,
    };
    answer.line(format!("{}: {} tensors, {parameters} parameters", path.display(), tensors.len()));
    match weights.config().map(Config::to_json) {
        Some(json) => answer.line(format!("  configuration: {}", json?)),
        None => answer
            .line("  the file names no network; run --weights takes re10k or small by its tensors"),
    }
    let shapes: serde_json::Map<String, Value> =
        tensors.iter().map(|(name, t)| (name.clone(), json!(t.dims()))).collect();
    Ok(json!({
        "kind": "weights",
        "file": path.display().to_string(),
        "tensors": shapes,
        "parameters": parameters,
        "config": config,
    }))
}

fn picture(path: &Path, answer: Answer) -> Result<Value> {
    let p = probe(path)?;
    answer.line(format!("{}: {}x{} pixels", path.display(), p.width, p.height));
    let header = probe_photograph(path)?;
    if let Some(orientation) = header.orientation {
        answer.line(format!(
            "  EXIF orientation {orientation}: without a pose file it is turned upright, {}x{}; a pose \
             file describes the pixels as they are stored",
            header.width, header.height
        ));
    }
    let camera = &header.camera;
    let names: Vec<&str> =
        [&camera.make, &camera.model].into_iter().flatten().map(String::as_str).collect();
    if !names.is_empty() {
        answer.line(format!("  camera: {}", names.join(" ")));
    }
    if let (Some(focal), Some(k)) = (camera.focal, header.intrinsics()) {
        answer.line(format!(
            "  focal length: {:.0} px, {:.1} degrees across ({})",
            focal.px,
            k.fov_x().to_degrees(),
            focal.source
        ));
    }
    if header.panorama {
        answer.line("  a panorama (equirectangular): `run` and `poses` make views of it");
    }
    header.warnings.iter().for_each(|w| answer.line(format!("  warning: {w}")));
    Ok(json!({
        "kind": "picture",
        "file": path.display().to_string(),
        "width": p.width,
        "height": p.height,
        "exif_orientation": p.orientation,
        "camera": names.join(" "),
        "focal_px": camera.focal.map(|f| f.px),
        "panorama": header.panorama,
    }))
}

fn scene(path: &Path, answer: Answer) -> Result<Value> {
    let scene: Scene = load_scene(path)?;
    answer.line(format!(
        "{}: {} photographs ({}), {} points of the scene",
        scene.name,
        scene.frames.len(),
        scene.source.name(),
        scene.points.as_ref().map_or(0, Vec::len)
    ));
    scene.warnings.iter().for_each(|w| answer.line(format!("  warning: {w}")));
    let frame = |f: &subsplat::files::poses::scene::Frame| {
        let i = f.entry;
        let k = f.camera.intrinsics();
        let p = f.camera.position();
        answer.line(format!(
            "  {i:>3} {:<12} {}x{} pixels, focal lengths {:.1} and {:.1} px, angle of view \
             {:.1}°×{:.1}°, at ({:.3}, {:.3}, {:.3})",
            f.name,
            k.width,
            k.height,
            k.fx,
            k.fy,
            k.fov_x().to_degrees(),
            k.fov_y().to_degrees(),
            p.x,
            p.y,
            p.z
        ));
        json!({
            "entry": i,
            "name": f.name,
            "image": f.image.display().to_string(),
            "width": k.width,
            "height": k.height,
            "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
            "world_from_camera": f.camera.world_from_camera().transpose().to_cols_array_2d(),
        })
    };
    let frames: Vec<Value> = scene.frames.iter().map(frame).collect();
    for left in &scene.left_out {
        answer.line(format!("  {:>3} {:<12} left out: {}", left.entry, left.name, left.reason));
    }
    Ok(json!({
        "kind": "scene",
        "file": path.display().to_string(),
        "name": scene.name,
        "format": scene.source.name(),
        "frames": frames,
        "near_far": scene.near_far.map(|range| [range.near, range.far]),
        "sparse_points": scene.points.as_ref().map_or(0, Vec::len),
        "warnings": scene.warnings,
        "left_out": left_out(&scene),
    }))
}

/// Most entries that [`print_left_out`] names.
const LEFT_OUT_MAX: usize = 20;

/// Prints the entries of a pose file that were left out, with their reasons.
pub fn print_left_out(scene: &Scene) {
    let left = &scene.left_out;
    if left.is_empty() {
        return;
    }
    let entries = if scene.source.has_file() { "entries of the pose file" } else { "pictures" };
    print_line(format!("left out of {} {entries}: {}", scene.entries(), left.len()));
    for one in left.iter().take(LEFT_OUT_MAX) {
        print_line(format!("  {:>3} {}: {}", one.entry, one.name, one.reason));
    }
    if left.len() > LEFT_OUT_MAX {
        print_line(format!("  and {} more", left.len() - LEFT_OUT_MAX));
    }
}

/// Entries of a pose file that are left out, for `--json`.
pub fn left_out(scene: &Scene) -> Vec<Value> {
    let left = scene.left_out.iter();
    left.map(|l| json!({ "entry": l.entry, "name": l.name, "reason": l.reason })).collect()
}
