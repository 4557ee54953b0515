//! Front-to-back compositing of one 32×32 tile (3DGS section 6, eq. 3):
//! C = Σ c_i α_i T_i + T·background, T_i = Π_{j<i} (1 − α_j).
//!
//! A tile is 64 blocks of 4×4 pixels, a block one 16-lane register per quantity.
//! Splats come in batches of 64, depth-ordered: each splat sets its bit in the
//! 64-bit mask of every block that its support can meet, then each block walks its
//! mask from the lowest bit, which is depth order again, with its accumulators at
//! hand. A block whose pixels have all stopped leaves; so does the tile.
//!
//! Per pixel, in either convention: α = min(cap, o·e^(−σ)), skipped below 1/255;
//! blending stops before the splat that would take T to 10⁻⁴ or below (`standard`)
//! or below 10⁻⁴ (`mvsplat`).

use crate::abi::{
    ALPHA_MAX_MVSPLAT, ALPHA_MAX_STANDARD, ALPHA_MIN_LOG2, BLOCK, Convention, TILE,
    TRANSMITTANCE_MIN,
};
use crate::cpu::ewa::Footprint;
use crate::cpu::tiles::Grid;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Pixels of a block.
pub(crate) const LANES: usize = BLOCK * BLOCK;
/// Blocks along a tile's side.
pub(crate) const BLOCKS: usize = TILE / BLOCK;
/// Splats per batch: the bits of a block's mask.
const BATCH: usize = 64;

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

/// The two numbers in which the conventions blend differently.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rules {
    pub(crate) alpha_max: f32,
    /// Blending stops where T would become this or less.
    pub(crate) stop: f32,
}

impl Rules {
    pub(crate) fn new(convention: Convention) -> Self {
        match convention {
            Convention::Standard => Self { alpha_max: ALPHA_MAX_STANDARD, stop: TRANSMITTANCE_MIN },
            Convention::Mvsplat => {
                Self { alpha_max: ALPHA_MAX_MVSPLAT, stop: TRANSMITTANCE_MIN.next_down() }
            }
        }
    }
}

impl Tile {
    /// Composites `list`, nearest first, into tile `t` of `grid`; returns how many
    /// (splat, block) items were blended.
    pub(crate) fn render(
        &mut self,
        t: usize,
        grid: &Grid,
        list: &[AtomicU32],
        footprints: &[Footprint],
        rules: Rules,
    ) -> usize {
        let (left, top) = (t % grid.columns * TILE, t / grid.columns * TILE);
        let mut live = self.reset(grid.width - left, grid.height - top);
        let mut items = 0;
        let mut masks = [0u64; BLOCKS * BLOCKS];
        let mut batch = [Footprint::default(); BATCH];
        for entries in list.chunks(BATCH) {
            // All loads first: they miss the cache, and side by side they overlap.
            for (entry, slot) in entries.iter().zip(&mut batch) {
                *slot = footprints[entry.load(Relaxed) as usize];
            }
            for (s, f) in batch[..entries.len()].iter_mut().enumerate() {
                // Tile coordinates from here on: small numbers keep their digits.
                f.u -= left as f32;
                f.v -= top as f32;
                mark(f, [left, top], 1 << s, &mut masks);
            }
            for b in bits(live) {
                let block = &mut self.blocks[b];
                let (x, y) = ((b % BLOCKS * BLOCK) as f32, (b / BLOCKS * BLOCK) as f32);
                for s in bits(masks[b]) {
                    items += 1;
                    if !block.blend(&batch[s], x, y, rules) {
                        live &= !(1 << b);
                        break;
                    }
                }
            }
            if live == 0 {
                break;
            }
            masks.fill(0);
        }
        items
    }

    /// Clears the accumulators; pixels beyond `width` × `height` start as stopped.
    /// Returns the mask of blocks with a pixel inside.
    fn reset(&mut self, width: usize, height: usize) -> u64 {
        let mut live = 0;
        for (b, block) in self.blocks.iter_mut().enumerate() {
            *block = Block::default();
            let (x, y) = (b % BLOCKS * BLOCK, b / BLOCKS * BLOCK);
            for (l, t) in block.t.iter_mut().enumerate() {
                let inside = x + l % BLOCK < width && y + l / BLOCK < height;
                *t = if inside { 1.0 } else { -1.0 };
            }
            live |= u64::from(x < width && y < height) << b;
        }
        live
    }
}

/// Sets `bit` in the mask of every block that `f` (in tile coordinates, its pixel
/// rectangle in the picture's) can touch in the tile at `corner`.
fn mark(f: &Footprint, corner: [usize; 2], bit: u64, masks: &mut [u64; BLOCKS * BLOCKS]) {
    let cells = |from: u32, to: u32, corner: usize| {
        let from = (from as usize).saturating_sub(corner) / BLOCK;
        let to = (to as usize).saturating_sub(corner).min(TILE).div_ceil(BLOCK);
        (from, to)
    };
    let (first, past) = cells(f.x0, f.x1, corner[0]);
    let (top, bottom) = cells(f.y0, f.y1, corner[1]);
    for row in top..bottom {
        let y = (row * BLOCK) as f32;
        let Some((left, right)) = f.span(y, y + (BLOCK - 1) as f32) else { continue };
        if right < 0.0 {
            continue;
        }
        // `as` takes what lies left of the tile to column 0.
        let from = first.max(left as usize / BLOCK);
        let to = past.min(right as usize / BLOCK + 1);
        for column in from..to {
            masks[row * BLOCKS + column] |= bit;
        }
    }
}

