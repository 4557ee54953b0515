//! One renderer for any device: what was asked for renders, and the CPU where that fails.

#[cfg(feature = "gpu")]
use subsplat_test_support::gpu as adapter;

use crate::program;

use glam::Mat4;
use program::{call_in, workplace};
use subsplat::scene::render::{Renderer, render};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{RasterOptions, SPLAT_STRIDE, ShBasis};

fn scene() -> (Splats, Camera) {
    let mut rows = Vec::new();
    for i in 0..50 {
        let t = i as f32 * 0.37;
        rows.extend([t.sin(), (1.7 * t).cos() * 0.7, 3.0 + (2.3 * t).sin()]);
        rows.extend([1.0, 0.3 * t.sin(), 0.2, -0.1 * t.cos(), 0.1, 0.15, 0.05, 0.7]);
    }
    let n = rows.len() / SPLAT_STRIDE;
    let sh = (0..3 * n).map(|i| (i as f32 * 0.9).sin()).collect();
    let splats = Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap();
    let k = Intrinsics::from_fov_x(0.9, 64, 48);
    (splats, Camera::new(k, Mat4::IDENTITY).unwrap())
}

#[test]
fn an_absent_adapter_leaves_the_cpu_and_a_warning() {
    let (splats, camera) = scene();
    let options = RasterOptions::default();
    let expected = render(&splats, &camera, &options);
    assert!(Renderer::open("no such adapter").is_err());
    let mut renderer = Renderer::open_or_cpu("no such adapter");
    let warning = renderer.take_warning().unwrap();
    assert!(warning.contains("no such adapter") && warning.contains("on the CPU"), "{warning}");
    assert_eq!(renderer.device(), "CPU");
    assert!(renderer.render(&splats, &camera, &options) == expected);
    assert_eq!(renderer.take_warning(), None);
    let mut plain = Renderer::open("cpu").unwrap();
    assert!(plain.render(&splats, &camera, &options) == expected);
}

#[cfg(feature = "gpu")]
#[test]
fn a_gpu_renders_what_the_cpu_does() {
    if adapter::gpu().is_none() {
        return;
    }
    let (splats, camera) = scene();
    let options = RasterOptions::default();
    let expected = render(&splats, &camera, &options);
    let mut renderer = Renderer::open("gpu").unwrap();
    assert_ne!(renderer.device(), "CPU");
    let got = renderer.render(&splats, &camera, &options);
    assert_eq!(renderer.take_warning(), None);
    // A decision at a threshold may flip at single pixels, worth 1/255 of a colour.
    let off = got.rgb.iter().zip(&expected.rgb).filter(|(a, b)| (*a - *b).abs() > 3e-5).count();
    assert!(off <= expected.rgb.len() / 1000, "{off} of {} numbers", expected.rgb.len());
    assert!(got.rgb.iter().zip(&expected.rgb).all(|(a, b)| (a - b).abs() < 0.02));
}

/// Mesa prints an error where no folder for sockets is named, though its driver works.
#[cfg(feature = "gpu")]
#[test]
fn a_gpu_is_opened_without_a_message_of_its_driver() {
    if adapter::gpu().is_none() {
        return;
    }
    let place = workplace();
    let quick = "run scene --context 0,1 --input-size 64 --fit 0 --refine off -o out";
    assert_eq!(call_in(place.path(), quick).code, 0);
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_subsplat"));
    command.args("render out --size 64 --device gpu -o views".split_whitespace());
    command.current_dir(place.path()).env_remove("XDG_RUNTIME_DIR");
    let called = program::called(&mut command);
    assert_eq!(called.code, 0, "{}", called.stderr);
    assert!(
        !called.stderr.contains("error") && !called.stderr.contains("XDG"),
        "{}",
        called.stderr
    );
}

/// A picture that is larger than WebGPU's default 128 MiB of a binding comes in bands.
#[cfg(feature = "gpu")]
#[test]
fn a_gpu_renders_a_picture_larger_than_a_binding() {
    if adapter::gpu().is_none() {
        return;
    }
    let (splats, camera) = scene();
    let camera = camera.resized(3200, 2400).unwrap();
    let options = RasterOptions::default();
    let mut renderer = Renderer::with_gpu(adapter::limited(128 << 20).unwrap());
    let got = renderer.render(&splats, &camera, &options);
    assert_eq!(renderer.take_warning(), None);
    let expected = render(&splats, &camera, &options);
    let off = got.rgb.iter().zip(&expected.rgb).filter(|(a, b)| (*a - *b).abs() > 3e-5).count();
    assert!(off <= expected.rgb.len() / 1000, "{off} of {} numbers", expected.rgb.len());
    assert!(got.rgb.iter().zip(&expected.rgb).all(|(a, b)| (a - b).abs() < 0.02));
}

/// The CPU takes over for the rest of the program, with one warning, where a scene does not fit
/// in bands and layers and where the device is lost.
#[cfg(feature = "gpu")]
#[test]
fn what_a_gpu_cannot_do_the_cpu_does() {
    let Some(small) = adapter::limited(2 << 10) else { return };
    let lost = adapter::limited(128 << 20).unwrap();
    lost.device().destroy();
    let (splats, camera) = scene();
    let options = RasterOptions::default();
    let expected = render(&splats, &camera, &options);
    for (gpu, hint) in [(small, "GPU too small for a row of tiles"), (lost, "GPU lost")] {
        let mut renderer = Renderer::with_gpu(gpu);
        assert_ne!(renderer.device(), "CPU");
        for first in [true, false] {
            assert!(renderer.render(&splats, &camera, &options) == expected);
            let warning = renderer.take_warning();
            assert_eq!(warning.is_some(), first, "{warning:?}");
            let told = warning.unwrap_or_else(|| format!("{hint} on the CPU"));
            assert!(told.starts_with(hint) && told.contains("on the CPU"), "{told}");
            assert_eq!(told.lines().count(), 1, "{told}");
        }
        assert_eq!(renderer.device(), "CPU");
    }
}

const RUN: &str = "--json run scene --context 0,2 --input-size 64 --no-check";

/// The whole program on a GPU scores as it does on the CPU, and says nothing of it.
#[cfg(feature = "gpu")]
#[test]
fn run_reconstructs_on_a_gpu() {
    if adapter::gpu().is_none() {
        return;
    }
    let place = workplace();
    let [cpu, gpu] = ["cpu", "gpu"].map(|device| {
        let called = call_in(place.path(), &format!("{RUN} --device {device} -o {device}"));
        assert_eq!(called.code, 0, "{}", called.stderr);
        assert!(!called.stderr.contains("on the CPU"), "{}", called.stderr);
        called.json()
    });
    assert_eq!(cpu["gaussians"], gpu["gaussians"]);
    assert_eq!(cpu["warnings"], gpu["warnings"]);
    let [cpu, gpu] = [cpu, gpu].map(|report| report["psnr"].as_f64().unwrap());
    assert!((cpu - gpu).abs() < 0.05 && cpu != gpu, "{cpu} and {gpu} dB");
}

#[test]
fn run_without_the_adapter_that_was_asked_for_goes_on() {
    let place = workplace();
    let called = call_in(place.path(), &format!("{RUN} --device nonesuch -o out"));
    assert_eq!(called.code, 0, "{}", called.stderr);
    let told = called.stderr.lines().filter(|l| l.contains("nonesuch")).collect::<Vec<_>>();
    assert!(told.iter().any(|l| l.contains("reconstructing on the CPU")), "{}", called.stderr);
    assert!(called.json()["gaussians"].as_u64().unwrap() > 0);
}
