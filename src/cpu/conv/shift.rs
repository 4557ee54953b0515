//! The convolution itself: outputs of eight channels and 48 places in registers, all
//! channels and taps of the source summed into them without a pause.

use super::Buffers;
use super::plan::{Axes, Layout, Pack, Plan, starts};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel, Vector};
use crate::cpu::uninit::{self, filled, grown};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Output channels of a full block of weights.
pub(super) const ROWS: usize = 8;
/// Pieces of work that a call is cut into at least, where it can be.
const JOBS: usize = 16;
/// Least vectors of a register tile that hide how long one sum takes.
const DIRECT: usize = 10;
/// Floats past a packed tile's end that a strip may read and not use.
const SLACK: usize = 16 * LANES;

/// Weights in the order in which the kernel reads them: for each block of output
/// channels and each pass, `[source channel][tap][channel of the block]`.
#[derive(Clone, Debug)]
pub(crate) struct Weights {
    data: Vec<f32>,
    blocks: Vec<Block>,
}

/// Output channels `first..first + rows`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    pub first: usize,
    pub rows: usize,
}

/// `channels` in blocks of [`ROWS`].
pub(super) fn blocks(channels: usize) -> Vec<Block> {
    let block = |first: usize| Block { first, rows: ROWS.min(channels - first) };
    (0..channels).step_by(ROWS).map(block).collect()
}

impl Weights {
    /// Of `w` as the caller stores them, in the memory of `data`.
    pub fn new(plan: &Plan, w: &[f32], mut data: Vec<f32>) -> Self {
        let depth = plan.src_channels * plan.all_taps();
        let blocks = blocks(plan.dst_channels);
        let floats = blocks.iter().map(|b| b.rows * depth).sum();
        let panels = grown(&mut data, floats).par_chunks_mut((ROWS * depth).max(1));
        panels.zip(&blocks).for_each(|(panel, block)| {
            let mut panel = panel;
            for pass in &plan.passes {
                let n = plan.src_channels * pass.taps.len() * block.rows;
                let (own, rest) = panel.split_at_mut(n);
                panel = rest;
                // Channel by channel of the source: what is written stays in the cache.
                let group = pass.taps.len() * block.rows;
                for (src, own) in own.chunks_exact_mut(group.max(1)).enumerate() {
                    for m in 0..block.rows {
                        let dst = block.first + m;
                        let row = match plan.transposed {
                            true => src * plan.dst_channels + dst,
                            false => dst * plan.src_channels + src,
                        };
                        let taps = &w[row * plan.kernel_taps..][..plan.kernel_taps];
                        for (tap, own) in pass.taps.iter().zip(own.chunks_exact_mut(block.rows)) {
                            own[m] = taps[tap.kernel];
                        }
                    }
                }
            }
        });
        Self { data, blocks }
    }

    /// Its memory, for other weights.
    pub fn into_memory(self) -> Vec<f32> {
        self.data
    }
}

/// Runs `plan` on pictures `x` into `y`, which is overwritten; `bias` is empty or one
/// value a channel written.
pub(crate) fn run(
    level: SimdLevel,
    plan: &Plan,
    x: &[f32],
    w: &Weights,
    bias: &[f32],
    y: &mut uninit::UninitSlice<f32>,
) {
    let src: usize = plan.src_size.iter().product();
    let dst: usize = plan.dst_size.iter().product();
    let image = plan.dst_channels * dst;
    if y.is_empty() || image == 0 {
        return;
    }
    let images = y.len() / image;
    let tile = plan.tile(plan.src_channels, images, JOBS);
    let layout = plan.layout(tile);
    let starts = starts(plan.grid(), tile);
    let tiles = images * starts.len();
    let parts = JOBS.div_ceil(tiles).min(w.blocks.len());
    let share = w.blocks.len().div_ceil(parts);
    let y = SharedSliceMut::new(y);
    (0..tiles * parts).into_par_iter().for_each(|job| {
        let (image, start) = (job / parts / starts.len(), starts[job / parts % starts.len()]);
        let first = (job % parts * share).min(w.blocks.len());
        let blocks = first..(first + share).min(w.blocks.len());
        if blocks.is_empty() {
            return;
        }
        let x = &x[image * plan.src_channels * src..][..plan.src_channels * src];
        Buffers::with(|buffers| {
            let Buffers { x: packed, y: sums, .. } = buffers;
            let packed = packed.room(plan.src_channels * layout.channel + SLACK);
            let sums = sums.room(plan.passes.len() * ROWS * layout.flat().next_multiple_of(LANES));
            level.run(Pack { plan, layout: &layout, x, start, out: packed });
            level.run(Job { plan, layout, packed, sums, w, blocks, bias, image, start, y: &y });
        });
    });
}

