//! Backward of [`crate::cpu::blend`] for one 32×32 tile: once forward, once back.
//!
//! With q_i = c_i·∂L/∂rgb + z_i·∂L/∂depth of splat i at a pixel, b the same of the
//! background (bg·∂L/∂rgb − ∂L/∂alpha) and w_i = α_i T_i, the loss sees of a pixel
//! Σ w_i q_i + T b, whence (3DGS appendix)
//!
//! ∂L/∂ln α_i = w_i q_i − α_i/(1 − α_i)·(Σ_{j>i} w_j q_j + T b).
//!
//! The way forward repeats the forward's decisions by the forward's own operations and
//! leaves, per pixel, T and the last splat blended, and per (splat, tile) the mask of
//! blocks that it changed. The way back grows the sum over what lies behind from nothing
//! (subtracting it from the whole, front to back, would lose the digits of what opaque
//! splats hide) and recovers T by division, exact to rounding since α ≤ 0.999.
//!
//! Splats go one by one, each over its blocks, its ten sums in registers; one reduction
//! and one row per (splat, tile). Nothing is stored per pixel and splat.

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
const AHEAD: usize = LANES;

/// What one tile says of one splat, in the order of [`Moments`].
pub(crate) type PairSums = [f32; SUMS];

impl From<PairSums> for Moments {
    #[inline(always)]
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

/// One block on its way.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Walk {
    /// Transmittance; negative where blending has stopped.
    t: Lanes,
    /// [`rank`] of the last splat blended.
    last: Lanes,
    /// ∂L/∂T of the background, then with Σ w q of the splats passed on the way back.
    behind: Lanes,
    /// ∂L/∂ R, G, B, Σ w·z.
    g: [Lanes; 4],
}

/// x and y of a block's pixels.
const ACROSS: Lanes = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
const DOWN: Lanes = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];

/// Place `i` of an order as a float that compares as it does; above 0.
fn rank(i: usize) -> f32 {
    f32::from_bits(f32::MIN_POSITIVE.to_bits().saturating_add(i as u32))
}

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
    pub(crate) upstream: Upstream<'a>,
    /// Room for a mask per splat of the list.
    pub(crate) masks: &'a mut [u64],
    /// A row for every splat of the list.
    pub(crate) rows: &'a mut [PairSums],
}

