//! Exposure and white balance of two photographs of one scene, compared at matched points.
//!
//! The model is a = gain · b + offset for each channel, in 8-bit sRGB levels. A change of
//! exposure multiplies linear light. The upper part of sRGB's curve is
//! v = 1.055 · l^(1/2.4) − 0.055, so a factor e on l gives gain e^(1/2.4) and offset
//! 0.055 · (gain − 1) · 255: the model is exact above sRGB's linear toe.
//!
//! Estimation, for each channel:
//!
//! 1. One sample per match: the mean of a patch in each picture. Patches with a saturated
//!    value are left out.
//! 2. A line through the samples by repeated medians (Siegel 1982), which tolerate up to half of
//!    the samples as outliers.
//! 3. A refined line by reweighted orthogonal regression with Tukey's biweight, because both
//!    pictures have noise.
//!
//! Samples of a narrow brightness range do not separate gain and offset; the gain alone is
//! estimated from them. A correction that does not exceed the noise is replaced by the identity.

use crate::scene::pictures::Rgb;
use thiserror::Error;

/// A matched pair of points, px of each picture (pixel centres at +0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointPair {
    /// Position in the first picture, px.
    pub a: [f32; 2],
    /// Position in the second picture, px.
    pub b: [f32; 2],
}

/// A correction of the second picture to the first one's exposure and white balance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Factor on each channel of the second picture.
    pub gain: [f32; 3],
    /// Offset of each channel, 8-bit levels.
    pub offset: [f32; 3],
    /// Median absolute difference of the pictures at the samples before the correction, 8-bit
    /// levels.
    pub before: [f32; 3],
    /// The same after the correction.
    pub residual: [f32; 3],
    /// Number of samples of each channel.
    pub samples: [usize; 3],
}

/// Reason for which no exposure is estimated.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum ExposureError {
    /// Too few matches lie inside both pictures on patches that are not saturated.
    #[error(
        "exposure: expected at least {} usable matches in channel {channel}, got {found}",
        MIN_SAMPLES
    )]
    TooFew {
        /// Channel: 0 red, 1 green, 2 blue.
        channel: usize,
        /// Number of usable matches.
        found: usize,
    },
    /// The gain is outside the plausible range.
    #[error(
        "exposure: expected a gain of {} to {} in channel {channel}, got {gain}",
        GAIN_RANGE[0], GAIN_RANGE[1]
    )]
    Implausible {
        /// Channel: 0 red, 1 green, 2 blue.
        channel: usize,
        /// Estimated gain.
        gain: f32,
    },
}

/// Smallest number of samples.
pub const MIN_SAMPLES: usize = 12;

/// Plausible gains. sRGB's exponent makes them 3.7 stops of exposure in each direction.
pub const GAIN_RANGE: [f32; 2] = [0.35, 2.9];

/// Half the side of a patch, px: patches of 5 × 5.
const PATCH_RADIUS: i64 = 2;

/// Values outside this range count as saturated, 8-bit levels.
const UNSATURATED: [u8; 2] = [4, 250];

/// Largest number of samples in a channel. The repeated medians need its square.
const MAX_SAMPLES: usize = 512;

/// Smallest brightness range, 10 % to 90 % quantile, for which an offset is estimated, levels.
const RANGE_FOR_OFFSET: f64 = 24.0;

/// Largest correction that counts as the identity, 8-bit levels, apart from noise.
const IDENTITY_LEVELS: f64 = 1.0;

/// Standard errors below which a correction counts as noise.
const IDENTITY_ERRORS: f64 = 3.0;

/// A patch's mean in both pictures, levels.
#[derive(Clone, Copy, Debug)]
struct Sample {
    a: f64,
    b: f64,
}

/// a = gain · b + offset.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Line {
    gain: f64,
    offset: f64,
}

impl Line {
    const IDENTITY: Self = Self { gain: 1.0, offset: 0.0 };

    fn difference(self, s: &Sample) -> f64 {
        s.a - (self.gain * s.b + self.offset)
    }
}

