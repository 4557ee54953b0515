//! The rasterizer's gradients against finite differences of the naive `f64` oracle, on
//! random and on nasty scenes, for all five planes and every input; and what must hold
//! for any scene: no poison from bad numbers, the same bytes for any number of threads
//! and any memory limit.

#[path = "common/oracle.rs"]
mod oracle;

use glam::{EulerRot, Mat4, Quat, Vec3};
use oracle::{Shape, Splat};
use subsplat::abi::{
    Convention, LANE_OPACITY, LANE_QUAT, LANE_SCALE, RasterOptions, SPLAT_LANES, ShBasis,
    ShDirection, sh_coefficients,
};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::cpu::{Geometry, Gradients, Rasterizer, SplatSlices, Tier};

/// xorshift64*.
struct Random(u64);

impl Random {
    /// Uniform in [from, to).
    fn range(&mut self, from: f32, to: f32) -> f32 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let unit = (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 40) as f32 / (1u64 << 24) as f32;
        from + (to - from) * unit
    }

    fn array<const N: usize>(&mut self, from: f32, to: f32) -> [f32; N] {
        std::array::from_fn(|_| self.range(from, to))
    }
}

/// What a random scene is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Plain,
    /// Opacities to 1 on splats that cover much: early stops, capped alphas.
    Saturated,
    /// Axes 1 : 200.
    Needles,
    /// A third behind the camera, a third just past the near plane.
    Behind,
    /// Centres far outside the picture, where the Jacobian's slope is clamped.
    OffScreen,
    /// σ = 0 in one, two or three axes.
    Flat,
}

const KINDS: [Kind; 6] =
    [Kind::Plain, Kind::Saturated, Kind::Needles, Kind::Behind, Kind::OffScreen, Kind::Flat];
const CHILDREN: usize = 4;
const SIZE: (usize, usize) = (33, 22);

#[derive(Clone)]
struct Scene {
    rows: Vec<f32>,
    /// Instead of the rows' quaternions and σ, where not empty.
    cov6: Vec<f32>,
    sh: Vec<f32>,
    gain: Vec<f32>,
    degree: usize,
    camera: Camera,
}

impl Scene {
    fn new(kind: Kind, seed: u64, parents: usize, degree: usize, gain_lanes: usize) -> Self {
        let mut r = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let (width, height) = SIZE;
        let (w, h) = (width as f32, height as f32);
        let k = Intrinsics { fx: w, fy: 1.1 * w, cx: w / 2.0, cy: h / 2.0, width, height };
        let [a, b, c] = r.array(-3.0, 3.0);
        let turn = Quat::from_euler(EulerRot::XYZ, a, b, c);
        let pose = Mat4::from_rotation_translation(turn, Vec3::new(b, c, a));
        let camera = Camera::new(k, pose).unwrap();
        let (mut rows, mut sh, mut gain) = (Vec::new(), Vec::new(), Vec::new());
        for p in 0..parents {
            let z = r.range(1.5, 6.0);
            let centre = Vec3::new(r.range(-0.4, 0.4) * z, r.range(-0.3, 0.3) * z, z);
            let px = z / w;
            for child in 0..CHILDREN {
                let mut at = centre + Vec3::from_array(r.array(-3.0, 3.0)) * px;
                let mut scale = r.array(0.5, 4.0).map(|s: f32| s * px);
                let mut opacity = r.range(0.05, 0.95);
                match (kind, (p + child) % 3) {
                    (Kind::Saturated, i) => {
                        scale = r.array(2.0, 12.0).map(|s: f32| s * px);
                        opacity = [0.9, 0.99, 1.0][i];
                    }
                    (Kind::Needles, i) => {
                        scale = [0.1 * px; 3];
                        scale[i] = 20.0 * px;
                    }
                    (Kind::Behind, 0) => at.z = -at.z,
                    (Kind::Behind, 1) => {
                        at = Vec3::new(0.01, -0.02, 0.25 + 0.01 * (4 * p + child) as f32);
                        scale = r.array(0.01, 0.02);
                    }
                    (Kind::OffScreen, 0) => {
                        at.x = [-1.2, 1.3][child % 2] * z;
                        scale = r.array(0.2, 0.6).map(|s: f32| s * z);
                    }
                    (Kind::OffScreen, 1) => {
                        at.y = [-1.1, 0.9][child % 2] * z;
                        scale = r.array(0.2, 0.6).map(|s: f32| s * z);
                    }
                    (Kind::Flat, i) => scale[..=i].fill(0.0),
                    _ => {}
                }
                rows.extend(camera.world_from_camera.transform_point3(at).to_array());
                rows.extend(r.array::<4>(-1.0, 1.0));
                rows.extend(scale);
                rows.push(opacity);
                match gain_lanes {
                    1 => gain.push(r.range(-0.5, 1.5)),
                    4 => gain.extend([r.range(0.5, 1.5), r.range(-0.2, 0.2), 0.1, -0.3]),
                    _ => {}
                }
            }
            let set = 3 * sh_coefficients(degree);
            sh.extend((0..set).map(|i| r.range(-1.0, 1.0) * if i < 3 { 1.0 } else { 0.4 }));
        }
        Self { rows, cov6: Vec::new(), sh, gain, degree, camera }
    }

