//! Two photographs with cameras from the command line.

use super::args::{PairArgs, PoseConventionArg};
use anyhow::{Context, Result, bail, ensure};
use glam::{EulerRot, Mat4, Quat, Vec3};
use std::path::{Path, PathBuf};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::io::image::probe;
use subsplat::io::matrices::{self, PoseConvention, parse_intrinsics, parse_matrix};
use subsplat::io::scene::{Scene, SceneFormat, load_scene};

/// Loads a scene, or makes one of two photographs with the cameras of `args`.
pub fn load(input: &[PathBuf], args: &PairArgs) -> Result<Scene> {
    match input {
        [a, b] => of_photographs(a, b, args),
        [one] => {
            if let Some(flag) = args.first_flag() {
                bail!("{flag}: only with two photographs; {} has its own cameras", one.display());
            }
            let is_picture = one.is_file() && probe(one).is_ok();
            ensure!(
                !is_picture,
                "{}: expected a scene or two photographs, got one photograph",
                one.display()
            );
            let scene = load_scene(one)?;
            let Some(convention) = args.pose_convention else { return Ok(scene) };
            ensure!(
                scene.source == SceneFormat::Matrices,
                "--pose-convention: expected two photographs or a scene with poses.txt, got {} ({})",
                one.display(),
                scene.source.name()
            );
            Ok(matrices::load(folder_of(one), convention.into())?)
        }
        _ => bail!("expected a scene or two photographs, got {} paths", input.len()),
    }
}

/// The folder of a scene, given the folder or its pose file.
pub fn folder_of(scene: &Path) -> &Path {
    let parent = || scene.parent().filter(|p| !p.as_os_str().is_empty());
    if scene.is_dir() { scene } else { parent().unwrap_or(Path::new(".")) }
}

impl From<PoseConventionArg> for PoseConvention {
    fn from(arg: PoseConventionArg) -> Self {
        match arg {
            PoseConventionArg::OpencvC2w => Self::WorldFromCameraOpenCv,
            PoseConventionArg::OpencvW2c => Self::CameraFromWorldOpenCv,
            PoseConventionArg::OpenglC2w => Self::WorldFromCameraOpenGl,
        }
    }
}

impl PairArgs {
    /// The first of these flags on the command line; each applies to photographs only.
    pub(super) fn first_flag(&self) -> Option<&'static str> {
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

/// Makes a scene of photographs `a` and `b`.
fn of_photographs(a: &Path, b: &Path, args: &PairArgs) -> Result<Scene> {
    ensure!(
        args.pose_convention.is_none() || args.pose_a.is_some() || args.pose_b.is_some(),
        "--pose-convention: expected --pose-a or --pose-b beside it, got neither (--move and \
         --turn are in OpenCV axes)"
    );
    let convention = args.pose_convention.map_or(PoseConvention::default(), Into::into);
    let pose_a = match &args.pose_a {
        Some(text) => pose(text, "--pose-a", convention)?,
        None => Mat4::IDENTITY,
    };
    let pose_b = match &args.pose_b {
        Some(text) => pose(text, "--pose-b", convention)?,
        None if args.translation.is_none() => bail!(
            "two photographs need the pose of the second camera: give --move X,Y,Z (and --turn \
             RX,RY,RZ) in the first camera's frame, or --pose-b, or a scene with a pose file"
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

fn pose(text: &str, flag: &str, convention: PoseConvention) -> Result<Mat4> {
    let matrix = parse_matrix(text)
        .map_err(|got| anyhow::anyhow!("{flag}: expected 12 or 16 numbers, got {got}"))?;
    Ok(convention.to_world_from_camera(matrix).as_mat4())
}

/// Computes the pose of the second camera in the first one's frame.
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
