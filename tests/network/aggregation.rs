//! Aggregation stages against the equations written out; points, gates, parameters.

use subsplat_test_support::gather::{base, grid_sample, host};
use subsplat_test_support::scenes;

use candle_core::{DType, Device, Tensor};
use candle_nn::{VarBuilder, VarMap};
use glam::{Quat, Vec3};
use scenes::*;
use subsplat::network::config::*;
use subsplat::network::model::aggregation::Aggregation;
use subsplat::network::model::embed::Descriptors;
use subsplat::network::model::geometry::{Frames, ParentChunk};
use subsplat::network::model::mlp::Mode;
use subsplat::network::model::trunk::set_initial_values;
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{BackboneOutput, Primaries};
use subsplat::network::ops::attention_gather::{Gather, Level};

/// Everything a stage needs for one 16 × 16 scene of two views.
struct Fixture {
    cameras: Vec<subsplat_kernels::camera::Camera>,
    backbone: BackboneOutput,
    primaries: Primaries,
    frames: Frames,
    parents: ParentChunk,
    z: [Tensor; 2],
}

fn fixture(first: usize, len: usize, seed: u64) -> Fixture {
    let mut r = Random(seed);
    let cameras = cameras(2, 16, 16);
    let primaries = LocalPrimaries::random(&cameras, 4, &mut r).place(&cameras);
    let slice = |t: &Tensor| t.squeeze(0).unwrap().narrow(0, first, len).unwrap();
    let parents = ParentChunk {
        first,
        source: first / 256,
        means: slice(&primaries.means),
        quats_wxyz: slice(&primaries.quats_wxyz),
        scales: slice(&primaries.scales),
        opacities: slice(&primaries.opacities).unsqueeze(1).unwrap(),
        sh: slice(&primaries.sh).reshape((len, 12)).unwrap(),
    };
    Fixture {
        backbone: backbone(2, 16, 16, &mut r),
        frames: Frames::new(&cameras, DType::F32, &Device::Cpu).unwrap(),
        z: [0, 1].map(|_| r.tensor(&[len, 32], 1.0, DType::F32)),
        cameras,
        primaries,
        parents,
    }
}

fn paper() -> subsplat::network::config::Aggregation {
    Config::re10k(Preset::Paper, 2).agg
}

/// The aggregation with random parameters, and those parameters.
fn build(keys: &subsplat::network::config::Aggregation, seed: u64) -> (Aggregation, VarMap) {
    let variables = VarMap::new();
    let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
    let agg = Aggregation::new(keys, 32, &channels(), vb.pp("subsplat").pp("agg")).unwrap();
    set_initial_values(&variables).unwrap();
    let mut r = Random(seed);
    let mut named: Vec<_> = variables.data().lock().unwrap().clone().into_iter().collect();
    named.sort_by(|a, b| a.0.cmp(&b.0));
    for (_, var) in named {
        let noise = r.tensor(var.dims(), 0.2, DType::F32);
        var.set(&(var.as_tensor() + noise).unwrap()).unwrap();
    }
    (agg, variables)
}

/// The feature maps of a backbone, by their levels.
fn maps_of(backbone: &BackboneOutput) -> impl Fn(FeatureLevel) -> candle_core::Result<Tensor> {
    |level| backbone.feature(level).cloned()
}

/// `[N, 3]`.
fn means_of(primaries: &Primaries) -> Tensor {
    primaries.means.squeeze(0).unwrap()
}

fn run(agg: &Aggregation, x: &Fixture, mode: Mode) -> [Tensor; 2] {
    let views = views(&x.cameras);
    let prepared =
        agg.prepare(&views, &x.frames, maps_of(&x.backbone), &means_of(&x.primaries)).unwrap();
    let z = Descriptors { geometry: x.z[0].clone(), appearance: x.z[1].clone() };
    let f = agg.forward(&prepared, &x.parents, &x.frames, &z, mode).unwrap();
    [f.geometry, f.appearance]
}

