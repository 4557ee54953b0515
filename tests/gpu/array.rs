//! Operations of the network in device memory against those of candle tensors.

use subsplat_test_support::cpu_against_gpu::{Random, assert_matches_cpu};
use subsplat_test_support::gather::base;
use subsplat_test_support::gpu::gpu;

use candle_core::{DType, Device, Result, Tensor};
use glam::{Mat4, Quat, Vec3};
use std::sync::Arc;
use subsplat::network::config::MaskMode;
use subsplat::network::model::Backend;
use subsplat::network::model::geometry::Frames;
use subsplat::network::ops::activation::Activation;
use subsplat::network::ops::attention::Labels;
use subsplat::network::ops::attributes::Attributes;
use subsplat::network::ops::plane_sweep::{Sweep, pair, relative_pose};
use subsplat::network::ops::small::{Candidates, MeanOver, SmallArray, Start};
use subsplat::network::ops::{Array, ConvConfig, Executor};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::MuInput;

/// Tolerance: sums of at most 2,000 products in another order, and elementary functions of the
/// device, which are exact to 3 units in the last place.
const TOLERANCE: f32 = 4e-6;

/// Tolerance of copies: no number may differ, but the comparison perturbs by an amount that f32
/// resolves.
const COPIED: f32 = 3e-7;

pub(super) fn executor() -> Option<Arc<Executor>> {
    Executor::new(&Backend::from(gpu()?))
}

/// Tensor of numbers in ±2.
pub(super) fn noise(r: &mut Random, dims: &[usize]) -> Tensor {
    let values = r.many(dims.iter().product(), -2.0, 2.0);
    Tensor::from_vec(values, dims, &Device::Cpu).unwrap()
}

pub(super) fn values(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

/// Returns the tensor of `f`.
fn made(f: impl FnOnce() -> Result<Tensor>) -> Tensor {
    f().unwrap()
}

/// Compares `$body` of tensors with `$body` of the same arrays in device memory.
macro_rules! agree {
    ($gpu:expr, $name:expr, $tolerance:expr, |$($x:ident),+| $body:expr) => {{
        let expected = made(|| {
            $(let $x = &$x;)+
            $body
        });
        let got = made(|| {
            $(let $x = &$gpu.upload(&$x)?;)+
            let result: Result<_> = $body;
            result?.to_host()
        });
        assert_eq!(got.dims(), expected.dims(), "{}", $name);
        assert_matches_cpu($name, &values(&got), &values(&expected), $tolerance);
    }};
}

#[test]
fn elementwise_functions() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(3);
    let (x, y) = (noise(r, &[3, 5, 7, 9]), noise(r, &[3, 5, 7, 9]));
    let (row, map) = (noise(r, &[1, 5, 1, 1]), noise(r, &[3, 1, 7, 9]));
    agree!(gpu, "affine", TOLERANCE, |x| x.affine(-1.5, 0.25));
    agree!(gpu, "abs", TOLERANCE, |x| Array::abs(x));
    agree!(gpu, "sqr", TOLERANCE, |x| Array::sqr(x));
    agree!(gpu, "recip", TOLERANCE, |x| Array::recip(x));
    agree!(gpu, "clamp", TOLERANCE, |x| Array::clamp(x, -0.5, 1.25));
    agree!(gpu, "add", TOLERANCE, |x, y| Array::add(x, y));
    agree!(gpu, "add row", TOLERANCE, |x, row| Array::add(x, row));
    agree!(gpu, "add, relu", TOLERANCE, |x, row| x.add_activation(row, Activation::Relu));
    agree!(gpu, "sub map", TOLERANCE, |x, map| Array::sub(x, map));
    agree!(gpu, "mul row", TOLERANCE, |x, row| Array::mul(x, row));
    agree!(gpu, "div", TOLERANCE, |x, y| Array::div(x, y));
    for kind in [Activation::Relu, Activation::Silu, Activation::Gelu, Activation::Sigmoid] {
        agree!(gpu, &format!("{kind:?}"), TOLERANCE, |x| x.affine(4.0, 0.0)?.activate(kind));
    }
    let large =
        Tensor::new(&[-200f32, -20.0, -1e-3, 0.0, 1e-3, 20.0, 200.0], &Device::Cpu).unwrap();
    for kind in [Activation::Silu, Activation::Gelu, Activation::Sigmoid] {
        agree!(gpu, &format!("{kind:?} far out"), TOLERANCE, |large| large.activate(kind));
    }
    let nan = Tensor::new(&[f32::NAN, 1.0], &Device::Cpu).unwrap();
    let clamped = gpu.upload(&nan).unwrap().clamp(0.0, 2.0).unwrap();
    assert!(values(&clamped.to_host().unwrap())[0].is_nan(), "a clamp hides NaN");
}

