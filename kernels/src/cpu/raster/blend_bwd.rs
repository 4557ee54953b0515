//! Backward of [`crate::cpu::raster::blend`] for one 32×32 tile: once forward, once back.
//!
//! With q_i = c_i·∂L/∂rgb + z_i·∂L/∂depth of splat i at a pixel, b the same of the
//! background (bg·∂L/∂rgb − ∂L/∂alpha) and w_i = α_i T_i, the loss depends on a pixel
//! by Σ w_i q_i + T b, whence (3DGS appendix)
//!
//! ∂L/∂ln α_i = w_i q_i − α_i/(1 − α_i)·(Σ_{j>i} w_j q_j + T b) = w_i (q_i − B_i),
//!
//! where B_i = (Σ_{j>i} w_j q_j + T b) / T_{i+1} is q composited behind splat i, as if nothing
//! were before it: B_{i−1} = B_i + α_i (q_i − B_i), b behind the last. The recursion has
//! neither a division nor a difference of sums, so hidden splats keep their digits.
//!
//! The first pass repeats the forward's decisions by the forward's own operations. It stores
//! the mask of changed blocks per (splat, tile), and an [`Item`] per (splat, block) of those.
//! The second pass reads them back to front.
//!
//! It handles one splat at a time over its blocks, with ten sums in registers: one reduction
//! and one row per (splat, tile). Items are stored for a stretch of the list at a time,
//! [`ITEMS`] or little more. All stretches of a longer list but the last repeat the first
//! pass from a stored T.

use crate::cpu::raster::blend::{BLOCKS, Lanes, Rules};
use crate::cpu::raster::blocks::intersected;
use crate::cpu::raster::ewa::Footprint;
use crate::cpu::raster::ewa_bwd::Moments;
use crate::cpu::raster::tiles::Grid;
use crate::cpu::simd::elementary::exp2;
use crate::cpu::simd::{F32Vector, Kernel, LANES, Mask, Simd, Vector};
use crate::layout::{ALPHA_MIN_LOG2, BLOCK, TILE};

/// Sums kept per (splat, tile): the numbers of [`Moments`].
pub(crate) const SUMS: usize = 10;
/// Items after which a stretch of a list ends: 4 MiB per thread; the next splats may add
/// 128 KiB.
const ITEMS: usize = 1 << 15;
/// Items that the splats of one step forward can make.
const STEP: usize = LANES * BLOCKS * BLOCKS;
/// Distance of prefetches, splats.
const AHEAD: usize = LANES;

/// Sums of one splat over one tile, in the order of [`Moments`].
pub(crate) type PairSums = [f32; SUMS];

impl From<PairSums> for Moments {
    #[inline(always)]
    fn from([one, d, s, dd, ds, ss, r, g, b, z]: PairSums) -> Self {
        Self { one, d, s, dd, ds, ss, rgb: [r, g, b], z }
    }
}

/// The gradient of the loss with respect to a picture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Upstream<'a> {
    /// `[5, H, W]`: ∂L/∂ R, G, B, alpha, Σ w·z.
    pub(crate) planes: &'a [f32],
    pub(crate) background: [f32; 3],
}

/// The contribution of a splat to the pixels of a block.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Item {
    /// α, 0 where nothing is blended.
    alpha: Lanes,
    /// α·T.
    w: Lanes,
}

/// State at the start of a stretch of a list.
#[derive(Clone, Debug)]
struct Stretch {
    /// Place in the order.
    from: usize,
    live: u64,
    /// T of every block.
    t: [Lanes; BLOCKS * BLOCKS],
}

/// Working memory of a thread, reused from tile to tile.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    items: Vec<Item>,
    stretches: Vec<Stretch>,
}

impl Scratch {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        self.items.capacity() * size_of::<Item>() + self.stretches.capacity() * size_of::<Stretch>()
    }
}

/// One block on its way.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Walk {
    /// Transmittance; negative where blending has stopped.
    t: Lanes,
    /// B of the splats passed on the way back; at first the background's b.
    behind: Lanes,
    /// ∂L/∂ R, G, B, Σ w·z.
    g: [Lanes; 4],
}

/// The blocks of a tile, and x and y of their pixels by column and row.
#[repr(C, align(64))]
struct Walks {
    x: [Lanes; BLOCKS],
    y: [Lanes; BLOCKS],
    blocks: [Walk; BLOCKS * BLOCKS],
}

