//! Gradients of the operations in device memory against those of candle's tape, and of the whole
//! small network.

use subsplat_test_support::cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_test_support::gather::base;
use subsplat_test_support::gpu::gpu;

use candle_core::{DType, Device, Result, Tensor, Var};
use std::sync::Arc;
use subsplat::network::config::MaskMode;
use subsplat::network::model::Backend;
use subsplat::network::model::geometry::Frames;
use subsplat::network::ops::activation::Activation;
use subsplat::network::ops::attention::Labels;
use subsplat::network::ops::attributes::Attributes;
use subsplat::network::ops::plane_sweep::{Sweep, pair, relative_pose};
use subsplat::network::ops::precomputed_gradient::precomputed_gradient;
use subsplat::network::ops::small::{Candidates, MeanOver, SmallArray, Start};
use subsplat::network::ops::{Array, ConvConfig, Executor, TapeArray};
use subsplat_kernels::layout::MuInput;

use super::array::{CONVOLUTIONS, cameras, noise, values};

/// Tolerance: sums of at most 10,000 products in another order, and elementary functions of the
/// device, which are exact to 3 units in the last place.
const TOLERANCE: f32 = 1e-5;
/// Tolerance of normalisations, whose gradients are differences.
const DIFFERENCES: f32 = 5e-5;

fn executor() -> Option<Arc<Executor>> {
    Executor::new(&Backend::from(gpu()?))
}

/// Gradient of a result: numbers in ±2 from the sizes alone.
fn upstream(dims: &[usize]) -> Tensor {
    noise(&mut Random(1 + dims.iter().product::<usize>() as u64), dims)
}

/// Compares gradients of `$body` of tensors with those of `$body` of arrays in device memory, with
/// respect to every argument. The arguments in brackets are constants.
macro_rules! same_gradients {
    ($gpu:expr, $name:expr, $tolerance:expr, |$($x:ident),+| $body:expr) => {
        same_gradients!($gpu, $name, $tolerance, [], |$($x),+| $body)
    };
    ($gpu:expr, $name:expr, $tolerance:expr, [$($c:ident),*], |$($x:ident),+| $body:expr) => {{
        let run = || -> Result<()> {
            let vars = [$(Var::from_tensor(&$x)?),+];
            let of_tensors: Vec<Tensor> = {
                let [$($x),+] = &vars;
                $(let $x = $x.as_tensor();)+
                $(let $c = &$c;)*
                let y: Result<_> = $body;
                let y = y?;
                let total = precomputed_gradient(&y, 0.0, values(&upstream(y.dims())))?;
                let store = total.backward()?;
                vars.iter().map(|var| store.get(var).expect($name).clone()).collect()
            };
            let leaves = [$($gpu.upload(&$x)?.leaf()),+];
            let [$($x),+] = &leaves;
            $(let $c = &$gpu.upload(&$c)?;)*
            let y: Result<TapeArray> = $body;
            let y = y?;
            assert!(y.track_op(), "{}: no tape", $name);
            let gradient = $gpu.upload(&upstream(y.dims()))?;
            let gradients = $gpu.backward(&[(&y, &gradient)])?;
            for (i, (leaf, expected)) in leaves.iter().zip(&of_tensors).enumerate() {
                let got = gradients.of(leaf).expect($name).to_host()?;
                assert_eq!(got.dims(), expected.dims(), "{} {i}", $name);
                let name = format!("{} {i}", $name);
                assert_matches_cpu(&name, &values(&got), &values(expected), $tolerance);
            }
            Ok(())
        };
        run().unwrap();
    }};
}

