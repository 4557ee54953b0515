//! Detects scale-invariant features: extrema of the difference of Gaussians.
//!
//! Input: a grey picture. Output: positions (px of the picture, pixel centres at +0.5) and
//! descriptors. `descriptors.rs` describes the features.
//!
//! Descriptors are upright or oriented along the gradients around the feature. Hand-held
//! photographs of one scene hardly roll against each other, and upright descriptors then give more
//! right matches. Oriented descriptors match a portrait photograph with a landscape photograph.
//!
//! Source: D. Lowe, "Distinctive image features from scale-invariant keypoints", 2004.

use super::GrayImage;
use super::descriptors::{describe, oriented};
use rayon::prelude::*;

/// Blur of the first level of an octave, px of the octave (Lowe, section 3.3).
const SIGMA_BASE: f32 = 1.6;
/// Blur of an unprocessed photograph, px (Lowe, section 3.3).
const SIGMA_CAMERA: f32 = 0.5;
/// Levels per doubling of the scale (Lowe, figure 3).
const LEVELS: usize = 3;
/// Smallest |difference of Gaussians| of a feature, for values in [0, 1]. Lowe takes 0.03; indoor
/// walls need a lower threshold. The limit on the number of features keeps the strongest.
const MIN_CONTRAST: f32 = 0.004;
/// Largest ratio of principal curvatures (Lowe, section 4.1). Positions along an edge are not well
/// defined.
const MAX_CURVATURE_RATIO: f32 = 10.0;
/// Pictures whose longer side is below this are doubled first, px. Small pictures hold most of
/// their detail in the finest octave.
const DOUBLE_BELOW: usize = 700;
/// Width of the border of an octave that holds no features, px.
const BORDER: usize = 4;
/// Distance of features from masked pixels, px of the picture and multiples of their size: the difference of Gaussians
/// reads about two standard deviations around, and masks are seldom right to the pixel.
const MASK_MARGIN: f32 = 2.0;
const MASK_SIZES: f32 = 2.0;
/// Grid cells along the longer side, over which features are spread.
const GRID: usize = 16;
/// Largest number of features of a cell, in multiples of an even share.
const CELL_SHARE: f32 = 2.5;

/// Orientation of the descriptors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Orientation {
    /// All descriptors existing_blur the orientation of the picture.
    Upright,
    /// Each descriptor is rotated along the dominant gradient around its feature.
    Gradient,
}

/// A distinct point of a picture.
#[derive(Clone, Debug)]
pub(crate) struct Feature {
    /// Position, px of the picture.
    pub x: f32,
    /// Position, px of the picture.
    pub y: f32,
    /// Blur at which the feature was found, px of the picture: its size.
    pub size: f32,
    /// |Difference of Gaussians|: larger is more distinct.
    pub response: f32,
    /// Position in the image pyramid.
    pub position: PyramidPoint,
}

/// Position of a feature in the image pyramid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PyramidPoint {
    /// Octave, 0 the finest.
    pub octave: usize,
    /// Level of the octave.
    pub level: usize,
    /// Column, octave px, pixel centres at whole numbers.
    pub x: f32,
    /// Row, octave px.
    pub y: f32,
    /// Blur at which the feature was found, px of the octave.
    pub sigma: f32,
    /// Rotation of the descriptor against the picture, radians.
    pub angle: f32,
}

/// Features of one picture.
#[derive(Clone, Debug, Default)]
pub(crate) struct Features {
    /// n features, the strongest first.
    pub points: Vec<Feature>,
    /// `[n, 128]`, each of unit length.
    pub descriptors: Vec<f32>,
}

impl Features {
    /// Returns the `count` strongest features.
    pub(crate) fn strongest(&self, count: usize) -> Self {
        let n = count.min(self.points.len());
        Self {
            points: self.points[..n].to_vec(),
            descriptors: self.descriptors[..n * super::descriptors::DESCRIPTOR].to_vec(),
        }
    }
}

