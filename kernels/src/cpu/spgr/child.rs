//! One vector of children, child k of each lane's parent: everything but the opacity, with
//! gradients.

use super::Rules;
use super::parent::{Parent, ParentGradient};
use super::shape::{Footprint, Turn, Unit, conjugate, matrix, matrix_backward, multiply};
use super::view::{Jacobian, M3, V3, add, add4, axpy, dot, product, scaled, times, transposed};
use crate::cpu::redistribute::OpacityRule;
use crate::cpu::simd::{Mask, Vector};
use crate::layout::{
    DEPTH_FRACTION_MIN, DepthDir, DepthUnit, HEAD_DEPTH_OFFSET, HEAD_LOG_SCALE_OFFSET,
    HEAD_ROTATION_OFFSET, HEAD_STRIDE, HEAD_UV_OFFSET,
};

/// The camera-frame step from parent to child, and the values that its gradient needs.
struct Step<V: Vector> {
    out: V3<V>,
    /// tanh of the learned offset, where it is bounded.
    bounded: [V; 2],
    /// Input px.
    offset: [V; 2],
    /// Share of the disc step.
    along_disc: V,
    tanh_z: V,
    free_z: V::Mask,
    /// Before the residual along the ray.
    side: [V; 2],
    ray: Option<(V, V, V::Mask)>,
}

impl<V: Vector> Step<V> {
    #[inline(always)]
    fn new(rules: &Rules, parent: &Parent<V>, k: usize, head: &[V; HEAD_STRIDE]) -> Self {
        let z = parent.z;
        let per_side = 1.0 / rules.zoom();
        let position = rules.positions.of(k);
        let learned = [head[HEAD_UV_OFFSET], head[HEAD_UV_OFFSET + 1]];
        let (bounded, per_px) = match rules.offset_bound {
            Some(bound) => ([learned[0].tanh(), learned[1].tanh()], bound * per_side),
            None => (learned, per_side),
        };
        let grid = |i: usize| V::constant(position[i]);
        let offset = [
            bounded[0].fma(V::constant(per_px), grid(0)),
            bounded[1].fma(V::constant(per_px), grid(1)),
        ];
        let f = parent.view.focal;
        let mut s = [z * offset[0] / f[0], z * offset[1] / f[1], V::constant(0.0)];
        let mut along_disc = V::constant(0.0);
        if let Some(disc) = &parent.disc {
            let [u, v] = disc.steps;
            let d = axpy(offset[1], v, scaled(u, offset[0]));
            // Both steps have the same projection to first order, and so has a mixture. It
            // limits the slide of an edge-on disc to a tenth of its depth.
            let tenth = V::constant(DEPTH_FRACTION_MIN) * z;
            along_disc = disc.solid.select_or_zero(tenth / d[2].abs().max(tenth));
            s = axpy(along_disc, [d[0] - s[0], d[1] - s[1], d[2] - s[2]], s);
        }
        let tanh_z = head[HEAD_DEPTH_OFFSET].tanh();
        let mut dz = V::constant(rules.beta_z) * tanh_z;
        if rules.depth_unit == DepthUnit::Relative {
            dz = dz * z;
        }
        let least = V::constant(DEPTH_FRACTION_MIN - 1.0) * z - s[2];
        let free_z = least.lt(dz);
        let dz = dz.max(least);
        let side = [s[0], s[1]];
        let mut ray = None;
        if rules.depth_dir == DepthDir::Ray {
            let ahead = parent.in_camera[2] + s[2];
            let inverse = V::constant(1.0) / ahead.max(parent.view.z_min);
            let share = dz * inverse;
            for (s, x) in s.iter_mut().zip(parent.in_camera).take(2) {
                *s = share.fma(x + *s, *s);
            }
            ray = Some((share, inverse, parent.view.z_min.lt(ahead)));
        }
        s[2] = s[2] + dz;
        Self { out: s, bounded, offset, along_disc, tanh_z, free_z, side, ray }
    }

