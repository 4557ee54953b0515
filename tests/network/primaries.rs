//! The Gaussian adapter: frames, colour bases, guards and gradients. Its numbers are
//! held against the public MVSplat in `parity.rs`.

use subsplat_test_support::primaries_reference;

use candle_core::{DType, Device, Result, Tensor, Var};
use glam::{DMat3, DQuat, DVec3, Mat4, Quat, Vec3};
use subsplat::network::config::{Mvsplat, Primaries as Settings, ShFrame};
use subsplat::network::model::primaries::{primaries, sh_mask};
use subsplat::network::model::trace::Trace;
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat::network::ops::adapter::{Adapter, Turn, View, place};
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::ShBasis;
use subsplat_kernels::sh;

const SIZE: (usize, usize) = (4, 6);

fn settings(sh_frame: ShFrame) -> Settings {
    Settings { sh_frame, ..Mvsplat::re10k().primaries }
}

fn views(world: Mat4) -> Views {
    let (h, w) = SIZE;
    let k = Intrinsics { fx: 5.0, fy: 6.0, cx: 2.7, cy: 2.2, width: w, height: h };
    let pose = |i: f32| {
        let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.3 * i, 1.0 - i, 0.7 * i);
        let local = Mat4::from_rotation_translation(turn, Vec3::new(i, -0.5, 0.2 * i));
        Camera::new(k, world * local).unwrap()
    };
    let images = Tensor::zeros((1, 2, 3, h, w), DType::F32, &Device::Cpu).unwrap();
    Views::new(images, vec![vec![pose(0.0), pose(1.0)]], vec![vec![NearFar::RE10K; 2]]).unwrap()
}

fn wave(n: usize, step: f32) -> Vec<f32> {
    (0..n).map(|i| 1.5 * (i as f32 * step).sin() + 0.3).collect()
}

fn output() -> BackboneOutput {
    let n = SIZE.0 * SIZE.1;
    let t = |v: Vec<f32>, d: usize| Tensor::from_vec(v, (1, 2, n, d), &Device::Cpu).unwrap();
    BackboneOutput {
        raw: t(wave(2 * n * 84, 0.37), 84),
        depths: t(wave(2 * n, 0.9).into_iter().map(|v| v.abs() + 1.0).collect(), 1),
        densities: t(wave(2 * n, 0.5).into_iter().map(|v| (0.1 + v.abs()) / 3.0).collect(), 1),
        features: Vec::new(),
    }
}

fn run(out: &BackboneOutput, views: &Views, frame: ShFrame) -> Primaries {
    primaries(out, views, &settings(frame), &mut Trace::off()).unwrap()
}

fn rows(t: &Tensor, n: usize) -> Vec<Vec<f64>> {
    let v = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    v.chunks(n).map(|r| r.iter().map(|v| f64::from(*v)).collect()).collect()
}

fn quat(v: &[f64]) -> DQuat {
    DQuat::from_xyzw(v[1], v[2], v[3], v[0])
}

#[test]
fn means_lie_within_half_a_pixel_at_the_given_distance() {
    let (out, views) = (output(), views(Mat4::IDENTITY));
    let p = run(&out, &views, ShFrame::Mvsplat);
    let depths = rows(&out.depths, 1);
    for (i, mean) in rows(&p.means, 3).into_iter().enumerate() {
        let camera = &views.cameras[0][i / p.per_view];
        let world = DVec3::from_slice(&mean).as_vec3();
        assert!((f64::from((world - camera.position()).length()) - depths[i][0]).abs() < 1e-5);
        let px = camera.project(world).unwrap();
        let pixel = i % p.per_view;
        let (x, y) = ((pixel % SIZE.1) as f32 + 0.5, (pixel / SIZE.1) as f32 + 0.5);
        assert!((px.x - x).abs() <= 0.501 && (px.y - y).abs() <= 0.501, "{i}: {px}");
    }
}

