//! The fused op's own gradient: against differences, against the unfused graph, on
//! inputs at every guard, and the same bytes from any number of threads.

use subsplat_test_support::scenes;
use subsplat_test_support::spgr_calls;
use subsplat_test_support::spgr_reference;

use candle_core::{DType, Device, Result, Tensor, Var};
use scenes::*;
use spgr_calls::*;
use subsplat::network::config::*;
use subsplat::network::ops::spgr::{Spgr, spgr};
use subsplat_kernels::cpu::spgr as kernel;
use subsplat_kernels::cpu::spgr::Args;
use subsplat_kernels::layout::{HEAD_GAIN_OFFSET, HEAD_STRIDE, SPLAT_STRIDE};

fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Rows and gains side by side.
fn joined((rows, gain): (Tensor, Tensor)) -> Result<Tensor> {
    let n = rows.dim(0)?;
    Tensor::cat(&[rows, gain.reshape((n, ()))?], 1)
}

type Op = fn(&Tensor, &Tensor, &Spgr) -> Result<(Tensor, Tensor)>;

/// Gradients of Σ w·children with respect to head and parents.
fn gradients(op: Op, call: &Spgr, h: &Tensor, p: &Tensor, seed: u64) -> [Tensor; 2] {
    let (h, p) = (Var::from_tensor(h).unwrap(), Var::from_tensor(p).unwrap());
    let y = joined(op(&h, &p, call).unwrap()).unwrap();
    let w = Random(seed).tensor(y.dims(), 1.0, y.dtype());
    let grads = (y * w).unwrap().sum_all().unwrap().backward().unwrap();
    [grads.get(&h).unwrap().clone(), grads.get(&p).unwrap().clone()]
}

/// Largest error of each column, relative to its largest entry.
#[track_caller]
fn assert_lanes_close(got: &Tensor, want: &Tensor, tolerance: f64, what: &str) {
    let lanes = *got.dims().last().unwrap();
    let (got, want) = (host(got), host(want));
    for lane in 0..lanes {
        let (mut error, mut scale) = (0f64, 1e-30f64);
        for (g, w) in got.iter().zip(&want).skip(lane).step_by(lanes) {
            assert!(g.is_finite() && w.is_finite(), "{what} lane {lane}: {g} {w}");
            error = error.max((g - w).abs());
            scale = scale.max(w.abs());
        }
        assert!(error <= tolerance * scale, "{what} lane {lane}: {error:e} of {scale:e}");
    }
}

#[test]
fn gradients_match_differences() {
    let mut r = Random(31);
    for (name, mut config) in variants(2) {
        // Growth and the capped share of a disc step are constants of the gradient by
        // decision: no clamp, and pixels so fine that no disc step is capped.
        let size = if name.contains("disc") { 64 } else { 8 };
        config.spgr.ablations.a_min = AMin::Off;
        let mut call = call(&config, size);
        call.per_view = 3;
        let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
        let middle = size * size / 2 + size / 2;
        let of_view = |v: usize| p.narrow(0, v * size * size + middle, 3).unwrap();
        let p = Tensor::cat(&[of_view(0), of_view(1)], 0).unwrap();
        let h = head(6, 4, 0.4, DType::F64, &mut r);
        let f = |x: &[Tensor]| joined(spgr(&x[0], &x[1], &call)?);
        eprintln!("{name}");
        check_gradients(&[h, p], &f, 40, 2e-5, &mut r);
    }
}

#[test]
fn gradients_equal_those_of_the_unfused_graph() {
    let mut r = Random(32);
    for k in [1, 4, 5, 6, 9, 16] {
        for (name, config) in variants(2) {
            let call = call_of(&config, 8, k);
            let p = parents(&call.cameras, &mut r);
            for (dtype, tolerance) in [(DType::F64, 1e-9), (DType::F32, 2e-3)] {
                let p = p.to_dtype(dtype).unwrap();
                let h = head(p.dim(0).unwrap(), k, 0.6, dtype, &mut r);
                let got = gradients(spgr, &call, &h, &p, 7);
                let want = gradients(spgr_reference::spgr, &call, &h, &p, 7);
                assert_lanes_close(&got[0], &want[0], tolerance, &format!("{name} {dtype:?} head"));
                let what = format!("{name} {dtype:?} parents");
                assert_lanes_close(&got[1], &want[1], tolerance, &what);
            }
        }
    }
}

