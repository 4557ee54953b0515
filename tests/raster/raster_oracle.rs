//! The rasterizer against the naive `f64` oracle on random scenes, and what must
//! hold for any scene: the same bytes for any number of threads and any memory
//! limit, no poison from bad numbers, background where nothing is.

use subsplat_test_support::edit::Edit;
use subsplat_test_support::oracle;

use glam::{EulerRot, Mat4, Quat, Vec3};
use oracle::{Shape, Splat};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Geometry, Rasterizer, Rendered, SimdLevel, SplatSlices};
use subsplat_kernels::layout::{
    ALPHA_MIN, Convention, OPACITY_OFFSET, RasterOptions, SPLAT_STRIDE, ShBasis, ShDirection,
};

/// xorshift64*.
struct Random(u64);

impl Random {
    /// Uniform in [0, 1).
    fn unit(&mut self) -> f32 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 40) as f32 / (1u64 << 24) as f32
    }

    fn range(&mut self, from: f32, to: f32) -> f32 {
        from + (to - from) * self.unit()
    }

    fn array<const N: usize>(&mut self, from: f32, to: f32) -> [f32; N] {
        std::array::from_fn(|_| self.range(from, to))
    }
}

/// Parameters of a random scene.
#[derive(Clone, Copy, Debug)]
enum Kind {
    /// Splats of a few pixels, some off the picture.
    Plain,
    /// Half behind the camera, some on and just past the near plane.
    NearPlane,
    /// Filling the view, opacities to 1.
    Huge,
    /// Axes 1 : 200.
    Needles,
    /// Opacity 0 or just below 1/255, among others above.
    Transparent,
    /// σ = 0 in one, two or three axes.
    Flat,
}

const KINDS: [Kind; 6] =
    [Kind::Plain, Kind::NearPlane, Kind::Huge, Kind::Needles, Kind::Transparent, Kind::Flat];

struct Scene {
    splats: Splats,
    camera: Camera,
}

const CHILDREN: usize = 4;

fn scene(kind: Kind, seed: u64, size: (usize, usize), gain_channels: usize) -> Scene {
    let mut r = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let camera = camera(&mut r, size, matches!(kind, Kind::NearPlane));
    let parents = 40;
    let (mut rows, mut sh, mut gain) = (Vec::new(), Vec::new(), Vec::new());
    for p in 0..parents {
        let z = r.range(1.5, 6.0);
        let at = Vec3::new(r.range(-0.6, 0.6) * z, r.range(-0.6, 0.6) * z, z);
        let px = z / camera.intrinsics().fx;
        for k in 0..CHILDREN {
            let jitter = Vec3::from_array(r.array(-2.0, 2.0)) * px;
            let (mut at, mut scale) = (at + jitter, r.array(0.4, 4.0).map(|s: f32| s * px));
            let mut opacity = r.unit().sqrt();
            match (kind, (p + k) % 4) {
                (Kind::NearPlane, 0) => at.z = -at.z,
                (Kind::NearPlane, 1) => {
                    // Exactly on either convention's plane, then past it.
                    at = Vec3::new(0.001, 0.002, [0.01, 0.2, 0.011, 0.21][p % 4]);
                    scale = r.array(1e-4, 2e-4);
                    opacity *= 0.5;
                }
                (Kind::Huge, _) => scale = r.array(0.5, 4.0).map(|s: f32| s * z),
                (Kind::Needles, i) => {
                    scale = [0.1 * px; 3];
                    scale[i % 3] = 20.0 * px;
                }
                (Kind::Transparent, i) => {
                    opacity = [0.0, 0.99 * ALPHA_MIN, 1.2 * ALPHA_MIN, 0.9][i];
                }
                (Kind::Flat, i) => scale[..i.min(3)].fill(0.0),
                _ => {}
            }
            rows.extend(camera.world_from_camera().transform_point3(at).to_array());
            // Any length: the kernel normalises.
            rows.extend(r.array::<4>(-1.0, 1.0));
            rows.extend(scale);
            rows.push(opacity);
            match gain_channels {
                1 => gain.push(r.range(-0.5, 1.5)),
                4 => gain.extend([r.range(0.5, 1.5), r.range(-0.2, 0.2), 0.1, -0.9]),
                _ => {}
            }
        }
        sh.extend((0..75).map(|i| r.range(-1.0, 1.0) * if i < 3 { 1.0 } else { 0.3 }));
    }
    Scene { splats: Splats::new(rows, sh, gain, 4, ShBasis::Standard).unwrap(), camera }
}

