//! Cameras and points of three or more photographs, one photograph after the other.
//!
//! Pairs are matched and verified (`edges.rs`); their matches join to tracks. The best pair of the
//! largest group ([`Groups`]) starts; then the photograph that sees most points is located among
//! them, its tracks give new points, and all cameras and points are adjusted together. Where a
//! larger group is left out than was placed, it is reconstructed as well, and the model with most
//! photographs is used. Thereby photographs of which all fit are reconstructed once.
//!
//! Source: N. Snavely, S. Seitz and R. Szeliski, "Photo tourism", 2006; J. Schönberger and
//! J.-M. Frahm, "Structure-from-motion revisited", 2016.

use super::absolute::{Absolute, Sight, in_view, locate};
use super::bend::{self, Bend};
use super::bundle::{Bundle, Observation};
use super::edges::{Edge, edges_of};
use super::groups::Groups;
use super::photo::{PosePhoto, aligned_position};
use super::refine::FocalPrior;
use super::tracks::{FeatureId, tracks};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Smallest number of points by which a photograph is located.
const MIN_SIGHTS: usize = 12;
/// Smallest share of the points that agree with a located photograph.
const MIN_SIGHT_SHARE: f64 = 0.25;
/// Largest residual of a sight or an observation, standard deviations.
const LIMIT: f64 = 5.0;
/// The same for cameras that are given and not adjusted yet. Matches of verified pairs are hardly
/// ever wrong, and 100 deviations of a feature are 40 working px: 4° or more.
const GIVEN_LIMIT: f64 = 100.0;
/// Smallest angle between two rays of a point, radians (1.5 degrees).
const MIN_ANGLE: f64 = 0.026;
/// Angle between rays at which a pair is wide enough to start with, radians (6 degrees).
const START_ANGLE: f64 = 0.105;
/// Largest number of models that are built: the first one, and others of photographs that it leaves
/// out. It bounds the time where one model after the other places few photographs.
const MODELS: usize = 4;

/// A point with its features.
#[derive(Clone, Debug)]
pub(super) struct Point {
    /// Position, units of the model.
    pub position: DVec3,
    /// The features that agree with it.
    pub features: Vec<FeatureId>,
}

/// Cameras and points in an arbitrary frame and scale.
#[derive(Clone, Debug)]
pub(super) struct Model {
    /// One pose for each photograph; `None` where it does not fit.
    pub cameras: Vec<Option<Absolute>>,
    /// The points.
    pub points: Vec<Point>,
    /// Focal length over that of the lenses.
    pub focal_scale: f64,
    /// Standard deviation of the logarithm of the focal length.
    pub focal_deviation: f64,
    /// Largest standard deviation of a camera's rotation, radians.
    pub rotation_deviation: f64,
    /// Largest standard deviation of a camera's position over the extent of all.
    pub position_deviation: f64,
    /// The lens, where the photographs have one that bends.
    pub bend: Option<Bend>,
    /// All of it for one more adjustment, and the photographs of its cameras.
    pub bundle: Option<(Bundle, Vec<usize>)>,
}

impl Model {
    /// Number of photographs with a pose.
    pub(super) fn placed(&self) -> usize {
        self.cameras.iter().flatten().count()
    }

    /// Number of features that agree with the points.
    pub(super) fn agreeing(&self) -> usize {
        self.points.iter().map(|p| p.features.len()).sum()
    }
}

/// The growing model.
struct Builder<'a> {
    photos: &'a [PosePhoto],
    tracks: Vec<Vec<FeatureId>>,
    cameras: Vec<Option<Absolute>>,
    /// Position of each track; `None` where it is not a point yet.
    positions: Vec<Option<DVec3>>,
    /// Features of each point that agree with it.
    agreeing: Vec<Vec<FeatureId>>,
    log_focal: f64,
    prior: Option<FocalPrior>,
    /// Places of features after the alignment of their surroundings: (track, feature) in order.
    precise: Vec<Vec<Option<DVec2>>>,
    /// Largest residual of an observation, standard deviations.
    limit: f64,
}

