//! Linear layer as a candle op with gradients: y = x·Wᵀ + b.
//!
//! Product and bias are one pass over blocks of rows; the weight is packed once per call.
//! Up to 256 rows run on the caller's thread. Candle's own product distributes every call
//! over all threads, so that calls from several rayon tasks block each other.
//! Kernel: [`subsplat_kernels::cpu::gemm`]. Tests: below (against candle's product).

use super::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Tensor, bail};
use rayon::prelude::*;
use subsplat_kernels::cpu::gemm::{Base, Mat, Packed, gemm, rows_product};

const NAME: &str = "linear";

/// Rows per partial sum of the parameters' gradients. A constant keeps the order of summation
/// independent of the number of threads.
const GRADIENT_ROWS: usize = 1024;

/// Computes y = x·Wᵀ + b: `x` `[N, C]`, `weight` `[O, C]`, `bias` `[O]`, y `[N, O]`, all f32.
///
/// # Errors
/// Where shapes disagree or a dtype is not f32.
pub fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let (o, c) = weight.dims2()?;
    if x.rank() != 2 || x.dims()[1] != c || bias.dims() != [o] {
        bail!("{NAME}: expected x [N, {c}] and bias [{o}], got {:?}, {:?}", x.dims(), bias.dims());
    }
    x.contiguous()?.apply_op3(&weight.contiguous()?, &bias.contiguous()?, Linear)
}

/// Computes y = x·Wᵀ, as [`linear`] without a bias.
///
/// # Errors
/// As [`linear`].
pub fn linear_no_bias(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let (_, c) = weight.dims2()?;
    if x.rank() != 2 || x.dims()[1] != c {
        bail!("{NAME}: expected x [N, {c}], got {:?}", x.dims());
    }
    x.contiguous()?.apply_op2(&weight.contiguous()?, Linear)
}

struct Linear;

/// Computes x `[n, c]` · (w `[o, c]`)ᵀ + b.
fn forward(x: &[f32], w: &[f32], b: Option<&[f32]>, [n, c, o]: [usize; 3]) -> Vec<f32> {
    let base = b.map_or(Base::Zero, Base::Row);
    Packed::with(Mat::new(w, o, c, c).t(), |w| rows_product(Mat::new(x, n, c, c), w, base))
}

