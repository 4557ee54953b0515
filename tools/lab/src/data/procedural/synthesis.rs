//! Synthesises periodic fields with the statistics of natural pictures: scale-free noise, dead
//! leaves, stripes, text-like strokes, tiles, grain and level sets.
//!
//! The amplitude spectrum of pictures falls about as 1/f (Field 1987; Ruderman 1994). Opaque shapes
//! whose radii follow an inverse cube law have the same slope and real edges (dead leaves: Lee,
//! Mumford and Huang 2001). All fields are periodic in both directions.

use super::rng::Rng;
use super::texture::Kind;

/// Two square fields, row-major, with values intended for [0, 1].
#[derive(Clone)]
pub(super) struct Fields {
    /// Side, px; a power of two.
    pub(super) size: usize,
    pub(super) a: Vec<f32>,
    pub(super) b: Vec<f32>,
}

impl Fields {
    /// Returns constant fields.
    pub(super) fn filled(size: usize, a: f32, b: f32) -> Self {
        Self { size, a: vec![a; size * size], b: vec![b; size * size] }
    }

    /// Evaluates `f(x, y)` for every texel.
    fn from_fn(size: usize, f: impl Fn(usize, usize) -> [f32; 2]) -> Self {
        let mut fields = Self::filled(size, 0.0, 0.0);
        for y in 0..size {
            for x in 0..size {
                let [a, b] = f(x, y);
                fields.a[y * size + x] = a;
                fields.b[y * size + x] = b;
            }
        }
        fields
    }

    /// Blends a shape over the fields, periodically. `shape` receives the offset of a texel centre
    /// from (`cx`, `cy`), px, at most `reach`, and returns coverage and value.
    fn stamp(&mut self, [cx, cy]: [f32; 2], reach: f32, shape: impl Fn(f32, f32) -> Stamp) {
        let n = self.size as i64;
        let rows = (cy - reach).floor() as i64..=(cy + reach).ceil() as i64;
        for y in rows {
            let row = (y.rem_euclid(n) * n) as usize;
            for x in (cx - reach).floor() as i64..=(cx + reach).ceil() as i64 {
                let stamp = shape(x as f32 + 0.5 - cx, y as f32 + 0.5 - cy);
                if stamp.coverage > 0.0 {
                    let i = row + x.rem_euclid(n) as usize;
                    self.a[i] += stamp.coverage * (stamp.value[0] - self.a[i]);
                    self.b[i] += stamp.coverage * (stamp.value[1] - self.b[i]);
                }
            }
        }
    }
}

/// Effect of a stamped shape on one texel.
struct Stamp {
    coverage: f32,
    value: [f32; 2],
}

/// Synthesises one texture of `kind`.
pub(super) fn fields(kind: Kind, size: usize, rng: &mut Rng) -> Fields {
    match kind {
        Kind::Noise => noise(size, rng),
        Kind::Leaves => leaves(size, rng),
        Kind::Stripes => stripes(size, rng),
        Kind::Text => text(size, rng),
        Kind::Tiles => tiles(size, rng),
        Kind::Grain if rng.chance(0.5) => normalised(planks(size, rng)),
        Kind::Grain => normalised(weave(size, rng)),
        Kind::Blobs => blobs(size, rng),
    }
}

/// Scales the first field to mean ½ and deviation [`SIGMA`].
fn normalised(mut fields: Fields) -> Fields {
    standardised(&mut fields.a);
    fields.a.iter_mut().for_each(|v| *v = 0.5 + SIGMA * *v);
    fields
}

/// Scales a field to mean 0 and variance 1.
fn standardised(field: &mut [f32]) {
    let n = field.len().max(1) as f64;
    let mean = field.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let square = field.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n;
    let scale = 1.0 / square.sqrt().max(1e-9);
    field.iter_mut().for_each(|v| *v = ((f64::from(*v) - mean) * scale) as f32);
}

/// Doubles the size along the inner axis, periodically. Two passes with further octaves interpolate
/// by a quadratic B-spline.
fn doubled(row: &[f32], out: &mut Vec<f32>) {
    let n = row.len();
    for i in 0..n {
        let before = row[(i + n - 1) % n];
        let after = row[(i + 1) % n];
        out.push(0.75 * row[i] + 0.25 * before);
        out.push(0.75 * row[i] + 0.25 * after);
    }
}

