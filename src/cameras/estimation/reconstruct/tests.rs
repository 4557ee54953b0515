use super::super::pair::PairEstimate;
use super::super::photo::{Lens, deviations};
use super::super::refine::Refined;
use super::super::two_view::{Bearings, Relative, rotation};
use super::*;
use crate::cameras::matches::GrayImage;
use crate::cameras::matches::features::{Feature, Features, PyramidPoint};
use crate::cameras::matches::pairs::Pair;
use crate::cameras::matches::random::SplitMix;
use subsplat_kernels::camera::Intrinsics;

/// Side of the photographs, px.
const SIDE: usize = 64;

/// Photographs without texture, whose features show `points`, from cameras on an arc.
fn photographs(count: usize, points: usize, random: &mut SplitMix) -> Vec<PosePhoto> {
    let coordinate = |random: &mut SplitMix| 2.0 * random.uniform() - 1.0;
    let points: Vec<DVec3> = (0..points)
        .map(|_| DVec3::from_array(std::array::from_fn(|_| coordinate(random))) + DVec3::Z * 4.0)
        .collect();
    (0..count)
        .map(|i| {
            let turn = rotation(DVec3::Y * (0.12 * i as f64));
            let centre = DVec3::Z * 4.0;
            let pose = Absolute { rotation: turn, translation: centre - turn * centre };
            photograph(&points, &pose)
        })
        .collect()
}

fn photograph(points: &[DVec3], pose: &Absolute) -> PosePhoto {
    let intrinsics = Intrinsics::from_fov_x(1.0, SIDE, SIDE);
    let bearings: Vec<DVec2> =
        points.iter().map(|p| pose.to_camera(*p)).map(|q| q.truncate() / q.z).collect();
    let feature = |b: &DVec2| {
        let [x, y] = [b.x, b.y].map(|v| v as f32 * intrinsics.fx + 0.5 * SIDE as f32);
        let position = PyramidPoint { octave: 0, level: 1, x, y, sigma: 1.0, angle: 0.0 };
        Feature { x, y, size: 1.0, response: 1.0, position }
    };
    let features =
        Features { points: bearings.iter().map(feature).collect(), descriptors: Vec::new() };
    PosePhoto {
        image: GrayImage::new(SIDE, SIDE, vec![0.5; SIDE * SIDE]).unwrap(),
        features,
        lens: Lens::known(intrinsics),
        working: intrinsics,
        bend: 0.0,
        colours: vec![[0; 3]; bearings.len()],
        bearings,
        views: Vec::new(),
    }
}

/// The pair of photographs `i` and `j` with the pose `relative`. The first `shared` features of both
/// are matched.
fn edge(photos: &[PosePhoto], [i, j]: [usize; 2], shared: usize, relative: Relative) -> Edge {
    let deviation = deviations(&photos[i])[0];
    let bearings = |k: usize| Bearings {
        a: photos[i].bearings[k],
        b: photos[j].bearings[k],
        deviation,
        views: None,
    };
    let estimate = PairEstimate {
        refined: Refined { relative, focal_scale: 1.0, information: Default::default() },
        inliers: (0..shared).map(|k| Pair { a: k, b: k, ratio: 0.5 }).collect(),
        points: (0..shared).map(bearings).collect(),
        matches: shared,
        consistent: shared,
        free_focal: false,
        rival: 0.0,
    };
    Edge { photos: [i, j], estimate }
}

/// All pairs of the `count` photographs of one scene from `first` on.
fn edges_of_scene(photos: &[PosePhoto], first: usize, count: usize) -> Vec<Edge> {
    let mut edges = Vec::new();
    for i in 0..count {
        for j in i + 1..count {
            let turn = rotation(DVec3::Y * (0.12 * (j - i) as f64));
            let centre = DVec3::Z * 4.0;
            let translation = (centre - turn * centre).normalize();
            let shared = photos[first + i].bearings.len();
            let relative = Relative { rotation: turn, translation };
            edges.push(edge(photos, [first + i, first + j], shared, relative));
        }
    }
    edges
}

/// Photographs of scenes, each with (photographs, points), one scene after the other.
fn scenes(of: &[(usize, usize)]) -> (Vec<PosePhoto>, Vec<Edge>) {
    let mut random = SplitMix(11);
    let all = of.iter().map(|&(count, points)| photographs(count, points, &mut random));
    let photos: Vec<PosePhoto> = all.flatten().collect();
    let (mut edges, mut first) = (Vec::new(), 0);
    for &(count, _) in of {
        edges.extend(edges_of_scene(&photos, first, count));
        first += count;
    }
    (photos, edges)
}

fn placed(photos: &[PosePhoto], edges: &[Edge]) -> Vec<usize> {
    let model = build(photos, edges, None, 1).unwrap();
    (0..photos.len()).filter(|&i| model.cameras[i].is_some()).collect()
}

#[test]
fn the_larger_group_is_used_and_not_the_best_pair() {
    let (photos, edges) = scenes(&[(3, 160), (5, 60)]);
    let (_, best) = start(&edges[..3], &[true; 8]).unwrap();
    assert_eq!(best.estimate.inliers.len(), 160);
    assert_eq!(placed(&photos, &edges), [3, 4, 5, 6, 7]);
    // Of equally large groups the one of the best pair.
    let (photos, edges) = scenes(&[(3, 60), (3, 160)]);
    assert_eq!(placed(&photos, &edges), [3, 4, 5]);
}

#[test]
fn groups_that_a_wrong_pair_joins_are_built_one_after_the_other() {
    let (photos, mut edges) = scenes(&[(3, 160), (5, 60)]);
    let relative = edges[0].estimate.refined.relative;
    edges.push(edge(&photos, [1, 6], 24, relative));
    let (size, first) = start(&edges, &[true; 8]).unwrap();
    assert_eq!((size, first.estimate.inliers.len()), (8, 160));
    assert_eq!(placed(&photos, &edges), [3, 4, 5, 6, 7]);
    // The other way round the first model stays.
    let (photos, mut edges) = scenes(&[(3, 60), (5, 160)]);
    edges.push(edge(&photos, [1, 6], 24, relative));
    assert_eq!(placed(&photos, &edges), [3, 4, 5, 6, 7]);
}

#[test]
fn one_group_starts_with_its_best_pair() {
    let (photos, edges) = scenes(&[(5, 60)]);
    let (size, first) = start(&edges, &[true; 5]).unwrap();
    let angles: Vec<f64> = edges.iter().map(|e| e.estimate.median_angle()).collect();
    let wide = angles.iter().position(|a| *a > START_ANGLE).unwrap();
    assert_eq!((size, first.photos), (5, edges[wide].photos), "{angles:?}");
    assert_eq!(placed(&photos, &edges), [0, 1, 2, 3, 4]);
    assert!(start(&edges, &[true, false, false, false, false]).is_none());
    assert!(build(&photos, &[], None, 1).is_none());
}
