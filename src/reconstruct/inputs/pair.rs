//! Measures the geometry of two views and selects the context pair of a scene.
//!
//! Feed-forward reconstruction needs two views that share most of their content. Their baseline
//! must be large enough for parallax, the only source of depth. MVSplat advises an overlap of 40 to
//! 60 %; the weights that ship do best at 85 % (measured, see `OVERLAP`).
//!
//! Lengths are world units, angles degrees.
//!
//! The pair of a scene is chosen for the mean PSNR over all frames of the scene, those outside the pair included.
//! PSNR between two neighbours alone is highest, but such a pair covers little. An overlap of 85 % serves both:
//! on four scenes of real photographs that did not choose the rule, PSNR over all frames is 18.6 dB (40 to 60 %:
//! 17.7), and over frames between the two photographs 23.2 dB (18.0).
//!
//! A scene is made from its best pair and from the photographs that overlap with those chosen before
//! (`choose_photographs`), up to a number.
//!
//! Of many photographs, each is compared with its two best partners (`choose_sources`), not with all: the time
//! grows with twice the number of photographs, and wide pairs harm.

use crate::files::poses::scene::{Scene, Units};
use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::{Camera, NearFar};

/// Relative geometry of two cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewGeometry {
    /// Distance between the cameras, world units.
    pub baseline: f32,
    /// Angle of the rotation between the cameras, degrees.
    pub rotation_deg: f32,
    /// Share of each picture that lies inside the other, mean of both, in [0, 1]. Occlusion is not
    /// considered.
    pub overlap: f32,
}

/// Number of depths sampled, uniform in their logarithm.
const DEPTHS: usize = 8;
/// Number of pixels sampled along each side.
const GRID: usize = 12;

/// Compares two cameras for a scene between `near` and `far` (camera z, world units; uniform in the
/// logarithm).
pub fn view_geometry(a: &Camera, b: &Camera, near: f32, far: f32) -> ViewGeometry {
    geometry(a, b, 0.5 * (overlap_in(a, b, near, far) + overlap_in(b, a, near, far)))
}

/// Returns the geometry of two cameras with a known overlap.
fn geometry(a: &Camera, b: &Camera, overlap: f32) -> ViewGeometry {
    let between = a.rotation().transpose() * b.rotation();
    ViewGeometry {
        baseline: a.position().distance(b.position()),
        rotation_deg: angle(&between).to_degrees(),
        overlap,
    }
}

/// Returns the angle of a rotation matrix, radians. It uses the sine and the cosine, because acos
/// alone loses angles below a thousandth of a degree.
fn angle(r: &Mat3) -> f32 {
    let axis = Vec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    let trace = r.x_axis.x + r.y_axis.y + r.z_axis.z;
    axis.length().atan2(trace - 1.0)
}

/// Returns the share of `a`'s picture that lies inside `b`'s.
fn overlap_in(a: &Camera, b: &Camera, near: f32, far: f32) -> f32 {
    let (from, to) = (&a.intrinsics(), &b.intrinsics());
    let size = Vec2::new(from.width as f32, from.height as f32);
    let mut inside_count = 0;
    for d in 0..DEPTHS {
        let depth = near * (far / near).powf((d as f32 + 0.5) / DEPTHS as f32);
        for i in 0..GRID * GRID {
            let at = Vec2::new((i % GRID) as f32 + 0.5, (i / GRID) as f32 + 0.5) / GRID as f32;
            let point = a.unproject(at * size, depth);
            let inside = b.project(point).is_some_and(|p| {
                p.x >= 0.0 && p.y >= 0.0 && p.x <= to.width as f32 && p.y <= to.height as f32
            });
            inside_count += usize::from(inside);
        }
    }
    inside_count as f32 / (DEPTHS * GRID * GRID) as f32
}

/// A selected pair of frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// Indices of the frames, the smaller first.
    pub frames: [usize; 2],
    /// Relative geometry of the two cameras.
    pub geometry: ViewGeometry,
    /// Depth range for which the overlap was computed, world units.
    pub depths: [f32; 2],
    /// Explanation for the user, one sentence.
    pub reason: String,
}

