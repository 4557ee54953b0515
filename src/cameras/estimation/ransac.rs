//! Finds the relative poses that the matches support, in spite of wrong matches.
//!
//! Random samples of five matches give essential matrices. Each that improves on the best is
//! refined on its inliers. The best distinct poses are returned, because a plane has two.
//!
//! Source: O. Chum, J. Matas and J. Kittler, "Locally optimized RANSAC", 2003; MSAC: P. Torr and
//! A. Zisserman 2000.

use super::five_point::essential_matrices;
use super::refine::refine;
use super::two_view::{Bearings, Relative, sampson};
use crate::cameras::matches::random::SplitMix;
use glam::DMat3;

/// Largest number of samples. At a share of right matches of 0.25 a sample is right once in 1024.
const MAX_SAMPLES: usize = 4000;
/// Smallest number of samples: the stopping rule relies on the share of an early pose.
const MIN_SAMPLES: usize = 300;
/// The search ends when the probability that no sample was right falls below this value.
const MAX_MISS_PROBABILITY: f64 = 1e-4;
/// Largest number of matches that a new best pose is refined on.
const REFINED_ON: usize = 300;
/// Poses whose rotations and translations differ by less are one, radians.
const DISTINCT: f64 = 0.05;
/// Number of distinct poses that are kept.
const KEPT: usize = 6;

/// A pose with its support.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    /// The pose.
    pub relative: Relative,
    /// Sum of 1 − (r / limit)² over the matches within the limit (MSAC).
    pub score: f64,
}

/// Score of E: see [`Candidate::score`].
pub(super) fn score(e: &DMat3, points: &[Bearings], limit: f64) -> f64 {
    let inverse = 1.0 / (limit * limit);
    points.iter().map(|m| (1.0 - sampson(e, m).powi(2) * inverse).max(0.0)).sum()
}

/// Indices of the matches within `limit` of E.
pub(super) fn inliers(e: &DMat3, points: &[Bearings], limit: f64) -> Vec<usize> {
    (0..points.len()).filter(|&i| sampson(e, &points[i]).abs() < limit).collect()
}

/// Returns distinct poses with the largest support among `points`, the best first. `limit` is the
/// largest residual of a right match, standard deviations.
pub(super) fn candidates(points: &[Bearings], limit: f64, seed: u64) -> Vec<Candidate> {
    let mut kept: Vec<Candidate> = Vec::new();
    if points.len() < 6 {
        return kept;
    }
    let mut random = SplitMix(seed);
    let (mut needed, mut drawn) = (MAX_SAMPLES, 0);
    while drawn < needed {
        drawn += 1;
        let sample = random.sample::<5>(points.len()).map(|i| points[i]);
        for e in essential_matrices(&sample) {
            let s = score(&e, points, limit);
            // A raw matrix of five noisy matches lies a little below its refined form.
            let worst = if kept.len() < KEPT { 0.0 } else { kept[kept.len() - 1].score };
            if s < 6.0 || s < 0.8 * worst {
                continue;
            }
            let Some(candidate) = improved(&e, points, limit) else { continue };
            let before = kept.first().map_or(0.0, |c| c.score);
            insert(&mut kept, candidate);
            if kept[0].score > before {
                let share = inliers(&kept[0].relative.essential(), points, limit).len() as f64
                    / points.len() as f64;
                needed = samples_for(share).clamp(MIN_SAMPLES, MAX_SAMPLES);
            }
        }
    }
    kept
}

/// Decomposes E and refines the pose on at most [`REFINED_ON`] of its inliers.
fn improved(e: &DMat3, points: &[Bearings], limit: f64) -> Option<Candidate> {
    let support = inliers(e, points, 1.5 * limit);
    let step = support.len().div_ceil(REFINED_ON).max(1);
    let chosen: Vec<Bearings> = support.iter().step_by(step).map(|&i| points[i]).collect();
    let (pose, front) = Relative::in_front(e, &chosen)?;
    if 2 * front < chosen.len() {
        return None;
    }
    let relative = refine(&pose, 1.0, &chosen, None, 6).relative;
    Some(Candidate { relative, score: score(&relative.essential(), points, limit) })
}

/// Inserts a candidate in order of the scores; of two that are nearly one pose the better stays.
fn insert(kept: &mut Vec<Candidate>, new: Candidate) {
    let same = |c: &Candidate| c.relative.distance(&new.relative) < DISTINCT;
    if kept.iter().any(|c| same(c) && c.score >= new.score) {
        return;
    }
    kept.retain(|c| !same(c));
    let at = kept.iter().position(|c| c.score < new.score).unwrap_or(kept.len());
    kept.insert(at, new);
    kept.truncate(KEPT);
}

/// Number of samples after which one is right, with probability 1 − [`MAX_MISS_PROBABILITY`].
fn samples_for(right_share: f64) -> usize {
    let all_right = right_share.powi(5).clamp(1e-12, 1.0 - 1e-9);
    (MAX_MISS_PROBABILITY.ln() / (1.0 - all_right).ln()).ceil() as usize
}

#[cfg(test)]
mod tests {
    use super::super::two_view::tests::scene;
    use super::*;

    #[test]
    fn the_pose_is_found_among_wrong_matches() {
        for seed in 0..6 {
            let (pose, mut points) = scene(300, 0.3 / 500.0, seed);
            let n = points.len();
            for i in 0..n / 2 {
                points[i].b = points[(i * 7 + 13) % n].b;
            }
            let found = candidates(&points, 4.0, 1);
            let off = found[0].relative.distance(&pose);
            assert!(off < 0.02, "{seed}: {off}");
            let right = inliers(&found[0].relative.essential(), &points, 4.0);
            assert!(right.len() >= n / 2, "{}", right.len());
            assert!(found.windows(2).all(|w| w[0].score >= w[1].score));
        }
    }

    #[test]
    fn few_or_equal_matches_give_no_pose() {
        let (_, points) = scene(5, 0.0, 1);
        assert!(candidates(&points, 0.004, 1).is_empty());
        assert!(candidates(&[points[0]; 40], 0.004, 1).is_empty());
    }
}
