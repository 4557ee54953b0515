//! Pairs of photographs that are compared, and their relative poses.

use super::pair::{self, PairEstimate};
use super::photo::{PosePhoto, detected};
use super::refine::FocalPrior;
use crate::cameras::matches::pairs::pairs;
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
    let alike: Vec<usize> =
        all.par_iter().map(|&[i, j]| pairs(&sketches[i], &sketches[j]).len()).collect();
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

/// Ratio of neighbouring focal lengths that are tried.
const FOCAL_STEP: f64 = 1.15;
/// Logarithm of the likelihood of one more match that agrees: half the squared limit of a residual would be
/// 6, but residuals of neighbouring matches are alike.
const LIKELIHOOD: f64 = 1.0;

/// Estimates the shared focal length of photographs whose lenses are not exact, over that of the lenses: those that
/// are tried are compared by the matches of the pairs with most of them, all together. A pair of photographs alone often
/// supports a wrong one nearly as well. Mean and standard deviation of the logarithm.
pub(super) fn focal_scale(photos: &[PosePhoto], deviation: f64, seed: u64) -> FocalPrior {
    /// Number of pairs that vote.
    const VOTES: usize = 8;
    let sketches: Vec<_> = photos.par_iter().map(|p| p.features.strongest(SKETCH)).collect();
    let mut alike: Vec<(usize, [usize; 2])> = compared(photos)
        .into_par_iter()
        .map(|[i, j]| (pairs(&sketches[i], &sketches[j]).len(), [i, j]))
        .collect();
    alike.sort_by_key(|(n, pair)| (std::cmp::Reverse(*n), *pair));
    // Neighbours of a video have many matches and little parallax: every second pair counts.
    let step = (alike.len() / (2 * VOTES)).clamp(1, 3);
    let chosen: Vec<[usize; 2]> =
        alike.iter().step_by(step).take(VOTES).map(|(_, pair)| *pair).collect();
    let tried: Vec<f64> = (-5..=6).map(|i| f64::from(i) * FOCAL_STEP.ln()).collect();
    let kept = FocalPrior { mean: 0.0, deviation: 0.3 * FOCAL_STEP.ln() };
    let votes: Vec<Vec<f64>> = chosen
        .par_iter()
        .map(|photographs| {
            let [a, b] = photographs.map(|i| &photos[i]);
            let matches = detected(a, b, &pair::some_pairs(a, b));
            let of = |log_focal: &f64| {
                let scaled: Vec<_> = matches.iter().map(|m| m.rescaled(log_focal.exp())).collect();
                pair::best(&scaled, kept, seed).map_or(0.0, |(support, _)| support)
            };
            tried.iter().map(of).collect()
        })
        .collect();
    let log_likelihood = |i: usize| {
        let support: f64 = votes.iter().map(|of_pair| of_pair[i]).sum();
        LIKELIHOOD * support - 0.5 * (tried[i] / deviation).powi(2)
    };
    let all: Vec<f64> = (0..tried.len()).map(log_likelihood).collect();
    let most = all.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = all.iter().map(|l| (l - most).exp()).collect();
    let total: f64 = weights.iter().sum();
    let mean_of = |f: &dyn Fn(f64) -> f64| {
        tried.iter().zip(&weights).map(|(x, w)| f(*x) * w).sum::<f64>() / total
    };
    let mean = mean_of(&|x| x);
    let deviation = mean_of(&|x| (x - mean).powi(2)).sqrt();
    FocalPrior { mean, deviation }
}
