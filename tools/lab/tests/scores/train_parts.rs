//! Tests of the parts of training: losses by finite differences, optimizer and schedule against
//! independent implementations, sources and augmentation by their invariants.

use subsplat_test_support as common;

use candle_core::{Device, Tensor, Var};
use std::collections::BTreeMap;
use std::sync::Arc;
use subsplat::network::model::weights::Weights;
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::{HEAD_GEOMETRY_LEN, HEAD_LOG_SCALE_OFFSET};
use subsplat_lab::data::dataset::Posed;
use subsplat_lab::data::procedural::{ExampleSpec, TargetSpec};
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::augment::Augmentation;
use subsplat_lab::train::loading::{Loader, LoaderOptions};
use subsplat_lab::train::loss;
use subsplat_lab::train::loss::{Scored, with_gradient};
use subsplat_lab::train::optimizer::{Optimizer, Settings};
use subsplat_lab::train::ranks::{Division, Ranks};
use subsplat_lab::train::schedule::{NamedWarmup, Schedule, Warmup};
use subsplat_lab::train::source::{Example, ExampleSize, InputTargets, Replay, Rooms, Source};
use subsplat_lab::train::step::{Learner, Seconds, StepScale};
use subsplat_test_support::finite_differences::{check_gradient, noise};

#[test]
fn cross_entropy_weights_candidates_by_distance() {
    let (d, n) = (7, 5);
    let logits: Vec<f32> = noise(2 * d * n, 5).iter().map(|v| 4.0 * v - 2.0).collect();
    let mut target: Vec<f32> = noise(2 * n, 6).iter().map(|v| v * (d - 1) as f32).collect();
    (target[1], target[2], target[3], target[8]) = (f32::NAN, 6.0, 0.0, 6.5);
    let found = loss::two_hot_cross_entropy(&logits, &target, [d, n]);
    // The definition.
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, t) in target.iter().enumerate() {
        if !(0.0..=6.0).contains(t) {
            continue;
        }
        let at = |k: usize| f64::from(logits[(i / n * d + k) * n + i % n]);
        let total: f64 = (0..d).map(|k| at(k).exp()).sum();
        let (k, share) = (t.floor() as usize, f64::from(t.fract()));
        let p = |k: usize| (at(k).exp() / total).ln();
        sum -= (1.0 - share) * p(k) + if share > 0.0 { share * p(k + 1) } else { 0.0 };
        count += 1.0;
    }
    assert_eq!(count, 8.0);
    assert!((found.value - sum / count).abs() < 1e-6, "{} {}", found.value, sum / count);
    check_gradient(&logits, 1e-2, 1e-3, |x| loss::two_hot_cross_entropy(x, &target, [d, n]));
    let unknown = loss::two_hot_cross_entropy(&logits, &vec![f32::NAN; 2 * n], [d, n]);
    assert_eq!(unknown, Scored::zero(2 * d * n));
}

#[test]
fn disparity_and_confidence_losses() {
    let target: Vec<f32> = noise(60, 7).iter().map(|v| 5.0 * v).collect();
    let mut with_gaps = target.clone();
    with_gaps[7] = f32::NAN;
    let x: Vec<f32> = noise(60, 8).iter().map(|v| 5.0 * v).collect();
    check_gradient(&x, 1e-2, 1e-2, |x| loss::smooth_l1(x, &with_gaps));
    let one = loss::smooth_l1(&[0.5, 4.0, 9.0], &[0.0, 1.0, f32::NAN]);
    assert!((one.value - (0.125 + 2.5) / 2.0).abs() < 1e-9, "{}", one.value);
    let p: Vec<f32> = noise(60, 9).iter().map(|v| 0.1 + 0.8 * v).collect();
    check_gradient(&p, 1e-3, 1e-2, |p| loss::confidence(p, &x, &with_gaps));
    // The minimum is at the target confidence.
    let target_confidence = (-1.0f32).exp();
    let at = |p: f32| loss::confidence(&[p], &[1.5], &[0.0]);
    assert!(at(target_confidence).gradient[0].abs() < 1e-5);
    assert!(
        at(target_confidence).value < at(0.3).value && at(target_confidence).value < at(0.5).value
    );
}

