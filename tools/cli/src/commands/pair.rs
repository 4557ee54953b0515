//! The scene of the command line: a scene's path, or photographs with given or estimated cameras.

use super::args::{PairArgs, PoseConventionArg, ReadArgs};
use super::convention::fitting;
use super::frames;
use super::trained::{finished, instead_of_photographs, is_of_training};
use crate::report::{print_line, print_warning};
use anyhow::{Context, Result, bail, ensure};
use glam::{EulerRot, Mat4, Quat, Vec3};
use indicatif::ProgressBar;
use std::path::{Path, PathBuf};
use subsplat::cameras::estimation::{Confidence, PoseOptions, Uncertain};
use subsplat::files::photos::folder::{FolderPhotographs, find_photographs, is_folder_of_masks};
use subsplat::files::photos::image::{LoadOptions, Truncated, probe};
use subsplat::files::photos::photograph::{PhotographHeader, load_photograph, probe_photograph};
use subsplat::files::photos::video::is_video;
use subsplat::files::poses::find::{folders, is_own_output, not_read};
use subsplat::files::poses::matrices::{PoseConvention, parse_intrinsics, parse_matrix};
use subsplat::files::poses::scene::{Scene, SceneFormat, has_scene, load_scene_with};
use subsplat::reconstruct::{KnownLens, Projection};
use subsplat::{EstimateOptions, EstimatedScene, estimate_cameras_of_files};
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Formats whose matrices programs write in several conventions.
const WITH_CONVENTION: [SceneFormat; 6] = [
    SceneFormat::Matrices,
    SceneFormat::Transforms,
    SceneFormat::Polycam,
    SceneFormat::ScannerApp,
    SceneFormat::MvsNet,
    SceneFormat::MatrixFiles,
];

/// End of a line about a file with several pictures.
const FIRST_READ: &str = "is read";

/// A scene, and whether its cameras are an estimate of low confidence.
pub struct Loaded {
    pub scene: Scene,
    pub doubtful: bool,
}

impl From<Scene> for Loaded {
    /// A scene whose cameras are given.
    fn from(scene: Scene) -> Self {
        Self { scene, doubtful: false }
    }
}

/// Loads a scene; or makes one of photographs, with the cameras of `args` or estimated ones. `wanted` are the words of
/// flags that name photographs: words that name none are refused before cameras are estimated.
pub fn load(
    input: &[PathBuf],
    args: &PairArgs,
    wanted: &[(&str, &[String])],
    bar: &ProgressBar,
) -> Result<Loaded> {
    if let ([a, b], true) = (input, args.has_pose()) {
        ensure!(args.lens.is_none(), "--lens: only without --move and --pose-b");
        return of_photographs(a, b, args).map(Loaded::from);
    }
    if let Some(photographs) = photographs(input, &args.read)? {
        if let Some(flag) = args.first_pose_flag() {
            bail!("{flag}: expected two photographs with --move or --pose-b, got neither flag");
        }
        frames::check_words(&photographs, wanted)?;
        let options = EstimateRequest {
            fov: args.fov,
            intrinsics: args.intrinsics.as_deref(),
            force: args.force,
            projection: args.lens.unwrap_or_default(),
            strict: args.read.strict,
        };
        let estimated = estimate(&input[0], &photographs, &options, bar)?;
        bar.suspend(|| print_estimate(&estimated));
        let doubtful = estimated.estimate.confidence == Confidence::Low;
        return Ok(Loaded { scene: estimated.scene, doubtful });
    }
    let [one] = input else {
        bail!("expected photographs, or one scene, got {} paths", input.len())
    };
    if let Some(flag) = args.first_flag() {
        bail!(
            "{flag}: only with photographs; {} has its own cameras, leave the flag out",
            one.display()
        );
    }
    let convention = args.pose_convention.map(PoseConvention::from);
    let options = args.read.options(convention);
    let scene = match load_scene_with(one, &options) {
        Ok(scene) => scene,
        // A training has cameras, and its photographs lie elsewhere.
        Err(error) if is_of_training(one) => {
            return Err(instead_of_photographs(one).unwrap_or_else(|| error.into()));
        }
        Err(error) => return Err(error.into()),
    };
    ensure!(
        convention.is_none() || WITH_CONVENTION.contains(&scene.source),
        "--pose-convention: expected two photographs, or a scene with poses.txt, transforms.json, a \
         matrix file of each picture, or cameras of Polycam, 3D Scanner App or MVSNet, got {} ({})",
        one.display(),
        scene.source.name()
    );
    let may_turn = convention.is_none() && WITH_CONVENTION.contains(&scene.source);
    if may_turn || (convention.is_none() && !scene.other_sources.is_empty()) {
        return fitting(one, scene, &options, may_turn).map(Loaded::from);
    }
    Ok(scene.into())
}

