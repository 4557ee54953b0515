//! The benches' baselines compute what they claim to: the rasterizer's picture and all
//! its gradients against the conformance cases, the others against our own ops. The
//! benches' scenes have the stated properties.

use subsplat_test_support as common;
#[path = "../../benches/common/conventional/mod.rs"]
#[allow(dead_code, reason = "the benches use all of it")]
mod conventional;
#[path = "../../benches/common/inputs.rs"]
mod inputs;
#[path = "../../benches/common/scene.rs"]
#[allow(dead_code, reason = "the benches use all of it")]
mod scene;

use candle_core::{Device, Tensor, Var};
use common::shared;
use conventional::project::{Options, Splats};
use conventional::raster::Rasterizer;
use conventional::{attention, redistribute, sweep};
use glam::Mat4;
use safetensors::SafeTensors;
use std::collections::HashMap;
use subsplat::network::ops;
use subsplat::network::ops::redistribute::OpacityRule;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{ALPHA_MIN, RasterOptions};

/// No pixel of alpha ≥ 1/255 lies outside such a box.
const EXACT_BOX: f32 = 3.34;

struct Case {
    tensors: HashMap<String, Vec<f32>>,
    metadata: HashMap<String, String>,
}

impl Case {
    fn read(name: &str) -> Option<Self> {
        let path = shared(&format!("fixtures/raster/{name}.safetensors"))?;
        let bytes = std::fs::read(path).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let metadata = header.metadata().clone().unwrap();
        let all = SafeTensors::deserialize(&bytes).unwrap();
        let tensors = all.tensors().into_iter().map(|(name, t)| {
            let floats = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
            let data = match t.dtype() {
                safetensors::Dtype::F32 => t.data().chunks_exact(4).map(floats).collect(),
                _ => t.data().iter().map(|&b| f32::from(b)).collect(),
            };
            (name, data)
        });
        Some(Self { tensors: tensors.collect(), metadata })
    }

    fn get(&self, name: &str) -> &[f32] {
        self.tensors.get(name).map_or(&[], |v| v)
    }

    fn number(&self, key: &str) -> f32 {
        self.metadata[key].parse().unwrap()
    }

    /// `[N, 11]` rows, or their gradients.
    fn rows(&self, prefix: &str) -> Vec<f32> {
        let get = |name: &str| self.get(&format!("{prefix}{name}"));
        let rows = get("opacities").iter().enumerate().flat_map(|(i, o)| {
            let mean = &get("means")[3 * i..3 * i + 3];
            let quat = &get("quats")[4 * i..4 * i + 4];
            [mean, quat, &get("scales")[3 * i..3 * i + 3], &[*o]].concat()
        });
        rows.collect()
    }

    fn camera(&self) -> Camera {
        let k = self.get("intrinsics");
        let (width, height) = (self.number("width") as usize, self.number("height") as usize);
        let k = Intrinsics { fx: k[0], fy: k[1], cx: k[2], cy: k[3], width, height };
        let pose: [f32; 16] = self.get("world_from_camera").try_into().unwrap();
        Camera::new(k, Mat4::from_cols_array(&pose).transpose()).unwrap()
    }

    fn options(&self) -> Options {
        Options {
            near: self.number("near"),
            lowpass: self.number("lowpass"),
            antialiased: self.metadata["antialiased"] == "true",
            background: self.get("background").try_into().unwrap(),
            box_sigmas: EXACT_BOX,
        }
    }
}

/// The README's measure: of each row, max |difference| over (its largest number + the
/// median of that over the rows that are not zero).
fn gradient_error(got: &[f32], expected: &[f32], lanes: usize) -> f32 {
    assert_eq!(got.len(), expected.len());
    let largest = |row: &[f32]| row.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let mut sizes: Vec<f32> = expected.chunks(lanes).map(largest).filter(|&v| v > 0.0).collect();
    sizes.sort_by(f32::total_cmp);
    let median = sizes[sizes.len() / 2];
    let rows = got.chunks(lanes).zip(expected.chunks(lanes));
    let errors = rows.map(|(g, e)| {
        let d: Vec<f32> = g.iter().zip(e).map(|(g, e)| g - e).collect();
        assert!(d.iter().all(|v| v.is_finite()));
        largest(&d) / (largest(e) + median)
    });
    errors.fold(0.0, f32::max)
}

