//! SPGR on the GPU against the CPU version, under every rule.

use subsplat_test_support::cpu_against_gpu;
use subsplat_test_support::gpu as adapter;

use adapter::gpu;
use cpu_against_gpu::{Random, assert_matches_cpu};
use glam::{EulerRot, Mat4, Quat, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::spgr as cpu;
use subsplat_kernels::gpu::{GpuError, SpgrArgs};
use subsplat_kernels::layout::{
    AMinMode, AreaAt, DepthDir, DepthUnit, GainSpace, HEAD_STRIDE, MEAN_OFFSET, OPACITY_OFFSET,
    OpacityRule, Positions, PrimaryView, QUAT_OFFSET, Rules, SCALE_OFFSET, SPLAT_STRIDE, Slide,
};

/// Tolerance: a few hundred roundings of 6e-8, including WGSL's larger errors (division 2.5 units
/// in the last place, exponential 3 + 2|x|). The growth along two axes divides by a cross
/// product.
const SPGR: f32 = 3e-5;

/// Tolerance of gradients, relative to the largest number of the column. Needles and edge-on
/// discs divide by areas that cancel: both GPU and CPU differ by about 1e-5 from the f64 kernel,
/// the f32 CPU kernel by up to 3e-5.
const TOLERANCE_F64: f32 = 4e-5;
const TOLERANCE_F32: f32 = 1e-4;

/// Two views of one place, with slightly different rotations.
fn cameras(size: usize) -> Vec<Camera> {
    let each = |v: usize| {
        let s = size as f32;
        let (fx, fy, cx, cy) = (0.9 * s, 0.95 * s, 0.51 * s, 0.48 * s);
        let k = Intrinsics { fx, fy, cx, cy, width: size, height: size };
        let side = v as f32 - 0.5;
        let q = Quat::from_euler(EulerRot::XYZ, 0.05 * side, -0.12 * side, 0.08 * side);
        let at = Vec3::new(0.3 * side, 0.05 * side, 0.1 * v as f32);
        Camera::new(k, Mat4::from_rotation_translation(q, at)).unwrap()
    };
    (0..2).map(each).collect()
}

/// One parent per pixel and view, from a hundredth of a pixel to several pixels, flat and round.
fn parents(cameras: &[Camera], r: &mut Random) -> Vec<f32> {
    let mut rows = Vec::new();
    for camera in cameras {
        let k = camera.intrinsics();
        for i in 0..k.width * k.height {
            let z = r.range(1.5, 12.0);
            let (x, y) = ((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5);
            let p = Vec3::new((x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z);
            let mean = camera.rotation() * p + camera.position();
            rows.extend(mean.to_array());
            rows.extend(r.many(4, -1.0, 1.0));
            let px = z / k.fx;
            rows.extend(r.many(3, -5.0, 2.0).iter().map(|e| e.exp2() * px));
            rows.push(r.range(0.0, 1.0));
        }
    }
    rows
}

/// The rules of the presets at K = `children`.
fn base(tuned: bool, children: usize) -> Rules {
    let k = children as f64;
    Rules {
        positions: Positions::new(children),
        primary_view: if tuned { PrimaryView::Source } else { PrimaryView::NearestVisible },
        offset_bound: tuned.then_some(0.5),
        beta_z: if tuned { 0.1 } else { 0.25 },
        depth_dir: if tuned { DepthDir::Ray } else { DepthDir::Axis },
        depth_unit: if tuned { DepthUnit::Relative } else { DepthUnit::World },
        slide: Slide::ZConst,
        lambda_s: if tuned { 1.0 / k.sqrt() } else { 0.6 },
        dlog_clamp: 2.0,
        area_at: AreaAt::Child,
        a_min: if children == 1 { 0.0 } else { 1.0 / k },
        a_min_mode: AMinMode::Iso,
        opacity: if tuned { OpacityRule::OpticalDepth } else { OpacityRule::Linear },
        lowpass_target: 0.3,
        lowpass_input: 0.3,
        delta: 0.5,
        gain_space: GainSpace::Sh,
    }
}

/// Every rule, applied one at a time to each preset.
fn variants(children: usize) -> Vec<(String, Rules)> {
    type Change = (&'static str, fn(&mut Rules));
    let changes: [Change; 22] = [
        ("as is", |_| {}),
        ("nearest", |s| s.primary_view = PrimaryView::NearestVisible),
        ("source", |s| s.primary_view = PrimaryView::Source),
        ("unbounded", |s| s.offset_bound = None),
        ("bounded", |s| s.offset_bound = Some(0.5)),
        ("axis", |s| s.depth_dir = DepthDir::Axis),
        ("ray", |s| s.depth_dir = DepthDir::Ray),
        ("world", |s| (s.depth_unit, s.beta_z) = (DepthUnit::World, 9.0)),
        ("relative", |s| (s.depth_unit, s.beta_z) = (DepthUnit::Relative, 1.0)),
        ("disc", |s| s.slide = Slide::Disc),
        ("lambda", |s| s.lambda_s = 1.2 / s.zoom()),
        ("at parent", |s| s.area_at = AreaAt::Parent),
        ("a_min px", |s| s.a_min = 2.0),
        ("a_min in", |s| s.a_min = 0.5 * s.children() as f64),
        ("a_min off", |s| s.a_min = 0.0),
        ("two axis", |s| (s.a_min, s.a_min_mode) = (2.0, AMinMode::TwoAxis)),
        ("linear", |s| s.opacity = OpacityRule::Linear),
        ("depth", |s| s.opacity = OpacityRule::OpticalDepth),
        ("through", |s| s.opacity = OpacityRule::Transmittance),
        ("area", |s| s.opacity = OpacityRule::Area),
        ("none", |s| s.opacity = OpacityRule::None),
        ("rgb", |s| s.gain_space = GainSpace::Rgb),
    ];
    let mut all = Vec::new();
    for tuned in [false, true] {
        for (name, change) in changes {
            let mut rules = base(tuned, children);
            change(&mut rules);
            all.push((
                format!("{} {name} K={children}", if tuned { "tuned" } else { "paper" }),
                rules,
            ));
        }
    }
    all
}

/// Cameras, near planes, parents and head records.
struct Inputs {
    cameras: Vec<Camera>,
    near: Vec<f32>,
    parents: Vec<f32>,
    head: Vec<f32>,
}

impl Inputs {
    fn new(children: usize, r: &mut Random) -> Self {
        let cameras = cameras(12);
        let parents = parents(&cameras, r);
        let n = parents.len() / SPLAT_STRIDE;
        let head = r.many(n * children * HEAD_STRIDE, -1.5, 1.5);
        Self { cameras, near: vec![1.0; 2], parents, head }
    }

    fn gpu<'a>(&'a self, rules: &'a Rules) -> SpgrArgs<'a> {
        let Self { cameras, near, parents, head } = self;
        SpgrArgs { rules, cameras, near, per_view: 144, first: 0, head, parents }
    }
}

fn on_cpu(inputs: &Inputs, rules: &Rules) -> (Vec<f32>, Vec<f32>) {
    let Inputs { cameras, near, parents, head } = inputs;
    let source = cpu::Source { cameras, near, per_view: 144, first: 0 };
    let count = parents.len() / SPLAT_STRIDE * rules.children();
    let mut rows = vec![0.0; count * SPLAT_STRIDE];
    let mut gains = vec![0.0; count * rules.gain_channels()];
    assert!(cpu::forward(cpu::Args { rules, source, head, parents }, &mut rows, &mut gains));
    (rows, gains)
}

/// Returns `count` columns of all rows, from column `first` on.
fn columns(rows: &[f32], first: usize, count: usize) -> Vec<f32> {
    rows.chunks_exact(SPLAT_STRIDE).flat_map(|r| r[first..first + count].to_vec()).collect()
}

const PARTS: [(&str, usize, usize); 4] = [
    ("mean", MEAN_OFFSET, 3),
    ("quaternion", QUAT_OFFSET, 4),
    ("scale", SCALE_OFFSET, 3),
    ("opacity", OPACITY_OFFSET, 1),
];

#[test]
fn children() {
    let Some(gpu) = gpu() else { return };
    let mut r = Random(11);
    for k in [1, 4, 9, 5, 6] {
        let inputs = Inputs::new(k, &mut r);
        for (name, rules) in variants(k) {
            let expected = on_cpu(&inputs, &rules);
            let got = gpu.spgr(&inputs.gpu(&rules)).unwrap();
            for (part, first, count) in PARTS {
                let of = |rows: &[f32]| columns(rows, first, count);
                let (got, expected) = (of(&got.0), of(&expected.0));
                assert_matches_cpu(&format!("{name} {part}"), &got, &expected, SPGR);
            }
            assert_matches_cpu(&format!("{name} gain"), &got.1, &expected.1, SPGR);
        }
    }
}

/// Returns the gradients on the CPU: of the head records, of the parents, and of the head records
/// by the gains.
fn gradients<T: subsplat_kernels::cpu::simd::Real>(
    inputs: &Inputs,
    rules: &Rules,
    grad: &[f32],
    by_gain: &[f32],
) -> [Vec<f32>; 3] {
    let wide = |v: &[f32]| v.iter().map(|&v| T::constant(f64::from(v))).collect::<Vec<T>>();
    let narrow = |v: Vec<T>| v.into_iter().map(|v| v.to_f64() as f32).collect::<Vec<f32>>();
    let (head, parents) = (wide(&inputs.head), wide(&inputs.parents));
    let source =
        cpu::Source { cameras: &inputs.cameras, near: &inputs.near, per_view: 144, first: 0 };
    let zeros = |n: usize| vec![T::default(); n];
    let [mut d_head, mut d_gain] = [0; 2].map(|_| zeros(head.len()));
    let mut d_parents = zeros(parents.len());
    let args = cpu::Args { rules, source, head: &head, parents: &parents };
    cpu::backward(args, &wide(grad), &mut d_head, &mut d_parents);
    cpu::gains_backward(rules, &head, &wide(by_gain), &mut d_gain);
    [narrow(d_head), narrow(d_parents), narrow(d_gain)]
}

#[test]
fn gradients_of_children() {
    let Some(gpu) = gpu() else { return };
    let mut r = Random(12);
    for k in [1, 4, 9, 5, 6] {
        let inputs = Inputs::new(k, &mut r);
        for (name, rules) in variants(k) {
            let count = inputs.parents.len() / SPLAT_STRIDE * rules.children();
            let grad = r.many(count * SPLAT_STRIDE, -1.0, 1.0);
            let by_gain = r.many(count * rules.gain_channels(), -1.0, 1.0);
            let [head, parents, gain] = gradients::<f32>(&inputs, &rules, &grad, &by_gain);
            let exact = gradients::<f64>(&inputs, &rules, &grad, &by_gain);
            let got = gpu.spgr_backward(&inputs.gpu(&rules), &grad).unwrap();
            let got_gain = gpu.spgr_gains_backward(&rules, &inputs.head, &by_gain).unwrap();
            for column in 0..SPLAT_STRIDE {
                let of = |rows: &[f32]| columns(rows, column, 1);
                let all =
                    [("head", &got.0, &head, &exact[0]), ("parents", &got.1, &parents, &exact[1])];
                for (what, got, cpu, exact) in all {
                    let name = format!("{name} {what} {column}");
                    assert_matches_cpu(&name, &of(got), &of(exact), TOLERANCE_F64);
                    assert_matches_cpu(&name, &of(got), &of(cpu), TOLERANCE_F32);
                }
            }
            assert_matches_cpu(&format!("{name} gain"), &got_gain, &gain, SPGR);
        }
    }
}

#[test]
fn inconsistent_arguments_are_named() {
    let Some(gpu) = gpu() else { return };
    let inputs = Inputs::new(2, &mut Random(3));
    let error = |change: &dyn Fn(&mut SpgrArgs)| {
        let rules = base(true, 2);
        let mut args = inputs.gpu(&rules);
        change(&mut args);
        match gpu.spgr(&args) {
            Err(GpuError::Argument { argument, .. }) => argument,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(error(&|a| a.head = &a.head[1..]), "head records");
    assert_eq!(error(&|a| a.near = &a.near[1..]), "near planes");
    assert_eq!(error(&|a| a.per_view = 0), "parents per view");
}
