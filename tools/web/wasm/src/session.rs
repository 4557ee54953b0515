//! The photographs and the scene of one page.

use serde_json::{Value, json};
use std::ops::ControlFlow;
use std::path::Path;
use subsplat::loose::LooseOptions;
use subsplat::{
    Camera, FitOptions, LoadOptions, Options, Photo, Photograph, RasterOptions, Reconstructor,
    Refine, SaveOptions, SplatFormat, Splats, encode_splats, loose_photos, parse_photograph,
};

#[cfg(all(target_family = "wasm", target_os = "unknown"))]
#[link(wasm_import_module = "env")]
unsafe extern "C" {
    safe fn progress(stage: *const u8, length: usize, fraction: f32);
}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
fn progress(_: *const u8, _: usize, _: f32) {}

/// Reports a stage to the page.
fn report(stage: &str, fraction: f32) {
    progress(stage.as_ptr(), stage.len(), fraction);
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

    pub(crate) fn reconstruct(&mut self, upscale: usize, effort: u32) -> Result<Vec<u8>, String> {
        self.scene = None;
        let photographs = std::mem::take(&mut self.photographs);
        let (photos, mut warnings) = with_cameras(photographs)?;
        let mut options = Options::default();
        match effort {
            0 => options = options.with_fit(FitOptions::off()).with_refine(Refine::Off),
            1 => options = options.with_refine(Refine::Off),
            _ => {}
        }
        let model = Reconstructor::shipped(upscale).map_err(|e| e.to_string())?;
        let result = model
            .run_with(&photos, &options, &mut |p| {
                report(p.stage.name(), p.fraction);
                ControlFlow::Continue(())
            })
            .map_err(|e| e.to_string())?;
        warnings.extend(result.warnings().iter().map(ToString::to_string));
        self.scene = Some(Scene {
            options: *result.raster_options(),
            comments: result.comments(),
            cameras: result.inputs().iter().map(|c| c.target_camera).collect(),
            splats: result.into_splats(),
            warnings,
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
        })))
    }

    pub(crate) fn save(&self, extension: &[u8]) -> Result<Vec<u8>, String> {
        let scene = self.scene()?;
        let extension = String::from_utf8_lossy(extension);
        let format = SplatFormat::from_name(Path::new(&format!("scene.{extension}")))
            .ok_or_else(|| format!("expected ply, spz, glb or splat, got {extension:?}"))?;
        let options = SaveOptions { comments: scene.comments.clone(), ..SaveOptions::default() };
        encode_splats(format, &scene.splats, &options).map_err(|e| e.to_string())
    }
}

/// Estimates the cameras of photographs. Photographs without one are left out, with a warning.
fn with_cameras(
    photographs: Vec<(String, Photograph)>,
) -> Result<(Vec<Photo>, Vec<String>), String> {
    let (names, photographs): (Vec<String>, Vec<Photograph>) = photographs.into_iter().unzip();
    let mut warnings: Vec<String> = photographs.iter().flat_map(|p| p.warnings.clone()).collect();
    report("cameras", 0.0);
    let found =
        loose_photos(photographs, &LooseOptions::default()).map_err(|error| error.to_string())?;
    let estimate = &found.estimate;
    warnings.extend(
        estimate.left_out.iter().map(|l| format!("{} is left out: {}", names[l.photo], l.reason)),
    );
    warnings.extend(estimate.warnings.iter().map(|w| format!("estimated cameras: {w}")));
    Ok((found.photos, warnings))
}
