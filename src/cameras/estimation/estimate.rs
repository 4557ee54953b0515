//! The estimate for applications: from photographs to cameras, points and a confidence.

use super::absolute::Absolute;
use super::bend;
use super::edges::Edge;
use super::focal;
use super::groups;
use super::pair::{self, PairEstimate};
use super::photo::{PosePhoto, STATED};
use super::reasons::{PoseRefusal, PoseWarning, narrow_view};
use super::reconstruct::{Model, Point, midpoint};
use super::still;
use super::tracks::FeatureId;
use super::two_view::Bearings;
use super::world;
use super::zoom;
use glam::{DMat3, DVec3, Mat4, Vec3};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Options of [`estimate_poses`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct PoseOptions {
    /// Seed of the random samples.
    pub seed: u64,
    /// Treatment of photographs that do not determine their cameras.
    pub uncertain: Uncertain,
    /// Lenses may bend straight lines ([`PoseEstimate::radial`]).
    pub may_bend: bool,
}

/// Treatment of photographs that do not determine their cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Uncertain {
    /// They are refused ([`PoseRefusal`]).
    #[default]
    Refuse,
    /// The best estimate is returned, as long as there is any.
    Accept,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self { seed: 0x5EED, uncertain: Uncertain::Refuse, may_bend: true }
    }
}

impl PoseOptions {
    /// Sets [`PoseOptions::uncertain`].
    #[must_use]
    pub fn with_uncertain(mut self, uncertain: Uncertain) -> Self {
        self.uncertain = uncertain;
        self
    }

    /// Sets [`PoseOptions::may_bend`].
    #[must_use]
    pub fn with_may_bend(mut self, may_bend: bool) -> Self {
        self.may_bend = may_bend;
        self
    }
}

/// Reliability of an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Confidence {
    /// The matches determine the cameras.
    High,
    /// The cameras may be off by more than five degrees.
    Low,
}

/// A shared focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalEstimate {
    /// Focal length over that of the photographs' lenses; 1 where it was exact. Where the photographs have several focal
    /// lengths ([`PoseWarning::Zoomed`]), over that of lenses in these proportions, and each camera has its own.
    pub scale: f64,
    /// Standard deviation of its logarithm: 0.03 means three percent. At least the distance to another focal length that
    /// the points support nearly as well. 0 where it was exact.
    pub deviation: f64,
}

/// A lens that bends straight lines: a position d of the picture, in focal lengths from its middle, shows the direction
/// (d / (1 + k |d|²), 1). Source: A. Fitzgibbon 2001.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RadialLens {
    /// k: negative for a barrel, positive for a pincushion.
    pub k: f64,
    /// Focal length of the picture's middle over that of the photographs' lenses.
    pub focal_scale: f64,
}

/// A point that two or more photographs show.
#[derive(Clone, Debug, PartialEq)]
pub struct PosePoint {
    /// Position, world units.
    pub position: Vec3,
    /// Colour in one of the photographs, sRGB.
    pub colour: [u8; 3],
    /// Index of each photograph, and the position in it, px.
    pub observations: Vec<(usize, [f32; 2])>,
    /// Mean distance between positions and projections, px.
    pub error_px: f32,
}

/// A photograph without a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Index of the photograph.
    pub photo: usize,
    /// The reason, a clause for the user.
    pub reason: String,
}

