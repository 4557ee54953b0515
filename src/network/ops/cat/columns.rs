//! Columns of two or three matrices as a candle op with gradients. Tests:
//! tests/network/trunk_parts.rs.

use crate::network::ops::{Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

const NAME: &str = "cat columns";
/// Rows per task.
const BLOCK: usize = 256;

/// Concatenates `[n, a]`, `[n, b]` and, if there is one, `[n, c]` to `[n, a + b + c]`; f32 or f64.
///
/// # Errors
/// Another rank, another number of rows, no columns at all, mixed dtypes.
pub fn cat_columns(first: &Tensor, second: &Tensor, third: Option<&Tensor>) -> Result<Tensor> {
    let (n, a) = first.dims2()?;
    let (m, b) = second.dims2()?;
    let (k, c) = third.map_or(Ok((n, 0)), Tensor::dims2)?;
    if m != n || k != n || a + b + c == 0 {
        bail!("{NAME}: expected as many rows in each, got {:?} and {:?}", first.dims(), (m, k));
    }
    let (first, second) = (first.contiguous()?, second.contiguous()?);
    match third {
        Some(third) => first.apply_op3(&second, &third.contiguous()?, Columns([a, b, c])),
        None => first.apply_op2(&second, Columns([a, b, 0])),
    }
}

/// Widths.
struct Columns([usize; 3]);

fn concatenated<T: Number>(
    widths: [usize; 3],
    rows: usize,
    parts: &[(&CpuStorage, &Layout)],
) -> Result<(CpuStorage, Shape)> {
    let width: usize = widths.iter().sum();
    let mut slices: [&[T]; 3] = [&[]; 3];
    for (to, (storage, layout)) in slices.iter_mut().zip(parts) {
        *to = slice::<T>(NAME, "part", storage, layout)?;
    }
    let mut out = vec![T::default(); rows * width];
    out.par_chunks_mut(BLOCK * width).enumerate().for_each(|(block, out)| {
        for (i, mut row) in out.chunks_exact_mut(width).enumerate() {
            for (part, w) in slices.iter().zip(widths) {
                let (own, rest) = row.split_at_mut(w);
                own.copy_from_slice(&part[(block * BLOCK + i) * w..][..w]);
                row = rest;
            }
        }
    });
    Ok((T::to_cpu_storage_owned(out), Shape::from((rows, width))))
}

/// The part of `dy` `[n, width]` that begins at column `first` and is as wide as `like`.
fn part<T: Number>(dy: &Tensor, like: &Tensor, first: usize) -> Result<Option<Tensor>> {
    if !like.track_op() {
        return Ok(None);
    }
    let (_, width) = dy.dims2()?;
    let (_, w) = like.dims2()?;
    let mut dx = vec![T::default(); like.elem_count()];
    borrowed::<T, _, 1>(NAME, [dy], |[dy]| {
        let blocks = dx.par_chunks_mut((BLOCK * w).max(1)).zip(dy.par_chunks(BLOCK * width));
        blocks.for_each(|(dx, dy)| {
            for (dx, dy) in dx.chunks_exact_mut(w).zip(dy.chunks_exact(width)) {
                dx.copy_from_slice(&dy[first..first + w]);
            }
        });
    })?;
    Tensor::from_vec(dx, like.dims(), like.device()).map(Some)
}

impl Columns {
    fn parts<const N: usize>(&self, dy: &Tensor, all: [&Tensor; N]) -> Result<[Option<Tensor>; N]> {
        let dy = dy.contiguous()?;
        let mut out = [const { None }; N];
        let mut first = 0;
        for ((out, like), w) in out.iter_mut().zip(all).zip(self.0) {
            *out = by_dtype!(NAME, dy.dtype(), part(&dy, like, first))?;
            first += w;
        }
        Ok(out)
    }
}

impl CustomOp2 for Columns {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let parts = [(s1, l1), (s2, l2)];
        by_dtype!(NAME, s1.dtype(), concatenated(self.0, l1.dims()[0], &parts))
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [a, b] = self.parts(dy, [a, b])?;
        Ok((a, b))
    }
}

impl CustomOp3 for Columns {
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
    ) -> Result<(CpuStorage, Shape)> {
        let parts = [(s1, l1), (s2, l2), (s3, l3)];
        by_dtype!(NAME, s1.dtype(), concatenated(self.0, l1.dims()[0], &parts))
    }

    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        c: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [a, b, c] = self.parts(dy, [a, b, c])?;
        Ok((a, b, c))
    }
}
