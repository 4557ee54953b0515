//! The trunk end to end on random scenes: every switch, both paths (fused and
//! differentiable), invariances.

use subsplat_test_support::scenes;

use candle_core::{DType, Device, Tensor};
use candle_nn::{VarBuilder, VarMap};
use scenes::*;
use subsplat::network::config::*;
use subsplat::network::model::embed::Embeddings;
use subsplat::network::model::geometry::{Frames, ParentChunk};
use subsplat::network::model::trunk::{Children, TrainPass, Trunk, set_initial_values};
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat_kernels::camera::Camera;

const SIZE: usize = 16;

fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// A narrow model: E = 32, SH degree 1.
fn config(preset: Preset, side: usize) -> Config {
    let mut c = Config::small(preset, side);
    c.embed.dim = 32;
    c.spgr.hidden = 32;
    if let Backbone::Small(b) = &mut c.backbone {
        b.primaries.sh_degree = 1;
    }
    c
}

/// A trunk with random parameters, heads included.
fn trunk(config: &Config, seed: u64) -> (Trunk, VarMap) {
    let variables = VarMap::new();
    let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
    let trunk = Trunk::new(config, &channels(), vb).unwrap();
    let mut named: Vec<_> = variables.data().lock().unwrap().clone().into_iter().collect();
    named.sort_by(|a, b| a.0.cmp(&b.0));
    // Candle's own draws are others in every run.
    let seeded = Weights::seeded(seed).trainable();
    Trunk::new(config, &channels(), seeded.builder()).unwrap();
    let seeded = seeded.variables();
    for (name, var) in &named {
        var.set(&seeded[name]).unwrap();
    }
    set_initial_values(&variables).unwrap();
    let mut r = Random(seed);
    for (_, var) in named {
        let noise = r.tensor(var.dims(), 0.1, DType::F32);
        var.set(&(var.as_tensor() + noise).unwrap()).unwrap();
    }
    (trunk, variables)
}

struct Scene {
    views: Views,
    backbone: BackboneOutput,
    primaries: Primaries,
}

impl Scene {
    fn new(cameras: &[Camera], seed: u64) -> Self {
        let mut r = Random(seed);
        let local = LocalPrimaries::random(cameras, 4, &mut r);
        Self {
            views: views(cameras),
            backbone: backbone(cameras.len(), SIZE, SIZE, &mut r),
            primaries: local.place(cameras),
        }
    }

    fn infer(&self, trunk: &Trunk) -> Children {
        trunk.forward(&self.views, &self.backbone, &self.primaries).unwrap()
    }

    fn train(&self, trunk: &Trunk, chunk: usize) -> Children {
        trunk
            .forward_train(
                &self.views,
                &self.backbone,
                &self.primaries,
                TrainPass { chunk, seed: 3 },
            )
            .unwrap()
    }
}

type Change = fn(&mut Config);

