//! Matches the features of two photographs by their descriptors, without the poses.
//!
//! A match is a pair of mutual nearest neighbours whose distance is clearly below the distance of
//! the second-nearest descriptor (Lowe, section 7.1).

use super::descriptors::DESCRIPTOR;
use super::features::{Feature, Features};
use rayon::prelude::*;
use subsplat_kernels::cpu::gemm::{Base, Mat, Packed, product};

/// Largest ratio of the nearest descriptor's distance to the second-nearest one's. Lowe (section
/// 7.1) takes 0.8. Required in both directions, 0.85 admits as few wrong matches and finds a tenth
/// more right ones on wide pairs.
const RATIO: f32 = 0.85;
/// A second-nearest feature within this distance of the nearest is the same point, detected twice,
/// px.
const SAME_PLACE_PX: f32 = 3.0;

/// One matched pair of features.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    /// Index into the first picture's features.
    pub a: usize,
    /// Index into the second picture's features.
    pub b: usize,
    /// Distance of the nearest over the second-nearest descriptor: smaller is more certain.
    pub ratio: f32,
}

/// Rows of descriptors whose products with all others are computed at once. 64 × 4000 products are
/// 1 MiB.
const ROWS: usize = 64;

/// Returns the mutual nearest neighbours that pass the ratio test in both directions, the most
/// certain first.
pub(crate) fn pairs(a: &Features, b: &Features) -> Vec<Pair> {
    let (n, m) = (a.points.len(), b.points.len());
    if n == 0 || m == 0 {
        return Vec::new();
    }
    let (forward, backward) = nearest(a, b);
    let mut pairs: Vec<Pair> = forward
        .iter()
        .enumerate()
        .filter_map(|(i, near)| {
            let back = &backward[near.index];
            let ratio = near.ratio().max(back.ratio());
            (back.index == i && ratio < RATIO).then_some(Pair { a: i, b: near.index, ratio })
        })
        .collect();
    pairs.sort_by(|p, q| p.ratio.total_cmp(&q.ratio).then(p.a.cmp(&q.a)));
    once_per_place(pairs, a, b)
}

/// The nearest descriptor, and the next one of a feature at another position.
#[derive(Clone, Copy, Debug)]
struct Nearest {
    index: usize,
    /// Dot product with the nearest descriptor.
    dot: f32,
    /// Largest dot product of a feature at another position.
    next: f32,
}

impl Nearest {
    const NONE: Self = Self { index: 0, dot: -1.0, next: -1.0 };

    /// Takes feature `index` of `others` into account; indices come in rising order.
    #[inline]
    fn offer(&mut self, index: usize, dot: f32, others: &[Feature]) {
        if dot <= self.next {
            return;
        }
        let elsewhere = |of: usize| {
            let (p, q) = (&others[of], &others[index]);
            (p.x - q.x).hypot(p.y - q.y) > SAME_PLACE_PX
        };
        if dot > self.dot {
            if self.dot > self.next && elsewhere(self.index) {
                self.next = self.dot;
            }
            (self.index, self.dot) = (index, dot);
        } else if elsewhere(self.index) {
            self.next = dot;
        }
    }

    /// Distance of the nearest over that of the next. Unit vectors: distance² = 2 − 2·dot.
    fn ratio(&self) -> f32 {
        let distance = |dot: f32| (2.0 - 2.0 * dot).max(0.0).sqrt();
        distance(self.dot) / distance(self.next).max(1e-6)
    }
}

