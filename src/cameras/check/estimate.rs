//! Estimates the epipolar geometry that the matches support, independently of the cameras.
//!
//! Input: matches, px. Output: a fundamental matrix and its inliers. The estimator is RANSAC over
//! the 7-point algorithm. The normalised 8-point algorithm refines each new best matrix on its
//! inliers. The random numbers are seeded, so that equal matches give equal results.
//!
//! Source: Hartley and Zisserman, sections 11.1, 11.2 and 11.6; local optimisation: O. Chum et al.
//! 2003.

use super::epipolar::{Match, distance};
use crate::cameras::matches::random::SplitMix;
use glam::{DMat3, DVec2, DVec3};

/// RANSAC stops when the probability that no sample was free of wrong matches falls below this
/// value.
const MAX_MISS_PROBABILITY: f64 = 1e-3;
/// Largest number of samples: 7 right matches of 7 at a share of 0.3 need 30 000.
const MAX_SAMPLES: usize = 20_000;
/// Smallest number of samples. The stopping rule relies on the inlier share of an early, unrefined
/// matrix; 1000 samples take a few milliseconds.
const MIN_SAMPLES: usize = 1000;
/// Rounds of refinement of a new best matrix.
const REFINEMENTS: usize = 4;

/// A fundamental matrix and its inliers.
#[derive(Clone, Debug)]
pub(super) struct Estimate {
    /// The matrix, px.
    pub fundamental: DMat3,
    /// Indices of the matches within the limit.
    pub inliers: Vec<usize>,
}

/// Returns the fundamental matrix with the largest support among `matches` within `limit` px.
/// Returns `None` for fewer than 8 matches.
pub(super) fn fundamental(matches: &[Match], limit: f64, seed: u64) -> Option<Estimate> {
    if matches.len() < 8 {
        return None;
    }
    let mut random = SplitMix(seed);
    let mut best: Option<(f64, DMat3)> = None;
    let mut needed = MAX_SAMPLES;
    let mut drawn = 0;
    while drawn < needed {
        let sample = random.sample::<7>(matches.len()).map(|i| matches[i]);
        drawn += 1;
        for f in seven_point(&sample) {
            let s = score(&f, matches, limit);
            if best.as_ref().is_none_or(|(b, _)| s > *b) {
                let refined = refine(f, matches, limit);
                best = Some(refined);
                let share = support(&refined.1, matches, limit).len() as f64 / matches.len() as f64;
                needed = samples_for(share).clamp(MIN_SAMPLES, MAX_SAMPLES);
            }
        }
    }
    let (_, fundamental) = best?;
    Some(Estimate { fundamental, inliers: support(&fundamental, matches, limit) })
}

/// Returns the number of samples after which one contains right matches only, with probability 1 −
/// [`MAX_MISS_PROBABILITY`].
fn samples_for(right_share: f64) -> usize {
    let all_right = right_share.powi(7).clamp(1e-12, 1.0 - 1e-9);
    (MAX_MISS_PROBABILITY.ln() / (1.0 - all_right).ln()).ceil() as usize
}

/// Returns the indices of the matches within `limit` px of `f`.
pub(super) fn support(f: &DMat3, matches: &[Match], limit: f64) -> Vec<usize> {
    (0..matches.len()).filter(|&i| distance(f, &matches[i]) < limit).collect()
}

/// Returns the sum of 1 − (d/limit)² over the matches within the limit (MSAC).
fn score(f: &DMat3, matches: &[Match], limit: f64) -> f64 {
    matches.iter().map(|m| (1.0 - (distance(f, m) / limit).powi(2)).max(0.0)).sum()
}

/// Refits `start` to its inliers by the 8-point algorithm while the score rises; returns score and
/// matrix.
fn refine(start: DMat3, matches: &[Match], limit: f64) -> (f64, DMat3) {
    let mut best = (score(&start, matches, limit), start);
    for round in 0..REFINEMENTS {
        // The first round takes twice the limit, because the noise of the sample excludes right
        // matches.
        let radius = limit * if round == 0 { 2.0 } else { 1.0 };
        let chosen: Vec<Match> =
            support(&best.1, matches, radius).into_iter().map(|i| matches[i]).collect();
        let Some(f) = eight_point(&chosen) else { break };
        let s = score(&f, matches, limit);
        if s > best.0 {
            best = (s, f);
        } else if round > 0 {
            break;
        }
    }
    best
}