/// One tile and some blocks of channels.
struct Job<'a> {
    plan: &'a Plan,
    layout: Layout,
    packed: &'a [f32],
    sums: &'a mut [f32],
    w: &'a Weights,
    blocks: std::ops::Range<usize>,
    bias: &'a [f32],
    image: usize,
    start: Axes,
    y: &'a SharedSliceMut<'a, MaybeUninit<f32>>,
}

impl Kernel for Job<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (plan, layout) = (self.plan, self.layout);
        let depth = plan.src_channels * plan.all_taps();
        let length = layout.flat().next_multiple_of(LANES);
        let offsets: Vec<Vec<usize>> =
            plan.passes.iter().map(|p| p.taps.iter().map(|t| layout.offset(t)).collect()).collect();
        for index in self.blocks.clone() {
            let block = self.w.blocks[index];
            let panel = &self.w.data[index * ROWS * depth..][..block.rows * depth];
            let mut bias = [0.0; ROWS];
            for (m, b) in bias.iter_mut().take(block.rows).enumerate() {
                *b = self.bias.get(block.first + m).copied().unwrap_or(0.0);
            }
            let [depths, rows, columns] = self.inside();
            // Rows of whole vectors need no detour, if they fill a register tile.
            let direct = plan.dst_step == [1; 3]
                && columns.is_multiple_of(LANES)
                && block.rows * (columns / LANES) >= DIRECT
                && block.rows > ROWS / 2;
            for d in 0..depths {
                let strip = Strip {
                    x: &self.packed[d * layout.depth()..],
                    channel: layout.channel,
                    channels: plan.src_channels,
                    offsets: &offsets[0],
                    w: panel,
                    bias,
                    length,
                };
                if direct {
                    for r in 0..rows {
                        let x = &strip.x[r * layout.pitch()..];
                        let strip = Strip { x, length: columns, ..strip };
                        // SAFETY: the same piece of a row of y in each channel of the block,
                        // this job's alone: jobs differ in picture, tile or channels.
                        unsafe { strip.run_to(s, block.rows, self.row(block.first, d, r)) };
                    }
                    continue;
                }
                let mut from = 0;
                for (p, offsets) in offsets.iter().enumerate() {
                    let n = plan.src_channels * offsets.len() * block.rows;
                    let strip = Strip { offsets, w: &panel[from..from + n], ..strip };
                    from += n;
                    let sums = &mut self.sums[p * ROWS * length..][..ROWS * length];
                    strip.run(s, block.rows, sums);
                }
                for m in 0..block.rows {
                    self.write(s, block.first + m, m, d, length);
                }
            }
        }
    }
}

