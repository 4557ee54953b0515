//! Normalisations with activations, against tensor operations.

use candle_core::{DType, Device, Result, Tensor};
use subsplat::network::ops::activation::Activation;
use subsplat::network::ops::norm::{
    Affine, group_norm, group_norm_then, instance_norm_then, layer_norm,
};
use subsplat_test_support::same::{noise, same};

fn erf_gelu(x: &Tensor) -> Result<Tensor> {
    ((x / 2f64.sqrt())?.erf()? + 1.0)? * (x * 0.5)?
}

/// `[R, n]` to zero mean and unit variance.
fn unit(x: &Tensor) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(1)?)?;
    centred.broadcast_div(&(centred.sqr()?.mean_keepdim(1)? + 1e-5)?.sqrt()?)
}

fn plain(x: &[Tensor], groups: usize) -> Result<Tensor> {
    let (b, c) = (x[0].dim(0)?, x[1].elem_count());
    let y = unit(&x[0].reshape((b * groups, ()))?)?.reshape(x[0].shape())?;
    let y = y.broadcast_mul(&x[1].reshape((1, c, 1, 1))?)?;
    y.broadcast_add(&x[2].reshape((1, c, 1, 1))?)
}

/// Where e^{-v} leaves the range of f32, and where there is no number.
#[test]
fn silu_of_far_values() -> Result<()> {
    let (w, b) =
        (Tensor::new(&[400f32, -90.0], &Device::Cpu)?, Tensor::zeros(2, DType::F32, &Device::Cpu)?);
    let x = noise(&[1, 2, 5, 9], 7)?;
    let got = group_norm_then(&x, 1, Affine { weight: &w, bias: &b }, Some(Activation::Silu))?;
    let values = group_norm(&x, 1, &w, &b)?.flatten_all()?.to_vec1::<f32>()?;
    assert!(values.iter().any(|v| *v < -300.0) && values.iter().any(|v| *v > 300.0));
    for (got, v) in got.flatten_all()?.to_vec1::<f32>()?.into_iter().zip(values) {
        let want = f64::from(v) / (1.0 + (-f64::from(v)).exp());
        assert!((f64::from(got) - want).abs() <= 1e-6 * want.abs().max(1.0), "{v}: {got} {want}");
    }
    let lost = group_norm_then(
        &(x * f64::NAN)?,
        1,
        Affine { weight: &w, bias: &b },
        Some(Activation::Silu),
    )?;
    assert!(lost.flatten_all()?.to_vec1::<f32>()?.iter().all(|v| v.is_nan()));
    Ok(())
}

#[test]
fn norm_and_activation_agree_with_their_definitions() -> Result<()> {
    let inputs = [noise(&[3, 6, 7, 11], 1)?, noise(&[6], 2)?, noise(&[6], 3)?];
    for (kind, f) in [
        (None, (|x: &Tensor| Ok(x.clone())) as fn(&Tensor) -> Result<Tensor>),
        (Some(Activation::Gelu), erf_gelu),
        (Some(Activation::Silu), |x: &Tensor| x / (x.neg()?.exp()? + 1.0)?),
    ] {
        same(
            &inputs,
            |x| {
                let affine = Affine { weight: &x[1], bias: &x[2] };
                Ok(vec![group_norm_then(&x[0], 3, affine, kind)?])
            },
            |x| Ok(vec![f(&plain(x, 3)?)?]),
        )?;
    }
    same(
        &inputs[..1],
        |x| Ok(vec![instance_norm_then(&x[0], Some(Activation::Silu))?]),
        |x| {
            let y = unit(&x[0].reshape((18, ()))?)?.reshape(x[0].shape())?;
            Ok(vec![(&y / (y.neg()?.exp()? + 1.0)?)?])
        },
    )?;
    // More rows than one task takes; whole vectors, parts of them, long rows.
    for (rows, n) in [(5000, 9), (37, 128), (11, 41), (5, 700)] {
        let inputs = [noise(&[rows, n], 4)?, noise(&[n], 5)?, noise(&[n], 6)?];
        same(
            &inputs,
            |x| Ok(vec![layer_norm(&x[0], &x[1], &x[2])?]),
            |x| Ok(vec![unit(&x[0])?.broadcast_mul(&x[1])?.broadcast_add(&x[2])?]),
        )?;
    }
    Ok(())
}