/// The backward of one tile; returns Σ T·∂L/∂rgb over its pixels.
pub(crate) struct WalkTile<'a> {
    /// Index of the tile in `grid`.
    pub(crate) t: usize,
    pub(crate) grid: Grid,
    /// Places in `splats` and `rows`, nearest first.
    pub(crate) order: &'a [u32],
    pub(crate) splats: &'a [u32],
    pub(crate) footprints: &'a [Footprint],
    pub(crate) rules: Rules,
    pub(crate) upstream: Upstream<'a>,
    /// A mask per splat of the list.
    pub(crate) masks: &'a mut [u64],
    /// A row for every splat of the list.
    pub(crate) rows: &'a mut [PairSums],
    pub(crate) scratch: &'a mut Scratch,
}

impl Kernel for WalkTile<'_> {
    type Output = [f64; 3];

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> [f64; 3] {
        let corner = [self.t % self.grid.columns * TILE, self.t / self.grid.columns * TILE];
        let (mut walks, mut live) = Walks::start(s, corner, &self.grid, self.upstream);
        let corner = corner.map(|c| c as f32);
        self.scratch.stretches.clear();
        let count = self.order.len();
        let (mut reached, mut items) = (0, 0);
        while reached < count && live != 0 {
            let stretch = Stretch { from: reached, live, t: walks.transmittances() };
            self.scratch.stretches.push(stretch);
            (reached, items) = self.forward(s, &mut walks, &mut live, reached, corner);
        }
        let total = walks.background(s);
        let mut past = reached;
        while let Some(stretch) = self.scratch.stretches.pop() {
            if past < reached {
                let mut live = stretch.live;
                for (walk, t) in walks.blocks.iter_mut().zip(&stretch.t) {
                    walk.t = *t;
                }
                (_, items) = self.forward(s, &mut walks, &mut live, stretch.from, corner);
            }
            self.back(s, &mut walks, stretch.from..past, items);
            past = stretch.from;
        }
        for &place in &self.order[reached..] {
            if let Some(row) = self.rows.get_mut(place as usize) {
                *row = [0.0; SUMS];
            }
        }
        total
    }
}

impl WalkTile<'_> {
    #[inline(always)]
    fn footprint(&self, i: usize) -> &Footprint {
        &self.footprints[self.splats[self.order[i] as usize] as usize]
    }

    /// Advances `walks` from splat `from` of the order to the end of its stretch: enough
    /// items, the last splat, or all pixels stopped. Returns the end and the number of items.
    /// Writes the changed blocks to `masks`, by place in the order.
    #[inline(always)]
    fn forward<S: Simd>(
        &mut self,
        s: S,
        walks: &mut Walks,
        live: &mut u64,
        mut from: usize,
        corner: [f32; 2],
    ) -> (usize, usize) {
        let count = self.order.len();
        let mut items = 0;
        while from < count && *live != 0 && items < ITEMS {
            let past = (from + LANES).min(count);
            let mut i = past;
            while i < (past + AHEAD).min(count) {
                s.prefetch(self.footprint(i));
                i += 1;
            }
            if self.scratch.items.len() < items + STEP {
                let empty = Item { alpha: [0.0; LANES], w: [0.0; LANES] };
                self.scratch.items.resize((2 * items).max(items + STEP), empty);
            }
            let mut masks = [0; LANES];
            let mut fields = [s.splat(0.0); LANES];
            for (l, field) in fields.iter_mut().enumerate() {
                // Spare lanes repeat the last splat; the loop below skips them.
                *field = s.load(self.footprint((from + l).min(past - 1)).fields());
            }
            intersected(s, s.transpose(fields), corner, &mut masks);
            for i in from..past {
                let f = &self.footprints[self.splats[self.order[i] as usize] as usize];
                let mut mask = masks[i - from] & *live;
                let mut blocks = mask;
                while blocks != 0 {
                    let b = blocks.trailing_zeros() as usize;
                    blocks &= blocks - 1;
                    let Some(item) = self.scratch.items.get_mut(items) else { break };
                    let (changed, goes_on) = step_forward(s, walks, b, f, self.rules, item);
                    items += usize::from(changed);
                    mask &= !(u64::from(!changed) << b);
                    *live &= !(u64::from(!goes_on) << b);
                }
                self.masks[i] = mask;
            }
            from = past;
        }
        (from, items)
    }

    /// Moves `walks` back over one stretch, whose items are the first `items`, and writes the
    /// rows of its splats.
    #[inline(always)]
    fn back<S: Simd>(
        &mut self,
        s: S,
        walks: &mut Walks,
        stretch: std::ops::Range<usize>,
        items: usize,
    ) {
        let first = stretch.start;
        let mut rest = self.scratch.items.get(..items).unwrap_or(&[]);
        for i in stretch.rev() {
            s.prefetch(self.footprint(i.saturating_sub(AHEAD).max(first)));
            let f = self.footprint(i);
            let mut blocks = self.masks[i];
            let mut row = [0.0; SUMS];
            if blocks != 0 {
                let mut sums = [s.splat(0.0); SUMS];
                let (before, own) =
                    rest.split_at(rest.len().saturating_sub(blocks.count_ones() as usize));
                rest = before;
                for item in own {
                    let b = blocks.trailing_zeros() as usize;
                    blocks &= blocks.wrapping_sub(1);
                    sums = step_back(s, walks, b, f, self.rules, item, sums);
                }
                row = s.sums(sums);
            }
            if let Some(to) = self.rows.get_mut(self.order[i] as usize) {
                *to = row;
            }
        }
    }
}

