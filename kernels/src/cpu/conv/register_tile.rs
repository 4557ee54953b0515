//! Register tiles of the forward direction: sums over source channels and taps.
//!
//! out[m][p] = bias[m] + Σ_c Σ_tap w[c][tap][m] · x[c·channel_stride + offset(tap) + p]
//!
//! m runs over up to [`BLOCK_CHANNELS`] destination channels, p over flat places. A register
//! tile holds M channels × N vectors of places; all products are summed into it before it is
//! stored once. Direct sums call this with the taps of a kernel, Winograd's algorithm with a
//! single tap (a matrix product of transformed tiles).

use crate::cpu::simd::{LANES, Simd, Vector};

/// Destination channels of a full block.
pub(super) const BLOCK_CHANNELS: usize = 8;

/// Destination channels `first..first + channels`, at most [`BLOCK_CHANNELS`].
#[derive(Clone, Copy, Debug)]
pub(super) struct ChannelBlock {
    pub first: usize,
    pub channels: usize,
}

/// Cuts `channels` destination channels into blocks.
pub(super) fn channel_blocks(channels: usize) -> Vec<ChannelBlock> {
    let block =
        |first: usize| ChannelBlock { first, channels: BLOCK_CHANNELS.min(channels - first) };
    (0..channels).step_by(BLOCK_CHANNELS).map(block).collect()
}

/// Operands of one strip of places for one block of destination channels.
#[derive(Clone, Copy)]
pub(super) struct Strip<'a> {
    /// Source, from the strip's first place on.
    pub x: &'a [f32],
    /// Distance of source channels in `x`.
    pub channel_stride: usize,
    /// Source channels.
    pub channels: usize,
    /// Offset of each tap, relative to an output's own place.
    pub offsets: &'a [usize],
    /// Weights `[source channel][tap][channel of the block]`.
    pub w: &'a [f32],
    /// Bias of each channel of the block.
    pub bias: [f32; BLOCK_CHANNELS],
    /// Places of the strip, a multiple of [`LANES`].
    pub length: usize,
}

/// Destination of a strip: channel m of the block begins at `at + m·stride`.
#[derive(Clone, Copy)]
pub(super) struct StripOutput {
    pub at: *mut f32,
    pub stride: usize,
}

