//! Command-line arguments. Their documentation is the program's manual.

#[cfg(feature = "view")]
use super::args_view::{KEYS, ViewArgs};
use super::values;
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;
use subsplat::{Density, FitOptions, InputSize, Refine, Size, TargetSize};

/// Exit codes, which scripts rely on.
const EXIT_CODES: &str = "\
Exit codes: 0 success; 1 an error, one line on stderr; 2 wrong usage; 3 a negative answer (check:
bad poses; photographs that do not determine their cameras).

--json: one object and nothing else on stdout; {\"error\": ...} with exit codes 1 and 2.";

/// Photographs in, 3D Gaussians and sharper new views out.
///
/// Conventions everywhere: camera axes are OpenCV's (+x right, +y down, +z
/// forward), poses are camera-to-world, pixel centres lie at +0.5. Readers convert
/// from each format's own convention.
#[derive(Debug, Parser)]
#[command(name = "subsplat", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Cli {
    /// The command.
    #[command(subcommand)]
    pub command: Command,
    /// Print one JSON object on stdout; everything else goes to stderr.
    #[arg(long, global = true)]
    pub json: bool,
    /// Worker threads (default: RAYON_NUM_THREADS, else one per core). The result does not
    /// depend on it.
    #[arg(long, global = true, value_name = "N", value_parser = values::threads)]
    pub threads: Option<usize>,
}

/// The program's commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Reconstruct a scene from two photographs, render views, write all outputs.
    Run(Box<RunArgs>),
    /// Render a finished scene (.ply, .splat, .spz, .ksplat, .glb).
    Render(RenderArgs),
    /// Write a finished scene in another format: one .html file that shows it, .ply, .glb, .spz,
    /// .splat.
    Export(ExportArgs),
    /// Show a scene in a window: a finished one, or photographs.
    #[cfg(feature = "view")]
    #[command(after_help = KEYS)]
    View(Box<ViewArgs>),
    /// Show a scene in a window: only in builds with the feature `view`.
    #[cfg(not(feature = "view"))]
    View(NoViewArgs),
    /// Estimate the cameras of photographs: poses, focal length, sparse points.
    Poses(PosesArgs),
    /// Check poses and intrinsics by points matched between the photographs.
    Check(CheckArgs),
    /// Describe a file or a scene folder.
    Info(InfoArgs),
}

impl Command {
    /// The conflict between two arguments that need no file, if there is one.
    pub fn conflict(&self) -> Option<String> {
        match self {
            Self::Run(args) => {
                let targets = args.path == PathArg::Targets || args.target.is_empty();
                let conflict = || Some("--target: only with --path targets".to_owned());
                let source = &args.source;
                values::depth_conflict(source.near, source.far)
                    .or_else(|| radius_conflict(args.path, &args.motion))
                    .or_else(|| if targets { None } else { conflict() })
            }
            #[cfg(feature = "view")]
            Self::View(args) => args.conflict(),
            Self::Render(args) => radius_conflict(args.path, &args.motion),
            _ => None,
        }
    }
}

impl Command {
    /// Returns whether the command may open a GPU.
    pub fn uses_gpu(&self) -> bool {
        let named = |device: &str| !device.eq_ignore_ascii_case("cpu");
        match self {
            Self::Run(args) => named(&args.rendering.device),
            Self::Render(args) => named(&args.rendering.device),
            Self::View(_) => cfg!(feature = "view"),
            _ => false,
        }
    }
}

/// The conflict of `--orbit-radius` with a path without one.
fn radius_conflict(path: PathArg, motion: &MotionArgs) -> Option<String> {
    (motion.orbit_radius.is_some() && path.closed().is_none())
        .then(|| "--orbit-radius: only with --path orbit, spiral or dolly".to_owned())
}

/// The rules of a rasterizer.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum ConventionArg {
    /// 3DGS and gsplat.
    Standard,
    /// The rasterizer that MVSplat's public weights were trained with.
    Mvsplat,
}

impl From<ConventionArg> for subsplat_kernels::layout::Convention {
    fn from(arg: ConventionArg) -> Self {
        match arg {
            ConventionArg::Standard => Self::Standard,
            ConventionArg::Mvsplat => Self::Mvsplat,
        }
    }
}

