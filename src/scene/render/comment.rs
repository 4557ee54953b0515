//! Rasterizer options and cameras as comments of a scene file.
//!
//! A .ply or .glb file does not state which rules its Gaussians were made for, nor from where they
//! are to be seen. Convention, near plane, low-pass and background therefore travel as one comment
//! line, the camera of the first photograph as another, and each photograph's name and camera as one more.

use glam::{DVec3, Mat4};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{Convention, RasterOptions};

/// First words of the comment.
const PREFIX: &str = "subsplat render:";

/// Formats `options` as a comment for a scene file; [`options_of_comments`] reads it.
pub fn comment_of_options(options: &RasterOptions) -> String {
    let convention = match options.convention {
        Convention::Standard => "standard",
        Convention::Mvsplat => "mvsplat",
    };
    let [r, g, b] = options.background;
    format!(
        "{PREFIX} convention={convention} near={} lowpass={} background={r},{g},{b}",
        options.near, options.lowpass
    )
}

/// First words of the comment of a camera.
const CAMERA_PREFIX: &str = "subsplat camera:";

/// First words of the comment of a photograph.
const PHOTOGRAPH_PREFIX: &str = "subsplat photograph:";

/// Formats `camera` as a comment for a scene file; [`camera_of_comments`] reads it.
pub fn comment_of_camera(camera: &Camera) -> String {
    format!("{CAMERA_PREFIX} {}", text_of_camera(camera))
}

/// Formats the name and the camera of a photograph that a scene was made from as a comment for a scene
/// file; [`photographs_of_comments`] reads it. Control characters of the name become spaces.
pub fn comment_of_photograph(name: &str, camera: &Camera) -> String {
    let name = name.replace(char::is_control, " ");
    format!("{PHOTOGRAPH_PREFIX} {} name={name}", text_of_camera(camera))
}

fn text_of_camera(camera: &Camera) -> String {
    let k = camera.intrinsics();
    let pose = camera.world_from_camera().transpose().to_cols_array();
    let pose: Vec<String> = pose[..12].iter().map(f32::to_string).collect();
    format!(
        "size={},{} focal={},{} centre={},{} c2w={}",
        k.width,
        k.height,
        k.fx,
        k.fy,
        k.cx,
        k.cy,
        pose.join(",")
    )
}

/// Reads the camera of a file's comments; `None` where no comment holds a valid one.
pub fn camera_of_comments(comments: &[String]) -> Option<Camera> {
    camera_of_text(comments.iter().find_map(|c| c.trim().strip_prefix(CAMERA_PREFIX))?)
}

/// Reads names and cameras of the photographs in a file's comments, without those that are invalid.
pub fn photographs_of_comments(comments: &[String]) -> Vec<(String, Camera)> {
    let texts = comments.iter().filter_map(|c| c.trim().strip_prefix(PHOTOGRAPH_PREFIX));
    let photograph = |text: &str| {
        let (camera, name) = text.split_once(" name=")?;
        Some((name.to_owned(), camera_of_text(camera)?))
    };
    texts.filter_map(photograph).collect()
}

fn camera_of_text(text: &str) -> Option<Camera> {
    let value = |key: &str| text.split_whitespace().find_map(|w| w.strip_prefix(key));
    let numbers = |key: &str| {
        let all = value(key)?.split(',').map(str::parse::<f32>).collect::<Result<Vec<_>, _>>();
        all.ok().filter(|all| all.iter().all(|v| v.is_finite()))
    };
    let mut size = value("size=")?.split(',').map(|side| side.parse::<usize>().ok());
    let (width, height) = (size.next()??, size.next()??);
    let [fx, fy] = <[f32; 2]>::try_from(numbers("focal=")?).ok()?;
    let [cx, cy] = <[f32; 2]>::try_from(numbers("centre=")?).ok()?;
    let rows = <[f32; 12]>::try_from(numbers("c2w=")?).ok()?;
    let mut pose = [0.0; 16];
    pose[..12].copy_from_slice(&rows);
    pose[15] = 1.0;
    let pose = Mat4::from_cols_array(&pose).transpose();
    Camera::new(Intrinsics { fx, fy, cx, cy, width, height }, pose).ok()
}

/// First words of the comment of an origin.
const ORIGIN_PREFIX: &str = "subsplat origin:";

/// Formats the point of another world that is the origin of a file's coordinates
/// ([`Scene::origin`](crate::files::poses::scene::Scene::origin)), as a comment for a scene file;
/// [`origin_of_comments`] reads it. `None` for the same world.
pub fn comment_of_origin(origin: DVec3) -> Option<String> {
    let DVec3 { x, y, z } = origin;
    (origin != DVec3::ZERO).then(|| format!("{ORIGIN_PREFIX} {x},{y},{z}"))
}

/// Reads the origin of a file's comments; zero where no comment holds one.
pub fn origin_of_comments(comments: &[String]) -> DVec3 {
    let text = comments.iter().find_map(|c| c.trim().strip_prefix(ORIGIN_PREFIX));
    let numbers = text.map(|text| text.trim().split(',').map(str::parse::<f64>));
    let numbers = numbers.and_then(|all| all.collect::<Result<Vec<_>, _>>().ok());
    let origin = numbers.and_then(|all| Some(DVec3::from(<[f64; 3]>::try_from(all).ok()?)));
    origin.filter(|origin| origin.is_finite()).unwrap_or_default()
}

