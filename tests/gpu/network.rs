//! Attention gather and plane sweep on the GPU against the CPU versions.

use subsplat_test_support::cpu_against_gpu;
use subsplat_test_support::gather::base;
use subsplat_test_support::gpu as adapter;

use adapter::gpu;
use cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_kernels::cpu::{attention_gather as cpu, plane_sweep};
use subsplat_kernels::gpu::{AttentionGatherArgs, GpuError, PlaneSweepArgs};
use subsplat_kernels::layout::{Drop, Gather, Level, Pair, SampleConvention, Sweep};

/// Tolerance: sums of at most 64 products in another order; sample positions within the f32
/// rounding of 14 columns (1e-6 px); softmax weights whose exponential has an error of 3 + 2|x|
/// units in the last place. Each is about 1e-6, times a few samples.
const GATHER: f32 = 4e-6;

/// Tolerance of gradients: in addition, gradients of logits cancel and gradients of points are
/// multiplied by 14.
const GATHER_BWD: f32 = 1e-5;

/// Every option of a gather, and one with the sizes of the paper.
fn gathers() -> Vec<(&'static str, Gather)> {
    let levels = || {
        let fine = Level { height: 10, width: 14, first_cell: 70 };
        vec![Level { height: 5, width: 7, first_cell: 0 }, fine]
    };
    let three = vec![
        Level { height: 5, width: 7, first_cell: 0 },
        Level { height: 10, width: 14, first_cell: 105 },
    ];
    let two = levels;
    let drop =
        |probability| Some(Drop { probability, seed: 0xDEAD_BEEF_1234_5678, first_parent: 7 });
    vec![
        ("ref", base()),
        ("integer", Gather { sample_convention: SampleConvention::Integer, ..base() }),
        ("clamp", Gather { renormalise: false, ..base() }),
        ("two levels", Gather { levels: two(), ..base() }),
        ("three views", Gather { views: 3, levels: three, ..base() }),
        ("13 points", Gather { points: 13, ..base() }),
        ("13 points, groups", Gather { points: 13, groups: 4, levels: two(), ..base() }),
        ("offsets", Gather { points: 3, points_per_level: true, levels: two(), ..base() }),
        ("no projection", Gather { stride: 8, value: 0, ..base() }),
        ("linear", Gather { stride: 8, value: 0, key: None, groups: 2, points: 4, ..base() }),
        (
            "odd width",
            Gather { dim: 18, stride: 36, value: 18, groups: 2, levels: two(), ..base() },
        ),
        ("wide", Gather { dim: 192, stride: 384, value: 192, groups: 6, points: 4, ..base() }),
        ("dropping", Gather { drop: drop(0.3), points: 4, groups: 2, ..base() }),
        ("all dropped", Gather { drop: drop(1.0), ..base() }),
    ]
}

/// Random maps, query and points. The points of a parent are clustered; some are outside and one
/// is NaN.
fn inputs(g: &Gather, n: usize, r: &mut Random) -> [Vec<f32>; 3] {
    let ends = g.levels.iter().map(|l| l.first_cell + g.views * l.height * l.width);
    let maps = r.many(ends.max().unwrap() * g.stride, -1.0, 1.0);
    let query = r.many(n * g.query_width(), -1.0, 1.0);
    let mut points = Vec::new();
    for _ in 0..n * g.views {
        let centre = [r.range(-0.1, 1.1), r.range(-0.1, 1.1)];
        for _ in 0..g.points_width() {
            points.extend(centre.map(|c| c + r.range(-0.06, 0.06)));
        }
    }
    points[0] = f32::NAN;
    // All points of the second parent are outside.
    let row = points.len() / n;
    points[row..2 * row].fill(1.25);
    [maps, query, points]
}

#[test]
fn attention_gather() {
    let Some(gpu) = gpu() else { return };
    let mut r = Random(1);
    for (name, g) in gathers() {
        let n = 150;
        let [maps, query, points] = inputs(&g, n, &mut r);
        let mut expected = vec![0.0; n * g.dim];
        cpu::forward(&g, &maps, &query, &points, &mut expected);
        let (maps, query, points) = (&maps[..], &query[..], &points[..]);
        let args = AttentionGatherArgs { gather: &g, maps, query, points };
        let got = gpu.attention_gather(&args).unwrap();
        assert_matches_cpu(name, &got, &expected, GATHER);
        let nothing = expected.iter().all(|v| *v == 0.0);
        assert_eq!(nothing, name == "all dropped", "{name}: nothing to compare");
    }
}

