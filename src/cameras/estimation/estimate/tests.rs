//! Thresholds of refusals and warnings, each by cases 2 % below and above it. They stand here as numbers, so that a
//! change of a constant is seen.

use super::super::focal::{Built, spread, starts};
use super::super::refine::FocalPrior;
use super::*;
use crate::cameras::estimation::photo::Lens;
use crate::cameras::estimation::refine::Refined;
use crate::cameras::estimation::two_view::Relative;
use glam::DVec2;
use nalgebra::SMatrix;

/// A photograph of 640 px with a focal length of 640 px: a distance on the plane z = 1 is 640 px.
fn photo(deviation: f64) -> PosePhoto {
    let intrinsics = Intrinsics { fx: 640.0, fy: 640.0, cx: 320.0, cy: 2.0, width: 640, height: 4 };
    PosePhoto::from_rgb8(&[128; 3 * 640 * 4], Lens { intrinsics, deviation }, 10).unwrap()
}

/// Points on two rings, of which a step forward moves the outer ones by `px`; no rotation explains any of it.
fn forward(px: f64) -> Vec<Bearings> {
    let ring = |radius: f64| {
        (0..20).map(move |i| {
            let a = radius * DVec2::from_angle(std::f64::consts::TAU * f64::from(i) / 20.0);
            let b = a * (1.0 + px / 640.0 / 0.2);
            Bearings { a, b, deviation: 1e-3, views: None }
        })
    };
    ring(0.1).chain(ring(0.2)).collect()
}

fn estimate(consistent: usize, matches: usize, rival: f64) -> PairEstimate {
    let relative = Relative { rotation: DMat3::IDENTITY, translation: -DVec3::Z };
    let refined = Refined { relative, focal_scale: 1.0, information: SMatrix::identity() * 1e9 };
    let points = forward(20.0);
    PairEstimate {
        refined,
        inliers: Vec::new(),
        points,
        matches,
        consistent,
        free_focal: false,
        rival,
    }
}

#[test]
fn few_matches_are_refused_by_number_and_by_share() {
    let a = photo(0.0);
    let found = |consistent, matches| refusal(&a, &estimate(consistent, matches, 0.0));
    assert_eq!(
        found(14, 20),
        Some(PoseRefusal::FewMatches { consistent: 14, matches: 20, needed: 15 })
    );
    assert_eq!(found(15, 20), None);
    let few = PoseRefusal::FewMatches { consistent: 199, matches: 1000, needed: 200 };
    assert_eq!([found(199, 1000), found(200, 1000)], [Some(few), None]);
}

#[test]
fn an_equal_rival_is_refused() {
    let a = photo(0.0);
    assert_eq!(refusal(&a, &estimate(100, 200, 0.98)), None);
    let rival = refusal(&a, &estimate(100, 200, 0.99));
    assert!(matches!(rival, Some(PoseRefusal::Ambiguous { percent }) if percent == 99.0));
}

#[test]
fn views_of_one_place_are_refused() {
    let a = photo(0.0);
    assert!(matches!(
        still(&a, &forward(0.98), 1.0),
        Some(PoseRefusal::PureRotation { parallax_px, .. }) if (parallax_px - 0.98).abs() < 1e-3
    ));
    assert_eq!(still(&a, &forward(1.02), 1.0), None);
    // All points move alike, as under a turn.
    let aside = |px: f64| {
        let moved = |m: Bearings| Bearings { b: m.a + DVec2::X * px / 640.0, ..m };
        let points: Vec<Bearings> = forward(0.0).into_iter().map(moved).collect();
        still(&a, &points, 1.0)
    };
    assert!(matches!(aside(0.49), Some(PoseRefusal::SameView { .. })));
    assert!(matches!(aside(0.51), Some(PoseRefusal::PureRotation { .. })));
}

