//! Cameras of photographs that come without any: poses, a shared focal length and sparse points.
//!
//! Input: photographs with what is known of their lenses ([`PosePhoto`], [`Lens`]). Output:
//! [`PoseEstimate`], or the reason why there is none ([`PoseRefusal`]). The module reads no files.
//! Equal photographs give equal estimates.
//!
//! A panorama is a photograph of several views with one centre (`views.rs`).
//!
//! The focal length is one for all where the points do not tell otherwise (`focal.rs`, `zoom.rs`).
//!
//! Features that stand still in the picture are left out (`still.rs`). A lens that bends straight lines is found and
//! said; the caller straightens the photographs (`bend.rs`).
//!
//! Cameras that are nearly right are adjusted by [`adjust_poses`] (`adjust.rs`).
//!
//! Two photographs: points are matched, an essential matrix is estimated and refined
//! (`pair.rs`). Three and more: pairs are verified (`edges.rs`), joined one by one (`reconstruct.rs`) and adjusted
//! together (`bundle.rs`). Of photographs that fall into groups without common points the largest
//! group is used (`groups.rs`). The world's +y axis points down as far as the cameras' horizon says
//! (`world.rs`); its unit is the median depth of the points.

mod absolute;
mod adjust;
mod bend;
mod bundle;
mod edges;
mod estimate;
mod five_point;
mod focal;
mod groups;
mod pair;
mod photo;
mod ransac;
mod reasons;
mod reconstruct;
mod refine;
mod still;
mod tracks;
mod two_view;
mod views;
mod world;
mod zoom;

pub use adjust::{CERTAIN_POINTS, PoseAdjustment, adjust_poses, locate_photos, move_along};
pub use estimate::{
    Confidence, FocalEstimate, LeftOut, PoseEstimate, PoseOptions, PosePoint, RadialLens,
    Uncertain, estimate_poses,
};
pub use photo::{Lens, PosePhoto, PosePhotoError};
pub use reasons::{PoseRefusal, PoseWarning};
pub use views::PhotoView;
