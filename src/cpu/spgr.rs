//! Sub-pixel Gaussian reparameterization, one pass per parent and no temporary in
//! memory (SubSplat 3.2, supp. A.3; spec 2.9b).
//!
//! In: head records `[N, K, 11]` and parents `[N, 11]` (lanes in [`crate::abi`]),
//! cameras of the V context views.   Out: children `[N·K, 11]`, child k of parent n
//! at row n·K + k, and their colour gain `[N·K]` or, in RGB, `[N·K, 4]` (γ, δ).
//!
//! Child k = (i, j) of the r × r sub-pixel grid, row-major, in the parent's primary
//! view v* with camera coordinates x_c of its mean and z its depth:
//! ```text
//! Δ   = ((j+½)/r − ½, (i+½)/r − ½) + bounded (û, v̂)/r            input px
//! p   = x_c + lateral(Δ) + Δẑ·direction,   Δẑ = β_z·tanh(Δz)·unit
//! s_k = λ_s·s⊙exp(c·tanh(Δlog s/c)),   q_k = q_p ⊗ e(Δr)
//! M   = J(p)·R_w2c·R(q_k)·diag(s_k)                                target px
//! A_k = |m₁ × m₂| = √det(J Σ Jᵀ), raised to A_min
//! ```
//! and opacities by [`super::redistribute`]. Twin: ops/spgr.rs. The same in tensor
//! operations, with gradients: model/spgr_ref.rs. Tests: tests/spgr.rs.

use super::real::Real;
use super::redistribute::{self, Rule};
use crate::abi::{
    AREA_SQ_EPS, DEPTH_FRACTION_MIN, FRUSTUM_MARGIN, GROWTH_MAX, HEAD_DEPTH, HEAD_GAIN, HEAD_LANES,
    HEAD_LOG_SCALE, HEAD_LOGIT, HEAD_OFFSET, HEAD_ROTATION, LANE_MEAN, LANE_OPACITY, LANE_QUAT,
    LANE_SCALE, SPLAT_LANES, VISIBLE_Z_MIN,
};
use crate::camera::Camera;
use rayon::prelude::*;

/// Most children per parent: they live on the stack.
pub const CHILDREN_MAX: usize = 64;

/// The rules in numbers; what each means is said at `config::Spgr`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// r: K = r² children, and the target picture is r times the input.
    pub side: usize,
    /// v* is the nearest view that sees the parent; else the source view.
    pub nearest_visible: bool,
    /// ρ, sub-pixels.
    pub offset_bound: Option<f64>,
    /// β_z.
    pub beta_z: f64,
    /// Depth residuals run along the viewing ray; else along the optical axis.
    pub ray: bool,
    /// β_z in units of the parent's depth; else world units.
    pub relative_depth: bool,
    /// Children slide along the parent's disc; else at constant camera z.
    pub disc: bool,
    /// λ_s.
    pub lambda_s: f64,
    /// c of the soft bound of Δlog s.
    pub dlog_clamp: f64,
    /// Footprints take the parent's Jacobian; else the child's.
    pub area_at_parent: bool,
    /// A_min, target px²; 0 is no clamp.
    pub a_min: f64,
    /// The clamp grows the two axes that make the footprint; else all three.
    pub two_axis: bool,
    /// Opacity rule.
    pub opacity: Rule,
    /// Low-pass of the target picture, target px².
    pub lowpass_target: f64,
    /// Low-pass of a native render of the parents, input px².
    pub lowpass_input: f64,
    /// δ of γ = 1 + δ·tanh γ̃.
    pub delta: f64,
    /// The gain multiplies ½ + Σ, not Σ alone: four lanes per child.
    pub rgb_gain: bool,
}

impl Rules {
    /// K.
    pub fn children(&self) -> usize {
        self.side * self.side
    }

    /// Floats of gain per child.
    pub fn gain_lanes(&self) -> usize {
        if self.rgb_gain { 4 } else { 1 }
    }
}

/// Which parents, seen by which cameras.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Context views, pixels of the input pictures.
    pub cameras: &'a [Camera],
    /// Near plane of each view, world units.
    pub near: &'a [f32],
    /// Parents per view.
    pub per_view: usize,
    /// Index of parent 0 of this call: parent n came from view (first + n) / per_view.
    pub first: usize,
}

type V3<T> = [T; 3];
type M3<T> = [[T; 3]; 3];

