//! Photographs and pictures: decoding, metadata, lens distortion, sizes; frames of videos.

mod converted;
mod decode;
pub mod distortion;
pub mod exif;
pub mod folder;
mod heic;
mod heif;
mod icc;
pub mod image;
mod jpeg;
mod jxl;
pub(in crate::files) mod masks;
pub mod notes;
pub mod photograph;
mod programs;
mod ranges;
mod raw;
mod reduced;
pub mod resize;
mod rgb_image;
pub mod shape;
mod tiff_tags;
pub mod undistort;
pub mod video;
pub mod views;