#[test]
fn single_precision_gradients_are_as_good_as_the_unfused_graphs() {
    // Both against f64, so that a shared loss of digits would show.
    let mut r = Random(33);
    for preset in [Preset::Paper, Preset::Tuned] {
        let call = call(&Config::re10k(preset, 4), 16);
        let p = parents(&call.cameras, &mut r);
        let h = head(p.dim(0).unwrap(), 16, 0.5, DType::F32, &mut r);
        let double = |t: &Tensor| t.to_dtype(DType::F64).unwrap();
        let exact = gradients(spgr, &call, &double(&h), &double(&p), 8);
        let error = |op: Op| -> f64 {
            let got = gradients(op, &call, &h, &p, 8);
            let each = got.iter().zip(&exact).map(|(g, e)| {
                let d = (double(g) - e).unwrap().sqr().unwrap().sum_all().unwrap();
                let s = e.sqr().unwrap().sum_all().unwrap();
                (d / s).unwrap().to_scalar::<f64>().unwrap().sqrt()
            });
            each.fold(0.0, f64::max)
        };
        let (fused, graph) = (error(spgr), error(spgr_reference::spgr));
        assert!(fused < 2.0 * graph.max(1e-6), "{preset:?}: {fused:e} fused, {graph:e} graph");
    }
}

/// One parent in front of view 0 of `call` and one head record for its children, f64.
struct Nasty {
    name: &'static str,
    row: [f64; SPLAT_STRIDE],
    head: Vec<f64>,
}

fn nasty(call: &Spgr, children: usize, r: &mut Random) -> Vec<Nasty> {
    let camera = &call.cameras[0];
    let middle = camera.intrinsics().height / 2 * camera.intrinsics().width + 3;
    let base: Vec<f64> = host(&parents(&call.cameras, r).narrow(0, middle, 1).unwrap());
    let base: [f64; SPLAT_STRIDE] = base.try_into().unwrap();
    let at = |x: f32, y: f32, z: f32| {
        let p = camera.position() + camera.rotation() * glam::Vec3::new(x, y, z);
        p.to_array().map(f64::from)
    };
    let moved = |to: [f64; 3]| {
        let mut row = base;
        row[..3].copy_from_slice(&to);
        row
    };
    let with = |lane: usize, v: f64| {
        let mut row = base;
        row[lane] = v;
        row
    };
    let edge_on = {
        let q = glam::Quat::from_mat3(&camera.rotation())
            * glam::Quat::from_rotation_y(std::f32::consts::FRAC_PI_2);
        let mut row = moved(at(0.0, 0.0, 3.0));
        row[3..7].copy_from_slice(&[q.w, q.x, q.y, q.z].map(f64::from));
        row[7..10].copy_from_slice(&[0.4, 0.3, 1e-6]);
        row
    };
    let flat = {
        let mut row = base;
        row[7..10].copy_from_slice(&[1e-5, 1e-5, 1e-5]);
        row
    };
    let mut all = Vec::new();
    let mut push = |name, row, change: &dyn Fn(&mut [f64])| {
        let mut head = r.normals(children * HEAD_STRIDE, 0.5);
        head.chunks_mut(HEAD_STRIDE).for_each(change);
        all.push(Nasty { name, row, head });
    };
    push("zero record", base, &|c| c.fill(0.0));
    push("tiny rotation", base, &|c| c[6..9].copy_from_slice(&[1e-9, -1e-9, 2e-9]));
    push("series' end", base, &|c| c[6..9].copy_from_slice(&[0.6, 0.0, -0.7999]));
    push("many turns", base, &|c| c[6..9].copy_from_slice(&[40.0, -3.0, 9.0]));
    push("scale at its bound", base, &|c| c[3..6].copy_from_slice(&[60.0, -60.0, 9.0]));
    push("depth at its bound", base, &|c| c[2] = -50.0);
    push("logits far apart", base, &|c| c[9] *= 80.0);
    push("transparent", with(10, 0.0), &|_| {});
    push("opaque", with(10, 1.0), &|_| {});
    push("almost opaque", with(10, 0.99985), &|_| {});
    push("long quaternion", with(3, 7.0), &|_| {});
    push("at the least depth", moved(at(0.0, 0.0, 0.0101)), &|_| {});
    push("before the least depth", moved(at(0.001, 0.0, 0.004)), &|_| {});
    push("behind all views", moved(at(0.2, 0.1, -3.0)), &|_| {});
    push("beside the picture", moved(at(9.0, -8.0, 3.0)), &|_| {});
    push("edge-on", edge_on, &|_| {});
    push("a point", flat, &|_| {});
    all
}

