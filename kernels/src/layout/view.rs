//! The parameters of projection that the CPU and the GPU kernels derive from a camera and
//! the options of a call.

use super::{
    Convention, JACOBIAN_LIMIT_MVSPLAT, JACOBIAN_MARGIN_STANDARD, NEAR_MVSPLAT, RasterOptions,
    Z_EPSILON_MVSPLAT,
};
use crate::camera::{Camera, Intrinsics};

/// Parameters of projection: a camera under a convention.
#[derive(Clone, Debug)]
pub struct View {
    /// Rows of the rotation that maps world to camera.
    pub rows: [[f32; 3]; 3],
    /// Position of the camera in world.
    pub eye: [f32; 3],
    /// fx, fy, px.
    pub focal: [f32; 2],
    /// Principal point, px, pixel centres at integers.
    pub centre: [f32; 2],
    /// Intervals (low, high) to which x/z and y/z are clamped inside the Jacobian.
    pub limit: [(f32, f32); 2],
    /// Nearest camera z that is rendered, world units.
    pub near: f32,
    /// Term added to camera z in the projection of a mean, world units.
    pub z_epsilon: f32,
    /// Low-pass of the 2-D covariance, px².
    pub lowpass: f32,
    /// Opacities are scaled by √(det Σ / det(Σ + low-pass)).
    pub antialiased: bool,
    /// Splats are cut at the edges of 16×16 tiles.
    pub tile_cut: bool,
    /// Width and height, px.
    pub size: [usize; 2],
}

impl View {
    /// Derives the parameters from `camera` and `options`.
    pub fn new(camera: &Camera, options: &RasterOptions) -> Self {
        let k = &camera.intrinsics;
        let size = [k.width, k.height];
        let sides = [k.width as f32, k.height as f32];
        let rotation = camera.rotation();
        let standard = options.convention == Convention::Standard;
        let (focal, centre, limit) = if standard {
            let focal = [k.fx, k.fy];
            let principal = [k.cx, k.cy];
            let limit = std::array::from_fn(|i| {
                let margin = JACOBIAN_MARGIN_STANDARD * 0.5 * sides[i] / focal[i];
                let low = principal[i] / focal[i];
                let high = (sides[i] - principal[i]) / focal[i];
                (-low - margin, high + margin)
            });
            (focal, principal.map(|c| c - 0.5), limit)
        } else {
            let tan = tan_half_fov(k);
            let focal = std::array::from_fn(|i| 0.5 * sides[i] / tan[i]);
            let limit = tan.map(|t| (-JACOBIAN_LIMIT_MVSPLAT * t, JACOBIAN_LIMIT_MVSPLAT * t));
            (focal, sides.map(|s| 0.5 * s - 0.5), limit)
        };
        let near = if standard { options.near } else { NEAR_MVSPLAT * options.near };
        Self {
            rows: std::array::from_fn(|i| rotation.col(i).to_array()),
            eye: camera.position().to_array(),
            focal,
            centre,
            limit,
            // A point at z = 0 has no projection.
            near: near.max(f32::MIN_POSITIVE),
            z_epsilon: if standard { 0.0 } else { Z_EPSILON_MVSPLAT * options.near },
            lowpass: options.lowpass,
            antialiased: standard && options.antialiased,
            tile_cut: !standard,
            size,
        }
    }
}

/// Returns tan of half the angle between the rays through the middles of opposite picture
/// edges, horizontally and vertically: MVSplat's frustum.
fn tan_half_fov(k: &Intrinsics) -> [f32; 2] {
    let (w, h) = (k.width as f64, k.height as f64);
    let ray = |u: f64, v: f64| {
        glam::DVec3::new(
            (u - f64::from(k.cx)) / f64::from(k.fx),
            (v - f64::from(k.cy)) / f64::from(k.fy),
            1.0,
        )
    };
    let half =
        |a: glam::DVec3, b: glam::DVec3| (0.5 * a.cross(b).length().atan2(a.dot(b))).tan() as f32;
    [half(ray(0.0, 0.5 * h), ray(w, 0.5 * h)), half(ray(0.5 * w, 0.0), ray(0.5 * w, h))]
}
