//! Pictures that are no pinhole photographs, by their pixels: panoramas, and circles of fisheye lenses.

use crate::scene::pictures::Rgb;
use glam::{DMat3, DVec2, DVec3};

/// Rows of the columns that are compared.
const ROWS: usize = 256;
/// Pairs of neighbouring columns that the seam is compared with.
const NEIGHBOURS: usize = 64;
/// Rows over which a column is smoothed to remove its coarse brightness (the sky above the ground).
const SMOOTH: usize = 9;
/// Least contrast of the columns at the seam, 8-bit levels: plain edges, as those of a picture of a product,
/// prove nothing.
const CONTRAST: f64 = 1.0;
/// Least correlation of the columns at the seam. The edges of the 166 photographs of `../shared/photos` have 0.31
/// at most, those of four rendered panoramas (JPEG) 0.87 at least.
const CORRELATION: f64 = 0.6;
/// Largest difference of the columns at the seam over the median difference of neighbours.
const DIFFERENCE: f64 = 4.0;

/// Returns whether the left and the right edge of a picture continue each other, as those of a panorama of 360°.
pub fn edges_meet(picture: &Rgb) -> bool {
    let Rgb { width, height, .. } = *picture;
    if width < 4 || height < 2 * SMOOTH {
        return false;
    }
    let [last, first] = [width - 1, 0].map(|x| column(picture, x));
    let contrast = deviation(&last).min(deviation(&first));
    let mut differences: Vec<f64> = (0..NEIGHBOURS)
        .map(|i| (width - 2) * i / (NEIGHBOURS - 1))
        .map(|x| difference(&column(picture, x), &column(picture, x + 1)))
        .collect();
    differences.sort_by(f64::total_cmp);
    let typical = differences[NEIGHBOURS / 2];
    contrast >= CONTRAST
        && correlation(&last, &first) >= CORRELATION
        && difference(&last, &first) <= DIFFERENCE * typical + 0.5
}

/// Luma of a column in [`ROWS`] rows at most, less its mean over [`SMOOTH`] rows, 8-bit levels.
fn column(picture: &Rgb, x: usize) -> Vec<f64> {
    let rows = ROWS.min(picture.height);
    let value = |y: usize| luma(picture, x, y);
    let block = |i: usize| {
        let range = i * picture.height / rows..(i + 1) * picture.height / rows;
        let count = range.len().max(1) as f64;
        range.map(value).sum::<f64>() / count
    };
    let values: Vec<f64> = (0..rows).map(block).collect();
    let mean = |i: usize| {
        let around = &values[i.saturating_sub(SMOOTH / 2)..(i + SMOOTH / 2 + 1).min(rows)];
        around.iter().sum::<f64>() / around.len() as f64
    };
    (0..rows).map(|i| values[i] - mean(i)).collect()
}

fn luma(picture: &Rgb, x: usize, y: usize) -> f64 {
    let at = 3 * (y * picture.width + x);
    let [r, g, b] = [0, 1, 2].map(|c| f64::from(picture.data[at + c]));
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

fn deviation(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

fn difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.len() as f64
}

/// Correlation of values without their means, −1 to 1.
pub(super) fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let product: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / a.len() as f64;
    product / (deviation(a) * deviation(b)).max(1e-9)
}

/// The bright disc of a fisheye lens on a dark picture, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageCircle {
    /// Centre.
    pub centre: [f64; 2],
    /// Radius.
    pub radius: f64,
}

/// Largest luma of a pixel outside the disc: JPEG leaves noise beside its rim.
const DARK: f64 = 24.0;
/// Directions in which the rim is searched.
const DIRECTIONS: usize = 180;
/// Largest distance of the rim from the circle, of the radius.
const RIM: f64 = 0.015;
/// Least share of the directions that show the rim on the circle.
const ON_RIM: f64 = 0.5;
/// Side of the corners that are dark, of the picture's shorter side.
const CORNER: f64 = 0.04;

/// Finds the disc of a circular fisheye lens: all four corners are dark, and a circle bounds what is not. The disc
/// may be cut by the picture's edges. `None` for other pictures.
pub fn image_circle(picture: &Rgb) -> Option<ImageCircle> {
    let Rgb { width, height, .. } = *picture;
    let side = ((width.min(height) as f64 * CORNER) as usize).max(1);
    if width.min(height) < 64 {
        return None;
    }
    let corners = [[0, 0], [width - side, 0], [0, height - side], [width - side, height - side]];
    let dark = |[x, y]: [usize; 2]| {
        let pixels = (y..y + side).flat_map(|y| (x..x + side).map(move |x| (x, y)));
        pixels.map(|(x, y)| luma(picture, x, y)).sum::<f64>() / ((side * side) as f64) < DARK
    };
    if !corners.into_iter().all(dark) {
        return None;
    }
    let rim = rim(picture);
    let mut chosen = rim.clone();
    let mut circle = fitted(&chosen)?;
    for _ in 0..8 {
        // Dark parts of the scene lie inside the circle.
        chosen = rim.iter().copied().filter(|p| near(&circle, *p, 4.0 * RIM)).collect();
        circle = fitted(&chosen)?;
    }
    let on = rim.iter().filter(|p| near(&circle, **p, RIM)).count();
    let shorter = width.min(height) as f64;
    let sized = (0.25 * shorter..=0.75 * width.max(height) as f64).contains(&circle.radius);
    let inside = (0.0..=width as f64).contains(&circle.centre[0])
        && (0.0..=height as f64).contains(&circle.centre[1]);
    let enough = on as f64 >= ON_RIM * DIRECTIONS as f64 && on as f64 >= 0.8 * rim.len() as f64;
    (sized && inside && enough).then_some(circle)
}