#[test]
fn parts_and_orders() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(4);
    let (x, y) = (noise(r, &[2, 6, 4, 8]), noise(r, &[2, 3, 4, 8]));
    let small = noise(r, &[2, 3, 2, 4]);
    agree!(gpu, "reshape", COPIED, |x| x.reshape((12, ())));
    agree!(gpu, "narrow 1", COPIED, |x| x.narrow(1, 2, 3));
    agree!(gpu, "narrow 3", COPIED, |x| x.narrow(3, 1, 5));
    // The second picture begins at a multiple of 256 bytes, so that memory is shared; the third
    // row of 8 numbers does not.
    agree!(gpu, "narrow 0", COPIED, |x| x.narrow(0, 1, 1)?.affine(2.0, 0.0));
    agree!(gpu, "part of a part", COPIED, |x| {
        x.narrow(0, 1, 1)?.reshape((24, 8))?.narrow(0, 3, 2)?.affine(2.0, 0.0)
    });
    agree!(gpu, "a shared part is read", COPIED, |x| x.narrow(0, 1, 1));
    agree!(gpu, "permute", COPIED, |x| Array::permute(x, &[2, 0, 3, 1]));
    agree!(gpu, "index select", COPIED, |x| Array::index_select(x, &[5, 0, 0, 2], 1));
    agree!(gpu, "cat", COPIED, |x, y| Array::cat(&[y, x, y], 1));
    agree!(gpu, "cat 0", COPIED, |x| Array::cat(&[x, x], 0));
    agree!(gpu, "upsample nearest", COPIED, |x| Array::upsample_nearest2d(x, 3));
    agree!(gpu, "cat upsampled", COPIED, |x, small| x.cat_upsampled(small, 2));
    agree!(gpu, "channels last", COPIED, |x| x.channels_last());
    for padding in [1, 3] {
        agree!(gpu, "replication pad", COPIED, |x| x.replication_pad2d(padding));
    }
    let (a, b, c) = (noise(r, &[7, 2]), noise(r, &[7, 5]), noise(r, &[7, 1]));
    agree!(gpu, "cat columns", COPIED, |a, b, c| a.cat_columns(b, Some(c)));
    agree!(gpu, "average pool", TOLERANCE, |x| Array::avg_pool2d(x, 2));
    agree!(gpu, "sum", TOLERANCE, |x| Array::sum(x, 1));
    agree!(gpu, "mean", TOLERANCE, |x| Array::mean(x, 2));
    for dim in [1, 3] {
        agree!(gpu, "max", COPIED, |x| Array::max_keepdim(x, dim));
    }
}

/// (channels, outputs, height, width, kernel, stride, padding): parts of tiles on every side, strides
/// that leave pixels out, several parts of the pixels.
pub const CONVOLUTIONS: [(usize, usize, usize, usize, usize, usize, usize); 6] = [
    (3, 70, 37, 41, 3, 1, 1),
    (5, 9, 36, 20, 5, 2, 2),
    (4, 6, 9, 12, 3, 2, 1),
    (17, 130, 9, 16, 1, 1, 0),
    (3, 16, 32, 32, 7, 2, 3),
    (1, 1, 8, 9, 3, 1, 0),
];

