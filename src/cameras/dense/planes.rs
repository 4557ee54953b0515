//! The plane of every pixel, improved by its neighbours' planes and by small changes at random.

use super::patch::{HIDDEN, Patch, SAMPLES, Warp};
use super::{DenseView, warps};
use crate::cameras::matches::GrayImage;
use rayon::prelude::*;
use subsplat_kernels::cpu::simd::vectorize;
use subsplat_kernels::layout::random::{GOLDEN, mix};

/// Rounds over all pixels.
const ROUNDS: usize = 4;
/// Neighbours whose planes a pixel tries, px. All have the other colour of the chessboard.
const NEIGHBOURS: [[isize; 2]; 8] =
    [[1, 0], [-1, 0], [0, 1], [0, -1], [5, 0], [-5, 0], [0, 5], [0, -5]];
/// The first of [`NEIGHBOURS`] that touch the pixel.
const TOUCHING: usize = 4;
/// Cost of a pixel whose touching neighbours all have another depth.
const ROUGHNESS_COST: f32 = 0.1;
/// Relative difference of inverse depths that counts as another depth; smaller ones count in proportion.
const OTHER_DEPTH: f32 = 0.02;
/// Largest slope of a first plane, relative to its inverse depth, a pixel: steps between surfaces are no
/// slopes.
const FIRST_SLOPE_MAX: f32 = 0.03;
/// Planes that differ by less, relative to the inverse depth, in the pixel and across the patch are one.
const SAME_PLANE: f32 = 2e-5;
/// Pixels from the middle of the patch to its border.
const SAME_PLANE_REACH: f32 = 4.0;
/// Changes at random, relative to the inverse depth: of itself and of the slopes a pixel. The first two halve with
/// each round.
const CHANGES: [[f32; 2]; 3] = [[0.2, 0.0], [0.01, 0.01], [0.002, 0.003]];
/// The first changes that halve.
const HALVING: usize = 2;
/// Difference from which on a photograph shows something else than the patch, or nothing. A mean with it would
/// favour wrong planes that two photographs show over right ones that one shows.
const SECOND_MAX: f32 = 0.8;
/// Added where one of several photographs shows the patch.
const UNCONFIRMED: f32 = 0.1;
/// Fewest pixels of a parallel task.
const TASK: usize = 256;

/// Plane of a pixel, and how well the patch on it agrees with the other photographs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Plane {
    /// Inverse depth at the pixel's centre, 1 over world units.
    pub inverse: f32,
    /// Its change to the next column and row.
    pub slopes: [f32; 2],
    /// [`Patch::difference`]: the mean of the best two photographs, or that of the one which shows the patch.
    pub difference: f32,
}

impl Plane {
    /// The plane of a pixel that is (dx, dy) away.
    #[inline(always)]
    fn moved(self, [dx, dy]: [isize; 2]) -> Self {
        let inverse = self.inverse + self.slopes[0] * dx as f32 + self.slopes[1] * dy as f32;
        Self { inverse, ..self }
    }

    #[inline(always)]
    fn is_nearly(&self, other: &Self) -> bool {
        let reach = SAME_PLANE_REACH * (self.slopes[0] - other.slopes[0]).abs()
            + SAME_PLANE_REACH * (self.slopes[1] - other.slopes[1]).abs();
        (self.inverse - other.inverse).abs() + reach <= SAME_PLANE * self.inverse.abs()
    }

    /// The plane after change `k` of [`CHANGES`] by three numbers from −1 to 1.
    #[inline(always)]
    fn changed(&self, k: usize, round: usize, noise: [f32; 3]) -> Self {
        let scale = if k < HALVING { 0.5f32.powi(round as i32) } else { 1.0 };
        let depth = scale * CHANGES[k][0];
        let slope = scale * CHANGES[k][1] * self.inverse;
        let slopes = [self.slopes[0] + slope * noise[1], self.slopes[1] + slope * noise[2]];
        Self { inverse: self.inverse * (1.0 + depth * noise[0]), slopes, ..*self }
    }
}

/// The planes of a photograph, `[H·W]`; empty where they are not known.
pub(super) type Field = Vec<Plane>;

/// A photograph with the others.
struct Comparison<'a> {
    picture: &'a GrayImage,
    others: Vec<(&'a GrayImage, Warp)>,
    /// Weights of each pixel's patch.
    weights: Vec<[f32; SAMPLES]>,
    /// Least and largest inverse depth.
    range: [f32; 2],
    /// Index of the photograph.
    view: usize,
}