impl Kernel for WalkTile<'_> {
    type Output = [f64; 3];

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> [f64; 3] {
        let corner = [self.t % self.grid.columns * TILE, self.t / self.grid.columns * TILE];
        let empty = [0.0; LANES];
        let walk = Walk { t: [-1.0; LANES], last: empty, behind: empty, g: [empty; 4] };
        let mut walks = [walk; BLOCKS * BLOCKS];
        let live = start(&mut walks, corner, &self.grid, self.upstream);
        let corner = corner.map(|c| c as f32);
        let reached = self.forward(s, &mut walks, live, corner);
        let total = turn(&mut walks);
        self.back(s, &mut walks, reached, corner);
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

    /// Takes `walks` from front to back; returns how many splats it took until all
    /// pixels had stopped. Leaves in `masks`, by place in the order, the blocks changed.
    #[inline(always)]
    fn forward<S: Simd>(
        &mut self,
        s: S,
        walks: &mut [Walk; BLOCKS * BLOCKS],
        mut live: u64,
        corner: [f32; 2],
    ) -> usize {
        let count = self.order.len();
        let mut from = 0;
        while from < count && live != 0 {
            let past = (from + LANES).min(count);
            let mut i = past;
            while i < (past + AHEAD).min(count) {
                s.prefetch(self.footprint(i));
                i += 1;
            }
            let mut masks = [0; LANES];
            let mut fields = [s.splat(0.0); LANES];
            for (l, field) in fields.iter_mut().enumerate() {
                // Spare lanes repeat the last splat and are not walked.
                *field = s.load(self.footprint((from + l).min(past - 1)).fields());
            }
            met(s, s.transpose(fields), corner, &mut masks);
            for i in from..past {
                let f = self.footprint(i);
                let mut mask = masks[i - from] & live;
                let mut blocks = mask;
                while blocks != 0 {
                    let b = blocks.trailing_zeros() as usize;
                    blocks &= blocks - 1;
                    let (changed, goes_on) = step_forward(
                        s,
                        &mut walks[b & 63],
                        f,
                        block_corner(corner, b),
                        (i, self.rules),
                    );
                    mask &= !(u64::from(!changed) << b);
                    live &= !(u64::from(!goes_on) << b);
                }
                self.masks[i] = mask;
            }
            from = past;
        }
        from
    }

    /// Takes `walks` back from splat `reached` and writes the rows of all before it.
    #[inline(always)]
    fn back<S: Simd>(
        &mut self,
        s: S,
        walks: &mut [Walk; BLOCKS * BLOCKS],
        reached: usize,
        corner: [f32; 2],
    ) {
        for i in (0..reached).rev() {
            s.prefetch(self.footprint(i.saturating_sub(AHEAD)));
            let f = self.footprint(i);
            let mut sums = [s.splat(0.0); SUMS];
            let mut blocks = self.masks[i];
            let mut row = [0.0; SUMS];
            if blocks != 0 {
                while blocks != 0 {
                    let b = blocks.trailing_zeros() as usize;
                    blocks &= blocks - 1;
                    let at = block_corner(corner, b);
                    sums = step_back(s, &mut walks[b & 63], f, at, (i, self.rules), sums);
                }
                for (to, sum) in row.iter_mut().zip(sums) {
                    *to = s.sum(sum);
                }
            }
            if let Some(to) = self.rows.get_mut(self.order[i] as usize) {
                *to = row;
            }
        }
    }
}

#[inline(always)]
fn block_corner(corner: [f32; 2], b: usize) -> [f32; 2] {
    [corner[0] + (b % BLOCKS * BLOCK) as f32, corner[1] + (b / BLOCKS * BLOCK) as f32]
}

/// Fills `walks`; returns the blocks with a pixel inside.
fn start(
    walks: &mut [Walk; BLOCKS * BLOCKS],
    corner: [usize; 2],
    grid: &Grid,
    Upstream { planes, background }: Upstream,
) -> u64 {
    let (width, height) = (grid.width - corner[0], grid.height - corner[1]);
    let (width, height) = (width.min(TILE), height.min(TILE));
    let pixels = grid.width * grid.height;
    let mut live = 0u64;
    for y in 0..height {
        let first = (corner[1] + y) * grid.width + corner[0];
        // Pixel by pixel instead of plane by plane.
        let mut row = [[0.0f32; 5]; TILE];
        for c in 0..5 {
            let plane = &planes[c * pixels + first..][..width];
            for (pixel, v) in row.iter_mut().zip(plane) {
                pixel[c] = *v;
            }
        }
        for (x, &[r, g, b, alpha, z]) in row[..width].iter().enumerate() {
            let (block, l) = (y / BLOCK * BLOCKS + x / BLOCK, y % BLOCK * BLOCK + x % BLOCK);
            let walk = &mut walks[block];
            live |= 1 << block;
            walk.t[l] = 1.0;
            walk.behind[l] = background[0] * r + background[1] * g + background[2] * b - alpha;
            for (to, v) in walk.g.iter_mut().zip([r, g, b, z]) {
                to[l] = v;
            }
        }
    }
    live
}

/// At the far end: T without its sign, T·b; returns Σ T·∂L/∂rgb.
fn turn(walks: &mut [Walk; BLOCKS * BLOCKS]) -> [f64; 3] {
    let mut total = [0.0f64; 3];
    for walk in walks {
        for l in 0..LANES {
            walk.t[l] = walk.t[l].abs();
            walk.behind[l] *= walk.t[l];
        }
        for (sum, g) in total.iter_mut().zip(&walk.g) {
            let row: f32 = g.iter().zip(&walk.t).map(|(g, t)| g * t).sum();
            *sum += f64::from(row);
        }
    }
    total
}

