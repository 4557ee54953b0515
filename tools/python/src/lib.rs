//! The native module of the Python package `subsplat`.
//!
//! Python code in `python/subsplat/` has the public names, their documentation and their defaults; this
//! module has what needs the library. Every function releases the interpreter's lock while it
//! computes. An array that is passed is read in place: no function copies one.
//!
//! * `arrays.rs`, `numbers.rs`: numpy arrays to slices and numbers, with one clear exception for each kind of misfit.
//! * `raster.rs`, `camera_gradients.rs`: the rasterizer, forward and backward.
//! * `camera.rs`, `scene.rs`, `photographs.rs`, `reconstruct.rs`: the classes and the calls on photographs.
//! * `work.rs`: long calls, which hear Ctrl-C and report progress.

#![forbid(unsafe_code)]

mod arrays;
mod camera;
mod camera_gradients;
mod error;
mod numbers;
mod photographs;
mod raster;
mod reconstruct;
mod scene;
mod work;

use pyo3::prelude::*;

/// Large blocks on huge pages: the network and the gradients allocate hundreds of megabytes.
#[global_allocator]
static PAGES: subsplat_cli::pages::Pages = subsplat_cli::pages::Pages;
/// Free memory that stays for the next call, bytes. Python frees pictures and gradients late: without it each
/// step of a training with PyTorch maps its gradients anew, a seventh of its time at 131,072 Gaussians.
const KEPT_FREE: usize = 128 << 20;

/// Functions and classes of the package `subsplat`, without its defaults.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    subsplat_cli::pages::keep_free(KEPT_FREE);
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<camera::Camera>()?;
    module.add_class::<raster::Frame>()?;
    module.add_class::<scene::Scene>()?;
    module.add_function(wrap_pyfunction!(raster::rasterize, module)?)?;
    module.add_function(wrap_pyfunction!(scene::load, module)?)?;
    module.add_function(wrap_pyfunction!(photographs::photographs, module)?)?;
    module.add_function(wrap_pyfunction!(reconstruct::reconstruct, module)?)?;
    module.add_function(wrap_pyfunction!(reconstruct::estimate_cameras, module)?)?;
    module.add_function(wrap_pyfunction!(reconstruct::check, module)?)?;
    Ok(())
}
