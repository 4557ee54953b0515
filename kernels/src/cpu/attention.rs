//! Scaled dot-product attention in blocks of query rows: the logits of one block
//! exist at a time, never the whole matrix.
//!
//! q `[R, L, d]`, k `[R, M, d]`, v `[R, M, e]`, out `[R, L, e]`. R counts
//! independent windows or heads. An optional mask adds [`PENALTY`] where the labels
//! of query and key differ (Swin's shifted windows; MVSplat section 2).

use super::gemm::{Base, Mat, Packed, gemm, product};
use super::simd::{Kernel, Simd, SimdLevel};
use super::softmax::exp_row;
use super::sums::dot;
use rayon::prelude::*;

/// Added to the logit of a masked pair: −100, not −∞ (Swin).
pub const PENALTY: f32 = -100.0;
/// Logits of one block, elements: 512 KiB.
const BLOCK: usize = 131_072;

/// Labels of query and key positions for each of `windows` windows; row r of q uses
/// window r mod `windows`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Labels {
    /// Number of windows.
    pub windows: usize,
    /// `[windows, L]`.
    pub queries: Vec<u8>,
    /// `[windows, M]`.
    pub keys: Vec<u8>,
}

/// Sizes and constants of one call.
#[derive(Clone, Debug, PartialEq)]
pub struct Attention {
    /// L: queries of a row.
    pub queries: usize,
    /// M: keys of a row.
    pub keys: usize,
    /// d: width of queries and keys.
    pub width: usize,
    /// e: width of values.
    pub value_width: usize,
    /// Factor of the dot product.
    pub scale: f32,
    /// Mask, if any.
    pub labels: Option<Labels>,
}

impl Attention {
    fn block(&self) -> usize {
        (BLOCK / self.keys.max(1)).clamp(16, 128).min(self.queries.max(1))
    }

    /// Row `r`, queries from `first`: e^{logit − max} in `p` `[rows, M]`, and 1/Σ of
    /// every row.
    fn weights(
        &self,
        (r, first): (usize, usize),
        q: &[f32],
        k: &Packed,
        p: &mut [f32],
    ) -> Vec<f32> {
        let rows = p.len() / self.keys;
        let m = self.keys;
        let d = self.width;
        product((p, m), Mat::new(q, rows, d, d), k, self.scale, Base::Zero);
        let labels = self.labels.as_ref().map(|l| {
            let w = r % l.windows;
            let queries = &l.queries[w * self.queries + first..][..rows];
            (queries, &l.keys[w * m..(w + 1) * m])
        });
        SimdLevel::best().run(Weigh { p, keys: m, labels })
    }
}

/// Logits to weights, row by row.
struct Weigh<'a> {
    p: &'a mut [f32],
    keys: usize,
    /// Of the rows, and of the keys.
    labels: Option<(&'a [u8], &'a [u8])>,
}

impl Kernel for Weigh<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Vec<f32> {
        let mut inverse = Vec::with_capacity(self.p.len() / self.keys);
        for (i, row) in self.p.chunks_exact_mut(self.keys).enumerate() {
            if let Some((queries, keys)) = self.labels {
                let own = queries[i];
                for (x, &label) in row.iter_mut().zip(keys) {
                    *x += if label == own { 0.0 } else { PENALTY };
                }
            }
            inverse.push(1.0 / exp_row(s, row));
        }
        inverse
    }
}