fn camera(r: &mut Random, (width, height): (usize, usize), at_origin: bool) -> Camera {
    let (w, h) = (width as f32, height as f32);
    // Centred, since the mvsplat frustum is.
    let k = Intrinsics { fx: 0.9 * w, fy: 0.95 * h, cx: w / 2.0, cy: h / 2.0, width, height };
    let [a, b, c] = r.array(-3.0, 3.0);
    let pose = if at_origin {
        Mat4::IDENTITY
    } else {
        let turn = Quat::from_euler(EulerRot::XYZ, a, b, c);
        Mat4::from_rotation_translation(turn, Vec3::new(b, c, a))
    };
    Camera::new(k, pose).unwrap()
}

fn for_oracle(splats: &Splats) -> Vec<Splat> {
    let k = splats.children_per_parent();
    let parent_mean = |p: usize| -> [f64; 3] {
        std::array::from_fn(|c| {
            (p * k..(p + 1) * k).map(|i| f64::from(splats.mean(i)[c])).sum::<f64>() / k as f64
        })
    };
    let one = |i: usize| {
        let (gain, residual) = splats.gain_of(i);
        Splat {
            mean: splats.mean(i),
            shape: Shape::Quat(splats.quat_wxyz(i), splats.scale(i)),
            opacity: splats.opacity(i),
            sh: splats.sh_of(i).chunks_exact(3).map(|c| c.try_into().unwrap()).collect(),
            gain,
            residual,
            parent_mean: parent_mean(i / k),
        }
    };
    (0..splats.len()).map(one).collect()
}

fn slices(splats: &Splats) -> SplatSlices<'_> {
    subsplat::scene::render::slices(splats)
}

/// Compares off the boundary; returns the largest difference and the boundary's size.
fn compare(got: &Rendered, expected: &oracle::Picture, what: &str, tolerance: f64) -> (f64, usize) {
    let (mut worst, mut boundary) = (0.0f64, 0);
    for p in 0..expected.alpha.len() {
        if expected.boundary[p] {
            boundary += 1;
            continue;
        }
        let mut check = |name: &str, got: f32, expected: f64, scale: f64| {
            let d = (f64::from(got) - expected).abs() / scale;
            assert!(d < tolerance, "{what}, pixel {p}, {name}: {got}, oracle {expected}");
            worst = worst.max(d);
        };
        for c in 0..3 {
            let e = expected.rgb[3 * p + c];
            check("rgb", got.rgb[3 * p + c], e, e.abs().max(1.0));
        }
        check("alpha", got.alpha[p], expected.alpha[p], 1.0);
        check("depth", got.depth_sum[p], expected.depth_sum[p], expected.depth_sum[p].max(1.0));
    }
    (worst, boundary)
}

fn options(convention: Convention) -> RasterOptions {
    let sh_basis = match convention {
        Convention::Standard => ShBasis::Standard,
        Convention::Mvsplat => ShBasis::Mvsplat,
    };
    let background = [0.2, 0.7, 0.4];
    RasterOptions { sh_basis, background, ..RasterOptions::new(convention) }
}

