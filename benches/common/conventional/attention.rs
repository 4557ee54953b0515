//! Dot-product attention over bilinear samples as a chain of tensor operations:
//! `index_select` of four taps, weighted sums, softmax over the views.

use candle_core::{D, DType, Result, Tensor};
use candle_nn::ops::softmax;

/// Sizes of one call.
#[derive(Clone, Copy)]
pub struct Size {
    /// V.
    pub views: usize,
    /// Rows and columns of each view's map.
    pub map: [usize; 2],
    /// E; keys are channels 0..E of a cell, values E..2E.
    pub dim: usize,
    /// Factor of the dot product.
    pub scale: f64,
}

/// Returns the attention `[N, E]` of maps `[V·h·w, 2E]`, query `[N, E]`, bias `[N, V]`, gate `[N,
/// V]` and points `[N, V, 1, 2]` in (0, 1)²: one sample per view, half-pixel centres, zeros
/// outside.
pub fn gather(
    maps: &Tensor,
    query: &Tensor,
    bias: &Tensor,
    gate: &Tensor,
    points: &Tensor,
    size: Size,
) -> Result<Tensor> {
    let n = query.dim(0)?;
    let (e, v) = (size.dim, size.views);
    let sampled = sample(maps, points, size)?.reshape((n, v, 2 * e))?;
    let (keys, values) = (sampled.narrow(2, 0, e)?, sampled.narrow(2, e, e)?);
    let logits = keys.broadcast_mul(&query.unsqueeze(1)?)?.sum(D::Minus1)?;
    let logits = (logits.affine(size.scale, 0.0)? + bias)?;
    let weights = softmax(&logits, D::Minus1)?.mul(gate)?;
    values.broadcast_mul(&weights.unsqueeze(2)?)?.sum(1)
}

/// `[N·V, 2E]`.
fn sample(maps: &Tensor, points: &Tensor, size: Size) -> Result<Tensor> {
    let ([h, w], v) = (size.map, size.views);
    let n = points.dim(0)?;
    let points = points.squeeze(2)?;
    let axis = |i: usize, side: usize| -> Result<(Tensor, Tensor)> {
        let at = points.narrow(2, i, 1)?.squeeze(2)?.affine(side as f64, -0.5)?;
        let low = at.detach().floor()?;
        let share = at.sub(&low)?;
        Ok((low, share))
    };
    let ((x0, fx), (y0, fy)) = (axis(0, w)?, axis(1, h)?);
    let first: Vec<f32> = (0..n * v).map(|i| (i % v * h * w) as f32).collect();
    let first = Tensor::from_vec(first, (n, v), points.device())?;
    let mut total: Option<Tensor> = None;
    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
        let (x, y) = (x0.affine(1.0, dx)?, y0.affine(1.0, dy)?);
        let inside = |t: &Tensor, side: usize| -> Result<Tensor> {
            t.ge(0.0)?.mul(&t.lt(side as f64)?)?.to_dtype(DType::F32)
        };
        let seen = inside(&x, w)?.mul(&inside(&y, h)?)?;
        let (x, y) = (x.clamp(0.0, (w - 1) as f64)?, y.clamp(0.0, (h - 1) as f64)?);
        let cell = (y.affine(w as f64, 0.0)? + x)?.add(&first)?.flatten_all()?;
        let part = |f: &Tensor, d: f64| if d == 0.0 { f.affine(-1.0, 1.0) } else { Ok(f.clone()) };
        let weight = part(&fx, dx)?.mul(&part(&fy, dy)?)?.mul(&seen)?.reshape((n * v, 1))?;
        let taps = maps.index_select(&cell.to_dtype(DType::U32)?, 0)?.broadcast_mul(&weight)?;
        total = Some(match total {
            Some(t) => t.add(&taps)?,
            None => taps,
        });
    }
    total.ok_or_else(|| candle_core::Error::Msg("no taps".to_owned()))
}
