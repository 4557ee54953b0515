//! Attributes of parents as the embeddings read them, one pass per parent, with the
//! gradient (spec 1.1).
//!
//! In: packed rows `[n, 11]` (lanes in [`crate::abi`]).   Out: `[n, 11]`, position 3,
//! scale 3, quaternion wxyz 4, opacity 1:
//! ```text
//! p = Rᵀ(μ − eye)              position p,   or  (clamp(x/z), clamp(y/z), ln z)
//! scale s,  or  ln s − ln z + ln f_x         z in the source view
//! quaternion conj(q_R) ⊗ q with w ≥ 0        opacity α,  or  ln α − ln(1 − α)
//! ```
//! Twin: ops/attributes.rs. The same in tensor operations:
//! `model::embed::Embeddings::inputs`.

use super::lanes::{Kernel, LaneReal, Lanes, Machine};
use crate::abi::{MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};
use rayon::prelude::*;

/// A camera's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Rows of R, world from camera.
    pub rotation: [[f64; 3]; 3],
    /// The eye, world.
    pub position: [f64; 3],
    /// Rows of the matrix L with L·q = conj(q_R) ⊗ q, wxyz.
    pub turn: [[f64; 4]; 4],
}

/// What is made of the rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attributes {
    /// Where positions and quaternions are told; `None`: the world.
    pub frame: Option<Frame>,
    /// The source view, whose z scales are measured by.
    pub source: Frame,
    /// f_x of the source view, px: scales as logarithms of pixels; `None`: as they are.
    pub log_px: Option<f64>,
    /// Positions as slopes and ln z.
    pub ray: bool,
    /// Opacities as logits, clipped to ± this; `None`: as they are.
    pub logit: Option<f64>,
    /// Least z that is divided by or a logarithm taken of, world units.
    pub z_min: f64,
    /// Bound of slopes.
    pub slope_max: f64,
    /// Least σ of which a logarithm is taken, world units.
    pub scale_min: f64,
}

/// Parents per task.
const BLOCK: usize = 256;

/// Lanes of the result.
const SCALE: usize = 3;
const QUAT: usize = 6;
const OPACITY: usize = 10;

/// μ − eye.
#[inline(always)]
fn centred<M: Machine>(m: M, frame: &Frame, row: &[M::V; SPLAT_STRIDE]) -> [M::V; 3] {
    let mut out = [row[MEAN_OFFSET], row[MEAN_OFFSET + 1], row[MEAN_OFFSET + 2]];
    for (v, o) in out.iter_mut().zip(frame.position) {
        *v = *v - m.of(o);
    }
    out
}

/// Column `j` of R times v.
#[inline(always)]
fn along<M: Machine>(m: M, frame: &Frame, v: [M::V; 3], j: usize) -> M::V {
    let [x, y, z] = &frame.rotation;
    let two = m.of(y[j]).fma(v[1], m.of(x[j]) * v[0]);
    m.of(z[j]).fma(v[2], two)
}

/// A position, its z bounded below, and the slopes before they are clamped.
struct Place<V> {
    own: [V; 3],
    z: V,
    slopes: [V; 2],
}

impl Attributes {
    #[inline(always)]
    fn place<M: Machine>(&self, m: M, row: &[M::V; SPLAT_STRIDE]) -> Place<M::V> {
        let own = match &self.frame {
            None => [row[MEAN_OFFSET], row[MEAN_OFFSET + 1], row[MEAN_OFFSET + 2]],
            Some(frame) => {
                let c = centred(m, frame, row);
                [along(m, frame, c, 0), along(m, frame, c, 1), along(m, frame, c, 2)]
            }
        };
        let z = own[2].max(m.of(self.z_min));
        Place { own, z, slopes: [own[0] / z, own[1] / z] }
    }

