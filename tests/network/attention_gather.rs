//! The fused attention gather against loops written out, and its gradients.

use subsplat_test_support::gather::{base, grid_sample, host};
use subsplat_test_support::scenes;

use candle_core::{DType, Device, Tensor};
use scenes::*;
use subsplat::network::ops::attention_gather::{
    Drop, Gather, Level, attention_gather, occlusion_gate,
};
use subsplat_kernels::layout::SampleConvention;

/// The definition, sample by sample, nothing merged; without dropping.
fn naive(g: &Gather, maps: &Tensor, query: &Tensor, points: &Tensor) -> Tensor {
    let n = query.dim(0).unwrap();
    let (maps, query, points) = (host(maps), host(query), host(points));
    let (qc, width) = (g.query_channels(), g.dim / g.groups);
    let mut out = vec![0.0; n * g.dim];
    for i in 0..n {
        let row = &query[i * g.query_width()..(i + 1) * g.query_width()];
        let mut samples = Vec::new();
        for v in 0..g.views {
            for l in 0..g.levels.len() {
                for m in 0..g.points {
                    let own = if g.points_per_level { l * g.points + m } else { m };
                    let at = 2 * ((i * g.views + v) * g.points_width() + own);
                    let at = [points[at], points[at + 1]];
                    let inside = at.iter().all(|&r| r > 0.0 && r < 1.0);
                    let value =
                        if inside { grid_sample(&maps, g, l, v, at) } else { vec![0.0; g.stride] };
                    samples.push((inside, v, value));
                }
            }
        }
        for group in 0..g.groups {
            let logits: Vec<f64> = samples
                .iter()
                .enumerate()
                .map(|(j, (inside, _, value))| {
                    let mut a = row[qc + j * g.groups + group];
                    if let Some(key) = g.key {
                        for c in group * width..(group + 1) * width {
                            a += g.logit_scale * row[c] * value[key + c];
                        }
                    }
                    if *inside || !g.renormalise { a } else { f64::NEG_INFINITY }
                })
                .collect();
            let sum: f64 = logits.iter().map(|a| a.exp()).sum();
            if sum == 0.0 {
                continue;
            }
            for ((_, v, value), a) in samples.iter().zip(&logits) {
                let weight = a.exp() / sum * row[row.len() - g.views + v];
                for c in group * width..(group + 1) * width {
                    out[i * g.dim + c] += weight * value[g.value + c];
                }
            }
        }
    }
    Tensor::from_vec(out, (n, g.dim), &Device::Cpu).unwrap()
}

fn forms() -> Vec<(&'static str, Gather)> {
    let two = vec![
        Level { height: 5, width: 7, first_cell: 0 },
        Level { height: 10, width: 14, first_cell: 70 },
    ];
    vec![
        ("ref", base()),
        ("integer", Gather { sample_convention: SampleConvention::Integer, ..base() }),
        ("clamp", Gather { renormalise: false, ..base() }),
        ("two levels", Gather { levels: two.clone(), ..base() }),
        ("three views", Gather { views: 3, ..base() }),
        ("13 points", Gather { points: 13, ..base() }),
        ("13 points, groups", Gather { points: 13, groups: 4, levels: two.clone(), ..base() }),
        ("offsets", Gather { points: 3, points_per_level: true, levels: two.clone(), ..base() }),
        ("no projection", Gather { stride: 8, value: 0, ..base() }),
        ("linear", Gather { stride: 8, value: 0, key: None, groups: 2, points: 4, ..base() }),
        ("odd width", Gather { dim: 18, stride: 36, value: 18, groups: 2, levels: two, ..base() }),
    ]
}