/// The photographs that `input` names: two or more files and folders, or a folder without cameras. `None`
/// for a scene.
///
/// # Errors
/// One photograph; a file among several that is no picture; pictures that `subsplat run` rendered; with
/// `--strict` a picture that cannot be read.
pub fn photographs(input: &[PathBuf], read: &ReadArgs) -> Result<Option<Vec<PathBuf>>> {
    if let Some(folder) = input.iter().find(|path| is_own_output(path)) {
        bail!(
            "{}: expected photographs, got pictures that subsplat rendered; give the photographs, or open \
             the scene with `subsplat view {}`",
            folder.display(),
            folder.join("scene.ply").display()
        );
    }
    if let Some(video) = input.iter().find(|path| is_video(path)) {
        bail!(
            "{0}: expected photographs or a scene, got a video; `subsplat run {0} -o out` makes a scene of its \
             frames, and `subsplat poses {0} -o out` their cameras",
            video.display()
        );
    }
    if let [_] = input
        && read.model_path.is_some()
    {
        return Ok(None);
    }
    let flag = [(read.model_path.is_some(), "--model"), (read.images.is_some(), "--images")];
    let flag = flag.into_iter().find(|f| f.0).map(|f| f.1);
    let no_scene = |input: &Path| match flag {
        Some(flag) => bail!(
            "{flag}: expected one scene with cameras, got photographs alone ({}); leave the flag out",
            input.display()
        ),
        None => Ok(()),
    };
    if let [one] = input {
        if one.is_dir() && !has_scene(one) {
            no_scene(one)?;
            return of_folder(one, read.strict).map(Some);
        }
        let is_picture = one.is_file() && probe(one).is_ok();
        if is_picture {
            ensure_several(one)?;
        }
        ensure!(
            !is_picture,
            "{}: expected a scene or at least two photographs, got one photograph",
            one.display()
        );
        return Ok(None);
    }
    no_scene(&input[0])?;
    let mut all = Vec::with_capacity(input.len());
    for path in input {
        if path.is_dir() {
            if has_scene(path) {
                print_warning(format!(
                    "{}: its cameras are not used: those of photographs of several inputs are estimated together",
                    path.display()
                ));
            }
            let found = find_photographs(path);
            say_left_out(path, &found, read.strict)?;
            ensure!(
                !found.photographs.is_empty(),
                "{}: expected photographs, got none",
                path.display()
            );
            all.extend(found.photographs);
        } else {
            probe(path)?;
            all.push(path.clone());
        }
    }
    Ok(Some(all))
}

/// Refuses the only picture where its file has more than one.
fn ensure_several(path: &Path) -> Result<()> {
    let warnings = load_photograph(path, &LoadOptions::default()).map(|p| p.warnings);
    let several = warnings.unwrap_or_default().into_iter().find(|line| line.ends_with(FIRST_READ));
    several.map_or(Ok(()), |line| {
        bail!("expected at least two photographs, got one file: {line}; save each picture as a file of its own")
    })
}

/// Prints what is left out of a folder's photographs; an error where `strict`.
fn say_left_out(folder: &Path, found: &FolderPhotographs, strict: bool) -> Result<()> {
    if let (true, [[name, reason], ..]) = (strict, found.left_out.as_slice()) {
        bail!(
            "{}: expected no picture that is left out (--strict), got {}: the first is {name} ({reason})",
            folder.display(),
            found.left_out.len()
        );
    }
    found.notes().iter().for_each(|note| print_warning(format!("{}: {note}", folder.display())));
    Ok(())
}

