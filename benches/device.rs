//! Work and time of the network on a GPU: calls, workgroups, operations, bytes and device memory of
//! two pictures, counted, and the time that adapters of four classes would need for them.
//!
//! `cargo bench --bench device -- [small|mvsplat …] [--side PX] [--device NAME] [--count]`. Work and
//! memory depend on the sizes only; the measured time is that of the adapter at hand. `--count` allocates
//! the memory and counts the calls, but executes none.
//!
//! `--subgroups` times the kernels with two sources instead, with and without subgroup operations.
//! `--convolutions` times convolutions of both networks for pictures of `--side`: a line each for
//! `tools/lab/gpu/torch_convolutions.py`, which adds PyTorch's time.

use anyhow::{Context, Result, bail, ensure};
use candle_core::{Device, Tensor};
use glam::{Mat4, Vec3};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{Backend, Views};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::gpu::{
    Array, ConvolutionCall, FULL_GRID, Gpu, GpuError, NormSum, PointwiseFunction, Recorder, Work,
};

/// Class of adapters, its f32 rate in flop/s, and its memory's rate in bytes/s (data sheets).
const CLASSES: [(&str, f64, f64); 4] = [
    ("integrated", 2e12, 60e9),
    ("laptop", 10e12, 250e9),
    ("desktop", 30e12, 700e9),
    ("H200", 60e12, 4.8e12),
];
/// Shares of both rates that are expected of tiled products and of streams; duration of a call, s.
const FLOPS_SHARE: f64 = 0.3;
const BYTES_SHARE: f64 = 0.7;
const CALL_S: f64 = 5e-6;
/// Calls without arithmetic of their own, which a fusion with the call before could replace. All others are
/// the minimum that the bytes are compared with.
const FUSIBLE: [&str; 3] = ["elementwise copy", "elementwise sum", "elementwise activation"];

struct Args {
    names: Vec<String>,
    side: usize,
    device: String,
    count: bool,
    subgroups: bool,
    convolutions: bool,
}

fn parse() -> Result<Args> {
    let mut args = Args {
        names: Vec::new(),
        side: 256,
        device: "gpu".to_owned(),
        count: false,
        subgroups: false,
        convolutions: false,
    };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().with_context(|| format!("{word}: expected a value"));
        match word.as_str() {
            "--bench" => {}
            "--count" => args.count = true,
            "--subgroups" => args.subgroups = true,
            "--convolutions" => args.convolutions = true,
            "--side" => args.side = value()?.parse().context("--side")?,
            "--device" => args.device = value()?,
            other if other.starts_with('-') => bail!("unknown option {other}"),
            name => args.names.push(name.to_owned()),
        }
    }
    Ok(args)
}

/// Two pictures of noise, 0.2 apart.
fn views(side: usize) -> Result<Views> {
    let s = side as f32;
    let k = Intrinsics { fx: s, fy: s, cx: 0.5 * s, cy: 0.5 * s, width: side, height: side };
    let camera = |x: f32| Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0)));
    let number = |i: usize| ((i as f32 * 12.9898).sin() * 43_758.547).fract().abs();
    let pixels = (0..6 * side * side).map(number).collect();
    let images = Tensor::from_vec(pixels, (1, 2, 3, side, side), &Device::Cpu)?;
    let near_far = vec![vec![NearFar::new(1.0, 100.0); 2]];
    Ok(Views::new(images, vec![vec![camera(0.0)?, camera(0.2)?]], near_far)?)
}

/// Seconds of one pass and the work of each kernel in it.
fn pass(network: &SubSplat, views: &Views) -> Result<(f64, BTreeMap<&'static str, Work>)> {
    let executor = network.trunk().executor().context("expected a GPU, got the CPU")?;
    let before = executor.recorder().work();
    let start = Instant::now();
    network.forward(views, &mut |_| {})?;
    let seconds = start.elapsed().as_secs_f64();
    let mut work = executor.recorder().work();
    for (name, own) in &mut work {
        let was = before.get(name).copied().unwrap_or_default();
        own.calls -= was.calls;
        own.full_calls -= was.full_calls;
        own.workgroups -= was.workgroups;
        own.flops -= was.flops;
        own.bytes -= was.bytes;
    }
    Ok((seconds, work))
}

