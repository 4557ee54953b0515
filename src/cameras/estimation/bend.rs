//! Lenses that bend straight lines: one radial parameter, shared by all photographs.
//!
//! A position d of the picture on the plane z = 1 shows the direction d / (1 + k |d|²). k < 0 is a barrel, as wide
//! lenses and action cameras have it, up to a full-frame fisheye lens; k > 0 is a pincushion. Source: A. Fitzgibbon,
//! "Simultaneous linear estimation of multiple view geometry and lens distortion", 2001.
//!
//! Matches of pairs tell whether a lens that bends explains more of them than a pinhole. If so, pairs are matched and
//! cameras are built anew with it, and it is adjusted with them (`bundle.rs`), until it no longer changes. Points of
//! cameras that were built as pinholes would not tell: those that contradict a pinhole are not among them.

use super::edges::Edge;
use super::pair;
use super::photo::{PosePhoto, detected, deviations};
use super::reconstruct::{self, Model};
use super::refine::FocalPrior;
use super::two_view::Bearings;
use glam::{DMat2, DVec2};
use rayon::prelude::*;
use subsplat_kernels::camera::Intrinsics;

/// Fewest photographs that tell a bent line from another shape of the scene.
pub(super) const PHOTOGRAPHS: usize = 3;
/// Standard deviation of the logarithm of the focal length while the lens bends: lenses state the focal length of their
/// middle, or that of the whole angle.
pub(super) const FOCAL_DEVIATION: f64 = 0.1;
/// Standard deviation of what is known of k before: a full-frame fisheye lens lies within two of them, because a
/// stereographic one has −1/4 on the plane of its own focal length.
pub(super) const DEVIATION: f64 = 0.2;
/// Bends of the corners that are tried, over their distance from the middle.
const TRIED: [f64; 4] = [-0.15, -0.05, 0.02, 0.06];
/// Number of pairs on which they are tried.
const VOTES: usize = 8;
/// Support of a lens that bends over that of a pinhole from which on cameras are built with it.
const SUSPECT: f64 = 1.002;
/// Matches that support it and no pinhole, from which on cameras are built with it. Pictures of pinholes gave up to 4.2.
const SUSPECT_MATCHES: f64 = 6.0;
/// Rounds of matching with a lens that bends.
const ROUNDS: usize = 5;
/// Features that agree with the points, over those of pinholes, below which no further round follows.
const HOPEFUL: f64 = 0.9;
/// Change of the corner between two rounds, over its distance from the middle, below which the lens is found.
const SETTLED: f64 = 3e-3;
/// Bend of the corners from which on a lens is no pinhole. The photographs of `examples/berlin` came out at 0.023.
const CLEAR: f64 = 0.03;
/// Standard deviations of k from which on it is not 0.
const CERTAIN: f64 = 8.0;

/// A lens that bends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Bend {
    /// k, on the plane of the photographs' own focal length.
    pub k: f64,
    /// Its standard deviation.
    pub deviation: f64,
    /// Focal length of the middle over that of the lenses.
    pub focal_scale: f64,
}

/// The position of a straight ray's picture that lies at `bent`.
pub(super) fn straight(bent: DVec2, k: f64) -> DVec2 {
    bent / (1.0 + k * bent.length_squared())
}

/// The picture of a straight ray; `None` where the lens has none.
pub(super) fn bent(straight: DVec2, k: f64) -> Option<DVec2> {
    let root = 1.0 - 4.0 * k * straight.length_squared();
    (root > 0.0).then(|| straight * (2.0 / (1.0 + root.sqrt())))
}

/// Derivatives of [`bent`] by its position and by k.
pub(super) fn bent_slopes(straight: DVec2, k: f64) -> (DMat2, DVec2) {
    let r2 = straight.length_squared();
    let root = (1.0 - 4.0 * k * r2).max(1e-12).sqrt();
    let growth = 4.0 / (root * (1.0 + root).powi(2));
    let outer = DMat2::from_cols(straight * straight.x, straight * straight.y);
    let by_position = DMat2::from_diagonal(DVec2::splat(2.0 / (1.0 + root)));
    (by_position + outer * (2.0 * k * growth), straight * (r2 * growth))
}