/// Form of the modules that SubSplat adds to the backbone.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum PresetArg {
    /// The paper's equations as written.
    Paper,
    /// The same with the corrections listed in ARCHITECTURE.md: for weights that were not
    /// trained together with SubSplat.
    Tuned,
}

impl From<PresetArg> for subsplat::network::config::Preset {
    fn from(arg: PresetArg) -> Self {
        match arg {
            PresetArg::Paper => Self::Paper,
            PresetArg::Tuned => Self::Tuned,
        }
    }
}

/// The network that predicts the primary Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackboneArg {
    /// MVSplat (12 M parameters).
    Re10k,
    /// This project's own light network.
    Small,
}

/// Source of colour detail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DetailArg {
    /// Colours from the network alone.
    Off,
    /// Photographs that are larger than the input add detail to each child's colour.
    Photo,
}

/// Part of the photographs that the network reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CropShapeArg {
    /// The photographs' own shape, but for the rounding of the input's sides.
    Whole,
    /// The middle square, as in the evaluation protocol and in `eval`.
    Square,
}

/// Size of the network's input, by purpose. Times and memory are relative to `normal`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum QualityArg {
    /// As --input-size 192: half of the time.
    Fast,
    /// As --input-size 256: the default.
    Normal,
    /// Up to --input-size 512, less where the photographs or the memory are smaller: four times
    /// the time, three times the memory. Sharper, and 1 to 3 dB better at the photographs' own
    /// cameras; new views gain up to 1 dB where the photographs overlap well and lose up to 2.5 dB
    /// where they do not.
    High,
}

impl QualityArg {
    /// Pixels of the input, as many as the network can use.
    pub fn area(self) -> usize {
        match self {
            Self::Fast => 192 * 192,
            Self::Normal => 256 * 256,
            Self::High => 512 * 512,
        }
    }
}

/// Size of the network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputSizeArg {
    /// Side of the square of the same area, px.
    Side(usize),
    /// Width and height, px.
    Sides(usize, usize),
}

impl RunArgs {
    /// Size of the pictures: --size, else --upscale times the input.
    pub fn target_size(&self) -> TargetSize {
        match self.size {
            Some((width, height)) => TargetSize::Exact(Size::new(width, height)),
            None => self.source.target_size(),
        }
    }
}

impl SourceArgs {
    /// Side of the children's grid that --upscale names.
    pub fn children_side(&self) -> Option<usize> {
        self.upscale.map(|r| r.ceil() as usize)
    }

    /// Size of the target pictures that --upscale names.
    pub fn target_size(&self) -> TargetSize {
        match self.upscale {
            Some(r) if r.fract() > 0.0 => TargetSize::Times(r),
            _ => TargetSize::Upscaled,
        }
    }

    /// Size of the network's input that --input-size and --crop name.
    pub fn input_size(&self) -> InputSize {
        match (self.input_size, self.crop) {
            (InputSizeArg::Side(side), CropShapeArg::Whole) => InputSize::Area(side * side),
            (InputSizeArg::Side(side), CropShapeArg::Square) => InputSize::exact(side, side),
            (InputSizeArg::Sides(width, height), _) => InputSize::exact(width, height),
        }
    }
}

/// The picture whose pixels are the unit of the low-pass.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum LowpassArg {
    /// The rendered picture's (3DGS).
    Target,
    /// The network input's.
    Input,
}

/// Cameras to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PathArg {
    /// The target frames (of `--target`, protocol.json, or between the contexts).
    Targets,
    /// From the first context camera to the last.
    Interpolate,
    /// A circle around the middle of the context cameras (--orbit-radius).
    Orbit,
    /// Two turns whose width and distance change.
    Spiral,
    /// Towards the scene and back.
    Dolly,
}

impl PathArg {
    /// The closed path around the cameras that this is, if it is one.
    pub fn closed(self) -> Option<super::frames::Loop> {
        use super::frames::Loop;
        match self {
            Self::Targets | Self::Interpolate => None,
            Self::Orbit => Some(Loop::Orbit),
            Self::Spiral => Some(Loop::Spiral),
            Self::Dolly => Some(Loop::Dolly),
        }
    }
}