fn report(name: &str, config: &Config, args: &Args) -> Result<()> {
    let backend = Backend::open(&args.device)?;
    let gpu = backend.gpu().context("--device: expected a GPU, got the CPU")?.clone();
    let weights = Weights::seeded(7);
    let network = SubSplat::new(config, weights.builder())?.with_backend(&backend);
    let views = views(args.side)?;
    let executor = network.trunk().executor().context("expected a GPU, got the CPU")?;
    executor.recorder().set_counts_only(args.count);
    pass(&network, &views)?;
    let (seconds, work) = pass(&network, &views)?;
    ensure!(backend.warning().is_none(), "{name}: {}", backend.warning().unwrap_or_default());
    println!("{name}, two pictures of {0}x{0}, on {1}", args.side, gpu.adapter());
    let heads = ["calls", "full", "workgroups", "GFLOP", "MB"];
    let [calls, full, workgroups, flops, bytes] = heads;
    println!("{:22} {calls:>6} {full:>6} {workgroups:>11} {flops:>9} {bytes:>9}", "kernel");
    let line = |name: &str, w: &Work| {
        let (flops, bytes) = (w.flops as f64 / 1e9, w.bytes as f64 / 1e6);
        let Work { calls, full_calls, workgroups, .. } = w;
        println!("{name:22} {calls:>6} {full_calls:>6} {workgroups:>11} {flops:>9.2} {bytes:>9.1}");
    };
    let mut sum = Work::default();
    for (name, own) in &work {
        line(name, own);
        sum.calls += own.calls;
        sum.full_calls += own.full_calls;
        sum.workgroups += own.workgroups;
        sum.flops += own.flops;
        sum.bytes += own.bytes;
    }
    line("sum", &sum);
    let full = 100.0 * sum.full_calls as f64 / sum.calls as f64;
    println!("{full:.0} % of the calls have at least {FULL_GRID} workgroups, which fill an H200");
    let minimum: u64 =
        work.iter().filter(|(n, _)| !FUSIBLE.contains(n)).map(|(_, w)| w.bytes).sum();
    println!(
        "{:.2} times the bytes without copies, sums and activations",
        sum.bytes as f64 / minimum as f64
    );
    let memory = gpu.peak_allocated_bytes() as f64 / 1048576.0;
    if args.count {
        println!("{memory:.0} MiB of device memory at most; nothing was executed")
    } else {
        println!("{memory:.0} MiB of device memory at most, {seconds:.3} s here")
    }
    for (class, flops, bytes) in CLASSES {
        let of = |w: &Work| {
            let products = w.flops as f64 / (FLOPS_SHARE * flops);
            products.max(w.bytes as f64 / (BYTES_SHARE * bytes)) + CALL_S * w.calls as f64
        };
        println!("{class:12} {:.1} ms expected", 1e3 * work.values().map(of).sum::<f64>());
    }
    println!();
    Ok(())
}

/// Calls of one measurement, and most measurements of each device, of which the fastest counts.
const CALLS: usize = 10;
const REPEATS: usize = 7;
/// Time after which a kernel gets no further measurement; it has two at least, of which the first compiles it.
const ENOUGH: Duration = Duration::from_secs(2);

/// Runs `measure` as often as a kernel is measured.
fn repeat(mut measure: impl FnMut() -> Result<()>) -> Result<()> {
    let begun = Instant::now();
    for i in 0..=REPEATS {
        if i > 1 && begun.elapsed() > ENOUGH {
            break;
        }
        measure()?;
    }
    Ok(())
}

/// A kernel on arrays of its device: gradients have the last one as the upstream gradient.
type Call = fn(&[Array; 4]) -> Result<(), GpuError>;

const REDUCTIONS: [(&str, [usize; 4], Call); 6] = [
    ("group norm", [2, 64, 128, 128], |[x, f, s, _]| {
        x.group_norm(8, Some([f, s]), PointwiseFunction::Silu, None).map(drop)
    }),
    ("group norm backward", [2, 64, 64, 64], |[x, f, s, dy]| {
        x.group_norm_backward(8, Some([f, s]), PointwiseFunction::Silu, dy).map(drop)
    }),
    ("layer norm", [1, 128, 64, 128], |[x, f, s, _]| {
        x.reshape(&[64 * 128, 128])?.layer_norm([f, s], NormSum::None).map(drop)
    }),
    ("layer norm backward", [1, 128, 64, 128], |[x, f, _, dy]| {
        let rows = |a: &Array| a.reshape(&[64 * 128, 128]);
        rows(x)?.layer_norm_backward(f, &rows(dy)?).map(drop)
    }),
    ("softmax of 32", [64, 64, 16, 32], |[x, ..]| x.softmax().map(drop)),
    ("softmax of 1024", [1, 64, 32, 1024], |[x, ..]| x.softmax().map(drop)),
];

