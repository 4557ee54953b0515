//! Level of detail: moments of a merge, the selection by distance, and pictures of selections.

use glam::{DMat3, DQuat, DVec3, Mat4, Vec3};
use subsplat::finish::merge::Blob;
use subsplat::scene::levels::{BLOCK, CELL_PX, Levels};
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::render;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{LOWPASS, RasterOptions, SPLAT_STRIDE, ShBasis};
use subsplat_kernels::sh::C0;
use subsplat_test_support::edit::Edit;

/// Side of the pictures, px.
const SIDE: usize = 128;
/// Gaussians along each side of a wall.
const GRID: usize = 96;

/// A camera that looks along z at the point (0, 0, 1), from `distance`.
fn camera(distance: f32) -> Camera {
    let (f, c) = (SIDE as f32, 0.5 * SIDE as f32);
    let k = Intrinsics { fx: f, fy: f, cx: c, cy: c, width: SIDE, height: SIDE };
    Camera::new(k, Mat4::from_translation(Vec3::Z * (1.0 - distance))).unwrap()
}

/// Deterministic numbers from 0 to 1.
fn unit(i: usize) -> f32 {
    (i as f64 * 0.618_033_988_749_895).fract() as f32
}

/// A slanted wall with two layers, smooth colours with some noise, and gains; four children a parent.
fn wall() -> Splats {
    let (mut rows, mut sh, mut gain) = (Vec::new(), Vec::new(), Vec::new());
    for parent in 0..GRID * GRID / 4 {
        let (x, y) = (2 * (parent % (GRID / 2)), 2 * (parent / (GRID / 2)));
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let [u, v] = [x + dx, y + dy].map(|i| (i as f32 + 0.5) / GRID as f32 - 0.5);
            let i = rows.len() / SPLAT_STRIDE;
            let layer = if i.is_multiple_of(3) { 0.02 } else { 0.0 };
            rows.extend([u, v, 1.0 + 0.4 * u + layer, 1.0, 0.2 * unit(i), 0.1, -0.1]);
            let sigma = (0.7 + 0.5 * unit(i + 7)) / GRID as f32;
            rows.extend([sigma, 0.7 * sigma, 0.1 * sigma, 0.5 + 0.45 * unit(i + 3)]);
            gain.extend([0.98 + 0.04 * unit(i + 1), 0.01 * unit(i + 2), 0.0, -0.01]);
        }
        let wave = |c: usize| (0.1 * x as f32 + c as f32).sin() * (0.13 * y as f32).cos();
        sh.extend([0, 1, 2].map(|c| wave(c) + 0.03 * unit(5 * parent + c)));
        sh.extend([0.05; 9]);
    }
    Splats::new(rows, sh, gain, 1, ShBasis::Standard).unwrap()
}

fn covariance(splats: &Splats, i: usize) -> DMat3 {
    let [w, x, y, z] = splats.quat_wxyz(i).map(f64::from);
    let s = DVec3::from_array(splats.scale(i).map(f64::from));
    let m = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()) * DMat3::from_diagonal(s);
    m * m.transpose()
}

fn point(splats: &Splats, i: usize) -> DVec3 {
    DVec3::from_array(splats.mean(i).map(f64::from))
}

/// Optical depth, integrated under a low-pass of the variance `l`.
fn weight(splats: &Splats, i: usize, l: f64) -> f64 {
    let mut s = splats.scale(i).map(f64::from);
    s.sort_by(f64::total_cmp);
    let area = ((s[1] * s[1] + l) * (s[2] * s[2] + l)).sqrt();
    -(-f64::from(splats.opacity(i))).ln_1p() * area
}

/// Compares a merge with sums over the Gaussians of `all`.
fn check_merge(all: &Splats, one: &Splats, l: f64) {
    let weights: Vec<f64> = (0..all.len()).map(|i| weight(all, i, l)).collect();
    let sum: f64 = weights.iter().sum();
    let got = weight(one, 0, l);
    assert!((got / sum - 1.0).abs() < 1e-4, "{got} {sum}");
    let terms = || weights.iter().map(|w| w / sum).enumerate();
    let mean: DVec3 = terms().map(|(i, w)| point(all, i) * w).sum();
    assert!((point(one, 0) - mean).length() < 1e-6);
    let mut expected = DMat3::ZERO;
    for (i, w) in terms() {
        let d = point(all, i) - mean;
        expected += (covariance(all, i) + DMat3::from_cols(d * d.x, d * d.y, d * d.z)) * w;
    }
    let got = covariance(one, 0);
    for (a, b) in got.to_cols_array().iter().zip(expected.to_cols_array()) {
        assert!((a - b).abs() < 1e-7, "{got} {expected}");
    }
    for (c, value) in one.sh().iter().enumerate() {
        let own = |i: usize| {
            let (gamma, delta) = all.gain_of(i);
            f64::from(gamma * all.sh_of(i)[c]) + f64::from(delta[c]) / C0
        };
        let expected: f64 = terms().map(|(i, w)| own(i) * w).sum();
        assert!((f64::from(*value) - expected).abs() < 1e-5, "{c}: {value} {expected}");
    }
}