/// Returns the nearest feature of `b` for each of `a`, and of `a` for each of `b`.
fn nearest(a: &Features, b: &Features) -> (Vec<Nearest>, Vec<Nearest>) {
    let matrix = |f: &Features| Packed::new(rows(&f.descriptors, 0, f.points.len()).t());
    let one_way = |from: &Features, to: &Features, packed: &Packed| -> Vec<Nearest> {
        let (n, m) = (from.points.len(), to.points.len());
        let blocks: Vec<usize> = (0..n).step_by(ROWS).collect();
        blocks
            .into_par_iter()
            .flat_map_iter(|first| {
                let count = ROWS.min(n - first);
                let mut dots = vec![0.0f32; count * m];
                let left = rows(&from.descriptors, first, count);
                product((&mut dots, m), left, packed, 1.0, Base::Zero);
                let best = |row: &[f32]| {
                    let mut near = Nearest::NONE;
                    row.iter().enumerate().for_each(|(j, &d)| near.offer(j, d, &to.points));
                    near
                };
                dots.chunks_exact(m).map(best).collect::<Vec<_>>()
            })
            .collect()
    };
    (one_way(a, b, &matrix(b)), one_way(b, a, &matrix(a)))
}

/// Rows `first..first + count` of descriptors.
fn rows(descriptors: &[f32], first: usize, count: usize) -> Mat<'_> {
    let from = &descriptors[first * DESCRIPTOR..(first + count) * DESCRIPTOR];
    Mat::new(from, count, DESCRIPTOR, DESCRIPTOR)
}

/// Largest ratio of distances among the features that a known geometry allows: few of them are
/// alike.
const GUIDED_RATIO: f32 = 0.9;
/// Smallest dot product of two descriptors that are matched by a known geometry.
const GUIDED_DOT: f32 = 0.75;

/// Returns the mutual nearest neighbours among the pairs of features that `allowed` admits, the
/// most certain first. `allowed` takes a feature of `a` and returns the test of those of `b`. It
/// finds the matches that repeated or weak texture hides from [`pairs()`].
pub(crate) fn guided<F: Fn(usize) -> bool>(
    a: &Features,
    b: &Features,
    allowed: impl Fn(usize) -> F + Sync,
) -> Vec<Pair> {
    let forward: Vec<Nearest> = (0..a.points.len())
        .into_par_iter()
        .map(|i| {
            let mut near = Nearest::NONE;
            let own = &a.descriptors[i * DESCRIPTOR..(i + 1) * DESCRIPTOR];
            let admits = allowed(i);
            for j in (0..b.points.len()).filter(|&j| admits(j)) {
                let other = &b.descriptors[j * DESCRIPTOR..(j + 1) * DESCRIPTOR];
                near.offer(j, dot(own, other), &b.points);
            }
            near
        })
        .collect();
    let mut backward = vec![(usize::MAX, -1.0f32); b.points.len()];
    for (i, near) in forward.iter().enumerate() {
        if near.dot > backward.get(near.index).map_or(f32::INFINITY, |b| b.1) {
            backward[near.index] = (i, near.dot);
        }
    }
    let mut pairs: Vec<Pair> = forward
        .iter()
        .enumerate()
        .filter(|(i, n)| n.dot > GUIDED_DOT && backward[n.index].0 == *i)
        .map(|(i, n)| Pair { a: i, b: n.index, ratio: n.ratio() })
        .filter(|p| p.ratio < GUIDED_RATIO)
        .collect();
    pairs.sort_by(|p, q| p.ratio.total_cmp(&q.ratio).then(p.a.cmp(&q.a)));
    once_per_place(pairs, a, b)
}

/// Drops repeated pairs of the same two positions (one point at two scales); the more certain pair
/// remains.
fn once_per_place(sorted: Vec<Pair>, a: &Features, b: &Features) -> Vec<Pair> {
    let mut seen = std::collections::HashSet::new();
    let key = |v: f32| (v / SAME_PLACE_PX) as i32;
    sorted
        .into_iter()
        .filter(|p| {
            let (f, g) = (&a.points[p.a], &b.points[p.b]);
            seen.insert((key(f.x), key(f.y), key(g.x), key(g.y)))
        })
        .collect()
}

/// Computes the dot product in eight independent sums, which the compiler keeps in registers.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for ((s, x), y) in sums.iter_mut().zip(x).zip(y) {
            *s += x * y;
        }
    }
    sums.iter().sum()
}
