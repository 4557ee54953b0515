//! A textured plane before two cameras, for fits of Gaussians to pictures.

use glam::{Mat4, Vec3};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render;
use subsplat::{Camera, Intrinsics, RasterOptions, ShBasis, Splats};

/// Width and height of the pictures, px.
pub const SIDE: usize = 48;

/// Two cameras, 0.2 apart, that look along +z.
pub fn cameras() -> [Camera; 2] {
    let side = SIDE as f32;
    let k = Intrinsics {
        fx: side,
        fy: side,
        cx: 0.5 * side,
        cy: 0.5 * side,
        width: SIDE,
        height: SIDE,
    };
    [-0.1, 0.1].map(|x| Camera::new(k, Mat4::from_translation(Vec3::new(x, 0.0, 0.0))).unwrap())
}

/// A textured plane at z = 2 of one Gaussian a pixel, of `sigma` px and opacity `alpha`.
pub fn plane(sigma: f32, alpha: f32) -> Splats {
    let (mut rows, mut sh) = (Vec::new(), Vec::new());
    let pixel = 2.0 / SIDE as f32;
    for i in 0..SIDE * SIDE {
        let (x, y) = ((i % SIDE) as f32, (i / SIDE) as f32);
        let middle = 0.5 * SIDE as f32 - 0.5;
        rows.extend([(x - middle) * pixel, (y - middle) * pixel, 2.0, 1.0, 0.0, 0.0, 0.0]);
        rows.extend([sigma * pixel, sigma * pixel, sigma * pixel, alpha]);
        let wave = (1.3 * x).sin() * (0.9 * y).cos();
        sh.extend([wave, 0.5 * wave, 0.3 - wave]);
    }
    Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
}

/// The plane as both cameras see it.
pub fn pictures(splats: &Splats) -> Vec<Rgb> {
    cameras()
        .iter()
        .map(|c| {
            let picture = render(splats, c, &RasterOptions::default());
            Rgb::from_unit(&picture.rgb, SIDE, SIDE).unwrap()
        })
        .collect()
}
