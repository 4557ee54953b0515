//! Cameras from photographs alone, on `../shared/photos`: errors against the given cameras, and
//! seconds. `cargo bench --bench poses -- [NAME …] [--quick] [--threads N]`; the tables are `pairs
//! known`, `pairs unknown`, `scenes known`, `many known` and `many unknown`; `--quick` leaves out
//! the last three.
//!
//! Columns of pairs: error of the rotation and of the direction (degrees), the estimate's own
//! standard deviations of both, focal length over the true one, verdict. Columns of many
//! photographs: number with a camera, largest error of a centre over the extent of all centres
//! (percent) and of a rotation (degrees) after alignment. Columns of scenes: PSNR of the protocol's
//! targets (dB), means of a pair, with the given cameras of the inputs, with estimated ones and
//! their difference. Both see the targets from the given cameras; the estimated cameras are moved to
//! the given ones by their mean rotation, the scale of the baseline and the middle between them.

mod common;

use anyhow::{Context, Result};
use common::Bench;
use serde_json::json;
use std::time::Instant;
use subsplat::cameras::estimation::Uncertain;
use subsplat::cameras::estimation::{
    Confidence, PoseOptions, PosePhoto, PoseRefusal, estimate_poses,
};
use subsplat::scene::metrics::psnr;
use subsplat::{Options, Photo, Reconstructor};
use subsplat_kernels::camera::{Camera, Size};
use subsplat_test_support::pose_errors::{
    aligned_cameras, aligned_errors, area_under_curve, median, relative_errors,
};
use subsplat_test_support::posed_photos::{
    Intrinsics, MANY_FEATURES, PAIR_FEATURES, PosedPair, PosedPhoto, context_pairs, photo_scene,
};

/// Scenes of many photographs, and which of their photographs are taken.
const MANY: [(&str, usize); 6] = [
    ("fox", 1),
    ("hololens_table", 3),
    ("hololens_foosball", 3),
    ("re10k_0bf152ef84195293", 3),
    ("re10k_0c9b371cc6225682", 3),
    ("re10k_0f68374b76390082", 3),
];

fn main() -> Result<()> {
    let mut bench = Bench::new("poses")?;
    let lenses = [("known", Intrinsics::Known), ("unknown", Intrinsics::Unknown)];
    for (word, intrinsics) in lenses {
        let name = format!("pairs {word}");
        if bench.selects(&name) {
            let rows = pairs(&bench, &name, intrinsics)?;
            bench.add_group(&name, rows);
        }
    }
    if bench.selects("scenes known") && !bench.args.quick {
        let rows = scenes(&bench)?;
        bench.add_group("scenes known", rows);
    }
    for (word, intrinsics) in lenses {
        let name = format!("many {word}");
        if bench.selects(&name) && !bench.args.quick {
            let rows = many(&bench, &name, intrinsics)?;
            bench.add_group(&name, rows);
        }
    }
    bench.finish()
}

/// The table of the context pairs.
fn pairs(bench: &Bench, name: &str, intrinsics: Intrinsics) -> Result<Vec<serde_json::Value>> {
    println!("\n{name}: rotation, direction (deg) ± (deg), focal, verdict, seconds");
    let pairs = context_pairs().context("../shared/photos is absent")?;
    let (mut errors, mut rows) = (Vec::new(), Vec::new());
    for PosedPair { name, photos, .. } in &pairs {
        let begin = Instant::now();
        let estimate = bench.on_all(|| {
            let photos = photos.each_ref().map(|p| p.features(intrinsics, PAIR_FEATURES));
            estimate_poses(&photos, &PoseOptions::default())
        });
        let seconds = begin.elapsed().as_secs_f64();
        let error = match estimate {
            Err(refusal) => {
                println!("{name:40} refused: {refusal}");
                f64::INFINITY
            }
            Ok(e) => {
                let found: Vec<&Camera> = e.cameras.iter().flatten().collect();
                let truth = photos.each_ref().map(|p| &p.camera);
                let [rotation, direction] = relative_errors([found[0], found[1]], truth);
                let focal = found[0].intrinsics().fx / truth[0].intrinsics().fx;
                let verdict = if e.confidence == Confidence::High { "" } else { "low confidence" };
                let own = [e.rotation_error_deg, e.direction_error_deg];
                println!(
                    "{name:40} {rotation:6.2} {direction:6.2}  ±{:5.2} {:5.2}  {focal:5.3} {seconds:5.2} s {verdict}",
                    own[0], own[1]
                );
                rotation.max(direction)
            }
        };
        rows.push(json!({ "pair": name, "error_deg": error, "seconds": seconds }));
        errors.push(error);
    }
    let areas = [5.0, 10.0, 20.0].map(|limit| area_under_curve(&errors, limit));
    println!("median {:.2}, area under the curve at 5, 10, 20: {areas:.3?}", median(&errors));
    Ok(rows)
}