#[test]
fn products() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(5);
    for (c, o, h, w, k, stride, padding) in CONVOLUTIONS {
        let (x, weight, bias) = (noise(r, &[2, c, h, w]), noise(r, &[o, c, k, k]), noise(r, &[o]));
        let steps = ConvConfig { stride, padding };
        let name = format!("convolution {c} {o} {k}");
        agree!(gpu, &name, TOLERANCE, |x, weight, bias| Array::conv2d(
            x,
            weight,
            Some(bias),
            steps,
            None
        ));
        agree!(gpu, &name, TOLERANCE, |x, weight| Array::conv2d(x, weight, None, steps, None));
        let gelu = Some(Activation::Gelu);
        agree!(gpu, &name, TOLERANCE, |x, weight| Array::conv2d(x, weight, None, steps, gelu));
    }
    let (x, weight, bias) =
        (noise(r, &[2, 4, 6, 9, 10]), noise(r, &[3, 4, 3, 3, 3]), noise(r, &[3]));
    let steps = ConvConfig { stride: 1, padding: 1 };
    agree!(gpu, "3-D", TOLERANCE, |x, weight, bias| Array::conv3d(
        x,
        weight,
        Some(bias),
        steps,
        None
    ));
    for (n, c, o) in [(1, 1, 1), (130, 67, 70), (64, 128, 64), (300, 11, 5)] {
        let (x, weight, bias) = (noise(r, &[n, c]), noise(r, &[o, c]), noise(r, &[o]));
        agree!(gpu, "linear", TOLERANCE, |x, weight, bias| x.linear(weight, Some(bias), None));
        agree!(gpu, "linear", TOLERANCE, |x, weight| x.linear(weight, None, None));
        let silu = Some(Activation::Silu);
        agree!(gpu, "linear", TOLERANCE, |x, weight| x.linear(weight, None, silu));
    }
    let (x, weights) = (noise(r, &[2, 30, 13]), noise(r, &[2, 13]));
    agree!(gpu, "weighted sum", TOLERANCE, |x, weights| x.weighted_sum(weights));
    let wrong = gpu.upload(&noise(r, &[4, 5, 3, 3])).unwrap();
    let x = gpu.upload(&noise(r, &[1, 4, 8, 8])).unwrap();
    let text = x.conv2d(&wrong, None, steps, None).unwrap_err().to_string();
    assert!(text.contains("convolution") && text.contains("[4, 5, 3, 3]"), "{text}");
}

#[test]
fn norms_and_softmax() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(6);
    // Rows of 3 parts, of less than one, and far from zero.
    for (c, h, w) in [(8, 96, 100), (16, 5, 7), (24, 16, 16)] {
        let x = noise(r, &[2, c, h, w]).affine(1.0, 7.0).unwrap();
        let (weight, bias) = (noise(r, &[c]), noise(r, &[c]));
        let residual = noise(r, &[2, c, h, w]);
        for activation in [None, Some(Activation::Silu), Some(Activation::Gelu)] {
            agree!(gpu, "group norm", 1e-5, |x, weight, bias| {
                x.group_norm(4, [weight, bias], activation, None)
            });
            agree!(gpu, "group norm and residual", 1e-5, |x, weight, bias, residual| {
                x.group_norm(4, [weight, bias], activation, Some(residual))
            });
        }
        agree!(gpu, "instance norm", 1e-5, |x| x.instance_norm(Some(Activation::Relu)));
        agree!(gpu, "instance norm", 1e-5, |x| x.instance_norm(None));
    }
    let x = gpu.upload(&noise(r, &[2, 8, 3, 4])).unwrap();
    let [ones, other] = [&[8][..], &[2, 8, 4, 3]].map(|dims| gpu.upload(&noise(r, dims)).unwrap());
    let text = x.group_norm(4, [&ones, &ones], None, Some(&other)).unwrap_err().to_string();
    assert!(text.contains("residual") && text.contains("[2, 8, 4, 3]"), "{text}");
    for c in [7, 64, 192] {
        let (x, weight, bias) = (noise(r, &[130, c]), noise(r, &[c]), noise(r, &[c]));
        let residual = noise(r, &[130, c]);
        agree!(gpu, "layer norm", 1e-5, |x, weight, bias| x.layer_norm([weight, bias], None));
        agree!(gpu, "layer norm and residual", 1e-5, |x, weight, bias, residual| {
            x.layer_norm([weight, bias], Some(residual))
        });
        agree!(gpu, "layer norm of a sum", 1e-5, |x, weight, bias, residual| {
            x.add_layer_norm(residual, [weight, bias])
        });
        agree!(gpu, "softmax", TOLERANCE, |x| x.affine(10.0, 0.0)?.softmax());
    }
}

