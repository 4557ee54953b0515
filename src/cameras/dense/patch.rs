//! The patch around a pixel, and its difference from another photograph.

use crate::cameras::matches::GrayImage;
use glam::{DMat3, DVec3};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Samples of a patch are this far apart, px.
const STEP: i32 = 2;
/// Samples on either side of the pixel.
const REACH: i32 = 2;
/// Samples of a side.
const SIDE: usize = 2 * REACH as usize + 1;
/// Samples of a patch.
pub(super) const SAMPLES: usize = SIDE * SIDE;
/// [`SAMPLES`], rounded up to whole vectors of [`SUMS`] floats. The further samples have no weight.
pub(super) const PADDED: usize = 32;
/// Partial sums, so that the order of summation does not depend on the width of vectors.
const SUMS: usize = 8;
/// Difference of brightness that lowers a sample's weight by a factor of e: samples of another surface
/// count less (bilateral weights of Yoon and Kweon 2006).
const BRIGHTNESS_SCALE: f32 = 0.15;
/// Weight that all samples have at least.
const WEIGHT_MIN: f32 = 1e-3;
/// Added to the variances, so that noise on an even surface does not correlate: 0.6 % of the brightness.
const VARIANCE_FLOOR: f32 = 4e-5;
/// Share of the weights that the other photograph must show.
const SHOWN_MIN: f32 = 0.5;
/// Least depth in the other photograph over that in the first.
const DEPTH_MIN: f32 = 1e-4;

/// Difference of a patch that the other photograph does not show: the largest one.
pub(super) const HIDDEN: f32 = 2.0;

/// Projection of the pixels of one photograph into another: `x' ~ A·(x, y, 1) + b/z`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Warp {
    /// Rows of A.
    a: [[f32; 3]; 3],
    b: [f32; 3],
}

impl Warp {
    pub fn new(from: &Camera, to: &Camera) -> Self {
        let relative =
            to.world_from_camera().as_dmat4().inverse() * from.world_from_camera().as_dmat4();
        let k = |k: Intrinsics| {
            let [fx, fy, cx, cy] = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
            DMat3::from_cols(DVec3::X * fx, DVec3::Y * fy, DVec3::new(cx, cy, 1.0))
        };
        let to = k(to.intrinsics());
        let a = to * DMat3::from_mat4(relative) * k(from.intrinsics()).inverse();
        let b = to * relative.w_axis.truncate();
        let rows = a.transpose();
        let row = |v: DVec3| v.as_vec3().to_array();
        Self { a: [row(rows.x_axis), row(rows.y_axis), row(rows.z_axis)], b: row(b) }
    }

    /// Projects the pixel (x, y) with the inverse depth `inverse`; `None` behind the other camera.
    pub fn project(&self, [x, y]: [f32; 2], inverse: f32) -> Option<[f32; 2]> {
        let [u, v, w] = [0, 1, 2].map(|i| {
            let a = &self.a[i];
            a[0] * x + a[1] * y + a[2] + self.b[i] * inverse
        });
        (w > DEPTH_MIN).then(|| [u / w, v / w])
    }
}

/// Offsets of the samples along one axis, px.
const fn offsets(along_rows: bool) -> [f32; PADDED] {
    let mut out = [0.0; PADDED];
    let mut i = 0;
    while i < SAMPLES {
        let at = if along_rows { i / SIDE } else { i % SIDE };
        out[i] = (STEP * (at as i32 - REACH)) as f32;
        i += 1;
    }
    out
}

const X_OFFSETS: [f32; PADDED] = offsets(false);
const Y_OFFSETS: [f32; PADDED] = offsets(true);

/// Samples around a pixel, and their weights.
pub(super) struct Patch {
    centre: [f32; 2],
    values: [f32; PADDED],
    weights: [f32; PADDED],
    /// Sum of the weights.
    weight: f32,
}

impl Patch {
    /// The weights of the patch around pixel (x, y); 0 outside the picture and at masked pixels.
    pub fn weights(picture: &GrayImage, x: usize, y: usize) -> [f32; SAMPLES] {
        let centre = picture.row(y)[x];
        std::array::from_fn(|i| {
            let (dx, dy) = (X_OFFSETS[i], Y_OFFSETS[i]);
            let Some(value) = sample(picture, x, y, i) else { return 0.0 };
            let reach = (STEP * REACH) as f32;
            let distance = (dx * dx + dy * dy) / (2.0 * reach * reach);
            (-distance - (value - centre).abs() / BRIGHTNESS_SCALE).exp() + WEIGHT_MIN
        })
    }

    /// The patch around pixel (x, y) with its [`Patch::weights`].
    #[inline(always)]
    pub fn new(picture: &GrayImage, x: usize, y: usize, of: &[f32; SAMPLES]) -> Self {
        let (mut values, mut weights) = ([0.0; PADDED], [0.0; PADDED]);
        for (i, value) in values.iter_mut().enumerate().take(SAMPLES) {
            *value = sample(picture, x, y, i).unwrap_or(0.0);
        }
        weights[..SAMPLES].copy_from_slice(of);
        let weight = of.iter().sum();
        Self { centre: [x as f32 + 0.5, y as f32 + 0.5], values, weights, weight }
    }

