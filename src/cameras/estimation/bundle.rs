//! Bundle adjustment: all cameras, all points and a shared lens (focal length, bend) together.
//!
//! Levenberg-Marquardt steps on the robust sum of squared distances between the points' pictures
//! and their projections. The points are eliminated (Schur complement), so that a step solves one
//! dense system of 6 unknowns a camera, 7 where each has a focal length of its own, and two for the lens. The first
//! camera is kept.
//!
//! Source: B. Triggs et al., "Bundle adjustment - a modern synthesis", 2000.

use super::absolute::{Absolute, in_view, matrix as converted, projection_slope, slope_in_camera};
use super::bend;
use super::refine::FocalPrior;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// A point's picture in a camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Observation {
    /// Index into [`Bundle::cameras`].
    pub camera: usize,
    /// Index into [`Bundle::points`].
    pub point: usize,
    /// The picture on the plane z = 1 of the lens's own focal length, as the lens bends it.
    pub bearing: DVec2,
    /// Standard deviation of the bearing, units of the plane.
    pub deviation: f64,
    /// See [`Sight::view`](super::absolute::Sight::view).
    pub view: Option<DMat3>,
}

/// Cameras, points and observations.
#[derive(Clone, Debug)]
pub(super) struct Bundle {
    /// Cameras; the first one is kept.
    pub cameras: Vec<Absolute>,
    /// Positions of the points.
    pub points: Vec<DVec3>,
    /// Observations, sorted by point.
    pub observations: Vec<Observation>,
    /// Logarithm of the focal length over that of the lenses.
    pub log_focal: f64,
    /// Knowledge of the focal length; `None` keeps it.
    pub prior: Option<FocalPrior>,
    /// Bend k of the lens ([`bend`]).
    pub bend: f64,
    /// Standard deviation of what is known of [`Bundle::bend`], whose mean is 0; `None` keeps it.
    pub bend_prior: Option<f64>,
    /// Logarithm of each camera's focal length over that of the first.
    pub zooms: Vec<f64>,
    /// Standard deviation of what is known of [`Bundle::zooms`], whose means are 0; `None` keeps them.
    pub zoom_prior: Option<f64>,
}

/// Residual at which Cauchy's loss begins to grow slowly, standard deviations.
const LOSS_SCALE: f64 = 2.0;
/// Unknowns of a camera's pose.
const POSE: usize = 6;
/// The same with its focal length.
const ZOOMED: usize = POSE + 1;
/// Unknowns of the lens: logarithm of the focal length, bend.
const LENS: usize = 2;

type PointSlope = SMatrix<f64, 2, 3>;

impl Observation {
    /// Residual, standard deviations; `None` behind the camera, and where the lens has no picture.
    fn residual(
        &self,
        camera: &Absolute,
        point: DVec3,
        log_focal: f64,
        bend: f64,
    ) -> Option<DVec2> {
        let p = in_view(self.view, camera.to_camera(point));
        let straight = p.truncate() / p.z * log_focal.exp();
        let projected = if bend == 0.0 { straight } else { bend::bent(straight, bend)? };
        (p.z > 1e-9).then(|| (projected - self.bearing) / self.deviation)
    }
}

/// Normal equations of the cameras, `N` unknowns each, and the lens after the elimination of the points.
struct Reduced<const N: usize> {
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Inverse of each point's own block, and its gradient.
    points: Vec<(SMatrix<f64, 3, 3>, SVector<f64, 3>)>,
    /// For each observation the product of the slopes of camera and point.
    mixed: Vec<SMatrix<f64, N, 3>>,
    /// For each point the product of the slopes of point and lens.
    lens: Vec<SMatrix<f64, 3, 2>>,
}

impl Bundle {
    /// Cameras of one focal length and a lens that does not bend.
    pub(super) fn new(
        cameras: Vec<Absolute>,
        points: Vec<DVec3>,
        observations: Vec<Observation>,
        log_focal: f64,
        prior: Option<FocalPrior>,
    ) -> Self {
        let zooms = vec![0.0; cameras.len()];
        let (bend, bend_prior, zoom_prior) = (0.0, None, None);
        Self {
            cameras,
            points,
            observations,
            log_focal,
            prior,
            bend,
            bend_prior,
            zooms,
            zoom_prior,
        }
    }

    /// Number of unknowns with `N` of each camera.
    fn unknowns<const N: usize>(&self) -> usize {
        N * (self.cameras.len() - 1) + LENS
    }

