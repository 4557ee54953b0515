//! Gradients of raw rows, distances and densities.

use super::colour::{self, Frame};
use super::{Adapter, GEOMETRY, Pixel, QUAT_EPS, View, columns, dot, opacity, strided};
use crate::cpu::simd::{LANES, Real, RowLayout, Vector, VectorKernel};
use crate::layout::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};
use rayon::prelude::*;

/// Gradients of the results.
#[derive(Clone, Copy, Debug)]
pub struct Reached<'a, T> {
    /// `[views·H·W·G, 11]`.
    pub rows: &'a [T],
    /// Of the two SH of [`Frame`]; `None` where no gradient exists.
    pub colours: [Option<&'a [T]>; 2],
}

/// Gradients of [`super::forward`] and [`colour::forward`] together.
pub struct Gradients<T> {
    /// `[views·H·W, 9 + 3·D]`.
    pub raw: Vec<T>,
    /// `[views·H·W, G]`.
    pub depths: Vec<T>,
    /// `[views·H·W, G]`.
    pub densities: Vec<T>,
}

/// One row of pixels.
struct Backward<'a, T> {
    adapter: &'a Adapter,
    view: usize,
    row: usize,
    inputs: [&'a [T]; 3],
    reached: Reached<'a, T>,
    d_raw: &'a mut [T],
    d_depths: &'a mut [T],
    d_densities: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for Backward<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(mut self) {
        let width = self.adapter.size[1];
        for first in (0..width).step_by(V::LANES) {
            self.group::<V>((first, V::LANES.min(width - first)));
        }
    }
}

impl<T: Real> Backward<'_, T> {
    #[inline(always)]
    fn group<V: Vector<Element = T>>(&mut self, (first, count): (usize, usize)) {
        let lanes = self.adapter.raw_lanes();
        let g = self.adapter.per_pixel;
        let view = &self.adapter.views[self.view];
        let [raw, depths, densities] = self.inputs;
        let raw: [V; GEOMETRY] =
            V::load_rows(&raw[first * lanes..], RowLayout { stride: lanes, count });
        let at = (columns(first), V::constant(self.row as f64));
        let pixel = Pixel::new(view, &raw, at);
        // With respect to the ray in world frame, σ at distance 1, the quaternion.
        let zero = V::constant(0.0);
        let (mut d_towards, mut d_scale, mut d_quat) = ([zero; 3], [zero; 3], [zero; 4]);
        for k in 0..g {
            let t: V = strided(depths, (first * g + k, g));
            let p: V = strided(densities, (first * g + k, g));
            let from = &self.reached.rows[(first * g + k) * SPLAT_STRIDE..];
            let d: [V; SPLAT_STRIDE] =
                V::load_rows(from, RowLayout { stride: g * SPLAT_STRIDE, count });
            let mut d_t = zero;
            for i in 0..3 {
                let (mean, scale) = (d[MEAN_OFFSET + i], d[SCALE_OFFSET + i]);
                d_towards[i] = t.fma(mean, d_towards[i]);
                d_scale[i] = t.fma(scale, d_scale[i]);
                d_t = mean.fma(pixel.towards[i], scale.fma(pixel.scale[i], d_t));
            }
            for (sum, d) in d_quat.iter_mut().zip(&d[QUAT_OFFSET..QUAT_OFFSET + 4]) {
                *sum = *sum + *d;
            }
            let d_p = d[OPACITY_OFFSET] * opacity(self.adapter, p).1;
            put(d_t, (first * g + k, g, count), self.d_depths);
            put(d_p, (first * g + k, g, count), self.d_densities);
        }
        let d = geometry(view, (&raw, &pixel), (d_towards, d_scale, d_quat));
        V::store_rows(&d, RowLayout { stride: lanes, count }, &mut self.d_raw[first * lanes..]);
        let n = 3 * self.adapter.functions;
        let mut d_colours = [zero; 75];
        for (frame, d_out) in [Frame::World, Frame::Camera].into_iter().zip(self.reached.colours) {
            if let Some(d_out) = d_out {
                let from = (&d_out[first * g * n..], count);
                let of = (self.adapter, frame, self.view);
                colour::backward(of, from, &mut d_colours[..n]);
            }
        }
        let to = &mut self.d_raw[first * lanes + GEOMETRY..];
        colour::store(&d_colours[..n], RowLayout { stride: lanes, count }, to);
    }
}

