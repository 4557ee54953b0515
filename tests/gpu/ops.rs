//! Ops on a GPU against the same ops on the CPU: values and gradients under every rule of SPGR,
//! and calls that the GPU cannot execute.

use subsplat_test_support::gather;
use subsplat_test_support::gpu as adapter;
use subsplat_test_support::scenes;
use subsplat_test_support::spgr_calls;

use adapter::{gpu, limited};
use candle_core::{DType, Result, Tensor, Var};
use scenes::Random;
use subsplat::network::ops::attention_gather::attention_gather_on;
use subsplat::network::ops::plane_sweep::{Sweep, pair, plane_sweep_on};
use subsplat::network::ops::redistribute::redistribute_on;
use subsplat::network::ops::spgr::spgr_on;
use subsplat::network::ops::{Backend, rasterize_on};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu::{DeviceChoice, Gpu};
use subsplat_kernels::layout::{Convention, Gather, OpacityRule, RasterOptions, ShDirection};

/// Tolerance, relative to the largest number. Kernels agree to 4e-5 (tests/gpu/spgr.rs,
/// tests/gpu/network.rs); random parents contain needles, whose f32 gradients on the CPU have
/// errors of 3e-5.
const ALLOWED: f64 = 2e-4;

fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Returns the results of `f` on `backend`, then the gradients of Σ w·result with respect to its
/// inputs, with distinct weights w.
fn run(
    backend: &Backend,
    inputs: &[&Tensor],
    f: impl Fn(&Backend, &[Tensor]) -> Result<Vec<Tensor>>,
) -> Vec<Vec<f64>> {
    let variables: Vec<Var> = inputs.iter().map(|t| Var::from_tensor(t).unwrap()).collect();
    let tensors: Vec<Tensor> = variables.iter().map(|v| v.as_tensor().clone()).collect();
    let results = f(backend, &tensors).unwrap();
    let mut loss = Tensor::zeros((), inputs[0].dtype(), inputs[0].device()).unwrap();
    for r in &results {
        let mut weights = Random(9);
        let w = weights.tensor(r.dims(), 1.0, r.dtype());
        loss = (loss + (r * w).unwrap().sum_all().unwrap()).unwrap();
    }
    let gradients = loss.backward().unwrap();
    let of = |v: &Var| gradients.get(v).map(host).unwrap_or_default();
    results.iter().map(host).chain(variables.iter().map(of)).collect()
}

/// Compares `f` on the GPU with `f` on the CPU; the GPU must execute every call.
fn agrees(
    name: &str,
    backend: &Backend,
    inputs: &[&Tensor],
    f: impl Fn(&Backend, &[Tensor]) -> Result<Vec<Tensor>>,
) {
    let (got, expected) = (run(backend, inputs, &f), run(&Backend::Cpu, inputs, &f));
    assert_eq!(backend.warning(), None, "{name}");
    let mut same = true;
    for (i, (got, expected)) in got.iter().zip(&expected).enumerate() {
        assert_eq!(got.len(), expected.len(), "{name} {i}");
        let largest = expected.iter().fold(1e-30f64, |m, v| m.max(v.abs()));
        for (g, e) in got.iter().zip(expected) {
            assert!((g - e).abs() <= ALLOWED * largest, "{name} {i}: {g} {e} of {largest}");
        }
        same &= got == expected;
    }
    // Devices round differently, so equal bytes mean that one device computed both results.
    assert!(!same, "{name}: the results have equal bytes");
}

#[test]
fn spgr_under_every_rule() {
    let Some(gpu) = gpu() else { return };
    let backend = Backend::from(gpu);
    let mut r = Random(21);
    for k in [4, 9, 5, 6] {
        for (name, config) in spgr_calls::variants(2) {
            let call = spgr_calls::call_of(&config, 8, k);
            let parents = spgr_calls::parents(&call.cameras, &mut r);
            let head = spgr_calls::head(128, k, 1.0, DType::F32, &mut r);
            agrees(&name, &backend, &[&head, &parents], |backend, x| {
                let (rows, gains) = spgr_on(backend, &x[0], &x[1], &call)?;
                Ok(vec![rows, gains])
            });
        }
    }
}