    fn residual(&self, o: &Observation) -> Option<DVec2> {
        let log_focal = self.log_focal + self.zooms[o.camera];
        o.residual(&self.cameras[o.camera], self.points[o.point], log_focal, self.bend)
    }

    /// Sum of Cauchy's losses, and of the prior.
    fn cost(&self) -> f64 {
        let c2 = LOSS_SCALE * LOSS_SCALE;
        let one = |o: &Observation| {
            // A point behind the camera costs as much as a large residual.
            let squared = self.residual(o).map_or(1e8, |r| r.length_squared());
            0.5 * c2 * (squared / c2).ln_1p()
        };
        let data: f64 = self.observations.iter().map(one).sum();
        let focal = self.prior.map_or(0.0, |p| 0.5 * p.distance(self.log_focal).powi(2));
        let bend = self.bend_prior.map_or(0.0, |d| 0.5 * (self.bend / d).powi(2));
        let zoom = |d: f64| self.zooms.iter().map(|zoom| 0.5 * (zoom / d).powi(2)).sum::<f64>();
        data + focal + bend + self.zoom_prior.map_or(0.0, zoom)
    }

    /// Improves all unknowns in at most `steps` steps.
    pub(super) fn adjust(&mut self, steps: usize) {
        match self.zoom_prior {
            None => self.adjust_all::<POSE>(steps),
            Some(_) => self.adjust_all::<ZOOMED>(steps),
        }
    }

    fn adjust_all<const N: usize>(&mut self, steps: usize) {
        let mut damping = 1e-4;
        let mut cost = self.cost();
        for _ in 0..steps {
            let reduced = self.reduce::<N>(damping);
            let next = reduced.solve().map(|step| self.moved(&reduced, &step));
            let next_cost = next.as_ref().map_or(f64::INFINITY, Self::cost);
            match next {
                Some(next) if next_cost < cost => {
                    let gain = cost - next_cost;
                    *self = next;
                    cost = next_cost;
                    damping = (damping * 0.2).max(1e-8);
                    if gain < 1e-6 * cost {
                        break;
                    }
                }
                _ => {
                    damping *= 10.0;
                    if damping > 1e6 {
                        break;
                    }
                }
            }
        }
    }