/// Every value of every switch, one at a time, on top of both presets.
fn switches() -> Vec<(&'static str, Change)> {
    use FeatureLevel::*;
    vec![
        ("as is", |_| {}),
        ("embed pg", |c| c.embed.mlp = EmbedMlp::Pg),
        ("embed lite", |c| c.embed.mlp = EmbedMlp::Lite),
        ("world", |c| c.embed.anchor_frame = AnchorFrame::World),
        ("src_cam", |c| c.embed.anchor_frame = AnchorFrame::SrcCam),
        ("view0", |c| c.embed.anchor_frame = AnchorFrame::View0),
        ("mu raw", |c| c.embed.mu = MuInput::Raw),
        ("mu ray", |c| c.embed.mu = MuInput::RayLogz),
        ("scale raw", |c| c.embed.scale = ScaleInput::Raw),
        ("scale px", |c| c.embed.scale = ScaleInput::LogPx),
        ("alpha raw", |c| c.embed.alpha = AlphaInput::Raw),
        ("alpha logit", |c| c.embed.alpha = AlphaInput::Logit),
        ("sh world", |c| c.embed.sh = ShInput::World),
        ("sh camera", |c| c.embed.sh = ShInput::Camera),
        ("no aggregation", |c| c.agg.enabled = false),
        ("no geometry stage", |c| c.agg.stages_geo = 0),
        ("one stage", |c| c.agg.stages_geo = 1),
        ("no appearance stage", |c| c.agg.stages_app = 0),
        ("shared weights", |c| c.agg.ablations.share_stage_weights = true),
        ("all levels", |c| c.agg.levels = vec![Trans4, Trans8, Trans16, Cnn4, Cnn2, Refine1]),
        ("linear", |c| c.agg.ablations.op = AttentionOp::Linear),
        ("13 points", |c| c.agg.ablations.points = Points::Pixelgaussian),
        ("PixelGaussian", |c| {
            c.agg.ablations.op = AttentionOp::Linear;
            c.agg.ablations.points = Points::Pixelgaussian;
            c.agg.ablations.groups = 4;
            c.agg.ablations.mask = MaskMode::PgClamp;
            c.agg.ablations.attn_drop = 0.15;
            c.agg.ablations.share_stage_weights = true;
        }),
        ("GaussianFormer", |c| {
            c.agg.ablations.op = AttentionOp::Linear;
            c.agg.ablations.points = Points::Pixelgaussian;
            c.agg.ablations.groups = 4;
            c.agg.ablations.residual = Residual::Cat;
            c.agg.ablations.ffn = true;
        }),
        ("fixed points", |c| {
            (c.agg.ablations.points, c.agg.ablations.n_learned) = (Points::Pixelgaussian, 0)
        }),
        ("learned points", |c| {
            (c.agg.ablations.points, c.agg.ablations.n_fixed) = (Points::Pixelgaussian, 0)
        }),
        ("map offsets", |c| c.agg.ablations.points = Points::MapOffsets),
        ("no offsets", |c| {
            (c.agg.ablations.points, c.agg.ablations.n_learned) = (Points::MapOffsets, 0)
        }),
        ("groups", |c| c.agg.ablations.groups = 4),
        ("groups, levels", |c| (c.agg.ablations.groups, c.agg.levels) = (2, vec![Cnn2, Refine1])),
        ("scale 1", |c| c.agg.ablations.logit_scale = LogitScale::One),
        ("no projection", |c| c.agg.ablations.kv_proj = false),
        ("no projection, levels", |c| {
            (c.agg.ablations.kv_proj, c.agg.levels) = (false, vec![Cnn2])
        }),
        ("softmax gate", |c| c.agg.ablations.gate = Gate::Softmax),
        ("query gate", |c| c.agg.ablations.gate = Gate::Query),
        ("no gate", |c| c.agg.ablations.gate = Gate::Off),
        ("more gate views", |c| (c.agg.gate_views, c.agg.ablations.op) = (5, AttentionOp::Linear)),
        ("residual none", |c| c.agg.ablations.residual = Residual::None),
        ("residual cat", |c| c.agg.ablations.residual = Residual::Cat),
        ("norm none", |c| c.agg.norm = StageNorm::None),
        ("norm pre", |c| c.agg.norm = StageNorm::Pre),
        ("ffn", |c| c.agg.ablations.ffn = true),
        ("pg clamp", |c| c.agg.ablations.mask = MaskMode::PgClamp),
        ("integer", |c| c.agg.ablations.sample_convention = SampleConvention::Integer),
        ("detached points", |c| c.agg.ablations.detach_points = true),
        ("detached key points", |c| {
            (c.agg.ablations.detach_points, c.agg.ablations.points) = (true, Points::Pixelgaussian)
        }),
        ("occlusion", |c| c.agg.occlusion_gate = true),
        ("no occlusion", |c| c.agg.occlusion_gate = false),
        ("heads read f", |c| c.agg.ablations.head_input = HeadInput::F),
        ("literal", |c| c.agg.ablations.strict_literal = true),
        ("head pg", |c| c.spgr.head = SpgrHead::Pg),
        ("head coord", |c| c.spgr.head = SpgrHead::Coord),
        // At ×2 its further layers have no effect.
        ("head polynomial", |c| (c.spgr.head, c.upscale) = (SpgrHead::Polynomial, 3)),
        ("heads not zero", |c| c.spgr.zero_init = false),
        ("rgb gain", |c| c.spgr.ablations.gain_space = GainSpace::Rgb),
        ("low-pass of the input", |c| c.render.lowpass_ref = LowpassRef::Input),
        ("no SPGR", |c| c.spgr.enabled = false),
    ]
}

#[test]
fn every_switch_runs_and_both_paths_agree() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 1);
    for preset in [Preset::Paper, Preset::Tuned] {
        for (i, (name, change)) in switches().into_iter().enumerate() {
            let side = [2, 1, 3][i % 3];
            let mut c = config(preset, side);
            change(&mut c);
            c.check().unwrap();
            let (trunk, variables) = trunk(&c, 2);
            let a = scene.infer(&trunk);
            c.agg.ablations.attn_drop = 0.0;
            let undropped = Trunk::new(
                &c,
                &channels(),
                VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu),
            );
            let b = scene.train(&undropped.unwrap(), 100);
            let k = if c.spgr.enabled { c.children() } else { 1 };
            assert_eq!((a.k, b.k), (k, k));
            assert_eq!(a.rows.dims(), [512 * k, 11], "{name}");
            assert_eq!(a.sh.dims(), [512, 4, 3]);
            for lane in 0..11 {
                let one = |t: &Tensor| t.narrow(1, lane, 1).unwrap();
                let (d, scale) = difference(&one(&a.rows), &one(&b.rows));
                assert!(d < 3e-4 * scale, "{preset:?} {name} lane {lane}: {d:e} of {scale:e}");
            }
            assert_close(&a.gain, &b.gain, 1e-4);
            let splats = a.to_splats().unwrap();
            assert_eq!((splats.len(), splats.parents()), (512 * k, 512));
            assert_eq!(splats.gain_channels(), if name == "rgb gain" { 4 } else { 1 });
        }
    }
}