#[test]
fn resizes() {
    let Some(gpu) = executor() else { return };
    let x = noise(&mut Random(7), &[2, 3, 5, 9]);
    for size in [[5, 9], [20, 36], [1, 1], [7, 4], [64, 33]] {
        for activation in [None, Some(Activation::Gelu)] {
            agree!(gpu, &format!("{size:?}"), TOLERANCE, |x| Array::upsample_bilinear2d(
                x, size, activation
            ));
        }
    }
    let line = noise(&mut Random(8), &[1, 2, 1, 4]);
    agree!(gpu, "one row", TOLERANCE, |line| Array::upsample_bilinear2d(line, [3, 8], None));
}

#[test]
fn attention() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(9);
    // (rows, queries, keys, width, values): parts of tiles.
    for (rows, l, m, d, e) in [(4, 37, 70, 24, 24), (2, 64, 64, 128, 128), (3, 1, 5, 3, 40)] {
        let (q, k, v) = (noise(r, &[rows, l, d]), noise(r, &[rows, m, d]), noise(r, &[rows, m, e]));
        agree!(gpu, "attention", TOLERANCE, |q, k, v| q.attention(k, v, 0.4, None));
    }
    let (q, k, v) = (noise(r, &[4, 33, 16]), noise(r, &[4, 66, 16]), noise(r, &[4, 66, 16]));
    let label = |n: usize, step: usize| (0..n).map(|i| (i / step % 3) as u8).collect::<Vec<_>>();
    let labels = Labels { windows: 2, queries: label(66, 7), keys: label(132, 5) };
    agree!(gpu, "labels", TOLERANCE, |q, k, v| q.attention(k, v, 0.4, Some(labels.clone())));
    let (x, message) = (noise(r, &[70, 16]), noise(r, &[70, 16]));
    let (up, down) = (noise(r, &[64, 32]), noise(r, &[16, 64]));
    let (scale, shift) = (noise(r, &[16]), noise(r, &[16]));
    agree!(gpu, "feed forward", 1e-5, |x, message, up, down, scale, shift| {
        x.feed_forward(message, [up, down], [scale, shift])
    });
}

pub(super) fn cameras(size: [usize; 2], count: usize) -> Vec<Camera> {
    let [h, w] = size;
    let focal = w as f32;
    let k = Intrinsics {
        fx: focal,
        fy: focal,
        cx: w as f32 / 2.0,
        cy: h as f32 / 2.0,
        width: w,
        height: h,
    };
    let pose = |i: usize| {
        let turn = Quat::from_rotation_y(0.05 * i as f32);
        Mat4::from_rotation_translation(turn, Vec3::new(0.3 * i as f32, 0.02, 0.0))
    };
    (0..count).map(|i| Camera::new(k, pose(i)).unwrap()).collect()
}

