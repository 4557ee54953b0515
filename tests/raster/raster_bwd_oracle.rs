//! The rasterizer's gradients against finite differences of the naive `f64` oracle, on
//! random and on nasty scenes, for all five planes and every input; and what must hold
//! for any scene: no poison from bad numbers, the same bytes for any number of threads
//! and any memory limit.

use subsplat_test_support::raster_scene;

use glam::Vec3;
use raster_scene::{CHILDREN, KINDS, Kind, Random, SIZE, Scene};
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Gradients, Rasterizer, SimdLevel};
use subsplat_kernels::layout::{
    Convention, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, ShBasis,
    ShDirection, sh_coefficients,
};

/// Central difference of the loss in one number, which `of` finds. Steps are such that
/// no alpha moves by more than the oracle's boundary is wide, and count as `f32` took
/// them.
fn slope(
    scene: &Scene,
    (o, v): (&RasterOptions, &[f32]),
    step: f32,
    of: impl Fn(&mut Scene) -> &mut f32,
) -> f64 {
    let at = |sign: f32| {
        let mut s = scene.clone();
        let x = of(&mut s);
        *x += sign * step;
        let x = f64::from(*x);
        (x, s.loss(o, v))
    };
    let ((x1, l1), (x0, l0)) = (at(1.0), at(-1.0));
    (l1 - l0) / (x1 - x0)
}

/// Largest error over rows of `lanes`: max|difference| / (max|row| + median max|row|).
fn worst_row(got: &[f32], expected: &[f64], lanes: usize, what: &str) -> f64 {
    assert_eq!(got.len(), expected.len(), "{what}");
    let most = |row: &[f64]| row.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let mut sizes: Vec<f64> = expected.chunks(lanes).map(most).filter(|&m| m > 0.0).collect();
    assert!(!sizes.is_empty(), "{what}: nothing to compare with");
    sizes.sort_by(f64::total_cmp);
    let median = sizes[sizes.len() / 2];
    let rows = got.chunks(lanes).zip(expected.chunks(lanes));
    rows.fold(0.0f64, |worst, (g, e)| {
        let d = g.iter().zip(e).fold(0.0f64, |m, (g, e)| {
            assert!(g.is_finite(), "{what}: {g} for {e}");
            m.max((f64::from(*g) - e).abs())
        });
        worst.max(d / (most(e) + median))
    })
}

