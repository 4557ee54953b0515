//! Attributes of parents for the embeddings, one pass per parent, with the gradient.
//!
//! Input: packed rows `[n, 11]` (offsets in [`crate::layout`]).   Output: `[n, 11]`, position 3,
//! scale 3, quaternion wxyz 4, opacity 1:
//! ```text
//! p = Rᵀ(μ − eye)              position p,   or  (clamp(x/z), clamp(y/z), ln z)
//! scale s,  or  ln s − ln z + ln f_x         z in the source view
//! quaternion conj(q_R) ⊗ q with w ≥ 0        opacity α,  or  ln α − ln(1 − α)
//! ```
//! Op: ops/attributes.rs. Reference in tensor operations: `model::embed::Embeddings::inputs`.

use super::simd::{Mask, Real, RowLayout, Vector, VectorKernel};
use crate::layout::{
    MEAN_OFFSET, MuInput, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};
use rayon::prelude::*;

/// A camera's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Rows of R, world from camera.
    pub rotation: [[f64; 3]; 3],
    /// Position of the eye, world units.
    pub position: [f64; 3],
    /// Rows of the matrix L with L·q = conj(q_R) ⊗ q, wxyz.
    pub turn: [[f64; 4]; 4],
}

/// Conversion of rows to attributes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attributes {
    /// Frame of positions and quaternions; `None`: the world.
    pub frame: Option<Frame>,
    /// The source view; its z normalises scales.
    pub source: Frame,
    /// f_x of the source view, px: scales become logarithms of pixels. `None`: unchanged.
    pub log_px: Option<f64>,
    /// Form of positions.
    pub position: MuInput,
    /// Opacities become logits, clipped to ± this. `None`: unchanged.
    pub logit: Option<f64>,
    /// Lower clamp of z in divisions and logarithms, world units.
    pub z_min: f64,
    /// Clamp of slopes.
    pub slope_max: f64,
    /// Lower clamp of σ in logarithms, world units.
    pub scale_min: f64,
}

/// Parents per task.
const BLOCK: usize = 256;

// Offsets in a row of the result.
const SCALE: usize = 3;
const QUAT: usize = 6;
const OPACITY: usize = 10;

/// μ − eye.
#[inline(always)]
fn centred<V: Vector>(frame: &Frame, row: &[V; SPLAT_STRIDE]) -> [V; 3] {
    let mut out = [row[MEAN_OFFSET], row[MEAN_OFFSET + 1], row[MEAN_OFFSET + 2]];
    for (v, o) in out.iter_mut().zip(frame.position) {
        *v = *v - V::constant(o);
    }
    out
}

/// Column `j` of R times v.
#[inline(always)]
fn along<V: Vector>(frame: &Frame, v: [V; 3], j: usize) -> V {
    let [x, y, z] = &frame.rotation;
    let two = V::constant(y[j]).fma(v[1], V::constant(x[j]) * v[0]);
    V::constant(z[j]).fma(v[2], two)
}

/// A position, its clamped z, and the slopes before the clamp.
struct Place<V> {
    own: [V; 3],
    z: V,
    slopes: [V; 2],
}

impl Attributes {
    #[inline(always)]
    fn place<V: Vector>(&self, row: &[V; SPLAT_STRIDE]) -> Place<V> {
        let own = match &self.frame {
            None => [row[MEAN_OFFSET], row[MEAN_OFFSET + 1], row[MEAN_OFFSET + 2]],
            Some(frame) => {
                let c = centred(frame, row);
                [along(frame, c, 0), along(frame, c, 1), along(frame, c, 2)]
            }
        };
        let z = own[2].max(V::constant(self.z_min));
        Place { own, z, slopes: [own[0] / z, own[1] / z] }
    }

