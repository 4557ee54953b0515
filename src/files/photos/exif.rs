//! The camera in the EXIF block of a photograph: make, model and focal length.
//!
//! Source: EXIF 2.32 (CIPA DC-008-2019), section 4.6; CIPA DCG-001 for the 35 mm equivalent.
//! `kamadak-exif` reads the tags.
//!
//! The focal length is determined in px of the loaded picture, from the first of these that is
//! there:
//!
//! 1. `FocalLengthIn35mmFilm` f₃₅: f = f₃₅ · D / 43.27 mm, where D is the picture's diagonal in
//!    px and 43.27 mm the diagonal of 36 × 24 mm film (DCG-001 compares diagonals). Makers
//!    include the digital zoom in f₃₅, so `DigitalZoomRatio` is not applied.
//! 2. `FocalLength` in mm times `FocalPlaneXResolution` and `FocalPlaneYResolution` in px per
//!    mm, times `DigitalZoomRatio`.
//!
//! Both hold for the picture that the camera stored, `PixelXDimension` × `PixelYDimension`.
//! A picture of another size was resized or cropped after the shot. The reader assumes the
//! smallest crop: the stored picture was scaled until one side fits, and the other was cut.
//! The longer side is compared with the longer one, because programs that rotate pixels often
//! keep the two tags. Pixels are square, so the focal length holds for every orientation.

use exif::{DateTime, Exif, In, Rational, Tag, Value};
use std::fmt;

/// Diagonal of 35 mm film, 36 × 24 mm.
const FILM_DIAGONAL_MM: f64 = 43.266_615_305_567_875;

/// Accepted fields of view along the longer side, degrees.
const FOV_DEGREES: [f64; 2] = [5.0, 170.0];

/// Accepted digital zooms.
const ZOOM: [f64; 2] = [0.1, 100.0];

/// Largest relative difference between the two sides' scales of an uncropped picture, and
/// between the focal plane's two resolutions.
const SIDE_TOLERANCE: f64 = 0.02;

/// Longest make or model, characters.
const NAME_LENGTH: usize = 64;

/// The origin of a focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FocalSource {
    /// `FocalLengthIn35mmFilm`.
    Film35mm {
        /// Equivalent focal length, mm.
        mm: f64,
    },
    /// `FocalLength` with the resolution of the focal plane.
    FocalPlane {
        /// Focal length, mm.
        mm: f64,
        /// Resolution of the focal plane, px of the stored picture per mm.
        px_per_mm: f64,
        /// Digital zoom; 1 if it was not used.
        zoom: f64,
    },
}

impl fmt::Display for FocalSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Film35mm { mm } => write!(f, "EXIF FocalLengthIn35mmFilm {mm} mm"),
            Self::FocalPlane { mm, px_per_mm, zoom } => {
                write!(f, "EXIF FocalLength {mm} mm and {px_per_mm:.1} px/mm on the focal plane")?;
                if *zoom == 1.0 { Ok(()) } else { write!(f, ", digital zoom {zoom}") }
            }
        }
    }
}

/// A focal length with its origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalLength {
    /// Focal length along both axes, px of the loaded picture.
    pub px: f64,
    /// The tags from which it was computed.
    pub source: FocalSource,
}

/// The camera of a photograph as its EXIF block describes it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExifCamera {
    /// Maker, for messages.
    pub make: Option<String>,
    /// Model, for messages.
    pub model: Option<String>,
    /// Focal length; `None` if the block does not determine it.
    pub focal: Option<FocalLength>,
}

/// Time and exposure of a photograph, which tell a series of exposures of one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Local time of `DateTimeOriginal`, seconds since 1970.
    pub seconds: f64,
    /// `ExposureBiasValue`, stops above the measured exposure.
    pub bias: f64,
}

/// Result of [`parse_exif`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExifReport {
    /// The camera.
    pub camera: ExifCamera,
    /// Time and exposure, where the block states both.
    pub shot: Option<Shot>,
    /// Ignored values, one line each with tag and value.
    pub warnings: Vec<String>,
}