/// Overlap of the best pairs, measured with the weights that ship on 190 pairs of seven scenes of
/// real photographs. Three scenes chose the rule among overlaps of 0.7 to 0.9. On the four others it
/// gives 18.6 dB over all frames of the scene and 23.2 dB over those between the two photographs;
/// the earlier rule, which preferred 0.4 to 0.6, gave 17.7 and 18.0 dB.
const OVERLAP: f32 = 0.85;
/// Weight of the coverage. 0.3 gains 1 dB between the photographs on the scenes that chose the rule,
/// with the same PSNR over all frames; more prefers wide pairs.
const COVERAGE: f32 = 0.3;
/// Rotation above which surfaces become oblique, degrees. The weights that ship are weak above 25.
const ROTATION_DEG: f32 = 20.0;
/// Smallest parallax: baseline over depth. The backbones were trained at 0.05 to 0.38, and the
/// measured pairs below 0.1 lose up to 2 dB over their scene.
const PARALLAX: f32 = 0.1;
/// Overlap of a further photograph with one that was chosen before. Less leaves places that one photograph
/// alone shows.
const LINK_OVERLAP: f32 = 0.7;
/// Least overlap of a further photograph. One that shows another place does not join.
const LEAST_OVERLAP: f32 = 0.3;
/// Largest number of frames whose pairs are all compared. More frames are subsampled evenly.
const FRAMES_MAX: usize = 128;

/// Frames that can be chosen, and how much of each the others see.
struct Candidates<'a> {
    scene: &'a Scene,
    /// Indices of the frames.
    frames: Vec<usize>,
    /// Row t: share of candidate t's picture that each candidate sees, 0 to 1.
    seen: Vec<Vec<f32>>,
    /// Distance of what the photographs show, world units, with its source.
    depth: f32,
    origin: &'static str,
}

impl<'a> Candidates<'a> {
    /// The usable frames of `scene`, [`FRAMES_MAX`] at most. Returns `None` where no distance is known.
    fn new(scene: &'a Scene) -> Option<Self> {
        let step = scene.frames.len().div_ceil(FRAMES_MAX).max(1);
        let frames: Vec<usize> = scene.usable().into_iter().step_by(step).collect();
        let (depth, origin) = typical_depth(scene)?;
        let [low, high] = depths_around(depth);
        let camera = |n: usize| &scene.frames[frames[n]].camera;
        let seen = (0..frames.len())
            .into_par_iter()
            .map(|t| {
                let share = |n: usize| overlap_in(camera(t), camera(n), low, high);
                (0..frames.len()).map(|n| if n == t { 1.0 } else { share(n) }).collect()
            })
            .collect();
        Some(Self { scene, frames, seen, depth, origin })
    }

    fn camera(&self, n: usize) -> &Camera {
        &self.scene.frames[self.frames[n]].camera
    }

    /// Mean share of both pictures that the other one shows.
    fn overlap(&self, a: usize, b: usize) -> f32 {
        0.5 * (self.seen[a][b] + self.seen[b][a])
    }

    /// The best pair as candidates, and its geometry.
    fn best_pair(&self) -> Option<([usize; 2], ViewGeometry)> {
        let count = self.frames.len();
        let coverage = |a: usize, b: usize| {
            self.seen.iter().map(|row| row[a].max(row[b])).sum::<f32>() / count as f32
        };
        let pairs: Vec<(usize, usize)> =
            (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).collect();
        let scored: Vec<(f32, [usize; 2], ViewGeometry)> = pairs
            .into_par_iter()
            .filter_map(|(a, b)| {
                let geometry = geometry(self.camera(a), self.camera(b), self.overlap(a, b));
                Some((score(&geometry, self.depth, coverage(a, b))?, [a, b], geometry))
            })
            .collect();
        // The first of equal scores, so that the result does not depend on the threads.
        let best = scored.into_iter().reduce(|a, b| if b.0 > a.0 { b } else { a });
        best.map(|(_, pair, geometry)| (pair, geometry))
    }
}

/// Range of distances around a typical one.
fn depths_around(depth: f32) -> [f32; 2] {
    [0.5 * depth, 2.0 * depth]
}