#[test]
fn random_scenes_agree() {
    let sizes = [(64, 48), (37, 53), (1, 1), (100, 33)];
    let (mut worst, mut pixels, mut boundary) = (0.0f64, 0, 0);
    for (i, kind) in KINDS.into_iter().enumerate() {
        for (j, &size) in sizes.iter().enumerate() {
            let scene = scene(kind, (100 * i + j) as u64, size, [0, 1, 4][(i + j) % 3]);
            let splats = for_oracle(&scene.splats);
            for convention in [Convention::Standard, Convention::Mvsplat] {
                let base = options(convention);
                let standard = convention == Convention::Standard;
                let variants = [
                    base,
                    RasterOptions { sh_direction: ShDirection::Parent, sh_degree: 2, ..base },
                    RasterOptions { antialiased: standard, lowpass: 1.2, ..base },
                ];
                for (v, o) in variants.into_iter().enumerate() {
                    let what = format!("{kind:?} {size:?} {convention:?} variant {v}");
                    let expected = oracle::render(&splats, &scene.camera, &o);
                    for &level in SimdLevel::available() {
                        let mut rasterizer = Rasterizer::new().with_simd_level(level);
                        let got = rasterizer.render(&slices(&scene.splats), &scene.camera, &o);
                        let what = format!("{what} {level:?}");
                        let (d, b) = compare(&got, &expected, &what, 5e-5);
                        worst = worst.max(d);
                        boundary += b;
                    }
                    pixels += expected.alpha.len();
                    if size == (64, 48) {
                        let covered = expected.alpha.iter().filter(|&&a| a > 0.05).count();
                        assert!(covered > 150, "{what}: only {covered} pixels covered");
                    }
                }
            }
        }
    }
    eprintln!("oracle: worst {worst:.1e}, boundary {boundary} of {pixels} pixels");
    let pixels = pixels * SimdLevel::available().len();
    assert!(boundary * 200 < pixels, "boundary: {boundary} of {pixels} pixels");
}

#[test]
fn covariances_and_quaternions_agree() {
    let scene = scene(Kind::Plain, 7, (64, 48), 1);
    let s = &scene.splats;
    let means: Vec<f32> = (0..s.len()).flat_map(|i| s.mean(i)).collect();
    let opacities: Vec<f32> = (0..s.len()).map(|i| s.opacity(i)).collect();
    let covariance = |i: usize| -> [f32; 6] {
        let [w, x, y, z] = s.quat_wxyz(i).map(f64::from);
        let r = glam::DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w).normalize());
        let d = glam::DVec3::from_array(s.scale(i).map(f64::from));
        let c = r * glam::DMat3::from_diagonal(d * d) * r.transpose();
        let e = |i: usize, j: usize| c.col(j)[i] as f32;
        [e(0, 0), e(0, 1), e(0, 2), e(1, 1), e(1, 2), e(2, 2)]
    };
    let cov6: Vec<f32> = (0..s.len()).flat_map(covariance).collect();
    let by_covariance = SplatSlices {
        geometry: Geometry::Cov6 { means: &means, cov6: &cov6, opacities: &opacities },
        ..slices(s)
    };
    let mut with_covariance = for_oracle(s);
    for (i, splat) in with_covariance.iter_mut().enumerate() {
        splat.shape = Shape::Cov6(covariance(i));
    }
    for convention in [Convention::Standard, Convention::Mvsplat] {
        let o = options(convention);
        let got = Rasterizer::new().render(&by_covariance, &scene.camera, &o);
        let expected = oracle::render(&with_covariance, &scene.camera, &o);
        compare(&got, &expected, &format!("cov6 {convention:?}"), 1e-4);
        let quats = Rasterizer::new().render(&slices(s), &scene.camera, &o);
        compare(&quats, &expected, &format!("quaternions {convention:?}"), 1e-4);
    }
}