#[test]
fn candidates_and_blocks() {
    // D = 5 between 1/4 and 1; index 0 is far.
    let inverse = [0.25, 1.0, 0.625, 0.0, 0.2, 0.1, 1.2];
    let index = loss::candidate_index(&inverse, NearFar::new(1.0, 4.0), 5);
    assert_eq!(index[..3], [0.0, 4.0, 2.0]);
    assert!(index[3].is_nan() && index[5].is_nan() && index[6].is_nan());
    assert_eq!(index[4], 0.0);
    let mut map: Vec<f32> = (0..32).map(|i| i as f32).collect();
    // Left block: rows of 0 1 2 3, 8 9 10 11, …: the 8th of 16.
    assert_eq!(loss::block_median(&map, 8), [11.0, 15.0]);
    (0..9).for_each(|i| map[i % 3 + 8 * (i / 3)] = f32::NAN);
    assert!(loss::block_median(&map, 8)[0].is_nan());
}

#[test]
fn a_precomputed_gradient_reaches_the_variable() {
    let x = Var::new(&[[1f32, 2.0], [3.0, 4.0]], &Device::Cpu).unwrap();
    let y = (x.as_tensor() * 3.0).unwrap();
    let scored = Scored { value: 7.5, gradient: vec![1.0, 2.0, 3.0, 4.0] };
    let loss = with_gradient(&y, scored.clone()).unwrap();
    assert_eq!(loss.to_scalar::<f32>().unwrap(), 7.5);
    let store = (loss * 2.0).unwrap().backward().unwrap();
    let gradient = store.get(&x).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(gradient, [6.0, 12.0, 18.0, 24.0]);
    let short = Scored { gradient: vec![1.0], ..scored };
    assert!(with_gradient(&y, short).unwrap_err().to_string().contains("4 elements"));
}

#[test]
fn one_cycle_equals_pytorch() {
    let Some(path) = common::shared("golden/onecycle_lr.json") else { return };
    let text = std::fs::read_to_string(path).unwrap();
    let golden: BTreeMap<String, f64> = serde_json::from_str(&text).unwrap();
    let released = Warmup::Named(NamedWarmup::Released);
    let schedule = Schedule::OneCycle { rate: 2e-4, warmup: released };
    for (step, want) in &golden {
        // MVSplat's `max_steps` is 300,001.
        let got = schedule.rate(step.parse().unwrap(), 300_001);
        assert!((got - want).abs() < 1e-9 * want + 1e-18, "{step}: {got} {want}");
    }
    // The other reading: 2,000 of 300,000 steps.
    let schedule = Schedule::OneCycle { rate: 2e-4, warmup: Warmup::Steps(2000) };
    assert!((schedule.rate(1999, 300_000) - 2e-4).abs() < 1e-12);
    assert!(schedule.rate(1990, 300_000) < 2e-4 && schedule.rate(2010, 300_000) < 2e-4);
}

/// Returns a loss of two variables, one of them a matrix.
fn quadratic(vars: &BTreeMap<String, Var>) -> Tensor {
    let term = |name: &str, to: f64| {
        ((vars[name].as_tensor() - to).unwrap().sqr().unwrap().sum_all().unwrap() * 0.5).unwrap()
    };
    (term("small.w", 1.0) + term("subsplat.b", -2.0)).unwrap()
}

fn variables() -> BTreeMap<String, Var> {
    let var = |v: &[f32], shape: &[usize]| {
        Var::from_tensor(&Tensor::from_slice(v, shape, &Device::Cpu).unwrap()).unwrap()
    };
    BTreeMap::from([
        ("small.w".to_owned(), var(&[0.5, -1.0, 2.0, 3.0], &[2, 2])),
        ("small.unused".to_owned(), var(&[5.0], &[1])),
        ("subsplat.b".to_owned(), var(&[0.0, 1.0], &[2])),
    ])
}

