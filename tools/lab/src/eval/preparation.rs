//! Preparation of the inputs before the network, as [`subsplat::reconstruct`] does it for `run`.

use subsplat::cameras::estimation::move_along;
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::reconstruct::stages::{
    adjusted, adjusted_if_doubted, check_pairs, equalise, located,
};
use subsplat::reconstruct::{Photo, Poses, Result};
use subsplat_kernels::camera::Camera;

/// Steps before the network. They receive the inputs' photographs and the cameras after all
/// disturbances.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Preparation {
    /// Cameras of the inputs. Default: those of the data, on which a protocol compares methods. With adjusted ones, the targets are located by points matched with the
    /// inputs, because a target's own camera is in the frame of the cameras before. Targets with too few
    /// matches follow the inputs by one similarity.
    pub poses: Poses,
    /// Gives all inputs the exposure and white balance of one of them; of two inputs it is the first.
    pub equal_exposure: bool,
}

impl Default for Preparation {
    fn default() -> Self {
        Self { poses: Poses::Given, equal_exposure: false }
    }
}

impl Preparation {
    /// Prepares the inputs of a case, by points matched between the inputs' photographs with their
    /// cameras after all disturbances. `photos` makes these of the inputs where a step needs them. `given`: the cameras before any disturbance;
    /// `truth`: the targets' photographs.
    ///
    /// # Errors
    /// Pictures of which no features can be taken.
    pub(super) fn apply(
        self,
        given: &[Camera],
        photos: impl FnOnce(&[Cropped]) -> Result<Vec<Photo>>,
        inputs: &mut [Cropped],
        truth: &[Photo],
        targets: &mut [Cropped],
    ) -> Result<()> {
        if self.poses == Poses::Given && !self.equal_exposure {
            return Ok(());
        }
        let mut photos = photos(inputs)?;
        let found = match self.poses {
            Poses::Given => None,
            Poses::Adjusted => adjusted(&photos)?,
            _ => adjusted_if_doubted(&photos, &check_pairs(&photos, |_| Ok(()))?)?,
        };
        if self.poses == Poses::Adjusted || found.is_some() {
            photos = found.map_or(photos, |(moved, _)| moved);
            let cameras: Vec<Camera> = photos.iter().map(|p| *p.camera()).collect();
            inputs.iter_mut().zip(&cameras).for_each(|(c, camera)| place(c, camera));
            let seen: Vec<Camera> = truth.iter().map(|p| *p.camera()).collect();
            let seen = move_along(given, &cameras, &seen).unwrap_or(seen);
            let truth = truth.iter().zip(&seen).map(|(p, c)| p.with_camera(*c));
            let found = located(&photos, &truth.collect::<Result<Vec<_>>>()?)?;
            for ((target, found), moved) in targets.iter_mut().zip(&found).zip(&seen) {
                place(target, found.as_ref().unwrap_or(moved));
            }
        }
        if self.equal_exposure {
            let reports = check_pairs(&photos, |_| Ok(()))?;
            equalise(&photos, inputs, &reports);
        }
        Ok(())
    }
}

/// The whole photographs `whole` of `inputs`, with the cameras that the inputs have after disturbances.
/// `given`: the inputs' cameras before.
///
/// # Errors
/// A disturbed camera that is none, such as a focal length that is not finite.
pub(super) fn whole_photos(
    whole: &[Photo],
    given: &[Camera],
    inputs: &[Cropped],
) -> Result<Vec<Photo>> {
    let of = |((photo, given), input): ((&Photo, &Camera), &Cropped)| {
        let (from, to) = (given.intrinsics(), input.target_camera.intrinsics());
        let zoomed = photo.camera().zoomed_unchecked(to.fx / from.fx, to.fy / from.fy);
        photo.with_camera(zoomed.with_pose_unchecked(input.target_camera.world_from_camera()))
    };
    whole.iter().zip(given).zip(inputs).map(of).collect()
}

/// Photographs of the target's size with their cameras.
pub(super) fn photos(inputs: &[Cropped]) -> Result<Vec<Photo>> {
    inputs.iter().map(|c| Photo::new(c.target.clone(), c.target_camera)).collect()
}

/// Moves both cameras of a crop to the pose of `camera`.
fn place(crop: &mut Cropped, camera: &Camera) {
    crop.input_camera = crop.input_camera.with_pose_unchecked(camera.world_from_camera());
    crop.target_camera = crop.target_camera.with_pose_unchecked(camera.world_from_camera());
}