#[test]
fn every_parameter_has_a_gradient() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 3);
    for preset in [Preset::Paper, Preset::Tuned] {
        for (name, change) in switches() {
            let mut c = config(preset, 2);
            change(&mut c);
            let (trunk, variables) = trunk(&c, 4);
            if !c.spgr.enabled {
                assert!(variables.all_vars().is_empty());
                continue;
            }
            let out = scene.train(&trunk, 256);
            let w = Random(5).tensor(out.rows.dims(), 1.0, DType::F32);
            let loss = (out.rows * w).unwrap().sum_all().unwrap();
            let loss = (loss + out.gain.sqr().unwrap().sum_all().unwrap()).unwrap();
            let grads = loss.backward().unwrap();
            let agg = c.agg.resolved();
            for (key, var) in variables.data().lock().unwrap().iter() {
                // Gates of views beyond the scene's, f that no head reads, key biases
                // that shift all of a softmax's logits alike.
                let f_unused = key.contains(".agg.a") && c.agg.stages_app == 0;
                let z_unused = agg.ablations.head_input == HeadInput::F
                    && c.agg.enabled
                    && (key.contains(".w_g") || key.contains(".embed."));
                let shift = key.contains(".wk.") && key.ends_with("bias");
                // f = 0 before the first stage, so its key points depend on a bias only.
                let blind =
                    key.contains("g0.key_points.weight") && !c.agg.ablations.share_stage_weights;
                if f_unused || z_unused || shift || blind {
                    continue;
                }
                let g = grads.get(var).unwrap_or_else(|| panic!("{preset:?} {name}: {key} unused"));
                let g = host(g);
                assert!(g.iter().all(|v| v.is_finite()), "{preset:?} {name}: {key}");
                assert!(g.iter().any(|v| *v != 0.0), "{preset:?} {name}: {key} has no gradient");
            }
        }
    }
}

#[test]
fn gradients_reach_the_backbone_and_the_whole_chain_is_right() {
    // Directional derivative of the whole trunk along a random direction of one input
    // at a time, f32: the sum over many parents keeps it well above rounding.
    let cams = cameras(2, SIZE, SIZE);
    let scene = Scene::new(&cams, 6);
    let mut c = config(Preset::Tuned, 2);
    c.spgr.ablations.a_min = AMin::Off;
    c.agg.occlusion_gate = false;
    let (trunk, _) = trunk(&c, 7);
    let map = scene.backbone.feature(FeatureLevel::Trans4).unwrap();
    let w = Random(8).tensor(&[512 * 4, 11], 1.0, DType::F32);
    let loss = |m: &Tensor, means: &Tensor, sh: &Tensor| {
        let mut backbone = scene.backbone.clone();
        backbone.features[0].1 = m.clone();
        let primaries =
            Primaries { means: means.clone(), sh_camera: sh.clone(), ..scene.primaries.clone() };
        let out = trunk
            .forward_train(&scene.views, &backbone, &primaries, TrainPass { chunk: 512, seed: 0 })
            .unwrap();
        (out.rows * &w).unwrap().sum_all().unwrap()
    };
    let p = &scene.primaries;
    let at = [map.clone(), p.means.clone(), p.sh_camera.clone()];
    let vars = at.clone().map(|t| candle_core::Var::from_tensor(&t).unwrap());
    let grads = loss(&vars[0], &vars[1], &vars[2]).backward().unwrap();
    for (i, h) in [(0, 3e-2), (1, 3e-4), (2, 3e-2)] {
        let g = grads.get(&vars[i]).unwrap();
        // Along the gradient, so that the derivative is as large as it can be.
        let direction =
            g.broadcast_div(&g.sqr().unwrap().sum_all().unwrap().sqrt().unwrap()).unwrap();
        let value = |sign: f64| {
            let mut x = at.clone();
            x[i] = (&x[i] + (&direction * (sign * h)).unwrap()).unwrap();
            f64::from(loss(&x[0], &x[1], &x[2]).to_scalar::<f32>().unwrap())
        };
        let numeric = (value(1.0) - value(-1.0)) / (2.0 * h);
        let analytic = host(&(g * &direction).unwrap().sum_all().unwrap())[0];
        assert!((numeric / analytic - 1.0).abs() < 0.03, "input {i}: {numeric} {analytic}");
    }
}

