//! Points matched between photographs, without any knowledge of the cameras.
//!
//! Input: grey pictures ([`GrayImage`]). Output: features (`features::detect`) and matched pairs of
//! them (`pairs::pairs`). `check` compares cameras with the matches; `poses` estimates cameras
//! from them. Equal inputs give equal results.

pub(crate) mod align;
pub(crate) mod descriptors;
pub(crate) mod features;
mod image;
pub(crate) mod pairs;
pub(crate) mod random;

pub use image::GrayImage;
