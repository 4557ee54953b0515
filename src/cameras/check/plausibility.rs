//! Judges what needs no matches: picture sizes, intrinsics, a repeated camera, a repeated
//! photograph.
//!
//! Input: grey photographs and cameras. Output: [`Finding`]s.

use super::measures::CameraMeasures;
use super::mistakes::NORMALISED_FOCAL;
use super::report::{Finding, Verdict};
use crate::cameras::matches::GrayImage;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Largest mean difference of two copies of one photograph, 0 to 1: below the error of
/// recompression.
const MAX_SAME_DIFFERENCE: f32 = 0.004;
/// Fields of view of hand-held pinhole cameras, degrees.
const PLAUSIBLE_FOV: std::ops::RangeInclusive<f32> = 8.0..=140.0;
/// Principal point over the picture's size. Lenses deviate by a few percent, crops by more,
/// intrinsics of half the size by a quarter.
const PLAUSIBLE_MIDDLE: std::ops::RangeInclusive<f32> = 0.28..=0.72;
/// Ratios fx / fy of the pixels of video. Other ratios arise from a division by the wrong side.
const PLAUSIBLE_PIXELS: std::ops::RangeInclusive<f32> = 0.7..=1.43;
/// Largest relative difference of aspect between a photograph and its intrinsics.
const ASPECT: f32 = 0.02;

/// Judges the cameras by the photographs' sizes and by each other.
pub(super) fn of_cameras(
    views: [(&GrayImage, &Camera); 2],
    cameras: &CameraMeasures,
) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (name, (image, camera)) in ["first", "second"].into_iter().zip(views) {
        findings.extend(size(name, image, &camera.intrinsics()));
        findings.extend(intrinsics(name, &camera.intrinsics()));
    }
    if cameras.is_same_camera {
        let sentence = "both photographs have the same camera position: depth can be seen only \
                        from two places";
        findings.push(Finding::new(Verdict::Bad, "same_camera", sentence));
    }
    findings
}

/// Reports a photograph whose size differs from its intrinsics.
fn size(name: &str, image: &GrayImage, k: &Intrinsics) -> Option<Finding> {
    let (w, h) = (image.width(), image.height());
    if (k.width, k.height) == (w, h) {
        return None;
    }
    let aspect = (w * k.height) as f32 / (h * k.width).max(1) as f32;
    let (severity, note) = if (k.width, k.height) == (h, w) {
        (Verdict::Bad, "the photograph was rotated (EXIF orientation?)")
    } else if (aspect - 1.0).abs() > ASPECT {
        (
            Verdict::Bad,
            "the shapes differ, because the photograph was cropped or the intrinsics belong to \
             another camera",
        )
    } else {
        (Verdict::Warning, "the intrinsics are scaled to fit")
    };
    let sentence = format!(
        "the {name} photograph has {w}x{h} pixels, but its intrinsics are for {}x{}: {note}",
        k.width, k.height
    );
    Some(Finding::new(severity, "size_differs", sentence))
}

/// Reports implausible focal lengths and principal points.
fn intrinsics(name: &str, k: &Intrinsics) -> Option<Finding> {
    let fov = [k.fov_x().to_degrees(), k.fov_y().to_degrees()];
    let middle = [k.cx / k.width as f32, k.cy / k.height as f32];
    if k.fx < NORMALISED_FOCAL && k.fy < NORMALISED_FOCAL {
        let sentence = format!(
            "the {name} camera has fx = {:.3} and fy = {:.3}: pixels are expected, but these \
             values are divided by the picture's size",
            k.fx, k.fy
        );
        return Some(Finding::new(Verdict::Bad, "intrinsics_normalised", sentence));
    }
    if fov.iter().any(|v| !PLAUSIBLE_FOV.contains(v)) {
        let sentence = format!(
            "the {name} camera's field of view is {:.0}° x {:.0}°: are its intrinsics in pixels \
             of this photograph?",
            fov[0], fov[1]
        );
        return Some(Finding::new(Verdict::Bad, "field_of_view", sentence));
    }
    if middle.iter().any(|v| !PLAUSIBLE_MIDDLE.contains(v)) {
        let sentence = format!(
            "the {name} camera's principal point ({:.0}, {:.0}) is far from the middle of its \
             {}x{} px: do its intrinsics belong to another picture size?",
            k.cx, k.cy, k.width, k.height
        );
        return Some(Finding::new(Verdict::Warning, "principal_point", sentence));
    }
    (!PLAUSIBLE_PIXELS.contains(&(k.fx / k.fy))).then(|| {
        let sentence = format!(
            "the {name} camera has fx = {:.0} px and fy = {:.0} px: pixels are rarely that far \
             from square; was a focal length divided by the wrong side?",
            k.fx, k.fy
        );
        Finding::new(Verdict::Warning, "pixels_not_square", sentence)
    })
}

