//! onnxruntime in a separate process (`tools/bench/rival.py`).

use super::{peak, whole};
use crate::common::{Bench, agree};
use anyhow::{Context, Result, ensure};
use candle_core::{Device, Tensor};
use glam::Mat4;
use serde::Deserialize;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;
use subsplat::network::config::Mvsplat as Settings;
use subsplat::network::model::Views;
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::Weights;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

/// Tolerance: f32 noise of a deep network. Single pixels differ by more where a clamp or an
/// epipolar border flips.
const NETWORK: [f32; 3] = [5e-4, 5e-2, 2e-3];

/// Output of the script.
#[derive(Deserialize)]
pub struct Reply {
    pub seconds: BTreeMap<String, Vec<f64>>,
    pub peak_bytes: f64,
    pub onnxruntime: String,
}

/// The Python interpreter, and a folder for exchanged tensors.
pub struct Rival {
    python: PathBuf,
    pub folder: tempfile::TempDir,
    pub threads: usize,
    pub runs: usize,
    quick: bool,
}

impl Rival {
    pub fn find(threads: usize, quick: bool) -> Result<Self> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let python = std::env::var_os("SUBSPLAT_PYTHON")
            .map_or_else(|| root.join("out/witness-venv/bin/python"), PathBuf::from);
        ensure!(python.exists(), "{}: not found; run tools/witness/setup.sh", python.display());
        let folder = tempfile::tempdir()?;
        Ok(Self { python, folder, threads, runs: if quick { 1 } else { 5 }, quick })
    }

    pub fn run(&self, words: &[&str]) -> Result<Reply> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/bench/rival.py");
        let folder = self.folder.path().as_os_str();
        let out = Command::new(&self.python)
            .arg(script)
            .args(words)
            .arg(folder)
            .args([self.runs.to_string(), self.threads.to_string()])
            .output()?;
        let errors = String::from_utf8_lossy(&out.stderr);
        ensure!(out.status.success(), "onnxruntime: {errors}");
        serde_json::from_slice(&out.stdout).context("the output of rival.py")
    }
}

pub fn median(seconds: &[f64]) -> f64 {
    let mut sorted = seconds.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Duration of a run, seconds, below which this many runs are timed.
const QUICK: (f64, usize) = (0.02, 50);

/// Returns the seconds of `runs` runs after two untimed ones; of more runs where they are short.
pub fn timed(runs: usize, mut run: impl FnMut() -> Result<()>) -> Result<Vec<f64>> {
    run()?;
    let start = Instant::now();
    run()?;
    let short = start.elapsed().as_secs_f64() < QUICK.0;
    (0..if short { runs.max(QUICK.1) } else { runs })
        .map(|_| {
            let start = Instant::now();
            run()?;
            Ok(start.elapsed().as_secs_f64())
        })
        .collect()
}

/// Returns the cameras and pictures that the script generated.
fn views(tensors: &HashMap<String, Tensor>, side: usize) -> Result<Views> {
    let list = |name: &str| -> Result<Vec<f32>> {
        let t = tensors.get(name).with_context(|| format!("rival: no {name}"))?;
        Ok(t.flatten_all()?.to_vec1()?)
    };
    let (poses, lenses, planes) = (list("poses")?, list("intrinsics")?, list("near_far")?);
    let camera = |(pose, k): (&[f32], &[f32])| -> Result<Camera> {
        let pose = Mat4::from_cols_array(pose.try_into()?).transpose();
        let [fx, fy, cx, cy]: [f32; 4] = k.try_into()?;
        let intrinsics = Intrinsics { fx, fy, cx, cy, width: side, height: side };
        Ok(Camera::new(intrinsics, pose)?)
    };
    let cameras = poses.chunks_exact(16).zip(lenses.chunks_exact(4)).map(camera);
    let near_far = planes.chunks_exact(2).map(|p| NearFar::new(p[0], p[1])).collect();
    let images = tensors["images"].unsqueeze(0)?;
    Ok(Views::new(images, vec![cameras.collect::<Result<_>>()?], vec![near_far])?)
}

/// Compares MVSplat's backbone with the script's weights, then returns the times of this crate.
fn backbone(rival: &Rival, side: usize) -> Result<Vec<f64>> {
    let path = rival.folder.path().join(format!("{side}.safetensors"));
    let tensors = candle_core::safetensors::load(path, &Device::Cpu)?;
    let strip =
        |(n, t): (&String, &Tensor)| n.strip_prefix("w.").map(|n| (n.to_owned(), t.clone()));
    let weights = Weights::from_tensors(tensors.iter().filter_map(strip).collect());
    let net = Mvsplat::new(&Settings::re10k(), weights.builder())?;
    let views = views(&tensors, side)?;
    let out = net.forward(&views, &mut Trace::off())?;
    let disparity = out.depths.recip()?;
    for (name, got) in [("disparity", &disparity), ("densities", &out.densities), ("raw", &out.raw)]
    {
        let want = tensors.get(&format!("out.{name}")).with_context(|| format!("no out.{name}"))?;
        let list = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        agree(&format!("backbone {side}: {name}"), &list(got)?, &list(want)?, NETWORK)?;
    }
    drop((out, disparity));
    timed(rival.runs, || {
        std::hint::black_box(net.forward(&views, &mut Trace::off())?);
        Ok(())
    })
}

/// Prints the table of whole networks.
pub fn compare(bench: &Bench, rival: &Rival) -> Result<()> {
    let sides: &[usize] = if rival.quick { &[256] } else { &[256, 512] };
    let mut rows: Vec<(String, f64, f64)> = Vec::new();
    let mut version = String::new();
    for &side in sides {
        let reply = rival.run(&["network", &side.to_string()])?;
        let seconds = reply.seconds.values().next().context("rival: no times")?;
        version = reply.onnxruntime;
        rows.push((
            format!("onnxruntime: MVSplat backbone {side}²"),
            median(seconds),
            reply.peak_bytes,
        ));
        let ours = bench.on_all(|| backbone(rival, side))?;
        let peak = peak(&format!("mvsplat backbone {side}"))?;
        rows.push((format!("ours: MVSplat backbone {side}² (same results)"), median(&ours), peak));
    }
    let mut cases = vec!["mvsplat 256 to 512", "mvsplat 256 to 1024", "small 256 to 512"];
    if !rival.quick {
        cases.push("mvsplat 512 to 512");
    }
    for case in cases {
        let mut run = whole(case)?;
        let seconds = bench.on_all(|| timed(rival.runs, || run().map(drop)))?;
        rows.push((format!("ours: photographs to picture, {case}"), median(&seconds), peak(case)?));
    }
    println!(
        "\nwhole networks, {} threads, onnxruntime {version}, median of {}",
        rival.threads, rival.runs
    );
    let of = |side: usize| {
        rows.iter().find(|r| r.0.ends_with(&format!("onnxruntime: MVSplat backbone {side}²")))
    };
    let (small, large) = (of(256).map(|r| r.1), of(512).map(|r| r.1));
    println!(
        "  {:<52} {:>9} {:>9} {:>11} {:>11}",
        "", "seconds", "peak GiB", "of ort 256", "of ort 512"
    );
    for (name, seconds, bytes) in &rows {
        let part =
            |whole: Option<f64>| whole.map_or(String::new(), |w| format!("{:.3}x", seconds / w));
        let gib = bytes / f64::from(1 << 30);
        println!("  {name:<52} {seconds:>9.3} {gib:>9.2} {:>11} {:>11}", part(small), part(large));
    }
    Ok(())
}