/// The photographs of a folder without cameras, or of the one folder in the two levels below it that has some.
fn of_folder(folder: &Path, strict: bool) -> Result<Vec<PathBuf>> {
    let mut found = find_photographs(folder);
    let mut name = folder.to_owned();
    let mut below: Vec<(PathBuf, FolderPhotographs)> = Vec::new();
    if found.photographs.is_empty() {
        let first = photograph_folders(folder);
        below = with_photographs(&first);
        if below.is_empty() {
            if let Some(scene) = first.iter().find(|folder| has_scene(folder)) {
                let trained = finished(scene).into_iter().find(|found| found.is_dir());
                if let Some(error) = trained.and_then(|found| instead_of_photographs(&found)) {
                    return Err(error);
                }
                bail!(
                    "{}: expected a scene or photographs, got a folder with a scene below it: give {}",
                    folder.display(),
                    scene.display()
                );
            }
            let second: Vec<PathBuf> = first.iter().flat_map(|f| photograph_folders(f)).collect();
            below = with_photographs(&second);
        }
        if below.len() == 1 {
            (name, found) = below.remove(0);
            print_line(format!("the photographs are those of {}", name.display()));
        }
    } else if let Some(note) = beside(folder, &found.photographs) {
        print_warning(note);
    }
    say_left_out(&name, &found, strict)?;
    if let Some(cameras) = not_read(folder) {
        print_warning(cameras);
    }
    let deeper: Vec<String> = below
        .iter()
        .map(|(folder, found)| {
            format!("{} ({} photographs)", folder.display(), found.photographs.len())
        })
        .collect();
    ensure!(
        deeper.is_empty(),
        "{}: expected photographs, got folders of photographs: give one of them, or several if they show one \
         place: {}",
        folder.display(),
        deeper.join(", ")
    );
    if found.photographs.is_empty()
        && let Some(error) = instead_of_photographs(folder)
    {
        return Err(error);
    }
    if let [one] = found.photographs.as_slice() {
        ensure_several(one)?;
    }
    ensure!(
        found.photographs.len() >= 2,
        "{}: expected a scene (cameras.json, transforms.json, a COLMAP model, a RealEstate10K txt, poses.txt \
         with K.txt, or cameras of OpenSfM, Polycam, Record3D, Bundler, LLFF, Metashape, RealityCapture, OpenMVG, \
         Meshroom, 3D Scanner App, MVSNet, NeuS, ScanNet, 7-Scenes, NSVF or NeRF++) or a folder of at least 2 photographs, got {} photograph(s) and no cameras",
        folder.display(),
        found.photographs.len()
    );
    Ok(found.photographs)
}

/// Folders of a folder that may have photographs: no results of an earlier run, no masks.
fn photograph_folders(folder: &Path) -> Vec<PathBuf> {
    let mut all = folders(folder);
    all.retain(|below| !is_own_output(below) && !is_folder_of_masks(below));
    all
}

/// Those of `all` that have photographs, with these.
fn with_photographs(all: &[PathBuf]) -> Vec<(PathBuf, FolderPhotographs)> {
    let found = all.iter().map(|folder| (folder.clone(), find_photographs(folder)));
    found.filter(|(_, found)| !found.photographs.is_empty()).collect()
}