/// Cameras of photographs, sparse points, and how certain they are.
///
/// World: +y down, the first camera with a pose at the origin, looking towards +z as far as the
/// horizon allows; the median depth of the points is 1.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PoseEstimate {
    /// One camera for each photograph, intrinsics in px of the photograph; `None` for those in
    /// [`PoseEstimate::left_out`].
    pub cameras: Vec<Option<Camera>>,
    /// The points.
    pub points: Vec<PosePoint>,
    /// Photographs without a camera, with the reason.
    pub left_out: Vec<LeftOut>,
    /// Focal length.
    pub focal: FocalEstimate,
    /// The lens where three or more photographs show that it bends straight lines. Cameras and points are those of a
    /// pinhole all the same: whoever reads this straightens the photographs and estimates their cameras again.
    pub radial: Option<RadialLens>,
    /// Verdict on the whole.
    pub confidence: Confidence,
    /// Standard deviation of the least certain camera's rotation, degrees.
    pub rotation_error_deg: f64,
    /// Standard deviation of the direction from the first camera to the least certain one, degrees.
    pub direction_error_deg: f64,
    /// Weaknesses, for the user.
    pub warnings: Vec<PoseWarning>,
}

impl PoseEstimate {
    /// One sentence, without a final full stop, for each reason in [`PoseEstimate::left_out`].
    /// `name` gives the name of the photograph of an index. A sentence has up to three names and the
    /// number of the other photographs. Empty where every photograph has a camera.
    pub fn left_out_sentences(&self, name: impl Fn(usize) -> String) -> Vec<String> {
        groups::sentences(&self.left_out, name)
    }
}

/// Smallest number of matches, found without a geometry, that agree with a pose. Random matches of
/// unrelated photographs reach 9.
const MIN_CONSISTENT: usize = 15;
/// Smallest share of them among all matches.
const MIN_SHARE: f64 = 0.2;
/// Number of agreeing matches below which a pose is not certain.
const FEW_CONSISTENT: usize = 45;
/// Points of each of three and more photographs below which cameras of an unknown lens are not certain.
const FEW_A_PHOTOGRAPH: usize = 40;
/// Median shift of matched points below which two photographs are one view, px of 640 px.
const SAME_VIEW_PX: f64 = 0.5;
/// Median shift beside the best rotation below which the camera did not move, px of 640 px.
const MIN_PARALLAX_PX: f64 = 1.0;
/// Support of another pose over that of the best above which the estimate is not certain.
const RIVAL: f64 = 0.85;
/// Support above which neither is chosen.
const AMBIGUOUS: f64 = 0.985;
/// Standard deviation of the focal length's logarithm above which the poses are not certain.
const UNCERTAIN_FOCAL: f64 = 0.12;
/// Standard deviation of a direction above which it is not certain, degrees.
const UNCERTAIN_DIRECTION: f64 = 1.5;
/// Side at which shifts are reported, px.
const REPORT_SIDE: f64 = 640.0;

/// Estimates the cameras of two or more photographs of one scene, in any order.
///
/// # Errors
/// See [`PoseRefusal`].
pub fn estimate_poses(
    photos: &[PosePhoto],
    options: &PoseOptions,
) -> Result<PoseEstimate, PoseRefusal> {
    // Views of one photograph have exact lenses, with which a common focal length is no unknown.
    if photos.iter().any(PosePhoto::has_views)
        && photos.iter().any(|photo| photo.lens.deviation > 0.0)
    {
        let exact: Vec<PosePhoto> = photos.iter().map(|photo| photo.with_focal(1.0)).collect();
        return estimate_poses(&exact, options);
    }
    match photos {
        [a, b] => two(a, b, options),
        [] | [_] => Err(PoseRefusal::TooFew { count: photos.len() }),
        _ => match still::without_still(photos) {
            None => many(photos, options, true),
            Some((moving, share)) => {
                let mut estimate = many(&moving, options, true)?;
                estimate.warnings.push(PoseWarning::StandsStill { percent: 100.0 * share });
                Ok(estimate)
            }
        },
    }
}

