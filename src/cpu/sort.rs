//! Front-to-back order of the visible splats: a stable radix sort of depth bits.
//!
//! Camera z is positive, so its bits as an integer sort as the number does. Three
//! passes of 11 bits, each a count per chunk, a prefix sum over (digit, chunk) and
//! a scatter; equal depths keep the splats' order. The result is one fixed
//! permutation, so neither threads nor chunks can change a picture.
//!
//! The scatter writes from many threads to slots that the prefix sum made
//! disjoint; relaxed atomic stores express that without `unsafe` and compile to
//! plain ones.

use crate::cpu::ewa::Footprint;
use crate::cpu::project::CHUNK;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Bits per pass: 3 × 11 ≥ 31 bits of a positive float.
const DIGIT_BITS: u32 = 11;
const DIGITS: usize = 1 << DIGIT_BITS;
const PASSES: u32 = 3;

/// Buffers of the sort, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct DepthSort {
    /// Depth bits in the upper half, splat index in the lower; sorted at the end.
    front: Vec<AtomicU64>,
    back: Vec<AtomicU64>,
    /// `[chunks, DIGITS]`: counts, then where each chunk's next entry goes.
    slots: Vec<u32>,
    len: usize,
}

impl DepthSort {
    /// Sorts the visible ones of `footprints`; `visible` counts them per [`CHUNK`].
    pub(crate) fn run(&mut self, footprints: &[Footprint], visible: &[usize]) {
        self.len = visible.iter().sum();
        if self.front.len() < self.len {
            self.front.resize_with(self.len, AtomicU64::default);
            self.back.resize_with(self.len, AtomicU64::default);
        }
        self.gather(footprints, visible);
        for pass in 0..PASSES {
            self.pass(pass * DIGIT_BITS);
        }
    }

    /// Visible splats, nearest first.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Index of the splat with depth rank `rank` < [`DepthSort::len`].
    pub(crate) fn splat(&self, rank: usize) -> u32 {
        self.front[rank].load(Relaxed) as u32
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        8 * (self.front.capacity() + self.back.capacity()) + 4 * self.slots.capacity()
    }

    fn gather(&mut self, footprints: &[Footprint], visible: &[usize]) {
        // The prefix over chunks is short: one number per 4096 splats.
        let mut rest = &mut self.front[..self.len];
        let mut parts = Vec::with_capacity(visible.len());
        for &count in visible {
            let (part, tail) = rest.split_at_mut(count);
            parts.push(part);
            rest = tail;
        }
        parts.into_par_iter().enumerate().for_each(|(c, part)| {
            let first = c * CHUNK;
            let chunk = &footprints[first..(first + CHUNK).min(footprints.len())];
            let kept = chunk.iter().enumerate().filter(|(_, f)| f.visible());
            for (slot, (j, f)) in part.iter_mut().zip(kept) {
                *slot.get_mut() = u64::from(f.z.to_bits()) << 32 | (first + j) as u64;
            }
        });
    }

    /// One stable counting sort by the digit at `shift` of the depth bits.
    fn pass(&mut self, shift: u32) {
        let n = self.len;
        let digit = |entry: u64| (entry >> (32 + shift)) as usize & (DIGITS - 1);
        let chunk = chunk_len(n);
        let chunks = n.div_ceil(chunk);
        self.slots.clear();
        self.slots.resize(chunks * DIGITS, 0);
        let (front, back) = (&self.front[..n], &self.back[..n]);
        self.slots.par_chunks_mut(DIGITS).zip(front.par_chunks(chunk)).for_each(
            |(counts, entries)| {
                for e in entries {
                    counts[digit(e.load(Relaxed))] += 1;
                }
            },
        );
        let mut next = 0;
        for d in 0..DIGITS {
            for c in 0..chunks {
                next += std::mem::replace(&mut self.slots[c * DIGITS + d], next);
            }
        }
        self.slots.par_chunks_mut(DIGITS).zip(front.par_chunks(chunk)).for_each(
            |(slots, entries)| {
                for e in entries {
                    let e = e.load(Relaxed);
                    let slot = &mut slots[digit(e)];
                    back[*slot as usize].store(e, Relaxed);
                    *slot += 1;
                }
            },
        );
        std::mem::swap(&mut self.front, &mut self.back);
    }
}

/// Length of the chunks into which `n` sorted entries are cut for one pass: enough
/// chunks to occupy every thread, long enough to be worth their tables.
pub(crate) fn chunk_len(n: usize) -> usize {
    n.div_ceil(2 * rayon::current_num_threads()).max(CHUNK)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_that_of_a_stable_sort() {
        let mut state = 1u32;
        let footprints: Vec<_> = (0..30_000)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                // Few distinct depths over many magnitudes: ties and all digits.
                let z =
                    ((state >> 20) as f32).exp2().clamp(1e-30, 1e30) / 7.0 + (state >> 28) as f32;
                Footprint { z, x1: u32::from(state & 0x300 != 0), ..Footprint::default() }
            })
            .collect();
        let visible: Vec<usize> =
            footprints.chunks(CHUNK).map(|c| c.iter().filter(|f| f.visible()).count()).collect();
        let mut expected: Vec<u32> =
            (0..30_000).filter(|&i| footprints[i as usize].visible()).collect();
        expected.sort_by(|&a, &b| footprints[a as usize].z.total_cmp(&footprints[b as usize].z));
        let mut sort = DepthSort::default();
        // Twice: the second run meets used buffers.
        for _ in 0..2 {
            sort.run(&footprints, &visible);
            let got: Vec<u32> = (0..sort.len()).map(|r| sort.splat(r)).collect();
            assert_eq!(got, expected);
        }
    }
}
