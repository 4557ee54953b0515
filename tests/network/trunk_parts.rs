//! Ops of the trunk beside tensor operations: attributes of parents, columns, linear
//! layers and LayerNorm, values and gradients.

use candle_core::{DType, Device, Result, Tensor, Var};
use glam::{Mat4, Quat, Vec3};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::config::{AnchorFrame, Config, Embed, Preset};
use subsplat::model::embed::Embeddings;
use subsplat::model::geometry::{Frames, ParentChunk};
use subsplat::model::weights::Weights;
use subsplat::ops::columns::columns;
use subsplat::ops::linear::linear;
use subsplat::ops::norm::layer_norm;

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
            let all = match fused {
                true => embeddings.attributes(&chunk, &frames)?,
                false => Tensor::cat(&embeddings.inputs(&chunk, &frames)?, 1)?,
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
    beside(&x, |x| columns(&x[0], &x[1], Some(&x[2])), cat)?;
    beside(&x[..2], |x| columns(&x[0], &x[1], None), cat)?;
    assert!(columns(x[0].as_tensor(), noise(294, 3, 1.0)?.as_tensor(), None).is_err());
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
