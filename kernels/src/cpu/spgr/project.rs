//! Projection of children from head records to one camera's 2-D splats. No child's mean,
//! quaternion, covariance or SH is stored in memory.
//!
//! Input: that of [`super::forward`], the parents' SH `[N, D, 3]`, a target camera.
//! Output: one [`Footprint`] per child, empty for a dropped one, by the rules of
//! [`crate::cpu::raster::ewa`] and of the frame's projection (tests/spgr/spgr_project.rs compares them).
//! [`ShDirection::Parent`] evaluates SH once per parent.

use super::child::Child;
use super::colour::Coefficients;
use super::parent::Parent;
use super::view::{V3, axpy, cross, dot, each, product, scaled, splat, times, transposed};
use super::{Args, BLOCK, gain, not_finite, records};
use crate::camera::Camera;
use crate::cpu::raster::ewa::{Footprint, View};
use crate::cpu::redistribute::share;
use crate::cpu::simd::{LANES, Mask, Real, Vector, VectorKernel};
use crate::cpu::spgr::view::Table;
use crate::layout::{
    ALPHA_MIN, ALPHA_MIN_LOG2, DISCRIMINANT_MIN_MVSPLAT, HEAD_GAIN_OFFSET, HEAD_LOGIT_OFFSET,
    RADIUS_SIGMAS_MVSPLAT, RasterOptions, ShDirection, TILE_MVSPLAT, sh_coefficients,
};
use rayon::prelude::*;

/// Relative and absolute widening of a support, in log₂ of alpha (as in `ewa`).
const SUPPORT_SLACK: f64 = 1e-4;
/// Widening of an extent, px (as in `ewa`).
const SPAN_SLACK_PX: f64 = 1e-3;
/// A sum with it has a whole number below 2²³ in its mantissa.
const MANTISSA: f32 = 8_388_608.0;

/// Target camera, rasterizer options and parents' SH.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a> {
    /// The camera of the picture to be rendered.
    pub camera: &'a Camera,
    /// Options of the rasterizer.
    pub options: &'a RasterOptions,
    /// `[N, D, 3]`, D = (`sh_degree` + 1)².
    pub sh: &'a [f32],
    /// Degree that `sh` stores.
    pub sh_degree: usize,
}

/// Numbers of the children of one vector of parents, one entry per child.
struct Scratch<'a, V> {
    projected: &'a mut [ProjectedChild<V>],
    areas: &'a mut [V],
    /// Logits, then opacities.
    alphas: &'a mut [V],
}

/// A child in the target camera, before its opacity is known.
#[derive(Clone, Copy)]
struct ProjectedChild<V> {
    /// Camera point.
    p: V3<V>,
    /// J·Σ·Jᵀ before the low-pass, px², and its determinant, px⁴.
    xx: V,
    xy: V,
    yy: V,
    det: V,
    gain: [V; 2],
    /// Σ sh·Y at the child's own direction.
    sum: V3<V>,
}

impl<V: Vector<Element = f32>> ProjectedChild<V> {
    #[inline(always)]
    fn new(view: &View, d: V3<V>, child: &Child<V>) -> Self {
        let rows = [splat(&view.rows[0]), splat(&view.rows[1]), splat(&view.rows[2])];
        let p = times(&rows, d);
        let inverse = V::constant(1.0) / p[2];
        let mut footprint = [[inverse; 3]; 2];
        for (i, row) in footprint.iter_mut().enumerate() {
            let (low, high) = view.limit[i];
            let slope = (p[i] * inverse).max(V::splat(low)).min(V::splat(high));
            let world = scaled(axpy(-slope, rows[2], rows[i]), V::splat(view.focal[i]) * inverse);
            *row = product(transposed(child.rotation(), world), child.scale);
        }
        let [a, b] = footprint;
        let n = cross(a, b);
        let zero = V::constant(0.0);
        Self {
            p,
            xx: dot(a, a),
            xy: dot(a, b),
            yy: dot(b, b),
            det: dot(n, n),
            gain: [zero; 2],
            sum: [zero; 3],
        }
    }

