//! Sub-pixel reparameterization and opacity redistribution, fused, against a graph of candle
//! tensor operations.

mod common;
use subsplat_test_support::spgr_reference;

use anyhow::Result;
use candle_core::{CpuStorage, CustomOp2, Layout, Shape, Storage, Tensor, Var};
use common::conventional::redistribute as plain;
use common::scene::{self, Spec};
use common::{Bench, Contender, Threads, Work, agree, inputs};
use rayon::prelude::*;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::spgr_heads::rules;
use subsplat::network::ops::redistribute::{OpacityRule, redistribute};
use subsplat::network::ops::spgr::{Spgr, spgr, spgr_into};
use subsplat_kernels::cpu::{redistribute as shares, spgr as kernel, sums};
use subsplat_kernels::layout::{HEAD_STRIDE, SPLAT_STRIDE};

/// The allocator of the programs.
#[path = "../tools/cli/src/pages.rs"]
#[allow(dead_code, reason = "its unit tests run with the programs")]
mod pages;

#[global_allocator]
static PAGES: pages::Pages = pages::Pages;

/// Side of the two input pictures, px: 131,072 parents, as for MVSplat at 256².
const SIDE: usize = 256;
/// The same with `--quick`.
const SIDE_QUICK: usize = 64;
/// Multiplications and additions of one child, 18 per elementary function: eleven functions,
/// quaternions 40, rotation 30, M 48, area and growth 35, opacity 20.
const FLOPS_PER_CHILD: f64 = 370.0;
/// The same for redistribution alone: two elementary functions and eight operations.
const FLOPS_PER_SHARE: f64 = 44.0;
/// Tolerance: f32 rounding through two chains of about 40 operations.
const TIGHT: [f32; 3] = [1e-4, 1e-2, 1e-4];

fn main() -> Result<()> {
    let mut bench = Bench::new("spgr")?;
    let side = if bench.args.quick { SIDE_QUICK } else { SIDE };
    for (preset, name) in [(Preset::Tuned, "tuned"), (Preset::Paper, "paper")] {
        for upscale in [2, 4] {
            let names = ["forward", "backward"].map(|p| format!("spgr {p} {name} x{upscale}"));
            if !names.iter().any(|n| bench.selects(n)) {
                continue;
            }
            let case = Case::new(side, preset, upscale)?;
            if bench.selects(&names[0]) {
                forward(&mut bench, &names[0], &case)?;
            }
            if bench.selects(&names[1]) {
                backward(&mut bench, &names[1], &case)?;
            }
        }
    }
    for (rule, name) in
        [(OpacityRule::Linear, "linear"), (OpacityRule::OpticalDepth, "optical-depth")]
    {
        for children in [4, 16] {
            for (pass, pass_name) in [(Pass::Forward, "forward"), (Pass::Both, "backward")] {
                let name = format!("redistribute {pass_name} {name} K={children}");
                if bench.selects(&name) {
                    redistribution(&mut bench, &name, rule, (2 * side * side, children), pass)?;
                }
            }
        }
    }
    bench.finish()
}

fn host(t: &Tensor) -> Result<Vec<f32>> {
    Ok(t.flatten_all()?.to_vec1()?)
}

/// Σ wᵢxᵢ over two tensors as one op, whose gradients are the weights. The cost of this loss is
/// negligible.
struct Dot([Tensor; 2]);

impl CustomOp2 for Dot {
    fn name(&self) -> &'static str {
        "dot"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let mut sum = 0.0;
        for ((x, layout), weights) in [(s1, l1), (s2, l2)].into_iter().zip(&self.0) {
            let (held, _) = weights.storage_and_layout();
            let (Storage::Cpu(held), Some((start, end))) = (&*held, layout.contiguous_offsets())
            else {
                candle_core::bail!("dot: expected contiguous tensors on the CPU, got {layout:?}")
            };
            let (x, w) = (&x.as_slice::<f32>()?[start..end], held.as_slice::<f32>()?);
            let chunks = x.par_chunks(1 << 14).zip(w.par_chunks(1 << 14));
            sum += chunks.map(|(x, w)| f64::from(sums::dot(x, w))).sum::<f64>();
        }
        Ok((CpuStorage::F32(vec![sum as f32]), Shape::from(())))
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        // The loss is the root of the graph: its own gradient is 1.
        let [a, b] = &self.0;
        Ok((Some(a.clone()), Some(b.clone())))
    }
}