    fn len(&self) -> usize {
        self.rows.len() / SPLAT_LANES
    }

    /// The same splats by covariance.
    fn with_covariances(mut self) -> Self {
        self.cov6 = (0..self.len())
            .flat_map(|i| {
                let row = &self.rows[i * SPLAT_LANES..(i + 1) * SPLAT_LANES];
                let [w, x, y, z]: [f32; 4] = row[LANE_QUAT..LANE_SCALE].try_into().unwrap();
                let r = glam::Mat3::from_quat(Quat::from_xyzw(x, y, z, w).normalize());
                let s = Vec3::from_slice(&row[LANE_SCALE..]);
                let c = r * glam::Mat3::from_diagonal(s * s) * r.transpose();
                let e = |i: usize, j: usize| c.col(j)[i];
                [e(0, 0), e(0, 1), e(0, 2), e(1, 1), e(1, 2), e(2, 2)]
            })
            .collect();
        self
    }

    /// Runs `f` on the kernels' view of the scene.
    fn with_slices<R>(&self, f: impl FnOnce(SplatSlices) -> R) -> R {
        let pick = |from: usize, n: usize| -> Vec<f32> {
            self.rows.chunks(SPLAT_LANES).flat_map(|r| r[from..from + n].to_vec()).collect()
        };
        let (means, opacities) = (pick(0, 3), pick(LANE_OPACITY, 1));
        let geometry = if self.cov6.is_empty() {
            Geometry::Packed(&self.rows)
        } else {
            Geometry::Cov6 { means: &means, cov6: &self.cov6, opacities: &opacities }
        };
        f(SplatSlices { geometry, sh: &self.sh, gain: &self.gain, sh_degree: self.degree })
    }

    fn gradients(&self, o: &RasterOptions, v: &[f32]) -> Gradients {
        let mut out = Gradients::default();
        self.with_slices(|s| Rasterizer::new().backward(&s, &self.camera, o, v, &mut out));
        out
    }

    fn for_oracle(&self) -> Vec<Splat> {
        let set = 3 * sh_coefficients(self.degree);
        let lanes = self.gain.len() / self.len();
        let row = |i: usize| &self.rows[i * SPLAT_LANES..(i + 1) * SPLAT_LANES];
        let one = |i: usize| {
            let family = i / CHILDREN * CHILDREN..(i / CHILDREN + 1) * CHILDREN;
            let parent_mean = std::array::from_fn(|c| {
                family.clone().map(|j| f64::from(row(j)[c])).sum::<f64>() / CHILDREN as f64
            });
            let r = row(i);
            let shape = if self.cov6.is_empty() {
                let scale = r[LANE_SCALE..LANE_OPACITY].try_into().unwrap();
                Shape::Quat(r[LANE_QUAT..LANE_SCALE].try_into().unwrap(), scale)
            } else {
                Shape::Cov6(self.cov6[6 * i..6 * i + 6].try_into().unwrap())
            };
            let g = |c: usize| if c < lanes { self.gain[lanes * i + c] } else { 0.0 };
            Splat {
                mean: r[..3].try_into().unwrap(),
                shape,
                opacity: r[LANE_OPACITY],
                sh: self.sh[i / CHILDREN * set..][..set]
                    .chunks_exact(3)
                    .map(|c| c.try_into().unwrap())
                    .collect(),
                gain: if lanes > 0 { g(0) } else { 1.0 },
                residual: [g(1), g(2), g(3)],
                parent_mean,
            }
        };
        (0..self.len()).map(one).collect()
    }

    /// Σ planes·v by the oracle.
    fn loss(&self, o: &RasterOptions, v: &[f32]) -> f64 {
        let p = oracle::render(&self.for_oracle(), &self.camera, o);
        let n = p.alpha.len();
        let v = |i: usize| f64::from(v[i]);
        (0..n)
            .map(|i| {
                let rgb: f64 = (0..3).map(|c| p.rgb[3 * i + c] * v(c * n + i)).sum();
                rgb + p.alpha[i] * v(3 * n + i) + p.depth_sum[i] * v(4 * n + i)
            })
            .sum()
    }

    /// Random gradients of the five planes, 0 on the oracle's boundary pixels.
    fn upstream(&self, o: &RasterOptions, seed: u64) -> Vec<f32> {
        let mut r = Random(seed | 1);
        let p = oracle::render(&self.for_oracle(), &self.camera, o);
        let n = p.alpha.len();
        let mut v: Vec<f32> = (0..5 * n).map(|_| r.range(-1.0, 1.0)).collect();
        for i in (0..n).filter(|&i| p.boundary[i]) {
            (0..5).for_each(|c| v[c * n + i] = 0.0);
        }
        v
    }
}