#[test]
fn gradients_at_every_guard_are_finite_and_those_of_the_unfused_graph() {
    for side in [1, 2, 4] {
        let mut r = Random(34);
        for (name, config) in variants(side) {
            let mut call = call(&config, 8);
            call.per_view = 1;
            let k = side * side;
            for case in nasty(&call, k, &mut r) {
                let p = Tensor::from_slice(&case.row, (1, SPLAT_STRIDE), &Device::Cpu).unwrap();
                let h = Tensor::from_vec(case.head, (1, k, HEAD_STRIDE), &Device::Cpu).unwrap();
                let what = format!("{name}, {}", case.name);
                let got = gradients(spgr, &call, &h, &p, 9);
                let want = gradients(spgr_reference::spgr, &call, &h, &p, 9);
                // Entry by entry: columns of one parent.
                for (got, want) in got.iter().zip(&want) {
                    let scale = host(want).iter().fold(1e-30f64, |m, v| m.max(v.abs()));
                    for (g, w) in host(got).iter().zip(host(want)) {
                        let allowed = 1e-7 * w.abs() + 1e-9 * scale;
                        assert!((g - w).abs() <= allowed, "{what}: {g:e} for {w:e} of {scale:e}");
                    }
                }
                let single = |t: &Tensor| t.to_dtype(DType::F32).unwrap();
                for g in gradients(spgr, &call, &single(&h), &single(&p), 9) {
                    assert!(host(&g).iter().all(|v| v.is_finite()), "{what} in f32");
                }
            }
        }
    }
}

/// Inputs of the kernel in f32 and everything that it gives.
struct Plain {
    call: Spgr,
    head: Vec<f32>,
    parents: Vec<f32>,
}

impl Plain {
    fn new(config: &Config, seed: u64) -> Self {
        let call = call(config, 13);
        let mut r = Random(seed);
        let p = parents(&call.cameras, &mut r);
        let h = head(p.dim(0).unwrap(), call.rules.children(), 0.6, DType::F32, &mut r);
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        Self { head: flat(&h), parents: flat(&p), call }
    }

    fn args(&self) -> Args<'_, f32> {
        let Spgr { rules, cameras, near, per_view, first } = &self.call;
        let source = kernel::Source { cameras, near, per_view: *per_view, first: *first };
        Args { rules, source, head: &self.head, parents: &self.parents }
    }

    /// Children, gains, and gradients of head and parents.
    fn run(&self) -> (bool, [Vec<f32>; 4]) {
        let (n, rules) = (self.parents.len() / SPLAT_STRIDE, &self.call.rules);
        let mut rows = vec![0f32; n * rules.children() * SPLAT_STRIDE];
        let mut gains = vec![0f32; n * rules.children() * rules.gain_channels()];
        let finite = kernel::forward(self.args(), &mut rows, &mut gains);
        let weights = |n: usize| -> Vec<f32> { (0..n).map(|i| (i as f32 * 0.37).sin()).collect() };
        let (g_rows, g_gains) = (weights(rows.len()), weights(gains.len()));
        let (mut head, mut parents) = (vec![0f32; self.head.len()], vec![0f32; self.parents.len()]);
        kernel::backward(self.args(), &g_rows, &mut head, &mut parents);
        kernel::gains_backward(rules, &self.head, &g_gains, &mut head);
        (finite, [rows, gains, head, parents])
    }
}

