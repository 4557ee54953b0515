//! Consistency between views, as a tensor. Kernel: cpu/small/cross_check.rs.

use crate::camera::Camera;
use crate::cpu::small::cross_check::{RgbdView, cross_check as kernel};
use candle_core::{Result, Tensor, bail};

/// Compares each pixel's point with the other views of its scene. Returns a factor of its opacity,
/// `[B, V, H·W, 1]`, without a gradient.
///
/// `images` `[B, V, 3, H, W]`, `cameras` `[B][V]`, `distances` `[B, V, H·W, 1]` along the
/// unit ray, all f32.
///
/// # Errors
/// Shapes that do not fit one another; another dtype.
pub fn cross_check(images: &Tensor, cameras: &[Vec<Camera>], distances: &Tensor) -> Result<Tensor> {
    let (b, v, c, h, w) = images.dims5()?;
    if c != 3 || distances.dims() != [b, v, h * w, 1] {
        let (images, distances) = (images.dims(), distances.dims());
        bail!(
            "cross-check: expected images [B, V, 3, H, W] and distances [B, V, H·W, 1], got \
             {images:?} and {distances:?}"
        );
    }
    let misfit = |k: &Camera| (k.intrinsics.width, k.intrinsics.height) != (w, h);
    if cameras.len() != b || cameras.iter().any(|all| all.len() != v || all.iter().any(misfit)) {
        bail!("cross-check: expected {v} cameras of {w}x{h} pixels for each of {b} scenes");
    }
    let rgb = images.detach().flatten_all()?.to_vec1::<f32>()?;
    let z = distances.detach().flatten_all()?.to_vec1::<f32>()?;
    let pixels = h * w;
    let mut out = Vec::with_capacity(z.len());
    for (s, all) in cameras.iter().enumerate() {
        let view = |(i, camera)| {
            let at = (s * v + i) * pixels;
            let rgb = &rgb[3 * at..3 * (at + pixels)];
            RgbdView { camera, rgb, distances: &z[at..at + pixels] }
        };
        out.extend(kernel(&all.iter().enumerate().map(view).collect::<Vec<_>>()));
    }
    Tensor::from_vec(out, (b, v, pixels, 1), images.device())
}