    /// Adds the gradients through the step to those of head and parent.
    #[inline(always)]
    fn backward(
        &self,
        (rules, parent): (&Rules, &Parent<V>),
        mut d_s: V3<V>,
        d_head: &mut [V; HEAD_STRIDE],
        d: &mut ParentGradient<V>,
    ) {
        let z = parent.z;
        let mut d_dz = d_s[2];
        if let Some((share, inverse, free)) = self.ray {
            let mut d_share = V::constant(0.0);
            #[expect(
                clippy::needless_range_loop,
                reason = "three arrays, and iterators do not inline"
            )]
            for i in 0..2 {
                d_share = d_s[i].fma(parent.in_camera[i] + self.side[i], d_share);
                d.in_camera[i] = share.fma(d_s[i], d.in_camera[i]);
                d_s[i] = share.fma(d_s[i], d_s[i]);
            }
            let each = d_share * inverse;
            d_dz = d_dz + each;
            let d_ahead = free.select_or_zero(-each * share);
            d.in_camera[2] = d.in_camera[2] + d_ahead;
            d_s[2] = d_s[2] + d_ahead;
        }
        let free_dz = self.free_z.select_or_zero(d_dz);
        let bound_dz = d_dz - free_dz;
        d.z = bound_dz.fma(V::constant(DEPTH_FRACTION_MIN - 1.0), d.z);
        d_s[2] = d_s[2] - bound_dz;
        let mut d_tanh = free_dz * V::constant(rules.beta_z);
        if rules.depth_unit == DepthUnit::Relative {
            d.z = d_tanh.fma(self.tanh_z, d.z);
            d_tanh = d_tanh * z;
        }
        d_head[HEAD_DEPTH_OFFSET] = d_tanh * (V::constant(1.0) - self.tanh_z * self.tanh_z);
        let mut d_offset = [V::constant(0.0); 2];
        let mut d_flat = d_s;
        if let Some(disc) = &parent.disc {
            let d_slid = scaled(d_s, self.along_disc);
            for i in 0..2 {
                d.disc[i] = axpy(self.offset[i], d_slid, d.disc[i]);
                d_offset[i] = dot(disc.steps[i], d_slid);
                d_flat[i] = d_s[i] - d_slid[i];
            }
        }
        let per_side = 1.0 / rules.zoom();
        for i in 0..2 {
            let per = d_flat[i] / parent.view.focal[i];
            d_offset[i] = per.fma(z, d_offset[i]);
            d.z = per.fma(self.offset[i], d.z);
            let t = self.bounded[i];
            d_head[HEAD_UV_OFFSET + i] = match rules.offset_bound {
                Some(bound) => {
                    d_offset[i] * V::constant(bound * per_side) * (V::constant(1.0) - t * t)
                }
                None => d_offset[i] * V::constant(per_side),
            };
        }
    }
}

pub(super) struct Child<V: Vector> {
    step: Step<V>,
    turn: Turn<V>,
    unit: Unit<V>,
    rotation: M3<V>,
    /// At the child; `None` where footprints take the parent's.
    jacobian: Option<Jacobian<V>>,
    footprint: Footprint<V>,
    /// tanh(Δlog s/c), and λ_s·e^…
    soft: V3<V>,
    factor: V3<V>,
    /// Before the growth to the least footprint.
    small: V3<V>,
    growth: V3<V>,
    clamped: V,
    /// World.
    pub(super) mean: V3<V>,
    /// σ, world units.
    pub(super) scale: V3<V>,
    /// Divisor of the opacity rule, target px².
    pub(super) area: V,
}

/// Gradients of a child's outputs.
pub(super) struct ChildGradient<V> {
    pub(super) mean: V3<V>,
    pub(super) quat: [V; 4],
    pub(super) scale: V3<V>,
    pub(super) area: V,
}

