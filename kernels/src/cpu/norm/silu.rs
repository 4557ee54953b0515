//! SiLU of normalised rows: v / (1 + e^{−v}) in vectors, with fused products.

use super::Rows;
use crate::cpu::simd::elementary::exp2_by_sums;
use crate::cpu::simd::{Kernel, LANES, Simd, Vector, first_lanes_bits};
use crate::cpu::uninit::UninitSlice;

/// Rows from number `first` on.
pub(super) struct Silu<'a> {
    pub rows: &'a Rows,
    pub first: usize,
    pub x: &'a [f32],
    pub y: &'a mut UninitSlice<f32>,
    /// Scales and shifts `[channels]`, or empty.
    pub affine: [&'a [f32]; 2],
}

impl Kernel for Silu<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { rows, first, x, y, affine: [w, b] } = self;
        assert_eq!(x.len(), y.len(), "normalisation: lengths");
        let pairs = x.chunks_exact(rows.len).zip(y.chunks_exact_mut(rows.len));
        for (r, (x, y)) in pairs.enumerate() {
            let (mean, inverse) = rows.moments(x);
            let channel = rows.channel(first + r);
            let runs = x.chunks_exact(rows.run).zip(y.chunks_exact_mut(rows.run));
            for (c, (x, y)) in runs.enumerate() {
                let at = |of: &[f32], none: f32| of.get(channel + c).copied().unwrap_or(none);
                let line = Line { mean, scale: inverse * at(w, 1.0), shift: at(b, 0.0) };
                line.run(s, x, y);
            }
        }
    }
}

/// Mean, scale and shift of one channel of a row.
struct Line {
    mean: f32,
    scale: f32,
    shift: f32,
}

impl Line {
    #[inline(always)]
    fn run<S: Simd>(&self, s: S, x: &[f32], y: &mut UninitSlice<f32>) {
        let (sources, last) = x.as_chunks::<LANES>();
        let (places, rest) = y.as_chunks_mut::<LANES>();
        for (y, x) in places.iter_mut().zip(sources) {
            s.store_uninit(self.of(s, s.load(x)), y);
        }
        assert_eq!(last.len(), rest.len(), "normalisation: lengths");
        if last.is_empty() {
            return;
        }
        let bits = first_lanes_bits(last.len());
        // SAFETY: `bits` selects the floats of `last` and the places of `rest`, as many.
        unsafe {
            s.store_masked(self.of(s, s.load_masked(last.as_ptr(), bits)), rest.as_mut_ptr(), bits)
        };
    }

    #[inline(always)]
    fn of<S: Simd>(&self, s: S, x: S::F) -> S::F {
        let v = (x - s.splat(self.mean)).fma(s.splat(self.scale), s.splat(self.shift));
        // NaN stays. One product is enough here: the result's error is below 1e-6.
        let p = (v * s.splat(-std::f32::consts::LOG2_E)).max(s.splat(-125.0));
        v / (s.splat(1.0) + exp2_by_sums(p.min(s.splat(126.0))))
    }
}
