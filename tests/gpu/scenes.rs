//! Scenes of users on the GPU against the CPU, pictures and gradients: the example room with the
//! shipped weights, and a .ply of 16,384 Gaussians.

use subsplat_test_support as common;
use subsplat_test_support::edit::Edit;
use subsplat_test_support::gpu as adapter;

use adapter::gpu;
use std::path::PathBuf;
use subsplat::FitOptions;
use subsplat::files::load_splats;
use subsplat::files::poses::scene::{Scene, load_scene};
use subsplat::network::model::Backend;
use subsplat::reconstruct::inputs::crop::CropOptions;
use subsplat::reconstruct::{Check, DepthRange, Options, Photo, Reconstructor};
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::slices;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, NearFar, Size};
use subsplat_kernels::cpu;
use subsplat_kernels::gpu::Rasterizer;
use subsplat_kernels::layout::{Convention, Gradients, RasterOptions};

/// Fraction of the numbers of a picture whose error may exceed that of tests/gpu/raster.rs: where
/// an alpha falls on the other side of 1/255.
const COLOUR: f32 = 3e-5;
const FLIPPED: f64 = 2e-3;
const FLIP: f32 = 0.02;
/// Tolerance of a gradient relative to the largest of its kind, and the fraction of rows that may
/// exceed it: rows of splats at such thresholds.
const GRADIENT: f32 = 1e-3;
const GRADIENTS_OFF: f64 = 3e-3;
/// Fraction of the rows of a reconstruction that may differ (a depth whose window around the mode
/// begins one candidate farther), and the tolerance of the others relative to the largest number
/// of the column.
const MOVED: f64 = 2e-3;
const COLUMN: f32 = 2e-3;

/// Returns the fraction of the numbers that differ by more than rounding, and the largest
/// difference.
fn differences(got: &[f32], expected: &[f32]) -> (f64, f32) {
    assert_eq!(got.len(), expected.len());
    let difference = |(g, e): (&f32, &f32)| (g - e).abs();
    let off = got.iter().zip(expected).map(difference).filter(|d| !(*d < COLOUR)).count();
    let worst = got.iter().zip(expected).map(difference);
    let worst = worst.fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m });
    (off as f64 / got.len() as f64, worst)
}

/// Returns the fraction of rows with an error above [`GRADIENT`] of the largest number of the
/// column.
fn rows_off(got: &[f32], expected: &[f32], columns: usize) -> f64 {
    assert_eq!(got.len(), expected.len());
    let mut largest = vec![0f32; columns];
    for (i, v) in expected.iter().enumerate() {
        largest[i % columns] = largest[i % columns].max(v.abs());
    }
    assert!(largest.iter().any(|&v| v > 0.0), "no gradient to compare");
    let rows = got.chunks(columns).zip(expected.chunks(columns));
    let off = rows
        .filter(|(g, e)| (0..columns).any(|k| !((g[k] - e[k]).abs() <= GRADIENT * largest[k])))
        .count();
    off as f64 / (expected.len() / columns) as f64
}

/// Checks that picture and gradients of `splats` on the GPU equal those of the CPU.
fn check(name: &str, splats: &Splats, camera: &Camera, options: &RasterOptions) {
    let options = RasterOptions { sh_basis: splats.sh_basis(), ..*options };
    let (all, mut on_gpu) = (slices(splats), Rasterizer::new(gpu().unwrap()));
    let got = on_gpu.render(&all, camera, &options).unwrap();
    let expected = cpu::Rasterizer::new().render(&all, camera, &options);
    let covered = expected.alpha.iter().filter(|&&a| a > 0.5).count();
    assert!(2 * covered > expected.alpha.len(), "{name}: little to see");
    let (off, worst) = differences(&got.rgb, &expected.rgb);
    let (alphas_off, _) = differences(&got.alpha, &expected.alpha);
    eprintln!("{name}: {off:.1e} of colours, {alphas_off:.1e} of alphas off, at most {worst:.1e}");
    assert!(off < FLIPPED && alphas_off < FLIPPED && worst < FLIP, "{name}: {off} {worst}");
    // The check fails for one changed splat in a thousand.
    let mut moved = splats.clone();
    moved.edit(|p| p.rows.chunks_mut(11 * 1000).for_each(|rows| rows[10] *= 0.5));
    let (off, worst) =
        differences(&on_gpu.render(&slices(&moved), camera, &options).unwrap().rgb, &expected.rgb);
    assert!(off > FLIPPED || worst > FLIP, "{name}: halved opacities pass: {off} {worst}");

    let upstream: Vec<f32> =
        (0..5 * expected.alpha.len()).map(|i| (i as f32 * 0.61).sin()).collect();
    let got = on_gpu.backward(&all, camera, &options, &upstream).unwrap();
    let mut expected = Gradients::default();
    cpu::Rasterizer::new().backward(&all, camera, &options, &upstream, &mut expected);
    let set = splats.sh().len() / all.parents();
    for (what, got, expected, lanes) in
        [("rows", &got.rows, &expected.rows, 11), ("sh", &got.sh, &expected.sh, set)]
    {
        let off = rows_off(got, expected, lanes);
        eprintln!("{name}: {off:.1e} of the gradients of {what} off");
        assert!(off < GRADIENTS_OFF, "{name} {what}: {off}");
        let mut wrong = got.clone();
        wrong.chunks_mut(50 * lanes).for_each(|rows| rows[0] += 1.0);
        assert!(rows_off(&wrong, expected, lanes) > GRADIENTS_OFF, "{name} {what}");
    }
}