/// mvsplat divides the scene by the near plane, so scaling a scene and its near
/// plane together changes nothing but the unit of depth; and it has no principal
/// point.
#[test]
fn mvsplat_lengths_are_in_units_of_near() {
    let scene = scene(Kind::NearPlane, 3, (64, 48), 0);
    let o = options(Convention::Mvsplat);
    let base = Rasterizer::new().render(&slices(&scene.splats), &scene.camera, &o);
    // A power of two scales f32 exactly.
    let mut scaled = scene.splats.clone();
    scaled.edit(|p| {
        for row in p.rows.chunks_exact_mut(SPLAT_STRIDE) {
            for lane in [0, 1, 2, 7, 8, 9] {
                row[lane] *= 4.0;
            }
        }
    });
    let mut pose = scene.camera.world_from_camera();
    pose.w_axis *= glam::Vec4::new(4.0, 4.0, 4.0, 1.0);
    let camera = Camera::new(scene.camera.intrinsics(), pose).unwrap();
    let near = RasterOptions { near: 4.0, ..o };
    let got = Rasterizer::new().render(&slices(&scaled), &camera, &near);
    assert!(got.rgb == base.rgb && got.alpha == base.alpha);
    for (a, b) in got.depth_sum.iter().zip(&base.depth_sum) {
        assert!((a - 4.0 * b).abs() <= 1e-6 * a.abs());
    }
    let unscaled = Rasterizer::new().render(&slices(&scaled), &camera, &o);
    assert!(unscaled.rgb != base.rgb, "the near plane has no effect");

    // The frustum's half-angles lie between the rays through the middles of opposite
    // edges; those of the vertical pair lean sideways by (W/2 − cx)/fx.
    let k = scene.camera.intrinsics();
    let off_k = Intrinsics { cx: k.cx + 7.0, ..k };
    let off = scene.camera.with_intrinsics(off_k).unwrap();
    let fx = 32.0 / (0.5 * off_k.fov_x()).tan();
    let fy = k.fy * 1.0f32.hypot(7.0 / off_k.fx);
    let centred = scene.camera.with_intrinsics(Intrinsics { fx, fy, ..k }).unwrap();
    let a = Rasterizer::new().render(&slices(&scene.splats), &off, &o);
    let b = Rasterizer::new().render(&slices(&scene.splats), &centred, &o);
    let distance = |a: &Rendered, b: &Rendered| {
        a.rgb.iter().zip(&b.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    assert!(distance(&a, &b) < 2e-4, "{}", distance(&a, &b));
    assert!(distance(&a, &base) > 0.01);
}

#[test]
fn any_number_of_threads_and_any_memory_gives_the_same_bytes() {
    // More splats than one chunk, so that there is something to divide.
    let mut all = scene(Kind::Plain, 0, (150, 97), 4);
    let camera = all.camera;
    for seed in 1..90 {
        let kind = KINDS[seed % KINDS.len()];
        if matches!(kind, Kind::NearPlane) {
            continue;
        }
        let more = scene(kind, seed as u64, (150, 97), 4);
        let move_back = camera.world_from_camera() * more.camera.camera_from_world();
        all.splats.edit(|p| {
            for row in more.splats.rows().chunks_exact(SPLAT_STRIDE) {
                let at = move_back.transform_point3(Vec3::from_slice(&row[..3]));
                p.rows.extend(at.to_array());
                p.rows.extend_from_slice(&row[3..]);
            }
            p.sh.extend_from_slice(more.splats.sh());
            p.gain.extend_from_slice(more.splats.gain());
        });
    }
    assert!(all.splats.len() > 10_000);
    let levels = SimdLevel::available().iter().map(|&level| (Convention::Standard, level));
    for (convention, level) in levels.chain([(Convention::Mvsplat, SimdLevel::best())]) {
        let o = options(convention);
        let new = || Rasterizer::new().with_simd_level(level);
        let run = |threads: usize, mut rasterizer: Rasterizer| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let first = rasterizer.render(&slices(&all.splats), &camera, &o);
                // Again with used buffers, after a frame of another size.
                let small = Intrinsics { width: 20, height: 30, ..camera.intrinsics() };
                let small = camera.with_intrinsics(small).unwrap();
                rasterizer.render(&slices(&all.splats), &small, &o);
                let second = rasterizer.render(&slices(&all.splats), &camera, &o);
                assert!(bytes(&first) == bytes(&second), "a used context changes the picture");
                (first, rasterizer.stats())
            })
        };
        let (one, stats) = run(1, new());
        let (three, stats3) = run(3, new());
        assert!(
            bytes(&one) == bytes(&three),
            "{convention:?} {level:?}: threads change the picture"
        );
        assert_eq!((stats.pairs, stats.items), (stats3.pairs, stats3.items));
        for limit in [0, stats.pairs / 7] {
            let (few, _) = run(2, new().with_pairs_per_group(limit));
            assert!(
                bytes(&one) == bytes(&few),
                "{convention:?} {level:?}: the limit changes the picture"
            );
        }
        let mut planes = Vec::new();
        new().render_planes(&slices(&all.splats), &camera, &o, &mut planes);
        let pixels = one.alpha.len();
        for p in 0..pixels {
            let got: [f32; 5] = std::array::from_fn(|c| planes[c * pixels + p]);
            let rgb = &one.rgb[3 * p..3 * p + 3];
            assert_eq!(got, [rgb[0], rgb[1], rgb[2], one.alpha[p], one.depth_sum[p]]);
        }
    }
}

