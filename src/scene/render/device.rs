//! One renderer for every device: the CPU rasterizer, or a GPU's with the CPU as fallback.

use super::{Picture, slices};
use crate::scene::splats::Splats;
use subsplat_kernels::backend::Backend;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu;
#[cfg(feature = "gpu")]
use subsplat_kernels::gpu;
use subsplat_kernels::layout::{Gradients, RasterOptions, Rendered, SplatSlices};

pub use subsplat_kernels::backend::DeviceError;

/// Renders splats on the chosen device, and on the CPU after an error of that device.
#[derive(Debug)]
pub struct Renderer {
    cpu: cpu::Rasterizer,
    rasterizer: Rasterizer,
    warning: Option<String>,
}

/// The rasterizer that renders now.
#[derive(Debug)]
enum Rasterizer {
    Cpu,
    #[cfg(feature = "gpu")]
    Gpu(gpu::Rasterizer),
}

impl Default for Renderer {
    /// Renders on the CPU.
    fn default() -> Self {
        Self::new(&Backend::Cpu)
    }
}

impl Renderer {
    /// Opens `device`: `cpu`, `auto`, `gpu`, or a part of an adapter's name
    /// ([`subsplat_kernels::device::DeviceChoice`]).
    ///
    /// # Errors
    /// As [`Backend::open`].
    pub fn open(device: &str) -> Result<Self, DeviceError> {
        Backend::open(device).map(|backend| Self::new(&backend))
    }

    /// Renders on the device of `backend`.
    pub fn new(backend: &Backend) -> Self {
        let rasterizer = match backend {
            Backend::Cpu => Rasterizer::Cpu,
            #[cfg(feature = "gpu")]
            Backend::Wgpu(_) => backend
                .gpu()
                .map_or(Rasterizer::Cpu, |gpu| Rasterizer::Gpu(gpu::Rasterizer::new(gpu.clone()))),
        };
        Self { cpu: cpu::Rasterizer::new(), rasterizer, warning: None }
    }

    /// Renders on an opened GPU.
    #[cfg(feature = "gpu")]
    pub fn with_gpu(gpu: std::sync::Arc<gpu::Gpu>) -> Self {
        Self::new(&Backend::from(gpu))
    }

    /// Opens `device` as [`Renderer::open`] does; on an error, renders on the CPU and keeps the
    /// error as a warning.
    pub fn open_or_cpu(device: &str) -> Self {
        Self::open(device).unwrap_or_else(|e| Self {
            warning: Some(format!("{e}; rendering on the CPU")),
            ..Self::default()
        })
    }

    /// Returns the GPU that renders now.
    #[cfg(feature = "gpu")]
    pub(crate) fn gpu(&self) -> Option<&std::sync::Arc<gpu::Gpu>> {
        match &self.rasterizer {
            Rasterizer::Cpu => None,
            Rasterizer::Gpu(rasterizer) => Some(rasterizer.gpu()),
        }
    }

    /// Returns the name of the device that renders now: `CPU`, or the adapter.
    pub fn device(&self) -> String {
        match &self.rasterizer {
            Rasterizer::Cpu => "CPU".to_owned(),
            #[cfg(feature = "gpu")]
            Rasterizer::Gpu(rasterizer) => rasterizer.gpu().adapter().to_string(),
        }
    }

    /// Returns and clears the pending warning.
    pub fn take_warning(&mut self) -> Option<String> {
        self.warning.take()
    }

    /// Renders `splats` as seen by `camera`, in the SH basis of the splats.
    ///
    /// After an error of the GPU, this call and all later ones render on the CPU, and
    /// [`Renderer::take_warning`] returns the error.
    pub fn render(&mut self, splats: &Splats, camera: &Camera, options: &RasterOptions) -> Picture {
        let options = RasterOptions { sh_basis: splats.sh_basis, ..*options };
        let rendered = match self.render_slices(&slices(splats), camera, &options) {
            Ok(rendered) => rendered,
            Err(e) => {
                self.use_cpu(&e);
                self.cpu.render(&slices(splats), camera, &options)
            }
        };
        Picture::from(rendered)
    }

    /// Renders on the current device, without the CPU as fallback.
    ///
    /// # Errors
    /// [`DeviceError::Gpu`] where the GPU is too small, lost, or rejects a command.
    pub fn render_slices(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Rendered, DeviceError> {
        match &mut self.rasterizer {
            Rasterizer::Cpu => Ok(self.cpu.render(splats, camera, options)),
            #[cfg(feature = "gpu")]
            Rasterizer::Gpu(rasterizer) => Ok(rasterizer.render(splats, camera, options)?),
        }
    }

    /// Renders planes `[5, H, W]`: R, G, B, alpha, Σ w·z. After an error of the GPU, this call
    /// and all later ones use the CPU.
    pub(crate) fn render_planes(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Vec<f32> {
        #[cfg(feature = "gpu")]
        if let Rasterizer::Gpu(rasterizer) = &mut self.rasterizer {
            match rasterizer.render_planes(splats, camera, options) {
                Ok(planes) => return planes,
                Err(e) => self.use_cpu(&e),
            }
        }
        let mut planes = Vec::new();
        self.cpu.render_planes(splats, camera, options, &mut planes);
        planes
    }

    /// Renders planes as [`Renderer::render_planes`] does, passes them to `loss`, which returns
    /// the gradient by each of their elements, and writes the gradients by the splats to `out`,
    /// within its [`Gradients::sh_limit`]. `loss` is called again where a GPU fails.
    pub(crate) fn gradients_of(
        &mut self,
        splats: &SplatSlices,
        camera: &Camera,
        options: &RasterOptions,
        out: &mut Gradients,
        loss: &mut dyn FnMut(&[f32]) -> Vec<f32>,
    ) {
        #[cfg(feature = "gpu")]
        if let Rasterizer::Gpu(rasterizer) = &mut self.rasterizer {
            let frame = rasterizer.frame(splats, camera, options);
            match frame.and_then(|(planes, mut frame)| frame.backward(&loss(&planes))) {
                Ok(gradients) => {
                    *out = gradients.limited(splats.sh_degree, out.sh_limit);
                    return;
                }
                Err(e) => self.use_cpu(&e),
            }
        }
        let mut planes = Vec::new();
        let mut frame = self.cpu.frame(*splats, camera, options, &mut planes);
        frame.backward(&loss(&planes), out);
    }

    /// Renders on the CPU from now on, and keeps the reason as a warning.
    fn use_cpu(&mut self, reason: &dyn std::fmt::Display) {
        self.warning = Some(format!("{reason}; rendering on the CPU"));
        self.rasterizer = Rasterizer::Cpu;
    }

    /// Computes the gradients of a loss with respect to the splats, on the current device and
    /// without the CPU as fallback.
    ///
    /// `gradients` `[5, H, W]`: gradient of the loss with respect to R, G, B, alpha and Σ w·z of
    /// this view.
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
        match &mut self.rasterizer {
            Rasterizer::Cpu => {
                let mut out = Gradients::default();
                self.cpu.backward(splats, camera, options, gradients, &mut out);
                Ok(out)
            }
            #[cfg(feature = "gpu")]
            Rasterizer::Gpu(rasterizer) => {
                Ok(rasterizer.backward(splats, camera, options, gradients)?)
            }
        }
    }
}