#[test]
fn quaternions_are_unit_in_world_frame_and_zero_is_no_rotation() {
    let (mut out, views) = (output(), views(Mat4::IDENTITY));
    let mut raw = out.raw.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    raw[5 * 84 + 5..5 * 84 + 9].fill(0.0);
    raw[(24 + 3) * 84 + 5..(24 + 3) * 84 + 9].fill(0.0);
    out.raw = Tensor::from_vec(raw.clone(), out.raw.shape(), &Device::Cpu).unwrap();
    let p = run(&out, &views, ShFrame::Mvsplat);
    for (i, q) in rows(&p.quats_wxyz, 4).into_iter().enumerate() {
        let got = quat(&q);
        assert!((got.length() - 1.0).abs() < 1e-6 && q[0] >= 0.0, "{i}: {q:?}");
        let raw: Vec<f64> = raw[i * 84 + 5..i * 84 + 9].iter().map(|v| f64::from(*v)).collect();
        let own = DQuat::from_slice(&raw);
        let own = if own.length() == 0.0 { DQuat::IDENTITY } else { own.normalize() };
        let r = views.cameras[0][i / p.per_view].rotation().as_dmat3();
        let want = r * DMat3::from_quat(own);
        let e = DMat3::from_quat(got.normalize()) - want;
        assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{i}");
    }
}

/// The colour that set `i` of `[.., 3, 25]` gives in direction `d`, channel 0.
fn colour(sh: &[Vec<f64>], i: usize, d: DVec3, basis: ShBasis) -> f64 {
    let set = &sh[3 * i];
    match basis {
        ShBasis::Standard => sh::standard(d).iter().zip(set).map(|(y, c)| y * c).sum(),
        ShBasis::Mvsplat => sh::mvsplat(d).iter().zip(set).map(|(y, c)| y * c).sum(),
    }
}

#[test]
fn colours_turn_with_the_camera() {
    let (out, views) = (output(), views(Mat4::IDENTITY));
    let mask = sh_mask(4);
    let raw: Vec<Vec<f64>> = rows(&out.raw, 84)
        .into_iter()
        .flat_map(|r| r[9..].chunks(25).map(<[f64]>::to_vec).collect::<Vec<_>>())
        .map(|set| set.iter().zip(&mask).map(|(c, m)| c * f64::from(*m)).collect())
        .collect();
    let d = DVec3::new(0.3, -0.8, 0.5).normalize();
    for (frame, basis) in
        [(ShFrame::Standard, ShBasis::Standard), (ShFrame::MvsplatExact, ShBasis::Mvsplat)]
    {
        let p = run(&out, &views, frame);
        assert_eq!(p.sh_basis, ShBasis::Standard);
        let (world, camera) = (rows(&p.sh, 25), rows(&p.sh_camera, 25));
        for i in 0..2 * p.per_view {
            let r = views.cameras[0][i / p.per_view].rotation().as_dmat3();
            let want = colour(&raw, i, d, basis);
            let turned = colour(&world, i, r * d, ShBasis::Standard);
            assert!((turned - want).abs() < 1e-5, "{frame:?} {i}: {turned} {want}");
            let before = colour(&camera, i, d, ShBasis::Standard);
            assert!((before - want).abs() < 1e-5, "{frame:?} {i}: {before} {want}");
        }
    }
    // As released: the basis stays MVSplat's, the rotation is e3nn's.
    let p = run(&out, &views, ShFrame::Mvsplat);
    assert_eq!(p.sh_basis, ShBasis::Mvsplat);
    let (world, camera) = (rows(&p.sh, 25), rows(&p.sh_camera, 25));
    for i in 0..2 * p.per_view {
        assert!(camera[3 * i].iter().zip(&raw[3 * i]).all(|(a, b)| (a - b).abs() < 1e-6));
        let r = views.cameras[0][i / p.per_view].rotation().as_dmat3();
        let sum = |set: &[f64], d: DVec3| -> f64 {
            sh::e3nn(d).iter().zip(set).map(|(y, c)| y * c).sum()
        };
        assert!((sum(&world[3 * i], r * d) - sum(&raw[3 * i], d)).abs() < 1e-5);
    }
}