/// AdamW as in its paper, in f64.
#[test]
fn the_optimizer_follows_adamw() {
    let settings = Settings { clip: 3.0, average: 0.9, weight_decay: 0.1, ..Settings::default() };
    let vars = variables();
    let mut optimizer = Optimizer::new(settings, vars.clone()).unwrap();
    let mut value = [0.5f64, -1.0, 2.0, 3.0, 0.0, 1.0];
    let (mut m, mut v, mut average) = ([0.0; 6], [0.0; 6], value);
    for step in 0..5u64 {
        let rate = 0.1 / (1.0 + step as f64);
        let store = quadratic(&vars).backward().unwrap();
        let mut gradients = optimizer.gradients();
        optimizer.collect(&store, &mut gradients).unwrap();
        let norm = gradients.norm();
        optimizer.step(&gradients, norm, rate, step).unwrap();

        let g: Vec<f64> = (0..6).map(|i| value[i] - if i < 4 { 1.0 } else { -2.0 }).collect();
        let want = g.iter().map(|g| g * g).sum::<f64>().sqrt();
        assert!((norm - want).abs() < 1e-5, "{norm} {want}");
        let decay = 0.9f64.min((1.0 + step as f64) / (10.0 + step as f64));
        for i in 0..6 {
            let g = g[i] * (3.0 / want).min(1.0);
            m[i] = 0.9 * m[i] + 0.1 * g;
            v[i] = 0.999 * v[i] + 0.001 * g * g;
            let t = step as i32 + 1;
            let (mh, vh) = (m[i] / (1.0 - 0.9f64.powi(t)), v[i] / (1.0 - 0.999f64.powi(t)));
            if i < 4 {
                value[i] -= rate * 0.1 * value[i];
            }
            value[i] -= rate * mh / (vh.sqrt() + 1e-8);
            average[i] = decay * average[i] + (1.0 - decay) * value[i];
        }
    }
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let got = [flat(&vars["small.w"]), flat(&vars["subsplat.b"])].concat();
    let averaged = optimizer.averaged().unwrap();
    let got_average = [flat(&averaged["small.w"]), flat(&averaged["subsplat.b"])].concat();
    for i in 0..6 {
        assert!((f64::from(got[i]) - value[i]).abs() < 1e-5, "{i}: {} {}", got[i], value[i]);
        assert!((f64::from(got_average[i]) - average[i]).abs() < 1e-5);
    }
    // Without a gradient, not even the weight decay applies.
    assert_eq!(flat(&vars["small.unused"]), [5.0]);
}

#[test]
fn a_frozen_backbone_is_constant_and_the_state_is_restored() {
    let settings = Settings { freeze_backbone: true, ..Settings::default() };
    let vars = variables();
    let mut optimizer = Optimizer::new(settings.clone(), vars.clone()).unwrap();
    let step = |optimizer: &mut Optimizer, vars: &BTreeMap<String, Var>, n: u64| {
        let store = quadratic(vars).backward().unwrap();
        let mut gradients = optimizer.gradients();
        optimizer.collect(&store, &mut gradients).unwrap();
        let norm = gradients.norm();
        optimizer.step(&gradients, norm, 0.1, n).unwrap();
    };
    step(&mut optimizer, &vars, 0);
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(flat(&vars["small.w"]), [0.5, -1.0, 2.0, 3.0]);
    assert_ne!(flat(&vars["subsplat.b"]), [0.0, 1.0]);
    let state = optimizer.state().unwrap();
    let others = variables();
    let mut other = Optimizer::new(settings, others.clone()).unwrap();
    other.restore(state.clone()).unwrap();
    step(&mut optimizer, &vars, 1);
    step(&mut other, &others, 1);
    assert_eq!(flat(&vars["subsplat.b"]), flat(&others["subsplat.b"]));
    let mut lacking = state.clone();
    lacking.remove("first/small.w");
    assert!(other.restore(lacking).unwrap_err().to_string().contains("first/small.w"));
    let mut foreign = state;
    foreign
        .insert("first/x".into(), Tensor::zeros(1, candle_core::DType::F32, &Device::Cpu).unwrap());
    assert!(other.restore(foreign).unwrap_err().to_string().contains("first/x"));
}

#[test]
fn parameters_that_are_not_named_stay_constant() {
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let settings = Settings { only: vec![".b".to_owned()], ..Settings::default() };
    let vars = variables();
    let before = flat(&vars["small.w"]);
    let mut optimizer = Optimizer::new(settings, vars.clone()).unwrap();
    let store = quadratic(&vars).backward().unwrap();
    let mut gradients = optimizer.gradients();
    optimizer.collect(&store, &mut gradients).unwrap();
    let norm = gradients.norm();
    optimizer.step(&gradients, norm, 0.1, 0).unwrap();
    assert_eq!(flat(&vars["small.w"]), before);
    assert_ne!(flat(&vars["subsplat.b"]), [0.0, 1.0]);
    let unknown = Settings { only: vec![".c".to_owned()], ..Settings::default() };
    let error = Optimizer::new(unknown, variables()).unwrap_err().to_string();
    assert!(error.contains("optimizer.only") && error.contains(".c"), "{error}");
}