impl Job<'_> {
    /// Grid positions of the tile that there are.
    #[inline(always)]
    fn inside(&self) -> Axes {
        let grid = self.plan.grid();
        std::array::from_fn(|a| self.layout.tile[a].min(grid[a] - self.start[a]))
    }

    /// Row `r` of the tile at depth `d` in y, from channel `channel` on, stride 1.
    #[inline(always)]
    fn row(&self, channel: usize, d: usize, r: usize) -> To {
        let [depth, height, width] = self.plan.dst_size;
        let row = (self.image * self.plan.dst_channels + channel) * depth + self.start[0] + d;
        let at = (row * height + self.start[1] + r) * width + self.start[2];
        To { at: self.y.address(at).cast_mut().cast(), stride: depth * height * width }
    }

    /// Copies channel `m` of the block's sums at depth `d` to channel `channel` of y.
    #[inline(always)]
    fn write<S: Simd>(&self, s: S, channel: usize, m: usize, d: usize, length: usize) {
        let (plan, layout) = (self.plan, &self.layout);
        let ([depth, height, width], step) = (plan.dst_size, plan.dst_step);
        let base = (self.image * plan.dst_channels + channel) * depth * height * width;
        let left = self.start[2] * step[2];
        let columns = (layout.tile[2] * step[2]).min(width - left);
        for (rows, passes) in plan.passes.chunks_exact(step[2]).enumerate() {
            let [fd, fh, _] = passes[0].phase;
            let z = (self.start[0] + d) * step[0] + fd;
            if z >= depth {
                continue;
            }
            for r in 0..layout.tile[1] {
                let row = (self.start[1] + r) * step[1] + fh;
                if row >= height {
                    break;
                }
                let at = base + (z * height + row) * width + left;
                // SAFETY: jobs differ in picture, tile or channels, and so in the
                // rows, or pieces of rows, that they write.
                let to = unsafe { self.y.part(at..at + columns) };
                let source = |p: usize| {
                    let first = ((rows * step[2] + p) * ROWS + m) * length + r * layout.pitch();
                    &self.sums[first..first + layout.tile[2]]
                };
                match step[2] {
                    1 => drop(filled(to, &source(0)[..columns])),
                    2 => zip(s, source(0), source(1), to),
                    n => {
                        for p in 0..n {
                            let places = to.iter_mut().skip(p).step_by(n);
                            places.zip(source(p)).for_each(|(to, v)| *to = MaybeUninit::new(*v));
                        }
                    }
                }
            }
        }
    }
}

/// `even` and `odd` in turns; `to` is as long as both, or shorter.
#[inline(always)]
pub(super) fn zip<S: Simd>(s: S, even: &[f32], odd: &[f32], to: &mut [MaybeUninit<f32>]) {
    let whole = to.len() / (2 * LANES) * LANES;
    let (vectors, rest) = to.split_at_mut(2 * whole);
    let pairs = even.as_chunks().0.iter().zip(odd.as_chunks().0);
    for (to, (even, odd)) in vectors.chunks_exact_mut(2 * LANES).zip(pairs) {
        let pair = s.interleave(s.load(even), s.load(odd));
        for (to, v) in to.as_chunks_mut().0.iter_mut().zip(pair) {
            s.store_uninit(v, to);
        }
    }
    for (i, to) in rest.iter_mut().enumerate() {
        let from = if i.is_multiple_of(2) { even } else { odd };
        *to = MaybeUninit::new(from[whole + i / 2]);
    }
}

/// One pass over one depth of a tile, for one block of channels.
#[derive(Clone, Copy)]
pub(super) struct Strip<'a> {
    pub x: &'a [f32],
    /// Distance of channels in `x`.
    pub channel: usize,
    pub channels: usize,
    /// Where taps read, from an output's own place.
    pub offsets: &'a [usize],
    /// `[channel][tap][channel of the block]`.
    pub w: &'a [f32],
    pub bias: [f32; ROWS],
    /// Outputs, whole vectors.
    pub length: usize,
}

/// Where sums go: channel m of the block to `at + m·stride`.
#[derive(Clone, Copy)]
struct To {
    at: *mut f32,
    stride: usize,
}