/// Central difference of the loss in one number, which `of` finds. Steps are such that
/// no alpha moves by more than the oracle's boundary is wide, and count as `f32` took
/// them.
fn slope(
    scene: &Scene,
    (o, v): (&RasterOptions, &[f32]),
    step: f32,
    of: impl Fn(&mut Scene) -> &mut f32,
) -> f64 {
    let mut at = |sign: f32| {
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
        let of = |i: usize| i * SPLAT_LANES + lane;
        (0..scene.len())
            .map(|i| slope(scene, with, step(scene.rows[of(i)]), |s| &mut s.rows[of(i)]))
            .collect()
    };
    let lanes = |from: usize, n: usize, step: &dyn Fn(f32) -> f32| -> Vec<f64> {
        let columns: Vec<_> = (from..from + n).map(|l| lane(l, step)).collect();
        (0..scene.len()).flat_map(|i| columns.iter().map(move |c| c[i])).collect()
    };
    let part = |from: usize, n: usize| -> Vec<f32> {
        got.rows.chunks(SPLAT_LANES).flat_map(|r| r[from..from + n].to_vec()).collect()
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
    let opacities = lanes(LANE_OPACITY, 1, &|x| 5e-5 * x);
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
        hold("quats", &part(LANE_QUAT, 4), &lanes(LANE_QUAT, 4, &|_| 3e-7), 4);
        let step = |x: f32| if x == 0.0 { 1e-4 * px } else { 3e-5 * x };
        hold("scales", &part(LANE_SCALE, 3), &lanes(LANE_SCALE, 3, &step), 3);
        hold("opacities", &part(LANE_OPACITY, 1), &opacities, 1);
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
        for lane in 0..SPLAT_LANES {
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38] {
                // Opaque is not bad, and a point at 1e38 may well be seen.
                if bad == 1e38 && (lane == LANE_OPACITY || lane < LANE_QUAT) {
                    continue;
                }
                let (mut broken, mut without) = (good.clone(), good.clone());
                let hit: Vec<usize> = (lane % 3..good.len()).step_by(5).collect();
                for &i in &hit {
                    broken.rows[i * SPLAT_LANES + lane] = bad;
                    without.rows[i * SPLAT_LANES + LANE_OPACITY] = 0.0;
                }
                let (got, expected) = (broken.gradients(&o, &v), without.gradients(&o, &v));
                assert!(got == expected, "lane {lane} = {bad} {convention:?}");
                assert!(got.rows.iter().any(|&g| g != 0.0));
                for i in hit {
                    assert!(got.rows[i * SPLAT_LANES..][..SPLAT_LANES].iter().all(|&g| g == 0.0));
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
        broken.rows[8 * SPLAT_LANES] = f32::NAN;
        let got = broken.gradients(&shared, &v);
        assert!(got.rows.iter().chain(&got.sh).all(|g| g.is_finite()));
        assert!(got.rows[8 * SPLAT_LANES..][..SPLAT_LANES].iter().all(|&g| g == 0.0));
    }
}

/// A big scene in a bigger picture, of every kind.
fn crowd() -> Scene {
    let mut all = Scene::new(Kind::Plain, 0, 700, 3, 1);
    let k = Intrinsics { fx: 150.0, fy: 150.0, cx: 75.0, cy: 50.0, width: 151, height: 99 };
    let from = all.camera.world_from_camera;
    all.camera = Camera::new(k, from).unwrap();
    for (seed, kind) in KINDS.into_iter().enumerate().skip(1) {
        let more = Scene::new(kind, 100 + seed as u64, 300, 3, 1);
        let move_back = from * more.camera.camera_from_world();
        for row in more.rows.chunks_exact(SPLAT_LANES) {
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

/// Every instruction set gives the gradients, and those that fuse the same bytes.
#[test]
fn tiers_agree() {
    let scene = Scene::new(Kind::Plain, 21, 12, 3, 4);
    let o = options(Convention::Standard);
    let v = scene.upstream(&o, 3);
    let run = |tier: Tier| {
        let mut out = Gradients::default();
        let mut rasterizer = Rasterizer::new().with_tier(tier);
        scene.with_slices(|s| rasterizer.backward(&s, &scene.camera, &o, &v, &mut out));
        out
    };
    let best = run(Tier::best());
    for &tier in Tier::available() {
        let got = run(tier);
        if tier != Tier::Scalar && Tier::best() != Tier::Scalar {
            assert!(bytes(&got) == bytes(&best), "{tier:?}");
        }
        for (what, got, best, lanes) in [
            ("rows", &got.rows, &best.rows, SPLAT_LANES),
            ("sh", &got.sh, &best.sh, 48),
            ("gain", &got.gain, &best.gain, 4),
        ] {
            let best: Vec<f64> = best.iter().map(|&v| f64::from(v)).collect();
            let e = worst_row(got, &best, lanes, what);
            assert!(e < 2e-4, "{tier:?} {what}: {e:.1e}");
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
