//! Consistency between views, as a tensor. Kernel: cpu/small/cross_check.rs.

use super::rgbd::Scenes;
use candle_core::{Result, Tensor};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::small::cross_check::cross_check as kernel;

/// Compares each pixel's point with the other views of its scene. Returns a factor of its opacity,
/// `[B, V, H·W, 1]`, without a gradient.
///
/// `images` `[B, V, 3, H, W]`, `cameras` `[B][V]`, `distances` `[B, V, H·W, 1]` along the
/// unit ray, all f32.
///
/// # Errors
/// Shapes that do not fit one another; another dtype.
pub fn cross_check(images: &Tensor, cameras: &[Vec<Camera>], distances: &Tensor) -> Result<Tensor> {
    let scenes = Scenes::new("cross-check", images, cameras, distances)?;
    let factors: Vec<f32> = scenes.iter().flat_map(|views| kernel(&views)).collect();
    Tensor::from_vec(factors, distances.dims(), images.device())
}
