//! Scenes of pictures with depth, from tensors.

use candle_core::{Result, Tensor, bail};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::small::rgbd::RgbdView;

/// Images `[B, V, 3, H, W]` and distances `[B, V, H·W, 1]` in host memory, and their cameras.
pub(super) struct Scenes<'a> {
    rgb: Vec<f32>,
    distances: Vec<f32>,
    cameras: &'a [Vec<Camera>],
    /// H·W.
    pub pixels: usize,
}

impl<'a> Scenes<'a> {
    /// `op` is the operation's name in errors.
    ///
    /// # Errors
    /// Shapes that do not fit one another; another dtype.
    pub fn new(
        op: &str,
        images: &Tensor,
        cameras: &'a [Vec<Camera>],
        distances: &Tensor,
    ) -> Result<Self> {
        let (b, v, c, h, w) = images.dims5()?;
        if c != 3 || distances.dims() != [b, v, h * w, 1] {
            let (images, distances) = (images.dims(), distances.dims());
            bail!(
                "{op}: expected images [B, V, 3, H, W] and distances [B, V, H·W, 1], got \
                 {images:?} and {distances:?}"
            );
        }
        let misfit = |k: &Camera| (k.intrinsics().width, k.intrinsics().height) != (w, h);
        if cameras.len() != b || cameras.iter().any(|all| all.len() != v || all.iter().any(misfit))
        {
            bail!("{op}: expected {v} cameras of {w}x{h} pixels for each of {b} scenes");
        }
        let host = |t: &Tensor| t.detach().flatten_all()?.to_vec1::<f32>();
        let (rgb, distances) = (host(images)?, host(distances)?);
        Ok(Self { rgb, distances, cameras, pixels: h * w })
    }

    /// Returns the views of each scene.
    pub fn iter(&self) -> impl Iterator<Item = Vec<RgbdView<'_>>> {
        self.cameras.iter().enumerate().map(|(s, all)| {
            let view = |(i, camera)| {
                let at = (s * all.len() + i) * self.pixels;
                let rgb = &self.rgb[3 * at..3 * (at + self.pixels)];
                RgbdView { camera, rgb, distances: &self.distances[at..at + self.pixels] }
            };
            all.iter().enumerate().map(view).collect()
        })
    }
}