#[test]
fn elementwise_functions() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(3);
    let (x, y) = (noise(r, &[3, 5, 7, 9]), noise(r, &[3, 5, 7, 9]));
    let (row, map) = (noise(r, &[1, 5, 1, 1]), noise(r, &[3, 1, 7, 9]));
    same_gradients!(gpu, "affine", TOLERANCE, |x| x.affine(-1.5, 0.25));
    same_gradients!(gpu, "abs", TOLERANCE, |x| Array::abs(x));
    same_gradients!(gpu, "sqr", TOLERANCE, |x| Array::sqr(x));
    same_gradients!(gpu, "recip", TOLERANCE, |x| Array::recip(x));
    same_gradients!(gpu, "clamp", TOLERANCE, |x| Array::clamp(x, -0.5, 1.25));
    same_gradients!(gpu, "where gt", TOLERANCE, [map], |x| x.where_gt(map, 0.25, 3.0));
    same_gradients!(gpu, "add", TOLERANCE, |x, y| Array::add(x, y));
    same_gradients!(gpu, "add row", TOLERANCE, |x, row| Array::add(x, row));
    same_gradients!(gpu, "sub map", TOLERANCE, |x, map| Array::sub(x, map));
    same_gradients!(gpu, "mul row", TOLERANCE, |x, row| Array::mul(x, row));
    same_gradients!(gpu, "div", TOLERANCE, |x, y| Array::div(x, y));
    same_gradients!(gpu, "div map", TOLERANCE, |x, map| Array::div(x, map));
    same_gradients!(gpu, "used twice", TOLERANCE, |x, y| Array::add(
        &Array::mul(x, x)?,
        &Array::mul(y, x)?
    ));
    for kind in [Activation::Relu, Activation::Silu, Activation::Gelu, Activation::Sigmoid] {
        let name = format!("{kind:?}");
        same_gradients!(gpu, &name, TOLERANCE, |x| x.affine(4.0, 0.0)?.activate(kind));
    }
    same_gradients!(gpu, "softmax", TOLERANCE, |x| x.affine(3.0, 0.0)?.softmax());
}

#[test]
fn parts_orders_and_sums() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(4);
    let (x, y) = (noise(r, &[2, 6, 4, 8]), noise(r, &[2, 3, 4, 8]));
    let small = noise(r, &[2, 3, 2, 4]);
    same_gradients!(gpu, "reshape", TOLERANCE, |x| x.reshape((12, ())));
    same_gradients!(gpu, "narrow 1", TOLERANCE, |x| x.narrow(1, 2, 3));
    same_gradients!(gpu, "narrow 0", TOLERANCE, |x| x.narrow(0, 1, 1)?.affine(2.0, 0.0));
    same_gradients!(gpu, "permute", TOLERANCE, |x| Array::permute(x, &[2, 0, 3, 1]));
    same_gradients!(gpu, "index select", TOLERANCE, |x| Array::index_select(
        x,
        &[5, 0, 0, 2, 3, 1, 4],
        1
    ));
    same_gradients!(gpu, "cat", TOLERANCE, |x, y| Array::cat(&[y, x, y], 1));
    same_gradients!(gpu, "cat 0", TOLERANCE, |x| Array::cat(&[x, x], 0));
    same_gradients!(gpu, "upsample nearest", TOLERANCE, |x| Array::upsample_nearest2d(x, 3));
    same_gradients!(gpu, "cat upsampled", TOLERANCE, |x, small| x.cat_upsampled(small, 2));
    same_gradients!(gpu, "channels last", TOLERANCE, |x| x.channels_last());
    same_gradients!(gpu, "replication pad", TOLERANCE, |x| x.replication_pad2d(1));
    let (a, b, c) = (noise(r, &[7, 2]), noise(r, &[7, 5]), noise(r, &[7, 1]));
    same_gradients!(gpu, "cat columns", TOLERANCE, |a, b, c| a.cat_columns(b, Some(c)));
    same_gradients!(gpu, "average pool", TOLERANCE, |x| Array::avg_pool2d(x, 2));
    same_gradients!(gpu, "sum", TOLERANCE, |x| Array::sum(x, 1));
    same_gradients!(gpu, "mean", TOLERANCE, |x| Array::mean(x, 2));
    for dim in [1, 3] {
        same_gradients!(gpu, "max", TOLERANCE, |x| Array::max_keepdim(x, dim));
    }
    let row = noise(r, &[1, 5]);
    same_gradients!(gpu, "broadcast", TOLERANCE, |row| Array::broadcast_as(row, &[700, 5]));
    let (x, weights) = (noise(r, &[2, 30, 13]), noise(r, &[2, 13]));
    same_gradients!(gpu, "weighted sum", TOLERANCE, |x, weights| x.weighted_sum(weights));
    let x = noise(r, &[2, 3, 5, 9]);
    for size in [[5, 9], [20, 36], [1, 1], [7, 4], [64, 33]] {
        for activation in [None, Some(Activation::Gelu)] {
            let name = format!("resize {size:?}");
            same_gradients!(gpu, &name, TOLERANCE, |x| Array::upsample_bilinear2d(
                x, size, activation
            ));
        }
    }
    let line = noise(r, &[1, 2, 1, 4]);
    same_gradients!(gpu, "one row", TOLERANCE, |line| Array::upsample_bilinear2d(
        line,
        [3, 8],
        None
    ));
}