impl Walks {
    /// The blocks of the tile at `corner`, and the mask of those with a pixel inside.
    #[inline(always)]
    fn start<S: Simd>(
        s: S,
        corner: [usize; 2],
        grid: &Grid,
        Upstream { planes, background }: Upstream,
    ) -> (Self, u64) {
        let (width, height) = (grid.width - corner[0], grid.height - corner[1]);
        let pixels = grid.width * grid.height;
        let empty = [0.0; LANES];
        let walk = Walk { t: [-1.0; LANES], behind: empty, g: [empty; 4] };
        let mut walks =
            Self { x: [empty; BLOCKS], y: [empty; BLOCKS], blocks: [walk; BLOCKS * BLOCKS] };
        for k in 0..BLOCKS {
            for l in 0..LANES {
                walks.x[k][l] = (corner[0] + k * BLOCK + l % BLOCK) as f32;
                walks.y[k][l] = (corner[1] + k * BLOCK + l / BLOCK) as f32;
            }
        }
        let background = background.map(|v| s.splat(v));
        let mut live = 0u64;
        for b in 0..BLOCKS * BLOCKS {
            let x = b % BLOCKS * BLOCK;
            let y = b / BLOCKS * BLOCK;
            if x >= width || y >= height {
                continue;
            }
            live |= 1 << b;
            let walk = &mut walks.blocks[b];
            let mut alpha = empty;
            let first = (corner[1] + y) * grid.width + corner[0] + x;
            for r in 0..BLOCK.min(height - y) {
                let lane = r * BLOCK;
                let n = BLOCK.min(width - x);
                let at = first + r * grid.width;
                walk.t[lane..lane + n].fill(1.0);
                let [red, green, blue, depth] = &mut walk.g;
                for (c, to) in [red, green, blue, &mut alpha, depth].into_iter().enumerate() {
                    copy(&mut to[lane..lane + n], &planes[c * pixels + at..]);
                }
            }
            let (red, green, blue) = (s.load(&walk.g[0]), s.load(&walk.g[1]), s.load(&walk.g[2]));
            let colour = green.fma(background[1], red * background[0]);
            s.store(blue.fma(background[2], colour) - s.load(&alpha), &mut walk.behind);
        }
        (walks, live)
    }

    #[inline(always)]
    fn transmittances(&self) -> [Lanes; BLOCKS * BLOCKS] {
        let mut t = [[0.0; LANES]; BLOCKS * BLOCKS];
        for (t, walk) in t.iter_mut().zip(&self.blocks) {
            *t = walk.t;
        }
        t
    }