    /// Computes the footprint's 12 numbers and four extents in the order of [`Footprint`],
    /// and 1 in lanes that are kept.
    #[inline(always)]
    fn finish(&self, view: &View, alpha: V) -> ([V; 16], V) {
        let (zero, one, lowpass) = (V::constant(0.0), V::constant(1.0), V::splat(view.lowpass));
        let (xx, yy) = (self.xx + lowpass, self.yy + lowpass);
        let det = self.det + lowpass * (self.xx + self.yy) + lowpass * lowpass;
        let mut alpha = alpha;
        if view.antialiased {
            alpha = alpha * (self.det / det).max(zero).sqrt();
        }
        let power = alpha.log2();
        let reach = power - V::splat(ALPHA_MIN_LOG2);
        let reach = reach + V::constant(SUPPORT_SLACK) * (one + reach);
        let reach = V::constant(2.0 * std::f64::consts::LN_2) * reach;
        let inverse_z = one / (self.p[2] + V::splat(view.z_epsilon));
        let place = |i: usize| {
            (V::splat(view.focal[i]) * self.p[i]).fma(inverse_z, V::splat(view.centre[i]))
        };
        let (u, v) = (place(0), place(1));
        let half = V::constant(0.5 * std::f64::consts::LOG2_E);
        let inverse_yy = one / yy;
        let sx = (half * (yy / det)).sqrt();
        let shear = -self.xy * inverse_yy;
        let sy = (half * inverse_yy).sqrt();
        let (width, height) = ((reach * xx).sqrt(), (reach * yy).sqrt());
        let radius = view.tile_cut.then(|| {
            let mid = V::constant(0.5) * (xx + yy);
            let spread = (mid * mid - det).max(V::splat(DISCRIMINANT_MIN_MVSPLAT)).sqrt();
            -(-(V::splat(RADIUS_SIGMAS_MVSPLAT) * (mid + spread).sqrt())).floor()
        });
        let (x0, x1) = extent(view.size[0] as f32, (u, width), radius);
        let (y0, y1) = extent(view.size[1] as f32, (v, height), radius);
        let grey = V::constant(0.5) + self.gain[1];
        let rgb = axpy(self.gain[0], self.sum, [grey; 3]);
        let numbers =
            [u, v, sx, shear, sy, power, rgb[0], rgb[1], rgb[2], self.p[2], width, height];
        // Every test fails for NaN.
        let mut keep = V::splat(view.near).lt(self.p[2]).select_or_zero(one);
        for (low, high) in [(zero, det), (zero, xx), (zero, yy), (x0, x1), (y0, y1)] {
            keep = low.lt(high).select_or_zero(keep);
        }
        keep = alpha.lt(V::splat(ALPHA_MIN)).select(zero, keep);
        let sound = not_finite(&numbers, not_finite(&[det], zero)).abs();
        keep = sound.lt(one).select_or_zero(keep);
        let rgb = [rgb[0].max(zero), rgb[1].max(zero), rgb[2].max(zero)];
        (
            [
                u, v, sx, shear, sy, power, rgb[0], rgb[1], rgb[2], self.p[2], width, height, x0,
                y0, x1, y1,
            ],
            keep,
        )
    }
}

/// Computes the pixels [first, past the last) along one axis of `side` pixels that the
/// support intersects and, with a radius, that the tile cut keeps; whole numbers.
#[inline(always)]
fn extent<V: Vector<Element = f32>>(side: f32, (mean, half): (V, V), radius: Option<V>) -> (V, V) {
    let (zero, one, side) = (V::constant(0.0), V::constant(1.0), V::splat(side));
    let half = half + V::constant(SPAN_SLACK_PX);
    // The clamp comes first, so that a whole number fits the mantissa.
    let first = (mean - half).max(zero).min(side);
    let past = (mean + half).max(-one).min(side);
    let mut first = -(-first).floor();
    let mut past = (past.floor() + one).min(side);
    if let Some(r) = radius {
        let tile = V::constant(TILE_MVSPLAT as f64);
        let per = one / tile;
        let ends = [mean - r, mean + r + (tile - one)];
        let cut = each(
            ends,
            #[inline(always)]
            |at| (at.max(zero).min(side + tile) * per).floor() * tile,
        );
        first = first.max(cut[0]).min(side);
        past = past.min(cut[1]);
    }
    (first, past)
}

/// One block of parents; `out` is the block's own.
struct Project<'a> {
    args: Args<'a, f32>,
    target: Target<'a>,
    view: &'a View,
    table: &'a Table<f32>,
    range: std::ops::Range<usize>,
    out: &'a mut [Footprint],
}

