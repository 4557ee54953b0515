//! Two posed photographs in, 3D Gaussians dense enough for a screen two to four
//! times sharper out, and new views of them: on any CPU, with no Python and no CUDA.
//!
//! The method is *SubSplat: High-Resolution Pixel-aligned 3DGS via Sub-pixel Gaussian
//! Reparameterization* on its MVSplat backbone.
//!
//! ```
//! use subsplat::io::scene::load_scene;
//! use subsplat::{DepthBounds, Options, Photo, Reconstructor};
//!
//! # fn main() -> subsplat::Result<()> {
//! let scene = load_scene("examples/room".as_ref())?;
//! let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
//! let options = Options::default().with_depth_prior(DepthBounds::of_scene(&scene, &[0, 1])?);
//! let model = Reconstructor::shipped(2)?; // or ::load(weights)
//! let room = model.run(&photos, &options)?;
//! let picture = room.render(&scene.frames[2].camera); // any camera
//! assert_eq!((picture.width, picture.height, room.splats().len()), (512, 512, 524_288));
//! # let out = std::env::temp_dir().join(format!("subsplat-doc-{}.ply", std::process::id()));
//! # let room_ply = out.as_path();
//! room.save(room_ply)?;
//! # std::fs::remove_file(room_ply).map_err(|e| subsplat::io::Error::io(room_ply, e))?;
//! # Ok(())
//! # }
//! ```
//!
//! Where to look: [`pipeline`] is the whole path in one call; [`render()`] draws any
//! [`splats::Splats`], [`rasterize`] does so with gradients; [`io`] reads and writes files; [`check`] judges poses; [`eval`] scores methods;
//! [`model`] is the network, its parts usable one by one, configured by
//! [`config::Config`]; [`ops`] are the same kernels as candle ops. Every geometric
//! convention is said once, in [`camera`]; [`navigation`] moves one by hand.
//!
//! Features, both default: `cli` builds the programs `subsplat` and `subsplat-convert`;
//! `gpu` the WGSL kernels ([`gpu`]). `view` adds `subsplat view`, a window.

pub mod abi;
pub mod camera;
pub mod check;
pub mod config;
pub mod cpu;
pub mod data;
pub mod eval;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod io;
pub mod metrics;
pub mod model;
pub mod navigation;
pub mod ops;
pub mod pipeline;
pub mod render;
pub mod sh;
pub mod splats;
pub mod train;
pub mod view;

pub use ops::rasterize_splats as rasterize;
pub use pipeline::{
    Check, DepthBounds, DepthRange, DepthSource, Detail, Error, Options, Photo, PoseError,
    Prepared, Progress, Reconstruction, Reconstructor, Result, Stage, StageTime, Warning,
};
pub use render::{Picture, render};
