//! Matches the features of two photographs by their descriptors, without the poses.
//!
//! A match is a pair of mutual nearest neighbours whose distance is clearly below the distance of
//! the second-nearest descriptor (Lowe, section 7.1).

use super::descriptors::DESCRIPTOR;
use super::features::Features;
use rayon::prelude::*;

/// Largest ratio of the nearest descriptor's distance to the second-nearest one's. Lowe (section
/// 7.1) takes 0.8. Required in both directions, 0.85 admits as few wrong matches and finds a tenth
/// more right ones on wide pairs.
const RATIO: f32 = 0.85;
/// A second-nearest feature within this distance of the nearest is the same point, detected twice,
/// px.
const SAME_PLACE_PX: f32 = 3.0;

/// One matched pair of features.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    /// Index into the first picture's features.
    pub a: usize,
    /// Index into the second picture's features.
    pub b: usize,
    /// Distance of the nearest over the second-nearest descriptor: smaller is more certain.
    pub ratio: f32,
}

/// Returns the mutual nearest neighbours that pass the ratio test in both directions, the most
/// certain first.
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

/// Returns the index of the largest of `count` dot products, and the ratio of its distance to that
/// of the second-nearest feature at another position.
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
        if d > next && (p.x - place.x).hypot(p.y - place.y) > SAME_PLACE_PX {
            next = d;
        }
    }
    // Unit vectors: distance² = 2 − 2·dot.
    let distance = |dot: f32| (2.0 - 2.0 * dot).max(0.0).sqrt();
    (top, distance(dot(top)) / distance(next).max(1e-6))
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