/// Two photographs, with rotated descriptors where upright ones find too little.
fn two(a: &PosePhoto, b: &PosePhoto, options: &PoseOptions) -> Result<PoseEstimate, PoseRefusal> {
    let upright = pair::estimate(a, b, true, options.seed);
    // Panoramas turn by any angle; their views are level.
    if a.has_views() || b.has_views() {
        return judged(a, b, upright, options);
    }
    if supported(&upright) >= FEW_CONSISTENT && !is_upside_down(&upright) {
        return judged(a, b, upright, options);
    }
    let turned = [a, b].map(PosePhoto::with_rotated_features);
    let rotated = pair::estimate(&turned[0], &turned[1], true, options.seed);
    let better = supported(&rotated) > supported(&upright) + supported(&upright) / 2;
    let (best, [first, second]) =
        if better { (rotated, [&turned[0], &turned[1]]) } else { (upright, [a, b]) };
    // Symmetric things in a mirrored photograph agree with a camera upside down behind a plane.
    if options.uncertain == Uncertain::Refuse
        && (supported(&best) < FEW_CONSISTENT || is_upside_down(&best))
        && let Some(refusal) = mirrored(a, b, supported(&best), options)
    {
        return Err(refusal);
    }
    judged(first, second, best, options)
}

/// Returns whether one of the cameras looks back, or lies on its side and beyond, as the other
/// sees it.
fn is_upside_down(e: &Result<PairEstimate, Vec<Bearings>>) -> bool {
    let turn = |e: &PairEstimate| super::two_view::rotation_angle(&e.refined.relative.rotation);
    e.as_ref().is_ok_and(|e| turn(e) > std::f64::consts::FRAC_PI_2)
}

/// Number of matches that were found without a geometry and agree with the pose.
fn supported(e: &Result<PairEstimate, Vec<Bearings>>) -> usize {
    e.as_ref().map_or(0, |e| e.consistent)
}

/// Refuses an estimate, or turns it into cameras and points.
fn judged(
    a: &PosePhoto,
    b: &PosePhoto,
    estimate: Result<PairEstimate, Vec<Bearings>>,
    options: &PoseOptions,
) -> Result<PoseEstimate, PoseRefusal> {
    let estimate = estimate.map_err(|matches| unexplained(a, &matches))?;
    let refusal = refusal(a, &estimate);
    if let (Some(refusal), Uncertain::Refuse) = (&refusal, options.uncertain) {
        return Err(refusal.clone());
    }
    let relative = estimate.refined.relative;
    let cameras = [Absolute::IDENTITY, Absolute::IDENTITY.followed_by(&relative, 1.0)];
    let eye = cameras[1].position();
    let scale = estimate.refined.focal_scale;
    let mut points = Vec::new();
    for (m, p) in estimate.points.iter().zip(&estimate.inliers) {
        let m = m.rescaled(scale);
        if relative.depths(&m).iter().all(|z| *z > 0.0) {
            let [a, b] = m.rays();
            let u = a.normalize();
            let v = (cameras[1].rotation.transpose() * b).normalize();
            let features =
                vec![FeatureId { photo: 0, feature: p.a }, FeatureId { photo: 1, feature: p.b }];
            points.push(Point { position: midpoint([DVec3::ZERO, eye], [u, v]), features });
        }
    }
    let [rotation, direction, focal] = pair_deviations(&estimate);
    let model = Model {
        cameras: cameras.map(Some).to_vec(),
        points,
        focal_scale: scale,
        focal_deviation: focal,
        rotation_deviation: rotation,
        position_deviation: direction,
        bend: None,
        bundle: None,
    };
    let mut warnings: Vec<PoseWarning> = refusal.map(PoseWarning::Forced).into_iter().collect();
    if a.lens.deviation.max(b.lens.deviation) > STATED {
        warnings
            .push(PoseWarning::FocalOfTwo { focal_px: f64::from(a.lens.intrinsics.fx) * scale });
    }
    if estimate.consistent < FEW_CONSISTENT {
        warnings.push(PoseWarning::FewPoints { count: estimate.consistent });
    }
    if estimate.rival > RIVAL {
        warnings.push(PoseWarning::Rival { percent: 100.0 * estimate.rival });
    }
    Ok(finished(&[a, b], model, Vec::new(), warnings))
}

