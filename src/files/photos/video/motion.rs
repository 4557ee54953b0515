//! Motion between two small grey frames, by the features and the matcher of [`crate::cameras::matches`].
//!
//! The matcher needs no start value, so that frames that are seconds apart can be compared, and a cut shows as
//! features without consistent partners. Tracking from frame to frame (Lucas and Kanade) would be faster, and would
//! lose its points in fast motion and add up noise where the camera stands still.

use crate::cameras::matches::GrayImage;
use crate::cameras::matches::features::{Features, Orientation, detect};
use crate::cameras::matches::pairs::pairs;
use glam::{DMat3, DVec2, DVec3};

/// Features of a frame: enough for medians, at a few milliseconds a frame.
const FEATURES: usize = 300;
/// Focal length over the longer side, as the estimation of cameras assumes it.
const FOCAL: f64 = 0.75;
/// Steps of the estimate of a rotation.
const ROTATION_STEPS: usize = 10;
/// Fewest matches of two frames of one place.
const MATCHES_MIN: usize = 12;
/// Distance of a right match from the common motion, share of the longer side, and the share of the matches that
/// must lie within it. Wrong matches lie a third of the side away.
const CONSISTENT: (f64, f64) = (0.1, 0.5);
/// Quantile of the displacements that no rotation explains. The rotation follows the surface with the most
/// matches, so that the median would be that surface's.
const PARALLAX_QUANTILE: f64 = 0.75;

/// A small grey frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Thumbnail {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Values, row by row.
    pub data: Vec<u8>,
}

/// Motion from one frame to another, shares of the frames' longer side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Motion {
    /// Median displacement of the matched points.
    pub displacement: f64,
    /// Displacement that no rotation of the camera explains: the upper quartile.
    pub parallax: f64,
}

impl Thumbnail {
    /// Detects the features of the frame.
    pub fn features(&self) -> Features {
        let pixels = self.data.iter().map(|v| f32::from(*v) / 255.0).collect();
        let image = GrayImage::new(self.width, self.height, pixels);
        image.map(|image| detect(&image, FEATURES, Orientation::Upright)).unwrap_or_default()
    }
}

/// The motion between two frames of `size` pixels; `None` where they show no common place, or too little texture.
pub(super) fn motion(a: &Features, b: &Features, size: [usize; 2]) -> Option<Motion> {
    let [width, height] = size.map(|side| side as f64);
    let longer = width.max(height);
    let focal = FOCAL * longer;
    let centre = 0.5 * DVec2::new(width, height);
    let at = |f: &Features, i: usize| {
        let p = &f.points[i];
        (DVec2::new(f64::from(p.x), f64::from(p.y)) - centre) / focal
    };
    let flow: Vec<[DVec2; 2]> =
        pairs(a, b).iter().map(|pair| [at(a, pair.a), at(b, pair.b)]).collect();
    motion_of(&flow, longer / focal)
}

/// [`motion`] of matched positions on the plane z = 1, on which the longer side has length `longer`.
fn motion_of(flow: &[[DVec2; 2]], longer: f64) -> Option<Motion> {
    if flow.len() < MATCHES_MIN {
        return None;
    }
    let mut lengths: Vec<f64> = flow.iter().map(|[a, b]| a.distance(*b) / longer).collect();
    let mut beyond: Vec<f64> =
        beyond_rotation(flow).into_iter().map(|residual| residual / longer).collect();
    let consistent = beyond.iter().filter(|r| **r < CONSISTENT.0).count();
    if (consistent as f64) < CONSISTENT.1 * flow.len() as f64 {
        return None;
    }
    // Wrong matches are no motion.
    let right = |r: &f64| *r < CONSISTENT.0;
    let mut keep = beyond.iter().map(right).collect::<Vec<_>>().into_iter();
    lengths.retain(|_| keep.next().unwrap_or(false));
    beyond.retain(right);
    Some(Motion {
        displacement: quantile(&mut lengths, 0.5),
        parallax: quantile(&mut beyond, PARALLAX_QUANTILE),
    })
}