fn rooms() -> Rooms {
    let mut spec = ExampleSpec::new(32, 24, 1);
    spec.photographic = false;
    Rooms {
        seed: 4,
        scenes: 0,
        spec,
        targets: TargetSpec { ratio: 2, samples: 1, clean: true, inputs: false },
        sizes: Vec::new(),
        seen_range: 0.0,
        detail: 0.0,
    }
}

#[test]
fn rooms_are_determined_by_their_seed() {
    let one = rooms().example(3).unwrap();
    assert_eq!(one, rooms().example(3).unwrap());
    assert_ne!(one, rooms().example(4).unwrap());
    assert_eq!(one.context.len(), 2);
    assert_eq!((one.targets[0].image.width, one.targets[0].image.height), (64, 48));
    assert_eq!(one.targets[0].camera.intrinsics().width, 64);
    assert_eq!(one.inverse_depth[1].len(), 32 * 24);
    let finite = Rooms { scenes: 3, ..rooms() };
    assert_eq!(finite.example(4).unwrap(), rooms().example(1).unwrap());
}

#[test]
fn sizes_of_examples_take_turns() {
    let size = |input: [usize; 2], upscale: usize| ExampleSize { input, upscale };
    let all = Rooms { sizes: vec![size([32, 32], 3), size([64, 32], 1)], ..rooms() };
    for (i, (input, upscale)) in [((32, 32), 3), ((64, 32), 1), ((32, 32), 3)].iter().enumerate() {
        let made = all.example(i as u64).unwrap();
        let sizes = |p: &Posed| (p.image.width, p.image.height);
        assert_eq!((sizes(&made.context[1]), made.upscale()), (*input, *upscale));
        assert_eq!(sizes(&made.targets[0]), (input.0 * upscale, input.1 * upscale));
    }
}

/// A training on examples of several sizes: heads for every K take them, others refuse.
#[test]
fn a_step_trains_several_upscales() {
    let text = |head: &str, more: &str| {
        format!(
            "batch = 2\ntogether = 1\n[model]\nset = {{ agg = {{ enabled = false }}, spgr = {{ head = \"{head}\", \
             hidden = 16 }}, embed = {{ dim = 32 }}, backbone = {{ cnn_channels = [8, 8], unet_channels = [8, 8], \
             head_channels = 8, stem_channels = 0, depth_candidates = 8 }} }}\n[data]\nsizes = [{{ input = [32, 32], \
             upscale = 3 }}, {{ input = [64, 32], upscale = 2 }}]\n{more}"
        )
    };
    let config = TrainConfig::from_toml(&text("polynomial", "")).unwrap();
    let refused = |text: &str| TrainConfig::from_toml(text).unwrap_err().to_string();
    assert!(refused(&text("mlp2", "")).contains("data.sizes: expected the model's upscale, 2"));
    let together = text("polynomial", "").replace("together = 1", "together = 2");
    assert!(refused(&together).contains("together: expected 1"));
    let weights = Weights::seeded(5).trainable();
    let learner = Learner::new(&config, &weights).unwrap();
    let optimizer = Optimizer::new(Settings::default(), weights.variables()).unwrap();
    let source = subsplat_lab::train::validate::rooms(
        &config,
        subsplat_lab::train::validate::Split::Training,
    )
    .unwrap();
    let examples: Vec<Example> =
        (0..2).map(|i| Example::clone(&source.example(i).unwrap())).collect();
    let mut gradients = optimizer.gradients();
    let scale = StepScale { share: 0.5, step: 0 };
    let mut seconds = Seconds::default();
    let terms =
        learner.accumulate(&examples, scale, &optimizer, &mut gradients, &mut seconds).unwrap();
    assert!(terms.loss.is_finite() && gradients.norm() > 0.0);
}