/// Doubles the size along the outer axis, periodically.
fn doubled_rows(field: &[f32], width: usize) -> Vec<f32> {
    let height = field.len() / width;
    let mut out = Vec::with_capacity(2 * field.len());
    for y in 0..height {
        let row = &field[y * width..][..width];
        for side in [height - 1, 1] {
            let other = &field[(y + side) % height * width..][..width];
            out.extend(row.iter().zip(other).map(|(r, o)| 0.75 * r + 0.25 * o));
        }
    }
    out
}

/// Returns noise of mean 0 and variance 1 whose amplitude spectrum falls as 1/f^`exponent`.
///
/// Every octave adds white noise on its lattice. Its amplitude is 2^(1 − exponent) times that of
/// the next coarser octave, because an octave of twice the frequency has four times the area for
/// its power. The field is `stretch` octaves longer along x than along y.
pub(super) fn scale_free(size: usize, exponent: f32, stretch: usize, rng: &mut Rng) -> Vec<f32> {
    let mut width = 2;
    let mut height = (2 << stretch).min(size);
    let mut field: Vec<f32> = (0..width * height).map(|_| rng.normal()).collect();
    let mut amplitude = 1.0;
    while width < size || height < size {
        let adds_octave = height < size;
        if height < size {
            field = doubled_rows(&field, width);
            height *= 2;
        }
        if width < size {
            let mut out = Vec::with_capacity(2 * field.len());
            field.chunks(width).for_each(|row| doubled(row, &mut out));
            field = out;
            width *= 2;
        }
        if adds_octave {
            amplitude *= (1.0 - exponent).exp2();
            field.iter_mut().for_each(|v| *v += amplitude * rng.normal());
        }
    }
    standardised(&mut field);
    field
}

/// Standard deviation of noise around ½ in a field: the range [0, 1] covers ±2.8σ.
const SIGMA: f32 = 0.18;

/// Synthesises isotropic noise.
fn noise(size: usize, rng: &mut Rng) -> Fields {
    let exponent = rng.range(0.8, 1.7);
    let field = |rng: &mut Rng| -> Vec<f32> {
        scale_free(size, exponent, 0, rng).iter().map(|v| 0.5 + SIGMA * v).collect()
    };
    Fields { size, a: field(rng), b: field(rng) }
}

/// Samples a radius, px, with density ∝ r⁻³ from `low` to `high`.
fn leaf_radius(low: f32, high: f32, rng: &mut Rng) -> f32 {
    let (a, b) = (1.0 / (low * low), 1.0 / (high * high));
    1.0 / (a + (b - a) * rng.unit()).sqrt()
}

/// Synthesises dead leaves: opaque ellipses and rectangles.
fn leaves(size: usize, rng: &mut Rng) -> Fields {
    let mut fields = Fields::filled(size, rng.unit(), rng.unit());
    let grain = scale_free(size, 1.1, 0, rng);
    let grain_amplitude = rng.range(0.0, 0.08);
    let boxes = rng.unit();
    let low = rng.log_range(1.5, 5.0);
    let high = size as f32 * rng.range(0.08, 0.25);
    // Shapes of three times the total area leave 5 % of the background uncovered.
    let mut area = 3.0 * (size * size) as f32;
    while area > 0.0 {
        let r = leaf_radius(low, high, rng);
        let half = [r, r * rng.range(0.35, 1.0)];
        let (sin, cos) = rng.range(0.0, std::f32::consts::PI).sin_cos();
        let value = [rng.unit(), rng.unit()];
        let slope = 0.12 * rng.normal() / r;
        let rectangle = rng.chance(boxes);
        let centre = [rng.unit() * size as f32, rng.unit() * size as f32];
        fields.stamp(centre, r * if rectangle { 1.5 } else { 1.1 } + 1.0, |dx, dy| {
            let x = cos * dx + sin * dy;
            let y = cos * dy - sin * dx;
            let distance = if rectangle {
                (x.abs() - half[0]).max(y.abs() - half[1])
            } else {
                ((x / half[0]).hypot(y / half[1]) - 1.0) * half[1]
            };
            Stamp {
                coverage: (0.5 - distance).clamp(0.0, 1.0),
                value: [value[0] + slope * x, value[1]],
            }
        });
        area -= std::f32::consts::PI * half[0] * half[1];
    }
    for (a, g) in fields.a.iter_mut().zip(&grain) {
        *a += grain_amplitude * g;
    }
    fields
}