impl Block {
    /// Blends one splat into the block whose first pixel is (x, y), in the splat's
    /// coordinates. Returns whether a pixel still goes on.
    #[inline]
    fn blend(&mut self, f: &Footprint, x: f32, y: f32, rules: Rules) -> bool {
        let mut alpha = power(f, x, y);
        alpha_of(&mut alpha, rules.alpha_max);
        let [red, green, blue] = f.rgb;
        let [r, g, b] = &mut self.rgb;
        // One loop over whole arrays, by index: the form that becomes vectors.
        for l in 0..LANES {
            let t = self.t[l];
            // Where blending has stopped, t < 0 and nothing more is added.
            let w = alpha[l] * if t > 0.0 { t } else { 0.0 };
            let rest = t - w;
            let stop = rest <= rules.stop;
            let w = if stop { 0.0 } else { w };
            self.t[l] = if stop { -t.abs() } else { rest };
            r[l] += w * red;
            g[l] += w * green;
            b[l] += w * blue;
            self.z[l] += w * f.z;
        }
        any_positive(&self.t)
    }
}

/// log₂(o·e^(−σ)) at the pixels of the block at (x, y).
#[inline]
fn power(f: &Footprint, x: f32, y: f32) -> Lanes {
    let mut across = [0.0; BLOCK];
    let mut down = [(0.0, 0.0); BLOCK];
    for i in 0..BLOCK {
        across[i] = f.sx * (x + i as f32 - f.u);
        let dy = y + i as f32 - f.v;
        let s = f.sy * dy;
        down[i] = (f.sx * f.shear * dy, f.power - s * s);
    }
    let mut out = [0.0; LANES];
    for (row, (skew, rest)) in out.chunks_exact_mut(BLOCK).zip(down) {
        for (p, a) in row.iter_mut().zip(across) {
            let d = a + skew;
            *p = rest - d * d;
        }
    }
    out
}

/// Powers to alphas, in place: min(`cap`, 2^p), 0 where that is below 1/255.
///
/// 2^p = 2^n·2^f, n the nearest integer: 2^f by a minimax polynomial of degree 5 on
/// [−½, ½] (relative error 7.5e-8), 2^n by shifting n into the exponent. The mask
/// comes from p and p is clamped, so no denormal is ever made.
#[inline]
fn alpha_of(p: &mut Lanes, cap: f32) {
    /// 1.5·2²³: adding it leaves the nearest integer in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    const C: [f32; 6] =
        [1.000_000_1, 0.693_146_94, 0.240_221_2, 0.055_507_13, 0.009_675_541, 0.001_327_647_2];
    let least = ALPHA_MIN_LOG2;
    for v in p {
        let p = if *v < least { least } else { *v };
        let shifted = p + ROUND;
        let f = p - (shifted - ROUND);
        let m = C[0] + f * (C[1] + f * (C[2] + f * (C[3] + f * (C[4] + f * C[5]))));
        // The low bits hold n; those of ROUND itself leave by the shift.
        let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
        let alpha = m * scale;
        let alpha = if alpha < cap { alpha } else { cap };
        *v = if *v < least { 0.0 } else { alpha };
    }
}

#[inline(always)]
pub(crate) fn any_positive(v: &Lanes) -> bool {
    let mut most = [f32::MIN; BLOCK];
    for row in v.chunks_exact(BLOCK) {
        for (m, x) in most.iter_mut().zip(row) {
            *m = if *x > *m { *x } else { *m };
        }
    }
    most.iter().any(|&m| m > 0.0)
}

/// Positions of the set bits, lowest first.
pub(crate) fn bits(mut mask: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        (mask != 0).then(|| {
            let b = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            b
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alphas_are_exponentials() {
        assert_eq!(ALPHA_MIN_LOG2, f64::from(crate::abi::ALPHA_MIN).log2() as f32);
        let mut worst = 0.0f64;
        for i in 0..=80_000 {
            let p = -7.99 + f64::from(i) * 1e-4;
            let mut lanes = [p as f32; LANES];
            alpha_of(&mut lanes, 0.999);
            let expected = f64::from(p as f32).exp2().min(f64::from(0.999f32));
            worst = worst.max((f64::from(lanes[5]) / expected - 1.0).abs());
        }
        assert!(worst < 3e-7, "{worst:e}");
        let mut lanes = [-7.995; LANES];
        (lanes[0], lanes[1], lanes[2]) = (-1e30, f32::NEG_INFINITY, 60.0);
        alpha_of(&mut lanes, 0.99);
        assert_eq!(lanes[..4], [0.0, 0.0, 0.99, 0.0]);
    }

    #[test]
    fn bits_come_in_order() {
        assert_eq!(bits(0x8000_0000_0000_0015).collect::<Vec<_>>(), [0, 2, 4, 63]);
        assert_eq!(bits(0).count(), 0);
    }
}
