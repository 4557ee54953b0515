//! One vector of parents in their primary views: the values that their children share, with
//! gradients.

use super::shape::{Footprint, Unit, matrix, matrix_backward};
use super::view::{
    Jacobian, M3, Table, V3, View, add, add4, axpy, cross, dot, each, indexed, product, scaled,
    times, transposed,
};
use super::{Rules, Source};
use crate::cpu::redistribute::OpacityRule;
use crate::cpu::simd::{LANES, Mask, RowLayout, Vector};
use crate::layout::{
    AreaAt, DISC_AREA_SQ_MIN, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
    Slide,
};

pub(super) struct Parent<V: Vector> {
    pub(super) view: View<V>,
    pub(super) mean: V3<V>,
    pub(super) quat: [V; 4],
    pub(super) scale: V3<V>,
    pub(super) alpha: V,
    pub(super) in_camera: V3<V>,
    /// Depth that sets the pitch of the children, clamped to the view's `z_min`.
    pub(super) z: V,
    pub(super) disc: Option<Disc<V>>,
    /// The parent's Jacobian, if the children's footprints use it.
    pub(super) jacobian: Option<Jacobian<V>>,
    /// Footprint in a native render, target px²: with the low-pass for optical depth,
    /// without for integrated opacity; 1 for the other rules.
    pub(super) own: V,
}

/// Gradients of the parents, summed over their children.
pub(super) struct ParentGradient<V> {
    pub(super) mean: V3<V>,
    pub(super) quat: [V; 4],
    pub(super) scale: V3<V>,
    pub(super) alpha: V,
    pub(super) in_camera: V3<V>,
    pub(super) z: V,
    pub(super) disc: [V3<V>; 2],
    pub(super) jw: [V3<V>; 2],
    pub(super) own: V,
}

impl<V: Vector> ParentGradient<V> {
    #[inline(always)]
    pub(super) fn zero(zero: V) -> Self {
        let none = [zero; 3];
        Self {
            mean: none,
            quat: [zero; 4],
            scale: none,
            alpha: zero,
            in_camera: none,
            z: zero,
            disc: [none; 2],
            jw: [none; 2],
            own: zero,
        }
    }
}

impl<V: Vector> Parent<V> {
    /// Loads parents `first .. first + count` of `rows` `[N, 11]`; further lanes repeat the
    /// last.
    #[inline(always)]
    pub(super) fn load(
        (rules, table, source): (&Rules, &Table<V::Element>, &Source),
        rows: &[V::Element],
        (first, count): (usize, usize),
    ) -> Self {
        let row: [V; SPLAT_STRIDE] =
            V::load_rows(&rows[first * SPLAT_STRIDE..], RowLayout { stride: SPLAT_STRIDE, count });
        let mut index = [0; LANES];
        for (lane, index) in index[..V::LANES].iter_mut().enumerate() {
            let n = source.first + first + lane.min(count - 1);
            *index = (n / source.per_view).min(table.len() - 1);
        }
        let vector = |i: usize| [row[i], row[i + 1], row[i + 2]];
        let mean = vector(MEAN_OFFSET);
        let q = QUAT_OFFSET;
        let quat = [row[q], row[q + 1], row[q + 2], row[q + 3]];
        let view = table.primary(rules, mean, index);
        Self::new(rules, view, (mean, quat, vector(SCALE_OFFSET), row[OPACITY_OFFSET]))
    }

    #[inline(always)]
    fn new(
        rules: &Rules,
        view: View<V>,
        (mean, quat, scale, alpha): (V3<V>, [V; 4], V3<V>, V),
    ) -> Self {
        let in_camera = view.seen_from(mean);
        let z = in_camera[2].max(view.z_min);
        let one = V::constant(1.0);
        let mut parent = Self {
            view,
            mean,
            quat,
            scale,
            alpha,
            in_camera,
            z,
            disc: None,
            jacobian: None,
            own: one,
        };
        if rules.slide == Slide::Disc {
            parent.disc = Some(Disc::new(&parent));
        }
        if rules.area_at == AreaAt::Parent {
            let zoom = V::constant(rules.zoom());
            parent.jacobian = Some(Jacobian::new(&view, in_camera, zoom));
        }
        if rules.opacity.areas_are_relative() {
            parent.own = Own::new(&parent, rules).value;
        }
        parent
    }

