//! The surface of a window, and the GPU that draws on it.

use anyhow::{Context, Result, anyhow, ensure};
use std::sync::{Arc, Mutex, PoisonError};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu::{
    DeviceChoice, Gpu, Rasterizer, Scene, features_of, find_for, instance, limits_of, wgpu,
};
use subsplat_kernels::layout::RasterOptions;
use wgpu::CurrentSurfaceTexture as Current;
use winit::window::Window;

/// Formats for drawing and reading back, best first. A surface's other formats have deep or wide
/// colour.
const FORMATS: [wgpu::TextureFormat; 4] = [
    wgpu::TextureFormat::Bgra8Unorm,
    wgpu::TextureFormat::Rgba8Unorm,
    wgpu::TextureFormat::Bgra8UnormSrgb,
    wgpu::TextureFormat::Rgba8UnormSrgb,
];
/// Alignment of a texture's rows in a copy, bytes.
const ROW: u32 = wgpu::COPY_BYTES_PER_ROW_ALIGNMENT;

/// Result of a frame.
pub enum Frame {
    /// The window shows it; with its pixels where they were requested.
    Shown(Option<Rgb>),
    /// The window has no texture now (hidden, being resized).
    Skipped,
}

/// Error that the driver reported outside of a call.
type Fault = Arc<Mutex<Option<String>>>;

/// A window with its GPU.
pub struct Canvas {
    window: Arc<Window>,
    instance: wgpu::Instance,
    surface: wgpu::Surface<'static>,
    config: wgpu::SurfaceConfiguration,
    gpu: Arc<Gpu>,
    rasterizer: Rasterizer,
    fault: Fault,
}

fn surface_of(
    instance: &wgpu::Instance,
    window: &Arc<Window>,
) -> Result<wgpu::Surface<'static>, wgpu::CreateSurfaceError> {
    let target = wgpu::SurfaceTarget::DisplayAndWindow(Box::new(window.clone()));
    instance.create_surface(target)
}

/// Configuration of a surface on this adapter.
fn configuration(
    caps: &wgpu::SurfaceCapabilities,
    (width, height): (u32, u32),
) -> Result<wgpu::SurfaceConfiguration> {
    let format = FORMATS.into_iter().find(|f| caps.formats.contains(f)).with_context(|| {
        format!("window: expected a surface of one of {FORMATS:?}, got {:?}", caps.formats)
    })?;
    // Alpha is the scene's coverage of a pixel; the window itself is opaque.
    let opaque = wgpu::CompositeAlphaMode::Opaque;
    let alpha_mode =
        if caps.alpha_modes.contains(&opaque) { opaque } else { wgpu::CompositeAlphaMode::Auto };
    Ok(wgpu::SurfaceConfiguration {
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT
            | (caps.usages & wgpu::TextureUsages::COPY_SRC),
        format,
        color_space: wgpu::SurfaceColorSpace::Auto,
        width,
        height,
        present_mode: wgpu::PresentMode::AutoVsync,
        desired_maximum_frame_latency: 2,
        alpha_mode,
        view_formats: Vec::new(),
    })
}

/// Opens a device of `adapter` with the adapter's own limits and features, and a place for its errors.
fn device_of(adapter: &wgpu::Adapter) -> Result<(Arc<Gpu>, Fault)> {
    let descriptor = wgpu::DeviceDescriptor {
        label: Some("subsplat view"),
        required_features: features_of(adapter)?,
        required_limits: limits_of(adapter),
        ..wgpu::DeviceDescriptor::default()
    };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
        .with_context(|| format!("GPU {}: no device", adapter.get_info().name))?;
    let fault = Fault::default();
    let target = fault.clone();
    // The default handler of wgpu panics.
    device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
        let mut fault = target.lock().unwrap_or_else(PoisonError::into_inner);
        fault.get_or_insert_with(|| e.to_string());
    }));
    Ok((Gpu::from_device(device, queue), fault))
}

