//! Consensus of views about depth: each pixel takes the depth that most views support.
//!
//! A pixel has several candidates: its own depth and, for every other view, the depth at which
//! the pixel's ray meets that view's surface. A view supports a candidate by its confidence if its
//! surface lies there in the pixel's colour. The result is the mean disparity of the candidates
//! around the best-supported one, weighted by confidence. A pixel whose ray meets no other surface
//! keeps its depth exactly.
//!
//! With nine views of rooms this lowers the error of depth by 6 %
//! (tools/lab/tried.md, "Many photographs").
//!
//! In: pictures, cameras, distances along the unit rays, confidences, tolerances. Out: distances,
//! `[V, H·W]`. No gradient: the choice has no derivative. Oracle: the same in f64 by matrices (the
//! tests).
//!
//! Views support and never oppose: opposition by surfaces that would be hidden costs 0.3 dB. The consensus
//! runs at inference alone, after the heads.

use super::rgbd::{RgbdView, Surface};
use rayon::prelude::*;

/// σ of the agreement of two disparities, as a share of the range of disparities.
pub const TOLERANCE: f32 = 0.03;
/// Weight of a pixel's own depth; that of another view's is 1.
pub const OWN_WEIGHT: f32 = 4.0;
/// Σ|ΔRGB| of display values at which support falls to 1/e.
pub const COLOUR: f32 = 0.3;
/// Surfaces from this number of σ on give no support.
pub const REACH: f32 = 3.0;
/// Steps of the search for the intersection of a ray and a surface.
pub const STEPS: u32 = 4;
/// A surface point that lies at most this far from the ray, px per axis, is on it.
pub const ON_RAY: f32 = 0.75;
/// Term of the weights, so that depths without confidence have a mean.
pub const LEAST_WEIGHT: f32 = 1e-3;

/// A view with the confidences of its depths.
#[derive(Clone, Copy, Debug)]
pub struct DepthView<'a> {
    /// Colours and depths.
    pub seen: RgbdView<'a>,
    /// `[H·W]`: confidences, at least 0.
    pub confidences: &'a [f32],
    /// σ of the agreement of two disparities, 1 / world units.
    pub tolerance: f32,
}

/// A depth of a pixel's ray, and its weight.
struct DepthCandidate {
    z: f32,
    weight: f32,
}

/// A view of [`depth_consensus`].
struct Voter<'a> {
    surface: Surface<'a>,
    confidences: &'a [f32],
    tolerance: f32,
}

impl<'a> Voter<'a> {
    fn new(DepthView { seen, confidences, tolerance }: DepthView<'a>) -> Self {
        Self { surface: Surface::new(seen), confidences, tolerance }
    }

    /// Agreement of two depths, 0 to 1.
    fn agreement(&self, z: f32, other: f32) -> f32 {
        let apart = (1.0 / z - 1.0 / other) / self.tolerance;
        if apart.abs() < REACH { (-0.5 * apart * apart).exp() } else { 0.0 }
    }

    /// The candidate of pixel `i` where its ray meets the surface of `other`.
    fn candidate(&self, i: usize, other: &Self) -> Option<DepthCandidate> {
        let centre = self.surface.centre(i);
        let mut z = self.surface.z[i];
        for _ in 0..STEPS {
            let (at, _) = other.surface.project(self.surface.point(centre, z))?;
            let pixel = other.surface.pixel(at);
            let met = other.surface.point(at, other.surface.z[pixel]);
            let (back, met_z) = self.surface.project(met)?;
            if (back - centre).abs().max_element() <= ON_RAY {
                return Some(DepthCandidate { z: met_z, weight: other.confidences[pixel] });
            }
            z = met_z;
        }
        None
    }

    /// Support of another view's `point` of `colour` by this view.
    fn support(&self, point: glam::Vec3, colour: [f32; 3]) -> f32 {
        let Some((at, z)) = self.surface.project(point) else { return 0.0 };
        let pixel = self.surface.pixel(at);
        let agreement = self.agreement(z, self.surface.z[pixel]);
        if agreement == 0.0 {
            return 0.0;
        }
        let same = (-self.surface.difference(at, colour) / COLOUR).exp();
        same * self.confidences[pixel] * agreement
    }