/// Selects the pair of frames with an overlap nearest to 85 %, a baseline and little rotation
/// (weights: see `score`).
///
/// Returns `None` if the scene has no two frames at different positions.
pub fn choose_pair(scene: &Scene) -> Option<Pair> {
    let candidates = Candidates::new(scene)?;
    let ([a, b], geometry) = candidates.best_pair()?;
    let Candidates { frames, depth, origin, .. } = candidates;
    let reason = format!(
        "about {:.0} % overlap, where 85 % gives the best views; turned by {:.1} degrees and \
         {:.3} apart, with the scene at about {depth:.3}: {origin}",
        100.0 * geometry.overlap,
        geometry.rotation_deg,
        geometry.baseline,
    );
    Some(Pair { frames: [frames[a], frames[b]], geometry, depths: depths_around(depth), reason })
}

/// Selects the frames of a scene that is made from `most` photographs at most, 2 or more: the best pair
/// ([`choose_pair`]), then again and again the frame that overlaps least with those chosen before, but by
/// 70 %; where none does, the one that overlaps most. Frames that overlap with none by
/// 30 % are left out. In ascending order.
///
/// Returns `None` if the scene has no two frames at different positions.
pub fn choose_photographs(scene: &Scene, most: usize) -> Option<Vec<usize>> {
    let candidates = Candidates::new(scene)?;
    let (pair, _) = candidates.best_pair()?;
    let mut chosen = pair.to_vec();
    let link = |t: usize, chosen: &[usize]| {
        chosen.iter().map(|&c| candidates.overlap(t, c)).fold(0.0f32, f32::max)
    };
    while chosen.len() < most {
        let rest = (0..candidates.frames.len()).filter(|t| !chosen.contains(t));
        let links: Vec<(usize, f32)> = rest
            .map(|t| (t, link(t, &chosen)))
            .filter(|(_, link)| *link >= LEAST_OVERLAP)
            .collect();
        let linked = links.iter().filter(|(_, link)| *link >= LINK_OVERLAP);
        // The first of equal overlaps.
        let next = linked
            .reduce(|a, b| if b.1 < a.1 { b } else { a })
            .or_else(|| links.iter().reduce(|a, b| if b.1 > a.1 { b } else { a }));
        let Some((next, _)) = next else { break };
        chosen.push(*next);
    }
    let mut frames: Vec<usize> = chosen.into_iter().map(|n| candidates.frames[n]).collect();
    frames.sort_unstable();
    Some(frames)
}

/// Returns the score of a pair, or `None` without a baseline. A higher score is better. `coverage`:
/// share of the scene's frames that one of the two sees, in [0, 1].
///
/// The goal is the mean PSNR over all frames of the scene, those outside the pair included. Between
/// two neighbours alone PSNR is highest, but such a pair shows little of the scene.
///
/// * The distance of the overlap to 0.85 counts fully, the coverage by 0.3.
/// * A rotation above 20 degrees costs 0.01 per degree.
/// * A parallax below 0.1 costs 5 per unit. Cameras that mostly turn overlap by 85 % without one.
fn score(g: &ViewGeometry, depth: f32, coverage: f32) -> Option<f32> {
    let parallax = g.baseline / depth;
    if parallax.is_nan() || parallax <= 1e-4 {
        return None;
    }
    let turned = 0.01 * (g.rotation_deg - ROTATION_DEG).max(0.0);
    let too_near = 5.0 * (PARALLAX - parallax).max(0.0);
    Some(COVERAGE * coverage - (g.overlap - OVERLAP).abs() - turned - too_near)
}

/// Weight of the angle between the baselines of a view's sources: a second source on the other
/// side shows what the first one does not.
const OPPOSITE_SIDE: f32 = 0.1;

