//! The output folder of `run`: pictures, depth, cameras, and the scene in any format.
//!
//! `images/` holds the rendered views and `depth/` their depth. `inputs/` holds the network's
//! inputs with their depth, and `config.json` the model. `cameras.json` makes the folder a scene
//! that every command reads.

use super::args::SceneFormatArg;
use super::frames;
use super::html::Page;
use super::pair::folder_of;
use crate::report::print_warning;
use anyhow::{Context, Result, bail};
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::path::Path;
use subsplat::abi::RasterOptions;
use subsplat::camera::{Camera, NearFar};
use subsplat::config::Config;
use subsplat::data::crop::CropOptions;
use subsplat::io::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::io::image::{Depth, Rgb, save_depth_png, save_png};
use subsplat::io::scene::{Scene, Units, is_scene};
use subsplat::io::{SaveOptions, save_splats};
use subsplat::metrics::{psnr, ssim};
use subsplat::pipeline::{Photo, Reconstruction};
use subsplat::render::Renderer;

/// Folders inside the output folder.
const FOLDERS: [&str; 3] = ["images", "depth", "inputs"];

/// A view to render.
pub enum View {
    /// A camera of a path.
    Path(Camera),
    /// A frame of the scene, which is compared with its photograph.
    Frame(usize),
}

/// One rendered view, with scores where a photograph exists.
pub struct Scored {
    /// Name of the frame, or of the view.
    pub name: String,
    /// Name of its pictures, without extension.
    pub stem: String,
    /// Index in the scene.
    pub frame: Option<usize>,
    camera: Camera,
    depth_unit: f32,
    /// PSNR, dB; infinite for equal pictures.
    pub psnr: Option<f64>,
    /// SSIM; `None` also for pictures that are smaller than its window.
    pub ssim: Option<f64>,
    /// True if the photograph was smaller than the target, and was enlarged.
    pub enlarged: bool,
}

impl Scored {
    /// Formats the view as JSON.
    pub fn json(&self) -> Value {
        json!({
            "frame": self.name,
            "index": self.frame,
            "image": format!("images/{}.png", self.stem),
            "depth": format!("depth/{}.png", self.stem),
            "depth_unit": self.depth_unit,
            // JSON has no infinity: null, as for a view without a photograph.
            "psnr": self.psnr.filter(|v| v.is_finite()),
            "ssim": self.ssim,
            "photograph_enlarged": self.enlarged,
        })
    }
}

/// Creates the output folder before the network runs. `input` is the path of the scene.
///
/// # Errors
/// The folder cannot be created. It holds the scene that is read, or the poses of another one,
/// which the new cameras.json would overwrite or hide.
pub fn prepare(out: &Path, input: &Path, scene: &Scene) -> Result<()> {
    let make = |folder: &Path| {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("output folder {}", folder.display()))
    };
    make(out)?;
    let real = std::fs::canonicalize(out).with_context(|| out.display().to_string())?;
    for frame in &scene.frames {
        let image = std::fs::canonicalize(&frame.image);
        let within = |folder: &str| image.as_ref().is_ok_and(|i| i.starts_with(real.join(folder)));
        if FOLDERS.into_iter().any(within) {
            bail!(
                "output folder {}: holds the photographs that are read; choose another",
                out.display()
            );
        }
    }
    let own = scene.source.has_file()
        && std::fs::canonicalize(folder_of(input)).is_ok_and(|folder| folder == real);
    // A cameras.json may be that of an earlier run, which is replaced.
    if own || (is_scene(&real) && !real.join("cameras.json").is_file()) {
        bail!(
            "output folder {}: holds the poses of a scene, which the cameras.json that is written \
             would replace; choose another",
            out.display()
        );
    }
    FOLDERS.iter().try_for_each(|f| make(&out.join(f)))
}

/// Renders, scores and writes views one by one.
pub struct Views<'a> {
    /// Output folder.
    pub out: &'a Path,
    /// The scene of the frames.
    pub scene: &'a Scene,
    /// Crop of a frame's photograph.
    pub crop: CropOptions,
    /// Rules to render.
    pub options: RasterOptions,
}

