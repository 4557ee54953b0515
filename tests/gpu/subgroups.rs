//! Kernels with subgroup operations against the same kernels without: the same bytes. array.rs and
//! array_gradients.rs compare the version that the adapter takes with the CPU.

use crate::array::noise;
use subsplat_test_support::cpu_against_gpu::Random;
use subsplat_test_support::gpu::{gpu, without_subgroups};

use candle_core::Tensor;
use std::sync::Arc;
use subsplat_kernels::gpu::{Array, Gpu, NormSum, PointwiseFunction, Recorder};

/// Opens the adapter with and without subgroup operations; `None`, loudly, where it has none.
fn both() -> Option<[Arc<Gpu>; 2]> {
    let (with, without) = (gpu()?, without_subgroups()?);
    assert!(!without.has_subgroups(), "expected a device without subgroup operations");
    if !with.has_subgroups() {
        eprintln!("SKIP: {} has no subgroup operations; this test checked nothing", with.adapter());
        return None;
    }
    Some([with, without])
}

fn upload(recorder: &Arc<Recorder>, t: &Tensor) -> Array {
    recorder.upload(&crate::array::values(t), t.dims()).unwrap()
}

/// Compares the bits of `f` of the same arrays on two devices.
fn assert_same_bits(
    name: &str,
    devices: &[Arc<Gpu>; 2],
    tensors: &[&Tensor],
    f: impl Fn(&[Array]) -> Vec<Array>,
) {
    let [with, without] = devices.each_ref().map(|gpu| {
        let recorder = Recorder::new(gpu.clone());
        let arrays: Vec<_> = tensors.iter().map(|t| upload(&recorder, t)).collect();
        let results = f(&arrays);
        let numbers: Vec<f32> = results.iter().flat_map(|a| a.to_vec().unwrap()).collect();
        assert!(numbers.iter().all(|v| v.is_finite()), "{name}");
        numbers.iter().map(|v| v.to_bits()).collect::<Vec<u32>>()
    });
    let different = with.iter().zip(&without).filter(|(a, b)| a != b).count();
    assert_eq!((with.len(), different), (without.len(), 0), "{name}: numbers, and different ones");
}

#[test]
fn rows_have_the_bytes_of_the_path_without() {
    let Some(devices) = both() else { return };
    let r = &mut Random(11);
    for [rows, length] in [[1, 1], [3, 5], [2, 63], [7, 64], [2, 65], [5, 300], [130, 1024]] {
        let (x, dy) = (noise(r, &[rows, length]), noise(r, &[rows, length]));
        let affine = [noise(r, &[length]), noise(r, &[length])];
        let [factors, summands] = &affine;
        let name = |kernel: &str| format!("{kernel} of {rows} x {length}");
        assert_same_bits(&name("softmax"), &devices, &[&x], |a| vec![a[0].softmax().unwrap()]);
        assert_same_bits(&name("layer norm"), &devices, &[&x, factors, summands], |a| {
            vec![a[0].layer_norm([&a[1], &a[2]], NormSum::None).unwrap()]
        });
        assert_same_bits(&name("gradient of layer norm"), &devices, &[&x, factors, &dy], |a| {
            a[0].layer_norm_backward(&a[1], &a[2]).unwrap().to_vec()
        });
    }
}

#[test]
fn groups_have_the_bytes_of_the_path_without() {
    let Some(devices) = both() else { return };
    let r = &mut Random(12);
    // A row of one part with fewer numbers than threads, one of several parts, and one whose last part has
    // one number.
    for dims in [[1, 4, 3, 5], [2, 8, 60, 77], [1, 2, 1, 8193]] {
        let (x, dy) = (noise(r, &dims), noise(r, &dims));
        let affine = [noise(r, &[dims[1]]), noise(r, &[dims[1]])];
        let tensors = [&x, &affine[0], &affine[1], &dy];
        let silu = PointwiseFunction::Silu;
        assert_same_bits(&format!("group norm of {dims:?}"), &devices, &tensors, |a| {
            let of_result = a[0].group_norm(2, Some([&a[1], &a[2]]), silu, None).unwrap();
            let gradients = a[0].group_norm_backward(2, Some([&a[1], &a[2]]), silu, &a[3]);
            [vec![of_result], gradients.unwrap().to_vec()].concat()
        });
    }
}