/// Children, and the gradients of all parameters, of a map and of the primaries, of the
/// chunked walk against those of one graph over all parents.
#[test]
fn the_recomputed_pass_is_the_graphs() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 11);
    let wanted = ["as is", "no aggregation", "shared weights", "all levels", "PixelGaussian"];
    for (name, change) in switches().into_iter().filter(|(name, _)| wanted.contains(name)) {
        let mut c = config(Preset::Tuned, 2);
        c.embed.sh = ShInput::World;
        change(&mut c);
        let (trunk, variables) = trunk(&c, 12);
        let [map, means, sh] = [
            scene.backbone.features[0].1.clone(),
            scene.primaries.means.clone(),
            scene.primaries.sh.clone(),
        ]
        .map(|t| candle_core::Var::from_tensor(&t).unwrap());
        let mut backbone = scene.backbone.clone();
        backbone.features[0].1 = map.as_tensor().clone();
        let (at, sh_at) = (means.as_tensor().clone(), sh.as_tensor().clone());
        let primaries = Primaries { means: at, sh: sh_at, ..scene.primaries.clone() };
        let args = (&scene.views, &backbone, &primaries);
        let graph =
            trunk.forward_train(args.0, args.1, args.2, TrainPass { chunk: 512, seed: 3 }).unwrap();
        let w = [&graph.rows, &graph.gain, &graph.sh]
            .map(|t| Random(13).tensor(t.dims(), 1.0, DType::F32));
        let along = |t: &Tensor, w: &Tensor| (t * w).unwrap().sum_all().unwrap();
        let loss = (along(&graph.rows, &w[0]) + along(&graph.gain, &w[1])).unwrap();
        let store = (loss + along(&graph.sh, &w[2])).unwrap().backward().unwrap();
        let mut vars = variables.all_vars();
        vars.extend([map, means, sh]);

        // 100 does not divide a view's 256 parents.
        let pass = trunk
            .forward_recomputed(args.0, args.1, args.2, TrainPass { chunk: 100, seed: 3 })
            .unwrap();
        close(&pass.children().rows, &graph.rows, name);
        close(&pass.children().gain, &graph.gain, name);
        assert!(!pass.children().rows.track_op());
        let mut sums: Vec<Option<Tensor>> = vec![None; vars.len()];
        let mut collect = |store: &candle_core::backprop::GradStore| -> candle_core::Result<()> {
            for (sum, var) in sums.iter_mut().zip(&vars) {
                let Some(g) = store.get(var) else { continue };
                *sum = Some(match sum.take() {
                    Some(sum) => (sum + g)?,
                    None => g.clone(),
                });
            }
            Ok(())
        };
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let mut total = along(&pass.children().sh, &w[2]);
        let short = pass_error(&trunk, args, &flat(&w[0]));
        assert!(short.contains("gradients"), "{short}");
        for rest in pass.backward([&flat(&w[0]), &flat(&w[1])], &mut collect).unwrap() {
            total = (total + rest).unwrap();
        }
        collect(&total.backward().unwrap()).unwrap();
        for (sum, var) in sums.iter().zip(&vars) {
            match (sum, store.get(var)) {
                (Some(sum), Some(expected)) => close(sum, expected, name),
                // The graph's own accounting makes zeros of what nothing has reached.
                (None, Some(expected)) => assert!(host(expected).iter().all(|v| *v == 0.0)),
                (Some(sum), None) => assert!(host(sum).iter().all(|v| *v == 0.0)),
                (None, None) => {}
            }
        }
    }
    let mut off = config(Preset::Tuned, 1);
    off.spgr.enabled = false;
    let (off, _) = trunk(&off, 12);
    assert!(
        off.forward_recomputed(
            &scene.views,
            &scene.backbone,
            &scene.primaries,
            TrainPass { chunk: 64, seed: 0 }
        )
        .is_err()
    );
}

fn pass_error(
    trunk: &Trunk,
    (views, backbone, primaries): (&Views, &BackboneOutput, &Primaries),
    rows: &[f32],
) -> String {
    let pass = trunk
        .forward_recomputed(views, backbone, primaries, TrainPass { chunk: 100, seed: 3 })
        .unwrap();
    let done = pass.backward([rows, &[]], |_| Ok::<(), candle_core::Error>(()));
    done.map(|_| String::new()).unwrap_or_else(|e| e.to_string())
}

/// Within 2e-4 of the largest: f32 sums over some hundred parents in another order.
fn close(got: &Tensor, expected: &Tensor, name: &str) {
    assert_eq!(got.dims(), expected.dims(), "{name}");
    let (got, expected) = (host(got), host(expected));
    let scale = expected.iter().fold(1e-6f64, |m, v| m.max(v.abs()));
    for (i, (a, b)) in got.iter().zip(&expected).enumerate() {
        assert!((a - b).abs() < 2e-4 * scale, "{name}: {i}: {a}, expected {b} (scale {scale})");
    }
}

