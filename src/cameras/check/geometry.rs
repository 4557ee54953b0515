//! Geometry of matched points before two cameras: depths, parallax, overlap and coverage.
//!
//! Lengths are world units, positions px of the working size. `measures.rs` alone calls
//! these functions.

use super::epipolar::{Match, TwoViews, quantile};
use super::report::DepthReport;
use glam::{DMat3, DQuat, DVec2, DVec3};
use subsplat_kernels::camera::Intrinsics;

/// Points along each side of the grid on which overlap is measured.
const OVERLAP_GRID: usize = 24;
/// Cells along each side of the grid on which coverage is measured. A match covers its cell and the
/// eight around it, a twelfth of the side in each direction.
const COVERAGE_GRID: usize = 12;
/// Depths, in baselines, at which overlap is measured where no depth is known. The baseline of
/// photographs for reconstruction is a twentieth to a half of the depth.
const OVERLAP_DEPTHS: [f64; 6] = [1.0, 2.0, 4.0, 8.0, 16.0, 64.0];
/// Quantiles of the reported depths.
const QUANTILES: [f64; 5] = [0.02, 0.25, 0.5, 0.75, 0.98];
/// Near plane over the 2 % quantile. Points are found on texture only, and surfaces without texture
/// may be nearer. Depth candidates are uniform in 1/z, so this margin directly widens their
/// spacing.
const NEAR_MARGIN: f64 = 0.7;
/// Far plane over the 98 % quantile. A large margin costs little, because candidates are uniform in
/// 1/z.
const FAR_MARGIN: f64 = 2.0;
/// Quantile of [`parallax_beyond_rotation`]. The rotation cancels the parallax of the surface that
/// holds most points, so the median would be that surface's.
const BEYOND_ROTATION: f64 = 0.75;
/// Steps of the estimate of a rotation. It changes by less than a thousandth of a degree after 15.
const ROTATION_STEPS: usize = 20;
/// Side of the network's input, px, at which parallax is reported.
const INPUT_SIDE: f64 = 256.0;

/// Returns the depths of `matches` in the first camera. All `matches` are assumed right. Returns
/// `None` where fewer than half have a parallax above the `noise` of a point, px.
pub(super) fn depths(views: &TwoViews, matches: &[Match], noise: f64) -> Option<Vec<Option<f64>>> {
    let parallel = noise * views.radians_per_px();
    let depths: Vec<Option<f64>> = matches
        .iter()
        .map(|m| {
            let t = views.triangulate(m);
            (t.z_a > 0.0 && t.z_b > 0.0 && t.angle > parallel && t.z_a.is_finite()).then_some(t.z_a)
        })
        .collect();
    let known = depths.iter().flatten().count();
    (2 * known >= matches.len() && known > 0).then_some(depths)
}

/// Returns the median shift of the matches against infinity, px of the network's input.
pub(super) fn parallax(views: &TwoViews, matches: &[Match], longer_side: usize) -> f32 {
    shift(views, matches, longer_side, 0.5)
}

/// Returns the `q` quantile of the shifts against infinity, px of the network's input.
fn shift(views: &TwoViews, matches: &[Match], longer_side: usize, q: f64) -> f32 {
    let shift = |m: &Match| views.at_infinity(m.a).map(|far| far.distance(m.b));
    let mut shifts: Vec<f64> = matches.iter().filter_map(shift).collect();
    (quantile(&mut shifts, q).unwrap_or(0.0) * INPUT_SIDE / longer_side as f64) as f32
}

/// Returns the upper quartile of the matches' shifts that no rotation of the second camera explains, px
/// of the network's input. The rotation of `views` is the initial value only, so the result hardly
/// depends on it. A plane parallel to the picture gives little, whatever its parallax.
pub(super) fn parallax_beyond_rotation(
    views: &TwoViews,
    matches: &[Match],
    longer_side: usize,
) -> f32 {
    let rays: Vec<(DVec3, DVec3)> = matches
        .iter()
        .map(|m| {
            let ray = |k: &DMat3, px: DVec2| (k.inverse() * px.extend(1.0)).normalize_or(DVec3::Z);
            (ray(&views.k_a, m.a), ray(&views.k_b, m.b))
        })
        .collect();
    let mut rotation = views.rotation;
    // Least absolute deviations by reweighted least squares: the rotation follows the majority.
    for _ in 0..ROTATION_STEPS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (a, b) in &rays {
            let turned = rotation * *a;
            let weight = 1.0 / turned.distance(*b).max(1e-6);
            let outer = DMat3::from_cols(turned * turned.x, turned * turned.y, turned * turned.z);
            normal += (DMat3::IDENTITY - outer) * weight;
            right += turned.cross(*b) * weight;
        }
        // Rays in one direction leave the roll open.
        if normal.determinant().abs() < 1e-12 {
            break;
        }
        rotation = DMat3::from_quat(DQuat::from_scaled_axis(normal.inverse() * right)) * rotation;
    }
    shift(&TwoViews { rotation, ..*views }, matches, longer_side, BEYOND_ROTATION)
}