fn check(scene: &Scene, o: &RasterOptions, tolerance: f64, what: &str) -> f64 {
    let v = scene.upstream(o, 77);
    let got = scene.gradients(o, &v);
    let with = (o, &v[..]);
    let px = 3.0 / SIZE.0 as f32;
    let lane = |lane: usize, step: &dyn Fn(f32) -> f32| -> Vec<f64> {
        let of = |i: usize| i * SPLAT_STRIDE + lane;
        (0..scene.len())
            .map(|i| slope(scene, with, step(scene.rows[of(i)]), |s| &mut s.rows[of(i)]))
            .collect()
    };
    let lanes = |from: usize, n: usize, step: &dyn Fn(f32) -> f32| -> Vec<f64> {
        let columns: Vec<_> = (from..from + n).map(|l| lane(l, step)).collect();
        (0..scene.len()).flat_map(|i| columns.iter().map(move |c| c[i])).collect()
    };
    let part = |from: usize, n: usize| -> Vec<f32> {
        got.rows.chunks(SPLAT_STRIDE).flat_map(|r| r[from..from + n].to_vec()).collect()
    };
    let cov = !scene.cov6.is_empty();
    let mut worst = 0.0f64;
    let mut hold = |name: &str, got: &[f32], expected: &[f64], lanes: usize| {
        let what = format!("{what} {name}");
        let e = worst_row(got, expected, lanes, &what);
        assert!(e < tolerance, "{what}: {e:.1e}");
        worst = worst.max(e);
    };
    let means = lanes(0, 3, &|_| 1e-4 * px);
    let opacities = lanes(OPACITY_OFFSET, 1, &|x| 5e-5 * x);
    if cov {
        let expected: Vec<f64> = (0..scene.cov6.len())
            .map(|i| {
                let diagonal = scene.cov6[i / 6 * 6] + scene.cov6[i / 6 * 6 + 3];
                slope(scene, with, 2e-5 * diagonal, |s| &mut s.cov6[i])
            })
            .collect();
        hold("means", &got.means, &means, 3);
        hold("cov6", &got.cov6, &expected, 6);
        hold("opacities", &got.opacities, &opacities, 1);
    } else {
        hold("means", &part(0, 3), &means, 3);
        hold("quats", &part(QUAT_OFFSET, 4), &lanes(QUAT_OFFSET, 4, &|_| 3e-7), 4);
        let step = |x: f32| if x == 0.0 { 1e-4 * px } else { 3e-5 * x };
        hold("scales", &part(SCALE_OFFSET, 3), &lanes(SCALE_OFFSET, 3, &step), 3);
        hold("opacities", &part(OPACITY_OFFSET, 1), &opacities, 1);
    }
    let all = |n: usize, of: fn(&mut Scene) -> &mut Vec<f32>| -> Vec<f64> {
        (0..n).map(|i| slope(scene, with, 1e-5, |s| &mut of(s)[i])).collect()
    };
    let set = 3 * sh_coefficients(scene.degree);
    hold("sh", &got.sh, &all(scene.sh.len(), |s| &mut s.sh), set);
    if !scene.gain.is_empty() {
        let lanes = scene.gain.len() / scene.len();
        hold("gain", &got.gain, &all(scene.gain.len(), |s| &mut s.gain), lanes);
    }
    let background: Vec<f64> = (0..3)
        .map(|c| {
            let at = |x: f32| {
                let mut o = *o;
                o.background[c] += x;
                scene.loss(&o, &v)
            };
            at(0.5) - at(-0.5)
        })
        .collect();
    hold("background", &got.background, &background, 3);
    worst
}

fn options(convention: Convention) -> RasterOptions {
    let sh_basis = match convention {
        Convention::Standard => ShBasis::Standard,
        Convention::Mvsplat => ShBasis::Mvsplat,
    };
    let background = [0.2, 0.7, 0.4];
    RasterOptions { sh_basis, background, ..RasterOptions::new(convention) }
}

fn check_kind(kind: Kind) {
    for (v, convention) in [Convention::Standard, Convention::Mvsplat].into_iter().enumerate() {
        let o = options(convention);
        let i = kind as usize;
        let (degree, lanes) = ((i + v) % 5, [4, 0, 1][(i + v) % 3]);
        let scene = Scene::new(kind, 40 + i as u64, 5, degree, lanes);
        let tolerance = if kind == Kind::Needles { 2e-3 } else { 5e-4 };
        let what = format!("{kind:?} {convention:?}");
        let worst = check(&scene, &o, tolerance, &what);
        eprintln!("{what}: worst {worst:.1e}");
    }
}