    /// Builds the normal equations; `damping` is added to the diagonal in proportion.
    fn reduce<const N: usize>(&self, damping: f64) -> Reduced<N> {
        let n = self.unknowns::<N>();
        let lens_at = n - LENS;
        // Unknowns that are kept have no slope.
        let free = SVector::<f64, LENS>::new(
            f64::from(u8::from(self.prior.is_some())),
            f64::from(u8::from(self.bend_prior.is_some())),
        );
        let mut matrix = DMatrix::<f64>::zeros(n, n);
        let mut gradient = DVector::<f64>::zeros(n);
        let mut own = vec![SMatrix::<f64, 3, 3>::zeros(); self.points.len()];
        let mut own_gradient = vec![SVector::<f64, 3>::zeros(); self.points.len()];
        let mut lens = vec![SMatrix::<f64, 3, LENS>::zeros(); self.points.len()];
        let mut mixed = vec![SMatrix::<f64, N, 3>::zeros(); self.observations.len()];
        for (o, mixed) in self.observations.iter().zip(&mut mixed) {
            let camera = &self.cameras[o.camera];
            let point = self.points[o.point];
            let Some(r) = self.residual(o) else { continue };
            let weight = 1.0 / (1.0 + r.length_squared() / (LOSS_SCALE * LOSS_SCALE));
            let p = in_view(o.view, camera.to_camera(point));
            let scale = (self.log_focal + self.zooms[o.camera]).exp();
            let straight = p.truncate() / p.z * scale;
            let (bent, by_bend) = bend::bent_slopes(straight, self.bend);
            let bent = SMatrix::<f64, 2, 2>::from_column_slice(&bent.to_cols_array());
            let unit = scale / o.deviation;
            let rotation = converted(o.view.map_or(camera.rotation, |view| view * camera.rotation));
            let by_pose = bent * projection_slope(camera, o.view, point) * unit;
            let by_point: PointSlope = bent * slope_in_camera(p) * rotation * unit;
            let by_focal = bent * SVector::<f64, 2>::new(p.x / p.z, p.y / p.z) * unit;
            let by_camera = SMatrix::<f64, 2, N>::from_fn(|row, column| {
                if column < POSE { by_pose[(row, column)] } else { by_focal[row] }
            });
            let by_bend = SVector::<f64, 2>::new(by_bend.x, by_bend.y) / o.deviation;
            let by_lens =
                SMatrix::<f64, 2, LENS>::from_columns(&[by_focal * free[0], by_bend * free[1]]);
            let r = SVector::<f64, 2>::new(r.x, r.y);
            own[o.point] += by_point.transpose() * by_point * weight;
            own_gradient[o.point] += by_point.transpose() * r * weight;
            lens[o.point] += by_point.transpose() * by_lens * weight;
            let mut block = matrix.fixed_view_mut::<LENS, LENS>(lens_at, lens_at);
            block += by_lens.transpose() * by_lens * weight;
            let mut part = gradient.fixed_rows_mut::<LENS>(lens_at);
            part += by_lens.transpose() * r * weight;
            if let Some(at) = o.camera.checked_sub(1).map(|c| c * N) {
                *mixed = by_camera.transpose() * by_point * weight;
                let mut block = matrix.fixed_view_mut::<N, N>(at, at);
                block += by_camera.transpose() * by_camera * weight;
                let mut part = gradient.fixed_rows_mut::<N>(at);
                part += by_camera.transpose() * r * weight;
                let cross = by_camera.transpose() * by_lens * weight;
                let mut column = matrix.fixed_view_mut::<N, LENS>(at, lens_at);
                column += cross;
                let mut row = matrix.fixed_view_mut::<LENS, N>(lens_at, at);
                row += cross.transpose();
            }
        }
        let (focal_at, bend_at) = (lens_at, lens_at + 1);
        match self.prior {
            None => matrix[(focal_at, focal_at)] = 1.0,
            Some(p) => {
                matrix[(focal_at, focal_at)] += p.deviation.powi(-2);
                gradient[focal_at] += p.distance(self.log_focal) / p.deviation;
            }
        }
        match self.bend_prior {
            None => matrix[(bend_at, bend_at)] = 1.0,
            Some(deviation) => {
                matrix[(bend_at, bend_at)] += deviation.powi(-2);
                gradient[bend_at] += self.bend * deviation.powi(-2);
            }
        }
        if let (ZOOMED, Some(deviation)) = (N, self.zoom_prior) {
            for (i, zoom) in self.zooms.iter().enumerate().skip(1) {
                let at = i * N - 1;
                matrix[(at, at)] += deviation.powi(-2);
                gradient[at] += zoom * deviation.powi(-2);
            }
        }
        (0..n).for_each(|i| matrix[(i, i)] *= 1.0 + damping);
        let points: Vec<_> = own
            .into_iter()
            .zip(own_gradient)
            .map(|(mut m, g)| {
                (0..3).for_each(|i| m[(i, i)] = m[(i, i)] * (1.0 + damping) + 1e-12);
                (m.try_inverse().unwrap_or_else(SMatrix::zeros), g)
            })
            .collect();
        let mut reduced = Reduced { matrix, gradient, points, mixed, lens };
        self.eliminate(&mut reduced);
        reduced
    }

    /// Subtracts what the points take up: S = U − W V⁻¹ Wᵀ.
    fn eliminate<const N: usize>(&self, reduced: &mut Reduced<N>) {
        let lens_at = self.unknowns::<N>() - LENS;
        let Reduced { matrix, gradient, points, mixed, lens } = reduced;
        let all = self.observations.iter().zip(mixed.iter()).collect::<Vec<_>>();
        for run in all.chunk_by(|a, b| a.0.point == b.0.point) {
            let index = run[0].0.point;
            let (inverse, own) = &points[index];
            let lens = lens[index];
            let through = inverse * lens;
            let mut block = matrix.fixed_view_mut::<LENS, LENS>(lens_at, lens_at);
            block -= lens.transpose() * through;
            let mut part = gradient.fixed_rows_mut::<LENS>(lens_at);
            part -= through.transpose() * own;
            for (o, w) in run {
                let Some(at) = o.camera.checked_sub(1).map(|c| c * N) else { continue };
                let left = *w * inverse;
                let mut part = gradient.fixed_rows_mut::<N>(at);
                part -= left * own;
                let cross = *w * through;
                let mut column = matrix.fixed_view_mut::<N, LENS>(at, lens_at);
                column -= cross;
                let mut row = matrix.fixed_view_mut::<LENS, N>(lens_at, at);
                row -= cross.transpose();
                for (other, v) in run {
                    let Some(to) = other.camera.checked_sub(1).map(|c| c * N) else { continue };
                    let mut block = matrix.fixed_view_mut::<N, N>(at, to);
                    block -= left * v.transpose();
                }
            }
        }
    }