#[test]
fn views_are_compared() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(10);
    let ([h, w], d) = ([24, 32], 6);
    let all = vec![cameras([h, w], 3)];
    let images =
        Tensor::from_vec(r.many(9 * h * w, 0.0, 1.0), (1, 3, 3, h, w), &Device::Cpu).unwrap();
    let disparities = vec![vec![(0..d).map(|i| 0.2 + 0.15 * i as f32).collect::<Vec<f32>>(); 3]];
    let rows = [[0, 1], [1, 2], [2, 0]];
    // Variances are differences of mean squares, which cancel.
    agree!(gpu, "raw matching", 5e-4, |images| images.raw_matching(&all, &disparities, &rows));
    let distances =
        Tensor::from_vec(r.many(3 * h * w, 1.5, 4.0), (1, 3, h * w, 1), &Device::Cpu).unwrap();
    agree!(gpu, "cross-check", 1e-4, |images, distances| images.cross_check(&all, distances));
    let confidences =
        Tensor::from_vec(r.many(3 * h * w, 0.0, 1.0), (1, 3, h * w, 1), &Device::Cpu).unwrap();
    let ranges = vec![vec![NearFar { near: 1.0, far: 4.0 }; 3]];
    agree!(gpu, "depth consensus", 1e-4, |images, distances, confidences| {
        images.depth_consensus(&all, &ranges, [distances, confidences])
    });
    let features = noise(r, &[3, 8, h / 4, w / 4]);
    let small = cameras([h / 4, w / 4], 3);
    let line = |[i, j]: [usize; 2]| {
        let relative = relative_pose(&small[i], &small[j]);
        vec![pair(&small[i].intrinsics(), &small[j].intrinsics(), relative, j).unwrap()]
    };
    let sweep = Sweep {
        pairs: rows.map(line).to_vec(),
        depths: disparities[0].iter().map(|d| d.iter().map(|d| 1.0 / d).collect()).collect(),
        centre: 0.5,
        min_z: 1e-3,
        scale: 1.0,
        channels: 8,
        size: [h / 4, w / 4],
    };
    agree!(gpu, "plane sweep", 1e-5, |features| {
        features.plane_sweep(features, sweep.clone(), &Backend::Cpu)
    });
}