macro_rules! kinds {
    ($($name:ident $kind:ident)*) => { $( #[test] fn $name() { check_kind(Kind::$kind); } )* };
}

kinds! {
    plain Plain saturated Saturated needles Needles behind Behind off_screen OffScreen flat Flat
}

/// Colours below 0 and above 1, of the splats themselves and of parents.
#[test]
fn colours_without_a_direction() {
    let o = RasterOptions { sh_direction: ShDirection::Colour, ..options(Convention::Standard) };
    for (seed, lanes) in [(21, 0), (22, 1), (23, 4)] {
        let scene = Scene::new(Kind::Plain, seed, 4, 0, lanes);
        assert!(scene.sh.iter().any(|v| *v < 0.0));
        check(&scene, &o, 5e-4, &format!("colours, {lanes} numbers of gain"));
    }
}

#[test]
fn antialiasing_and_shared_directions() {
    let o = RasterOptions { antialiased: true, ..options(Convention::Standard) };
    check(&Scene::new(Kind::Plain, 9, 4, 1, 1), &o, 5e-4, "antialiased");
    check(&Scene::new(Kind::Needles, 8, 4, 0, 0), &o, 2e-3, "antialiased needles");
    for convention in [Convention::Standard, Convention::Mvsplat] {
        let o = RasterOptions { sh_direction: ShDirection::Parent, ..options(convention) };
        check(&Scene::new(Kind::Plain, 10, 4, 3, 4), &o, 5e-4, "parent's direction");
    }
    let o = RasterOptions { sh_degree: 2, ..options(Convention::Standard) };
    check(&Scene::new(Kind::Plain, 11, 4, 4, 1), &o, 5e-4, "degree cut to 2");
}

#[test]
fn covariances() {
    let aa = RasterOptions { antialiased: true, ..options(Convention::Standard) };
    for (o, what) in [(options(Convention::Mvsplat), "mvsplat"), (aa, "antialiased")] {
        let scene = Scene::new(Kind::Plain, 12, 5, 2, 1).with_covariances();
        check(&scene, &o, 5e-4, &format!("cov6 {what}"));
    }
}

/// 800 faint splats over every block of one tile: more (splat, block) items than the
/// tile's walk keeps at once (2¹⁵), so that it goes in stretches.
#[test]
fn a_list_longer_than_what_is_kept() {
    let mut scene = Scene::new(Kind::Plain, 9, 200, 0, 0);
    let mut r = Random(11);
    let depth = |row: &[f32], camera: &Camera| {
        let at = Vec3::new(row[0], row[1], row[2]);
        camera.world_from_camera().inverse().transform_point3(at).z
    };
    for row in scene.rows.chunks_mut(SPLAT_STRIDE) {
        let px = depth(row, &scene.camera) / SIZE.0 as f32;
        row[SCALE_OFFSET..SCALE_OFFSET + 3]
            .copy_from_slice(&r.array::<3>(60.0, 80.0).map(|s: f32| s * px));
        row[OPACITY_OFFSET] = r.range(0.008, 0.01);
    }
    let o = options(Convention::Standard);
    let v = scene.upstream(&o, 77);
    assert!(v.iter().filter(|v| **v != 0.0).count() > v.len() / 2);
    let got = scene.gradients(&o, &v);
    let opacity = |i: usize| got.rows[i * SPLAT_STRIDE + OPACITY_OFFSET];
    let most = (0..scene.len()).fold(0f32, |m, i| m.max(opacity(i).abs()));
    for i in (0..scene.len()).step_by(23) {
        let at = i * SPLAT_STRIDE + OPACITY_OFFSET;
        let want = slope(&scene, (&o, &v), 5e-5 * scene.rows[at], |s| &mut s.rows[at]);
        let error = (f64::from(opacity(i)) - want).abs() / f64::from(most);
        assert!(error < 1e-4, "splat {i}: {} for {want}", opacity(i));
    }
}

fn bytes(g: &Gradients) -> Vec<u32> {
    let all = [&g.rows[..], &g.means, &g.cov6, &g.opacities, &g.sh, &g.gain, &g.background];
    all.into_iter().flatten().map(|v| v.to_bits()).collect()
}

#[test]
fn bad_numbers_get_zeros_and_poison_nothing() {
    let good = Scene::new(Kind::Plain, 5, 12, 3, 4);
    for convention in [Convention::Standard, Convention::Mvsplat] {
        let o = options(convention);
        let v = good.upstream(&o, 3);
        for lane in 0..SPLAT_STRIDE {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38] {
                // Opaque is not bad, and a point at 1e38 may well be seen.
                if bad == 1e38 && (lane == OPACITY_OFFSET || lane < QUAT_OFFSET) {
                    continue;
                }
                let (mut broken, mut without) = (good.clone(), good.clone());
                let hit: Vec<usize> = (lane % 3..good.len()).step_by(5).collect();
                for &i in &hit {
                    broken.rows[i * SPLAT_STRIDE + lane] = bad;
                    without.rows[i * SPLAT_STRIDE + OPACITY_OFFSET] = 0.0;
                }
                let (got, expected) = (broken.gradients(&o, &v), without.gradients(&o, &v));
                assert!(got == expected, "lane {lane} = {bad} {convention:?}");
                assert!(got.rows.iter().any(|&g| g != 0.0));
                for i in hit {
                    assert!(got.rows[i * SPLAT_STRIDE..][..SPLAT_STRIDE].iter().all(|&g| g == 0.0));
                    assert!(got.gain[4 * i..4 * i + 4].iter().all(|&g| g == 0.0));
                }
            }
        }
        let mut broken = good.clone();
        broken.sh[48 * 3 + 5] = f32::NAN;
        broken.gain[4 * 30] = f32::INFINITY;
        let got = broken.gradients(&o, &v);
        assert!(got.rows.iter().chain(&got.sh).chain(&got.gain).all(|g| g.is_finite()));
        assert!(got.sh[48 * 3..48 * 4].iter().all(|&g| g == 0.0), "{convention:?}");
        let shared = RasterOptions { sh_direction: ShDirection::Parent, ..o };
        let mut broken = good.clone();
        broken.rows[8 * SPLAT_STRIDE] = f32::NAN;
        let got = broken.gradients(&shared, &v);
        assert!(got.rows.iter().chain(&got.sh).all(|g| g.is_finite()));
        assert!(got.rows[8 * SPLAT_STRIDE..][..SPLAT_STRIDE].iter().all(|&g| g == 0.0));
    }
}

/// A big scene in a bigger picture, of every kind.
fn crowd() -> Scene {
    let mut all = Scene::new(Kind::Plain, 0, 700, 3, 1);
    let k = Intrinsics { fx: 150.0, fy: 150.0, cx: 75.0, cy: 50.0, width: 151, height: 99 };
    let from = all.camera.world_from_camera();
    all.camera = Camera::new(k, from).unwrap();
    for (seed, kind) in KINDS.into_iter().enumerate().skip(1) {
        let more = Scene::new(kind, 100 + seed as u64, 300, 3, 1);
        let move_back = from * more.camera.camera_from_world();
        for row in more.rows.chunks_exact(SPLAT_STRIDE) {
            all.rows.extend(move_back.transform_point3(Vec3::from_slice(&row[..3])).to_array());
            all.rows.extend_from_slice(&row[3..]);
        }
        all.sh.extend(more.sh);
        all.gain.extend(more.gain);
    }
    all
}

#[test]
fn any_number_of_threads_and_any_memory_gives_the_same_bytes() {
    let all = crowd();
    assert!(all.len() > 8500);
    let n = 5 * 151 * 99;
    let mut r = Random(5);
    let v: Vec<f32> = (0..n).map(|_| r.range(-1.0, 1.0)).collect();
    for convention in [Convention::Standard, Convention::Mvsplat] {
        for sh_direction in [ShDirection::Child, ShDirection::Parent] {
            let o = RasterOptions { sh_direction, ..options(convention) };
            let run = |threads: usize, mut rasterizer: Rasterizer| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    all.with_slices(|s| {
                        let mut out = Gradients::default();
                        rasterizer.backward(&s, &all.camera, &o, &v, &mut out);
                        let first = bytes(&out);
                        // Again with used buffers, and with what the forward left.
                        let mut planes = Vec::new();
                        let mut frame = rasterizer.frame(s, &all.camera, &o, &mut planes);
                        for _ in 0..2 {
                            frame.backward(&v, &mut out);
                            assert!(bytes(&out) == first, "a used context changes gradients");
                        }
                        (first, rasterizer.stats().pairs)
                    })
                })
            };
            let (one, pairs) = run(1, Rasterizer::new());
            assert!(one.iter().all(|&v| f32::from_bits(v).is_finite()));
            let (two, _) = run(2, Rasterizer::new());
            let (three, _) = run(3, Rasterizer::new());
            assert!(one == two && one == three, "{convention:?}: threads change gradients");
            for limit in [0, pairs / 7] {
                let (few, _) = run(2, Rasterizer::new().with_pairs_per_group(limit));
                assert!(one == few, "{convention:?}: the memory limit changes gradients");
            }
        }
    }
}