/// Synthesises parallel bands.
fn stripes(size: usize, rng: &mut Rng) -> Fields {
    // Widths at four times the resolution, then averaged: edges have a width of one texel.
    const FINE: usize = 4;
    let colours: Vec<[f32; 2]> = (0..rng.count(2, 5)).map(|_| [rng.unit(), rng.unit()]).collect();
    let mean_width = rng.log_range(0.012, 0.12) * (size * FINE) as f32;
    let uneven = rng.range(0.0, 0.8);
    let mut profile: Vec<[f32; 2]> = Vec::with_capacity(size * FINE);
    let mut stripe = 0;
    while profile.len() < size * FINE {
        let width = (mean_width * (1.0 + uneven * rng.range(-1.0, 1.0))).max(1.0) as usize;
        let colour = colours[stripe % colours.len()];
        profile.extend(std::iter::repeat_n(colour, width));
        stripe += 1;
    }
    let column: Vec<[f32; 2]> = profile[..size * FINE]
        .chunks(FINE)
        .map(|c| [0, 1].map(|k| c.iter().map(|v| v[k]).sum::<f32>() / FINE as f32))
        .collect();
    let wear = scale_free(size, 1.2, 0, rng);
    let amount = rng.range(0.0, 0.05);
    Fields::from_fn(size, |x, y| [column[x][0] + amount * wear[y * size + x], column[x][1]])
}

/// Synthesises lines of glyph-like strokes.
fn text(size: usize, rng: &mut Rng) -> Fields {
    let mut fields = Fields::filled(size, 0.0, 0.0);
    let side = size as f32;
    let mut y = 0.0;
    while y < side {
        let line = rng.log_range(0.035, 0.14) * side;
        let lines = rng.count(1, if line < 0.06 * side { 5 } else { 2 });
        let tint = rng.unit();
        for _ in 0..lines {
            let mut x = rng.range(0.0, 0.1) * side;
            let end = side * rng.range(0.6, 0.98);
            while x < end && y + line < side {
                if rng.chance(0.82) {
                    glyph(&mut fields, [x, y], line, tint, rng);
                }
                x += 0.62 * line;
            }
            y += 1.25 * line;
        }
        y += 0.6 * line;
    }
    let paper = scale_free(size, 1.2, 0, rng);
    for (a, p) in fields.a.iter_mut().zip(&paper) {
        // A background of 0.05 keeps its noise above the clip.
        *a = 0.05 + 0.9 * *a + 0.015 * p;
    }
    fields
}

/// Draws two to four strokes between the points of a 3×4 grid in a cell of the line's height.
fn glyph(fields: &mut Fields, [left, top]: [f32; 2], line: f32, tint: f32, rng: &mut Rng) {
    let thickness = line * rng.range(0.07, 0.12);
    let point = |rng: &mut Rng| {
        let (column, row) = (rng.count(0, 2) as f32, rng.count(0, 3) as f32);
        [left + line * (0.08 + 0.2 * column), top + line * (0.1 + 0.24 * row)]
    };
    let mut from = point(rng);
    for _ in 0..rng.count(2, 4) {
        let to = point(rng);
        let (ex, ey) = (0.5 * (to[0] - from[0]), 0.5 * (to[1] - from[1]));
        let square = (ex * ex + ey * ey).max(1e-6);
        let centre = [0.5 * (from[0] + to[0]), 0.5 * (from[1] + to[1])];
        fields.stamp(centre, square.sqrt() + thickness + 1.0, |dx, dy| {
            let t = ((dx * ex + dy * ey) / square).clamp(-1.0, 1.0);
            let distance = (dx - t * ex).hypot(dy - t * ey) - 0.5 * thickness;
            Stamp { coverage: (0.5 - distance).clamp(0.0, 1.0), value: [1.0, tint] }
        });
        from = to;
    }
}

/// Synthesises tiles or bricks with grout.
fn tiles(size: usize, rng: &mut Rng) -> Fields {
    let bond = rng.chance(0.5);
    let rows = [2, 4, 6, 8, 10][rng.count(0, 4)];
    let columns = if bond { (rows / 2).max(1) } else { rows };
    let (width, height) = (size as f32 / columns as f32, size as f32 / rows as f32);
    let grout = rng.log_range(0.02, 0.08) * height;
    let (grain, coarse) = (scale_free(size, 1.1, 0, rng), scale_free(size, 1.5, 0, rng));
    let amount = rng.range(0.01, 0.12);
    let spread = rng.range(0.02, 0.3);
    let joint = rng.unit();
    let values: Vec<[f32; 2]> = (0..rows * columns).map(|_| [rng.normal(), rng.normal()]).collect();
    Fields::from_fn(size, |x, y| {
        let row = y * rows / size;
        let shift = if bond && row % 2 == 1 { 0.5 * width } else { 0.0 };
        let along = (x as f32 + 0.5 + shift).rem_euclid(size as f32);
        let column = ((along / width) as usize).min(columns - 1);
        let across = y as f32 + 0.5 - row as f32 * height;
        let inner = along - column as f32 * width;
        let edge = inner.min(width - inner).min(across).min(height - across);
        let tile = (edge - 0.5 * grout + 0.5).clamp(0.0, 1.0);
        let i = y * size + x;
        let [a, b] = values[row * columns + column];
        let surface = 0.6 + 0.3 * spread * a + amount * grain[i] + 0.04 * coarse[i];
        [joint + tile * (surface - joint), tile * (0.5 + 0.3 * spread * b)]
    })
}