/// Reads the camera from an EXIF block (a TIFF structure without `Exif\0\0`) of a picture of
/// `width` × `height` px. The order of the two sides does not matter. Malformed blocks and
/// values give warnings.
pub fn parse_exif(block: &[u8], width: usize, height: usize) -> ExifReport {
    let mut report = ExifReport::default();
    let read = exif::Reader::new().continue_on_error(true).read_raw(block.to_vec());
    let read = read.or_else(|e| {
        e.distill_partial_result(|errors| {
            let few = errors.iter().take(3).map(ToString::to_string).collect::<Vec<_>>();
            report.warnings.push(format!("the EXIF block is malformed: {}", few.join(", ")));
        })
    });
    let tags = match read {
        Ok(exif) => Tags { exif },
        Err(e) => {
            report.warnings.push(format!("the EXIF block is ignored: {e}"));
            return report;
        }
    };
    report.camera.make = tags.text(Tag::Make);
    report.camera.model = tags.text(Tag::Model);
    report.shot = tags.shot();
    let stored = tags.stored_size(width, height, &mut report.warnings);
    report.camera.focal = tags
        .film_35mm(&stored, &mut report.warnings)
        .or_else(|| tags.focal_plane(&stored, &mut report.warnings));
    report
}

/// Relation of the loaded picture to the one that the camera stored.
struct StoredSize {
    /// Diagonal of the stored picture, px of the loaded one.
    diagonal: f64,
    /// Px of the loaded picture per px of the stored one.
    scale: f64,
    /// Longer side of the loaded picture, px.
    longer: f64,
}

impl StoredSize {
    /// Accepts a focal length whose field of view is plausible.
    fn check(&self, px: f64) -> Result<f64, String> {
        let degrees = 2.0 * (0.5 * self.longer / px).atan().to_degrees();
        let [least, greatest] = FOV_DEGREES;
        if px.is_finite() && (least..=greatest).contains(&degrees) {
            return Ok(px);
        }
        Err(format!("a field of view of {degrees:.1}° (accepted: {least}° to {greatest}°)"))
    }
}

/// Days from 1970-01-01 to a date of the Gregorian calendar. The year begins in March, so that a leap day is its last.
fn days_before(year: i64, month: i64, day: i64) -> i64 {
    let year = if month > 2 { year } else { year - 1 };
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    // 719,468 days lie between 0000-03-01 and 1970-01-01.
    365 * year + year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400) + of_year
        - 719_468
}

struct Tags {
    exif: Exif,
}

impl Tags {
    fn value(&self, tag: Tag) -> Option<&Value> {
        self.exif.get_field(tag, In::PRIMARY).map(|field| &field.value)
    }

    /// Reads a printable string.
    fn text(&self, tag: Tag) -> Option<String> {
        let Value::Ascii(lines) = self.value(tag)? else { return None };
        let text = String::from_utf8_lossy(lines.first()?);
        let clean: String =
            text.trim_matches(['\0', ' ']).chars().filter(|c| !c.is_control()).collect();
        let short: String = clean.chars().take(NAME_LENGTH).collect();
        (!short.is_empty()).then_some(short)
    }

    /// Reads one number. A fraction with denominator 0 is infinite or NaN.
    fn number(&self, tag: Tag) -> Option<f64> {
        let ratio = |r: &Rational| f64::from(r.num) / f64::from(r.denom);
        match self.value(tag)? {
            Value::Rational(v) => v.first().map(ratio),
            Value::SRational(v) => v.first().map(|r| f64::from(r.num) / f64::from(r.denom)),
            Value::Float(v) => v.first().map(|v| f64::from(*v)),
            Value::Double(v) => v.first().copied(),
            other => other.get_uint(0).map(f64::from),
        }
    }

    fn shot(&self) -> Option<Shot> {
        let bias = self.number(Tag::ExposureBiasValue).filter(|bias| bias.is_finite())?;
        let Value::Ascii(lines) = self.value(Tag::DateTimeOriginal)? else { return None };
        let time = DateTime::from_ascii(lines.first()?).ok()?;
        let days = days_before(i64::from(time.year), i64::from(time.month), i64::from(time.day));
        let [hours, minutes, seconds] = [time.hour, time.minute, time.second].map(i64::from);
        let whole = ((24 * days + hours) * 60 + minutes) * 60 + seconds;
        Some(Shot { seconds: whole as f64, bias })
    }

    /// Reads a number above 0. Other values are ignored with a warning.
    fn positive(&self, tag: Tag, warnings: &mut Vec<String>) -> Option<f64> {
        let value = self.number(tag)?;
        if value > 0.0 && value.is_finite() {
            return Some(value);
        }
        warnings.push(format!("EXIF {tag} is ignored: expected a number above 0, got {value}"));
        None
    }