#[test]
fn moving_the_world_moves_the_gaussians_with_it() {
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.9, -0.4, 2.0);
    let (shift, out) = (DVec3::new(3.0, -1.0, 2.0), output());
    let world = Mat4::from_rotation_translation(turn.as_quat(), shift.as_vec3());
    let (views_a, views_b) = (views(Mat4::IDENTITY), views(world));
    for frame in [ShFrame::MvsplatExact, ShFrame::Standard] {
        let (a, b) = (run(&out, &views_a, frame), run(&out, &views_b, frame));
        for (x, y) in rows(&a.means, 3).iter().zip(rows(&b.means, 3)) {
            let moved = turn * DVec3::from_slice(x) + shift;
            assert!((moved - DVec3::from_slice(&y)).length() < 1e-4);
        }
        for (x, y) in rows(&a.quats_wxyz, 4).iter().zip(rows(&b.quats_wxyz, 4)) {
            assert!((turn * quat(x)).dot(quat(&y)).abs() > 1.0 - 1e-5);
        }
        let (x, y) = (rows(&a.sh, 25), rows(&b.sh, 25));
        let d = DVec3::new(-0.2, 0.5, 0.7).normalize();
        for i in 0..2 * a.per_view {
            let (before, after) =
                (colour(&x, i, d, ShBasis::Standard), colour(&y, i, turn * d, ShBasis::Standard));
            assert!((before - after).abs() < 1e-5, "{frame:?} {i}");
        }
    }
}

#[test]
fn the_opacity_mapping_is_the_formula() -> Result<()> {
    let (out, views) = (output(), views(Mat4::IDENTITY));
    for x in [0.0, 0.7, -1.0] {
        let s = Settings { opacity_exponent: x, ..settings(ShFrame::Mvsplat) };
        let p = primaries(&out, &views, &s, &mut Trace::off())?;
        let e = f64::powf(2.0, x);
        for (got, d) in rows(&p.opacities, 1).iter().zip(rows(&out.densities, 1)) {
            let want = 0.5 * (1.0 - (1.0 - d[0]).powf(e) + d[0].powf(1.0 / e));
            assert!((got[0] - want).abs() < 1e-6, "{x}: {} {want}", got[0]);
        }
    }
    Ok(())
}

#[test]
fn gradients_reach_every_input() -> Result<()> {
    let views = views(Mat4::IDENTITY);
    let out = output();
    let loss = |raw: &Tensor, depths: &Tensor| -> Result<Tensor> {
        let out = BackboneOutput { raw: raw.clone(), depths: depths.clone(), ..output() };
        let p = run(&out, &views, ShFrame::MvsplatExact);
        let mix = |t: &Tensor, step: f32| -> Result<Tensor> {
            let w = Tensor::from_vec(wave(t.elem_count(), step), t.shape(), t.device())?;
            (t * w)?.sum_all()
        };
        let a = (mix(&p.means, 0.11)? + mix(&p.quats_wxyz, 0.13)?)?;
        let b = (mix(&p.scales, 0.17)? + mix(&p.sh, 0.19)?)?;
        a + (b + mix(&p.covariances()?, 0.23)?)?
    };
    let (raw, depths) = (Var::from_tensor(&out.raw)?, Var::from_tensor(&out.depths)?);
    let grads = loss(&raw, &depths)?.backward()?;
    for (name, var) in [("raw", &raw), ("depths", &depths)] {
        let grad = grads.get(var).unwrap().flatten_all()?.to_vec1::<f32>()?;
        let at = var.flatten_all()?.to_vec1::<f32>()?;
        for i in (0..at.len()).step_by(1 + at.len() / 60) {
            let eval = |h: f32| -> Result<f64> {
                let mut v = at.clone();
                v[i] += h;
                let t = Tensor::from_vec(v, var.shape(), var.device())?;
                let value = match name {
                    "raw" => loss(&t, &depths)?,
                    _ => loss(&raw, &t)?,
                };
                Ok(f64::from(value.to_scalar::<f32>()?))
            };
            let numeric = (eval(0.02)? - eval(-0.02)?) / 0.04;
            let g = f64::from(grad[i]);
            assert!((numeric - g).abs() < 0.02 * (1.0 + g.abs()), "{name}[{i}]: {numeric} {g}");
        }
    }
    Ok(())
}

