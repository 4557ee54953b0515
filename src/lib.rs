//! `subsplat` turns two or more photographs into 3D Gaussians dense enough for views two to four
//! times sharper than the network's input, on any CPU or GPU, without Python or CUDA.
//!
//! The method is *SubSplat: High-Resolution Pixel-aligned 3DGS via Sub-pixel Gaussian
//! Reparameterization* on its MVSplat backbone.
//!
#![cfg_attr(feature = "network", doc = "```")]
#![cfg_attr(not(feature = "network"), doc = "```ignore")]
//! use subsplat::{DepthBounds, Options, Photo, Reconstructor, load_scene};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let scene = load_scene("examples/room")?;
//! let photos = [Photo::from_frame(&scene.frames[0])?, Photo::from_frame(&scene.frames[1])?];
//! let options = Options::default().with_depth_prior(DepthBounds::of_scene(&scene, &[0, 1])?);
//! let model = Reconstructor::shipped(2)?; // or ::load("weights.safetensors", None)
//! let room = model.run(&photos, &options)?;
//! let picture = room.render(&scene.frames[2].camera); // any camera
//! assert_eq!((picture.width, picture.height), (512, 512));
//! # let out = std::env::temp_dir().join(format!("subsplat-doc-{}.ply", std::process::id()));
//! # let room_ply = out.as_path();
//! room.save(room_ply)?;
//! # std::fs::remove_file(room_ply)?;
//! # Ok(())
//! # }
//! ```
//!
//! A viewer needs no network. This loads a file and draws it from a camera that sees all of it:
//!
//! ```
//! use subsplat::{Bounds, RasterOptions, Rgb, load_splats, save_png};
//! use subsplat::scene::render;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # use subsplat::{SaveOptions, ShBasis, Splats, save_splats};
//! # let folder = std::env::temp_dir();
//! # let file = |end| folder.join(format!("subsplat-doc-{}.{end}", std::process::id()));
//! # let (room_ply, view_png) = (&file("view.ply"), &file("view.png"));
//! # let row = |x| [x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.9];
//! # let rows = [-1.0, -0.5, 0.5, 1.0].map(row).concat();
//! # let four = Splats::new(rows, vec![0.5; 12], vec![], 0, ShBasis::default())?;
//! # save_splats(room_ply, &four, &SaveOptions::default())?;
//! let splats = load_splats(room_ply)?;
//! let bounds = Bounds::of(splats.means()).ok_or("the file holds no Gaussian")?;
//! let camera = bounds.camera(60f32.to_radians(), 512)?; // 512x512 pixels, along the world's +z
//! let picture = render(&splats, &camera, &RasterOptions::default());
//! save_png(view_png, &Rgb::from(&picture))?;
//! # assert!(picture.alpha[256 * 512 + 256] > 0.5);
//! # std::fs::remove_file(room_ply)?;
//! # std::fs::remove_file(view_png)?;
//! # Ok(())
//! # }
//! ```
//!
//! * `Reconstructor` runs the network: photographs and cameras to a `Reconstruction`.
//! * [`render()`] and [`Renderer`] draw any [`Splats`]; `rasterize` draws `SplatTensors` with
//!   gradients.
//! * [`load_scene`], [`load_splats`] and [`save_splats`] read and write files.
//! * `estimate_cameras` and `estimate_cameras_of_files` estimate the cameras of photographs that
//!   have none, in memory and in files; the module `cameras::estimation` holds options and results of the poses.
//! * The modules hold reports, options and types that are seldom named: [`scene`], [`files`], [`cameras`],
//!   [`finish`], `reconstruct`. The modules `network` and [`kernels`] carry no promise between versions.
//! * [`Camera`] and [`Intrinsics`] define all geometric conventions: OpenCV axes, pixel centres
//!   at +0.5, `world_from_camera`.
//!
//! # Features
//!
//! * `network` (default): the network, its training and its scores, on candle. Without it the
//!   crate has cameras, splats, their files and the rasterizer.
//! * `gpu` (default): the kernels as WGSL compute, through wgpu. In a browser (WebGPU) a program
//!   supplies the wait for the device: `kernels::gpu::set_gpu_wait`.
//! * `heic`: reads HEIC pictures, the default format of iPhones, in pure Rust.

#![forbid(unsafe_code)]

pub mod cameras;
pub mod files;
pub mod finish;
#[cfg(feature = "network")]
pub mod network;
#[cfg(feature = "network")]
pub mod reconstruct;
pub mod scene;

pub use glam;
pub use image;
pub use subsplat_kernels as kernels;

#[cfg(feature = "network")]
pub use crate::network::config::{Config, ConfigError, Preset};
#[cfg(feature = "network")]
pub use crate::network::ops::{SplatTensors, rasterize_splats as rasterize};
#[cfg(feature = "network")]
pub use crate::reconstruct::{
    Check, Density, DepthBounds, DepthRange, Detail, Error, EstimateOptions, EstimatedPhotos,
    EstimatedScene, InputSize, KnownLens, LensSource, Matching, Options, Photo, Photographs, Poses,
    Prepared, Progress, Quality, Reconstruction, Reconstructor, Refine, Result, SceneSoFar, Stage,
    Surroundings, TargetSize, Warning, estimate_cameras, estimate_cameras_of_files,
};
pub use files::photos::image::{LoadOptions, save_depth_png, save_png};
pub use files::photos::photograph::{Photograph, load_photograph, parse_photograph};
pub use files::poses::reading::SceneOptions;
pub use files::poses::scene::{Frame, Scene, load_scene, load_scene_with};
pub use files::{
    Error as FileError, SaveOptions, SplatFormat, Up, encode_splats, load_splats, parse_splats,
    save_splats,
};
pub use finish::{FinishError, FitOptions, TargetView};
pub use scene::mask::Mask;
pub use scene::navigation::Bounds;
pub use scene::pictures::{Depth, Rgb};
pub use scene::render::{Picture, Renderer, render};
pub use scene::splats::{Splats, SplatsError};
pub use subsplat_kernels::backend::{Backend, DeviceError};
pub use subsplat_kernels::camera::{Camera, CameraError, Intrinsics, NearFar, Size};
pub use subsplat_kernels::device::DeviceChoice;
pub use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};