/// Builds cameras and points of `photos` from verified pairs. `prior` is the knowledge of the
/// focal length over that of the lenses. `None` where no pair is wide enough to start with.
///
/// The largest group of photographs is built first. A group of photographs that no model has placed
/// is built as well where it is larger than the best model: a wrong pair joins two groups, or a model
/// started with a wrong pair. Other photographs may join it again. Of models with equally many
/// photographs the first one is returned.
pub(super) fn build(
    photos: &[PosePhoto],
    edges: &[Edge],
    prior: Option<FocalPrior>,
    seed: u64,
) -> Option<Model> {
    let mut is_left = vec![true; photos.len()];
    let mut best: Option<Model> = None;
    for _ in 0..MODELS {
        let most = best.as_ref().map_or(0, Model::placed);
        let Some((_, start)) = start(edges, &is_left).filter(|(size, _)| *size > most) else {
            break;
        };
        let model = grow(photos, edges, start, prior, seed);
        for (is_left, camera) in is_left.iter_mut().zip(&model.cameras) {
            *is_left &= camera.is_none();
        }
        if model.placed() > most {
            best = Some(model);
        }
    }
    best
}

/// Builds cameras and points from the pair `start`, of all photographs that fit.
fn grow(
    photos: &[PosePhoto],
    edges: &[Edge],
    start: &Edge,
    prior: Option<FocalPrior>,
    seed: u64,
) -> Model {
    let mut builder = Builder::new(photos, edges, prior);
    let [a, b] = start.photos;
    builder.cameras[a] = Some(Absolute::IDENTITY);
    builder.cameras[b] =
        Some(Absolute::IDENTITY.followed_by(&start.estimate.refined.relative, 1.0));
    builder.triangulate();
    builder.adjust(10);
    let mut refused = vec![false; photos.len()];
    while let Some(next) = builder.most_sights(&refused) {
        match builder.register(next, seed) {
            Some(pose) => {
                builder.cameras[next] = Some(pose);
                builder.triangulate();
                builder.adjust(6);
                // A photograph that was refused before may fit the larger model.
                refused.fill(false);
            }
            None => refused[next] = true,
        }
    }
    builder.align();
    for _ in 0..2 {
        builder.triangulate();
        builder.adjust(25);
    }
    builder.finish()
}

/// Cameras that were adjusted from given ones.
#[derive(Clone, Debug)]
pub(super) struct Adjusted {
    /// One pose for each photograph; `None` where too few points are seen.
    pub cameras: Vec<Option<Absolute>>,
    /// Median residual with the given cameras, working px.
    pub before: f64,
    /// The same with the adjusted ones.
    pub after: f64,
    /// Number of points.
    pub points: usize,
}

/// Adjusts `given` cameras by the matches of pairs. `None` where fewer than two photographs see
/// enough points.
pub(super) fn adjust(photos: &[PosePhoto], edges: &[Edge], given: &[Absolute]) -> Option<Adjusted> {
    let mut builder = Builder::new(photos, edges, None);
    builder.cameras = given.iter().copied().map(Some).collect();
    builder.limit = GIVEN_LIMIT;
    builder.triangulate();
    let mut seen = vec![0usize; photos.len()];
    builder.agreeing.iter().flatten().for_each(|f| seen[f.photo] += 1);
    for (camera, seen) in builder.cameras.iter_mut().zip(&seen) {
        camera.take_if(|_| *seen < MIN_SIGHTS);
    }
    if builder.cameras.iter().flatten().count() < 2 {
        return None;
    }
    let start = builder.cameras.clone();
    builder.adjust(15);
    builder.limit = LIMIT;
    builder.triangulate();
    builder.align();
    for _ in 0..2 {
        builder.triangulate();
        builder.adjust(25);
    }
    let cameras = builder.cameras.clone();
    let points = builder.positions.iter().flatten().count();
    builder.limit = f64::INFINITY;
    let mut error = |cameras: &[Option<Absolute>]| {
        builder.cameras = cameras.to_vec();
        builder.positions.fill(None);
        builder.triangulate();
        builder.median_residual()
    };
    let (before, after) = (error(&start)?, error(&cameras)?);
    Some(Adjusted { cameras, before, after, points })
}

/// Locates the photographs after the first `known.len()` among the points that those show with the
/// cameras `known`. `None` for a photograph that shows too few of them.
pub(super) fn locate_others(
    photos: &[PosePhoto],
    known: &[Absolute],
    seed: u64,
) -> Vec<Option<Absolute>> {
    let all = (0..photos.len()).flat_map(|j| (0..j.min(known.len())).map(move |i| [i, j]));
    let edges = edges_of(photos, all.collect(), seed);
    let mut builder = Builder::new(photos, &edges, None);
    builder.cameras[..known.len()].iter_mut().zip(known).for_each(|(c, k)| *c = Some(*k));
    builder.triangulate();
    builder.align();
    builder.triangulate();
    (known.len()..photos.len()).into_par_iter().map(|i| builder.register(i, seed)).collect()
}