    /// The bundle after a step of cameras and lens; the points follow.
    fn moved<const N: usize>(&self, reduced: &Reduced<N>, step: &DVector<f64>) -> Self {
        let mut next = self.clone();
        let lens_at = self.unknowns::<N>() - LENS;
        for (i, camera) in next.cameras.iter_mut().enumerate().skip(1) {
            let at = (i - 1) * N;
            *camera = camera.moved(&step.as_slice()[at..at + POSE]);
            if N > POSE {
                next.zooms[i] += step[at + POSE];
            }
        }
        if self.prior.is_some() {
            next.log_focal += step[lens_at];
        }
        if self.bend_prior.is_some() {
            next.bend += step[lens_at + 1];
        }
        let mut gradients: Vec<SVector<f64, 3>> = reduced.points.iter().map(|p| p.1).collect();
        for (o, w) in self.observations.iter().zip(&reduced.mixed) {
            if let Some(at) = o.camera.checked_sub(1).map(|c| c * N) {
                gradients[o.point] += w.transpose() * step.fixed_rows::<N>(at);
            }
        }
        for (i, point) in next.points.iter_mut().enumerate() {
            let g = gradients[i] + reduced.lens[i] * step.fixed_rows::<LENS>(lens_at);
            let move_by = -(reduced.points[i].0 * g);
            *point += DVec3::new(move_by[0], move_by[1], move_by[2]);
        }
        next
    }

    /// Standard deviations at the solution: of each camera's position in units of the scene (the
    /// scale is that of the given points), of each rotation, radians, of the logarithm of the focal
    /// length, and of the bend. The first camera has none. `None` where the system is singular.
    pub(super) fn deviations(&self) -> Option<Deviations> {
        match self.zoom_prior {
            None => self.deviations_of_all::<POSE>(),
            Some(_) => self.deviations_of_all::<ZOOMED>(),
        }
    }

    fn deviations_of_all<const N: usize>(&self) -> Option<Deviations> {
        let mut reduced = self.reduce::<N>(0.0);
        let n = self.unknowns::<N>();
        // The scale is free: its direction, translations in proportion to themselves, gets weight.
        let mut scale = DVector::<f64>::zeros(n);
        let origin = self.cameras[0].translation;
        for (i, camera) in self.cameras.iter().enumerate().skip(1) {
            let shift = camera.translation
                - camera.rotation * self.cameras[0].rotation.transpose() * origin;
            scale.fixed_rows_mut::<3>((i - 1) * N + 3).copy_from_slice(&shift.to_array());
        }
        let length = scale.norm().max(1e-12);
        scale /= length;
        let weight = reduced.matrix.diagonal().max();
        reduced.matrix.ger(weight, &scale, &scale, 1.0);
        let covariance = reduced.matrix.cholesky()?.inverse();
        let at = |i: usize, from: usize| {
            (0..3).map(|k| covariance[((i - 1) * N + from + k, (i - 1) * N + from + k)]).sum()
        };
        let all = |from: usize| -> Vec<f64> {
            (0..self.cameras.len())
                .map(|i| if i == 0 { 0.0 } else { f64::sqrt(at(i, from)) })
                .collect()
        };
        let of_lens = |at: usize, is_free: bool| {
            if is_free { covariance[(n - LENS + at, n - LENS + at)].sqrt() } else { 0.0 }
        };
        let focal = of_lens(0, self.prior.is_some());
        let bend = of_lens(1, self.bend_prior.is_some());
        let zoom = |i: usize| {
            if i == 0 || N == POSE { 0.0 } else { covariance[(i * N - 1, i * N - 1)].sqrt() }
        };
        let zooms = (0..self.cameras.len()).map(zoom).collect();
        Some(Deviations { rotations: all(0), translations: all(3), focal, bend, zooms })
    }
}