    /// Quaternion in the frame, before its sign is fixed.
    #[inline(always)]
    fn quat<V: Vector>(&self, row: &[V; SPLAT_STRIDE]) -> [V; 4] {
        let q =
            [row[QUAT_OFFSET], row[QUAT_OFFSET + 1], row[QUAT_OFFSET + 2], row[QUAT_OFFSET + 3]];
        let Some(frame) = &self.frame else { return q };
        let mut out = q;
        for (v, line) in out.iter_mut().zip(&frame.turn) {
            *v = V::constant(line[0]) * q[0];
            for i in 1..4 {
                *v = V::constant(line[i]).fma(q[i], *v);
            }
        }
        out
    }

    /// Camera z in the source view, not clamped.
    #[inline(always)]
    fn depth<V: Vector>(&self, row: &[V; SPLAT_STRIDE]) -> V {
        along(&self.source, centred(&self.source, row), 2)
    }

    #[inline(always)]
    fn forward<V: Vector>(&self, row: &[V; SPLAT_STRIDE]) -> [V; SPLAT_STRIDE] {
        let mut out = [V::constant(0.0); SPLAT_STRIDE];
        let place = self.place(row);
        out[..3].copy_from_slice(&place.own);
        if self.position == MuInput::RayLogz {
            let most = V::constant(self.slope_max);
            for (to, slope) in out.iter_mut().zip(place.slopes) {
                *to = slope.max(-most).min(most);
            }
            out[2] = place.z.ln();
        }
        out[SCALE..QUAT].copy_from_slice(&row[SCALE_OFFSET..SCALE_OFFSET + 3]);
        if let Some(fx) = self.log_px {
            let z = self.depth(row).max(V::constant(self.z_min)).ln() - V::constant(fx.ln());
            for v in &mut out[SCALE..QUAT] {
                *v = v.max(V::constant(self.scale_min)).ln() - z;
            }
        }
        let quat = self.quat(row);
        let negative = quat[0].lt(V::constant(0.0));
        for (to, q) in out[QUAT..OPACITY].iter_mut().zip(quat) {
            *to = negative.select(-q, q);
        }
        out[OPACITY] = row[OPACITY_OFFSET];
        if let Some(most) = self.logit {
            let low = 1.0 / (1.0 + most.exp());
            let p = row[OPACITY_OFFSET].max(V::constant(low)).min(V::constant(1.0 - low));
            out[OPACITY] = p.ln() - (V::constant(1.0) - p).ln();
        }
        out
    }

