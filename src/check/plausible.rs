//! What is wrong before anything is matched: sizes, intrinsics, one camera or one
//! photograph given twice.

use super::image::GrayImage;
use super::mistakes::NORMALISED_FOCAL;
use super::report::{PairReport, Verdict};
use crate::camera::{Camera, Intrinsics};

/// Largest mean difference of two photographs that are one and the same, 0 to 1:
/// below what recompression leaves.
const SAME_PHOTOGRAPH: f32 = 0.004;
/// Fields of view that hand-held pinhole cameras have, degrees.
const PLAUSIBLE_FOV: std::ops::RangeInclusive<f32> = 8.0..=140.0;
/// Principal point over the picture's size: lenses are off by a few percent, crops
/// by more, intrinsics of half the size by a quarter.
const PLAUSIBLE_MIDDLE: std::ops::RangeInclusive<f32> = 0.28..=0.72;
/// Ratios fx / fy of pixels that video has; beyond them something was divided by
/// the wrong side.
const PLAUSIBLE_PIXELS: std::ops::RangeInclusive<f32> = 0.7..=1.43;
/// Largest relative difference of aspect between a photograph and its intrinsics.
const ASPECT: f32 = 0.02;

/// Cameras against the photographs' sizes, without a look at the content.
pub(super) fn cameras(report: &mut PairReport, views: [(&GrayImage, &Camera); 2]) {
    for (name, (image, camera)) in ["first", "second"].into_iter().zip(views) {
        size(report, name, image, &camera.intrinsics);
        intrinsics(report, name, &camera.intrinsics);
    }
    let [a, b] = views.map(|v| v.1.world_from_camera);
    if a.abs_diff_eq(b, 1e-6) {
        let sentence =
            "both photographs have the same camera: there is no baseline to see depth by";
        report.find(Verdict::Bad, "same_camera", sentence);
    }
}

fn size(report: &mut PairReport, name: &str, image: &GrayImage, k: &Intrinsics) {
    let (w, h) = (image.width(), image.height());
    if (k.width, k.height) == (w, h) {
        return;
    }
    let aspect = (w * k.height) as f32 / (h * k.width).max(1) as f32;
    let (severity, note) = if (k.width, k.height) == (h, w) {
        (Verdict::Bad, "the photograph is turned (EXIF orientation?)")
    } else if (aspect - 1.0).abs() > ASPECT {
        (Verdict::Bad, "another aspect: it was cropped, or they belong to another camera")
    } else {
        (Verdict::Warning, "they are scaled to fit")
    };
    let sentence = format!(
        "the {name} photograph has {w}x{h} pixels, its intrinsics are for {}x{}: {note}",
        k.width, k.height
    );
    report.find(severity, "size_differs", sentence);
}

fn intrinsics(report: &mut PairReport, name: &str, k: &Intrinsics) {
    let fov = [k.fov_x().to_degrees(), k.fov_y().to_degrees()];
    let middle = [k.cx / k.width as f32, k.cy / k.height as f32];
    if k.fx < NORMALISED_FOCAL && k.fy < NORMALISED_FOCAL {
        let sentence = format!(
            "the {name} camera has fx = {:.3} and fy = {:.3}: these are divided by the picture's \
             size, pixels are expected",
            k.fx, k.fy
        );
        report.find(Verdict::Bad, "intrinsics_normalised", sentence);
    } else if fov.iter().any(|v| !PLAUSIBLE_FOV.contains(v)) {
        let sentence = format!(
            "the {name} camera's field of view is {:.0}° x {:.0}°: are its intrinsics in pixels \
             of this photograph?",
            fov[0], fov[1]
        );
        report.find(Verdict::Bad, "field_of_view", sentence);
    } else if middle.iter().any(|v| !PLAUSIBLE_MIDDLE.contains(v)) {
        let sentence = format!(
            "the {name} camera's principal point ({:.0}, {:.0}) is far from the middle of its \
             {}x{} px: do its intrinsics belong to another picture size?",
            k.cx, k.cy, k.width, k.height
        );
        report.find(Verdict::Warning, "principal_point", sentence);
    } else if !PLAUSIBLE_PIXELS.contains(&(k.fx / k.fy)) {
        let sentence = format!(
            "the {name} camera has fx = {:.0} px and fy = {:.0} px: pixels are hardly that far \
             from square; was a focal length divided by the wrong side?",
            k.fx, k.fy
        );
        report.find(Verdict::Warning, "pixels_not_square", sentence);
    }
}

/// Whether both photographs are one and the same, and says so.
pub(super) fn same_photograph(report: &mut PairReport, a: &GrayImage, b: &GrayImage) -> bool {
    if (a.width(), a.height()) != (b.width(), b.height()) {
        return false;
    }
    let sum: f64 = a.pixels().iter().zip(b.pixels()).map(|(x, y)| f64::from((x - y).abs())).sum();
    let same = sum / (a.pixels().len() as f64) < f64::from(SAME_PHOTOGRAPH);
    if same {
        let sentence =
            "both photographs show the same picture: there is no parallax to see depth by";
        report.find(Verdict::Bad, "same_photograph", sentence);
    }
    same
}