#[test]
fn a_visible_range_is_slightly_wider_than_the_depths() {
    let all = Rooms { seen_range: 1.0, ..rooms() };
    for i in 0..6 {
        let (own, visible) = (rooms().example(i).unwrap(), all.example(i).unwrap());
        assert_eq!((&own.context, &own.inverse_depth), (&visible.context, &visible.inverse_depth));
        let mut depths: Vec<f32> =
            visible.inverse_depth.iter().flatten().map(|d| d.to_f32().recip()).collect();
        depths.sort_by(f32::total_cmp);
        let last = depths.len() - 1;
        let (low, high) = (depths[last / 100], depths[last - last / 100]);
        let NearFar { near, far } = visible.near_far;
        assert!((0.74 * low..=1.01 * low).contains(&near), "{near} {low}");
        assert!((0.99 * high..=1.41 * high).contains(&far), "{far} {high}");
        assert_eq!(visible, all.example(i).unwrap());
    }
}

#[test]
fn replay_repeats_each_scene_of_a_window_equally() {
    let replay = Replay::new(rooms(), 7, 3);
    let places: Vec<u64> = (0..42).map(|i| replay.source_index(i)).collect();
    for block in 0..2u64 {
        for pass in 0..3 {
            let start = (block * 21 + pass * 7) as usize;
            let mut window = places[start..start + 7].to_vec();
            window.sort_unstable();
            assert_eq!(window, (block * 7..block * 7 + 7).collect::<Vec<_>>());
        }
    }
    assert_ne!(places[..7], places[7..14], "the same order again");
    // The product of this window and this number of repetitions overflows.
    assert!(Replay::new(rooms(), 1 << 32, 1 << 32).source_index(5) < 1 << 32);
    assert_eq!(replay.example(9).unwrap(), rooms().example(places[9]).unwrap());
    assert_eq!(replay.example(9).unwrap(), replay.example(9).unwrap());
}

/// A world point projects to mirrored positions in the picture and in its mirror image.
#[test]
fn mirroring_keeps_the_geometry() {
    let k = Intrinsics { fx: 30.0, fy: 31.0, cx: 13.0, cy: 9.0, width: 32, height: 24 };
    let pose = glam::Mat4::from_rotation_translation(
        glam::Quat::from_euler(glam::EulerRot::YXZ, 0.3, -0.2, 0.1),
        glam::Vec3::new(0.4, -0.3, 0.2),
    );
    let camera = Camera::new(k, pose).unwrap();
    let data = (0..32 * 24 * 3).map(|i| (i % 251) as u8).collect();
    let image = Rgb { width: 32, height: 24, data };
    let picture = Posed { image, camera };
    let mirrored = picture.flipped();
    assert_eq!(mirrored.image.data[..3], picture.image.data[31 * 3..32 * 3]);
    let rotation = mirrored.camera.rotation();
    assert!((rotation.determinant() - 1.0).abs() < 1e-5);
    for p in [glam::Vec3::new(0.5, 0.2, 3.0), glam::Vec3::new(-1.0, 0.4, 2.0)] {
        let before = camera.project(p).unwrap();
        let after = mirrored.camera.project(glam::Vec3::new(-p.x, p.y, p.z)).unwrap();
        assert!((after.x - (32.0 - before.x)).abs() < 1e-4 && (after.y - before.y).abs() < 1e-4);
    }
    assert_eq!(mirrored.flipped().image, picture.image);
}

#[test]
fn augmentation_is_a_function_of_the_position() {
    let example = rooms().example(0).unwrap();
    let all = Augmentation::default();
    let augmented: Vec<Example> = (0..24).map(|i| all.apply(&example, 1, i)).collect();
    assert_eq!(augmented[5], all.apply(&example, 1, 5));
    let different = augmented.iter().filter(|e| **e != *example).count();
    assert!((12..24).contains(&different), "{different}");
    let off = Augmentation { flip: 0.0, permute: 0.0, swap: 0.0, ..Default::default() };
    assert_eq!(off.apply(&example, 1, 5), *example);
    let swap = Augmentation { swap: 1.0, ..off }.apply(&example, 1, 5);
    assert_eq!(swap.context[0], example.context[1]);
    assert_eq!(swap.inverse_depth[0], example.inverse_depth[1]);
    let flip = Augmentation { flip: 1.0, ..off }.apply(&example, 1, 5);
    assert_eq!(flip.inverse_depth[0][0], example.inverse_depth[0][31]);
    assert_eq!(flip.targets[0].image.data[..3], example.targets[0].image.data[63 * 3..64 * 3]);
}

