//! Raw matching channels of a plane sweep: the agreement of two photographs at each
//! pixel of the reference view for each depth candidate, without any learning.
//! The small backbone uses them beside its learned correlation
//! (src/network/shipped/README.md, "The small backbone").
//!
//! In: both photographs as area means at half resolution (grey) and at quarter
//! resolution (RGB), cameras, candidates. Out: `[4, D, h, w]` at quarter resolution:
//! ZNCC over 6×6 half-resolution pixels, −mean |ΔRGB|, ZNCC over 5×5
//! quarter-resolution pixels, share of valid samples. A candidate's source pixel
//! that lies outside the picture or behind the camera is left out of every window.

use super::simd::vectorize;
use crate::camera::{Camera, Intrinsics};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Channels of [`raw_matching`].
pub const CHANNELS: usize = 4;

/// Added to each window's variance (grey levels in [0, 1]): a standard deviation of
/// 0.01 is camera noise, and must not count as texture.
pub const VARIANCE_FLOOR: f32 = 1e-4;
/// A source point nearer than this, as a share of the reference depth, is behind.
pub const Z_MIN: f32 = 1e-3;

/// One photograph at the two resolutions that are compared.
#[derive(Clone, Debug)]
pub struct Pyramid {
    /// `[2h, 2w]`: grey, mean over 2×2 pixels.
    pub half_grey: Vec<f32>,
    /// `[3, h, w]`: RGB, mean over 4×4 pixels.
    pub quarter_rgb: Vec<f32>,
    /// `[h, w]`: grey, mean over 4×4 pixels.
    pub quarter_grey: Vec<f32>,
    /// Quarter-resolution height.
    pub height: usize,
    /// Quarter-resolution width.
    pub width: usize,
}

impl Pyramid {
    /// Area means of an RGB picture `[3, H, W]`, H and W multiples of 4.
    pub fn new(rgb: &[f32], height: usize, width: usize) -> Self {
        let plane = height * width;
        debug_assert_eq!(rgb.len(), 3 * plane);
        let grey: Vec<f32> =
            (0..plane).map(|i| (rgb[i] + rgb[plane + i] + rgb[2 * plane + i]) / 3.0).collect();
        let quarter = |p: &[f32]| pool(p, height, width, 4);
        let mut quarter_rgb = Vec::with_capacity(3 * plane / 16);
        for c in 0..3 {
            quarter_rgb.extend(quarter(&rgb[c * plane..(c + 1) * plane]));
        }
        Self {
            half_grey: pool(&grey, height, width, 2),
            quarter_grey: quarter(&grey),
            quarter_rgb,
            height: height / 4,
            width: width / 4,
        }
    }
}

/// Mean over `step`×`step` blocks.
fn pool(plane: &[f32], height: usize, width: usize, step: usize) -> Vec<f32> {
    let (h, w) = (height / step, width / step);
    let share = 1.0 / (step * step) as f32;
    let mut out = vec![0.0; h * w];
    for y in 0..h * step {
        let row = &plane[y * width..(y + 1) * width];
        for (o, block) in out[(y / step) * w..][..w].iter_mut().zip(row.chunks_exact(step)) {
            *o += share * block.iter().sum::<f32>();
        }
    }
    out
}

/// Map from the pixels of one picture to those of another for a plane at constant
/// reference depth: homogeneous source pixel = `from_px`·(u, v, 1) + disparity·`shift`.
#[derive(Clone, Copy, Debug)]
pub struct PlaneWarp {
    from_px: Mat3,
    shift: Vec3,
}

impl PlaneWarp {
    /// From `reference` to `source`, both resampled to `width` × `height`.
    pub fn new(reference: &Camera, source: &Camera, width: usize, height: usize) -> Self {
        let relative = source.camera_from_world() * reference.world_from_camera;
        let k = |i: &Intrinsics| i.resized(width, height).matrix();
        let (k_r, k_s) = (k(&reference.intrinsics), k(&source.intrinsics));
        Self {
            from_px: k_s * Mat3::from_mat4(relative) * k_r.inverse(),
            shift: k_s * relative.w_axis.truncate(),
        }
    }

    /// Returns the three columns of the map of (u, v, 1) and the shift.
    pub fn columns(&self) -> [Vec3; 4] {
        [self.from_px.x_axis, self.from_px.y_axis, self.from_px.z_axis, self.shift]
    }
}