/// Levels with fused products agree to the byte, however wide their registers. The baseline,
/// which rounds products as well, agrees to 1e-5 but for pixels where that flips a decision.
#[test]
fn levels_agree() {
    let (mut flipped, mut pixels) = (0, 0);
    for (i, kind) in KINDS.into_iter().enumerate() {
        let scene = scene(kind, 40 + i as u64, (100, 75), [0, 1, 4][i % 3]);
        for convention in [Convention::Standard, Convention::Mvsplat] {
            let o = options(convention);
            let render = |level| {
                Rasterizer::new().with_simd_level(level).render(
                    &slices(&scene.splats),
                    &scene.camera,
                    &o,
                )
            };
            let baseline = render(SimdLevel::Baseline);
            let fused = SimdLevel::available().iter().filter(|&&t| t != SimdLevel::Baseline);
            let fused: Vec<Rendered> = fused.map(|&t| render(t)).collect();
            for other in fused.windows(2) {
                assert!(bytes(&other[0]) == bytes(&other[1]), "{kind:?} {convention:?}");
            }
            if let Some(picture) = fused.first() {
                pixels += picture.alpha.len();
                for (a, b) in picture.rgb.chunks_exact(3).zip(baseline.rgb.chunks_exact(3)) {
                    let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs() / b.abs().max(1.0));
                    flipped += usize::from(apart.fold(0.0, f32::max) > 1e-5);
                }
            }
        }
    }
    eprintln!("{flipped} of {pixels} pixels differ between baseline and fused levels");
    assert!(flipped * 100 <= pixels, "{flipped} of {pixels} pixels");
}

/// A context without a requested level uses the best one. A context with a level that the
/// processor lacks still draws.
#[test]
fn absent_levels_draw_as_the_baseline() {
    let scene = scene(Kind::Plain, 11, (64, 48), 0);
    let o = options(Convention::Standard);
    let render = |r: Rasterizer| bytes(&{ r }.render(&slices(&scene.splats), &scene.camera, &o));
    assert!(
        render(Rasterizer::new()) == render(Rasterizer::new().with_simd_level(SimdLevel::best()))
    );
    for level in [SimdLevel::Avx2, SimdLevel::Avx512, SimdLevel::Neon] {
        if !level.is_available() {
            let baseline = Rasterizer::new().with_simd_level(SimdLevel::Baseline);
            assert!(render(Rasterizer::new().with_simd_level(level)) == render(baseline));
        }
    }
}

/// A million splats in one tile, and splats far larger than the picture.
#[test]
fn crowds_and_giants_are_drawn() {
    let k = Intrinsics { fx: 60.0, fy: 60.0, cx: 20.0, cy: 20.0, width: 40, height: 40 };
    let camera = Camera::new(k, Mat4::IDENTITY).unwrap();
    let mut r = Random(77);
    let n = 1 << 20;
    let mut rows = Vec::with_capacity(SPLAT_STRIDE * n);
    for i in 0..n {
        let z = 2.0 + 3.0 * r.unit();
        let giant = i % 50_000 == 0;
        let scale = if giant { 1e6 } else { 0.002 };
        // All within one pixel of (10.5, 10.5).
        rows.extend([-0.16 * z, -0.16 * z, z, 1.0, 0.0, 0.0, 0.0, scale, scale, scale * 0.5]);
        rows.push(if giant { 0.05 } else { 0.008 });
    }
    let splats = Splats::new(rows, vec![0.3; 3 * n], vec![], 0, ShBasis::Standard).unwrap();
    let o = options(Convention::Standard);
    let mut rasterizer = Rasterizer::new();
    let picture = rasterizer.render(&slices(&splats), &camera, &o);
    assert!(picture.rgb.iter().all(|v| v.is_finite()));
    assert!(picture.alpha.iter().all(|&a| a > 0.5), "giants cover the picture");
    assert!(picture.alpha[10 * 40 + 10] > 0.9995, "the crowd is opaque");
    assert!(rasterizer.stats().visible == n);
    // Front to back: with all of one colour, C = c·alpha + T·background.
    let colour = 0.5 + 0.3 * 0.282_094_8;
    for p in 0..1600 {
        for c in 0..3 {
            let a = picture.alpha[p];
            let expected = a * colour + (1.0 - a) * o.background[c];
            assert!((picture.rgb[3 * p + c] - expected).abs() < 2e-5);
        }
    }
}