/// Returns the similarity that moves points to mean 0 and mean distance √2.
fn normalisation(points: impl Iterator<Item = DVec2> + Clone) -> DMat3 {
    let count = points.clone().count().max(1) as f64;
    let mean = points.clone().sum::<DVec2>() / count;
    let spread = points.map(|p| p.distance(mean)).sum::<f64>() / count;
    let s = std::f64::consts::SQRT_2 / spread.max(1e-9);
    DMat3::from_cols(
        DVec3::new(s, 0.0, 0.0),
        DVec3::new(0.0, s, 0.0),
        DVec3::new(-s * mean.x, -s * mean.y, 1.0),
    )
}

/// Returns the row of x_bᵀ F x_a = 0 in the nine entries of F, row-major.
fn equation(a: DVec3, b: DVec3) -> [f64; 9] {
    [b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]
}

/// Builds a matrix from nine row-major entries.
fn from_rows(v: &[f64; 9]) -> DMat3 {
    DMat3::from_cols_array(v).transpose()
}

/// Solves for F by smallest squares over eight or more matches and enforces rank 2. Returns `None`
/// where the result is not finite.
pub(super) fn eight_point(matches: &[Match]) -> Option<DMat3> {
    if matches.len() < 8 {
        return None;
    }
    let na = normalisation(matches.iter().map(|m| m.a));
    let nb = normalisation(matches.iter().map(|m| m.b));
    let mut gram = [[0.0f64; 9]; 9];
    for m in matches {
        let row = equation(na * m.a.extend(1.0), nb * m.b.extend(1.0));
        for (i, g) in gram.iter_mut().enumerate() {
            for (j, v) in g.iter_mut().enumerate() {
                *v += row[i] * row[j];
            }
        }
    }
    let f = from_rows(&smallest_eigenvector(gram));
    let square = f.transpose() * f;
    let rows: [[f64; 3]; 3] = std::array::from_fn(|i| square.row(i).to_array());
    let v = DVec3::from(smallest_eigenvector(rows));
    // F − (F v) vᵀ is the nearest matrix of rank 2.
    let fv = f * v;
    let rank2 = f - DMat3::from_cols(fv * v.x, fv * v.y, fv * v.z);
    unit(nb.transpose() * rank2 * na)
}

/// Scales to Frobenius norm 1; `None` where the norm is 0 or not finite.
fn unit(f: DMat3) -> Option<DMat3> {
    let norm = f.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    (norm.is_finite() && norm > 1e-30).then(|| f * (1.0 / norm))
}

/// Returns the one or three matrices of rank 2 that satisfy seven matches.
fn seven_point(sample: &[Match; 7]) -> Vec<DMat3> {
    let na = normalisation(sample.iter().map(|m| m.a));
    let nb = normalisation(sample.iter().map(|m| m.b));
    let rows = sample.map(|m| equation(na * m.a.extend(1.0), nb * m.b.extend(1.0)));
    let Some([f, g]) = null_space(rows) else { return Vec::new() };
    let (f, g) = (from_rows(&f), from_rows(&g));
    // det(g + x·(f − g)) is a cubic in x; four values give its coefficients.
    let at = |x: f64| (g + (f - g) * x).determinant();
    let d0 = at(0.0);
    let d1 = at(1.0);
    let dm = at(-1.0);
    let d2 = at(2.0);
    let b = 0.5 * (d1 + dm) - d0;
    let a = (d2 - d0 - 4.0 * b - (d1 - dm)) / 6.0;
    let c = 0.5 * (d1 - dm) - a;
    cubic_roots(a, b, c, d0)
        .into_iter()
        .filter_map(|x| unit(nb.transpose() * (g + (f - g) * x) * na))
        .collect()
}