    /// The depth of pixel `i` that most support, if the pixel's ray meets another surface.
    /// `candidates` is a buffer.
    fn best(
        &self,
        i: usize,
        others: &[&Self],
        candidates: &mut Vec<DepthCandidate>,
    ) -> Option<f32> {
        let own = self.surface.z[i];
        let weight = OWN_WEIGHT * self.confidences[i];
        candidates.clear();
        candidates.push(DepthCandidate { z: own, weight });
        candidates.extend(others.iter().filter_map(|other| self.candidate(i, other)));
        if candidates.len() == 1 {
            return None;
        }
        let (centre, colour) = (self.surface.centre(i), self.surface.colour(i));
        let mut most = f32::NEG_INFINITY;
        let mut best = own;
        for candidate in &*candidates {
            let point = self.surface.point(centre, candidate.z);
            let supports = others.iter().map(|other| other.support(point, colour));
            let support = weight * self.agreement(candidate.z, own) + supports.sum::<f32>();
            if support > most {
                (most, best) = (support, candidate.z);
            }
        }
        let (mut sum, mut weights) = (0.0, 0.0);
        for DepthCandidate { z, weight } in &*candidates {
            let weight = (weight + LEAST_WEIGHT) * self.agreement(*z, best);
            sum += weight / z;
            weights += weight;
        }
        Some(weights / sum)
    }
}

