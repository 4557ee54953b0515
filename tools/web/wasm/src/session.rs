//! The photographs and the scene of one page.

use crate::host;
use serde_json::{Value, json};
use std::ops::{ControlFlow, RangeInclusive};
use std::path::Path;
use subsplat::scene::render::comment_of_photograph;
use subsplat::{
    Backend, Camera, DeviceChoice, EstimateOptions, FitOptions, KnownLens, LoadOptions, Options,
    Photo, Photograph, Progress, RasterOptions, Reconstruction, Reconstructor, Refine, Renderer,
    SaveOptions, SceneSoFar, SplatFormat, Splats, Warning, encode_splats, estimate_cameras,
    parse_photograph,
};

/// Reports a stage to the page.
fn report(stage: &str, fraction: f32) {
    host::progress(stage.as_ptr(), stage.len(), fraction);
}

/// State between calls.
#[derive(Default)]
pub(crate) struct Session {
    photographs: Vec<(String, Photograph)>,
    scene: Option<Scene>,
}

struct Scene {
    splats: Splats,
    options: RasterOptions,
    /// Lines for the header of a .ply or .glb.
    comments: Vec<String>,
    /// Names and cameras of the photographs.
    cameras: Vec<(String, Camera)>,
    warnings: Vec<String>,
    /// JSON of the verdict: `trust` and `reason`.
    verdict: Value,
    network: Network,
}

/// Options of a reconstruction.
struct Request {
    /// r: side of the grid of Gaussians of an input pixel.
    upscale: usize,
    /// 0: the network alone; 1: a fit to the photographs; 2: a refinement too.
    effort: usize,
    /// Side of a square with as many pixels as the network's input.
    size: usize,
    /// The network's device.
    network: String,
    /// Focal length of the photographs as of 35 mm film, mm; `None` leaves it to them.
    focal: Option<f32>,
}

impl Request {
    /// Reads a JSON object of strings.
    fn parse(input: &[u8]) -> Result<Self, String> {
        let json: Value = serde_json::from_slice(input).map_err(|e| format!("options: {e}"))?;
        let text = |name: &str| json[name].as_str().unwrap_or_default().to_owned();
        let number = |name: &str, range: RangeInclusive<usize>| {
            let (text, [low, high]) = (text(name), [range.start(), range.end()]);
            let found = text.parse().ok().filter(|n| range.contains(n));
            found.ok_or_else(|| format!("{name}: expected {low} to {high}, got {text:?}"))
        };
        Ok(Self {
            upscale: number("upscale", 1..=8)?,
            effort: number("effort", 0..=2)?,
            size: number("size", 32..=1024)?,
            network: text("network"),
            focal: Some(text("focal")).filter(|text| !text.is_empty()).map(focal).transpose()?,
        })
    }
}

/// Shortest and longest focal length that a person may give, mm of 35 mm film.
const FOCAL_MM: [f32; 2] = [8.0, 400.0];
/// Diagonal of a photograph on 35 mm film, mm.
const FILM_DIAGONAL_MM: f32 = 43.27;

fn focal(text: String) -> Result<f32, String> {
    let [least, most] = FOCAL_MM;
    let found = text.parse::<f32>().ok().filter(|mm| (least..=most).contains(mm));
    found.ok_or_else(|| format!("Focal length: expected {least} to {most} mm, got {text:?}"))
}

/// The lens of a focal length as of 35 mm film, which the diagonal defines, for photographs of the size of the first.
fn lens(focal_mm: f32, photographs: &[(String, Photograph)]) -> Option<KnownLens> {
    let image = &photographs.first()?.1.image;
    let (width, height) = (image.width as f32, image.height as f32);
    let focal_px = focal_mm * width.hypot(height) / FILM_DIAGONAL_MM;
    Some(KnownLens::FovX(2.0 * (0.5 * width / focal_px).atan()))
}

/// Processor that ran the network.
struct Network {
    /// `gpu`, or `cpu`.
    processor: &'static str,
    /// Reason for which the CPU did all or some of a GPU's work.
    reason: Option<String>,
}