/// Synthesises wooden boards.
fn planks(size: usize, rng: &mut Rng) -> Fields {
    let rows = [1, 2, 4, 8][rng.count(0, 3)];
    let fine = scale_free(size, rng.range(0.8, 1.2), 5, rng);
    let rings = scale_free(size, 1.6, 3, rng);
    let (amount, frequency) = (rng.range(0.06, 0.14), rng.range(1.0, 4.0));
    let boards: Vec<[f32; 3]> =
        (0..rows).map(|_| [rng.normal(), rng.normal(), rng.unit()]).collect();
    let height = size / rows;
    Fields::from_fn(size, |x, y| {
        let [light, tint, shift] = boards[y / height];
        let shifted = (x + (shift * size as f32) as usize) % size;
        let i = y * size + shifted;
        let ring = (frequency * rings[i] * std::f32::consts::PI).sin();
        let gap = if rows > 1 && y % height == 0 { 0.35 } else { 0.0 };
        let a = 0.55 + amount * fine[i] + 0.08 * ring + 0.07 * light - gap;
        [a, 0.5 + 0.15 * tint + 0.08 * rings[i]]
    })
}

/// Synthesises woven cloth.
fn weave(size: usize, rng: &mut Rng) -> Fields {
    // A whole number of threads per period; at least eight texels each.
    let threads = rng.count(size / 64, size / 8) as f32;
    let (along, across) = (scale_free(size, 1.0, 4, rng), scale_free(size, 1.0, 4, rng));
    let soft = scale_free(size, 1.5, 0, rng);
    let (relief, amount) = (rng.range(0.05, 0.2), rng.range(0.05, 0.12));
    let k = std::f32::consts::TAU * threads / size as f32;
    Fields::from_fn(size, |x, y| {
        let over = (k * x as f32).sin() * (k * y as f32).sin();
        let weft = 0.5 + 0.5 * over;
        let thread = weft * along[y * size + x] + (1.0 - weft) * across[x * size + y];
        [0.5 + relief * over + amount * thread, 0.5 + SIGMA * soft[y * size + x]]
    })
}

/// Synthesises smoothed level sets of noise.
fn blobs(size: usize, rng: &mut Rng) -> Fields {
    let exponent = rng.range(1.0, 1.8);
    let (noise, other) = (scale_free(size, exponent, 0, rng), scale_free(size, exponent, 0, rng));
    let t0 = 0.5 * rng.normal();
    let t1 = 0.7 * rng.normal();
    let softness = rng.log_range(0.03, 0.3);
    let step = |v: f32| {
        let t = (v / softness + 0.5).clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    };
    Fields::from_fn(size, |x, y| {
        let i = y * size + x;
        [step(noise[i] - t0), step(other[i] - t1)]
    })
}

#[cfg(test)]
mod tests {
    use super::super::texture::BANK;
    use super::*;

    /// Returns the power |F(u, v)|² of a square field by the definition, rows then columns.
    fn power(field: &[f32], n: usize) -> Vec<f64> {
        let wave: Vec<(f64, f64)> =
            (0..n).map(|k| (std::f64::consts::TAU * k as f64 / n as f64).sin_cos()).collect();
        let pass = |input: &[(f64, f64)]| -> Vec<(f64, f64)> {
            // Transform along the inner axis, and transpose.
            let mut out = vec![(0.0, 0.0); n * n];
            for y in 0..n {
                for u in 0..n {
                    let mut sum = (0.0, 0.0);
                    for x in 0..n {
                        let ((sin, cos), (re, im)) = (wave[u * x % n], input[y * n + x]);
                        sum.0 += re * cos + im * sin;
                        sum.1 += im * cos - re * sin;
                    }
                    out[u * n + y] = sum;
                }
            }
            out
        };
        let mean = field.iter().map(|v| f64::from(*v)).sum::<f64>() / field.len() as f64;
        let start: Vec<(f64, f64)> = field.iter().map(|v| (f64::from(*v) - mean, 0.0)).collect();
        pass(&pass(&start)).iter().map(|(re, im)| re * re + im * im).collect()
    }

