//! ∂L/∂w: products of shifted tiles of x with ∂L/∂y, summed over all outputs.
//!
//! Wide: vectors hold output channels (∂L/∂y turned over, 48 channels of some 128
//! outputs in the first-level cache), rows are (channel, tap) of x, read as scalars
//! where they lie. Narrow, for at most eight output channels, or three times as many that
//! would leave half of a vector empty: vectors hold neighbouring outputs, and lanes are
//! added at the end.

use super::plan::{Axes, Layout, Pack, Plan, Sizes, starts};
use super::pointwise;
use super::winograd;
use super::winograd_weights::{self, Finish, Products};
use super::{Buffer, Buffers};
use crate::cpu::shared_slice::SharedSliceMut;
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel, Vector};
use crate::cpu::uninit;
use rayon::prelude::*;
use std::ops::Range;

/// Rows of a register tile.
pub(super) const ROWS: usize = 8;
/// Output channels of one job.
pub(super) const LANES_WIDE: usize = 3 * LANES;
/// The rows of any narrow register tile divide it.
const STEP: usize = 24;
/// Outputs whose gradients are turned over at once.
const CHUNK: usize = 128;
/// Rows (channel × tap) of a job, at least, where there are as many.
const DEPTH: usize = 144;
/// Jobs of a call, where it can be cut into as many.
const JOBS: usize = 16;
/// Output channels of a pass whose vectors hold outputs.
const NARROW: usize = 8;
/// Floats of ∂L/∂y of such a pass, which stay in a first-level cache.
const NARROW_FLOATS: usize = 8192;
/// Floats past a packed tile's end that may be read and not used.
const SLACK: usize = 2 * LANES;

/// ∂L/∂w from x and ∂L/∂y, `dw` overwritten.
pub fn weight_grad(level: SimdLevel, s: &Sizes, x: &[f32], dy: &[f32], dw: &mut [f32]) {
    let (c, o, taps) = (s.in_channels, s.out_channels, s.taps());
    let (in_image, out_image) = (c * s.in_pixels(), o * s.out_pixels());
    if dw.is_empty() || x.is_empty() || dy.is_empty() {
        dw.fill(0.0);
        return;
    }
    let images = x.len() / in_image;
    let plan = Plan::forward(s);
    if pointwise::suits(&plan) && o > NARROW {
        return pointwise::weight_grad(level, &plan, x, dy, dw);
    }
    let tiles = images * winograd::tiles_of(&plan);
    let way = Way::of(&plan, o, tiles);
    let (outputs, channels) = match way {
        Way::Narrow => (o, even(c, (c * taps).div_ceil(DEPTH))),
        Way::Wide => {
            let outputs = o.div_ceil(o.div_ceil(LANES_WIDE)).next_multiple_of(LANES);
            (outputs, even(c, (c * taps / DEPTH).max(1)))
        }
        Way::Winograd(_) => winograd_weights::part([c, o], tiles, rayon::current_num_threads()),
    };
    let parts: Vec<(usize, usize)> = (0..o)
        .step_by(outputs)
        .flat_map(|first| (0..c).step_by(channels).map(move |channel| (first, channel)))
        .collect();
    let tile = match way {
        Way::Winograd(_) => winograd_weights::tile(&plan),
        _ => plan.tile(channels, images, JOBS.div_ceil(parts.len())),
    };
    let layout = plan.layout(tile);
    let starts = starts(plan.grid(), tile);
    // Pictures of a unit.
    let together = match way {
        Way::Winograd(_) => winograd_weights::together(&plan),
        _ => 1,
    };
    let units = images.div_ceil(together) * starts.len();
    let groups = match way {
        Way::Winograd(_) => winograd_weights::groups(tiles),
        _ => JOBS.div_ceil(parts.len()).min(units),
    };
    let work = |(first, channel): (usize, usize)| Work {
        plan: &plan,
        layout,
        outputs: first..(first + outputs).min(o),
        pitch: way.pitch(outputs.min(o - first)),
        rows: channels.min(c - channel) * taps,
        step: if let Way::Narrow = way { STEP } else { ROWS },
    };
    assert!(groups <= units, "conv: no group of tiles is empty");
    // The first part is the largest.
    let floats = work(parts[0]).floats();
    let mut sums = uninit::zeros(parts.len() * groups * floats);
    sums.par_chunks_exact_mut(floats).enumerate().for_each(|(job, sums)| {
        let (part, group) = (job / groups, job % groups);
        let (first, channel) = parts[part];
        let work = work((first, channel));
        let unit = |unit: usize| {
            let (first, start) = (unit / starts.len() * together, starts[unit % starts.len()]);
            let count = together.min(images - first);
            let x = &x[first * in_image + channel * s.in_pixels()..];
            let x = &x[..(count - 1) * in_image + work.rows / taps * s.in_pixels()];
            (x, &dy[first * out_image..][..count * out_image], start)
        };
        let units = (units * group / groups..units * (group + 1) / groups).map(unit);
        Buffers::with(|buffers| way.sums(level, &work, units, buffers, sums));
    });
    let dw = SharedSliceMut::new(dw);
    sums.par_chunks_exact(groups * floats).zip(&parts).for_each(|(sums, &(first, channel))| {
        let rows = channels.min(c - channel) * taps;
        let outputs = first..(first + outputs).min(o);
        let pitch = way.pitch(outputs.len());
        (0..outputs.len().div_ceil(LANES)).into_par_iter().for_each(|block| {
            let lanes = block * LANES..(block * LANES + LANES).min(outputs.len());
            let part = |lane: usize| {
                let at = ((first + lane) * c + channel) * taps;
                // SAFETY: parts and blocks differ in outputs or channels.
                unsafe { dw.part(at..at + rows) }
            };
            let to = lanes.clone().map(part).collect();
            level.run(Add { sums, floats, pitch, first: lanes.start, to });
        });
    });
}

