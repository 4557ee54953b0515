//! `transforms.json` of nerfstudio and instant-ngp.
//!
//! Poses are OpenGL camera-to-world (x right, y up, −z forward); the reader negates the
//! second and third column, unless [`SceneOptions::convention`](super::reading::SceneOptions) says otherwise. Intrinsics are in pixels, per file or per frame: `fl_x`, `fl_y`
//! (else `fl_x`), `cx`, `cy` (else the middle), `w`, `h` (else the stored picture's). Files
//! without `fl_x` have `camera_angle_x` and `camera_angle_y` in radians. Camera models: none
//! given, SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV,
//! OPENCV_FISHEYE, EQUIRECTANGULAR (a picture becomes several frames, `super::panoramas`). `mask_path` of a frame names its mask ([`super::scene::Frame::mask`]). Other keys
//! (`aabb_scale`, `sharpness`, `ply_file_path`, …) are ignored.

use super::assemble::{Draft, Lens, assemble, find_image};
use super::cameras_json::{matrix, side};
use super::json;
use super::matrices::PoseConvention;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::photos::views::panorama_intrinsics;
use crate::files::{Error, Result, read};
use glam::{DMat4, DVec4};
use serde::Deserialize;
use std::path::Path;

/// Keys of the file, of a frame, or of both; a frame's value takes precedence.
#[derive(Deserialize, Default, Clone)]
#[serde(expecting = "an object")]
struct Optics {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

impl Optics {
    /// Takes the frame's values, and the file's where the frame has none.
    fn over(self, file: &Self) -> Self {
        Self {
            camera_model: self.camera_model.or_else(|| file.camera_model.clone()),
            is_fisheye: self.is_fisheye.or(file.is_fisheye),
            fl_x: self.fl_x.or(file.fl_x),
            fl_y: self.fl_y.or(file.fl_y),
            cx: self.cx.or(file.cx),
            cy: self.cy.or(file.cy),
            w: self.w.or(file.w),
            h: self.h.or(file.h),
            camera_angle_x: self.camera_angle_x.or(file.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(file.camera_angle_y),
            k1: self.k1.or(file.k1),
            k2: self.k2.or(file.k2),
            k3: self.k3.or(file.k3),
            k4: self.k4.or(file.k4),
            k5: self.k5.or(file.k5),
            k6: self.k6.or(file.k6),
            p1: self.p1.or(file.p1),
            p2: self.p2.or(file.p2),
        }
    }

    fn distortion(&self) -> std::result::Result<Distortion, String> {
        let k = [self.k1, self.k2, self.k3, self.k4, self.k5, self.k6].map(|v| v.unwrap_or(0.0));
        let p = [self.p1, self.p2].map(|v| v.unwrap_or(0.0));
        let model = self.camera_model.as_deref().unwrap_or("");
        let fisheye = self.is_fisheye.unwrap_or(false);
        match model.to_ascii_uppercase().as_str() {
            "" | "OPENCV" | "FULL_OPENCV" if fisheye => {
                Ok(Distortion::fisheye([k[0], k[1], k[2], k[3]]))
            }
            "OPENCV_FISHEYE" => Ok(Distortion::fisheye([k[0], k[1], k[2], k[3]])),
            "SIMPLE_PINHOLE" | "PINHOLE" => Ok(Distortion::None),
            // k4 to k6 are the denominator of FULL_OPENCV only: nerfstudio writes another
            // k4 beside OPENCV.
            "" | "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" => {
                Ok(Distortion::brown([k[0], k[1], k[2], 0.0, 0.0, 0.0], p))
            }
            "FULL_OPENCV" => Ok(Distortion::brown(k, p)),
            "EQUIRECTANGULAR" => Ok(Distortion::Equirectangular),
            _ => Err(format!("`{model}`")),
        }
    }
}

#[derive(Deserialize)]
#[serde(expecting = "an object with frames")]
struct File {
    #[serde(flatten)]
    optics: Optics,
    frames: Vec<FileFrame>,
}

#[derive(Deserialize)]
#[serde(expecting = "a frame: file_path, transform_matrix")]
struct FileFrame {
    file_path: String,
    mask_path: Option<String>,
    #[serde(deserialize_with = "json::rows")]
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    optics: Optics,
}

/// Converts OpenGL camera axes to OpenCV's.
pub(super) fn opengl_to_opencv(pose: DMat4) -> DMat4 {
    pose * DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0))
}

