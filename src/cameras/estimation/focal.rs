//! The focal length that all photographs share: known, or the one of several with which most points agree.

use super::edges::{self, Edge};
use super::photo::{PosePhoto, STATED, UNKNOWN_DEVIATION};
use super::reconstruct::{self, Model};
use super::refine::FocalPrior;
use rayon::prelude::*;

/// Features that agree with a model, over those of the best one, from which on it is another answer.
const RIVAL_MODEL: f64 = 0.85;
/// The same of what the matches of pairs tell, above which several focal lengths are tried.
const TOLD: f64 = 0.15;
/// Difference of the logarithm of a given focal length from which on it is wrong.
const WRONG: f64 = 0.15;
/// Features that agree with the points of an unknown focal length, over those of a given one, from which on the given
/// one is wrong. Right angles of view gave 0.97 to 1.10 (six sets of `../shared/photos`), those that were wrong by a
/// fifth and more 1.23 to 2.4.
const MORE: f64 = 1.15;
/// Most photographs on which a given focal length is checked.
const CHECKED: usize = 12;

/// Cameras that were built with one focal length.
pub(super) struct Built {
    /// Focal length at the start, over that of the lenses.
    pub first: f64,
    /// Photographs with that focal length.
    pub photos: Vec<PosePhoto>,
    /// Their pairs.
    pub edges: Vec<Edge>,
    /// Knowledge of the focal length over that at the start.
    pub prior: Option<FocalPrior>,
    /// The result.
    pub model: Model,
}

/// The best of the models of photographs of which the focal length is known up to `deviation`, of its logarithm, and how
/// far the focal lengths of others that the points support nearly as well lie from its own.
pub(super) fn built(
    photos: &[PosePhoto],
    deviation: f64,
    is_sound: &impl Fn(&[PosePhoto], &Edge) -> bool,
    seed: u64,
) -> Option<(Built, f64)> {
    let starts = if deviation > STATED {
        starts(edges::focal_scale(photos, deviation, seed))
    } else {
        vec![1.0]
    };
    let build = |first: f64| {
        let exact: Vec<PosePhoto> = photos.par_iter().map(|p| p.with_focal(first)).collect();
        let edges = edges::edges(&exact, seed);
        let usable: Vec<Edge> = edges.into_iter().filter(|e| is_sound(&exact, e)).collect();
        let prior = (deviation > 0.0).then_some(FocalPrior { mean: -first.ln(), deviation });
        let model = reconstruct::build(&exact, &usable, prior, seed)?;
        Some(Built { first, photos: exact, edges: usable, prior, model })
    };
    let mut built: Vec<Built> = starts.into_iter().filter_map(build).collect();
    // A stable order: the first of equal ones.
    built.sort_by_key(|b| std::cmp::Reverse((b.model.placed(), b.model.agreeing())));
    let spread = spread(&built);
    built.into_iter().next().map(|best| (best, spread))
}

/// Largest difference between the logarithms of the focal lengths of the first model and of those that the points
/// support nearly as well.
pub(super) fn spread(built: &[Built]) -> f64 {
    let Some(best) = built.first() else { return 0.0 };
    let log_focal = |b: &Built| (b.first * b.model.focal_scale).ln();
    let least = RIVAL_MODEL * best.model.agreeing() as f64;
    let rivals = built.iter().filter(|b| b.model.agreeing() as f64 >= least);
    rivals.map(|b| (log_focal(b) - log_focal(best)).abs()).fold(0.0, f64::max)
}

/// Focal lengths with which cameras are built, over those of the lenses: one where the matches tell it, else three of
/// which the points decide.
pub(super) fn starts(found: FocalPrior) -> Vec<f64> {
    let FocalPrior { mean, deviation } = found;
    if deviation < TOLD {
        return vec![mean.exp()];
    }
    [0.0, -1.0, 1.0].map(|side| (mean + side * 1.2 * deviation).exp()).to_vec()
}

/// The focal length that the points of `photos` fit over the one that was given, where they contradict the latter.
pub(super) fn contradicted(
    photos: &[PosePhoto],
    is_sound: &impl Fn(&[PosePhoto], &Edge) -> bool,
    seed: u64,
) -> Option<f64> {
    if photos.iter().any(|photo| photo.has_views() || photo.lens.deviation > 0.0) {
        return None;
    }
    let count = photos.len().min(CHECKED);
    let some: Vec<PosePhoto> =
        (0..count).map(|i| photos[i * photos.len() / count].clone()).collect();
    let (given, _) = built(&some, 0.0, is_sound, seed)?;
    let (free, _) = built(&some, UNKNOWN_DEVIATION, is_sound, seed)?;
    let found = free.first * free.model.focal_scale;
    let more = free.model.agreeing() as f64 > MORE * given.model.agreeing() as f64;
    (more && found.ln().abs() > WRONG && free.model.placed() >= given.model.placed())
        .then_some(found)
}
