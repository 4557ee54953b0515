//! Gradients of the GPU rasterizer: the conformance cases of `shared/fixtures/raster`, and random
//! scenes against the CPU. Results are reproducible.

use subsplat_test_support as common;
use subsplat_test_support::gpu as adapter;
use subsplat_test_support::raster_case;
use subsplat_test_support::raster_gradients;
use subsplat_test_support::raster_scene;

use adapter::gpu;
use common::shared;
use raster_case::File;
use raster_gradients::{check, named, planes, worst_row};
use raster_scene::{KINDS, Kind, Random, Scene};
use subsplat_kernels::cpu::{Geometry, SplatSlices};
use subsplat_kernels::gpu::{GpuError, Rasterizer};
use subsplat_kernels::layout::{Gradients, RasterOptions, ShDirection};

/// Largest error of a row, in the measure of the README of the conformance cases.
const GRADIENT: f32 = 5e-4;
/// The same for needles, and for covariances given as six numbers, whose determinants the GPU
/// computes in f32.
const GRADIENT_NEEDLES: f32 = 2e-3;

fn check_case(name: &str) {
    let Some(gpu) = gpu() else { return };
    let Some(path) = shared(&format!("fixtures/raster/{name}.safetensors")) else { return };
    let file = File::read(&path);
    let (camera, options) = (file.camera(), file.options());
    let upstream = planes(file.get("v_rgb"), file.get("v_alpha"));
    file.with_splats(|splats| {
        let mut rasterizer = Rasterizer::new(gpu);
        let got = rasterizer.backward(splats, &camera, &options, &upstream).unwrap();
        check(name, &file, &got, splats.parents());
    });
}

macro_rules! cases {
    ($($name:ident)*) => { $( #[test] fn $name() { check_case(stringify!($name)); } )* };
}

cases! {
    sh0_32 sh1 sh2 sh3 sh4 antialiased odd_size saturated needles behind_camera gain
    mvsplat_dgr_cam0 mvsplat_dgr_cam1 mvsplat_dgr_cam2 mvsplat_tiles
}

#[test]
fn every_fixture_has_a_test() {
    let Some(folder) = shared("fixtures/raster") else { return };
    let source = include_str!("raster_bwd.rs");
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let stem = path.file_stem().unwrap().to_str().unwrap();
        // brush_tiny contains no camera; its gradients are those of logarithms
        // (tests/raster/raster_bwd.rs).
        if path.extension().is_some_and(|e| e == "safetensors") && stem != "brush_tiny" {
            assert!(source.contains(stem), "no test for {stem}");
        }
    }
}

/// Returns the largest error of any gradient, and the name of that gradient.
fn largest_error(got: &Gradients, expected: &Gradients, parents: usize) -> (f32, &'static str) {
    let pairs = named(got, parents).into_iter().zip(named(expected, parents));
    let mut worst = (0.0, "");
    for ((what, got, lanes), (_, expected, _)) in pairs {
        assert_eq!(got.len(), expected.len(), "{what}");
        if expected.iter().any(|&v| v != 0.0) {
            let e = worst_row(&got, &expected, lanes);
            worst = if e > worst.0 { (e, what) } else { worst };
        } else {
            assert!(got.iter().all(|&v| v == 0.0), "{what}");
        }
    }
    worst
}

/// Every kind of scene with every option of projection. Depth has a gradient, too.
#[test]
fn random_scenes_match_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut rasterizer = Rasterizer::new(gpu);
    for (seed, kind) in (1u64..).zip(KINDS) {
        for variant in 0..6 {
            let (scene, options) = Scene::variant(kind, seed, variant);
            let v = scene.upstream(&options, 100 * seed + variant as u64);
            let expected = scene.gradients(&options, &v);
            let got = scene
                .with_slices(|s| rasterizer.backward(&s, &scene.camera, &options, &v))
                .unwrap();
            let (e, what) = largest_error(&got, &expected, 12);
            eprintln!("{kind:?} {variant}: {what} {e:.1e}");
            let tolerant = kind == Kind::Needles || !scene.cov6.is_empty();
            let allowed = if tolerant { GRADIENT_NEEDLES } else { GRADIENT };
            assert!(e < allowed, "{kind:?} {variant}: {what} {e}");
        }
    }
}