/// Length, radius and animation of a path.
#[derive(Debug, Args)]
pub struct MotionArgs {
    /// Number of views of a path (default: 30; `run` without targets and without --path: 3).
    #[arg(long, value_name = "N", value_parser = values::frames)]
    pub frames: Option<usize>,
    /// Radius of `--path orbit`, `spiral` and `dolly`, world units. Default: near points move
    /// against far ones by 6 % of the picture's width, or half the distance between the cameras.
    #[arg(long, value_name = "R", allow_negative_numbers = true, value_parser = values::positive)]
    pub orbit_radius: Option<f32>,
    /// The views as an animation too: .gif and .webp are written without another program, .mp4
    /// and .webm by ffmpeg, which must be installed.
    #[arg(long, value_name = "FILE")]
    pub video: Option<PathBuf>,
    /// Frames a second of --video.
    #[arg(long, default_value_t = 25, value_name = "N", value_parser = values::rate)]
    pub fps: u32,
}

/// Number of views of a path that is asked for.
pub const PATH_FRAMES: usize = 30;

/// Formats of the reconstructed scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SceneFormatArg {
    /// INRIA's layout, SH degree 3: what viewers read.
    Ply,
    /// glTF with KHR_gaussian_splatting.
    Glb,
    /// 32 bytes a Gaussian, no view-dependent colour.
    Splat,
    /// Niantic's compressed format, version 3.
    Spz,
    /// One page that shows the scene in any browser, without a network.
    Html,
}

impl SceneFormatArg {
    /// Name of the file in the output folder of `run`.
    pub fn file_name(self) -> &'static str {
        match self {
            Self::Ply => "scene.ply",
            Self::Glb => "scene.glb",
            Self::Splat => "scene.splat",
            Self::Spz => "scene.spz",
            Self::Html => "scene.html",
        }
    }
}

/// Content of a scene file.
#[derive(Clone, Copy, Debug, Args)]
pub struct ContentArgs {
    /// Highest SH degree of the scene files (default 3). A .ply holds 0, 9, 24 or 45 `f_rest` values
    /// accordingly; readers expect 45.
    #[arg(long, value_name = "0…3", value_parser = values::file_sh_degree)]
    pub sh: Option<usize>,
    /// Leave Gaussians of less opacity out of the scene files.
    #[arg(
        long,
        default_value_t = 0.0,
        value_name = "ALPHA",
        allow_negative_numbers = true,
        value_parser = values::opacity
    )]
    pub min_opacity: f32,
}

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Photographs or a folder of them, whose cameras are estimated; or a scene with cameras
    /// (folder or pose file: cameras.json, transforms.json, COLMAP, RealEstate10K txt).
    #[arg(required = true, num_args = 1.., value_name = "IMG… | DIR | SCENE")]
    pub input: Vec<PathBuf>,
    /// Output folder; it must not hold the poses of a scene.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Options of the reconstruction.
    #[command(flatten)]
    pub source: SourceArgs,
    /// Frames to render and to score against their photographs (default: protocol.json's,
    /// else those between the contexts, else a path).
    #[arg(long, value_delimiter = ',', value_name = "I,J,…")]
    pub target: Vec<String>,
    /// Rendered frames.
    #[arg(long, value_enum, default_value = "targets")]
    pub path: PathArg,
    /// Length, radius and animation of a path.
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Size of the pictures, px, for instance 1920x1080; N is NxN. The photographs are cropped to its
    /// shape. Without --upscale, the children are as many as its pixels need (at most 64 per input
    /// pixel).
    #[arg(long, value_name = "N | WxH", value_parser = values::size)]
    pub size: Option<(usize, usize)>,
    /// Formats of the scene, written as scene.ply and so on.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ply", value_name = "F,…")]
    pub save: Vec<SceneFormatArg>,
    /// Content of the scene files.
    #[command(flatten)]
    pub content: ContentArgs,
    /// Options of the rendering.
    #[command(flatten)]
    pub rendering: RenderingArgs,
}

