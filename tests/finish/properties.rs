//! The optimisers on random scenes and pictures of a fixed seed: no result is worse than its start by the measure that
//! the report states, and every number stays finite and in range.

use glam::{Mat4, Vec3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::ops::ControlFlow;
use subsplat::finish::{FitOptions, PhaseRun, RefineOptions, fit, refine};
use subsplat::scene::pictures::Rgb;
use subsplat::{Camera, Intrinsics, RasterOptions, Renderer, ShBasis, Splats, TargetView};
use subsplat_kernels::layout::OPACITY_OFFSET;

/// Side of the pictures, px.
const SIDE: usize = 16;

fn camera(x: f32) -> Camera {
    let k = Intrinsics::from_fov_x(1.0, SIDE, SIDE);
    Camera::new(k, Mat4::from_translation(Vec3::X * x)).unwrap()
}

/// One to twelve Gaussians before the cameras, in any direction and of any size.
fn splats() -> impl Strategy<Value = Splats> {
    let row = (
        prop::array::uniform2(-1.0..1.0f32),
        1.0..4.0f32,
        prop::array::uniform4(-1.0..1.0f32),
        prop::array::uniform3(-5.0..0.5f32),
        0.0..1.0f32,
        prop::array::uniform3(-1.5..1.5f32),
    );
    prop::collection::vec(row, 1..12).prop_map(|rows| {
        let (mut packed, mut sh) = (Vec::new(), Vec::new());
        for ([x, y], z, q, log_scales, opacity, colour) in rows {
            packed.extend([x, y, z]);
            packed.extend(if q.iter().all(|v| v.abs() < 0.05) { [1.0, 0.0, 0.0, 0.0] } else { q });
            packed.extend(log_scales.map(f32::exp));
            packed.push(opacity);
            sh.extend(colour);
        }
        Splats::new(packed, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
    })
}

fn picture() -> impl Strategy<Value = Rgb> {
    prop::collection::vec(any::<u8>(), 3 * SIDE * SIDE).prop_map(|data| Rgb {
        width: SIDE,
        height: SIDE,
        data,
    })
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 64,
        rng_seed: RngSeed::Fixed(0x5EED),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn no_optimiser_makes_a_scene_worse(
        start in splats(),
        pictures in prop::array::uniform2(picture()),
        steps in 1..12usize,
    ) {
        let cameras = [camera(-0.1), camera(0.1)];
        let views: Vec<TargetView<'_>> =
            cameras.iter().zip(&pictures).map(|(camera, image)| TargetView { camera, image }).collect();
        let (raster, mut renderer) = (RasterOptions::default(), Renderer::default());
        let mut go_on = |_: usize| ControlFlow::Continue(());
        let mut fitted = start.clone();
        let options = FitOptions::default().with_steps(steps);
        let first = fit(&mut fitted, &views, &raster, &options, &mut renderer, &mut go_on).unwrap();
        let mut go_on = |_: &PhaseRun<'_>| ControlFlow::Continue(());
        let mut refined = fitted.clone();
        let options = RefineOptions::default().with_steps(steps);
        let second = refine(&mut refined, &views, &raster, &options, &mut renderer, &mut go_on).unwrap();
        prop_assert!(first.after <= first.before && second.after <= second.before, "{:?} {:?}", first, second);
        for splats in [&fitted, &refined] {
            prop_assert!(splats.rows().iter().chain(splats.sh()).chain(splats.gain()).all(|v| v.is_finite()));
            prop_assert!(splats.rows().chunks(11).all(|row| (0.0..=1.0).contains(&row[OPACITY_OFFSET])));
        }
    }
}
