//! `ops::rasterize`: the kernel's numbers, every refusal by name, and gradients that
//! reach every input.

use candle_core::{DType, Device, Tensor, Var};
use glam::{Mat4, Vec3};
use subsplat::network::ops::SplatTensors;
use subsplat::network::ops::{over_background, rasterize};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Gradients, Rasterizer};
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};
use subsplat_test_support::edit::Edit;

fn camera() -> Camera {
    let k = Intrinsics { fx: 30.0, fy: 32.0, cx: 14.0, cy: 10.0, width: 29, height: 21 };
    Camera::new(k, Mat4::from_translation(Vec3::new(0.1, 0.0, -3.0))).unwrap()
}

/// Four parents of three children, degree 1, gain and residual.
fn splats() -> Splats {
    let wave = |i: usize, a: f32| (a * i as f32).sin();
    let row = |i: usize| {
        let at = [wave(i, 1.3), wave(i, 2.1), wave(i, 0.7)];
        let quat = [1.0, wave(i, 3.0), wave(i, 5.0), 0.2];
        let scale = [0.1, 0.2 + 0.1 * wave(i, 4.0), 0.15];
        [&at[..], &quat, &scale, &[0.8]].concat()
    };
    let rows = (0..12).flat_map(row).collect();
    let sh = (0..4 * 12).map(|i| wave(i, 0.9)).collect();
    let gain = (0..12).flat_map(|i| [1.0 + 0.3 * wave(i, 2.0), 0.1, -0.1, 0.05]).collect();
    Splats::new(rows, sh, gain, 1, ShBasis::Standard).unwrap()
}

#[test]
fn forward_is_the_kernels() {
    let (s, camera, o) = (splats(), camera(), RasterOptions::default());
    let (rows, sh, gain) = s.to_tensors(&Device::Cpu).unwrap();
    let out = rasterize(&rows, &sh, &gain, &camera, &o).unwrap();
    assert_eq!(out.dims(), [5, 21, 29]);
    let out = out.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let picture = subsplat::scene::render(&s, &camera, &o);
    let n = 21 * 29;
    assert!(picture.alpha.iter().filter(|&&a| a > 0.5).count() > 50);
    for p in 0..n {
        for c in 0..3 {
            assert_eq!(out[c * n + p], picture.rgb[3 * p + c]);
        }
        assert_eq!(out[3 * n + p], picture.alpha[p]);
        assert_eq!(out[4 * n + p] / out[3 * n + p].max(1e-10), picture.depth[p]);
    }
    // A view into a larger storage is contiguous but starts elsewhere.
    let twice = Tensor::cat(&[&rows, &rows], 0).unwrap();
    let second = twice.narrow(0, 12, 12).unwrap();
    let again = rasterize(&second, &sh, &gain, &camera, &o).unwrap();
    assert_eq!(again.flatten_all().unwrap().to_vec1::<f32>().unwrap(), out);
    // Gain of one channel.
    let one = gain.narrow(1, 0, 1).unwrap().flatten_all().unwrap().contiguous().unwrap();
    let mut single = s.clone();
    single.edit(|p| p.gain = one.to_vec1().unwrap());
    let got = rasterize(&rows, &sh, &one, &camera, &o).unwrap();
    let got = got.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let expected = subsplat::scene::render(&single, &camera, &o);
    assert!((0..n).all(|p| got[p] == expected.rgb[3 * p]));
    assert_ne!(got, out);
}

#[test]
fn no_splats_give_background() {
    let d = &Device::Cpu;
    let empty = |shape: &[usize]| Tensor::zeros(shape, DType::F32, d).unwrap();
    let o = RasterOptions { background: [0.1, 0.2, 0.3], ..RasterOptions::default() };
    let out = rasterize(&empty(&[0, 11]), &empty(&[0, 4, 3]), &empty(&[0]), &camera(), &o);
    let out = out.unwrap().to_vec3::<f32>().unwrap();
    assert_eq!([out[0][20][28], out[1][0][0], out[2][5][5], out[3][0][0]], [0.1, 0.2, 0.3, 0.0]);
}

