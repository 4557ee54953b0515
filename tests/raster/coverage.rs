//! Accumulated opacity of a plane seen by two cameras, one splat per input pixel,
//! when it is rendered at twice the input's size: the gaps that a fixed low-pass
//! leaves, and that a low-pass scaled with the picture closes. The measured table of
//! SubSplat's physical remark, first three columns.

use glam::{Mat4, Vec2, Vec3};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{Convention, LOWPASS, RasterOptions, ShBasis};

/// Input picture side, px: large enough for a middle without borders.
const SIDE: usize = 64;
const DEPTH: f32 = 2.0;

/// Draws of the two grids' offsets against the target's pixels.
const DRAWS: usize = 12;

fn camera(at: [f32; 2], side: usize) -> Camera {
    let (f, c) = (0.9 * side as f32, 0.5 * side as f32);
    let k = Intrinsics { fx: f, fy: f, cx: c, cy: c, width: side, height: side };
    Camera::new(k, Mat4::from_translation(Vec3::new(at[0], at[1], 0.0))).unwrap()
}

/// The pixel grids of fronto-parallel views at `eyes`, on the plane.
fn plane(sigma_px: f32, eyes: [[f32; 2]; 2]) -> Splats {
    let mut rows = Vec::new();
    for eye in eyes {
        let camera = camera(eye, SIDE);
        for i in 0..SIDE * SIDE {
            let px = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
            let at = camera.intrinsics().unproject(px) * DEPTH;
            rows.extend(camera.world_from_camera().transform_point3(at).to_array());
            rows.extend([1.0, 0.0, 0.0, 0.0]);
            rows.extend([sigma_px * DEPTH / camera.intrinsics().fx; 3]);
            rows.push(0.9);
        }
    }
    // White: ½ + C₀·h = 1.
    let sh = vec![0.5 / subsplat_kernels::sh::C0 as f32; rows.len() / 11 * 3];
    Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
}

/// Mean alpha over the middle of the view from the origin, `scale` times as large.
fn coverage(splats: &Splats, scale: usize, lowpass: f32, convention: Convention) -> f32 {
    let options = RasterOptions { lowpass, ..RasterOptions::new(convention) };
    let side = SIDE * scale;
    let picture = subsplat::scene::render(splats, &camera([0.0; 2], side), &options);
    let middle = side / 4..3 * side / 4;
    let (mut sum, mut n) = (0.0, 0.0);
    for p in middle.clone().flat_map(|y| middle.clone().map(move |x| y * side + x)) {
        let alpha = picture.alpha[p];
        let [r, g, b] = std::array::from_fn(|c| picture.rgb[3 * p + c]);
        assert!((r - alpha).abs() < 1e-4 && r == g && g == b, "white over black is alpha");
        sum += alpha;
        n += 1.0;
    }
    sum / n
}

/// Context eyes left and right of the target, by 4 input pixels of disparity and a
/// fraction that differs from draw to draw (Kronecker sequence).
fn eyes(draw: usize) -> [[f32; 2]; 2] {
    let px = DEPTH / (0.9 * SIDE as f32);
    let fraction = |k: usize| (draw as f32 * [0.8566, 0.7339, 0.6287, 0.5385][k]).fract();
    [[(4.0 + fraction(0)) * px, fraction(1) * px], [(-4.0 - fraction(2)) * px, fraction(3) * px]]
}

#[test]
fn plane_keeps_its_coverage_where_the_low_pass_scales() {
    // σ in input px; native, ×2, ×2 with low-pass × 4.
    let table = [
        (0.20, [0.998, 0.822, 0.996]),
        (0.35, [0.999, 0.956, 0.999]),
        (0.50, [1.00, 0.995, 1.00]),
        (0.75, [1.00, 1.00, 1.00]),
        (1.00, [1.00, 1.00, 1.00]),
        (1.55, [1.00, 1.00, 1.00]),
    ];
    let columns = [(1, LOWPASS), (2, LOWPASS), (2, 4.0 * LOWPASS)];
    for (sigma, expected) in table {
        let scenes: Vec<Splats> = (0..DRAWS).map(|draw| plane(sigma, eyes(draw))).collect();
        for convention in [Convention::Mvsplat, Convention::Standard] {
            let means = columns.map(|(scale, lowpass)| {
                let each = scenes.iter().map(|s| coverage(s, scale, lowpass, convention));
                each.sum::<f32>() / DRAWS as f32
            });
            eprintln!("sigma {sigma:.2} {convention:?}: {means:.3?}, table {expected:.3?}");
            for (got, expected) in means.into_iter().zip(expected) {
                assert!((got - expected).abs() < 0.01, "sigma {sigma} {convention:?}: {means:?}");
            }
        }
    }
}