#[test]
fn weak_pairs_have_warnings() {
    let warnings = |consistent: usize, rival: f64, deviation: f64| {
        let (a, b) = (photo(deviation), photo(0.0));
        let found = judged(&a, &b, Ok(estimate(consistent, 50, rival)), &PoseOptions::default());
        found.unwrap().warnings
    };
    assert_eq!(warnings(45, 0.98 * 0.85, 0.98 * 0.1), []);
    assert_eq!(warnings(44, 0.0, 0.0), [PoseWarning::FewPoints { count: 44 }]);
    assert!(matches!(warnings(45, 1.02 * 0.85, 0.0)[..], [PoseWarning::Rival { .. }]));
    assert!(matches!(warnings(45, 0.0, 1.02 * 0.1)[..], [PoseWarning::FocalOfTwo { .. }]));
}

#[test]
fn uncertain_cameras_have_warnings() {
    let a = photo(0.0);
    let warnings = |focal_deviation: f64, degrees: f64| {
        let position_deviation = degrees.to_radians();
        let model = Model { focal_deviation, position_deviation, ..model(2, Vec::new()) };
        finished(&[&a, &a], model, Vec::new(), Vec::new())
    };
    let certain = warnings(0.98 * 0.12, 0.98 * 1.5);
    assert_eq!((certain.warnings.len(), certain.confidence), (0, Confidence::High));
    let focal = warnings(1.02 * 0.12, 0.0);
    assert!(matches!(focal.warnings[..], [PoseWarning::UncertainFocal { .. }]));
    assert_eq!(focal.confidence, Confidence::Low);
    let direction = warnings(0.0, 1.02 * 1.5).warnings;
    assert!(matches!(direction[..], [PoseWarning::UncertainDirection { .. }]));
}

#[test]
fn an_unknown_lens_that_comes_out_long_is_doubted() {
    let warnings = |deviation: f64, scale: f64| {
        let a = photo(deviation);
        narrow_view(&[&a, &a], scale)
    };
    // The focal length is the photographs' width times the scale.
    assert_eq!(warnings(0.35, 0.98 * 1.5), None);
    let narrow = warnings(0.35, 1.02 * 1.5);
    assert!(
        matches!(narrow, Some(PoseWarning::NarrowView { degrees }) if (degrees - 36.2).abs() < 0.1)
    );
    // The file states it.
    assert_eq!(warnings(0.03, 2.0), None);
}

#[test]
fn several_focal_lengths_are_tried_where_the_matches_do_not_tell_it() {
    let found = |deviation| starts(FocalPrior { mean: 0.2, deviation });
    assert_eq!(found(0.147), [0.2f64.exp()]);
    let tried = found(0.153);
    assert_eq!(tried.len(), 3);
    assert!((tried[2] / tried[0] - (1.2f64 * 0.153).exp()).abs() < 1e-12, "{tried:?}");
    assert!((tried[1] * tried[2] / tried[0].powi(2) - 1.0).abs() < 1e-12, "{tried:?}");
}

#[test]
fn a_focal_length_is_as_uncertain_as_its_rival_is_far() {
    let built = |first: f64, features: usize| {
        let feature = |feature| FeatureId { photo: 0, feature };
        let point = Point { position: DVec3::Z, features: (0..features).map(feature).collect() };
        let model = model(0, vec![point]);
        Built { first, photos: Vec::new(), edges: Vec::new(), prior: None, model }
    };
    let of = |rival: usize| spread(&[built(0.9, 1000), built(1.2, rival), built(1.0, 900)]);
    assert!((of(833) - (1.0f64 / 0.9).ln()).abs() < 1e-12);
    assert!((of(867) - (1.2f64 / 0.9).ln()).abs() < 1e-12);
    assert_eq!([spread(&[]), spread(&[built(0.9, 10)])], [0.0, 0.0]);
}

/// A model of `placed` photographs.
fn model(placed: usize, points: Vec<Point>) -> Model {
    Model {
        cameras: vec![Some(Absolute::IDENTITY); placed],
        points,
        focal_scale: 1.1,
        focal_deviation: 0.01,
        rotation_deviation: 0.0,
        position_deviation: 0.0,
        bend: None,
        bundle: None,
    }
}

#[test]
fn few_points_do_not_tell_an_unknown_lens() {
    let point = Point { position: DVec3::Z, features: Vec::new() };
    let few = |points, deviation| too_few(&model(5, vec![point.clone(); points]), deviation);
    assert_eq!([few(196, 0.35), few(204, 0.35), few(196, 0.098)], [true, false, false]);
}