/// With and without siblings, by the directions of children and of parents.
#[test]
fn a_limit_of_sh_coefficients_leaves_the_other_gradients() {
    for (degree, alone) in [(0, true), (1, false), (3, true), (3, false), (4, true), (4, false)] {
        let mut scene = Scene::new(Kind::Plain, 40 + degree as u64, 40, degree, 4);
        let set = 3 * sh_coefficients(degree);
        if alone {
            let sets = scene.sh.chunks_exact(set);
            scene.sh = sets.flat_map(|set| set.repeat(CHILDREN)).collect();
        }
        for sh_direction in [ShDirection::Child, ShDirection::Parent] {
            let o = RasterOptions { sh_direction, ..options(Convention::Standard) };
            let v = scene.upstream(&o, 3);
            // Used buffers of all coefficients.
            let mut got = Gradients::default();
            let backward = |out: &mut Gradients| {
                let mut rasterizer = Rasterizer::new();
                scene.with_slices(|s| rasterizer.backward(&s, &scene.camera, &o, &v, out));
            };
            backward(&mut got);
            let all = got.clone();
            for limit in [4, 0, 1, 25] {
                got.sh_limit = Some(limit);
                backward(&mut got);
                let kept = set.min(3 * limit);
                let sh = all.sh.chunks_exact(set).flat_map(|set| &set[..kept]).copied().collect();
                let expected = Gradients { sh, sh_limit: Some(limit), ..all.clone() };
                let what = format!("degree {degree}, alone {alone}, {sh_direction:?}, {limit}");
                assert!(got == expected, "{what}");
                assert_eq!(all.clone().limited(degree, Some(limit)), expected, "{what}");
            }
        }
    }
}

