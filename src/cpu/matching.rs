//! Raw matching channels of a plane sweep: how well two photographs agree at each
//! pixel of the reference view for each depth candidate, without any learning.
//! They stand beside the learned correlation of the small backbone
//! (ARCHITECTURE.md, "The small backbone").
//!
//! In: both photographs as area means at half resolution (grey) and at quarter
//! resolution (RGB), cameras, candidates. Out: `[4, D, h, w]` at quarter resolution:
//! ZNCC over 6×6 half-resolution pixels, −mean |ΔRGB|, ZNCC over 5×5
//! quarter-resolution pixels, share of valid samples. A candidate's source pixel
//! that lies outside the picture or behind the camera is left out of every window.

use crate::camera::{Camera, Intrinsics};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Channels of [`raw_matching`].
pub const CHANNELS: usize = 4;

/// Added to each window's variance (grey levels in [0, 1]): a standard deviation of
/// 0.01 is camera noise, and must not count as texture.
const VARIANCE_FLOOR: f32 = 1e-4;
/// A source point nearer than this, as a share of the reference depth, is behind.
const Z_MIN: f32 = 1e-3;

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

/// Where the pixels of one picture land in another for a plane at constant
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

    /// Source position (px, centres at +0.5) of the reference pixel (x, y) at
    /// `disparity` = 1 / camera z, or `None` behind the source camera.
    #[inline]
    pub fn apply(&self, x: usize, y: usize, disparity: f32) -> Option<(f32, f32)> {
        let p =
            self.from_px * Vec3::new(x as f32 + 0.5, y as f32 + 0.5, 1.0) + self.shift * disparity;
        (p.z > Z_MIN).then(|| (p.x / p.z, p.y / p.z))
    }
}

/// Position split into the four neighbours' index, offsets and shares.
#[derive(Clone, Copy)]
struct Taps {
    index: [usize; 4],
    weight: [f32; 4],
}

/// Bilinear taps at (u, v) px; `None` outside the picture. Within half a pixel of
/// the border the border pixel itself is read.
#[inline]
fn taps(u: f32, v: f32, width: usize, height: usize) -> Option<Taps> {
    if !(u >= 0.0 && v >= 0.0 && u <= width as f32 && v <= height as f32) {
        return None;
    }
    let x = (u - 0.5).clamp(0.0, (width - 1) as f32);
    let y = (v - 0.5).clamp(0.0, (height - 1) as f32);
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    Some(Taps {
        index: [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1],
        weight: [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy],
    })
}

impl Taps {
    #[inline]
    fn read(&self, plane: &[f32]) -> f32 {
        (0..4).map(|i| self.weight[i] * plane[self.index[i]]).sum()
    }
}

/// The four channels, `[4, D, h, w]`, for `disparities` (1 / reference camera z).
pub fn raw_matching(
    reference: (&Pyramid, &Camera),
    source: (&Pyramid, &Camera),
    disparities: &[f32],
) -> Vec<f32> {
    let (r, s) = (reference.0, source.0);
    let (h, w, d) = (r.height, r.width, disparities.len());
    let quarter = PlaneWarp::new(reference.1, source.1, w, h);
    let half = PlaneWarp::new(reference.1, source.1, 2 * w, 2 * h);
    let planes: Vec<[Vec<f32>; CHANNELS]> = disparities
        .par_iter()
        .map(|&disparity| {
            let fine = Window { before: 2, after: 3, step: 2 };
            let coarse = Window { before: 2, after: 2, step: 1 };
            let (zncc_half, _) =
                zncc(&r.half_grey, &s.half_grey, (2 * h, 2 * w), &half, disparity, fine);
            let (zncc_quarter, valid) =
                zncc(&r.quarter_grey, &s.quarter_grey, (h, w), &quarter, disparity, coarse);
            [zncc_half, colour_difference(r, s, &quarter, disparity), zncc_quarter, valid]
        })
        .collect();
    let mut out = vec![0.0; CHANNELS * d * h * w];
    for (k, channels) in planes.iter().enumerate() {
        for (c, plane) in channels.iter().enumerate() {
            out[(c * d + k) * h * w..][..h * w].copy_from_slice(plane);
        }
    }
    out
}

