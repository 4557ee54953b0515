//! From photographs to a rendered scene in one call. Applications and programs use this module.
//!
//! ```no_run
//! use std::ops::ControlFlow;
//! use subsplat::reconstruct::{DepthBounds, Options, Photo, Reconstructor};
//! # fn main() -> subsplat::Result<()> {
//! let scene = subsplat::files::poses::scene::load_scene("scene")?;
//! let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
//! let options = Options::default().with_depth_prior(DepthBounds::of_scene(&scene, &[0, 1])?);
//! let model = Reconstructor::load("weights.safetensors", None)?;
//! let result = model.run_with(&photos, &options, &mut |progress| {
//!     println!("{:3.0} % {}", 100.0 * progress.fraction, progress.stage);
//!     ControlFlow::Continue(())
//! })?;
//! result.save("scene.ply")?;
//! # Ok(())
//! # }
//! ```
//!
//! The stages ([`Stage`]), in order:
//!
//! 0. With [`Poses::Adjusted`], the cameras are adjusted by points matched between photographs; by default
//!    after stage 3, where its check doubts them, and stages 1 to 3 run again.
//! 1. The initial depth range comes from [`Options::depth_range`], then from
//!    [`Options::depth_prior`], then from the distance between the cameras.
//! 2. The size of the network's input follows from the photographs' shapes ([`InputSize`]). Each
//!    photograph is cropped to it and to the target size.
//! 3. Points are matched between consecutive photographs. They check the poses ([`Check`]),
//!    their depths replace a range that was only guessed, and their colours bring the
//!    photographs to the exposure of the one of middle brightness.
//! 4. The small backbone estimates near and far at half size, unless the caller fixed one.
//! 5. The network predicts one primary Gaussian per input pixel.
//! 6. Primaries move to the depth at which the photographs agree ([`Matching`]), and are optimised on the
//!    photographs of the input's size. The network then predicts their children.
//! 7. The photographs add detail to the children's colours ([`Detail`]).
//! 8. Sizes, opacities and colours are fitted to the photographs ([`crate::finish::fit()`]).
//! 9. Means, shapes, opacities and colours are refined on the photographs ([`crate::finish::refine()`]).
//!
//! [`Reconstructor::run`] executes all of them. [`Reconstructor::prepare`] executes steps 1 to 3;
//! the caller can then free large photographs before the network runs.

mod assessment;
mod children;
mod coarse_to_fine;
mod density;
mod depth_range;
mod detail;
mod equal_exposure;
mod error;
mod estimate_cameras;
mod finishing;
mod input_size;
pub mod inputs;
mod options;
mod photo;
mod poses;
mod prepared;
mod progress;
mod projections;
mod reconstruction;
mod reconstructor;
mod repeated;
mod surroundings;
mod unit;
mod verdict;
mod warning;

pub use crate::network::model::Backend;
pub use assessment::{Agreement, Assessment};
pub use density::Density;
pub use depth_range::{DepthBounds, DepthRange, DepthSource};
pub use error::{Error, Result};
pub use estimate_cameras::{
    EstimateOptions, EstimatedPhotos, EstimatedScene, KnownLens, LensSource, estimate_cameras,
    estimate_cameras_of_files,
};
pub use input_size::InputSize;
pub use options::{
    Check, Detail, Matching, Options, Poses, Quality, QualitySettings, Refine, TargetSize,
};
pub use photo::{Photo, Photographs};
pub use poses::PoseError;
pub use prepared::{Prepared, SceneSoFar};
pub use progress::{Progress, Stage, StageTime};
pub use projections::{FisheyeCurve, FisheyeLens, Projection};
pub use reconstruction::Reconstruction;
pub use reconstructor::Reconstructor;
pub use surroundings::Surroundings;
pub use verdict::{SceneVerdict, Trust};
pub use warning::Warning;

pub(crate) use children::{SceneChildren, counts_of};
pub(crate) use coarse_to_fine::{match_parents, options_of_parents, refine_parents};
pub(crate) use finishing::{check_refine, fit_to_inputs, refine_on_inputs};
pub(crate) use poses::check_pairs;
pub(crate) use surroundings::{add_surroundings, restore_surroundings, take_surroundings};

/// The stages of a run, one by one, for evaluation. No version promises anything about them.
pub mod stages {
    pub use super::children::{Counts, SceneChildren, counts_of};
    pub use super::coarse_to_fine::{
        ParentsOptions, match_parents, options_of_parents, refine_parents,
    };
    pub use super::detail::add_detail;
    pub use super::equal_exposure::equalise;
    pub use super::finishing::{fit_to_inputs, refine_on_inputs};
    pub use super::poses::{adjusted, adjusted_if_doubted, check_pairs, located};
    pub use super::repeated::hide_repeated;
    pub use super::surroundings::add_surroundings;
    pub use crate::finish::Groups;
}

use crate::network::config::{Backbone, Config};

/// Returns whether a configuration's backbone is MVSplat.
pub fn is_mvsplat(config: &Config) -> bool {
    matches!(config.backbone, Backbone::Mvsplat(_))
}