/// Growth of lengths by [`straight`] at a position of the picture: the mean of those along and across the radius.
pub(super) fn stretch(bent: DVec2, k: f64) -> f64 {
    let kr2 = k * bent.length_squared();
    let across = 1.0 / (1.0 + kr2);
    0.5 * across * (1.0 + (1.0 - kr2) * across)
}

impl Bend {
    /// Bend of a corner of the picture of `lens` over its distance from the middle: negative for a barrel.
    fn of_corner(&self, lens: &Intrinsics) -> f64 {
        self.k * corner(lens)
    }

    /// The same lens for lenses with a focal length `scale` times as long.
    pub(super) fn seen_from(self, scale: f64) -> Self {
        let squared = scale * scale;
        Self {
            k: self.k * squared,
            deviation: self.deviation * squared,
            focal_scale: self.focal_scale / scale,
        }
    }

    /// Returns whether the lens is no pinhole.
    fn is_clear(&self, photos: &[PosePhoto]) -> bool {
        let most = photos.iter().map(|p| self.of_corner(&p.working).abs()).fold(0.0, f64::max);
        most > CLEAR && self.k.abs() > CERTAIN * self.deviation
    }
}

/// Squared distance of a corner from the middle, focal lengths.
fn corner(lens: &Intrinsics) -> f64 {
    let k = lens;
    let at = DVec2::new(k.width as f64 / f64::from(k.fx), k.height as f64 / f64::from(k.fy));
    (0.5 * at).length_squared()
}

/// The lens of `photos`, of which `model` was built as of pinholes from `edges`, after rounds of matching with it;
/// `None` where the lens is a pinhole as far as the points tell. `sound` tells which pairs count.
pub(super) fn of_photos(
    photos: &[PosePhoto],
    edges: &[Edge],
    model: &Model,
    prior: Option<FocalPrior>,
    sound: impl Fn(&Edge) -> bool,
    seed: u64,
) -> Option<Bend> {
    // A focal length that is given is that of the middle or of the whole angle, as a stated one is.
    let prior = prior.unwrap_or(FocalPrior { mean: 0.0, deviation: FOCAL_DEVIATION });
    let first = photos.first()?;
    if model.placed() < PHOTOGRAPHS || photos.iter().any(PosePhoto::has_views) {
        return None;
    }
    let mut bend = suspected(photos, edges, seed)?;
    let mut agreeing = 0;
    for _ in 0..ROUNDS {
        let k = bend.seen_from(bend.focal_scale).k;
        let lens = |p: &PosePhoto| p.with_focal(bend.focal_scale).with_bend(k);
        let bent: Vec<PosePhoto> = photos.par_iter().map(lens).collect();
        let edges: Vec<Edge> =
            super::edges::edges(&bent, seed).into_iter().filter(&sound).collect();
        let prior = FocalPrior { mean: prior.mean - bend.focal_scale.ln(), ..prior };
        let built = reconstruct::build(&bent, &edges, Some(prior), seed)?;
        agreeing = built.agreeing();
        let next = built.bend?.seen_from(1.0 / bend.focal_scale);
        let change = (next.of_corner(&first.working) - bend.of_corner(&first.working)).abs();
        if (agreeing as f64) < HOPEFUL * model.agreeing() as f64 {
            return None;
        }
        bend = next;
        if change < SETTLED {
            break;
        }
    }
    (bend.is_clear(photos) && agreeing > model.agreeing()).then_some(bend)
}

/// A match of photographs whose features have the standard deviations `deviations`, without the lens's bend.
fn straight_match(m: &Bearings, deviations: [f64; 2], k: f64) -> Bearings {
    let deviation = 0.5 * (deviations[0] * stretch(m.a, k) + deviations[1] * stretch(m.b, k));
    Bearings { a: straight(m.a, k), b: straight(m.b, k), deviation, views: m.views }
}