#[test]
fn a_level_keeps_moments_colour_and_optical_depth() {
    #[rustfmt::skip]
    let rows = vec![
        0.10, -0.20, 3.00,  0.9, 0.1, -0.3, 0.2,  0.05, 0.02, 0.01,  0.3,
        0.15, -0.18, 3.02,  0.7, -0.5, 0.1, 0.4,  0.03, 0.06, 0.004,  0.2,
        0.12, -0.25, 3.01,  0.1, 0.5, -0.9, 0.4,  0.01, 0.02, 0.03,  0.5,
    ];
    let sh = vec![0.3, -0.2, 0.1, -0.4, 0.5, 0.2, 0.1, 0.2, 0.3];
    let gain = vec![1.0, 0.0, 0.0, 0.0, 0.5, 0.1, 0.0, -0.1, 1.5, -0.1, 0.1, 0.0];
    let three = Splats::new(rows, sh, gain, 0, ShBasis::Standard).unwrap();
    let levels = Levels::new(&three);
    let selection = levels.select(&camera(1e4), CELL_PX);
    let one = levels.gather(&three, &selection).unwrap();
    assert_eq!((one.len(), selection.len(), one.gain().len()), (1, 1, 0));
    // The side of the cells is not public, so the low-pass is found from the optical depth.
    let sum = |l: f64| (0..3).map(|i| weight(&three, i, l)).sum::<f64>();
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..200 {
        let l = 0.5 * (low + high);
        if weight(&one, 0, l) > sum(l) { low = l } else { high = l }
    }
    let pixel = (low / f64::from(LOWPASS)).sqrt();
    assert!((0.04..0.1).contains(&pixel), "{pixel}");
    check_merge(&three, &one, low);
    // Without a low-pass, pair by pair.
    let moments = |i: usize| Blob::of(three.row(i)).moments(0.0);
    let joined = moments(0).joined(&moments(1)).joined(&moments(2));
    let mut row = vec![0.0; SPLAT_STRIDE];
    joined.write(0.0, &mut row);
    let sh = (0..3).map(|c| {
        let share = |i: usize| weight(&three, i, 0.0) / sum(0.0);
        let own = |i: usize| {
            let (gamma, delta) = three.gain_of(i);
            f64::from(gamma * three.sh_of(i)[c]) + f64::from(delta[c]) / C0
        };
        (0..3).map(|i| share(i) * own(i)).sum::<f64>() as f32
    });
    let direct = Splats::new(row, sh.collect(), Vec::new(), 0, ShBasis::Standard).unwrap();
    check_merge(&three, &direct, 0.0);
}

#[test]
fn far_cameras_draw_fewer_gaussians_and_nearly_the_same_picture() {
    let (all, options) = (wall(), RasterOptions::default());
    let levels = Levels::new(&all);
    let mut before = all.len() + 1;
    let mut least = Vec::new();
    for distance in [0.3, 1.0, 2.0, 4.0, 8.0, 16.0, 100.0, 1e6] {
        let camera = camera(distance);
        let selection = levels.select(&camera, CELL_PX);
        let chosen = levels.gather(&all, &selection).unwrap();
        assert_eq!((chosen.len(), chosen.is_empty()), (selection.len(), selection.is_empty()));
        assert!(chosen.len() <= before, "×{distance}: {} after {before}", chosen.len());
        before = chosen.len();
        let [whole, got] = [&all, &chosen].map(|s| render(s, &camera, &options));
        if selection.is_whole() {
            assert!(chosen == all && got == whole);
            continue;
        }
        let likeness = psnr(&got.rgb, &whole.rgb, SIDE, SIDE).unwrap();
        println!("×{distance}: {} of {}, {likeness:.1} dB", chosen.len(), all.len());
        assert!(likeness >= 40.0, "×{distance}: {likeness:.1} dB with {}", chosen.len());
        least.push(likeness);
    }
    // One Gaussian for each block and a few.
    assert!(before <= 2 * all.len().div_ceil(BLOCK), "{before}");
    assert!(least.len() >= 4);
    assert!(levels.select(&camera(1.0), CELL_PX).is_whole());
    assert!(levels.coarse_len() <= all.len());
}