/// Returns the real roots of a·x³ + b·x² + c·x + d (trigonometric form and Cardano's form).
fn cubic_roots(a: f64, b: f64, c: f64, d: f64) -> Vec<f64> {
    let size = b.abs().max(c.abs()).max(d.abs());
    if a.abs() <= 1e-12 * size {
        // Without a cubic term the sample is dropped, and RANSAC draws another.
        return Vec::new();
    }
    let (b, c, d) = (b / a, c / a, d / a);
    let q = (b * b - 3.0 * c) / 9.0;
    let r = (2.0 * b * b * b - 9.0 * b * c + 27.0 * d) / 54.0;
    if r * r < q * q * q {
        let theta = (r / q.powf(1.5)).clamp(-1.0, 1.0).acos();
        [0.0, 1.0, -1.0]
            .map(|k| -2.0 * q.sqrt() * ((theta + k * std::f64::consts::TAU) / 3.0).cos() - b / 3.0)
            .to_vec()
    } else {
        let s = -r.signum() * (r.abs() + (r * r - q * q * q).sqrt()).cbrt();
        let t = if s == 0.0 { 0.0 } else { q / s };
        vec![s + t - b / 3.0]
    }
}

/// Returns two vectors that span the null space of seven rows (Gauss-Jordan, full pivoting), or
/// `None` where the rows are dependent.
fn null_space(mut rows: [[f64; 9]; 7]) -> Option<[[f64; 9]; 2]> {
    let mut order: [usize; 9] = std::array::from_fn(|i| i);
    for p in 0..7 {
        let (mut pr, mut pc) = (p, p);
        for r in p..7 {
            for c in p..9 {
                if rows[r][c].abs() > rows[pr][pc].abs() {
                    (pr, pc) = (r, c);
                }
            }
        }
        if rows[pr][pc].abs() < 1e-10 {
            return None;
        }
        rows.swap(p, pr);
        order.swap(p, pc);
        rows.iter_mut().for_each(|row| row.swap(p, pc));
        let pivot = rows[p].map(|v| v / rows[p][p]);
        for (r, row) in rows.iter_mut().enumerate() {
            let factor = if r == p { 0.0 } else { row[p] };
            for (v, q) in row.iter_mut().zip(&pivot) {
                *v -= factor * q;
            }
        }
        rows[p] = pivot;
    }
    Some([7, 8].map(|free| {
        let mut v = [0.0; 9];
        v[order[free]] = 1.0;
        for (row, &column) in rows.iter().zip(&order) {
            v[column] = -row[free];
        }
        v
    }))
}

/// Returns the eigenvector of the smallest eigenvalue of a symmetric matrix (cyclic Jacobi).
fn smallest_eigenvector<const N: usize>(mut m: [[f64; N]; N]) -> [f64; N] {
    /// Maximum number of sweeps; convergence is quadratic and takes about six.
    const SWEEPS: usize = 30;
    let mut vectors = [[0.0f64; N]; N];
    (0..N).for_each(|i| vectors[i][i] = 1.0);
    for _ in 0..SWEEPS {
        let diagonal: f64 = (0..N).map(|i| m[i][i].abs()).sum();
        let off: f64 =
            (0..N).flat_map(|i| (i + 1..N).map(move |j| (i, j))).map(|(i, j)| m[i][j].abs()).sum();
        if off <= 1e-15 * diagonal {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                rotate(&mut m, &mut vectors, p, q);
            }
        }
    }
    let mut smallest = 0;
    for i in 1..N {
        if m[i][i] < m[smallest][smallest] {
            smallest = i;
        }
    }
    std::array::from_fn(|i| vectors[i][smallest])
}

