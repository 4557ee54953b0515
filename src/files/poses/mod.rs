//! Cameras of photographs, in every layout that is read or written.

pub(super) mod assemble;
pub mod cameras_json;
pub mod colmap;
pub mod find;
mod json;
pub mod matrices;
pub(in crate::files) mod panoramas;
pub mod protocol;
pub mod re10k;
pub mod scene;
pub mod transforms;