#[test]
fn products() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(5);
    for (c, o, h, w, k, stride, padding) in CONVOLUTIONS {
        let (x, weight, bias) = (noise(r, &[2, c, h, w]), noise(r, &[o, c, k, k]), noise(r, &[o]));
        let steps = ConvConfig { stride, padding };
        let name = format!("convolution {c} {o} {k}");
        same_gradients!(gpu, &name, TOLERANCE, |x, weight, bias| {
            Array::conv2d(x, weight, Some(bias), steps, None)
        });
    }
    let (x, weight, bias) =
        (noise(r, &[2, 4, 6, 9, 10]), noise(r, &[3, 4, 3, 3, 3]), noise(r, &[3]));
    let steps = ConvConfig { stride: 1, padding: 1 };
    same_gradients!(gpu, "3-D", TOLERANCE, |x, weight, bias| Array::conv3d(
        x,
        weight,
        Some(bias),
        steps,
        None
    ));
    same_gradients!(gpu, "constant weight", TOLERANCE, [weight], |x| Array::conv3d(
        x, weight, None, steps, None
    ));
    for (n, c, o) in [(1, 1, 1), (2200, 67, 70), (64, 128, 64), (300, 11, 5)] {
        let (x, weight, bias) = (noise(r, &[n, c]), noise(r, &[o, c]), noise(r, &[o]));
        same_gradients!(gpu, "linear", TOLERANCE, |x, weight, bias| {
            x.linear(weight, Some(bias), None)
        });
        same_gradients!(gpu, "linear", TOLERANCE, |x, weight| x.linear(weight, None, None));
        same_gradients!(gpu, "linear, gelu", TOLERANCE, |x, weight| {
            x.linear(weight, None, Some(Activation::Gelu))
        });
    }
}

#[test]
fn norms() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(6);
    // Rows of 3 parts and channels of 2, rows of less than one part, and far from zero.
    for (c, h, w) in [(8, 96, 100), (16, 5, 7), (24, 16, 16)] {
        let x = noise(r, &[2, c, h, w]).affine(1.0, 7.0).unwrap();
        let (weight, bias) = (noise(r, &[c]), noise(r, &[c]));
        let residual = noise(r, &[2, c, h, w]);
        for activation in [None, Some(Activation::Silu), Some(Activation::Gelu)] {
            same_gradients!(gpu, "group norm", DIFFERENCES, |x, weight, bias| {
                x.group_norm(4, [weight, bias], activation, None)
            });
            same_gradients!(
                gpu,
                "group norm and residual",
                DIFFERENCES,
                |x, weight, bias, residual| {
                    x.group_norm(4, [weight, bias], activation, Some(residual))
                }
            );
        }
        same_gradients!(gpu, "instance norm", DIFFERENCES, |x| {
            x.instance_norm(Some(Activation::Gelu))
        });
        same_gradients!(gpu, "instance norm", DIFFERENCES, |x| x.instance_norm(None));
    }
    for c in [7, 64, 192] {
        let (x, weight, bias) = (noise(r, &[130, c]), noise(r, &[c]), noise(r, &[c]));
        let residual = noise(r, &[130, c]);
        same_gradients!(gpu, "layer norm", DIFFERENCES, |x, weight, bias| {
            x.layer_norm([weight, bias], None)
        });
        same_gradients!(gpu, "norm and residual", DIFFERENCES, |x, weight, bias, residual| {
            x.layer_norm([weight, bias], Some(residual))
        });
        same_gradients!(gpu, "norm of a sum", DIFFERENCES, |x, weight, bias, residual| {
            x.add_layer_norm(residual, [weight, bias])
        });
    }
}

#[test]
fn attention_gather() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(16);
    let (gather, n) = (base(), 70);
    let maps = noise(r, &[70, gather.stride]);
    let query = noise(r, &[n, gather.query_width()]);
    let points = Tensor::from_vec(r.many(4 * n, -0.2, 1.2), (n, 2, 1, 2), &Device::Cpu).unwrap();
    same_gradients!(gpu, "gather", DIFFERENCES, |maps, query, points| {
        maps.attention_gather(query, points, gather.clone(), None, None, &Backend::Cpu)
    });
    let residual = noise(r, &[n, gather.dim]);
    same_gradients!(gpu, "gather and residual", DIFFERENCES, |maps, query, points, residual| {
        let (gather, residual) = (gather.clone(), Some(residual));
        maps.attention_gather(query, points, gather, None, residual, &Backend::Cpu)
    });
}

