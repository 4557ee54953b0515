//! Front-to-back compositing of one 32×32 tile (3DGS section 6, eq. 3):
//! C = Σ c_i α_i T_i + T·background, T_i = Π_{j<i} (1 − α_j).
//!
//! A tile is 64 blocks of 4×4 pixels, a block one 16-lane vector per quantity. Splats come
//! in depth-ordered batches. Each splat has a bit for every block that its support can
//! intersect. The matrix of bits is transposed, so that each block reads its splats in depth
//! order, with its accumulators in registers. The kernel does not branch on pixels. A block
//! ends when all its pixels have stopped, and a tile when all its blocks have.
//!
//! Per pixel, in either convention: α = min(cap, o·e^(−σ)), skipped below 1/255;
//! blending stops before the splat that would take T to 10⁻⁴ or below (`standard`)
//! or below 10⁻⁴ (`mvsplat`).

pub(crate) use crate::layout::BlendRules as Rules;

use crate::cpu::raster::blocks::{intersected, transpose_bits};
use crate::cpu::raster::ewa::Footprint;
use crate::cpu::raster::tiles::Grid;
use crate::cpu::simd;
use crate::cpu::simd::elementary::exp2;
use crate::cpu::simd::{F32Vector, Kernel, Mask, Simd, Vector};
use crate::layout::{ALPHA_MIN_LOG2, BLOCK, TILE};

/// Pixels of a block.
pub(crate) const LANES: usize = BLOCK * BLOCK;
/// Blocks along a tile's side.
pub(crate) const BLOCKS: usize = TILE / BLOCK;
/// Words of a block's bits in one batch.
const WORDS: usize = 4;
/// Splats per batch: large enough to amortise the load and store of a block's accumulators,
/// small enough for the first-level cache.
const BATCH: usize = 64 * WORDS;

const _: () = assert!(LANES == simd::LANES);
const _: () = assert!(BLOCKS * BLOCKS == 64, "one bit per block in a 64-bit mask");

/// One value per pixel of a block.
pub(crate) type Lanes = [f32; LANES];

/// Accumulators of 4×4 pixels, row-major.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(crate) struct Block {
    /// Transmittance; negative where blending has stopped.
    pub(crate) t: Lanes,
    /// Σ w·c per colour channel.
    pub(crate) rgb: [Lanes; 3],
    /// Σ w·z.
    pub(crate) z: Lanes,
}

/// Accumulators of 32×32 pixels, blocks row-major.
#[derive(Clone, Debug)]
pub(crate) struct Tile {
    pub(crate) blocks: [Block; BLOCKS * BLOCKS],
}

impl Default for Tile {
    fn default() -> Self {
        Self { blocks: [Block::default(); BLOCKS * BLOCKS] }
    }
}

impl Tile {
    /// Clears the accumulators; pixels beyond `width` × `height` start as stopped.
    /// Returns the mask of blocks with a pixel inside.
    fn reset(&mut self, width: usize, height: usize) -> u64 {
        let mut live = 0;
        for (b, block) in self.blocks.iter_mut().enumerate() {
            *block = Block::default();
            let x = b % BLOCKS * BLOCK;
            let y = b / BLOCKS * BLOCK;
            for (l, t) in block.t.iter_mut().enumerate() {
                let inside = x + l % BLOCK < width && y + l / BLOCK < height;
                *t = if inside { 1.0 } else { -1.0 };
            }
            live |= u64::from(x < width && y < height) << b;
        }
        live
    }
}

/// Working memory of a thread.
#[derive(Default)]
pub(crate) struct Workplace {
    pub(crate) tile: Tile,
    batch: Batch,
}

/// Composites one tile into `place.tile`.
pub(crate) struct RenderTile<'a> {
    pub(crate) place: &'a mut Workplace,
    /// Index of the tile in `grid`.
    pub(crate) t: usize,
    pub(crate) grid: Grid,
    /// Places in `splats`, nearest first.
    pub(crate) order: &'a [u32],
    pub(crate) splats: &'a [u32],
    pub(crate) footprints: &'a [Footprint],
    pub(crate) rules: Rules,
}

impl Kernel for RenderTile<'_> {
    /// Number of (splat, block) items that were blended.
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> usize {
        let Self { place: Workplace { tile, batch }, t, grid, order, splats, footprints, rules } =
            self;
        let left = t % grid.columns * TILE;
        let top = t / grid.columns * TILE;
        let mut live = tile.reset(grid.width - left, grid.height - top);
        let corner = [left as f32, top as f32];
        let mut items = 0;
        let mut rest = order;
        while live != 0 && !rest.is_empty() {
            let (now, later) = rest.split_at(rest.len().min(BATCH));
            batch.load(s, now, splats, footprints, corner);
            let mut blocks = live;
            // Each block prefetches a few of the next batch's footprints: the number of
            // outstanding requests is limited.
            let portion = BATCH.div_ceil(live.count_ones() as usize);
            let mut wanted = later[..later.len().min(BATCH)].chunks(portion);
            while blocks != 0 {
                let b = blocks.trailing_zeros() as usize;
                blocks &= blocks - 1;
                for &place in wanted.next().unwrap_or(&[]) {
                    s.prefetch(&footprints[splats[place as usize] as usize]);
                }
                let (count, goes_on) = batch.blend(s, &mut tile.blocks[b], b, corner, rules);
                items += count;
                live &= !(u64::from(!goes_on) << b);
            }
            rest = later;
        }
        items
    }
}

