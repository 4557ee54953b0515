//! Draws the epipolar picture of two photographs.
//!
//! Both photographs lie side by side, dimmed. A dozen matched points are drawn, each in its own
//! colour, with their epipolar lines in the other photograph. Lines that pass beside their points
//! show that the cameras are wrong. The picture holds no text.
//!
//! Input: 8-bit RGB photographs, cameras, matched points in px. Output: 8-bit RGB, 480 px high.

use super::epipolar::TwoViews;
use super::report::MatchedPoint;
use glam::{DVec2, DVec3};
use subsplat_kernels::camera::Camera;

/// Height of the picture, px.
const HEIGHT: usize = 480;
/// Largest width of either half, px; panoramas are reduced in height to fit.
const MAX_HALF_WIDTH: usize = 960;
/// Width of the black gap between the halves, px.
const GAP: usize = 8;
/// Number of points drawn.
const POINTS: usize = 12;
/// Radius of a point, px, inside a ring of [`RING`] px.
const RADIUS: f64 = 4.5;
/// Width of the dark ring that separates a point from its line, px.
const RING: f64 = 1.8;
/// Half the width of a line, px.
const HALF_LINE: f64 = 0.9;
/// Share of its saturation that a dimmed photograph keeps.
const DIM_SATURATION: f64 = 0.45;
/// Share of its brightness that a dimmed photograph keeps.
const DIM_BRIGHTNESS: f64 = 0.7;
/// Twelve colours of different hues, alternating in brightness.
const COLOURS: [[u8; 3]; POINTS] = [
    [255, 64, 64],
    [64, 224, 255],
    [255, 224, 32],
    [112, 128, 255],
    [96, 255, 96],
    [255, 96, 255],
    [255, 144, 32],
    [32, 192, 160],
    [255, 176, 208],
    [176, 224, 80],
    [176, 112, 255],
    [255, 255, 255],
];

/// An 8-bit RGB photograph, rows of interleaved values.
#[derive(Clone, Copy, Debug)]
pub struct RgbPicture<'a> {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `[height, width, 3]`.
    pub pixels: &'a [u8],
}

/// One half of the picture, floats 0 to 255, with its scale.
struct Half {
    width: usize,
    height: usize,
    pixels: Vec<[f64; 3]>,
    /// Px of this half per px of the photograph.
    scale: DVec2,
}