/// Two views of `size`, G Gaussians a pixel, SH of `degree`.
fn larger((h, w): (usize, usize), g: usize, degree: usize) -> (BackboneOutput, Views) {
    let mut views = views(Mat4::from_rotation_y(0.4));
    for camera in views.cameras[0].iter_mut() {
        let k = camera.intrinsics();
        let k = Intrinsics { width: w, height: h, cx: 0.4 * w as f32, ..k };
        *camera = camera.with_intrinsics(k).unwrap();
    }
    views.images = Tensor::zeros((1, 2, 3, h, w), DType::F32, &Device::Cpu).unwrap();
    let (n, lanes) = (h * w, 9 + 3 * (degree + 1) * (degree + 1));
    let t = |v: Vec<f32>, d: usize| Tensor::from_vec(v, (1, 2, n, d), &Device::Cpu).unwrap();
    let mut raw = wave(2 * n * lanes, 0.37);
    raw[3 * lanes + 5..3 * lanes + 9].fill(0.0);
    let out = BackboneOutput {
        raw: t(raw, lanes),
        depths: t(wave(2 * n * g, 0.9).into_iter().map(|v| v.abs() + 1.0).collect(), g),
        densities: t(wave(2 * n * g, 0.5).into_iter().map(|v| (0.1 + v.abs()) / 3.0).collect(), g),
        features: Vec::new(),
    };
    (out, views)
}