/// Splits the input into a name and a file.
fn named(input: &[u8], name_length: usize) -> Result<(&Path, &[u8]), String> {
    let (name, file) = input
        .split_at_checked(name_length)
        .ok_or_else(|| format!("expected a name of {name_length} bytes, got {}", input.len()))?;
    let name = std::str::from_utf8(name).map_err(|e| format!("name of the file: {e}"))?;
    Ok((Path::new(name), file))
}

fn bytes(answer: &Value) -> Vec<u8> {
    answer.to_string().into_bytes()
}

impl Session {
    pub(crate) fn add_photograph(
        &mut self,
        input: &[u8],
        name_length: usize,
    ) -> Result<Vec<u8>, String> {
        let (name, file) = named(input, name_length)?;
        let photograph =
            parse_photograph(file, &LoadOptions::default(), name).map_err(|e| e.to_string())?;
        let (width, height) = (photograph.image.width, photograph.image.height);
        let answer = json!({ "width": width, "height": height, "warnings": photograph.warnings });
        self.photographs.push((name.display().to_string(), photograph));
        Ok(bytes(&answer))
    }

    pub(crate) fn reconstruct(&mut self, request: &[u8]) -> Result<Vec<u8>, String> {
        self.scene = None;
        let photographs = std::mem::take(&mut self.photographs);
        let request = Request::parse(request)?;
        let lens = request.focal.and_then(|focal| lens(focal, &photographs));
        let Found { photos, names, mut warnings } = with_cameras(photographs, lens)?;
        let mut options = Options::default().with_input_area(request.size * request.size);
        match request.effort {
            0 => options = options.with_fit(FitOptions::off()).with_refine(Refine::Off),
            1 => options = options.with_refine(Refine::Off),
            // A page has fewer threads and half of the vector's width: nine steps for each of five photographs or more.
            _ if photos.len() > 2 => options = options.with_refine(Refine::Each(3)),
            _ => {}
        }
        let (backend, mut reason) = open(&request.network);
        let model = Reconstructor::shipped(request.upscale).map_err(|e| e.to_string())?;
        let model = model.with_backend(&backend);
        let mut progress = |p: Progress| {
            report(p.stage.name(), p.fraction);
            ControlFlow::Continue(())
        };
        let prepared = model.prepare_with(&photos, &options, &mut progress);
        let prepared = prepared.map_err(|e| e.to_string())?;
        let places: Vec<Camera> = prepared.inputs().iter().map(|c| c.target_camera).collect();
        let cameras: Vec<(String, Camera)> = names.into_iter().zip(places).collect();
        let mut show = |scene: &SceneSoFar<'_>| host::show(|| so_far(scene, &cameras));
        let result = prepared.reconstruct_showing(&mut progress, &mut show);
        let result = result.map_err(|e| e.to_string())?;
        let (of_gpu, rest): (Vec<Warning>, Vec<Warning>) = result
            .warnings()
            .iter()
            .cloned()
            .partition(|warning| matches!(warning, Warning::CpuInsteadOfGpu { .. }));
        reason = of_gpu.last().map(Warning::to_string).or(reason);
        warnings.extend(Warning::sentences(&rest));
        let processor = if backend.is_cpu() { "cpu" } else { "gpu" };
        let photographs = cameras.iter().map(|(name, camera)| comment_of_photograph(name, camera));
        self.scene = Some(Scene {
            options: *result.raster_options(),
            comments: result.comments().into_iter().chain(photographs).collect(),
            cameras,
            verdict: verdict(&result)?,
            splats: result.into_splats(),
            warnings,
            network: Network { processor, reason },
        });
        self.describe()
    }

    fn scene(&self) -> Result<&Scene, String> {
        self.scene.as_ref().ok_or_else(|| "there is no scene yet".to_owned())
    }

