//! The library's main call: progress, cancellation, check, warnings.

use subsplat_test_support::whole;

use candle_core::{Device, Tensor};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};
use subsplat::cameras::check::Verdict;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::Views;
use subsplat::network::model::weights::Weights;
use subsplat::reconstruct::{DepthRange, DepthSource, Refine};
use subsplat::{
    Check, Detail, Error, NearFar, Options, Photo, Progress, Reconstructor, Stage, Warning,
};
use subsplat_kernels::camera::{Camera, Size};

fn photos() -> Vec<Photo> {
    whole::shoot(3, 2, 160, 144).photos
}

fn untrained() -> Reconstructor {
    Reconstructor::untrained(&Config::small(Preset::Tuned, 2), 7).unwrap()
}

/// 96 px and not 64: smaller inputs are not halved for the estimate of the depth range.
fn quick() -> Options {
    Options::default().with_input_size(96, 96)
}

const STAGES: [Stage; 11] = [
    Stage::Crop,
    Stage::Check,
    Stage::DepthRange,
    Stage::Backbone,
    Stage::Primaries,
    Stage::Matching,
    Stage::Parents,
    Stage::Subsplat,
    Stage::Detail,
    Stage::Fit,
    Stage::Refine,
];

#[test]
fn progress_rises_through_all_stages_and_a_break_cancels() {
    let (model, photos) = (untrained(), photos());
    let mut seen: Vec<Progress> = Vec::new();
    let mut record = |progress| {
        seen.push(progress);
        ControlFlow::Continue(())
    };
    let result = model.run_with(&photos, &quick(), &mut record).unwrap();
    let mut stages: Vec<Stage> = seen.iter().map(|p| p.stage).collect();
    stages.dedup();
    assert_eq!(stages, STAGES);
    let times: Vec<Stage> = result.stage_times().iter().map(|t| t.stage).collect();
    assert_eq!(times, STAGES);
    assert!(seen.windows(2).all(|w| w[0].fraction <= w[1].fraction), "{seen:?}");
    let ends = [seen[0].fraction, seen.last().unwrap().fraction];
    assert_eq!(ends, [0.0, 1.0]);
    for stage in STAGES {
        let mut calls = 0;
        let mut stop = |progress: Progress| {
            assert!(progress.stage <= stage, "{progress:?} after {stage} was cancelled");
            if progress.stage < stage {
                return ControlFlow::Continue(());
            }
            calls += 1;
            ControlFlow::Break(())
        };
        let error = model.run_with(&photos, &quick(), &mut stop).unwrap_err();
        assert!(matches!(error, Error::Cancelled) && calls == 1, "{stage}: {error}");
    }
}

/// Runs `model` to the report that follows the first of `stage`, and cancels there.
fn cancel_within(model: &Reconstructor, photos: &[Photo], stage: Stage) -> (usize, Error) {
    let mut calls = 0;
    let mut stop = |progress: Progress| {
        assert!(progress.stage <= stage, "{progress:?} after {stage} was cancelled");
        calls += usize::from(progress.stage == stage);
        if calls < 2 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    };
    let error = model.run_with(photos, &quick(), &mut stop).err().unwrap();
    (calls, error)
}

#[test]
fn a_break_within_a_stage_of_the_network_cancels_it() {
    let (small, photos) = (untrained(), photos());
    for stage in [Stage::DepthRange, Stage::Backbone, Stage::Subsplat] {
        let (calls, error) = cancel_within(&small, &photos, stage);
        assert!(matches!(error, Error::Cancelled) && calls == 2, "{stage}: {error}");
    }
    let mvsplat = Reconstructor::untrained(&Config::re10k(Preset::Tuned, 2), 7).unwrap();
    let (calls, error) = cancel_within(&mvsplat, &photos, Stage::Backbone);
    assert!(matches!(error, Error::Cancelled) && calls == 2, "{error}");
}

/// The fraction of a stage divides by the number of its steps, which the models state.
#[test]
fn the_networks_have_as_many_steps_as_they_state() {
    let photos = photos();
    for config in [Config::small(Preset::Tuned, 2), Config::re10k(Preset::Tuned, 2)] {
        let model = Reconstructor::untrained(&config, 7).unwrap();
        let (network, near_far) = (model.model(), NearFar::new(1.0, 20.0));
        let inputs: Vec<_> = photos
            .iter()
            .map(|p| p.crop(&model.crop_options(Size::new(64, 64))).unwrap())
            .collect();
        let pixels: Vec<f32> = inputs.iter().flat_map(|c| c.input.to_planes()).collect();
        let images = Tensor::from_vec(pixels, (1, 2, 3, 64, 64), &Device::Cpu).unwrap();
        let cameras = inputs.iter().map(|c| c.input_camera).collect();
        let views = Views::new(images, vec![cameras], vec![vec![near_far; 2]]).unwrap();
        let count = AtomicUsize::new(0);
        let step = || {
            count.fetch_add(1, Ordering::Relaxed);
            Ok(())
        };
        let output = network.encode_with(&views, &step).unwrap();
        assert_eq!(count.swap(0, Ordering::Relaxed), network.encode_steps(2));
        let primaries = network.primaries(&views, &output).unwrap();
        let trunk = network.trunk();
        trunk.forward_with(&views, &output, &primaries, &step).unwrap();
        assert_eq!(count.swap(0, Ordering::Relaxed), trunk.steps(&primaries));
    }
}

