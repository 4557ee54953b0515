//! Backward of [`crate::cpu::blend`] for one 32×32 tile, front to back as the forward.
//!
//! With q_i = c_i·∂L/∂rgb + z_i·∂L/∂depth of splat i at a pixel, b the same of the
//! background (bg·∂L/∂rgb − ∂L/∂alpha) and w_i = α_i T_i, the part of the loss that
//! pixels see is Σ w_i q_i + T b, whence (3DGS appendix)
//!
//! ∂L/∂ln α_i = w_i q_i − α_i/(1 − α_i)·(Σ_{j>i} w_j q_j + T b).
//!
//! The forward leaves Σ w c, Σ w z and T of every pixel, so the sum over what lies
//! behind is known at the first splat and shrinks by w_i q_i at each: nothing per pixel
//! and splat is stored, and the decisions (skip, cap, stop) are taken by the forward's
//! own expressions. Splats go one by one, each over the blocks that it can touch, its
//! ten sums in registers; one reduction and one row per (splat, tile).

use crate::cpu::blend::{BLOCKS, LANES, Lanes, Rules, Tile, any_positive, bits};
use crate::cpu::ewa::Footprint;
use crate::cpu::ewa_bwd::Moments;
use crate::cpu::tiles::Grid;
use crate::abi::{ALPHA_MIN_LOG2, BLOCK, TILE};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Splats whose footprints are fetched side by side.
const BATCH: usize = 64;
/// Sums kept per (splat, tile): the numbers of [`Moments`].
pub(crate) const SUMS: usize = 10;

/// What one tile says of one splat, in the order of [`Moments`].
pub(crate) type PairSums = [f32; SUMS];

impl From<PairSums> for Moments {
    fn from([one, d, s, dd, ds, ss, r, g, b, z]: PairSums) -> Self {
        Self { one, d, s, dd, ds, ss, rgb: [r, g, b], z }
    }
}

/// The gradient that arrives at a picture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Upstream<'a> {
    /// `[5, H, W]`: ∂L/∂ R, G, B, alpha, Σ w·z.
    pub(crate) planes: &'a [f32],
    pub(crate) background: [f32; 3],
}

/// What a tile's backward leaves besides its rows.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Report {
    /// Rows written; what lies behind met no pixel that still went on.
    pub(crate) reached: usize,
    /// Σ T·∂L/∂rgb over the tile's pixels.
    pub(crate) background: [f64; 3],
}

/// One block on its way from front to back.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Walk {
    /// Transmittance; negative where blending has stopped.
    t: Lanes,
    /// Σ w q of the splats still to come, with T·b of the end.
    behind: Lanes,
    /// ∂L/∂ R, G, B, Σ w·z.
    g: [Lanes; 4],
}

/// x and y of a block's pixels.
const ACROSS: Lanes = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
const DOWN: Lanes = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];

/// Walks `list` through tile `t` of `grid`, whose forward left `done`; `rows[i]`
/// becomes the sums of the i-th splat.
#[inline(always)]
pub(crate) fn backward(
    (t, grid): (usize, &Grid),
    list: &[AtomicU32],
    footprints: &[Footprint],
    (done, rules): (&Tile, Rules),
    upstream: Upstream,
    rows: &mut [PairSums],
) -> Report {
    let corner = [t % grid.columns * TILE, t / grid.columns * TILE];
    let mut walks = [Walk { t: [-1.0; LANES], behind: [0.0; LANES], g: [[0.0; LANES]; 4] }; 64];
    let (mut live, background) = start(&mut walks, done, corner, grid, upstream);
    let mut batch = [Footprint::default(); BATCH];
    let chunks = list.chunks(BATCH).zip(rows.chunks_mut(BATCH));
    for (c, (entries, rows)) in chunks.enumerate() {
        for (entry, slot) in entries.iter().zip(&mut batch) {
            *slot = footprints[entry.load(Relaxed) as usize];
        }
        for (i, (f, row)) in batch.iter_mut().zip(rows).enumerate() {
            f.u -= corner[0] as f32;
            f.v -= corner[1] as f32;
            let mut sums = [[0.0; LANES]; SUMS];
            for b in bits(blocks(f, corner) & live) {
                let at = [(b % BLOCKS * BLOCK) as f32, (b / BLOCKS * BLOCK) as f32];
                if !step(&mut walks[b], f, at, rules, &mut sums) {
                    live &= !(1 << b);
                }
            }
            *row = sums.map(fold);
            if live == 0 {
                return Report { reached: c * BATCH + i + 1, background };
            }
        }
    }
    Report { reached: list.len(), background }
}

