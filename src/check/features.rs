//! Scale-invariant features: extrema of the difference of Gaussians (D. Lowe, "Distinctive image features from
//! scale-invariant keypoints", 2004; `descriptors.rs`).
//!
//! Features are upright or turned with their surroundings. Hand-held photographs
//! of one scene hardly roll against each other, and upright descriptors find more
//! right matches; turned ones find a portrait in a landscape format.
//! Positions are px of the given picture, pixel centres at +0.5.

use super::descriptors::{describe, oriented};
use super::image::GrayImage;
use rayon::prelude::*;

/// Blur of the first level of an octave, px of the octave (Lowe, section 3.3).
const SIGMA_BASE: f32 = 1.6;
/// Blur that a photograph has already, px (Lowe, section 3.3).
const SIGMA_CAMERA: f32 = 0.5;
/// Levels per doubling of the scale (Lowe, figure 3).
const LEVELS: usize = 3;
/// Smallest |difference of Gaussians| of a feature, for values in [0, 1]. Lowe
/// takes 0.03; indoor walls need fainter ones, and the cap on the number keeps
/// the strongest anyway.
const CONTRAST: f32 = 0.004;
/// Largest ratio of principal curvatures (Lowe, section 4.1): edges slide.
const EDGE: f32 = 10.0;
/// Pictures whose longer side is below this are doubled first: small pictures
/// hold most of their detail in the finest octave, px.
const DOUBLE_BELOW: usize = 700;
/// Pixels at the border of an octave without features.
const BORDER: usize = 4;
/// Cells along the longer side over which features are spread.
const GRID: usize = 16;
/// A cell keeps at most this multiple of its even share.
const CELL_SHARE: f32 = 2.5;

/// A place in a picture that can be found again.
#[derive(Clone, Debug)]
pub(super) struct Feature {
    /// Position, px of the picture.
    pub x: f32,
    /// Position, px of the picture.
    pub y: f32,
    /// |Difference of Gaussians|: larger is more distinct.
    pub response: f32,
    /// Octave, level and place in it.
    pub site: Site,
}

/// Where in the pyramid a feature was found.
#[derive(Clone, Copy, Debug)]
pub(super) struct Site {
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
    /// Turn of the descriptor against the picture, radians.
    pub angle: f32,
}

/// Features of one picture and `[n, 128]` descriptors of unit length.
#[derive(Clone, Debug, Default)]
pub(super) struct Features {
    pub points: Vec<Feature>,
    pub descriptors: Vec<f32>,
}

/// One octave: LEVELS + 3 blurred pictures and their LEVELS + 2 differences.
pub(super) struct Octave {
    /// Ever more blurred, by 2^(1/LEVELS) a step.
    pub blurred: Vec<GrayImage>,
    differences: Vec<GrayImage>,
}

/// At most `most` features of `image`, spread over it; `upright` gives every
/// descriptor the picture's own orientation.
pub(super) fn detect(image: &GrayImage, most: usize, upright: bool) -> Features {
    let doubled = image.width().max(image.height()) < DOUBLE_BELOW;
    let octaves = pyramid(image, doubled);
    let unit = if doubled { 0.5 } else { 1.0 };
    let mut found: Vec<Feature> = octaves
        .iter()
        .enumerate()
        .flat_map(|(o, octave)| extrema(octave, o, unit * (1u32 << o) as f32))
        .collect();
    // A total order, so that the result does not depend on threads.
    found.sort_by(|a, b| {
        b.response.total_cmp(&a.response).then(a.y.total_cmp(&b.y)).then(a.x.total_cmp(&b.x))
    });
    let mut points = spread(found, image, most);
    if !upright {
        points = points.iter().flat_map(|f| oriented(f, &octaves)).collect();
    }
    let descriptors = points.par_iter().flat_map_iter(|f| describe(&f.site, &octaves)).collect();
    Features { points, descriptors }
}