/// Returns whether a picture has the discs of two fisheye lenses beside or above each other, as 360° cameras store them.
pub fn has_two_circles(picture: &Rgb) -> bool {
    let Rgb { width, height, .. } = *picture;
    let beside = width == 2 * height;
    if !beside && height != 2 * width {
        return false;
    }
    let side = width.min(height);
    let half = |second: usize| {
        let from = second * side;
        let rows = if beside { 0..side } else { from..from + side };
        let row = |y: usize| {
            let start = 3 * (y * width + if beside { from } else { 0 });
            &picture.data[start..start + 3 * side]
        };
        Rgb { width: side, height: side, data: rows.flat_map(row).copied().collect() }
    };
    [0, 1].into_iter().all(|second| image_circle(&half(second)).is_some())
}

fn near(circle: &ImageCircle, at: DVec2, share: f64) -> bool {
    let off = at.distance(DVec2::from(circle.centre)) - circle.radius;
    off.abs() <= share * circle.radius
}

/// Outermost bright pixel in each direction from the middle of the bright pixels; directions in which the picture
/// is bright up to its edge are left out.
fn rim(picture: &Rgb) -> Vec<DVec2> {
    let Rgb { width, height, .. } = *picture;
    let step = (width.max(height) / 256).max(1);
    let places =
        || (0..height).step_by(step).flat_map(|y| (0..width).step_by(step).map(move |x| [x, y]));
    let bright = |[x, y]: [usize; 2]| luma(picture, x, y) >= DARK;
    let (mut sum, mut count) = (DVec2::ZERO, 0.0);
    for at in places().filter(|at| bright(*at)) {
        sum += DVec2::new(at[0] as f64, at[1] as f64);
        count += 1.0;
    }
    if count == 0.0 {
        return Vec::new();
    }
    let middle = sum / count;
    let inside = |p: DVec2| {
        let within = p.x >= 0.0 && p.y >= 0.0 && p.x < width as f64 && p.y < height as f64;
        within.then_some([p.x as usize, p.y as usize])
    };
    let mut found = Vec::new();
    for i in 0..DIRECTIONS {
        let angle = std::f64::consts::TAU * i as f64 / DIRECTIONS as f64;
        let direction = DVec2::new(angle.cos(), angle.sin());
        let reach =
            (0..).take_while(|r| inside(middle + direction * f64::from(*r)).is_some()).count();
        let lit = |r: &usize| inside(middle + direction * *r as f64).is_some_and(bright);
        if let Some(last) = (0..reach).rev().find(lit)
            && last + 2 < reach
        {
            found.push(middle + direction * (last as f64 + 0.5));
        }
    }
    found
}

/// The circle with the least squares of its algebraic distances (I. Kåsa 1976).
fn fitted(points: &[DVec2]) -> Option<ImageCircle> {
    if points.len() < 8 {
        return None;
    }
    let mean = points.iter().sum::<DVec2>() / points.len() as f64;
    let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for p in points {
        let q = *p - mean;
        let row = q.extend(1.0);
        a += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        b += row * q.length_squared();
    }
    if a.determinant().abs() < 1e-9 {
        return None;
    }
    let solution = a.inverse() * b;
    let centre = 0.5 * solution.truncate();
    let radius = (solution.z + centre.length_squared()).sqrt();
    let circle = ImageCircle { centre: (mean + centre).to_array(), radius };
    (radius.is_finite() && radius > 0.0).then_some(circle)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Discs of `radius` px around `centres`, uneven, on black.
    fn discs([width, height]: [usize; 2], centres: &[[f64; 2]], radius: f64) -> Rgb {
        let value = |x: usize, y: usize| {
            let at = DVec2::new(x as f64, y as f64);
            let inside = centres.iter().any(|centre| at.distance(DVec2::from(*centre)) < radius);
            if inside { 80 + ((13 * x + 7 * y) % 120) as u8 } else { ((x + y) % 4) as u8 }
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Rgb { width, height, data: pixels.flat_map(|(x, y)| [value(x, y); 3]).collect() }
    }

    #[test]
    fn one_circle_and_two_are_told_apart() {
        let one = discs([400, 300], &[[200.0, 150.0]], 140.0);
        let circle = image_circle(&one).unwrap();
        assert!((circle.radius - 140.0).abs() < 2.0, "{circle:?}");
        assert!(!has_two_circles(&one));
        let beside = discs([600, 300], &[[150.0, 148.0], [452.0, 150.0]], 140.0);
        let above = discs([300, 600], &[[150.0, 148.0], [150.0, 452.0]], 140.0);
        assert!(has_two_circles(&beside) && has_two_circles(&above));
        // One disc, a picture of two to one without any, and another shape.
        assert!(!has_two_circles(&discs([600, 300], &[[150.0, 150.0]], 140.0)));
        assert!(!has_two_circles(&discs([600, 300], &[[300.0, 150.0]], 900.0)));
        let wide = discs([640, 300], &[[150.0, 150.0], [490.0, 150.0]], 140.0);
        assert!(!has_two_circles(&wide));
    }
}
