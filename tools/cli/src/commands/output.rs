//! What `run` writes: pictures, depth, cameras, the scene in any format.
//!
//! `images/` holds the rendered views, `depth/` their depth, `inputs/` what the network
//! saw and its depth of it, `config.json` the model. With `cameras.json` the folder is a scene that every
//! command reads.

use super::args::SceneFormatArg;
use super::frames;
use super::pair::folder_of;
use crate::report::warn;
use anyhow::{Context, Result, bail};
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::path::Path;
use subsplat::abi::{Convention, RasterOptions};
use subsplat::camera::Camera;
use subsplat::config::Config;
use subsplat::data::crop::CropOptions;
use subsplat::io::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::io::image::{Depth, Rgb, save_depth_png, save_png};
use subsplat::io::scene::{Scene, SceneFormat, Units, is_scene};
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
    /// A frame of the scene, to be compared with its photograph.
    Frame(usize),
}

/// One rendered view, and its scores where there is a photograph.
pub struct Scored {
    /// Name of the frame, or of the view.
    pub name: String,
    /// Name of its pictures, without extension.
    pub stem: String,
    /// Index in the scene.
    pub frame: Option<usize>,
    camera: Camera,
    depth_unit: f32,
    /// dB; infinite where the pictures are the same.
    pub psnr: Option<f64>,
    /// `None` also for pictures smaller than the measure's window.
    pub ssim: Option<f64>,
    /// The photograph was smaller than the target and had to be enlarged.
    pub enlarged: bool,
}

impl Scored {
    /// For programs.
    pub fn json(&self) -> Value {
        json!({
            "frame": self.name,
            "index": self.frame,
            "image": format!("images/{}.png", self.stem),
            "depth": format!("depth/{}.png", self.stem),
            "depth_unit": self.depth_unit,
            // JSON knows no infinity: null, as for a view without photograph.
            "psnr": self.psnr.filter(|v| v.is_finite()),
            "ssim": self.ssim,
            "photograph_enlarged": self.enlarged,
        })
    }
}

/// Makes the output folder; before the network runs, so that nobody waits for nothing.
/// `input`: what the scene was read from.
///
/// # Errors
/// It cannot be made; it holds the very scene that is read, or poses of another one, which
/// would be overwritten or hidden by the new cameras.json.
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
    let own = scene.source != SceneFormat::Pair
        && std::fs::canonicalize(folder_of(input)).is_ok_and(|folder| folder == real);
    // Where cameras.json is read already, an earlier run's may lie.
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
    /// Where frames come from.
    pub scene: &'a Scene,
    /// Crop of a frame's photograph.
    pub crop: CropOptions,
    /// How to render.
    pub options: RasterOptions,
}