fn lanes_of(rows: &[f32], lanes: std::ops::Range<usize>) -> Vec<f32> {
    rows.chunks(11).flat_map(|r| r[lanes.clone()].to_vec()).collect()
}

fn check_case(name: &str) {
    for keeps in [false, true] {
        check_walk(name, keeps);
    }
}

/// The baseline, with and without a list of what each pixel blended.
fn check_walk(name: &str, keeps: bool) {
    let Some(case) = Case::read(name) else { return };
    let rows = case.rows("");
    let children: usize = case.metadata["children"].parse().unwrap();
    let coefficients = case.get("sh").len() / 3 * children / (rows.len() / 11);
    let splats = Splats {
        rows: &rows,
        sh: case.get("sh"),
        gain: case.get("gain"),
        sh_degree: coefficients.isqrt() - 1,
    };
    let (camera, options) = (case.camera(), case.options());
    let mut rasterizer = Rasterizer::new(keeps);
    rasterizer.forward(&splats, &camera, options);
    let boundary = case.get("boundary");
    let outputs = [
        ("rgb", &rasterizer.frame.rgb, 3),
        ("alpha", &rasterizer.frame.alpha, 1),
        ("depth_sum", &rasterizer.frame.depth_sum, 1),
    ];
    for (what, got, lanes) in outputs {
        let expected = case.get(what);
        assert_eq!(got.len(), expected.len());
        for i in (0..got.len()).filter(|i| boundary[i / lanes] == 0.0) {
            let d = (got[i] - expected[i]).abs() / expected[i].abs().max(1.0);
            assert!(d < 3e-5, "{name} {what} {i}: {} {}", got[i], expected[i]);
        }
    }
    let (v_rgb, v_alpha) = (case.get("v_rgb"), case.get("v_alpha"));
    let g = rasterizer.backward(&splats, &camera, options, v_rgb, v_alpha);
    let expected = case.rows("grad.");
    let allowed = if name == "needles" { 2e-3 } else { 5e-4 };
    let check = |what: &str, got: &[f32], expected: &[f32], lanes: usize| {
        let error = gradient_error(got, expected, lanes);
        assert!(error < allowed, "{name} gradient of {what}: {error}");
    };
    for (what, lanes) in
        [("means", 0..3), ("quats", 3..7), ("scales", 7..10), ("opacities", 10..11)]
    {
        let (got, expected) =
            (lanes_of(&g.rows, lanes.clone()), lanes_of(&expected, lanes.clone()));
        check(what, &got, &expected, lanes.len());
    }
    check("sh", &g.sh, case.get("grad.sh"), 3 * coefficients);
    check("background", &g.background, case.get("grad.background"), 3);
    if !splats.gain.is_empty() {
        check("gain", &g.gain, case.get("grad.gain"), 1);
    }
}