/// Maps, query, points; points of one parent clustered, a fifth of them outside.
fn inputs(g: &Gather, n: usize, dtype: DType, r: &mut Random) -> [Tensor; 3] {
    let levels = g.levels.iter().map(|l| l.first_cell + g.views * l.height * l.width);
    let cells = levels.max().unwrap();
    let maps = r.tensor(&[cells, g.stride], 1.0, dtype);
    let query = r.tensor(&[n, g.query_width()], 1.0, dtype);
    let mut points = Vec::new();
    for _ in 0..n * g.views {
        let centre = [r.uniform(-0.1, 1.1), r.uniform(-0.1, 1.1)];
        for _ in 0..g.points_width() {
            points.extend(centre.map(|c| c + r.uniform(-0.06, 0.06)));
        }
    }
    let shape = (n, g.views, g.points_width(), 2);
    let points = Tensor::from_vec(points, shape, &Device::Cpu).unwrap().to_dtype(dtype).unwrap();
    [maps, query, points]
}

#[test]
fn fused_gather_equals_the_definition() {
    let mut r = Random(1);
    for (name, g) in forms() {
        for (dtype, allowed) in [(DType::F64, 1e-12), (DType::F32, 1e-5)] {
            let [maps, query, points] = inputs(&g, 150, dtype, &mut r);
            let got = attention_gather(&maps, &query, &points, g.clone()).unwrap();
            let want = naive(&g, &maps, &query, &points);
            let (d, scale) = difference(&got, &want);
            assert!(d <= allowed * scale, "{name} {dtype:?}: {d:e} of {scale:e}");
        }
    }
}

#[test]
fn gather_gradients_match_differences() {
    let mut r = Random(2);
    let mut all = forms();
    let drop = Some(Drop { probability: 0.3, seed: 5, first_parent: 11 });
    all.push(("dropping", Gather { drop, points: 4, groups: 2, ..base() }));
    for (name, g) in all {
        let args = inputs(&g, 5, DType::F64, &mut r);
        eprintln!("{name}");
        let f = |x: &[Tensor]| attention_gather(&x[0], &x[1], &x[2], g.clone());
        check_gradients(&args, &f, 40, 1e-6, &mut r);
    }
}