/// Estimates the correction that gives `second` the exposure and the white balance of `first`.
/// `matches` may have up to 40 % of outliers; matches outside a picture are left out.
///
/// # Errors
/// Fewer than [`MIN_SAMPLES`] usable matches in a channel; a gain outside [`GAIN_RANGE`].
pub fn estimate_exposure(
    first: &Rgb,
    second: &Rgb,
    matches: &[PointPair],
) -> Result<Exposure, ExposureError> {
    let mut exposure = Exposure {
        gain: [1.0; 3],
        offset: [0.0; 3],
        before: [0.0; 3],
        residual: [0.0; 3],
        samples: [0; 3],
    };
    for channel in 0..3 {
        let sample = |m: &PointPair| {
            let a = patch_mean(first, m.a, channel)?;
            Some(Sample { a, b: patch_mean(second, m.b, channel)? })
        };
        let samples: Vec<Sample> = matches.iter().filter_map(sample).collect();
        let found = samples.len();
        if found < MIN_SAMPLES {
            return Err(ExposureError::TooFew { channel, found });
        }
        let samples = thin(samples);
        let line = fit(&samples);
        let gain = line.gain as f32;
        if !(GAIN_RANGE[0]..=GAIN_RANGE[1]).contains(&gain) {
            return Err(ExposureError::Implausible { channel, gain });
        }
        exposure.gain[channel] = gain;
        exposure.offset[channel] = line.offset as f32;
        exposure.before[channel] = spread(Line::IDENTITY, &samples) as f32;
        exposure.residual[channel] = spread(line, &samples) as f32;
        exposure.samples[channel] = samples.len();
    }
    Ok(exposure)
}

impl Exposure {
    /// Reports whether the photographs agree within noise: [`Exposure::apply`] changes nothing.
    pub fn is_identity(&self) -> bool {
        self.gain == [1.0; 3] && self.offset == [0.0; 3]
    }

    /// Corrects a picture: gain · v + offset, rounded and clamped to 0..=255.
    pub fn apply(&self, picture: &mut Rgb) {
        if self.is_identity() {
            return;
        }
        let table = |c: usize| -> [u8; 256] {
            // `as` saturates.
            std::array::from_fn(|v| (self.gain[c] * v as f32 + self.offset[c]).round() as u8)
        };
        let tables = [table(0), table(1), table(2)];
        for px in picture.data.chunks_exact_mut(3) {
            px.iter_mut().zip(&tables).for_each(|(v, table)| *v = table[usize::from(*v)]);
        }
    }
}

/// Computes the mean of a channel on the patch around a point; `None` if the patch leaves the
/// picture or is saturated.
fn patch_mean(picture: &Rgb, at: [f32; 2], channel: usize) -> Option<f64> {
    if !at.iter().all(|v| v.is_finite()) {
        return None;
    }
    let [x, y] = at.map(|v| v.floor() as i64);
    let inside = |v: i64, side: usize| v >= PATCH_RADIUS && v < side as i64 - PATCH_RADIUS;
    if !inside(x, picture.width) || !inside(y, picture.height) {
        return None;
    }
    let mut sum = 0u32;
    for row in y - PATCH_RADIUS..=y + PATCH_RADIUS {
        let start = row as usize * picture.width + (x - PATCH_RADIUS) as usize;
        for i in start..=start + 2 * PATCH_RADIUS as usize {
            let value = *picture.data.get(3 * i + channel)?;
            if !(UNSATURATED[0]..=UNSATURATED[1]).contains(&value) {
                return None;
            }
            sum += u32::from(value);
        }
    }
    let side = 2 * PATCH_RADIUS + 1;
    Some(f64::from(sum) / (side * side) as f64)
}

/// Keeps at most [`MAX_SAMPLES`] samples, evenly spaced.
fn thin(samples: Vec<Sample>) -> Vec<Sample> {
    let n = samples.len();
    if n <= MAX_SAMPLES {
        return samples;
    }
    (0..MAX_SAMPLES).map(|i| samples[i * n / MAX_SAMPLES]).collect()
}

