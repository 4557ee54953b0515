//! Ops of the trunk beside tensor operations: attributes of parents, columns, linear
//! layers and LayerNorm, values and gradients.

use candle_core::{DType, Device, Result, Tensor, Var};
use glam::{Mat4, Quat, Vec3};
use subsplat::network::config::{
    AlphaInput, AnchorFrame, Config, Embed, MuInput, Preset, ScaleInput,
};
use subsplat::network::model::embed::Embeddings;
use subsplat::network::model::geometry::{Frames, ParentChunk};
use subsplat::network::model::weights::Weights;
use subsplat::network::ops::cat::cat_columns;
use subsplat::network::ops::linear::linear;
use subsplat::network::ops::norm::layer_norm;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Parents in front of, behind and beside the cameras, with scales and opacities
/// inside and outside every bound.
fn parents(n: usize) -> Result<Var> {
    let wave = |i: usize, k: f64| (i as f64 * k + 0.3).sin();
    let row = |i: usize| {
        let (w, s) = (wave(i, 0.7), |k: f64| 0.05 + 0.04 * wave(i, k));
        let p = if i.is_multiple_of(5) { 1e-4 } else { 0.5 + 0.499 * wave(i, 2.3) };
        let z = 4.0 * wave(i, 0.23) + 2.0;
        let mean = [2.0 * w, wave(i, 1.1), z];
        let quat = [wave(i, 0.9), w, wave(i, 1.9), 0.4];
        [&mean[..], &quat, &[s(1.3), s(1.7), if i == 3 { 1e-13 } else { s(2.9) }], &[p]].concat()
    };
    let data: Vec<f64> = (0..n).flat_map(row).collect();
    Var::from_tensor(&Tensor::from_vec(data, (n, 11), &Device::Cpu)?)
}

/// Clip of the opacity logit.
const LOGIT_MAX: f64 = 6.0;
/// Smallest divisor of a coordinate and smallest argument of ln z, world units.
const Z_MIN: f64 = 1e-3;
/// Bound of x/z and y/z.
const SLOPE_MAX: f64 = 100.0;
/// Smallest argument of ln σ, world units.
const SCALE_MIN: f64 = 1e-12;

/// The same rotations with w ≥ 0: `[n, 4]` wxyz.
fn canonical(quats_wxyz: &Tensor) -> Result<Tensor> {
    let w = quats_wxyz.narrow(1, 0, 1)?;
    let sign = w.ge(0.0)?.to_dtype(w.dtype())?.affine(2.0, -1.0)?;
    quats_wxyz.broadcast_mul(&sign)
}

/// The embeddings' attributes in tensor operations: μ `[n,3]`, s `[n,3]`, q `[n,4]`,
/// α `[n,1]`.
fn attributes(config: &Embed, parents: &ParentChunk, frames: &Frames) -> Result<[Tensor; 4]> {
    let source = &frames.0[parents.source];
    let frame = match config.anchor_frame {
        AnchorFrame::World => None,
        AnchorFrame::SrcCam => Some(source),
        AnchorFrame::View0 => Some(&frames.0[0]),
    };
    let (mean, quat) = match frame {
        None => (parents.means.clone(), parents.quats_wxyz.clone()),
        Some(f) => (f.to_camera(&parents.means)?, f.quat_to_camera(&parents.quats_wxyz)?),
    };
    let mean = match config.mu {
        MuInput::Raw => mean,
        MuInput::RayLogz => {
            let z = mean.narrow(1, 2, 1)?.maximum(Z_MIN)?;
            let slopes = mean.narrow(1, 0, 2)?.broadcast_div(&z)?;
            Tensor::cat(&[&slopes.clamp(-SLOPE_MAX, SLOPE_MAX)?, &z.log()?], 1)?
        }
    };
    let scale = match config.scale {
        ScaleInput::Raw => parents.scales.clone(),
        ScaleInput::LogPx => {
            let z = source.to_camera(&parents.means)?.narrow(1, 2, 1)?.maximum(Z_MIN)?;
            let fx = f64::from(source.camera.intrinsics().fx);
            let log = parents.scales.maximum(SCALE_MIN)?.log()?;
            log.broadcast_sub(&z.log()?.affine(1.0, -fx.ln())?)?
        }
    };
    let alpha = match config.alpha {
        AlphaInput::Raw => parents.opacities.clone(),
        AlphaInput::Logit => {
            let low = 1.0 / (1.0 + LOGIT_MAX.exp());
            let p = parents.opacities.clamp(low, 1.0 - low)?;
            (p.log()? - p.affine(-1.0, 1.0)?.log()?)?
        }
    };
    Ok([mean, scale, canonical(&quat)?, alpha])
}

