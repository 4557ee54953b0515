//! Gradient of the correlation with respect to both feature maps; the sampling grid
//! is a constant (MVSplat section 3).
//!
//! For pixel i and source cell j the correlation is Σ_k G_k·w_kj·(f_i·g_j), so all
//! that the gradients need is one coefficient c_ij = scale/pairs · Σ_k G_k·w_kj per
//! pixel and distinct cell: ∂f_i = Σ_j c_ij·g_j, ∂g_j = Σ_i c_ij·f_i. The coefficients
//! of one pair of views are listed by pixel, then by cell (a counting sort), and each
//! row is summed by one task in a fixed order: no two threads write one number, and
//! the sums do not depend on how many threads there are.

use super::{Pair, Sweep, Walk, channels_last};
use crate::cpu::simd::vectorize;
use rayon::prelude::*;

/// Coefficients c_ij of one pair of views, by row: entries `starts[i]..starts[i + 1]`
/// of `entries` are (column, c_ij), columns in a fixed order.
struct Sparse {
    starts: Vec<usize>,
    entries: Vec<(u32, f32)>,
}

impl Sparse {
    /// The same numbers by column.
    fn transposed(&self) -> Self {
        let n = self.starts.len() - 1;
        let mut starts = vec![0; n + 1];
        for &(j, _) in &self.entries {
            starts[j as usize + 1] += 1;
        }
        for j in 0..n {
            starts[j + 1] += starts[j];
        }
        let mut next = starts.clone();
        let mut entries = vec![(0, 0.0); self.entries.len()];
        for i in 0..n {
            for &(j, c) in &self.entries[self.starts[i]..self.starts[i + 1]] {
                entries[next[j as usize]] = (i as u32, c);
                next[j as usize] += 1;
            }
        }
        Self { starts, entries }
    }

    /// out_i += Σ_j c_ij·rows_j, for `[n, channels]` in and out.
    fn add_product(&self, rows: &[f32], channels: usize, out: &mut [f32]) {
        out.par_chunks_exact_mut(channels).enumerate().for_each(|(i, out)| {
            vectorize(
                #[inline(always)]
                || {
                    for &(j, c) in &self.entries[self.starts[i]..self.starts[i + 1]] {
                        let row = &rows[j as usize * channels..][..channels];
                        for (o, v) in out.iter_mut().zip(row) {
                            *o += c * v;
                        }
                    }
                },
            );
        });
    }
}

/// One line of pixels: the number of entries of each pixel, and the entries.
type Line = (Vec<usize>, Vec<(u32, f32)>);

/// c_ij of reference row `r` and one of its pairs, by reference pixel.
fn coefficients(s: &Sweep, r: usize, pair: &Pair, grad: &[f32]) -> Sparse {
    let ([h, w], d) = (s.size, s.candidates());
    let factor = s.scale / s.pairs[r].len().max(1) as f32;
    let rows: Vec<Line> = (0..h)
        .into_par_iter()
        .map_init(
            || Walk::new(s),
            |walk, y| {
                let mut lengths = Vec::with_capacity(w);
                let mut entries = Vec::new();
                for x in 0..w {
                    walk.begin(s, pair, (x, y), &s.depths[r]);
                    let first = entries.len();
                    for k in 0..d {
                        let g = factor * grad[((r * d + k) * h + y) * w + x];
                        let Some(at) = s.sample(walk.u[k], walk.v[k]) else { continue };
                        for (tap, weight) in at.taps.into_iter().zip(at.weights) {
                            if weight != 0.0 {
                                let sum = walk.value(tap, || {
                                    entries.push((tap as u32, 0.0));
                                    0.0
                                });
                                *sum += weight * g;
                            }
                        }
                    }
                    for (tap, c) in &mut entries[first..] {
                        *c = walk.cells[*tap as usize].value;
                    }
                    lengths.push(entries.len() - first);
                }
                (lengths, entries)
            },
        )
        .collect();
    let mut starts = vec![0];
    let mut end = 0;
    for length in rows.iter().flat_map(|(lengths, _)| lengths) {
        end += length;
        starts.push(end);
    }
    Sparse { starts, entries: rows.into_iter().flat_map(|(_, entries)| entries).collect() }
}

/// Gradients `([R, C, h, w], [S, C, h, w])` for `grad` `[R, D, h, w]`.
pub fn backward(
    s: &Sweep,
    reference: &[f32],
    source: &[f32],
    grad: &[f32],
) -> (Vec<f32>, Vec<f32>) {
    let ([h, w], c) = (s.size, s.channels);
    let n = h * w;
    let (mut d_reference, mut d_source) = (vec![0.0; reference.len()], vec![0.0; source.len()]);
    if n * c == 0 {
        return (d_reference, d_source);
    }
    let reference = channels_last(c, n, reference);
    let source = channels_last(c, n, source);
    for (r, pairs) in s.pairs.iter().enumerate() {
        let own = r * n * c..(r + 1) * n * c;
        for pair in pairs {
            let other = pair.source * n * c..(pair.source + 1) * n * c;
            let by_pixel = coefficients(s, r, pair, grad);
            by_pixel.add_product(&source[other.clone()], c, &mut d_reference[own.clone()]);
            let by_cell = by_pixel.transposed();
            by_cell.add_product(&reference[own.clone()], c, &mut d_source[other]);
        }
    }
    // `[rows, n, C]` back to `[rows, C, n]`.
    (channels_last(n, c, &d_reference), channels_last(n, c, &d_source))
}