/// −mean |ΔRGB| per quarter-resolution pixel; invalid samples count as the
/// difference of unrelated pixels, −0.25.
fn colour_difference(r: &Pyramid, s: &Pyramid, warp: &PlaneWarp, disparity: f32) -> Vec<f32> {
    let (h, w) = (r.height, r.width);
    let plane = h * w;
    let mut out = vec![-0.25; plane];
    for y in 0..h {
        for x in 0..w {
            let at = y * w + x;
            let hit = warp.apply(x, y, disparity).and_then(|(u, v)| taps(u, v, w, h));
            if let Some(t) = hit {
                let sum: f32 = (0..3)
                    .map(|c| {
                        let channel = &s.quarter_rgb[c * plane..(c + 1) * plane];
                        (t.read(channel) - r.quarter_rgb[c * plane + at]).abs()
                    })
                    .sum();
                out[at] = -sum / 3.0;
            }
        }
    }
    out
}

/// Window around output pixel j: inputs j·step − before ..= j·step + after.
#[derive(Clone, Copy)]
struct Window {
    before: usize,
    after: usize,
    step: usize,
}

impl Window {
    /// Box sums of `plane[height, width]` on the output grid.
    fn sums(self, plane: &[f32], height: usize, width: usize) -> Vec<f32> {
        let (h, w) = (height / self.step, width / self.step);
        let range = |j: usize, n: usize| {
            let centre = j * self.step;
            centre.saturating_sub(self.before)..(centre + self.after + 1).min(n)
        };
        let mut rows = vec![0.0; height * w];
        for y in 0..height {
            let row = &plane[y * width..(y + 1) * width];
            for (x, o) in rows[y * w..(y + 1) * w].iter_mut().enumerate() {
                *o = row[range(x, width)].iter().sum();
            }
        }
        let mut out = vec![0.0; h * w];
        for y in 0..h {
            for yy in range(y, height) {
                let row = &rows[yy * w..(yy + 1) * w];
                for (o, v) in out[y * w..(y + 1) * w].iter_mut().zip(row) {
                    *o += v;
                }
            }
        }
        out
    }
}

/// Zero-mean normalised cross-correlation in [−1, 1] and the share of valid samples
/// in each window, both `[h, w]` of the output grid; 0 where less than half of the
/// window is valid.
fn zncc(
    reference: &[f32],
    source: &[f32],
    (height, width): (usize, usize),
    warp: &PlaneWarp,
    disparity: f32,
    window: Window,
) -> (Vec<f32>, Vec<f32>) {
    let n = height * width;
    // Masked planes: 1, r, w, r², w², r·w.
    let mut planes: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.0; n]);
    for y in 0..height {
        for x in 0..width {
            let hit = warp.apply(x, y, disparity).and_then(|(u, v)| taps(u, v, width, height));
            if let Some(t) = hit {
                let at = y * width + x;
                let (a, b) = (reference[at], t.read(source));
                let values = [1.0, a, b, a * a, b * b, a * b];
                for (plane, value) in planes.iter_mut().zip(values) {
                    plane[at] = value;
                }
            }
        }
    }
    let sums = planes.map(|p| window.sums(&p, height, width));
    let full = ((window.before + window.after + 1) as f32).powi(2);
    let score = |i: usize| {
        let count = sums[0][i];
        if count < 0.5 * full {
            return 0.0;
        }
        let (a, b) = (sums[1][i] / count, sums[2][i] / count);
        let var_a = (sums[3][i] / count - a * a).max(0.0) + VARIANCE_FLOOR;
        let var_b = (sums[4][i] / count - b * b).max(0.0) + VARIANCE_FLOOR;
        (sums[5][i] / count - a * b) / (var_a * var_b).sqrt()
    };
    let outputs = sums[0].len();
    ((0..outputs).map(score).collect(), sums[0].iter().map(|c| c / full).collect())
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
