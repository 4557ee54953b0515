//! The plane sweep's gradients against finite differences of a naive sweep in double
//! precision, and its independence of threads.

use candle_core::{Device, Result, Tensor, Var};
use glam::{Mat4, Quat, Vec3};
use subsplat::network::ops::plane_sweep::{Pair, Sweep, pair, plane_sweep};
use subsplat_kernels::camera::Intrinsics;

const SIZE: [usize; 2] = [7, 9];
const CHANNELS: usize = 5;

/// Numbers in (−1, 1), the same each time.
fn noise(n: usize, seed: u32) -> Vec<f32> {
    let mut state = seed;
    let next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    std::iter::repeat_with(next).take(n).collect()
}

/// Three reference rows: with two pairs, with one whose camera has turned away (most
/// samples are behind it or outside), and with none.
fn sweep(centre: f32) -> Sweep {
    let [h, w] = SIZE;
    let k = Intrinsics::from_fov_x(1.0, w, h);
    let to = |x: f32, turn: f32, row: usize| -> Pair {
        let pose =
            Mat4::from_rotation_translation(Quat::from_rotation_y(turn), Vec3::new(x, 0.13, -0.2));
        pair(&k, &k, pose, row).unwrap()
    };
    Sweep {
        pairs: vec![vec![to(0.4, 0.1, 1), to(-0.3, -0.2, 0)], vec![to(0.2, 0.8, 1)], vec![]],
        depths: vec![vec![0.7, 1.0, 1.1, 1.3, 2.0, 40.0]; 3],
        centre,
        min_z: 1e-3,
        scale: 0.3,
        channels: CHANNELS,
        size: SIZE,
    }
}

/// Σ grad·correlation by the definition, in f64 throughout.
fn loss(s: &Sweep, reference: &[f64], source: &[f64], grad: &[f32]) -> f64 {
    let ([h, w], d, c) = (s.size, s.candidates(), s.channels);
    let at = |map: &[f64], row: usize, channel: usize, y: f64, x: f64| {
        let inside = y >= 0.0 && x >= 0.0 && y < h as f64 && x < w as f64;
        if inside { map[((row * c + channel) * h + y as usize) * w + x as usize] } else { 0.0 }
    };
    let mut total = 0.0;
    for (r, pairs) in s.pairs.iter().enumerate() {
        for (k, &depth) in s.depths[r].iter().enumerate() {
            for i in 0..h * w {
                let (x, y) = (i % w, i / w);
                let g = f64::from(grad[(r * d + k) * h * w + i]);
                for p in pairs {
                    let centre = f64::from(s.centre);
                    let inverse = p.inverse.map(f64::from);
                    let ray = [
                        inverse[0] * (x as f64 + centre) + inverse[2],
                        inverse[1] * (y as f64 + centre) + inverse[3],
                        1.0,
                    ];
                    let q: [f64; 3] = std::array::from_fn(|row| {
                        let dot: f64 =
                            (0..3).map(|j| f64::from(p.rotation[3 * row + j]) * ray[j]).sum();
                        dot * f64::from(depth) + f64::from(p.t[row])
                    });
                    let [fx, fy, cx, cy] = p.k.map(f64::from);
                    let z = q[2].max(f64::from(s.min_z));
                    let u = (fx * q[0] + cx * q[2]) / z - centre;
                    let v = (fy * q[1] + cy * q[2]) / z - centre;
                    for (dy, dx) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
                        let (ty, tx) = (v.floor() + dy, u.floor() + dx);
                        let weight = (1.0 - (v - ty).abs()) * (1.0 - (u - tx).abs());
                        for channel in 0..c {
                            let f = at(reference, r, channel, y as f64, x as f64);
                            let share = f64::from(s.scale) / pairs.len() as f64;
                            total += g * share * weight * f * at(source, p.source, channel, ty, tx);
                        }
                    }
                }
            }
        }
    }
    total
}

fn tensor(values: &[f32], rows: usize) -> Result<Tensor> {
    Tensor::from_slice(values, (rows, CHANNELS, SIZE[0], SIZE[1]), &Device::Cpu)
}

/// Gradients of Σ grad·correlation through the op.
fn gradients(s: &Sweep, f: &[f32], g: &[f32], grad: &[f32]) -> Result<[Vec<f32>; 2]> {
    let (f, g) = (Var::from_tensor(&tensor(f, 3)?)?, Var::from_tensor(&tensor(g, 2)?)?);
    let out = plane_sweep(&f, &g, s.clone())?;
    let all =
        (&out * Tensor::from_slice(grad, out.dims(), &Device::Cpu)?)?.sum_all()?.backward()?;
    let host = |v: &Var| all.get(v).unwrap().flatten_all()?.to_vec1::<f32>();
    Ok([host(&f)?, host(&g)?])
}

fn case() -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let n = SIZE[0] * SIZE[1];
    (noise(3 * CHANNELS * n, 1), noise(2 * CHANNELS * n, 2), noise(3 * 6 * n, 3))
}

#[test]
fn gradients_are_finite_differences_in_double_precision() -> Result<()> {
    let (f, g, grad) = case();
    for centre in [0.0, 0.5] {
        let s = sweep(centre);
        let got = gradients(&s, &f, &g, &grad)?;
        let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
        let mut maps = [wide(&f), wide(&g)];
        let mut live = 0;
        for side in 0..2 {
            for i in (0..maps[side].len()).step_by(3) {
                // The sweep is linear in either map: any step gives the derivative.
                let mut value = |step: f64| {
                    maps[side][i] += step;
                    let l = loss(&s, &maps[0], &maps[1], &grad);
                    maps[side][i] -= step;
                    l
                };
                let want = (value(1.0) - value(-1.0)) / 2.0;
                let got = f64::from(got[side][i]);
                live += usize::from(want != 0.0);
                // Sample positions are rounded to f32: about 1e-6 of a pixel, times
                // features of size 1 and up to 12 candidates.
                assert!(
                    (got - want).abs() < 2e-5,
                    "centre {centre}, map {side}, {i}: {got} {want}"
                );
            }
        }
        assert!(live > 100, "{live}");
    }
    Ok(())
}

/// The op's own value against the same definition: the sum with random weights
/// depends on every output.
#[test]
fn values_are_the_definition() -> Result<()> {
    let (f, g, grad) = case();
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    for centre in [0.0, 0.5] {
        let s = sweep(centre);
        let out = plane_sweep(&tensor(&f, 3)?, &tensor(&g, 2)?, s.clone())?;
        let out = out.flatten_all()?.to_vec1::<f32>()?;
        let got: f64 = out.iter().zip(&grad).map(|(a, b)| f64::from(a * b)).sum();
        let want = loss(&s, &wide(&f), &wide(&g), &grad);
        assert!((got - want).abs() < 1e-4 && want.abs() > 0.1, "{got} {want}");
        // The row without pairs is zero, the others are not.
        let row = out.len() / 3;
        assert!(out[2 * row..].iter().all(|&v| v == 0.0));
        assert!(out[..2 * row].chunks(row).all(|r| r.iter().any(|&v| v != 0.0)));
    }
    Ok(())
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() -> Result<()> {
    let (f, g, grad) = case();
    let s = sweep(0.5);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| -> Result<_> {
            let out = plane_sweep(&tensor(&f, 3)?, &tensor(&g, 2)?, s.clone())?;
            Ok((out.flatten_all()?.to_vec1::<f32>()?, gradients(&s, &f, &g, &grad)?))
        })
    };
    let one = run(1)?;
    for threads in [2, 5] {
        assert_eq!(one, run(threads)?);
    }
    Ok(())
}