impl Views<'_> {
    /// All of `views`; one step of `bar` each.
    pub fn render(
        &self,
        renderer: &mut Renderer,
        result: &Reconstruction,
        views: &[View],
        bar: &ProgressBar,
    ) -> Result<Vec<Scored>> {
        for (i, (input, depth)) in result.inputs.iter().zip(&result.depths).enumerate() {
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
            scored.push(self.one(renderer, result, view, (name, stem))?);
            bar.inc(1);
        }
        Ok(scored)
    }

    fn one(
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
        let picture = renderer.render(&result.splats, &camera, &self.options);
        renderer.take_warning().iter().for_each(warn);
        let (width, height) = (picture.width, picture.height);
        let file = self.out.join(format!("images/{stem}.png"));
        save_png(&file, &to_rgb8(&picture.rgb, width, height))?;
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

/// Linear values to 8 bits, rounded.
pub fn to_rgb8(rgb: &[f32], width: usize, height: usize) -> Rgb {
    let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    Rgb { width, height, data: rgb.iter().map(byte).collect() }
}

/// `cameras.json` of the rendered views, in the scene's unit, with near and far.
pub fn write_cameras(
    out: &Path,
    views: &[Scored],
    units: Units,
    near_far: (f32, f32),
) -> Result<()> {
    let camera = |v: &Scored| NamedCamera {
        file: format!("images/{}.png", v.stem),
        camera: v.camera,
        timestamp: None,
        depth: Some(format!("depth/{}.png", v.stem)),
    };
    let cameras = views.iter().map(camera).collect();
    let content = CameraFile { cameras, units, near_far: Some(near_far) };
    Ok(save_cameras_json(&out.join("cameras.json"), &content)?)
}

/// `config.json`, which `--config` takes.
pub fn write_config(out: &Path, config: &Config) -> Result<()> {
    let text = serde_json::to_string_pretty(config)?;
    let write =
        |f: &mut std::io::BufWriter<std::fs::File>| std::io::Write::write_all(f, text.as_bytes());
    Ok(subsplat::io::write_atomic(&out.join("config.json"), write)?)
}

/// The scene in each of `formats`; one report each.
pub fn write_scene(
    out: &Path,
    result: &Reconstruction,
    formats: &[SceneFormatArg],
    options: &SaveOptions,
) -> Result<Vec<Value>> {
    let mut names: Vec<&str> = Vec::new();
    for format in formats {
        let name = match format {
            SceneFormatArg::Ply => "scene.ply",
            SceneFormatArg::Glb => "scene.glb",
            SceneFormatArg::Splat => "scene.splat",
            SceneFormatArg::Spz => "scene.spz",
        };
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let one = |name: &&str| {
        let path = out.join(name);
        let saved = save_splats(&path, &result.splats, options)?;
        let mut value = serde_json::to_value(&saved)?;
        value["file"] = json!(path.display().to_string());
        Ok(value)
    };
    names.iter().map(one).collect()
}

/// First words of the comment that carries how a scene is meant to be rendered.
const NOTE: &str = "subsplat render:";

/// `options` as a comment for a scene file; [`rendering`] reads it.
pub fn note(options: &RasterOptions) -> String {
    let convention = match options.convention {
        Convention::Standard => "standard",
        Convention::Mvsplat => "mvsplat",
    };
    let [r, g, b] = options.background;
    format!(
        "{NOTE} convention={convention} near={} lowpass={} background={r},{g},{b}",
        options.near, options.lowpass
    )
}

/// Convention, near plane, low-pass and background that [`note`] left among a file's
/// comments.
pub fn rendering(comments: &[String]) -> Option<RasterOptions> {
    let text = comments.iter().find_map(|c| c.trim().strip_prefix(NOTE))?;
    let value = |key: &str| text.split_whitespace().find_map(|w| w.strip_prefix(key));
    let number = |key: &str| value(key)?.parse::<f32>().ok().filter(|v| v.is_finite());
    let convention = match value("convention=")? {
        "standard" => Convention::Standard,
        "mvsplat" => Convention::Mvsplat,
        _ => return None,
    };
    let near = number("near=").filter(|v| *v > 0.0)?;
    let lowpass = number("lowpass=").filter(|v| *v >= 0.0)?;
    let mut options = RasterOptions { near, lowpass, ..RasterOptions::new(convention) };
    // Not in files of earlier versions.
    let channels = value("background=").map(|v| v.split(',').map(str::parse::<f32>));
    if let Some(Ok(rgb)) = channels.map(|all| all.collect::<Result<Vec<_>, _>>())
        && let Ok(rgb) = <[f32; 3]>::try_from(rgb)
        && rgb.iter().all(|v| (0.0..=1.0).contains(v))
    {
        options.background = rgb;
    }
    Some(options)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_file_remembers_how_it_is_rendered() {
        for (convention, near, lowpass) in
            [(Convention::Standard, 0.01f32, 0.3f32), (Convention::Mvsplat, 1.25, 1.2)]
        {
            let background = [near.min(1.0), 0.25, 0.0];
            let plain = RasterOptions::new(convention);
            let options = RasterOptions { near, lowpass, background, ..plain };
            assert_eq!(rendering(&["up is -y".to_owned(), note(&options)]), Some(options));
        }
        for bad in [
            "",
            "convention=gsplat near=1 lowpass=0.3",
            "convention=standard near=-1 lowpass=0.3",
            "convention=standard near=1 lowpass=nan",
            "near=1 lowpass=0.3",
        ] {
            assert_eq!(rendering(&[format!("{NOTE} {bad}")]), None, "{bad}");
        }
    }
}
