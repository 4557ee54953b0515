//! The fused attention gather against a composition of `index_select`, weighted sums and softmax
//! in candle.

mod common;

use anyhow::{Result, anyhow, ensure};
use candle_core::{Tensor, Var};
use common::conventional::attention::{Size, gather as plain};
use common::inputs::Attention;
use common::{Bench, Contender, Threads, Work, agree};
use subsplat::network::ops::attention_gather::attention_gather;

/// The paper's E.
const DIM: usize = 128;
/// Side of the two input pictures, px: forward, backward. The composition keeps about 40 tensors
/// of N·2·2E floats for its backward pass, so the backward picture is smaller.
const SIDES: [usize; 2] = [256, 128];
/// The same with `--quick`.
const SIDES_QUICK: [usize; 2] = [64, 32];
/// Queries per call of the composition's forward pass: its tensors fit the caches.
const CHUNK: usize = 4096;
/// Tolerance: f32 rounding of sums over 128 channels.
const TIGHT: [f32; 3] = [2e-5, 1e-4, 1e-4];

fn main() -> Result<()> {
    let mut bench = Bench::new("attention")?;
    let sides = if bench.args.quick { SIDES_QUICK } else { SIDES };
    for (pass, side) in [("forward", sides[0]), ("backward", sides[1])] {
        let name = format!("attention {pass} {side}");
        if bench.selects(&name) {
            let case = Attention::new(side, DIM)?;
            match pass {
                "forward" => forward(&mut bench, &name, &case)?,
                _ => backward(&mut bench, &name, &case)?,
            }
        }
    }
    bench.finish()
}

fn host(t: &Tensor) -> Result<Vec<f32>> {
    Ok(t.flatten_all()?.to_vec1()?)
}

fn size(a: &Attention) -> Size {
    let level = a.gather.levels[0];
    Size {
        views: a.gather.views,
        map: [level.height, level.width],
        dim: a.gather.dim,
        scale: a.gather.logit_scale,
    }
}

/// The composition on packed query rows.
fn composed(a: &Attention, maps: &Tensor, query: &Tensor, points: &Tensor) -> Result<Tensor> {
    let (e, v) = (a.gather.dim, a.gather.views);
    let part = |from: usize, n: usize| query.narrow(1, from, n);
    let (q, bias, gate) = (part(0, e)?, part(e, v)?, part(e + v, v)?);
    Ok(plain(maps, &q, &bias, &gate, points, size(a))?)
}

fn work(a: &Attention) -> Result<Work> {
    let (n, e, v) = (a.query.dim(0)? as f64, a.gather.dim as f64, a.gather.views as f64);
    // Query, bias, gate, points, output; maps once.
    let floats = n * (2.0 * e + 4.0 * v) + a.maps.elem_count() as f64;
    // Four taps a view: a dot product with the key, a multiple of the value.
    Ok(Work { bytes: 4.0 * floats, flops: n * v * 4.0 * e * 4.0 })
}

fn forward(bench: &mut Bench, name: &str, a: &Attention) -> Result<()> {
    let query = a.packed_query()?;
    let n = query.dim(0)?;
    let fused = || Ok(attention_gather(&a.maps, &query, &a.points, a.gather.clone())?);
    let chunks = || -> Result<Vec<Tensor>> {
        let starts = (0..n).step_by(CHUNK);
        let parts = starts.map(|from| {
            let rows = CHUNK.min(n - from);
            composed(a, &a.maps, &query.narrow(0, from, rows)?, &a.points.narrow(0, from, rows)?)
        });
        parts.collect()
    };
    let fused_check: Result<Tensor> = fused();
    agree(name, &host(&fused_check?)?, &host(&Tensor::cat(&chunks()?, 0)?)?, TIGHT)?;
    let mut contenders = Vec::new();
    for threads in [Threads::One, Threads::All] {
        contenders.push(Contender::new("candle graph", threads, || chunks().map(drop)));
    }
    for threads in [Threads::One, Threads::All] {
        let run = || {
            let out: Result<Tensor> = fused();
            out.map(drop)
        };
        contenders.push(Contender::new("fused", threads, run).with_work(work(a)?));
    }
    bench.group(name, contenders, &format!("{n} queries, {DIM} channels, 2 views"))
}

fn backward(bench: &mut Bench, name: &str, a: &Attention) -> Result<()> {
    let n = a.query.dim(0)?;
    let weights = common::inputs::tensor(&[n, a.gather.dim], 1.0, 80)?;
    let run = |fused: bool| -> Result<[Tensor; 3]> {
        let maps = Var::from_tensor(&a.maps)?;
        let query = Var::from_tensor(&a.packed_query()?)?;
        let points = Var::from_tensor(&a.points)?;
        let y = if fused {
            attention_gather(&maps, &query, &points, a.gather.clone())?
        } else {
            composed(a, &maps, &query, &points)?
        };
        let grads = y.mul(&weights)?.sum_all()?.backward()?;
        let get = |v: &Var| grads.get(v).cloned().ok_or_else(|| anyhow!("no gradient"));
        Ok([get(&maps)?, get(&query)?, get(&points)?])
    };
    let (fused, graph) = (run(true)?, run(false)?);
    for (i, what) in ["maps", "query", "points"].into_iter().enumerate() {
        ensure!(fused[i].dims() == graph[i].dims(), "{what}: shapes differ");
        agree(what, &host(&fused[i])?, &host(&graph[i])?, [1e-4, 1e-3, 1e-4])?;
    }
    drop((fused, graph));
    let mut contenders = Vec::new();
    for (what, fused) in [("candle graph", false), ("fused", true)] {
        for threads in [Threads::One, Threads::All] {
            contenders.push(Contender::new(what, threads, move || run(fused).map(drop)));
        }
    }
    bench.group(name, contenders, &format!("{n} queries, forward and backward"))
}