/// Samples of one parent: per view and level, raw channels at the projected mean,
/// with torch's rule and zeros outside.
fn raw_samples(
    x: &Fixture,
    levels: &[FeatureLevel],
    n: usize,
) -> Vec<Option<(usize, usize, Vec<f64>)>> {
    let mean = host(&x.parents.means.narrow(0, n, 1).unwrap());
    let mean = Vec3::new(mean[0] as f32, mean[1] as f32, mean[2] as f32);
    let mut out = Vec::new();
    for (v, camera) in x.cameras.iter().enumerate() {
        for (l, level) in levels.iter().enumerate() {
            let px = camera.project(mean);
            let inside = |p: &glam::Vec2| p.x > 0.0 && p.y > 0.0 && p.x < 16.0 && p.y < 16.0;
            out.push(px.filter(inside).map(|px| {
                let map = x.backbone.feature(*level).unwrap().squeeze(0).unwrap();
                let (_, c, h, w) = map.dims4().unwrap();
                let map =
                    host(&map.get(v).unwrap().permute((1, 2, 0)).unwrap().contiguous().unwrap());
                let g = Gather {
                    levels: vec![Level { height: h, width: w, first_cell: 0 }],
                    stride: c,
                    ..base()
                };
                (
                    v,
                    l,
                    grid_sample(&map, &g, 0, 0, [f64::from(px.x) / 16.0, f64::from(px.y) / 16.0]),
                )
            }));
        }
    }
    out
}

struct Layers<'a>(&'a VarMap);

impl Layers<'_> {
    fn tensor(&self, name: &str) -> Vec<f64> {
        host(self.0.data().lock().unwrap()[&format!("subsplat.agg.{name}")].as_tensor())
    }

    fn linear(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let w = self.tensor(&format!("{name}.weight"));
        let b = self.tensor(&format!("{name}.bias"));
        let rows = w.chunks(x.len()).zip(b);
        rows.map(|(w, b)| b + w.iter().zip(x).map(|(w, x)| w * x).sum::<f64>()).collect()
    }

    fn norm(&self, name: &str, x: &[f64]) -> Vec<f64> {
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let var = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / x.len() as f64;
        let (w, b) = (self.tensor(&format!("{name}.weight")), self.tensor(&format!("{name}.bias")));
        x.iter()
            .zip(w.iter().zip(b))
            .map(|(v, (w, b))| (v - mean) / (var + 1e-5).sqrt() * w + b)
            .collect()
    }
}