/// Parents of two views and their head records.
struct Case {
    call: Spgr,
    head: Tensor,
    parents: Tensor,
    /// Weights of the loss of the backward passes.
    weights: [Tensor; 2],
}

type Op = fn(&Tensor, &Tensor, &Spgr) -> candle_core::Result<(Tensor, Tensor)>;
const GRAPH: Op = spgr_reference::spgr;
const FUSED: Op = spgr;

impl Case {
    fn new(side: usize, preset: Preset, upscale: usize) -> Result<Self> {
        let call = Spgr {
            rules: rules(&Config::re10k(preset, upscale), upscale),
            cameras: scene::views(side).to_vec(),
            near: vec![1.0; 2],
            per_view: side * side,
            first: 0,
        };
        let spec = Spec { name: "", grid: side, sigma_at: side, sigma_px: 1.0, side };
        let n = 2 * side * side;
        let rows = scene::shared(&spec).into_parts().rows;
        let parents = Tensor::from_vec(rows, (n, SPLAT_STRIDE), &candle_core::Device::Cpu)?;
        let (k, lanes) = (call.rules.children(), call.rules.gain_channels());
        let gains = if lanes == 1 { vec![n * k] } else { vec![n * k, lanes] };
        Ok(Self {
            head: inputs::tensor(&[n, k, HEAD_STRIDE], 0.3, 60)?,
            parents,
            weights: [
                inputs::tensor(&[n * k, SPLAT_STRIDE], 1.0, 61)?,
                inputs::tensor(&gains, 1.0, 62)?,
            ],
            call,
        })
    }

    fn children(&self) -> usize {
        self.call.per_view * 2 * self.call.rules.children()
    }

    /// Returns the gradients of head records and parents.
    fn gradients(&self, op: Op) -> Result<[Tensor; 2]> {
        let (head, parents) = (Var::from_tensor(&self.head)?, Var::from_tensor(&self.parents)?);
        let (rows, gains) = op(&head, &parents, &self.call)?;
        let grads = rows
            .contiguous()?
            .apply_op2(&gains.contiguous()?, Dot(self.weights.clone()))?
            .backward()?;
        let get = |v: &Var| grads.get(v).cloned().ok_or_else(|| anyhow::anyhow!("no gradient"));
        Ok([get(&head)?, get(&parents)?])
    }

    /// Returns the minimum work of forward and backward. The inputs are read twice more (each
    /// column of the head records, and the cache line of the gain once again). Gradients of the
    /// results are read and gradients of the inputs written. Children are computed three times,
    /// and their gradient costs as much as two.
    fn work_both(&self) -> Work {
        let Work { bytes, flops } = self.work();
        let head = 4.0 * self.children() as f64 * HEAD_STRIDE as f64;
        Work { bytes: 2.0 * bytes + 3.0 * head, flops: 5.0 * flops }
    }

    fn work(&self) -> Work {
        let n = self.children() as f64;
        let out = SPLAT_STRIDE + self.call.rules.gain_channels();
        let parent = SPLAT_STRIDE as f64 / self.call.rules.children() as f64;
        Work {
            bytes: 4.0 * n * (HEAD_STRIDE as f64 + parent + out as f64),
            flops: FLOPS_PER_CHILD * n,
        }
    }
}