/// One context camera in numbers of the kernel.
struct View<T> {
    /// Rows of R, world from camera.
    rotation: M3<T>,
    position: V3<T>,
    focal: [T; 2],
    centre: [T; 2],
    size: [T; 2],
    /// Least camera z that is divided by.
    z_min: T,
    /// Bounds of x/z and y/z in the Jacobian.
    low: [T; 2],
    high: [T; 2],
}

impl<T: Real> View<T> {
    fn new(camera: &Camera, near: f32) -> Self {
        let k = camera.intrinsics;
        let focal = [f64::from(k.fx), f64::from(k.fy)];
        let centre = [f64::from(k.cx), f64::from(k.cy)];
        let size = [k.width as f64, k.height as f64];
        let margin = |i: usize| FRUSTUM_MARGIN * 0.5 * size[i] / focal[i];
        let r = camera.rotation();
        let row = |i: usize| r.row(i).to_array().map(|v| T::of(f64::from(v)));
        let both = |f: &dyn Fn(usize) -> f64| [T::of(f(0)), T::of(f(1))];
        Self {
            rotation: [row(0), row(1), row(2)],
            position: camera.position().to_array().map(|v| T::of(f64::from(v))),
            focal: both(&|i| focal[i]),
            centre: both(&|i| centre[i]),
            size: both(&|i| size[i]),
            z_min: T::of((0.01 * f64::from(near)).max(1e-3)),
            low: both(&|i| -centre[i] / focal[i] - margin(i)),
            high: both(&|i| (size[i] - centre[i]) / focal[i] + margin(i)),
        }
    }

    fn to_camera(&self, p: V3<T>) -> V3<T> {
        let d: V3<T> = std::array::from_fn(|i| p[i] - self.position[i]);
        std::array::from_fn(|j| (0..3).map(|i| self.rotation[i][j] * d[i]).sum())
    }

    fn to_world(&self, v: V3<T>) -> V3<T> {
        std::array::from_fn(|i| (0..3).map(|j| self.rotation[i][j] * v[j]).sum())
    }

    /// In front of the camera and inside the picture.
    fn sees(&self, p: V3<T>) -> bool {
        p[2] > T::of(VISIBLE_Z_MIN)
            && (0..2).all(|i| {
                let u = self.focal[i] * p[i] / p[2] + self.centre[i];
                u > T::default() && u < self.size[i]
            })
    }

    /// Rows of ∂(u, v)/∂(x, y, z), px per world unit times `zoom`, with the guards
    /// of the rasterizer.
    fn jacobian(&self, p: V3<T>, zoom: T) -> [V3<T>; 2] {
        let z = p[2].max(self.z_min);
        let slope = |i: usize| (p[i] / z).max(self.low[i]).min(self.high[i]);
        let f = [zoom * self.focal[0] / z, zoom * self.focal[1] / z];
        let zero = T::default();
        [[f[0], zero, -f[0] * slope(0)], [zero, f[1], -f[1] * slope(1)]]
    }

    /// R_w2c · R(q) · diag(s).
    fn ellipsoid(&self, quat: [T; 4], scale: V3<T>) -> M3<T> {
        let r = matrix(quat);
        std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let turned: T = (0..3).map(|m| self.rotation[m][i] * r[m][j]).sum();
                turned * scale[j]
            })
        })
    }
}

