//! Transformed kernels: G·g·Gᵀ.

use super::kind::{Kind, TransformTask};
use super::product_layout::GROUPS;
use super::transforms::{Transform, WEIGHTS};
use crate::cpu::conv::algorithm::ConvolveArgs;
use crate::cpu::conv::plan::{Direction, Plan};
use crate::cpu::conv::register_tile::{BLOCK_CHANNELS, ChannelBlock, channel_blocks};
use crate::cpu::simd::{Kernel, LANES, Simd};
use crate::cpu::uninit::grown;
use rayon::prelude::*;

/// Taps of a 3×3 kernel.
pub(super) const TAPS: usize = 9;
/// Source channels between the kernel that is transformed and the one that is prefetched.
const PREFETCH_CHANNELS: usize = 8;

/// Returns the floats from group to group of the weights of a block. Sixteen more than a
/// group has keep the distance off powers of two, where all groups would share one cache set.
pub(super) fn group_stride(channels: usize) -> usize {
    channels * BLOCK_CHANNELS + LANES
}

/// The weights of all blocks of destination channels: for each block
/// `[group][source channel][channel of the block]`, groups [`group_stride`] apart.
pub(super) struct TransformedWeights {
    pub data: Vec<f32>,
    pub blocks: Vec<ChannelBlock>,
}

impl TransformedWeights {
    /// Transforms the weights of a call; `data` provides the memory.
    pub fn new(args: &ConvolveArgs<'_>, kind: Kind, mut data: Vec<f32>) -> Self {
        let &ConvolveArgs { level, plan, w, .. } = args;
        let blocks = channel_blocks(plan.dst_channels);
        let floats = GROUPS * group_stride(plan.src_channels);
        grown(&mut data, blocks.len() * floats)
            .par_chunks_exact_mut(floats)
            .zip(&blocks)
            .for_each(|(panel, block)| level.run(TransformWeights { plan, kind, w, block, panel }));
        Self { data, blocks }
    }
}

/// Transforms the weights of one block of destination channels.
pub(super) struct TransformWeights<'a> {
    pub plan: &'a Plan,
    pub kind: Kind,
    pub w: &'a [f32],
    pub block: &'a ChannelBlock,
    /// `[group][source channel][channel of the block]`.
    pub panel: &'a mut [f32],
}

impl Kernel for TransformWeights<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.kind.run(WithSimd(s, self));
    }
}

/// A task that already runs at a SIMD level.
struct WithSimd<S, T>(S, T);

impl<S: Simd> TransformTask for WithSimd<S, TransformWeights<'_>> {
    #[inline(always)]
    fn run<T, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        T: Transform<IN, POINTS, OUT>,
    {
        let Self(s, TransformWeights { plan, w, block, panel, .. }) = self;
        let channels = plan.src_channels;
        let ahead = PREFETCH_CHANNELS
            * TAPS
            * match plan.direction {
                Direction::Forward => 1,
                Direction::InputGrad => plan.dst_channels,
            };
        // The lanes are two source channels, each with the channels of the block.
        for first in (0..channels).step_by(2) {
            let mut kernels = [s.splat(0.0); LANES];
            for lane in 0..LANES {
                let src = first + lane / BLOCK_CHANNELS;
                let m = lane % BLOCK_CHANNELS;
                if src >= channels || m >= block.channels {
                    continue;
                }
                let taps = &w[plan.kernel_index(src, block.first + m) * TAPS..][..TAPS];
                s.prefetch(taps.as_ptr().wrapping_add(ahead));
                // SAFETY: `taps` has nine floats, the mask nine bits.
                kernels[lane] = unsafe { s.load_masked(taps.as_ptr(), 0x1ff) };
            }
            let taps = s.transpose(kernels);
            let mut half = [[s.splat(0.0); 3]; WEIGHTS];
            for x in 0..3 {
                let column = match plan.direction {
                    Direction::Forward => [taps[x], taps[3 + x], taps[6 + x]],
                    // The input gradient uses the kernel mirrored along both axes.
                    Direction::InputGrad => [taps[8 - x], taps[5 - x], taps[2 - x]],
                };
                let column = T::weights(s, column);
                for i in 0..WEIGHTS {
                    half[i][x] = column[i];
                }
            }
            for i in 0..WEIGHTS {
                let row = T::weights(s, half[i]);
                for j in 0..WEIGHTS {
                    let group = (i * WEIGHTS + j) * group_stride(channels);
                    let to = &mut panel[group + first * block.channels..];
                    // A second channel beyond the last falls into the gap between groups.
                    if block.channels == BLOCK_CHANNELS
                        && let Some(to) = to.first_chunk_mut()
                    {
                        s.store(row[j], to);
                        continue;
                    }
                    let mut both = [0.0; LANES];
                    s.store(row[j], &mut both);
                    let to = to.chunks_exact_mut(block.channels).take(channels - first);
                    for (to, from) in to.zip(both.chunks_exact(BLOCK_CHANNELS)) {
                        to.copy_from_slice(&from[..block.channels]);
                    }
                }
            }
        }
    }
}
