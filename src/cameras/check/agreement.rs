//! Measures how well the cameras explain the consistent matches, and finds the usual mistake that
//! explains them better.
//!
//! Input: cameras and matches at the working size. Output: [`Agreement`].

use super::epipolar::{Match, TwoViews, distance, median};
use super::mistakes::{Reading, readings};
use super::working::{LIMIT_PX, WorkingPair};

/// Median distance, px at 640, above which the poses are wrong rather than imprecise. Usable video
/// poses reach 2.8. 4 px are 1.6 px of a 256 px input, where both views' Gaussians miss each other
/// by more than their size.
const WRONG_PX: f64 = 4.0;
/// Smallest share of matches in front of both cameras.
const MIN_IN_FRONT: f64 = 0.7;
/// A reading is reported if its error is below this share of the error of the cameras as given.
const CLEARLY_BETTER: f64 = 0.3;
/// Factor of the focal length (or its inverse) above which it is a mistake. Calibrations of one
/// lens differ by a few percent.
const WRONG_FOCAL: f32 = 1.15;
/// Readings within this factor of the best, or within [`LIMIT_PX`] / 3, are reported too.
const EQUALLY_GOOD: f64 = 1.5;

/// Distances of matches to the epipolar lines of two cameras.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    /// Median epipolar distance, px. A point behind a camera counts as infinitely distant.
    pub error: f64,
    /// Median epipolar distance alone, px.
    pub distance: f64,
    /// Share of matches that triangulate in front of both cameras.
    pub in_front: f64,
}

impl Fit {
    /// Measures the fit of `views` to `matches`; `noise` is the accuracy of a point, px.
    pub(super) fn new(views: &TwoViews, matches: &[Match], noise: f64) -> Self {
        let f = views.fundamental();
        let distances: Vec<f64> = matches.iter().map(|m| distance(&f, m)).collect();
        let front: Vec<bool> = matches.iter().map(|m| views.in_front(m, noise)).collect();
        let counted = distances.iter().zip(&front);
        let errors = counted.map(|(&d, &ok)| if ok { d } else { f64::INFINITY }).collect();
        Self {
            error: median(errors).unwrap_or(f64::INFINITY),
            distance: median(distances).unwrap_or(f64::INFINITY),
            in_front: front.iter().filter(|&&ok| ok).count() as f64 / front.len().max(1) as f64,
        }
    }
}

/// Accuracy of the poses and intrinsics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Accuracy {
    /// Good enough for every measure.
    Precise,
    /// Good enough for depths, too bad for the sharpest result.
    Imprecise,
    /// No depth follows from them.
    Wrong,
}

/// Agreement of the cameras with the consistent matches.
pub(super) struct Agreement {
    /// Accuracy of the cameras.
    pub accuracy: Accuracy,
    /// Median distance of the matches to the cameras' epipolar lines, px at 640.
    pub error_px: f64,
    /// The error alone makes the cameras imprecise or wrong.
    pub is_distant: bool,
    /// Share of matches that triangulate in front of both cameras.
    pub in_front: f64,
    /// Readings that explain the matches clearly better, with their errors in px at 640, the best
    /// first. Empty for precise cameras.
    pub better: Vec<(f64, Reading)>,
}

impl Agreement {
    /// Assesses the cameras of `work` by their `fit` to the matches `chosen`.
    pub(super) fn new(work: &WorkingPair, chosen: &[Match], fit: &Fit) -> Self {
        let error_px = fit.distance / work.px_per_report_px;
        let is_distant = error_px.is_finite() && error_px > LIMIT_PX;
        let is_behind = fit.in_front < MIN_IN_FRONT;
        let in_front = fit.in_front;
        if error_px <= LIMIT_PX && !is_behind {
            let accuracy = Accuracy::Precise;
            let better = Vec::new();
            return Self { accuracy, error_px, is_distant, in_front, better };
        }
        let mut better = better_readings(work, chosen, fit);
        let is_mistaken = is_behind
            || error_px > WRONG_PX
            || better.first().is_some_and(|(_, reading)| is_mistake(reading));
        let accuracy = if is_mistaken { Accuracy::Wrong } else { Accuracy::Imprecise };
        better.iter_mut().for_each(|(error, _)| *error /= work.px_per_report_px);
        Self { accuracy, error_px, is_distant, in_front, better }
    }
}

/// Returns whether a reading that fits shows a mistake rather than an inexact calibration.
fn is_mistake(reading: &Reading) -> bool {
    reading.rank == 0 || reading.factor.is_some_and(|f| f.max(1.0 / f) > WRONG_FOCAL)
}