/// Selects for each camera the `count` others with which its view is compared, the best first.
///
/// Each source has the best score of [`choose_pair`] without the coverage; later sources gain
/// where their baseline points away from those of earlier ones. `near` and `far`: depth range of
/// the scene, camera z. Cameras at one place come last. Returns fewer than `count` where there
/// are fewer cameras.
pub(crate) fn choose_sources(
    cameras: &[Camera],
    NearFar { near, far }: NearFar,
    count: usize,
) -> Vec<Vec<usize>> {
    // Candidates are uniform in 1/z; this is the depth of the middle one.
    let depth = 2.0 / (near.recip() + far.recip());
    let (low, high) = (0.5 * depth, 2.0 * depth);
    let of_view = |i: usize| -> Vec<usize> {
        let mut rest: Vec<(usize, f32, Vec3)> = (0..cameras.len())
            .filter(|&j| j != i)
            .map(|j| {
                let geometry = view_geometry(&cameras[i], &cameras[j], low, high);
                let score = score(&geometry, depth, 0.0).unwrap_or(f32::NEG_INFINITY);
                let across = cameras[j].position() - cameras[i].position();
                (j, score, across.normalize_or_zero())
            })
            .collect();
        let mut chosen: Vec<(usize, Vec3)> = Vec::new();
        while chosen.len() < count && !rest.is_empty() {
            let value = |(_, score, side): &(usize, f32, Vec3)| {
                let same = chosen.iter().map(|(_, s)| s.dot(*side)).sum::<f32>();
                score - OPPOSITE_SIDE * same
            };
            // The first of equal scores.
            let best = (0..rest.len())
                .reduce(|a, b| if value(&rest[b]) > value(&rest[a]) { b } else { a });
            let (j, _, side) = rest.remove(best.unwrap_or(0));
            chosen.push((j, side));
        }
        chosen.into_iter().map(|(j, _)| j).collect()
    };
    (0..cameras.len()).into_par_iter().map(of_view).collect()
}

/// Estimates the depth of the scene and names the source of the estimate.
fn typical_depth(scene: &Scene) -> Option<(f32, &'static str)> {
    let cameras: Vec<&Camera> = scene.frames.iter().map(|f| &f.camera).collect();
    if let Some(points) = &scene.points {
        let mut depths: Vec<f32> = Vec::new();
        for camera in &cameras {
            depths.extend(points_in_view(camera, points));
        }
        if depths.len() >= 20 {
            return Some((quantile(&mut depths, 0.5), "the median of the sparse points"));
        }
    }
    if scene.units == Units::RealEstate10k {
        // Rooms are a few units deep at the scale where near is 1.
        return Some((3.0, "RealEstate10K's scale"));
    }
    if let Some(depth) = convergence_depth(&cameras) {
        return Some((depth, "the distance at which the optical axes meet"));
    }
    let eyes = || cameras.iter().map(|c| c.position());
    let low = eyes().fold(Vec3::INFINITY, Vec3::min);
    let high = eyes().fold(Vec3::NEG_INFINITY, Vec3::max);
    let extent = low.distance(high);
    (extent > 0.0 && extent.is_finite()).then_some((1.5 * extent, "1.5 times the cameras' extent"))
}

/// Returns the median distance of the cameras to the point closest to all optical axes. Returns
/// `None` where the axes do not converge in front of the cameras.
fn convergence_depth(cameras: &[&Camera]) -> Option<f32> {
    // Least squares: Σ(I − d dᵀ)·x = Σ(I − d dᵀ)·p.
    let (mut a, mut b) = (Mat3::ZERO, Vec3::ZERO);
    for c in cameras {
        let d = c.rotation().z_axis;
        let across = Mat3::IDENTITY - Mat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += across;
        b += across * c.position();
    }
    let n = cameras.len() as f32;
    // The determinant of the mean projector is 0 for parallel axes; 0.01 is an average spread of
    // about six degrees.
    if (a * (1.0 / n)).determinant() < 0.01 {
        return None;
    }
    let point = a.inverse() * b;
    let mut depths: Vec<f32> = cameras.iter().map(|c| c.to_camera(point).z).collect();
    let in_front = depths.iter().filter(|d| **d > 0.0).count();
    let depth = quantile(&mut depths, 0.5);
    (in_front * 10 >= cameras.len() * 9 && depth.is_finite()).then_some(depth)
}

/// Returns the camera z of the points that project into the picture.
pub(crate) fn points_in_view(camera: &Camera, points: &[Vec3]) -> Vec<f32> {
    let k = &camera.intrinsics();
    let depth = |p: &Vec3| {
        let p = camera.to_camera(*p);
        let px = k.project(p);
        let inside =
            (0.0..=k.width as f32).contains(&px.x) && (0.0..=k.height as f32).contains(&px.y);
        (p.z > 0.0 && inside).then_some(p.z)
    };
    points.iter().filter_map(depth).collect()
}

