//! Intersection of splats with the 4×4 blocks of a tile, for sixteen splats at a time, and
//! the transpose from "blocks of a splat" to "splats of a block".

use crate::cpu::raster::blend::BLOCKS;
use crate::cpu::raster::ewa::{FIELDS, support_lanes};
use crate::cpu::simd::{APPROX_SQRT_ERROR, F32Vector, IntVector, LANES, Mask, Simd, Vector};
use crate::layout::{BLOCK, SPAN_SLACK_PX};

/// Computes masks of the blocks that sixteen splats can intersect in the tile whose first
/// pixel is at `corner`: bit 8·row + column. `fields` are their footprints, field by field.
///
/// As in [`crate::cpu::raster::ewa::Footprint::span`]: over the four pixel rows of a row of
/// blocks, the ellipse spans the columns between its left edge at one row and its right
/// edge at another.
#[inline(always)]
pub(crate) fn intersected<S: Simd>(
    s: S,
    fields: [S::F; FIELDS],
    corner: [f32; 2],
    masks: &mut [u64; LANES],
) {
    /// Columns and rows are counted in blocks from the tile's corner.
    const PER_BLOCK: f32 = 1.0 / BLOCK as f32;
    let [u, v, sx, shear, sy, power, _, _, _, _, half_width, half_height, x0, y0, x1, y1] = fields;
    let (zero, one, quarter) = (s.splat(0.0), s.splat(1.0), s.splat(PER_BLOCK));
    let (left, top) = (s.splat(corner[0]), s.splat(corner[1]));
    let reach = support_lanes(s, power);
    let sy2 = sy * sy;
    let tip = -(shear * half_height * half_height / half_width);
    let lowest = (whole(y0) - v).max(-half_height);
    let highest = (whole(y1) - one - v).min(half_height);
    // Edges in blocks; the factor covers the error of the approximate root.
    let width = s.splat(PER_BLOCK * (1.0 + 2.0 * APPROX_SQRT_ERROR)) / sx;
    let slack = s.splat(SPAN_SLACK_PX * PER_BLOCK);
    let middle = (u - left) * quarter;
    let (middle_left, middle_right) = (middle - slack, middle + slack);
    let slant = shear * quarter;
    let first = zero.max((whole(x0) - left) * quarter);
    let last = s.splat(BLOCKS as f32 - PER_BLOCK);
    let last = last.min((whole(x1) - one - left) * quarter);
    let mut halves = [S::I::splat(0); 2];
    for (half, bits) in halves.iter_mut().enumerate() {
        for r in 0..4 {
            let y = top + s.splat(((4 * half + r) * BLOCK) as f32) - v;
            let low = lowest.max(y);
            let high = highest.min(y + s.splat(BLOCK as f32 - 1.0));
            let right = high.min(low.max(tip));
            let left = high.min(low.max(-tip));
            let reach_left = edge(left, sy2, reach);
            let reach_right = edge(right, sy2, reach);
            let from = reach_left.fnma(width, slant.fnma(left, middle_left));
            let to = reach_right.fma(width, slant.fnma(right, middle_right));
            let from = first.max(from);
            let to = low.le(high).select_or_zero(last.min(to) + one);
            // Truncation is floor here: both are positive where the splat intersects.
            let row = below(from.max(to)) - below(from);
            *bits = *bits | row.shl_each(S::I::splat(8 * r as i32));
        }
    }
    let (mut a, mut b) = ([0; LANES], [0; LANES]);
    halves[0].store(&mut a);
    halves[1].store(&mut b);
    for ((mask, a), b) in masks.iter_mut().zip(a).zip(b) {
        *mask = u64::from(a as u32) | u64::from(b as u32) << 32;
    }
}

/// Converts bits of whole numbers to floats.
#[inline(always)]
fn whole<V: F32Vector>(v: V) -> V {
    V::from_int(v.to_bits())
}

/// Computes the distance along x of the ellipse's edge from its middle, `dy` off the mean,
/// before the division by sx.
#[inline(always)]
fn edge<V: F32Vector>(dy: V, sy2: V, reach: V) -> V {
    V::splat(f32::MIN_POSITIVE).max((dy * dy).fnma(sy2, reach)).approx_sqrt()
}

/// Sets the bits of columns 0 to `past` − 1.
#[inline(always)]
fn below<V: F32Vector>(past: V) -> V::Int {
    V::Int::splat(1).shl_each(past.to_int())
}

