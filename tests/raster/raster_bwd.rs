//! The rasterizer's gradients against the conformance cases of
//! `shared/fixtures/raster` (float64, both conventions; one case by gsplat).

use subsplat_test_support as common;
use subsplat_test_support::raster_case;
use subsplat_test_support::raster_gradients;

use common::{raster_cases, shared};
use glam::{DVec3, Mat4, Vec3};
use raster_case::{File, rows};
use raster_gradients::{check, part, planes, worst_row};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Geometry, Gradients, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{RasterOptions, SPLAT_STRIDE};

fn check_case(name: &str) {
    let Some(path) = shared(&format!("fixtures/raster/{name}.safetensors")) else { return };
    let file = File::read(&path);
    let (camera, options) = (file.camera(), file.options());
    let upstream = planes(file.get("v_rgb"), file.get("v_alpha"));
    file.with_splats(|splats| {
        let mut got = Gradients::default();
        Rasterizer::new().backward(splats, &camera, &options, &upstream, &mut got);
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

/// gsplat's own gradients, through brush: of logarithms and logits, and with the SH
/// direction detached. Ours is not, so its share, which follows from the colour's
/// gradient (that of the constant coefficient), is taken off the means' first.
#[test]
fn brush_tiny() {
    let Some(path) = shared("fixtures/raster/brush_tiny.safetensors") else { return };
    let file = File::read(&path);
    let (width, height) = (123, 82);
    let k = Intrinsics { fx: 61.5, fy: 61.5, cx: 61.5, cy: 41.0, width, height };
    let eye = Vec3::new(0.123, 0.456, -8.0);
    let camera = Camera::new(k, Mat4::from_translation(eye)).unwrap();
    let scales: Vec<f32> = file.get("scales").iter().map(|s| s.exp()).collect();
    let opacities: Vec<f32> =
        file.get("opacities").iter().map(|o| 1.0 / (1.0 + (-o).exp())).collect();
    let packed = rows(file.get("means"), file.get("quats"), &scales, &opacities);
    let sh = file.get("coeffs");
    let geometry = Geometry::Packed(&packed);
    let splats = SplatSlices { geometry, sh, gain: &[], sh_degree: 3 };
    let v = file.get("v_out_img");
    let n = width * height;
    let mut upstream = vec![0.0; 5 * n];
    for p in 0..n {
        for c in 0..4 {
            upstream[c * n + p] = v[4 * p + c];
        }
    }
    let mut got = Gradients::default();
    let o = RasterOptions::default();
    Rasterizer::new().backward(&splats, &camera, &o, &upstream, &mut got);

    let mut means = part(&got.rows, 0, 3);
    let mut moved = 0.0f64;
    for (i, mean) in means.chunks_exact_mut(3).enumerate() {
        let colour: [f64; 3] = std::array::from_fn(|c| f64::from(got.sh[48 * i + c]) / 0.282_094_8);
        let at = DVec3::from_array(splat_mean(&packed, i)) - eye.as_dvec3();
        let loss = |at: DVec3| -> f64 {
            let y = subsplat_kernels::sh::standard(at.normalize());
            (0..16)
                .map(|k| {
                    (0..3).map(|c| colour[c] * f64::from(sh[48 * i + 3 * k + c])).sum::<f64>()
                        * y[k]
                })
                .sum()
        };
        for axis in 0..3 {
            let mut h = DVec3::ZERO;
            h[axis] = 1e-5;
            let share = (loss(at + h) - loss(at - h)) / 2e-5;
            moved = moved.max(share.abs());
            mean[axis] -= share as f32;
        }
    }
    assert!(moved > 1e-6, "the direction moves no colour: {moved}");
    let by = |values: Vec<f32>, factor: &dyn Fn(usize) -> f32| -> Vec<f32> {
        values.iter().enumerate().map(|(i, v)| v * factor(i)).collect()
    };
    let scales = by(part(&got.rows, 7, 3), &|i| scales[i]);
    let opacities = by(part(&got.rows, 10, 1), &|i| opacities[i] * (1.0 - opacities[i]));
    let all = [
        ("means", means, 3),
        ("quats", part(&got.rows, 3, 4), 4),
        ("scales", scales, 3),
        ("opacities", opacities, 1),
        ("coeffs", got.sh, 48),
    ];
    for (what, values, lanes) in all {
        let e = worst_row(&values, file.get(&format!("v_{what}")), lanes);
        eprintln!("brush_tiny {what}: {e:.1e}");
        assert!(e < 5e-4, "{what}: {e}");
    }
}

fn splat_mean(packed: &[f32], i: usize) -> [f64; 3] {
    std::array::from_fn(|c| f64::from(packed[SPLAT_STRIDE * i + c]))
}

#[test]
fn every_fixture_has_a_test() {
    for path in raster_cases() {
        let stem = path.file_stem().unwrap().to_str().unwrap();
        assert!(include_str!("raster_bwd.rs").contains(stem), "no test for {stem}");
    }
}