fn pyramid(image: &GrayImage, doubled: bool) -> Vec<Octave> {
    let (mut base, have) =
        if doubled { (image.doubled(), 2.0 * SIGMA_CAMERA) } else { (image.clone(), SIGMA_CAMERA) };
    base = base.blurred((SIGMA_BASE * SIGMA_BASE - have * have).sqrt());
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

fn difference(a: &GrayImage, b: &GrayImage) -> Option<GrayImage> {
    let pixels = a.pixels().iter().zip(b.pixels()).map(|(a, b)| a - b).collect();
    GrayImage::new(a.width(), a.height(), pixels)
}

/// Extrema of an octave among their 26 neighbours, refined below the pixel.
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

fn is_extremum(d: &[GrayImage], level: usize, x: usize, y: usize) -> bool {
    let v = d[level].at(x, y);
    if v.abs() < 0.5 * CONTRAST {
        return false;
    }
    let sign = v.signum();
    d[level - 1..=level + 1].iter().enumerate().all(|(l, plane)| {
        (y - 1..=y + 1).all(|r| {
            let row = &plane.row(r)[x - 1..=x + 1];
            row.iter().enumerate().all(|(c, &n)| {
                // Strict against neighbours before it, so that a flat top counts once.
                let before = (l, r, c) < (1, y, 1);
                let (n, v) = (sign * n, sign * v);
                n < v || (!before && n == v)
            })
        })
    })
}

/// Quadratic fit to the 27 differences around an extremum (Lowe, section 4).
fn refine(d: &[GrayImage], start: [usize; 3], octave: usize, unit: f32) -> Option<Feature> {
    /// Steps to a neighbouring pixel before the fit gives up (Lowe: "a few").
    const STEPS: usize = 4;
    let [mut level, mut x, mut y] = start;
    let (w, h) = (d[0].width(), d[0].height());
    for _ in 0..STEPS {
        let fit = Quadratic::at(d, level, x, y);
        let o = fit.offset()?;
        if o.iter().all(|v| v.abs() <= 0.6) {
            let value = fit.value + 0.5 * (0..3).map(|i| fit.gradient[i] * o[i]).sum::<f32>();
            if value.abs() < CONTRAST || fit.is_edge() {
                return None;
            }
            let sigma = SIGMA_BASE * 2f32.powf((level as f32 + o[2]) / LEVELS as f32);
            let (px, py) = (x as f32 + o[0], y as f32 + o[1]);
            // Octave pixel i has its centre where pixel i·unit of the picture has
            // it; the half pixel is the picture's.
            return Some(Feature {
                x: px * unit + 0.5,
                y: py * unit + 0.5,
                response: value.abs(),
                site: Site { octave, level, x: px, y: py, sigma, angle: 0.0 },
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

    /// −H⁻¹g, or `None` where H is singular.
    fn offset(&self) -> Option<[f32; 3]> {
        let h = glam::Mat3::from_cols_array_2d(&self.hessian);
        let determinant = h.determinant();
        if determinant.abs() < 1e-18 {
            return None;
        }
        Some((-(h.inverse() * glam::Vec3::from(self.gradient))).to_array())
    }

    fn is_edge(&self) -> bool {
        let h = &self.hessian;
        let trace = h[0][0] + h[1][1];
        let determinant = h[0][0] * h[1][1] - h[0][1] * h[0][1];
        determinant <= 0.0 || trace * trace * EDGE >= (EDGE + 1.0) * (EDGE + 1.0) * determinant
    }
}

/// The strongest `most` of `sorted`, at most a few times the even share from each
/// cell of a grid: one textured carpet must not use up all features.
fn spread(sorted: Vec<Feature>, image: &GrayImage, most: usize) -> Vec<Feature> {
    let cell = image.width().max(image.height()) as f32 / GRID as f32;
    let columns = (image.width() as f32 / cell).ceil() as usize;
    let rows = (image.height() as f32 / cell).ceil() as usize;
    let quota = (CELL_SHARE * most as f32 / (columns * rows) as f32).ceil() as usize;
    let mut taken = vec![0usize; columns * rows];
    let mut kept = Vec::with_capacity(most);
    for f in sorted {
        let c = ((f.x / cell) as usize).min(columns - 1);
        let r = ((f.y / cell) as usize).min(rows - 1);
        let count = &mut taken[r * columns + c];
        if *count < quota && kept.len() < most {
            *count += 1;
            kept.push(f);
        }
    }
    kept
}