    /// Gradient with respect to the row, from the gradient `d` of the result.
    #[inline(always)]
    fn backward<V: Vector>(
        &self,
        row: &[V; SPLAT_STRIDE],
        d: &[V; SPLAT_STRIDE],
    ) -> [V; SPLAT_STRIDE] {
        let zero = V::constant(0.0);
        let mut out = [zero; SPLAT_STRIDE];
        let mut d_own = [d[0], d[1], d[2]];
        if self.position == MuInput::RayLogz {
            let place = self.place(row);
            let most = V::constant(self.slope_max);
            let mut d_z = d[2];
            for i in 0..2 {
                let inside = place.slopes[i].abs().lt(most);
                let d_slope = inside.select_or_zero(d[i]);
                d_z = d_z - d_slope * place.slopes[i];
                d_own[i] = d_slope / place.z;
            }
            let free = V::constant(self.z_min).lt(place.own[2]);
            d_own[2] = free.select_or_zero(d_z / place.z);
        }
        for (i, to) in out[MEAN_OFFSET..MEAN_OFFSET + 3].iter_mut().enumerate() {
            *to = match &self.frame {
                None => d_own[i],
                Some(frame) => {
                    let r = frame.rotation[i];
                    V::constant(r[0]) * d_own[0]
                        + V::constant(r[1]) * d_own[1]
                        + V::constant(r[2]) * d_own[2]
                }
            };
        }
        out[SCALE_OFFSET..SCALE_OFFSET + 3].copy_from_slice(&d[SCALE..QUAT]);
        if self.log_px.is_some() {
            let depth = self.depth(row);
            let least = V::constant(self.z_min);
            let d_z = -(d[SCALE] + d[SCALE + 1] + d[SCALE + 2]) / depth.max(least);
            let d_z = least.lt(depth).select_or_zero(d_z);
            for i in 0..3 {
                let mean = &mut out[MEAN_OFFSET + i];
                *mean = V::constant(self.source.rotation[i][2]).fma(d_z, *mean);
                let s = row[SCALE_OFFSET + i];
                let least = V::constant(self.scale_min);
                let slope = d[SCALE + i] / s.max(least);
                out[SCALE_OFFSET + i] = least.lt(s).select_or_zero(slope);
            }
        }
        let negative = self.quat(row)[0].lt(zero);
        let mut d_quat = [d[QUAT], d[QUAT + 1], d[QUAT + 2], d[QUAT + 3]];
        for v in &mut d_quat {
            *v = negative.select(-*v, *v);
        }
        for (i, to) in out[QUAT_OFFSET..QUAT_OFFSET + 4].iter_mut().enumerate() {
            *to = d_quat[i];
            if let Some(frame) = &self.frame {
                *to = V::constant(frame.turn[0][i]) * d_quat[0];
                for (row, d) in frame.turn.iter().zip(d_quat).skip(1) {
                    *to = V::constant(row[i]).fma(d, *to);
                }
            }
        }
        out[OPACITY_OFFSET] = d[OPACITY];
        if let Some(most) = self.logit {
            let low = 1.0 / (1.0 + most.exp());
            let (p, low, high) = (row[OPACITY_OFFSET], V::constant(low), V::constant(1.0 - low));
            let held = p.max(low).min(high);
            let slope = d[OPACITY] / (held * (V::constant(1.0) - held));
            let inside = p.lt(high).select_or_zero(slope);
            out[OPACITY_OFFSET] = low.lt(p).select_or_zero(inside);
        }
        out
    }
}

/// One block of parents; `reached` holds the gradient of the result in the backward pass.
struct Block<'a, T> {
    attributes: &'a Attributes,
    rows: &'a [T],
    reached: Option<&'a [T]>,
    out: &'a mut [T],
}

impl<T: Real> VectorKernel<T> for Block<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector<Element = T>>(self) {
        let n = self.rows.len() / SPLAT_STRIDE;
        for first in (0..n).step_by(V::LANES) {
            let layout = RowLayout { stride: SPLAT_STRIDE, count: V::LANES.min(n - first) };
            let at = first * SPLAT_STRIDE;
            let row = V::load_rows(&self.rows[at..], layout);
            let out = match self.reached {
                None => self.attributes.forward(&row),
                Some(d) => self.attributes.backward(&row, &V::load_rows(&d[at..], layout)),
            };
            V::store_rows(&out, layout, &mut self.out[at..]);
        }
    }
}

/// Computes the attributes of `rows` into `out` (module documentation).
pub fn forward<T: Real>(attributes: &Attributes, rows: &[T], out: &mut [T]) {
    let size = BLOCK * SPLAT_STRIDE;
    rows.par_chunks(size).zip(out.par_chunks_mut(size)).for_each(|(rows, out)| {
        T::dispatch(Block { attributes, rows, reached: None, out });
    });
}

/// Computes the gradient with respect to `rows` into `out`, from the gradient `reached`
/// `[n, 11]` of the result.
pub fn backward<T: Real>(attributes: &Attributes, rows: &[T], reached: &[T], out: &mut [T]) {
    let size = BLOCK * SPLAT_STRIDE;
    let blocks = rows.par_chunks(size).zip(reached.par_chunks(size));
    blocks.zip(out.par_chunks_mut(size)).for_each(|((rows, reached), out)| {
        T::dispatch(Block { attributes, rows, reached: Some(reached), out });
    });
}