    fn describe(&self) -> Result<Vec<u8>, String> {
        let scene = self.scene()?;
        let mut description = views(&scene.options, &scene.cameras);
        description["gaussians"] = json!(scene.splats.len());
        description["verdict"] = json!(scene.verdict);
        description["warnings"] = json!(scene.warnings);
        let Network { processor, reason } = &scene.network;
        description["network"] = json!({ "processor": processor, "reason": reason });
        Ok(bytes(&description))
    }

    pub(crate) fn save(&self, extension: &[u8]) -> Result<Vec<u8>, String> {
        let scene = self.scene()?;
        let extension = String::from_utf8_lossy(extension);
        let format = SplatFormat::from_name(Path::new(&format!("scene.{extension}")))
            .ok_or_else(|| format!("expected ply, spz, sog, glb or splat, got {extension:?}"))?;
        let options = SaveOptions { comments: scene.comments.clone(), ..SaveOptions::default() };
        encode_splats(format, &scene.splats, &options).map_err(|e| e.to_string())
    }
}

/// Description of a scene as the viewer reads it: its background, and the photographs' own cameras.
fn views(options: &RasterOptions, cameras: &[(String, Camera)]) -> Value {
    json!({
        "background": options.background,
        "cameras": cameras.iter().map(named_camera).collect::<Vec<_>>(),
        "photographs": true,
    })
}

/// Description and .spz of a scene that is being refined; `None` where it cannot be encoded.
fn so_far(scene: &SceneSoFar<'_>, cameras: &[(String, Camera)]) -> Option<[Vec<u8>; 2]> {
    let description = bytes(&views(&scene.raster_options(), cameras));
    let spz = encode_splats(SplatFormat::Spz, &scene.splats(), &SaveOptions::default()).ok()?;
    Some([description, spz])
}

/// Judges a scene by its photographs.
fn verdict(result: &Reconstruction) -> Result<Value, String> {
    report("verdict", 0.0);
    let judged = result.assess(&mut Renderer::default(), result.raster_options());
    Ok(json!(judged.map_err(|e| e.to_string())?.verdict))
}

fn named_camera((name, camera): &(String, Camera)) -> Value {
    let mut value = json!(camera);
    value["name"] = json!(name);
    value
}

/// Opens `device` (`auto`, `cpu` or `gpu`). Returns the CPU and the reason where that fails.
fn open(device: &str) -> (Backend, Option<String>) {
    host::allow_waiting();
    let choice: DeviceChoice = device.parse().unwrap_or_default();
    match Backend::new(&choice) {
        Ok(backend) => (backend, None),
        Err(error) => (Backend::Cpu, Some(error.to_string())),
    }
}

/// Photographs with cameras, their names without extensions, and warnings.
struct Found {
    photos: Vec<Photo>,
    names: Vec<String>,
    warnings: Vec<String>,
}

/// Estimates the cameras of photographs, all of `lens` where it is known. Photographs without one are left out, with a
/// warning.
fn with_cameras(
    photographs: Vec<(String, Photograph)>,
    lens: Option<KnownLens>,
) -> Result<Found, String> {
    let (names, photographs): (Vec<String>, Vec<Photograph>) = photographs.into_iter().unzip();
    let mut warnings: Vec<String> = photographs.iter().flat_map(|p| p.warnings.clone()).collect();
    report("cameras", 0.0);
    let options = EstimateOptions { lens, ..EstimateOptions::default() };
    let found = estimate_cameras(photographs, &options).map_err(|error| error.to_string())?;
    if found.straightened.is_some() {
        warnings
            .push("the lens bends straight lines: the photographs were straightened".to_owned());
    }
    let estimate = &found.estimate;
    warnings.extend(estimate.left_out_sentences(|photo| names[photo].clone()));
    warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    let placed = names.iter().zip(&estimate.cameras).filter(|(_, camera)| camera.is_some());
    let stem =
        |name: &String| Path::new(name).file_stem().map(|s| s.to_string_lossy().into_owned());
    let names = placed.map(|(name, _)| stem(name).unwrap_or_default()).collect();
    Ok(Found { photos: found.photos, names, warnings })
}