fn bits(v: &[f32]) -> Vec<u32> {
    v.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn one_thread_and_two_give_the_same_bytes() {
    for preset in [Preset::Paper, Preset::Tuned] {
        let plain = Plain::new(&Config::re10k(preset, 2), 35);
        let pool = |n: usize| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        let (_, one) = pool(1).install(|| plain.run());
        let (_, two) = pool(2).install(|| plain.run());
        for (a, b) in one.iter().zip(&two) {
            assert!(bits(a) == bits(b), "{preset:?}");
        }
    }
}

#[test]
fn gains_alone_have_a_gradient() {
    // γ = 1 + δ·tanh γ̃ and, in RGB, three times δ/2·tanh γ̃.
    for (name, config) in variants(2) {
        let plain = Plain::new(&config, 38);
        let (n, k) = (plain.parents.len() / SPLAT_STRIDE, 4);
        let of = |v: &[f32], s: &[usize]| Var::from_slice(v, s, &Device::Cpu).unwrap();
        let (h, p) =
            (of(&plain.head, &[n, k, HEAD_STRIDE]), of(&plain.parents, &[n, SPLAT_STRIDE]));
        let (rows, gains) = spgr(&h, &p, &plain.call).unwrap();
        let grads = gains.sum_all().unwrap().backward().unwrap();
        let got = grads.get(&h).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let rules = &plain.call.rules;
        let factor = rules.delta * if rules.gain_space == GainSpace::Rgb { 2.5 } else { 1.0 };
        for (record, d) in plain.head.chunks(HEAD_STRIDE).zip(got.chunks(HEAD_STRIDE)) {
            let t = f64::from(record[HEAD_GAIN_OFFSET]).tanh();
            let want = factor * (1.0 - t * t);
            assert!((f64::from(d[HEAD_GAIN_OFFSET]) - want).abs() < 1e-6, "{name}: {d:?} {want}");
            assert!(d[..HEAD_GAIN_OFFSET].iter().all(|v| *v == 0.0), "{name}: {d:?}");
        }
        // Children alone leave that column without one.
        let grads = rows.sum_all().unwrap().backward().unwrap();
        let got = grads.get(&h).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(got.chunks(HEAD_STRIDE).all(|d| d[HEAD_GAIN_OFFSET] == 0.0), "{name}");
        assert!(got.iter().any(|v| *v != 0.0), "{name}");
    }
}

#[test]
fn children_do_not_depend_on_their_neighbours() {
    // A parent alone, where a vector holds it 16 times, and among others.
    let plain = Plain::new(&Config::re10k(Preset::Tuned, 2), 36);
    let (_, all) = plain.run();
    for n in [0, 17, 168, 169, 337] {
        let mut one = Plain::new(&Config::re10k(Preset::Tuned, 2), 36);
        let span = |v: &[f32], per: usize| v[n * per..(n + 1) * per].to_vec();
        one.head = span(&plain.head, 44);
        one.parents = span(&plain.parents, 11);
        one.call.first = n;
        let (_, got) = one.run();
        assert_eq!(bits(&got[0]), bits(&span(&all[0], 44)), "{n}");
        assert_eq!(bits(&got[1]), bits(&span(&all[1], 4)), "{n}");
    }
}

#[test]
fn a_record_that_is_not_a_number_stays_with_its_parent() {
    for (name, config) in variants(2) {
        let mut plain = Plain::new(&config, 37);
        let (finite, clean) = plain.run();
        assert!(finite, "{name}");
        let victim = 21;
        for lane in 0..HEAD_STRIDE {
            let at = (victim * 4 + 2) * HEAD_STRIDE + lane;
            let was = std::mem::replace(&mut plain.head[at], f32::NAN);
            let (finite, got) = plain.run();
            plain.head[at] = was;
            assert!(!finite, "{name} lane {lane} went unseen");
            let lanes = plain.call.rules.gain_channels();
            for (i, per) in [44, 4 * lanes, 44, 11].into_iter().enumerate() {
                let span = victim * per..(victim + 1) * per;
                let without = |v: &[f32]| [bits(&v[..span.start]), bits(&v[span.end..])].concat();
                let same = without(&got[i]) == without(&clean[i]);
                assert!(same, "{name} lane {lane} output {i}");
            }
        }
    }
}