/// Computes quantiles and a depth range; `None` without depths.
pub(super) fn depth_report(
    views: &TwoViews,
    depths: &[Option<f64>],
    parallax_px: f32,
) -> Option<DepthReport> {
    let mut known: Vec<f64> = depths.iter().flatten().copied().collect();
    let mut quantiles = [0.0f64; 5];
    for (out, q) in quantiles.iter_mut().zip(QUANTILES) {
        *out = quantile(&mut known, q)?;
    }
    Some(DepthReport {
        quantiles: quantiles.map(|v| v as f32),
        near: (NEAR_MARGIN * quantiles[0]) as f32,
        far: (FAR_MARGIN * quantiles[4]) as f32,
        baseline_over_depth: (views.translation.length() / quantiles[2]) as f32,
        parallax_px,
    })
}

/// Returns the share of the first photograph that the second camera sees. Each position takes the
/// depth of the nearest matched point.
pub(super) fn overlap(
    views: &TwoViews,
    sizes: [&Intrinsics; 2],
    matches: &[Match],
    depths: &[Option<f64>],
) -> f32 {
    let known: Vec<(DVec2, f64)> =
        matches.iter().zip(depths).filter_map(|(m, d)| d.map(|z| (m.a, z))).collect();
    visible_share(views, sizes, |p| {
        let nearer = |a: &&(DVec2, f64), b: &&(DVec2, f64)| {
            a.0.distance_squared(p).total_cmp(&b.0.distance_squared(p))
        };
        known.iter().min_by(nearer).map_or(f64::INFINITY, |k| k.1)
    })
}

/// Returns the share of a picture of `size` px that lies near one of `positions`.
pub(super) fn coverage(size: &Intrinsics, positions: impl Iterator<Item = DVec2>) -> f32 {
    let mut covered = [[false; COVERAGE_GRID]; COVERAGE_GRID];
    let cell = |v: f64, side: usize| {
        ((v * COVERAGE_GRID as f64 / side as f64).max(0.0) as usize).min(COVERAGE_GRID - 1)
    };
    let around = |c: usize| c.saturating_sub(1)..=(c + 1).min(COVERAGE_GRID - 1);
    for position in positions {
        for row in &mut covered[around(cell(position.y, size.height))] {
            row[around(cell(position.x, size.width))].fill(true);
        }
    }
    let count = covered.iter().flatten().filter(|&&c| c).count();
    count as f32 / (COVERAGE_GRID * COVERAGE_GRID) as f32
}

/// Returns the largest overlap over [`OVERLAP_DEPTHS`], with one depth for the whole photograph.
pub(super) fn overlap_at_best(views: &TwoViews, sizes: [&Intrinsics; 2]) -> f32 {
    let baseline = views.translation.length().max(1e-9);
    OVERLAP_DEPTHS
        .iter()
        .map(|factor| visible_share(views, sizes, |_| factor * baseline))
        .fold(0.0, f32::max)
}

/// Returns the share of a grid on the first photograph that projects into the second, at depths
/// `depth(px)`.
fn visible_share(views: &TwoViews, sizes: [&Intrinsics; 2], depth: impl Fn(DVec2) -> f64) -> f32 {
    let (w, h) = (sizes[0].width as f64, sizes[0].height as f64);
    let (wb, hb) = (sizes[1].width as f64, sizes[1].height as f64);
    let step = |i: usize| (i as f64 + 0.5) / OVERLAP_GRID as f64;
    let inside = |p: DVec2| {
        let q = views.k_b * views.in_second(p, depth(p));
        let px = q.truncate() / q.z;
        q.z > 0.0 && px.x >= 0.0 && px.y >= 0.0 && px.x <= wb && px.y <= hb
    };
    let positions = (0..OVERLAP_GRID * OVERLAP_GRID)
        .map(|i| DVec2::new(step(i % OVERLAP_GRID) * w, step(i / OVERLAP_GRID) * h));
    positions.filter(|&p| inside(p)).count() as f32 / (OVERLAP_GRID * OVERLAP_GRID) as f32
}
