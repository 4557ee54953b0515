//! Comparison of the encoder with a reference, tensor by tensor: the engine of
//! `subsplat-lab compare`.
//!
//! The reference file holds inputs (`in.image` `[B, V, 3, H, W]`, `in.extrinsics`
//! `[B, V, 4, 4]` camera to world, `in.intrinsics` `[B, V, 3, 3]` over the image's size,
//! `in.near`, `in.far` `[B, V]`). It also holds stages and outputs under the names of the
//! encoder's trace (`cnn.conv1` … `out.opacities`).

use crate::noise_floors::{ALLOWANCE, noise_floor};
use candle_core::{Error, Result, Tensor, bail};
use glam::Mat4;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use subsplat::network::config::{
    Backbone, Mvsplat as Settings, Primaries as PrimariesSettings, ShFrame,
};
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::primaries::primaries;
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::{Weights, read_tensors};
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat::network::ops::Backend;
use subsplat::network::ops::Executor;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

/// Factor of the tolerances on a GPU, whose elementary functions are less exact.
const GPU_FACTOR: f32 = 2.0;

/// One tensor of the reference file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Its name; `1/name` for the disparity of a depth.
    pub tensor: String,
    /// Largest |ours − reference|.
    pub max_abs: f32,
    /// `max_abs` over the largest |reference|.
    pub relative: f32,
    /// Largest `relative` that passes: ten times the noise floor, on a GPU twenty times.
    pub allowed: f32,
    /// True if `relative` is at most `allowed`.
    pub ok: bool,
    /// Reason of a failure without numbers (another shape).
    pub note: Option<String>,
}

/// The whole comparison.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// Tensors compared, in the order of computation.
    pub rows: Vec<Row>,
    /// Tensors of the file that the encoder does not produce.
    pub not_produced: Vec<String>,
    /// Tensors of the weight file that the encoder does not read.
    pub unexpected_weights: Vec<String>,
}

impl Report {
    /// Returns true if there are rows and every row passes.
    pub fn ok(&self) -> bool {
        !self.rows.is_empty() && self.rows.iter().all(|r| r.ok)
    }
}

/// Runs the encoder on `backend` on the file's inputs and compares every tensor that both have.
///
/// # Errors
/// The file is not readable, inputs are missing or malformed, or weights do not fit; errors of the
/// device.
pub fn compare(weights: &Weights, reference: &Path, backend: &Backend) -> Result<Report> {
    let (tensors, _) = read_tensors(reference).map_err(Error::wrap)?;
    let settings = match weights.config().map(|c| &c.backbone) {
        None => Settings::re10k(),
        // The reference has MVSplat's SH frame; the weights may name another one.
        Some(Backbone::Mvsplat(settings)) => {
            let primaries =
                PrimariesSettings { sh_frame: ShFrame::Mvsplat, ..settings.primaries.clone() };
            Settings { primaries, ..settings.clone() }
        }
        Some(Backbone::Small(_)) => {
            bail!("compare: expected weights of an MVSplat backbone, got the small backbone's")
        }
    };
    let encoder = Mvsplat::new(&settings, weights.builder())?;
    let mut report = compare_encoder(&encoder, &settings, &tensors, backend)?;
    report.unexpected_weights = weights.unexpected();
    Ok(report)
}

/// Does the same as [`compare`] with a model and tensors in memory.
///
/// # Errors
/// Inputs are missing or malformed.
pub fn compare_encoder(
    encoder: &Mvsplat,
    settings: &Settings,
    reference: &BTreeMap<String, Tensor>,
    backend: &Backend,
) -> Result<Report> {
    let views = views(reference)?;
    let factor = if backend.is_cpu() { 1.0 } else { GPU_FACTOR };
    let mut rows = Vec::new();
    let mut seen = Vec::new();
    let mut compare_stage = |name: &str, ours: &Tensor| -> Result<()> {
        if let Some(theirs) = reference.get(name) {
            rows.push(row(name, ours, theirs, factor)?);
            if name == "gauss.depths" {
                rows.push(row("1/gauss.depths", &ours.recip()?, &theirs.recip()?, factor)?);
            }
            seen.push(name.to_owned());
        }
        Ok(())
    };
    let mut trace = Trace::to(&mut compare_stage);
    let out = encode(encoder, &views, backend, &mut trace)?;
    let p = primaries(&out, &views, &settings.primaries, &mut trace)?;
    trace_outputs(&p, &mut trace)?;
    let not_produced =
        reference.keys().filter(|n| !n.starts_with("in.") && !seen.contains(n)).cloned().collect();
    Ok(Report { rows, not_produced, unexpected_weights: Vec::new() })
}