impl<V: Vector> Child<V> {
    #[inline(always)]
    pub(super) fn new(
        rules: &Rules,
        parent: &Parent<V>,
        k: usize,
        head: &[V; HEAD_STRIDE],
    ) -> Self {
        let step = Step::new(rules, parent, k, head);
        let mean = add(parent.mean, times(&parent.view.rotation, step.out));
        let c = V::constant(rules.dlog_clamp);
        let per_c = V::constant(1.0 / rules.dlog_clamp);
        let l = HEAD_LOG_SCALE_OFFSET;
        let [x, y, z] = scaled([head[l], head[l + 1], head[l + 2]], per_c);
        let soft = [x.tanh(), y.tanh(), z.tanh()];
        let [x, y, z] = scaled(soft, c);
        let factor = scaled([x.exp(), y.exp(), z.exp()], V::constant(rules.lambda_s));
        let small = product(factor, parent.scale);
        let r = HEAD_ROTATION_OFFSET;
        let turn = Turn::new([head[r], head[r + 1], head[r + 2]]);
        let unit = Unit::new(multiply(parent.quat, turn.e));
        let rotation = matrix(unit.q);
        let mut jacobian = None;
        let jw = match &parent.jacobian {
            Some(shared) => shared.jw,
            None => {
                let at = add(parent.in_camera, step.out);
                let own = Jacobian::new(&parent.view, at, V::constant(rules.zoom()));
                let jw = own.jw;
                jacobian = Some(own);
                jw
            }
        };
        let footprint = Footprint::new(&jw, &rotation, small);
        let growth = footprint.growth(rules);
        let clamped = footprint.area.max(V::constant(rules.a_min));
        let area = match rules.opacity {
            OpacityRule::OpticalDepth => footprint.blurred(growth, clamped, rules.lowpass_target),
            _ => clamped,
        };
        let scale = product(small, growth);
        Self {
            step,
            turn,
            unit,
            rotation,
            jacobian,
            footprint,
            soft,
            factor,
            small,
            growth,
            clamped,
            mean,
            scale,
            area,
        }
    }

    /// wxyz, unit.
    #[inline(always)]
    pub(super) fn quat(&self) -> [V; 4] {
        self.unit.q
    }

    /// Rows of R(q).
    #[inline(always)]
    pub(super) fn rotation(&self) -> &M3<V> {
        &self.rotation
    }

    /// Writes the gradients of the head record's geometry and adds to the parent's.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        (rules, parent): (&Rules, &Parent<V>),
        g: ChildGradient<V>,
        d_head: &mut [V; HEAD_STRIDE],
        d: &mut ParentGradient<V>,
    ) {
        let zero = V::constant(0.0);
        let f = &self.footprint;
        let (d_clamped, d_m) = match rules.opacity {
            OpacityRule::OpticalDepth => {
                let at = (self.growth, self.clamped, self.area);
                f.blurred_backward(at, rules.lowpass_target, g.area)
            }
            _ => (g.area, [[zero; 3]; 2]),
        };
        let d_area = V::constant(rules.a_min).lt(f.area).select_or_zero(d_clamped);
        let jw = match (&parent.jacobian, &self.jacobian) {
            (Some(j), _) | (None, Some(j)) => &j.jw,
            (None, None) => return,
        };
        let (d_jw, d_rotation, by_area) = f.backward((jw, &self.rotation, self.small), d_area, d_m);
        let c = V::constant(1.0);
        for i in 0..3 {
            let d_small = g.scale[i].fma(self.growth[i], by_area[i]);
            d.scale[i] = d_small.fma(self.factor[i], d.scale[i]);
            let t = self.soft[i];
            d_head[HEAD_LOG_SCALE_OFFSET + i] = d_small * self.small[i] * (c - t * t);
        }
        let by_rotation = matrix_backward(self.unit.q, &d_rotation);
        let d_unit = self.unit.backward(add4(g.quat, by_rotation));
        let d_turn = self.turn.backward(multiply(conjugate(parent.quat), d_unit));
        d_head[HEAD_ROTATION_OFFSET..HEAD_ROTATION_OFFSET + 3].copy_from_slice(&d_turn);
        let by_parent = multiply(d_unit, conjugate(self.turn.e));
        d.quat = add4(d.quat, by_parent);
        d.mean = add(d.mean, g.mean);
        let mut d_step = transposed(&parent.view.rotation, g.mean);
        match &self.jacobian {
            Some(j) => {
                let d_at = j.backward(&d_jw);
                d.in_camera = add(d.in_camera, d_at);
                d_step = add(d_step, d_at);
            }
            None => d.jw = [add(d.jw[0], d_jw[0]), add(d.jw[1], d_jw[1])],
        }
        self.step.backward((rules, parent), d_step, d_head, d);
    }
}
