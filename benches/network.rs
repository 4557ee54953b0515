//! The whole network: a training step of the small backbone; photographs to a picture with either
//! backbone; stages with their rates (`-- stages`); the serial fraction (`-- serial`). With
//! `--onnxruntime` also the same backbone and operators in onnxruntime, in the same run:
//!
//! ```text
//! tools/witness/setup.sh
//! cargo bench --bench network -- --onnxruntime
//! ```
//!
//! `SUBSPLAT_PYTHON` selects another interpreter than `out/witness-venv/bin/python`.

mod common;
#[path = "network/ops.rs"]
mod ops;
#[path = "network/rival.rs"]
mod rival;
#[path = "network/stages.rs"]
mod stages;

use anyhow::{Context, Result, bail};
use candle_core::Tensor;
use common::{Bench, Contender, Threads, inputs, scene};
use rival::{Rival, median, timed};
use stages::Stages;
use std::ops::ControlFlow;
use subsplat::FitOptions;
use subsplat::network::config::{Config, Mvsplat as Settings, Preset, Small};
use subsplat::network::model::Views;
use subsplat::network::model::backbone::{DisparityMean, Mvsplat, SmallBackbone};
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::Weights;
use subsplat::reconstruct::{
    Check, DepthBounds, Detail, Options, Photo, Progress, Reconstructor, Stage,
};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::NearFar;
use subsplat_kernels::cpu::SimdLevel;

/// The allocator of the programs.
#[path = "../tools/cli/src/pages.rs"]
#[allow(dead_code, reason = "its unit tests run with the programs")]
mod pages;

#[global_allocator]
static PAGES: pages::Pages = pages::Pages;

/// Restarts of the programs.
#[path = "../tools/cli/src/commands/environment.rs"]
#[allow(dead_code, reason = "the bench opens no GPU")]
mod environment;

fn main() -> Result<()> {
    // As `train` does: idle threads of candle's own pool spin, and take the cores from this crate's.
    environment::restart_with("CANDLE_NUM_THREADS", || "1".into());
    let words: Vec<String> = std::env::args().collect();
    if let Some(at) = words.iter().position(|w| w == "--peak") {
        return peak_of(words.get(at + 1).map_or("", String::as_str));
    }
    let mut bench = Bench::new("network")?;
    training_step(&mut bench)?;
    for case in CASES {
        let name = format!("photographs to picture, {case}");
        if bench.selects(&name) {
            let mut run = whole(case)?;
            bench.group(
                &name,
                vec![Contender::new("ours", Threads::All, move || run().map(drop))],
                "",
            )?;
        }
    }
    let tables = ["stages", "serial"].map(|name| bench.selects(name));
    if tables[0] {
        stages(&mut bench)?;
    }
    if tables[1] {
        serial(&bench)?;
    }
    if bench.args.onnxruntime {
        let rival = Rival::find(bench.threads(), bench.args.quick)?;
        if bench.selects("operators") {
            ops::compare(&mut bench, &rival)?;
        }
        if bench.selects("backbones") {
            rival::compare(&bench, &rival)?;
        }
        return Ok(());
    }
    // Tables that are not groups.
    if tables.contains(&true) && !bench.args.names.is_empty() {
        return Ok(());
    }
    bench.finish()
}

/// Returns `batch` scenes of two pictures.
fn views(batch: usize, side: usize) -> Result<Views> {
    let cameras = scene::views(side).to_vec();
    let images = (inputs::tensor(&[batch, 2, 3, side, side], 0.2, 7)? + 0.5)?.clamp(0.0, 1.0)?;
    Ok(Views::new(images, vec![cameras; batch], vec![vec![NearFar::RE10K; 2]; batch])?)
}

