//! Writes COLMAP's text model: `cameras.txt`, `images.txt`, `points3D.txt`.

use crate::files::{Error, Result, write_atomic};
use glam::{Quat, Vec3};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// A point of a sparse reconstruction.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePoint {
    /// Position, world units.
    pub position: Vec3,
    /// Colour, sRGB.
    pub colour: [u8; 3],
    /// Mean distance between observations and projections, px.
    pub error_px: f32,
    /// Index of each image that shows the point, and the position in it, px (pixel centres at
    /// +0.5, as COLMAP has them).
    pub track: Vec<(usize, [f32; 2])>,
}

/// Writes a model that `load_scene` and COLMAP read: one PINHOLE camera for each image. `images`
/// are paths of the pictures, relative to the image folder, with their cameras.
///
/// # Errors
/// A name with white space at its ends or a line break; a point of an image that does not exist;
/// errors of [`write_atomic`]; the folder cannot be created.
pub fn save_colmap(
    folder: impl AsRef<Path>,
    images: &[(String, Camera)],
    points: &[SparsePoint],
) -> Result<()> {
    write_model(folder.as_ref(), images, points)
}

fn write_model(folder: &Path, images: &[(String, Camera)], points: &[SparsePoint]) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    let mut cameras = String::from("# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n");
    let mut poses = String::from(
        "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# X Y POINT3D_ID of each point in it\n",
    );
    let mut sparse =
        String::from("# POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_IDX pairs\n");
    let mut seen: Vec<Vec<(usize, [f32; 2])>> = vec![Vec::new(); images.len()];
    for (i, p) in points.iter().enumerate() {
        let Vec3 { x, y, z } = p.position;
        let [r, g, b] = p.colour;
        let id = i + 1;
        // Writing to a string cannot fail.
        let _ = write!(sparse, "{id} {x} {y} {z} {r} {g} {b} {}", p.error_px);
        for (image, px) in &p.track {
            let Some(list) = seen.get_mut(*image) else {
                let expected = format!("images below {}", images.len());
                return Err(Error::format(folder, expected, format!("a point of image {image}")));
            };
            let _ = write!(sparse, " {} {}", image + 1, list.len());
            list.push((id, *px));
        }
        sparse.push('\n');
    }
    for (i, ((name, camera), seen)) in images.iter().zip(&seen).enumerate() {
        if name.trim() != name || name.is_empty() || name.contains(['\n', '\r']) {
            let expected = "an image name without white space at its ends";
            return Err(Error::format(folder, expected, format!("{name:?}")));
        }
        let id = i + 1;
        let Intrinsics { fx, fy, cx, cy, width, height } = camera.intrinsics();
        let _ = writeln!(cameras, "{id} PINHOLE {width} {height} {fx} {fy} {cx} {cy}");
        let pose = camera.camera_from_world();
        let q = Quat::from_mat4(&pose).normalize();
        let t = pose.w_axis;
        let _ = writeln!(
            poses,
            "{id} {} {} {} {} {} {} {} {id} {name}",
            q.w, q.x, q.y, q.z, t.x, t.y, t.z
        );
        let place = |(point, px): &(usize, [f32; 2])| format!("{} {} {point}", px[0], px[1]);
        poses.push_str(&seen.iter().map(place).collect::<Vec<_>>().join(" "));
        poses.push('\n');
    }
    for (name, text) in [("cameras.txt", cameras), ("images.txt", poses), ("points3D.txt", sparse)]
    {
        write_atomic(folder.join(name), |f| f.write_all(text.as_bytes()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;

    #[test]
    fn a_written_model_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let k = Intrinsics { fx: 30.0, fy: 31.0, cx: 16.0, cy: 12.0, width: 32, height: 24 };
        let poses = [Mat4::IDENTITY, Mat4::from_translation(Vec3::new(1.0, 0.5, -0.25))];
        let turned = Mat4::from_quat(Quat::from_rotation_y(0.3));
        let cameras = [poses[0], poses[1] * turned].map(|p| Camera::new(k, p).unwrap());
        let images: Vec<(String, Camera)> =
            cameras.iter().enumerate().map(|(i, c)| (format!("photo {i}.png"), *c)).collect();
        std::fs::create_dir(folder.path().join("images")).unwrap();
        for (name, _) in &images {
            let path = folder.path().join("images").join(name);
            crate::files::photos::image::save_png(
                &path,
                &crate::scene::pictures::Rgb::black(32, 24),
            )
            .unwrap();
        }
        let point = SparsePoint {
            position: Vec3::new(0.1, 0.2, 3.0),
            colour: [1, 2, 3],
            error_px: 0.25,
            track: vec![(0, [17.0, 14.0]), (1, [7.5, 9.0])],
        };
        save_colmap(folder.path().join("sparse/0"), &images, std::slice::from_ref(&point)).unwrap();
        let scene = crate::files::poses::scene::load_scene(folder.path()).unwrap();
        assert_eq!(scene.points.as_deref(), Some(&[point.position][..]));
        for (frame, camera) in scene.frames.iter().zip(&cameras) {
            assert!(frame.camera.position().distance(camera.position()) < 1e-6);
            assert_eq!(frame.camera.intrinsics(), k);
            assert!((frame.camera.rotation().x_axis - camera.rotation().x_axis).length() < 1e-6);
            assert_eq!(frame.visible, [0]);
        }
        let bad = SparsePoint { track: vec![(2, [0.0; 2])], ..point };
        let error = save_colmap(folder.path(), &images, &[bad]).unwrap_err().to_string();
        assert!(error.contains("image 2"), "{error}");
    }
}
