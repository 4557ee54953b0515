//! Photographs of different focal lengths: those of a zoom lens, or cropped ones, whose files do not say so.
//!
//! Cameras are built with one focal length for all photographs. In one more adjustment of all cameras and points the
//! focal lengths are free. If they differ clearly, cameras are built anew with lenses in these proportions, until the
//! proportions no longer change. Six sets of `../shared/photos` and 30 others of one lens differ by up to 0.03; five
//! photographs, two of them enlarged by 1.5, came out at 1.46 to 1.52 after four rounds.

use super::edges::Edge;
use super::photo::PosePhoto;
use super::reconstruct::{self, Model};
use super::refine::FocalPrior;
use rayon::prelude::*;

/// Fewest photographs that tell a focal length of one from a wrong position of the points.
const PHOTOGRAPHS: usize = 3;
/// Difference of the logarithm of a focal length to the median, from which on it is another one.
const CLEAR: f64 = 0.08;
/// Standard deviations of that difference from which on it is certain.
const CERTAIN: f64 = 6.0;
/// Rounds of building with lenses in the proportions that were found.
const ROUNDS: usize = 6;
/// Change of a proportion's logarithm below which it is found.
const SETTLED: f64 = 0.01;
/// Steps of an adjustment.
const STEPS: usize = 40;
/// Standard deviation of what is known of the logarithm of a focal length over that of another photograph.
const DEVIATION: f64 = 0.3;

/// A focal length over that of a lens.
#[derive(Clone, Copy, Debug)]
struct Zoom {
    /// Its logarithm.
    log: f64,
    /// Standard deviation of the logarithm.
    deviation: f64,
}

/// Focal length of each photograph of `model` over the median of all; `None` for photographs without a camera.
fn zooms_of(model: &Model) -> Option<Vec<Option<Zoom>>> {
    let (bundle, photos) = model.bundle.as_ref()?;
    if photos.len() < PHOTOGRAPHS {
        return None;
    }
    let mut bundle = bundle.clone();
    bundle.zoom_prior = Some(DEVIATION);
    bundle.adjust(STEPS);
    let deviations = bundle.deviations()?.zooms;
    let mut sorted = bundle.zooms.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let mut found = vec![None; model.cameras.len()];
    for ((photo, zoom), deviation) in photos.iter().zip(&bundle.zooms).zip(deviations) {
        found[*photo] = Some(Zoom { log: zoom - median, deviation });
    }
    Some(found)
}

/// The focal lengths of `photos` over the median of all, of which `model` was built as of one focal length; `None` where
/// they have one as far as the points tell. `sound` tells which pairs count.
pub(super) fn of_photos(
    photos: &[PosePhoto],
    model: &Model,
    prior: Option<FocalPrior>,
    sound: impl Fn(&Edge) -> bool,
    seed: u64,
) -> Option<Vec<f64>> {
    // A focal length that is exact holds for all, and views of one photograph have known directions.
    if prior.is_none() || photos.iter().any(PosePhoto::has_views) {
        return None;
    }
    let mut found = zooms_of(model)?;
    let is_other = |zoom: &Zoom| zoom.log.abs() > CLEAR.max(CERTAIN * zoom.deviation);
    if !found.iter().flatten().any(is_other) {
        return None;
    }
    let mut logs = vec![0.0; photos.len()];
    let mut agreeing = 0;
    for _ in 0..ROUNDS {
        let mut most = 0.0f64;
        for (log, zoom) in logs.iter_mut().zip(&found) {
            let change = zoom.map_or(0.0, |zoom| zoom.log);
            *log += change;
            most = most.max(change.abs());
        }
        if most < SETTLED {
            break;
        }
        let zoomed: Vec<PosePhoto> =
            photos.par_iter().zip(&logs).map(|(p, log)| p.with_focal(log.exp())).collect();
        let edges: Vec<Edge> =
            super::edges::edges(&zoomed, seed).into_iter().filter(&sound).collect();
        let built = reconstruct::build(&zoomed, &edges, prior, seed)?;
        agreeing = built.agreeing();
        found = zooms_of(&built)?;
    }
    let is_clear = logs.iter().any(|log| log.abs() > CLEAR) && agreeing > model.agreeing();
    is_clear.then(|| logs.into_iter().map(f64::exp).collect())
}

/// The longest of focal lengths over the shortest, less one, percent.
pub(super) fn percent(zooms: &[f64]) -> f64 {
    let [least, most] =
        [f64::min, f64::max].map(|pick| zooms.iter().copied().reduce(pick).unwrap_or(1.0));
    100.0 * (most / least - 1.0)
}