/// Draws two photographs with the points of a [`super::PairReport`] and their epipolar lines.
///
/// Returns (width, height, RGB). Without points, the second half shows the lines of a grid of
/// positions in the first. Returns `None` where a photograph's pixels do not fit its size.
pub fn epipolar_picture(
    photographs: [RgbPicture<'_>; 2],
    cameras: [&Camera; 2],
    points: &[MatchedPoint],
) -> Option<(usize, usize, Vec<u8>)> {
    let [mut a, mut b] = [Half::new(&photographs[0])?, Half::new(&photographs[1])?];
    let fitted =
        |i: usize| cameras[i].resized_unchecked(photographs[i].width, photographs[i].height);
    let views = TwoViews::new(&fitted(0), &fitted(1));
    let f = views.fundamental();
    let chosen = spread(points);
    if chosen.is_empty() {
        for (position, colour) in grid(&photographs[0]).into_iter().zip(COLOURS) {
            b.line(f * position.extend(1.0), colour);
            a.point(position, colour);
        }
        return Some(join(&a, &b));
    }
    for (p, colour) in chosen.iter().zip(COLOURS) {
        b.line(f * to_f64(p.a).extend(1.0), colour);
        a.line(f.transpose() * to_f64(p.b).extend(1.0), colour);
    }
    for (p, colour) in chosen.iter().zip(COLOURS) {
        a.point(to_f64(p.a), colour);
        b.point(to_f64(p.b), colour);
    }
    Some(join(&a, &b))
}

/// Converts a point to f64.
fn to_f64(p: [f32; 2]) -> DVec2 {
    DVec2::new(f64::from(p[0]), f64::from(p[1]))
}

/// Selects up to [`POINTS`] points, each as far as possible from the earlier ones. Consistent
/// points exclude all others where any exist.
fn spread(points: &[MatchedPoint]) -> Vec<MatchedPoint> {
    let any = points.iter().any(|p| p.consistent);
    let mut left: Vec<MatchedPoint> =
        points.iter().filter(|p| p.consistent || !any).copied().collect();
    let mut taken: Vec<MatchedPoint> = Vec::new();
    while taken.len() < POINTS && !left.is_empty() {
        let clearance = |p: &MatchedPoint| {
            let from = |t: &MatchedPoint| to_f64(t.a).distance_squared(to_f64(p.a));
            taken.iter().map(from).fold(f64::INFINITY, f64::min)
        };
        let mut best = 0;
        for i in 1..left.len() {
            if clearance(&left[i]) > clearance(&left[best]) {
                best = i;
            }
        }
        taken.push(left.remove(best));
    }
    taken
}

/// Returns four by three positions, evenly over the photograph.
fn grid(photograph: &RgbPicture<'_>) -> Vec<DVec2> {
    let size = DVec2::new(photograph.width as f64, photograph.height as f64);
    (0..POINTS)
        .map(|i| size * DVec2::new(((i % 4) as f64 + 0.5) / 4.0, ((i / 4) as f64 + 0.5) / 3.0))
        .collect()
}

/// Places the two halves side by side.
fn join(a: &Half, b: &Half) -> (usize, usize, Vec<u8>) {
    let width = a.width + GAP + b.width;
    let height = a.height.max(b.height);
    let mut out = vec![0u8; 3 * width * height];
    for (half, left) in [(a, 0), (b, a.width + GAP)] {
        for (y, row) in half.pixels.chunks_exact(half.width).enumerate() {
            let start = 3 * (y * width + left);
            let target = &mut out[start..start + 3 * half.width];
            for (o, p) in target.chunks_exact_mut(3).zip(row) {
                o.copy_from_slice(&p.map(|v| v.round().clamp(0.0, 255.0) as u8));
            }
        }
    }
    (width, height, out)
}

impl Half {
    /// Resamples the photograph to the picture's height and dims it.
    fn new(photograph: &RgbPicture<'_>) -> Option<Self> {
        let (w, h) = (photograph.width, photograph.height);
        let fits = w.checked_mul(h)?.checked_mul(3)? == photograph.pixels.len();
        if !fits || w == 0 || h == 0 {
            return None;
        }
        let factor = (HEIGHT as f64 / h as f64).min(MAX_HALF_WIDTH as f64 / w as f64);
        let side = |v: usize| ((v as f64 * factor).round() as usize).max(1);
        let (width, height) = (side(w), side(h));
        let scale = DVec2::new(width as f64 / w as f64, height as f64 / h as f64);
        let pixels = (0..width * height)
            .map(|i| {
                let at = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
                dimmed(sample(photograph, at / scale, scale.recip()))
            })
            .collect();
        Some(Self { width, height, pixels, scale })
    }

    /// Blends `colour` into pixel (x, y).
    fn blend(&mut self, x: usize, y: usize, colour: [f64; 3], coverage: f64) {
        let pixel = &mut self.pixels[y * self.width + x];
        for (p, c) in pixel.iter_mut().zip(colour) {
            *p += coverage.clamp(0.0, 1.0) * (c - *p);
        }
    }

    /// Draws a line l·(x, y, 1) = 0 of the photograph; a line without a direction is skipped.
    fn line(&mut self, line: DVec3, colour: [u8; 3]) {
        let line = DVec3::new(line.x / self.scale.x, line.y / self.scale.y, line.z);
        let length = line.truncate().length();
        if !(length.is_finite() && length > 0.0) {
            return;
        }
        let line = line / length;
        let colour = colour.map(f64::from);
        for y in 0..self.height {
            for x in 0..self.width {
                let d = line.dot(DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0)).abs();
                if d < HALF_LINE + 0.5 {
                    self.blend(x, y, colour, HALF_LINE + 0.5 - d);
                }
            }
        }
    }

    /// Draws a disc with a dark ring at a position of the photograph.
    fn point(&mut self, position: DVec2, colour: [u8; 3]) {
        let centre = position * self.scale;
        let reach = RADIUS + RING + 1.0;
        let range = |c: f64, size: usize| {
            let first = (c - reach).floor().clamp(0.0, size as f64) as usize;
            first..((c + reach).ceil().clamp(0.0, size as f64) as usize)
        };
        for y in range(centre.y, self.height) {
            for x in range(centre.x, self.width) {
                let d = centre.distance(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                self.blend(x, y, [0.0; 3], RADIUS + RING + 0.5 - d);
                self.blend(x, y, colour.map(f64::from), RADIUS + 0.5 - d);
            }
        }
    }
}

/// Returns the mean of bilinear samples over a box of `extent` px around `centre`.
fn sample(photograph: &RgbPicture<'_>, centre: DVec2, extent: DVec2) -> [f64; 3] {
    let taps = |e: f64| (e.ceil() as usize).max(1);
    let (nx, ny) = (taps(extent.x), taps(extent.y));
    let mut sum = [0.0; 3];
    for i in 0..nx * ny {
        let within = DVec2::new(
            ((i % nx) as f64 + 0.5) / nx as f64 - 0.5,
            ((i / nx) as f64 + 0.5) / ny as f64 - 0.5,
        );
        let value = bilinear(photograph, centre + within * extent);
        sum.iter_mut().zip(value).for_each(|(s, v)| *s += v / (nx * ny) as f64);
    }
    sum
}

/// Samples the photograph at a position in px; border pixels are repeated.
fn bilinear(photograph: &RgbPicture<'_>, at: DVec2) -> [f64; 3] {
    let (w, h) = (photograph.width, photograph.height);
    let split = |v: f64, size: usize| {
        let v = (v - 0.5).clamp(0.0, (size - 1) as f64);
        (v as usize, (v as usize + 1).min(size - 1), v - v.floor())
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (split(at.x, w), split(at.y, h));
    let value = |x: usize, y: usize, c: usize| f64::from(photograph.pixels[3 * (y * w + x) + c]);
    std::array::from_fn(|c| {
        let top = value(x0, y0, c) * (1.0 - fx) + value(x1, y0, c) * fx;
        let bottom = value(x0, y1, c) * (1.0 - fx) + value(x1, y1, c) * fx;
        top * (1.0 - fy) + bottom * fy
    })
}

/// Reduces saturation and brightness, so that the lines stand out.
fn dimmed(rgb: [f64; 3]) -> [f64; 3] {
    let grey = rgb.iter().sum::<f64>() / 3.0;
    rgb.map(|v| DIM_BRIGHTNESS * (DIM_SATURATION * v + (1.0 - DIM_SATURATION) * grey))
}