/// Stores the first `count` lanes at every `stride`-th place.
#[inline(always)]
fn put<V: Vector>(v: V, (first, stride, count): (usize, usize, usize), to: &mut [V::Element]) {
    let mut tile = [V::Element::default(); LANES];
    v.store(&mut tile);
    for (to, v) in to[first..].iter_mut().step_by(stride).zip(&tile[..count]) {
        *to = *v;
    }
}

/// Gradients with respect to direction, scales and quaternion.
type Slopes<V> = ([V; 3], [V; 3], [V; 4]);

/// Gradients with respect to the raw row's geometry.
#[inline(always)]
fn geometry<V: Vector>(
    view: &View,
    (raw, pixel): (&[V; GEOMETRY], &Pixel<V>),
    (d_towards, d_scale, d_quat): Slopes<V>,
) -> [V; GEOMETRY] {
    let mut out = [V::constant(0.0); GEOMETRY];
    let mut slope = pixel.shares;
    for s in &mut slope {
        *s = *s * (V::constant(1.0) - *s);
    }
    let mut d_ray = d_towards;
    for (j, d) in d_ray.iter_mut().enumerate() {
        let [x, y, z] = &view.rotation;
        let column = [V::constant(x[j]), V::constant(y[j]), V::constant(z[j])];
        *d = dot(column, d_towards);
    }
    let along = dot(pixel.ray, d_ray);
    for i in 0..2 {
        let d_plane = (d_ray[i] - pixel.ray[i] * along) / pixel.length;
        out[i] = d_plane / V::constant(view.focal[i]) * slope[i];
    }
    for i in 0..3 {
        out[2 + i] = d_scale[i] * V::constant(view.scale[1]) * slope[2 + i];
    }
    let along = dot(pixel.quat, d_quat);
    let mut d_turned = d_quat;
    for (d, q) in d_turned.iter_mut().zip(pixel.quat) {
        *d = (*d - q * along) / pixel.turned_length;
    }
    let mut d_own = d_quat;
    for (d, row) in d_own.iter_mut().zip(&view.quat) {
        let row =
            [V::constant(row[0]), V::constant(row[1]), V::constant(row[2]), V::constant(row[3])];
        *d = dot(row, d_turned);
    }
    let q = [raw[5], raw[6], raw[7], raw[8]];
    let inverse = V::constant(1.0) / (pixel.raw_length + V::constant(QUAT_EPS));
    let along = dot(q, d_own) * inverse * inverse / pixel.raw_length;
    for i in 0..4 {
        out[5 + i] = d_own[i] * inverse - q[i] * along;
    }
    out
}

/// Computes gradients with respect to raw rows, distances and densities from those of rows
/// and SH.
pub fn backward<T: Real>(
    a: &Adapter,
    [raw, depths, densities]: [&[T]; 3],
    reached: Reached<'_, T>,
) -> Gradients<T> {
    let ([height, width], g, lanes) = (a.size, a.per_pixel, a.raw_lanes());
    let set = width * g * 3 * a.functions;
    let mut d_raw = vec![T::default(); raw.len()];
    let mut d_depths = vec![T::default(); depths.len()];
    let mut d_densities = vec![T::default(); densities.len()];
    d_raw
        .par_chunks_mut(width * lanes)
        .zip(d_depths.par_chunks_mut(width * g).zip(d_densities.par_chunks_mut(width * g)))
        .enumerate()
        .for_each(|(i, (d_raw, (d_depths, d_densities)))| {
            let rows = &reached.rows[i * width * g * SPLAT_STRIDE..][..width * g * SPLAT_STRIDE];
            let colours = reached.colours.map(|c| c.map(|c| &c[i * set..][..set]));
            T::dispatch(Backward {
                adapter: a,
                view: i / height,
                row: i % height,
                inputs: [
                    &raw[i * width * lanes..][..width * lanes],
                    &depths[i * width * g..][..width * g],
                    &densities[i * width * g..][..width * g],
                ],
                reached: Reached { rows, colours },
                d_raw,
                d_depths,
                d_densities,
            });
        });
    Gradients { raw: d_raw, depths: d_depths, densities: d_densities }
}
