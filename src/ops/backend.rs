//! Where an op runs: the CPU kernels, or their WGSL twins on a GPU, chosen per call by one
//! handle. Tensors stay candle's, on the CPU; what a GPU cannot do (`f64`, more samples
//! than its kernel holds, a lost device) the CPU does, and [`Backend::warning`] says so.
//! Tests: tests/gpu_ops.rs.

#[cfg(feature = "gpu")]
use crate::gpu::{DeviceChoice, Gpu, GpuError};
#[cfg(feature = "gpu")]
use std::sync::{Arc, OnceLock};
use thiserror::Error;

/// Why a device does not open.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{0}")]
pub struct NoDevice(String);

/// The CPU kernels, or a GPU's. Clones share the GPU and its warning.
#[derive(Clone, Debug, Default)]
pub enum Backend {
    /// [`crate::cpu`].
    #[default]
    Cpu,
    /// [`crate::gpu`].
    #[cfg(feature = "gpu")]
    Wgpu(Arc<Offload>),
}

/// An opened GPU, and why it did not do everything.
#[cfg(feature = "gpu")]
#[derive(Debug)]
pub struct Offload {
    gpu: Arc<Gpu>,
    refused: OnceLock<GpuError>,
}

#[cfg(feature = "gpu")]
impl From<Arc<Gpu>> for Backend {
    fn from(gpu: Arc<Gpu>) -> Self {
        Self::Wgpu(Arc::new(Offload { gpu, refused: OnceLock::new() }))
    }
}

impl Backend {
    /// The kernels of `device`: `cpu`; `auto`, a GPU where there is one that is no software
    /// adapter; `gpu`, any adapter; else an adapter by a part of its name.
    ///
    /// # Errors
    /// A GPU was asked for and none answers, or the library was built without one.
    #[cfg(feature = "gpu")]
    pub fn open(device: &str) -> Result<Self, NoDevice> {
        let choice = device.parse::<DeviceChoice>().unwrap_or_default();
        let gpu = Gpu::open(&choice).map_err(|e| NoDevice(e.to_string()))?;
        Ok(gpu.map_or(Self::Cpu, Self::from))
    }

    /// The kernels of `device`: `cpu` or `auto`, as this build has no feature `gpu`.
    ///
    /// # Errors
    /// Another device.
    #[cfg(not(feature = "gpu"))]
    pub fn open(device: &str) -> Result<Self, NoDevice> {
        match device.to_ascii_lowercase().as_str() {
            "cpu" | "auto" => Ok(Self::Cpu),
            _ => Err(NoDevice(format!(
                "device {device}: expected cpu, as this build has no feature `gpu`"
            ))),
        }
    }

    /// Whether everything is meant for the CPU.
    pub fn is_cpu(&self) -> bool {
        matches!(self, Self::Cpu)
    }

    /// Why the CPU first did what was meant for the GPU; `None` where it did not.
    pub fn warning(&self) -> Option<String> {
        match self {
            Self::Cpu => None,
            #[cfg(feature = "gpu")]
            Self::Wgpu(offload) => {
                offload.refused.get().map(|e| format!("{e}; the CPU does this instead"))
            }
        }
    }

    /// `f` on the GPU; `None` where the CPU is to do it.
    #[cfg(feature = "gpu")]
    pub(super) fn offload<R>(&self, f: impl FnOnce(&Arc<Gpu>) -> Result<R, GpuError>) -> Option<R> {
        let Self::Wgpu(offload) = self else { return None };
        match f(&offload.gpu) {
            Ok(done) => Some(done),
            Err(e) => {
                // The first reason is the one that is told.
                let _ = offload.refused.set(e);
                None
            }
        }
    }
}