/// Options of a reconstruction: of `run` and `view`.
#[derive(Clone, Debug, Args)]
pub struct SourceArgs {
    /// Context frames: indices into the scene's frames, or file names (default: up to five photographs
    /// without poses all, else the protocol's or a pair).
    #[arg(long, value_delimiter = ',', value_name = "I,J")]
    pub context: Vec<String>,
    /// Size of the network's input, px. N: as many pixels as a square of side N, in the
    /// photographs' shape; with `--crop square` that square. WxH: these sides.
    #[arg(long, default_value = "256", value_name = "N | WxH", value_parser = values::input_size)]
    pub input_size: InputSizeArg,
    /// Size of the network's input by purpose. The size that is used is printed.
    #[arg(long, value_enum, conflicts_with = "input_size")]
    pub quality: Option<QualityArg>,
    /// Part of the photographs that is used, where --input-size is not WxH.
    #[arg(long, value_enum, default_value = "whole")]
    pub crop: CropShapeArg,
    /// Target over input, side over side, 1 to 8: 2 gives 4 children per pixel, 4 gives 16. A
    /// number between has the children of the next whole one. Default: the weights' own, else 2.
    #[arg(long, value_name = "R", value_parser = values::upscale)]
    pub upscale: Option<f32>,
    /// Number of Gaussians, at most, or their share of all children of all pixels. Pixels of even
    /// colour keep one, pixels with detail get all. auto: all of two photographs; more photographs
    /// share the Gaussians of two and a half. K/px: K for every pixel, a square number or not.
    #[arg(long, value_name = "auto | N | P% | K/px", value_parser = values::density, default_value = "auto")]
    pub gaussians: Density,
    /// Weights (.safetensors). Default: the shipped ones.
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Untrained weights, drawn from this seed.
    #[arg(long, value_name = "N", conflicts_with = "weights")]
    pub seed: Option<u64>,
    /// Nearest depth candidate, world units. Default: the pose file's, RealEstate10K's 1, or
    /// from sparse points, matched points or the baseline; without --near and --far the small
    /// backbone then estimates both at half size. To `view` a finished scene: the near plane.
    #[arg(long, allow_negative_numbers = true, value_parser = values::positive)]
    pub near: Option<f32>,
    /// Farthest depth candidate, world units. Default: likewise; RealEstate10K's 100.
    #[arg(long, allow_negative_numbers = true, value_parser = values::positive)]
    pub far: Option<f32>,
    /// Do not match points between the context photographs (check of poses, depth range).
    #[arg(long)]
    pub no_check: bool,
    /// Adjust the given cameras by points matched between the photographs, for poses that are nearly
    /// right, such as a headset's.
    #[arg(long)]
    pub adjust_poses: bool,
    /// Colour detail from photographs that are larger than the network's input.
    #[arg(long, value_enum, default_value = "photo")]
    pub detail: DetailArg,
    /// Steps of the fit to the photographs: sizes, opacities and colours of the Gaussians are
    /// changed so that they give the photographs back. 0: the network's Gaussians.
    #[arg(long, value_name = "STEPS", default_value_t = FitOptions::default().steps)]
    pub fit: usize,
    /// Refinement of the Gaussians on the photographs, after the fit: means, shapes, opacities and
    /// colours. `auto`: eight steps a photograph, 64 at most, none with `--fit 0` and of more than 1.5 million Gaussians; `off`; the number of
    /// steps; or a time in seconds, such as `20s`. The steps end earlier where they no longer help.
    #[arg(long, value_name = "auto | off | STEPS | SECONDSs", default_value = "auto", value_parser = values::refine)]
    pub refine: Refine,
    /// The model.
    #[command(flatten)]
    pub model: ModelArgs,
    /// Cameras of two photographs.
    #[command(flatten)]
    pub pair: PairArgs,
}

/// The model, where the weights do not state it.
#[derive(Clone, Debug, Args)]
pub struct ModelArgs {
    /// Network that predicts the primary Gaussians. Default: the weights' own, `re10k` for a
    /// bare MVSplat checkpoint; `re10k` without weights is untrained.
    #[arg(long, value_enum)]
    pub backbone: Option<BackboneArg>,
    /// SubSplat's equations. Default: the weights' own, `tuned` for weights without
    /// SubSplat.
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// A whole configuration (JSON) instead of the two above.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["backbone", "preset"])]
    pub config: Option<PathBuf>,
}

