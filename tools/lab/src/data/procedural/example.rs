//! Builds one training example from a procedural room: two context views, targets between them, and
//! the depth of all.
//!
//! The example has the units of length and the near and far planes of common data sets.

use super::Room;
use super::cameras::{CameraRange, CameraSpec, Rig, sample_cameras};
use super::render::{Grade, Quality, View};
use super::rng::Rng;
use super::texture::TextureBank;
use subsplat_kernels::camera::Camera;

/// Contents of an example.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExampleSpec {
    /// Sizes, number of targets, probability of cropping.
    pub cameras: CameraSpec,
    /// Applies gain and gamma per scene, and exposure, white balance, softness and noise per view.
    /// If false, all views have the grade of [`Quality::clean`].
    pub photographic: bool,
    /// Share of examples with objects close to the cameras, partly outside the picture: chairs,
    /// plants, the edge of a door.
    pub foreground: f32,
    /// Share of examples that show shapes at random places, indoors or outdoors, instead of a
    /// furnished room.
    pub scattered: f32,
    /// Share of furnished rooms with objects in the air.
    pub floating: f32,
    /// Share of examples with cameras of [`CameraRange::LogBaseline`].
    pub log_baseline: f32,
    /// Share of examples with cameras of [`CameraRange::Wide`], which exclude those of
    /// [`CameraRange::LogBaseline`].
    pub wide: f32,
    /// Samples along each side of a pixel.
    pub samples: usize,
    /// Textures of [`TextureBank::fine`] in furnished rooms, for large pictures; else of
    /// [`TextureBank::shared`].
    pub fine_textures: bool,
}

impl ExampleSpec {
    /// Returns two context views and `targets` more, 4 samples per pixel, half of the examples
    /// cropped from pictures twice as large, photographic, furnished rooms without foreground.
    pub fn new(width: usize, height: usize, targets: usize) -> Self {
        let range = CameraRange::HandHeld;
        let cameras = CameraSpec { width, height, targets, crop: 0.5, range };
        Self {
            cameras,
            photographic: true,
            foreground: 0.0,
            scattered: 0.0,
            floating: 0.0,
            log_baseline: 0.0,
            wide: 0.0,
            samples: 2,
            fine_textures: false,
        }
    }
}

/// Differences between the targets of an example and its context views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TargetSpec {
    /// Side of a target over the side of a context view; at least 1.
    pub ratio: usize,
    /// Samples along each side of a target's pixel; at least 1.
    pub samples: usize,
    /// Applies the scene's gain and gamma only. Exposure, softness and noise of a target could not
    /// be predicted.
    pub clean: bool,
    /// Adds the context views to the targets: their cameras at the targets' size, with the views'
    /// own exposure but without softness and noise.
    pub inputs: bool,
}

/// Views, cameras, near and far of one scene, in the example's unit of length.
#[derive(Clone, Debug)]
pub struct Example {
    /// Seed of the room.
    pub seed: u64,
    /// Two context views, then the targets, then the context views at the targets' size if they
    /// are targets; depth in the example's unit.
    pub views: Vec<View>,
    /// Cameras of the views, in the example's unit.
    pub cameras: Vec<Camera>,
    /// Near plane for the network.
    pub near: f32,
    /// Far plane for the network.
    pub far: f32,
}

/// Number of context views of an example.
pub(super) const CONTEXT: usize = 2;
/// Range of the 2 % quantile of depth, units.
const NEAR_DEPTH: [f32; 2] = [0.9, 2.4];
/// Share of examples with near 1 and far 100, the planes of RealEstate10K.
const FIXED_PLANES: f32 = 0.7;

/// Key of the random numbers for the foreground.
const FOREGROUND: u64 = 12;
/// Key of the random numbers that choose the kind of scene and of cameras.
const VARIETY: u64 = 13;
/// Key of the random numbers for objects in the air and for baselines with uniform logarithm.
const FLOATING: u64 = 15;

/// Unit of length and depth planes of an example.
struct Planes {
    /// Units per metre.
    scale: f32,
    /// Near plane, units.
    near: f32,
    /// Far plane, units.
    far: f32,
}