impl Strip<'_> {
    /// Sums `[channel of the block][length]` of `rows` channels.
    #[inline(always)]
    pub fn run<S: Simd>(&self, s: S, rows: usize, sums: &mut [f32]) {
        assert!(sums.len() >= rows * self.length);
        let to = To { at: sums.as_mut_ptr(), stride: self.length };
        // SAFETY: as many rows of `length` floats (just asserted).
        unsafe { self.run_to(s, rows, to) };
    }

    /// # Safety
    /// Each of `rows` channels has room for `length` floats at `to`, which nobody else
    /// reads or writes.
    #[inline(always)]
    unsafe fn run_to<S: Simd>(&self, s: S, rows: usize, to: To) {
        let farthest = self.offsets.iter().max().copied().unwrap_or(0) + self.length;
        assert!(self.channels.saturating_sub(1) * self.channel + farthest <= self.x.len());
        assert!(self.length.is_multiple_of(LANES));
        assert!(self.w.len() >= self.channels * self.offsets.len() * rows);
        if S::REGISTERS >= 32 {
            match rows {
                8 => self.strips::<S, 8, 8, 3, 2>(s, 0, to),
                7 => self.strips::<S, 7, 7, 3, 2>(s, 0, to),
                6 => self.strips::<S, 6, 6, 4, 2>(s, 0, to),
                5 => self.strips::<S, 5, 5, 5, 2>(s, 0, to),
                4 => self.strips::<S, 4, 4, 6, 3>(s, 0, to),
                3 => self.strips::<S, 3, 3, 7, 3>(s, 0, to),
                2 => self.strips::<S, 2, 2, 8, 3>(s, 0, to),
                _ => self.strips::<S, 1, 1, 12, 3>(s, 0, to),
            }
        } else {
            match rows {
                8 => {
                    self.strips::<S, 8, 4, 1, 1>(s, 0, to);
                    self.strips::<S, 8, 4, 1, 1>(s, 4, to);
                }
                7 => {
                    self.strips::<S, 7, 4, 1, 1>(s, 0, to);
                    self.strips::<S, 7, 3, 1, 1>(s, 4, to);
                }
                6 => self.strips::<S, 6, 6, 1, 1>(s, 0, to),
                5 => self.strips::<S, 5, 5, 1, 1>(s, 0, to),
                4 => self.strips::<S, 4, 4, 1, 1>(s, 0, to),
                3 => self.strips::<S, 3, 3, 2, 1>(s, 0, to),
                2 => self.strips::<S, 2, 2, 2, 1>(s, 0, to),
                _ => self.strips::<S, 1, 1, 4, 1>(s, 0, to),
            }
        }
    }

    /// `M` channels from `first` of a block of `P`, `A` vectors at a time, then `B`,
    /// then one.
    #[inline(always)]
    fn strips<S: Simd, const P: usize, const M: usize, const A: usize, const B: usize>(
        &self,
        s: S,
        first: usize,
        to: To,
    ) {
        let mut at = 0;
        while at < self.length {
            let left = (self.length - at) / LANES;
            // Two pairs rather than three and one.
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

    /// `M` channels × `N` vectors.
    #[inline(always)]
    fn tile<S: Simd, const P: usize, const M: usize, const N: usize>(
        &self,
        s: S,
        first: usize,
        at: usize,
        to: To,
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
                    // SAFETY: the last channel's farthest tap ends inside the packed
                    // tile (asserted by `run`).
                    v[n] = s.load(unsafe { &*from.wrapping_add(n * LANES).cast() });
                }
                for m in 0..M {
                    // SAFETY: the panel holds P weights for every channel and tap
                    // (asserted by `run`), first + M ≤ P.
                    let weight = s.splat(unsafe { *w.wrapping_add(m) });
                    for n in 0..N {
                        acc[m][n] = weight.fma(v[n], acc[m][n]);
                    }
                }
                w = w.wrapping_add(P);
            }
            x = x.wrapping_add(self.channel);
        }
        for m in 0..M {
            let row = to.at.wrapping_add((first + m) * to.stride + at);
            for n in 0..N {
                // SAFETY: inside the row (the promise of `run_to`'s caller).
                s.store(acc[m][n], unsafe { &mut *row.wrapping_add(n * LANES).cast() });
            }
        }
    }
}