    fn stored_size(&self, width: usize, height: usize, warnings: &mut Vec<String>) -> StoredSize {
        let (longer, shorter) = (width.max(height) as f64, width.min(height) as f64);
        let whole = StoredSize { diagonal: longer.hypot(shorter), scale: 1.0, longer };
        let x = self.positive(Tag::PixelXDimension, warnings);
        let y = self.positive(Tag::PixelYDimension, warnings);
        let (Some(x), Some(y)) = (x, y) else { return whole };
        let (stored_longer, stored_shorter) = (x.max(y), x.min(y));
        let scales = [longer / stored_longer, shorter / stored_shorter];
        let scale = scales[0].max(scales[1]);
        if scales[0].min(scales[1]) < (1.0 - SIDE_TOLERANCE) * scale {
            warnings.push(format!(
                "EXIF PixelXDimension and PixelYDimension are {x} and {y}, the picture has \
                 {width}x{height} px: it was cropped, and its field of view is uncertain"
            ));
        }
        StoredSize { diagonal: scale * stored_longer.hypot(stored_shorter), scale, longer }
    }

    fn film_35mm(&self, stored: &StoredSize, warnings: &mut Vec<String>) -> Option<FocalLength> {
        let tag = Tag::FocalLengthIn35mmFilm;
        let mm = self.positive(tag, warnings)?;
        match stored.check(mm * stored.diagonal / FILM_DIAGONAL_MM) {
            Ok(px) => Some(FocalLength { px, source: FocalSource::Film35mm { mm } }),
            Err(why) => {
                warnings.push(format!("EXIF {tag} {mm} mm is ignored: {why}"));
                None
            }
        }
    }

    fn focal_plane(&self, stored: &StoredSize, warnings: &mut Vec<String>) -> Option<FocalLength> {
        let mm = self.positive(Tag::FocalLength, warnings)?;
        let px_per_mm = self.px_per_mm(warnings)?;
        let zoom = self.digital_zoom(warnings);
        match stored.check(mm * px_per_mm * zoom * stored.scale) {
            Ok(px) => {
                let source = FocalSource::FocalPlane { mm, px_per_mm, zoom };
                Some(FocalLength { px, source })
            }
            Err(why) => {
                warnings.push(format!(
                    "EXIF {} {mm} mm with {px_per_mm:.1} px/mm ({}) and digital zoom {zoom} is \
                     ignored: {why}",
                    Tag::FocalLength,
                    Tag::FocalPlaneXResolution,
                ));
                None
            }
        }
    }

    /// Reads the resolution of the focal plane, px per mm: the mean of both axes.
    fn px_per_mm(&self, warnings: &mut Vec<String>) -> Option<f64> {
        let x = self.positive(Tag::FocalPlaneXResolution, warnings);
        let y = self.positive(Tag::FocalPlaneYResolution, warnings);
        let per_unit = match (x, y) {
            (Some(x), Some(y)) if (x / y - 1.0).abs() > SIDE_TOLERANCE => {
                warnings.push(format!(
                    "EXIF FocalPlaneXResolution {x} and FocalPlaneYResolution {y} are ignored: \
                     expected square pixels"
                ));
                return None;
            }
            (Some(x), Some(y)) => 0.5 * (x + y),
            (Some(one), None) | (None, Some(one)) => one,
            (None, None) => return None,
        };
        // 2 and 3 are the standard's; 4 and 5 are in use by some makers. Default: inch.
        let unit_mm = match self.number(Tag::FocalPlaneResolutionUnit).map(|v| v as i64) {
            None | Some(2) => 25.4,
            Some(3) => 10.0,
            Some(4) => 1.0,
            Some(5) => 0.001,
            Some(other) => {
                let tag = Tag::FocalPlaneResolutionUnit;
                warnings.push(format!(
                    "EXIF {tag} is ignored with the focal plane's resolution: expected 2 (inch) \
                     or 3 (cm), got {other}"
                ));
                return None;
            }
        };
        Some(per_unit / unit_mm)
    }

    /// Reads the digital zoom; 1 where it was not used (the standard's 0, or no tag).
    fn digital_zoom(&self, warnings: &mut Vec<String>) -> f64 {
        let tag = Tag::DigitalZoomRatio;
        let [least, greatest] = ZOOM;
        match self.number(tag) {
            None => 1.0,
            Some(0.0) => 1.0,
            Some(zoom) if (least..=greatest).contains(&zoom) => zoom,
            Some(zoom) => {
                warnings.push(format!(
                    "EXIF {tag} is ignored: expected 0 or {least} to {greatest}, got {zoom}"
                ));
                1.0
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_follow_the_calendar() {
        let dates = [(1970, 1, 1, 0), (1972, 2, 29, 789), (1972, 3, 1, 790), (2000, 1, 1, 10_957)];
        for (year, month, day, days) in dates.into_iter().chain([(2026, 11, 30, 20_787)]) {
            assert_eq!(days_before(year, month, day), days, "{year}-{month}-{day}");
        }
    }
}
