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
//! Features, both default: `cli` builds the programs `subsplat` and `subsplat-convert`;
//! `gpu` the WGSL kernels ([`gpu`]). `view` adds `subsplat view`, a window.

#![cfg_attr(
    not(feature = "internals"),
    allow(
        dead_code,
        unused_imports,
        reason = "programs, tests and benches use more of the crate than its public items do"
    )
)]

#[cfg(feature = "internals")]
pub mod abi;
#[cfg(feature = "internals")]
pub mod backend;
#[cfg(feature = "internals")]
pub mod camera;
#[cfg(feature = "internals")]
pub mod check;
#[cfg(feature = "internals")]
pub mod config;
#[cfg(feature = "internals")]
pub mod cpu;
#[cfg(feature = "internals")]
pub mod data;
#[cfg(feature = "internals")]
pub mod device;
#[cfg(all(feature = "internals", feature = "network"))]
pub mod eval;
#[cfg(all(feature = "internals", feature = "gpu"))]
pub mod gpu;
#[cfg(feature = "internals")]
pub mod io;
#[cfg(feature = "internals")]
pub mod metrics;
#[cfg(all(feature = "internals", feature = "network"))]
pub mod model;
#[cfg(feature = "internals")]
pub mod navigation;
#[cfg(all(feature = "internals", feature = "network"))]
pub mod ops;
#[cfg(all(feature = "internals", feature = "network"))]
pub mod pipeline;
#[cfg(feature = "internals")]
pub mod render;
#[cfg(feature = "internals")]
pub mod sh;
#[cfg(feature = "internals")]
pub mod splats;
#[cfg(all(feature = "internals", feature = "network"))]
pub mod train;

#[cfg(not(feature = "internals"))]
mod abi;
#[cfg(not(feature = "internals"))]
mod backend;
#[cfg(not(feature = "internals"))]
mod camera;
#[cfg(not(feature = "internals"))]
mod check;
#[cfg(not(feature = "internals"))]
mod config;
#[cfg(not(feature = "internals"))]
mod cpu;
#[cfg(not(feature = "internals"))]
mod data;
#[cfg(not(feature = "internals"))]
mod device;
#[cfg(all(not(feature = "internals"), feature = "network"))]
mod eval;
#[cfg(all(not(feature = "internals"), feature = "gpu"))]
mod gpu;
#[cfg(not(feature = "internals"))]
mod io;
#[cfg(not(feature = "internals"))]
mod metrics;
#[cfg(all(not(feature = "internals"), feature = "network"))]
mod model;
#[cfg(not(feature = "internals"))]
mod navigation;
#[cfg(all(not(feature = "internals"), feature = "network"))]
mod ops;
#[cfg(all(not(feature = "internals"), feature = "network"))]
mod pipeline;
#[cfg(not(feature = "internals"))]
mod render;
#[cfg(not(feature = "internals"))]
mod sh;
#[cfg(not(feature = "internals"))]
mod splats;
#[cfg(all(not(feature = "internals"), feature = "network"))]
mod train;

#[cfg(feature = "network")]
pub use candle_core;
pub use glam;

pub use abi::{Convention, RasterOptions, ShBasis};
pub use backend::{Backend, DeviceError};
pub use camera::{Camera, CameraError, Intrinsics};
pub use check::{CheckOptions, GrayImage, PairReport, Verdict, check_pair};
pub use device::DeviceChoice;
#[cfg(feature = "gpu")]
pub use gpu::Gpu;
pub use io::cameras_json::{CameraFile, NamedCamera, load_cameras_json, save_cameras_json};
pub use io::image::{Depth, Rgb, save_depth_png, save_png};
pub use io::scene::{Frame, Scene, SceneFormat, Units, load_scene};
pub use io::{SaveOptions, SaveReport, SplatFormat, Up, load_splats, save_splats};
pub use metrics::{MetricsError, psnr, ssim};
pub use navigation::{Bounds, Navigator, Start};
#[cfg(feature = "network")]
pub use ops::{SplatTensors, rasterize_splats as rasterize};
#[cfg(feature = "network")]
pub use pipeline::{Photo, Reconstruction, Reconstructor, Request};
pub use render::{Picture, Renderer, render};
pub use splats::{SplatParts, Splats, SplatsError};
