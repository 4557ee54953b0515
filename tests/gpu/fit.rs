//! The fit on the GPU against the fit on the CPU.

use std::ops::ControlFlow;
use subsplat::finish::{FitReport, fit};
use subsplat::{FitOptions, RasterOptions, Renderer, Splats, TargetView};
use subsplat_test_support::fit_scene::{cameras, pictures, plane};
use subsplat_test_support::gpu::gpu;

/// Relative tolerance of the loss. A gradient of noise has either sign on either device, and
/// Adam's first step is as long for a small gradient as for a large one.
const LOSS: f64 = 2e-2;

fn fitted(splats: &mut Splats, renderer: &mut Renderer) -> FitReport {
    let (cameras, truth) = (cameras(), pictures(&plane(0.5, 0.9)));
    let views: Vec<TargetView<'_>> =
        cameras.iter().zip(&truth).map(|(camera, image)| TargetView { camera, image }).collect();
    let (raster, options) = (RasterOptions::default(), FitOptions::default());
    fit(splats, &views, &raster, &options, renderer, &mut |_| ControlFlow::Continue(())).unwrap()
}

#[test]
fn fit_as_on_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (mut on_gpu, mut on_cpu) = (plane(1.1, 0.3), plane(1.1, 0.3));
    let mut renderer = Renderer::with_gpu(gpu);
    let got = fitted(&mut on_gpu, &mut renderer);
    assert_eq!(renderer.take_warning(), None);
    assert_ne!(renderer.device(), "CPU");
    let expected = fitted(&mut on_cpu, &mut Renderer::default());
    assert!(expected.after < 0.5 * expected.before, "{expected:?}");
    for (got, expected) in [(got.before, expected.before), (got.after, expected.after)] {
        assert!((got / expected - 1.0).abs() < LOSS, "{got} {expected}");
    }
}