/// Rendering options.
#[derive(Debug, Args)]
pub struct RenderingArgs {
    /// Rules of the rasterizer. Default: the model's own; for scene files those that `run` wrote
    /// into them (.ply, .glb), else `standard`.
    #[arg(long, value_enum)]
    pub convention: Option<ConventionArg>,
    /// The picture whose pixels are the unit of the 0.3 px² low-pass.
    #[arg(long, value_enum)]
    pub lowpass_ref: Option<LowpassArg>,
    /// Background colour, R,G,B in [0, 1]. Default: the model's own (the inputs' mean
    /// colour, or black); for scene files the one that `run` wrote into them, else black.
    #[arg(
        long,
        value_parser = values::colour,
        allow_hyphen_values = true,
        value_name = "R,G,B"
    )]
    pub background: Option<[f32; 3]>,
    /// Device for rendering, and with `run` for plane sweep, attention gather and children: cpu;
    /// auto (a GPU, but no software adapter); gpu (any adapter); or an adapter by a part of its
    /// name. Where it fails, the CPU does the work, with a warning.
    #[arg(long, default_value = "cpu", value_name = "auto|cpu|gpu|NAME")]
    pub device: String,
}

/// Cameras of photographs that come without a pose file. Without --move and --pose-b the poses
/// are estimated; without --fov and --intrinsics the focal length comes from EXIF, else it is
/// estimated too. With a pose of the second of two, the first camera is the world unless --pose-a
/// is given.
#[derive(Clone, Debug, Args)]
pub struct PairArgs {
    /// Horizontal field of view of all photographs, degrees.
    #[arg(
        long,
        value_name = "DEG",
        conflicts_with = "intrinsics",
        allow_negative_numbers = true,
        value_parser = values::fov
    )]
    pub fov: Option<f32>,
    /// Intrinsics of all photographs, px: FX,FY,CX,CY, or 9 numbers of a 3x3 matrix.
    #[arg(long, value_name = "K")]
    pub intrinsics: Option<String>,
    /// Position of the second camera in the first one's frame (x right, y down, z forward),
    /// world units.
    #[arg(long = "move", value_parser = values::triple, allow_hyphen_values = true, value_name = "X,Y,Z")]
    pub translation: Option<[f32; 3]>,
    /// Rotation of the second camera in the first one's frame: degrees about x, then y, then z.
    #[arg(long, value_parser = values::triple, allow_hyphen_values = true, value_name = "RX,RY,RZ")]
    pub turn: Option<[f32; 3]>,
    /// Pose of the first photograph: 12 or 16 numbers, row by row.
    #[arg(long, allow_hyphen_values = true, value_name = "M")]
    pub pose_a: Option<String>,
    /// Pose of the second photograph: 12 or 16 numbers, row by row.
    #[arg(long, allow_hyphen_values = true, value_name = "M", conflicts_with_all = ["translation", "turn"])]
    pub pose_b: Option<String>,
    /// Convention of --pose-a and --pose-b, or of a scene's poses.txt. Default: opencv-c2w.
    #[arg(long, value_enum)]
    pub pose_convention: Option<PoseConventionArg>,
    /// Use estimated cameras that would be refused, and truncated JPEG files.
    #[arg(long)]
    pub force: bool,
}

/// Axes and direction of a pose matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PoseConventionArg {
    /// Camera-to-world, x right, y down, z forward.
    OpencvC2w,
    /// World-to-camera, x right, y down, z forward.
    OpencvW2c,
    /// Camera-to-world, x right, y up, z backward (NeRF, Blender).
    OpenglC2w,
}

/// Arguments of `poses`.
#[derive(Debug, Args)]
pub struct PosesArgs {
    /// Photographs of one scene in any order, or a folder of them.
    #[arg(required = true, num_args = 1.., value_name = "IMG… | DIR")]
    pub input: Vec<PathBuf>,
    /// A .json file for the cameras; or a folder, which gets cameras.json and COLMAP's text model
    /// in sparse/0.
    #[arg(short, long, default_value = "poses", value_name = "FILE | DIR")]
    pub out: PathBuf,
    /// Horizontal field of view of all photographs, degrees.
    #[arg(long, value_name = "DEG", conflicts_with = "intrinsics", value_parser = values::fov)]
    pub fov: Option<f32>,
    /// Intrinsics of all photographs, px: FX,FY,CX,CY, or 9 numbers of a 3x3 matrix.
    #[arg(long, value_name = "K")]
    pub intrinsics: Option<String>,
    /// Write estimates that would be refused, and read truncated JPEG files.
    #[arg(long)]
    pub force: bool,
}

