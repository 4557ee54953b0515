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
//! # std::fs::remove_file(room_ply)?;
//! # Ok(())
//! # }
//! ```
//!
//! A viewer needs no network. This loads a file and draws it from a camera that sees all of it:
//!
//! ```
//! use subsplat::{Bounds, RasterOptions, Rgb, load_splats, render, save_png};
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
//! * `loose_photos` and `loose_scene` estimate the cameras of photographs that have none, in memory
//!   and in files; the module `loose` holds their options and results.
//! * [`details`] holds reports, and types that are seldom named.
//! * [`Camera`] and [`Intrinsics`] define all geometric conventions: OpenCV axes, pixel centres
//!   at +0.5, `world_from_camera`.
//!
//! # Features
//!
//! * `network` (default): the network, its training and its scores, on candle. Without it the
//!   crate has cameras, splats, their files and the rasterizer.
//! * `gpu` (default): the kernels as WGSL compute, through wgpu. In a browser (WebGPU) a program
//!   supplies the wait for the device: `details::set_gpu_wait`.
//! * `heic`: reads HEIC pictures, the default format of iPhones, in pure Rust.
//! * `internals`: makes the modules with kernels, ops and network parts public. No version
//!   promises anything about them.

#![cfg_attr(
    not(feature = "internals"),
    allow(
        dead_code,
        unused_imports,
        rustdoc::private_intra_doc_links,
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
mod clock;
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
#[cfg(feature = "internals")]
pub mod fit;
#[cfg(all(feature = "internals", feature = "gpu"))]
pub mod gpu;
#[cfg(feature = "internals")]
pub mod io;
#[cfg(feature = "internals")]
pub mod levels;
#[cfg(feature = "internals")]
pub mod loss;
#[cfg(feature = "internals")]
pub mod matches;
#[cfg(feature = "internals")]
pub mod merge;
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
pub mod poses;
#[cfg(feature = "internals")]
pub mod reduce;
#[cfg(feature = "internals")]
pub mod refine;
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
#[cfg(not(feature = "internals"))]
mod fit;
#[cfg(all(not(feature = "internals"), feature = "gpu"))]
mod gpu;
#[cfg(not(feature = "internals"))]
mod io;
#[cfg(not(feature = "internals"))]
mod levels;
#[cfg(not(feature = "internals"))]
mod loss;
#[cfg(not(feature = "internals"))]
mod matches;
#[cfg(not(feature = "internals"))]
mod merge;
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
mod poses;
#[cfg(not(feature = "internals"))]
mod reduce;
#[cfg(not(feature = "internals"))]
mod refine;
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
pub use image;

pub use abi::{Convention, RasterOptions, ShBasis};
pub use backend::{Backend, DeviceError};
pub use camera::{Camera, CameraError, Intrinsics, NearFar, Size};
#[cfg(feature = "network")]
pub use config::{Config, ConfigError, Preset};
pub use device::DeviceChoice;
pub use fit::FitOptions;
pub use io::image::{Depth, LoadOptions, Rgb, save_depth_png, save_png};
pub use io::photograph::{Photograph, load_photograph, parse_photograph};
pub use io::scene::{Frame, Scene, load_scene};
pub use io::{
    Error as FileError, SaveOptions, SplatFormat, Up, encode_splats, load_splats, parse_splats,
    save_splats,
};
pub use navigation::Bounds;
#[cfg(feature = "network")]
pub use ops::{SplatTensors, rasterize_splats as rasterize};
#[cfg(feature = "network")]
pub use pipeline::{
    Check, Density, DepthBounds, DepthRange, Detail, Error, InputSize, Options, Photo, Poses,
    Prepared, Progress, Reconstruction, Reconstructor, Refine, Result, Stage, TargetSize, Warning,
    loose_photos, loose_scene,
};
pub use render::{Picture, Renderer, render};
pub use splats::{Splats, SplatsError};

// Names that programs, tests and benches of this repository use beside the modules.
#[cfg(feature = "internals")]
pub use check::{CheckOptions, GrayImage, check_pair};
#[cfg(feature = "internals")]
pub use data::exposure::{Exposure, ExposureError, PointPair, estimate_exposure};
#[cfg(feature = "internals")]
pub use details::*;
#[cfg(feature = "internals")]
pub use fit::fit;
#[cfg(all(feature = "internals", feature = "gpu"))]
pub use gpu::Rasterizer as GpuRasterizer;
#[cfg(feature = "internals")]
pub use io::cameras_json::{CameraFile, NamedCamera, load_cameras_json, save_cameras_json};
#[cfg(feature = "internals")]
pub use io::exif::{ExifReport, parse_exif};
#[cfg(feature = "internals")]
pub use io::photograph::{PhotographHeader, probe_photograph};
#[cfg(all(feature = "internals", feature = "network"))]
pub use loose::*;
#[cfg(feature = "internals")]
pub use metrics::{psnr, ssim};
#[cfg(feature = "internals")]
pub use navigation::{Mode, Navigator, Pace, Start};
#[cfg(feature = "internals")]
pub use poses::{Lens, PosePhoto, adjust_poses, estimate_poses};
#[cfg(feature = "internals")]
pub use refine::refine;
#[cfg(feature = "internals")]
pub use splats::{Quantiles, SplatStatistics};

/// Types that an application reads or sets rarely: reports of a reconstruction, its inputs and its
/// refinement, details of scenes and photographs, and the errors beneath [`FileError`] and `Error`.
pub mod details {
    pub use crate::check::{
        DepthReport, EpipolarReport, Finding, MatchedPoint, PairReport, ReadingReport, Verdict,
    };
    #[cfg(feature = "network")]
    pub use crate::data::crop::{CropOptions, CropRule, Cropped, LrFrom, PhotoWindow};
    pub use crate::fit::{FitError, FitReport, FitView};
    #[cfg(all(feature = "gpu", target_family = "wasm", target_os = "unknown"))]
    pub use crate::gpu::set_gpu_wait;
    #[cfg(feature = "gpu")]
    pub use crate::gpu::{Gpu, GpuError};
    pub use crate::io::SaveReport;
    pub use crate::io::exif::{ExifCamera, FocalLength, FocalSource};
    pub use crate::io::image::Truncated;
    pub use crate::io::scene::{LoadedFrame, Pixels, SceneFormat, Units};
    pub use crate::io::undistort::Distortion;
    pub use crate::metrics::MetricsError;
    #[cfg(feature = "network")]
    pub use crate::pipeline::{DepthSource, StageTime};
    pub use crate::refine::{RefineOptions, RefineReport, Refiner};
    pub use crate::splats::SplatParts;
}

/// Options and results of [`loose_photos`] and [`loose_scene`],
/// which estimate the cameras of photographs.
#[cfg(feature = "network")]
pub mod loose {
    pub use crate::pipeline::{
        KnownLens, LensSource, LooseOptions, LoosePhotos, LooseScene, PoseError,
    };
    pub use crate::poses::{
        Confidence, FocalEstimate, LeftOut, PoseAdjustment, PoseEstimate, PoseOptions,
        PosePhotoError, PosePoint, PoseRefusal, PoseWarning, Uncertain,
    };
}
