//! The fit of Gaussians to pictures: it finds sizes and opacities again, keeps the geometry, and
//! leaves a set alone where it cannot make it better.

use std::ops::ControlFlow;
use subsplat::finish::{FitReport, fit};
use subsplat::scene::pictures::Rgb;
use subsplat::{FinishError, FitOptions, RasterOptions, Renderer, Splats, TargetView};
use subsplat_kernels::layout::{OPACITY_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};
use subsplat_test_support::fit_scene::{SIDE, cameras, pictures, plane};

fn fitted(splats: &mut Splats, truth: &[Rgb], steps: usize) -> FitReport {
    let cameras = cameras();
    let views: Vec<TargetView<'_>> =
        cameras.iter().zip(truth).map(|(camera, image)| TargetView { camera, image }).collect();
    let options = FitOptions::default().with_steps(steps);
    let (raster, mut renderer) = (RasterOptions::default(), Renderer::default());
    fit(splats, &views, &raster, &options, &mut renderer, &mut |_| ControlFlow::Continue(()))
        .unwrap()
}

fn median(splats: &Splats, offset: usize) -> f32 {
    let mut all: Vec<f32> = splats.rows().chunks(SPLAT_STRIDE).map(|row| row[offset]).collect();
    all.sort_by(f32::total_cmp);
    all[all.len() / 2]
}

#[test]
fn sizes_and_opacities_move_towards_the_truth() {
    let sharp = plane(0.5, 0.9);
    let truth = pictures(&sharp);
    let blurred = plane(1.1, 0.3);
    let mut splats = blurred.clone();
    let report = fitted(&mut splats, &truth, 10);
    assert!(report.after < 0.3 * report.before, "{report:?}");
    for offset in [SCALE_OFFSET, OPACITY_OFFSET] {
        let distance = |s: &Splats| (median(s, offset) - median(&sharp, offset)).abs();
        assert!(distance(&splats) < 0.7 * distance(&blurred), "element {offset}");
    }
    // Means, rotations and SH stay; each Gaussian has a colour offset.
    for (row, before) in splats.rows().chunks(SPLAT_STRIDE).zip(blurred.rows().chunks(SPLAT_STRIDE))
    {
        assert_eq!(row[..SCALE_OFFSET], before[..SCALE_OFFSET]);
    }
    assert_eq!((splats.sh(), splats.gain().len()), (blurred.sh(), 4 * blurred.len()));
    // The result does not depend on the number of threads.
    let mut again = blurred.clone();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(pool.install(|| fitted(&mut again, &truth, 10)), report);
    assert!(again == splats);
}

#[test]
fn the_limit_of_the_scales_holds() {
    let truth = pictures(&plane(0.2, 0.9));
    let mut splats = plane(1.5, 0.3);
    fitted(&mut splats, &truth, 12);
    let pixel = 2.0 / SIDE as f32;
    let least = 1.5 * pixel * (-0.5f32).exp();
    let found = splats.rows().chunks(SPLAT_STRIDE).map(|row| row[SCALE_OFFSET]);
    let found = found.fold(f32::INFINITY, f32::min);
    assert!((found / least - 1.0).abs() < 1e-4, "{found} {least}");
}

/// Four Gaussians for each SH set of the plane, which are children then.
fn children(splats: Splats) -> Splats {
    let mut parts = splats.into_parts();
    parts.sh = parts.sh.as_chunks::<3>().0.iter().step_by(4).flatten().copied().collect();
    Splats::try_from(parts).unwrap()
}

#[test]
fn children_start_sharper() {
    let truth = pictures(&children(plane(0.4, 0.9)));
    let scale_after_a_step = |mut splats: Splats| {
        let before = median(&splats, SCALE_OFFSET);
        fitted(&mut splats, &truth, 1);
        median(&splats, SCALE_OFFSET) / before
    };
    // One step changes ln σ by 0.25 at most, the start of children by ln 0.7 more.
    assert!(scale_after_a_step(children(plane(1.1, 0.3))) < 0.6);
    assert!(scale_after_a_step(plane(1.1, 0.3)) > 0.75);
}

#[test]
fn what_cannot_be_better_stays() {
    let sharp = plane(0.5, 0.9);
    let truth = pictures(&sharp);
    let mut splats = sharp.clone();
    let report = fitted(&mut splats, &truth, 1);
    assert!(report.after <= report.before);
    let mut untouched = sharp.clone();
    let report = fitted(&mut untouched, &truth, 0);
    assert!(untouched == sharp && report.before == report.after);
    // No view.
    let report = fitted(&mut untouched, &[], 4);
    assert!(untouched == sharp && report.before == report.after);
}

#[test]
fn a_cancelled_fit_changes_nothing() {
    let truth = pictures(&plane(0.5, 0.9));
    let (mut splats, cameras) = (plane(1.1, 0.3), cameras());
    let before = splats.clone();
    let views = [TargetView { camera: &cameras[0], image: &truth[0] }];
    let (raster, options) = (RasterOptions::default(), FitOptions::default());
    let mut steps = Vec::new();
    let mut stop = |step: usize| {
        steps.push(step);
        if step == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let result = fit(&mut splats, &views, &raster, &options, &mut Renderer::default(), &mut stop);
    assert!(matches!(result, Err(FinishError::Cancelled)));
    assert_eq!(steps, [1, 2]);
    assert!(splats == before);
}

#[test]
fn a_picture_of_another_size_is_refused() {
    let (mut splats, cameras) = (plane(1.1, 0.3), cameras());
    let image = Rgb { width: 2, height: 1, data: vec![0; 6] };
    let views = [TargetView { camera: &cameras[0], image: &image }];
    let (raster, options) = (RasterOptions::default(), FitOptions::default());
    let mut go_on = |_: usize| ControlFlow::Continue(());
    let error = fit(&mut splats, &views, &raster, &options, &mut Renderer::default(), &mut go_on);
    let text = error.unwrap_err().to_string();
    assert_eq!(text, "view 0: expected a picture of 48x48, got 2x1");
}