macro_rules! cases {
    ($($name:ident)*) => { $( #[test] fn $name() { check_case(stringify!($name)); } )* };
}

cases! {
    sh0_32 sh1 sh2 sh3 sh4 antialiased odd_size saturated needles behind_camera gain
}

fn host(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

#[track_caller]
fn assert_close(got: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(got.len(), expected.len());
    let size = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    assert!(size > 0.0);
    for (i, (g, e)) in got.iter().zip(expected).enumerate() {
        assert!((g - e).abs() <= tolerance * size, "{i}: {g} {e} of {size}");
    }
}

#[test]
fn attention_and_its_gradients_are_the_ops() {
    let a = inputs::Attention::new(16, 8).unwrap();
    let fused = |maps: &Tensor, query: &Tensor, points: &Tensor| {
        ops::attention_gather::attention_gather(maps, query, points, a.gather.clone())
    };
    let size = attention::Size { views: 2, map: [4, 4], dim: 8, scale: a.gather.logit_scale };
    let plain = |maps: &Tensor, query: &Tensor, points: &Tensor| {
        let part = |from: usize, n: usize| query.narrow(1, from, n).unwrap();
        attention::gather(maps, &part(0, 8), &part(8, 2), &part(10, 2), points, size)
    };
    type Call<'a> = &'a dyn Fn(&Tensor, &Tensor, &Tensor) -> candle_core::Result<Tensor>;
    let run = |f: Call| {
        let vars = [&a.maps, &a.packed_query().unwrap(), &a.points];
        let vars = vars.map(|t| Var::from_tensor(t).unwrap());
        let y = f(&vars[0], &vars[1], &vars[2]).unwrap();
        let weight = inputs::tensor(y.dims(), 1.0, 99).unwrap();
        let grads = (&y * weight).unwrap().sum_all().unwrap().backward().unwrap();
        let mut all = vec![host(&y)];
        all.extend(vars.iter().map(|v| host(grads.get(v).unwrap())));
        all
    };
    for (got, expected) in run(&plain).iter().zip(&run(&fused)) {
        assert_close(got, expected, 2e-5);
    }
}

#[test]
fn the_sweep_is_the_ops() {
    let s = inputs::sweep(&scene::views(12), 12, 5, 7).unwrap();
    let features = inputs::tensor(&[2, 5, 12, 12], 1.0, 30).unwrap();
    let got = sweep::correlation(&s, &host(&features), &host(&features));
    let expected = ops::plane_sweep::plane_sweep(&features, &features, s).unwrap();
    assert_close(&got, &host(&expected), 1e-5);
}

#[test]
fn redistribution_is_the_ops() {
    let logits = inputs::tensor(&[50, 4], 1.0, 40).unwrap();
    let areas = inputs::tensor(&[50, 4], 0.5, 41).unwrap().exp().unwrap();
    let own = inputs::tensor(&[50], 0.5, 42).unwrap().exp().unwrap();
    let alpha: Vec<f32> = (0..50).map(|i| scene::unit(43, i)).collect();
    let alpha = Tensor::from_vec(alpha, 50, &Device::Cpu).unwrap();
    let linear = redistribute::linear(&logits, &areas, &alpha).unwrap();
    let depth = redistribute::optical_depth(&logits, &areas, &alpha, &own).unwrap();
    for (got, rule) in [(linear, OpacityRule::Linear), (depth, OpacityRule::OpticalDepth)] {
        let op = ops::redistribute::redistribute(rule, &logits, &areas, &alpha, Some(&own));
        assert_close(&host(&got), &host(&op.unwrap()), 1e-5);
    }
}

#[test]
fn scenes_are_what_they_say() {
    let spec = scene::SCENES[0];
    let splats = scene::shared(&spec);
    assert_eq!((splats.len(), splats.parents()), (8192, 2048));
    assert_eq!(splats, scene::shared(&spec));
    let camera = scene::camera(spec.side);
    let own = scene::unshared(&splats);
    assert_eq!((own.len(), own.parents()), (8192, 8192));
    let options = RasterOptions::default();
    let (a, b) = (
        subsplat::scene::render(&splats, &camera, &options),
        subsplat::scene::render(&own, &camera, &options),
    );
    assert_close(&a.rgb, &b.rgb, 1e-4);
    // Covered, and with steps in depth.
    let covered = a.alpha.iter().filter(|&&v| v > 0.9).count();
    assert!(covered > a.alpha.len() * 8 / 10, "{covered}");
    let steps = a.depth.chunks(spec.side).flat_map(|r| r.windows(2));
    let steps = steps.filter(|w| (w[0] - w[1]).abs() > 0.5).count();
    assert!(steps > spec.side, "{steps}");
    let mut rasterizer = subsplat_kernels::cpu::Rasterizer::new();
    rasterizer.render(&subsplat::scene::render::slices(&splats), &camera, &options);
    // σ of the footprint without its low-pass, from the determinant of its conic.
    let sigma: Vec<f32> = rasterizer
        .footprints()
        .iter()
        .filter(|f| f.visible())
        .map(|f| {
            let [a, b, c] = f.conic();
            ((a * c - b * b).recip().sqrt() - options.lowpass).max(0.0).sqrt()
        })
        .collect();
    let mean = sigma.iter().sum::<f32>() / sigma.len() as f32;
    assert!((mean / spec.sigma_px - 1.0).abs() < 0.1, "{mean}");
    let opacity = |low: f32, high: f32| {
        let inside = (0..splats.len()).filter(|&i| (low..high).contains(&splats.opacity(i)));
        inside.count() as f32 / splats.len() as f32
    };
    assert!(opacity(0.0, 0.12) > 0.35 && opacity(0.5, 1.0) > 0.45);
    assert!(opacity(ALPHA_MIN, 1.0) > 0.75);
}
