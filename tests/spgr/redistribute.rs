//! Opacity redistribution: identities of every rule and gradients.

use subsplat_test_support::scenes;

use candle_core::{DType, Device, Tensor, Var};
use scenes::*;
use subsplat::network::ops::redistribute::{OpacityRule, redistribute};

fn cpu(v: Vec<f64>, shape: &[usize]) -> Tensor {
    Tensor::from_vec(v, shape, &Device::Cpu).unwrap()
}

fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

const RULES: [OpacityRule; 5] = [
    OpacityRule::Linear,
    OpacityRule::OpticalDepth,
    OpacityRule::Transmittance,
    OpacityRule::Area,
    OpacityRule::None,
];

/// Logits, areas, opacities, parent areas of p parents with k children, f64.
fn shares(p: usize, k: usize, r: &mut Random) -> [Tensor; 4] {
    let mut areas = |n| (0..n).map(|_| r.uniform(0.2, 3.0)).collect::<Vec<f64>>();
    let (a, own) = (areas(p * k), areas(p));
    let alpha = (0..p).map(|_| r.uniform(0.05, 0.95)).collect();
    let logits = r.tensor(&[p, k], 1.0, DType::F64);
    [logits, cpu(a, &[p, k]), cpu(alpha, &[p]), cpu(own, &[p])]
}

#[test]
fn linear_rule_is_the_papers_and_sums_to_the_parent() {
    let mut r = Random(1);
    let [l, a, o, _] = shares(9, 4, &mut r);
    let got = redistribute(OpacityRule::Linear, &l, &a, &o, None).unwrap();
    // w̃ = softmax(ℓ)/(A + ε), α·w̃/Σw̃ as written.
    let w = candle_nn::ops::softmax(&l, 1).unwrap().div(&(a + 1e-8).unwrap()).unwrap();
    let w = w.broadcast_div(&w.sum_keepdim(1).unwrap()).unwrap();
    assert_close(&got, &w.broadcast_mul(&o.unsqueeze(1).unwrap()).unwrap(), 1e-14);
    assert_close(&got.sum(1).unwrap(), &o, 1e-14);
}

#[test]
fn rules_conserve_what_they_promise() {
    let mut r = Random(2);
    for k in [1, 4, 9, 16] {
        let [l, a, o, own] = shares(7, k, &mut r);
        let run = |rule| redistribute(rule, &l, &a, &o, Some(&own)).unwrap();
        let tau = |alpha: &Tensor| alpha.affine(-1.0, 1.0).unwrap().log().unwrap().neg().unwrap();
        let depth = (tau(&run(OpacityRule::OpticalDepth)) * &a).unwrap().sum(1).unwrap();
        assert_close(&depth, &(tau(&o) * &own).unwrap(), 1e-12);
        let through = tau(&run(OpacityRule::Transmittance)).sum(1).unwrap();
        assert_close(&through, &tau(&o), 1e-12);
        let integrated = (run(OpacityRule::Area) * &a).unwrap().sum(1).unwrap();
        let whole = (&o * &own).unwrap();
        let capped =
            host(&run(OpacityRule::Area)).chunks(k).map(|c| c.contains(&0.99)).collect::<Vec<_>>();
        for (i, (got, want)) in host(&integrated).iter().zip(host(&whole)).enumerate() {
            assert!(if capped[i] { *got < want } else { (got - want).abs() < 1e-12 * want });
        }
        assert!(capped.iter().any(|c| !c) || k == 1, "every parent was capped");
        assert_close(
            &run(OpacityRule::None),
            &o.unsqueeze(1).unwrap().broadcast_as((7, k)).unwrap().contiguous().unwrap(),
            0.0,
        );
    }
}

#[test]
fn optical_depth_with_equal_relative_areas_keeps_the_opacity() {
    // λ_s = 1/√K, Δ = 0: Ã_k = Ã/K in the same unit.
    let mut r = Random(3);
    let [l, _, o, own] = shares(5, 4, &mut r);
    let areas = own.unsqueeze(1).unwrap().broadcast_as((5, 4)).unwrap().affine(0.25, 0.0).unwrap();
    let l = l.zeros_like().unwrap();
    let got = redistribute(OpacityRule::OpticalDepth, &l, &areas, &o, Some(&own)).unwrap();
    let want = o.unsqueeze(1).unwrap().broadcast_as((5, 4)).unwrap().contiguous().unwrap();
    assert_close(&got, &want, 1e-13);
}