/// What a splat is at a block's pixels.
struct Seen<S: Simd> {
    /// Whitened distances.
    across: S::F,
    down: S::F,
    /// Not below 1/255.
    shows: S::M,
    /// o·e^(−σ).
    raw: S::F,
}

/// The forward's own operations.
#[inline(always)]
fn look<S: Simd>(s: S, f: &Footprint, at: [f32; 2]) -> Seen<S> {
    let least = s.splat(ALPHA_MIN_LOG2);
    let x = s.load(&ACROSS) + s.splat(at[0]);
    let y = s.load(&DOWN) + s.splat(at[1]);
    let (dx, dy) = (x - s.splat(f.u), y - s.splat(f.v));
    let across = s.fma(s.splat(f.shear), dy, dx) * s.splat(f.sx);
    let down = dy * s.splat(f.sy);
    let power = s.fnma(down, down, s.fnma(across, across, s.splat(f.power)));
    Seen { across, down, shows: s.le(least, power), raw: simd::exp2(s, s.max(power, least)) }
}

/// Splat `i` of the order at one block: whether it changed a pixel, and whether a pixel
/// still goes on.
#[inline(always)]
fn step_forward<S: Simd>(
    s: S,
    walk: &mut Walk,
    f: &Footprint,
    at: [f32; 2],
    (i, rules): (usize, Rules),
) -> (bool, bool) {
    let zero = s.splat(0.0);
    let seen = look(s, f, at);
    let t = s.load(&walk.t);
    let shows = seen.shows & s.lt(zero, t);
    let alpha = s.min(seen.raw, s.splat(rules.alpha_max));
    let rest = s.fnma(alpha, t, t);
    let adds = s.lt(s.splat(rules.stop), rest) & shows;
    let t = s.select(adds, rest, s.select(shows, -t, t));
    s.store(t, &mut walk.t);
    s.store(s.select(adds, s.splat(rank(i)), s.load(&walk.last)), &mut walk.last);
    (s.any(adds), s.any(s.lt(zero, t)))
}

/// The same on the way back; adds to `sums`.
#[inline(always)]
fn step_back<S: Simd>(
    s: S,
    walk: &mut Walk,
    f: &Footprint,
    at: [f32; 2],
    (i, rules): (usize, Rules),
    sums: [S::F; SUMS],
) -> [S::F; SUMS] {
    let seen = look(s, f, at);
    let (cap, one) = (s.splat(rules.alpha_max), s.splat(1.0));
    let alpha = s.min(seen.raw, cap);
    let adds = seen.shows & s.le(s.splat(rank(i)), s.load(&walk.last));
    let after = s.load(&walk.t);
    let inverse = one / (one - alpha);
    let t = s.select(adds, after * inverse, after);
    s.store(t, &mut walk.t);
    let w = s.keep(adds, alpha * t);
    let g = [s.load(&walk.g[0]), s.load(&walk.g[1]), s.load(&walk.g[2]), s.load(&walk.g[3])];
    let q = s.fma(g[2], s.splat(f.rgb[2]), g[3] * s.splat(f.z));
    let q = s.fma(g[0], s.splat(f.rgb[0]), s.fma(g[1], s.splat(f.rgb[1]), q));
    let behind = s.load(&walk.behind);
    s.store(s.fma(w, q, behind), &mut walk.behind);
    let v = s.fnma(behind, alpha * inverse, w * q);
    let v = s.keep(adds & s.lt(seen.raw, cap), v);
    let (va, vd) = (v * seen.across, v * seen.down);
    [
        sums[0] + v,
        sums[1] + va,
        sums[2] + vd,
        s.fma(va, seen.across, sums[3]),
        s.fma(va, seen.down, sums[4]),
        s.fma(vd, seen.down, sums[5]),
        s.fma(w, g[0], sums[6]),
        s.fma(w, g[1], sums[7]),
        s.fma(w, g[2], sums[8]),
        s.fma(w, g[3], sums[9]),
    ]
}