/// Returns the readings that explain the matches clearly better, with their errors in working px,
/// the best first. The usual mistakes have precedence over a changed focal length, and that over
/// other axes.
fn better_readings(work: &WorkingPair, chosen: &[Match], given: &Fit) -> Vec<(f64, Reading)> {
    let limit = work.limit();
    let sizes = [0, 1].map(|i| (work.images[i].width(), work.images[i].height()));
    let error =
        |r: &Reading| Fit::new(&TwoViews::new(&r.cameras[0], &r.cameras[1]), chosen, limit).error;
    let mut tried: Vec<(f64, Reading)> =
        readings(&work.cameras, sizes).into_iter().map(|r| (error(&r), r)).collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    for rank in 0..=Reading::LAST_RANK {
        // Poses may be imprecise even after a usual mistake is corrected. Readings from a search
        // fit partly by chance and must therefore fit well.
        let max_error = if rank == 0 { WRONG_PX * work.px_per_report_px } else { limit };
        let fits = |(e, r): &(f64, Reading)| {
            r.rank == rank && *e <= max_error && *e < CLEARLY_BETTER * given.error
        };
        let mut fitting: Vec<(f64, Reading)> = tried.iter().filter(|t| fits(t)).cloned().collect();
        let Some(best) = fitting.first().map(|f| f.0) else { continue };
        let as_good = (EQUALLY_GOOD * best).max(limit / 3.0);
        fitting.retain(|(e, _)| *e <= as_good);
        if rank > 0 {
            fitting.truncate(1);
        }
        return fitting;
    }
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::super::CheckOptions;
    use super::*;
    use crate::cameras::matches::GrayImage;
    use glam::{DVec2, Mat4, Quat, Vec3};
    use subsplat_kernels::camera::{Camera, Intrinsics};

    const SIZE: [usize; 2] = [640, 480];

    fn camera(x: f32, turn: f32) -> Camera {
        let pose = Mat4::from_rotation_translation(Quat::from_rotation_y(turn), Vec3::X * x);
        Camera::new(Intrinsics::from_fov_x(1.0, SIZE[0], SIZE[1]), pose).unwrap()
    }

    /// Photographs of 640 px, of which a working pixel is a reported one.
    fn work(cameras: [Camera; 2]) -> WorkingPair {
        let grey = GrayImage::new(SIZE[0], SIZE[1], vec![0.5; SIZE[0] * SIZE[1]]).unwrap();
        WorkingPair::new([&grey, &grey], cameras, &CheckOptions::default())
    }

    /// Each threshold by cases 2 % below and above it, as numbers.
    #[test]
    fn accuracy_has_the_measured_thresholds() {
        let work = work([camera(0.0, 0.0), camera(0.3, 0.1)]);
        let of = |distance: f64, in_front: f64| {
            Agreement::new(&work, &[], &Fit { error: distance, distance, in_front }).accuracy
        };
        let by = |at: f64| [0.98, 1.02].map(|part| of(part * at, 1.0));
        assert_eq!(by(1.5), [Accuracy::Precise, Accuracy::Imprecise]);
        assert_eq!(by(4.0), [Accuracy::Imprecise, Accuracy::Wrong]);
        let front = [0.98, 1.02].map(|part| of(0.5, part * 0.7));
        assert_eq!(front, [Accuracy::Wrong, Accuracy::Precise]);
    }

    #[test]
    fn a_mistaken_focal_length_is_off_by_more_than_a_calibration() {
        let cameras = [camera(0.0, 0.0), camera(0.3, 0.1)];
        let reading = |rank: u8, factor: Option<f32>| {
            let (name, clause) = (String::new(), String::new());
            is_mistake(&Reading { name, clause, rank, factor, cameras })
        };
        let factors = [0.98 * 1.15, 1.02 * 1.15, 1.0 / (0.98 * 1.15), 1.0 / (1.02 * 1.15)];
        assert_eq!(factors.map(|f| reading(1, Some(f))), [false, true, false, true]);
        assert!(reading(0, None) && !reading(2, None));
    }

    /// Cameras with OpenGL's axes, and matches of the true ones that are off by half a pixel: the reading is better
    /// than the cameras as given if its error is below 0.3 of theirs.
    #[test]
    fn a_reading_is_reported_where_it_is_clearly_better() {
        let truth = [camera(0.0, 0.0), camera(0.3, 0.1)];
        let opengl = Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0));
        let given = truth.map(|c| c.with_pose_unchecked(c.world_from_camera() * opengl));
        let place = |c: &Camera, p: Vec3| c.project(p).unwrap().as_dvec2();
        let one = |i: usize| {
            let at = |k: usize| (i * k % 61) as f32 / 61.0 - 0.5;
            let point = Vec3::new(2.0 * at(7), 1.5 * at(11), 3.0 + 2.0 * at(23));
            let off = DVec2::Y * if i.is_multiple_of(2) { 0.5 } else { -0.5 };
            Match { a: place(&truth[0], point), b: place(&truth[1], point) + off }
        };
        let matches: Vec<Match> = (0..60).map(one).collect();
        let work = work(given);
        let better = |error: f64| {
            let fit = Fit { error, distance: error, in_front: 1.0 };
            better_readings(&work, &matches, &fit)
        };
        let (error, reading) = better(f64::INFINITY).swap_remove(0);
        assert!(reading.rank == 0 && error > 0.2, "{} {error}", reading.name);
        assert!(better(error / (0.98 * 0.3)).iter().any(|(_, r)| r.name == reading.name));
        assert!(better(error / (1.02 * 0.3)).is_empty());
    }
}