impl Views<'_> {
    /// Renders all of `views`, with one step of `bar` each.
    pub fn render(
        &self,
        renderer: &mut Renderer,
        result: &Reconstruction,
        views: &[View],
        bar: &ProgressBar,
    ) -> Result<Vec<Scored>> {
        for (i, (input, depth)) in result.inputs().iter().zip(result.depths()).enumerate() {
            save_png(&self.out.join(format!("inputs/{i}.png")), &input.input)?;
            save_depth_png(&self.out.join(format!("inputs/{i}_depth.png")), depth)?;
        }
        let name = |(i, view): (usize, &View)| match view {
            View::Path(_) => format!("path_{i:04}"),
            View::Frame(i) => self.scene.frames[*i].name.clone(),
        };
        let names: Vec<String> = views.iter().enumerate().map(name).collect();
        let stems = frames::file_stems(&names);
        let mut scored = Vec::with_capacity(views.len());
        for (view, (name, stem)) in views.iter().zip(names.into_iter().zip(stems)) {
            scored.push(self.render_one(renderer, result, view, (name, stem))?);
            bar.inc(1);
        }
        Ok(scored)
    }

    fn render_one(
        &self,
        renderer: &mut Renderer,
        result: &Reconstruction,
        view: &View,
        (name, stem): (String, String),
    ) -> Result<Scored> {
        let (camera, truth) = match view {
            View::Path(camera) => (*camera, None),
            View::Frame(i) => {
                let cropped = Photo::from_frame(&self.scene.frames[*i])?.crop(&self.crop)?;
                let enlarged = cropped.window.scale.min_element() < 1.0;
                (cropped.target_camera, Some((*i, cropped.target, enlarged)))
            }
        };
        let picture = renderer.render(result.splats(), &camera, &self.options);
        renderer.take_warning().iter().for_each(print_warning);
        let (width, height) = (picture.width, picture.height);
        let file = self.out.join(format!("images/{stem}.png"));
        save_png(&file, &Rgb::from(&picture))?;
        let depth = Depth { width, height, data: picture.depth };
        let depth_unit = save_depth_png(&self.out.join(format!("depth/{stem}.png")), &depth)?;
        let mut scored = Scored {
            name,
            stem,
            frame: None,
            camera,
            depth_unit,
            psnr: None,
            ssim: None,
            enlarged: false,
        };
        if let Some((frame, truth, enlarged)) = truth {
            let truth = truth.to_unit();
            scored.frame = Some(frame);
            scored.psnr = Some(psnr(&picture.rgb, &truth, width, height)?);
            scored.ssim = ssim(&picture.rgb, &truth, width, height).ok();
            scored.enlarged = enlarged;
        }
        Ok(scored)
    }
}

/// Writes `cameras.json` of the rendered views, in the scene's unit, with near and far.
pub fn write_cameras(out: &Path, views: &[Scored], units: Units, near_far: NearFar) -> Result<()> {
    let camera = |v: &Scored| NamedCamera {
        depth: Some(format!("depth/{}.png", v.stem)),
        ..NamedCamera::new(format!("images/{}.png", v.stem), v.camera)
    };
    let cameras = views.iter().map(camera).collect();
    let content = CameraFile { cameras, units, near_far: Some(near_far) };
    Ok(save_cameras_json(&out.join("cameras.json"), &content)?)
}

/// Writes `config.json`, which `--config` reads.
pub fn write_config(out: &Path, config: &Config) -> Result<()> {
    let text = serde_json::to_string_pretty(config)?;
    let write =
        |f: &mut std::io::BufWriter<std::fs::File>| std::io::Write::write_all(f, text.as_bytes());
    Ok(subsplat::io::write_atomic(&out.join("config.json"), write)?)
}

/// Writes the Gaussians in each of `formats`, and returns one report each.
pub fn write_scene(
    out: &Path,
    page: &Page<'_>,
    formats: &[SceneFormatArg],
    options: &SaveOptions,
) -> Result<Vec<Value>> {
    let mut distinct: Vec<SceneFormatArg> = Vec::new();
    for format in formats {
        if !distinct.contains(format) {
            distinct.push(*format);
        }
    }
    let one = |format: &SceneFormatArg| {
        let path = out.join(format.file_name());
        let html = *format == SceneFormatArg::Html;
        let saved = match html {
            true => page.write(&path, options)?,
            false => save_splats(&path, page.splats, options)?,
        };
        let mut value = serde_json::to_value(&saved)?;
        if html {
            value["format"] = json!("html");
        }
        value["file"] = json!(path.display().to_string());
        Ok(value)
    };
    distinct.iter().map(one).collect()
}