    /// Σ |T|·∂L/∂rgb.
    #[inline(always)]
    fn background<S: Simd>(&self, s: S) -> [f64; 3] {
        let mut total = [0.0f64; 3];
        for row in self.blocks.chunks_exact(BLOCKS) {
            let mut sums = [s.splat(0.0); 3];
            for walk in row {
                let t = s.load(&walk.t).abs();
                for (sum, g) in sums.iter_mut().zip(&walk.g) {
                    *sum = t.fma(s.load(g), *sum);
                }
            }
            for (total, sum) in total.iter_mut().zip(sums) {
                *total += f64::from(s.sum(sum));
            }
        }
        total
    }

    /// Distances of block `b`'s pixels from the mean of `f`, whitened.
    #[inline(always)]
    fn whitened<S: Simd>(&self, s: S, b: usize, f: &Footprint) -> [S::F; 2] {
        let dx = s.load(&self.x[b % BLOCKS]) - s.splat(f.u);
        let dy = s.load(&self.y[b / BLOCKS % BLOCKS]) - s.splat(f.v);
        [s.splat(f.shear).fma(dy, dx) * s.splat(f.sx), dy * s.splat(f.sy)]
    }
}

/// Copies the first of `from` over `to`; a whole row of a block without a loop.
#[inline(always)]
fn copy(to: &mut [f32], from: &[f32]) {
    match (<&mut [f32; BLOCK]>::try_from(&mut *to), from.first_chunk::<BLOCK>()) {
        (Ok(to), Some(from)) => *to = *from,
        _ => to.iter_mut().zip(from).for_each(|(to, from)| *to = *from),
    }
}

/// Blends a splat into block `b` by the forward's own operations. Returns whether it changed
/// a pixel, and whether a pixel is still live.
#[inline(always)]
fn step_forward<S: Simd>(
    s: S,
    walks: &mut Walks,
    b: usize,
    f: &Footprint,
    rules: Rules,
    item: &mut Item,
) -> (bool, bool) {
    let (least, zero) = (s.splat(ALPHA_MIN_LOG2), s.splat(0.0));
    let [across, down] = walks.whitened(s, b, f);
    let power = down.fnma(down, across.fnma(across, s.splat(f.power)));
    let alpha = s.splat(rules.alpha_max).min(exp2(least.max(power)));
    let walk = &mut walks.blocks[b % (BLOCKS * BLOCKS)];
    let t = s.load(&walk.t);
    let shows = least.le(power);
    let rest = shows.select_or_zero(alpha).fnma(t, t);
    // A stopped pixel has T < 0, and the rest is negative, too.
    let goes = s.splat(rules.stop).lt(rest);
    let adds = goes & shows;
    let alpha = adds.select_or_zero(alpha);
    s.store(alpha, &mut item.alpha);
    s.store(alpha * zero.max(t), &mut item.w);
    s.store(goes.select(rest, t.neg_abs()), &mut walk.t);
    (adds.any(), goes.any())
}

/// Steps back over a splat at block `b`; adds to `sums`.
#[inline(always)]
fn step_back<S: Simd>(
    s: S,
    walks: &mut Walks,
    b: usize,
    f: &Footprint,
    rules: Rules,
    item: &Item,
    sums: [S::F; SUMS],
) -> [S::F; SUMS] {
    let [across, down] = walks.whitened(s, b, f);
    let walk = &mut walks.blocks[b % (BLOCKS * BLOCKS)];
    let (alpha, w) = (s.load(&item.alpha), s.load(&item.w));
    let g = [s.load(&walk.g[0]), s.load(&walk.g[1]), s.load(&walk.g[2]), s.load(&walk.g[3])];
    let q = g[2].fma(s.splat(f.rgb[2]), g[3] * s.splat(f.z));
    let q = g[0].fma(s.splat(f.rgb[0]), g[1].fma(s.splat(f.rgb[1]), q));
    let behind = s.load(&walk.behind);
    let more = q - behind;
    s.store(alpha.fma(more, behind), &mut walk.behind);
    let v = alpha.lt(s.splat(rules.alpha_max)).select_or_zero(w * more);
    let (va, vd) = (v * across, v * down);
    [
        sums[0] + v,
        sums[1] + va,
        sums[2] + vd,
        va.fma(across, sums[3]),
        va.fma(down, sums[4]),
        vd.fma(down, sums[5]),
        w.fma(g[0], sums[6]),
        w.fma(g[1], sums[7]),
        w.fma(g[2], sums[8]),
        w.fma(g[3], sums[9]),
    ]
}
