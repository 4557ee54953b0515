//! An opened device: the CPU kernels, or their WGSL versions on a GPU.
//!
//! One [`Backend`] serves the network's ops and the `subsplat::scene::render::Renderer`. Tensors stay in
//! host memory. The CPU kernels take over calls that the GPU cannot execute: `f64`, more samples
//! than the kernel supports, a lost device. [`Backend::warning`] then returns the reason.
//!
//! Tests: tests/gpu/ops.rs, tests/gpu/model.rs.

use crate::device::DeviceChoice;
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError};
#[cfg(feature = "gpu")]
use std::sync::{Arc, OnceLock};
use thiserror::Error;

/// A device that cannot be opened, or that fails to render.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum DeviceError {
    /// The GPU is absent, too small, lost, or rejects a command.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The library was built without the feature `gpu`.
    #[error("device {device}: expected cpu, as this build has no feature `gpu`")]
    NoGpuFeature {
        /// The requested device.
        device: String,
    },
}

/// The CPU kernels, or those of one GPU. Clones share the GPU and its warning.
#[derive(Clone, Debug, Default)]
pub enum Backend {
    /// The kernels of [`crate::cpu`].
    #[default]
    Cpu,
    /// The kernels of [`crate::gpu`].
    #[cfg(feature = "gpu")]
    Wgpu(Arc<Offload>),
}

/// An opened GPU and the first error that sent a call to the CPU.
#[cfg(feature = "gpu")]
#[derive(Debug)]
pub struct Offload {
    gpu: Arc<Gpu>,
    first_error: OnceLock<GpuError>,
}

#[cfg(feature = "gpu")]
impl From<Arc<Gpu>> for Backend {
    fn from(gpu: Arc<Gpu>) -> Self {
        Self::Wgpu(Arc::new(Offload { gpu, first_error: OnceLock::new() }))
    }
}

impl Backend {
    /// Opens `device`: `cpu`, `auto`, `gpu`, or a part of an adapter's name
    /// ([`DeviceChoice`]).
    ///
    /// # Errors
    /// As [`Backend::new`].
    pub fn open(device: &str) -> Result<Self, DeviceError> {
        let Ok(choice) = device.parse();
        Self::new(&choice)
    }

    /// Opens the device of `choice`.
    ///
    /// # Errors
    /// [`DeviceError::Gpu`] where no adapter matches or its driver opens no device.
    #[cfg(feature = "gpu")]
    pub fn new(choice: &DeviceChoice) -> Result<Self, DeviceError> {
        Ok(Gpu::open(choice)?.map_or(Self::Cpu, Self::from))
    }

    /// Opens the device of `choice`; without the feature `gpu`, only [`DeviceChoice::Cpu`] and
    /// [`DeviceChoice::Auto`] exist.
    ///
    /// # Errors
    /// [`DeviceError::NoGpuFeature`] for every other choice.
    #[cfg(not(feature = "gpu"))]
    pub fn new(choice: &DeviceChoice) -> Result<Self, DeviceError> {
        let device = match choice {
            DeviceChoice::Cpu | DeviceChoice::Auto => return Ok(Self::Cpu),
            DeviceChoice::Gpu => "gpu".to_owned(),
            DeviceChoice::Named(name) => name.clone(),
        };
        Err(DeviceError::NoGpuFeature { device })
    }

    /// Returns whether every call runs on the CPU.
    pub fn is_cpu(&self) -> bool {
        matches!(self, Self::Cpu)
    }

    /// Returns the GPU; `None` for the CPU kernels.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> Option<&Arc<Gpu>> {
        match self {
            Self::Cpu => None,
            Self::Wgpu(offload) => Some(&offload.gpu),
        }
    }

    /// Returns why the CPU first took over a call of the GPU; `None` where it never did.
    pub fn warning(&self) -> Option<String> {
        match self {
            Self::Cpu => None,
            #[cfg(feature = "gpu")]
            Self::Wgpu(offload) => {
                offload.first_error.get().map(|e| format!("{e}; the CPU does this instead"))
            }
        }
    }

    /// Runs `f` on the GPU; `None` where the caller must use the CPU kernels.
    #[cfg(feature = "gpu")]
    pub fn offload<R>(&self, f: impl FnOnce(&Arc<Gpu>) -> Result<R, GpuError>) -> Option<R> {
        let Self::Wgpu(offload) = self else { return None };
        match f(&offload.gpu) {
            Ok(result) => Some(result),
            Err(e) => {
                // Only the first error is reported.
                let _ = offload.first_error.set(e);
                None
            }
        }
    }
}