/// Runs the encoder on `backend`. Errors of a GPU are errors here.
fn encode(
    encoder: &Mvsplat,
    views: &Views,
    backend: &Backend,
    trace: &mut Trace<'_>,
) -> Result<BackboneOutput> {
    if let Some(gpu) = Executor::new(backend) {
        return encoder.forward_on(views, &gpu.upload(&views.images)?, trace)?.to_host();
    }
    encoder.forward(views, trace)
}

fn trace_outputs(p: &Primaries, trace: &mut Trace<'_>) -> Result<()> {
    trace.put("out.means", &p.means)?;
    trace.put_with("out.covariances", || p.covariances())?;
    trace.put("out.harmonics", &p.sh)?;
    trace.put("out.opacities", &p.opacities)
}

fn row(name: &str, ours: &Tensor, theirs: &Tensor, factor: f32) -> Result<Row> {
    let allowed = factor * ALLOWANCE * noise_floor(name);
    let tensor = name.to_owned();
    if ours.dims() != theirs.dims() {
        let note = format!("expected shape {:?}, got {:?}", theirs.dims(), ours.dims());
        let inf = f32::INFINITY;
        let row = Row { tensor, max_abs: inf, relative: inf, allowed, ok: false, note: Some(note) };
        return Ok(row);
    }
    let (a, b) = (ours.flatten_all()?.to_vec1::<f32>()?, theirs.flatten_all()?.to_vec1::<f32>()?);
    // `f32::max` ignores NaN; this function keeps it.
    let worst = |m: f32, v: f32| if v > m || v.is_nan() { v } else { m };
    let max_abs = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, worst);
    let size = b.iter().map(|b| b.abs()).fold(0.0, worst);
    let relative = if max_abs == 0.0 { 0.0 } else { max_abs / size };
    Ok(Row { tensor, max_abs, relative, allowed, ok: relative <= allowed, note: None })
}

/// Returns the inputs of a reference file.
///
/// # Errors
/// A tensor is missing or has another shape; a camera is invalid.
pub fn views(tensors: &BTreeMap<String, Tensor>) -> Result<Views> {
    let input = |name: &str| match tensors.get(name) {
        Some(t) => Ok(t),
        None => bail!("reference file: expected a tensor `{name}`, got none"),
    };
    let images = input("in.image")?;
    let (b, v, _, h, w) = images.dims5()?;
    let numbers = |name: &str, rest: &[usize]| -> Result<Vec<f32>> {
        let t = input(name)?;
        let expected = [&[b, v], rest].concat();
        if t.dims() != expected {
            bail!("reference file `{name}`: expected shape {expected:?}, got {:?}", t.dims());
        }
        t.flatten_all()?.to_vec1()
    };
    let (poses, k) = (numbers("in.extrinsics", &[4, 4])?, numbers("in.intrinsics", &[3, 3])?);
    let (near, far) = (numbers("in.near", &[])?, numbers("in.far", &[])?);
    let mut cameras = Vec::new();
    for (pose, k) in poses.chunks_exact(16).zip(k.chunks_exact(9)) {
        let intrinsics = Intrinsics::from_normalised([k[0], k[4], k[2], k[5]], w, h);
        let mut m = [0f32; 16];
        m.copy_from_slice(pose);
        let pose = Mat4::from_cols_array(&m).transpose();
        cameras.push(Camera::new(intrinsics, pose).map_err(Error::wrap)?);
    }
    let range = |(near, far)| NearFar { near, far };
    let near_far: Vec<NearFar> = near.into_iter().zip(far).map(range).collect();
    Views::new(
        images.clone(),
        cameras.chunks(v).map(<[_]>::to_vec).collect(),
        near_far.chunks(v).map(<[_]>::to_vec).collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    #[test]
    fn nan_never_passes() -> Result<()> {
        let t = |v: [f32; 3]| Tensor::new(&v, &Device::Cpu);
        let fine = t([1.0, -2.0, 0.5])?;
        assert!(row("x", &fine, &fine, 1.0)?.ok);
        for bad in [[1.0, f32::NAN, 0.5], [f32::NAN, -2.0, 0.5], [1.0, -2.0, f32::INFINITY]] {
            assert!(!row("x", &t(bad)?, &fine, 1.0)?.ok, "{bad:?}");
            assert!(!row("x", &fine, &t(bad)?, 1.0)?.ok, "{bad:?}");
        }
        assert!(!row("x", &fine, &t([0.0; 3])?, 1.0)?.ok);
        assert!(row("x", &t([0.0; 3])?, &t([0.0; 3])?, 1.0)?.ok);
        assert!(!Report::default().ok());
        Ok(())
    }
}