/// Forward, a loss of every output, backward: 128², batch 4, without rendering.
fn training_step(bench: &mut Bench) -> Result<()> {
    let name = "small training step 128 batch 4";
    if !bench.selects(name) {
        return Ok(());
    }
    let weights = Weights::seeded(3).trainable();
    let net = SmallBackbone::new(&Small::standard(), weights.builder().pp("small"))?;
    // Most branches are zero before training.
    for (n, var) in weights.variables().values().enumerate() {
        let nudge = inputs::tensor(var.dims(), 0.02, n as u64)?;
        var.set(&(var.as_tensor() + nudge)?)?;
    }
    let v = views(4, 128)?;
    let forward = || -> Result<()> {
        std::hint::black_box(net.forward(&v, DisparityMean::AllCandidates)?);
        Ok(())
    };
    let supervised = || -> Result<()> {
        let (_, maps) = net.forward(&v, DisparityMean::AllCandidates)?;
        let loss = (maps.logits.sqr()?.mean_all()? + maps.index.sqr()?.mean_all()?)?;
        let loss = (loss + maps.confidence.sqr()?.mean_all()?)?;
        std::hint::black_box(loss.backward()?);
        Ok(())
    };
    let step = || -> Result<()> {
        let (out, maps) = net.forward(&v, DisparityMean::AllCandidates)?;
        let loss = (out.raw.sqr()?.mean_all()? + out.depths.recip()?.mean_all()?)?;
        let loss = (loss + out.densities.sqr()?.mean_all()?)?;
        let loss = (loss + (maps.logits.sqr()?.mean_all()? + maps.index.sqr()?.mean_all()?)?)?;
        std::hint::black_box(loss.backward()?);
        Ok(())
    };
    let contenders = vec![
        Contender::new("all outputs, with backward", Threads::All, step),
        Contender::new("depth losses, with backward", Threads::All, supervised),
        Contender::new("forward alone", Threads::All, forward),
    ];
    bench.group(name, contenders, "")
}

/// Backbone, input side and output side (the same: MVSplat alone).
const CASES: [&str; 6] = [
    "small 256 to 512",
    "mvsplat 256 to 512",
    "mvsplat 256 to 1024",
    "mvsplat 512 to 512",
    "mvsplat 512 to 1024",
    "mvsplat backbone 512",
];

fn photo(side: usize, view: usize) -> Result<Photo> {
    let planes = inputs::tensor(&[3, side / 4, side / 4], 0.25, 40 + view as u64)?;
    let planes =
        subsplat::network::ops::resize::resize_bilinear(&planes.unsqueeze(0)?, side, side)?;
    let rows = planes.squeeze(0)?.permute((1, 2, 0))?.flatten_all()?.to_vec1::<f32>()?;
    let data = rows.iter().map(|v| (255.0 * (v + 0.5).clamp(0.0, 1.0)) as u8).collect();
    let camera = scene::views(side)[view];
    Ok(Photo::new(Rgb { width: side, height: side, data }, camera)?)
}

type Run = Box<dyn FnMut() -> Result<f64> + Send>;

/// Returns one of [`CASES`] as a function, without decoding.
fn whole(case: &str) -> Result<Run> {
    let words: Vec<&str> = case.split(' ').collect();
    if let ["mvsplat", "backbone", side] = words[..] {
        let (net, v) = (backbone()?, views(1, side.parse()?)?);
        return Ok(Box::new(move || {
            let out = net.forward(&v, &mut Trace::off())?;
            Ok(f64::from(out.depths.mean_all()?.to_scalar::<f32>()?))
        }));
    }
    let (model, photos, options) = self::case(case)?;
    let camera = scene::camera(photos[0].size().width);
    Ok(Box::new(move || {
        let picture = model.run(&photos, &options)?.render(&camera);
        Ok(f64::from(picture.rgb.iter().sum::<f32>()))
    }))
}

/// Returns the model, the photographs and the options of one of [`CASES`] with photographs.
fn case(case: &str) -> Result<(Reconstructor, [Photo; 2], Options)> {
    let words: Vec<&str> = case.split(' ').collect();
    let [kind, from, "to", to] = words[..] else { bail!("no case {case:?}") };
    let (from, to): (usize, usize) = (from.parse()?, to.parse()?);
    let mut config = match kind {
        "small" => Config::small(Preset::Tuned, to / from),
        _ => Config::re10k(Preset::Tuned, to / from),
    };
    // MVSplat alone: one Gaussian per pixel.
    config.spgr.enabled = to > from;
    let model = Reconstructor::untrained(&config, 3)?;
    let options = Options::default()
        .with_input_size(from, from)
        .with_depth_prior(DepthBounds::re10k())
        .with_check(Check::Off)
        .with_detail(Detail::Off)
        .with_fit(FitOptions::off());
    Ok((model, [photo(to, 0)?, photo(to, 1)?], options))
}