/// A line about pictures in folders of `folder`, whose own `photographs` are used; `None` where there are none.
fn beside(folder: &Path, photographs: &[PathBuf]) -> Option<String> {
    let extension = |path: &Path| path.extension().map(|e| e.to_ascii_lowercase());
    let kinds: Vec<_> = photographs.iter().map(|path| extension(path)).collect();
    let count = |below: &PathBuf| {
        let files = std::fs::read_dir(below).into_iter().flatten().flatten();
        files.filter(|file| kinds.contains(&extension(&file.path()))).count()
    };
    // `images/` of a folder may have the photographs.
    let is_used = |below: &PathBuf| photographs.iter().any(|path| path.starts_with(below));
    let unused = photograph_folders(folder).into_iter().filter(|below| !is_used(below));
    let others: Vec<String> = unused
        .map(|below| (count(&below), below))
        .filter(|(count, _)| *count > 0)
        .map(|(count, below)| format!("{} ({count})", below.display()))
        .collect();
    (!others.is_empty()).then(|| {
        format!(
            "{}: pictures in folders of it are not used: {}; give all folders if they show one place",
            folder.display(),
            others.join(", ")
        )
    })
}

/// Arguments of an estimation of cameras.
pub struct EstimateRequest<'a> {
    /// Horizontal field of view, degrees.
    pub fov: Option<f32>,
    /// Text of `--intrinsics`.
    pub intrinsics: Option<&'a str>,
    /// Accept what would be refused.
    pub force: bool,
    /// Projection of the photographs.
    pub projection: Projection,
    /// Refuse a photograph that would be left out.
    pub strict: bool,
}

/// Estimates the cameras of photographs; `bar` shows the photograph that is read.
pub fn estimate(
    name: &Path,
    photographs: &[PathBuf],
    request: &EstimateRequest<'_>,
    bar: &ProgressBar,
) -> Result<EstimatedScene> {
    let lens = match request.intrinsics {
        Some(text) => Some(KnownLens::Pixels(four(text)?)),
        None => request.fov.map(|fov| KnownLens::FovX(fov.to_radians())),
    };
    let (truncated, uncertain) = if request.force {
        (Truncated::Accept, Uncertain::Accept)
    } else {
        (Truncated::Refuse, Uncertain::Refuse)
    };
    let options = EstimateOptions {
        lens,
        poses: PoseOptions::default().with_uncertain(uncertain),
        load: LoadOptions { truncated },
        projection: request.projection,
        strict: request.strict,
    };
    let wide = matches!(options.projection, Projection::Panorama | Projection::Fisheye(_));
    ensure!(
        !wide || lens.is_none(),
        "--lens: expected no --fov and no --intrinsics beside a panorama or a fisheye lens, whose angle is fixed \
         (give fisheye:DEGREES)"
    );
    let mut show = |i: usize| {
        bar.set_message(format!("photograph {} of {}", i + 1, photographs.len()));
        Ok(())
    };
    let estimated = estimate_cameras_of_files(name, photographs, &options, &mut show)?;
    bar.set_message("");
    Ok(estimated)
}