    /// Quaternion in the frame, before its sign.
    #[inline(always)]
    fn quat<M: Machine>(&self, m: M, row: &[M::V; SPLAT_STRIDE]) -> [M::V; 4] {
        let q =
            [row[QUAT_OFFSET], row[QUAT_OFFSET + 1], row[QUAT_OFFSET + 2], row[QUAT_OFFSET + 3]];
        let Some(frame) = &self.frame else { return q };
        let mut out = q;
        for (v, line) in out.iter_mut().zip(&frame.turn) {
            *v = m.of(line[0]) * q[0];
            for i in 1..4 {
                *v = m.of(line[i]).fma(q[i], *v);
            }
        }
        out
    }

    /// Camera z in the source view, not bounded.
    #[inline(always)]
    fn depth<M: Machine>(&self, m: M, row: &[M::V; SPLAT_STRIDE]) -> M::V {
        along(m, &self.source, centred(m, &self.source, row), 2)
    }

    #[inline(always)]
    fn forward<M: Machine>(&self, m: M, row: &[M::V; SPLAT_STRIDE]) -> [M::V; SPLAT_STRIDE] {
        let mut out = [m.of(0.0); SPLAT_STRIDE];
        let place = self.place(m, row);
        out[..3].copy_from_slice(&place.own);
        if self.ray {
            let most = m.of(self.slope_max);
            for (to, slope) in out.iter_mut().zip(place.slopes) {
                *to = slope.max(-most).min(most);
            }
            out[2] = place.z.ln();
        }
        out[SCALE..QUAT].copy_from_slice(&row[SCALE_OFFSET..SCALE_OFFSET + 3]);
        if let Some(fx) = self.log_px {
            let z = self.depth(m, row).max(m.of(self.z_min)).ln() - m.of(fx.ln());
            for v in &mut out[SCALE..QUAT] {
                *v = v.max(m.of(self.scale_min)).ln() - z;
            }
        }
        let quat = self.quat(m, row);
        let negative = quat[0].lt(m.of(0.0));
        for (to, q) in out[QUAT..OPACITY].iter_mut().zip(quat) {
            *to = M::V::select(negative, -q, q);
        }
        out[OPACITY] = row[OPACITY_OFFSET];
        if let Some(most) = self.logit {
            let low = 1.0 / (1.0 + most.exp());
            let p = row[OPACITY_OFFSET].max(m.of(low)).min(m.of(1.0 - low));
            out[OPACITY] = p.ln() - (m.of(1.0) - p).ln();
        }
        out
    }