#[test]
fn misfits_are_refused_by_name() {
    let (s, camera, o) = (splats(), camera(), RasterOptions::default());
    let (rows, sh, gain) = s.to_tensors(&Device::Cpu).unwrap();
    let refused = |r: candle_core::Result<Tensor>, words: &[&str]| {
        let message = r.unwrap_err().to_string();
        for word in words {
            assert!(message.contains(word), "{message} lacks {word}");
        }
    };
    let call = |r: &Tensor, s: &Tensor, g: &Tensor| rasterize(r, s, g, &camera, &o);
    let short = rows.narrow(1, 0, 10).unwrap().contiguous().unwrap();
    refused(call(&short, &sh, &gain), &["splats [N, 11]", "[12, 10]"]);
    let turned = rows.t().unwrap().contiguous().unwrap().t().unwrap();
    refused(call(&turned, &sh, &gain), &["splats contiguous", "[1, 12]"]);
    let double = rows.to_dtype(DType::F64).unwrap();
    refused(call(&double, &sh, &gain), &["splats", "F32", "F64"]);
    let three = sh.narrow(1, 0, 3).unwrap().contiguous().unwrap();
    refused(call(&rows, &three, &gain), &["sh", "16 or 25", "[4, 3, 3]"]);
    let five = Tensor::zeros((5, 4, 3), DType::F32, &Device::Cpu).unwrap();
    refused(call(&rows, &five, &gain), &["P dividing N = 12", "[5, 4, 3]"]);
    refused(call(&rows, &sh.i_first(), &gain), &["sh [P, D, 3]", "[4, 3]"]);
    let two = gain.narrow(1, 0, 2).unwrap().contiguous().unwrap();
    refused(call(&rows, &sh, &two), &["gain [12] or [12, 4]", "[12, 2]"]);

    let with = |o: RasterOptions| rasterize(&rows, &sh, &gain, &camera, &o);
    refused(with(RasterOptions { sh_degree: 5, ..o }), &["sh_degree", "got 5"]);
    refused(with(RasterOptions { lowpass: -0.3, ..o }), &["low-pass", "-0.3"]);
    refused(with(RasterOptions { near: f32::NAN, ..o }), &["near", "NaN"]);
    let mvsplat = RasterOptions::new(Convention::Mvsplat);
    refused(with(RasterOptions { antialiased: true, ..mvsplat }), &["antialiased", "mvsplat"]);
    let black_hole = [0.0, f32::INFINITY, 0.0];
    refused(with(RasterOptions { background: black_hole, ..o }), &["background", "inf"]);
}

trait First {
    fn i_first(&self) -> Tensor;
}

impl First for Tensor {
    fn i_first(&self) -> Tensor {
        self.get(0).unwrap().contiguous().unwrap()
    }
}

/// Weights of a loss over the planes, away from anything regular.
fn weights() -> Tensor {
    let v: Vec<f32> = (0..5 * 21 * 29).map(|i| (i as f32 * 0.37).sin()).collect();
    Tensor::from_vec(v, (5, 21, 29), &Device::Cpu).unwrap()
}

#[test]
fn gradients_are_the_kernels_and_those_of_the_loss() {
    let (mut s, camera, o) = (splats(), camera(), RasterOptions::default());
    // So wide and faint that no support ends inside the picture and no pixel stops: a
    // finite step then meets no jump.
    s.edit(|p| {
        for row in p.rows.chunks_exact_mut(11) {
            row[7..10].iter_mut().for_each(|scale| *scale *= 20.0);
            row[10] = 0.35;
        }
    });
    let (rows, sh, gain) = s.to_tensors(&Device::Cpu).unwrap();
    let variables = [&rows, &sh, &gain].map(|t| Var::from_tensor(t).unwrap());
    let [a, b, c] = variables.each_ref().map(|v| v.as_tensor().clone());
    let planes = rasterize(&a, &b, &c, &camera, &o).unwrap();
    let loss = (&planes * weights()).unwrap().sum_all().unwrap();
    // Twice: any number of backward passes can use the forward pass's results.
    let store = loss.backward().unwrap();
    let again = loss.backward().unwrap();
    let mut kernel = Gradients::default();
    let v: Vec<f32> = weights().flatten_all().unwrap().to_vec1().unwrap();
    let slices = subsplat::scene::render::slices(&s);
    Rasterizer::new().backward(&slices, &camera, &o, &v, &mut kernel);
    for (variable, expected) in variables.iter().zip([&kernel.rows, &kernel.sh, &kernel.gain]) {
        for store in [&store, &again] {
            let got = store.get(variable).unwrap();
            assert_eq!(got.dims(), variable.dims());
            let got: Vec<f32> = got.flatten_all().unwrap().to_vec1().unwrap();
            assert!(got == *expected && got.iter().any(|&g| g != 0.0));
        }
    }

    // Σ ∂L/∂x·Δ against the loss itself, along a direction in all inputs of a kind.
    for (which, step) in [(0, 2e-4f32), (1, 1e-3), (2, 1e-3)] {
        let dims = variables[which].dims();
        let n: usize = dims.iter().product();
        let direction: Vec<f32> = (0..n).map(|i| (i as f32 * 1.7).cos()).collect();
        let direction = Tensor::from_vec(direction, dims, &Device::Cpu).unwrap();
        let at = |sign: f64| -> f64 {
            let mut inputs = [rows.clone(), sh.clone(), gain.clone()];
            let moved = (&direction * (sign * f64::from(step))).unwrap();
            inputs[which] = (&inputs[which] + moved).unwrap();
            let [a, b, c] = &inputs;
            let planes = rasterize(a, b, c, &camera, &o).unwrap();
            let planes = (planes.to_dtype(DType::F64).unwrap())
                .mul(&weights().to_dtype(DType::F64).unwrap())
                .unwrap();
            planes.sum_all().unwrap().to_scalar::<f64>().unwrap()
        };
        let measured = (at(1.0) - at(-1.0)) / (2.0 * f64::from(step));
        let got = (store.get(&variables[which]).unwrap() * &direction).unwrap();
        let got = f64::from(got.sum_all().unwrap().to_scalar::<f32>().unwrap());
        let scale = measured.abs().max(1.0);
        assert!((got - measured).abs() < 0.02 * scale, "input {which}: {got} {measured}");
    }
}

