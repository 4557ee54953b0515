//! Adam, norms and clipping on a GPU, against the CPU's optimizer and the definition in f64.

use subsplat_test_support::cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_test_support::gpu::{gpu, limited};

use super::array::values;
use candle_core::{Device, Tensor, Var};
use std::collections::BTreeMap;
use std::sync::Arc;
use subsplat::network::model::Backend;
use subsplat::network::ops::Executor;
use subsplat_kernels::gpu::Gpu;
use subsplat_lab::train::optimizer::{Gradients, Optimizer, Settings};

/// Tolerance of state after [`STEPS`] steps: a dozen roundings a step, and roots and quotients of the
/// device, which are exact to 3 units in the last place.
const TOLERANCE: f32 = 1e-5;
const STEPS: u64 = 6;

/// Lengths below, at and above a block of the kernel; the last one receives no gradient.
const PARAMETERS: [(&str, &[usize]); 5] = [
    ("small.a", &[7, 31]),
    ("small.b", &[64]),
    ("subsplat.c", &[5, 3, 43]),
    ("subsplat.d", &[1]),
    ("subsplat.unused", &[3]),
];

fn settings() -> Settings {
    Settings {
        clip: 4.0,
        average: 0.9,
        weight_decay: 0.1,
        backbone_rate: 0.5,
        ..Settings::default()
    }
}

fn variables() -> BTreeMap<String, Var> {
    let r = &mut Random(11);
    let var = |(name, dims): &(&str, &[usize])| {
        let values = r.many(dims.iter().product(), -1.0, 1.0);
        let tensor = Tensor::from_vec(values, *dims, &Device::Cpu).unwrap();
        ((*name).to_owned(), Var::from_tensor(&tensor).unwrap())
    };
    PARAMETERS.iter().map(var).collect()
}

/// Gradients of step `n`: those of even steps are so large that they are clipped.
fn gradients(optimizer: &Optimizer, vars: &BTreeMap<String, Var>, n: u64) -> (Gradients, Vec<f32>) {
    let r = &mut Random(100 + n);
    let size = if n.is_multiple_of(2) { 3.0 } else { 0.05 };
    let (mut parts, mut all) = (Vec::new(), Vec::new());
    for (_, var) in vars.iter().filter(|(name, _)| !name.ends_with("unused")) {
        let own = r.many(var.elem_count(), -size, size);
        all.extend_from_slice(&own);
        let factors = Tensor::from_vec(own, var.dims(), &Device::Cpu).unwrap();
        parts.push((var.as_tensor() * factors).unwrap().sum_all().unwrap());
    }
    let loss = parts.into_iter().reduce(|a, b| (a + b).unwrap()).unwrap();
    let mut gradients = optimizer.gradients();
    optimizer.collect(&loss.backward().unwrap(), &mut gradients).unwrap();
    (gradients, all)
}

/// Takes step `n` and returns the norm.
fn step(optimizer: &mut Optimizer, vars: &BTreeMap<String, Var>, n: u64) -> f64 {
    let (gradients, _) = gradients(optimizer, vars, n);
    let norm = optimizer.norm(&gradients).unwrap();
    optimizer.step(&gradients, norm, 0.02, n).unwrap();
    norm
}

/// Variables with an optimizer, on `gpu` if there is one.
fn optimizer(gpu: Option<Arc<Gpu>>) -> (BTreeMap<String, Var>, Optimizer, Backend) {
    let vars = variables();
    let mut optimizer = Optimizer::new(settings(), vars.clone()).unwrap();
    let backend = gpu.map_or(Backend::Cpu, Backend::from);
    if let Some(executor) = Executor::new(&backend) {
        optimizer.set_device(&executor, &backend).unwrap();
        assert!(optimizer.is_on_device());
    }
    (vars, optimizer, backend)
}

fn assert_same_state(got: &Optimizer, expected: &Optimizer) {
    let (got, expected) = (got.state().unwrap(), expected.state().unwrap());
    assert_eq!(got.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, tensor) in &expected {
        assert_eq!(got[name].dims(), tensor.dims(), "{name}");
        // Zeros, which no step changed, have no scale.
        if values(tensor).iter().all(|v| *v == 0.0) || name == "updates" {
            assert_eq!(values(&got[name]), values(tensor), "{name}")
        } else {
            assert_matches_cpu(name, &values(&got[name]), &values(tensor), TOLERANCE)
        }
    }
}

