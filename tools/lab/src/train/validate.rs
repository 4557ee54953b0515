//! Evaluates the averaged weights on held-out scenes through the inference path: the scores of the
//! weights that would ship.

use super::Result;
use super::config::{Phase, TrainConfig};
use super::loss::{block_median, candidate_index};
use super::source::{Example, Rooms, Source, hash};
use super::step::{raster_options, views_of};
use crate::data::dataset::Posed;
use candle_core::Tensor;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat::files::photos::image::save_png;
use subsplat::network::config::{Backbone, Config};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::{SUBSPLAT_PREFIX, Weights};
use subsplat::scene::metrics::{psnr, ssim};
use subsplat::scene::pictures::Rgb;
use subsplat_cli::lettering;

/// Key mixed into the data's seed, which gives other scenes than those of the training.
const HELD_OUT: u64 = 0x48_45_4C_44;
/// Number of scenes on the contact sheet.
const SHEET_SCENES: usize = 4;

/// Scores, means over the held-out scenes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Found {
    /// PSNR of the targets, dB.
    pub psnr: f64,
    /// SSIM of the targets.
    pub ssim: f64,
    /// Error of disparity, candidates (small backbone only).
    pub disparity: f64,
    /// Share of pixels with an error of at most one candidate.
    pub within_one: f64,
    /// PSNR of a copy of the nearer input, dB: a lower bound for a useful model.
    pub copy_psnr: f64,
}

/// Held-out scenes and photographs.
pub struct Validator {
    model: Config,
    scenes: Vec<Arc<Example>>,
    photos: Vec<Arc<Example>>,
}

/// Part of the procedural rooms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Rooms for training.
    Training,
    /// Rooms for validation, which training never uses.
    HeldOut,
}

/// Returns the generator of `config` for one part of the rooms.
///
/// # Errors
/// An invalid model configuration.
pub fn rooms(config: &TrainConfig, split: Split) -> Result<Rooms> {
    let held_out = split == Split::HeldOut;
    let data = &config.data;
    let ratio = config.model_config()?.upscale;
    let [w, h] = data.input;
    // The depth phase renders targets for validation only.
    let count = if config.phase == Phase::Depth && !held_out { 0 } else { data.targets };
    let mut spec = crate::data::procedural::ExampleSpec::new(w, h, count);
    spec.cameras.crop = data.crop;
    spec.photographic = data.photographic;
    spec.foreground = data.foreground;
    spec.scattered = data.scattered;
    spec.floating = data.floating;
    spec.log_baseline = data.log_baseline;
    spec.wide = data.wide;
    spec.samples = data.samples;
    let targets = crate::data::procedural::TargetSpec {
        ratio,
        samples: data.target_samples,
        clean: true,
        inputs: data.input_targets && config.phase == Phase::Render && !held_out,
    };
    let seed = if held_out { hash(data.seed, HELD_OUT) } else { data.seed };
    let scenes = if held_out { 0 } else { data.scenes };
    let sizes = data.sizes.clone();
    let seen_range = data.seen_range;
    let detail = data.detail;
    Ok(Rooms { seed, scenes, spec, targets, sizes, seen_range, detail })
}

impl Validator {
    /// Returns a validator that evaluates nothing.
    ///
    /// # Errors
    /// An invalid model configuration.
    pub fn without_scenes(config: &TrainConfig) -> Result<Self> {
        Ok(Self { model: config.model_config()?, scenes: Vec::new(), photos: Vec::new() })
    }

    /// Makes the scenes, and reads the photographs in `photos`, which are evaluated only.
    ///
    /// # Errors
    /// An invalid configuration; photographs that cannot be read.
    pub fn new(config: &TrainConfig, photos: Option<&Path>) -> Result<Self> {
        let mut rooms = rooms(config, Split::HeldOut)?;
        rooms.targets.samples = rooms.targets.samples.max(2);
        rooms.spec.cameras.targets = 1;
        let scenes = (0..config.validate.scenes as u64)
            .map(|i| rooms.example(i))
            .collect::<Result<Vec<_>>>()?;
        let model = config.model_config()?;
        let photos = match photos {
            Some(folder) => super::photos::pairs(folder, model.stride())?,
            None => Vec::new(),
        };
        Ok(Self { model, scenes, photos })
    }