/// Adds `sums` `[group][row][pitch]`, groups `floats` apart, and turns them: column
/// `first + i` to row i of `to`.
struct Add<'a> {
    sums: &'a [f32],
    floats: usize,
    pitch: usize,
    first: usize,
    to: Vec<&'a mut [f32]>,
}

impl Kernel for Add<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { sums, floats, pitch, first, mut to } = self;
        let rows = to.first().map_or(0, |to| to.len());
        // Narrow sums have no whole vectors.
        let whole = if pitch.is_multiple_of(LANES) { rows / LANES * LANES } else { 0 };
        for r in (0..whole).step_by(LANES) {
            let mut square = [s.splat(0.0); LANES];
            for sums in sums.chunks_exact(floats) {
                for i in 0..LANES {
                    if let Some(row) = sums[(r + i) * pitch + first..].first_chunk() {
                        square[i] = square[i] + s.load(row);
                    }
                }
            }
            let turned = s.transpose(square);
            for i in 0..LANES {
                if let Some(to) = to.get_mut(i).and_then(|to| to[r..].first_chunk_mut()) {
                    s.store(turned[i], to);
                }
            }
        }
        for r in whole..rows {
            for (i, to) in to.iter_mut().enumerate() {
                let parts = sums.chunks_exact(floats).map(|sums| sums[r * pitch + first + i]);
                to[r] = parts.fold(0.0, |total, v| total + v);
            }
        }
    }
}

/// `n` in `parts` equal parts: the size of one.
fn even(n: usize, parts: usize) -> usize {
    n.div_ceil(parts.clamp(1, n.max(1))).max(1)
}

/// How the sums are made; see the top of this file and [`winograd_weights`].
#[derive(Clone, Copy)]
enum Way {
    Narrow,
    Wide,
    Winograd(winograd::Way),
}