/// One octave: LEVELS + 3 blurred pictures and their LEVELS + 2 differences.
pub(crate) struct Octave {
    /// Levels; the blur grows by 2^(1/LEVELS) per level.
    pub blurred: Vec<GrayImage>,
    differences: Vec<GrayImage>,
}

/// Detects at most `max_features` features, spread over the pixels that the picture's mask keeps. [`Orientation::Gradient`] may
/// add a second copy of a feature with several strong gradient directions.
pub(crate) fn detect(image: &GrayImage, max_features: usize, orientation: Orientation) -> Features {
    let doubled = image.width().max(image.height()) < DOUBLE_BELOW;
    let (base, blur, unit) = if doubled {
        (image.doubled(), 2.0 * SIGMA_CAMERA, 0.5)
    } else {
        (image.clone(), SIGMA_CAMERA, 1.0)
    };
    let octaves = pyramid(base, blur);
    let mut found: Vec<Feature> = octaves
        .iter()
        .enumerate()
        .flat_map(|(o, octave)| extrema(octave, o, unit * (1u32 << o) as f32))
        .collect();
    if let Some(mask) = image.mask() {
        found.retain(|f| mask.keeps_around([f.x, f.y], MASK_MARGIN + MASK_SIZES * f.size));
    }
    // A total order makes the result independent of the threads.
    found.sort_by(|a, b| {
        b.response.total_cmp(&a.response).then(a.y.total_cmp(&b.y)).then(a.x.total_cmp(&b.x))
    });
    let mut points = spread(found, image, max_features);
    if orientation == Orientation::Gradient {
        points = points.iter().flat_map(|f| oriented(f, &octaves)).collect();
    }
    let descriptors =
        points.par_iter().flat_map_iter(|f| describe(&f.position, &octaves)).collect();
    Features { points, descriptors }
}

/// Builds the octaves, the first at the size of `base`, which has a blur of `existing_blur`.
fn pyramid(base: GrayImage, existing_blur: f32) -> Vec<Octave> {
    let mut base = base.blurred((SIGMA_BASE * SIGMA_BASE - existing_blur * existing_blur).sqrt());
    let step = 2f32.powf(1.0 / LEVELS as f32);
    let mut octaves = Vec::new();
    while base.width().min(base.height()) >= 4 * BORDER {
        let mut blurred = vec![base];
        for level in 1..LEVELS + 3 {
            let sigma = SIGMA_BASE * step.powi(level as i32 - 1);
            let next = blurred[level - 1].blurred(sigma * (step * step - 1.0).sqrt());
            blurred.push(next);
        }
        let differences = blurred.windows(2).filter_map(|p| difference(&p[1], &p[0])).collect();
        base = blurred[LEVELS].decimated();
        octaves.push(Octave { blurred, differences });
    }
    octaves
}

/// Subtracts `b` from `a`.
fn difference(a: &GrayImage, b: &GrayImage) -> Option<GrayImage> {
    let pixels = a.pixels().iter().zip(b.pixels()).map(|(a, b)| a - b).collect();
    GrayImage::new(a.width(), a.height(), pixels)
}

/// Finds the extrema of an octave among their 26 neighbours and refines their positions below the
/// pixel. `unit` is the size of an octave's pixel in px of the picture.
fn extrema(octave: &Octave, index: usize, unit: f32) -> Vec<Feature> {
    let d = &octave.differences;
    let (w, h) = (d[0].width(), d[0].height());
    if w <= 2 * BORDER || h <= 2 * BORDER {
        return Vec::new();
    }
    (BORDER..h - BORDER)
        .into_par_iter()
        .flat_map_iter(|y| {
            let mut row = Vec::new();
            for level in 1..=LEVELS {
                for x in BORDER..w - BORDER {
                    if is_extremum(d, level, x, y) {
                        row.extend(refine(d, [level, x, y], index, unit));
                    }
                }
            }
            row
        })
        .collect()
}