fn forward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let (graph, fused) = (
        GRAPH(&case.head, &case.parents, &case.call)?,
        FUSED(&case.head, &case.parents, &case.call)?,
    );
    agree("children", &host(&fused.0)?, &host(&graph.0)?, TIGHT)?;
    agree("gains", &host(&fused.1)?, &host(&graph.1)?, TIGHT)?;
    let mut contenders = Vec::new();
    for threads in [Threads::One, Threads::All] {
        contenders.push(Contender::new("candle graph", threads, || {
            GRAPH(&case.head, &case.parents, &case.call)?;
            Ok(())
        }));
    }
    for threads in [Threads::One, Threads::All] {
        let mut rows = vec![0.0; case.children() * SPLAT_STRIDE];
        let mut gains = vec![0.0; case.children() * case.call.rules.gain_channels()];
        let run = move || {
            spgr_into(&case.head, &case.parents, &case.call, &mut rows, &mut gains)?;
            Ok(())
        };
        contenders.push(Contender::new("fused", threads, run).with_work(case.work()));
    }
    bench.group(name, contenders, "")
}

fn backward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let graph = case.gradients(GRAPH)?;
    let (ops, note): (&[(&str, Op)], String) = match case.gradients(FUSED) {
        Ok(fused) => {
            for (what, i) in [("by head records", 0), ("by parents", 1)] {
                agree(what, &host(&fused[i])?, &host(&graph[i])?, TIGHT)?;
            }
            (&[("candle graph", GRAPH), ("fused", FUSED)], "forward and backward".to_owned())
        }
        Err(e) => (&[("candle graph", GRAPH)], format!("forward and backward; {e}")),
    };
    let mut kernels = Kernels::new(case)?;
    kernels.run(case)?;
    for (got, expected) in kernels.inputs.iter().zip(&graph) {
        agree("without autograd", got, &host(expected)?, TIGHT)?;
    }
    drop((graph, kernels));
    let mut contenders = Vec::new();
    for (what, op) in ops {
        for threads in [Threads::One, Threads::All] {
            contenders.push(Contender::new(*what, threads, || case.gradients(*op).map(drop)));
        }
    }
    for threads in [Threads::One, Threads::All] {
        let mut kernels = Kernels::new(case)?;
        let contender = Contender::new("fused, no autograd", threads, move || kernels.run(case));
        contenders.push(contender.with_work(case.work_both()));
    }
    bench.group(name, contenders, &note)
}

/// Both passes of the op on existing buffers, without candle's sums of gradients.
struct Kernels {
    head: Vec<f32>,
    parents: Vec<f32>,
    grads: [Vec<f32>; 2],
    results: [Vec<f32>; 2],
    inputs: [Vec<f32>; 2],
}

impl Kernels {
    fn new(case: &Case) -> Result<Self> {
        let (head, parents) = (host(&case.head)?, host(&case.parents)?);
        let grads = [host(&case.weights[0])?, host(&case.weights[1])?];
        let zeros = |like: &[f32]| vec![0.0; like.len()];
        let results = [zeros(&grads[0]), zeros(&grads[1])];
        let inputs = [zeros(&head), zeros(&parents)];
        Ok(Self { head, parents, grads, results, inputs })
    }

