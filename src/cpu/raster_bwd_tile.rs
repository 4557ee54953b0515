//! Backward of [`crate::cpu::blend`] for one 32×32 tile, front to back as the forward.
//!
//! With q_i = c_i·∂L/∂rgb + z_i·∂L/∂depth of splat i at a pixel, b the same of the
//! background (bg·∂L/∂rgb − ∂L/∂alpha) and w_i = α_i T_i, the loss sees of a pixel
//! Σ w_i q_i + T b, whence (3DGS appendix)
//!
//! ∂L/∂ln α_i = w_i q_i − α_i/(1 − α_i)·(Σ_{j>i} w_j q_j + T b).
//!
//! The forward's planes give the whole sum at once, so the sum over what lies behind is
//! known at the first splat and shrinks by w_i q_i at each: nothing is stored per pixel
//! and splat, and skip, cap and stop are decided by the forward's own operations.
//! Splats go one by one, each over the blocks that it can touch, its ten sums in
//! registers; one reduction and one row per (splat, tile).

use crate::abi::{ALPHA_MIN_LOG2, BLOCK, TILE};
use crate::cpu::blend::{BLOCKS, Lanes, Rules};
use crate::cpu::blocks::met;
use crate::cpu::ewa::Footprint;
use crate::cpu::ewa_bwd::Moments;
use crate::cpu::simd::{self, Kernel, LANES, Simd};
use crate::cpu::tiles::Grid;

/// Sums kept per (splat, tile): the numbers of [`Moments`].
pub(crate) const SUMS: usize = 10;
/// Splats whose footprints are asked for ahead of their turn.
const AHEAD: usize = 2 * LANES;

/// What one tile says of one splat, in the order of [`Moments`].
pub(crate) type PairSums = [f32; SUMS];

impl From<PairSums> for Moments {
    #[inline(always)]
    fn from([one, d, s, dd, ds, ss, r, g, b, z]: PairSums) -> Self {
        Self { one, d, s, dd, ds, ss, rgb: [r, g, b], z }
    }
}

/// A picture and the gradient that arrives at it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pixels<'a> {
    /// `[5, H, W]`: R, G, B over the background, alpha, Σ w·z.
    pub(crate) planes: &'a [f32],
    /// `[5, H, W]`: ∂L/∂ of those.
    pub(crate) gradients: &'a [f32],
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

/// The backward of one tile; returns Σ T·∂L/∂rgb over its pixels.
pub(crate) struct WalkTile<'a> {
    /// Which tile of `grid`.
    pub(crate) t: usize,
    pub(crate) grid: Grid,
    /// Places in `splats` and `rows`, nearest first.
    pub(crate) order: &'a [u32],
    pub(crate) splats: &'a [u32],
    pub(crate) footprints: &'a [Footprint],
    pub(crate) rules: Rules,
    pub(crate) pixels: Pixels<'a>,
    /// A row for every splat of the list.
    pub(crate) rows: &'a mut [PairSums],
}

impl Kernel for WalkTile<'_> {
    type Output = [f64; 3];

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> [f64; 3] {
        let corner = [self.t % self.grid.columns * TILE, self.t / self.grid.columns * TILE];
        let empty = Walk { t: [-1.0; LANES], behind: [0.0; LANES], g: [[0.0; LANES]; 4] };
        let mut walks = [empty; BLOCKS * BLOCKS];
        let (mut live, background) = start(&mut walks, corner, &self.grid, self.pixels);
        let corner = corner.map(|c| c as f32);
        self.prefetch(s, 0);
        let mut from = 0;
        while from < self.order.len() && live != 0 {
            self.prefetch(s, from + AHEAD - LANES);
            let places = &self.order[from..(from + LANES).min(self.order.len())];
            let mut masks = [0; LANES];
            let mut fields = [s.splat(0.0); LANES];
            for l in 0..LANES {
                // Spare lanes repeat the last splat and are not walked.
                let place = places[l.min(places.len() - 1)];
                fields[l] = s.load(self.footprint(place).fields());
            }
            met(s, s.transpose(fields), corner, &mut masks);
            for (&place, mask) in places.iter().zip(masks) {
                let f = self.footprint(place);
                let row = walk(s, f, &mut walks, (mask, &mut live), corner, self.rules);
                if let Some(to) = self.rows.get_mut(place as usize) {
                    *to = row;
                }
            }
            from += places.len();
        }
        for &place in &self.order[from..] {
            if let Some(to) = self.rows.get_mut(place as usize) {
                *to = [0.0; SUMS];
            }
        }
        background
    }
}

impl WalkTile<'_> {
    #[inline(always)]
    fn footprint(&self, place: u32) -> &Footprint {
        &self.footprints[self.splats[place as usize] as usize]
    }

    /// Asks for the footprints of a group from `first` of the order on.
    #[inline(always)]
    fn prefetch<S: Simd>(&self, s: S, first: usize) {
        let past = self.order.len().min(first + LANES);
        for &place in self.order.get(first..past).unwrap_or_default() {
            s.prefetch(self.footprint(place));
        }
    }
}