/// On a thread of a pool a report of a stage cannot wait for another thread of the pool.
#[test]
fn a_reconstruction_on_the_only_thread_of_a_pool_ends() {
    let (model, photos) = (untrained(), photos());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let inside = pool.install(|| model.run(&photos, &quick()).unwrap());
    assert_eq!(inside.splats(), model.run(&photos, &quick()).unwrap().splats());
}

#[test]
fn a_prepared_scene_reconstructs_after_its_photographs_are_freed() {
    let (model, photos) = (untrained(), photos());
    let whole = model.run(&photos, &quick()).unwrap();
    let prepared = model.prepare(&photos, &quick()).unwrap();
    drop(photos);
    assert_eq!(prepared.reports(), whole.reports());
    let DepthSource::Estimated { from } = &whole.depth_range().source else {
        panic!("{:?}", whole.depth_range())
    };
    assert_eq!(**from, prepared.depth_range().source);
    let parts = prepared.reconstruct().unwrap();
    assert_eq!(parts.splats(), whole.splats());
    assert_eq!(parts.raster_options(), whole.raster_options());
    let camera = parts.inputs()[0].target_camera;
    assert_eq!(parts.render(&camera), whole.render(&camera));
    // A photograph of 160 px is larger than the input of 96, and smaller than the target of 192.
    assert_eq!(parts.detail(), Detail::Photographs);
    let enlarged = |w: &Warning| matches!(w, Warning::PhotographEnlarged { .. });
    assert!(parts.warnings().iter().any(enlarged), "{:?}", parts.warnings());
}

#[test]
fn black_lines_at_a_side_are_filled_and_named() {
    let (model, photos) = (untrained(), photos());
    let framed = |photo: &Photo, lines: usize| {
        let mut picture = photo.image().clone();
        let width = picture.width;
        for row in picture.data.chunks_exact_mut(3 * width) {
            row.iter_mut().for_each(|v| *v = (*v).max(60));
            row[..3 * lines].fill(0);
        }
        Photo::new(picture, *photo.camera()).unwrap()
    };
    let warnings = |lines: [usize; 2]| {
        let photos = [framed(&photos[0], lines[0]), framed(&photos[1], lines[1])];
        let result = model.run(&photos, &quick().with_refine(Refine::Off)).unwrap();
        Warning::sentences(result.warnings())
    };
    let named = "black lines along the sides of 1 photograph(s), up to 3 pixels wide, are filled with \
                 the pixels beside them";
    assert!(warnings([3, 0]).iter().any(|w| w == named));
    assert!(warnings([0, 0]).iter().all(|w| !w.starts_with("black lines")));
}

/// The second photograph shows the same picture as the first, from another camera.
#[test]
fn bad_poses_are_warnings_or_an_error() {
    let (model, photos) = (untrained(), photos());
    let twice =
        [photos[0].clone(), Photo::new(photos[0].image().clone(), *photos[1].camera()).unwrap()];
    let result = model.run(&twice, &quick()).unwrap();
    assert_eq!(result.reports()[0].verdict, Verdict::Bad);
    let sentence = match &result.warnings()[0] {
        Warning::Poses { first: 0, finding, .. } => finding.sentence.clone(),
        other => panic!("{other:?}"),
    };
    let error = model.run(&twice, &quick().with_check(Check::Refuse)).unwrap_err();
    assert!(matches!(error, Error::Poses(_)) && error.to_string().contains(&sentence), "{error}");
    let unchecked = model.run(&twice, &quick().with_check(Check::Off)).unwrap();
    assert!(unchecked.reports().is_empty());
    assert_eq!(unchecked.stage_times()[1].stage, Stage::DepthRange);
    let error = model.run(&photos[..1], &quick()).unwrap_err().to_string();
    assert_eq!(error, "photographs: expected at least 2, got 1");
}