/// Computes a quantile of `values`; they are not empty.
fn quantile(values: &mut [f64], q: f64) -> f64 {
    let at = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

fn median(values: &mut [f64]) -> f64 {
    quantile(values, 0.5)
}

/// Computes the median absolute difference of the samples to a line.
fn spread(line: Line, samples: &[Sample]) -> f64 {
    median(&mut samples.iter().map(|s| line.difference(s).abs()).collect::<Vec<_>>())
}

/// Estimates a channel's line.
fn fit(samples: &[Sample]) -> Line {
    let mut values: Vec<f64> = samples.iter().map(|s| s.b).collect();
    let [low, high] = [0.1, 0.9].map(|q| quantile(&mut values, q));
    let with_offset = high - low >= RANGE_FOR_OFFSET;
    let start = if with_offset { repeated_medians(samples) } else { gain_alone(samples) };
    let (line, weights) = reweighted(start, samples, with_offset);
    if is_noise(line, samples, &weights, [low, high]) { Line::IDENTITY } else { line }
}

/// Fits a line by repeated medians: the median over the samples of the median slope to the
/// other samples.
fn repeated_medians(samples: &[Sample]) -> Line {
    let mut slopes = Vec::with_capacity(samples.len());
    let mut to_others = Vec::with_capacity(samples.len());
    for s in samples {
        to_others.clear();
        // Patches of nearly equal brightness give no slope.
        let others = samples.iter().filter(|o| (o.b - s.b).abs() > 1.0);
        to_others.extend(others.map(|o| (o.a - s.a) / (o.b - s.b)));
        if !to_others.is_empty() {
            slopes.push(median(&mut to_others));
        }
    }
    if slopes.is_empty() {
        return gain_alone(samples);
    }
    let gain = median(&mut slopes);
    let offset = median(&mut samples.iter().map(|s| s.a - gain * s.b).collect::<Vec<_>>());
    Line { gain, offset }
}

/// Fits a gain without an offset. `b` is at least [`UNSATURATED`]'s lower end.
fn gain_alone(samples: &[Sample]) -> Line {
    let gain = median(&mut samples.iter().map(|s| s.a / s.b).collect::<Vec<_>>());
    Line { gain, offset: 0.0 }
}

/// Improves a line by reweighted orthogonal regression, and returns the last weights.
fn reweighted(mut line: Line, samples: &[Sample], with_offset: bool) -> (Line, Vec<f64>) {
    const STEPS: usize = 20;
    /// Tukey's constant for 95 % efficiency.
    const TUKEY: f64 = 4.685;
    let mut weights = vec![1.0; samples.len()];
    for _ in 0..STEPS {
        // 1.4826 times the median absolute difference is a normal distribution's deviation. Its
        // lower bound keeps exact data from weighing nothing.
        let scale = (1.4826 * spread(line, samples)).max(0.25);
        for (w, s) in weights.iter_mut().zip(samples) {
            let u = line.difference(s) / (TUKEY * scale);
            *w = if u.abs() < 1.0 { (1.0 - u * u).powi(2) } else { 0.0 };
        }
        let next = if with_offset {
            orthogonal(samples, &weights)
        } else {
            let sums = samples
                .iter()
                .zip(&weights)
                .fold([0.0; 2], |[ab, bb], (s, w)| [ab + w * s.a * s.b, bb + w * s.b * s.b]);
            (sums[1] > 0.0).then(|| Line { gain: sums[0] / sums[1], offset: 0.0 })
        };
        let Some(next) = next else { break };
        let change = (next.gain - line.gain).abs() * 128.0 + (next.offset - line.offset).abs();
        line = next;
        if change < 1e-4 {
            break;
        }
    }
    (line, weights)
}

/// Weighted means and second moments of samples.
struct Moments {
    weight: f64,
    a: f64,
    b: f64,
    aa: f64,
    ab: f64,
    bb: f64,
}

impl Moments {
    fn new(samples: &[Sample], weights: &[f64]) -> Option<Self> {
        let weight: f64 = weights.iter().sum();
        if !(weight > 1.0) {
            return None;
        }
        let mean = |f: &dyn Fn(&Sample) -> f64| {
            samples.iter().zip(weights).map(|(s, w)| w * f(s)).sum::<f64>() / weight
        };
        let (a, b) = (mean(&|s| s.a), mean(&|s| s.b));
        Some(Self {
            weight,
            a,
            b,
            aa: mean(&|s| (s.a - a).powi(2)),
            ab: mean(&|s| (s.a - a) * (s.b - b)),
            bb: mean(&|s| (s.b - b).powi(2)),
        })
    }
}

/// Fits the line with the least weighted squared distances. `None` if the samples determine
/// none of positive slope.
fn orthogonal(samples: &[Sample], weights: &[f64]) -> Option<Line> {
    let m = Moments::new(samples, weights)?;
    if !(m.ab > 0.0) {
        return None;
    }
    let difference = m.aa - m.bb;
    let gain = (difference + (difference * difference + 4.0 * m.ab * m.ab).sqrt()) / (2.0 * m.ab);
    Some(Line { gain, offset: m.a - gain * m.b })
}

/// Reports whether a line differs from the identity by less than its error, over the samples'
/// range of brightness `range`.
fn is_noise(line: Line, samples: &[Sample], weights: &[f64], range: [f64; 2]) -> bool {
    let Some(m) = Moments::new(samples, weights) else { return false };
    let squares: f64 =
        samples.iter().zip(weights).map(|(s, w)| w * line.difference(s).powi(2)).sum();
    let variance = squares / (m.weight - 1.0).max(1.0);
    range.into_iter().all(|b| {
        let correction = (line.gain * b + line.offset - b).abs();
        let leverage = if m.bb > 0.0 { (b - m.b).powi(2) / m.bb } else { 0.0 };
        let error = (variance * (1.0 + leverage) / m.weight).sqrt();
        correction <= IDENTITY_LEVELS.max(IDENTITY_ERRORS * error)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 96;

    /// Deterministic noise in [-1, 1).
    struct Noise(u64);

    impl Noise {
        fn next(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
        }
    }

    /// A picture of flat cells of 8 px, of levels 40 to 180, with `noise` levels of noise.
    fn cells(noise: f32, seed: u64) -> Rgb {
        let (mut levels, mut grain) = (Noise(1), Noise(seed));
        let colours: Vec<f32> = (0..144 * 3).map(|_| 110.0 + 70.0 * levels.next()).collect();
        let mut picture = Rgb::black(SIDE, SIDE);
        for (i, v) in picture.data.iter_mut().enumerate() {
            let x = i / 3 % SIDE;
            let y = i / 3 / SIDE;
            let c = i % 3;
            *v = (colours[3 * (y / 8 * 12 + x / 8) + c] + noise * grain.next()).round() as u8;
        }
        picture
    }

    /// The centres of the cells; a share `outliers` of them is matched with a wrong cell.
    fn matches(outliers: f32) -> Vec<PointPair> {
        let centre = |i: usize| [(8 * (i % 12)) as f32 + 4.5, (8 * (i / 12)) as f32 + 4.5];
        let mut noise = Noise(7);
        (0..144)
            .map(|i| {
                let wrong = 0.5 * (noise.next() + 1.0) < outliers;
                let b = if wrong { (i * 31 + 17) % 144 } else { i };
                PointPair { a: centre(i), b: centre(b) }
            })
            .collect()
    }

    fn changed(picture: &Rgb, gain: [f32; 3], offset: [f32; 3]) -> Rgb {
        let data = picture.data.iter().enumerate();
        let data = data.map(|(i, &v)| (gain[i % 3] * f32::from(v) + offset[i % 3]).round() as u8);
        Rgb { data: data.collect(), ..*picture }
    }

    #[test]
    fn gain_and_offset_are_found_among_outliers() {
        let gain = [1.25, 0.9, 0.8];
        let offset = [4.0, -6.0, 10.0];
        let second = cells(3.0, 5);
        let first = changed(&cells(3.0, 9), gain, offset);
        for outliers in [0.0, 0.3] {
            let found = estimate_exposure(&first, &second, &matches(outliers)).unwrap();
            for c in 0..3 {
                // The largest error over the picture's levels.
                for v in [40.0, 180.0] {
                    let error = (found.gain[c] - gain[c]) * v + found.offset[c] - offset[c];
                    assert!(error.abs() < 1.0, "{outliers} {c} {v}: {error} {found:?}");
                }
                assert!(found.residual[c] < 2.5 && found.before[c] > 5.0, "{found:?}");
                assert!(found.samples[c] >= 120, "{found:?}");
            }
            let mut corrected = second.clone();
            found.apply(&mut corrected);
            let worst = corrected.data.iter().zip(&first.data).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(worst.unwrap() <= 10, "{worst:?}");
        }
    }

    #[test]
    fn exposure_in_linear_light_is_a_line() {
        let linear = |v: f64| ((v + 0.055) / 1.055).powf(2.4);
        let encoded = |l: f64| 1.055 * l.powf(1.0 / 2.4) - 0.055;
        let second = cells(0.0, 5);
        let brighter = |&v: &u8| (encoded(1.6 * linear(f64::from(v) / 255.0)) * 255.0).round();
        let first = Rgb { data: second.data.iter().map(|v| brighter(v) as u8).collect(), ..second };
        let found = estimate_exposure(&first, &second, &matches(0.3)).unwrap();
        let gain = 1.6f64.powf(1.0 / 2.4);
        for c in 0..3 {
            assert!((f64::from(found.gain[c]) - gain).abs() < 0.01, "{found:?}");
            let offset = 0.055 * (gain - 1.0) * 255.0;
            assert!((f64::from(found.offset[c]) - offset).abs() < 1.0, "{found:?}");
        }
    }

    #[test]
    fn equal_photographs_give_the_identity() {
        let found = estimate_exposure(&cells(6.0, 5), &cells(6.0, 9), &matches(0.3)).unwrap();
        assert!(found.is_identity(), "{found:?}");
        assert!(found.residual == found.before && found.residual[0] > 0.0, "{found:?}");
        let mut picture = cells(6.0, 5);
        found.apply(&mut picture);
        assert_eq!(picture, cells(6.0, 5));
        // Two levels are more than the noise of 100 patches.
        let shifted = changed(&cells(6.0, 9), [1.0; 3], [2.0; 3]);
        let found = estimate_exposure(&shifted, &cells(6.0, 5), &matches(0.3)).unwrap();
        assert!(!found.is_identity(), "{found:?}");
    }

    #[test]
    fn saturated_patches_are_left_out() {
        let second = cells(0.0, 5);
        // Clipped above level 140 of the second picture.
        let first = changed(&second, [1.8; 3], [0.0; 3]);
        let found = estimate_exposure(&first, &second, &matches(0.0)).unwrap();
        for c in 0..3 {
            assert!((found.gain[c] - 1.8).abs() < 0.02, "{found:?}");
            assert!(found.samples[c] < 120, "{found:?}");
        }
        let mut picture = second.clone();
        found.apply(&mut picture);
        let bright = second.data.iter().position(|v| *v > 145).unwrap();
        assert_eq!(picture.data[bright], 255);
    }

    #[test]
    fn flat_pictures_give_a_gain() {
        let flat = |v: u8| Rgb { data: vec![v; SIDE * SIDE * 3], ..Rgb::black(SIDE, SIDE) };
        let found = estimate_exposure(&flat(120), &flat(100), &matches(0.0)).unwrap();
        assert_eq!(found.offset, [0.0; 3]);
        assert!(found.gain.iter().all(|g| (g - 1.2).abs() < 1e-3), "{found:?}");
    }

    #[test]
    fn a_narrow_range_gives_a_gain() {
        // Levels 94 to 106: the noise hides the slope.
        let narrow = |seed| changed(&cells(20.0, seed), [0.08; 3], [91.0; 3]);
        let first = changed(&narrow(5), [1.2; 3], [0.0; 3]);
        let found = estimate_exposure(&first, &narrow(9), &matches(0.3)).unwrap();
        assert_eq!(found.offset, [0.0; 3]);
        assert!(found.gain.iter().all(|g| (g - 1.2).abs() < 0.01), "{found:?}");
    }

    #[test]
    fn the_majority_decides() {
        // 40 % of the cells agree exactly on another line: they are unchanged.
        let second = cells(3.0, 5);
        let mut first = changed(&cells(3.0, 9), [0.5; 3], [0.0; 3]);
        for (i, v) in first.data.iter_mut().enumerate() {
            let x = i / 3 % SIDE / 8;
            let y = i / 3 / SIDE / 8;
            if (x + 2 * y) % 5 < 2 {
                *v = second.data[i];
            }
        }
        let found = estimate_exposure(&first, &second, &matches(0.0)).unwrap();
        for c in 0..3 {
            assert!((found.gain[c] - 0.5).abs() < 0.02, "{found:?}");
            assert!(found.offset[c].abs() < 2.0, "{found:?}");
        }
    }

    #[test]
    fn unusable_input_is_refused() {
        let (a, b) = (cells(0.0, 5), cells(0.0, 5));
        let few = estimate_exposure(&a, &b, &matches(0.0)[..11]).unwrap_err();
        assert_eq!(few, ExposureError::TooFew { channel: 0, found: 11 });
        assert!(few.to_string().contains("at least 12"), "{few}");
        let outside = PointPair { a: [f32::NAN, 5.0], b: [1e30, -4.0] };
        let found = estimate_exposure(&a, &b, &vec![outside; 40]).unwrap_err();
        assert_eq!(found, ExposureError::TooFew { channel: 0, found: 0 });
        let dark = changed(&a, [0.2; 3], [0.0; 3]);
        let found = estimate_exposure(&a, &dark, &matches(0.0)).unwrap_err();
        assert!(found.to_string().contains("gain of 0.35 to 2.9"), "{found}");
    }
}