/// Reads a scene. Frames without a picture are left out with a warning.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let expected = "transforms.json (frames with file_path, transform_matrix)";
    let file: File = json::parse(path, &read(path)?, expected)?;
    let drafts = file.frames.into_iter().enumerate().map(|(i, frame)| {
        let name = frame.file_path.clone();
        let place = format!(" frame {i}");
        draft(path, place, frame, &file.optics, reading).unwrap_or_else(|e| Draft::refused(name, e))
    });
    assemble(path, SceneFormat::Transforms, reading, drafts.collect())
}

fn draft(
    path: &Path,
    place: String,
    frame: FileFrame,
    file: &Optics,
    reading: &Reading<'_>,
) -> Result<Draft> {
    let bad = |expected: &str, got: String| Error::format(path, expected, got).at(&place);
    let pose = matrix(&frame.transform_matrix)
        .map_err(|got| bad("transform_matrix of 4x4 numbers", got))?;
    let optics = frame.optics.over(file);
    let distortion = optics.distortion().map_err(|got| {
        bad(
            "camera_model SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, \
             OPENCV_FISHEYE or EQUIRECTANGULAR",
            got,
        )
    })?;
    let size = match (optics.w, optics.h) {
        (Some(w), Some(h)) => match (side(w), side(h)) {
            (Some(w), Some(h)) => Some((w, h)),
            _ => return Err(bad("w and h in whole pixels", format!("{w}x{h}"))),
        },
        _ => None,
    };
    let folder = path.parent().unwrap_or(Path::new(""));
    let image = reading.find(&[folder], &frame.file_path);
    let mask = frame.mask_path.filter(|mask| !mask.is_empty());
    // A name alone would be found among the photographs.
    let found =
        |mask: &str| find_image(&[folder], mask).filter(|file| Some(file) != image.as_ref());
    let mask = mask.map(|mask| found(&mask).unwrap_or(folder.join(mask)));
    // Pixel intrinsics without a size belong to the stored picture.
    let stored = match (&image, size) {
        (_, Some(s)) => Some(s),
        (Some(image), None) => {
            let probe = crate::files::photos::image::probe(image)?;
            Some((probe.width, probe.height))
        }
        (None, None) => None,
    };
    let lens = lens(&optics, &distortion, stored).map_err(|got| {
        bad("fl_x, or camera_angle_x between 0 and π (for the file or the frame)", got)
    })?;
    let pose = reading.pose(pose, PoseConvention::WorldFromCameraOpenGl);
    Ok(Draft {
        image,
        size: stored,
        distortion,
        mask,
        ..Draft::new(place, frame.file_path, lens, pose)
    })
}

/// Computes pixel intrinsics for a picture of `size`. A frame without a size has no picture
/// and is left out later; its intrinsics are not used.
fn lens(
    o: &Optics,
    distortion: &Distortion,
    size: Option<(usize, usize)>,
) -> std::result::Result<Lens, String> {
    let (w, h) = size.map_or((1.0, 1.0), |(w, h)| (w as f64, h as f64));
    // A panorama has no focal length; nerfstudio writes half of its sides.
    if *distortion == Distortion::Equirectangular {
        return Ok(Lens::Pixels(panorama_intrinsics(w, h)));
    }
    let focal = |side: f64, angle: Option<f64>| match angle {
        Some(a) if a > 0.0 && a < std::f64::consts::PI => Ok(Some(0.5 * side / (0.5 * a).tan())),
        Some(a) => Err(format!("an angle of {a}")),
        None => Ok(None),
    };
    let fx = match o.fl_x {
        Some(f) => f,
        None => focal(w, o.camera_angle_x)?.ok_or("neither")?,
    };
    let fy = match (o.fl_y, o.fl_x) {
        (Some(f), _) => f,
        (None, Some(f)) => f,
        (None, None) => focal(h, o.camera_angle_y)?.unwrap_or(fx),
    };
    Ok(Lens::Pixels([fx, fy, o.cx.unwrap_or(0.5 * w), o.cy.unwrap_or(0.5 * h)]))
}