#[test]
fn stages_equal_the_equations_written_out() {
    // The raw map is sampled first and the sample projected after; the fused form has the
    // opposite order. Biases of W_k, W_v count only where a sample's weights sum to one,
    // so only parents whose samples lie inside the coarsest map are compared.
    for (name, tuned) in [("paper", false), ("two levels, norm", true)] {
        let mut keys = paper();
        if tuned {
            keys.levels = vec![FeatureLevel::Trans4, FeatureLevel::Cnn2];
            keys.norm = StageNorm::Pre;
        }
        let x = fixture(0, 256, 7);
        let (agg, variables) = build(&keys, 8);
        let [f_g, f_a] = run(&agg, &x, Mode::Infer).map(|t| host(&t));
        let layers = Layers(&variables);
        let mut compared = 0;
        for n in 0..256 {
            let samples = raw_samples(&x, &keys.levels, n);
            let mean = host(&x.parents.means.narrow(0, n, 1).unwrap());
            let mean = Vec3::new(mean[0] as f32, mean[1] as f32, mean[2] as f32);
            let interior = x.cameras.iter().all(|c| {
                let px = c.project(mean).unwrap();
                px.cmpgt(glam::Vec2::splat(2.0)).all() && px.cmplt(glam::Vec2::splat(14.0)).all()
                    || !(px.cmpgt(glam::Vec2::ZERO).all()
                        && px.cmplt(glam::Vec2::splat(16.0)).all())
            });
            if !interior {
                continue;
            }
            compared += 1;
            let mut f = vec![0.0; 32];
            for stage in ["g0", "g1", "g2", "a0"] {
                let z = &x.z[usize::from(stage == "a0")].narrow(0, n, 1).unwrap();
                let mut q: Vec<f64> = f.iter().zip(host(z)).map(|(f, z)| f + z).collect();
                if tuned {
                    q = layers.norm(&format!("{stage}.norm"), &q);
                }
                let beta = layers.tensor(&format!("{stage}.gate"));
                // The fixture has two views: they use the first two.
                let sum: f64 = beta[..2].iter().map(|b| b.exp()).sum();
                let mut logits = Vec::new();
                for (v, l, phi) in samples.iter().flatten() {
                    let k = layers.linear(&format!("{stage}.wk.{l}"), phi);
                    let mut a = q.iter().zip(&k).map(|(q, k)| q * k).sum::<f64>() / 32f64.sqrt();
                    if tuned {
                        a += layers.tensor(&format!("{stage}.level_bias"))[*l];
                    }
                    let u = layers.linear(&format!("{stage}.wv.{l}"), phi);
                    logits.push((a, 2.0 * beta[*v].exp() / sum, u));
                }
                let total: f64 = logits.iter().map(|(a, _, _)| a.exp()).sum();
                for (a, gate, u) in logits {
                    f.iter_mut().zip(u).for_each(|(f, u)| *f += a.exp() / total * gate * u);
                }
                if stage == "g2" {
                    let got = &f_g[32 * n..32 * n + 32];
                    let d = got.iter().zip(&f).fold(0f64, |m, (a, b)| m.max((a - b).abs()));
                    assert!(d < 1e-4, "{name} parent {n} f^g: {d}");
                }
            }
            let got = &f_a[32 * n..32 * n + 32];
            let d = got.iter().zip(&f).fold(0f64, |m, (a, b)| m.max((a - b).abs()));
            assert!(d < 2e-4, "{name} parent {n} f^a: {d}");
        }
        assert!(compared > 50, "{compared}");
    }
}

/// A map whose channel 0 is its own column and channel 1 its own row.
fn coordinate_maps(x: &mut Fixture) {
    for (level, map) in &mut x.backbone.features {
        let (c, stride) = level_shape(*level);
        let (h, w) = (16 / stride, 16 / stride);
        let mut data = vec![0f32; 2 * c * h * w];
        for v in 0..2 {
            for y in 0..h {
                for col in 0..w {
                    data[((v * c) * h + y) * w + col] = col as f32;
                    data[((v * c + 1) * h + y) * w + col] = y as f32;
                }
            }
        }
        *map = Tensor::from_vec(data, (1, 2, c, h, w), &Device::Cpu).unwrap();
    }
}

/// One stage that averages its samples: linear weights at zero, no projection.
fn averaging() -> subsplat::network::config::Aggregation {
    let ablations = AggregationAblations {
        op: AttentionOp::Linear,
        kv_proj: false,
        gate: Gate::Off,
        residual: Residual::None,
        ..AggregationAblations::default()
    };
    subsplat::network::config::Aggregation { stages_geo: 1, stages_app: 0, ablations, ..paper() }
}