#[test]
fn parts_of_the_small_backbone() {
    let Some(gpu) = executor() else { return };
    let r = &mut Random(11);
    let x = noise(r, &[2, 13, 6, 8]);
    agree!(gpu, "normalize channels", TOLERANCE, |x| x.normalize_channels());
    for (window, mean) in [(2, MeanOver::Window), (1, MeanOver::All)] {
        agree!(gpu, "expected candidate", 1e-5, |x| Ok(x.expectation(window, mean)?[0].clone()));
        agree!(gpu, "mass", 1e-5, |x| Ok(x.expectation(window, mean)?[1].clone()));
    }
    let scores = noise(r, &[2, 13, 6, 8]);
    let factor = Tensor::new(&[0.7f32], &Device::Cpu).unwrap();
    agree!(gpu, "add scores", TOLERANCE, |x, scores| x.add_scores(scores, &factor));
    let (masks, index) = (noise(r, &[2, 144, 6, 8]), noise(r, &[2, 1, 6, 8]));
    let confidence = noise(r, &[2, 1, 6, 8]);
    let start = r.many(144, 0.01, 1.0);
    for i in 0..2 {
        agree!(gpu, "convex upsampling", 1e-5, |masks, index, confidence| {
            Ok(masks.upsample_convex([index, confidence], &start)?[i].clone())
        });
    }
    let (rgb, fine) = (noise(r, &[2, 3, 12, 16]), noise(r, &[2, 1, 12, 16]));
    agree!(gpu, "head input", TOLERANCE, |x, rgb, fine| x.head_input(rgb, [fine, fine], 0.05));
    let output = noise(r, &[2, 13, 12, 16]);
    let starts = [
        Start {
            row: r.many(12, -1.0, 1.0),
            colour: Some(([9, 10, 11], 3.5, -1.7)),
            confident: true,
        },
        Start { row: r.many(12, -1.0, 1.0), colour: None, confident: false },
    ];
    for start in starts {
        for i in 0..2 {
            agree!(gpu, "head output", TOLERANCE, |output, fine, rgb| {
                Ok(output.head_output(fine, rgb, start.clone())?[i].clone())
            });
        }
    }
    let ranges = vec![Candidates { low: 0.1, step: 0.2 }, Candidates { low: 0.3, step: 0.1 }];
    let lengths = r.many(2 * 12 * 16, 1.0, 2.0);
    agree!(gpu, "ray distance", TOLERANCE, |fine| {
        Array::abs(fine)?.ray_distance(ranges.clone(), lengths.clone())
    });
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
        row[7..10].iter_mut().for_each(|s| *s = 1e-3 + s.abs());
        row[10] = [0.0, 1.0, 0.5 + 0.4 * row[10]][i % 3];
    }
    let rows = Tensor::from_vec(rows, (n, 11), &Device::Cpu).unwrap();
    let all = cameras([24, 32], 2);
    let frames = Frames::new(&all, DType::F32, &Device::Cpu).unwrap();
    let [first, second] = [frames.0[0].numbers(), frames.0[1].numbers()];
    let rules = Attributes {
        frame: Some(second),
        source: first,
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
        agree!(gpu, "attributes", TOLERANCE, |rows| rows.attributes(rules));
    }
    for mask in [MaskMode::Renorm, MaskMode::PgClamp] {
        for i in 0..2 {
            agree!(gpu, "projected points", 1e-5, |rows| {
                let (at, z) = frames.project(&rows.narrow(1, 0, 3)?.reshape((n, 1, 3))?, mask)?;
                if i == 0 { at.reshape((n, 2, 2)) } else { z.reshape((n, 2, 1)) }
            });
        }
    }
    let places = Tensor::from_vec(r.many(4 * n, -0.2, 1.2), (n, 2, 2), &Device::Cpu).unwrap();
    let z = Tensor::from_vec(r.many(2 * n, -0.2, 3.0), (n, 2), &Device::Cpu).unwrap();
    let maps = Tensor::from_vec(r.many(2 * 6 * 8, 0.5, 3.0), (2, 6, 8), &Device::Cpu).unwrap();
    agree!(gpu, "occlusion", 2e-5, |places, z, maps| places.occlusion_gate(z, maps));
    let row = noise(r, &[1, 5]);
    agree!(gpu, "broadcast", COPIED, |row| Array::broadcast_as(row, &[7, 5]));
    let gather = base();
    let maps = noise(r, &[70, gather.stride]);
    let query = noise(r, &[n, gather.query_width()]);
    let points = Tensor::from_vec(r.many(4 * n, -0.2, 1.2), (n, 2, 1, 2), &Device::Cpu).unwrap();
    agree!(gpu, "gather", 1e-5, |maps, query, points| {
        maps.attention_gather(query, points, gather.clone(), None, None, &Backend::Cpu)
    });
    let residual = noise(r, &[n, gather.dim]);
    agree!(gpu, "gather and residual", 1e-5, |maps, query, points, residual| {
        let (gather, residual) = (gather.clone(), Some(residual));
        maps.attention_gather(query, points, gather, None, residual, &Backend::Cpu)
    });
    let text = gpu.upload(&noise(r, &[3, 11])).unwrap();
    let text = text
        .attention_gather(&text, &text, gather, None, None, &Backend::Cpu)
        .unwrap_err()
        .to_string();
    assert!(text.contains("attention_gather"), "{text}");
}

/// More calls than one submit holds, with memory that returns to the pool between them.
#[test]
fn memory_is_used_again() {
    let Some(gpu) = gpu() else { return };
    let executor = Executor::new(&Backend::from(gpu.clone())).unwrap();
    let x = noise(&mut Random(12), &[1, 4, 64, 64]);
    gpu.trim();
    let before = gpu.allocated_bytes();
    let mut y = executor.upload(&x).unwrap();
    for i in 0..2000 {
        y = y.affine(1.0, if i % 2 == 0 { 0.5 } else { -0.5 }).unwrap();
    }
    let got = values(&y.to_host().unwrap());
    assert_matches_cpu("2000 calls", &got, &values(&x), 1e-4);
    // 2000 results of 64 KiB would be 125 MiB.
    let used = gpu.allocated_bytes().saturating_sub(before);
    assert!(used < 16 << 20, "{used} bytes");
}
