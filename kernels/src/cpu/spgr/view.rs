//! 3-D vector algebra in lanes, the primary view, and the guarded Jacobian with its gradient.

use super::{Rules, Source};
use crate::camera::Camera;
use crate::cpu::simd::{LANES, Mask, Real, Vector};
use crate::layout::{FRUSTUM_MARGIN, PrimaryView, VISIBLE_Z_MIN};

pub(super) type V3<V> = [V; 3];
pub(super) type M3<V> = [[V; 3]; 3];

#[inline(always)]
pub(super) fn dot<V: Vector>(a: V3<V>, b: V3<V>) -> V {
    a[2].fma(b[2], a[1].fma(b[1], a[0] * b[0]))
}

#[inline(always)]
pub(super) fn cross<V: Vector>(a: V3<V>, b: V3<V>) -> V3<V> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(super) fn add<V: Vector>(a: V3<V>, b: V3<V>) -> V3<V> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(super) fn scaled<V: Vector>(a: V3<V>, s: V) -> V3<V> {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// Applies `f` to each element. Compilers do not always inline `array::map` and `from_fn`,
/// and build calls without the level's vectors.
#[inline(always)]
pub(super) fn each<A: Copy, const N: usize>(mut a: [A; N], f: impl Fn(A) -> A) -> [A; N] {
    for v in &mut a {
        *v = f(*v);
    }
    a
}

/// Returns `f` of each index below `N`; `start` initialises the array.
#[inline(always)]
pub(super) fn indexed<A: Copy, const N: usize>(start: A, f: impl Fn(usize) -> A) -> [A; N] {
    let mut out = [start; N];
    for (i, v) in out.iter_mut().enumerate() {
        *v = f(i);
    }
    out
}

/// a + b.
#[inline(always)]
pub(super) fn add4<V: Vector>(a: [V; 4], b: [V; 4]) -> [V; 4] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]]
}

/// Puts each scalar into every lane of a vector.
#[inline(always)]
pub(super) fn splat<V: Vector, const N: usize>(from: &[V::Element; N]) -> [V; N] {
    indexed(
        V::constant(0.0),
        #[inline(always)]
        |i| V::splat(from[i]),
    )
}

/// Loads each row of a tile as a vector.
#[inline(always)]
pub(super) fn load<V: Vector, const N: usize>(tile: &[[V::Element; LANES]; N]) -> [V; N] {
    indexed(
        V::constant(0.0),
        #[inline(always)]
        |i| V::load(&tile[i]),
    )
}