/// See [`Bundle::deviations`].
#[derive(Clone, Debug)]
pub(super) struct Deviations {
    /// Of the rotations, radians.
    pub rotations: Vec<f64>,
    /// Of the translations, units of the scene.
    pub translations: Vec<f64>,
    /// Of the logarithm of the focal length; 0 where it is kept.
    pub focal: f64,
    /// Of the bend; 0 where it is kept.
    pub bend: f64,
    /// Of each camera's focal length over that of the first, logarithms; 0 where they are kept.
    pub zooms: Vec<f64>,
}

impl<const N: usize> Reduced<N> {
    fn solve(&self) -> Option<DVector<f64>> {
        let factor = self.matrix.clone().cholesky()?;
        let step = -factor.solve(&self.gradient);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }
}

#[cfg(test)]
mod tests {
    use super::super::two_view::rotation;
    use super::*;
    use crate::cameras::matches::random::SplitMix;

    /// Five cameras on an arc, 120 points; pictures for lenses with 1 / `focal` of the true focal
    /// length and normal noise of one standard deviation.
    fn scene(focal: f64, noise: f64) -> Bundle {
        let mut random = SplitMix(3);
        let cameras: Vec<Absolute> = (0..5)
            .map(|i| {
                let angle = 0.15 * f64::from(i);
                let r = rotation(DVec3::new(0.02 * f64::from(i), angle, 0.0));
                let centre = DVec3::new(0.0, 0.0, 4.0);
                let eye = centre
                    + rotation(DVec3::Y * -angle) * DVec3::new(0.0, 0.1 * f64::from(i), -4.0);
                Absolute { rotation: r, translation: -(r * eye) }
            })
            .collect();
        let points: Vec<DVec3> = (0..120)
            .map(|_| {
                DVec3::from_array(std::array::from_fn(|_| 2.0 * random.uniform() - 1.0))
                    + DVec3::Z * 4.0
            })
            .collect();
        let deviation = 1e-3;
        let mut observations = Vec::new();
        for (point, p) in points.iter().enumerate() {
            for (camera, c) in cameras.iter().enumerate() {
                let q = c.to_camera(*p);
                let jitter = DVec2::new(random.normal(), random.normal()) * noise * deviation;
                let bearing = q.truncate() / q.z * focal + jitter;
                let view = None;
                observations.push(Observation { camera, point, bearing, deviation, view });
            }
        }
        Bundle::new(cameras, points, observations, 0.0, None)
    }

    /// The same pictures through a lens that bends.
    fn bent(mut bundle: Bundle, k: f64) -> Bundle {
        for o in &mut bundle.observations {
            o.bearing = bend::bent(o.bearing, k).unwrap();
        }
        bundle
    }

    fn disturb(bundle: &mut Bundle) {
        let mut random = SplitMix(8);
        for c in bundle.cameras.iter_mut().skip(1) {
            let step: [f64; 6] = std::array::from_fn(|_| 0.02 * random.normal());
            *c = c.moved(&step);
        }
        for p in &mut bundle.points {
            *p += DVec3::from_array(std::array::from_fn(|_| 0.05 * random.normal()));
        }
    }

    /// Largest angle between the directions of positions, seen from the first camera.
    fn off(a: &Bundle, b: &Bundle) -> f64 {
        let pairs = a.cameras.iter().zip(&b.cameras).skip(1);
        pairs.map(|(a, b)| a.position().angle_between(b.position())).fold(0.0, f64::max)
    }

    #[test]
    fn disturbed_cameras_and_points_return() {
        let truth = scene(1.0, 0.0);
        let mut bundle = truth.clone();
        disturb(&mut bundle);
        assert!(off(&bundle, &truth) > 5e-3);
        bundle.adjust(60);
        assert!(off(&bundle, &truth) < 1e-4, "{}", off(&bundle, &truth));
    }