#[test]
fn a_real_ply() {
    if gpu().is_none() {
        return;
    }
    let Some(folder) = common::shared("photos/re10k_5aca87f95a9412c6") else { return };
    let splats = load_splats(folder.join("5aca87f95a9412c6.globalsplat16k.ply")).unwrap();
    assert_eq!((splats.len(), splats.sh_degree()), (16_384, 3));
    let camera = load_scene(&folder).unwrap().frames[4].pinhole().unwrap();
    for convention in [Convention::Standard, Convention::Mvsplat] {
        check(&format!("{convention:?}"), &splats, &camera, &RasterOptions::new(convention));
    }
}

/// Side of the network's input, px. At 256, which took a software adapter 210 s, the pictures differed by 86.7 dB.
const SIDE: usize = 128;

/// Returns the example's photographs, with the options of `subsplat run examples/room --fit 0 --input-size 128`. A
/// fit amplifies differences of rounding: tests/gpu/fit.rs compares its loss.
fn room() -> (Scene, Vec<Photo>, Options) {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("examples/room");
    let scene = load_scene(&folder).unwrap();
    let photos = scene.frames[..2].iter().map(|f| Photo::from_frame(f).unwrap()).collect();
    let NearFar { near, far } = scene.near_far.unwrap();
    let options = Options::default().with_depth_range(DepthRange::Fixed { near, far });
    let options = options.with_input_size(SIDE, SIDE);
    (scene, photos, options.with_check(Check::Off).with_fit(FitOptions::off()))
}

/// Returns the fraction of the rows of a reconstruction that differ.
fn moved(got: &Splats, expected: &Splats) -> f64 {
    assert_eq!(
        (got.rows().len(), got.gain().len()),
        (expected.rows().len(), expected.gain().len())
    );
    let mut largest = [0f32; 11];
    for (i, v) in expected.rows().iter().enumerate() {
        largest[i % 11] = largest[i % 11].max(v.abs());
    }
    let rows = got.rows().chunks(11).zip(expected.rows().chunks(11));
    let off = rows.filter(|(g, e)| (0..11).any(|k| !((g[k] - e[k]).abs() <= COLUMN * largest[k])));
    off.count() as f64 / expected.len() as f64
}

/// Plane sweep, SPGR and rasterizer with the shipped weights, whose configuration has no
/// attention gather (tests/gpu/model.rs covers it).
#[test]
fn the_example_room_with_the_shipped_weights() {
    let Some(gpu) = gpu() else { return };
    let (scene, photos, run) = room();
    let model = Reconstructor::shipped(2).unwrap();
    let expected = model.run(&photos, &run).unwrap();
    let options = *expected.raster_options();
    let expected = expected.into_splats();
    let backend = Backend::from(gpu.clone());
    let model = model.with_backend(&backend);
    let got = model.run(&photos, &run).unwrap().into_splats();
    assert_eq!(backend.warning(), None);
    // Devices round differently, so equal bytes mean that the GPU computed nothing.
    assert!(got.rows() != expected.rows(), "the results have equal bytes");
    let share = moved(&got, &expected);
    eprintln!("{} Gaussians, {share:.1e} of them moved", got.len());
    assert!(share < MOVED, "{share} of the rows moved");
    let mut other = got.clone();
    other.edit(|p| p.rows.chunks_mut(11 * 40).for_each(|rows| rows[0] += 0.1));
    assert!(moved(&other, &expected) > MOVED, "moved rows pass");

    let size = Size::new(2 * SIDE, 2 * SIDE);
    let crop = CropOptions { target_size: size, ..model.crop_options(Size::new(SIDE, SIDE)) };
    let target = Photo::from_frame(&scene.frames[2]).unwrap().crop(&crop).unwrap();
    let camera = target.target_camera;
    let k = camera.intrinsics();
    assert_eq!((k.width, k.height), (256, 256));
    check("the room", &expected, &camera, &options);
    // Reconstruction and rendering on the GPU against both on the CPU, scored with a photograph
    // that is not an input.
    let photograph = target.target.to_unit();
    let score = |rgb: &[f32]| psnr(rgb, &photograph, size.width, size.height).unwrap();
    let ours = RasterOptions { sh_basis: got.sh_basis(), ..options };
    let by_gpu = Rasterizer::new(gpu).render(&slices(&got), &camera, &ours).unwrap().rgb;
    let by_cpu = cpu::Rasterizer::new().render(&slices(&expected), &camera, &ours).rgb;
    let [on_gpu, on_cpu] = [score(&by_gpu), score(&by_cpu)];
    let between = psnr(&by_gpu, &by_cpu, size.width, size.height).unwrap();
    eprintln!("{on_gpu:.2} dB on the GPU, {on_cpu:.2} dB on the CPU, {between:.1} dB differences");
    assert!(on_cpu > 20.0 && (on_gpu - on_cpu).abs() < 0.05, "{on_gpu} and {on_cpu} dB");
    assert!(between > 60.0, "{between} dB");
}