#[test]
fn gradients_do_not_depend_on_the_number_of_threads() {
    let g = Gather { points: 3, groups: 2, ..base() };
    let args = inputs(&g, 300, DType::F32, &mut Random(3));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let maps = candle_core::Var::from_tensor(&args[0]).unwrap();
            let o = attention_gather(maps.as_tensor(), &args[1], &args[2], g.clone()).unwrap();
            let grads = o.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            host(grads.get(&maps).unwrap())
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn masked_samples_leave_the_softmax() {
    let g = base();
    let mut r = Random(4);
    let [maps, query, _] = inputs(&g, 6, DType::F64, &mut r);
    let at = |a: [f64; 2], b: [f64; 2]| {
        let one: Vec<f64> = a.into_iter().chain(b).collect();
        Tensor::from_vec(one.repeat(6), (6, 2, 1, 2), &Device::Cpu).unwrap()
    };
    let (inside, outside) = ([0.4, 0.6], [1.2, 0.5]);
    let run = |g: &Gather, p: &Tensor| attention_gather(&maps, &query, p, g.clone()).unwrap();
    // View 1 masked: view 0 has all the weight, o = gate·u.
    let got = run(&g, &at(inside, outside));
    let u = grid_sample(&host(&maps), &g, 0, 0, inside);
    let q = host(&query);
    for (i, row) in host(&got).chunks(8).enumerate() {
        let gate = q[(i + 1) * g.query_width() - 2];
        for (c, o) in row.iter().enumerate() {
            assert!((o - gate * u[8 + c]).abs() < 1e-12);
        }
    }
    // Everything masked, or nowhere: nothing.
    for p in [at(outside, [-0.1, 0.5]), at([f64::NAN; 2], outside), at([f64::INFINITY; 2], outside)]
    {
        assert!(host(&run(&g, &p)).iter().all(|&v| v == 0.0));
        assert!(
            host(&run(&Gather { renormalise: false, ..g.clone() }, &p)).iter().all(|&v| v == 0.0)
        );
    }
    // Without renormalisation a miss keeps its share of the weight.
    let kept = run(&Gather { renormalise: false, ..g.clone() }, &at(inside, outside));
    let (a, b) = (host(&kept), host(&got));
    assert!(a.iter().zip(&b).all(|(a, b)| a.abs() < 0.999 * b.abs()));
}

#[test]
fn dropping_keeps_the_mean_and_its_seed() {
    let drop = |seed, first_parent| Some(Drop { probability: 0.25, seed, first_parent });
    let g = |d| Gather { drop: d, ..base() };
    let mut r = Random(5);
    let [maps, query, _] = inputs(&base(), 1, DType::F64, &mut r);
    let n = 4000;
    let query = query.broadcast_as((n, base().query_width())).unwrap().contiguous().unwrap();
    let points = Tensor::full(0.5f64, (n, 2, 1, 2), &Device::Cpu).unwrap();
    let run = |d| attention_gather(&maps, &query, &points, g(d)).unwrap();
    let (plain, a) = (run(None), run(drop(1, 0)));
    assert_close(&a.mean(0).unwrap(), &plain.mean(0).unwrap(), 0.05);
    assert_close(&a, &run(drop(1, 0)), 0.0);
    assert!(difference(&a, &run(drop(2, 0))).0 > 0.0);
    // The same parent in another chunk drops the same weights.
    let shifted = attention_gather(
        &maps,
        &query.narrow(0, 0, 100).unwrap(),
        &points.narrow(0, 0, 100).unwrap(),
        g(drop(1, 700)),
    );
    assert_close(&shifted.unwrap(), &a.narrow(0, 700, 100).unwrap(), 0.0);
}

#[test]
fn misfits_are_refused_by_name() {
    let g = base();
    let [maps, query, points] = inputs(&g, 3, DType::F32, &mut Random(6));
    let error = |m: &Tensor, q: &Tensor, p: &Tensor, g: &Gather| {
        attention_gather(m, q, p, g.clone()).unwrap_err().to_string()
    };
    assert!(error(&maps.narrow(0, 0, 69).unwrap(), &query, &points, &g).contains("maps"));
    assert!(error(&maps, &query.narrow(1, 0, 9).unwrap(), &points, &g).contains("query"));
    assert!(error(&maps, &query, &points.narrow(1, 0, 1).unwrap(), &g).contains("points"));
    assert!(error(&maps, &query, &points, &Gather { groups: 3, ..g.clone() }).contains("groups"));
    let doubles = points.to_dtype(DType::F64).unwrap();
    assert!(error(&maps, &query, &doubles, &g).contains("F32"));
}

#[test]
fn occlusion_follows_its_formula() {
    let t = |v: Vec<f32>, s: &[usize]| Tensor::from_vec(v, s, &Device::Cpu).unwrap();
    // Depth 2 in the left half, 4 in the right half.
    let depths = t([2.0, 2.0, 4.0, 4.0].repeat(4), &[1, 4, 4]);
    let cases = [
        ([0.1, 0.5], 2.0, 1.0),                               // on the surface
        ([0.1, 0.5], 2.03, 1.0),                              // within 2 % of z
        ([0.1, 0.5], 2.1, (-(0.1f64 - 0.042) / 0.042).exp()), // a little behind
        ([0.1, 0.5], 4.0, 0.0),                               // far behind
        ([0.9, 0.5], 4.0, 1.0),                               // the far surface itself
        ([0.9, 0.5], 3.0, 1.0),                               // in front of it
        ([0.5, 0.5], 3.0, 1.0),                               // bilinear: halfway depth 3
        ([1.5, 0.5], 9.0, 1.0),                               // outside
        ([0.1, 0.5], -9.0, 1.0),                              // behind the camera
    ];
    for (at, z, want) in cases {
        let gate =
            occlusion_gate(&t(at.to_vec(), &[1, 1, 2]), &t(vec![z], &[1, 1]), &depths).unwrap();
        assert!((host(&gate)[0] - want).abs() < 1e-4, "{at:?} {z}: {gate} {want}");
    }
}