/// Returns the `q` quantile by nearest rank, or NaN without values; sorts `values`.
pub fn quantile(values: &mut [f32], q: f32) -> f32 {
    values.sort_by(f32::total_cmp);
    let rank = (q * (values.len().max(1) - 1) as f32).round() as usize;
    values.get(rank).copied().unwrap_or(f32::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::photos::distortion::Distortion;
    use crate::files::poses::scene::{Frame, Pixels, SceneFormat};
    use glam::{Mat4, Quat};
    use subsplat_kernels::camera::Intrinsics;

    fn camera(angle: f32, position: Vec3) -> Camera {
        let k = Intrinsics::from_fov_x(std::f32::consts::FRAC_PI_2, 200, 200);
        let pose = Mat4::from_rotation_translation(Quat::from_rotation_y(angle), position);
        Camera::new(k, pose).unwrap()
    }

    fn scene(cameras: Vec<Camera>) -> Scene {
        let frame = |camera| Frame {
            entry: 0,
            other_shape: None,
            name: String::new(),
            image: "".into(),
            pixels: Pixels::Stored,
            camera,
            distortion: Distortion::None,
            cut: None,
            timestamp: None,
            depth: None,
            mask: None,
            visible: Vec::new(),
        };
        Scene {
            name: String::new(),
            frames: cameras.into_iter().map(frame).collect(),
            points: None,
            source: SceneFormat::Pair,
            units: Units::Unknown,
            near_far: None,
            origin: Default::default(),
            warnings: Vec::new(),
            left_out: Vec::new(),
            other_sources: Vec::new(),
        }
    }

    #[test]
    fn sources_are_the_best_partners_on_both_sides() {
        let depths = NearFar::new(1.0, 3.0);
        // Five cameras in a row, 0.2 apart; depth 1.5.
        let row: Vec<Camera> =
            (0..5u8).map(|i| camera(0.0, Vec3::X * 0.2 * f32::from(i))).collect();
        let sources = choose_sources(&row, depths, 2);
        assert!(sources[2].iter().any(|&j| j < 2) && sources[2].iter().any(|&j| j > 2));
        // 0.4 of 1.5 overlaps by 87 %, 0.2 by 93 %; 0.6 has less.
        assert_eq!(sources[0][0], 2, "{sources:?}");
        assert!(sources.iter().enumerate().all(|(i, s)| s.len() == 2 && !s.contains(&i)));
        // A camera at the same place and one that looks away come last.
        let others = vec![row[0], row[0], camera(3.1, Vec3::X * 0.2), row[1]];
        assert_eq!(choose_sources(&others, depths, 1)[0], [3]);
        // Fewer cameras than sources.
        assert_eq!(choose_sources(&row[..2], depths, 2), [[1], [0]]);
    }

    #[test]
    fn a_scene_of_many_photographs_is_covered_by_linked_ones() {
        // Sideways in steps of 0.1 at a depth of 3; then cameras elsewhere.
        let mut walk: Vec<Camera> =
            (0..40u8).map(|i| camera(0.0, Vec3::X * 0.1 * f32::from(i))).collect();
        walk.extend((0..5u8).map(|i| camera(3.0, Vec3::X * 0.1 * f32::from(i))));
        let mut walk = scene(walk);
        walk.units = Units::RealEstate10k;
        let frames = choose_photographs(&walk, 6).unwrap();
        assert_eq!(frames.len(), 6);
        let overlap = |a: usize, b: usize| {
            let [a, b] = [a, b].map(|i| &walk.frames[i].camera);
            view_geometry(a, b, 1.5, 6.0).overlap
        };
        let neighbours: Vec<f32> = frames.windows(2).map(|w| overlap(w[0], w[1])).collect();
        assert!(neighbours.iter().all(|o| *o >= LINK_OVERLAP), "{neighbours:?}");
        // They reach as far as the links allow.
        assert!(overlap(frames[0], frames[5]) < 0.4, "{frames:?}");
        // All of one place, none of the other.
        let all = choose_photographs(&walk, 100).unwrap();
        assert_eq!(all, (0..40).collect::<Vec<_>>());
        let pair = choose_pair(&walk).unwrap();
        assert_eq!(choose_photographs(&walk, 2).unwrap(), pair.frames);
    }

    #[test]
    fn known_geometry() {
        let a = camera(0.0, Vec3::ZERO);
        let same = view_geometry(&a, &a, 1.0, 10.0);
        assert_eq!((same.baseline, same.overlap), (0.0, 1.0));
        assert!(same.rotation_deg < 1e-3);
        // At depth 1 a picture of 90 degrees is 2 wide: a shift of 1 leaves a half.
        let g = view_geometry(&a, &camera(0.0, Vec3::X), 0.999, 1.001);
        assert!((g.overlap - 0.5).abs() < 1e-6, "{g:?}");
        assert!((g.baseline - 1.0).abs() < 1e-6);
        let g = view_geometry(&a, &camera(0.4, Vec3::ZERO), 1.0, 2.0);
        assert!((g.rotation_deg - 0.4f32.to_degrees()).abs() < 1e-3, "{g:?}");
        let back = view_geometry(&a, &camera(std::f32::consts::PI, Vec3::ZERO), 1.0, 2.0);
        assert_eq!(back.overlap, 0.0);
        assert!((back.rotation_deg - 180.0).abs() < 0.1);
    }

    #[test]
    fn the_pair_of_an_orbit_is_apart_and_overlaps() {
        // Cameras on a circle of radius 4 around the origin, 5 degrees apart, directed at the
        // centre.
        let orbit = |i: usize| {
            let a = (5.0 * i as f32).to_radians();
            camera(a, Quat::from_rotation_y(a) * Vec3::new(0.0, 0.0, -4.0))
        };
        let pair = choose_pair(&scene((0..24).map(orbit).collect())).unwrap();
        let g = pair.geometry;
        assert!((0.8..0.9).contains(&g.overlap), "{pair:?}");
        assert!((10.0..25.0).contains(&g.rotation_deg), "{pair:?}");
        assert!((0.4..1.7).contains(&g.baseline), "{pair:?}");
        assert!(pair.reason.contains("optical axes meet"), "{pair:?}");
    }

    #[test]
    fn the_pair_of_a_walk_overlaps_by_85_percent() {
        // Sideways in steps of 0.1 at RealEstate10K's scale: the assumed depth is 3.
        let mut walk = scene((0..40).map(|i| camera(0.0, Vec3::X * 0.1 * i as f32)).collect());
        walk.units = Units::RealEstate10k;
        let g = choose_pair(&walk).unwrap().geometry;
        assert!((0.8..0.9).contains(&g.overlap) && (0.5..1.2).contains(&g.baseline), "{g:?}");
    }

    /// The overlap of cameras that turn falls without any parallax.
    #[test]
    fn a_turn_is_no_substitute_for_a_baseline() {
        let at = |i: usize, x: f32| camera(0.03 * i as f32, Vec3::X * x);
        let mut mixed: Vec<Camera> = (0..8).map(|i| at(i, 0.001 * i as f32)).collect();
        mixed.extend((1..8).map(|i| at(0, 0.15 * i as f32)));
        let mut mixed = scene(mixed);
        mixed.units = Units::RealEstate10k;
        let g = choose_pair(&mixed).unwrap().geometry;
        assert!(g.baseline > 0.3, "{g:?}");
    }

    #[test]
    fn the_score_prefers_the_measured_geometry() {
        let g = |overlap, rotation_deg, baseline| ViewGeometry { overlap, rotation_deg, baseline };
        let score = |g| score(&g, 1.0, 0.5).unwrap();
        let best = score(g(0.85, 10.0, 0.2));
        assert!(super::score(&g(0.85, 10.0, 0.2), 1.0, 0.6).unwrap() > best);
        for worse in
            [g(0.6, 10.0, 0.2), g(0.97, 10.0, 0.2), g(0.85, 40.0, 0.2), g(0.85, 10.0, 0.05)]
        {
            assert!(score(worse) < best - 0.1, "{worse:?}");
        }
    }

    #[test]
    fn rotation_without_translation_gives_no_pair() {
        let cameras = (0..5).map(|i| camera(0.1 * i as f32, Vec3::ONE)).collect();
        assert!(choose_pair(&scene(cameras)).is_none());
        assert!(choose_pair(&scene(vec![camera(0.0, Vec3::ZERO)])).is_none());
    }
}
