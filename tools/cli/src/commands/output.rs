//! The output folder of `run`: pictures, depth, cameras, and the scene in any format.
//!
//! `images/` holds the rendered views, `depth/` their depth and `depth_colour/` the same to be
//! looked at. `inputs/` holds the network's
//! inputs with their depth, and `config.json` the model. `cameras.json` makes the folder a scene
//! that every command reads.

use super::args::{MotionArgs, RunArgs, SceneFormatArg};
use super::depth_colour::colour_depth;
use super::frames;
use super::html::Page;
use super::pair::folder_of;
use super::video::{self, Video};
use crate::report::{print_line, print_warning};
use anyhow::{Context, Result, bail};
use indicatif::ProgressBar;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use subsplat::files::photos::folder::find_photographs;
use subsplat::files::photos::image::{LoadOptions, probe, save_depth_png, save_png};
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::files::poses::scene::{LeftOut, Scene, has_scene, is_scene};
use subsplat::files::{SaveOptions, save_splats};
use subsplat::network::config::Config;
use subsplat::reconstruct::inputs::crop::{CropOptions, Cropped};
use subsplat::reconstruct::{Photo, Reconstruction};
use subsplat::scene::metrics::ssim;
use subsplat::scene::pictures::{Depth, Rgb};
use subsplat::scene::render::Renderer;
use subsplat::scene::score::psnr_of_kept;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::layout::RasterOptions;

/// Folders inside the output folder.
const FOLDERS: [&str; 4] = ["images", "depth", "depth_colour", "inputs"];

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

/// Refuses an output folder that a run of `input` cannot use. It creates nothing.
///
/// # Errors
/// No folder; a folder with the poses of a scene, which the new cameras.json would overwrite or hide; the folder in
/// which the photographs of `input` lie, which later runs would take for rendered pictures.
pub fn check(out: &Path, input: &[PathBuf]) -> Result<()> {
    let whole = std::path::absolute(out).with_context(|| out.display().to_string())?;
    let file = whole.ancestors().find(|part| part.exists()).filter(|part| !part.is_dir());
    if let Some(file) = file {
        bail!(
            "output folder {}: expected a folder, got a file ({})",
            out.display(),
            file.display()
        );
    }
    let real = std::fs::canonicalize(out).ok();
    let of_pictures = |path: &PathBuf| {
        let folder = match path.is_dir() {
            true if has_scene(path) || find_photographs(path).photographs.is_empty() => {
                return false;
            }
            true => path.as_path(),
            false if probe(path).is_err() => return false,
            false => folder_of(path),
        };
        real.is_some() && std::fs::canonicalize(folder).ok() == real
    };
    if input.iter().any(of_pictures) {
        bail!(holds_photographs(out));
    }
    // A cameras.json may be that of an earlier run, which is replaced.
    if is_scene(out) && !out.join("cameras.json").is_file() {
        bail!(holds_poses(out));
    }
    Ok(())
}

fn holds_photographs(out: &Path) -> String {
    format!("output folder {}: holds the photographs that are read; choose another", out.display())
}

fn holds_poses(out: &Path) -> String {
    format!(
        "output folder {}: holds the poses of a scene, which the cameras.json that is written would replace; \
         choose another",
        out.display()
    )
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
            bail!(holds_photographs(out));
        }
    }
    let own = scene.source.has_file()
        && std::fs::canonicalize(folder_of(input)).is_ok_and(|folder| folder == real);
    if own {
        bail!(holds_poses(out));
    }
    remove_earlier(out);
    FOLDERS.iter().try_for_each(|f| make(&out.join(f)))
}

/// Removes the files that an earlier run into `out` lists in its metrics.json, so that none of them
/// is taken for a result of this one. Files of other programs stay.
fn remove_earlier(out: &Path) {
    let Ok(text) = std::fs::read_to_string(out.join("metrics.json")) else { return };
    let Ok(report) = serde_json::from_str::<Value>(&text) else { return };
    let list = |key: &str| report[key].as_array().cloned().unwrap_or_default();
    // A name, without the folder that it had then: the output folder may have moved.
    let name =
        |v: &Value| Path::new(v.as_str()?).file_name().map(|n| n.to_string_lossy().into_owned());
    let mut files: Vec<String> = Vec::new();
    for view in list("targets") {
        for folder in ["images", "depth", "depth_colour"] {
            files.extend(name(&view["image"]).map(|n| format!("{folder}/{n}")));
        }
    }
    for i in 0..list("context").len() {
        let of_input = ["", "_depth", "_children"];
        files.extend(of_input.map(|what| format!("inputs/{i}{what}.png")));
    }
    files.extend(list("files").iter().filter_map(|f| name(&f["file"])));
    for file in files {
        // One that is gone already, or that cannot be removed, does not stop the run.
        let _ = std::fs::remove_file(out.join(file));
    }
}

