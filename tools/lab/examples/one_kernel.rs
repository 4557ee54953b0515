//! Runs one kernel some times on one thread, for an emulator that counts instructions
//! (tools/instructions/run.sh).
//!
//! `one_kernel KERNEL REPEATS` prints how many units one run has: products, samples or pixels. Inputs are
//! the same for every SIMD level, which `SUBSPLAT_SIMD` chooses.

#[path = "../../../benches/common/scene.rs"]
#[allow(dead_code, reason = "the benches use all scenes")]
mod scene;

use std::error::Error;
use std::hint::black_box;
use subsplat::scene::render::slices;
use subsplat_kernels::cpu::conv::{Sizes, forward};
use subsplat_kernels::cpu::gemm::{Base, Mat, Packed, product};
use subsplat_kernels::cpu::softmax;
use subsplat_kernels::cpu::{Gradients, Rasterizer, SimdLevel};
use subsplat_kernels::layout::RasterOptions;

/// Rows, products per sum and columns of `product`.
const PRODUCT: [usize; 3] = [192, 256, 256];
/// Channels in and out, and side, of the convolutions.
const CONVOLUTION: [usize; 3] = [64, 64, 64];
/// Rows and columns of `softmax`.
const SOFTMAX: [usize; 2] = [512, 256];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let kernel = arguments.next().ok_or("expected KERNEL REPEATS, got no kernel")?;
    let repeats: usize =
        arguments.next().ok_or("expected KERNEL REPEATS, got no repeats")?.parse()?;
    SimdLevel::requested()?;
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let units = match kernel.as_str() {
        "product" => products(repeats),
        "conv1x1" => convolution(1, 1, repeats),
        "conv3x3" => convolution(3, 1, repeats),
        "conv3x3s2" => convolution(3, 2, repeats),
        "softmax" => softmax_rows(repeats),
        "forward" => rasterizer(repeats, false),
        "backward" => rasterizer(repeats, true),
        other => return Err(format!("expected a kernel, got {other}").into()),
    };
    println!("{units}");
    Ok(())
}

/// Normal numbers.
fn numbers(n: usize, stream: u64) -> Vec<f32> {
    (0..n as u64).map(|i| scene::normal(stream, i)).collect()
}

fn products(repeats: usize) -> usize {
    let [m, k, n] = PRODUCT;
    let (lhs, rhs) = (numbers(m * k, 1), numbers(k * n, 2));
    let packed = Packed::new(Mat::new(&rhs, k, n, n));
    let mut dst = vec![0.0; m * n];
    for _ in 0..repeats {
        product((&mut dst, n), Mat::new(&lhs, m, k, k), &packed, 1.0, Base::Zero);
        black_box(&mut dst);
    }
    m * k * n
}

/// Returns the products of the definition, whichever algorithm computes them.
fn convolution(kernel: usize, stride: usize, repeats: usize) -> usize {
    let [c, o, side] = CONVOLUTION;
    let sizes = Sizes::conv2d([c, o], [kernel; 2], stride, kernel / 2, [side; 2]);
    let x = numbers(c * side * side, 1);
    let w = numbers(o * c * kernel * kernel, 2);
    let bias = numbers(o, 3);
    for _ in 0..repeats {
        black_box(forward(SimdLevel::best(), &sizes, 1, &x, &w, &bias));
    }
    (side / stride).pow(2) * o * c * kernel * kernel
}

fn softmax_rows(repeats: usize) -> usize {
    let [rows, cols] = SOFTMAX;
    let x = numbers(rows * cols, 1);
    for _ in 0..repeats {
        black_box(softmax::softmax(cols, &x));
    }
    rows * cols
}

fn rasterizer(repeats: usize, backward: bool) -> usize {
    let spec = &scene::SCENES[0];
    let (splats, camera) = (scene::shared(spec), scene::camera(spec.side));
    let options = RasterOptions::default();
    let planes = numbers(5 * spec.side * spec.side, 50);
    let (mut rasterizer, mut gradients) = (Rasterizer::new(), Gradients::default());
    for _ in 0..repeats {
        if backward {
            rasterizer.backward(&slices(&splats), &camera, &options, &planes, &mut gradients);
        } else {
            black_box(rasterizer.render(&slices(&splats), &camera, &options));
        }
    }
    spec.side * spec.side
}