/// The planes of photograph `view`, with inverse depths within `range`.
pub(super) fn matched(view: usize, views: &[DenseView<'_>], range: [f32; 2]) -> Field {
    let DenseView { picture, depth, .. } = views[view];
    let others: Vec<_> =
        warps(view, views).into_iter().map(|(i, warp)| (views[i].picture, warp)).collect();
    if others.is_empty() {
        return Field::default();
    }
    let width = picture.width();
    let pixels = (0..depth.len()).into_par_iter().with_min_len(TASK);
    let weights = pixels.clone().map(|i| Patch::weights(picture, i % width, i / width)).collect();
    let all = Comparison { picture, others, weights, range, view };
    let first = |i: usize| {
        let plane = first_plane(depth, [i % width, i / width], [width, picture.height()]);
        let difference = all.difference(&all.patch(i), &plane);
        Plane { difference, ..plane }
    };
    let mut field: Field = pixels.clone().map(first).collect();
    for round in 0..ROUNDS {
        for colour in 0..2 {
            let before = &field;
            let better = |i: usize| {
                if (i % width + i / width) % 2 == colour {
                    vectorize(
                        #[inline(always)]
                        || all.better(i, before, round),
                    )
                } else {
                    before[i]
                }
            };
            field = pixels.clone().map(better).collect();
        }
    }
    field
}

/// The plane of a pixel by the first depths around it.
fn first_plane(depth: &[f32], [x, y]: [usize; 2], [width, height]: [usize; 2]) -> Plane {
    let inverse = |x: usize, y: usize| 1.0 / depth[y * width + x];
    let own = inverse(x, y);
    if !(own > 0.0 && own.is_finite()) {
        return Plane { inverse: 0.0, slopes: [0.0; 2], difference: HIDDEN };
    }
    let slope = |low: f32, high: f32, pixels: usize| {
        let slope = (high - low) / pixels.max(1) as f32;
        let most = FIRST_SLOPE_MAX * own;
        if slope.is_finite() { slope.clamp(-most, most) } else { 0.0 }
    };
    let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
    let (top, bottom) = (y.saturating_sub(1), (y + 1).min(height - 1));
    let slopes = [
        slope(inverse(left, y), inverse(right, y), right - left),
        slope(inverse(x, top), inverse(x, bottom), bottom - top),
    ];
    Plane { inverse: own, slopes, difference: HIDDEN }
}

impl Comparison<'_> {
    #[inline(always)]
    fn patch(&self, i: usize) -> Patch {
        let width = self.picture.width();
        Patch::new(self.picture, i % width, i / width, &self.weights[i])
    }

    /// [`Plane::difference`] of the patch on a plane.
    #[inline(always)]
    fn difference(&self, patch: &Patch, plane: &Plane) -> f32 {
        let [least, largest] = self.range;
        if !(plane.inverse >= least && plane.inverse <= largest) {
            return HIDDEN;
        }
        let mut best = [HIDDEN; 2];
        for (source, warp) in &self.others {
            let difference = patch.difference(warp, source, plane.inverse, plane.slopes);
            if difference < best[0] {
                best = [difference, best[0]];
            } else if difference < best[1] {
                best[1] = difference;
            }
        }
        if self.others.len() == 1 {
            return best[0];
        }
        if best[1] < SECOND_MAX { 0.5 * (best[0] + best[1]) } else { best[0] + UNCONFIRMED }
    }

    /// The best plane of pixel `i` among its own, its neighbours' and changes of it. One loop evaluates all
    /// of them, so that the evaluation is compiled once and with the vectors of the caller.
    #[inline(always)]
    fn better(&self, i: usize, field: &[Plane], round: usize) -> Plane {
        let (width, height) = (self.picture.width(), self.picture.height());
        let (x, y) = (i % width, i / width);
        let mut best = field[i];
        let mut neighbours = [None; NEIGHBOURS.len()];
        for (to, [dx, dy]) in neighbours.iter_mut().zip(NEIGHBOURS) {
            let (Some(column), Some(row)) = (x.checked_add_signed(dx), y.checked_add_signed(dy))
            else {
                continue;
            };
            if column < width && row < height {
                *to = Some(field[row * width + column].moved([-dx, -dy]));
            }
        }
        let patch = self.patch(i);
        let mut cost = best.difference + roughness(&neighbours, best.inverse);
        for k in 0..NEIGHBOURS.len() + CHANGES.len() {
            let plane = match (neighbours.get(k), k.checked_sub(NEIGHBOURS.len())) {
                (Some(Some(neighbour)), _) => *neighbour,
                (_, Some(k)) => {
                    let seed = ((self.view * ROUNDS + round) * CHANGES.len() + k) as u64;
                    best.changed(k, round, noise((seed << 40) | i as u64))
                }
                _ => continue,
            };
            let rough = roughness(&neighbours, plane.inverse);
            // No difference is below 0.
            if rough >= cost || plane.is_nearly(&best) {
                continue;
            }
            let difference = self.difference(&patch, &plane);
            if difference + rough < cost {
                cost = difference + rough;
                best = Plane { difference, ..plane };
            }
        }
        best
    }
}

/// Cost of a pixel whose touching neighbours, the first of `neighbours`, have other inverse depths.
#[inline(always)]
fn roughness(neighbours: &[Option<Plane>], inverse: f32) -> f32 {
    let mut sum = 0.0;
    for plane in neighbours[..TOUCHING].iter().flatten() {
        sum += ((plane.inverse / inverse - 1.0).abs() / OTHER_DEPTH).min(1.0);
    }
    ROUGHNESS_COST * sum / TOUCHING as f32
}

/// Three numbers from −1 to 1.
#[inline(always)]
fn noise(seed: u64) -> [f32; 3] {
    let bits = mix(seed.wrapping_mul(GOLDEN).wrapping_add(GOLDEN));
    let number = |shift: u32| ((bits >> shift) & 0x1f_ffff) as f32 / (1u32 << 20) as f32 - 1.0;
    [number(0), number(21), number(42)]
}