/// Standard deviations of rotation and direction, radians, and of the logarithm of the focal
/// length.
fn pair_deviations(estimate: &PairEstimate) -> [f64; 3] {
    let Some(c) = estimate.refined.information.lu().try_inverse() else {
        return [f64::INFINITY; 3];
    };
    let sum = |from: usize, to: usize| (from..to).map(|i| c[(i, i)]).sum::<f64>().sqrt();
    let focal = if estimate.free_focal { sum(5, 6) } else { 0.0 };
    [sum(0, 3), sum(3, 5), focal]
}

/// Returns why a pair is no basis for cameras.
fn refusal(a: &PosePhoto, estimate: &PairEstimate) -> Option<PoseRefusal> {
    let scale = estimate.refined.focal_scale;
    let points: Vec<Bearings> = estimate.points.iter().map(|m| m.rescaled(scale)).collect();
    let (consistent, matches) = (estimate.consistent, estimate.matches);
    if consistent < MIN_CONSISTENT || (consistent as f64) < MIN_SHARE * matches as f64 {
        return Some(few_matches(consistent, matches));
    }
    let percent = 100.0 * estimate.rival;
    let ambiguous = (estimate.rival > AMBIGUOUS).then_some(PoseRefusal::Ambiguous { percent });
    still(a, &points, scale).or(ambiguous)
}

/// Returns the refusal of matches that no pose explains.
fn unexplained(a: &PosePhoto, matches: &[Bearings]) -> PoseRefusal {
    let enough = matches.len() >= MIN_CONSISTENT;
    enough.then(|| still(a, matches, 1.0)).flatten().unwrap_or(few_matches(0, matches.len()))
}

fn few_matches(consistent: usize, matches: usize) -> PoseRefusal {
    let needed = MIN_CONSISTENT.max((MIN_SHARE * matches as f64).ceil() as usize);
    PoseRefusal::FewMatches { consistent, matches, needed }
}

/// Returns the refusal of points that a camera sees which did not move. `points` belong to a focal
/// length `scale` times that of the lens of `a`.
fn still(a: &PosePhoto, points: &[Bearings], scale: f64) -> Option<PoseRefusal> {
    let k = &a.lens.intrinsics;
    let px = f64::from(k.fx.min(k.fy)) * scale * REPORT_SIDE / k.width.max(k.height) as f64;
    let shift = |m: &Bearings| match m.views {
        None => m.a.distance(m.b),
        Some(_) => m.shift(&DMat3::IDENTITY),
    };
    let shift_px = px * median(points.iter().map(shift).collect());
    if shift_px < SAME_VIEW_PX {
        return Some(PoseRefusal::SameView { shift_px });
    }
    let turn = best_rotation(points);
    let parallax_px = px * median(points.iter().map(|m| m.shift(&turn)).collect());
    let degrees = super::two_view::rotation_angle(&turn).to_degrees();
    (parallax_px < MIN_PARALLAX_PX).then_some(PoseRefusal::PureRotation { degrees, parallax_px })
}

/// Returns the refusal of two photographs of which one is mirrored: at least twice as many matches
/// as `consistent` agree with a pose, or with no motion, once the second is flipped.
fn mirrored(
    a: &PosePhoto,
    b: &PosePhoto,
    consistent: usize,
    options: &PoseOptions,
) -> Option<PoseRefusal> {
    let flipped = pair::estimate(a, &b.flipped(), false, options.seed);
    let agreeing = match &flipped {
        Ok(estimate) => estimate.consistent,
        Err(matches) if matches.len() >= MIN_CONSISTENT && still(a, matches, 1.0).is_some() => {
            matches.len()
        }
        Err(_) => 0,
    };
    let enough = agreeing >= FEW_CONSISTENT && agreeing >= 2 * consistent;
    enough.then_some(PoseRefusal::Mirrored { consistent: agreeing })
}