    /// By the row, for what reached the result.
    #[inline(always)]
    fn backward<M: Machine>(
        &self,
        m: M,
        row: &[M::V; SPLAT_STRIDE],
        d: &[M::V; SPLAT_STRIDE],
    ) -> [M::V; SPLAT_STRIDE] {
        let zero = m.of(0.0);
        let mut out = [zero; SPLAT_STRIDE];
        let mut d_own = [d[0], d[1], d[2]];
        if self.ray {
            let place = self.place(m, row);
            let most = m.of(self.slope_max);
            let mut d_z = d[2];
            for i in 0..2 {
                let inside = place.slopes[i].abs().lt(most);
                let d_slope = M::V::select(inside, d[i], zero);
                d_z = d_z - d_slope * place.slopes[i];
                d_own[i] = d_slope / place.z;
            }
            let free = m.of(self.z_min).lt(place.own[2]);
            d_own[2] = M::V::select(free, d_z / place.z, zero);
        }
        for (i, to) in out[MEAN_OFFSET..MEAN_OFFSET + 3].iter_mut().enumerate() {
            *to = match &self.frame {
                None => d_own[i],
                Some(frame) => {
                    let r = frame.rotation[i];
                    m.of(r[0]) * d_own[0] + m.of(r[1]) * d_own[1] + m.of(r[2]) * d_own[2]
                }
            };
        }
        out[SCALE_OFFSET..SCALE_OFFSET + 3].copy_from_slice(&d[SCALE..QUAT]);
        if self.log_px.is_some() {
            let depth = self.depth(m, row);
            let least = m.of(self.z_min);
            let d_z = -(d[SCALE] + d[SCALE + 1] + d[SCALE + 2]) / depth.max(least);
            let d_z = M::V::select(least.lt(depth), d_z, zero);
            for i in 0..3 {
                let mean = &mut out[MEAN_OFFSET + i];
                *mean = m.of(self.source.rotation[i][2]).fma(d_z, *mean);
                let (s, least) = (row[SCALE_OFFSET + i], m.of(self.scale_min));
                let slope = d[SCALE + i] / s.max(least);
                out[SCALE_OFFSET + i] = M::V::select(least.lt(s), slope, zero);
            }
        }
        let negative = self.quat(m, row)[0].lt(zero);
        let mut d_quat = [d[QUAT], d[QUAT + 1], d[QUAT + 2], d[QUAT + 3]];
        for v in &mut d_quat {
            *v = M::V::select(negative, -*v, *v);
        }
        for (i, to) in out[QUAT_OFFSET..QUAT_OFFSET + 4].iter_mut().enumerate() {
            *to = d_quat[i];
            if let Some(frame) = &self.frame {
                *to = m.of(frame.turn[0][i]) * d_quat[0];
                for (row, d) in frame.turn.iter().zip(d_quat).skip(1) {
                    *to = m.of(row[i]).fma(d, *to);
                }
            }
        }
        out[OPACITY_OFFSET] = d[OPACITY];
        if let Some(most) = self.logit {
            let low = 1.0 / (1.0 + most.exp());
            let (p, low, high) = (row[OPACITY_OFFSET], m.of(low), m.of(1.0 - low));
            let held = p.max(low).min(high);
            let slope = d[OPACITY] / (held * (m.of(1.0) - held));
            let inside = M::V::select(p.lt(high), slope, zero);
            out[OPACITY_OFFSET] = M::V::select(low.lt(p), inside, zero);
        }
        out
    }
}

/// One block of parents; `reached` is what came back, for the gradient.
struct Block<'a, T> {
    attributes: &'a Attributes,
    rows: &'a [T],
    reached: Option<&'a [T]>,
    out: &'a mut [T],
}

impl<T: LaneReal> Kernel<T> for Block<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<M: Machine<Scalar = T>>(self, m: M) {
        let n = self.rows.len() / SPLAT_STRIDE;
        for first in (0..n).step_by(M::WIDTH) {
            let span = (SPLAT_STRIDE, M::WIDTH.min(n - first));
            let at = first * SPLAT_STRIDE;
            let row = m.load_rows(&self.rows[at..], span);
            let out = match self.reached {
                None => self.attributes.forward(m, &row),
                Some(d) => self.attributes.backward(m, &row, &m.load_rows(&d[at..], span)),
            };
            m.store_rows(&out, span, &mut self.out[at..]);
        }
    }
}

/// Attributes of `rows` into `out` (module doc).
pub fn forward<T: LaneReal>(attributes: &Attributes, rows: &[T], out: &mut [T]) {
    let size = BLOCK * SPLAT_STRIDE;
    rows.par_chunks(size).zip(out.par_chunks_mut(size)).for_each(|(rows, out)| {
        T::dispatch(Block { attributes, rows, reached: None, out });
    });
}

/// The gradient by `rows` into `out`, for `reached` `[n, 11]`.
pub fn backward<T: LaneReal>(attributes: &Attributes, rows: &[T], reached: &[T], out: &mut [T]) {
    let size = BLOCK * SPLAT_STRIDE;
    let blocks = rows.par_chunks(size).zip(reached.par_chunks(size));
    blocks.zip(out.par_chunks_mut(size)).for_each(|((rows, reached), out)| {
        T::dispatch(Block { attributes, rows, reached: Some(reached), out });
    });
}
