//! Fewer Gaussians: moments and optical depth of a merge, and pictures of reduced scenes.

use glam::{DMat3, DQuat, DVec3, Mat4};
use subsplat::finish::reduce;
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::Renderer;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};
use subsplat_kernels::sh::C0;
use subsplat_test_support::edit::Edit;

/// Side of the pictures, px.
const SIDE: usize = 96;
/// Gaussians along each side of a wall.
const GRID: usize = 96;

fn camera() -> Camera {
    let (f, c) = (SIDE as f32, 0.5 * SIDE as f32);
    let k = Intrinsics { fx: f, fy: f, cx: c, cy: c, width: SIDE, height: SIDE };
    Camera::new(k, Mat4::IDENTITY).unwrap()
}

fn raster() -> RasterOptions {
    RasterOptions::new(Convention::Standard)
}

/// A wall that fills the picture at depth `z`: one Gaussian a pixel, of `colour` by row and column.
fn wall(z: f32, colour: impl Fn(usize, usize) -> [f32; 3]) -> Splats {
    let (mut rows, mut sh) = (Vec::new(), Vec::new());
    for (y, x) in (0..GRID).flat_map(|y| (0..GRID).map(move |x| (y, x))) {
        let at = |i: usize| (i as f32 + 0.5 - 0.5 * GRID as f32) * z / GRID as f32;
        rows.extend([at(x), at(y), z, 1.0, 0.0, 0.0, 0.0]);
        let sigma = 0.6 * z / GRID as f32;
        rows.extend([sigma, sigma, 0.1 * sigma, 0.9]);
        sh.extend(colour(x, y).map(|v| (v - 0.5) / C0 as f32));
    }
    Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
}

/// Half plain, half of a colour for each pixel.
fn pattern(x: usize, y: usize) -> [f32; 3] {
    let spread = |k: usize| ((x * 7919 + y * 104_729 + k * 1_299_709) % 97) as f32 / 97.0;
    if x < GRID / 2 { [0.2, 0.5, 0.7] } else { [0, 1, 2].map(spread) }
}

fn picture(splats: &Splats) -> Vec<f32> {
    Renderer::default().render(splats, &camera(), &raster()).rgb
}

fn likeness(splats: &Splats, whole: &[f32]) -> f64 {
    psnr(&picture(splats), whole, SIDE, SIDE).unwrap()
}

/// About `count` Gaussians, spread evenly.
fn evenly(splats: &Splats, count: usize) -> Splats {
    let share = count as f64 / splats.len() as f64;
    let kept = |i: &usize| (*i as f64 * 0.618_033_988_749_895).fract() < share;
    let chosen: Vec<usize> = (0..splats.len()).filter(kept).collect();
    let rows = chosen.iter().flat_map(|i| splats.row(*i)).copied().collect();
    let sh = chosen.iter().flat_map(|i| splats.sh_of(*i)).copied().collect();
    Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
}

fn joined(a: &Splats, b: &Splats) -> Splats {
    let both = |a: &[f32], b: &[f32]| [a, b].concat();
    Splats::new(both(a.rows(), b.rows()), both(a.sh(), b.sh()), Vec::new(), 0, ShBasis::Standard)
        .unwrap()
}

fn covariance(splats: &Splats, i: usize) -> DMat3 {
    let [w, x, y, z] = splats.quat_wxyz(i).map(f64::from);
    let s = DVec3::from_array(splats.scale(i).map(f64::from));
    let m = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()) * DMat3::from_diagonal(s);
    m * m.transpose()
}

