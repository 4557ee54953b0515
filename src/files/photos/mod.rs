//! Photographs and pictures: decoding, metadata, lens distortion, sizes.

mod decode;
pub mod exif;
mod heic;
mod icc;
pub mod image;
mod jpeg;
pub mod photograph;
pub mod resize;
mod rgb_image;
pub mod undistort;