    fn run(&mut self, case: &Case) -> Result<()> {
        let [rows, gains] = &mut self.results;
        spgr_into(&case.head, &case.parents, &case.call, rows, gains)?;
        let Spgr { rules, cameras, near, per_view, first } = &case.call;
        let source = kernel::Source { cameras, near, per_view: *per_view, first: *first };
        let args = kernel::Args { rules, source, head: &self.head, parents: &self.parents };
        let [head, parents] = &mut self.inputs;
        kernel::backward(args, &self.grads[0], head, parents);
        kernel::gains_backward(rules, &self.head, &self.grads[1], head);
        Ok(())
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Pass {
    Forward,
    Both,
}

/// Returns the minimum work of redistribution.
fn share_work(rule: OpacityRule, (parents, children): (usize, usize), pass: Pass) -> Work {
    // Forward: logits, areas and per-parent numbers are read, opacities written. Backward: the
    // gradient is read in addition, and the gradients of all inputs are written.
    let (pc, per_parent) = ((parents * children) as f64, parents as f64);
    let singles = if rule.areas_are_relative() { 2.0 } else { 1.0 };
    let (bytes, flops) = match pass {
        Pass::Forward => (3.0 * pc + singles * per_parent, FLOPS_PER_SHARE),
        Pass::Both => (8.0 * pc + 3.0 * singles * per_parent, 2.2 * FLOPS_PER_SHARE),
    };
    Work { bytes: 4.0 * bytes, flops: flops * pc }
}

fn redistribution(
    bench: &mut Bench,
    name: &str,
    rule: OpacityRule,
    (parents, children): (usize, usize),
    pass: Pass,
) -> Result<()> {
    let logits = Var::from_tensor(&inputs::tensor(&[parents, children], 1.0, 70)?)?;
    let areas = Var::from_tensor(&inputs::tensor(&[parents, children], 0.5, 71)?.exp()?)?;
    let own = inputs::tensor(&[parents], 0.3, 72)?.exp()?;
    let alpha: Vec<f32> = (0..parents as u64).map(|i| scene::unit(73, i)).collect();
    let alpha = Var::from_vec(alpha, parents, &candle_core::Device::Cpu)?;
    let weights = inputs::tensor(&[parents, children], 1.0, 74)?;
    // Leaves without gradients keep no intermediate results.
    let leaf = |v: &Var| if pass == Pass::Both { v.as_tensor().clone() } else { v.detach() };
    let (l, a, o) = (leaf(&logits), leaf(&areas), leaf(&alpha));
    let run = |fused: bool, weighted: bool| -> Result<Vec<Tensor>> {
        let y = match (fused, rule) {
            (true, _) => redistribute(rule, &l, &a, &o, Some(&own))?,
            (false, OpacityRule::Linear) => plain::linear(&l, &a, &o)?,
            (false, _) => plain::optical_depth(&l, &a, &o, &own)?,
        };
        if pass == Pass::Forward {
            return Ok(vec![y]);
        }
        // The timed loss is Σy: candle starts with a gradient of ones and no other work.
        let grads = if weighted { y.mul(&weights)?.sum_all()?.backward()? } else { y.backward()? };
        Ok([&logits, &areas, &alpha].into_iter().filter_map(|v| grads.get(v).cloned()).collect())
    };
    let (fused, graph) = (run(true, true)?, run(false, true)?);
    anyhow::ensure!(fused.len() == graph.len(), "{} and {} tensors", fused.len(), graph.len());
    for (got, expected) in fused.iter().zip(&graph) {
        agree(name, &host(got)?, &host(expected)?, TIGHT)?;
    }
    let work = share_work(rule, (parents, children), pass);
    let [hl, ha, ho, hown, hw] = [host(&l)?, host(&a)?, host(&o)?, host(&own)?, host(&weights)?];
    let args = shares::Args {
        rule,
        k: children,
        logits: &hl,
        areas: &ha,
        alphas: &ho,
        own: if rule.areas_are_relative() { &hown } else { &[] },
    };
    let mut contenders = Vec::new();
    for (what, fused) in [("candle graph", false), ("fused", true)] {
        for threads in [Threads::One, Threads::All] {
            let contender = Contender::new(what, threads, move || run(fused, false).map(drop));
            contenders.push(if fused { contender.with_work(work) } else { contender });
        }
    }
    for threads in [Threads::One, Threads::All] {
        let grad = hw.as_slice();
        let run = move || {
            std::hint::black_box(shares::forward(args));
            if pass == Pass::Both {
                std::hint::black_box(shares::backward(args, grad).logits);
            }
            Ok(())
        };
        let contender = Contender::new("kernels alone", threads, run);
        contenders.push(contender.with_work(work));
    }
    let note = if pass == Pass::Both { "forward and backward" } else { "" };
    bench.group(name, contenders, note)
}
