//! The whole model with plane sweep, attention gather and SPGR on a GPU, against the CPU.

use subsplat_test_support::gpu as adapter;
use subsplat_test_support::whole;

use adapter::{gpu, limited};
use candle_core::{Device, Tensor};
use std::ops::ControlFlow;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{Backend, Views};
use subsplat::reconstruct::Reconstructor;
use subsplat::{Error, Progress, Stage};
use subsplat_kernels::camera::NearFar;
use subsplat_kernels::gpu::{DeviceChoice, Gpu, PLAN_WORDS};
use subsplat_lab::compare::compare;
use subsplat_test_support::shared;
use whole::{Shoot, light, lively, plain, run, shoot};

/// Fraction of rows that may differ: a depth whose window around the mode begins one candidate
/// farther moves its pixel's children.
const MOVED_MAX: f64 = 0.02;
/// Tolerance of the other rows, relative to the largest number of the column.
const TOLERANCE: f32 = 2e-3;

fn check(mvsplat: bool) {
    // MVSplat's read-backs are counted, so that other tests must not use its device.
    let own = if mvsplat { limited(128 << 20) } else { gpu() };
    let Some(gpu) = own else { return };
    let config = light(plain(mvsplat, Preset::Tuned, 2));
    let shoot = shoot(5, 2, 96, 96);
    let model = lively(&config);
    let first = run(&model, &shoot.photos, (64, 64), false);
    let options = *first.raster_options();
    let expected = first.into_splats();
    let backend = Backend::from(gpu.clone());
    let model = model.with_backend(&backend);
    let start = gpu.read_backs();
    let got = run(&model, &shoot.photos, (64, 64), false).into_splats();
    let read = gpu.read_backs();
    assert_eq!(backend.warning(), None);
    if mvsplat {
        // Rows and gains of a chunk of each view; SH and depths of all.
        assert_eq!(read.count - start.count, 6);
    }
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

/// The network's input of photographs.
fn views(shoot: &Shoot) -> Views {
    let cameras: Vec<_> = shoot.photos.iter().map(|p| *p.camera()).collect();
    let pixels: Vec<f32> = shoot.photos.iter().flat_map(|p| p.image().to_planes()).collect();
    let k = cameras[0].intrinsics();
    let sizes = (1, cameras.len(), 3, k.height, k.width);
    let images = Tensor::from_vec(pixels, sizes, &Device::Cpu).unwrap();
    let near_far = vec![vec![whole::NEAR_FAR; cameras.len()]];
    Views::new(images, vec![cameras], near_far).unwrap()
}

/// From photographs to a picture, the host reads the picture alone, and the number of pairs that the
/// frame needs; from photographs to Gaussians, it reads these with one wait. With MVSplat: `mvsplat`.
#[test]
fn the_host_reads_the_picture_alone() {
    let Some(own) = limited(128 << 20) else { return };
    let config = light(plain(false, Preset::Tuned, 2));
    let shoot = shoot(5, 2, 64, 64);
    let views = views(&shoot);
    let camera = shoot.targets[0].resized(128, 128).unwrap();
    let options = config.raster_options(2.0, whole::NEAR_FAR.near, [0.3; 3]);
    let model = lively(&config);
    let expected = model.model().render(&views, &camera, &options).unwrap().remove(0);
    let backend = Backend::from(own.clone());
    let model = model.with_backend(&backend);
    let start = own.read_backs();
    let got = model.model().render(&views, &camera, &options).unwrap().remove(0);
    let read = own.read_backs();
    assert_eq!(backend.warning(), None);
    assert_eq!(got.dims(), [5, 128, 128]);
    let numbers = 5 * 128 * 128 + PLAN_WORDS as u64;
    assert_eq!((read.count - start.count, read.bytes - start.bytes), (2, 4 * numbers));
    let [got, expected] = [&got, &expected].map(|t| t.flatten_all().unwrap().to_vec1().unwrap());
    let rgb = 3 * 128 * 128;
    let decibels = decibels(&got[..rgb], &expected[..rgb]);
    eprintln!("{decibels:.1} dB");
    assert!(decibels > 45.0, "{decibels} dB");
    assert!(got != expected, "the pictures have equal bytes");
    let scene = model.model().forward(&views, &mut |_| {}).unwrap().remove(0);
    let children = &scene.children;
    let arrays = [&children.rows, &children.gain, &children.sh];
    let floats: usize = arrays.iter().map(|t| t.elem_count()).sum();
    let floats = floats + scene.depths.iter().map(Vec::len).sum::<usize>();
    let end = own.read_backs();
    // A chunk of each view, with rows and gains; SH and depths of all.
    assert_eq!((end.count - read.count, end.bytes - read.bytes), (6, 4 * floats as u64));
}

/// Parents that the host moved have the children that the CPU computes from them, on the GPU and after it is
/// lost.
#[test]
fn children_follow_parents_that_moved() {
    let Some(own) = limited(128 << 20) else { return };
    let shoot = shoot(5, 2, 64, 64);
    let views = views(&shoot);
    let model = lively(&light(plain(false, Preset::Tuned, 2)));
    let children = |model: &Reconstructor, moves: bool, lost: &dyn Fn()| {
        let network = model.model();
        let features = network.encode_scene(&views, &|| Ok(())).unwrap();
        let mut encoding = network.place(features).unwrap();
        if moves {
            let mut parts = encoding.parents(network).unwrap().into_parts();
            parts.rows.chunks_exact_mut(11).for_each(|row| row[2] += 0.3);
            encoding = encoding.with_parents(network, &parts.try_into().unwrap()).unwrap();
        }
        lost();
        encoding.children(network, &|| Ok(())).unwrap().children.to_splats().unwrap()
    };
    let [still, expected] = [false, true].map(|moves| children(&model, moves, &|| ()));
    let height = |splats: &subsplat::Splats| {
        splats.rows().iter().skip(2).step_by(11).map(|z| f64::from(*z)).sum::<f64>()
            / splats.len() as f64
    };
    assert!((height(&expected) - height(&still) - 0.3).abs() < 0.05);
    let backend = Backend::from(own.clone());
    let model = model.with_backend(&backend);
    let got = children(&model, true, &|| ());
    assert_eq!(backend.warning(), None);
    assert!((height(&got) - height(&expected)).abs() < 1e-3);
    let lost = children(&model, true, &|| {
        own.device().destroy();
        own.device().poll(subsplat_kernels::gpu::wgpu::PollType::wait_indefinitely()).ok();
    });
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
    // The rows that were moved come from the GPU.
    assert!((height(&lost) - height(&expected)).abs() < 1e-3);
}

/// Calls that are only counted are those that run, and need the same memory.
#[test]
fn counted_calls_are_those_that_run() {
    let shoot = shoot(5, 2, 64, 64);
    let mut model = lively(&light(plain(false, Preset::Tuned, 2)));
    let mut found = Vec::new();
    for counts_only in [false, true] {
        let Some(own) = limited(128 << 20) else { return };
        let backend = Backend::from(own.clone());
        model = model.with_backend(&backend);
        let network = model.model();
        let recorder = network.trunk().executor().unwrap().recorder().clone();
        recorder.set_counts_only(counts_only);
        let scene = network.forward(&views(&shoot), &mut |_| {}).unwrap().remove(0);
        assert_eq!(backend.warning(), None);
        let rows = scene.children.rows.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(rows.iter().all(|v| *v == 0.0), counts_only, "what runs has results");
        found.push((recorder.work(), own.peak_allocated_bytes()));
    }
    assert!(found[0].0.values().map(|work| work.flops).sum::<u64>() > 1_000_000_000);
    assert_eq!(found[0], found[1]);
}

/// Memory of two pictures of 256×256, of which no call runs: both networks stay below their limits, MiB.
#[test]
fn peak_memory_at_256_by_256() {
    let shoot = shoot(5, 2, 256, 256);
    for (mvsplat, most) in [(false, 0.2 * 1024.0), (true, 0.6 * 1024.0)] {
        if gpu().is_none() {
            return;
        }
        // The adapter's own sizes of bindings, and a pool of its own.
        let own = Gpu::open(&DeviceChoice::Gpu).unwrap().unwrap();
        let backend = Backend::from(own.clone());
        let config = if mvsplat {
            Config::re10k(Preset::Tuned, 2)
        } else {
            Weights::shipped(2).unwrap().config().unwrap().clone()
        };
        let network = SubSplat::new(&config, Weights::seeded(7).builder()).unwrap();
        let network = network.with_backend(&backend);
        let recorder = network.trunk().executor().unwrap().recorder().clone();
        recorder.set_counts_only(true);
        // The second pass has the parameters and the free buffers of the first.
        for _ in 0..2 {
            network.forward(&views(&shoot), &mut |_| {}).unwrap();
        }
        assert_eq!(backend.warning(), None);
        let peak = own.peak_allocated_bytes() as f64 / 1048576.0;
        eprintln!("mvsplat {mvsplat}: {peak:.0} MiB");
        assert!(peak <= most, "mvsplat {mvsplat}: {peak:.0} MiB, limit {most:.0}");
        assert!(
            peak > 0.25 * most,
            "mvsplat {mvsplat}: {peak:.0} MiB cannot hold the network's arrays"
        );
    }
}

fn decibels(got: &[f32], expected: &[f32]) -> f64 {
    let squares = got.iter().zip(expected).map(|(a, b)| f64::from(a - b).powi(2));
    -10.0 * (squares.sum::<f64>() / got.len() as f64).log10()
}

/// A device that is lost between backbone and trunk: the CPU repeats the scene, both for Gaussians and
/// for a picture.
#[test]
fn a_device_lost_within_a_scene_repeats_it_on_the_cpu() {
    let config = light(plain(false, Preset::Tuned, 2));
    let shoot = shoot(5, 2, 64, 64);
    let views = views(&shoot);
    let camera = shoot.targets[0].resized(128, 128).unwrap();
    let options = config.raster_options(2.0, whole::NEAR_FAR.near, [0.3; 3]);
    let model = lively(&config);
    let expected = model.model().forward(&views, &mut |_| {}).unwrap().remove(0);
    let picture = model.model().render(&views, &camera, &options).unwrap().remove(0);
    let Some(own) = limited(128 << 20) else { return };
    let backend = Backend::from(own.clone());
    let model = model.with_backend(&backend);
    let network = model.model();
    let place = || network.place(network.encode_scene(&views, &|| Ok(())).unwrap()).unwrap();
    let [first, second] = [place(), place()];
    assert_eq!(backend.warning(), None);
    own.device().destroy();
    own.device().poll(subsplat_kernels::gpu::wgpu::PollType::wait_indefinitely()).ok();
    let got = first.children(network, &|| Ok(())).unwrap();
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
    let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(values(&got.children.rows), values(&expected.children.rows));
    assert_eq!(got.depths, expected.depths);
    let drawn = second.render(network, &camera, &options).unwrap();
    let off = decibels(&values(&drawn), &values(&picture));
    assert!(off > 90.0, "{off} dB");
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
    own.device().poll(subsplat_kernels::gpu::wgpu::PollType::wait_indefinitely()).ok();
    let got = run(&model, &shoot.photos, (64, 64), false).into_splats();
    assert_eq!(got.rows(), expected.rows());
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
}