#[test]
fn key_points_lie_on_the_gaussian() {
    let mut x = fixture(0, 256, 9);
    coordinate_maps(&mut x);
    // The centre and +0.45 σ along the parent's own x axis.
    let mut keys = averaging();
    keys.ablations.points = Points::Pixelgaussian;
    keys.ablations.n_fixed = 2;
    keys.ablations.n_learned = 0;
    let variables = VarMap::new();
    let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
    let agg = Aggregation::new(&keys, 32, &channels(), vb).unwrap();
    let got = host(&run(&agg, &x, Mode::Infer)[0]);
    let (means, quats, scales) =
        (host(&x.parents.means), host(&x.parents.quats_wxyz), host(&x.parents.scales));
    let mut compared = 0;
    for n in 0..256 {
        let v = |t: &[f64]| Vec3::new(t[0] as f32, t[1] as f32, t[2] as f32);
        let q = &quats[4 * n..4 * n + 4];
        let q = Quat::from_xyzw(q[1] as f32, q[2] as f32, q[3] as f32, q[0] as f32);
        let mean = v(&means[3 * n..]);
        let key = mean + q * Vec3::X * (0.45 * scales[3 * n] as f32);
        let px: Vec<glam::Vec2> =
            x.cameras.iter().flat_map(|c| [mean, key].map(|p| c.project(p).unwrap())).collect();
        // Inside the 4 × 4 map, where bilinear interpolation reproduces coordinates.
        if px.iter().any(|p| p.min_element() < 2.0 || p.max_element() > 14.0) {
            continue;
        }
        compared += 1;
        let want = px.iter().fold(glam::Vec2::ZERO, |s, p| s + (*p / 4.0 - 0.5) / 4.0);
        let got = glam::Vec2::new(got[32 * n] as f32, got[32 * n + 1] as f32);
        assert!((got - want).length() < 1e-4, "{n} {got} {want}");
    }
    assert!(compared > 30, "{compared}");
}

#[test]
fn map_offsets_start_on_a_ring_of_one_map_pixel() {
    let mut x = fixture(0, 256, 10);
    coordinate_maps(&mut x);
    let mut keys = averaging();
    keys.ablations.points = Points::MapOffsets;
    keys.ablations.n_learned = 1;
    keys.levels = vec![FeatureLevel::Trans4];
    let variables = VarMap::new();
    let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
    let agg = Aggregation::new(&keys, 32, &channels(), vb.pp("subsplat").pp("agg")).unwrap();
    set_initial_values(&variables).unwrap();
    let got = host(&run(&agg, &x, Mode::Infer)[0]);
    let means = host(&x.parents.means);
    let mut compared = 0;
    for n in 0..256 {
        let mean = Vec3::new(means[3 * n] as f32, means[3 * n + 1] as f32, means[3 * n + 2] as f32);
        let px: Vec<glam::Vec2> = x.cameras.iter().map(|c| c.project(mean).unwrap()).collect();
        if px.iter().any(|p| p.min_element() < 2.0 || p.max_element() > 10.0) {
            continue;
        }
        compared += 1;
        // Centre and centre + (1, 0): the mean lies half a map pixel to the right.
        let centre = px.iter().fold(glam::Vec2::ZERO, |s, p| s + (*p / 4.0 - 0.5) / 2.0);
        let got = glam::Vec2::new(got[32 * n] as f32, got[32 * n + 1] as f32);
        assert!((got - centre - glam::Vec2::new(0.5, 0.0)).length() < 1e-4, "{n} {got} {centre}");
    }
    assert!(compared > 20, "{compared}");
}

#[test]
fn literal_form_has_no_parameters_but_gates() {
    let mut keys = paper();
    keys.ablations.strict_literal = true;
    let (agg, variables) = build(&keys, 11);
    let mut names: Vec<String> = variables.data().lock().unwrap().keys().cloned().collect();
    names.sort();
    assert_eq!(names, ["a0", "g0", "g1", "g2"].map(|s| format!("subsplat.agg.{s}.gate")));
    // f of stage t is in the span of the samples: with one visible view it is that
    // view's gate times its sample, whatever the stage.
    let x = fixture(0, 256, 12);
    let f = host(&run(&agg, &x, Mode::Infer)[0]);
    let beta = Layers(&variables).tensor("g2.gate");
    // The fixture has two views: they use the first two.
    let sum: f64 = beta[..2].iter().map(|b| b.exp()).sum();
    let mut compared = 0;
    for n in 0..256 {
        let samples: Vec<_> =
            raw_samples(&x, &keys.resolved().levels, n).into_iter().flatten().collect();
        if let [(v, _, phi)] = &samples[..] {
            compared += 1;
            for (got, phi) in f[32 * n..32 * n + 32].iter().zip(phi) {
                assert!((got - beta[*v].exp() / sum * phi).abs() < 1e-4);
            }
        }
    }
    assert!(compared > 3, "{compared}");
}