/// Stage times are zeros unless enabled.
#[test]
fn stage_times_are_asked_for() {
    let scene = scene(Kind::Plain, 2, (64, 48), 0);
    let o = options(Convention::Standard);
    let mut plain = Rasterizer::new();
    plain.render(&slices(&scene.splats), &scene.camera, &o);
    assert_eq!(plain.stage_times(), Default::default());
    let mut timed = Rasterizer::new().with_stage_times();
    timed.render(&slices(&scene.splats), &scene.camera, &o);
    let t = timed.stage_times();
    assert!([t.project, t.list, t.tiles, t.sort, t.blend, t.write].iter().all(|d| !d.is_zero()));
}

fn bytes(picture: &Rendered) -> Vec<u32> {
    let values = picture.rgb.iter().chain(&picture.alpha).chain(&picture.depth_sum);
    values.map(|v| v.to_bits()).collect()
}

#[test]
fn bad_numbers_drop_their_splat_and_nothing_else() {
    let good = scene(Kind::Plain, 5, (64, 48), 4);
    let (n, k) = (good.splats.len(), CHILDREN);
    for convention in [Convention::Standard, Convention::Mvsplat] {
        let o = options(convention);
        let rasterize = |s: &Splats, o| Rasterizer::new().render(&slices(s), &good.camera, o);
        // The oracle of dropping a splat is not having it: opacity 0.
        let without = |dropped: &[usize]| {
            let mut s = good.splats.clone();
            s.edit(|p| {
                dropped.iter().for_each(|i| p.rows[i * SPLAT_STRIDE + OPACITY_OFFSET] = 0.0);
            });
            rasterize(&s, &o)
        };
        assert!(without(&[]) != without(&(0..n).collect::<Vec<_>>()));
        for lane in 0..SPLAT_STRIDE {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38] {
                if lane == OPACITY_OFFSET && bad == 1e38 {
                    continue; // Opaque, not bad: the cap deals with it.
                }
                let mut s = good.splats.clone();
                let hit: Vec<usize> = (lane..n).step_by(9).collect();
                s.edit(|p| hit.iter().for_each(|i| p.rows[i * SPLAT_STRIDE + lane] = bad));
                let got = rasterize(&s, &o);
                assert!(got == without(&hit), "lane {lane} = {bad} {convention:?}");
            }
        }
        let mut s = good.splats.clone();
        let zero: Vec<usize> = (0..n).step_by(5).collect();
        s.edit(|p| {
            let quaternion = |i: &usize| i * SPLAT_STRIDE + 3..i * SPLAT_STRIDE + 7;
            zero.iter().for_each(|i| p.rows[quaternion(i)].fill(0.0));
        });
        assert!(rasterize(&s, &o) == without(&zero), "zero quaternions {convention:?}");
        let mut s = good.splats.clone();
        s.edit(|p| {
            p.gain[4 * 11 + 2] = f32::NAN;
            p.gain[4 * 12] = f32::INFINITY;
        });
        assert!(rasterize(&s, &o) == without(&[11, 12]), "gain {convention:?}");
        let mut s = good.splats.clone();
        s.edit(|p| p.sh[75 * 3 + 5] = f32::NAN);
        let family: Vec<usize> = (3 * k..4 * k).collect();
        assert!(rasterize(&s, &o) == without(&family), "SH {convention:?}");
        // A lost child does not blind its siblings under the parent's direction.
        let shared = RasterOptions { sh_direction: ShDirection::Parent, ..o };
        let mut s = good.splats.clone();
        s.edit(|p| p.rows[8 * SPLAT_STRIDE] = f32::NAN);
        let got = rasterize(&s, &shared);
        assert!(got.rgb.iter().all(|v| v.is_finite()));
        let all_gone = rasterize(&poisoned(&good.splats), &o);
        assert!(all_gone == without(&(0..n).collect::<Vec<_>>()));
    }
}