    /// 1 − the weighted correlation of the patch, which lies on the plane of inverse depth `inverse` with
    /// the given slopes a pixel, with the other photograph: 0 to 2. [`HIDDEN`] where that does not show it.
    #[inline(always)]
    pub fn difference(
        &self,
        warp: &Warp,
        source: &GrayImage,
        inverse: f32,
        slopes: [f32; 2],
    ) -> f32 {
        let [x, y] = self.centre;
        let mut affine = [[0.0; 3]; 3];
        for ((to, a), b) in affine.iter_mut().zip(&warp.a).zip(&warp.b) {
            let at = a[0] * x + a[1] * y + a[2] + b * inverse;
            *to = [at, a[0] + b * slopes[0], a[1] + b * slopes[1]];
        }
        let [us, vs, ws] = affine;
        let right = (source.width() - 1) as f32;
        let bottom = (source.height() - 1) as f32;
        // The last column and row are reached from those before.
        let left_max = (right - 1.0).max(0.0);
        let top_max = (bottom - 1.0).max(0.0);
        let width = source.width() as i32;
        let (mut weights, mut corners) = ([0.0f32; PADDED], [0u32; PADDED]);
        let (mut across, mut down) = ([0.0f32; PADDED], [0.0f32; PADDED]);
        for i in 0..PADDED {
            let (dx, dy) = (X_OFFSETS[i], Y_OFFSETS[i]);
            let u = us[0] + us[1] * dx + us[2] * dy;
            let v = vs[0] + vs[1] * dx + vs[2] * dy;
            let w = ws[0] + ws[1] * dx + ws[2] * dy;
            // Pixel centres are at +0.5.
            let column = u / w - 0.5;
            let row = v / w - 0.5;
            let inside = column >= 0.0 && column <= right && row >= 0.0 && row <= bottom;
            let shown = w > DEPTH_MIN && inside;
            weights[i] = if shown { self.weights[i] } else { 0.0 };
            let column = if shown { column } else { 0.0 };
            let row = if shown { row } else { 0.0 };
            // Neither is negative, so that the conversion rounds down.
            let left = column.min(left_max) as i32;
            let top = row.min(top_max) as i32;
            across[i] = column - left as f32;
            down[i] = row - top as f32;
            corners[i] = (top * width + left) as u32;
        }
        if let Some(mask) = source.mask() {
            // A masked pixel shows something else, or nothing.
            for i in 0..SAMPLES {
                let right = usize::from(across[i] > 0.5);
                let below = if down[i] > 0.5 { source.width() } else { 0 };
                let at = corners[i] as usize + right + below;
                if mask.kept().get(at) == Some(&false) {
                    weights[i] = 0.0;
                }
            }
        }
        let mut corner_values = [[0.0f32; PADDED]; 4];
        let (pixels, below) = (source.pixels(), source.pixels().get(source.width()..));
        let below = below.filter(|below| !below.is_empty()).unwrap_or(pixels);
        for i in 0..SAMPLES {
            let at = corners[i] as usize;
            let (Some(&[a, b]), Some(&[c, d])) =
                (pixels[at..].first_chunk(), below[at.min(below.len() - 1)..].first_chunk())
            else {
                return HIDDEN;
            };
            corner_values[0][i] = a;
            corner_values[1][i] = b;
            corner_values[2][i] = c;
            corner_values[3][i] = d;
        }
        let mut sums = [[0.0f32; SUMS]; 6];
        for i in (0..PADDED).step_by(SUMS) {
            for j in 0..SUMS {
                let (a, c) = (corner_values[0][i + j], corner_values[2][i + j]);
                let upper = a + across[i + j] * (corner_values[1][i + j] - a);
                let lower = c + across[i + j] * (corner_values[3][i + j] - c);
                let other = upper + down[i + j] * (lower - upper);
                let (w, own) = (weights[i + j], self.values[i + j]);
                sums[0][j] += w;
                sums[1][j] += w * own;
                sums[2][j] += w * other;
                sums[3][j] += w * own * own;
                sums[4][j] += w * other * other;
                sums[5][j] += w * own * other;
            }
        }
        let mut totals = [0.0f32; 6];
        for (total, sums) in totals.iter_mut().zip(&sums) {
            for sum in sums {
                *total += sum;
            }
        }
        let [weight, own, other, own2, other2, both] = totals;
        if !(weight > SHOWN_MIN * self.weight) {
            return HIDDEN;
        }
        let mean = [own / weight, other / weight];
        let variance = (own2 / weight - mean[0] * mean[0]).max(0.0) + VARIANCE_FLOOR;
        let other_variance = (other2 / weight - mean[1] * mean[1]).max(0.0) + VARIANCE_FLOOR;
        let covariance = both / weight - mean[0] * mean[1];
        1.0 - covariance / (variance * other_variance).sqrt()
    }
}

/// Value of sample `i` of the patch around pixel (x, y); `None` outside the picture and at masked pixels.
#[inline(always)]
fn sample(picture: &GrayImage, x: usize, y: usize, i: usize) -> Option<f32> {
    let column = x.checked_add_signed(X_OFFSETS[i] as isize)?;
    let row = y.checked_add_signed(Y_OFFSETS[i] as isize)?;
    let inside = column < picture.width() && row < picture.height();
    let at = row * picture.width() + column;
    (inside && picture.mask().is_none_or(|mask| mask.kept()[at])).then(|| picture.pixels()[at])
}