/// The pair to start with, and the number of photographs of its group. Pairs and groups are those of
/// the photographs that are left. A pair of the largest group that has one starts: the one with many
/// matches and a wide angle between their rays.
fn start<'a>(edges: &'a [Edge], is_left: &[bool]) -> Option<(usize, &'a Edge)> {
    let left = || edges.iter().filter(|e| e.photos.iter().all(|&photo| is_left[photo]));
    let groups = Groups::new(is_left.len(), left().map(|e| e.photos));
    let score = |e: &Edge| {
        let angle = e.estimate.median_angle();
        let certain = 1.0 - e.estimate.rival.min(1.0);
        e.estimate.inliers.len() as f64 * (angle / START_ANGLE).min(1.0).powi(2) * certain.sqrt()
    };
    let sized = left().map(|e| ((groups.size(e.photos[0]), score(e)), e));
    // The first one of equal pairs.
    let best = sized.filter(|s| s.0.1 > 0.0).reduce(|a, b| if b.0 > a.0 { b } else { a });
    best.map(|((size, _), e)| (size, e))
}

impl<'a> Builder<'a> {
    /// The matches of `edges` as tracks, without cameras.
    fn new(photos: &'a [PosePhoto], edges: &[Edge], prior: Option<FocalPrior>) -> Self {
        let matches = edges.iter().flat_map(|e| {
            let [a, b] = e.photos;
            e.estimate.inliers.iter().map(move |p| {
                [FeatureId { photo: a, feature: p.a }, FeatureId { photo: b, feature: p.b }]
            })
        });
        let tracks = tracks(matches);
        let count = tracks.len();
        Self {
            photos,
            precise: tracks.iter().map(|t| vec![None; t.len()]).collect(),
            tracks,
            cameras: vec![None; photos.len()],
            positions: vec![None; count],
            agreeing: vec![Vec::new(); count],
            log_focal: 0.0,
            prior,
            limit: LIMIT,
        }
    }

    /// Median distance of the points' projections from their features, working px; `None` without
    /// points.
    fn median_residual(&self) -> Option<f64> {
        let mut all: Vec<f64> = Vec::new();
        for (track, position) in self.positions.iter().enumerate() {
            let Some(position) = position else { continue };
            for (at, f) in self.tracks[track].iter().enumerate() {
                let Some(camera) = self.cameras[f.photo] else { continue };
                let p = in_view(self.view(f), camera.to_camera(*position));
                let (bearing, _) = self.sight(track, at);
                let distance = (p.truncate() / p.z).distance(bearing);
                all.push(distance * self.photos[f.photo].focal());
            }
        }
        let middle = all.len() / 2;
        (!all.is_empty()).then(|| *all.select_nth_unstable_by(middle, f64::total_cmp).1)
    }

    /// Bearing of a track's feature, and its standard deviation, for the lens's own focal length.
    fn sight(&self, track: usize, at: usize) -> (DVec2, f64) {
        let id = self.tracks[track][at];
        let photo = &self.photos[id.photo];
        let [detected, aligned] = photo.deviations_of(id.feature);
        match self.precise[track][at] {
            Some(px) => (photo.bearing(px), aligned),
            None => (photo.bearings[id.feature], detected),
        }
    }

    /// See [`Sight::view`].
    fn view(&self, f: &FeatureId) -> Option<DMat3> {
        self.photos[f.photo].view_of(f.feature)
    }

    /// The tracks' known points as photograph `photo` sees them, with their tracks.
    fn sights(&self, photo: usize) -> Vec<(usize, Sight)> {
        let scale = self.log_focal.exp();
        let mut out = Vec::new();
        for (track, position) in self.positions.iter().enumerate() {
            let Some(point) = *position else { continue };
            if let Some(at) = self.tracks[track].iter().position(|f| f.photo == photo) {
                let (bearing, deviation) = self.sight(track, at);
                let view = self.view(&self.tracks[track][at]);
                let (bearing, deviation) = (bearing / scale, deviation / scale);
                let sight = Sight { point, bearing, deviation, view };
                out.push((track, sight));
            }
        }
        out
    }

    /// The photograph without a pose that sees most points.
    fn most_sights(&self, refused: &[bool]) -> Option<usize> {
        let mut counts = vec![0usize; self.photos.len()];
        for (track, position) in self.tracks.iter().zip(&self.positions) {
            if position.is_some() {
                track.iter().for_each(|f| counts[f.photo] += 1);
            }
        }
        (0..self.photos.len())
            .filter(|&i| self.cameras[i].is_none() && !refused[i] && counts[i] >= MIN_SIGHTS)
            .max_by_key(|&i| (counts[i], std::cmp::Reverse(i)))
    }