#[test]
fn attention() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(9);
    for (rows, l, m, d, e) in [(4, 37, 70, 24, 24), (2, 64, 64, 128, 128), (3, 1, 5, 3, 40)] {
        let (q, k, v) = (noise(r, &[rows, l, d]), noise(r, &[rows, m, d]), noise(r, &[rows, m, e]));
        same_gradients!(gpu, "attention", DIFFERENCES, |q, k, v| q.attention(k, v, 0.2, None));
    }
    let (q, k, v) = (noise(r, &[4, 33, 16]), noise(r, &[4, 66, 16]), noise(r, &[4, 66, 16]));
    let label = |n: usize, step: usize| (0..n).map(|i| (i / step % 3) as u8).collect::<Vec<_>>();
    let labels = Labels { windows: 2, queries: label(66, 7), keys: label(132, 5) };
    same_gradients!(gpu, "labels", DIFFERENCES, |q, k, v| {
        q.attention(k, v, 0.4, Some(labels.clone()))
    });
}

#[test]
fn plane_sweep() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(10);
    let ([h, w], d) = ([24, 32], 6);
    let features = noise(r, &[3, 8, h / 4, w / 4]);
    let small = cameras([h / 4, w / 4], 3);
    let line = |[i, j]: [usize; 2]| {
        let relative = relative_pose(&small[i], &small[j]);
        vec![pair(&small[i].intrinsics(), &small[j].intrinsics(), relative, j).unwrap()]
    };
    let depths: Vec<f32> = (0..d).map(|i| 1.0 / (0.2 + 0.15 * i as f32)).collect();
    let sweep = Sweep {
        pairs: [[0, 1], [1, 2], [2, 0]].map(line).to_vec(),
        depths: vec![depths; 3],
        centre: 0.5,
        min_z: 1e-3,
        scale: 1.0,
        channels: 8,
        size: [h / 4, w / 4],
    };
    let other = noise(r, &[3, 8, h / 4, w / 4]);
    same_gradients!(gpu, "plane sweep", TOLERANCE, |features, other| {
        features.plane_sweep(other, sweep.clone(), &Backend::Cpu)
    });
    same_gradients!(gpu, "plane sweep of one map", TOLERANCE, |features| {
        features.plane_sweep(features, sweep.clone(), &Backend::Cpu)
    });
}

#[test]
fn parts_of_the_small_backbone() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(11);
    let x = noise(r, &[2, 13, 6, 8]);
    same_gradients!(gpu, "normalize channels", TOLERANCE, |x| x.normalize_channels());
    for (window, mean) in [(2, MeanOver::Window), (1, MeanOver::All)] {
        same_gradients!(gpu, "expectation", TOLERANCE, |x| {
            let [mean, mass] = x.expectation(window, mean)?;
            Array::add(&mean, &mass.affine(-7.0, 0.0)?)
        });
    }
    let scores = noise(r, &[2, 13, 6, 8]);
    let factor = Tensor::new(&[0.7f32], &Device::Cpu).unwrap();
    same_gradients!(gpu, "add scores", TOLERANCE, |x, scores| x.add_scores(scores, &factor));
    let (masks, index) = (noise(r, &[2, 144, 6, 8]), noise(r, &[2, 1, 6, 8]));
    let confidence = noise(r, &[2, 1, 6, 8]);
    let start = r.many(144, 0.01, 1.0);
    same_gradients!(gpu, "convex upsampling", TOLERANCE, |masks, index, confidence| {
        let [first, second] = masks.upsample_convex([index, confidence], &start)?;
        Array::add(&first, &second.affine(-3.0, 0.0)?)
    });
    let (rgb, fine) = (noise(r, &[2, 3, 12, 16]), noise(r, &[2, 1, 12, 16]));
    let logit = noise(r, &[2, 1, 12, 16]);
    same_gradients!(gpu, "head input", TOLERANCE, [rgb], |x, fine, logit| {
        x.head_input(rgb, [fine, logit], 0.05)
    });
    let output = noise(r, &[2, 13, 12, 16]);
    let start = Start {
        row: r.many(12, -1.0, 1.0),
        colour: Some(([9, 10, 11], 3.5, -1.7)),
        confident: true,
    };
    same_gradients!(gpu, "head output", TOLERANCE, [rgb], |output, fine| {
        let [raw, opacity] = output.head_output(fine, rgb, start.clone())?;
        Array::cat(&[&raw.reshape((2, ()))?, &opacity.reshape((2, ()))?], 1)
    });
    let start = Start { colour: None, confident: false, ..start };
    same_gradients!(gpu, "plain opacity", TOLERANCE, [rgb, fine], |output| {
        Ok(output.head_output(fine, rgb, start.clone())?[1].clone())
    });
    let ranges = vec![Candidates { low: 0.1, step: 0.2 }, Candidates { low: 0.3, step: 0.1 }];
    let lengths = r.many(2 * 12 * 16, 1.0, 2.0);
    same_gradients!(gpu, "ray distance", TOLERANCE, |fine| {
        Array::abs(fine)?.ray_distance(ranges.clone(), lengths.clone())
    });
}

