//! One renderer for any device: the CPU's kernels, or a GPU's with the CPU's behind them.

use super::{Picture, slices};
use crate::abi::{Gradients, RasterOptions, Rendered, SplatSlices};
use crate::camera::Camera;
use crate::cpu;
#[cfg(feature = "gpu")]
use crate::gpu;
use crate::splats::Splats;
use thiserror::Error;

/// Why a device does not render.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{0}")]
pub struct DeviceError(String);

/// Renders splats on the device that was asked for, and on the CPU where that fails.
#[derive(Debug)]
pub struct Renderer {
    cpu: cpu::Rasterizer,
    backend: Backend,
    warning: Option<String>,
}

#[derive(Debug)]
enum Backend {
    Cpu,
    #[cfg(feature = "gpu")]
    Gpu(gpu::Rasterizer),
}

impl Default for Renderer {
    /// The CPU's.
    fn default() -> Self {
        Self { cpu: cpu::Rasterizer::new(), backend: Backend::Cpu, warning: None }
    }
}

impl Renderer {
    /// The renderer of `device`: `cpu`; `auto`, a GPU where there is one that is no
    /// software adapter; `gpu`, any adapter; else an adapter by a part of its name.
    ///
    /// # Errors
    /// A GPU was asked for and none answers, or the library was built without one.
    pub fn open(device: &str) -> Result<Self, DeviceError> {
        let backend = Backend::open(device)?;
        Ok(Self { backend, ..Self::default() })
    }

    /// The renderer of a GPU that is open already.
    #[cfg(feature = "gpu")]
    pub fn with_gpu(gpu: std::sync::Arc<gpu::Gpu>) -> Self {
        Self { backend: Backend::Gpu(gpu::Rasterizer::new(gpu)), ..Self::default() }
    }

    /// [`Renderer::open`], but the CPU's with a warning where that fails.
    pub fn open_or_cpu(device: &str) -> Self {
        Self::open(device).unwrap_or_else(|e| Self {
            warning: Some(format!("{e}; rendering on the CPU")),
            ..Self::default()
        })
    }

    /// What renders now: `CPU`, or the adapter.
    pub fn device(&self) -> String {
        match &self.backend {
            Backend::Cpu => "CPU".to_owned(),
            #[cfg(feature = "gpu")]
            Backend::Gpu(rasterizer) => rasterizer.gpu().adapter().to_string(),
        }
    }

    /// What the caller should tell, once.
    pub fn take_warning(&mut self) -> Option<String> {
        self.warning.take()
    }

    /// Renders `splats` seen by `camera`, in the splats' own SH basis. Where a GPU fails,
    /// the CPU takes over for good, and there is a warning to take.
    pub fn render(&mut self, splats: &Splats, camera: &Camera, options: &RasterOptions) -> Picture {
        let options = RasterOptions { sh_basis: splats.sh_basis, ..*options };
        let rendered = match self.render_slices(&slices(splats), camera, &options) {
            Ok(rendered) => rendered,
            Err(e) => {
                self.warning = Some(format!("{e}; rendering on the CPU"));
                self.backend = Backend::Cpu;
                self.cpu.render(&slices(splats), camera, &options)
            }
        };
        Picture::from(rendered)
    }

    /// Renders on the device itself, without another behind it.
    ///
    /// # Errors
    /// The GPU refuses, is lost or is too small.
    pub fn render_slices(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Rendered, DeviceError> {
        match &mut self.backend {
            Backend::Cpu => Ok(self.cpu.render(splats, camera, options)),
            #[cfg(feature = "gpu")]
            Backend::Gpu(rasterizer) => {
                rasterizer.render(splats, camera, options).map_err(|e| DeviceError(e.to_string()))
            }
        }
    }
}

impl Renderer {
    /// Gradients of a loss whose gradient with respect to the planes `[5, H, W]` of this
    /// view (R, G, B, alpha, Σ w·z) is `gradients`, by the device itself.
    ///
    /// # Errors
    /// As [`Renderer::render_slices`].
    pub fn backward(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        gradients: &[f32],
    ) -> Result<Gradients, DeviceError> {
        match &mut self.backend {
            Backend::Cpu => {
                let mut out = Gradients::default();
                self.cpu.backward(splats, camera, options, gradients, &mut out);
                Ok(out)
            }
            #[cfg(feature = "gpu")]
            Backend::Gpu(rasterizer) => rasterizer
                .backward(splats, camera, options, gradients)
                .map_err(|e| DeviceError(e.to_string())),
        }
    }
}

impl Backend {
    #[cfg(feature = "gpu")]
    fn open(device: &str) -> Result<Self, DeviceError> {
        let choice = device.parse::<gpu::DeviceChoice>().unwrap_or_default();
        match gpu::Gpu::open(&choice).map_err(|e| DeviceError(e.to_string()))? {
            Some(gpu) => Ok(Self::Gpu(gpu::Rasterizer::new(gpu))),
            None => Ok(Self::Cpu),
        }
    }

    #[cfg(not(feature = "gpu"))]
    fn open(device: &str) -> Result<Self, DeviceError> {
        match device.to_ascii_lowercase().as_str() {
            "cpu" | "auto" => Ok(Self::Cpu),
            _ => Err(DeviceError(format!(
                "device {device}: expected cpu, as this build has no feature `gpu`"
            ))),
        }
    }
}