    fn register(&self, photo: usize, seed: u64) -> Option<Absolute> {
        let sights: Vec<Sight> = self.sights(photo).into_iter().map(|s| s.1).collect();
        let (pose, inside) = locate(&sights, 2.0 * LIMIT, seed)?;
        let enough = inside.len() >= MIN_SIGHTS
            && inside.len() as f64 >= MIN_SIGHT_SHARE * sights.len() as f64;
        enough.then_some(pose)
    }

    /// Gives every track that two or more cameras see a position, where its rays agree.
    fn triangulate(&mut self) {
        let this = &*self;
        let found: Vec<(Option<DVec3>, Vec<FeatureId>)> =
            (0..this.tracks.len()).into_par_iter().map(|track| this.triangulated(track)).collect();
        (self.positions, self.agreeing) = found.into_iter().unzip();
    }

    fn triangulated(&self, track: usize) -> (Option<DVec3>, Vec<FeatureId>) {
        let scale = self.log_focal.exp();
        let mut rays = Vec::new();
        for (at, f) in self.tracks[track].iter().enumerate() {
            if let Some(camera) = self.cameras[f.photo] {
                let (bearing, deviation) = self.sight(track, at);
                let (bearing, deviation) = (bearing / scale, deviation / scale);
                rays.push(Ray { feature: *f, camera, bearing, deviation, view: self.view(f) });
            }
        }
        // Of the points of all pairs of rays the one with which most rays agree.
        let mut best: (usize, Option<DVec3>) = (1, None);
        for i in 0..rays.len() {
            for j in i + 1..rays.len() {
                let (u, v) = (rays[i].direction(), rays[j].direction());
                if u.angle_between(v) < MIN_ANGLE {
                    continue;
                }
                let p = midpoint([rays[i].camera.position(), rays[j].camera.position()], [u, v]);
                let count = rays.iter().filter(|ray| ray.residual(p) < self.limit).count();
                if count > best.0 {
                    best = (count, Some(p));
                }
            }
            if best.0 == rays.len() {
                break;
            }
        }
        let Some(mut p) = best.1 else { return (None, Vec::new()) };
        // A point that was adjusted before keeps its place where as many rays agree with it.
        if let Some(old) = self.positions[track] {
            let count = rays.iter().filter(|ray| ray.residual(old) < self.limit).count();
            if count >= best.0 {
                p = old;
            }
        }
        let agreeing =
            rays.iter().filter(|ray| ray.residual(p) < self.limit).map(|ray| ray.feature).collect();
        (Some(p), agreeing)
    }

    /// Adjusts all cameras, points and the focal length.
    fn adjust(&mut self, steps: usize) {
        let (mut bundle, photos, points) = self.bundle();
        if bundle.cameras.len() < 2 || bundle.points.len() < MIN_SIGHTS {
            return;
        }
        bundle.adjust(steps);
        self.log_focal = bundle.log_focal;
        photos.iter().zip(&bundle.cameras).for_each(|(&i, c)| self.cameras[i] = Some(*c));
        points.iter().zip(&bundle.points).for_each(|(&i, p)| self.positions[i] = Some(*p));
    }

    /// The bundle of all cameras and points, with their photographs and tracks.
    fn bundle(&self) -> (Bundle, Vec<usize>, Vec<usize>) {
        let photos: Vec<usize> =
            (0..self.photos.len()).filter(|&i| self.cameras[i].is_some()).collect();
        let index = |photo: usize| photos.binary_search(&photo).ok();
        let (mut points, mut kept, mut observations) = (Vec::new(), Vec::new(), Vec::new());
        for (track, position) in self.positions.iter().enumerate() {
            let Some(position) = position else { continue };
            for (at, f) in self.tracks[track].iter().enumerate() {
                let Some(camera) = index(f.photo) else { continue };
                if self.agreeing[track].contains(f) {
                    let (bearing, deviation) = self.sight(track, at);
                    let point = points.len();
                    let view = self.view(f);
                    observations.push(Observation { camera, point, bearing, deviation, view });
                }
            }
            points.push(*position);
            kept.push(track);
        }
        let cameras = photos.iter().filter_map(|&i| self.cameras[i]).collect();
        let bundle = Bundle::new(cameras, points, observations, self.log_focal, self.prior);
        (bundle, photos, kept)
    }