#[test]
fn redistribution() {
    let Some(gpu) = gpu() else { return };
    let backend = Backend::from(gpu);
    let mut r = Random(22);
    let logits = r.tensor(&[300, 4], 3.0, DType::F32);
    let areas = r.tensor(&[300, 4], 1.0, DType::F32).exp().unwrap();
    let alphas = (r.tensor(&[300], 0.4, DType::F32) + 0.5).unwrap();
    let alphas = alphas.clamp(0.01, 0.99).unwrap();
    let own = r.tensor(&[300], 1.0, DType::F32).exp().unwrap();
    for rule in [
        OpacityRule::Linear,
        OpacityRule::OpticalDepth,
        OpacityRule::Transmittance,
        OpacityRule::Area,
    ] {
        let inputs = [&logits, &areas, &alphas, &own];
        agrees(&format!("{rule:?}"), &backend, &inputs, |backend, x| {
            Ok(vec![redistribute_on(backend, rule, &x[0], &x[1], &x[2], Some(&x[3]))?])
        });
    }
}

fn gather(points: usize) -> Gather {
    Gather { points, groups: 2, ..gather::base() }
}

/// Maps, query and points of 90 parents.
fn gather_inputs(g: &Gather, dtype: DType) -> [Tensor; 3] {
    let mut r = Random(23);
    let points = (r.tensor(&[90, 2, g.points, 2], 0.3, dtype) + 0.5).unwrap();
    [r.tensor(&[70, 16], 1.0, dtype), r.tensor(&[90, g.query_width()], 1.0, dtype), points]
}

#[test]
fn attention() {
    let Some(gpu) = gpu() else { return };
    let backend = Backend::from(gpu);
    let g = gather(4);
    let [maps, query, points] = gather_inputs(&g, DType::F32);
    agrees("gather", &backend, &[&maps, &query, &points], |backend, x| {
        Ok(vec![attention_gather_on(backend, &x[0], &x[1], &x[2], g.clone())?])
    });
}

#[test]
fn sweep() {
    let Some(gpu) = gpu() else { return };
    let backend = Backend::from(gpu);
    let cameras = scenes::cameras(2, 12, 9);
    let k = cameras[0].intrinsics();
    let to = |a: usize, b: usize| {
        let pose = subsplat::network::ops::plane_sweep::relative_pose(&cameras[a], &cameras[b]);
        pair(&k, &k, pose, b).unwrap()
    };
    let s = Sweep {
        pairs: vec![vec![to(0, 1)], vec![to(1, 0)]],
        depths: vec![vec![1.0, 1.5, 3.0, 10.0]; 2],
        centre: 0.5,
        min_z: 1e-3,
        scale: 0.4,
        channels: 6,
        size: [9, 12],
    };
    let features = Random(24).tensor(&[2, 6, 9, 12], 1.0, DType::F32);
    agrees("sweep", &backend, &[&features, &features], |backend, x| {
        Ok(vec![plane_sweep_on(backend, &x[0], &x[1], s.clone())?])
    });
}

/// Returns 60 splats in front of a camera, and the SH of their 15 parents.
fn splats(r: &mut Random) -> (Camera, Tensor, Tensor) {
    let camera = scenes::cameras(2, 40, 30)[0];
    let n = 60;
    let place = |r: &mut Random| {
        let z = r.uniform(2.0, 6.0);
        let at = [r.uniform(-0.3, 0.3) * z, r.uniform(-0.3, 0.3) * z, z].map(|v| v as f32);
        camera.world_from_camera().transform_point3(at.into()).to_array()
    };
    let means: Vec<f32> = (0..n).flat_map(|_| place(r)).collect();
    let means = Tensor::from_vec(means, (n, 3), &candle_core::Device::Cpu).unwrap();
    let quats = r.tensor(&[n, 4], 1.0, DType::F32);
    let scales = (r.tensor(&[n, 3], 0.3, DType::F32).exp().unwrap() * 0.15).unwrap();
    let alphas = r.tensor(&[n, 1], 0.1, DType::F32).clamp(-0.4, 0.4).unwrap();
    let rows = [means, quats, scales, (alphas + 0.5).unwrap()];
    (camera, Tensor::cat(&rows, 1).unwrap(), r.tensor(&[n / 4, 9, 3], 0.4, DType::F32))
}