/// Splats that are blended together.
struct Batch {
    footprints: [Footprint; BATCH],
    /// Bits of each block: its splats among the batch.
    words: [[u64; BLOCKS * BLOCKS]; WORDS],
}

impl Default for Batch {
    fn default() -> Self {
        Self { footprints: [Footprint::default(); BATCH], words: [[0; 64]; WORDS] }
    }
}

impl Batch {
    /// Loads the splats at `places` and finds the blocks that they intersect.
    #[inline(always)]
    fn load<S: Simd>(
        &mut self,
        s: S,
        places: &[u32],
        splats: &[u32],
        footprints: &[Footprint],
        corner: [f32; 2],
    ) {
        let mut masks = [[0; LANES]; BATCH / LANES];
        let groups = places.chunks(LANES).zip(self.footprints.chunks_exact_mut(LANES));
        for ((places, to), masks) in groups.zip(&mut masks) {
            let mut rows = [s.splat(0.0); LANES];
            for l in 0..LANES {
                // Spare lanes repeat the last splat; their bits are cleared below.
                let place = places[l.min(places.len() - 1)];
                rows[l] = s.load(footprints[splats[place as usize] as usize].fields());
                s.store(rows[l], to[l].fields_mut());
            }
            intersected(s, s.transpose(rows), corner, masks);
            masks[places.len()..].fill(0);
        }
        for (words, masks) in self.words.iter_mut().zip(masks.chunks_exact(4)) {
            for (to, from) in words.chunks_exact_mut(LANES).zip(masks) {
                to.copy_from_slice(from);
            }
            transpose_bits(words);
        }
    }

    /// Blends the batch into block `b`. Returns the number of splats and whether a pixel is
    /// still live.
    #[inline(always)]
    fn blend<S: Simd>(
        &self,
        s: S,
        block: &mut Block,
        b: usize,
        corner: [f32; 2],
        rules: Rules,
    ) -> (usize, bool) {
        const ACROSS: Lanes = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
        const DOWN: Lanes = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];
        let x = s.load(&ACROSS) + s.splat(corner[0] + (b % BLOCKS * BLOCK) as f32);
        let y = s.load(&DOWN) + s.splat(corner[1] + (b / BLOCKS * BLOCK) as f32);
        let (least, cap) = (s.splat(ALPHA_MIN_LOG2), s.splat(rules.alpha_max));
        let stop = s.splat(rules.stop);
        let mut t = s.load(&block.t);
        let [mut red, mut green, mut blue] =
            [s.load(&block.rgb[0]), s.load(&block.rgb[1]), s.load(&block.rgb[2])];
        let mut z = s.load(&block.z);
        let mut count = 0;
        let mut goes_on = true;
        'batch: for (words, footprints) in self.words.iter().zip(self.footprints.chunks_exact(64)) {
            let mut bits = words[b];
            while bits != 0 {
                let f = &footprints[bits.trailing_zeros() as usize & 63];
                bits &= bits - 1;
                count += 1;
                let (dx, dy) = (x - s.splat(f.u), y - s.splat(f.v));
                let across = s.splat(f.shear).fma(dy, dx) * s.splat(f.sx);
                let down = dy * s.splat(f.sy);
                let power = down.fnma(down, across.fnma(across, s.splat(f.power)));
                // The clamp avoids denormals.
                let alpha = cap.min(exp2(least.max(power)));
                let alpha = least.le(power).select_or_zero(alpha);
                let rest = alpha.fnma(t, t);
                // A live pixel has T > stop, so an alpha of 0 changes nothing. A stopped one
                // has T < 0 and stays stopped.
                let goes = stop.lt(rest);
                let w = goes.select_or_zero(alpha * t);
                t = goes.select(rest, t.neg_abs());
                red = w.fma(s.splat(f.rgb[0]), red);
                green = w.fma(s.splat(f.rgb[1]), green);
                blue = w.fma(s.splat(f.rgb[2]), blue);
                z = w.fma(s.splat(f.z), z);
                if !goes.any() {
                    goes_on = false;
                    break 'batch;
                }
            }
        }
        if count > 0 {
            s.store(t, &mut block.t);
            s.store(red, &mut block.rgb[0]);
            s.store(green, &mut block.rgb[1]);
            s.store(blue, &mut block.rgb[2]);
            s.store(z, &mut block.z);
        }
        (count, goes_on)
    }
}