fn moved(cameras: &[Camera]) -> Vec<Camera> {
    let m = motion();
    let each = |c: &Camera| Camera::new(c.intrinsics(), m * c.world_from_camera()).unwrap();
    cameras.iter().map(each).collect()
}

/// Largest differences of means, quaternions (up to sign), scales, opacities and gains
/// between `b` and `a` moved by [`motion`].
fn world_differences(a: &Children, b: &Children) -> [f64; 4] {
    let m = motion();
    let turn = glam::Quat::from_mat4(&m);
    let (ra, rb) = (host(&a.rows), host(&b.rows));
    let mut worst = [0f64; 4];
    for (a, b) in ra.chunks(11).zip(rb.chunks(11)) {
        let v = |r: &[f64]| glam::Vec3::new(r[0] as f32, r[1] as f32, r[2] as f32);
        let q =
            |r: &[f64]| glam::Quat::from_xyzw(r[4] as f32, r[5] as f32, r[6] as f32, r[3] as f32);
        worst[0] = worst[0].max(f64::from((m.transform_point3(v(a)) - v(b)).length()));
        worst[1] =
            worst[1].max(f64::from(1.0 - (turn * q(a)).normalize().dot(q(b).normalize()).abs()));
        for i in 7..11 {
            worst[2] = worst[2].max((a[i] / b[i] - 1.0).abs());
        }
    }
    let gains = host(&a.gain).into_iter().zip(host(&b.gain));
    worst[3] = gains.fold(0.0, |w, (x, y)| w.max((x - y).abs()));
    worst
}

#[test]
fn tuned_children_turn_and_move_with_the_world() {
    let cams = cameras(2, SIZE, SIZE);
    for preset in [Preset::Tuned, Preset::Paper] {
        let (trunk, variables) = trunk(&config(preset, 2), 9);
        let a = Scene::new(&cams, 10);
        let b = Scene::new(&moved(&cams), 10);
        let d = world_differences(&a.infer(&trunk), &b.infer(&trunk));
        let fits = d[0] < 2e-4 && d[1] < 1e-5 && d[2] < 3e-3 && d[3] < 1e-4;
        // `paper` reads world coordinates: it must not be invariant, or the test is blind.
        assert_eq!(fits, preset == Preset::Tuned, "{preset:?} {d:?}");
        // While the heads' last layers are zero, `paper` is too.
        for (key, var) in variables.data().lock().unwrap().iter() {
            if key.contains("geo.lin1") || key.contains("app.lin1") {
                var.set(&var.zeros_like().unwrap()).unwrap();
            }
        }
        let d = world_differences(&a.infer(&trunk), &b.infer(&trunk));
        assert!(d[0] < 1e-4 && d[1] < 1e-5 && d[2] < 3e-3 && d[3] == 0.0, "{preset:?} {d:?}");
    }
}

#[test]
fn views_may_come_in_any_order_with_gates_off() {
    let cams = cameras(3, SIZE, SIZE);
    let order = [2usize, 0, 1];
    for gate in [Gate::Off, Gate::Query, Gate::SoftmaxV] {
        let mut c = config(Preset::Tuned, 2);
        c.agg.ablations.gate = gate;
        c.agg.gate_views = 3;
        let (trunk, _) = trunk(&c, 11);
        let a = Scene::new(&cams, 12);
        let index = Tensor::from_vec(order.map(|v| v as u32).to_vec(), 3, &Device::Cpu).unwrap();
        let blocks = |t: &Tensor| {
            let dims = t.dims().to_vec();
            let mut split = vec![1, 3, 256];
            split.extend(&dims[2..]);
            let t = t.reshape(split).unwrap().index_select(&index, 1).unwrap();
            t.reshape(dims).unwrap()
        };
        let p = &a.primaries;
        let b = Scene {
            views: views(&order.map(|v| cams[v])),
            backbone: BackboneOutput {
                features: a
                    .backbone
                    .features
                    .iter()
                    .map(|(l, m)| (*l, m.index_select(&index, 1).unwrap()))
                    .collect(),
                ..a.backbone.clone()
            },
            primaries: Primaries {
                means: blocks(&p.means),
                quats_wxyz: blocks(&p.quats_wxyz),
                scales: blocks(&p.scales),
                opacities: blocks(&p.opacities),
                sh: blocks(&p.sh),
                sh_camera: blocks(&p.sh_camera),
                ..p.clone()
            },
        };
        let rows = |s: &Scene| s.infer(&trunk).rows.reshape((3, 1024, 11)).unwrap();
        let want = rows(&a).index_select(&index, 0).unwrap();
        let (d, _) = difference(&rows(&b), &want);
        // Only gates by index depend on the order.
        assert_eq!(d < 1e-4, gate != Gate::SoftmaxV, "{gate:?} {d}");
    }
}

