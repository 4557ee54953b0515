//! The fused plane sweep against a warp of all features to all depths and a dot product
//! (`common/conventional/sweep.rs`), at MVSplat's sizes.

mod common;

use anyhow::{Result, anyhow};
use candle_core::{Tensor, Var};
use common::conventional::sweep as plain;
use common::{Bench, Contender, Threads, Work, agree, inputs, scene};
use subsplat::network::ops::plane_sweep::{Sweep, plane_sweep};

/// Two 256² pictures with features at a quarter of the resolution: (side, channels, candidates).
const SIZE: (usize, usize, usize) = (64, 128, 128);
/// The same with `--quick`.
const SIZE_QUICK: (usize, usize, usize) = (32, 32, 32);
/// Tolerance: f32 rounding of sums over 128 channels.
const TIGHT: [f32; 3] = [2e-5, 1e-4, 1e-4];

fn main() -> Result<()> {
    let mut bench = Bench::new("sweep")?;
    let (side, channels, depths) = if bench.args.quick { SIZE_QUICK } else { SIZE };
    let case = Case {
        sweep: inputs::sweep(&scene::views(side), side, channels, depths)?,
        features: inputs::tensor(&[2, channels, side, side], 1.0, 90)?,
        weights: inputs::tensor(&[2, depths, side, side], 1.0, 91)?,
    };
    let name = |pass: &str| format!("sweep {pass} {side}x{side} C={channels} D={depths}");
    if bench.selects(&name("forward")) {
        forward(&mut bench, &name("forward"), &case)?;
    }
    if bench.selects(&name("backward")) {
        backward(&mut bench, &name("backward"), &case)?;
    }
    bench.finish()
}

struct Case {
    sweep: Sweep,
    /// `[2, C, h, w]`.
    features: Tensor,
    /// `[2, D, h, w]`: gradient of the loss for the backward passes.
    weights: Tensor,
}

fn host(t: &Tensor) -> Result<Vec<f32>> {
    Ok(t.flatten_all()?.to_vec1()?)
}

impl Case {
    fn fused(&self) -> Result<Tensor> {
        Ok(plane_sweep(&self.features, &self.features, self.sweep.clone())?)
    }

    fn fused_gradient(&self) -> Result<Tensor> {
        let features = Var::from_tensor(&self.features)?;
        let y = plane_sweep(&features, &features, self.sweep.clone())?;
        let grads = y.mul(&self.weights)?.sum_all()?.backward()?;
        grads.get(&features).cloned().ok_or_else(|| anyhow!("no gradient"))
    }

    fn work(&self) -> Work {
        let (features, out) = (self.features.elem_count(), self.weights.elem_count());
        // Reference and source are one tensor; four taps of C multiply-adds each.
        let flops = 8.0 * (out * self.sweep.channels) as f64;
        Work { bytes: 4.0 * (2 * features + out) as f64, flops }
    }
}

fn forward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let features = host(&case.features)?;
    let warped = || plain::correlation(&case.sweep, &features, &features);
    agree(name, &host(&case.fused()?)?, &warped(), TIGHT)?;
    let mut contenders = Vec::new();
    for threads in [Threads::One, Threads::All] {
        contenders.push(Contender::new("warp, then dot", threads, || {
            std::hint::black_box(warped());
            Ok(())
        }));
    }
    for threads in [Threads::One, Threads::All] {
        let run = || case.fused().map(drop);
        contenders.push(Contender::new("fused", threads, run).with_work(case.work()));
    }
    bench.group(name, contenders, "")
}

fn backward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let (features, weights) = (host(&case.features)?, host(&case.weights)?);
    let warped = || {
        let (reference, source) = plain::backward(&case.sweep, &features, &features, &weights);
        // The features are reference and source.
        reference.iter().zip(&source).map(|(a, b)| a + b).collect::<Vec<f32>>()
    };
    let fused = case.fused_gradient();
    let mut note = "forward and backward".to_owned();
    match &fused {
        Ok(fused) => agree(name, &host(fused)?, &warped(), [1e-4, 1e-3, 1e-4])?,
        Err(e) => note = format!("{note}; {e}"),
    }
    let mut contenders = Vec::new();
    for threads in [Threads::One, Threads::All] {
        contenders.push(Contender::new("warp, then dot", threads, || {
            std::hint::black_box(plain::correlation(&case.sweep, &features, &features));
            std::hint::black_box(warped());
            Ok(())
        }));
    }
    if fused.is_ok() {
        for threads in [Threads::One, Threads::All] {
            let run = || case.fused_gradient().map(drop);
            contenders.push(Contender::new("fused", threads, run));
        }
    }
    bench.group(name, contenders, &note)
}