    /// Computes gradients `[11]` of the rows from those of the shared values.
    #[inline(always)]
    pub(super) fn backward(&self, rules: &Rules, mut d: ParentGradient<V>) -> [V; SPLAT_STRIDE] {
        if rules.opacity.areas_are_relative() {
            Own::new(self, rules).backward(self, rules, &mut d);
        }
        if let Some(jacobian) = &self.jacobian {
            d.in_camera = add(d.in_camera, jacobian.backward(&d.jw));
        }
        if let Some(disc) = &self.disc {
            disc.backward(self, &mut d);
        }
        let free = self.view.z_min.lt(self.in_camera[2]);
        d.in_camera[2] = d.in_camera[2] + free.select_or_zero(d.z);
        let mean = add(d.mean, times(&self.view.rotation, d.in_camera));
        let ([x, y, z], [a, b, c, e], [s, t, u]) = (mean, d.quat, d.scale);
        [x, y, z, a, b, c, e, s, t, u, d.alpha]
    }
}

/// The parents' own footprints.
struct Own<V: Vector> {
    unit: Unit<V>,
    rotation: M3<V>,
    jacobian: Jacobian<V>,
    footprint: Footprint<V>,
    blurred: V,
    value: V,
}

impl<V: Vector> Own<V> {
    #[inline(always)]
    fn new(parent: &Parent<V>, rules: &Rules) -> Self {
        let one = V::constant(1.0);
        let unit = Unit::new(parent.quat);
        let rotation = matrix(unit.q);
        let jacobian = Jacobian::new(&parent.view, parent.in_camera, one);
        let footprint = Footprint::new(&jacobian.jw, &rotation, parent.scale);
        let blurred = match rules.opacity {
            OpacityRule::OpticalDepth => {
                footprint.blurred([one; 3], footprint.area, rules.lowpass_input)
            }
            _ => footprint.area,
        };
        let value = V::constant(rules.children() as f64) * blurred;
        Self { unit, rotation, jacobian, footprint, blurred, value }
    }

    #[inline(always)]
    fn backward(&self, parent: &Parent<V>, rules: &Rules, d: &mut ParentGradient<V>) {
        let one = V::constant(1.0);
        let each = d.own * V::constant(rules.children() as f64);
        let zero = [V::constant(0.0); 3];
        let f = &self.footprint;
        let (d_area, d_m) = match rules.opacity {
            OpacityRule::OpticalDepth => {
                let at = ([one; 3], f.area, self.blurred);
                f.blurred_backward(at, rules.lowpass_input, each)
            }
            _ => (each, [zero; 2]),
        };
        let at = (&self.jacobian.jw, &self.rotation, parent.scale);
        let (d_jw, d_rotation, d_scale) = f.backward(at, d_area, d_m);
        d.in_camera = add(d.in_camera, self.jacobian.backward(&d_jw));
        d.scale = add(d.scale, d_scale);
        let d_quat = self.unit.backward(matrix_backward(self.unit.q, &d_rotation));
        d.quat = add4(d.quat, d_quat);
    }
}

/// Steps along the parent's disc: columns of G·Mᵀ·(M Mᵀ)⁻¹, G = R_w2c·R·S and M = J·G,
/// the camera-frame steps of least Mahalanobis length that project to one pixel.
pub(super) struct Disc<V: Vector> {
    /// For one px of u and of v.
    pub(super) steps: [V3<V>; 2],
    /// Lanes whose disc has an area to slide on.
    pub(super) solid: V::Mask,
    unit: Unit<V>,
    /// R_w2c·R(q), rows, and the same with scales.
    turned: M3<V>,
    g: M3<V>,
    j: [V3<V>; 2],
    m: [V3<V>; 2],
    normal: V3<V>,
    inverse_det: V,
    weights: [V3<V>; 2],
}

