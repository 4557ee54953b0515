//! Placing primaries on a GPU, against the CPU's kernel and the definition in tensor operations.

use subsplat_test_support::cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_test_support::primaries_reference;

use super::array::{executor, values};
use candle_core::{DType, Device, Tensor};
use glam::{EulerRot, Mat4, Quat, Vec3};
use subsplat::network::config::{Mvsplat, Primaries as Settings, ShFrame};
use subsplat::network::model::primaries::{adapter_of, primaries};
use subsplat::network::model::trace::Trace;
use subsplat::network::model::{BackboneOutput, Views};
use subsplat::network::ops::{Array, ColourLayout};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::sh_coefficients;

/// Height and width, px; neither is a multiple of a workgroup.
const SIZE: (usize, usize) = (7, 11);

/// Tolerance: a dozen roundings and the device's exponential and logarithm, whose error a power of
/// 1/e multiplies.
const TOLERANCE: f32 = 8e-6;

fn views() -> Views {
    let (h, w) = SIZE;
    let k = Intrinsics { fx: 9.0, fy: 8.0, cx: 5.7, cy: 3.2, width: w, height: h };
    let camera = |i: f32| {
        let turn = Quat::from_euler(EulerRot::XYZ, 0.3 * i, 1.0 - i, 0.7 * i);
        Camera::new(k, Mat4::from_rotation_translation(turn, Vec3::new(i, -0.5, 0.2 * i))).unwrap()
    };
    let images = Tensor::zeros((1, 2, 3, h, w), DType::F32, &Device::Cpu).unwrap();
    let near_far = vec![vec![NearFar::RE10K; 2]];
    Views::new(images, vec![vec![camera(0.4), camera(1.3)]], near_far).unwrap()
}

/// Head rows of `per_pixel` Gaussians a pixel, some with a quaternion of 0, and densities that
/// include 0 and 1.
fn output(per_pixel: usize, degree: usize) -> BackboneOutput {
    let (r, pixels, row) = (&mut Random(5), 2 * SIZE.0 * SIZE.1, 9 + 3 * sh_coefficients(degree));
    let mut raw = r.many(pixels * row, -2.0, 2.0);
    raw.chunks_mut(row).step_by(17).for_each(|row| row[5..9].fill(0.0));
    let depths = r.many(pixels * per_pixel, 0.5, 9.0);
    let mut densities = r.many(pixels * per_pixel, 0.0, 1.0);
    (densities[0], densities[1]) = (0.0, 1.0);
    let tensor = |v: Vec<f32>, last: usize| {
        Tensor::from_vec(v, (1, 2, pixels / 2, last), &Device::Cpu).unwrap()
    };
    BackboneOutput {
        raw: tensor(raw, row),
        depths: tensor(depths, per_pixel),
        densities: tensor(densities, per_pixel),
        features: Vec::new(),
    }
}

#[test]
fn primaries_agree_with_the_cpu_and_with_the_definition() {
    let Some(gpu) = executor() else { return };
    let views = views();
    let cases = [
        (1, 4, ShFrame::Mvsplat, 0.0),
        (1, 4, ShFrame::MvsplatExact, 1.5),
        (3, 1, ShFrame::Standard, -0.5),
        (2, 0, ShFrame::Standard, 0.0),
    ];
    for (per_pixel, sh_degree, sh_frame, opacity_exponent) in cases {
        let own = Mvsplat::re10k().primaries;
        let settings = Settings { sh_degree, sh_frame, opacity_exponent, ..own };
        let out = output(per_pixel, sh_degree);
        let [raw, depths, densities] =
            [&out.raw, &out.depths, &out.densities].map(|t| gpu.upload(t).unwrap());
        let adapter = adapter_of(&out, &views, &settings).unwrap();
        let rows = raw.placed(&depths, &densities, &adapter).unwrap();
        let host = |first: usize, count: usize| {
            values(&rows.narrow(1, first, count).unwrap().to_host().unwrap())
        };
        let sh = |layout| values(&raw.placed_colours(&adapter, layout).unwrap().to_host().unwrap());
        let cpu = primaries(&out, &views, &settings, &mut Trace::off()).unwrap();
        let definition = primaries_reference::primaries(&out, &views, &settings).unwrap();
        for (name, p) in [("CPU", cpu), ("definition", definition)] {
            let same = |what: &str, got: Vec<f32>, expected: &Tensor| {
                let name = format!("{what}, {name}, G = {per_pixel}, degree {sh_degree}");
                assert_matches_cpu(&name, &got, &values(expected), TOLERANCE);
            };
            same("means", host(0, 3), &p.means);
            same("quaternions", host(3, 4), &p.quats_wxyz);
            same("scales", host(7, 3), &p.scales);
            same("opacities", host(10, 1), &p.opacities);
            same("SH", sh(ColourLayout::World), &p.sh.transpose(2, 3).unwrap());
            same("SH by colour", sh(ColourLayout::WorldByColour), &p.sh);
            same("SH of the view", sh(ColourLayout::Camera), &p.sh_camera);
        }
    }
}

#[test]
fn arrays_of_other_sizes_are_refused() {
    let Some(gpu) = executor() else { return };
    let (views, settings, out) = (views(), Mvsplat::re10k().primaries, output(1, 4));
    let adapter = adapter_of(&out, &views, &settings).unwrap();
    let [raw, depths] = [&out.raw, &out.depths].map(|t| gpu.upload(t).unwrap());
    let short = depths.narrow(2, 0, 64).unwrap();
    let refused = |text: String| assert!(text.contains("expected"), "{text}");
    refused(raw.placed(&short, &depths, &adapter).unwrap_err().to_string());
    refused(raw.placed(&depths, &short, &adapter).unwrap_err().to_string());
    refused(short.placed(&depths, &depths, &adapter).unwrap_err().to_string());
    refused(depths.placed_colours(&adapter, ColourLayout::World).unwrap_err().to_string());
}