#[test]
fn redistribution_gradients_match_differences() {
    let mut r = Random(4);
    for rule in RULES {
        for k in [1, 4, 9] {
            let [l, a, o, own] = shares(6, k, &mut r);
            let relative = rule.areas_are_relative();
            let mut inputs = vec![l, a, o];
            if relative {
                inputs.push(own);
            }
            let f = |x: &[Tensor]| redistribute(rule, &x[0], &x[1], &x[2], x.get(3));
            check_gradients(&inputs, &f, 12, 1e-7, &mut r);
        }
    }
}

#[test]
fn vectors_of_parents_give_what_single_ones_in_double_precision_do() {
    // More than one block of 512 and a rest that fills no vector; K that has a path of
    // its own and K that has none.
    let mut r = Random(6);
    for k in [1, 2, 4, 9, 16, 25] {
        let inputs = shares(531, k, &mut r);
        let weights = r.tensor(&[531, k], 1.0, DType::F64);
        let run = |rule, dtype| -> Vec<Tensor> {
            let vars = [0, 1, 2, 3]
                .map(|i: usize| Var::from_tensor(&inputs[i].to_dtype(dtype).unwrap()).unwrap());
            let [l, a, o, own] = &vars;
            let y = redistribute(rule, l, a, o, Some(own)).unwrap();
            let weights = weights.to_dtype(dtype).unwrap();
            let grads = (&y * weights).unwrap().sum_all().unwrap().backward().unwrap();
            let of = vars.iter().filter_map(|v| grads.get(v).cloned());
            std::iter::once(y.clone()).chain(of).collect()
        };
        for rule in RULES {
            let (got, want) = (run(rule, DType::F32), run(rule, DType::F64));
            assert_eq!(got.len(), if rule.areas_are_relative() { 5 } else { 4 });
            for (i, (got, want)) in got.iter().zip(&want).enumerate() {
                let (got, want) = (host(got), host(want));
                let size = want.iter().fold(0.0f64, |m, v| m.max(v.abs()));
                for (j, (g, w)) in got.iter().zip(&want).enumerate() {
                    assert!((g - w).abs() <= 2e-5 * size, "{rule:?} K={k} {i} {j}: {g} {w}");
                }
            }
        }
    }
}

#[test]
fn redistribution_survives_extremes_and_refuses_misfits() {
    let t = |v: &[f32], s: &[usize]| Tensor::from_slice(v, s, &Device::Cpu).unwrap();
    let logits = t(&[300.0, -300.0, 0.0, 88.0], &[2, 2]);
    let areas = t(&[0.0, 1e30, 1e-30, 1.0], &[2, 2]);
    let own = t(&[1e-12, 1e6], &[2]);
    for rule in RULES {
        for alpha in [[0.0f32, 1.0], [1.0, 0.5]] {
            let o = t(&alpha, &[2]);
            let got = redistribute(rule, &logits, &areas, &o, Some(&own)).unwrap();
            assert!(host(&got).iter().all(|v| (0.0..=1.0).contains(v)), "{rule:?} {got}");
        }
    }
    // A child that covers the sky takes nothing from its sibling's share.
    let (l, o) = (t(&[0.0; 2], &[1, 2]), t(&[0.75], &[1]));
    let beside = |sky: f32| {
        redistribute(
            OpacityRule::OpticalDepth,
            &l,
            &t(&[sky, 1.0], &[1, 2]),
            &o,
            Some(&t(&[1.0], &[1])),
        )
    };
    for sky in [1e30, f32::MAX, f32::INFINITY] {
        let got = host(&beside(sky).unwrap());
        assert!(got[0].abs() < 1e-12 && (got[1] - 0.5).abs() < 1e-6, "{sky}: {got:?}");
    }
    let o = t(&[0.5, 0.5], &[2]);
    let error = redistribute(OpacityRule::Area, &logits, &areas, &o, None).unwrap_err().to_string();
    assert!(error.contains("parents' areas"), "{error}");
    let error =
        redistribute(OpacityRule::Linear, &logits, &areas, &t(&[0.5], &[1]), None).unwrap_err();
    assert!(error.to_string().contains("opacities [2]"), "{error}");
    let f64s = areas.to_dtype(DType::F64).unwrap();
    assert!(redistribute(OpacityRule::Linear, &logits, &f64s, &o, None).is_err());
}