    /// The lens, from one more adjustment of all cameras and points with a free bend; `None` for photographs without
    /// a bend.
    fn bend(&self) -> Option<Bend> {
        let prior = self.prior?;
        let first = self.photos.first().filter(|photo| photo.bend != 0.0)?;
        let mut bundle = self.bundle().0;
        for o in &mut bundle.observations {
            o.bearing = bend::bent(o.bearing, first.bend)?;
            o.deviation /= bend::stretch(o.bearing, first.bend);
        }
        let deviation = prior.deviation.max(bend::FOCAL_DEVIATION);
        bundle.prior = Some(FocalPrior { deviation, ..prior });
        (bundle.bend, bundle.bend_prior) = (first.bend, Some(bend::DEVIATION));
        bundle.adjust(25);
        let deviation = bundle.deviations()?.bend;
        Some(Bend { k: bundle.bend, deviation, focal_scale: bundle.log_focal.exp() })
    }

    /// Moves the features of each point to where their surroundings agree with those of the feature
    /// that shows it largest.
    fn align(&mut self) {
        let (photos, tracks) = (self.photos, &self.tracks);
        let agreeing = &self.agreeing;
        self.precise.par_iter_mut().zip(tracks.par_iter().zip(agreeing)).for_each(
            |(places, (track, agreeing))| {
                let size = |f: &FeatureId| photos[f.photo].features.points[f.feature].size;
                let reference = agreeing
                    .iter()
                    .max_by(|a, b| size(a).total_cmp(&size(b)).then(b.cmp(a)))
                    .copied();
                let Some(reference) = reference else { return };
                for (place, f) in places.iter_mut().zip(track) {
                    let own = || photos[f.photo].position(f.feature);
                    *place = if *f == reference {
                        Some(own())
                    } else {
                        let from = (&photos[reference.photo], reference.feature);
                        aligned_position(from, (&photos[f.photo], f.feature))
                    };
                }
            },
        );
    }

    fn finish(self) -> Model {
        let bend = self.bend();
        let (bundle, photos, _) = self.bundle();
        let deviations = bundle.deviations();
        let eyes: Vec<DVec3> = bundle.cameras.iter().map(Absolute::position).collect();
        let extent = eyes.iter().fold(0.0f64, |m, e| m.max(e.distance(eyes[0])));
        let most = |v: &[f64]| v.iter().fold(0.0f64, |m, x| m.max(*x));
        let (rotation, position, focal) = deviations
            .map_or((f64::INFINITY, f64::INFINITY, 1.0), |d| {
                (most(&d.rotations), most(&d.translations) / extent.max(1e-12), d.focal)
            });
        let mut cameras = vec![None; self.photos.len()];
        photos.iter().zip(&bundle.cameras).for_each(|(&i, c)| cameras[i] = Some(*c));
        let points = self
            .positions
            .into_iter()
            .zip(self.agreeing)
            .filter_map(|(position, features)| Some(Point { position: position?, features }))
            .filter(|p| p.features.len() > 1)
            .collect();
        Model {
            cameras,
            points,
            focal_scale: self.log_focal.exp(),
            focal_deviation: focal,
            rotation_deviation: rotation,
            position_deviation: position,
            bend,
            bundle: Some((bundle, photos)),
        }
    }
}

/// A feature of a track, seen from its camera.
struct Ray {
    feature: FeatureId,
    camera: Absolute,
    bearing: DVec2,
    deviation: f64,
    /// See [`Sight::view`].
    view: Option<DMat3>,
}

impl Ray {
    /// Direction in the world, of unit length.
    fn direction(&self) -> DVec3 {
        let ray = self.bearing.extend(1.0);
        let ray = self.view.map_or(ray, |view| view.transpose() * ray);
        (self.camera.rotation.transpose() * ray).normalize()
    }

    /// Distance of the feature from the projection of a point, standard deviations.
    fn residual(&self, point: DVec3) -> f64 {
        let p = in_view(self.view, self.camera.to_camera(point));
        let distance = || (p.truncate() / p.z).distance(self.bearing) / self.deviation;
        if p.z > 1e-9 { distance() } else { f64::INFINITY }
    }
}

/// The point closest to two rays.
pub(super) fn midpoint(origins: [DVec3; 2], directions: [DVec3; 2]) -> DVec3 {
    let [u, v] = directions;
    let between = origins[1] - origins[0];
    let c = u.dot(v);
    let n = (1.0 - c * c).max(1e-15);
    let s = (between.dot(u) - c * between.dot(v)) / n;
    let t = (c * between.dot(u) - between.dot(v)) / n;
    0.5 * (origins[0] + s * u + origins[1] + t * v)
}

#[cfg(test)]
mod tests;
