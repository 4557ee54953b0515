//! The whole model with plane sweep, attention gather and SPGR on a GPU, against the CPU.

use subsplat_test_support::gpu as adapter;
use subsplat_test_support::whole;

use adapter::{gpu, limited};
use std::ops::ControlFlow;
use std::path::Path;
use subsplat::camera::NearFar;
use subsplat::config::Preset;
use subsplat::model::Backend;
use subsplat::model::compare::compare;
use subsplat::model::weights::Weights;
use subsplat::pipeline::{Photo, Reconstructor};
use subsplat::{Error, Progress, Stage, load_scene};
use subsplat_test_support::shared;
use whole::{light, lively, plain, run, shoot};

/// Fraction of rows that may differ: a depth whose window around the mode begins one candidate
/// farther moves its pixel's children.
const MOVED_MAX: f64 = 0.02;
/// Tolerance of the other rows, relative to the largest number of the column.
const TOLERANCE: f32 = 2e-3;

fn check(mvsplat: bool) {
    let Some(gpu) = gpu() else { return };
    let config = light(plain(mvsplat, Preset::Tuned, 2));
    let shoot = shoot(5, 2, 96, 96);
    let model = lively(&config);
    let first = run(&model, &shoot.photos, (64, 64), false);
    let options = *first.raster_options();
    let expected = first.into_splats();
    let backend = Backend::from(gpu);
    let model = model.with_backend(&backend);
    let got = run(&model, &shoot.photos, (64, 64), false).into_splats();
    assert_eq!(backend.warning(), None);
    assert_eq!(
        (got.rows().len(), got.gain().len()),
        (expected.rows().len(), expected.gain().len())
    );
    // Devices round differently, so equal bytes mean that the GPU computed nothing.
    assert!(got.rows() != expected.rows(), "the results have equal bytes");
    let mut largest = [0f32; 11];
    for (i, v) in expected.rows().iter().enumerate() {
        largest[i % 11] = largest[i % 11].max(v.abs());
    }
    let rows = got.rows().chunks(11).zip(expected.rows().chunks(11));
    let off =
        rows.filter(|(g, e)| (0..11).any(|k| !((g[k] - e[k]).abs() <= TOLERANCE * largest[k])));
    let share = off.count() as f64 / expected.len() as f64;
    let camera = shoot.photos[0].camera();
    let decibels = whole::compare(&expected, &got, camera, &options);
    eprintln!("mvsplat {mvsplat}: {share:.4} of the rows moved, {decibels:.1} dB");
    assert!(share < MOVED_MAX, "{share} of the rows moved");
    assert!(decibels > 45.0, "{decibels} dB");
}

#[test]
fn small() {
    check(false);
}

#[test]
fn mvsplat() {
    check(true);
}

/// The weights that ship on the room that ships. At the default size of the input, 256², which takes a
/// software adapter minutes, the pictures differed by 86.7 dB.
#[test]
fn shipped_weights_on_the_shipped_room() {
    let Some(gpu) = gpu() else { return };
    let room = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/room");
    let scene = load_scene(&room).unwrap();
    let photos: Vec<Photo> =
        scene.frames[..2].iter().map(|f| Photo::from_frame(f).unwrap()).collect();
    let options = whole::options((128, 128), NearFar::new(1.0, 12.0), true);
    let model = Reconstructor::shipped(2).unwrap();
    let expected = model.run(&photos, &options).unwrap();
    let backend = Backend::from(gpu);
    let got = model.with_backend(&backend).run(&photos, &options).unwrap();
    assert_eq!(backend.warning(), None);
    let raster = *expected.raster_options();
    let camera = *photos[0].camera();
    let decibels = whole::compare(expected.splats(), got.splats(), &camera, &raster);
    eprintln!("shipped room: {decibels:.1} dB");
    assert!(decibels >= 50.0, "{decibels} dB");
    assert!(got.splats().rows() != expected.splats().rows(), "the results have equal bytes");
}

/// The encoder with MVSplat's weights, stage by stage, against the outputs of the public MVSplat.
#[test]
fn every_stage_of_mvsplat_agrees_with_the_reference() {
    let Some(gpu) = gpu() else { return };
    let Some(weights) = shared("golden/mvsplat_weights.safetensors") else { return };
    let Some(reference) = shared("golden/mvsplat_64x64_b1v2.safetensors") else { return };
    let backend = Backend::from(gpu);
    let report = compare(&Weights::load(&weights).unwrap(), &reference, &backend).unwrap();
    let bad: Vec<_> = report.rows.iter().filter(|row| !row.ok).collect();
    assert!(report.ok(), "{bad:#?}");
    assert_eq!(report.not_produced, [""; 0]);
    assert_eq!(report.rows.len(), 99);
}

/// After a device is lost, the CPU computes the network; after cancellation it does not.
#[test]
fn the_cpu_takes_over_from_a_lost_device() {
    let Some(own) = limited(128 << 20) else { return };
    let config = light(plain(false, Preset::Tuned, 2));
    let shoot = shoot(5, 2, 96, 96);
    let model = lively(&config);
    let expected = run(&model, &shoot.photos, (64, 64), false).into_splats();
    let backend = Backend::from(own.clone());
    let model = model.with_backend(&backend);
    let mut calls = 0;
    let mut cancel = |p: Progress| {
        calls += usize::from(p.stage == Stage::Subsplat);
        if calls > 1 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let options = whole::options((64, 64), NearFar::RE10K, false);
    let cancelled = model.run_with(&shoot.photos, &options, &mut cancel);
    assert!(matches!(cancelled, Err(Error::Cancelled)), "{cancelled:?}");
    assert_eq!(backend.warning(), None);
    own.device().destroy();
    // The loss is reported after the work in flight.
    own.device().poll(subsplat::gpu::wgpu::PollType::wait_indefinitely()).ok();
    let got = run(&model, &shoot.photos, (64, 64), false).into_splats();
    assert_eq!(got.rows(), expected.rows());
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
}