fn poisoned(splats: &Splats) -> Splats {
    let mut s = splats.clone();
    s.edit(|p| p.rows.fill(f32::NAN));
    s
}

#[test]
fn an_empty_scene_is_background() {
    let mut r = Random(1);
    let camera = camera(&mut r, (45, 33), false);
    let empty = Splats::new(vec![], vec![], vec![], 3, ShBasis::Standard).unwrap();
    for convention in [Convention::Standard, Convention::Mvsplat] {
        let o = options(convention);
        let picture = subsplat::scene::render(&empty, &camera, &o);
        assert_eq!((picture.width, picture.height), (45, 33));
        assert_eq!(picture.rgb.len(), 3 * 45 * 33);
        assert!(picture.rgb.chunks_exact(3).all(|c| c == o.background));
        assert!(picture.alpha.iter().chain(&picture.depth).all(|&v| v == 0.0));
    }
}

/// Behind two opaque layers no work is done, at the picture's rim either.
#[test]
fn opaque_layers_end_the_work() {
    let k = Intrinsics { fx: 30.0, fy: 30.0, cx: 16.5, cy: 16.5, width: 33, height: 33 };
    let camera = Camera::new(k, Mat4::IDENTITY).unwrap();
    let layer = |i: usize| [0.0, 0.0, 2.0 + i as f32, 1.0, 0.0, 0.0, 0.0, 1e3, 1e3, 0.0, 1.0];
    let rows: Vec<f32> = (0..300).flat_map(layer).collect();
    let splats = Splats::new(rows, vec![0.5; 900], vec![], 0, ShBasis::Standard).unwrap();
    let mut rasterizer = Rasterizer::new();
    let picture = rasterizer.render(&slices(&splats), &camera, &RasterOptions::default());
    assert!(picture.alpha.iter().all(|&a| a > 0.998));
    // 9 × 9 blocks have a pixel inside; each takes one layer and stops at the next.
    let stats = rasterizer.stats();
    assert_eq!((stats.visible, stats.pairs, stats.items), (300, 4 * 300, 2 * 81));

    // Points over a picture of one pixel: the block's other 15 stay clear for long,
    // and count for nothing.
    let k = Intrinsics { cx: 0.5, cy: 0.5, width: 1, height: 1, ..k };
    let camera = Camera::new(k, Mat4::IDENTITY).unwrap();
    let mut points = splats.clone();
    points.edit(|p| p.rows.chunks_exact_mut(SPLAT_STRIDE).for_each(|row| row[7..10].fill(0.0)));
    rasterizer.render(&slices(&points), &camera, &RasterOptions::default());
    assert_eq!(rasterizer.stats().items, 2);
}

/// `render` reads the basis from the splats, and divides depth by alpha.
#[test]
fn render_uses_the_splats_own_basis() {
    let scene = scene(Kind::Plain, 9, (64, 48), 0);
    let mut splats = scene.splats;
    splats.edit(|p| p.sh_basis = ShBasis::Mvsplat);
    let o = RasterOptions::default();
    let picture = subsplat::scene::render(&splats, &scene.camera, &o);
    let mvsplat = RasterOptions { sh_basis: ShBasis::Mvsplat, ..o };
    let direct = Rasterizer::new().render(&slices(&splats), &scene.camera, &mvsplat);
    assert!(picture.rgb == direct.rgb);
    let standard = Rasterizer::new().render(&slices(&splats), &scene.camera, &o);
    assert!(picture.rgb != standard.rgb);
    for p in (0..64 * 48).filter(|&p| direct.alpha[p] > 0.1) {
        let expected = direct.depth_sum[p] / direct.alpha[p];
        assert!((picture.depth[p] - expected).abs() < 1e-5 * expected);
        assert!((1.0..6.5).contains(&picture.depth[p]));
    }
}