#[test]
fn attributes_are_those_of_tensor_operations_and_so_is_their_gradient() -> Result<()> {
    let camera = |angle: f32| {
        let k = Intrinsics { fx: 50.0, fy: 55.0, cx: 16.0, cy: 12.0, width: 32, height: 24 };
        let at = Mat4::from_rotation_translation(
            Quat::from_rotation_y(angle) * Quat::from_rotation_x(0.3),
            Vec3::new(angle, -0.2, 0.1),
        );
        Camera::new(k, at).map_err(candle_core::Error::wrap)
    };
    let frames = Frames::new(&[camera(0.2)?, camera(-0.5)?], DType::F64, &Device::Cpu)?;
    let rows = parents(41)?;
    let weights = Weights::seeded(1);
    for (preset, frame) in [
        (Preset::Tuned, AnchorFrame::SrcCam),
        (Preset::Tuned, AnchorFrame::View0),
        (Preset::Paper, AnchorFrame::World),
    ] {
        let config = Embed { anchor_frame: frame, ..Config::small(preset, 2).embed };
        let embeddings = Embeddings::new(&config, 12, weights.builder())?;
        let run = |fused: bool| -> Result<(Vec<f64>, Vec<f64>)> {
            let part = |first, width| rows.narrow(1, first, width);
            let chunk = ParentChunk {
                first: 0,
                source: 1,
                means: part(0, 3)?,
                quats_wxyz: part(3, 4)?,
                scales: part(7, 3)?,
                opacities: part(10, 1)?,
                sh: Tensor::zeros((41, 12), DType::F64, &Device::Cpu)?,
            };
            let all = if fused {
                embeddings.attributes(&chunk, &frames)?
            } else {
                Tensor::cat(&attributes(&config, &chunk, &frames)?, 1)?
            };
            let weight: Vec<f64> = (0..41 * 11).map(|i| (i as f64 * 0.61).cos()).collect();
            let weight = Tensor::from_vec(weight, (41, 11), &Device::Cpu)?;
            let store = (&all * weight)?.sum_all()?.backward()?;
            let Some(gradient) = store.get(&rows) else { candle_core::bail!("no gradient") };
            Ok((all.flatten_all()?.to_vec1()?, gradient.flatten_all()?.to_vec1()?))
        };
        let (got, want) = (run(true)?, run(false)?);
        for (a, b) in got.0.iter().zip(&want.0).chain(got.1.iter().zip(&want.1)) {
            assert!((a - b).abs() < 1e-9 * (1.0 + b.abs()), "{preset:?} {frame:?}: {a} {b}");
        }
    }
    Ok(())
}

fn noise(n: usize, width: usize, k: f32) -> Result<Var> {
    let data: Vec<f32> = (0..n * width).map(|i| ((i as f32 + 0.5) * k).sin() + 0.2).collect();
    Var::from_tensor(&Tensor::from_vec(data, (n, width), &Device::Cpu)?)
}

/// Values and gradients of `f` of `x`, and of `g` of the same in f64.
fn beside(
    x: &[Var],
    f: impl Fn(&[Tensor]) -> Result<Tensor>,
    g: impl Fn(&[Tensor]) -> Result<Tensor>,
) -> Result<()> {
    let wide: Vec<Var> =
        x.iter().map(|v| Var::from_tensor(&v.to_dtype(DType::F64)?)).collect::<Result<_>>()?;
    let tensors = |x: &[Var]| x.iter().map(|v| v.as_tensor().clone()).collect::<Vec<_>>();
    let (got, want) = (f(&tensors(x))?, g(&tensors(&wide))?);
    let weight: Vec<f64> = (0..want.elem_count()).map(|i| (i as f64 * 0.61).cos()).collect();
    let weight = Tensor::from_vec(weight, want.dims(), &Device::Cpu)?;
    let got_store = (&got * weight.to_dtype(DType::F32)?)?.sum_all()?.backward()?;
    let want_store = (&want * &weight)?.sum_all()?.backward()?;
    let mut pairs = vec![(got, want)];
    for (a, b) in x.iter().zip(&wide) {
        pairs.push((got_store.get(a).unwrap().clone(), want_store.get(b).unwrap().clone()));
    }
    for (which, (got, want)) in pairs.into_iter().enumerate() {
        assert_eq!(got.dims(), want.dims());
        let want = want.flatten_all()?.to_vec1::<f64>()?;
        let size = want.iter().fold(0f64, |m, v| m.max(v.abs()));
        assert!(size > 0.0, "{which} is nothing");
        for (a, b) in got.flatten_all()?.to_vec1::<f32>()?.into_iter().zip(want) {
            assert!((f64::from(a) - b).abs() < 1e-5 * (1.0 + size), "{which}: {a} {b}");
        }
    }
    Ok(())
}

#[test]
fn columns_are_cat() -> Result<()> {
    // More rows than a task takes.
    let x = [noise(293, 5, 0.71)?, noise(293, 3, 1.3)?, noise(293, 7, 0.37)?];
    let cat = |x: &[Tensor]| Tensor::cat(x, 1);
    beside(&x, |x| cat_columns(&x[0], &x[1], Some(&x[2])), cat)?;
    beside(&x[..2], |x| cat_columns(&x[0], &x[1], None), cat)?;
    assert!(cat_columns(x[0].as_tensor(), noise(294, 3, 1.0)?.as_tensor(), None).is_err());
    Ok(())
}

#[test]
fn linear_layers_are_products_over_many_parts() -> Result<()> {
    let bias = Var::from_tensor(&noise(1, 11, 2.1)?.squeeze(0)?)?;
    let x = [noise(2 * 1024 + 37, 19, 0.71)?, noise(11, 19, 1.3)?, bias];
    let plain = |x: &[Tensor]| x[0].matmul(&x[1].t()?)?.broadcast_add(&x[2]);
    beside(&x, |x| linear(&x[0], &x[1], &x[2]), plain)
}

#[test]
fn layer_norm_is_its_definition() -> Result<()> {
    let row = |k: f32| Var::from_tensor(&noise(1, 37, k)?.squeeze(0)?);
    let x = [noise(1000, 37, 0.71)?, row(1.3)?, row(0.4)?];
    let plain = |x: &[Tensor]| {
        let centred = x[0].broadcast_sub(&x[0].mean_keepdim(1)?)?;
        let scale = (centred.sqr()?.mean_keepdim(1)? + 1e-5)?.sqrt()?;
        centred.broadcast_div(&scale)?.broadcast_mul(&x[1])?.broadcast_add(&x[2])
    };
    beside(&x, |x| layer_norm(&x[0], &x[1], &x[2]), plain)
}