/// Applies one Jacobi rotation that clears entry (p, q).
fn rotate<const N: usize>(m: &mut [[f64; N]; N], vectors: &mut [[f64; N]; N], p: usize, q: usize) {
    if m[p][q] == 0.0 {
        return;
    }
    let theta = (m[q][q] - m[p][p]) / (2.0 * m[p][q]);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let t = if theta == 0.0 { 1.0 } else { t };
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for row in m.iter_mut() {
        let (a, b) = (row[p], row[q]);
        (row[p], row[q]) = (c * a - s * b, s * a + c * b);
    }
    let (row_p, row_q) = (m[p], m[q]);
    for ((k, a), b) in row_p.into_iter().enumerate().zip(row_q) {
        (m[p][k], m[q][k]) = (c * a - s * b, s * a + c * b);
    }
    for row in vectors.iter_mut() {
        let (a, b) = (row[p], row[q]);
        (row[p], row[q]) = (c * a - s * b, s * a + c * b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random(seed: u64) -> impl FnMut() -> f64 {
        let mut state = SplitMix(seed);
        move || (state.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns `n` matches of points in front of two cameras 1 unit and 0.2 rad apart.
    fn scene(n: usize, noise: f64) -> Vec<Match> {
        let k = DMat3::from_cols_array(&[500.0, 0.0, 0.0, 0.0, 510.0, 0.0, 320.0, 240.0, 1.0]);
        let rotation = DMat3::from_rotation_y(0.2);
        let mut next = random(7);
        (0..n)
            .map(|_| {
                let p = DVec3::new(4.0 * next() - 2.0, 3.0 * next() - 1.5, 3.0 + 4.0 * next());
                let mut project = |p: DVec3| {
                    let q = k * p;
                    let error = DVec2::new(next() - 0.5, next() - 0.5) * noise;
                    q.truncate() / q.z + error
                };
                Match { a: project(p), b: project(rotation * p + DVec3::new(1.0, 0.1, 0.2)) }
            })
            .collect()
    }

    #[test]
    fn eight_points_determine_the_matrix() {
        let f = eight_point(&scene(12, 0.0)).unwrap();
        assert!(scene(40, 0.0).iter().all(|m| distance(&f, m) < 1e-6));
        assert!(f.determinant().abs() < 1e-12);
        assert!(eight_point(&scene(7, 0.0)).is_none());
    }

    #[test]
    fn seven_points_determine_the_matrix() {
        let all = scene(40, 0.0);
        let sample: [Match; 7] = std::array::from_fn(|i| all[i]);
        let found = seven_point(&sample);
        assert!(!found.is_empty() && found.len() <= 3);
        for f in &found {
            assert!(sample.iter().all(|m| distance(f, m) < 1e-5));
        }
        assert!(found.iter().any(|f| all.iter().all(|m| distance(f, m) < 1e-5)));
    }

    #[test]
    fn wrong_matches_are_outliers() {
        let mut matches = scene(120, 0.6);
        let mut next = random(3);
        for m in matches.iter_mut().step_by(2) {
            m.b = DVec2::new(640.0 * next(), 480.0 * next());
        }
        let estimate = fundamental(&matches, 1.5, 1).unwrap();
        let right = estimate.inliers.iter().filter(|&&i| i % 2 == 1).count();
        assert!(right >= 58, "{right}");
        assert!(estimate.inliers.len() - right <= 4);
        let again = fundamental(&matches, 1.5, 1).unwrap();
        assert_eq!(estimate.inliers, again.inliers);
        assert!(fundamental(&matches[..7], 1.5, 1).is_none());
    }

    #[test]
    fn repeated_matches_give_no_geometry_and_no_panic() {
        let one = scene(1, 0.0)[0];
        let estimate = fundamental(&[one; 20], 1.5, 1);
        assert!(estimate.is_none_or(|e| e.fundamental.is_finite()));
    }

    #[test]
    fn cubics_have_their_roots() {
        let mut three = cubic_roots(2.0, -12.0, 22.0, -12.0);
        three.sort_by(f64::total_cmp);
        for (root, expected) in three.iter().zip([1.0, 2.0, 3.0]) {
            assert!((root - expected).abs() < 1e-9);
        }
        let one = cubic_roots(1.0, 0.0, 1.0, -10.0);
        assert!(one.len() == 1 && (one[0] - 2.0).abs() < 1e-9);
    }
}