/// Pixels per step of a loop.
const LANES: usize = 16;

/// Bilinear samples of one line of reference pixels: where the four neighbours are and
/// their shares. Within half a pixel of the border the border pixel itself is read.
#[derive(Default)]
struct Line {
    /// Upper left neighbour, and the steps to the right and the lower one.
    index: Vec<u32>,
    right: Vec<u32>,
    down: Vec<u32>,
    /// Shares of the right and the lower neighbours.
    fx: Vec<f32>,
    fy: Vec<f32>,
    /// 1 inside the source picture and before the camera, else 0.
    valid: Vec<f32>,
}

impl Line {
    /// Line `y` of a picture of `size` (height, width) at `disparity`.
    fn place(&mut self, warp: &PlaneWarp, y: usize, disparity: f32, size: (usize, usize)) {
        let (height, width) = size;
        let room = width.next_multiple_of(LANES);
        for of_pixel in [&mut self.index, &mut self.right, &mut self.down] {
            of_pixel.resize(room, 0);
        }
        for of_pixel in [&mut self.fx, &mut self.fy, &mut self.valid] {
            of_pixel.resize(room, 0.0);
        }
        let base = warp.from_px * Vec3::new(0.0, y as f32 + 0.5, 1.0) + warp.shift * disparity;
        vectorize(
            #[inline(always)]
            || {
                for x in (0..room).step_by(LANES) {
                    self.sixteen(x, base, warp.from_px.x_axis, (height, width));
                }
            },
        );
    }

    #[inline(always)]
    fn sixteen(&mut self, x: usize, base: Vec3, step: Vec3, (height, width): (usize, usize)) {
        let (w, h) = (width as f32, height as f32);
        let part = x..x + LANES;
        let ints = self.index[part.clone()].iter_mut().zip(&mut self.right[part.clone()]);
        let ints = ints.zip(&mut self.down[part.clone()]);
        let floats = self.fx[part.clone()].iter_mut().zip(&mut self.fy[part.clone()]);
        let all = ints.zip(floats).zip(&mut self.valid[part]);
        for (l, ((((index, right), down), (fx, fy)), valid)) in all.enumerate() {
            let at = (x + l) as f32 + 0.5;
            let z = base.z + step.z * at;
            let (u, v) = ((base.x + step.x * at) / z, (base.y + step.y * at) / z);
            let inside = (z > Z_MIN) & (u >= 0.0) & (v >= 0.0) & (u <= w) & (v <= h);
            let (u, v) = if inside { (u - 0.5, v - 0.5) } else { (0.0, 0.0) };
            let (u, v) = (u.max(0.0).min(w - 1.0), v.max(0.0).min(h - 1.0));
            let (left, top) = (u as i32, v as i32);
            *fx = u - left as f32;
            *fy = v - top as f32;
            *index = (top * width as i32 + left) as u32;
            *right = u32::from(left + 1 < width as i32);
            *down = if top + 1 < height as i32 { width as u32 } else { 0 };
            *valid = if inside { 1.0 } else { 0.0 };
        }
    }

    /// Samples of `plane`; 0 where none is valid.
    fn read(&self, plane: &[f32], out: &mut [f32]) {
        let ints = self.index.iter().zip(&self.right).zip(&self.down);
        let floats = self.fx.iter().zip(&self.fy).zip(&self.valid);
        for ((out, ((index, right), down)), ((fx, fy), valid)) in
            out.iter_mut().zip(ints).zip(floats)
        {
            let (i, r, d) = (*index as usize, *right as usize, *down as usize);
            let top = (1.0 - fx) * plane[i] + fx * plane[i + r];
            let bottom = (1.0 - fx) * plane[i + d] + fx * plane[i + d + r];
            *out = valid * ((1.0 - fy) * top + fy * bottom);
        }
    }
}

/// The four channels, `[4, D, h, w]`, for `disparities` (1 / reference camera z).
pub fn raw_matching(
    reference: (&Pyramid, &Camera),
    source: (&Pyramid, &Camera),
    disparities: &[f32],
) -> Vec<f32> {
    let plane = reference.0.height * reference.0.width;
    let mut out = vec![0.0; CHANNELS * disparities.len() * plane];
    write_raw_matching(reference, source, disparities, &mut out);
    out
}