/// The lens that most matches of pairs support, where it is another one than a pinhole.
fn suspected(photos: &[PosePhoto], edges: &[Edge], seed: u64) -> Option<Bend> {
    let mut best: Vec<&Edge> = edges.iter().collect();
    best.sort_by_key(|e| (std::cmp::Reverse(e.estimate.inliers.len()), e.photos));
    best.truncate(VOTES);
    let unit = corner(&photos.first()?.working);
    let ks: Vec<f64> = std::iter::once(0.0).chain(TRIED.map(|tried| tried / unit)).collect();
    let prior = FocalPrior { mean: 0.0, deviation: FOCAL_DEVIATION };
    // Support and logarithm of the focal length, of each pair and each k.
    let votes: Vec<Vec<(f64, f64)>> = best
        .par_iter()
        .map(|edge| {
            let [a, b] = edge.photos.map(|i| &photos[i]);
            let matches = detected(a, b, &pair::some_pairs(a, b));
            let deviations = [a, b].map(|photo| deviations(photo)[0]);
            let of = |&k: &f64| {
                let straight: Vec<Bearings> =
                    matches.iter().map(|m| straight_match(m, deviations, k)).collect();
                pair::best(&straight, prior, seed)
                    .map_or((0.0, 0.0), |(support, refined)| (support, refined.focal_scale.ln()))
            };
            ks.iter().map(of).collect()
        })
        .collect();
    let support = |i: usize| votes.iter().map(|of_pair| of_pair[i].0).sum::<f64>();
    let most = (1..ks.len()).max_by(|&i, &j| support(i).total_cmp(&support(j)))?;
    let log_focal = votes.iter().map(|of_pair| of_pair[most].0 * of_pair[most].1).sum::<f64>();
    let focal_scale = (log_focal / support(most)).exp();
    let bend = Bend { k: ks[most], deviation: 0.0, focal_scale };
    let is_more = support(most) > (SUSPECT * support(0)).max(support(0) + SUSPECT_MATCHES);
    is_more.then_some(bend)
}

#[cfg(test)]
mod tests {
    use super::*;

    const KS: [f64; 4] = [-0.6, -0.1, 0.0, 0.05];

    #[test]
    fn bent_undoes_straight() {
        for k in KS {
            for at in [DVec2::ZERO, DVec2::new(0.4, -0.3), DVec2::new(-0.9, 0.7)] {
                let back = bent(straight(at, k), k).unwrap();
                assert!((back - at).length() < 1e-12, "{k}: {back} {at}");
            }
        }
        // Rays beyond the edge of what a pincushion shows.
        assert_eq!(bent(DVec2::new(3.0, 0.0), 0.05), None);
    }

    #[test]
    fn slopes_and_stretch_are_those_of_finite_differences() {
        const H: f64 = 1e-6;
        for k in KS {
            let at = DVec2::new(0.5, -0.35);
            let (by_position, by_k) = bent_slopes(at, k);
            let numeric = |plus: Option<DVec2>, minus: Option<DVec2>| {
                (plus.unwrap() - minus.unwrap()) / (2.0 * H)
            };
            for (i, axis) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
                let slope = numeric(bent(at + axis * H, k), bent(at - axis * H, k));
                assert!((slope - by_position.col(i)).length() < 1e-8, "{k}, {i}: {slope}");
            }
            let slope = numeric(bent(at, k + H), bent(at, k - H));
            assert!((slope - by_k).length() < 1e-8, "{k}: {slope} {by_k}");
            let radius = at.normalize();
            let along = |axis: DVec2| {
                (straight(at + axis * H, k) - straight(at - axis * H, k)).length() / (2.0 * H)
            };
            let mean = 0.5 * (along(radius) + along(radius.perp()));
            assert!((stretch(at, k) - mean).abs() < 1e-8, "{k}: {mean}");
        }
    }

    #[test]
    fn a_lens_is_the_same_in_other_focal_lengths() {
        let bend = Bend { k: -0.2, deviation: 0.01, focal_scale: 0.9 };
        let seen = bend.seen_from(1.5);
        // The same pixel and the same ray, each in units of its own focal length.
        let at = DVec2::new(0.6, 0.2);
        let rays = [straight(at, bend.k) / bend.focal_scale, {
            straight(at / 1.5, seen.k) / seen.focal_scale
        }];
        assert!((rays[0] - rays[1]).length() < 1e-12, "{rays:?}");
        assert!((seen.seen_from(1.0 / 1.5).k - bend.k).abs() < 1e-12);
    }
}
