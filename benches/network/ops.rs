//! Single operators at MVSplat's sizes for two 256² pictures, against onnxruntime.

use super::rival::{Rival, median, timed};
use crate::common::{Bench, agree, inputs};
use anyhow::{Context, Result};
use candle_core::{Device, Tensor};
use std::collections::HashMap;
use subsplat::network::model::layers;
use subsplat::network::model::layers::Activation;
use subsplat::network::ops::attention::attention;
use subsplat::network::ops::cat::cat_upsampled;
use subsplat::network::ops::linear::linear_no_bias;
use subsplat::network::ops::norm;

type Run = fn(&HashMap<String, Tensor>) -> candle_core::Result<Tensor>;

struct Case {
    /// The first word is the operator, which `tools/bench/rival.py` builds in onnxruntime.
    name: &'static str,
    /// (name, shape).
    inputs: &'static [(&'static str, &'static [usize])],
    run: Run,
}

/// The factors and summands of a normalisation.
fn affine(t: &HashMap<String, Tensor>) -> norm::Affine<'_> {
    norm::Affine { weight: &t["w"], bias: &t["b"] }
}

/// Every operator of MVSplat except convolutions, at its largest and at its most frequent size.
const CASES: [Case; 15] = [
    Case {
        name: "instance_norm_relu 2x64x128x128",
        inputs: &[("x", &[2, 64, 128, 128])],
        run: |t| layers::instance_norm_relu(&t["x"]),
    },
    Case {
        name: "group_norm_silu 2x128x64x64",
        inputs: &[("x", &[2, 128, 64, 64]), ("w", &[128]), ("b", &[128])],
        run: |t| norm::group_norm_then(&t["x"], 8, affine(t), Some(Activation::Silu)),
    },
    Case {
        name: "group_norm_silu 2x32x256x256",
        inputs: &[("x", &[2, 32, 256, 256]), ("w", &[32]), ("b", &[32])],
        run: |t| norm::group_norm_then(&t["x"], 8, affine(t), Some(Activation::Silu)),
    },
    Case {
        name: "layer_norm 8192x128",
        inputs: &[("x", &[8192, 128]), ("w", &[128]), ("b", &[128])],
        run: |t| norm::layer_norm(&t["x"], &t["w"], &t["b"]),
    },
    Case {
        name: "gelu 8192x1024",
        inputs: &[("x", &[8192, 1024])],
        run: |t| layers::gelu(&t["x"]),
    },
    Case {
        name: "gelu 1x168x256x256",
        inputs: &[("x", &[1, 168, 256, 256])],
        run: |t| layers::gelu(&t["x"]),
    },
    Case {
        name: "softmax 8192x128",
        inputs: &[("x", &[8192, 128])],
        run: |t| layers::softmax(&t["x"]),
    },
    Case {
        name: "softmax 4096x1024",
        inputs: &[("x", &[4096, 1024])],
        run: |t| layers::softmax(&t["x"]),
    },
    Case {
        name: "linear 8192x256 to 1024",
        inputs: &[("x", &[8192, 256]), ("w", &[1024, 256])],
        run: |t| linear_no_bias(&t["x"], &t["w"]),
    },
    Case {
        name: "linear 8192x128 to 128",
        inputs: &[("x", &[8192, 128]), ("w", &[128, 128])],
        run: |t| linear_no_bias(&t["x"], &t["w"]),
    },
    Case {
        name: "attention 8x1024x128",
        inputs: &[("q", &[8, 1024, 128]), ("k", &[8, 1024, 128]), ("v", &[8, 1024, 128])],
        run: |t| attention(&t["q"], &t["k"], &t["v"], 1.0 / 128f32.sqrt(), None),
    },
    Case {
        name: "bilinear 1x128x64x64 to 256",
        inputs: &[("x", &[1, 128, 64, 64])],
        run: |t| layers::resize_bilinear(&t["x"], 256, 256),
    },
    Case {
        name: "bilinear_gelu 1x128x64x64 to 256",
        inputs: &[("x", &[1, 128, 64, 64])],
        run: |t| layers::resize_bilinear_then(&t["x"], 256, 256, Activation::Gelu),
    },
    Case {
        name: "nearest 2x32x128x128 to 256",
        inputs: &[("x", &[2, 32, 128, 128])],
        run: |t| layers::upsample_nearest(&t["x"], 2),
    },
    Case {
        name: "cat 2x32x256x256 twice",
        inputs: &[("x", &[2, 32, 256, 256]), ("y", &[2, 32, 256, 256])],
        run: |t| cat_upsampled(&t["x"], &t["y"], 1),
    },
];

pub fn compare(bench: &mut Bench, rival: &Rival) -> Result<()> {
    let (mut files, mut cases) = (HashMap::new(), Vec::new());
    for (i, case) in CASES.iter().enumerate() {
        let mut tensors = HashMap::new();
        for (k, (name, shape)) in case.inputs.iter().enumerate() {
            let t = inputs::tensor(shape, 1.0, (200 + 10 * i + k) as u64)?;
            files.insert(format!("{}.{name}", case.name), t.clone());
            tensors.insert((*name).to_owned(), t);
        }
        cases.push((case, tensors));
    }
    let folder = rival.folder.path();
    candle_core::safetensors::save(&files, folder.join("ops.safetensors"))?;
    drop(files);
    let reply = rival.run(&["ops"])?;
    let theirs = candle_core::safetensors::load(folder.join("ops_out.safetensors"), &Device::Cpu)?;
    println!("\noperators, {} threads, median of {}", rival.threads, rival.runs);
    println!("  {:<36} {:>10} {:>10} {:>8}", "", "ours ms", "ort ms", "ratio");
    for (case, tensors) in &cases {
        let want = theirs.get(case.name).with_context(|| format!("rival: no {}", case.name))?;
        let seconds = reply.seconds.get(case.name).context("rival: no times")?;
        let got = bench.on_all(|| (case.run)(tensors))?;
        let list = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        agree(case.name, &list(&got)?, &list(want)?, [2e-5, 2e-4, 1e-4])?;
        let ours = bench.on_all(|| {
            timed(rival.runs, || {
                std::hint::black_box((case.run)(tensors)?);
                Ok(())
            })
        })?;
        let (ours, theirs) = (1e3 * median(&ours), 1e3 * median(seconds));
        println!("  {:<36} {ours:>10.2} {theirs:>10.2} {:>7.2}x", case.name, ours / theirs);
    }
    Ok(())
}
