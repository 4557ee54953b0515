//! Splats to a picture in one call: on the CPU, or on the device that is asked for.

mod comment;
mod device;
mod image;

pub use comment::{comment_of_options, options_of_comments};
pub use device::{DeviceError, Renderer};

use crate::abi::{RasterOptions, Rendered};
use crate::camera::Camera;
use crate::cpu::{Geometry, Rasterizer, SplatSlices};
use crate::splats::Splats;

/// A rendered view, H × W pixels, row-major, top row first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// W, px.
    pub width: usize,
    /// H, px.
    pub height: usize,
    /// `[H, W, 3]`: colour over the background; may exceed 1, never below 0 unless
    /// the background is.
    pub rgb: Vec<f32>,
    /// `[H, W]`: accumulated opacity, 1 − T.
    pub alpha: Vec<f32>,
    /// `[H, W]`: expected camera z, Σ w·z / alpha, world units; 0 where nothing is.
    pub depth: Vec<f32>,
}

/// Renders `splats` seen by `camera`.
///
/// The SH basis is the splats' own; `options.sh_basis` is not read. To render many
/// views, keep a [`Rasterizer`] and use [`render_with`], or a [`Renderer`] for a GPU.
pub fn render(splats: &Splats, camera: &Camera, options: &RasterOptions) -> Picture {
    render_with(&mut Rasterizer::new(), splats, camera, options)
}

/// [`render`] with buffers kept from view to view.
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

/// `splats` as the kernels read them.
pub fn slices(splats: &Splats) -> SplatSlices<'_> {
    SplatSlices {
        geometry: Geometry::Packed(&splats.rows),
        sh: &splats.sh,
        gain: &splats.gain,
        sh_degree: splats.sh_degree,
    }
}