/// A scene in a unit a million times as large is the same scene, bit for bit: both units are powers of two.
#[test]
fn the_unit_of_length_does_not_matter() {
    const UNIT: f32 = 1.0 / (1 << 20) as f32;
    let (model, photos) = (untrained(), photos());
    let tiny: Vec<Photo> = photos
        .iter()
        .map(|photo| {
            let mut pose = photo.camera().world_from_camera();
            pose.w_axis = (pose.w_axis.truncate() * UNIT).extend(1.0);
            let camera = Camera::new(photo.camera().intrinsics(), pose).unwrap();
            Photo::new(photo.image().clone(), camera).unwrap()
        })
        .collect();
    let run = |photos: &[Photo], unit: f32| {
        let range = DepthRange::Fixed { near: unit, far: 8.0 * unit };
        let options = quick().with_check(Check::Off).with_depth_range(range);
        model.run(photos, &options.with_refine(Refine::Steps(2))).unwrap()
    };
    let (whole, small) = (run(&photos, 1.0), run(&tiny, UNIT));
    assert_eq!(small.raster_options().near, whole.raster_options().near * UNIT);
    assert_eq!(small.depth_range().near, UNIT);
    for (a, b) in whole.splats().rows().chunks(11).zip(small.splats().rows().chunks(11)) {
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            let is_length = i < 3 || (7..10).contains(&i);
            let expected = if is_length { a * UNIT } else { *a };
            assert_eq!(*b, expected, "number {i}");
        }
    }
    assert_eq!(whole.splats().sh(), small.splats().sh());
    for (a, b) in whole.inputs().iter().zip(small.inputs()) {
        assert_eq!(a.target_camera.position() * UNIT, b.target_camera.position());
    }
    for (a, b) in whole.depths().iter().zip(small.depths()) {
        assert!(a.data.iter().zip(&b.data).all(|(a, b)| a * UNIT == *b));
    }
}

/// Photographs keep their shape and are never stretched; the cut share is the truth.
#[test]
fn the_input_has_the_shape_of_the_photographs() {
    let model = untrained();
    let options = Options::default().with_input_area(128 * 128).with_check(Check::Off);
    for ((w, h), expected, cut) in
        [((160, 96), (160, 96), 0.0), ((96, 160), (96, 160), 0.0), ((160, 144), (128, 128), 0.1)]
    {
        let photos = whole::shoot(3, 2, w, h).photos;
        let prepared = model.prepare(&photos, &options).unwrap();
        for (crop, share) in prepared.inputs().iter().zip(prepared.cut_shares()) {
            assert_eq!((crop.input.width, crop.input.height), expected);
            assert!((crop.window.scale.x / crop.window.scale.y - 1.0).abs() < 0.01, "{w}x{h}");
            assert!((share - cut).abs() < 0.01, "{w}x{h}: {share}");
        }
        let shape =
            |w: &Warning| matches!(w, Warning::InputSizeCut { .. } | Warning::PhotographCut { .. });
        assert!(!prepared.warnings().iter().any(shape));
    }
    // Portraits as landscapes.
    let portraits = whole::shoot(3, 2, 96, 160).photos;
    let prepared = model.prepare(&portraits, &options.clone().with_input_size(160, 96)).unwrap();
    let cut = |w: &Warning| matches!(w, Warning::PhotographCut { .. });
    let sentences: Vec<String> =
        prepared.warnings().iter().filter(|w| cut(w)).map(Warning::to_string).collect();
    let expected = "64 % of a photograph of 96x160 is cut at its edges: pictures of 320x192 have \
                    another shape";
    assert_eq!(sentences, [expected]);
    // Two shapes share one input.
    let mut mixed = whole::shoot(3, 2, 160, 96).photos;
    mixed[1] = whole::shoot(3, 2, 96, 160).photos.remove(1);
    let prepared = model.prepare(&mixed, &options).unwrap();
    assert!(prepared.inputs().iter().all(|c| (c.input.width, c.input.height) == (128, 128)));
    assert!(prepared.cut_shares().iter().all(|s| (s - 0.4).abs() < 0.01));
}

#[test]
fn untrained_heads_are_a_warning() {
    let told = |weights: Weights, upscale: usize| {
        let config = Config { upscale, ..weights.config().unwrap().clone() };
        let model = Reconstructor::from_weights(weights, Some(&config)).unwrap();
        let prepared = model.prepare(&photos(), &quick().with_check(Check::Off)).unwrap();
        let untrained = |w: &&Warning| matches!(w, Warning::UntrainedTensors { .. });
        prepared.warnings().iter().find(untrained).map(Warning::to_string)
    };
    for upscale in [1, 3] {
        assert_eq!(told(Weights::shipped(upscale).unwrap(), upscale), None);
        let backbone = Weights::shipped(upscale).unwrap().without("subsplat.");
        let expected = match upscale {
            1 => "each pixel gives one splat",
            _ => "each pixel is divided evenly into 9 splats",
        };
        let told = told(backbone, upscale).unwrap();
        assert!(told.contains(expected), "x{upscale}: {told}");
    }
}