type Made = Vec<(&'static str, Vec<f32>)>;

/// All attributes, and the gradients of a mix of them by raw rows, distances and
/// densities.
fn with_gradients(
    out: &BackboneOutput,
    make: impl Fn(&BackboneOutput) -> Result<Primaries>,
) -> Result<(Made, Made)> {
    let vars = [&out.raw, &out.depths, &out.densities].map(|t| Var::from_tensor(t).unwrap());
    let [raw, depths, densities] = vars.each_ref().map(|v| v.as_tensor().clone());
    let p = make(&BackboneOutput { raw, depths, densities, features: Vec::new() })?;
    let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
    let all = [
        ("means", &p.means),
        ("quats", &p.quats_wxyz),
        ("scales", &p.scales),
        ("opacities", &p.opacities),
        ("sh", &p.sh),
        ("sh_camera", &p.sh_camera),
    ];
    let (mut made, mut loss) = (Vec::new(), Tensor::new(0f32, &Device::Cpu)?);
    for (i, (name, t)) in all.into_iter().enumerate() {
        made.push((name, flat(t)?));
        let w = wave(t.elem_count(), 0.11 + 0.02 * i as f32);
        let w = Tensor::from_vec(w, t.shape(), t.device())?;
        loss = (loss + (t * w)?.sum_all()?)?;
    }
    let grads = loss.backward()?;
    let of = |name, i: usize| (name, flat(grads.get(&vars[i]).unwrap()).unwrap());
    Ok((made, vec![of("d raw", 0), of("d depths", 1), of("d densities", 2)]))
}

#[test]
fn the_op_agrees_with_tensor_operations_and_so_do_its_gradients() -> Result<()> {
    // Rows that fill vectors and rows that do not; one Gaussian a pixel and three.
    let frames = [ShFrame::Mvsplat, ShFrame::MvsplatExact, ShFrame::Standard];
    let cases = [((3, 37), 1, 1, 0.0), ((2, 16), 3, 4, 0.7), ((4, 5), 2, 0, -1.0)];
    for (size, g, degree, exponent) in cases {
        for frame in frames {
            let (out, views) = larger(size, g, degree);
            let mut s = settings(frame);
            (s.sh_degree, s.opacity_exponent) = (degree, exponent);
            let op = |out: &BackboneOutput| primaries(out, &views, &s, &mut Trace::off());
            let graph = |out: &BackboneOutput| primaries_reference::primaries(out, &views, &s);
            let (got, want) = (with_gradients(&out, op)?, with_gradients(&out, graph)?);
            let pairs = got.0.iter().zip(&want.0).map(|p| (p, 4e-6));
            for (((name, got), (_, want)), within) in
                pairs.chain(got.1.iter().zip(&want.1).map(|p| (p, 2e-5)))
            {
                assert_eq!(got.len(), want.len(), "{name}");
                // Row 3 has a quaternion of zero, whose slopes are up to 1e8.
                let lanes = out.raw.dim(3)?;
                let zero =
                    |i: usize| *name == "d raw" && i / lanes == 3 && (5..9).contains(&(i % lanes));
                for (i, (a, b)) in got.iter().zip(want).enumerate() {
                    let (off, size) = ((a - b).abs(), if zero(i) { 1e8 } else { 4.0 + b.abs() });
                    assert!(off < within * size, "{frame:?} {g} {name}[{i}]: {a} {b}");
                }
            }
        }
    }
    Ok(())
}

#[test]
fn gradients_are_those_of_finite_differences() -> Result<()> {
    let (h, w, g, d) = (2, 5, 2, 4);
    let turn = |k: f64| Turn::new(&(0..16).map(|i| (i as f64 * k).sin()).collect::<Vec<_>>(), d);
    let view = View {
        focal: [4.0, 5.0],
        centre: [2.2, 1.1],
        rotation: [[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]],
        origin: [1.0, -2.0, 0.5],
        quat: std::array::from_fn(|i| {
            std::array::from_fn(|k| if k == (i + 1) % 4 { 1.0 } else { 0.2 })
        }),
        scale: [0.1, 0.7],
        turn: turn(0.7),
    };
    let adapter = Adapter {
        views: vec![view],
        size: [h, w],
        per_pixel: g,
        functions: d,
        exponent: 0.6,
        camera: turn(0.3),
    };
    let wave = |n: usize, k: f64| (0..n).map(|i| (i as f64 * k).sin()).collect::<Vec<f64>>();
    let of = |v: Vec<f64>, last: usize| Tensor::from_vec(v, (1, h * w, last), &Device::Cpu);
    let inputs = [
        of(wave(h * w * 21, 0.37), 21)?,
        of(wave(h * w * g, 0.9).into_iter().map(|v| v + 2.0).collect(), g)?,
        of(wave(h * w * g, 0.5).into_iter().map(|v| 0.5 + 0.4 * v).collect(), g)?,
    ];
    let loss = |x: &[Tensor; 3]| -> Result<Tensor> {
        let all = place(&x[0], &x[1], &x[2], adapter.clone())?;
        let mix = |t: &Tensor, k: f64| -> Result<Tensor> {
            (t * Tensor::from_vec(wave(t.elem_count(), k), t.shape(), t.device())?)?.sum_all()
        };
        (mix(&all.rows, 1.1)? + mix(&all.sh()?, 1.3)?)? + mix(&all.sh_camera()?, 1.7)?
    };
    let vars = inputs.each_ref().map(|t| Var::from_tensor(t).unwrap());
    let grads = loss(&vars.each_ref().map(|v| v.as_tensor().clone()))?.backward()?;
    for (which, var) in vars.iter().enumerate() {
        let grad = grads.get(var).unwrap().flatten_all()?.to_vec1::<f64>()?;
        let at = inputs[which].flatten_all()?.to_vec1::<f64>()?;
        for i in 0..at.len() {
            let eval = |step: f64| -> Result<f64> {
                let mut v = at.clone();
                v[i] += step;
                let mut x = inputs.clone();
                x[which] = Tensor::from_vec(v, inputs[which].shape(), &Device::Cpu)?;
                loss(&x)?.to_scalar::<f64>()
            };
            let numeric = (eval(1e-5)? - eval(-1e-5)?) / 2e-5;
            let off = (numeric - grad[i]).abs();
            assert!(off < 1e-7 * (1.0 + numeric.abs()), "{which}[{i}]: {} {numeric}", grad[i]);
        }
    }
    Ok(())
}
