//! Register tiles of the weight gradient: sums of outer products over outputs.
//!
//! sums[m][o] = Σ_r Σ_i x[offset(m) + r·x_row_stride + i] · dy[r][i][o]
//!
//! m runs over rows (channel × tap, or channels), o over output channels, which are the
//! lanes; x is read as scalars where it lies. Direct sums call this with a packed tile and
//! transposed gradients, Winograd's algorithm with transformed tiles of both.

use crate::cpu::simd::{LANES, Simd, Vector};

/// Rows of a register tile.
pub(super) const TILE_ROWS: usize = 8;
/// Maximum output channels of a register tile.
pub(super) const MAX_TILE_CHANNELS: usize = 3 * LANES;

/// Treatment of numbers that are already in the destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Store {
    /// They are overwritten.
    Overwrite,
    /// The sums are added to them.
    Add,
}

/// Operands of a register tile.
pub(super) struct OuterProducts<'a> {
    pub x: &'a [f32],
    /// Distance of rows of outputs in `x`.
    pub x_row_stride: usize,
    /// Gradients `[height][width][stride]`.
    pub dy: &'a [f32],
    /// Floats from output to output in `dy`, and from row to row of the sums: the output
    /// channels, rounded up to whole vectors, at most [`MAX_TILE_CHANNELS`].
    pub stride: usize,
    /// Rows of outputs.
    pub height: usize,
    /// Outputs of a row.
    pub width: usize,
}

impl OuterProducts<'_> {
    /// Computes `[M][stride]` sums of the first `M` rows of `offsets`; M is four or eight.
    #[inline(always)]
    pub fn run<S: Simd, const M: usize>(
        &self,
        s: S,
        offsets: &[usize; TILE_ROWS],
        store: Store,
        sums: &mut [f32],
    ) {
        let farthest = offsets.iter().max().copied().unwrap_or(0) + self.width;
        assert!(farthest + self.height.saturating_sub(1) * self.x_row_stride <= self.x.len());
        assert!(self.dy.len() >= self.height * self.width * self.stride);
        assert!(sums.len() >= M * self.stride);
        if S::REGISTERS >= 32 {
            match self.stride / LANES {
                3 => self.tile::<S, M, 3>(s, offsets, 0, 0, store, sums),
                2 => self.tile::<S, M, 2>(s, offsets, 0, 0, store, sums),
                _ => self.tile::<S, M, 1>(s, offsets, 0, 0, store, sums),
            }
        } else if S::REGISTERS >= 8 && M > 4 {
            // As in the forward direction: twelve sums in flight, then eight.
            for channel in (0..self.stride).step_by(LANES) {
                self.tile::<S, 6, 1>(s, offsets, 0, channel, store, sums);
            }
            let pairs = self.stride / (2 * LANES) * 2 * LANES;
            for channel in (0..pairs).step_by(2 * LANES) {
                self.tile::<S, 2, 2>(s, offsets, 6, channel, store, sums);
            }
            if pairs < self.stride {
                self.tile::<S, 2, 1>(s, offsets, 6, pairs, store, sums);
            }
        } else {
            for channel in (0..self.stride).step_by(LANES) {
                self.tile::<S, 4, 1>(s, offsets, 0, channel, store, sums);
                if M > 4 {
                    self.tile::<S, 4, 1>(s, offsets, 4, channel, store, sums);
                }
            }
        }
    }

    /// Computes `M` rows from `first` on × `N` vectors from output channel `channel` on.
    #[inline(always)]
    fn tile<S: Simd, const M: usize, const N: usize>(
        &self,
        s: S,
        offsets: &[usize; TILE_ROWS],
        first: usize,
        channel: usize,
        store: Store,
        sums: &mut [f32],
    ) {
        let mut acc = [[s.splat(0.0); N]; M];
        let mut dy = self.dy.as_ptr().wrapping_add(channel);
        for r in 0..self.height {
            let mut x = [self.x.as_ptr(); M];
            for m in 0..M {
                x[m] = self.x.as_ptr().wrapping_add(offsets[first + m] + r * self.x_row_stride);
            }
            for i in 0..self.width {
                let mut v = [s.splat(0.0); N];
                for n in 0..N {
                    // SAFETY: `dy` has height·width·stride floats (asserted by `run`).
                    v[n] = s.load(unsafe { &*dy.wrapping_add(n * LANES).cast() });
                }
                for m in 0..M {
                    // SAFETY: the farthest row ends inside `x` (asserted by `run`).
                    let x = s.splat(unsafe { *x[m].wrapping_add(i) });
                    for n in 0..N {
                        acc[m][n] = x.fma(v[n], acc[m][n]);
                    }
                }
                dy = dy.wrapping_add(self.stride);
            }
        }
        for m in 0..M {
            let row = &mut sums[(first + m) * self.stride + channel..][..N * LANES];
            for (to, v) in row.as_chunks_mut().0.iter_mut().zip(acc[m]) {
                // Adding short sums to a total loses less precision than one long sum.
                let v = if store == Store::Add { s.load(to) + v } else { v };
                s.store(v, to);
            }
        }
    }
}