/// Prints what was estimated.
pub fn print_estimate(estimated: &EstimatedScene) {
    let estimate = &estimated.estimate;
    let placed = estimate.cameras.iter().flatten().count();
    let certain = match estimate.confidence {
        Confidence::High => "reliable",
        Confidence::Low => "DOUBTFUL",
    };
    let about = |degrees: f64| match degrees.is_finite() {
        true => format!("about {degrees:.2}°"),
        false => "unknown".to_owned(),
    };
    print_line(format!(
        "the cameras of {placed} of {} photographs were estimated from {} shared points: {certain} \
         (error of rotations {}, of directions between cameras {}); the unit of length is the median \
         distance of the points",
        estimate.cameras.len(),
        estimate.points.len(),
        about(estimate.rotation_error_deg),
        about(estimate.direction_error_deg),
    ));
    if let Some((camera, source)) =
        estimate.cameras.iter().zip(&estimated.lenses).find_map(|(c, s)| Some(((*c)?, s)))
    {
        let k = camera.intrinsics();
        print_line(format!(
            "focal length {:.1} px at {}x{} ({:.1}° wide), {source}{}",
            k.fx,
            k.width,
            k.height,
            k.fov_x().to_degrees(),
            match estimate.focal.deviation {
                0.0 => String::new(),
                // A lens's distortion and its principal point can change it by far more.
                d => format!(", then adjusted to the points (±{:.1} %)", 100.0 * d),
            }
        ));
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
    /// Returns whether the command line gives the pose of the second of two photographs.
    fn has_pose(&self) -> bool {
        self.translation.is_some() || self.pose_b.is_some()
    }

    /// The first flag that describes a pose.
    fn first_pose_flag(&self) -> Option<&'static str> {
        let flags = [
            (self.translation.is_some(), "--move"),
            (self.turn.is_some(), "--turn"),
            (self.pose_a.is_some(), "--pose-a"),
            (self.pose_b.is_some(), "--pose-b"),
            (self.pose_convention.is_some(), "--pose-convention"),
        ];
        flags.into_iter().find(|f| f.0).map(|f| f.1)
    }

    /// The first of these flags on the command line; each applies to photographs only.
    pub(super) fn first_flag(&self) -> Option<&'static str> {
        let flags = [
            (self.fov.is_some(), "--fov"),
            (self.intrinsics.is_some(), "--intrinsics"),
            (self.lens.is_some(), "--lens"),
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
        None => {
            pose_a * relative(args.translation.unwrap_or_default(), args.turn.unwrap_or_default())
        }
    };
    let camera = |path: &Path, pose: Mat4| -> Result<Camera> {
        // The size of the upright picture: photographs without a pose file are turned upright.
        let header = probe_photograph(path)?;
        let k = intrinsics(args, path, &header)?;
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

/// Intrinsics of a photograph by the flags, else by EXIF.
fn intrinsics(args: &PairArgs, path: &Path, header: &PhotographHeader) -> Result<Intrinsics> {
    let PhotographHeader { width, height, .. } = *header;
    if let Some(text) = &args.intrinsics {
        let [fx, fy, cx, cy] = four(text)?;
        return Ok(Intrinsics { fx, fy, cx, cy, width, height });
    }
    match args.fov {
        Some(fov) => Ok(Intrinsics::from_fov_x(fov.to_radians(), width, height)),
        None => header.intrinsics().with_context(|| {
            format!(
                "{}: EXIF states no focal length: give --fov DEGREES or --intrinsics FX,FY,CX,CY, or \
                 leave out --move and --pose-b to have the cameras estimated",
                path.display()
            )
        }),
    }
}

/// fx, fy, cx, cy of `--intrinsics`, px.
fn four(text: &str) -> Result<[f32; 4]> {
    let k = parse_intrinsics(text).map_err(|got| {
        anyhow::anyhow!("--intrinsics: expected FX,FY,CX,CY in pixels or a 3x3 matrix, got {got}")
    })?;
    Ok(k.map(|v| v as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use subsplat::image::codecs::png::PngEncoder;
    use subsplat::image::{ExtendedColorType, ImageEncoder};

    #[derive(Parser)]
    struct Flags {
        #[command(flatten)]
        pair: PairArgs,
    }

    #[test]
    fn portraits_are_upright() {
        // EXIF orientation 6, big-endian TIFF: the stored picture lies on its side.
        let mut exif = b"MM\0\x2a\0\0\0\x08\0\x01".to_vec();
        exif.extend([0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, 6, 0, 0, 0, 0, 0, 0]);
        let mut png = Vec::new();
        let mut encoder = PngEncoder::new(&mut png);
        encoder.set_exif_metadata(exif).unwrap();
        encoder.write_image(&[9; 8 * 6 * 3], 8, 6, ExtendedColorType::Rgb8).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let paths = ["a.png", "b.png"].map(|n| folder.path().join(n));
        paths.iter().for_each(|p| std::fs::write(p, &png).unwrap());
        let flags = Flags::parse_from(["pair", "--fov", "60", "--move", "1,0,0"]);
        let Loaded { scene, .. } = load(&paths, &flags.pair, &[], &ProgressBar::hidden()).unwrap();
        let (picture, camera) = scene.frames[0].load().unwrap();
        assert_eq!((picture.width, picture.height), (6, 8));
        let k = camera.intrinsics();
        assert_eq!((k.width, k.height, k.cx, k.cy), (6, 8, 3.0, 4.0));
        assert!((k.fov_x().to_degrees() - 60.0).abs() < 1e-3, "{k:?}");
    }
}