    #[test]
    fn a_wrong_focal_length_and_wrong_pictures_are_survived() {
        let truth = scene(1.15, 0.5);
        let mut bundle = truth.clone();
        for o in bundle.observations.iter_mut().step_by(23) {
            o.bearing.x += 0.1;
        }
        bundle.prior = Some(FocalPrior { mean: 0.0, deviation: 0.5 });
        disturb(&mut bundle);
        bundle.adjust(100);
        assert!((bundle.log_focal.exp() / 1.15 - 1.0).abs() < 0.02, "{}", bundle.log_focal.exp());
        assert!(off(&bundle, &truth) < 0.01, "{}", off(&bundle, &truth));
        let deviations = bundle.deviations().unwrap();
        assert!(deviations.focal > 1e-4 && deviations.focal < 0.05, "{deviations:?}");
        assert!(deviations.rotations[1] > 1e-5 && deviations.rotations[1] < 0.01);
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let mut bundle = scene(1.1, 0.5);
        bundle.prior = Some(FocalPrior { mean: 0.1, deviation: 0.3 });
        (bundle.bend, bundle.bend_prior) = (-0.07, Some(0.2));
        (bundle.zooms, bundle.zoom_prior) = (vec![0.0, 0.1, -0.2, 0.05, 0.0], Some(0.3));
        disturb(&mut bundle);
        bundle.observations.truncate(200);
        let n = bundle.unknowns::<ZOOMED>();
        // Points that do not move: the cameras' gradient before the elimination is that of the cost.
        let kept = bundle.clone();
        let mut plain = bundle.reduce::<ZOOMED>(0.0);
        for (o, w) in kept.observations.iter().zip(plain.mixed.clone()) {
            if let Some(at) = o.camera.checked_sub(1).map(|c| c * ZOOMED) {
                let (inverse, own) = &plain.points[o.point];
                let mut part = plain.gradient.fixed_rows_mut::<ZOOMED>(at);
                part += w * inverse * own;
            }
        }
        for (i, (inverse, own)) in plain.points.iter().enumerate() {
            let mut part = plain.gradient.fixed_rows_mut::<LENS>(n - LENS);
            part += plain.lens[i].transpose() * (inverse * own);
        }
        for i in 0..n {
            let at = |h: f64| {
                let mut moved = kept.clone();
                if i == n - LENS {
                    moved.log_focal += h;
                } else if i == n - 1 {
                    moved.bend += h;
                } else if i % ZOOMED == POSE {
                    moved.zooms[1 + i / ZOOMED] += h;
                } else {
                    let mut step = [0.0; POSE];
                    step[i % ZOOMED] = h;
                    moved.cameras[1 + i / ZOOMED] = moved.cameras[1 + i / ZOOMED].moved(&step);
                }
                moved.cost()
            };
            let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
            let got = plain.gradient[i];
            assert!((numeric - got).abs() < 1e-3 * (1.0 + got.abs()), "{i}: {numeric} {got}");
        }
    }

    #[test]
    fn the_bend_of_a_lens_is_found_with_its_focal_length() {
        for k in [-0.12, 0.04] {
            let truth = bent(scene(1.1, 0.3), k);
            let mut bundle = truth.clone();
            bundle.prior = Some(FocalPrior { mean: 0.0, deviation: 0.3 });
            disturb(&mut bundle);
            let mut pinhole = bundle.clone();
            pinhole.adjust(100);
            bundle.bend_prior = Some(0.2);
            bundle.adjust(100);
            let deviations = bundle.deviations().unwrap();
            assert!((bundle.bend - k).abs() < 4.0 * deviations.bend + 1e-3, "{}", bundle.bend);
            assert!(deviations.bend > 1e-5 && deviations.bend < 0.02, "{deviations:?}");
            let errors = [&bundle, &pinhole].map(|b| off(b, &truth));
            assert!(errors[0] < 0.01 && errors[0] < 0.9 * errors[1], "{k}: {errors:?}");
        }
    }

    #[test]
    fn focal_lengths_of_single_cameras_are_found() {
        let mut truth = scene(1.0, 0.3);
        let zooms = [0.0, 0.3, 0.0, -0.2, 0.05f64];
        for o in &mut truth.observations {
            o.bearing *= zooms[o.camera].exp();
        }
        let mut bundle = truth.clone();
        bundle.prior = Some(FocalPrior { mean: 0.0, deviation: 0.3 });
        disturb(&mut bundle);
        let mut shared = bundle.clone();
        shared.adjust(100);
        bundle.zoom_prior = Some(0.3);
        bundle.adjust(100);
        let deviations = bundle.deviations().unwrap().zooms;
        for (i, zoom) in zooms.iter().enumerate() {
            let error = (bundle.zooms[i] - zoom).abs();
            assert!(error < 4.0 * deviations[i] + 2e-3, "{i}: {error} {deviations:?}");
            assert!(i == 0 || (1e-5..0.02).contains(&deviations[i]), "{deviations:?}");
        }
        let errors = [&bundle, &shared].map(|b| off(b, &truth));
        assert!(errors[0] < 0.01 && errors[0] < 0.5 * errors[1], "{errors:?}");
    }
}