/// The rotation that moves the first bearings closest to the second ones: least squares on unit
/// vectors, then again on the closer half of them. Source: W. Kabsch 1976.
fn best_rotation(points: &[Bearings]) -> DMat3 {
    let unit: Vec<[DVec3; 2]> =
        points.iter().map(|m| m.rays().map(|ray| ray.normalize())).collect();
    let mut rotation = DMat3::IDENTITY;
    let mut chosen: Vec<usize> = (0..unit.len()).collect();
    for _ in 0..6 {
        let mut sum = nalgebra::Matrix3::<f64>::zeros();
        for &i in &chosen {
            let [a, b] = unit[i].map(|v| nalgebra::Vector3::new(v.x, v.y, v.z));
            sum += b * a.transpose();
        }
        let svd = sum.svd(true, true);
        let (Some(u), Some(vt)) = (svd.u, svd.v_t) else { return rotation };
        let sign = (u * vt).determinant().signum();
        let fix = nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, sign));
        rotation = DMat3::from_cols_slice((u * fix * vt).as_slice());
        let mut order: Vec<(f64, usize)> = (0..unit.len())
            .map(|i| ((rotation * unit[i][0]).distance_squared(unit[i][1]), i))
            .collect();
        order.sort_by(|x, y| x.0.total_cmp(&y.0));
        chosen = order.iter().take(unit.len().div_ceil(2)).map(|o| o.1).collect();
    }
    rotation
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Three and more photographs, whose lenses may differ in their focal lengths by more than is known of them.
fn many(
    photos: &[PosePhoto],
    options: &PoseOptions,
    may_zoom: bool,
) -> Result<PoseEstimate, PoseRefusal> {
    let deviation = photos.iter().fold(0.0f64, |m, p| m.max(p.lens.deviation));
    let accepted = options.uncertain == Uncertain::Accept;
    let is_sound = |photos: &[PosePhoto], e: &Edge| {
        accepted || refusal(&photos[e.photos[0]], &e.estimate).is_none()
    };
    let (best, spread) =
        focal::built(photos, deviation, &is_sound, options.seed).ok_or(PoseRefusal::NoPair)?;
    let focal::Built { first, photos: exact, edges: usable, prior, mut model } = best;
    model.focal_deviation = model.focal_deviation.max(spread);
    let wrong = if may_zoom { focal::contradicted(photos, &is_sound, options.seed) } else { None };
    let sound = |e: &Edge| is_sound(&exact, e);
    let zooms = may_zoom.then(|| zoom::of_photos(&exact, &model, prior, sound, options.seed));
    if let Some(zooms) = zooms.flatten() {
        let zoomed: Vec<PosePhoto> = photos.iter().zip(&zooms).map(|(p, z)| p.zoomed(*z)).collect();
        let mut estimate = many(&zoomed, options, false)?;
        estimate.warnings.push(PoseWarning::Zoomed { percent: zoom::percent(&zooms) });
        return Ok(estimate);
    }
    let radial = (options.may_bend && may_zoom)
        .then(|| bend::of_photos(&exact, &usable, &model, prior, sound, options.seed))
        .flatten()
        .map(|bend| bend.seen_from(1.0 / first));
    model.focal_scale *= first;
    let placed: Vec<bool> = model.cameras.iter().map(Option::is_some).collect();
    let pairs: Vec<[usize; 2]> = usable.iter().map(|e| e.photos).collect();
    let left_out = groups::left_out(&placed, &pairs);
    let all: Vec<&PosePhoto> = photos.iter().collect();
    let wrong = wrong.map(PoseWarning::contradicted);
    let few =
        too_few(&model, deviation).then_some(PoseWarning::FewPoints { count: model.points.len() });
    let mut estimate = finished(&all, model, left_out, few.into_iter().chain(wrong).collect());
    // On the plane of the focal length that was found, as the definition says.
    estimate.radial = radial.map(|bend| {
        let focal_scale = bend.focal_scale;
        RadialLens { k: bend.seen_from(focal_scale).k, focal_scale }
    });
    Ok(estimate)
}