impl Way {
    fn of(plan: &Plan, outputs: usize, tiles: usize) -> Self {
        let plain = match outputs {
            0..=NARROW => return Self::Narrow,
            // Half of their last vector would be empty.
            n if (LANES + 1..=LANES + NARROW).contains(&n) => Self::Narrow,
            _ => Self::Wide,
        };
        if tiles < winograd_weights::LEAST {
            return plain;
        }
        winograd::Way::of(plan).map_or(plain, Self::Winograd)
    }

    /// Floats of one row of sums of so many outputs.
    fn pitch(self, outputs: usize) -> usize {
        match self {
            Self::Narrow if outputs < NARROW => outputs.next_power_of_two(),
            Self::Narrow => outputs.next_multiple_of(NARROW),
            Self::Wide | Self::Winograd(_) => outputs.next_multiple_of(LANES),
        }
    }

    /// Adds the sums of one job over `units` to `sums`, which is zero: x from the job's
    /// channels on, ∂L/∂y of the same pictures, and the first output of a tile.
    fn sums<'a>(
        self,
        level: SimdLevel,
        work: &Work<'_>,
        units: impl Iterator<Item = (&'a [f32], &'a [f32], Axes)>,
        buffers: &mut Buffers,
        sums: &mut [f32],
    ) {
        let sums = &mut sums[..work.floats()];
        if let Self::Winograd(way) = self {
            // Apart, since `Products` uses the other buffers.
            let mut own = std::mem::take(&mut buffers.products);
            let products = own.room(winograd_weights::floats(work));
            let reader = &way.reader(work.plan);
            for (i, (x, dy, start)) in units.enumerate() {
                let first = i == 0;
                level.run(Products { work, way, reader, x, dy, start, first, buffers, products });
            }
            level.run(Finish { work, way, products, sums });
            buffers.products = own;
            return;
        }
        let channels = work.rows / work.plan.kernel_taps;
        for (x, dy, start) in units {
            let floats = channels * work.layout.channel;
            let x_packed = buffers.x.room(floats + SLACK);
            // Multiplied by zeros: it must be no NaN.
            x_packed[floats..].fill(0.0);
            level.run(Pack { plan: work.plan, layout: &work.layout, x, start, out: x_packed });
            let (x, turned) = (&*x_packed, &mut buffers.y);
            let sums = &mut *sums;
            match self {
                Self::Narrow => level.run(Narrow { work, x, dy, start, turned, sums }),
                _ => level.run(Wide { work, x, dy, start, turned, sums }),
            }
        }
    }
}

/// A range of output channels and rows (channel × tap).
pub(super) struct Work<'a> {
    pub plan: &'a Plan,
    pub layout: Layout,
    pub outputs: Range<usize>,
    /// Floats of one row of sums: the outputs, rounded up.
    pub pitch: usize,
    pub rows: usize,
    /// Rows come in multiples of this, the last ones repeated.
    pub step: usize,
}

impl Work<'_> {
    /// Sums of a job: `[rows rounded up][outputs rounded up]`.
    fn floats(&self) -> usize {
        self.rows.next_multiple_of(self.step) * self.pitch
    }

    /// Where each row of the packed tile begins, the last one repeated.
    fn offsets(&self) -> Vec<usize> {
        let taps = &self.plan.passes[0].taps;
        let row = |r: usize| {
            let r = r.min(self.rows - 1);
            r / taps.len() * self.layout.channel + self.layout.offset(&taps[r % taps.len()])
        };
        (0..self.rows.next_multiple_of(self.step)).map(row).collect()
    }

    /// Outputs of the tile at `start` that exist.
    pub fn inside(&self, start: Axes) -> Axes {
        std::array::from_fn(|a| self.layout.tile[a].min(self.plan.dst_size[a] - start[a]))
    }

    /// One output channel's depth `d` of the tile: its rows begin at the result, one
    /// picture row apart.
    pub fn dy_at(&self, output: usize, start: Axes, d: usize) -> usize {
        let [depth, height, width] = self.plan.dst_size;
        ((output * depth + start[0] + d) * height + start[1]) * width + start[2]
    }
}

