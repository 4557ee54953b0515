//! Every convolution of MVSplat (two 256² views) and of `small` (four pairs of 128² views),
//! forward and backward, against blocked im2col with the `gemm` crate.
//!
//! With `SUBSPLAT_ORT=out/witness-venv/bin/python` (made by tools/witness/setup.sh) also against
//! onnxruntime, with the same shapes, inputs and threads. The runs alternate, and results are
//! compared first. onnxruntime packs its weights beforehand; this crate packs them in every call.

mod common;

use anyhow::{Context, Result, bail, ensure};
use candle_core::Tensor;
use common::conventional::conv as plain;
use common::inputs::tensor;
use common::{Bench, Contender, Threads, Work, agree};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use subsplat::network::ops::conv2d::conv2d;
use subsplat::network::ops::conv3d::conv3d;
use subsplat_kernels::cpu::SimdLevel;
use subsplat_kernels::cpu::conv::{Sizes, bias_grad, forward, input_grad, weight_grad};

/// The allocator of the programs.
#[path = "../tools/cli/src/pages.rs"]
#[allow(dead_code, reason = "its unit tests run with the programs")]
mod pages;

#[global_allocator]
static PAGES: pages::Pages = pages::Pages;

/// Name, channels in and out, kernel, stride, side of the input.
type Row = (&'static str, usize, usize, usize, usize, usize);

/// MVSplat, two views of 256².
const MVSPLAT: &[Row] = &[
    ("cnn 7x7s2", 3, 64, 7, 2, 256),
    ("cnn 64", 64, 64, 3, 1, 128),
    ("cnn 64-96s2", 64, 96, 3, 2, 128),
    ("cnn down 1x1s2", 64, 96, 1, 2, 128),
    ("cnn 96", 96, 96, 3, 1, 64),
    ("cnn 96-128", 96, 128, 3, 1, 64),
    ("cnn 128", 128, 128, 3, 1, 64),
    ("cnn 1x1", 128, 128, 1, 1, 64),
    ("refine 256-128", 256, 128, 3, 1, 64),
    ("refine 1x1", 256, 128, 1, 1, 64),
    ("refine down s2", 128, 128, 3, 2, 64),
    ("refine 128 at 32", 128, 128, 3, 1, 32),
    ("refine 128 at 16", 128, 128, 3, 1, 16),
    ("depth head", 128, 256, 3, 1, 64),
    ("proj 128-32", 128, 32, 3, 1, 256),
    ("unet 32", 32, 32, 3, 1, 256),
    ("unet 64-32", 64, 32, 3, 1, 256),
    ("unet 32s2", 32, 32, 3, 2, 256),
    ("unet 32 at 64", 32, 32, 3, 1, 64),
    ("to_gaussians.0", 163, 168, 3, 1, 256),
    ("to_gaussians.2", 168, 84, 3, 1, 256),
    ("to_disparity.0", 32, 64, 3, 1, 256),
    ("to_disparity.2", 64, 2, 3, 1, 256),
];

/// `small`, eight views of 128².
const SMALL: &[Row] = &[
    ("down2 5x5s2", 3, 24, 5, 2, 128),
    ("down4 3x3s2", 24, 48, 3, 2, 64),
    ("residual", 48, 48, 3, 1, 32),
    ("matching 1x1", 48, 8, 1, 1, 32),
    ("unet in", 112, 64, 3, 1, 32),
    ("unet 64", 64, 64, 3, 1, 32),
    ("shrink 64-80s2", 64, 80, 3, 2, 32),
    ("unet 80", 80, 80, 3, 1, 16),
    ("shrink 80-96s2", 80, 96, 3, 2, 16),
    ("unet 96 at 8", 96, 96, 3, 1, 8),
    ("unet 96 at 4", 96, 96, 3, 1, 4),
    ("up 192-96", 192, 96, 3, 1, 8),
    ("up 176-80", 176, 80, 3, 1, 16),
    ("up 144-64", 144, 64, 3, 1, 32),
    ("mask 1x1", 64, 144, 1, 1, 32),
    ("head.0", 69, 64, 3, 1, 128),
    ("head.1", 64, 85, 3, 1, 128),
];

/// 3-D stem of `small`: channels in and out; eight volumes of 64 candidates at 32².
const STEM: &[(&str, usize, usize)] = &[("stem.0", 5, 8), ("stem.1", 8, 1)];

/// Tolerance of `agree`: Winograd against sums in another order.
const CLOSE: [f32; 3] = [1e-5, 1e-4, 1e-4];

/// One convolution with inputs.
struct Case {
    name: String,
    sizes: Sizes,
    x: Tensor,
    w: Tensor,
    b: Tensor,
}

impl Case {
    fn flat(network: &str, images: usize, &(name, c, o, k, stride, side): &Row) -> Result<Self> {
        let sizes = Sizes::conv2d([c, o], [k, k], stride, k / 2, [side, side]);
        let scale = 1.0 / ((c * k * k) as f32).sqrt();
        Ok(Self {
            name: format!("{network} {name}"),
            sizes,
            x: tensor(&[images, c, side, side], 1.0, 1)?,
            w: tensor(&[o, c, k, k], scale, 2)?,
            b: tensor(&[o], 1.0, 3)?,
        })
    }

    fn stem(&(name, c, o): &(&str, usize, usize)) -> Result<Self> {
        Ok(Self {
            name: format!("small {name}"),
            sizes: Sizes::conv3d([c, o], [3; 3], 1, [64, 32, 32]),
            x: tensor(&[8, c, 64, 32, 32], 1.0, 1)?,
            w: tensor(&[o, c, 3, 3, 3], 0.1, 2)?,
            b: tensor(&[o], 1.0, 3)?,
        })
    }

    fn volume(&self) -> bool {
        self.x.rank() == 5
    }

    fn run(&self) -> Result<Tensor> {
        let s = &self.sizes;
        Ok(if self.volume() {
            conv3d(&self.x, &self.w, Some(&self.b), s.padding[2])?
        } else {
            conv2d(&self.x, &self.w, Some(&self.b), s.stride[2], s.padding[2])?
        })
    }

    /// Returns the baseline's geometry; `None` for volumes, which it does not support.
    fn plain(&self) -> Option<plain::Geometry> {
        let s = &self.sizes;
        (!self.volume()).then_some(plain::Geometry {
            in_channels: s.in_channels,
            out_channels: s.out_channels,
            kernel: [s.kernel[1], s.kernel[2]],
            stride: s.stride[2],
            padding: s.padding[2],
            size: [s.size[1], s.size[2]],
        })
    }

    /// Multiplications and additions of the definition.
    fn work(&self, times: f64) -> Result<Work> {
        let s = &self.sizes;
        let macs = self.x.dim(0)? * s.out_channels * s.out_pixels() * s.in_channels * s.taps();
        let floats = self.x.elem_count() + self.w.elem_count();
        Ok(Work { bytes: 4.0 * floats as f64, flops: 2.0 * times * macs as f64 })
    }
}

fn main() -> Result<()> {
    let mut bench = Bench::new("conv")?;
    let mut ort = match std::env::var_os("SUBSPLAT_ORT") {
        Some(python) => Some(Ort::start(&PathBuf::from(python))?),
        None => None,
    };
    let mut cases = Vec::new();
    for row in MVSPLAT {
        cases.push(Case::flat("mvsplat", 2, row));
    }
    for row in SMALL {
        cases.push(Case::flat("small", 8, row));
    }
    cases.extend(STEM.iter().map(Case::stem));
    for case in cases {
        let case = case?;
        for (pass, backward) in [("forward", false), ("backward", true)] {
            let name = format!("{pass} {}", case.name);
            if !bench.selects(&name) {
                continue;
            }
            if backward {
                self::backward(&mut bench, &name, &case)?
            } else {
                self::forth(&mut bench, &name, &case, ort.as_mut())?
            }
        }
    }
    bench.finish()
}

fn host(t: &Tensor) -> Result<Vec<f32>> {
    Ok(t.flatten_all()?.to_vec1()?)
}

fn forth(bench: &mut Bench, name: &str, case: &Case, ort: Option<&mut Ort>) -> Result<()> {
    let (x, w, b) = (host(&case.x)?, host(&case.w)?, host(&case.b)?);
    let y = case.run()?;
    let want = host(&y)?;
    let mut buffer = vec![0.0; want.len()];
    let mut contenders = Vec::new();
    if let Some(g) = case.plain() {
        plain::forward(&g, &x, &w, &b, &mut buffer);
        agree(name, &want, &buffer, CLOSE)?;
        let (x, w, b, buffer) = (&x, &w, &b, &mut buffer);
        contenders.push(Contender::new("im2col", Threads::All, move || {
            plain::forward(&g, x, w, b, buffer);
            Ok(())
        }));
    }
    let threads = bench.on_all(rayon::current_num_threads);
    if let Some(ort) = ort {
        let error = ort.load(case, &y, threads)?;
        ensure!(error < 2e-5, "{name}: onnxruntime differs by {error:e}");
        contenders.insert(0, Contender::in_other_process("onnxruntime", move || ort.run()));
    }
    for threads in [Threads::One, Threads::All] {
        let run = || case.run().map(drop);
        contenders.push(Contender::new("ours", threads, run).with_work(case.work(1.0)?));
    }
    bench.group(name, contenders, &format!("{:?} * {:?}", case.x.dims(), case.w.dims()))
}

fn backward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let (s, level) = (&case.sizes, SimdLevel::best());
    let (x, w, b) = (host(&case.x)?, host(&case.w)?, host(&case.b)?);
    let dy = host(&tensor(case.run()?.dims(), 1.0, 4)?)?;
    let images = x.len() / (s.in_channels * s.in_pixels());
    let (mut dw, mut db) = (w.clone(), b.clone());
    let (mut plain_dx, mut plain_dw) = (x.clone(), w.clone());
    let mut contenders = Vec::new();
    let (x, w, b, dy) = (&x, &w, &b, &dy);
    contenders.push(Contender::new("ours, forward", Threads::All, move || {
        std::hint::black_box(forward(level, s, images, x, w, b));
        Ok(())
    }));
    let dx = input_grad(level, s, images, dy, w);
    weight_grad(level, s, x, dy, &mut dw);
    if let Some(g) = case.plain() {
        plain::input_grad(&g, dy, w, &mut plain_dx);
        plain::weight_grad(&g, x, dy, &mut plain_dw);
        agree("dx", &dx, &plain_dx, CLOSE)?;
        agree("dw", &dw, &plain_dw, CLOSE)?;
        contenders.push(Contender::new("im2col", Threads::All, move || {
            plain::input_grad(&g, dy, w, &mut plain_dx);
            plain::weight_grad(&g, x, dy, &mut plain_dw);
            Ok(())
        }));
    }
    let run = move || {
        std::hint::black_box(input_grad(level, s, images, dy, w));
        weight_grad(level, s, x, dy, &mut dw);
        bias_grad(s.out_pixels(), dy, &mut db);
        Ok(())
    };
    let ours = Contender::new("ours, backward", Threads::All, run);
    contenders.push(ours.with_work(case.work(2.0)?));
    bench.group(name, contenders, "input, weight and bias; ratios to the forward pass")
}