/// Returns whether a model has too few points for lenses whose focal length has the standard deviation `deviation`.
fn too_few(model: &Model, deviation: f64) -> bool {
    deviation > STATED && model.points.len() < FEW_A_PHOTOGRAPH * model.placed()
}

/// Moves a model to the world frame and writes it out.
fn finished(
    photos: &[&PosePhoto],
    model: Model,
    left_out: Vec<LeftOut>,
    mut warnings: Vec<PoseWarning>,
) -> PoseEstimate {
    let placed: Vec<usize> = (0..photos.len()).filter(|&i| model.cameras[i].is_some()).collect();
    let mut cameras: Vec<Absolute> = placed.iter().filter_map(|&i| model.cameras[i]).collect();
    let mut positions: Vec<DVec3> = model.points.iter().map(|p| p.position).collect();
    let index = |photo: usize| placed.binary_search(&photo).ok();
    let depths = model.points.iter().flat_map(|p| {
        let cameras = &cameras;
        p.features
            .iter()
            .filter_map(move |f| index(f.photo).map(|i| cameras[i].to_camera(p.position).z))
    });
    let depth = median(depths.collect());
    world::upright(&mut cameras, &mut positions, if depth > 0.0 { 1.0 / depth } else { 1.0 });
    let scale = model.focal_scale;
    let mut out = vec![None; photos.len()];
    for (&photo, pose) in placed.iter().zip(&cameras) {
        let k = photos[photo].lens.intrinsics;
        let intrinsics = Intrinsics {
            fx: (f64::from(k.fx) * scale) as f32,
            fy: (f64::from(k.fy) * scale) as f32,
            ..k
        };
        let rotation = pose.rotation.transpose().as_mat3();
        let world_from_camera = Mat4::from_mat3_translation(rotation, pose.position().as_vec3());
        out[photo] = Camera::new(intrinsics, world_from_camera).ok();
    }
    let points = model
        .points
        .iter()
        .zip(&positions)
        .map(|(p, position)| written(photos, &out, p, position.as_vec3()))
        .collect();
    if model.focal_deviation > UNCERTAIN_FOCAL {
        warnings.push(PoseWarning::UncertainFocal { percent: 100.0 * model.focal_deviation });
    }
    let direction = model.position_deviation.to_degrees();
    if !(direction < UNCERTAIN_DIRECTION) {
        warnings.push(PoseWarning::UncertainDirection { degrees: direction });
    }
    warnings.extend(narrow_view(photos, scale));
    PoseEstimate {
        cameras: out,
        points,
        left_out,
        focal: FocalEstimate { scale, deviation: model.focal_deviation },
        radial: None,
        confidence: if warnings.is_empty() { Confidence::High } else { Confidence::Low },
        rotation_error_deg: model.rotation_deviation.to_degrees(),
        direction_error_deg: direction,
        warnings,
    }
}

/// A point with its colour, observations in px and error.
fn written(
    photos: &[&PosePhoto],
    cameras: &[Option<Camera>],
    point: &Point,
    position: Vec3,
) -> PosePoint {
    let mut observations = Vec::with_capacity(point.features.len());
    let mut error = 0.0;
    for f in &point.features {
        let photo = photos[f.photo];
        let px = photo.in_photograph(photo.position(f.feature)).as_vec2();
        let project = |camera: Camera| photo.project(&camera, f.feature, position);
        if let Some(projected) = cameras[f.photo].and_then(project) {
            error += projected.distance(px);
        }
        observations.push((f.photo, px.to_array()));
    }
    let colour = point
        .features
        .first()
        .and_then(|f| photos[f.photo].colours.get(f.feature).copied())
        .unwrap_or_default();
    let error_px = error / observations.len().max(1) as f32;
    PosePoint { position, colour, observations, error_px }
}

#[cfg(test)]
mod tests;
