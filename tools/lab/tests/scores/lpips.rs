//! LPIPS against reference outputs (random trunk, published linear weights), and its
//! gradient against differences.

use subsplat_test_support as common;

use candle_core::{Device, Tensor, Var};
use common::shared;
use std::collections::BTreeMap;
use subsplat::network::model::weights::{Weights, read_tensors};
use subsplat_lab::lpips::{Lpips, MIN_SIDE};

/// Largest relative difference allowed. Two fp32 implementations sum 13 convolutions in
/// other orders; 2e-7 to 6e-7 were seen.
const TOLERANCE: f32 = 5e-6;

fn values(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

#[track_caller]
fn agree(ours: &[f32], theirs: &[f32], what: &str) {
    assert_eq!(ours.len(), theirs.len());
    for (a, b) in ours.iter().zip(theirs) {
        let off = (a - b).abs() / b.abs();
        eprintln!("{what}: {a} {b} {off:.1e}");
        assert!(off < TOLERANCE, "{what}: {a}, expected {b}");
    }
}

fn golden() -> Option<(Lpips, BTreeMap<String, Tensor>)> {
    let (tensors, _) = read_tensors(&shared("golden/metrics_lpips_randvgg.safetensors")?).unwrap();
    let weights = tensors
        .iter()
        .filter_map(|(name, t)| Some((name.strip_prefix("w.")?.to_owned(), t.clone())))
        .collect();
    let weights = Weights::from_tensors(weights);
    let lpips = Lpips::new(weights.builder()).unwrap();
    // Constants of the module, not weights.
    assert_eq!(weights.unexpected(), ["scaling_layer.scale", "scaling_layer.shift"]);
    Some((lpips, tensors))
}

#[test]
fn every_layer_agrees_with_the_reference() {
    let Some((lpips, tensors)) = golden() else { return };
    let (a, b) = (&tensors["pred"], &tensors["gt"]);
    let layers = lpips.layers(a, b).unwrap();
    for i in 0..5 {
        let name = format!("lpips_layer{i}");
        agree(&values(&layers.narrow(1, i, 1).unwrap()), &values(&tensors[&name]), &name);
    }
    agree(&values(&lpips.forward(a, b).unwrap()), &values(&tensors["lpips"]), "lpips");
    // It is a distance: symmetric, zero on equal pictures.
    agree(&values(&lpips.forward(b, a).unwrap()), &values(&tensors["lpips"]), "swapped");
    assert_eq!(values(&lpips.forward(a, a).unwrap()), [0.0, 0.0]);
}

/// Two pictures of `h` × `w` pixels without structure.
fn noise(h: usize, w: usize) -> (Vec<f32>, Vec<f32>) {
    let mut state = 7u64;
    let mut next = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    let a = (0..3 * h * w).map(|_| next()).collect();
    (a, (0..3 * h * w).map(|_| next()).collect())
}

#[test]
fn the_gradient_is_the_slope() {
    // Odd sides: pooling leaves a row and a column out.
    let (h, w) = (19, 34);
    let lpips = Lpips::new(Weights::seeded(5).builder()).unwrap();
    let picture = |v: &[f32]| Tensor::from_slice(v, (1, 3, h, w), &Device::Cpu).unwrap();
    let (a, b) = noise(h, w);
    let var = Var::from_tensor(&picture(&a)).unwrap();
    let other = picture(&b);
    let loss = |x: &Tensor| lpips.forward(x, &other).unwrap().sum_all().unwrap();
    let grads = loss(var.as_tensor()).backward().unwrap();
    let gradient = values(grads.get(var.as_tensor()).unwrap());
    assert!(gradient.iter().all(|g| g.is_finite()));
    // Along the gradient and along the way to the other picture.
    let length = gradient.iter().map(|g| f64::from(g * g)).sum::<f64>().sqrt();
    let along: Vec<f32> = gradient.iter().map(|g| (f64::from(*g) / length) as f32).collect();
    let toward: Vec<f32> = a.iter().zip(&b).map(|(a, b)| b - a).collect();
    for (name, direction, step) in [("gradient", along, 1e-2f32), ("toward", toward, 3e-4)] {
        let slope: f64 =
            gradient.iter().zip(&direction).map(|(g, d)| f64::from(*g) * f64::from(*d)).sum();
        let at = |s: f32| {
            let moved: Vec<f32> = a.iter().zip(&direction).map(|(a, d)| a + s * d).collect();
            f64::from(loss(&picture(&moved)).to_scalar::<f32>().unwrap())
        };
        let measured = (at(step) - at(-step)) / (2.0 * f64::from(step));
        eprintln!("{name}: {slope:.6} {measured:.6}");
        assert!((slope - measured).abs() < 2e-2 * slope.abs(), "{name}: {slope} {measured}");
    }
}

#[test]
fn black_features_have_a_gradient() {
    // All features are zero where every bias is negative and the picture is the mean.
    let weights = Weights::seeded(5).trainable();
    Lpips::new(weights.builder()).unwrap();
    let dead = weights
        .variables()
        .into_iter()
        .map(|(name, var)| {
            let t = var.as_tensor().detach();
            (
                name.clone(),
                if name.ends_with("bias") { (t.abs().unwrap() * -9.0).unwrap() } else { t },
            )
        })
        .collect();
    let lpips = Lpips::new(Weights::from_tensors(dead).builder()).unwrap();
    let flat = Tensor::full(0.45f32, (1, 3, 16, 16), &Device::Cpu).unwrap();
    let var = Var::from_tensor(&flat).unwrap();
    let d = lpips.forward(var.as_tensor(), &(flat * 0.9).unwrap()).unwrap();
    let grads = d.sum_all().unwrap().backward().unwrap();
    assert!(values(grads.get(var.as_tensor()).unwrap()).iter().all(|g| g.is_finite()));
}

#[test]
fn pictures_that_do_not_fit_are_refused() {
    let lpips = Lpips::new(Weights::seeded(1).builder()).unwrap();
    let zeros = |shape: (usize, usize, usize, usize)| {
        Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu).unwrap()
    };
    let side = MIN_SIDE;
    let good = zeros((1, 3, side, side));
    for (other, named) in [
        (zeros((1, 3, side, side + 1)), "[1, 3, 16, 17]"),
        (zeros((2, 3, side, side)), "[2, 3, 16, 16]"),
    ] {
        let e = lpips.forward(&good, &other).unwrap_err().to_string();
        assert!(e.contains(named), "{e}");
    }
    let short = zeros((1, 3, side, side - 1));
    assert!(lpips.forward(&short, &short).unwrap_err().to_string().contains("15x16"));
    let grey = zeros((1, 1, side, side));
    assert!(lpips.forward(&grey, &grey).unwrap_err().to_string().contains("[1, 1, 16, 16]"));
    assert_eq!(values(&lpips.forward(&good, &good).unwrap()), [0.0]);
}
