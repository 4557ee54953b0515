//! Consistency between views: an opacity factor for each pixel's point.
//!
//! The point of a pixel is projected into every other view. A view without a surface before
//! the point should show the pixel's colour there. In another colour the depth of the point is
//! most likely wrong. The colour is compared with the nearest of 3×3 pixels, since depth is
//! exact to a pixel at best. On the photographs of the model card this gains 0.2 dB
//! (src/network/shipped/README.md, "The small backbone").
//!
//! In: pictures, cameras, distance along the unit ray of each pixel. Out: `[V, H·W]`,
//! factors from [`MIN_FACTOR`] (another colour in all views that show it) to 1 (the same
//! colour, or hidden in all views). No gradient: pictures are inputs, and the step of a point
//! across a silhouette has no derivative. Oracle: the same in f64 by matrices (the tests).

use super::rgbd::{RgbdView, Surface};
use rayon::prelude::*;

/// Factor of a pixel whose inconsistency is 1 in every view that shows its point.
pub const MIN_FACTOR: f32 = 0.1;
/// Σ|ΔRGB| of display values from which inconsistency is 1.
pub const COLOUR: f32 = 1.0;
/// A point is hidden where it lies behind the other view's surface by more than this
/// share of that surface's z.
pub const BEHIND: f32 = 0.05;

impl Surface<'_> {
    /// Returns the inconsistency of a `point` (world) of `colour` with this view, 0 to 1; none
    /// where the view does not show the point.
    fn inconsistency(&self, point: glam::Vec3, colour: [f32; 3]) -> Option<f32> {
        let (at, z) = self.project(point)?;
        let surface = self.around(at).map(|i| self.z[i]).fold(0.0, f32::max);
        let apart = || self.difference(at, colour).min(COLOUR) / COLOUR;
        (z <= surface * (1.0 + BEHIND)).then(apart)
    }
}

/// The factors of all views' pixels, `[V, H·W]`: 1 minus the mean inconsistency of
/// the other views that show the pixel's point.
pub fn cross_check(views: &[RgbdView<'_>]) -> Vec<f32> {
    let surfaces: Vec<Surface> = views.iter().map(|v| Surface::new(*v)).collect();
    let mut out: Vec<f32> = Vec::with_capacity(views.iter().map(|v| v.distances.len()).sum());
    for (v, own) in surfaces.iter().enumerate() {
        let factor = |i: usize| {
            let point = own.point(own.centre(i), own.z[i]);
            let others = surfaces.iter().enumerate().filter(|(u, _)| *u != v);
            let inconsistencies = others.filter_map(|(_, u)| u.inconsistency(point, own.colour(i)));
            let (sum, count) = inconsistencies.fold((0.0, 0u32), |(s, n), d| (s + d, n + 1));
            1.0 - (1.0 - MIN_FACTOR) * sum / count.max(1) as f32
        };
        let factors = (0..own.z.len()).into_par_iter().with_min_len(1024).map(factor);
        out.par_extend(factors);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::rgbd::examples::{
        SIDE, Seen, around, centre, colour, difference, place, project, turned, wall, z_of,
    };
    use super::*;
    use glam::DVec3;

    fn factors(change: impl Fn(&mut [f32])) -> Vec<f32> {
        let [mut a, b] = [wall(0.0), wall(0.5)];
        change(&mut a.distances);
        cross_check(&[a.view(), b.view()])
    }

    #[test]
    fn consistent_pixels_keep_their_opacity() {
        assert!(factors(|_| ()).iter().all(|f| *f == 1.0));
    }

    #[test]
    fn a_bright_point_before_the_dark_half_is_inconsistent() {
        // Pixel (17, 16) of the first view shows the bright half, 1.5 px right of the
        // edge at x = 0. At z = 1 its point lies at x = 0.047, which the second view
        // (8 px of parallax at z = 2, 16 at z = 1) shows 7 px left of the edge.
        let at = 16 * SIDE + 17;
        let all = factors(|d| d[at] *= 0.5);
        let expected = 1.0 - (1.0 - MIN_FACTOR) * 1.0;
        assert!((all[at] - expected).abs() < 1e-6, "{}", all[at]);
        // No other pixel of the first view; the second view has its own points before them.
        assert!(all[..SIDE * SIDE].iter().enumerate().all(|(i, f)| i == at || *f == 1.0));
    }

    #[test]
    fn hidden_points_and_points_outside_are_not_compared() {
        let at = 16 * SIDE + 17;
        // Behind the second view's wall by half; beyond its border (64 px of parallax).
        assert_eq!(factors(|d| d[at] *= 1.5)[at], 1.0);
        assert_eq!(factors(|d| d[at] *= 0.125)[at], 1.0);
        // A distance that is NaN has no point.
        assert_eq!(factors(|d| d[at] = f32::NAN)[at], 1.0);
    }

    /// The same in f64 by 4×4 matrices, one pixel after the other.
    fn oracle(views: &[RgbdView<'_>]) -> Vec<f64> {
        let mut out = Vec::new();
        for (v, own) in views.iter().enumerate() {
            for i in 0..own.distances.len() {
                let point = place(own, centre(own, i), z_of(own, i));
                let inconsistencies: Vec<f64> = (0..views.len())
                    .filter(|u| *u != v)
                    .filter_map(|u| inconsistency(&views[u], point, colour(own, i)))
                    .collect();
                let mean =
                    inconsistencies.iter().sum::<f64>() / inconsistencies.len().max(1) as f64;
                out.push(1.0 - (1.0 - f64::from(MIN_FACTOR)) * mean);
            }
        }
        out
    }

    fn inconsistency(view: &RgbdView<'_>, point: DVec3, wanted: [f64; 3]) -> Option<f64> {
        let (at, z) = project(view, point)?;
        let pixels = around(view, at);
        let surface = pixels.iter().map(|i| z_of(view, *i)).fold(0.0, f64::max);
        let apart = difference(view, &pixels, wanted).min(f64::from(COLOUR));
        let hidden = z > surface * (1.0 + f64::from(BEHIND));
        (!hidden).then_some(apart / f64::from(COLOUR))
    }

    #[test]
    fn three_turned_views_agree_with_the_oracle() {
        let seen = turned();
        let views: Vec<RgbdView> = seen.iter().map(Seen::view).collect();
        let (got, want) = (cross_check(&views), oracle(&views));
        assert_eq!(got.len(), want.len());
        // Pixels that round, or surfaces that hide, the other way.
        let off = got.iter().zip(&want).filter(|(a, b)| (f64::from(**a) - **b).abs() > 1e-4);
        let off = off.count();
        assert!(off * 200 <= got.len(), "{off} of {}", got.len());
        let doubted = want.iter().filter(|w| **w < 0.9).count();
        assert!(doubted * 10 > want.len() && doubted < want.len(), "{doubted}: nothing to see");
    }
}