impl Strip<'_> {
    /// Writes `[channel of the block][length]` sums of `channels` channels to `sums`.
    #[inline(always)]
    pub fn run<S: Simd>(&self, s: S, channels: usize, sums: &mut [f32]) {
        assert!(sums.len() >= channels * self.length);
        let to = StripOutput { at: sums.as_mut_ptr(), stride: self.length };
        // SAFETY: `sums` holds that many channels of `length` floats (just asserted).
        unsafe { self.run_to(s, channels, to) };
    }

    /// Writes the sums of `channels` channels to `to`.
    ///
    /// # Safety
    /// `to` has `length` writable floats for each of the channels, which no other thread
    /// accesses.
    #[inline(always)]
    pub unsafe fn run_to<S: Simd>(&self, s: S, channels: usize, to: StripOutput) {
        let farthest = self.offsets.iter().max().copied().unwrap_or(0) + self.length;
        assert!(self.channels.saturating_sub(1) * self.channel_stride + farthest <= self.x.len());
        assert!(self.length.is_multiple_of(LANES));
        assert!(self.w.len() >= self.channels * self.offsets.len() * channels);
        if S::REGISTERS >= 32 {
            match channels {
                8 => self.tiles::<S, 8, 8, 3, 2>(s, 0, to),
                7 => self.tiles::<S, 7, 7, 3, 2>(s, 0, to),
                6 => self.tiles::<S, 6, 6, 4, 2>(s, 0, to),
                5 => self.tiles::<S, 5, 5, 5, 2>(s, 0, to),
                4 => self.tiles::<S, 4, 4, 6, 3>(s, 0, to),
                3 => self.tiles::<S, 3, 3, 7, 3>(s, 0, to),
                2 => self.tiles::<S, 2, 2, 8, 3>(s, 0, to),
                _ => self.tiles::<S, 1, 1, 12, 3>(s, 0, to),
            }
        } else {
            match channels {
                // AVX2 has 16 registers, two a vector: twelve sums, then eight, are in flight.
                8 if S::REGISTERS >= 8 => {
                    self.tiles::<S, 8, 6, 1, 1>(s, 0, to);
                    self.tiles::<S, 8, 2, 2, 1>(s, 6, to);
                }
                7 if S::REGISTERS >= 8 => {
                    self.tiles::<S, 7, 5, 1, 1>(s, 0, to);
                    self.tiles::<S, 7, 2, 2, 1>(s, 5, to);
                }
                8 => {
                    self.tiles::<S, 8, 4, 1, 1>(s, 0, to);
                    self.tiles::<S, 8, 4, 1, 1>(s, 4, to);
                }
                7 => {
                    self.tiles::<S, 7, 4, 1, 1>(s, 0, to);
                    self.tiles::<S, 7, 3, 1, 1>(s, 4, to);
                }
                6 => self.tiles::<S, 6, 6, 1, 1>(s, 0, to),
                5 => self.tiles::<S, 5, 5, 1, 1>(s, 0, to),
                4 => self.tiles::<S, 4, 4, 1, 1>(s, 0, to),
                3 => self.tiles::<S, 3, 3, 2, 1>(s, 0, to),
                2 => self.tiles::<S, 2, 2, 2, 1>(s, 0, to),
                _ => self.tiles::<S, 1, 1, 4, 1>(s, 0, to),
            }
        }
    }

    /// Computes `M` channels, from channel `first` of a block of `P`, in register tiles of
    /// `A` vectors, then of `B`, then of one.
    #[inline(always)]
    fn tiles<S: Simd, const P: usize, const M: usize, const A: usize, const B: usize>(
        &self,
        s: S,
        first: usize,
        to: StripOutput,
    ) {
        let mut at = 0;
        while at < self.length {
            let left = (self.length - at) / LANES;
            // Four vectors as 2 + 2 are faster than as 3 + 1.
            if left >= A && (A, left) != (3, 4) {
                self.tile::<S, P, M, A>(s, first, at, to);
                at += A * LANES;
            } else if left >= B {
                self.tile::<S, P, M, B>(s, first, at, to);
                at += B * LANES;
            } else {
                self.tile::<S, P, M, 1>(s, first, at, to);
                at += LANES;
            }
        }
    }

    /// Computes one register tile of `M` channels × `N` vectors, from place `at` on.
    #[inline(always)]
    fn tile<S: Simd, const P: usize, const M: usize, const N: usize>(
        &self,
        s: S,
        first: usize,
        at: usize,
        to: StripOutput,
    ) {
        let mut acc = [[s.splat(0.0); N]; M];
        for m in 0..M {
            acc[m] = [s.splat(self.bias[first + m]); N];
        }
        let mut w = self.w.as_ptr().wrapping_add(first);
        let mut x = self.x.as_ptr().wrapping_add(at);
        for _ in 0..self.channels {
            for &offset in self.offsets {
                let from = x.wrapping_add(offset);
                let mut v = [s.splat(0.0); N];
                for n in 0..N {
                    // SAFETY: the farthest tap of the last channel ends inside `x`
                    // (asserted by `run_to`).
                    v[n] = s.load(unsafe { &*from.wrapping_add(n * LANES).cast() });
                }
                for m in 0..M {
                    // SAFETY: `w` holds P weights for every channel and tap (asserted by
                    // `run_to`), and first + M ≤ P.
                    let weight = s.splat(unsafe { *w.wrapping_add(m) });
                    for n in 0..N {
                        acc[m][n] = weight.fma(v[n], acc[m][n]);
                    }
                }
                w = w.wrapping_add(P);
            }
            x = x.wrapping_add(self.channel_stride);
        }
        for m in 0..M {
            let row = to.at.wrapping_add((first + m) * to.stride + at);
            for n in 0..N {
                // SAFETY: inside the channel's `length` floats (the contract of `run_to`).
                s.store(acc[m][n], unsafe { &mut *row.wrapping_add(n * LANES).cast() });
            }
        }
    }
}
