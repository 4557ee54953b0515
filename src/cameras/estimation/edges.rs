//! Pairs of photographs that are compared, and their relative poses.

use super::pair::{self, PairEstimate};
use super::photo::PosePhoto;
use rayon::prelude::*;

/// Smallest number of matches of a verified pair.
const MIN_PAIR_INLIERS: usize = 20;
/// Smallest number of its matches that were found without a geometry.
const MIN_PAIR_CONSISTENT: usize = 16;
/// Photographs that are compared with all others; of more, each is compared with this many
/// neighbours in their order and with the photographs most alike.
const PARTNERS: usize = 10;
/// Features by which likeness is judged.
const SKETCH: usize = 700;

/// Two photographs with a verified relative pose.
#[derive(Clone, Debug)]
pub(super) struct Edge {
    /// Indices of the photographs, the smaller first.
    pub photos: [usize; 2],
    /// Their relative pose.
    pub estimate: PairEstimate,
}

/// Returns the pairs of photographs that are compared in full: all of a few photographs, else those
/// that are most alike by their strongest features.
fn compared(photos: &[PosePhoto]) -> Vec<[usize; 2]> {
    let n = photos.len();
    let all: Vec<[usize; 2]> = (0..n).flat_map(|i| (i + 1..n).map(move |j| [i, j])).collect();
    if n <= PARTNERS {
        return all;
    }
    let sketches: Vec<_> = photos.par_iter().map(|p| p.features.strongest(SKETCH)).collect();
    let alike: Vec<usize> = all
        .par_iter()
        .map(|&[i, j]| crate::cameras::matches::pairs::pairs(&sketches[i], &sketches[j]).len())
        .collect();
    let mut chosen = vec![false; all.len()];
    for photo in 0..n {
        let mut own: Vec<usize> = (0..all.len()).filter(|&k| all[k].contains(&photo)).collect();
        own.sort_by_key(|&k| std::cmp::Reverse(alike[k]));
        own.iter().take(PARTNERS).for_each(|&k| chosen[k] = true);
    }
    all.into_iter().zip(chosen).filter_map(|(pair, c)| c.then_some(pair)).collect()
}

/// Estimates the relative poses of all comparable pairs.
pub(super) fn edges(photos: &[PosePhoto], seed: u64) -> Vec<Edge> {
    edges_of(photos, compared(photos), seed)
}

/// Estimates the relative poses of `pairs`.
pub(super) fn edges_of(photos: &[PosePhoto], pairs: Vec<[usize; 2]>, seed: u64) -> Vec<Edge> {
    pairs
        .into_par_iter()
        .filter_map(|[i, j]| {
            let estimate = pair::estimate(&photos[i], &photos[j], false, seed).ok()?;
            let enough = estimate.consistent >= MIN_PAIR_CONSISTENT
                && estimate.inliers.len() >= MIN_PAIR_INLIERS;
            enough.then_some(Edge { photos: [i, j], estimate })
        })
        .collect()
}

/// Estimates the shared focal length of photographs whose lenses are not exact, over that of the
/// lenses: the weighted median of the estimates of the pairs with most matches.
pub(super) fn focal_scale(photos: &[PosePhoto], seed: u64) -> f64 {
    /// Number of pairs that vote.
    const VOTES: usize = 8;
    let sketches: Vec<_> = photos.par_iter().map(|p| p.features.strongest(SKETCH)).collect();
    let mut alike: Vec<(usize, [usize; 2])> = compared(photos)
        .into_par_iter()
        .map(|[i, j]| {
            (crate::cameras::matches::pairs::pairs(&sketches[i], &sketches[j]).len(), [i, j])
        })
        .collect();
    alike.sort_by_key(|(n, pair)| (std::cmp::Reverse(*n), *pair));
    // Neighbours of a video have many matches and little parallax: every second pair counts.
    let step = (alike.len() / (2 * VOTES)).clamp(1, 3);
    let mut votes: Vec<(f64, f64)> = alike
        .iter()
        .step_by(step)
        .take(VOTES)
        .collect::<Vec<_>>()
        .into_par_iter()
        .filter_map(|(_, [i, j])| {
            let e = pair::estimate(&photos[*i], &photos[*j], false, seed).ok()?;
            let weight =
                e.refined.information.lu().try_inverse().map_or(0.0, |c| 1.0 / c[(5, 5)].max(1e-6));
            (e.consistent >= MIN_PAIR_INLIERS).then_some((e.refined.focal_scale, weight.sqrt()))
        })
        .collect();
    votes.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = votes.iter().map(|v| v.1).sum();
    let mut sum = 0.0;
    votes
        .iter()
        .find(|v| {
            sum += v.1;
            sum >= 0.5 * total
        })
        .map_or(1.0, |v| v.0)
}
