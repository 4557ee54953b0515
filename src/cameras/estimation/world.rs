//! The world frame of estimated cameras: which way is up, where the origin is, and the unit.

use super::absolute::Absolute;
use glam::{DMat3, DVec3};

/// Weight of the cameras' own vertical axes against their horizontal axes. Photographs are seldom
/// rolled, but often pitched: the horizontal axes decide unless all of them are parallel.
const VERTICAL_WEIGHT: f64 = 0.01;

/// Returns the direction of gravity in the world of `cameras`: the direction that is perpendicular
/// to the cameras' x axes in the sense of least squares, towards their y axes.
pub(super) fn down(cameras: &[Absolute]) -> DVec3 {
    let mut m = nalgebra::Matrix3::<f64>::zeros();
    let mut mean = DVec3::ZERO;
    for c in cameras {
        // Rows of R are the camera's axes in the world.
        let axes = c.rotation.transpose();
        let vector = |v: DVec3| nalgebra::Vector3::new(v.x, v.y, v.z);
        let (x, y) = (vector(axes.x_axis), vector(axes.y_axis));
        m += x * x.transpose() - y * y.transpose() * VERTICAL_WEIGHT;
        mean += axes.y_axis;
    }
    let eigen = m.symmetric_eigen();
    let at = eigen.eigenvalues.imin();
    let v = eigen.eigenvectors.column(at);
    let v = DVec3::new(v[0], v[1], v[2]).normalize_or(DVec3::Y);
    if v.dot(mean) < 0.0 { -v } else { v }
}

/// Moves cameras and points to a frame with +y down, the first camera at the origin and looking
/// towards +z as far as the horizon allows, and lengths times `scale`.
pub(super) fn upright(cameras: &mut [Absolute], points: &mut [DVec3], scale: f64) {
    let Some(first) = cameras.first().copied() else { return };
    let down = down(cameras);
    let forward = first.rotation.transpose().z_axis;
    let level = (forward - down * forward.dot(down)).normalize_or(down.any_orthonormal_vector());
    // Rows: the new axes in the old world.
    let turn = DMat3::from_cols(down.cross(level), down, level).transpose();
    let origin = first.position();
    for p in points.iter_mut() {
        *p = turn * (*p - origin) * scale;
    }
    for c in cameras.iter_mut() {
        let position = turn * (c.position() - origin) * scale;
        let rotation = c.rotation * turn.transpose();
        *c = Absolute { rotation, translation: -(rotation * position) };
    }
}

#[cfg(test)]
mod tests {
    use super::super::two_view::rotation;
    use super::*;

    /// A camera at yaw and pitch in a world whose down is +y, seen from a world that is turned.
    fn camera(yaw: f64, pitch: f64, tilt: DMat3) -> Absolute {
        let level = rotation(DVec3::X * pitch) * rotation(DVec3::Y * yaw);
        let eye = DVec3::new(yaw, 0.1, 0.5);
        let rotation = level * tilt.transpose();
        Absolute { rotation, translation: -(level * eye) }
    }

    #[test]
    fn level_cameras_stand_upright_whatever_their_pitch() {
        let tilt = rotation(DVec3::new(0.4, -0.2, 0.7));
        for yaws in [[0.0, 0.5, 1.2], [0.0, 0.0, 0.0]] {
            let pitch = if yaws[1] == 0.0 { 0.0 } else { -0.4 };
            let mut cameras = yaws.map(|yaw| camera(yaw, pitch, tilt));
            let before: Vec<DVec3> = cameras.iter().map(Absolute::position).collect();
            let mut points = [tilt * DVec3::new(0.3, 0.2, 4.0)];
            let seen = cameras[1].to_camera(points[0]);
            upright(&mut cameras, &mut points, 2.0);
            for c in &cameras {
                let axes = c.rotation.transpose();
                assert!(axes.x_axis.y.abs() < 1e-2, "{axes}");
                assert!(axes.y_axis.y > 0.9);
            }
            assert!(cameras[0].position().length() < 1e-12);
            assert!((cameras[1].to_camera(points[0]) - 2.0 * seen).length() < 1e-9);
            let distance = cameras[0].position().distance(cameras[2].position());
            assert!((distance - 2.0 * before[0].distance(before[2])).abs() < 1e-9);
        }
    }
}