/// Fills `walks`; returns the blocks with a pixel inside and the background's gradient.
fn start(
    walks: &mut [Walk; BLOCKS * BLOCKS],
    done: &Tile,
    corner: [usize; 2],
    grid: &Grid,
    Upstream { planes, background }: Upstream,
) -> (u64, [f64; 3]) {
    let (width, height) = (grid.width - corner[0], grid.height - corner[1]);
    let pixels = grid.width * grid.height;
    let (mut live, mut total) = (0, [0.0f64; 3]);
    for (b, (walk, done)) in walks.iter_mut().zip(&done.blocks).enumerate() {
        let (x, y) = (b % BLOCKS * BLOCK, b / BLOCKS * BLOCK);
        if x >= width || y >= height {
            continue;
        }
        live |= 1 << b;
        for l in 0..LANES {
            let (x, y) = (x + l % BLOCK, y + l / BLOCK);
            if x >= width || y >= height {
                continue;
            }
            let p = (corner[1] + y) * grid.width + corner[0] + x;
            let g: [f32; 5] = std::array::from_fn(|c| planes[c * pixels + p]);
            let rest = done.t[l].abs();
            let mut behind = g[4] * done.z[l] - rest * g[3];
            for c in 0..3 {
                behind += g[c] * (done.rgb[c][l] + rest * background[c]);
                total[c] += f64::from(rest * g[c]);
                walk.g[c][l] = g[c];
            }
            walk.g[3][l] = g[4];
            walk.t[l] = 1.0;
            walk.behind[l] = behind;
        }
    }
    (live, total)
}

/// Mask of the blocks that `f` (in tile coordinates, its pixel rectangle in the
/// picture's) can touch in the tile at `corner`: the forward's own choice.
#[inline(always)]
fn blocks(f: &Footprint, corner: [usize; 2]) -> u64 {
    let cells = |from: u32, to: u32, corner: usize| {
        let from = (from as usize).saturating_sub(corner) / BLOCK;
        let to = (to as usize).saturating_sub(corner).min(TILE).div_ceil(BLOCK);
        (from, to)
    };
    let (first, past) = cells(f.x0, f.x1, corner[0]);
    let (top, bottom) = cells(f.y0, f.y1, corner[1]);
    let mut mask = 0;
    for row in top..bottom {
        let y = (row * BLOCK) as f32;
        let Some((left, right)) = f.span(y, y + (BLOCK - 1) as f32) else { continue };
        if right < 0.0 {
            continue;
        }
        let from = first.max(left as usize / BLOCK);
        let to = past.min(right as usize / BLOCK + 1);
        if from < to {
            mask |= ((1u64 << to) - (1u64 << from)) << (row * BLOCKS);
        }
    }
    mask
}

/// One splat at one block: adds to `sums`, moves `walk` past the splat. Returns whether
/// a pixel still goes on.
#[inline(always)]
fn step(walk: &mut Walk, f: &Footprint, [x, y]: [f32; 2], rules: Rules, sums: &mut [Lanes; SUMS]) -> bool {
    const ROUND: f32 = 12_582_912.0;
    const C: [f32; 6] =
        [1.000_000_1, 0.693_146_94, 0.240_221_2, 0.055_507_13, 0.009_675_541, 0.001_327_647_2];
    let [red, green, blue] = f.rgb;
    for l in 0..LANES {
        let dy = y + DOWN[l] - f.v;
        let s = f.sy * dy;
        let d = f.sx * (x + ACROSS[l] - f.u) + f.sx * f.shear * dy;
        let p = (f.power - s * s) - d * d;
        let least = ALPHA_MIN_LOG2;
        let skipped = p < least;
        let p = if skipped { least } else { p };
        let shifted = p + ROUND;
        let r = p - (shifted - ROUND);
        let m = C[0] + r * (C[1] + r * (C[2] + r * (C[3] + r * (C[4] + r * C[5]))));
        let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
        let raw = m * scale;
        let capped = !(raw < rules.alpha_max);
        let alpha = if capped { rules.alpha_max } else { raw };
        let alpha = if skipped { 0.0 } else { alpha };
        let t = walk.t[l];
        let w = alpha * if t > 0.0 { t } else { 0.0 };
        let rest = t - w;
        let stop = rest <= rules.stop;
        let w = if stop { 0.0 } else { w };
        walk.t[l] = if stop { -t.abs() } else { rest };
        let g: [f32; 4] = [walk.g[0][l], walk.g[1][l], walk.g[2][l], walk.g[3][l]];
        let own = w * (red * g[0] + green * g[1] + blue * g[2] + f.z * g[3]);
        let behind = walk.behind[l] - own;
        walk.behind[l] = behind;
        let v = own - behind * (alpha / (1.0 - alpha));
        let v = if stop | capped { 0.0 } else { v };
        let (vd, vs) = (v * d, v * s);
        sums[0][l] += v;
        sums[1][l] += vd;
        sums[2][l] += vs;
        sums[3][l] += vd * d;
        sums[4][l] += vd * s;
        sums[5][l] += vs * s;
        sums[6][l] += w * g[0];
        sums[7][l] += w * g[1];
        sums[8][l] += w * g[2];
        sums[9][l] += w * g[3];
    }
    any_positive(&walk.t)
}

/// Sum of the lanes, pairwise.
#[inline(always)]
fn fold(mut lanes: Lanes) -> f32 {
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
    }
    lanes[0]
}