/// Writes [`raw_matching`] to `out`, whose elements are 0.
pub fn write_raw_matching(
    reference: (&Pyramid, &Camera),
    source: (&Pyramid, &Camera),
    disparities: &[f32],
    out: &mut [f32],
) {
    let (r, s) = (reference.0, source.0);
    let (h, w) = (r.height, r.width);
    let n = h * w;
    if n * disparities.len() == 0 {
        return;
    }
    let pair = Pair {
        reference: r,
        source: s,
        half: PlaneWarp::new(reference.1, source.1, 2 * w, 2 * h),
        quarter: PlaneWarp::new(reference.1, source.1, w, h),
    };
    let (first, rest) = out.split_at_mut(n * disparities.len());
    let (second, rest) = rest.split_at_mut(n * disparities.len());
    let (third, fourth) = rest.split_at_mut(n * disparities.len());
    let outs = first.par_chunks_exact_mut(n).zip(second.par_chunks_exact_mut(n));
    let outs = outs.zip(third.par_chunks_exact_mut(n)).zip(fourth.par_chunks_exact_mut(n));
    disparities.par_iter().zip(outs).for_each_init(Work::default, |work, (&disparity, outs)| {
        let (((fine, colour), coarse), valid) = outs;
        pair.half_resolution(disparity, work);
        work.sums.score(fine, None);
        pair.quarter_resolution(disparity, work, colour);
        work.sums.score(coarse, Some(valid));
    });
}

/// Scratch memory of one thread.
#[derive(Default)]
struct Work {
    line: Line,
    /// Samples of up to three channels along a line.
    samples: [Vec<f32>; 3],
    sums: Sums,
}

impl Work {
    fn samples(&mut self, width: usize) {
        for row in &mut self.samples {
            row.resize(width, 0.0);
        }
    }
}

/// Two photographs.
struct Pair<'a> {
    reference: &'a Pyramid,
    source: &'a Pyramid,
    half: PlaneWarp,
    quarter: PlaneWarp,
}

impl Pair<'_> {
    /// Sums for windows of 6×6 half-resolution pixels, 2 before and 3 after the first of
    /// each pair: three pairs.
    fn half_resolution(&self, disparity: f32, work: &mut Work) {
        let (h, w) = (self.reference.height, self.reference.width);
        work.sums.begin([h, w], 1, 4.0);
        work.samples(2 * w);
        for y in 0..2 * h {
            work.line.place(&self.half, y, disparity, (2 * h, 2 * w));
            work.line.read(&self.source.half_grey, &mut work.samples[0]);
            let own = &self.reference.half_grey[2 * y * w..2 * (y + 1) * w];
            let valid = &work.line.valid;
            let samples = &work.samples[0];
            let sums = &mut work.sums;
            vectorize(
                #[inline(always)]
                || sums.add(y / 2, [valid, own, samples], 2),
            );
        }
    }

    /// Sums for windows of 5×5 quarter-resolution pixels; adds −mean |ΔRGB|
    /// to `colour`, −0.25 (that of unrelated pixels) where there is no sample.
    fn quarter_resolution(&self, disparity: f32, work: &mut Work, colour: &mut [f32]) {
        let (h, w) = (self.reference.height, self.reference.width);
        let n = h * w;
        work.sums.begin([h, w], 2, 1.0);
        work.samples(w);
        for y in 0..h {
            work.line.place(&self.quarter, y, disparity, (h, w));
            for (c, row) in work.samples.iter_mut().enumerate() {
                work.line.read(&self.source.quarter_rgb[c * n..(c + 1) * n], row);
            }
            let own = |c: usize| &self.reference.quarter_rgb[c * n + y * w..][..w];
            let rgb = [own(0), own(1), own(2)];
            let grey = &self.reference.quarter_grey[y * w..(y + 1) * w];
            let colour = &mut colour[y * w..(y + 1) * w];
            let (valid, [red, green, blue], sums) =
                (&work.line.valid, &mut work.samples, &mut work.sums);
            vectorize(
                #[inline(always)]
                || {
                    for x in 0..w {
                        let samples = [red[x], green[x], blue[x]];
                        let sum = (0..3).fold(0.0, |sum, c| sum + (samples[c] - rgb[c][x]).abs());
                        colour[x] -= if valid[x] > 0.0 { sum / 3.0 } else { 0.25 };
                        red[x] = (samples[0] + samples[1] + samples[2]) / 3.0;
                    }
                    sums.add(y, [valid, grey, red], 1);
                },
            );
        }
    }
}