fn quantile(values: &mut [f64], q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get((values.len() as f64 * q) as usize).copied().unwrap_or(0.0)
}

/// Lengths of the displacements that the rotation of the most matches does not explain: least absolute deviations
/// by reweighted least squares, of the displacements by a small rotation (Longuet-Higgins and Prazdny 1980).
fn beyond_rotation(flow: &[[DVec2; 2]]) -> Vec<f64> {
    let basis = |p: DVec2| {
        let DVec2 { x, y } = p;
        [DVec2::new(x * y, 1.0 + y * y), DVec2::new(-1.0 - x * x, -x * y), DVec2::new(y, -x)]
    };
    let mut rotation = DVec3::ZERO;
    let residual = |[a, b]: &[DVec2; 2], rotation: DVec3| {
        let [u, v, w] = basis(0.5 * (*a + *b));
        (*b - *a) - (u * rotation.x + v * rotation.y + w * rotation.z)
    };
    for _ in 0..ROTATION_STEPS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for pair in flow {
            let weight = 1.0 / residual(pair, rotation).length().max(1e-5);
            let axes = basis(0.5 * (pair[0] + pair[1]));
            let change = pair[1] - pair[0];
            let row = |of: DVec2| DVec3::from_array(axes.map(|axis| axis.dot(of)));
            normal += DMat3::from_cols_array_2d(&axes.map(|axis| row(axis).to_array())) * weight;
            right += row(change) * weight;
        }
        if normal.determinant().abs() < 1e-12 {
            break;
        }
        rotation = normal.inverse() * right;
    }
    flow.iter().map(|pair| residual(pair, rotation).length()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Points in front of a camera that turns by `turn` radians about y and moves by `x`, as positions of two frames.
    fn flow(turn: f64, x: f64) -> Vec<[DVec2; 2]> {
        let project = |p: DVec3| p.truncate() / p.z;
        let point = |i: usize| {
            let (u, v) = ((i % 8) as f64 / 4.0 - 0.9, (i / 8) as f64 / 4.0 - 0.9);
            DVec3::new(u, v, 1.0) * (2.0 + (i % 5) as f64)
        };
        let moved = |p: DVec3| DQuat::from_rotation_y(turn) * (p - DVec3::new(x, 0.0, 0.0));
        (0..64).map(|i| [project(point(i)), project(moved(point(i)))]).collect()
    }

    #[test]
    fn a_rotation_has_no_parallax_and_a_step_aside_has() {
        let longer = 1.0 / FOCAL;
        let turned = motion_of(&flow(0.05, 0.0), longer).unwrap();
        assert!(turned.displacement > 0.03 && turned.parallax < 0.002, "{turned:?}");
        let moved = motion_of(&flow(0.0, 0.3), longer).unwrap();
        assert!(moved.displacement > 0.03 && moved.parallax > 0.015, "{moved:?}");
        let still = motion_of(&flow(0.0, 0.0), longer).unwrap();
        assert!(still.displacement < 1e-9 && still.parallax < 1e-9);
    }

    #[test]
    fn wrong_matches_are_no_motion() {
        let longer = 1.0 / FOCAL;
        let mut mixed = flow(0.0, 0.3);
        let clean = motion_of(&mixed, longer).unwrap();
        for (i, pair) in mixed.iter_mut().enumerate().filter(|(i, _)| i % 4 == 0) {
            pair[1] = DVec2::new((i % 7) as f64 / 5.0 - 0.6, (i % 11) as f64 / 9.0 - 0.6);
        }
        let with_wrong = motion_of(&mixed, longer).unwrap();
        assert!((with_wrong.displacement - clean.displacement).abs() < 0.02);
        let wrong: Vec<_> = mixed
            .iter()
            .enumerate()
            .map(|(i, pair)| [pair[0], mixed[(i * 37 + 11) % 64].map(|p| -p)[1]])
            .collect();
        assert_eq!(motion_of(&wrong, longer), None);
        assert_eq!(motion_of(&mixed[..MATCHES_MIN - 1], longer), None);
    }
}