/// Transposes a 64×64 matrix of bits: bit c of word r becomes bit r of word c. It swaps the
/// off-diagonal halves of ever smaller squares (Warren, Hacker's Delight).
#[inline(always)]
pub(crate) fn transpose_bits(m: &mut [u64; 64]) {
    macro_rules! step {
        ($half:expr, $mask:expr) => {
            for square in m.chunks_exact_mut(2 * $half) {
                let (a, b) = square.split_at_mut($half);
                for (a, b) in a.iter_mut().zip(b) {
                    let swap = ((*a >> $half) ^ *b) & $mask;
                    *a ^= swap << $half;
                    *b ^= swap;
                }
            }
        };
    }
    step!(32, 0x0000_0000_ffff_ffff);
    step!(16, 0x0000_ffff_0000_ffff);
    step!(8, 0x00ff_00ff_00ff_00ff);
    step!(4, 0x0f0f_0f0f_0f0f_0f0f);
    step!(2, 0x3333_3333_3333_3333);
    step!(1, 0x5555_5555_5555_5555);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::raster::ewa::Footprint;
    use crate::cpu::simd::{Kernel, SimdLevel};
    use crate::layout::{ALPHA_MIN_LOG2, TILE};

    #[test]
    fn bits_are_transposed() {
        let mut state = 7u64;
        let words: [u64; 64] = std::array::from_fn(|_| {
            state = state.wrapping_mul(0x5851_F42D_4C95_7F2D).wrapping_add(0x1405_7B7E_F767_814F);
            state ^ state >> 29
        });
        let mut turned = words;
        transpose_bits(&mut turned);
        for (r, word) in words.iter().enumerate() {
            for (c, other) in turned.iter().enumerate() {
                assert_eq!(word >> c & 1, other >> r & 1, "{r} {c}");
            }
        }
    }

    struct Met<'a>(&'a [Footprint; LANES], [f32; 2]);

    impl Kernel for Met<'_> {
        type Output = [u64; LANES];

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> [u64; LANES] {
            let mut rows = [s.splat(0.0); LANES];
            for (row, f) in rows.iter_mut().zip(self.0) {
                *row = s.load(f.fields());
            }
            let mut masks = [0; LANES];
            intersected(s, s.transpose(rows), self.1, &mut masks);
            masks
        }
    }

    /// The mask holds every block with a visible pixel, few others, and none outside the
    /// splat's rectangle.
    #[test]
    fn blocks_are_those_with_pixels_that_show() {
        let mut state = 3u32;
        let mut next = |from: f32, to: f32| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            from + (to - from) * (state >> 8) as f32 / (1 << 24) as f32
        };
        let corner = [64.0, 32.0];
        let (mut needed, mut named) = (0, [0; 4]);
        for _ in 0..200 {
            let splats: [Footprint; LANES] = std::array::from_fn(|l| {
                let (sx, sy) = (next(0.02, 1.5), next(0.02, 1.5));
                let (shear, power) = (next(-3.0, 3.0), next(-7.9, 0.0));
                let reach = power - ALPHA_MIN_LOG2;
                let half_height = reach.sqrt() / sy;
                let half_width = (reach / (sx * sx) + (shear * half_height).powi(2)).sqrt();
                // The tile cut of `mvsplat` for some.
                let cut = if l % 4 == 0 { 80 } else { 1000 };
                let (u, v) = (next(50.0, 110.0), next(20.0, 80.0));
                Footprint {
                    u,
                    v,
                    sx,
                    shear,
                    sy,
                    power,
                    half_width,
                    half_height,
                    x1: cut,
                    y0: 36,
                    y1: 2000,
                    ..Footprint::default()
                }
            });
            let exact = splats.map(|f| {
                let mut mask = 0u64;
                for p in 0..TILE * TILE {
                    let (x, y) = (p % TILE, p / TILE);
                    let (px, py) = (corner[0] + x as f32, corner[1] + y as f32);
                    let (dx, dy) = (f64::from(px - f.u), f64::from(py - f.v));
                    let a = f64::from(f.sx) * (dx + f64::from(f.shear) * dy);
                    let b = f64::from(f.sy) * dy;
                    let shows = f64::from(f.power) - a * a - b * b >= f64::from(ALPHA_MIN_LOG2);
                    if shows && px < f.x1 as f32 && py >= f.y0 as f32 {
                        mask |= 1 << (y / BLOCK * BLOCKS + x / BLOCK);
                    }
                }
                mask
            });
            needed += exact.iter().map(|m| m.count_ones()).sum::<u32>();
            for (i, &level) in SimdLevel::available().iter().enumerate() {
                for (l, (got, exact)) in
                    level.run(Met(&splats, corner)).into_iter().zip(exact).enumerate()
                {
                    assert_eq!(exact & !got, 0, "{level:?} {:?}", splats[l]);
                    let rectangle: u64 =
                        if splats[l].x1 == 80 { 0x0f0f_0f0f_0f0f_0f00 } else { !0xff };
                    assert_eq!(got & !rectangle, 0, "{level:?} {:?}: outside", splats[l]);
                    named[i] += got.count_ones();
                }
            }
        }
        assert!(needed > 5000, "{needed}");
        for (named, level) in named.iter().zip(SimdLevel::available()) {
            assert!(f64::from(*named) < 1.15 * f64::from(needed), "{level:?}: {named} of {needed}");
        }
    }
}