/// Number of sums in [`Sums`]: Σ 1, r, s, r², s², r·s over valid samples s of reference r.
const WINDOW_SUMS: usize = 6;

/// Sums over blocks, then over windows of (2·radius + 1)² blocks.
#[derive(Default)]
struct Sums {
    size: [usize; 2],
    radius: usize,
    /// Samples of a whole window.
    full: f32,
    /// `[6, h, w + 2·radius]`: of blocks, zeros at the sides.
    blocks: Vec<f32>,
    /// `[6, h, w]`: over the columns of the window.
    columns: Vec<f32>,
}

impl Sums {
    /// Zeros for a new picture of h × w blocks of `samples` each.
    fn begin(&mut self, size: [usize; 2], radius: usize, samples: f32) {
        let [h, w] = size;
        let side = (2 * radius + 1) as f32;
        (self.size, self.radius, self.full) = (size, radius, side * side * samples);
        self.blocks.clear();
        self.blocks.resize(WINDOW_SUMS * h * (w + 2 * radius), 0.0);
        self.columns.clear();
        self.columns.resize(WINDOW_SUMS * h * w, 0.0);
    }

    /// Adds a line (validity, reference, samples) to the blocks of row `y`; blocks are
    /// `step` (1 or 2) pixels wide.
    #[inline(always)]
    fn add(&mut self, y: usize, [valid, own, samples]: [&[f32]; 3], step: usize) {
        let [h, w] = self.size;
        let wide = w + 2 * self.radius;
        let row = |p: usize| p * h * wide + y * wide + self.radius;
        let line = [valid, own, samples];
        let to = |p: usize| row(p)..row(p) + w;
        add_line(&mut self.blocks[to(0)], line, step, |v, _, _| v);
        add_line(&mut self.blocks[to(1)], line, step, |v, a, _| v * a);
        add_line(&mut self.blocks[to(2)], line, step, |_, _, b| b);
        add_line(&mut self.blocks[to(3)], line, step, |v, a, _| v * a * a);
        add_line(&mut self.blocks[to(4)], line, step, |_, _, b| b * b);
        add_line(&mut self.blocks[to(5)], line, step, |_, a, b| a * b);
    }

    /// Adds the zero-mean normalised cross-correlation in [−1, 1] to `out`
    /// `[h, w]` (0 where less than half of the window is valid), and that of the valid
    /// share of the window to `valid`.
    fn score(&mut self, out: &mut [f32], valid: Option<&mut [f32]>) {
        let ([h, w], r) = (self.size, self.radius);
        let wide = w + 2 * r;
        vectorize(
            #[inline(always)]
            || {
                let rows = self.blocks.chunks_exact(wide).zip(self.columns.chunks_exact_mut(w));
                for (blocks, sums) in rows {
                    for t in 0..=2 * r {
                        for (sum, v) in sums.iter_mut().zip(&blocks[t..t + w]) {
                            *sum += v;
                        }
                    }
                }
            },
        );
        let mut windows = vec![0f32; WINDOW_SUMS * w];
        let mut valid = valid;
        for (y, out) in out.chunks_exact_mut(w).enumerate() {
            windows.fill(0.0);
            vectorize(
                #[inline(always)]
                || {
                    for (p, sums) in windows.chunks_exact_mut(w).enumerate() {
                        for row in y.saturating_sub(r)..(y + r + 1).min(h) {
                            let row = &self.columns[(p * h + row) * w..][..w];
                            sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
                        }
                    }
                    score_line(&windows, self.full, out);
                    if let Some(valid) = &mut valid {
                        let counts = windows[..w].iter().zip(&mut valid[y * w..(y + 1) * w]);
                        counts.for_each(|(count, to)| *to += count / self.full);
                    }
                },
            );
        }
    }
}

/// Adds f of (validity, reference, sample) to `sums`, `step` (1 or 2) pixels to each.
#[inline(always)]
fn add_line(
    sums: &mut [f32],
    [valid, own, samples]: [&[f32]; 3],
    step: usize,
    f: impl Fn(f32, f32, f32) -> f32,
) {
    if step == 1 {
        for (((sum, v), a), b) in sums.iter_mut().zip(valid).zip(own).zip(samples) {
            *sum += f(*v, *a, *b);
        }
    } else {
        let pairs = valid.chunks_exact(2).zip(own.chunks_exact(2)).zip(samples.chunks_exact(2));
        for (sum, ((v, a), b)) in sums.iter_mut().zip(pairs) {
            *sum += f(v[0], a[0], b[0]) + f(v[1], a[1], b[1]);
        }
    }
}

