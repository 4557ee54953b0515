//! One example to learn from: two views of a room, targets between them, depth of all,
//! in the units and with the near and far planes that data sets use.

use super::Room;
use super::cameras::{CameraSpec, Rig, sample_cameras};
use super::render::{Grade, Quality, View};
use super::rng::Rng;
use crate::camera::Camera;

/// What an example holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExampleSpec {
    /// Sizes, number of targets, chance of cropping.
    pub cameras: CameraSpec,
    /// Gain and gamma per scene; exposure, white balance, softness and noise per view.
    /// Off: [`Quality::clean`]'s grade in all views.
    pub photographic: bool,
    /// Share of examples with things close before the cameras, half out of the picture:
    /// chairs, plants, the edge of a door.
    pub foreground: f32,
    /// Samples along each side of a pixel.
    pub samples: usize,
}

impl ExampleSpec {
    /// Two context views and `targets` more, 4 samples a pixel, half of the examples
    /// cropped from pictures twice as large, photographic, nothing close before the cameras.
    pub fn new(width: usize, height: usize, targets: usize) -> Self {
        let cameras = CameraSpec { width, height, targets, crop: 0.5 };
        Self { cameras, photographic: true, foreground: 0.0, samples: 2 }
    }
}

/// How the targets of an example differ from its context views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TargetSpec {
    /// Side of a target over side of a context view; at least 1.
    pub ratio: usize,
    /// Samples along each side of a target's pixel; at least 1.
    pub samples: usize,
    /// The scene's gain and gamma alone: no exposure of its own, softness or noise, which
    /// nothing could predict.
    pub clean: bool,
}

/// Views, cameras, near and far of one scene, in the example's unit of length.
#[derive(Clone, Debug)]
pub struct Example {
    /// Seed of the room that was used.
    pub seed: u64,
    /// Two context views, then the targets. Depth in the example's unit.
    pub views: Vec<View>,
    /// Their cameras, in the example's unit.
    pub cameras: Vec<Camera>,
    /// Nearest depth that the network is told.
    pub near: f32,
    /// Farthest depth that the network is told.
    pub far: f32,
}

/// Context views of an example.
pub(super) const CONTEXT: usize = 2;
/// Depth that both rules put the 2 % quantile of depth at, units.
const NEAR_DEPTH: [f32; 2] = [0.9, 2.4];
/// Share of examples with near 1 and far 100, RealEstate10K's habit.
const FIXED_PLANES: f32 = 0.7;

/// Key of the draws for what stands before the cameras.
const FOREGROUND: u64 = 12;

/// Unit of length (units per metre), near and far for a rig.
fn planes(rig: &Rig, rng: &mut Rng) -> (f32, f32, f32) {
    let scale = rng.log_range(NEAR_DEPTH[0], NEAR_DEPTH[1]) / rig.near_depth.max(1e-3);
    if rng.chance(FIXED_PLANES) {
        return (scale, 1.0, 100.0);
    }
    // Half the baseline, or nearer to what there is to see; 30 baselines, and at least
    // all there is to see.
    let baseline = rig.baseline * scale;
    let seen = 0.9 * rig.near_depth * scale;
    let near = 0.5 * baseline + rng.unit() * (seen - 0.5 * baseline).max(0.0);
    (scale, near, (30.0 * baseline).max(rig.far_depth * scale))
}

impl Example {
    /// The example of `seed`. A room without a place for cameras is replaced by the
    /// next of a fixed sequence: every seed gives an example.
    pub fn new(seed: u64, spec: &ExampleSpec) -> Self {
        let targets = TargetSpec { ratio: 1, samples: spec.samples, clean: false };
        Self::with_targets(seed, spec, &targets)
    }

    /// [`Example::new`] with targets of another size or grade: the same rooms and cameras.
    pub fn with_targets(seed: u64, spec: &ExampleSpec, targets: &TargetSpec) -> Self {
        let mut rng = Rng::new(seed).fork(11);
        loop {
            let seed = rng.bits();
            let mut room = Room::new(seed);
            if let Some(mut rig) = sample_cameras(&room, seed, &spec.cameras) {
                // A stream of its own: without these things the example stays what it was.
                let mut extra = Rng::new(seed).fork(FOREGROUND);
                if extra.chance(spec.foreground) {
                    room.crowd(&mut rig, &mut extra);
                }
                return Self::of(seed, &room, &rig, (spec, targets), &mut rng);
            }
        }
    }

    fn of(
        seed: u64,
        room: &Room,
        rig: &Rig,
        (spec, targets): (&ExampleSpec, &TargetSpec),
        rng: &mut Rng,
    ) -> Self {
        let (scale, near, far) = planes(rig, rng);
        let scene = Grade::of_scene(rng);
        let soft = rng.chance(0.3);
        let mut cameras = rig.cameras.clone();
        for camera in cameras.iter_mut().skip(CONTEXT) {
            let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
            *camera = camera.resized(w * targets.ratio.max(1), h * targets.ratio.max(1));
        }
        let render = |(i, camera): (usize, &Camera)| {
            let target = i >= CONTEXT;
            let grade = match spec.photographic {
                true if target && targets.clean => scene,
                true => scene.of_view(soft, rng),
                false => Grade::default(),
            };
            let samples = if target { targets.samples } else { spec.samples };
            let quality = Quality { samples, ..Quality::training(grade) };
            let mut view = room.render(camera, &quality);
            view.depth.iter_mut().for_each(|d| *d *= scale);
            view
        };
        let views = cameras.iter().enumerate().map(render).collect();
        for camera in &mut cameras {
            let eye = camera.position() * scale;
            camera.world_from_camera.w_axis = eye.extend(1.0);
        }
        Self { seed, views, cameras, near, far }
    }
}