/// Prints the times of kernels with two sources on the adapter, with and without subgroup operations.
fn report_subgroups() -> Result<()> {
    let with = subsplat_test_support::gpu::gpu().context("expected a GPU")?;
    let without = subsplat_test_support::gpu::without_subgroups().context("expected a GPU")?;
    ensure!(with.has_subgroups(), "{}: expected subgroup operations", with.adapter());
    println!(
        "{:22} {:>12} {:>12}   ms a call, {}",
        "kernel",
        "subgroups",
        "without",
        with.adapter()
    );
    for (name, dims, call) in REDUCTIONS {
        let arrays = |gpu: &Arc<Gpu>| -> Result<_> {
            let recorder = Recorder::new(gpu.clone());
            let numbers = |n: usize| (0..n).map(|i| (i as f32 * 0.37).sin()).collect::<Vec<_>>();
            let upload = |dims: &[usize]| recorder.upload(&numbers(dims.iter().product()), dims);
            let channels = [dims[1]];
            Ok([upload(&dims)?, upload(&channels)?, upload(&channels)?, upload(&dims)?])
        };
        let devices = [arrays(&with)?, arrays(&without)?];
        let mut best = [f64::INFINITY; 2];
        repeat(|| {
            for (arrays, best) in devices.iter().zip(&mut best) {
                let recorder = arrays[0].recorder();
                recorder.finish()?;
                let start = Instant::now();
                for _ in 0..CALLS {
                    call(arrays)?;
                }
                recorder.finish()?;
                *best = best.min(start.elapsed().as_secs_f64());
            }
            Ok(())
        })?;
        let [own, other] = best.map(|s| 1e3 * s / CALLS as f64);
        println!("{name:22} {own:>12.3} {other:>12.3}");
    }
    Ok(())
}

/// Convolutions of two pictures of 256²: batch, channels in, height, width, channels out, side of the
/// kernel, stride.
const CONVOLUTIONS: [[usize; 7]; 8] = [
    [2, 3, 256, 256, 64, 7, 2],
    [2, 64, 128, 128, 64, 3, 1],
    [2, 96, 64, 64, 96, 3, 1],
    [2, 128, 64, 64, 128, 3, 1],
    [2, 64, 64, 64, 80, 3, 2],
    [2, 128, 64, 64, 128, 1, 1],
    [2, 32, 256, 256, 32, 3, 1],
    [2, 288, 64, 64, 128, 3, 1],
];

/// Prints the time of each convolution, forward, without a bias.
fn report_convolutions(args: &Args) -> Result<()> {
    let backend = Backend::open(&args.device)?;
    let gpu = backend.gpu().context("--device: expected a GPU, got the CPU")?.clone();
    println!("# batch in height width out kernel stride ms GFLOP/s, {}", gpu.adapter());
    let recorder = Recorder::new(gpu);
    let numbers = |n: usize| (0..n).map(|i| (i as f32 * 0.37).sin()).collect::<Vec<_>>();
    let upload = |dims: &[usize]| recorder.upload(&numbers(dims.iter().product()), dims);
    for [b, c, h, w, o, k, stride] in CONVOLUTIONS {
        let [h, w] = [h, w].map(|side| side * args.side / 256);
        let (x, weight) = (upload(&[b, c, h, w])?, upload(&[o, c, k, k])?);
        let call = ConvolutionCall { stride, padding: k / 2 };
        let run = || x.convolved(&weight, None, call, PointwiseFunction::None);
        let mut best = f64::INFINITY;
        repeat(|| {
            recorder.finish()?;
            let start = Instant::now();
            for _ in 0..CALLS {
                run()?;
            }
            recorder.finish()?;
            best = best.min(start.elapsed().as_secs_f64() / CALLS as f64);
            Ok(())
        })?;
        let flops = 2 * b * o * c * k * k * (h / stride) * (w / stride);
        println!(
            "{b} {c} {h} {w} {o} {k} {stride} {:.4} {:.0}",
            1e3 * best,
            flops as f64 / best / 1e9
        );
    }
    Ok(())
}

fn main() -> Result<()> {
    let args = parse()?;
    if args.subgroups {
        return report_subgroups();
    }
    if args.convolutions {
        return report_convolutions(&args);
    }
    let all = [
        ("small", Weights::shipped(2)?.config().context("the weights' configuration")?.clone()),
        ("mvsplat", Config::re10k(Preset::Tuned, 2)),
    ];
    for (name, config) in all {
        if args.names.is_empty() || args.names.iter().any(|n| n == name) {
            report(name, &config, &args)?;
        }
    }
    Ok(())
}