/// Adds the scores of a line of windows, `[6, w]` sums.
#[inline(always)]
fn score_line(windows: &[f32], full: f32, out: &mut [f32]) {
    let w = out.len();
    let plane = |p: usize| &windows[p * w..(p + 1) * w];
    let (count, a, b) = (plane(0), plane(1), plane(2));
    let (aa, bb, ab) = (plane(3), plane(4), plane(5));
    for x in 0..w {
        let inverse = 1.0 / count[x].max(1.0);
        let (mean_a, mean_b) = (a[x] * inverse, b[x] * inverse);
        let var_a = (aa[x] * inverse - mean_a * mean_a).max(0.0) + VARIANCE_FLOOR;
        let var_b = (bb[x] * inverse - mean_b * mean_b).max(0.0) + VARIANCE_FLOOR;
        let score = (ab[x] * inverse - mean_a * mean_b) / (var_a * var_b).sqrt();
        out[x] += if count[x] < 0.5 * full { 0.0 } else { score };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;

    /// A smooth random texture on the plane z = 4, seen by two cameras side by side.
    fn photograph(camera: &Camera) -> Vec<f32> {
        let k = camera.intrinsics;
        let mut rgb = vec![0.0; 3 * k.width * k.height];
        for y in 0..k.height {
            for x in 0..k.width {
                let ray = k.unproject(glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                let p = camera.world_from_camera.transform_point3(ray * 4.0);
                for c in 0..3 {
                    let f = c as f32 + 1.0;
                    let v = (7.0 * p.x * f).sin() * (5.0 * p.y + f).cos()
                        + (13.0 * p.x + 11.0 * p.y * f).sin();
                    rgb[(c * k.height + y) * k.width + x] = 0.5 + 0.2 * v;
                }
            }
        }
        rgb
    }

    fn cameras() -> [Camera; 2] {
        let k = Intrinsics::from_fov_x(0.9, 128, 96);
        [0.0, 0.4].map(|x| Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap())
    }

    #[test]
    fn the_right_candidate_wins() {
        let [a, b] = cameras();
        let pyramids = [&a, &b].map(|c| Pyramid::new(&photograph(c), 96, 128));
        let disparities: Vec<f32> = (0..16).map(|k| 0.05 + 0.04 * k as f32).collect(); // 0.25 is k = 5
        let out = raw_matching((&pyramids[0], &a), (&pyramids[1], &b), &disparities);
        let (h, w, d) = (24, 32, 16);
        for c in [0, 1, 2] {
            let mut right = 0;
            for y in 4..20 {
                for x in 12..28 {
                    let value = |k: usize| out[((c * d + k) * h + y) * w + x];
                    let best = (0..d).max_by(|&i, &j| value(i).total_cmp(&value(j))).unwrap();
                    right += usize::from(best == 5);
                }
            }
            // One pixel's colour alone is ambiguous more often than a window.
            let enough = if c == 1 { 200 } else { 240 };
            assert!(right >= enough, "channel {c}: {right} of 256 pixels");
        }
        let zncc = out[(5 * h + 12) * w + 20];
        assert!(zncc > 0.95 && zncc <= 1.0 + 1e-4, "{zncc}");
    }

    #[test]
    fn what_the_source_does_not_see_is_invalid() {
        let [a, b] = cameras();
        let pyramids = [&a, &b].map(|c| Pyramid::new(&photograph(c), 96, 128));
        let out = raw_matching((&pyramids[0], &a), (&pyramids[1], &b), &[2.0]);
        // At disparity 2 (depth ½) the shift is most of the picture: left column unseen.
        let plane = 24 * 32;
        assert_eq!(out[3 * plane + 12 * 32], 0.0);
        assert_eq!(out[12 * 32], 0.0);
        assert!(out.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn a_camera_that_looks_away_gives_no_match() {
        let [a, _] = cameras();
        let turned = Mat4::from_rotation_y(std::f32::consts::PI);
        let b = Camera::new(a.intrinsics, turned).unwrap();
        let p = Pyramid::new(&photograph(&a), 96, 128);
        let out = raw_matching((&p, &a), (&p, &b), &[0.25, 1.0]);
        assert!(out[3 * 2 * 24 * 32..].iter().all(|v| *v == 0.0));
    }
}