struct Wide<'a, 'b> {
    work: &'a Work<'b>,
    x: &'a [f32],
    dy: &'a [f32],
    start: Axes,
    turned: &'a mut Buffer,
    sums: &'a mut [f32],
}

impl Kernel for Wide<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (work, layout) = (self.work, self.work.layout);
        let [depth, height, width] = work.inside(self.start);
        let offsets = work.offsets();
        let pitch = work.pitch;
        let rows = (CHUNK / width).clamp(1, height);
        let turned = self.turned.room(rows * width * pitch);
        for d in 0..depth {
            for first in (0..height).step_by(rows) {
                let count = rows.min(height - first);
                let turned = &mut turned[..count * width * pitch];
                let x = &self.x[d * layout.depth() + first * layout.pitch()..];
                turn(s, work, self.dy, (self.start, d, first), [count, width], turned);
                let tile = Tile { x, x_pitch: layout.pitch(), dy: turned, pitch, count, width };
                let sums = self.sums.chunks_exact_mut(ROWS * pitch);
                for (i, (offsets, sums)) in offsets.as_chunks().0.iter().zip(sums).enumerate() {
                    if work.rows - i * ROWS > ROWS / 2 {
                        tile.rows::<S, ROWS>(s, offsets, true, sums);
                    } else {
                        tile.rows::<S, { ROWS / 2 }>(s, offsets, true, sums);
                    }
                }
            }
        }
    }
}

/// ∂L/∂y of `[rows, width]` outputs, turned over to `[output][channel]`.
#[inline(always)]
fn turn<S: Simd>(
    s: S,
    work: &Work<'_>,
    dy: &[f32],
    (start, d, first): (Axes, usize, usize),
    [rows, width]: [usize; 2],
    out: &mut [f32],
) {
    let pitch = work.pitch;
    let row_pitch = work.plan.dst_size[2];
    // Whole rows lie one behind the other.
    let (runs, run) = if row_pitch == width { (1, rows * width) } else { (rows, width) };
    for v in (0..pitch).step_by(LANES) {
        let outputs = LANES.min(work.outputs.len().saturating_sub(v));
        for r in 0..runs {
            let to = &mut out[r * run * pitch..][..run * pitch];
            let at = |i: usize| {
                work.dy_at(work.outputs.start + v + i, start, d) + (first + r) * row_pitch
            };
            let mut places = [0; LANES];
            for i in 0..LANES {
                places[i] = at(i.min(outputs.saturating_sub(1)));
            }
            let whole = run / LANES * LANES;
            for p in (0..whole).step_by(LANES) {
                let mut m = [s.splat(0.0); LANES];
                for i in 0..LANES {
                    if i < outputs
                        && let Some(from) = dy[places[i] + p..].first_chunk()
                    {
                        // The next columns, in whose lines nothing else is near.
                        s.prefetch_l2(from.as_ptr().wrapping_add(LANES));
                        m[i] = s.load(from);
                    }
                }
                let m = s.transpose(m);
                for i in 0..LANES {
                    if let Some(to) = to[(p + i) * pitch + v..].first_chunk_mut() {
                        s.store(m[i], to);
                    }
                }
            }
            for p in whole..run {
                let to = &mut to[p * pitch + v..][..LANES];
                for i in 0..LANES {
                    to[i] = if i < outputs { dy[places[i] + p] } else { 0.0 };
                }
            }
        }
    }
}

/// Some rows of a tile and their turned gradients.
pub(super) struct Tile<'a> {
    pub x: &'a [f32],
    /// Distance of rows in `x`.
    pub x_pitch: usize,
    /// `[count][width][pitch]`.
    pub dy: &'a [f32],
    pub pitch: usize,
    pub count: usize,
    pub width: usize,
}