/// The tensors that a user optimises: parts packed by candle, gain or none, a view.
#[test]
fn splat_tensors_pass_gradients_to_their_parts() {
    let (s, camera, o) = (splats(), camera(), RasterOptions::default());
    let (rows, sh, _) = s.to_tensors(&Device::Cpu).unwrap();
    let part = |from: usize, n: usize| {
        let part = rows.narrow(1, from, n).unwrap().contiguous().unwrap();
        Var::from_tensor(&part).unwrap()
    };
    let (means, quats, scales) = (part(0, 3), part(3, 4), part(7, 3));
    let opacities = Var::from_tensor(&part(10, 1).flatten_all().unwrap()).unwrap();
    let sh = Var::from_tensor(&sh).unwrap();
    let tensors =
        SplatTensors::from_parts(&means, &quats, &scales, &opacities, &sh, s.sh_basis()).unwrap();
    let planes = subsplat::rasterize(&tensors, &camera, &o).unwrap();
    let mut plain = s.clone();
    plain.edit(|p| p.gain.clear());
    let picture = subsplat::scene::render(&plain, &camera, &o);
    let got: Vec<f32> = planes.get(3).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    assert!(got == picture.alpha);
    let store = (&planes * weights()).unwrap().sum_all().unwrap().backward().unwrap();
    for v in [&means, &quats, &scales, &opacities, &sh] {
        let g = store.get(v).unwrap().abs().unwrap().sum_all().unwrap();
        assert!(g.to_scalar::<f32>().unwrap() > 1e-3);
    }
    // With its gain, and with SH that is a view of something else.
    let mut tensors = SplatTensors::new(&s, &Device::Cpu).unwrap();
    tensors.sh = tensors.sh.transpose(0, 1).unwrap().contiguous().unwrap().transpose(0, 1).unwrap();
    let planes = subsplat::rasterize(&tensors, &camera, &o).unwrap();
    let got: Vec<f32> = planes.get(0).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    let picture = subsplat::scene::render(&s, &camera, &o);
    assert!(got.iter().zip(picture.rgb.chunks_exact(3)).all(|(g, p)| *g == p[0]));
}

#[test]
fn a_background_tensor_is_the_option_and_has_a_gradient() {
    let (s, camera) = (splats(), camera());
    let black = RasterOptions::default();
    let background = [0.2f32, 0.5, 0.9];
    let tensors = SplatTensors::new(&s, &Device::Cpu).unwrap();
    let variable = Var::new(&background, &Device::Cpu).unwrap();
    let planes = subsplat::rasterize(&tensors, &camera, &black).unwrap();
    let over = over_background(&planes, &variable).unwrap();
    let fixed = RasterOptions { background, ..black };
    let expected = subsplat::rasterize(&tensors, &camera, &fixed).unwrap();
    let apart = (&over - &expected).unwrap().abs().unwrap().max_all().unwrap();
    assert!(apart.to_scalar::<f32>().unwrap() < 1e-6);
    let store = (&over * weights()).unwrap().sum_all().unwrap().backward().unwrap();
    let got: Vec<f32> = store.get(&variable).unwrap().to_vec1().unwrap();
    let mut kernel = Gradients::default();
    let v: Vec<f32> = weights().flatten_all().unwrap().to_vec1().unwrap();
    let slices = subsplat::scene::render::slices(&s);
    Rasterizer::new().backward(&slices, &camera, &fixed, &v, &mut kernel);
    for (g, e) in got.iter().zip(kernel.background) {
        assert!((g - e).abs() < 1e-4 * e.abs().max(1.0), "{g} {e}");
    }
    let error = over_background(&planes.narrow(0, 0, 4).unwrap(), &variable).unwrap_err();
    assert!(error.to_string().contains("[4, 21, 29]"), "{error}");
}