impl CustomOp2 for Linear {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, candle_core::Shape)> {
        let x = slice::<f32>(NAME, "x", s1, l1)?;
        let w = slice::<f32>(NAME, "weight", s2, l2)?;
        let (n, c) = l1.shape().dims2()?;
        let o = l2.dims()[0];
        output(forward(x, w, None, [n, c, o]), (n, o))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (dx, dw, _) = gradients(x, w, dy)?;
        Ok((dx, Some(dw)))
    }
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, candle_core::Shape)> {
        let x = slice::<f32>(NAME, "x", s1, l1)?;
        let w = slice::<f32>(NAME, "weight", s2, l2)?;
        let b = slice::<f32>(NAME, "bias", s3, l3)?;
        let (n, c) = l1.shape().dims2()?;
        output(forward(x, w, Some(b), [n, c, b.len()]), (n, b.len()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _b: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (dx, dw, db) = gradients(x, w, dy)?;
        Ok((dx, Some(dw), Some(db)))
    }
}

/// Computes the gradients of x (if x is tracked), weight and bias.
fn gradients(x: &Tensor, w: &Tensor, dy: &Tensor) -> Result<(Option<Tensor>, Tensor, Tensor)> {
    let (o, c) = w.dims2()?;
    let dy = dy.contiguous()?;
    let tracked = x.track_op();
    let (dx, dw, db) = borrowed(NAME, [x, w, &dy], |[x, w, dy]: [&[f32]; 3]| {
        let dx = match (tracked, o > 0 && c > 0) {
            (false, _) => None,
            (true, true) => Some(input_grad(dy, w, [o, c])),
            (true, false) => Some(vec![0.0; x.len()]),
        };
        let (dw, db) = parameter_grads(x, dy, [o, c]);
        (dx, dw, db)
    })?;
    let dx = dx.map(|dx| tensor_like(dx, x)).transpose()?;
    Ok((dx, tensor_like(dw, w)?, Tensor::from_vec(db, o, x.device())?))
}

/// Computes dx = dy `[N, O]` · W `[O, C]`.
fn input_grad(dy: &[f32], w: &[f32], [o, c]: [usize; 2]) -> Vec<f32> {
    let dy = Mat::new(dy, dy.len() / o, o, o);
    Packed::with(Mat::new(w, o, c, c), |w| rows_product(dy, w, Base::Zero))
}

/// Computes dW = dyᵀ·x `[O, C]` and db = column sums of dy `[O]`, in parts of
/// [`GRADIENT_ROWS`] rows that are added in order.
fn parameter_grads(x: &[f32], dy: &[f32], [o, c]: [usize; 2]) -> (Vec<f32>, Vec<f32>) {
    let mut dw = vec![0f32; o * c];
    let mut db = vec![0f32; o];
    if o * c == 0 {
        return (dw, db);
    }
    let part = |(x, dy): (&[f32], &[f32])| {
        let rows = dy.len() / o;
        let mut dw = vec![0f32; o * c];
        gemm(&mut dw, c, Mat::new(dy, rows, o, o).t(), Mat::new(x, rows, c, c), 1.0, false);
        let mut db = vec![0f32; o];
        for row in dy.chunks_exact(o) {
            db.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
        }
        (dw, db)
    };
    let parts: Vec<_> =
        x.par_chunks(GRADIENT_ROWS * c).zip(dy.par_chunks(GRADIENT_ROWS * o)).map(part).collect();
    for (part_w, part_b) in &parts {
        dw.iter_mut().zip(part_w).for_each(|(sum, v)| *sum += v);
        db.iter_mut().zip(part_b).for_each(|(sum, v)| *sum += v);
    }
    (dw, db)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    /// Returns y and the gradients (dx, dw, db) of Σ y·r.
    fn run(f: impl Fn(&Tensor, &Tensor, &Tensor) -> Result<Tensor>) -> Result<[Vec<f32>; 4]> {
        let number = |i: usize, k: f32| ((i as f32 + 0.5) * k).sin();
        let make = |n: usize, k: f32, shape: &[usize]| {
            let data: Vec<f32> = (0..n).map(|i| number(i, k)).collect();
            Var::from_tensor(&Tensor::from_vec(data, shape, &Device::Cpu)?)
        };
        // One full block of rows and one that is not full.
        let n = 256 + 37;
        let c = 19;
        let o = 11;
        let x = make(n * c, 0.71, &[n, c])?;
        let w = make(o * c, 1.3, &[o, c])?;
        let b = make(o, 2.1, &[o])?;
        let y = f(&x, &w, &b)?;
        let r = make(n * o, 0.37, &[n, o])?;
        let grads = (&y * r.as_tensor())?.sum_all()?.backward()?;
        let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let grad = |v: &Var| match grads.get(v) {
            Some(g) => flat(g),
            None => bail!("no gradient"),
        };
        Ok([flat(&y)?, grad(&x)?, grad(&w)?, grad(&b)?])
    }

    #[test]
    fn output_and_gradients_agree_with_candle() -> Result<()> {
        let ours = run(linear)?;
        let theirs = run(|x, w, b| x.matmul(&w.t()?)?.broadcast_add(b))?;
        for (a, b) in ours.iter().zip(&theirs) {
            assert_eq!(a.len(), b.len());
            for (a, b) in a.iter().zip(b) {
                assert!((a - b).abs() < 1e-4, "{a} {b}");
            }
        }
        Ok(())
    }

    #[test]
    fn wrong_shapes_are_errors() -> Result<()> {
        let zeros = |shape: &[usize]| Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu);
        let w = zeros(&[2, 3])?;
        let b = zeros(&[2])?;
        assert!(linear(&zeros(&[5, 4])?, &w, &b).is_err());
        assert!(linear(&zeros(&[5, 3])?, &w, &zeros(&[3])?).is_err());
        assert_eq!(linear(&zeros(&[0, 3])?, &w, &b)?.dims(), [0, 2]);
        Ok(())
    }
}
