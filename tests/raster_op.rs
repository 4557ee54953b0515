//! `ops::rasterize`: the kernel's numbers, every refusal by name, and no silent
//! gradient.

use candle_core::{DType, Device, Tensor, Var};
use glam::{Mat4, Vec3};
use subsplat::abi::{Convention, RasterOptions, ShBasis};
use subsplat::camera::{Camera, Intrinsics};
use subsplat::ops::rasterize;
use subsplat::splats::Splats;

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
    let picture = subsplat::render(&s, &camera, &o);
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
    // Gain of one lane.
    let one = gain.narrow(1, 0, 1).unwrap().flatten_all().unwrap().contiguous().unwrap();
    let mut single = s.clone();
    single.gain = one.to_vec1().unwrap();
    let got = rasterize(&rows, &sh, &one, &camera, &o).unwrap();
    let got = got.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let expected = subsplat::render(&single, &camera, &o);
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
    let mut empty = camera;
    empty.intrinsics.width = 0;
    refused(rasterize(&rows, &sh, &gain, &empty, &o), &["at least 1x1", "0x21"]);
}

trait First {
    fn i_first(&self) -> Tensor;
}

impl First for Tensor {
    fn i_first(&self) -> Tensor {
        self.get(0).unwrap().contiguous().unwrap()
    }
}

#[test]
fn backward_is_an_error_and_not_silence() {
    let (rows, sh, gain) = splats().to_tensors(&Device::Cpu).unwrap();
    let o = RasterOptions::default();
    for which in 0..3 {
        let mut inputs = [rows.clone(), sh.clone(), gain.clone()];
        let variable = Var::from_tensor(&inputs[which]).unwrap();
        inputs[which] = variable.as_tensor().clone();
        let out = rasterize(&inputs[0], &inputs[1], &inputs[2], &camera(), &o).unwrap();
        let error = out.sum_all().unwrap().backward().unwrap_err().to_string();
        assert!(error.contains("rasterize"), "{error}");
    }
}