impl Tile<'_> {
    /// `[M][pitch]` sums of the first `M` rows, four or eight, added to those that are there
    /// with `add`.
    #[inline(always)]
    pub fn rows<S: Simd, const M: usize>(
        &self,
        s: S,
        offsets: &[usize; ROWS],
        add: bool,
        sums: &mut [f32],
    ) {
        let farthest = offsets.iter().max().copied().unwrap_or(0) + self.width;
        assert!(farthest + self.count.saturating_sub(1) * self.x_pitch <= self.x.len());
        assert!(self.dy.len() >= self.count * self.width * self.pitch);
        assert!(sums.len() >= M * self.pitch);
        if S::REGISTERS >= 32 {
            match self.pitch / LANES {
                3 => self.block::<S, M, 3>(s, offsets, [0, 0], add, sums),
                2 => self.block::<S, M, 2>(s, offsets, [0, 0], add, sums),
                _ => self.block::<S, M, 1>(s, offsets, [0, 0], add, sums),
            }
        } else {
            for v in (0..self.pitch).step_by(LANES) {
                self.block::<S, 4, 1>(s, offsets, [0, v], add, sums);
                if M > 4 {
                    self.block::<S, 4, 1>(s, offsets, [4, v], add, sums);
                }
            }
        }
    }

    /// `M` rows from `first` × `N` vectors from channel `from`.
    #[inline(always)]
    fn block<S: Simd, const M: usize, const N: usize>(
        &self,
        s: S,
        offsets: &[usize; ROWS],
        [first, from]: [usize; 2],
        add: bool,
        sums: &mut [f32],
    ) {
        let mut acc = [[s.splat(0.0); N]; M];
        let mut dy = self.dy.as_ptr().wrapping_add(from);
        for r in 0..self.count {
            let mut x = [self.x.as_ptr(); M];
            for m in 0..M {
                x[m] = self.x.as_ptr().wrapping_add(offsets[first + m] + r * self.x_pitch);
            }
            for i in 0..self.width {
                let mut v = [s.splat(0.0); N];
                for n in 0..N {
                    // SAFETY: count·width·pitch floats (asserted by `rows`).
                    v[n] = s.load(unsafe { &*dy.wrapping_add(n * LANES).cast() });
                }
                for m in 0..M {
                    // SAFETY: the farthest row ends inside x (asserted by `rows`).
                    let x = s.splat(unsafe { *x[m].wrapping_add(i) });
                    for n in 0..N {
                        acc[m][n] = x.fma(v[n], acc[m][n]);
                    }
                }
                dy = dy.wrapping_add(self.pitch);
            }
        }
        for m in 0..M {
            let row = &mut sums[(first + m) * self.pitch + from..][..N * LANES];
            for (to, v) in row.as_chunks_mut().0.iter_mut().zip(acc[m]) {
                // Sums of sums: shorter ones, which lose less.
                let v = if add { s.load(to) + v } else { v };
                s.store(v, to);
            }
        }
    }
}

struct Narrow<'a, 'b> {
    work: &'a Work<'b>,
    x: &'a [f32],
    dy: &'a [f32],
    start: Axes,
    turned: &'a mut Buffer,
    sums: &'a mut [f32],
}

