//! A camera for a scene file that comes without one.

use anyhow::{Context, Result};
use glam::{DMat3, DVec3, Mat3, Mat4, Vec3};
use subsplat::scene::navigation::Bounds;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::Camera;

/// Side of the picture, px.
const SIDE: usize = 512;
/// Horizontal field of view, radians.
const FOV_X: f32 = 0.9;
/// Least correlation of the Gaussians' size with their place that tells the viewing direction. Scenes
/// of two photographs, and one of GlobalSplat's, have 0.45.
const CORRELATION: f64 = 0.2;
/// Least horizontal part of a viewing direction of length 1.
const HORIZONTAL: f32 = 0.3;

/// Bounds of a scene's splats without outliers.
pub fn bounds(splats: &Splats) -> Result<Bounds> {
    Bounds::of(splats.means()).context("the scene has no splat with a finite position")
}

/// A level camera that shows the central 96 % of the means, from the side on which the photographs
/// were taken. `comments`: header of the file, which may state the up direction.
///
/// A photograph's pixel is larger on what is farther away. Gaussians therefore grow with the
/// distance to the photographs' cameras, and the gradient of their size is the viewing direction.
pub fn camera(splats: &Splats, comments: &[String]) -> Result<Camera> {
    let up = up_of_comments(comments);
    // Forward of a file whose up direction is known: the axes of OpenCV, OpenGL and Blender.
    let forward = match up {
        Vec3::Y => Vec3::NEG_Z,
        Vec3::Z => Vec3::Y,
        _ => Vec3::Z,
    };
    let level = |d: Vec3| (d - d.dot(up) * up).try_normalize();
    let grown = growth(splats, &bounds(splats)?).map(|d| d - d.dot(up) * up);
    let direction = grown.filter(|d| d.length() > HORIZONTAL).and_then(level).unwrap_or(forward);
    // Axes of the camera: right, down, forward.
    let world_from_view = Mat3::from_cols((-up).cross(direction), -up, direction);
    let view_from_world = world_from_view.transpose();
    let turned = splats.means().map(|p| (view_from_world * Vec3::from(p)).to_array());
    let bounds = Bounds::of(turned).context("the scene has no splat with a finite position")?;
    let camera = bounds.camera(FOV_X, SIDE)?;
    let pose = Mat4::from_mat3(world_from_view) * camera.world_from_camera();
    Ok(Camera::new(camera.intrinsics(), pose)?)
}

/// The up direction that the first comment about axes states; −y, as photogrammetry programs write
/// files, without one.
fn up_of_comments(comments: &[String]) -> Vec3 {
    match comments.iter().find_map(|c| c.split("up is ").nth(1)) {
        Some("+y") => Vec3::Y,
        Some("+z") => Vec3::Z,
        _ => Vec3::NEG_Y,
    }
}

/// The unit vector along which the Gaussians grow, by linear regression of ln σ on the mean. `None`
/// where their size says little about their place.
fn growth(splats: &Splats, bounds: &Bounds) -> Option<Vec3> {
    let inside = |p: &Vec3| p.cmpge(bounds.low).all() && p.cmple(bounds.high).all();
    let one = |i: usize| {
        let size = splats.scale(i).iter().map(|s| f64::from(*s).ln()).sum::<f64>() / 3.0;
        (Vec3::from(splats.mean(i)), size)
    };
    let all = || (0..splats.len()).map(one).filter(|(p, s)| inside(p) && s.is_finite());
    let count = all().count() as f64;
    let (sum, sizes) = all().fold((DVec3::ZERO, 0.0), |(p, s), (q, t)| (p + q.as_dvec3(), s + t));
    let (centre, mean) = (sum / count, sizes / count);
    let mut spread = DMat3::ZERO;
    let mut along = DVec3::ZERO;
    let mut variance = 0.0;
    for (p, size) in all() {
        let p = p.as_dvec3() - centre;
        let size = size - mean;
        spread += DMat3::from_cols(p * p.x, p * p.y, p * p.z);
        along += p * size;
        variance += size * size;
    }
    // A flat scene has no inverse.
    let gradient = spread.inverse() * along;
    let correlation = (gradient.dot(along) / variance).max(0.0).sqrt();
    (correlation > CORRELATION && gradient.is_finite())
        .then(|| gradient.as_vec3().try_normalize())?
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat_kernels::layout::ShBasis;

    /// Points on a wall 4 units before a camera at the origin that looks along `forward`, and on a
    /// box 2 units before it; σ is a hundredth of the distance.
    fn scene(forward: Vec3, right: Vec3) -> Splats {
        let down = forward.cross(right);
        let mut rows = Vec::new();
        for (distance, count) in [(4.0, 20), (2.0, 8)] {
            for i in 0..count * count {
                let at = |n: usize| (n as f32 / (count - 1) as f32 - 0.5) * 0.2 * count as f32;
                let p = distance * forward + at(i % count) * right + at(i / count) * down;
                rows.extend(p.to_array());
                rows.extend([1.0, 0.0, 0.0, 0.0]);
                rows.extend([0.01 * distance; 3]);
                rows.push(0.9);
            }
        }
        let count = rows.len() / 11;
        Splats::new(rows, vec![0.5; 3 * count], vec![], 0, ShBasis::default()).unwrap()
    }

    #[test]
    fn the_camera_stands_on_the_side_of_the_small_gaussians() {
        let (x, z) = (Vec3::X, Vec3::Z);
        let cases = [
            (z, x, "", Vec3::NEG_Y),
            (-z, -x, "", Vec3::NEG_Y),
            (Vec3::new(0.6, 0.0, -0.8), Vec3::new(-0.8, 0.0, -0.6), "", Vec3::NEG_Y),
            (-z, x, "axes: up is +y", Vec3::Y),
            (Vec3::Y, x, "axes: up is +z", Vec3::Z),
            (-Vec3::Y, -x, "axes: up is +z", Vec3::Z),
        ];
        for (forward, right, comment, up) in cases {
            let camera = camera(&scene(forward, right), &[comment.to_owned()]).unwrap();
            let rotation = camera.rotation();
            assert!(rotation.z_axis.dot(forward) > 0.99, "{forward} {comment}: {rotation}");
            assert!(rotation.y_axis.dot(-up) > 0.99, "{forward} {comment}: {rotation}");
            // It is in front of the box, and sees the corners of the wall.
            assert!(camera.position().dot(forward) < 2.0);
            let corner = 4.0 * forward + 1.8 * right + 1.8 * forward.cross(right);
            let seen = camera.project(corner).unwrap();
            assert!(seen.min_element() > 0.0 && seen.max_element() < SIDE as f32, "{seen}");
        }
    }

    #[test]
    fn without_growth_the_camera_looks_along_the_axes_of_the_file() {
        let mut same = scene(-Vec3::Z, -Vec3::X);
        let mut rows = same.rows().to_vec();
        rows.chunks_exact_mut(11).for_each(|row| row[7..10].fill(0.02));
        same = Splats::new(rows, same.sh().to_vec(), vec![], 0, ShBasis::default()).unwrap();
        for (comment, forward) in [("", Vec3::Z), ("up is +y", Vec3::NEG_Z), ("up is +z", Vec3::Y)]
        {
            let camera = camera(&same, &[comment.to_owned()]).unwrap();
            assert!(camera.rotation().z_axis.dot(forward) > 0.99, "{comment}");
        }
    }
}