/// The rasterizer's op with every gradient, for gains of one and of four floats.
#[test]
fn rasterization() {
    let Some(gpu) = gpu() else { return };
    let backend = Backend::from(gpu);
    let mut r = Random(25);
    let (camera, rows, sh) = splats(&mut r);
    for (gain_stride, convention, sh_direction) in [
        (1, Convention::Standard, ShDirection::Child),
        (4, Convention::Mvsplat, ShDirection::Parent),
    ] {
        let options = RasterOptions { sh_direction, ..RasterOptions::new(convention) };
        let gain = (r.tensor(&[60, gain_stride], 0.2, DType::F32) + 1.0).unwrap();
        let gain = if gain_stride == 1 { gain.flatten_all().unwrap() } else { gain };
        let inputs = [&rows, &sh, &gain];
        agrees(&format!("{convention:?}"), &backend, &inputs, |backend, x| {
            Ok(vec![rasterize_on(backend, &x[0], &x[1], &x[2], &camera, &options)?])
        });
    }
}

/// A device whose bindings hold less than a row of tiles, and a device that is lost between the
/// two passes: the CPU computes the result and a warning is set.
#[test]
fn the_cpu_takes_over_from_a_failed_rasterizer() {
    let Some(small) = limited(2 << 10) else { return };
    let mut r = Random(26);
    let (camera, rows, sh) = splats(&mut r);
    let gain = Tensor::ones(60, DType::F32, rows.device()).unwrap();
    let inputs = [&rows, &sh, &gain];
    let options = RasterOptions::default();
    let of = |backend: &Backend, camera: &Camera| {
        run(backend, &inputs, |backend, x| {
            Ok(vec![rasterize_on(backend, &x[0], &x[1], &x[2], camera, &options)?])
        })
    };
    let backend = Backend::from(small);
    assert!(of(&backend, &camera) == of(&Backend::Cpu, &camera));
    let warning = backend.warning().unwrap();
    assert!(warning.contains("GPU too small for a row of tiles"), "{warning}");
    assert!(warning.contains("CPU"), "{warning}");

    let own = Gpu::open(&DeviceChoice::Gpu).unwrap().unwrap();
    let backend = Backend::from(own.clone());
    let got = run(&backend, &inputs, |backend, x| {
        let planes = rasterize_on(backend, &x[0], &x[1], &x[2], &camera, &options)?;
        assert_eq!(backend.warning(), None);
        own.device().destroy();
        own.device().poll(subsplat_kernels::gpu::wgpu::PollType::Poll).ok();
        Ok(vec![planes])
    });
    let expected = of(&Backend::Cpu, &camera);
    assert!(got[0] != expected[0], "the GPU did not render");
    assert!(got[1..] == expected[1..], "the CPU did not compute the backward pass");
    assert!(backend.warning().is_some_and(|w| w.contains("GPU lost")), "{:?}", backend.warning());
}

/// More samples than the kernel supports, and double precision: the CPU computes the result. Only
/// the former sets a warning.
#[test]
fn the_cpu_computes_unsupported_calls() {
    let Some(gpu) = gpu() else { return };
    for (points, dtype, warns) in [(65, DType::F32, true), (4, DType::F64, false)] {
        let backend = Backend::from(gpu.clone());
        let g = gather(points);
        let [maps, query, points] = gather_inputs(&g, dtype);
        let of = |backend: &Backend| {
            run(backend, &[&maps, &query, &points], |backend, x| {
                Ok(vec![attention_gather_on(backend, &x[0], &x[1], &x[2], g.clone())?])
            })
        };
        assert!(of(&backend) == of(&Backend::Cpu));
        let warning = backend.warning();
        assert_eq!(warning.is_some(), warns);
        assert!(warning.is_none_or(|w| w.contains("samples per parent") && w.contains("128")));
    }
}