/// Reports two photographs that are the same picture.
pub(super) fn same_photograph(a: &GrayImage, b: &GrayImage) -> Option<Finding> {
    if (a.width(), a.height()) != (b.width(), b.height()) {
        return None;
    }
    let sum: f64 = a.pixels().iter().zip(b.pixels()).map(|(x, y)| f64::from((x - y).abs())).sum();
    let is_same = sum / (a.pixels().len() as f64) < f64::from(MAX_SAME_DIFFERENCE);
    is_same.then(|| {
        let sentence = "both photographs are the same picture: depth can be seen only from two \
                        places";
        Finding::new(Verdict::Bad, "same_photograph", sentence)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Code and severity of a finding.
    fn code(finding: Option<Finding>) -> Option<(String, Verdict)> {
        finding.map(|f| (f.code, f.severity))
    }

    /// Each threshold by cases 2 % below and above it, as numbers.
    #[test]
    fn thresholds_are_those_of_lenses_and_video() {
        let lens = Intrinsics::from_fov_x(1.0, 1000, 1000);
        let found = |k: Intrinsics| code(intrinsics("first", &k)).map(|(code, _)| code);
        let of = |change: &dyn Fn(&mut Intrinsics, f32), at: f32| {
            [0.98, 1.02].map(|part| {
                let mut k = lens;
                change(&mut k, part * at);
                found(k).unwrap_or_default()
            })
        };
        assert_eq!(found(lens), None);
        let fov = |k: &mut Intrinsics, degrees: f32| {
            *k = Intrinsics::from_fov_x(degrees.to_radians(), 1000, 1000);
        };
        assert_eq!(of(&fov, 8.0), ["field_of_view", ""]);
        assert_eq!(of(&fov, 140.0), ["", "field_of_view"]);
        let middle = |k: &mut Intrinsics, share: f32| k.cx = 1000.0 * share;
        assert_eq!(of(&middle, 0.28), ["principal_point", ""]);
        assert_eq!(of(&middle, 0.72), ["", "principal_point"]);
        let pixels = |k: &mut Intrinsics, ratio: f32| k.fx = ratio * k.fy;
        assert_eq!(of(&pixels, 0.7), ["pixels_not_square", ""]);
        assert_eq!(of(&pixels, 1.43), ["", "pixels_not_square"]);
        let normalised = |k: &mut Intrinsics, focal: f32| (k.fx, k.fy) = (focal, focal);
        assert_eq!(of(&normalised, 10.0), ["intrinsics_normalised", "field_of_view"]);
    }

    #[test]
    fn a_photograph_of_another_shape_is_bad() {
        let image = GrayImage::new(100, 100, vec![0.5; 10_000]).unwrap();
        let judge = |width: usize, height: usize| {
            let k = Intrinsics { width, height, ..Intrinsics::from_fov_x(1.0, 100, 100) };
            code(size("first", &image, &k)).map(|(_, severity)| severity)
        };
        assert_eq!(judge(100, 100), None);
        assert_eq!(judge(10_000, 10_196), Some(Verdict::Warning));
        assert_eq!(judge(10_000, 10_204), Some(Verdict::Bad));
        let wide = GrayImage::new(200, 100, vec![0.5; 20_000]).unwrap();
        let k = Intrinsics { width: 100, height: 200, ..Intrinsics::from_fov_x(1.0, 100, 100) };
        let turned = size("first", &wide, &k).unwrap();
        assert!(turned.severity == Verdict::Bad && turned.sentence.contains("rotated"));
    }

    #[test]
    fn copies_differ_by_less_than_recompression() {
        let grey = |v: f32, side: usize| GrayImage::new(side, side, vec![v; side * side]).unwrap();
        let same =
            |difference: f32| same_photograph(&grey(0.5, 9), &grey(0.5 + difference, 9)).is_some();
        assert_eq!([same(0.98 * 0.004), same(1.02 * 0.004)], [true, false]);
        assert!(same_photograph(&grey(0.5, 9), &grey(0.5, 8)).is_none());
    }
}