impl Canvas {
    /// Opens the adapter of `choice` for `window`.
    ///
    /// # Errors
    /// No adapter that can show pictures there, no device, no format that fits.
    pub fn open(window: Arc<Window>, choice: &DeviceChoice) -> Result<Self> {
        let instance = instance();
        let surface = surface_of(&instance, &window).context("window: no surface")?;
        let adapter = find_for(&instance, choice, Some(&surface))?
            .with_context(|| format!("window: expected {choice}, got none that can show it"))?;
        let (gpu, fault) = device_of(&adapter)?;
        let size = window.inner_size();
        let config = configuration(&surface.get_capabilities(&adapter), (size.width, size.height))?;
        let rasterizer = Rasterizer::new(gpu.clone());
        let mut new = Self { window, instance, surface, config, gpu, rasterizer, fault };
        new.resize(size.width, size.height)?;
        Ok(new)
    }

    /// The GPU.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The window.
    pub fn window(&self) -> &Window {
        &self.window
    }

    /// Width and height of a frame, px.
    pub fn size(&self) -> (usize, usize) {
        (self.config.width as usize, self.config.height as usize)
    }

    /// Sets the window's size, px. A size without pixels (minimised) has no effect.
    ///
    /// # Errors
    /// More pixels a side than the adapter draws.
    pub fn resize(&mut self, width: u32, height: u32) -> Result<()> {
        if width == 0 || height == 0 {
            return Ok(());
        }
        let most = self.gpu.limits().max_texture_dimension_2d;
        ensure!(
            width.max(height) <= most,
            "window: expected at most {most} pixels a side, got {width}x{height}"
        );
        (self.config.width, self.config.height) = (width, height);
        self.configure()
    }

    fn configure(&self) -> Result<()> {
        self.surface.configure(self.gpu.device(), &self.config);
        self.check()
    }

    /// Returns an error of the device since the last call.
    fn check(&self) -> Result<()> {
        self.gpu.check()?;
        let fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner).take();
        fault.map_or(Ok(()), |reason| Err(anyhow!("the GPU could not draw a frame: {reason}")))
    }

    /// True if the device is lost; no other frame can then be drawn.
    pub fn is_lost(&self) -> bool {
        self.gpu.check().is_err()
    }

    /// Returns the texture that the window shows next. An outdated surface is configured again; a
    /// lost one is created again.
    fn next(&mut self) -> Result<Option<wgpu::SurfaceTexture>> {
        for _ in 0..2 {
            match self.surface.get_current_texture() {
                Current::Success(texture) | Current::Suboptimal(texture) => {
                    return Ok(Some(texture));
                }
                Current::Timeout | Current::Occluded => return Ok(None),
                Current::Outdated => {
                    let size = self.window.inner_size();
                    self.resize(size.width, size.height)?;
                }
                Current::Lost => {
                    self.surface = surface_of(&self.instance, &self.window)
                        .context("window: its surface was lost")?;
                    self.configure()?;
                }
                Current::Validation => {
                    self.check()?;
                    return Err(anyhow!("window: expected a texture to draw to, got none"));
                }
            }
        }
        Ok(None)
    }

    /// Draws and shows a frame. `camera` receives the frame's width and height. `capture` requests
    /// the pixels.
    ///
    /// # Errors
    /// The scene is too large for the device; the device is lost or rejects a call.
    pub fn draw(
        &mut self,
        scene: &Scene,
        options: &RasterOptions,
        camera: impl FnOnce(usize, usize) -> Camera,
        capture: bool,
    ) -> Result<Frame> {
        let Some(shown) = self.next()? else { return Ok(Frame::Skipped) };
        let (width, height) = self.size();
        let camera = camera(width, height);
        let view = shown.texture.create_view(&wgpu::TextureViewDescriptor::default());
        self.rasterizer.draw(scene, &camera, options, &view)?;
        let readable = self.config.usage.contains(wgpu::TextureUsages::COPY_SRC);
        let picture = match (capture, readable) {
            (false, _) => None,
            (true, true) => Some(self.read(&shown.texture)?),
            (true, false) => {
                let own = self.texture();
                let view = own.create_view(&wgpu::TextureViewDescriptor::default());
                self.rasterizer.draw(scene, &camera, options, &view)?;
                Some(self.read(&own)?)
            }
        };
        self.window.pre_present_notify();
        self.gpu.queue().present(shown);
        self.check()?;
        Ok(Frame::Shown(picture))
    }

    /// Creates a texture of the window's format and size that can be read.
    fn texture(&self) -> wgpu::Texture {
        let (width, height) = (self.config.width, self.config.height);
        self.gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("picture"),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: self.config.format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        })
    }

    /// Reads the pixels of a texture of the window's format.
    fn read(&self, texture: &wgpu::Texture) -> Result<Rgb> {
        let (device, size) = (self.gpu.device(), texture.size());
        let row = (4 * size.width).next_multiple_of(ROW);
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("picture"),
            size: u64::from(row) * u64::from(size.height),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(row),
            rows_per_image: None,
        };
        let to = wgpu::TexelCopyBufferInfo { buffer: &buffer, layout };
        encoder.copy_texture_to_buffer(texture.as_image_copy(), to, size);
        self.gpu.queue().submit([encoder.finish()]);
        let (answer, answered) = std::sync::mpsc::channel();
        buffer.slice(..).map_async(wgpu::MapMode::Read, move |done| {
            // The receiver is gone only after an error.
            answer.send(done).ok();
        });
        device.poll(wgpu::PollType::wait_indefinitely()).context("reading the picture")?;
        answered.recv().context("reading the picture")?.context("reading the picture")?;
        let mapped = buffer.slice(..).get_mapped_range().context("reading the picture")?;
        let bytes: Vec<u8> = mapped.iter().copied().collect();
        Ok(rgb(&bytes, row as usize, (size.width as usize, size.height as usize), self.is_bgra()))
    }

    fn is_bgra(&self) -> bool {
        use wgpu::TextureFormat::{Bgra8Unorm, Bgra8UnormSrgb};
        matches!(self.config.format, Bgra8Unorm | Bgra8UnormSrgb)
    }
}

