//! Rotations of pose files: rounding is undone, a common scale is divided out, and mirrored worlds are refused.

use super::assemble::Draft;
use crate::files::{Error, Result};
use glam::{DMat3, DMat4};
use std::path::Path;
use subsplat_kernels::camera::Camera;

/// A pose after [`orthonormal`].
pub(super) struct OrthonormalPose {
    /// The corrected pose.
    pub pose: DMat4,
    /// Largest entry of |RᵀR − I| before the correction.
    pub error: f64,
}

/// Replaces the rotation by the nearest orthonormal one, to undo rounding in the file. The
/// pose stays as it is where [`Camera::new`] would refuse it, and where the error is below
/// the precision of f32.
pub(super) fn orthonormal(pose: DMat4) -> OrthonormalPose {
    let mut rotation = DMat3::from_mat4(pose);
    let error = skew(rotation);
    if !(2e-6..=f64::from(Camera::RIGID_TOLERANCE)).contains(&error) {
        return OrthonormalPose { pose, error };
    }
    // Newton's iteration for the polar decomposition converges quadratically; the start is
    // within 1 %.
    for _ in 0..6 {
        rotation = (rotation + rotation.inverse().transpose()) * 0.5;
    }
    OrthonormalPose { pose: with_rotation(pose, rotation), error }
}

/// Largest entry of |RᵀR − I|.
fn skew(r: DMat3) -> f64 {
    let gram = r.transpose() * r - DMat3::IDENTITY;
    gram.to_cols_array().into_iter().fold(0.0f64, |m, v| m.max(v.abs()))
}

fn with_rotation(pose: DMat4, rotation: DMat3) -> DMat4 {
    let column = |v: glam::DVec3| v.extend(0.0);
    DMat4::from_cols(
        column(rotation.x_axis),
        column(rotation.y_axis),
        column(rotation.z_axis),
        pose.w_axis,
    )
}

/// The uniform scale s of a rotation, RᵀR = s²·I; `None` for another matrix.
fn uniform_scale(pose: DMat4) -> Option<f64> {
    let r = DMat3::from_mat4(pose);
    let gram = r.transpose() * r;
    let scale = ((gram.x_axis.x + gram.y_axis.y + gram.z_axis.z) / 3.0).sqrt();
    let is_scale =
        scale.is_normal() && skew(r * scale.recip()) <= f64::from(Camera::RIGID_TOLERANCE);
    is_scale.then_some(scale)
}

/// Refuses a mirrored world, and divides out the uniform scale that all rotations share. Positions stay: the file
/// has them in one unit. Returns a line about the scale.
///
/// # Errors
/// All rotations have the determinant −1.
pub(super) fn of_one_world(path: &Path, drafts: &mut [Draft]) -> Result<Option<String>> {
    let placed = || drafts.iter().filter(|draft| draft.refused.is_none());
    let scales: Option<Vec<f64>> = placed().map(|d| uniform_scale(d.world_from_camera)).collect();
    let scales = scales.unwrap_or_default();
    let Some(&first) = scales.first().filter(|_| scales.len() > 1) else { return Ok(None) };
    if placed().all(|draft| draft.world_from_camera.determinant() < 0.0) {
        let expected = "cameras of a right-handed world";
        let got = format!(
            "{} matrices that mirror (a left-handed world, as Unity and Unreal have it): export the cameras in \
             right-handed axes, or negate one axis of the world, which is one of the first three rows of each \
             camera-to-world matrix",
            scales.len()
        );
        return Err(Error::format(path, expected, got));
    }
    let tolerance = f64::from(Camera::RIGID_TOLERANCE);
    let shared = scales.iter().all(|scale| (scale / first - 1.0).abs() <= tolerance);
    // A scale within the tolerance is rounding, which `orthonormal` undoes.
    let is_rounding = scales.iter().any(|scale| (scale * scale - 1.0).abs() <= tolerance);
    if !shared || is_rounding {
        return Ok(None);
    }
    let placed = drafts.iter_mut().filter(|draft| draft.refused.is_none());
    for (draft, scale) in placed.zip(&scales) {
        let rotation = DMat3::from_mat4(draft.world_from_camera) * scale.recip();
        draft.world_from_camera = with_rotation(draft.world_from_camera, rotation);
    }
    Ok(Some(format!(
        "the rotations of all {} matrices have a scale of {first:.6}: it is divided out of them, and the positions \
         stay as they are",
        scales.len()
    )))
}
