//! The encoder's gradients, every parameter's, against those of the public MVSplat.

use subsplat_test_support as common;

use candle_core::{DType, Device, Result, Tensor};
use common::shared;
use std::collections::BTreeMap;
use subsplat::network::config::Mvsplat as Settings;
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::primaries::primaries;
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::{Weights, read_tensors};
use subsplat_lab::compare::views;

/// Norm of a difference over the norm; the worst seen is 4e-3 (a convolution of the CNN):
/// depth turns the last digits of features into its third, and a gradient of the CNN has
/// come through all of it.
const APART: f64 = 1e-2;
/// Gradients with a smaller norm are rounding; the next larger one is 7e-3.
const NOTHING: f64 = 1e-6;

type Tensors = BTreeMap<String, Tensor>;

/// The reference's loss: 100 times the sum of a mean per output (its metadata).
fn loss(weights: &Weights, inputs: &Tensors, reference: &Tensors) -> Result<Tensor> {
    let settings = Settings::re10k();
    let encoder = Mvsplat::new(&settings, weights.builder())?;
    let views = views(inputs)?;
    let out = encoder.forward(&views, &mut Trace::off())?;
    let p = primaries(&out, &views, &settings.primaries, &mut Trace::off())?;
    let bent = |t: &Tensor| (t * 0.1)?.tanh();
    let outputs = [
        ("means", bent(&p.means)?),
        ("covariances", bent(&p.covariances()?)?),
        ("harmonics", p.sh.clone()),
        ("opacities", p.opacities.clone()),
    ];
    let mut sum = Tensor::zeros((), DType::F32, &Device::Cpu)?;
    for (name, t) in outputs {
        sum = (sum + (t * &reference[&format!("w.{name}")])?.mean_all()?)?;
    }
    sum * 100.0
}

fn values(t: &Tensor) -> Vec<f64> {
    let t = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    t.into_iter().map(f64::from).collect()
}

fn norm(x: impl IntoIterator<Item = f64>) -> f64 {
    x.into_iter().map(|v| v * v).sum::<f64>().sqrt()
}

#[test]
fn every_parameter_has_the_gradient_of_the_reference() {
    let Some(weights) = shared("golden/mvsplat_weights.safetensors") else { return };
    let Some(inputs) = shared("golden/mvsplat_64x64_b1v2.safetensors") else { return };
    let Some(reference) = shared("golden/mvsplat_64x64_b1v2_grads.safetensors") else { return };
    let weights = Weights::load(&weights).unwrap().trainable();
    let (inputs, _) = read_tensors(&inputs).unwrap();
    let (reference, _) = read_tensors(&reference).unwrap();
    let loss = loss(&weights, &inputs, &reference).unwrap();
    let (got, want) = (values(&loss)[0], values(&reference["loss"])[0]);
    assert!((got / want - 1.0).abs() < 3e-4, "loss {got}, expected {want}");
    let grads = loss.backward().unwrap();
    let variables = weights.variables();
    assert_eq!(variables.len(), 471);
    for (name, var) in variables {
        let key = format!("grad.encoder.{}", name.strip_prefix("encoder.").unwrap_or(&name));
        let part = |what: &str| values(&reference[&format!("{key}|{what}")]);
        let (every, whole) = (part("every"), part("step_norm"));
        let (step, size) = (whole[0] as usize, whole[1]);
        let got = values(grads.get(&var).unwrap_or_else(|| panic!("{name}: no gradient")));
        let own = norm(got.iter().copied());
        if size < NOTHING {
            // A bias before an InstanceNorm: rounding alone.
            assert!(own < NOTHING, "{name}: norm {own}, expected {size}");
            continue;
        }
        assert!((own / size - 1.0).abs() < 2e-3, "{name}: norm {own}, expected {size}");
        let thin: Vec<f64> = got.into_iter().step_by(step).collect();
        assert_eq!(thin.len(), every.len(), "{name}");
        let apart = norm(thin.iter().zip(&every).map(|(a, b)| a - b));
        let relative = apart / norm(every);
        assert!(relative < APART, "{name}: {relative:.1e} apart");
    }
}
