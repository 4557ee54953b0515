//! Convex ×4 upsampling (RAFT, 3.3) of two maps under one mask: each fine pixel is a
//! weighted mean of the 3×3 coarse pixels around it, edges repeated; the weights are a
//! softmax over the nine of logits + ln start.
//!
//! Logits `[B, 16·9, h, w]` (fine pixel 4·row + column, then neighbour 3·row + column),
//! maps `[B, h, w]`, out `[2, B, 4h, 4w]`.

use crate::cpu::simd::elementary::exp;
use crate::cpu::simd::vectorize;
use rayon::prelude::*;

const LANES: usize = 16;
const NEIGHBOURS: usize = 9;
const FINE: usize = 16;

/// Sizes, and where the softmax starts.
#[derive(Clone, Debug, PartialEq)]
pub struct Convex {
    /// h, w.
    pub size: [usize; 2],
    /// `[16, 9]`: ln of the shares of a mask of zeros.
    pub start: Vec<f32>,
}

/// Edge pixels of `[h, w]` repeated once on every side.
fn padded(x: &[f32], [h, w]: [usize; 2]) -> Vec<f32> {
    let mut out = Vec::with_capacity((h + 2) * (w + 2));
    for y in 0..h + 2 {
        let row = &x[y.saturating_sub(1).min(h - 1) * w..][..w];
        out.push(row[0]);
        out.extend_from_slice(row);
        out.push(row[w - 1]);
    }
    out
}

/// The transpose of [`padded`], added to `x`.
fn fold_edges(padded: &[f32], [h, w]: [usize; 2], x: &mut [f32]) {
    for (y, row) in padded.chunks_exact(w + 2).enumerate() {
        let x = &mut x[y.saturating_sub(1).min(h - 1) * w..][..w];
        for (x, v) in x.iter_mut().zip(&row[1..]) {
            *x += v;
        }
        x[0] += row[0];
        x[w - 1] += row[w + 1];
    }
}

/// Up to 16 numbers from `at`, zeros beyond `count`.
#[inline(always)]
fn lanes(x: &[f32], at: usize, count: usize) -> [f32; LANES] {
    let from = &x[at..at + count];
    match from.try_into() {
        Ok(whole) => whole,
        Err(_) => std::array::from_fn(|l| from.get(l).copied().unwrap_or(0.0)),
    }
}

impl Convex {
    /// Shares of fine pixel `fine` for up to 16 coarse pixels of a row from `at`
    /// (index in `[h, w]`) of one picture's `logits`.
    #[inline(always)]
    fn shares(
        &self,
        logits: &[f32],
        fine: usize,
        at: usize,
        count: usize,
    ) -> [[f32; LANES]; NEIGHBOURS] {
        let n = self.size[0] * self.size[1];
        let mut p: [[f32; LANES]; NEIGHBOURS] = std::array::from_fn(|k| {
            let start = self.start[fine * NEIGHBOURS + k];
            lanes(logits, (fine * NEIGHBOURS + k) * n + at, count).map(|v| v + start)
        });
        let mut max = p[0];
        for p in &p[1..] {
            for l in 0..LANES {
                max[l] = if p[l] > max[l] { p[l] } else { max[l] };
            }
        }
        let mut sum = [0f32; LANES];
        for p in &mut p {
            for l in 0..LANES {
                p[l] = exp(p[l] - max[l]);
                sum[l] += p[l];
            }
        }
        let inverse = sum.map(|s| 1.0 / s);
        for p in &mut p {
            for l in 0..LANES {
                p[l] *= inverse[l];
            }
        }
        p
    }
}

/// Both maps under the mask.
pub fn forward(c: &Convex, logits: &[f32], maps: [&[f32]; 2], out: &mut [f32]) {
    let [h, w] = c.size;
    let mask = FINE * NEIGHBOURS * h * w;
    let padded: [Vec<Vec<f32>>; 2] =
        maps.map(|m| m.par_chunks_exact(h * w).map(|m| padded(m, c.size)).collect());
    let (first, second) = out.split_at_mut(out.len() / 2);
    let rows = first.par_chunks_exact_mut(FINE * w).zip(second.par_chunks_exact_mut(FINE * w));
    rows.enumerate().for_each(|(i, (first, second))| {
        let (b, y) = (i / h, i % h);
        let logits = &logits[b * mask..(b + 1) * mask];
        let around = [&padded[0][b], &padded[1][b]];
        vectorize(
            #[inline(always)]
            || {
                for x in (0..w).step_by(LANES) {
                    let count = LANES.min(w - x);
                    for fine in 0..FINE {
                        let p = c.shares(logits, fine, y * w + x, count);
                        let to = fine / 4 * 4 * w + 4 * x + fine % 4;
                        for (around, out) in
                            around.iter().zip([&mut first[to..], &mut second[to..]])
                        {
                            let mut sum = [0f32; LANES];
                            for (k, p) in p.iter().enumerate() {
                                let v = lanes(around, (y + k / 3) * (w + 2) + x + k % 3, count);
                                for l in 0..LANES {
                                    sum[l] += p[l] * v[l];
                                }
                            }
                            for (out, sum) in out.iter_mut().step_by(4).zip(&sum[..count]) {
                                *out = *sum;
                            }
                        }
                    }
                }
            },
        );
    });
}