/// The factor of the skip is a parameter: its gradient enters candle's graph.
#[test]
fn a_tracked_tensor_receives_its_gradient() {
    let Some(gpu) = executor() else { return };
    let run = || -> Result<()> {
        let r = &mut Random(12);
        let (x, scores) = (noise(r, &[2, 13, 6, 8]), noise(r, &[2, 13, 6, 8]));
        let factor = Var::new(&[0.7f32], &Device::Cpu)?;
        let y = x.add_scores(&scores, &factor)?;
        let dy = upstream(y.dims());
        let expected = precomputed_gradient(&y, 0.0, values(&dy))?.backward()?;
        let y = gpu.upload(&x)?.add_scores(&gpu.upload(&scores)?, &factor)?;
        let gradients = gpu.backward(&[(&y, &gpu.upload(&dy)?)])?;
        let [scalar] = &gradients.scalars()?[..] else { panic!("expected one parameter") };
        let got = scalar.backward()?;
        let of = |store: &candle_core::backprop::GradStore| values(store.get(&factor).unwrap());
        assert_matches_cpu("factor", &of(&got), &of(&expected), TOLERANCE);
        let again = gpu.backward(&[(&y, &gpu.upload(&dy)?)]).unwrap_err().to_string();
        assert!(again.contains("one pass"), "{again}");
        Ok(())
    };
    run().unwrap();
}

#[test]
fn parts_of_the_trunk() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(13);
    let n = 70;
    // Two views of 35 parents; some points lie behind a camera, some opacities are 0 and 1.
    let mut rows = r.many(n * 11, -1.0, 1.0);
    for (i, row) in rows.chunks_exact_mut(11).enumerate() {
        row[2] = if i % 9 == 0 { -0.5 } else { 2.0 + row[2] };
        row[7..10].iter_mut().for_each(|s| *s = 1e-2 + s.abs());
        row[10] = [0.0, 1.0, 0.5 + 0.4 * row[10]][i % 3];
    }
    let rows = Tensor::from_vec(rows, (n, 11), &Device::Cpu).unwrap();
    let all = cameras([24, 32], 2);
    let frames = Frames::new(&all, DType::F32, &Device::Cpu).unwrap();
    let rules = Attributes {
        frame: Some(frames.0[0].numbers()),
        source: frames.0[1].numbers(),
        log_px: Some(32.0),
        position: MuInput::RayLogz,
        logit: Some(6.0),
        z_min: 1e-3,
        slope_max: 100.0,
        scale_min: 1e-12,
    };
    let plain =
        Attributes { frame: None, log_px: None, position: MuInput::Raw, logit: None, ..rules };
    for rules in [rules, plain] {
        same_gradients!(gpu, "attributes", TOLERANCE, |rows| rows.attributes(rules));
    }
    same_gradients!(gpu, "projected points", TOLERANCE, |rows| {
        let points = rows.narrow(1, 0, 3)?.reshape((n, 1, 3))?;
        frames.project(&points, MaskMode::Renorm)?.0.reshape((n, 2, 2))
    });
}

#[test]
fn nothing_is_recorded_without_a_leaf() {
    let Some(gpu) = executor() else { return };
    let x = gpu.upload(&noise(&mut Random(14), &[3, 4])).unwrap();
    assert!(!x.softmax().unwrap().track_op());
    assert!(!x.leaf().detach().softmax().unwrap().track_op());
}

/// The same bytes in every pass.
#[test]
fn gradients_are_reproducible() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(15);
    let (x, weight) = (noise(r, &[2, 9, 40, 41]), noise(r, &[20, 9, 3, 3]));
    let pass = || -> Result<Vec<u32>> {
        let (x, weight) = (gpu.upload(&x)?.leaf(), gpu.upload(&weight)?.leaf());
        let y = x.conv2d(&weight, None, ConvConfig { stride: 1, padding: 1 }, None)?;
        let y = y.instance_norm(Some(Activation::Gelu))?;
        let gradients = gpu.backward(&[(&y, &gpu.upload(&upstream(y.dims()))?)])?;
        let of = |leaf: &TapeArray| Ok(values(&gradients.of(leaf).unwrap().to_host()?));
        let all: Result<Vec<Vec<f32>>> = [&x, &weight].into_iter().map(of).collect();
        Ok(all?.concat().into_iter().map(f32::to_bits).collect())
    };
    assert_eq!(pass().unwrap(), pass().unwrap());
}