#[test]
fn steps_agree_with_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let (cpu_vars, mut cpu, _) = optimizer(None);
    let (vars, mut own, backend) = optimizer(Some(gpu));
    let (mut clipped, mut early) = (0, None);
    for n in 0..STEPS {
        let expected = step(&mut cpu, &cpu_vars, n);
        let norm = step(&mut own, &vars, n);
        clipped += usize::from(norm > settings().clip);
        assert!((norm / expected - 1.0).abs() < 1e-6, "{norm} {expected}");
        assert_same_state(&own, &cpu);
        if n == 1 {
            early = Some((cpu.state().unwrap(), own.state().unwrap()));
        }
        // The tensors that the CPU's modules read have the device's values.
        let state = own.state().unwrap();
        for (name, var) in &vars {
            assert_eq!(values(var), values(&state[&format!("weights/{name}")]), "{name}");
        }
    }
    assert_eq!(backend.warning(), None);
    assert_eq!(clipped, STEPS.div_ceil(2) as usize, "steps that are clipped and others");
    // A state of the CPU goes on on the device, and the reverse; an early one, which differs from theirs.
    let (from_cpu, from_device) = early.unwrap();
    own.restore(from_cpu).unwrap();
    cpu.restore(from_device).unwrap();
    assert!(own.is_on_device() && !cpu.is_on_device());
    step(&mut cpu, &cpu_vars, STEPS);
    step(&mut own, &vars, STEPS);
    assert_same_state(&own, &cpu);
}

/// The paper's algorithm in f64, for the first element of each parameter.
#[test]
fn steps_follow_the_definition() {
    let Some(gpu) = gpu() else { return };
    let (vars, mut own, _) = optimizer(Some(gpu));
    let s = settings();
    let first = |t: &Tensor| f64::from(values(t)[0]);
    let named: Vec<_> = PARAMETERS.iter().take(4).collect();
    let mut state: Vec<[f64; 4]> =
        named.iter().map(|(name, _)| first(&vars[*name])).map(|v| [v, 0.0, 0.0, v]).collect();
    for n in 0..STEPS {
        let (_, all) = gradients(&own, &vars, n);
        let norm = all.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
        step(&mut own, &vars, n);
        let (mut at, t) = (0, n as i32 + 1);
        let decay = s.average.min((1.0 + n as f64) / (10.0 + n as f64));
        for ((name, dims), [value, m, v, average]) in named.iter().zip(&mut state) {
            let g = f64::from(all[at]) * (s.clip / norm).min(1.0);
            let rate = if name.starts_with("small") { 0.02 * s.backbone_rate } else { 0.02 };
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *value -= if dims.len() > 1 { rate * s.weight_decay * *value } else { 0.0 };
            let root = (*v / (1.0 - 0.999f64.powi(t))).sqrt() + s.epsilon;
            *value -= rate * (*m / (1.0 - 0.9f64.powi(t))) / root;
            *average += (1.0 - decay) * (*value - *average);
            at += dims.iter().product::<usize>();
        }
    }
    let averaged = own.averaged().unwrap();
    for ((name, _), [value, _, _, average]) in named.iter().zip(&state) {
        let got = [first(&vars[*name]), first(&averaged[*name])];
        let off = (got[0] - value).abs().max((got[1] - average).abs());
        assert!(off < 2e-6, "{name}: {got:?}, expected {value} and {average}");
    }
}

/// After the loss of its device the optimizer goes on on the CPU, from the state of its last step.
#[test]
fn a_lost_device_loses_no_step() {
    let Some(gpu) = limited(128 << 20) else { return };
    let (cpu_vars, mut cpu, _) = optimizer(None);
    let (vars, mut own, backend) = optimizer(Some(gpu.clone()));
    for n in 0..STEPS {
        if n == 2 {
            assert_eq!(backend.warning(), None);
            gpu.device().destroy();
            gpu.device().poll(subsplat_kernels::gpu::wgpu::PollType::wait_indefinitely()).ok();
        }
        step(&mut cpu, &cpu_vars, n);
        step(&mut own, &vars, n);
    }
    assert!(!own.is_on_device());
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
    assert_same_state(&own, &cpu);
}