/// Pictures of the number of children of each input pixel, one for each photograph: black where there
/// are none, white for the most. Empty where all pixels have the same number.
fn children_maps(result: &Reconstruction) -> Vec<Rgb> {
    let counts = result.children_counts();
    let most = counts.iter().copied().max().unwrap_or(0).max(1);
    let per_view = counts.len() / result.inputs().len().max(1);
    let map = |(input, counts): (&Cropped, &[u8])| {
        let (width, height) = (input.input.width, input.input.height);
        // MVSplat may give a pixel several Gaussians; the first one counts.
        let per_pixel = (counts.len() / (width * height).max(1)).max(1);
        let grey = |k: &u8| (255.0 * (f32::from(*k) / f32::from(most)).sqrt()).round() as u8;
        let data = counts.iter().step_by(per_pixel).flat_map(|k| [grey(k); 3]).collect();
        Rgb { width, height, data }
    };
    result.inputs().iter().zip(counts.chunks(per_view.max(1))).map(map).collect()
}

/// Renders, scores and writes views one by one.
pub struct Views<'a> {
    /// Output folder.
    pub out: &'a Path,
    /// The scene of the frames.
    pub scene: &'a Scene,
    /// Decoding of a frame's photograph.
    pub load: LoadOptions,
    /// The frames were named: each is needed.
    pub named: bool,
    /// Frames whose photographs cannot be read, and which are not drawn.
    pub left_out: Vec<LeftOut>,
    /// Crop of a frame's photograph.
    pub crop: CropOptions,
    /// Rules to render.
    pub options: RasterOptions,
    /// Animation of the views.
    pub motion: &'a MotionArgs,
    /// The animation so far.
    pub video: Option<Video>,
}

