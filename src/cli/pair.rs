//! Two loose photographs and cameras from the command line.

use super::args::{PairArgs, PoseConventionArg};
use anyhow::{Context, Result, bail, ensure};
use glam::{EulerRot, Mat4, Quat, Vec3};
use std::path::{Path, PathBuf};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::io::image::probe;
use subsplat::io::matrices::{PoseConvention, parse_intrinsics, parse_matrix};
use subsplat::io::scene::{Scene, load_scene};

/// The scene that `input` names: a scene's path, or two photographs with the cameras
/// of `args`.
pub fn load(input: &[PathBuf], args: &PairArgs) -> Result<Scene> {
    match input {
        [a, b] => of_photographs(a, b, args),
        [one] => {
            if let Some(flag) = args.given() {
                bail!("{flag}: only with two photographs; {} has its own cameras", one.display());
            }
            let is_picture = one.is_file() && probe(one).is_ok();
            ensure!(
                !is_picture,
                "{}: expected a scene or two photographs, got one photograph",
                one.display()
            );
            Ok(load_scene(one)?)
        }
        _ => bail!("expected a scene or two photographs, got {} paths", input.len()),
    }
}

impl PairArgs {
    /// A flag of these that was given.
    fn given(&self) -> Option<&'static str> {
        let flags = [
            (self.fov.is_some(), "--fov"),
            (self.intrinsics.is_some(), "--intrinsics"),
            (self.translation.is_some(), "--move"),
            (self.turn.is_some(), "--turn"),
            (self.pose_a.is_some(), "--pose-a"),
            (self.pose_b.is_some(), "--pose-b"),
        ];
        flags.into_iter().find(|f| f.0).map(|f| f.1)
    }
}

/// The scene of photographs `a` and `b`.
fn of_photographs(a: &Path, b: &Path, args: &PairArgs) -> Result<Scene> {
    let pose_a = match &args.pose_a {
        Some(text) => pose(text, "--pose-a", args.pose_convention)?,
        None => Mat4::IDENTITY,
    };
    let pose_b = match &args.pose_b {
        Some(text) => pose(text, "--pose-b", args.pose_convention)?,
        None if args.translation.is_none() => bail!(
            "two photographs need to know where the second camera stands: give --move X,Y,Z (and \
             --turn RX,RY,RZ) in the first camera's frame, or --pose-b, or a scene with a pose file"
        ),
        None => {
            pose_a * relative(args.translation.unwrap_or_default(), args.turn.unwrap_or_default())
        }
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
fn relative(translation: [f32; 3], turn: [f32; 3]) -> Mat4 {
    let [x, y, z] = turn.map(f32::to_radians);
    let rotation = Quat::from_euler(EulerRot::XYZ, x, y, z);
    Mat4::from_rotation_translation(rotation, Vec3::from(translation))
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
