//! Moves a matched point to the place where the surroundings of both points agree, below the pixel.
//!
//! The window around the first point is compared with the second photograph under an affine map, a
//! gain and an offset (Gauss-Newton steps). Source: B. Lucas and T. Kanade 1981; J. Shi and
//! C. Tomasi, "Good features to track", 1994.

use super::GrayImage;
use glam::{DMat2, DVec2};
use nalgebra::{SMatrix, SVector};

/// Half of the side of the window, in samples.
const RADIUS: i32 = 7;
const STEPS: usize = 20;
/// Shift at which the steps end, px.
const CONVERGED_PX: f64 = 0.005;

/// Bilinear value and gradient at `p` (pixel centres at +0.5); `None` outside.
fn sample(image: &GrayImage, p: DVec2) -> Option<[f32; 3]> {
    let (x, y) = (p.x - 0.5, p.y - 0.5);
    if !(x >= 1.0 && y >= 1.0 && x < (image.width() - 2) as f64 && y < (image.height() - 2) as f64)
    {
        return None;
    }
    let (i, j) = (x as usize, y as usize);
    let (u, v) = ((x - i as f64) as f32, (y - j as f64) as f32);
    let a = image.at(i, j);
    let b = image.at(i + 1, j);
    let c = image.at(i, j + 1);
    let d = image.at(i + 1, j + 1);
    let value = (1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d);
    let dx = (1.0 - v) * (b - a) + v * (d - c);
    let dy = (1.0 - u) * (c - a) + u * (d - b);
    Some([value, dx, dy])
}

/// Least correlation of the two windows (Pearson's, weighted) after the alignment.
const MIN_CORRELATION: f64 = 0.8;

/// Returns the position in the second picture that corresponds to `places[0]` of the first one,
/// near `places[1]`, px. `sizes` are the features' sizes, px: the window follows the first, the
/// initial map their ratio. `None` where the window leaves a picture, or does not converge or
/// agree.
pub(crate) fn aligned(
    [a, b]: [&GrayImage; 2],
    [at_a, at_b]: [DVec2; 2],
    sizes: [f64; 2],
) -> Option<DVec2> {
    let spacing = sizes[0].max(0.7);
    let ratio = sizes[1] / sizes[0];
    let max_shift = 2.0 + sizes[1];
    let unit = spacing * f64::from(RADIUS);
    let template = template(a, at_a, spacing)?;
    let mut centre = at_b;
    let mut map = DMat2::from_diagonal(DVec2::splat(ratio));
    let (mut gain, mut bias) = (1.0, 0.0);
    let mut correlation = 0.0;
    for step in 0..STEPS {
        let mut sums = Sums::default();
        for s in &template {
            let [value, dx, dy] = sample(b, centre + map * s.offset)?.map(f64::from);
            let DVec2 { x, y } = s.offset / unit;
            let slope = [dx, dy, dx * x, dx * y, dy * x, dy * y, -s.value, -1.0];
            sums.add(s.weight, value - (gain * s.value + bias), &slope);
            sums.add_values(s.weight, value, s.value);
        }
        correlation = sums.correlation();
        let change = sums.step()?;
        centre += DVec2::new(change[0], change[1]);
        let columns = [DVec2::new(change[2], change[4]), DVec2::new(change[3], change[5])];
        map += DMat2::from_cols(columns[0], columns[1]) * (1.0 / unit);
        gain += change[6];
        bias += change[7];
        if !(centre.distance(at_b) < max_shift) {
            return None;
        }
        if step > 2 && change[0].hypot(change[1]) < CONVERGED_PX {
            break;
        }
    }
    (correlation > MIN_CORRELATION).then_some(centre)
}

/// A sample of the window in the first picture.
struct Sample {
    /// Offset from the point, px.
    offset: DVec2,
    value: f64,
    /// Gaussian weight: 1/e at the window's sides.
    weight: f64,
}

/// Samples the window around a point; `None` where it leaves the picture.
fn template(a: &GrayImage, centre: DVec2, spacing: f64) -> Option<Vec<Sample>> {
    let grid = (-RADIUS..=RADIUS).flat_map(|y| (-RADIUS..=RADIUS).map(move |x| (x, y)));
    grid.map(|(x, y)| {
        let offset = DVec2::new(f64::from(x), f64::from(y)) * spacing;
        let far = f64::from(x * x + y * y) / f64::from(RADIUS * RADIUS);
        let value = f64::from(sample(a, centre + offset)?[0]);
        Some(Sample { offset, value, weight: (-far).exp() })
    })
    .collect()
}

/// Parameters: shift (2), affine map (4), gain, offset.
const PARAMETERS: usize = 8;

/// Sums of a Gauss-Newton step.
#[derive(Default)]
struct Sums {
    /// Lower triangle of Σ w·j·jᵀ, row by row.
    squares: [[f64; PARAMETERS]; PARAMETERS],
    /// Σ w·r·j.
    gradient: [f64; PARAMETERS],
    /// Σ w·(1, v, t, v², t², v·t) of the values v and t of both pictures.
    values: [f64; 6],
}

impl Sums {
    #[inline]
    fn add(&mut self, weight: f64, residual: f64, slope: &[f64; PARAMETERS]) {
        for (i, row) in self.squares.iter_mut().enumerate() {
            let scaled = weight * slope[i];
            self.gradient[i] += scaled * residual;
            for (sum, j) in row[..=i].iter_mut().zip(slope) {
                *sum += scaled * j;
            }
        }
    }

    #[inline]
    fn add_values(&mut self, weight: f64, v: f64, t: f64) {
        for (sum, x) in self.values.iter_mut().zip([1.0, v, t, v * v, t * t, v * t]) {
            *sum += weight * x;
        }
    }

    /// Pearson's correlation of both pictures' values.
    fn correlation(&self) -> f64 {
        let [w, v, t, vv, tt, vt] = self.values;
        let (v, t) = (v / w, t / w);
        let variances = (vv / w - v * v) * (tt / w - t * t);
        (vt / w - v * t) / variances.max(1e-12).sqrt()
    }

    /// The step, with a little damping; `None` where the window has no texture.
    fn step(&self) -> Option<[f64; PARAMETERS]> {
        let at = |i: usize, j: usize| self.squares[i.max(j)][i.min(j)];
        let damp = |i: usize, j: usize| if i == j { 1e-4 * at(i, i) + 1e-9 } else { 0.0 };
        let h = SMatrix::<f64, PARAMETERS, PARAMETERS>::from_fn(|i, j| at(i, j) + damp(i, j));
        let step = -h.cholesky()?.solve(&SVector::from(self.gradient));
        Some(step.into())
    }
}
