//! Two loose photographs and cameras from the command line.

use super::args::{PairArgs, PoseConventionArg};
use anyhow::{Context, Result, bail};
use glam::{EulerRot, Mat4, Quat, Vec3};
use std::path::Path;
use subsplat::camera::{Camera, Intrinsics};
use subsplat::io::image::probe;
use subsplat::io::matrices::{PoseConvention, parse_intrinsics, parse_matrix};
use subsplat::io::scene::Scene;

/// The scene of photographs `a` and `b`.
pub fn scene(a: &Path, b: &Path, args: &PairArgs) -> Result<Scene> {
    let pose_a = match &args.pose_a {
        Some(text) => pose(text, "--pose-a", args.pose_convention)?,
        None => Mat4::IDENTITY,
    };
    let pose_b = match &args.pose_b {
        Some(text) => pose(text, "--pose-b", args.pose_convention)?,
        None if args.translation.is_empty() => bail!(
            "two photographs need to know where the second camera stands: give --move X,Y,Z (and \
             --turn RX,RY,RZ) in the first camera's frame, or --pose-b, or a scene with a pose file"
        ),
        None => pose_a * relative(&args.translation, &args.turn),
    };
    let camera = |path: &Path, pose: Mat4| -> Result<Camera> {
        let size = probe(path)?;
        let k = intrinsics(args, size.width, size.height)?;
        Camera::new(k, pose).with_context(|| format!("camera of {}", path.display()))
    };
    Ok(Scene::from_pair(a, b, camera(a, pose_a)?, camera(b, pose_b)?)?)
}

fn pose(text: &str, flag: &str, convention: PoseConventionArg) -> Result<Mat4> {
    let matrix = parse_matrix(text)
        .map_err(|got| anyhow::anyhow!("{flag}: expected 12 or 16 numbers, got {got}"))?;
    let convention = match convention {
        PoseConventionArg::OpencvC2w => PoseConvention::WorldFromCameraOpenCv,
        PoseConventionArg::OpencvW2c => PoseConvention::CameraFromWorldOpenCv,
        PoseConventionArg::OpenglC2w => PoseConvention::WorldFromCameraOpenGl,
    };
    Ok(convention.to_world_from_camera(matrix).as_mat4())
}

/// Pose of the second camera in the first one's frame.
fn relative(translation: &[f32], turn: &[f32]) -> Mat4 {
    let angle = |i: usize| turn.get(i).copied().unwrap_or(0.0).to_radians();
    let at = |i: usize| translation.get(i).copied().unwrap_or(0.0);
    let rotation = Quat::from_euler(EulerRot::XYZ, angle(0), angle(1), angle(2));
    Mat4::from_rotation_translation(rotation, Vec3::new(at(0), at(1), at(2)))
}

fn intrinsics(args: &PairArgs, width: usize, height: usize) -> Result<Intrinsics> {
    if let Some(text) = &args.intrinsics {
        let k = parse_intrinsics(text).map_err(|got| {
            anyhow::anyhow!(
                "--intrinsics: expected FX,FY,CX,CY in pixels or a 3x3 matrix, got {got}"
            )
        })?;
        let [fx, fy, cx, cy] = k.map(|v| v as f32);
        return Ok(Intrinsics { fx, fy, cx, cy, width, height });
    }
    match args.fov {
        Some(fov) if fov > 0.0 && fov < 180.0 => {
            Ok(Intrinsics::from_fov_x(fov.to_radians(), width, height))
        }
        Some(fov) => bail!("--fov: expected above 0 and below 180 degrees, got {fov}"),
        None => bail!(
            "two photographs need their field of view: give --fov DEGREES or --intrinsics \
             FX,FY,CX,CY, or a scene with a pose file"
        ),
    }
}