#[test]
fn pixel_unit_embeddings_transfer_to_another_resolution() {
    // The same rays, depths and sizes in pixels seen by a 16 px and a 32 px camera:
    // world scales halve, and only `log_px` is unchanged.
    for scale in [ScaleInput::LogPx, ScaleInput::Raw] {
        let mut c = config(Preset::Tuned, 2).embed;
        c.scale = scale;
        let variables = VarMap::new();
        let vb = VarBuilder::from_varmap(&variables, DType::F32, &Device::Cpu);
        let embeddings = Embeddings::new(&c, 12, vb).unwrap();
        let small = cameras(2, 16, 16);
        let local = LocalPrimaries::random(&small, 4, &mut Random(13)).place(&small);
        let run = |cams: &[Camera], factor: f64| {
            let t = |t: &Tensor| t.squeeze(0).unwrap().narrow(0, 256, 256).unwrap();
            let parents = ParentChunk {
                first: 256,
                source: 1,
                means: t(&local.means),
                quats_wxyz: t(&local.quats_wxyz),
                scales: (t(&local.scales) * factor).unwrap(),
                opacities: t(&local.opacities).unsqueeze(1).unwrap(),
                sh: t(&local.sh_camera).reshape((256, 12)).unwrap(),
            };
            let frames = Frames::new(cams, DType::F32, &Device::Cpu).unwrap();
            embeddings.forward(&parents, &frames).unwrap()
        };
        let large: Vec<Camera> = small.iter().map(|c| c.resized(32, 32).unwrap()).collect();
        let (a, b) = (run(&small, 1.0), run(&large, 0.5));
        let (d, _) = difference(&a.geometry, &b.geometry);
        assert_eq!(d < 1e-5, scale == ScaleInput::LogPx, "{scale:?} {d}");
        assert_close(&a.appearance, &b.appearance, 0.0);
    }
}

#[test]
fn heads_for_any_k_serve_any_grid_and_others_refuse() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 14);
    let mut c = config(Preset::Tuned, 2);
    for head in [SpgrHead::Coord, SpgrHead::Polynomial] {
        c.spgr.head = head;
        let (mut any, _) = trunk(&c, 15);
        let two = scene.infer(&any);
        for side in [1, 3, 4, 8] {
            any.set_upscale(side).unwrap();
            let out = scene.infer(&any);
            assert_eq!((out.k, out.rows.dim(0).unwrap()), (side * side, 512 * side * side));
        }
        for children in [2, 3, 6] {
            any.set_children(children).unwrap();
            assert_eq!(scene.infer(&any).rows.dim(0).unwrap(), 512 * children);
        }
        any.set_upscale(2).unwrap();
        assert_close(&scene.infer(&any).rows, &two.rows, 0.0);
        assert!(any.set_upscale(9).is_err() && any.set_children(65).is_err());
    }
    let (mut fixed, _) = trunk(&config(Preset::Tuned, 2), 15);
    fixed.set_upscale(2).unwrap();
    assert!(fixed.set_upscale(4).unwrap_err().to_string().contains("expected 2"));
    assert!(fixed.set_children(3).unwrap_err().to_string().contains("expected 4"));
}

/// Heads of the form `polynomial` give the children of `mlp2` at ×2, whatever the further layers are,
/// and the parents at ×1.
#[test]
fn polynomial_heads_equal_fixed_ones_at_two_and_the_parents_at_one() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 18);
    let mut c = config(Preset::Tuned, 2);
    let (fixed, variables) = trunk(&c, 19);
    c.spgr.head = SpgrHead::Polynomial;
    let (_, further) = trunk(&c, 20);
    let tensors = |variables: &VarMap| -> std::collections::BTreeMap<String, Tensor> {
        let all = variables.data().lock().unwrap();
        all.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect()
    };
    let mut both = tensors(&further);
    both.extend(tensors(&variables));
    let weights = Weights::from_tensors(both);
    let mut any = Trunk::new(&c, &channels(), weights.builder()).unwrap();
    let (got, want) = (scene.infer(&any), scene.infer(&fixed));
    assert_close(&got.rows, &want.rows, 0.0);
    assert_close(&got.gain, &want.gain, 0.0);
    any.set_upscale(1).unwrap();
    assert!(any.is_off());
    c.spgr.enabled = false;
    let parents = scene.infer(&Trunk::new(&c, &channels(), Weights::seeded(0).builder()).unwrap());
    assert_close(&scene.infer(&any).rows, &parents.rows, 0.0);
}