/// Distances of all views' pixels along the unit rays, `[V, H·W]`, world units.
pub fn depth_consensus(views: &[DepthView<'_>]) -> Vec<f32> {
    let voters: Vec<Voter> = views.iter().map(|view| Voter::new(*view)).collect();
    let mut out: Vec<f32> = Vec::with_capacity(voters.iter().map(|v| v.confidences.len()).sum());
    for (v, own) in voters.iter().enumerate() {
        let others: Vec<&Voter> =
            voters.iter().enumerate().filter(|(u, _)| *u != v).map(|(_, other)| other).collect();
        let pixels = (0..own.confidences.len()).into_par_iter().with_min_len(1024);
        out.par_extend(pixels.map_init(Vec::new, |candidates, i| {
            let best = own.best(i, &others, candidates);
            best.map_or(own.surface.distance(i), |z| z * own.surface.ray_length(i))
        }));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::rgbd::examples::{
        SIDE, Seen, around, centre, colour, difference, noise, place, project, ray_length, turned,
        wall, z_of,
    };
    use super::*;
    use glam::DVec3;

    /// Range of disparities of 0.5 and 0.3, in the middle.
    const SIGMA: f32 = 0.01;

    fn depth_views<'a>(seen: &'a [Seen], confidences: &'a [Vec<f32>]) -> Vec<DepthView<'a>> {
        let view = |(seen, confidences): (&'a Seen, &'a Vec<f32>)| DepthView {
            seen: seen.view(),
            confidences,
            tolerance: SIGMA,
        };
        seen.iter().zip(confidences).map(view).collect()
    }

    /// Distances of the first of three views of the wall after `change`.
    fn distances(change: impl Fn(&mut [Seen], &mut [Vec<f32>])) -> Vec<f32> {
        let mut seen = [wall(0.0), wall(0.25), wall(-0.25)];
        let mut confidences = vec![vec![0.5; SIDE * SIDE]; 3];
        change(&mut seen, &mut confidences);
        let mut all = depth_consensus(&depth_views(&seen, &confidences));
        all.truncate(SIDE * SIDE);
        all
    }

    /// A pixel of the bright half of the wall.
    const AT: usize = 16 * SIDE + 20;

    #[test]
    fn views_that_agree_keep_their_depths() {
        let wall = wall(0.0).distances;
        let got = distances(|_, _| ());
        assert!(got.iter().zip(&wall).all(|(a, b)| (a - b).abs() < 1e-5 * b));
    }

    #[test]
    fn a_depth_without_confidence_takes_that_of_the_other_views() {
        let wrong = |seen: &mut [Seen], confidences: &mut [Vec<f32>]| {
            seen[0].distances[AT] *= 0.9;
            confidences[0][AT] = 0.0;
        };
        let wall = wall(0.0).distances;
        let got = distances(wrong);
        assert!((got[AT] - wall[AT]).abs() < 1e-3 * wall[AT], "{} {}", got[AT], wall[AT]);
        // A sure pixel keeps it.
        let sure = distances(|seen, confidences| {
            wrong(seen, confidences);
            confidences[0][AT] = 1.0;
        });
        assert!((sure[AT] - 0.9 * wall[AT]).abs() < 1e-3 * wall[AT], "{}", sure[AT]);
        // Surfaces of another colour give no support.
        let other_colour = distances(|seen, confidences| {
            wrong(seen, confidences);
            (confidences[0][AT], seen[1].rgb, seen[2].rgb) =
                (0.1, vec![0.0; 3 * SIDE * SIDE], vec![0.0; 3 * SIDE * SIDE]);
        });
        assert!((other_colour[AT] - 0.9 * wall[AT]).abs() < 1e-3 * wall[AT]);
    }

    #[test]
    fn depths_that_nobody_else_shows_and_nan_stay() {
        let far = distances(|seen, _| seen[0].distances[AT] *= 0.02);
        assert_eq!(far[AT], 0.02 * wall(0.0).distances[AT]);
        assert!(distances(|seen, _| seen[0].distances[AT] = f32::NAN)[AT].is_nan());
        let others = distances(|seen, _| {
            seen[1].distances.fill(f32::NAN);
            seen[2].distances.fill(f32::NAN);
        });
        assert!(others.iter().zip(&wall(0.0).distances).all(|(a, b)| (a - b).abs() < 1e-6 * b));
    }

    /// The same in f64 by 4×4 matrices, one pixel after the other.
    fn oracle(views: &[DepthView<'_>]) -> Vec<f64> {
        let mut out = Vec::new();
        for (v, own) in views.iter().enumerate() {
            let others: Vec<&DepthView> =
                (0..views.len()).filter(|u| *u != v).map(|u| &views[u]).collect();
            for i in 0..own.confidences.len() {
                let z = z_of(&own.seen, i);
                let own_weight = f64::from(OWN_WEIGHT * own.confidences[i]);
                let mut candidates = vec![(z, own_weight)];
                candidates.extend(others.iter().filter_map(|other| met(own, i, other)));
                let support = |z_candidate: f64| {
                    let point = place(&own.seen, centre(&own.seen, i), z_candidate);
                    let of = |other: &&DepthView| support(other, point, colour(&own.seen, i));
                    own_weight * agreement(own, z_candidate, z) + others.iter().map(of).sum::<f64>()
                };
                let best =
                    candidates.iter().rev().max_by(|a, b| support(a.0).total_cmp(&support(b.0)));
                let best = best.unwrap().0;
                let weight =
                    |(z, w): &(f64, f64)| (w + f64::from(LEAST_WEIGHT)) * agreement(own, *z, best);
                let sum: f64 = candidates.iter().map(|c| weight(c) / c.0).sum();
                let weights: f64 = candidates.iter().map(weight).sum();
                out.push(weights / sum * ray_length(&own.seen, i));
            }
        }
        out
    }

    fn agreement(view: &DepthView<'_>, a: f64, b: f64) -> f64 {
        let apart = (1.0 / a - 1.0 / b) / f64::from(view.tolerance);
        if apart.abs() < f64::from(REACH) { (-0.5 * apart * apart).exp() } else { 0.0 }
    }

    fn pixel(view: &RgbdView<'_>, at: glam::DVec2) -> usize {
        at.y.floor() as usize * view.camera.intrinsics.width + at.x.floor() as usize
    }

    fn met(own: &DepthView<'_>, i: usize, other: &DepthView<'_>) -> Option<(f64, f64)> {
        let centre = centre(&own.seen, i);
        let mut z = z_of(&own.seen, i);
        for _ in 0..STEPS {
            let (at, _) = project(&other.seen, place(&own.seen, centre, z))?;
            let j = pixel(&other.seen, at);
            let point = place(&other.seen, at, z_of(&other.seen, j));
            let (back, found) = project(&own.seen, point)?;
            if (back.x - centre.x).abs().max((back.y - centre.y).abs()) <= f64::from(ON_RAY) {
                return Some((found, f64::from(other.confidences[j])));
            }
            z = found;
        }
        None
    }

    fn support(view: &DepthView<'_>, point: DVec3, wanted: [f64; 3]) -> f64 {
        let Some((at, z)) = project(&view.seen, point) else { return 0.0 };
        let j = pixel(&view.seen, at);
        let apart = difference(&view.seen, &around(&view.seen, at), wanted);
        let same = (-apart / f64::from(COLOUR)).exp();
        same * f64::from(view.confidences[j]) * agreement(view, z, z_of(&view.seen, j))
    }

    #[test]
    fn three_turned_views_agree_with_the_oracle() {
        let seen = turned();
        let n = seen[0].distances.len();
        let confidences: Vec<_> = (0..3u8).map(|v| noise(n, 500.0 + f32::from(v))).collect();
        let mut views = depth_views(&seen, &confidences);
        // Distances are noise from 1.5 to 2: wide enough that many agree, and many do not.
        views.iter_mut().for_each(|view| view.tolerance = 0.03);
        let (got, want) = (depth_consensus(&views), oracle(&views));
        assert_eq!(got.len(), want.len());
        // Pixels that round the other way.
        let off = got.iter().zip(&want).filter(|(a, b)| (f64::from(**a) - **b).abs() > 1e-4);
        let off = off.count();
        assert!(off * 100 <= got.len(), "{off} of {}", got.len());
        let before = seen.iter().flat_map(|seen| &seen.distances);
        let moved = got.iter().zip(before).filter(|(a, b)| (**a - **b).abs() > 1e-2).count();
        assert!(moved * 10 > got.len() && moved < got.len(), "{moved}: nothing to see");
    }
}