#[test]
fn views_differ_as_photographs_do() {
    let example = rooms().example(0).unwrap();
    let off = Augmentation { flip: 0.0, permute: 0.0, swap: 0.0, ..Default::default() };
    let photographic = Augmentation { photographic: 0.5, ..off };
    let (mut changed, mut one_alone, mut distance) = (0, 0, 0.0);
    for i in 0..40 {
        let out = photographic.apply(&example, 1, i);
        assert_eq!(out, photographic.apply(&example, 1, i));
        // Pictures of the targets, poses and depth stay.
        assert_eq!((&out.targets, &out.inverse_depth), (&example.targets, &example.inverse_depth));
        let differs = [0, 1].map(|v| {
            assert_eq!(out.context[v].camera, example.context[v].camera);
            let pairs = out.context[v].image.data.iter().zip(&example.context[v].image.data);
            let sum: f64 = pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
            distance += sum / example.context[v].image.data.len() as f64;
            sum > 0.0
        });
        changed += usize::from(differs[0]) + usize::from(differs[1]);
        one_alone += usize::from(differs[0] != differs[1]);
    }
    assert!((25..55).contains(&changed) && one_alone > 10, "{changed} {one_alone}");
    // Display values of 255: visible, and still the same scene.
    let mean = distance / changed as f64;
    assert!((4.0..40.0).contains(&mean), "{mean}");
}

#[test]
fn errors_of_poses_have_their_size() {
    let example = rooms().example(0).unwrap();
    let off = Augmentation { flip: 0.0, permute: 0.0, swap: 0.0, ..Default::default() };
    let errors = Augmentation { rotation_error: 0.5, focal_error: 0.01, ..off };
    let (mut squares, mut focal) = (0.0, 0.0);
    let n = 200;
    for i in 0..n {
        let out = errors.apply(&example, 1, i);
        assert_eq!(out.context[0].camera.rotation(), example.context[0].camera.rotation());
        assert_eq!(out.context[1].camera.position(), example.context[1].camera.position());
        assert_eq!(out.targets, example.targets);
        let relative =
            example.context[1].camera.rotation().transpose() * out.context[1].camera.rotation();
        squares += glam::Quat::from_mat3(&relative).to_scaled_axis().length_squared().to_degrees();
        let [a, b] = [&out, &example].map(|e| e.context[0].camera.intrinsics().fx);
        focal += (a / b).ln().powi(2);
    }
    // Three axes of 0.5 degrees each; degrees times radians.
    let sigma = (squares / n as f32 * 57.29578 / 3.0).sqrt();
    assert!((0.4..0.6).contains(&sigma), "{sigma} degrees");
    let focal = (focal / n as f32).sqrt();
    assert!((0.008..0.012).contains(&focal), "{focal}");
}

#[test]
fn inputs_can_be_targets() {
    let mut source = rooms();
    let plain = source.example(2).unwrap();
    source.targets.inputs = true;
    source.detail = 0.5;
    let mut with_detail = 0;
    for i in 0..20 {
        let example = source.example(i).unwrap();
        assert_eq!(example.targets.len(), 3);
        for (input, target) in example.context.iter().zip(&example.targets[1..]) {
            let [small, own] = [target.camera.resized(32, 24).unwrap(), input.camera];
            assert_eq!(small.world_from_camera(), own.world_from_camera());
            assert!((small.intrinsics().fy - own.intrinsics().fy).abs() < 1e-4);
            assert!((small.intrinsics().cx - own.intrinsics().cx).abs() < 1e-4);
            assert_eq!((target.image.width, target.image.height), (64, 48));
        }
        with_detail += usize::from(example.input_targets == InputTargets::WithDetail);
        assert_ne!(example.input_targets, InputTargets::Absent);
    }
    assert!((4..17).contains(&with_detail), "{with_detail}");
    let example = source.example(2).unwrap();
    assert_eq!((&example.context, &example.targets[0]), (&plain.context, &plain.targets[0]));
    // Exchanged views exchange their targets.
    let off = Augmentation { flip: 0.0, permute: 0.0, swap: 0.0, ..Default::default() };
    let swapped = Augmentation { swap: 1.0, ..off }.apply(&example, 1, 5);
    assert_eq!(swapped.targets[0], example.targets[0]);
    assert_eq!(swapped.targets[1], example.targets[2]);
    assert_eq!(swapped.targets[2], example.targets[1]);
}

