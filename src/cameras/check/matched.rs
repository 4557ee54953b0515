//! Matches points between two photographs, and selects the matches that agree with one another.
//!
//! Input: photographs at the working size; their cameras are only one of two geometries that the
//! matches may support. Output: [`Matched`], px of the working size.

use super::CheckOptions;
use super::epipolar::{Match, TwoViews, distance, median};
use super::estimate;
use super::working::WorkingPair;
use crate::cameras::matches::features;
use crate::cameras::matches::features::Orientation;
use crate::cameras::matches::pairs;
use glam::DVec2;

/// Smallest number of consistent matches that counts as evidence. Any 7 matches define a geometry,
/// and of 100 wrong ones one or two agree with it by chance.
pub(super) const MIN_EVIDENCE: usize = 16;
/// Smallest share of all matches that counts as evidence.
const MIN_EVIDENCE_SHARE: f64 = 0.25;

/// Points matched between the photographs.
pub(super) struct Matched {
    /// Number of features in each photograph.
    pub features: [usize; 2],
    /// All matches, the most certain first.
    pub matches: Vec<Match>,
    /// Indices of the matches that support one geometry.
    pub consistent: Vec<usize>,
    /// Number of matches that support the cameras.
    pub camera_inliers: usize,
    /// Median distance to the geometry estimated from the matches, working px.
    pub estimated_distance: f64,
    /// Number of matches that support the estimated geometry.
    pub estimated_inliers: usize,
}

impl Matched {
    /// Detects and matches features, then selects the consistent matches.
    pub(super) fn new(work: &WorkingPair, options: &CheckOptions) -> Self {
        let upright = Self::oriented(work, options, Orientation::Upright);
        if upright.is_sufficient() {
            return upright;
        }
        // Photographs that roll against each other need descriptors oriented along their gradients.
        let oriented = Self::oriented(work, options, Orientation::Gradient);
        if oriented.consistent.len() > upright.consistent.len() { oriented } else { upright }
    }

    /// Matches features whose descriptors have this orientation.
    fn oriented(work: &WorkingPair, options: &CheckOptions, orientation: Orientation) -> Self {
        let [a, b] = [&work.images[0], &work.images[1]]
            .map(|image| features::detect(image, options.features, orientation));
        let position = |f: &features::Feature| DVec2::new(f64::from(f.x), f64::from(f.y));
        let matches: Vec<Match> = pairs::pairs(&a, &b)
            .iter()
            .map(|p| Match { a: position(&a.points[p.a]), b: position(&b.points[p.b]) })
            .collect();
        Self::selected(work, [a.points.len(), b.points.len()], matches, options.seed)
    }

    /// Selects the matches that agree with the cameras or with another geometry.
    fn selected(work: &WorkingPair, features: [usize; 2], matches: Vec<Match>, seed: u64) -> Self {
        let limit = work.limit();
        let views = TwoViews::new(&work.cameras[0], &work.cameras[1]);
        let by_cameras: Vec<usize> = estimate::support(&views.fundamental(), &matches, limit)
            .into_iter()
            .filter(|&i| views.in_front(&matches[i], limit))
            .collect();
        let camera_inliers = by_cameras.len();
        let Some(estimate) = estimate::fundamental(&matches, limit, seed) else {
            return Self {
                features,
                matches,
                consistent: by_cameras,
                camera_inliers,
                estimated_distance: 0.0,
                estimated_inliers: 0,
            };
        };
        let inliers = estimate.inliers.iter();
        let distances = inliers.map(|&i| distance(&estimate.fundamental, &matches[i])).collect();
        let estimated_inliers = estimate.inliers.len();
        // The cameras have fewer degrees of freedom than a free matrix. With equal support
        // they are the better explanation.
        let consistent =
            if camera_inliers >= estimated_inliers { by_cameras } else { estimate.inliers };
        Self {
            features,
            matches,
            consistent,
            camera_inliers,
            estimated_distance: median(distances).unwrap_or(0.0),
            estimated_inliers,
        }
    }

    /// Returns the matches that support one geometry.
    pub(super) fn consistent_matches(&self) -> Vec<Match> {
        self.consistent.iter().map(|&i| self.matches[i]).collect()
    }

    /// Returns whether enough matches agree for an assessment of the poses.
    pub(super) fn is_sufficient(&self) -> bool {
        let n = self.consistent.len();
        n >= MIN_EVIDENCE && n as f64 >= MIN_EVIDENCE_SHARE * self.matches.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 16 matches, and a quarter of all.
    #[test]
    fn evidence_is_a_number_and_a_share_of_matches() {
        let enough = |consistent: usize, matches: usize| {
            let matched = Matched {
                features: [matches; 2],
                matches: vec![Match { a: DVec2::ZERO, b: DVec2::ZERO }; matches],
                consistent: (0..consistent).collect(),
                camera_inliers: 0,
                estimated_distance: 0.0,
                estimated_inliers: 0,
            };
            assert_eq!(matched.consistent_matches().len(), consistent);
            matched.is_sufficient()
        };
        assert_eq!([enough(15, 20), enough(16, 20)], [false, true]);
        assert_eq!([enough(249, 1000), enough(250, 1000)], [false, true]);
    }
}
