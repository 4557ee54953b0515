//! Photographs and pictures: decoding, metadata, lens distortion, sizes; frames of videos.

mod decode;
pub mod exif;
pub mod folder;
mod heic;
mod icc;
pub mod image;
mod jpeg;
pub(in crate::files) mod masks;
pub mod photograph;
pub mod resize;
mod rgb_image;
pub mod undistort;
pub mod video;