/// a ⊙ b.
#[inline(always)]
pub(super) fn product<V: Vector>(a: V3<V>, b: V3<V>) -> V3<V> {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

/// s·a + b.
#[inline(always)]
pub(super) fn axpy<V: Vector>(s: V, a: V3<V>, b: V3<V>) -> V3<V> {
    [s.fma(a[0], b[0]), s.fma(a[1], b[1]), s.fma(a[2], b[2])]
}

/// M·v.
#[inline(always)]
pub(super) fn times<V: Vector>(m: &M3<V>, v: V3<V>) -> V3<V> {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// Mᵀ·v.
#[inline(always)]
pub(super) fn transposed<V: Vector>(m: &M3<V>, v: V3<V>) -> V3<V> {
    axpy(v[2], m[2], axpy(v[1], m[1], scaled(m[0], v[0])))
}

/// Numbers of one context camera.
const FIELDS: usize = 23;

/// The context cameras as numbers of the kernel's type.
pub(super) struct Table<T> {
    cameras: Vec<[T; FIELDS]>,
}

impl<T: Real> Table<T> {
    pub(super) fn new(source: &Source) -> Self {
        let pairs = source.cameras.iter().zip(source.near);
        Self { cameras: pairs.map(|(camera, &near)| Self::row(camera, near)).collect() }
    }

    fn row(camera: &Camera, near: f32) -> [T; FIELDS] {
        let k = camera.intrinsics;
        let focal = [f64::from(k.fx), f64::from(k.fy)];
        let centre = [f64::from(k.cx), f64::from(k.cy)];
        let size = [k.width as f64, k.height as f64];
        let margin = |i: usize| FRUSTUM_MARGIN * 0.5 * size[i] / focal[i];
        let mut row = [0.0; FIELDS];
        let r = camera.rotation();
        for i in 0..3 {
            row[3 * i..3 * i + 3].copy_from_slice(&r.row(i).to_array().map(f64::from));
        }
        row[9..12].copy_from_slice(&camera.position().to_array().map(f64::from));
        for i in 0..2 {
            row[12 + i] = focal[i];
            row[14 + i] = centre[i];
            row[16 + i] = size[i];
            row[19 + i] = -centre[i] / focal[i] - margin(i);
            row[21 + i] = (size[i] - centre[i]) / focal[i] + margin(i);
        }
        row[18] = (0.01 * f64::from(near)).max(1e-3);
        row.map(T::constant)
    }

    pub(super) fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Loads the view of every lane.
    #[inline(always)]
    pub(super) fn views<V: Vector<Element = T>>(&self, index: &[usize; LANES]) -> View<V> {
        let lanes = &index[..V::LANES];
        if lanes.iter().all(|&v| v == lanes[0]) {
            return View::new(splat(&self.cameras[lanes[0]]));
        }
        let mut tile = [[T::default(); LANES]; FIELDS];
        for (lane, &v) in lanes.iter().enumerate() {
            for (tile, &v) in tile.iter_mut().zip(&self.cameras[v]) {
                tile[lane] = v;
            }
        }
        View::new(load(&tile))
    }

    /// Loads v* of every lane (module documentation of [`super`]).
    #[inline(always)]
    pub(super) fn primary<V: Vector<Element = T>>(
        &self,
        rules: &Rules,
        mean: V3<V>,
        source: [usize; LANES],
    ) -> View<V> {
        if rules.primary_view == PrimaryView::Source || self.len() == 1 {
            return self.views(&source);
        }
        let mut nearest = V::constant(f64::INFINITY);
        let mut best = V::constant(-1.0);
        for (v, camera) in self.cameras.iter().enumerate() {
            let view = View::new(splat(camera));
            let p = view.seen_from(mean);
            let closer = view.sees(p, p[2].lt(nearest));
            nearest = closer.select(p[2], nearest);
            best = closer.select(V::constant(v as f64), best);
        }
        let mut lanes = [T::default(); LANES];
        best.store(&mut lanes);
        let mut index = source;
        for (index, best) in index[..V::LANES].iter_mut().zip(lanes) {
            let best = best.to_f64();
            if best >= 0.0 {
                *index = best as usize;
            }
        }
        self.views(&index)
    }
}

/// One context camera in every lane.
#[derive(Clone, Copy)]
pub(super) struct View<V> {
    /// Rows of R, world from camera.
    pub(super) rotation: M3<V>,
    position: V3<V>,
    pub(super) focal: [V; 2],
    centre: [V; 2],
    size: [V; 2],
    /// Lower clamp of camera z in divisions.
    pub(super) z_min: V,
    /// Clamps of x/z and y/z in the Jacobian.
    low: [V; 2],
    high: [V; 2],
}

impl<V: Vector> View<V> {
    #[inline(always)]
    fn new(f: [V; FIELDS]) -> Self {
        Self {
            rotation: [[f[0], f[1], f[2]], [f[3], f[4], f[5]], [f[6], f[7], f[8]]],
            position: [f[9], f[10], f[11]],
            focal: [f[12], f[13]],
            centre: [f[14], f[15]],
            size: [f[16], f[17]],
            z_min: f[18],
            low: [f[19], f[20]],
            high: [f[21], f[22]],
        }
    }

    #[inline(always)]
    pub(super) fn seen_from(&self, p: V3<V>) -> V3<V> {
        let o = self.position;
        transposed(&self.rotation, [p[0] - o[0], p[1] - o[1], p[2] - o[2]])
    }

    /// Lanes of `also` whose point is in front of the camera and inside the picture.
    #[inline(always)]
    fn sees(&self, p: V3<V>, also: V::Mask) -> V::Mask {
        let mut seen = also & V::constant(VISIBLE_Z_MIN).lt(p[2]);
        for i in 0..2 {
            let u = self.focal[i] * p[i] / p[2] + self.centre[i];
            seen = seen & V::constant(0.0).lt(u) & u.lt(self.size[i]);
        }
        seen
    }
}

/// J·R_w2c, J the Jacobian of the projection with the guards of the rasterizer, px per
/// world unit.
pub(super) struct Jacobian<V: Vector> {
    /// Two rows.
    pub(super) jw: [V3<V>; 2],
    focal: [V; 2],
    raw: [V; 2],
    inverse_z: V,
    /// Axis in world: the third column of R.
    axis: V3<V>,
    /// Lanes whose depth and slopes no guard clamps.
    free_z: V::Mask,
    free: [[V::Mask; 2]; 2],
}

impl<V: Vector> Jacobian<V> {
    /// Computes the Jacobian at camera point `p`, for pixels `zoom` times finer than the
    /// view's.
    #[inline(always)]
    pub(super) fn new(view: &View<V>, p: V3<V>, zoom: V) -> Self {
        let r = &view.rotation;
        let inverse_z = V::constant(1.0) / p[2].max(view.z_min);
        let axis = [r[0][2], r[1][2], r[2][2]];
        let raw = [p[0] * inverse_z, p[1] * inverse_z];
        let slope =
            [raw[0].max(view.low[0]).min(view.high[0]), raw[1].max(view.low[1]).min(view.high[1])];
        let focal = [zoom * view.focal[0] * inverse_z, zoom * view.focal[1] * inverse_z];
        let mut jw = [axis; 2];
        for (i, row) in jw.iter_mut().enumerate() {
            let side = [r[0][i], r[1][i], r[2][i]];
            *row = scaled(axpy(-slope[i], axis, side), focal[i]);
        }
        let inside = |i: usize| [view.low[i].lt(raw[i]), raw[i].lt(view.high[i])];
        Self {
            jw,
            focal,
            raw,
            inverse_z,
            axis,
            free_z: view.z_min.lt(p[2]),
            free: [inside(0), inside(1)],
        }
    }

    /// ∂/∂p for the gradient of the two rows.
    #[inline(always)]
    pub(super) fn backward(&self, d: &[V3<V>; 2]) -> V3<V> {
        let mut d_z = V::constant(0.0);
        let mut d_p = [d_z; 3];
        for i in 0..2 {
            let [above, below] = self.free[i];
            let d_slope = (above & below).select_or_zero(-self.focal[i] * dot(d[i], self.axis));
            d_p[i] = d_slope * self.inverse_z;
            d_z = d_z - dot(d[i], self.jw[i]) - d_slope * self.raw[i];
        }
        d_p[2] = self.free_z.select_or_zero(d_z * self.inverse_z);
        d_p
    }
}