/// Every instruction set gives the gradients, and those that fuse the same bytes.
#[test]
fn levels_agree() {
    let scene = Scene::new(Kind::Plain, 21, 12, 3, 4);
    let o = options(Convention::Standard);
    let v = scene.upstream(&o, 3);
    let run = |level: SimdLevel| {
        let mut out = Gradients::default();
        let mut rasterizer = Rasterizer::new().with_simd_level(level);
        scene.with_slices(|s| rasterizer.backward(&s, &scene.camera, &o, &v, &mut out));
        out
    };
    let best = run(SimdLevel::best());
    for &level in SimdLevel::available() {
        let got = run(level);
        if level != SimdLevel::Baseline && SimdLevel::best() != SimdLevel::Baseline {
            assert!(bytes(&got) == bytes(&best), "{level:?}");
        }
        for (what, got, best, lanes) in [
            ("rows", &got.rows, &best.rows, SPLAT_STRIDE),
            ("sh", &got.sh, &best.sh, 48),
            ("gain", &got.gain, &best.gain, 4),
        ] {
            let best: Vec<f64> = best.iter().map(|&v| f64::from(v)).collect();
            let e = worst_row(got, &best, lanes, what);
            assert!(e < 2e-4, "{level:?} {what}: {e:.1e}");
        }
    }
}

#[test]
fn nothing_to_see_gives_zeros() {
    let scene = Scene::new(Kind::Plain, 2, 3, 1, 1);
    let o = options(Convention::Standard);
    // Gradients of another size than the picture.
    let got = scene.gradients(&o, &[1.0; 7]);
    assert_eq!((got.rows.len(), got.sh.len()), (scene.rows.len(), scene.sh.len()));
    assert!(bytes(&got).iter().all(|&b| b == 0));
    let mut empty = scene.clone();
    (empty.rows, empty.sh, empty.gain) = (Vec::new(), Vec::new(), Vec::new());
    let v = vec![0.25; 5 * SIZE.0 * SIZE.1];
    let got = empty.gradients(&o, &v);
    assert!(got.rows.is_empty() && got.sh.is_empty());
    assert_eq!(got.background, [0.25 * (SIZE.0 * SIZE.1) as f32; 3]);
}