    /// Scores `weights` on procedural scenes and on photographs (`None` where there are none).
    ///
    /// With a path, it also writes a contact sheet for each: inputs, prediction, target and depth
    /// with their labels, at `path` with `-rooms.png` and `-photos.png`.
    ///
    /// # Errors
    /// Weights that do not fit or give values that are not finite; a sheet that cannot be written.
    pub fn evaluate(
        &self,
        weights: BTreeMap<String, Tensor>,
        sheet: Option<&Path>,
    ) -> Result<[Option<Found>; 2]> {
        // As in `subsplat::reconstruct`: heads without weights split each pixel evenly.
        let weights = Weights::from_tensors(weights).allow_missing(SUBSPLAT_PREFIX, 0);
        let model = SubSplat::new(&self.model, weights.builder())?;
        let path = |end: &str| {
            let path = sheet?;
            let mut name = path.file_name()?.to_owned();
            name.push(end);
            Some(path.with_file_name(name))
        };
        Ok([
            self.evaluate_scenes(&model, &self.scenes, path("-rooms.png"))?,
            self.evaluate_scenes(&model, &self.photos, path("-photos.png"))?,
        ])
    }

    /// Scores the model on `scenes` and writes their contact sheet.
    fn evaluate_scenes(
        &self,
        model: &SubSplat,
        scenes: &[Arc<Example>],
        sheet: Option<PathBuf>,
    ) -> Result<Option<Found>> {
        if scenes.is_empty() {
            return Ok(None);
        }
        let mut found = Found::default();
        let mut rows = Vec::new();
        // Rows at regular intervals, so that the sheet shows different scenes.
        let stride = scenes.len().div_ceil(SHEET_SCENES);
        for (i, scene) in scenes.iter().enumerate() {
            let one = self.evaluate_scene(model, scene)?;
            let share = 1.0 / scenes.len() as f64;
            found.psnr += share * one.found.psnr;
            found.ssim += share * one.found.ssim;
            found.disparity += share * one.found.disparity;
            found.within_one += share * one.found.within_one;
            found.copy_psnr += share * one.found.copy_psnr;
            if i % stride == 0 {
                rows.push(one.pictures);
            }
        }
        if let Some(path) = sheet {
            save_png(&path, &tiled(&rows))?;
        }
        Ok(Some(found))
    }

    /// Scores the model on one scene.
    fn evaluate_scene(&self, model: &SubSplat, scene: &Example) -> Result<SceneResult> {
        let mut views = views_of(&[scene])?;
        // Known depth is compared in candidates of the example's range. Without it the model
        // estimates the range.
        if scene.inverse_depth.is_empty() {
            views = model.estimate_depth_range(&views)?;
        }
        let output = model.encode(&views)?;
        let parents = model.primaries(&views, &output)?;
        let mut found = Found::default();
        let distances = output.depths.narrow(3, 0, 1)?.flatten_all()?.to_vec1::<f32>()?;
        let depth = self.depth_scores(scene, &distances, &mut found);
        let mut trunk = model.trunk().clone();
        if scene.upscale() > 1 {
            // Photographs have targets of the input's size, for which the model keeps its own r.
            trunk.set_upscale(scene.upscale())?;
        }
        let input = |(i, p): (usize, &Posed)| Labelled::new(format!("input {}", i + 1), &p.image);
        let mut pictures: Vec<Labelled> = scene.context.iter().enumerate().map(input).collect();
        for target in &scene.targets {
            let k = target.camera.intrinsics();
            let options = raster_options(&self.model, scene, &target.camera);
            let planes = trunk.render(&views, &output, &parents, &target.camera, &options)?;
            let rgb = planes.narrow(0, 0, 3)?.flatten_all()?.to_vec1::<f32>()?;
            let rgb: Vec<f32> = rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
            let Some(picture) = Rgb::from_planes(&rgb, k.width, k.height) else { continue };
            let share = 1.0 / scene.targets.len() as f64;
            let truth = values(&target.image);
            let rendered = interleaved(&rgb);
            // Both pictures are finite and of one size.
            let psnr_of_view = psnr(&rendered, &truth, k.width, k.height).unwrap_or(f64::NAN);
            found.psnr += share * psnr_of_view;
            found.ssim += share * ssim(&rendered, &truth, k.width, k.height).unwrap_or(f64::NAN);
            let copy = enlarged(nearer(scene, target), k.width, k.height);
            found.copy_psnr +=
                share * psnr(&values(&copy), &truth, k.width, k.height).unwrap_or(f64::NAN);
            if pictures.len() < scene.context.len() + 2 {
                let label = format!("prediction {psnr_of_view:.1} dB");
                pictures.push(Labelled::new(label, &picture));
                pictures.push(Labelled::new("truth".to_owned(), &target.image));
            }
        }
        pictures.extend(depth);
        Ok(SceneResult { found, pictures })
    }