impl Kernel for Narrow<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (work, layout) = (self.work, self.work.layout);
        let [depth, height, width] = work.inside(self.start);
        let offsets = work.offsets();
        let (row_pitch, x_pitch) = (work.plan.dst_size[2], layout.pitch());
        let pass = NARROW.min(work.pitch);
        let rows = (NARROW_FLOATS / (pass * width)).clamp(1, height);
        let farthest = offsets.iter().max().copied().unwrap_or(0);
        for (d, top) in (0..depth).flat_map(|d| (0..height).step_by(rows).map(move |r| (d, r))) {
            let count = rows.min(height - top);
            // Rows of whole vectors lie close, others as far apart as those of x.
            let whole = width.is_multiple_of(LANES);
            let (lines, line, apart) = match whole {
                true => (count, width, width),
                false => (1, ((count - 1) * x_pitch + width).next_multiple_of(LANES), x_pitch),
            };
            let x = &self.x[d * layout.depth() + top * x_pitch..];
            assert!(farthest + (lines - 1) * x_pitch + line <= x.len());
            let packed = self.turned.room(pass * lines * line);
            for first in (0..work.pitch).step_by(NARROW) {
                let outputs = work.outputs.clone().skip(first);
                if !whole || outputs.len() < pass {
                    // Zeros wherever the tile has no output.
                    packed.fill(0.0);
                }
                for (output, plane) in outputs.zip(packed.chunks_exact_mut(lines * line)) {
                    let from = &self.dy[work.dy_at(output, self.start, d) + top * row_pitch..];
                    if whole && row_pitch == width {
                        plane.copy_from_slice(&from[..plane.len()]);
                        continue;
                    }
                    for (r, to) in plane.chunks_mut(apart).take(count).enumerate() {
                        to[..width].copy_from_slice(&from[r * row_pitch..][..width]);
                    }
                }
                let (dy, rows, pitch) = (&*packed, work.rows, work.pitch);
                let dots = Dots { x, x_pitch, dy, lines, line, offsets: &offsets, rows, pitch };
                let sums = &mut self.sums[first..];
                if S::REGISTERS >= 32 {
                    match pass {
                        8 => dots.run::<S, 8, 3>(s, 0, sums),
                        4 => dots.run::<S, 4, 6>(s, 0, sums),
                        2 => dots.run::<S, 2, 8>(s, 0, sums),
                        _ => dots.run::<S, 1, 12>(s, 0, sums),
                    }
                } else if pass == 1 {
                    dots.run::<S, 1, 4>(s, 0, sums);
                } else {
                    (0..pass).step_by(2).for_each(
                        #[inline(always)]
                        |first| dots.run::<S, 2, 2>(s, first, sums),
                    );
                }
            }
        }
    }
}

/// Gradients `[outputs][lines][line]` and a packed tile, whose lines are `x_pitch` apart.
struct Dots<'a> {
    x: &'a [f32],
    x_pitch: usize,
    dy: &'a [f32],
    lines: usize,
    line: usize,
    /// Where each row of sums reads, and some rows too many.
    offsets: &'a [usize],
    rows: usize,
    /// Floats of a row of sums.
    pitch: usize,
}

impl Dots<'_> {
    /// Adds to the sums of outputs `first..first + M`, `T` rows at a time.
    #[inline(always)]
    fn run<S: Simd, const M: usize, const T: usize>(&self, s: S, first: usize, sums: &mut [f32]) {
        let length = self.lines * self.line;
        assert!(self.dy.len() >= (first + M) * length);
        let offsets = self.offsets[..self.rows.next_multiple_of(T)].chunks_exact(T);
        for (offsets, sums) in offsets.zip(sums.chunks_mut(T * self.pitch)) {
            let mut acc = [[s.splat(0.0); M]; T];
            let mut x_line = self.x.as_ptr();
            let mut dy = self.dy.as_ptr().wrapping_add(first * length);
            for _ in 0..self.lines {
                for at in (0..self.line).step_by(LANES) {
                    let mut x = [s.splat(0.0); T];
                    for t in 0..T {
                        let from = x_line.wrapping_add(offsets[t] + at);
                        // SAFETY: the farthest row ends inside x (asserted by `run`).
                        x[t] = s.load(unsafe { &*from.cast() });
                    }
                    for m in 0..M {
                        let from = dy.wrapping_add(m * length);
                        // SAFETY: as many outputs (asserted above) of whole vectors.
                        let v = s.load(unsafe { &*from.cast() });
                        for t in 0..T {
                            acc[t][m] = x[t].fma(v, acc[t][m]);
                        }
                    }
                    dy = dy.wrapping_add(LANES);
                }
                x_line = x_line.wrapping_add(self.x_pitch);
            }
            for t in 0..T {
                let added = s.sums(acc[t]);
                for m in 0..M {
                    sums[t * self.pitch + first + m] += added[m];
                }
            }
        }
    }
}
