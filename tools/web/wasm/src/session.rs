//! The photographs and the scene of one page.

use crate::host;
use serde_json::{Value, json};
use std::ops::{ControlFlow, RangeInclusive};
use std::path::Path;
use subsplat::EstimateOptions;
use subsplat::{
    Backend, Camera, DeviceChoice, FitOptions, LoadOptions, Options, Photo, Photograph,
    RasterOptions, Reconstructor, Refine, SaveOptions, SplatFormat, Splats, Warning, encode_splats,
    estimate_cameras, parse_photograph,
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
    cameras: Vec<Camera>,
    warnings: Vec<String>,
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
        })
    }
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
        let (photos, mut warnings) = with_cameras(photographs)?;
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
        let result = model
            .run_with(&photos, &options, &mut |p| {
                report(p.stage.name(), p.fraction);
                ControlFlow::Continue(())
            })
            .map_err(|e| e.to_string())?;
        let (of_gpu, rest): (Vec<Warning>, Vec<Warning>) = result
            .warnings()
            .iter()
            .cloned()
            .partition(|warning| matches!(warning, Warning::CpuInsteadOfGpu { .. }));
        reason = of_gpu.last().map(Warning::to_string).or(reason);
        warnings.extend(Warning::sentences(&rest));
        let processor = if backend.is_cpu() { "cpu" } else { "gpu" };
        self.scene = Some(Scene {
            options: *result.raster_options(),
            comments: result.comments(),
            cameras: result.inputs().iter().map(|c| c.target_camera).collect(),
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
        Ok(bytes(&json!({
            "gaussians": scene.splats.len(),
            "background": scene.options.background,
            "cameras": scene.cameras,
            "warnings": scene.warnings,
            "network": {
                "processor": scene.network.processor,
                "reason": scene.network.reason,
            },
        })))
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

/// Opens `device` (`auto`, `cpu` or `gpu`). Returns the CPU and the reason where that fails.
fn open(device: &str) -> (Backend, Option<String>) {
    host::allow_waiting();
    let choice: DeviceChoice = device.parse().unwrap_or_default();
    match Backend::new(&choice) {
        Ok(backend) => (backend, None),
        Err(error) => (Backend::Cpu, Some(error.to_string())),
    }
}

/// Estimates the cameras of photographs. Photographs without one are left out, with a warning.
fn with_cameras(
    photographs: Vec<(String, Photograph)>,
) -> Result<(Vec<Photo>, Vec<String>), String> {
    let (names, photographs): (Vec<String>, Vec<Photograph>) = photographs.into_iter().unzip();
    let mut warnings: Vec<String> = photographs.iter().flat_map(|p| p.warnings.clone()).collect();
    report("cameras", 0.0);
    let found = estimate_cameras(photographs, &EstimateOptions::default())
        .map_err(|error| error.to_string())?;
    let estimate = &found.estimate;
    warnings.extend(estimate.left_out_sentences(|photo| names[photo].clone()));
    warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok((found.photos, warnings))
}