    /// Returns the slope of log power over log frequency, from 3 cycles to a quarter of the side.
    fn slope(field: &[f32], n: usize) -> f64 {
        let power = power(field, n);
        let mut rings = vec![(0.0, 0u32); n];
        for v in 0..n {
            for u in 0..n {
                let fold = |k: usize| k.min(n - k) as f64;
                let f = fold(u).hypot(fold(v));
                let ring = &mut rings[f.round() as usize];
                *ring = (ring.0 + power[v * n + u], ring.1 + 1);
            }
        }
        let points: Vec<(f64, f64)> = (3..=n / 4)
            .map(|f| ((f as f64).ln(), (rings[f].0 / f64::from(rings[f].1)).ln()))
            // Subsampling gives low and high octaves the same number of points.
            .enumerate()
            .filter(|(i, _)| (*i).is_power_of_two() || *i % 5 == 0)
            .map(|(_, p)| p)
            .collect();
        let count = points.len() as f64;
        let (mx, my) =
            points.iter().fold((0.0, 0.0), |m, p| (m.0 + p.0 / count, m.1 + p.1 / count));
        let (xy, xx) = points
            .iter()
            .fold((0.0, 0.0), |s, (x, y)| (s.0 + (x - mx) * (y - my), s.1 + (x - mx) * (x - mx)));
        xy / xx
    }

    const N: usize = 128;

    #[test]
    fn noise_has_the_requested_spectrum() {
        let mut rng = Rng::new(1);
        for exponent in [0.8, 1.2, 1.7] {
            let slopes = (0..4).map(|_| slope(&scale_free(N, exponent, 0, &mut rng), N));
            let mean = slopes.sum::<f64>() / 4.0;
            // Power is the square of amplitude.
            let want = -2.0 * f64::from(exponent);
            assert!((mean - want).abs() < 0.3, "exponent {exponent}: power slope {mean}");
        }
    }

    #[test]
    fn dead_leaves_have_the_spectrum_of_pictures() {
        let mut rng = Rng::new(2);
        let slopes = (0..6).map(|_| slope(&fields(Kind::Leaves, N, &mut rng).b, N));
        let mean = slopes.sum::<f64>() / 6.0;
        // Photographs: −2 ± 0.4 in power; leaves of a finite range of radii bend to −3.
        assert!((-3.1..-1.7).contains(&mean), "{mean}");
    }

    #[test]
    fn grain_is_longer_than_wide() {
        let mut rng = Rng::new(3);
        let field = scale_free(N, 1.0, 4, &mut rng);
        let step = |dx: usize, dy: usize| -> f64 {
            let moved = |i: usize| (i / N + dy) % N * N + (i % N + dx) % N;
            (0..N * N).map(|i| f64::from(field[i] - field[moved(i)]).powi(2)).sum()
        };
        assert!(step(0, 1) > 8.0 * step(1, 0), "{} {}", step(0, 1), step(1, 0));
    }

    #[test]
    fn all_textures_of_the_bank_vary_and_are_periodic() {
        for index in 0..BANK {
            let mut rng = Rng::new(0).fork(index as u64);
            let f = fields(Kind::of(index), 64, &mut rng);
            let all = f.a.iter().chain(&f.b);
            assert!(all.clone().all(|v| v.is_finite()), "texture {index}");
            let clipped = all.filter(|v| !(-0.001..=1.001).contains(*v)).count();
            assert!(clipped * 8 < f.a.len(), "texture {index}: {clipped} values clip");
            let mean = f.a.iter().sum::<f32>() / f.a.len() as f32;
            let deviation =
                (f.a.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / f.a.len() as f32).sqrt();
            assert!(deviation > 0.02, "texture {index} {:?}: {deviation}", Kind::of(index));
        }
        // The step across the period's border is like the steps within.
        let mut rng = Rng::new(9);
        for kind in [Kind::Noise, Kind::Leaves, Kind::Blobs, Kind::Text] {
            let (mut seam, mut within) = (0.0, 0.0);
            for _ in 0..8 {
                let f = fields(kind, 64, &mut rng);
                for y in 0..64 {
                    seam += (f.a[y * 64] - f.a[y * 64 + 63]).abs();
                    within += (f.a[y * 64 + 20] - f.a[y * 64 + 19]).abs()
                        + (f.a[y * 64 + 43] - f.a[y * 64 + 42]).abs();
                }
            }
            assert!(
                seam < 1.6 * within,
                "{kind:?}: {seam} over the seam, {within} within two columns"
            );
        }
    }
}
