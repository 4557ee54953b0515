//! Cameras of photographs, in every layout that is read or written.

pub(super) mod assemble;
pub mod bundler;
pub mod cameras_json;
pub mod colmap;
pub mod find;
mod json;
pub mod llff;
mod load;
pub mod matrices;
pub mod metashape;
mod nerfstudio;
mod notes;
mod opensfm;
pub(in crate::files) mod panoramas;
mod polycam;
pub mod protocol;
pub mod re10k;
pub mod reading;
pub mod reality_capture;
mod record3d;
mod rotations;
pub mod scene;
pub mod transforms;
mod without_camera;