/// Leaves out comments that hold in a file's own axes only.
pub fn comments_without_camera(comments: &[String]) -> Vec<String> {
    let prefixes = [CAMERA_PREFIX, PHOTOGRAPH_PREFIX, ORIGIN_PREFIX];
    let of_axes = |c: &str| prefixes.iter().any(|prefix| c.starts_with(prefix));
    comments.iter().filter(|c| !of_axes(c.trim())).cloned().collect()
}

/// Reads convention, near plane, low-pass and background from a file's comments; `None` where
/// no comment holds valid ones.
pub fn options_of_comments(comments: &[String]) -> Option<RasterOptions> {
    let text = comments.iter().find_map(|c| c.trim().strip_prefix(PREFIX))?;
    let value = |key: &str| text.split_whitespace().find_map(|w| w.strip_prefix(key));
    let number = |key: &str| value(key)?.parse::<f32>().ok().filter(|v| v.is_finite());
    let convention = match value("convention=")? {
        "standard" => Convention::Standard,
        "mvsplat" => Convention::Mvsplat,
        _ => return None,
    };
    let near = number("near=").filter(|v| *v > 0.0)?;
    let lowpass = number("lowpass=").filter(|v| *v >= 0.0)?;
    let mut options = RasterOptions { near, lowpass, ..RasterOptions::new(convention) };
    // Files of earlier versions have no background.
    let channels = value("background=").map(|v| v.split(',').map(str::parse::<f32>));
    if let Some(Ok(rgb)) = channels.map(|all| all.collect::<Result<Vec<_>, _>>())
        && let Ok(rgb) = <[f32; 3]>::try_from(rgb)
        && rgb.iter().all(|v| (0.0..=1.0).contains(v))
    {
        options.background = rgb;
    }
    Some(options)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_comment_restores_the_origin() {
        let origin = DVec3::new(691_234.0, 5_411_933.0, -0.5);
        let comments = ["up is -y".to_owned(), comment_of_origin(origin).unwrap()];
        assert_eq!(origin_of_comments(&comments), origin);
        assert_eq!(comment_of_origin(DVec3::ZERO), None);
        for bad in
            ["", "subsplat origin: 1,2", "subsplat origin: 1,2,nan", "subsplat origin: a,b,c"]
        {
            assert_eq!(origin_of_comments(&[bad.to_owned()]), DVec3::ZERO, "{bad}");
        }
    }

    #[test]
    fn a_comment_restores_the_options() {
        for (convention, near, lowpass) in
            [(Convention::Standard, 0.01f32, 0.3f32), (Convention::Mvsplat, 1.25, 1.2)]
        {
            let background = [near.min(1.0), 0.25, 0.0];
            let plain = RasterOptions::new(convention);
            let options = RasterOptions { near, lowpass, background, ..plain };
            let comments = ["up is -y".to_owned(), comment_of_options(&options)];
            assert_eq!(options_of_comments(&comments), Some(options));
        }
        for bad in [
            "",
            "convention=gsplat near=1 lowpass=0.3",
            "convention=standard near=-1 lowpass=0.3",
            "convention=standard near=1 lowpass=nan",
            "near=1 lowpass=0.3",
        ] {
            assert_eq!(options_of_comments(&[format!("{PREFIX} {bad}")]), None, "{bad}");
        }
    }

    #[test]
    fn a_comment_restores_a_camera() {
        let k = Intrinsics { fx: 300.1, fy: 299.7, cx: 127.3, cy: 90.2, width: 256, height: 192 };
        let pose = Mat4::from_rotation_translation(
            glam::Quat::from_euler(glam::EulerRot::XYZ, 0.3, -1.7, 0.05),
            glam::Vec3::new(0.1, -2.7, 1e-3),
        );
        let camera = Camera::new(k, pose).unwrap();
        let comments = ["up is -y".to_owned(), comment_of_camera(&camera)];
        assert_eq!(camera_of_comments(&comments), Some(camera));
        assert_eq!(comments_without_camera(&comments), ["up is -y"]);
        // Names of photographs have spaces, and the first camera is no photograph's.
        let photograph = comment_of_photograph("a name=b c\n.jpg", &camera);
        let comments = [photograph, "subsplat photograph: size=1".to_owned()];
        assert_eq!(photographs_of_comments(&comments), [("a name=b c .jpg".to_owned(), camera)]);
        assert_eq!(camera_of_comments(&comments), None);
        assert!(comments_without_camera(&comments).is_empty());
        let good = comment_of_camera(&camera);
        for (from, to) in [
            ("size=256,192", "size=256"),
            ("size=256,192", "size=0,192"),
            ("focal=300.1", "focal=nan"),
            ("centre=", "center="),
            ("c2w=", "c2w=1,"),
            ("c2w=", "c2w=5"),
        ] {
            let bad = good.replace(from, to);
            assert_ne!(bad, good);
            assert_eq!(camera_of_comments(std::slice::from_ref(&bad)), None, "{bad}");
        }
    }
}