/// The table of scenes from the context pairs, with given and with estimated cameras.
fn scenes(bench: &Bench) -> Result<Vec<serde_json::Value>> {
    println!(
        "\nscenes known: PSNR of targets with given cameras, estimated cameras, difference (dB)"
    );
    let pairs = context_pairs().context("../shared/photos is absent")?;
    let model = Reconstructor::shipped(2)?;
    let (mut rows, mut differences) = (Vec::new(), Vec::new());
    for pair in &pairs {
        let photos = pair.photos.each_ref();
        let truth = photos.map(|p| p.camera);
        let estimate = bench.on_all(|| {
            let features = photos.map(|p| p.features(Intrinsics::Known, PAIR_FEATURES));
            let options = PoseOptions::default();
            estimate_poses(&features, &options).map(|e| (e, "")).or_else(|_| {
                Ok((
                    estimate_poses(&features, &options.with_uncertain(Uncertain::Accept))?,
                    "refused",
                ))
            })
        });
        let (estimate, note) = match estimate {
            Ok(found) => found,
            Err::<_, PoseRefusal>(refusal) => {
                println!("{:40} refused: {refusal}", pair.name);
                continue;
            }
        };
        let found: Vec<Camera> = estimate.cameras.iter().flatten().copied().collect();
        let found = aligned_cameras(&found, &truth);
        let score = |cameras: &[Camera]| bench.on_all(|| scene_psnr(&model, pair, cameras));
        let [given, estimated] = [score(&truth)?, score(&found)?];
        let difference = estimated - given;
        println!("{:40} {given:6.2} {estimated:6.2} {difference:+6.2} {note}", pair.name);
        rows.push(json!({ "pair": pair.name, "given": given, "estimated": estimated }));
        if note.is_empty() {
            differences.push(difference);
        }
    }
    let mean = differences.iter().sum::<f64>() / differences.len().max(1) as f64;
    println!("mean of the {} pairs that are not refused: {mean:+.2} dB", differences.len());
    Ok(rows)
}

/// Mean PSNR of a pair's targets where its photographs have `cameras`.
fn scene_psnr(model: &Reconstructor, pair: &PosedPair, cameras: &[Camera]) -> Result<f64> {
    let photos: Vec<Photo> =
        pair.photos.iter().zip(cameras).map(|(p, c)| p.with_camera(*c)).collect();
    let scene = model.run(&photos, &Options::default())?;
    let input = &scene.inputs()[0].input;
    let crop = model.crop_options(Size::new(input.width, input.height));
    let mut sum = 0.0;
    for target in &pair.targets {
        let truth = target.with_camera(target.camera).crop(&crop)?;
        let picture = scene.render(&truth.target_camera);
        sum += psnr(&picture.rgb, &truth.target.to_unit(), picture.width, picture.height)?;
    }
    Ok(sum / pair.targets.len() as f64)
}

/// The table of scenes of many photographs, in a mixed order.
fn many(bench: &Bench, name: &str, intrinsics: Intrinsics) -> Result<Vec<serde_json::Value>> {
    println!("\n{name}: with a camera, centre (%), rotation (deg), focal, seconds");
    let mut rows = Vec::new();
    for (scene_name, step) in MANY {
        let scene = photo_scene(scene_name).context("../shared/photos is absent")?;
        let mut taken: Vec<usize> = (0..scene.frames.len()).step_by(step).collect();
        // The order does not help: seven steps ahead each time.
        let n = taken.len();
        taken =
            (0..n).map(|i| taken[(if n.is_multiple_of(7) { 5 } else { 7 } * i + 3) % n]).collect();
        let photos: Vec<PosedPhoto> = taken.iter().map(|&i| PosedPhoto::load(&scene, i)).collect();
        let begin = Instant::now();
        let estimate = bench.on_all(|| {
            let features: Vec<PosePhoto> =
                photos.iter().map(|p| p.features(intrinsics, MANY_FEATURES)).collect();
            estimate_poses(&features, &PoseOptions::default())
        });
        let seconds = begin.elapsed().as_secs_f64();
        match estimate {
            Err(refusal) => println!("{scene_name:30} refused: {refusal}"),
            Ok(e) => {
                let (found, truth): (Vec<Camera>, Vec<Camera>) = (e.cameras.iter())
                    .zip(&photos)
                    .filter_map(|(c, p)| Some(((*c)?, p.camera)))
                    .unzip();
                let errors = aligned_errors(&found, &truth);
                let focal = found[0].intrinsics().fx / truth[0].intrinsics().fx;
                println!(
                    "{scene_name:30} {:2} of {n:2} {:7.2} {:6.2}  {focal:5.3} {seconds:6.1} s",
                    found.len(),
                    100.0 * errors.centre,
                    errors.rotation_deg
                );
                rows.push(json!({
                    "scene": scene_name, "placed": found.len(), "of": n, "centre": errors.centre,
                    "rotation_deg": errors.rotation_deg, "seconds": seconds,
                }));
            }
        }
    }
    Ok(rows)
}