/// Fills `walks`; returns the blocks with a pixel inside and the background's gradient.
fn start(
    walks: &mut [Walk; BLOCKS * BLOCKS],
    corner: [usize; 2],
    grid: &Grid,
    Pixels { planes, gradients }: Pixels,
) -> (u64, [f64; 3]) {
    let (width, height) = (grid.width - corner[0], grid.height - corner[1]);
    let pixels = grid.width * grid.height;
    let (mut live, mut total) = (0u64, [0.0f64; 3]);
    for y in 0..TILE.min(height) {
        let first = (corner[1] + y) * grid.width + corner[0];
        let row = |from: &'_ [f32], c: usize| -> [f32; TILE] {
            let mut out = [0.0; TILE];
            let inside = c * pixels + first..c * pixels + first + TILE.min(width);
            let from = from.get(inside).unwrap_or_default();
            out[..from.len()].copy_from_slice(from);
            out
        };
        let g: [[f32; TILE]; 5] = std::array::from_fn(|c| row(gradients, c));
        let p: [[f32; TILE]; 5] = std::array::from_fn(|c| row(planes, c));
        let mut sums = [0.0f32; 3];
        for x in 0..TILE.min(width) {
            let rest = 1.0 - p[3][x];
            let (b, l) = (y / BLOCK * BLOCKS + x / BLOCK, y % BLOCK * BLOCK + x % BLOCK);
            let walk = &mut walks[b];
            live |= 1 << b;
            walk.t[l] = 1.0;
            let mut whole = -f64::from(g[3][x]) * f64::from(rest);
            for c in [0, 1, 2, 4] {
                whole += f64::from(g[c][x]) * f64::from(p[c][x]);
            }
            walk.behind[l] = whole as f32;
            for (to, c) in walk.g.iter_mut().zip([0, 1, 2, 4]) {
                to[l] = g[c][x];
            }
            for (sum, g) in sums.iter_mut().zip(&g) {
                *sum += rest * g[x];
            }
        }
        for (sum, v) in total.iter_mut().zip(sums) {
            *sum += f64::from(v);
        }
    }
    (live, total)
}

/// One splat over the blocks of `mask`: moves them past it, takes those off `live` whose
/// pixels have all stopped, and returns its sums.
#[inline(always)]
fn walk<S: Simd>(
    s: S,
    f: &Footprint,
    walks: &mut [Walk; BLOCKS * BLOCKS],
    (mask, live): (u64, &mut u64),
    corner: [f32; 2],
    rules: Rules,
) -> PairSums {
    let zero = s.splat(0.0);
    let mut sums = [zero; SUMS];
    let (least, cap) = (s.splat(ALPHA_MIN_LOG2), s.splat(rules.alpha_max));
    let (stop, one) = (s.splat(rules.stop), s.splat(1.0));
    let mut blocks = mask & *live;
    while blocks != 0 {
        let b = blocks.trailing_zeros() as usize;
        blocks &= blocks - 1;
        let block = &mut walks[b & 63];
        let x = s.load(&ACROSS) + s.splat(corner[0] + (b % BLOCKS * BLOCK) as f32);
        let y = s.load(&DOWN) + s.splat(corner[1] + (b / BLOCKS * BLOCK) as f32);
        let t = s.load(&block.t);
        let (dx, dy) = (x - s.splat(f.u), y - s.splat(f.v));
        let across = s.fma(s.splat(f.shear), dy, dx) * s.splat(f.sx);
        let down = dy * s.splat(f.sy);
        let power = s.fnma(down, down, s.fnma(across, across, s.splat(f.power)));
        let shows = s.le(least, power) & s.lt(zero, t);
        let raw = simd::exp2(s, s.max(power, least));
        let alpha = s.min(raw, cap);
        let rest = s.fnma(alpha, t, t);
        let adds = s.lt(stop, rest) & shows;
        let w = s.keep(adds, alpha * t);
        let t = s.select(adds, rest, s.select(shows, -t, t));
        s.store(t, &mut block.t);
        if !s.any(s.lt(zero, t)) {
            *live &= !(1 << b);
        }
        let g = [
            s.load(&block.g[0]),
            s.load(&block.g[1]),
            s.load(&block.g[2]),
            s.load(&block.g[3]),
        ];
        let wg = [w * g[0], w * g[1], w * g[2], w * g[3]];
        let q = s.fma(g[2], s.splat(f.rgb[2]), g[3] * s.splat(f.z));
        let q = s.fma(g[0], s.splat(f.rgb[0]), s.fma(g[1], s.splat(f.rgb[1]), q));
        let behind = s.fnma(w, q, s.load(&block.behind));
        s.store(behind, &mut block.behind);
        let v = s.fnma(behind, alpha / (one - alpha), w * q);
        let v = s.keep(adds & s.lt(raw, cap), v);
        let (va, vd) = (v * across, v * down);
        sums[0] = sums[0] + v;
        sums[1] = sums[1] + va;
        sums[2] = sums[2] + vd;
        sums[3] = s.fma(va, across, sums[3]);
        sums[4] = s.fma(va, down, sums[4]);
        sums[5] = s.fma(vd, down, sums[5]);
        sums[6] = sums[6] + wg[0];
        sums[7] = sums[7] + wg[1];
        sums[8] = sums[8] + wg[2];
        sums[9] = sums[9] + wg[3];
    }
    if mask == 0 {
        return [0.0; SUMS];
    }
    let sum = |k: usize| s.sum(sums[k]);
    [sum(0), sum(1), sum(2), sum(3), sum(4), sum(5), sum(6), sum(7), sum(8), sum(9)]
}
