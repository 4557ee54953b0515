//! Which feature of one photograph is which of the other: nearest descriptors that
//! choose each other and are clearly nearer than the runner-up. Uses no pose.

use super::descriptors::DESCRIPTOR;
use super::features::Features;
use rayon::prelude::*;

/// Largest ratio of the nearest descriptor's distance to the next one's. Lowe
/// (section 7.1) takes 0.8; demanded both ways, 0.85 keeps as few wrong ones and
/// gives a tenth more right matches on wide pairs.
const RATIO: f32 = 0.85;
/// A runner-up this near to the best, px, is the same place found twice.
const SAME_PLACE: f32 = 3.0;

/// One pair of features.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    /// Index into the first picture's features.
    pub a: usize,
    /// Index into the second picture's features.
    pub b: usize,
    /// Distance of the best over the next: smaller is surer.
    pub ratio: f32,
}

/// Mutual nearest neighbours that pass the ratio test both ways, surest first.
pub(super) fn pairs(a: &Features, b: &Features) -> Vec<Pair> {
    let (n, m) = (a.points.len(), b.points.len());
    if n == 0 || m == 0 {
        return Vec::new();
    }
    let mut dots = vec![0.0f32; n * m];
    dots.par_chunks_mut(m).zip(a.descriptors.par_chunks(DESCRIPTOR)).for_each(|(row, d)| {
        for (o, e) in row.iter_mut().zip(b.descriptors.chunks_exact(DESCRIPTOR)) {
            *o = dot(d, e);
        }
    });
    let forward: Vec<(usize, f32)> =
        (0..n).into_par_iter().map(|i| best(m, |j| dots[i * m + j], b)).collect();
    let backward: Vec<(usize, f32)> =
        (0..m).into_par_iter().map(|j| best(n, |i| dots[i * m + j], a)).collect();
    let mut pairs: Vec<Pair> = forward
        .iter()
        .enumerate()
        .filter_map(|(i, &(j, ratio))| {
            let (back, other) = backward[j];
            let ratio = ratio.max(other);
            (back == i && ratio < RATIO).then_some(Pair { a: i, b: j, ratio })
        })
        .collect();
    pairs.sort_by(|p, q| p.ratio.total_cmp(&q.ratio).then(p.a.cmp(&q.a)));
    once_per_place(pairs, a, b)
}

/// Index of the largest of `count` dot products and the ratio of its distance to
/// the next one's at another place.
fn best(count: usize, dot: impl Fn(usize) -> f32, others: &Features) -> (usize, f32) {
    let mut top = 0;
    for j in 1..count {
        if dot(j) > dot(top) {
            top = j;
        }
    }
    let place = &others.points[top];
    let mut next = -1.0f32;
    for (j, p) in others.points.iter().enumerate().take(count) {
        let d = dot(j);
        if d > next && (p.x - place.x).hypot(p.y - place.y) > SAME_PLACE {
            next = d;
        }
    }
    // Unit vectors: distance² = 2 − 2·dot.
    let distance = |dot: f32| (2.0 - 2.0 * dot).max(0.0).sqrt();
    (top, distance(dot(top)) / distance(next).max(1e-6))
}

/// Drops the less sure of two pairs that say the same (one place at two scales).
fn once_per_place(sorted: Vec<Pair>, a: &Features, b: &Features) -> Vec<Pair> {
    let mut seen = std::collections::HashSet::new();
    let key = |v: f32| (v / SAME_PLACE) as i32;
    sorted
        .into_iter()
        .filter(|p| {
            let (f, g) = (&a.points[p.a], &b.points[p.b]);
            seen.insert((key(f.x), key(f.y), key(g.x), key(g.y)))
        })
        .collect()
}

/// Dot product in eight independent sums, which the compiler keeps in registers.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 8];
    for (x, y) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for ((s, x), y) in sums.iter_mut().zip(x).zip(y) {
            *s += x * y;
        }
    }
    sums.iter().sum()
}