#[test]
fn each_block_is_coarser_at_a_larger_distance_and_for_larger_cells() {
    let levels = Levels::new(&wall());
    let near = levels.select(&camera(8.0), CELL_PX);
    let far = levels.select(&camera(9.0), CELL_PX);
    let wide = levels.select(&camera(8.0), 1.3 * CELL_PX);
    assert_eq!(near.levels().len(), (GRID * GRID).div_ceil(BLOCK));
    for coarser in [&far, &wide] {
        assert!(near.covers(coarser) && !coarser.covers(&near) && coarser.len() < near.len());
    }
    // A block near the camera stays whole where the others are coarse.
    let mut rows = wall().rows().to_vec();
    let moved = rows.len() / 2;
    rows[..moved].chunks_exact_mut(SPLAT_STRIDE).for_each(|row| row[2] -= 12.0);
    let two = Splats::new(rows, wall().sh().to_vec(), Vec::new(), 1, ShBasis::Standard).unwrap();
    let levels = Levels::new(&two);
    let mixed = levels.select(&camera(13.0), CELL_PX);
    assert!(!mixed.is_whole() && mixed.levels().contains(&0), "{:?}", mixed.levels());
    let chosen = levels.gather(&two, &mixed).unwrap();
    let options = RasterOptions::default();
    let [whole, got] = [&two, &chosen].map(|s| render(s, &camera(13.0), &options));
    let likeness = psnr(&got.rgb, &whole.rgb, SIDE, SIDE).unwrap();
    assert!(likeness >= 40.0 && chosen.len() < two.len(), "{likeness:.1} dB");
    // NaN selects all.
    assert!(levels.select(&camera(1e6), f32::NAN).is_whole());
}

#[test]
fn any_number_of_threads_gives_the_same_levels() {
    let (all, camera) = (wall(), camera(6.0));
    let made = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let levels = Levels::new(&all);
            let chosen = levels.gather(&all, &levels.select(&camera, CELL_PX)).unwrap();
            (levels, chosen)
        })
    };
    let one = made(1);
    assert!(one.1.len() < all.len());
    for threads in [2, 5] {
        assert!(made(threads) == one, "{threads} threads");
    }
}

#[test]
fn scenes_without_a_merge_stay_whole() {
    let empty = Splats::new(vec![], vec![], vec![], 0, ShBasis::Standard).unwrap();
    let levels = Levels::new(&empty);
    let selection = levels.select(&camera(9.0), CELL_PX);
    assert!(levels.is_empty() && selection.is_empty() && selection.is_whole());
    assert!(levels.gather(&empty, &selection).unwrap() == empty);
    let row = vec![0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.9];
    let one = Splats::new(row, vec![0.5; 3], vec![], 0, ShBasis::Standard).unwrap();
    let levels = Levels::new(&one);
    let selection = levels.select(&camera(1e9), CELL_PX);
    assert!(levels.len() == 1 && selection.len() == 1);
    assert!(levels.gather(&one, &selection).unwrap() == one);
    // No cell is as large as these four.
    let four = Splats::new(one.rows().repeat(4), one.sh().repeat(4), vec![], 0, ShBasis::Standard);
    let levels = Levels::new(&four.unwrap());
    assert!(levels.select(&camera(1e9), CELL_PX).is_whole());
    // The lengths of scene and selection are compared.
    let error = levels.gather(&one, &selection).unwrap_err().to_string();
    assert_eq!(error, "levels of detail: expected 4 Gaussians, got 1");
    let error = Levels::new(&wall()).gather(&wall(), &selection).unwrap_err().to_string();
    assert_eq!(error, "levels of detail: expected 9 blocks, got 1");
}

#[test]
fn numbers_that_are_not_finite_have_no_part_in_a_merge() {
    let all = wall();
    let camera = camera(10.0);
    let options = RasterOptions::default();
    let good = Levels::new(&all);
    let count = good.select(&camera, CELL_PX).len();
    for (column, value) in [
        (0, f32::NAN),
        (2, f32::INFINITY),
        (3, f32::NAN),
        (7, f32::NAN),
        (8, f32::INFINITY),
        (10, f32::NAN),
        (10, 0.001),
    ] {
        let mut poisoned = all.clone();
        poisoned.edit(|p| {
            let rows = p.rows.chunks_exact_mut(SPLAT_STRIDE).step_by(50);
            rows.for_each(|r| r[column] = value);
        });
        let levels = Levels::new(&poisoned);
        let selection = levels.select(&camera, CELL_PX);
        let chosen = levels.gather(&poisoned, &selection).unwrap();
        assert!(chosen.len() <= count + count / 10, "{column}: {} {count}", chosen.len());
        assert!(chosen.rows().iter().chain(chosen.sh()).all(|v| v.is_finite()), "{column}");
        let [whole, got] = [&poisoned, &chosen].map(|s| render(s, &camera, &options));
        let likeness = psnr(&got.rgb, &whole.rgb, SIDE, SIDE).unwrap();
        assert!(likeness >= 35.0, "{column}: {likeness:.1} dB");
    }
    let mut poisoned = all.clone();
    poisoned.edit(|p| {
        p.sh[7] = f32::NAN;
        p.gain[400] = f32::INFINITY;
    });
    let levels = Levels::new(&poisoned);
    let chosen = levels.gather(&poisoned, &levels.select(&camera, CELL_PX)).unwrap();
    assert!(chosen.sh().iter().all(|v| v.is_finite()));
    let nothing = {
        let mut nothing = all.clone();
        nothing.edit(|p| p.rows.fill(f32::NAN));
        nothing
    };
    assert!(Levels::new(&nothing).select(&camera, CELL_PX).is_whole());
}
