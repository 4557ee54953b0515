//! Comparison of a custom op with its definition in tensor operations: values and
//! gradients.

use candle_core::backprop::GradStore;
use candle_core::{Device, Result, Tensor, Var, bail};

/// Returns numbers in (−2, 2) from a formula; the same for the same `seed`.
pub fn noise(shape: &[usize], seed: usize) -> Result<Tensor> {
    let n: usize = shape.iter().product();
    let at = |i: usize| (((i + 131 * seed) as f32 * 12.9898).sin() * 43758.547).fract();
    Tensor::from_vec((0..n).map(|i| 2.0 * at(i)).collect::<Vec<f32>>(), shape, &Device::Cpu)
}

/// Returns the largest absolute difference.
pub fn far(a: &Tensor, b: &Tensor) -> Result<f32> {
    assert_eq!(a.dims(), b.dims());
    (a - b)?.abs()?.flatten_all()?.max(0)?.to_scalar()
}

/// Checks values and gradients of `ours` against those of `plain`, which consists of
/// tensor operations, for the loss Σ out·r over all outputs.
pub fn same(
    inputs: &[Tensor],
    ours: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>,
    plain: impl Fn(&[Tensor]) -> Result<Vec<Tensor>>,
) -> Result<()> {
    let vars = inputs.iter().map(Var::from_tensor).collect::<Result<Vec<_>>>()?;
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let (got, want) = (ours(&tensors)?, plain(&tensors)?);
    assert_eq!(got.len(), want.len());
    let (mut got_loss, mut want_loss) =
        (Tensor::new(0f32, &Device::Cpu)?, Tensor::new(0f32, &Device::Cpu)?);
    for (i, (g, w)) in got.iter().zip(&want).enumerate() {
        let size = w.abs()?.flatten_all()?.max(0)?.to_scalar::<f32>()?;
        assert!(far(g, w)? < 1e-5 * (1.0 + size), "output {i}: {}", far(g, w)?);
        let r = noise(w.dims(), 77 + i)?;
        got_loss = (got_loss + (g * &r)?.sum_all()?)?;
        want_loss = (want_loss + (w * &r)?.sum_all()?)?;
    }
    let (got, want) = (got_loss.backward()?, want_loss.backward()?);
    for (i, var) in vars.iter().enumerate() {
        let (g, w) = (gradient(&got, var)?, gradient(&want, var)?);
        let size = w.abs()?.flatten_all()?.max(0)?.to_scalar::<f32>()?;
        assert!(size > 0.0, "gradient {i} is zero");
        assert!(far(&g, &w)? < 3e-5 * (1.0 + size), "gradient {i}: {}", far(&g, &w)?);
    }
    Ok(())
}

/// Returns the gradient by `x` in `store`.
pub fn gradient(store: &GradStore, x: &Tensor) -> Result<Tensor> {
    match store.get(x) {
        Some(gradient) => Ok(gradient.clone()),
        None => bail!("no gradient of {:?}", x.dims()),
    }
}