impl VectorKernel<f32> for Project<'_> {
    type Output = bool;
    #[inline(always)]
    fn run<V: Vector<Element = f32>>(mut self) -> bool {
        let children = self.args.rules.children();
        let options = self.target.options;
        let degree = options.sh_degree.min(self.target.sh_degree);
        let mut colour = Coefficients::new(options.sh_basis, degree);
        let zero = V::constant(0.0);
        let empty = ProjectedChild {
            p: [zero; 3],
            xx: zero,
            xy: zero,
            yy: zero,
            det: zero,
            gain: [zero; 2],
            sum: [zero; 3],
        };
        let mut projected = vec![empty; children];
        let (mut areas, mut alphas) = (vec![zero; children], vec![zero; children]);
        let mut bad = zero;
        for first in self.range.clone().step_by(V::LANES) {
            let span = (first, V::LANES.min(self.range.end - first));
            let set = 3 * sh_coefficients(self.target.sh_degree);
            colour.load::<V>(self.target.sh, (span.0, span.1, set));
            let scratch =
                Scratch { projected: &mut projected, areas: &mut areas, alphas: &mut alphas };
            bad = bad + self.group(span, &colour, scratch);
            self.write(span, &projected, &alphas);
        }
        let mut lanes = [0.0; LANES];
        bad.store(&mut lanes);
        lanes[..V::LANES].iter().all(|&v| v == 0.0)
    }
}

impl Project<'_> {
    /// Projects the children of one vector of parents; returns 0 in lanes where all numbers
    /// are finite, else NaN.
    #[inline(always)]
    fn group<V: Vector<Element = f32>>(
        &self,
        span: (usize, usize),
        colour: &Coefficients<f32>,
        Scratch { projected, areas, alphas }: Scratch<V>,
    ) -> V {
        let Args { rules, source, parents, .. } = self.args;
        let parent = Parent::load((rules, self.table, &source), parents, span);
        let mut bad = not_finite(&[parent.alpha, parent.z], V::constant(0.0));
        let eye = splat(&self.view.eye);
        let shared = self.target.options.sh_direction == ShDirection::Parent;
        let mut towards = [V::constant(0.0); 3];
        for (k, projected) in projected.iter_mut().enumerate() {
            let head = records(&self.args, span, k);
            bad = not_finite(&head, bad);
            let child = Child::new(rules, &parent, k, &head);
            (areas[k], alphas[k]) = (child.area, head[HEAD_LOGIT_OFFSET]);
            bad = not_finite(&child.mean, not_finite(&child.scale, bad));
            let d = axpy(V::constant(-1.0), eye, child.mean);
            *projected = ProjectedChild::new(self.view, d, &child);
            let [gamma, residual, ..] = gain(rules, head[HEAD_GAIN_OFFSET]);
            projected.gain = [gamma, residual];
            if shared {
                towards = axpy(V::constant(1.0), d, towards);
            } else {
                projected.sum = colour.radiance(d);
            }
        }
        if shared {
            let sum = colour.radiance(towards);
            projected.iter_mut().for_each(|child| child.sum = sum);
        }
        share(rules.opacity, areas, parent.alpha, parent.own, alphas);
        not_finite(alphas, bad)
    }

    #[inline(always)]
    fn write<V: Vector<Element = f32>>(
        &mut self,
        (first, count): (usize, usize),
        projected: &[ProjectedChild<V>],
        alphas: &[V],
    ) {
        let children = projected.len();
        let at = (first - self.range.start) * children;
        for (k, (child, &alpha)) in projected.iter().zip(alphas).enumerate() {
            let (numbers, keep) = child.finish(self.view, alpha);
            let mut tile = [[0.0; LANES]; 16];
            for (i, (v, tile)) in numbers.into_iter().zip(&mut tile).enumerate() {
                let v = if i < 12 { v } else { v + V::splat(MANTISSA) };
                v.store(tile);
            }
            let mut keeps = [0.0; LANES];
            keep.store(&mut keeps);
            for lane in 0..count {
                let f = |i: usize| tile[i][lane];
                let whole = |i: usize| tile[i][lane].to_bits() & 0x007f_ffff;
                self.out[at + lane * children + k] = if keeps[lane] > 0.0 {
                    Footprint {
                        u: f(0),
                        v: f(1),
                        sx: f(2),
                        shear: f(3),
                        sy: f(4),
                        power: f(5),
                        rgb: [f(6), f(7), f(8)],
                        z: f(9),
                        half_width: f(10),
                        half_height: f(11),
                        x0: whole(12),
                        y0: whole(13),
                        x1: whole(14),
                        y1: whole(15),
                    }
                } else {
                    Footprint::default()
                };
            }
        }
    }
}

/// Computes the footprints `[N·K]` of the children in `target` (module documentation),
/// child k of parent n at n·K + k. Returns false as [`super::forward`].
pub fn project(args: Args<f32>, target: Target, out: &mut [Footprint]) -> bool {
    let table = Table::new(&args.source);
    let view = View::new(target.camera, target.options);
    out.par_chunks_mut(BLOCK * args.rules.children())
        .enumerate()
        .map(|(block, out)| {
            let range = args.block(block);
            f32::dispatch(Project { args, target, view: &view, table: &table, range, out })
        })
        .reduce(|| true, |a, b| a && b)
}
