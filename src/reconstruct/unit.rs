//! The unit of length in which a scene is reconstructed. The network and the kernels have constants in
//! world units, such as the nearest plane of a picture and floors of a thousandth; a scene in kilometres or
//! in millimetres is therefore reconstructed in another unit. Factors are powers of two, so that cameras keep
//! every bit.

use super::{DepthBounds, DepthRange, DepthSource, Error, Result};
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::splats::Splats;
use std::ops::RangeInclusive;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{MEAN_OFFSET, OPACITY_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};

/// Near planes of scenes that keep their unit: from a close-up in metres to a valley in metres.
const KEPT: RangeInclusive<f32> = 0.004..=250.0;
/// log₂ of the factor between two units.
const STEP: f32 = 10.0;

/// World units of one unit of the reconstruction, for a scene whose nearest depth is `near`, world units.
pub(super) fn unit_of(near: f32) -> f32 {
    if KEPT.contains(&near) || !(near > 0.0 && near.is_finite()) {
        return 1.0;
    }
    (STEP * (near.log2() / STEP).round()).exp2()
}

/// Multiplies the positions of the cameras by `factor`.
///
/// # Errors
/// A position that is then not finite.
pub(super) fn scale_cameras(inputs: &mut [Cropped], factor: f32) -> Result<()> {
    if factor == 1.0 {
        return Ok(());
    }
    let scaled = |camera: &Camera| {
        let mut pose = camera.world_from_camera();
        pose.w_axis = (pose.w_axis.truncate() * factor).extend(1.0);
        Camera::new(camera.intrinsics(), pose).map_err(|e| {
            Error::argument("unit of length", "cameras of finite positions", e.to_string())
        })
    };
    for input in inputs {
        input.input_camera = scaled(&input.input_camera)?;
        input.target_camera = scaled(&input.target_camera)?;
    }
    Ok(())
}

/// Multiplies a depth range by `factor`.
pub(super) fn scaled(bounds: DepthBounds, factor: f32) -> DepthBounds {
    let DepthBounds { near, far, source } = bounds;
    DepthBounds { near: near * factor, far: far * factor, source: scaled_source(source, factor) }
}

fn scaled_source(source: DepthSource, factor: f32) -> DepthSource {
    let inner = |source: Box<DepthSource>| Box::new(scaled_source(*source, factor));
    match source {
        DepthSource::Baseline { distance } => DepthSource::Baseline { distance: distance * factor },
        DepthSource::Estimated { from } => DepthSource::Estimated { from: inner(from) },
        DepthSource::FixedNear { far } => DepthSource::FixedNear { far: inner(far) },
        DepthSource::FixedFar { near } => DepthSource::FixedFar { near: inner(near) },
        other => other,
    }
}

/// Multiplies the ends that a caller fixed by `factor`.
pub(super) fn scaled_range(range: DepthRange, factor: f32) -> DepthRange {
    match range {
        DepthRange::Auto => DepthRange::Auto,
        DepthRange::Fixed { near, far } => {
            DepthRange::Fixed { near: near * factor, far: far * factor }
        }
        DepthRange::Near(near) => DepthRange::Near(near * factor),
        DepthRange::Far(far) => DepthRange::Far(far * factor),
    }
}

/// Multiplies means and σ by `factor`.
pub(super) fn scale_splats(splats: &mut Splats, factor: f32) {
    for row in splats.rows.chunks_exact_mut(SPLAT_STRIDE) {
        let (means, scales) = (MEAN_OFFSET..MEAN_OFFSET + 3, SCALE_OFFSET..OPACITY_OFFSET);
        means.chain(scales).for_each(|i| row[i] *= factor);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ordinary_scenes_keep_their_unit() {
        for near in [0.004, 0.4, 1.0, 250.0, 0.0, f32::NAN, f32::INFINITY] {
            assert_eq!(unit_of(near), 1.0, "{near}");
        }
        // Millimetres, kilometres, micrometres.
        assert_eq!(unit_of(400.0), 1024.0);
        assert_eq!(unit_of(0.0004), 1.0 / 1024.0);
        assert_eq!(unit_of(4e5), 1024.0 * 1024.0);
        for near in [1e-20f32, 1e20] {
            let unit = unit_of(near);
            assert!((0.02..40.0).contains(&(near / unit)), "{near} {unit}");
        }
    }
}