#[test]
fn initial_values_are_the_recommended_ones() {
    let mut keys = paper();
    keys.levels = vec![FeatureLevel::Trans4, FeatureLevel::Cnn2];
    keys.ablations.residual = Residual::Cat;
    let variables = VarMap::new();
    let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
    Aggregation::new(&keys, 32, &channels(), vb.pp("subsplat").pp("agg")).unwrap();
    set_initial_values(&variables).unwrap();
    let layers = Layers(&variables);
    for (level, columns) in [(0, 32), (1, 16)] {
        let w = layers.tensor(&format!("g1.wk.{level}.weight"));
        for (i, v) in w.iter().enumerate() {
            assert_eq!(*v, f64::from(u8::from(i / columns == i % columns)));
        }
        let spread = layers.tensor(&format!("g1.wv.{level}.weight"));
        let bound = (6.0 / (32 + columns) as f64).sqrt();
        let largest = spread.iter().fold(0f64, |m, v| m.max(v.abs()));
        assert!(largest <= bound + 1e-6 && largest > 0.9 * bound);
    }
    let cat = layers.linear("g0.cat", &(0..64).map(f64::from).collect::<Vec<_>>());
    for (i, v) in cat.iter().enumerate() {
        assert_eq!(*v, (i + i + 32) as f64, "f + o");
    }
    for name in ["g0.gate", "g0.level_bias", "g0.wk.0.bias", "g0.wv.1.bias"] {
        assert!(layers.tensor(name).iter().all(|v| *v == 0.0), "{name}");
    }
}

#[test]
fn learned_gates_have_a_limit_of_views() {
    let three = cameras(3, 16, 16);
    let mut r = Random(13);
    let primaries = LocalPrimaries::random(&three, 4, &mut r).place(&three);
    let backbone = backbone(3, 16, 16, &mut r);
    let frames = Frames::new(&three, DType::F32, &Device::Cpu).unwrap();
    for (gate, op, fits) in [
        (Gate::SoftmaxV, AttentionOp::Dot, false),
        (Gate::Softmax, AttentionOp::Dot, false),
        (Gate::Query, AttentionOp::Dot, true),
        (Gate::Off, AttentionOp::Dot, true),
        (Gate::Off, AttentionOp::Linear, false),
    ] {
        let mut keys = paper();
        (keys.gate_views, keys.ablations.gate, keys.ablations.op) = (2, gate, op);
        let (agg, _) = build(&keys, 14);
        let got = agg.prepare(&views(&three), &frames, maps_of(&backbone), &means_of(&primaries));
        match got {
            Ok(_) => assert!(fits, "{gate:?} {op:?}"),
            Err(e) => assert!(!fits && e.to_string().contains("agg.gate_views"), "{e}"),
        }
    }
}

/// The presets' stage and the general form give the same bits: `attn_drop` alone selects the
/// general form and has no effect at inference.
#[test]
fn presets_equal_the_general_form() {
    for preset in [Preset::Paper, Preset::Tuned] {
        let x = fixture(256, 256, 15);
        let run = |attn_drop: f64| {
            let mut keys = Config::re10k(preset, 2).agg;
            keys.ablations.attn_drop = attn_drop;
            let weights = Weights::seeded(16);
            let vb = weights.builder().pp("subsplat").pp("agg");
            let agg = Aggregation::new(&keys, 32, &channels(), vb).unwrap();
            run(&agg, &x, Mode::Infer).map(|t| host(&t))
        };
        assert_eq!(run(0.0), run(0.1), "{preset:?}");
    }
}