/// Arguments of `render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// The scene: .ply, .compressed.ply, .splat, .spz, .ksplat or .glb; or a folder that `run`
    /// wrote.
    #[arg(value_name = "SPLATS | DIR")]
    pub scene: PathBuf,
    /// Folder for the pictures.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Cameras: any pose file or scene folder. Default: cameras.json beside the
    /// scene, else a view of the whole.
    #[arg(long, value_name = "SCENE")]
    pub cameras: Option<PathBuf>,
    /// Frames of `--cameras` to render (default: all).
    #[arg(long, value_delimiter = ',', value_name = "I,J,…")]
    pub target: Vec<String>,
    /// Rendered frames.
    #[arg(long, value_enum, default_value = "targets")]
    pub path: PathArg,
    /// Length, radius and animation of a path.
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Picture size, px: N, or WxH (default: the cameras' own).
    #[arg(long, value_name = "N | WxH", value_parser = values::size)]
    pub size: Option<(usize, usize)>,
    /// Highest SH degree evaluated.
    #[arg(long, default_value_t = 4, value_name = "0…4", value_parser = values::sh_degree)]
    pub sh_degree: usize,
    /// Write depth pictures too: 16 bits in depth/, colours with a legend in depth_colour/ of that
    /// folder.
    #[arg(long)]
    pub depth: bool,
    /// Options of the rendering.
    #[command(flatten)]
    pub rendering: RenderingArgs,
    /// Near plane of the `mvsplat` convention, whose 0.2-fold is the nearest depth
    /// drawn; nearest depth itself under `standard`.
    #[arg(long, allow_negative_numbers = true, value_parser = values::positive)]
    pub near: Option<f32>,
}

/// Arguments of `view` in a build without it.
#[cfg(not(feature = "view"))]
#[derive(Debug, Args)]
pub struct NoViewArgs {
    /// Anything: the command says how to get a window.
    #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _ignored: Vec<String>,
}

/// The up direction of a written file.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum UpArg {
    /// The scene's own axes: up is −y, as photogrammetry programs write it.
    Keep,
    /// Up is +y (OpenGL, game engines).
    Y,
    /// Up is +z (Blender, CAD).
    Z,
}

impl From<UpArg> for subsplat::Up {
    fn from(arg: UpArg) -> Self {
        match arg {
            UpArg::Keep => Self::Keep,
            UpArg::Y => Self::Y,
            UpArg::Z => Self::Z,
        }
    }
}

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// The scene: .ply, .compressed.ply, .splat, .spz, .ksplat or .glb; or a folder that `run`
    /// wrote.
    #[arg(value_name = "SPLATS | DIR")]
    pub scene: PathBuf,
    /// The file to write; its extension decides the format: .html, .ply, .glb, .spz or .splat.
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
    /// Places that the .html offers, and from which --gaussians looks: any pose file or scene folder.
    /// Default: cameras.json beside the scene, else the file's own camera, else none.
    #[arg(long, value_name = "SCENE")]
    pub cameras: Option<PathBuf>,
    /// Number of Gaussians, at most, or their share: Gaussians that no camera shows are removed, then
    /// neighbours are merged. Half costs nothing that can be seen, and a tenth 0.3 dB in the example's
    /// room.
    #[arg(long, value_name = "N | P%", value_parser = values::reduced)]
    pub gaussians: Option<Density>,
    /// Content of the scene files.
    #[command(flatten)]
    pub content: ContentArgs,
    /// Up direction of a .ply or .splat (default: keep). A .glb and a .spz are y-up by their
    /// formats, and a .html is upright.
    #[arg(long, value_enum)]
    pub up: Option<UpArg>,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// A scene folder or pose file; or photographs, or a folder of them.
    #[arg(required = true, num_args = 1.., value_name = "SCENE | IMG… | DIR")]
    pub input: Vec<PathBuf>,
    /// Frames to check, each with the next (default: protocol.json's contexts, else the pair
    /// that `run` would choose).
    #[arg(long, value_delimiter = ',', value_name = "I,J")]
    pub context: Vec<String>,
    /// Folder for the epipolar pictures.
    #[arg(short, long, default_value = "out", value_name = "DIR")]
    pub out: PathBuf,
    /// Cameras of two photographs that come without a scene.
    #[command(flatten)]
    pub pair: PairArgs,
}

/// Arguments of `info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// A splat file, a weight file, a photograph, or a scene.
    pub file: PathBuf,
}