/// Rotation matrix (rows) of a unit quaternion wxyz.
fn matrix<T: Real>([w, x, y, z]: [T; 4]) -> M3<T> {
    let (one, two) = (T::of(1.0), T::of(2.0));
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// Hamilton product, wxyz.
fn multiply<T: Real>(a: [T; 4], b: [T; 4]) -> [T; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// Unit quaternion; zero stays zero.
fn normalise<T: Real>(q: [T; 4]) -> [T; 4] {
    let squared: T = q.iter().map(|&v| v * v).sum();
    let inverse = T::of(1.0) / squared.max(T::of(AREA_SQ_EPS)).sqrt();
    q.map(|v| v * inverse)
}

/// Quaternion of a rotation vector; a series below 1e-3 radians, where the
/// quotient sin(θ/2)/θ would lose its digits.
fn exponential<T: Real>(r: V3<T>) -> [T; 4] {
    let theta = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt();
    let half = T::of(0.5);
    let s = if theta < T::of(1e-3) {
        half * (T::of(1.0) - theta * theta / T::of(24.0))
    } else {
        (half * theta).sin() / theta
    };
    [(half * theta).cos(), s * r[0], s * r[1], s * r[2]]
}

/// A 2×3 matrix M = J·R·S, whose M·Mᵀ is the projected covariance.
#[derive(Clone, Copy)]
struct Footprint<T>([V3<T>; 2]);

impl<T: Real> Footprint<T> {
    fn new(j: [V3<T>; 2], e: &M3<T>) -> Self {
        let row = |r: V3<T>| std::array::from_fn(|c| (0..3).map(|i| r[i] * e[i][c]).sum());
        Self([row(j[0]), row(j[1])])
    }

    /// σ₁σ₂ = √det(M Mᵀ) as the length of a cross product (Cauchy-Binet): never
    /// negative, exact for discs seen edge-on.
    fn area(&self) -> T {
        let [a, b] = self.0;
        let n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        (n[0] * n[0] + n[1] * n[1] + n[2] * n[2] + T::of(AREA_SQ_EPS)).sqrt()
    }

    /// √det(M Mᵀ + low-pass·I), given the area without.
    fn blurred(&self, area: T, lowpass: T) -> T {
        let trace: T = self.0.iter().flatten().map(|&v| v * v).sum();
        (area * area + lowpass * trace + lowpass * lowpass).sqrt()
    }

    fn column_cross(&self, i: usize, j: usize) -> T {
        self.0[0][i] * self.0[1][j] - self.0[1][i] * self.0[0][j]
    }

    /// Factors of the three σ that raise the area to `a_min` where it is below.
    fn growth(&self, area: T, a_min: T, two_axis: bool) -> V3<T> {
        let (one, most) = (T::of(1.0), T::of(GROWTH_MAX));
        let small = area < a_min;
        if !small {
            return [one; 3];
        }
        if !two_axis {
            return [(a_min / area).sqrt().min(most); 3];
        }
        let length = |i: usize| self.0[0][i] * self.0[0][i] + self.0[1][i] * self.0[1][i];
        let mut still = 0;
        for i in 1..3 {
            if length(i) < length(still) {
                still = i;
            }
        }
        // c⁴·p + c²·q = A_min², the root without cancellation.
        let (a, b) = ((still + 1) % 3, (still + 2) % 3);
        let square = |v: T| v * v;
        let p = square(self.column_cross(a, b));
        let q = square(self.column_cross(a, still)) + square(self.column_cross(b, still));
        let target = a_min * a_min;
        let c2 = T::of(2.0) * target / (q + (q * q + T::of(4.0) * p * target).sqrt());
        let mut factors = [c2.sqrt().min(most); 3];
        factors[still] = one;
        factors
    }

    fn grown(mut self, factors: V3<T>) -> Self {
        for row in &mut self.0 {
            for (v, f) in row.iter_mut().zip(factors) {
                *v *= f;
            }
        }
        self
    }
}

/// One parent in its primary view.
struct Parent<'a, T> {
    view: &'a View<T>,
    mean: V3<T>,
    quat: [T; 4],
    scale: V3<T>,
    alpha: T,
    in_camera: V3<T>,
    /// Depth of the pitch, at least the view's least.
    z: T,
    /// Camera-frame step per input px along the disc, (x, y, z) for u and v.
    disc: Option<[V3<T>; 2]>,
}

impl<'a, T: Real> Parent<'a, T> {
    fn new(rules: &Rules, views: &'a [View<T>], source: usize, row: &[T]) -> Self {
        let mean = [row[LANE_MEAN], row[LANE_MEAN + 1], row[LANE_MEAN + 2]];
        let scale = [row[LANE_SCALE], row[LANE_SCALE + 1], row[LANE_SCALE + 2]];
        let quat = [row[LANE_QUAT], row[LANE_QUAT + 1], row[LANE_QUAT + 2], row[LANE_QUAT + 3]];
        let mut best: Option<(usize, T)> = None;
        if rules.nearest_visible {
            for (v, view) in views.iter().enumerate() {
                let p = view.to_camera(mean);
                if view.sees(p) && best.is_none_or(|(_, z)| p[2] < z) {
                    best = Some((v, p[2]));
                }
            }
        }
        let view = &views[best.map_or(source, |(v, _)| v)];
        let in_camera = view.to_camera(mean);
        let z = in_camera[2].max(view.z_min);
        let mut parent =
            Self { view, mean, quat, scale, alpha: row[LANE_OPACITY], in_camera, z, disc: None };
        if rules.disc {
            parent.disc = parent.disc_steps();
        }
        parent
    }

    /// Columns of G·Mᵀ·(M Mᵀ)⁻¹, G = R_w2c·R·S and M = J·G: the camera-frame step of
    /// least Mahalanobis length that projects to one pixel. `None` where the disc has
    /// no area to slide on.
    fn disc_steps(&self) -> Option<[V3<T>; 2]> {
        let g = self.view.ellipsoid(normalise(self.quat), self.scale);
        let z = self.z;
        let zero = T::default();
        let f = [self.view.focal[0] / z, self.view.focal[1] / z];
        let j = [
            [f[0], zero, -f[0] * self.in_camera[0] / z],
            [zero, f[1], -f[1] * self.in_camera[1] / z],
        ];
        let m = Footprint::new(j, &g);
        let det = m.area() * m.area();
        let solid = det > T::of(1e-20);
        if !solid {
            return None;
        }
        let [a, b] = m.0;
        let inner = |x: V3<T>, y: V3<T>| x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
        let (aa, ab, bb) = (inner(a, a), inner(a, b), inner(b, b));
        let column = |wa: T, wb: T| {
            let t: V3<T> = std::array::from_fn(|i| (wa * a[i] + wb * b[i]) / det);
            std::array::from_fn(|i| inner(g[i], t))
        };
        Some([column(bb, -ab), column(-ab, aa)])
    }

    /// Camera-frame step of child `k`.
    fn step(&self, rules: &Rules, k: usize, head: &[T]) -> V3<T> {
        let side = T::of(rules.side as f64);
        let half = T::of(0.5);
        let cell = [k % rules.side, k / rules.side];
        let offset: [T; 2] = std::array::from_fn(|i| {
            let learned = head[HEAD_OFFSET + i];
            let learned = match rules.offset_bound {
                Some(bound) => T::of(bound) * learned.tanh(),
                None => learned,
            };
            (T::of(cell[i] as f64) + half) / side - half + learned / side
        });
        let f = self.view.focal;
        let z = self.z;
        let mut s = [z * offset[0] / f[0], z * offset[1] / f[1], T::default()];
        if let Some([u, v]) = self.disc {
            let d: V3<T> = std::array::from_fn(|i| u[i] * offset[0] + v[i] * offset[1]);
            // Both steps project alike to first order, so a mixture does: an edge-on
            // disc slides at most a tenth of its depth.
            let tenth = T::of(DEPTH_FRACTION_MIN) * z;
            let share = if d[2].abs() > tenth { tenth / d[2].abs() } else { T::of(1.0) };
            s = std::array::from_fn(|i| s[i] + share * (d[i] - s[i]));
        }
        let mut dz = T::of(rules.beta_z) * head[HEAD_DEPTH].tanh();
        if rules.relative_depth {
            dz *= z;
        }
        let dz = dz.max(T::of(DEPTH_FRACTION_MIN - 1.0) * z - s[2]);
        if rules.ray {
            let depth = (self.in_camera[2] + s[2]).max(self.view.z_min);
            let share = dz / depth;
            s[0] += share * (self.in_camera[0] + s[0]);
            s[1] += share * (self.in_camera[1] + s[1]);
        }
        s[2] += dz;
        s
    }

    /// Footprint of the parent itself in a native render, target px²: with the
    /// low-pass for optical depth, without for integrated opacity.
    fn area(&self, rules: &Rules) -> T {
        let j = self.view.jacobian(self.in_camera, T::of(1.0));
        let m = Footprint::new(j, &self.view.ellipsoid(normalise(self.quat), self.scale));
        let area = m.area();
        let zoom = T::of(rules.children() as f64);
        match rules.opacity {
            Rule::OpticalDepth => zoom * m.blurred(area, T::of(rules.lowpass_input)),
            _ => zoom * area,
        }
    }

    /// Writes child `k` but for its opacity; returns the area that the opacity rule
    /// divides by, target px².
    fn child(&self, rules: &Rules, k: usize, head: &[T], row: &mut [T]) -> T {
        let step = self.step(rules, k, head);
        let in_world = self.view.to_world(step);
        let c = T::of(rules.dlog_clamp);
        let scale: V3<T> = std::array::from_fn(|i| {
            let soft = c * (head[HEAD_LOG_SCALE + i] / c).tanh();
            T::of(rules.lambda_s) * self.scale[i] * soft.exp()
        });
        let turn = [head[HEAD_ROTATION], head[HEAD_ROTATION + 1], head[HEAD_ROTATION + 2]];
        let quat = normalise(multiply(self.quat, exponential(turn)));
        let at = if rules.area_at_parent {
            self.in_camera
        } else {
            std::array::from_fn(|i| self.in_camera[i] + step[i])
        };
        let j = self.view.jacobian(at, T::of(rules.side as f64));
        let m = Footprint::new(j, &self.view.ellipsoid(quat, scale));
        let (area, a_min) = (m.area(), T::of(rules.a_min));
        let growth = m.growth(area, a_min, rules.two_axis);
        let clamped = area.max(a_min);
        for i in 0..3 {
            row[LANE_MEAN + i] = self.mean[i] + in_world[i];
            row[LANE_SCALE + i] = scale[i] * growth[i];
        }
        row[LANE_QUAT..LANE_QUAT + 4].copy_from_slice(&quat);
        match rules.opacity {
            Rule::OpticalDepth => m.grown(growth).blurred(clamped, T::of(rules.lowpass_target)),
            _ => clamped,
        }
    }
}

/// Parents per rayon task.
const BLOCK: usize = 64;

/// Children of N parents into `rows` `[N·K, 11]` and `gains` (module doc).
/// K ≤ [`CHILDREN_MAX`].
pub fn forward<T: Real>(
    rules: &Rules,
    source: Source,
    head: &[T],
    parents: &[T],
    rows: &mut [T],
    gains: &mut [T],
) {
    let views = source.cameras.iter().zip(source.near);
    let views: Vec<View<T>> = views.map(|(c, &near)| View::new(c, near)).collect();
    let (k, lanes) = (rules.children(), rules.gain_lanes());
    rows.par_chunks_mut(BLOCK * k * SPLAT_LANES)
        .zip(gains.par_chunks_mut(BLOCK * k * lanes))
        .enumerate()
        .for_each(|(block, (rows, gains))| {
            let each =
                rows.chunks_exact_mut(k * SPLAT_LANES).zip(gains.chunks_exact_mut(k * lanes));
            for (i, (rows, gains)) in each.enumerate() {
                let n = block * BLOCK + i;
                let view = ((source.first + n) / source.per_view).min(views.len() - 1);
                let row = &parents[n * SPLAT_LANES..(n + 1) * SPLAT_LANES];
                let parent = Parent::new(rules, &views, view, row);
                let head = &head[n * k * HEAD_LANES..(n + 1) * k * HEAD_LANES];
                split(rules, &parent, head, rows, gains);
            }
        });
}

/// The K children of one parent.
fn split<T: Real>(rules: &Rules, parent: &Parent<T>, head: &[T], rows: &mut [T], gains: &mut [T]) {
    let k = rules.children();
    let mut logits = [T::default(); CHILDREN_MAX];
    let mut areas = [T::default(); CHILDREN_MAX];
    let mut alphas = [T::default(); CHILDREN_MAX];
    let records = head.chunks_exact(HEAD_LANES).zip(rows.chunks_exact_mut(SPLAT_LANES));
    for (i, (record, row)) in records.enumerate() {
        areas[i] = parent.child(rules, i, record, row);
        logits[i] = record[HEAD_LOGIT];
    }
    if rules.opacity.areas_are_relative() {
        let own = parent.area(rules);
        areas[..k].iter_mut().for_each(|a| *a = *a / own);
    }
    redistribute::row(rules.opacity, &logits[..k], &areas[..k], parent.alpha, &mut alphas[..k]);
    let lanes = rules.gain_lanes();
    for i in 0..k {
        rows[i * SPLAT_LANES + LANE_OPACITY] = alphas[i];
        let extra = T::of(rules.delta) * head[i * HEAD_LANES + HEAD_GAIN].tanh();
        let gain = &mut gains[i * lanes..(i + 1) * lanes];
        gain[0] = T::of(1.0) + extra;
        // γ(½ + Σ) = ½ + γΣ + (γ − 1)/2.
        gain[1..].fill(T::of(0.5) * extra);
    }
}