/// Tests a pixel of a level against its 26 neighbours.
fn is_extremum(d: &[GrayImage], level: usize, x: usize, y: usize) -> bool {
    let v = d[level].at(x, y);
    if v.abs() < 0.5 * MIN_CONTRAST {
        return false;
    }
    let sign = v.signum();
    d[level - 1..=level + 1].iter().enumerate().all(|(l, plane)| {
        (y - 1..=y + 1).all(|r| {
            let row = &plane.row(r)[x - 1..=x + 1];
            row.iter().enumerate().all(|(c, &n)| {
                // Strict against earlier neighbours, so that a plateau counts once.
                let before = (l, r, c) < (1, y, 1);
                let (n, v) = (sign * n, sign * v);
                n < v || (!before && n == v)
            })
        })
    })
}

/// Fits a quadratic to the 27 differences around an extremum (Lowe, section 4). Returns `None` for
/// low contrast, edges, and fits that leave the octave.
fn refine(d: &[GrayImage], start: [usize; 3], octave: usize, unit: f32) -> Option<Feature> {
    /// Steps to a neighbouring pixel before the fit is abandoned (Lowe: "a few").
    const STEPS: usize = 4;
    let [mut level, mut x, mut y] = start;
    let (w, h) = (d[0].width(), d[0].height());
    for _ in 0..STEPS {
        let fit = Quadratic::at(d, level, x, y);
        let o = fit.offset()?;
        if o.iter().all(|v| v.abs() <= 0.6) {
            let value = fit.value + 0.5 * (0..3).map(|i| fit.gradient[i] * o[i]).sum::<f32>();
            if value.abs() < MIN_CONTRAST || fit.is_edge() {
                return None;
            }
            let sigma = SIGMA_BASE * 2f32.powf((level as f32 + o[2]) / LEVELS as f32);
            let (px, py) = (x as f32 + o[0], y as f32 + o[1]);
            // The centre of octave pixel i is the centre of pixel i·unit of the picture; the half
            // pixel belongs to the picture.
            return Some(Feature {
                x: px * unit + 0.5,
                y: py * unit + 0.5,
                size: sigma * unit,
                response: value.abs(),
                position: PyramidPoint { octave, level, x: px, y: py, sigma, angle: 0.0 },
            });
        }
        let step = |at: usize, v: f32| (at as f32 + v.clamp(-1.0, 1.0).round()) as usize;
        (x, y, level) = (step(x, o[0]), step(y, o[1]), step(level, o[2]));
        let inside = (1..=LEVELS).contains(&level)
            && (BORDER..w - BORDER).contains(&x)
            && (BORDER..h - BORDER).contains(&y);
        if !inside {
            return None;
        }
    }
    None
}

/// Value, gradient and Hessian of the difference of Gaussians in (x, y, level).
struct Quadratic {
    value: f32,
    gradient: [f32; 3],
    hessian: [[f32; 3]; 3],
}

impl Quadratic {
    /// Computes the derivatives by central differences.
    fn at(d: &[GrayImage], level: usize, x: usize, y: usize) -> Self {
        let v = |dx: i32, dy: i32, dl: i32| {
            d[(level as i32 + dl) as usize].at((x as i32 + dx) as usize, (y as i32 + dy) as usize)
        };
        let value = v(0, 0, 0);
        let axis = |i: usize, s: i32| {
            let mut e = [0; 3];
            e[i] = s;
            v(e[0], e[1], e[2])
        };
        let pair = |i: usize, j: usize, s: i32, t: i32| {
            let mut e = [0; 3];
            (e[i], e[j]) = (s, t);
            v(e[0], e[1], e[2])
        };
        let second = |i: usize, j: usize| {
            if i == j {
                return axis(i, 1) + axis(i, -1) - 2.0 * value;
            }
            0.25 * (pair(i, j, 1, 1) - pair(i, j, 1, -1) - pair(i, j, -1, 1) + pair(i, j, -1, -1))
        };
        let hessian = std::array::from_fn(|i| std::array::from_fn(|j| second(i, j)));
        let gradient = std::array::from_fn(|i| 0.5 * (axis(i, 1) - axis(i, -1)));
        Self { value, gradient, hessian }
    }