/// The step's gradient with the detail of the inputs' pictures, by differences of the loss.
#[test]
fn a_step_with_detail_has_the_gradient_of_its_loss() {
    const BIAS: &str = "subsplat.app.lin1.bias";
    let set = r#"{ agg = { enabled = false }, embed = { mlp = "lite" },
        backbone = { primaries = { sh_degree = 1 } } }"#
        .replace('\n', "");
    let text = format!("[model]\nset = {set}\n[loss]\ncross_entropy = 0.0\ndisparity = 0.0\n");
    let config =
        TrainConfig::from_toml(&format!("{text}confidence = 0.0\ndssim = 0.15\n")).unwrap();
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let weights = Weights::load(&root.join("src/network/shipped/small.safetensors")).unwrap();
    let weights = weights.trainable();
    let learner = Learner::new(&config, &weights).unwrap();
    let bias = weights.variables()[BIAS].clone();
    let variables = BTreeMap::from([(BIAS.to_owned(), bias.clone())]);
    let optimizer = Optimizer::new(Settings::default(), variables).unwrap();
    let mut source = rooms();
    source.spec = ExampleSpec::new(64, 64, 1);
    source.targets.inputs = true;
    source.targets.samples = 4;
    source.detail = 1.0;
    let example = Example::clone(&source.example(1).unwrap());
    let step = |example: &Example| {
        let mut gradients = optimizer.gradients();
        let (scale, mut seconds) = (StepScale { share: 1.0, step: 0 }, Seconds::default());
        let examples = [example.clone()];
        let terms =
            learner.accumulate(&examples, scale, &optimizer, &mut gradients, &mut seconds).unwrap();
        (terms, gradients.norm())
    };
    // Children of 0.6 of their σ: detail of wide, transparent children averages out.
    let geometry = weights.variables()["subsplat.geo.lin1.bias"].clone();
    let mut values = geometry.as_tensor().to_vec1::<f32>().unwrap();
    for record in values.chunks_exact_mut(HEAD_GEOMETRY_LEN) {
        record[HEAD_LOG_SCALE_OFFSET..][..3].iter_mut().for_each(|v| *v -= 0.5);
    }
    geometry.set(&Tensor::new(values, &Device::Cpu).unwrap()).unwrap();
    let (terms, norm) = step(&example);
    let plain = Example { input_targets: InputTargets::Plain, ..example.clone() };
    assert!(step(&plain).0.mse > terms.mse, "detail brings the pictures nearer to the inputs");
    let before = bias.as_tensor().to_vec1::<f32>().unwrap();
    for (example, norm) in [(&plain, step(&plain).1), (&example, norm)] {
        let slope = |i: usize| {
            let loss = |h: f32| {
                let mut values = before.clone();
                values[i] += h;
                bias.set(&Tensor::new(values, &Device::Cpu).unwrap()).unwrap();
                step(example).0.loss
            };
            (loss(0.005) - loss(-0.005)) / 0.01
        };
        let slopes: Vec<f64> = (0..before.len()).map(slope).collect();
        bias.set(&Tensor::new(before.clone(), &Device::Cpu).unwrap()).unwrap();
        let expected = slopes.iter().map(|v| v * v).sum::<f64>().sqrt();
        // The loss jumps where a splat's alpha passes 1/255; the gradient does not contain the jumps.
        assert!((norm / expected - 1.0).abs() < 0.04, "{norm:e} {expected:e}");
    }
}

#[test]
fn loading_gives_the_sequence_for_any_number_of_threads() {
    let off = Augmentation { flip: 0.0, permute: 0.0, swap: 0.0, ..Default::default() };
    for workers in [1, 3] {
        let division = Division::of(&TrainConfig::default(), Ranks::single());
        let options = LoaderOptions { augmentation: off, seed: 0, workers, ahead: 4, division };
        let mut loader = Loader::start(Arc::new(rooms()), options, 2).unwrap();
        for i in 2..8 {
            assert_eq!(loader.position(), i);
            assert_eq!(loader.take().unwrap(), Some(Example::clone(&rooms().example(i).unwrap())));
        }
    }
}
