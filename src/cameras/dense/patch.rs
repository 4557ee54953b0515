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
}

impl Patch {
    /// The weights of the patch around pixel (x, y); 0 outside the picture.
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
        for i in 0..SAMPLES {
            values[i] = sample(picture, x, y, i).unwrap_or(0.0);
        }
        weights[..SAMPLES].copy_from_slice(of);
        Self { centre: [x as f32 + 0.5, y as f32 + 0.5], values, weights }
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
        let affine = [0, 1, 2].map(|i| {
            let (a, b) = (&warp.a[i], warp.b[i]);
            let at = a[0] * x + a[1] * y + a[2] + b * inverse;
            [at, a[0] + b * slopes[0], a[1] + b * slopes[1]]
        });
        let [right, bottom] = [source.width() - 1, source.height() - 1].map(|v| v as f32);
        let (mut columns, mut rows, mut weights) =
            ([0.0f32; PADDED], [0.0f32; PADDED], [0.0f32; PADDED]);
        for i in 0..PADDED {
            let [u, v, w] = affine.map(|[at, dx, dy]| at + dx * X_OFFSETS[i] + dy * Y_OFFSETS[i]);
            // Pixel centres are at +0.5.
            let column = u / w - 0.5;
            let row = v / w - 0.5;
            let shown =
                w > DEPTH_MIN && column >= 0.0 && column <= right && row >= 0.0 && row <= bottom;
            weights[i] = if shown { self.weights[i] } else { 0.0 };
            columns[i] = if shown { column } else { 0.0 };
            rows[i] = if shown { row } else { 0.0 };
        }
        let mut found = [0.0f32; PADDED];
        let (pixels, width) = (source.pixels(), source.width());
        for i in 0..SAMPLES {
            // The last column and row are reached from those before.
            let left = (columns[i] as usize).min(width.saturating_sub(2));
            let top = (rows[i] as usize).min(source.height().saturating_sub(2));
            let (fx, fy) = (columns[i] - left as f32, rows[i] - top as f32);
            let at = top * width + left;
            let (Some([a, b]), Some([c, d])) = (
                pixels[at..].first_chunk(),
                pixels.get(at + width..).and_then(<[f32]>::first_chunk),
            ) else {
                return HIDDEN;
            };
            let upper = a + fx * (b - a);
            let lower = c + fx * (d - c);
            found[i] = upper + fy * (lower - upper);
        }
        let mut sums = [[0.0f32; SUMS]; 7];
        for i in (0..PADDED).step_by(SUMS) {
            for j in 0..SUMS {
                let (w, own, other) = (weights[i + j], self.values[i + j], found[i + j]);
                sums[0][j] += w;
                sums[1][j] += w * own;
                sums[2][j] += w * other;
                sums[3][j] += w * own * own;
                sums[4][j] += w * other * other;
                sums[5][j] += w * own * other;
                sums[6][j] += self.weights[i + j];
            }
        }
        let [weight, own, other, own2, other2, both, all] = sums.map(|s| s.iter().sum::<f32>());
        if !(weight > SHOWN_MIN * all) {
            return HIDDEN;
        }
        let mean = [own / weight, other / weight];
        let variance = (own2 / weight - mean[0] * mean[0]).max(0.0) + VARIANCE_FLOOR;
        let other_variance = (other2 / weight - mean[1] * mean[1]).max(0.0) + VARIANCE_FLOOR;
        let covariance = both / weight - mean[0] * mean[1];
        1.0 - covariance / (variance * other_variance).sqrt()
    }
}

/// Value of sample `i` of the patch around pixel (x, y); `None` outside the picture.
#[inline(always)]
fn sample(picture: &GrayImage, x: usize, y: usize, i: usize) -> Option<f32> {
    let column = x.checked_add_signed(X_OFFSETS[i] as isize)?;
    let row = y.checked_add_signed(Y_OFFSETS[i] as isize)?;
    let inside = column < picture.width() && row < picture.height();
    inside.then(|| picture.pixels()[row * picture.width() + column])
}