impl<V: Vector> Disc<V> {
    #[inline(always)]
    fn new(parent: &Parent<V>) -> Self {
        let (z, x, s) = (parent.z, parent.in_camera, parent.scale);
        let (zero, one) = (V::constant(0.0), V::constant(1.0));
        let unit = Unit::new(parent.quat);
        let rotation = matrix(unit.q);
        let columns = &parent.view.rotation;
        let turned: M3<V> = indexed(
            [zero; 3],
            #[inline(always)]
            |i| transposed(&rotation, [columns[0][i], columns[1][i], columns[2][i]]),
        );
        let g = [product(turned[0], s), product(turned[1], s), product(turned[2], s)];
        let f = [parent.view.focal[0] / z, parent.view.focal[1] / z];
        let j = [[f[0], zero, -f[0] * x[0] / z], [zero, f[1], -f[1] * x[1] / z]];
        let m = [transposed(&g, j[0]), transposed(&g, j[1])];
        let normal = cross(m[0], m[1]);
        let det = dot(normal, normal) + V::constant(crate::layout::AREA_SQ_EPS);
        let solid = V::constant(DISC_AREA_SQ_MIN).lt(det);
        let inverse_det = one / solid.select(det, one);
        // Rows of (M Mᵀ)⁻¹·M as cross products: (b·b)·a − (a·b)·b cancels for needles.
        let weights =
            [scaled(cross(m[1], normal), inverse_det), scaled(cross(normal, m[0]), inverse_det)];
        let steps = [times(&g, weights[0]), times(&g, weights[1])];
        Self { steps, solid, unit, turned, g, j, m, normal, inverse_det, weights }
    }

    #[inline(always)]
    fn backward(&self, parent: &Parent<V>, d: &mut ParentGradient<V>) {
        let [a, b] = self.m;
        let [du, dv] = each(
            d.disc,
            #[inline(always)]
            |[x, y, z]| {
                [
                    self.solid.select_or_zero(x),
                    self.solid.select_or_zero(y),
                    self.solid.select_or_zero(z),
                ]
            },
        );
        let [tu, tv] = self.weights;
        // steps = G·t: ∂G = d tᵀ, ∂t = Gᵀ d.
        let mut d_g: M3<V> = indexed(
            tu,
            #[inline(always)]
            |i| axpy(dv[i], tv, scaled(tu, du[i])),
        );
        let (eu, ev) = (
            scaled(transposed(&self.g, du), self.inverse_det),
            scaled(transposed(&self.g, dv), self.inverse_det),
        );
        // t_u = b×n/det, t_v = n×a/det, det = n·n, n = a×b.
        let n = self.normal;
        let d_det = -(dot(eu, tu) + dot(ev, tv));
        let d_n = axpy(d_det + d_det, n, add(cross(eu, b), cross(a, ev)));
        let d_a = add(cross(ev, n), cross(b, d_n));
        let d_b = add(cross(n, eu), cross(d_n, a));
        // m = J·G.
        for (i, row) in d_g.iter_mut().enumerate() {
            *row = axpy(self.j[0][i], d_a, axpy(self.j[1][i], d_b, *row));
        }
        for (i, d_m) in [d_a, d_b].into_iter().enumerate() {
            // J's row is f/z at column i and −f·x/z² at column 2.
            let (d_f, d_x) = (dot(d_m, self.g[i]), dot(d_m, self.g[2]));
            let z = parent.z;
            let per = parent.view.focal[i] / (z * z);
            d.in_camera[i] = d.in_camera[i] - d_x * per;
            d.z = d.z - d_f * per - V::constant(2.0) * d_x * self.j[i][2] / z;
        }
        // G = R_w2c·R·S.
        let s = parent.scale;
        let t = &self.turned;
        for (scale, t) in d_g.iter().zip(t) {
            d.scale = add(d.scale, product(*scale, *t));
        }
        let d_turned = [product(d_g[0], s), product(d_g[1], s), product(d_g[2], s)];
        let r = &parent.view.rotation;
        let d_rotation: M3<V> =
            [transposed(&d_turned, r[0]), transposed(&d_turned, r[1]), transposed(&d_turned, r[2])];
        let d_quat = self.unit.backward(matrix_backward(self.unit.q, &d_rotation));
        d.quat = add4(d.quat, d_quat);
    }
}