#[test]
fn attention_gather_gradients() {
    let Some(gpu) = gpu() else { return };
    let mut r = Random(5);
    for (name, g) in gathers() {
        let n = 150;
        let [maps, query, points] = inputs(&g, n, &mut r);
        let grad = r.many(n * g.dim, -1.0, 1.0);
        let expected = cpu::backward(&g, &maps, &query, &points, &grad);
        let (maps, query, points) = (&maps[..], &query[..], &points[..]);
        let args = AttentionGatherArgs { gather: &g, maps, query, points };
        let got = gpu.attention_gather_backward(&args, &grad).unwrap();
        assert_matches_cpu(&format!("{name} maps"), &got.maps, &expected.maps, GATHER_BWD);
        assert_matches_cpu(&format!("{name} query"), &got.query, &expected.query, GATHER_BWD);
        assert_matches_cpu(&format!("{name} points"), &got.points, &expected.points, GATHER_BWD);
        let again = gpu.attention_gather_backward(&args, &grad).unwrap();
        assert!(got == again, "{name}: results are not reproducible");
        let fixed = Gather { point_gradient: false, ..g.clone() };
        let fixed = AttentionGatherArgs { gather: &fixed, ..args };
        let got = gpu.attention_gather_backward(&fixed, &grad).unwrap();
        assert!(got.points.iter().all(|v| *v == 0.0) && got.maps == again.maps);
    }
}

#[test]
fn inconsistent_arguments_are_named() {
    let Some(gpu) = gpu() else { return };
    let g = base();
    let [maps, query, points] = inputs(&g, 3, &mut Random(2));
    let error = |g: &Gather, maps: &[f32], points: &[f32]| {
        let args = AttentionGatherArgs { gather: g, maps, query: &query, points };
        match gpu.attention_gather(&args) {
            Err(GpuError::Argument { argument, .. }) => argument,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(error(&g, &maps[1..], &points), "maps");
    assert_eq!(error(&g, &maps, &points[1..]), "points");
    assert_eq!(error(&Gather { groups: 3, ..g.clone() }, &maps, &points), "groups");
    let many = Gather { points: 65, ..g.clone() };
    assert_eq!(error(&many, &maps, &points), "samples per parent");
}

/// Tolerance: sample positions of up to 40 px, rounded in another order (fused or not): 1e-5 px
/// times slopes of at most 2 per px; the correlation sums 40 products.
const SWEEP: f32 = 2e-5;

/// A source camera rotated by `angle` about y and moved along x.
fn pair(size: [usize; 2], x: f32, angle: f32, source: usize) -> Pair {
    let [h, w] = size.map(|v| v as f32);
    let (f, cx, cy) = (0.9 * w, 0.51 * w, 0.48 * h);
    let (sin, cos) = angle.sin_cos();
    Pair {
        source,
        inverse: [1.0 / f, 1.0 / f, -cx / f, -cy / f],
        rotation: [cos, 0.0, sin, 0.0, 1.0, 0.0, -sin, 0.0, cos],
        t: [x, 0.13, -0.2],
        k: [f, f, cx, cy],
    }
}

/// A sweep whose reference rows have two pairs; a pair with a camera that is rotated away (most
/// samples are behind it or outside); no pair; and one pair. One depth is 0.
fn sweep(centre: f32, size: [usize; 2], channels: usize) -> Sweep {
    let to = |x: f32, angle: f32, row: usize| pair(size, x, angle, row);
    Sweep {
        pairs: vec![
            vec![to(0.4, 0.1, 1), to(-0.3, -0.2, 0)],
            vec![to(0.2, 0.8, 1)],
            vec![],
            vec![to(-0.4, -0.1, 0)],
        ],
        depths: vec![vec![0.7, 1.0, 1.1, 1.3, 2.0, 40.0, 0.0]; 4],
        centre,
        min_z: 1e-3,
        scale: 1.0 / (channels as f32).sqrt(),
        channels,
        size,
    }
}

fn sweeps() -> Vec<(String, Sweep)> {
    let sizes = [([7, 9], 5), ([40, 33], 40)];
    let all = [0.0, 0.5].into_iter().flat_map(|centre| {
        sizes.map(|(size, c)| (format!("{size:?} centre {centre}"), sweep(centre, size, c)))
    });
    all.collect()
}

#[test]
fn plane_sweeps() {
    let Some(gpu) = gpu() else { return };
    let mut r = Random(3);
    for (name, s) in sweeps() {
        let plane = s.size[0] * s.size[1];
        let reference = r.many(4 * s.channels * plane, -1.0, 1.0);
        let source = r.many(2 * s.channels * plane, -1.0, 1.0);
        let mut expected = vec![0.0; 4 * s.candidates() * plane];
        plane_sweep::correlation(&s, &reference, &source, &mut expected);
        let (reference, source) = (&reference[..], &source[..]);
        let args = PlaneSweepArgs { sweep: &s, reference, source };
        assert_matches_cpu(&name, &gpu.plane_sweep(&args).unwrap(), &expected, SWEEP);
        let grad = r.many(expected.len(), -1.0, 1.0);
        let expected = plane_sweep::backward(&s, reference, source, &grad);
        let got = gpu.plane_sweep_backward(&args, &grad).unwrap();
        assert_matches_cpu(&format!("{name} reference"), &got.0, &expected.0, SWEEP);
        assert_matches_cpu(&format!("{name} source"), &got.1, &expected.1, SWEEP);
        let again = gpu.plane_sweep_backward(&args, &grad).unwrap();
        assert!(got == again, "{name}: results are not reproducible");
        let short = PlaneSweepArgs { source: &source[1..], ..args };
        let error = gpu.plane_sweep(&short).unwrap_err();
        assert!(matches!(error, GpuError::Argument { argument: "source", .. }), "{error}");
    }
}