impl Views<'_> {
    /// Renders all of `views`, with one step of `bar` each.
    pub fn render(
        &mut self,
        renderer: &mut Renderer,
        result: &Reconstruction,
        views: &[View],
        bar: &ProgressBar,
    ) -> Result<Vec<Scored>> {
        for (i, (input, depth)) in result.inputs().iter().zip(result.depths()).enumerate() {
            save_png(self.out.join(format!("inputs/{i}.png")), &input.input)?;
            save_depth_png(self.out.join(format!("inputs/{i}_depth.png")), depth)?;
        }
        for (i, map) in children_maps(result).iter().enumerate() {
            save_png(self.out.join(format!("inputs/{i}_children.png")), map)?;
        }
        let name = |(i, view): (usize, &View)| match view {
            View::Path(_) => format!("path_{i:04}"),
            View::Frame(i) => self.scene.frames[*i].name.clone(),
        };
        let names: Vec<String> = views.iter().enumerate().map(name).collect();
        let stems = frames::file_stems(&names);
        let mut scored = Vec::with_capacity(views.len());
        for (view, (name, stem)) in views.iter().zip(names.into_iter().zip(stems)) {
            bar.inc(1);
            let (camera, truth) = match view {
                View::Path(camera) => (*camera, None),
                View::Frame(i) => {
                    let Some(cropped) = self.photograph(*i)? else { continue };
                    (cropped.target_camera, Some((*i, cropped)))
                }
            };
            scored.push(self.render_one(renderer, result, camera, truth, (name, stem))?);
        }
        Ok(scored)
    }

    /// The photograph of a frame; `None` for one that cannot be read and that nobody named.
    fn photograph(&mut self, frame: usize) -> Result<Option<Cropped>> {
        let frame = &self.scene.frames[frame];
        match Photo::from_frame_with(frame, &self.load) {
            Ok(photo) => Ok(Some(photo.crop(&self.crop)?)),
            Err(subsplat::Error::Io(error)) if !self.named => {
                let left = LeftOut::of_frame(frame, &error);
                print_warning(format!("{} is not drawn: {}", left.name, left.reason));
                self.left_out.push(left);
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }

    fn render_one(
        &mut self,
        renderer: &mut Renderer,
        result: &Reconstruction,
        camera: Camera,
        truth: Option<(usize, Cropped)>,
        (name, stem): (String, String),
    ) -> Result<Scored> {
        let picture = renderer.render(result.splats(), &camera, &self.options);
        renderer.take_warning().iter().for_each(print_warning);
        let (width, height) = (picture.width, picture.height);
        let file = self.out.join(format!("images/{stem}.png"));
        let rgb = Rgb::from(&picture);
        save_png(&file, &rgb)?;
        video::push(&mut self.video, self.motion, &rgb)?;
        let depth = Depth { width, height, data: picture.depth };
        let depth_unit = save_depth_png(self.out.join(format!("depth/{stem}.png")), &depth)?;
        save_png(self.out.join(format!("depth_colour/{stem}.png")), &colour_depth(&depth))?;
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
        if let Some((frame, cropped)) = truth {
            let enlarged = cropped.window.scale.min_element() < 1.0;
            let (truth, mask) = (cropped.target.to_unit(), cropped.target_mask);
            scored.frame = Some(frame);
            // Masked pixels count as equal in the windows of SSIM.
            scored.psnr = Some(psnr_of_kept(&picture.rgb, &truth, (width, height), mask.as_ref())?);
            let merged = mask.map(|mask| mask.merged(&picture.rgb, &truth));
            let seen = merged.as_deref().unwrap_or(&picture.rgb);
            scored.ssim = ssim(seen, &truth, width, height).ok();
            scored.enlarged = enlarged;
        }
        Ok(scored)
    }
}

/// Writes `cameras.json` of the rendered views, in the scene's unit, with near and far.
pub fn write_cameras(out: &Path, views: &[Scored], scene: &Scene, near_far: NearFar) -> Result<()> {
    let camera = |v: &Scored| NamedCamera {
        depth: Some(format!("depth/{}.png", v.stem)),
        ..NamedCamera::new(format!("images/{}.png", v.stem), v.camera)
    };
    let cameras = views.iter().map(camera).collect();
    let Scene { units, origin, .. } = *scene;
    let content = CameraFile { cameras, units, near_far: Some(near_far), origin };
    Ok(save_cameras_json(out.join("cameras.json"), &content)?)
}

/// Writes `config.json`, which `--config` reads.
pub fn write_config(out: &Path, config: &Config) -> Result<()> {
    let text = serde_json::to_string_pretty(config)?;
    let write =
        |f: &mut std::io::BufWriter<std::fs::File>| std::io::Write::write_all(f, text.as_bytes());
    Ok(subsplat::files::write_atomic(out.join("config.json"), write)?)
}

/// Most Gaussians of a .spz, and so of a .html: the limit of its readers.
const SPZ_COUNT_MAX: u64 = 10_000_000;
/// Largest .glb: its header counts bytes with 32 bits.
const GLB_BYTES_MAX: u64 = u32::MAX as u64;
/// Size of a page that nobody asked for by name, bytes.
const PAGE_BYTES: usize = 12_000_000;
/// Size of a scene file that is announced before the work, bytes.
const ANNOUNCED: u64 = 90_000_000;
/// Largest .ply with SH of degree 3 by default; a larger one has the scene's own degree.
const PLY_PADDED_MAX: u64 = 150_000_000;

/// Largest size of a scene file of `count` Gaussians with SH of `stored` degrees, of which `asked`
/// are written, bytes; .spz and .html are compressed, .html contains base64.
fn bytes_at_most(format: SceneFormatArg, count: u64, stored: usize, asked: Option<usize>) -> u64 {
    let asked = asked.unwrap_or(3);
    let rest = |degree: usize| 3 * (degree + 1).pow(2) as u64 - 3;
    let kept = rest(stored.min(asked));
    match format {
        SceneFormatArg::Ply => count * 4 * (17 + rest(asked)),
        // Position, rotation, scales, opacity, SH, and a colour of four 16-bit numbers.
        SceneFormatArg::Glb => count * (4 * (11 + 3 + kept) + 8),
        SceneFormatArg::Splat => count * 32,
        SceneFormatArg::Spz => count * (20 + kept),
        // Pictures of 19 bytes a splat, and the palette of 65,536 sets of SH.
        SceneFormatArg::Sog => count * 20 + count.min(65536) * kept,
        SceneFormatArg::Html => count * (20 + kept) * 4 / 3,
    }
}

/// Refuses formats that cannot hold the scene of a run, before the work, and prints the size of
/// large files. The scene has at most `count` Gaussians with SH of `degree`.
pub fn check_formats(args: &RunArgs, count: u64, degree: usize) -> Result<()> {
    for format in &args.formats() {
        let written = written_degree(args.content.sh, count, degree);
        let bytes = bytes_at_most(*format, count, degree, written);
        if *format == SceneFormatArg::Html && !args.whole_page() {
            continue;
        }
        check_format(*format, count, bytes, args.content.min_opacity)?;
        if *format == SceneFormatArg::Ply && bytes > ANNOUNCED {
            let [ply, spz] = [bytes, bytes_at_most(SceneFormatArg::Spz, count, degree, written)]
                .map(|bytes| bytes / 1_000_000);
            let padded = match written {
                Some(degree) if args.content.sh.is_none() => format!(
                    "; its colours have degree {degree} (--sh 3 adds zeros that some viewers expect)"
                ),
                _ => String::new(),
            };
            print_line(format!(
                "scene.ply takes up to {ply} MB for {count} splats, and --save spz up to {spz} MB{padded}"
            ));
        }
    }
    Ok(())
}

/// Degree of the SH that the files of a scene of `count` Gaussians with SH of `degree` have, of which
/// `asked` are asked for; `None` leaves it to the format.
pub fn written_degree(asked: Option<usize>, count: u64, degree: usize) -> Option<usize> {
    let padded = bytes_at_most(SceneFormatArg::Ply, count, degree, None);
    let own = (padded > PLY_PADDED_MAX).then_some(degree.min(3));
    asked.or(own)
}

/// [`check_formats`] of one file. A least opacity may leave fewer Gaussians, so that nothing is
/// refused with one.
fn check_format(format: SceneFormatArg, count: u64, bytes: u64, min_opacity: f32) -> Result<()> {
    let name = format.file_name();
    let limit = match format {
        SceneFormatArg::Spz | SceneFormatArg::Html if count > SPZ_COUNT_MAX => {
            Some(format!("at most {SPZ_COUNT_MAX} splats"))
        }
        SceneFormatArg::Glb if bytes > GLB_BYTES_MAX => {
            Some(format!("at most {:.1} GB", GLB_BYTES_MAX as f64 / 1e9))
        }
        _ => None,
    };
    if let Some(limit) = limit.filter(|_| min_opacity == 0.0) {
        bail!(
            "--save: {name} holds {limit}, and this run gives {count} splats ({:.1} GB); choose another \
             format, or fewer splats by --gaussians or a smaller --upscale",
            bytes as f64 / 1e9
        );
    }
    if bytes > ANNOUNCED && format != SceneFormatArg::Ply {
        let size = bytes as f64 / 1e6;
        print_line(format!("{name} takes up to {size:.0} MB for {count} splats"));
    }
    Ok(())
}

/// Writes the Gaussians in each format of `args`, and returns one report each.
pub fn write_scene(args: &RunArgs, page: &Page<'_>, options: &SaveOptions) -> Result<Vec<Value>> {
    let one = |format: &SceneFormatArg| {
        let path = args.out.join(format.file_name());
        let html = *format == SceneFormatArg::Html;
        let saved = match html {
            true if args.whole_page() => page.write(&path, options)?,
            true => page.write_within(&path, options, PAGE_BYTES, &mut Renderer::default())?,
            false => save_splats(&path, page.splats, options)?,
        };
        saved.notes().iter().for_each(print_warning);
        let mut value = serde_json::to_value(&saved)?;
        if html {
            value["format"] = json!("html");
        }
        value["file"] = json!(path.display().to_string());
        Ok(value)
    };
    args.formats().iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_refused_before_the_work() {
        use SceneFormatArg::{Glb, Html, Ply, Spz};
        let check = |format, count, opacity| {
            check_format(format, count, bytes_at_most(format, count, 3, None), opacity)
        };
        let error = check(Spz, 10_000_001, 0.0).unwrap_err().to_string();
        assert!(error.contains("scene.spz holds at most 10000000 splats"), "{error}");
        assert!(check(Html, 10_000_001, 0.0).is_err());
        assert!(check(Spz, 10_000_001, 0.1).is_ok() && check(Spz, 10_000_000, 0.0).is_ok());
        let error = check(Glb, 20_000_000, 0.0).unwrap_err().to_string();
        assert!(error.contains("at most 4.3 GB"), "{error}");
        assert!(check(Ply, 20_000_000, 0.0).is_ok());
        assert_eq!(bytes_at_most(Ply, 2_097_152, 1, None), 520_093_696);
        assert_eq!(bytes_at_most(Ply, 1000, 1, Some(0)), 68_000);
        // All splats of two photographs at twice the input's size keep the 45 values.
        assert_eq!(written_degree(None, 524_288, 1), None);
        let most = subsplat::Density::Auto.limit(1 << 20, 2, 2) as u64;
        assert_eq!(written_degree(None, most, 1), Some(1));
        assert!(bytes_at_most(Ply, most, 1, Some(1)) < 100_000_000);
        assert_eq!(
            (written_degree(Some(3), most, 1), written_degree(None, most, 4)),
            (Some(3), Some(3))
        );
    }
}