/// MVSplat of the released size, with seeded weights.
fn backbone() -> Result<Mvsplat> {
    Ok(Mvsplat::new(&Settings::re10k(), Weights::seeded(3).builder())?)
}

/// Prints the stages of MVSplat's backbone, summed by the first two parts of their names, and of
/// photographs to a scene with the small backbone; second of two runs.
fn stages(bench: &mut Bench) -> Result<()> {
    let (net, v) = (backbone()?, views(1, 256)?);
    let observed = || {
        let mut stages = Stages::start();
        let mut observe = |name: &str, _: &Tensor| {
            let parts: Vec<&str> = name.split('.').take(2).collect();
            stages.end(&parts.join("."));
            Ok(())
        };
        net.forward(&v, &mut Trace::to(&mut observe))?;
        anyhow::Ok(stages)
    };
    let small = || {
        let mut stages = Stages::start();
        let mut current = None;
        let mut progress = |progress: Progress| {
            stages.end(current.map_or("start", Stage::name));
            current = Some(progress.stage);
            ControlFlow::Continue(())
        };
        let (model, photos, options) = case("small 256 to 512")?;
        model.run_with(&photos, &options, &mut progress)?;
        stages.end(current.map_or("start", Stage::name));
        anyhow::Ok(stages)
    };
    let mvsplat = bench.on_all(|| observed().and_then(|_| observed()))?;
    let small = bench.on_all(|| small().and_then(|_| small()))?;
    let level = SimdLevel::best().name();
    let title = "MVSplat's backbone, 256² (observed, so a little slower than alone)";
    mvsplat.print(&format!("stages of {title}, {level}"), bench.machine());
    let title = "photographs to a scene, small 256 to 512";
    small.print(&format!("stages of {title}, {level}"), bench.machine());
    Ok(())
}

/// Prints the fraction of the time that more threads do not shorten, by Amdahl's law from one
/// thread and all. It includes serial code and waits for shared memory bandwidth.
fn serial(bench: &Bench) -> Result<()> {
    let threads = bench.threads();
    anyhow::ensure!(threads > 1, "serial share: expected 2 threads or more, got {threads}");
    println!("\nserial share, {threads} threads, medians of 5");
    println!("  {:<40} {:>9} {:>9} {:>8} {:>8}", "", "one s", "all s", "speed", "serial");
    for case in &CASES[..3] {
        let mut run = whole(case)?;
        let one = median(&bench.on_one(|| timed(5, || run().map(drop)))?);
        let all = median(&bench.on_all(|| timed(5, || run().map(drop)))?);
        let speed = one / all;
        let share = (threads as f64 / speed - 1.0) / (threads as f64 - 1.0);
        println!("  {case:<40} {one:>9.3} {all:>9.3} {speed:>7.2}x {:>7.1}%", 100.0 * share);
    }
    Ok(())
}

/// Runs one of [`CASES`], or the backbone at 256², once in this process, and prints the peak
/// memory in bytes.
fn peak_of(case: &str) -> Result<()> {
    let sum = whole(case)?()?;
    let status = std::fs::read_to_string("/proc/self/status").context("peak memory")?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).context("peak memory: no VmHWM")?;
    let kib: f64 = line.split_whitespace().nth(1).context("peak memory")?.parse()?;
    println!("{} {sum}", 1024.0 * kib);
    Ok(())
}

/// Returns the peak memory of `case` in a separate process, bytes.
fn peak(case: &str) -> Result<f64> {
    let out =
        std::process::Command::new(std::env::current_exe()?).args(["--peak", case]).output()?;
    let output = String::from_utf8_lossy(&out.stdout);
    let bytes = output.split_whitespace().next().context("the child process printed nothing")?;
    bytes.parse().with_context(|| format!("{case}: {}", String::from_utf8_lossy(&out.stderr)))
}
