//! Rendering of splats to a picture, on the CPU or on a chosen device.

mod comment;
mod device;
mod image;

pub use comment::{
    camera_of_comments, comment_of_camera, comment_of_options, comment_of_origin,
    comment_of_photograph, comments_without_camera, options_of_comments, origin_of_comments,
    photographs_of_comments,
};
pub use device::{DeviceError, Renderer};

use crate::scene::splats::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::{Geometry, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{RasterOptions, Rendered};

/// A rendered view, H × W pixels, row-major, top row first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// W, px.
    pub width: usize,
    /// H, px.
    pub height: usize,
    /// `[H, W, 3]`: colour over the background. Values may exceed 1; none is below 0 unless the
    /// background is.
    pub rgb: Vec<f32>,
    /// `[H, W]`: accumulated opacity, 1 − T.
    pub alpha: Vec<f32>,
    /// `[H, W]`: expected camera z, Σ w·z / alpha, world units; 0 where alpha is 0.
    pub depth: Vec<f32>,
}

/// Renders `splats` as seen by `camera`, on the CPU.
///
/// The SH basis of the splats replaces `options.sh_basis`. To render many views, keep a
/// [`Rasterizer`] and call [`render_with`], or open a [`Renderer`] for a GPU.
pub fn render(splats: &Splats, camera: &Camera, options: &RasterOptions) -> Picture {
    render_with(&mut Rasterizer::new(), splats, camera, options)
}

impl Splats {
    /// Renders the scene as seen by `camera` on the CPU, with the default [`RasterOptions`].
    pub fn render(&self, camera: &Camera) -> Picture {
        render(self, camera, &RasterOptions::default())
    }
}

/// Renders as [`render`] does, with buffers that are reused from view to view.
pub fn render_with(
    rasterizer: &mut Rasterizer,
    splats: &Splats,
    camera: &Camera,
    options: &RasterOptions,
) -> Picture {
    let options = RasterOptions { sh_basis: splats.sh_basis, ..*options };
    Picture::from(rasterizer.render(&slices(splats), camera, &options))
}

impl From<Rendered> for Picture {
    fn from(rendered: Rendered) -> Self {
        let depth = rendered.depth();
        let (width, height) = (rendered.width, rendered.height);
        Self { width, height, rgb: rendered.rgb, alpha: rendered.alpha, depth }
    }
}

/// Returns the slices of `splats` that the kernels read.
pub fn slices(splats: &Splats) -> SplatSlices<'_> {
    SplatSlices {
        geometry: Geometry::Packed(&splats.rows),
        sh: &splats.sh,
        gain: &splats.gain,
        sh_degree: splats.sh_degree,
    }
}