/// out = softmax(scale·q·kᵀ + mask)·v.
pub fn forward(a: &Attention, q: &[f32], k: &[f32], v: &[f32], out: &mut [f32]) {
    let (l, m, d, e) = (a.queries, a.keys, a.width, a.value_width);
    if out.is_empty() || m == 0 {
        out.fill(0.0);
        return;
    }
    let block = a.block();
    let pack = |r: usize| {
        let k = Mat::new(&k[r * m * d..(r + 1) * m * d], m, d, d).t();
        let v = Mat::new(&v[r * m * e..(r + 1) * m * e], m, e, e);
        (Packed::new(k), Packed::new(v))
    };
    let packed: Vec<_> = (0..out.len() / (l * e)).into_par_iter().map(pack).collect();
    let jobs: Vec<(usize, usize, &mut [f32])> = out
        .chunks_exact_mut(l * e)
        .enumerate()
        .flat_map(|(r, rows)| {
            rows.chunks_mut(block * e).enumerate().map(move |(i, part)| (r, i * block, part))
        })
        .collect();
    jobs.into_par_iter().for_each_init(Vec::new, |p, (r, first, part)| {
        let rows = part.len() / e;
        p.resize(rows * m, 0.0);
        let q = &q[(r * l + first) * d..][..rows * d];
        let (k, v) = &packed[r];
        let inverse = a.weights((r, first), q, k, p);
        product((part, e), Mat::new(p, rows, m, m), v, 1.0, Base::Zero);
        for (row, inverse) in part.chunks_exact_mut(e).zip(inverse) {
            row.iter_mut().for_each(|x| *x *= inverse);
        }
    });
}

/// Arguments of [`backward`].
pub struct Saved<'a> {
    /// Queries.
    pub q: &'a [f32],
    /// Keys.
    pub k: &'a [f32],
    /// Values.
    pub v: &'a [f32],
    /// Result of [`forward`].
    pub out: &'a [f32],
    /// ∂L/∂out.
    pub grad: &'a [f32],
}

/// Computes (dq, dk, dv). It recomputes the weights block by block.
pub fn backward(a: &Attention, s: &Saved<'_>) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let (l, m, d, e) = (a.queries, a.keys, a.width, a.value_width);
    let mut dq = vec![0f32; s.q.len()];
    let mut dk = vec![0f32; s.k.len()];
    let mut dv = vec![0f32; s.v.len()];
    if [l, m, d, e].contains(&0) {
        return (dq, dk, dv);
    }
    let grads = dq
        .par_chunks_exact_mut(l * d)
        .zip(dk.par_chunks_exact_mut(m * d))
        .zip(dv.par_chunks_exact_mut(m * e));
    grads.enumerate().for_each(|(r, ((dq, dk), dv))| {
        let (k, v) = (&s.k[r * m * d..(r + 1) * m * d], &s.v[r * m * e..(r + 1) * m * e]);
        let packed = Packed::new(Mat::new(k, m, d, d).t());
        let values = Packed::new(Mat::new(v, m, e, e).t());
        let (mut p, mut ds) = (Vec::new(), Vec::new());
        for first in (0..l).step_by(a.block()) {
            let rows = a.block().min(l - first);
            p.resize(rows * m, 0.0);
            ds.resize(rows * m, 0.0);
            let q = &s.q[(r * l + first) * d..][..rows * d];
            let grad = &s.grad[(r * l + first) * e..][..rows * e];
            let out = &s.out[(r * l + first) * e..][..rows * e];
            let inverse = a.weights((r, first), q, &packed, &mut p);
            // dS = P·(dO·Vᵀ − dO·O).
            product((&mut ds, m), Mat::new(grad, rows, e, e), &values, 1.0, Base::Zero);
            for (i, (p, ds)) in p.chunks_exact_mut(m).zip(ds.chunks_exact_mut(m)).enumerate() {
                let own = dot(&grad[i * e..(i + 1) * e], &out[i * e..(i + 1) * e]);
                for (p, ds) in p.iter_mut().zip(ds) {
                    *p *= inverse[i];
                    *ds = *p * (*ds - own);
                }
            }
            let dqr = &mut dq[first * d..(first + rows) * d];
            gemm(dqr, d, Mat::new(&ds, rows, m, m), Mat::new(k, m, d, d), a.scale, false);
            gemm(dk, d, Mat::new(&ds, rows, m, m).t(), Mat::new(q, rows, d, d), a.scale, true);
            gemm(dv, e, Mat::new(&p, rows, m, m).t(), Mat::new(grad, rows, e, e), 1.0, true);
        }
    });
    (dq, dk, dv)
}
