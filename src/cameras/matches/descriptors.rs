//! Describes the surroundings of a feature by histograms of gradient directions.
//!
//! Input: features and the blurred levels of the image pyramid. Output: `[128]` floats of unit
//! length per feature.
//!
//! Source: Lowe 2004, sections 5 and 6. The square-root normalisation is that of R. Arandjelović
//! and A. Zisserman, "Three things everyone should know to improve object retrieval", 2012.

use super::GrayImage;
use super::features::{Feature, Octave, PyramidPoint};
use std::f32::consts::{PI, TAU};

/// Number of floats in a descriptor: 4 × 4 cells of 8 gradient directions.
pub(crate) const DESCRIPTOR: usize = 128;

/// Returns the magnitude and the direction of the gradient at an inner pixel.
fn gradient(image: &GrayImage, x: usize, y: usize) -> (f32, f32) {
    let gx = image.at(x + 1, y) - image.at(x - 1, y);
    let gy = image.at(x, y + 1) - image.at(x, y - 1);
    ((gx * gx + gy * gy).sqrt(), atan2_approx(gy, gx))
}

/// Approximates `atan2` to 2e-4 rad by a polynomial on one octant. The exact function took a third
/// of the time of [`describe`].
fn atan2_approx(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    if large == 0.0 {
        return 0.0;
    }
    let t = small / large;
    let s = t * t;
    let mut angle = ((-0.046_496_475 * s + 0.159_314_22) * s - 0.327_622_76) * s * t + t;
    if ay > ax {
        angle = 0.5 * PI - angle;
    }
    if x < 0.0 {
        angle = PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

/// Returns one copy of the feature for every strong gradient direction around it (Lowe, section 5).
pub(crate) fn oriented(feature: &Feature, octaves: &[Octave]) -> Vec<Feature> {
    const BINS: usize = 36;
    let position = feature.position;
    let image = &octaves[position.octave].blurred[position.level];
    let weight_sigma = 1.5 * position.sigma;
    let mut bins = [0.0f32; BINS];
    for_window(image, &position, 3.0 * weight_sigma, |dx, dy, magnitude, angle| {
        let weight = (-(dx * dx + dy * dy) / (2.0 * weight_sigma * weight_sigma)).exp();
        let bin = (angle.rem_euclid(TAU) / TAU * BINS as f32) as usize % BINS;
        bins[bin] += weight * magnitude;
    });
    for _ in 0..2 {
        let old = bins;
        for (i, bin) in bins.iter_mut().enumerate() {
            *bin = 0.25 * old[(i + BINS - 1) % BINS] + 0.5 * old[i] + 0.25 * old[(i + 1) % BINS];
        }
    }
    let top = bins.iter().fold(0.0f32, |m, &v| m.max(v));
    (0..BINS)
        .filter_map(|i| {
            let l = bins[(i + BINS - 1) % BINS];
            let c = bins[i];
            let r = bins[(i + 1) % BINS];
            (c >= 0.8 * top && c > l && c > r).then(|| {
                let peak = i as f32 + 0.5 + 0.5 * (l - r) / (l - 2.0 * c + r);
                let mut copy = feature.clone();
                copy.position.angle = peak / BINS as f32 * TAU;
                copy
            })
        })
        .collect()
}

/// Calls `visit(dx, dy, magnitude, angle)` for the inner pixels within `radius` of `position`.
fn for_window(
    image: &GrayImage,
    position: &PyramidPoint,
    radius: f32,
    mut visit: impl FnMut(f32, f32, f32, f32),
) {
    let range = |at: f32, size: usize| {
        let first = (at - radius).ceil().max(1.0) as usize;
        let last = (at + radius).floor().min(size as f32 - 2.0).max(0.0) as usize;
        first..last + 1
    };
    for y in range(position.y, image.height()) {
        for x in range(position.x, image.width()) {
            let (dx, dy) = (x as f32 - position.x, y as f32 - position.y);
            if dx * dx + dy * dy <= radius * radius {
                let (magnitude, angle) = gradient(image, x, y);
                visit(dx, dy, magnitude, angle);
            }
        }
    }
}

/// Returns the descriptor of a feature: 4 × 4 cells of 3σ, 8 directions, trilinear weights, a
/// Gaussian of half the width (Lowe, section 6). The result √(L1-normalised) has unit length.
pub(crate) fn describe(position: &PyramidPoint, octaves: &[Octave]) -> [f32; DESCRIPTOR] {
    const CELLS: usize = 4;
    const DIRECTIONS: usize = 8;
    let image = &octaves[position.octave].blurred[position.level];
    let cell = 3.0 * position.sigma;
    let radius = cell * 0.5 * (CELLS as f32 + 1.0) * std::f32::consts::SQRT_2;
    let (sin, cos) = position.angle.sin_cos();
    // One additional ring of cells and one additional direction: the trilinear weights then need no
    // bounds test.
    const RING: usize = CELLS + 2;
    let mut bins = [0.0f32; RING * RING * (DIRECTIONS + 1)];
    for_window(image, position, radius, |dx, dy, magnitude, angle| {
        let u = (cos * dx + sin * dy) / cell;
        let v = (cos * dy - sin * dx) / cell;
        let (cu, cv) = (u + 0.5 * CELLS as f32 + 0.5, v + 0.5 * CELLS as f32 + 0.5);
        let top = (RING - 1) as f32;
        if !(cu > 0.0 && cv > 0.0 && cu < top && cv < top) {
            return;
        }
        // The Gaussian's σ is half of the window's width: CELLS / 2 = 2 cells.
        let weight = magnitude * (-(u * u + v * v) / 8.0).exp();
        let relative = (angle - position.angle).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
        let (iu, iv) = (cu as usize, cv as usize);
        let io = (relative as usize).min(DIRECTIONS - 1);
        let (fu, fv, fo) = (cu - iu as f32, cv - iv as f32, relative - io as f32);
        for (row, wv) in [(iv, 1.0 - fv), (iv + 1, fv)] {
            for (column, wu) in [(iu, 1.0 - fu), (iu + 1, fu)] {
                let at = (row * RING + column) * (DIRECTIONS + 1) + io;
                bins[at] += weight * wv * wu * (1.0 - fo);
                bins[at + 1] += weight * wv * wu * fo;
            }
        }
    });
    let mut out = [0.0f32; DESCRIPTOR];
    for (i, o) in out.iter_mut().enumerate() {
        let (cell, direction) = (i / DIRECTIONS, i % DIRECTIONS);
        let row = cell / CELLS + 1;
        let column = cell % CELLS + 1;
        let from = (row * RING + column) * (DIRECTIONS + 1);
        let wrapped = if direction == 0 { bins[from + DIRECTIONS] } else { 0.0 };
        *o = bins[from + direction] + wrapped;
    }
    let sum: f32 = out.iter().sum::<f32>().max(1e-12);
    out.iter_mut().for_each(|v| *v = (*v / sum).sqrt());
    out
}