    /// Compares depth with the generator's, and returns both as pictures.
    fn depth_scores(&self, scene: &Example, distances: &[f32], found: &mut Found) -> Vec<Labelled> {
        let Some(view) = scene.context.first() else { return Vec::new() };
        let (w, h) = (view.image.width, view.image.height);
        let mut pictures = Vec::new();
        let d = match &self.model.backbone {
            Backbone::Small(small) => small.depth_candidates,
            Backbone::Mvsplat(mvsplat) => mvsplat.depth_candidates,
        };
        let (mut sum, mut near, mut count) = (0.0, 0usize, 0usize);
        for (v, view) in scene.context.iter().enumerate() {
            let k = view.camera.intrinsics();
            let inverse = (0..w * h).map(|i| {
                let at = glam::Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
                k.unproject(at).length() / distances.get(v * w * h + i).unwrap_or(&1.0)
            });
            let predicted = candidate_index(&inverse.collect::<Vec<_>>(), scene.near_far, d);
            let truth: Vec<f32> =
                scene.inverse_depth.get(v).into_iter().flatten().map(|x| x.to_f32()).collect();
            let truth = candidate_index(&truth, scene.near_far, d);
            for (s, t) in
                predicted.iter().zip(&truth).filter(|(s, t)| s.is_finite() && t.is_finite())
            {
                sum += f64::from((s - t).abs());
                near += usize::from((s - t).abs() <= 1.0);
                count += 1;
            }
            if v == 0 {
                let known = if truth.is_empty() { &predicted } else { &truth };
                let top = block_median(known, w).into_iter().filter(|v| v.is_finite());
                let top = top.fold(1.0, f32::max);
                let both = [("depth of input 1", predicted), ("true depth", truth)].into_iter();
                let both = both.filter(|(_, index)| !index.is_empty());
                let labelled = |(label, index): (&str, Vec<f32>)| {
                    Labelled::new(label.to_owned(), &grey(&index, w, h, top))
                };
                pictures = both.map(labelled).collect();
            }
        }
        found.disparity = sum / count.max(1) as f64;
        found.within_one = near as f64 / count.max(1) as f64;
        pictures
    }
}

/// Scores of a scene and its row of the contact sheet.
struct SceneResult {
    found: Found,
    pictures: Vec<Labelled>,
}

/// A picture of the contact sheet.
struct Labelled {
    label: String,
    picture: Rgb,
}

impl Labelled {
    fn new(label: String, picture: &Rgb) -> Self {
        Self { label, picture: picture.clone() }
    }
}

/// Returns the context view whose camera is nearer to the target's.
fn nearer<'a>(scene: &'a Example, target: &'a Posed) -> &'a Rgb {
    let distance = |p: &Posed| p.camera.position().distance(target.camera.position());
    let best = scene.context.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    best.map_or(&target.image, |p| &p.image)
}

/// Returns the picture's values in [0, 1].
fn values(picture: &Rgb) -> Vec<f32> {
    picture.data.iter().map(|v| f32::from(*v) / 255.0).collect()
}

/// Converts `[3, H, W]` to `[H, W, 3]`.
fn interleaved(planes: &[f32]) -> Vec<f32> {
    let n = planes.len() / 3;
    (0..n).flat_map(|i| [planes[i], planes[n + i], planes[2 * n + i]]).collect()
}