/// Splats with invalid numbers among valid ones: gradients of the valid splats equal the CPU's,
/// the others are zero.
#[test]
fn broken_splats_have_no_gradient() {
    let Some(gpu) = gpu() else { return };
    let mut scene = Scene::new(Kind::Plain, 77, 30, 2, 4);
    let broken = [f32::NAN, f32::INFINITY, -f32::INFINITY, 1e30, -1e30, 0.0];
    let lanes = [0, 3, 7, 10, 1, 4, 8, 2, 6, 9];
    let mut wrong = Vec::new();
    for (k, &lane) in lanes.iter().enumerate() {
        let i = 4 * 3 * k + k % 4;
        if i < scene.len() {
            scene.rows[11 * i + lane] = broken[k % broken.len()];
            wrong.push(i);
        }
    }
    // A zero quaternion and a NaN colour.
    scene.rows[11 * 7 + 3..11 * 7 + 7].fill(0.0);
    scene.gain[4 * 13] = f32::NAN;
    for direction in [ShDirection::Child, ShDirection::Parent] {
        let options = RasterOptions { sh_direction: direction, ..RasterOptions::default() };
        let pixels = scene.camera.intrinsics().width * scene.camera.intrinsics().height;
        let mut r = Random(5);
        let v: Vec<f32> = (0..5 * pixels).map(|_| r.range(-1.0, 1.0)).collect();
        let expected = scene.gradients(&options, &v);
        let got = scene
            .with_slices(|s| Rasterizer::new(gpu.clone()).backward(&s, &scene.camera, &options, &v))
            .unwrap();
        assert!(got.rows[11 * 7..11 * 8] == [0.0; 11] || direction == ShDirection::Parent);
        assert!(got.gain[4 * 13..4 * 14] == [0.0; 4]);
        let (e, what) = largest_error(&got, &expected, 30);
        assert!(e < GRADIENT_NEEDLES, "{direction:?}: {what} {e}");
    }
    assert!(!wrong.is_empty());
}

/// Lists of thousands of splats over many tiles. A few rows may differ where a threshold flips. A
/// second run, and a rasterizer whose capacity has to grow, give the same bytes.
#[test]
fn a_crowded_scene_matches_the_cpu_and_is_reproducible() {
    let Some(gpu) = gpu() else { return };
    let scene = Scene::new(Kind::Plain, 11, 3000, 1, 1);
    let options = RasterOptions::default();
    let pixels = scene.camera.intrinsics().width * scene.camera.intrinsics().height;
    let mut r = Random(6);
    let v: Vec<f32> = (0..5 * pixels).map(|_| r.range(-1.0, 1.0)).collect();
    let expected = scene.gradients(&options, &v);
    let run = |mut rasterizer: Rasterizer| {
        scene.with_slices(|s| rasterizer.backward(&s, &scene.camera, &options, &v)).unwrap()
    };
    let got = run(Rasterizer::new(gpu.clone()));
    assert!(
        got == run(Rasterizer::new(gpu.clone()).with_capacity(5)),
        "results are not reproducible"
    );
    for ((what, got, lanes), (_, expected, _)) in
        named(&got, 3000).into_iter().zip(named(&expected, 3000))
    {
        let largest = expected.iter().fold(0f32, |m, v| m.max(v.abs()));
        assert!(largest > 0.0);
        let pairs = got.chunks(lanes).zip(expected.chunks(lanes));
        let off = pairs
            .filter(|(g, e)| g.iter().zip(*e).any(|(g, e)| !((g - e).abs() <= 1e-3 * largest)));
        let (off, all) = (off.count(), expected.len() / lanes);
        assert!(off <= all / 100, "{what}: {off} of {all} rows");
    }
}

/// A frame without splats, and gradients of another size.
#[test]
fn inconsistent_gradients_are_named() {
    let Some(gpu) = gpu() else { return };
    let scene = Scene::new(Kind::Plain, 1, 1, 0, 0);
    let (camera, options) = (scene.camera, RasterOptions::default());
    let pixels = camera.intrinsics().width * camera.intrinsics().height;
    let mut v = vec![0.0; 5 * pixels];
    v[..pixels].fill(1.0);
    let none = SplatSlices { geometry: Geometry::Packed(&[]), sh: &[], gain: &[], sh_degree: 0 };
    let got = Rasterizer::new(gpu.clone()).backward(&none, &camera, &options, &v).unwrap();
    assert!(got.rows.is_empty() && got.sh.is_empty() && got.gain.is_empty());
    assert_eq!(got.background, [pixels as f32, 0.0, 0.0]);
    let error = Rasterizer::new(gpu).backward(&none, &camera, &options, &v[1..]).err();
    assert!(matches!(error, Some(GpuError::Argument { argument: "gradients", .. })), "{error:?}");
}