/// A parent with K children has those of a run in which all parents have K children.
#[test]
fn mixed_children_are_those_of_their_number() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 21);
    for preset in [Preset::Tuned, Preset::Paper] {
        let mut c = config(preset, 2);
        c.spgr.head = SpgrHead::Polynomial;
        let (mut any, _) = trunk(&c, 22);
        let mixed = |trunk: &Trunk, counts: &[u8]| {
            let Scene { views, backbone, primaries } = &scene;
            trunk.forward_mixed(views, backbone, primaries, counts, &|| Ok(()))
        };
        let counts: Vec<u8> = (0..512).map(|i| [4, 0, 1, 16, 3][i * i % 5]).collect();
        let got = mixed(&any, &counts).unwrap();
        let all: Vec<Option<Children>> = (0..17)
            .map(|k| {
                [1, 3, 4, 16].contains(&k).then(|| {
                    any.set_children(k).unwrap();
                    scene.infer(&any)
                })
            })
            .collect();
        let all: Vec<_> = all.iter().map(|c| c.as_ref().map(|c| c.to_splats().unwrap())).collect();
        let mut at = 0;
        for (parent, children) in counts.iter().map(|k| usize::from(*k)).enumerate() {
            let Some(of_count) = &all[children] else { continue };
            for k in 0..children {
                let i = parent * children + k;
                assert_eq!(got.parents[at], parent as u32);
                for (g, w) in got.splats.row(at).iter().zip(of_count.row(i)) {
                    assert!(
                        (g - w).abs() <= 1e-5 * w.abs().max(1.0),
                        "{preset:?} {parent} {g} {w}"
                    );
                }
                assert_eq!(got.splats.sh_of(at), of_count.sh_of(i));
                let (gain, want) = (got.splats.gain_of(at).0, of_count.gain_of(i).0);
                assert!((gain - want).abs() < 1e-5, "{preset:?} {parent}: gain {gain}, {want}");
                at += 1;
            }
        }
        assert_eq!(at, got.splats.len());
        assert!(mixed(&any, &counts[1..]).unwrap_err().to_string().contains("each of 512 parents"));
        assert!(mixed(&any, &[65; 512]).unwrap_err().to_string().contains("1 to 64"));
        assert!(mixed(&any, &[0; 512]).unwrap().splats.is_empty());
        // Heads for one K serve their own grid beside parents.
        let (fixed, _) = trunk(&config(preset, 2), 23);
        assert_eq!(mixed(&fixed, &[4; 512]).unwrap().splats.len(), 2048);
        assert!(mixed(&fixed, &[16; 512]).unwrap_err().to_string().contains("expected 4"));
    }
}

#[test]
fn without_spgr_the_primaries_pass_through() {
    let scene = Scene::new(&cameras(2, SIZE, SIZE), 16);
    let mut c = config(Preset::Paper, 4);
    c.spgr.enabled = false;
    let out = scene.infer(&trunk(&c, 17).0);
    assert_close(
        &out.rows.narrow(1, 0, 3).unwrap(),
        &scene.primaries.means.squeeze(0).unwrap(),
        0.0,
    );
    assert_close(&out.rows.narrow(1, 10, 1).unwrap(), &scene.primaries.opacities.t().unwrap(), 0.0);
    let splats = out.to_splats().unwrap();
    let sh = host(&scene.primaries.sh);
    // Primaries are colour-major, splats have RGB innermost.
    for (colour, got) in [(0, 3), (1, 4), (2, 5)] {
        assert_eq!(f64::from(splats.sh_of(7)[got]), sh[7 * 12 + colour * 4 + 1]);
    }
}

#[test]
fn batches_equal_their_scenes() {
    let cams = cameras(2, SIZE, SIZE);
    let (a, b) = (Scene::new(&cams, 18), Scene::new(&moved(&cams), 19));
    let both = |x: &Tensor, y: &Tensor| Tensor::cat(&[x, y], 0).unwrap();
    let (p, q) = (&a.primaries, &b.primaries);
    let views = Views::new(
        both(&a.views.images, &b.views.images),
        [a.views.cameras.clone(), b.views.cameras.clone()].concat(),
        [a.views.near_far.clone(), b.views.near_far.clone()].concat(),
    );
    let features = a.backbone.features.iter().zip(&b.backbone.features);
    let backbone = BackboneOutput {
        raw: both(&a.backbone.raw, &b.backbone.raw),
        depths: both(&a.backbone.depths, &b.backbone.depths),
        densities: both(&a.backbone.densities, &b.backbone.densities),
        features: features.map(|((l, x), (_, y))| (*l, both(x, y))).collect(),
    };
    let primaries = Primaries {
        means: both(&p.means, &q.means),
        quats_wxyz: both(&p.quats_wxyz, &q.quats_wxyz),
        scales: both(&p.scales, &q.scales),
        opacities: both(&p.opacities, &q.opacities),
        sh: both(&p.sh, &q.sh),
        sh_camera: both(&p.sh_camera, &q.sh_camera),
        ..p.clone()
    };
    let (trunk, _) = trunk(&config(Preset::Tuned, 2), 20);
    let views = views.unwrap();
    let got = trunk.forward_scenes(&views, &backbone, &primaries).unwrap();
    for (got, scene) in got.iter().zip([&a, &b]) {
        assert_close(&got.rows, &scene.infer(&trunk).rows, 0.0);
    }
    let error = trunk.forward(&views, &backbone, &primaries).unwrap_err().to_string();
    assert!(error.contains("one scene"), "{error}");
}