#[test]
fn a_merge_keeps_moments_colour_and_optical_depth() {
    #[rustfmt::skip]
    let rows = vec![
        0.1, -0.2, 3.0,  0.9, 0.1, -0.3, 0.2,  0.05, 0.02, 0.01,  0.7,
        0.15, -0.18, 3.02,  0.7, -0.5, 0.1, 0.4,  0.03, 0.06, 0.004,  0.4,
    ];
    let sh = vec![0.3, -0.2, 0.1, -0.4, 0.5, 0.2];
    // γ and δ of the second are folded into its colour.
    let gain = vec![1.0, 0.0, 0.0, 0.0, 0.5, 0.1, 0.0, -0.1];
    let pair = Splats::new(rows, sh, gain, 0, ShBasis::Standard).unwrap();
    let one = reduce(&pair, &[], &raster(), 1, &mut Renderer::default());
    assert_eq!((one.len(), one.gain().len()), (1, 0));
    let area = |s: &Splats, i: usize| {
        let mut sorted = s.scale(i).map(f64::from);
        sorted.sort_by(f64::total_cmp);
        sorted[1] * sorted[2]
    };
    let depth = |s: &Splats, i: usize| -(-f64::from(s.opacity(i))).ln_1p() * area(s, i);
    let weights = [depth(&pair, 0), depth(&pair, 1)];
    let sum = weights[0] + weights[1];
    assert!((depth(&one, 0) / sum - 1.0).abs() < 1e-4, "{} {sum}", depth(&one, 0));
    let point = |s: &Splats, i: usize| DVec3::from_array(s.mean(i).map(f64::from));
    let mean = (point(&pair, 0) * weights[0] + point(&pair, 1) * weights[1]) / sum;
    assert!((point(&one, 0) - mean).length() < 1e-6);
    let mut expected = DMat3::ZERO;
    for (i, weight) in weights.iter().enumerate() {
        let d = point(&pair, i) - mean;
        let outer = DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        expected += (covariance(&pair, i) + outer) * (weight / sum);
    }
    let got = covariance(&one, 0);
    for (a, b) in got.to_cols_array().iter().zip(expected.to_cols_array()) {
        assert!((a - b).abs() < 1e-7, "{got} {expected}");
    }
    let second = [-0.4 * 0.5 + 0.1 / C0, 0.5 * 0.5, 0.2 * 0.5 - 0.1 / C0];
    for (c, value) in one.sh().iter().enumerate() {
        let first = [0.3, -0.2, 0.1][c];
        let expected = (first * weights[0] + second[c] * weights[1]) / sum;
        assert!((f64::from(*value) - expected).abs() < 1e-6, "{c}: {value} {expected}");
    }
}

#[test]
fn plain_parts_are_merged_and_patterns_stay() {
    let all = wall(2.0, pattern);
    let whole = picture(&all);
    let (count, mut renderer) = (5 * all.len() / 8, Renderer::default());
    let merged = reduce(&all, &[camera()], &raster(), count, &mut renderer);
    assert_eq!(merged.len(), count);
    // A wall of one layer over black is the hardest case: any gap shows. As many Gaussians, chosen
    // evenly, give 22.8 dB.
    let removed = likeness(&evenly(&all, count), &whole);
    let psnr = likeness(&merged, &whole);
    assert!(psnr > 27.0 && psnr > removed + 4.0, "{psnr:.1} dB, removed {removed:.1} dB");
    // The plain half is merged, not the pattern.
    let plain = |s: &Splats| s.means().filter(|m| m[0] < 0.0).count();
    assert!(3 * plain(&merged) < plain(&all), "{} of {}", plain(&merged), plain(&all));
    // Without cameras too.
    let alone = reduce(&all, &[], &raster(), count, &mut renderer);
    let psnr = likeness(&alone, &whole);
    assert!(psnr > 27.0 && psnr > removed + 4.0, "{psnr:.1} dB, removed {removed:.1} dB");
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = one_thread
        .install(|| reduce(&all, &[camera()], &raster(), count, &mut Renderer::default()));
    assert_eq!(again, merged);
    assert_eq!(reduce(&all, &[], &raster(), all.len(), &mut renderer), all);
    assert_eq!(reduce(&all, &[], &raster(), 0, &mut renderer).len(), 1);
}

#[test]
fn gaussians_behind_a_wall_go_first_and_those_outside_the_picture_stay() {
    let front = wall(2.0, pattern);
    let hidden = wall(4.0, |_, y| [y as f32 / GRID as f32, 1.0, 0.0]);
    let mut beside = wall(2.0, |x, y| [x as f32 / GRID as f32, y as f32 / GRID as f32, 1.0]);
    beside.edit(|p| p.rows.chunks_exact_mut(11).for_each(|row| row[0] += 5.0));
    let scene = joined(&front, &hidden);
    let whole = picture(&scene);
    let mut renderer = Renderer::default();
    let reduced = reduce(&scene, &[camera()], &raster(), 11 * front.len() / 10, &mut renderer);
    let behind = |s: &Splats| s.means().filter(|m| m[2] > 3.0).count();
    // The wall is not quite opaque and shows a little of them.
    assert!(behind(&reduced) < hidden.len() / 8, "{} stay", behind(&reduced));
    assert!(likeness(&reduced, &whole) > 40.0, "{:.1} dB", likeness(&reduced, &whole));
    let scene = joined(&front, &beside);
    let reduced = reduce(&scene, &[camera()], &raster(), front.len(), &mut renderer);
    let outside = reduced.means().filter(|m| m[0] > 3.0).count();
    assert!(outside > beside.len() / 10, "{outside} stay");
}
