//! Two posed photographs in, 3D Gaussians dense enough for a screen two to four
//! times sharper out, and new views of them: on any CPU, with no Python and no CUDA.
//!
//! The method is *SubSplat: High-Resolution Pixel-aligned 3DGS via Sub-pixel Gaussian
//! Reparameterization* on its MVSplat backbone.
//!
//! ```
//! use subsplat::io::{save_splats, scene::load_scene};
//! use subsplat::pipeline::{Photo, Reconstructor, Request};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let scene = load_scene("examples/room".as_ref())?;
//! let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
//! let model = Reconstructor::shipped(2)?; // or ::load(weights)
//! let room = model.reconstruct(&photos, &Request::default())?;
//! let camera = room.inputs[0].target_camera; // any camera
//! let options = model.raster_options(room.near_far.0, &room.inputs);
//! let picture = subsplat::render(&room.splats, &camera, &options);
//! assert_eq!((picture.width, picture.height, room.splats.len()), (512, 512, 524_288));
//! # let out = std::env::temp_dir().join(format!("subsplat-doc-{}.ply", std::process::id()));
//! # let room_ply = out.as_path();
//! save_splats(room_ply, &room.splats, &Default::default())?;
//! # std::fs::remove_file(out)?;
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
//! Devices: [`device`] parses the choice of a device, [`backend`] opens it for the ops and the
//! renderer.
//!
//! Features, both default: `cli` builds the programs `subsplat` and `subsplat-convert`; `gpu` the
//! WGSL kernels ([`gpu`]). `view` adds `subsplat view`, a window.

pub mod abi;
pub mod backend;
pub mod camera;
pub mod check;
pub mod config;
pub mod cpu;
pub mod data;
pub mod device;
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

pub use backend::Backend;
pub use device::DeviceChoice;
pub use ops::rasterize_splats as rasterize;
pub use render::{Picture, render};
