//! The whole network: a training step of the small backbone and inference of both.

mod common;

use anyhow::Result;
use candle_core::{Device, Tensor};
use common::{Bench, Contender, Threads, inputs, scene};
use std::time::Instant;
use subsplat::config::Small;
use subsplat::model::Views;
use subsplat::model::backbone::SmallBackbone;
use subsplat::model::weights::Weights;

fn views(batch: usize, side: usize) -> Result<Views> {
    let cameras = scene::views(side).to_vec();
    let images = (inputs::tensor(&[batch, 2, 3, side, side], 0.2, 7)? + 0.5)?.clamp(0.0, 1.0)?;
    Ok(Views::new(images, vec![cameras; batch], vec![vec![(1.0, 100.0); 2]; batch])?)
}

fn main() -> Result<()> {
    let mut bench = Bench::new("network")?;
    let weights = Weights::seeded(3).trainable();
    let net = SmallBackbone::new(&Small::standard(), weights.builder().pp("small"))?;
    for (n, var) in weights.variables().values().enumerate() {
        let nudge = inputs::tensor(var.dims(), 0.02, n as u64)?;
        var.set(&(var.as_tensor() + nudge)?)?;
    }
    let v = views(4, 128)?;
    let step = || -> Result<()> {
        let t = Instant::now();
        let (out, maps) = net.forward(&v, true)?;
        let a = t.elapsed();
        let loss = (((out.raw.sqr()?.mean_all()? + out.depths.recip()?.mean_all()?)?
            + out.densities.sqr()?.mean_all()?)?
            + (maps.logits.sqr()?.mean_all()? + maps.index.sqr()?.mean_all()?)?)?;
        let b = t.elapsed();
        let g = loss.backward()?;
        std::hint::black_box(&g);
        let c = t.elapsed();
        if std::env::var("V").is_ok() {
            eprintln!("fwd {:?} loss {:?} bwd {:?}", a, b - a, c - b);
        }
        Ok(())
    };
    bench.group(
        "small training step 128 batch 4",
        vec![Contender::new("ours", Threads::All, step)],
        "",
    )?;
    bench.finish()
}