/// Makes a picture of rows of `row` bytes that begin with `width` pixels of four bytes.
fn rgb(bytes: &[u8], row: usize, (width, height): (usize, usize), bgra: bool) -> Rgb {
    let mut data = Vec::with_capacity(3 * width * height);
    for line in bytes.chunks_exact(row).take(height) {
        for pixel in line.chunks_exact(4).take(width) {
            let first = pixel.iter().take(3);
            let rest = pixel.iter().take(3).rev();
            if bgra { data.extend(rest) } else { data.extend(first) }
        }
    }
    Rgb { width, height, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn padding_is_removed_and_channels_are_ordered() {
        let bytes = [1, 2, 3, 9, 4, 5, 6, 9, 0, 0, 7, 8, 9, 9, 10, 11, 12, 9, 0, 0];
        let as_is = rgb(&bytes, 10, (2, 2), false);
        assert_eq!(as_is.data, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        let swapped = rgb(&bytes, 10, (1, 2), true);
        assert_eq!((swapped.width, swapped.height, swapped.data), (1, 2, vec![3, 2, 1, 9, 8, 7]));
    }

    #[test]
    fn a_surface_without_a_known_format_is_named() {
        let formats = vec![wgpu::TextureFormat::Rgba16Float];
        let mut caps = wgpu::SurfaceCapabilities { formats, ..Default::default() };
        let error = configuration(&caps, (4, 3)).unwrap_err().to_string();
        assert!(error.contains("Bgra8Unorm") && error.contains("Rgba16Float"), "{error}");
        caps.formats.push(wgpu::TextureFormat::Rgba8UnormSrgb);
        caps.formats.push(wgpu::TextureFormat::Rgba8Unorm);
        let found = configuration(&caps, (4, 3)).unwrap();
        assert_eq!((found.format, found.width), (wgpu::TextureFormat::Rgba8Unorm, 4));
    }
}