#[test]
fn several_gaussians_per_pixel() {
    // G = 2: parents 2i and 2i + 1 share a pixel; equal parents give equal children.
    let cams = cameras(2, SIZE, SIZE);
    let a = Scene::new(&cams, 21);
    let twice = |t: &Tensor| {
        let dims = t.dims().to_vec();
        let t = t.unsqueeze(2).unwrap();
        let t = Tensor::cat(&[&t, &t], 2).unwrap();
        let mut shape = dims.clone();
        shape[1] *= 2;
        t.reshape(shape).unwrap()
    };
    let p = &a.primaries;
    let b = Scene {
        primaries: Primaries {
            means: twice(&p.means),
            quats_wxyz: twice(&p.quats_wxyz),
            scales: twice(&p.scales),
            opacities: twice(&p.opacities),
            sh: twice(&p.sh),
            sh_camera: twice(&p.sh_camera),
            per_view: 512,
            ..p.clone()
        },
        views: a.views.clone(),
        backbone: a.backbone.clone(),
    };
    let (trunk, _) = trunk(&config(Preset::Tuned, 2), 22);
    let (one, two) = (a.infer(&trunk).rows, b.infer(&trunk).rows);
    let two = two.reshape((512, 2, 44)).unwrap();
    let one = one.reshape((512, 44)).unwrap();
    for copy in 0..2 {
        let rows = two.narrow(1, copy, 1).unwrap().squeeze(1).unwrap().contiguous().unwrap();
        assert_close(&rows, &one, 1e-5);
    }
}

#[test]
fn bad_inputs_are_refused_by_name() {
    let cams = cameras(2, SIZE, SIZE);
    let c = config(Preset::Tuned, 2);
    let (trunk, _) = trunk(&c, 23);
    let error = |change: &dyn Fn(&mut Scene)| {
        let mut scene = Scene::new(&cams, 24);
        change(&mut scene);
        let result = trunk.forward(&scene.views, &scene.backbone, &scene.primaries);
        result.map(|_| ()).unwrap_err().to_string()
    };
    for bad in [f32::NAN, f32::INFINITY] {
        for tensor in 0..4 {
            let e = error(&|s: &mut Scene| {
                let p = &mut s.primaries;
                let t = [&mut p.means, &mut p.quats_wxyz, &mut p.scales, &mut p.opacities];
                let t = t.into_iter().nth(tensor).unwrap();
                let mut data = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let at = data.len() / 2;
                data[at] = bad;
                *t = Tensor::from_vec(data, t.dims(), &Device::Cpu).unwrap();
            });
            assert!(e.contains("finite") && e.contains("parent 256"), "{tensor} {bad}: {e}");
        }
    }
    let e = error(&|s| s.backbone.features.retain(|(l, _)| *l != FeatureLevel::Cnn2));
    assert!(e.contains("Cnn2"), "{e}");
    let e = error(&|s| s.primaries.per_view = 255);
    assert!(e.contains("2 views of 255"), "{e}");
    let e = error(&|s| s.primaries.scales = s.primaries.scales.narrow(2, 0, 2).unwrap());
    assert!(e.contains("scales [1, 512, 3]"), "{e}");
    let e = error(&|s| s.primaries.sh_camera = s.primaries.sh_camera.narrow(3, 0, 1).unwrap());
    assert!(e.contains("[1, 512, 3, 4]"), "{e}");
    let vb = VarBuilder::zeros(DType::F32, &Device::Cpu);
    let e = Trunk::new(&c, &channels()[..1], vb).unwrap_err().to_string();
    assert!(e.contains("agg.levels") && e.contains("Cnn2"), "{e}");
}

#[test]
fn parents_behind_every_camera_stay_finite() {
    let cams = cameras(2, SIZE, SIZE);
    for preset in [Preset::Paper, Preset::Tuned] {
        for mask in [MaskMode::Renorm, MaskMode::PgClamp] {
            let mut c = config(preset, 2);
            c.agg.ablations.mask = mask;
            c.embed.anchor_frame = AnchorFrame::View0;
            let (trunk, _) = trunk(&c, 25);
            let mut scene = Scene::new(&cams, 26);
            scene.primaries.means = scene.primaries.means.neg().unwrap();
            let rows = scene.infer(&trunk).rows;
            assert!(host(&rows).iter().all(|v| v.is_finite()));
        }
    }
}