/// Samples the unit of length, near and far for a rig.
fn planes(rig: &Rig, rng: &mut Rng) -> Planes {
    let scale = rng.log_range(NEAR_DEPTH[0], NEAR_DEPTH[1]) / rig.near_depth.max(1e-3);
    if rng.chance(FIXED_PLANES) {
        return Planes { scale, near: 1.0, far: 100.0 };
    }
    // near lies between half the baseline and the nearest visible depth. far is 30 baselines, and
    // at least the farthest visible depth.
    let baseline = rig.baseline * scale;
    let nearest = 0.9 * rig.near_depth * scale;
    let near = 0.5 * baseline + rng.unit() * (nearest - 0.5 * baseline).max(0.0);
    Planes { scale, near, far: (30.0 * baseline).max(rig.far_depth * scale) }
}

impl Example {
    /// Builds the example of `seed`. A room without space for cameras is replaced by the next of a
    /// fixed sequence, so that every seed gives an example.
    pub fn new(seed: u64, spec: &ExampleSpec) -> Self {
        let targets = TargetSpec { ratio: 1, samples: spec.samples, clean: false, inputs: false };
        Self::with_targets(seed, spec, &targets)
    }

    /// Builds an example with targets of another size or grade; rooms and cameras are those of
    /// [`Example::new`].
    pub fn with_targets(seed: u64, spec: &ExampleSpec, targets: &TargetSpec) -> Self {
        let mut rng = Rng::new(seed).fork(11);
        loop {
            let seed = rng.bits();
            // Separate streams: the example of a furnished room is unchanged.
            let mut variety = Rng::new(seed).fork(VARIETY);
            let scattered = variety.chance(spec.scattered);
            let wide = variety.chance(spec.wide);
            let mut floating = Rng::new(seed).fork(FLOATING);
            let log_baseline = floating.chance(spec.log_baseline);
            let floats = floating.chance(spec.floating) && !scattered;
            let range = match (wide, log_baseline) {
                (true, _) => CameraRange::Wide,
                (false, true) => CameraRange::LogBaseline,
                (false, false) => spec.cameras.range,
            };
            let mut room = match (scattered, spec.fine_textures) {
                (true, _) => Room::scattered(seed),
                (false, true) => Room::with_bank(seed, TextureBank::fine()),
                (false, false) => Room::new(seed),
            };
            if let Some(mut rig) =
                sample_cameras(&room, seed, &CameraSpec { range, ..spec.cameras })
            {
                if scattered {
                    room.scatter_objects(&mut rig, &mut variety);
                }
                if floats {
                    room.add_floating(&mut rig, &mut floating);
                }
                let mut extra = Rng::new(seed).fork(FOREGROUND);
                if extra.chance(spec.foreground) {
                    room.add_foreground(&mut rig, &mut extra);
                }
                return Self::rendered(seed, &room, &rig, spec, targets, &mut rng);
            }
        }
    }

    /// Renders the views of a rig.
    fn rendered(
        seed: u64,
        room: &Room,
        rig: &Rig,
        spec: &ExampleSpec,
        targets: &TargetSpec,
        rng: &mut Rng,
    ) -> Self {
        let Planes { scale, near, far } = planes(rig, rng);
        let scene = Grade::sample_scene(rng);
        let soft = rng.chance(0.3);
        let mut cameras = rig.cameras.clone();
        if targets.inputs {
            cameras.extend_from_within(..CONTEXT);
        }
        for camera in cameras.iter_mut().skip(CONTEXT) {
            let (w, h) = (camera.intrinsics().width, camera.intrinsics().height);
            *camera = camera.resized_unchecked(w * targets.ratio.max(1), h * targets.ratio.max(1));
        }
        let first_input_target = rig.cameras.len();
        let mut context_grades = Vec::with_capacity(CONTEXT);
        let render = |(i, camera): (usize, &Camera)| {
            let target = i >= CONTEXT;
            let grade = if !spec.photographic {
                Grade::default()
            } else if i >= first_input_target {
                let grade: Grade = context_grades[i - first_input_target];
                Grade { softness: 0.0, noise: 0.0, ..grade }
            } else if target && targets.clean {
                scene
            } else {
                scene.sample_view(soft, rng)
            };
            if !target {
                context_grades.push(grade);
            }
            let samples = if target { targets.samples } else { spec.samples };
            let quality = Quality { samples, ..Quality::training(grade) };
            let mut view = room.render(camera, &quality);
            view.depth.iter_mut().for_each(|d| *d *= scale);
            view
        };
        let views = cameras.iter().enumerate().map(render).collect();
        for camera in &mut cameras {
            let eye = camera.position() * scale;
            let mut pose = camera.world_from_camera();
            pose.w_axis = eye.extend(1.0);
            *camera = camera.with_pose_unchecked(pose);
        }
        Self { seed, views, cameras, near, far }
    }
}