/// Gradients (logits, first map, second map) for `grad` `[2, B, 4h, 4w]`.
pub fn backward(
    c: &Convex,
    logits: &[f32],
    maps: [&[f32]; 2],
    grad: &[f32],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let [h, w] = c.size;
    let n = h * w;
    let padded: [Vec<Vec<f32>>; 2] =
        maps.map(|m| m.par_chunks_exact(n).map(|m| padded(m, c.size)).collect());
    let mut d_logits = vec![0f32; logits.len()];
    let grads = grad.split_at(grad.len() / 2);
    // One task for each picture and fine pixel; its share of the maps' gradients, padded.
    let parts: Vec<[Vec<f32>; 2]> = d_logits
        .par_chunks_exact_mut(NEIGHBOURS * n)
        .enumerate()
        .map(|(task, d_logits)| {
            let (b, fine) = (task / FINE, task % FINE);
            let job = Job {
                convex: c,
                fine,
                logits: &logits[b * FINE * NEIGHBOURS * n..(b + 1) * FINE * NEIGHBOURS * n],
                around: [&padded[0][b], &padded[1][b]],
                grads: [
                    &grads.0[b * FINE * n..(b + 1) * FINE * n],
                    &grads.1[b * FINE * n..(b + 1) * FINE * n],
                ],
            };
            let mut sums = [vec![0f32; (h + 2) * (w + 2)], vec![0f32; (h + 2) * (w + 2)]];
            vectorize(
                #[inline(always)]
                || job.run(d_logits, &mut sums),
            );
            sums
        })
        .collect();
    let of_map = |m: usize| {
        let mut out = vec![0f32; maps[m].len()];
        out.par_chunks_exact_mut(n).zip(parts.par_chunks_exact(FINE)).for_each(|(out, parts)| {
            for part in parts {
                fold_edges(&part[m], c.size, out);
            }
        });
        out
    };
    let (first, second) = (of_map(0), of_map(1));
    (d_logits, first, second)
}

/// The backward pass of one fine pixel of one picture.
struct Job<'a> {
    convex: &'a Convex,
    fine: usize,
    logits: &'a [f32],
    around: [&'a [f32]; 2],
    grads: [&'a [f32]; 2],
}

impl Job<'_> {
    #[inline(always)]
    fn run(&self, d_logits: &mut [f32], sums: &mut [Vec<f32>; 2]) {
        let [h, w] = self.convex.size;
        let n = h * w;
        for y in 0..h {
            for x in (0..w).step_by(LANES) {
                let count = LANES.min(w - x);
                let p = self.convex.shares(self.logits, self.fine, y * w + x, count);
                // Gradient with respect to each share, and its mean under the shares.
                let mut d = [[0f32; LANES]; NEIGHBOURS];
                let mut mean = [0f32; LANES];
                let from = (4 * y + self.fine / 4) * 4 * w + 4 * x + self.fine % 4;
                for ((grad, around), sums) in self.grads.iter().zip(self.around).zip(&mut *sums) {
                    let mut g = [0f32; LANES];
                    for (g, v) in g.iter_mut().zip(grad[from..].iter().step_by(4)).take(count) {
                        *g = *v;
                    }
                    for k in 0..NEIGHBOURS {
                        let at = (y + k / 3) * (w + 2) + x + k % 3;
                        let v = lanes(around, at, count);
                        for l in 0..LANES {
                            d[k][l] += g[l] * v[l];
                            mean[l] += p[k][l] * g[l] * v[l];
                        }
                        for (l, sum) in sums[at..at + count].iter_mut().enumerate() {
                            *sum += p[k][l] * g[l];
                        }
                    }
                }
                for k in 0..NEIGHBOURS {
                    let to = &mut d_logits[k * n + y * w + x..][..count];
                    for (l, to) in to.iter_mut().enumerate() {
                        *to = p[k][l] * (d[k][l] - mean[l]);
                    }
                }
            }
        }
    }
}