    /// Returns −H⁻¹g, or `None` where H is singular.
    fn offset(&self) -> Option<[f32; 3]> {
        let h = glam::Mat3::from_cols_array_2d(&self.hessian);
        let determinant = h.determinant();
        if determinant.abs() < 1e-18 {
            return None;
        }
        Some((-(h.inverse() * glam::Vec3::from(self.gradient))).to_array())
    }

    /// Tests the ratio of the principal curvatures against [`MAX_CURVATURE_RATIO`].
    fn is_edge(&self) -> bool {
        let h = &self.hessian;
        let trace = h[0][0] + h[1][1];
        let determinant = h[0][0] * h[1][1] - h[0][1] * h[0][1];
        determinant <= 0.0
            || trace * trace * MAX_CURVATURE_RATIO
                >= (MAX_CURVATURE_RATIO + 1.0) * (MAX_CURVATURE_RATIO + 1.0) * determinant
    }
}

/// Returns the strongest `max_features` of `sorted`, with a limit per grid cell. The limit prevents
/// one textured area from using up all features.
fn spread(sorted: Vec<Feature>, image: &GrayImage, max_features: usize) -> Vec<Feature> {
    let cell = image.width().max(image.height()) as f32 / GRID as f32;
    let columns = (image.width() as f32 / cell).ceil() as usize;
    let rows = (image.height() as f32 / cell).ceil() as usize;
    let quota = (CELL_SHARE * max_features as f32 / (columns * rows) as f32).ceil() as usize;
    let mut taken = vec![0usize; columns * rows];
    let mut kept = Vec::with_capacity(max_features);
    for f in sorted {
        let c = ((f.x / cell) as usize).min(columns - 1);
        let r = ((f.y / cell) as usize).min(rows - 1);
        let count = &mut taken[r * columns + c];
        if *count < quota && kept.len() < max_features {
            *count += 1;
            kept.push(f);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::mask::Mask;
    use crate::scene::pictures::Rgb;

    /// Blocks of random brightness, and a mask over the middle with a bright frame.
    fn masked(side: usize) -> (Rgb, Mask) {
        let mut picture = Rgb::black(side, side);
        let mut kept = vec![true; side * side];
        for (i, pixel) in picture.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % side, i / side);
            let block = (y / 6 * side + x / 6) as u64;
            pixel.fill((subsplat_kernels::layout::random::mix(block) >> 57) as u8);
            let inside = |v: usize| (side / 4..3 * side / 4).contains(&v);
            if inside(x) && inside(y) {
                kept[i] = false;
                pixel.fill(if (x / 5 + y / 5) % 2 == 0 { 255 } else { 130 });
            }
        }
        (picture, Mask::new(side, side, kept).unwrap())
    }

    #[test]
    fn masked_pixels_have_no_features() {
        let (picture, mask) = masked(240);
        let find = |mask: Option<&Mask>, orientation| {
            detect(&GrayImage::from_picture(&picture, mask).unwrap(), 800, orientation)
        };
        for orientation in [Orientation::Upright, Orientation::Gradient] {
            let inside = |f: &Feature| !mask.keeps_around([f.x, f.y], 2.0);
            let all = find(None, orientation);
            assert!(all.points.iter().filter(|f| inside(f)).count() > 50);
            let kept = find(Some(&mask), orientation);
            assert!(kept.points.len() > 200, "{}", kept.points.len());
            assert!(!kept.points.iter().any(inside));
            assert_eq!(kept.descriptors.len(), 128 * kept.points.len());
        }
        // The mask follows the picture to another size and side.
        let grey = GrayImage::from_picture(&picture, Some(&mask)).unwrap();
        let small = grey.reduced(120, 120).flipped();
        let small_mask = small.mask().unwrap().clone();
        assert_eq!(small_mask.count(), 120 * 120 * 3 / 4);
        let found = detect(&small, 800, Orientation::Upright);
        assert!(found.points.iter().all(|f| small_mask.keeps_around([f.x, f.y], 2.0)));
        // A mask of another size is refused.
        assert!(GrayImage::from_picture(&Rgb::black(8, 8), Some(&mask)).is_none());
    }
}