/// A Python process with onnxruntime that runs one convolution at a time.
struct Ort {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    folder: tempfile::TempDir,
}

impl Ort {
    fn start(python: &Path) -> Result<Self> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/bench/conv_ort.py");
        let mut command = Command::new(python);
        command.arg(script).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().with_context(|| python.display().to_string())?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else {
            bail!("no pipe to {}", python.display())
        };
        Ok(Self { child, to, from: BufReader::new(from), folder: tempfile::tempdir()? })
    }

    fn request(&mut self, command: &Value, answer: &str) -> Result<f64> {
        writeln!(self.to, "{command}")?;
        let mut line = String::new();
        self.from.read_line(&mut line)?;
        let reply: Value = serde_json::from_str(&line).context("onnxruntime sent no reply")?;
        reply[answer].as_f64().with_context(|| format!("onnxruntime replied {line}"))
    }

    /// Loads a case; returns the largest difference from `y`, relative to the largest value of y.
    fn load(&mut self, case: &Case, y: &Tensor, threads: usize) -> Result<f64> {
        let mut files = serde_json::Map::new();
        for (name, tensor) in [("x", &case.x), ("w", &case.w), ("b", &case.b), ("y", y)] {
            let path = self.folder.path().join(name);
            let bytes: Vec<u8> = host(tensor)?.iter().flat_map(|v| v.to_le_bytes()).collect();
            std::fs::write(&path, bytes)?;
            files.insert(name.into(), json!([path, tensor.dims()]));
        }
        files.insert("stride".into(), json!(case.sizes.stride[2]));
        files.insert("padding".into(), json!(case.sizes.padding[2]));
        files.insert("threads".into(), json!(threads));
        self.request(&Value::Object(files), "error")
    }

    fn run(&mut self) -> Result<f64> {
        self.request(&json!({}), "seconds")
    }
}

impl Drop for Ort {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