/// Converts candidate indices to a grey picture; `top` is white, unknown is black.
fn grey(index: &[f32], w: usize, h: usize, top: f32) -> Rgb {
    let value = |v: &f32| if v.is_finite() { (255.0 * (v / top).clamp(0.0, 1.0)) as u8 } else { 0 };
    Rgb { width: w, height: h, data: index.iter().flat_map(|v| [value(v); 3]).collect() }
}

/// Enlarges a picture by repeating its pixels.
fn enlarged(picture: &Rgb, w: usize, h: usize) -> Rgb {
    let mut data = Vec::with_capacity(3 * w * h);
    for (y, x) in (0..h).flat_map(|y| (0..w).map(move |x| (y, x))) {
        let (sy, sx) = (y * picture.height / h.max(1), x * picture.width / w.max(1));
        data.extend_from_slice(&picture.data[3 * (sy * picture.width + sx)..][..3]);
    }
    Rgb { width: w, height: h, data }
}

/// Space above and below a label, dots.
const LABEL_MARGIN: usize = 2;

/// Arranges pictures in rows and columns, all at the size of the largest, each below its label.
fn tiled(rows: &[Vec<Labelled>]) -> Rgb {
    let all = || rows.iter().flatten();
    let side = |side: fn(&Rgb) -> usize| all().map(|l| side(&l.picture)).max().unwrap_or(1);
    let (w, h) = (side(|p| p.width), side(|p| p.height));
    let longest = all().map(|l| l.label.chars().count()).max().unwrap_or(1).max(1);
    // Dots as large as the longest label allows, of at most 1/60 of the picture's height.
    let scale = (w / (lettering::ADVANCE * longest)).min(h / 60).max(1);
    let margin = scale * LABEL_MARGIN;
    let text = scale * lettering::HEIGHT;
    let strip = text + 2 * margin;
    let columns = rows.iter().map(Vec::len).max().unwrap_or(1);
    let mut sheet = Rgb::black(w * columns.max(1), (strip + h) * rows.len().max(1));
    for (r, row) in rows.iter().enumerate() {
        let top = r * (strip + h);
        for (c, Labelled { label, picture }) in row.iter().enumerate() {
            lettering::write(&mut sheet, (c * w + margin, top + margin), scale, [255; 3], label);
            let picture = enlarged(picture, w, h);
            for y in 0..h {
                let at = 3 * ((top + strip + y) * sheet.width + c * w);
                sheet.data[at..at + 3 * w]
                    .copy_from_slice(&picture.data[3 * y * w..3 * (y + 1) * w]);
            }
        }
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_has_each_picture_below_its_label() {
        let grey = |w, h, v: u8| Rgb { width: w, height: h, data: vec![v; 3 * w * h] };
        let row = |v| {
            let small = Labelled::new("input 1".to_owned(), &grey(32, 20, v));
            [small, Labelled::new("truth".to_owned(), &grey(64, 40, v + 1))].into()
        };
        let sheet = tiled(&[row(10), row(20)]);
        let strip = lettering::HEIGHT + 2 * LABEL_MARGIN;
        assert_eq!((sheet.width, sheet.height), (128, 2 * (strip + 40)));
        let at = |x: usize, y: usize| sheet.data[3 * (y * 128 + x)];
        // Corners of the pictures.
        for (r, v) in [(0, 10), (1, 20)] {
            let top = r * (strip + 40) + strip;
            assert_eq!(
                [at(0, top), at(63, top + 39), at(64, top), at(127, top + 39)],
                [v, v, v + 1, v + 1]
            );
        }
        // The I of "input" and the T of "truth".
        let first = |left: usize| -> String {
            let dot = |x| if at(left + LABEL_MARGIN + x, LABEL_MARGIN) == 255 { '#' } else { '.' };
            (0..3).map(dot).collect()
        };
        assert_eq!([first(0), first(64)], ["###", "###"]);
        let lit = |left: usize| {
            let dots = (0..strip).flat_map(|y| (0..64).map(move |x| (left + x, y)));
            dots.filter(|(x, y)| at(*x, *y) == 255).count()
        };
        assert_ne!(lit(0), lit(64));
    }
}
