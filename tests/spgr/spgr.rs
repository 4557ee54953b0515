//! Sub-pixel reparameterization: identities, invariances, gradients, and the fused kernel
//! against the unfused graph.

use subsplat_test_support::scenes;
use subsplat_test_support::spgr_calls;
use subsplat_test_support::spgr_reference;

use candle_core::{DType, Device, Tensor, Var};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use scenes::*;
use spgr_calls::*;
use subsplat::network::config::*;
use subsplat::network::ops::spgr::{Rules, Spgr, spgr, spgr_into};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{HEAD_STRIDE, Positions};

fn cpu(v: Vec<f64>, shape: &[usize]) -> Tensor {
    Tensor::from_vec(v, shape, &Device::Cpu).unwrap()
}

fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

fn column(rows: &Tensor, i: usize) -> Vec<f64> {
    host(&rows.narrow(1, i, 1).unwrap())
}

fn mean(rows: &[f64]) -> Vec3 {
    Vec3::new(rows[0] as f32, rows[1] as f32, rows[2] as f32)
}

#[test]
fn one_child_is_its_parent() {
    let config = Config::re10k(Preset::Tuned, 1);
    let call = call(&config, 8);
    let mut r = Random(5);
    let p = parents(&call.cameras, &mut r);
    let n = p.dim(0).unwrap();
    let zero = Tensor::zeros((n, 1, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
    let (rows, gain) = spgr(&zero, &p, &call).unwrap();
    for lanes in [0..3, 7..10] {
        for i in lanes {
            assert_eq!(column(&rows, i), column(&p, i), "lane {i}");
        }
    }
    assert_close(&rows, &p, 1e-6);
    assert!(host(&gain).iter().all(|&g| g == 1.0));
}

#[test]
fn untrained_tuned_children_have_their_parents_opacity() {
    // With the parent's Jacobian exactly; with the child's, J differs by half a pixel's
    // angle, which in an 8-pixel picture is much.
    for (side, at, allowed) in
        [(2, AreaAt::Parent, 1e-5), (4, AreaAt::Parent, 1e-5), (2, AreaAt::Child, 0.05)]
    {
        let mut config = Config::re10k(Preset::Tuned, side);
        config.spgr.ablations.a_min = AMin::Off;
        config.spgr.ablations.area_at = at;
        let call = call(&config, 8);
        let mut r = Random(6);
        let p = parents(&call.cameras, &mut r);
        let (n, k) = (p.dim(0).unwrap(), side * side);
        let zero = Tensor::zeros((n, k, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
        let (rows, _) = spgr(&zero, &p, &call).unwrap();
        let (alpha, own) = (column(&rows, 10), column(&p, 10));
        for (i, a) in alpha.iter().enumerate() {
            assert!((a - own[i / k]).abs() < allowed, "{at:?} {a} {}", own[i / k]);
        }
    }
}

#[test]
fn fused_equals_unfused() {
    let mut r = Random(7);
    for side in [1, 2, 3, 4] {
        for (name, config) in variants(side) {
            let call = call(&config, 8);
            for dtype in [DType::F64, DType::F32] {
                let p = parents(&call.cameras, &mut r).to_dtype(dtype).unwrap();
                let h = head(p.dim(0).unwrap(), side * side, 0.6, dtype, &mut r);
                let fused = spgr(&h, &p, &call).unwrap();
                let graph = spgr_reference::spgr(&h, &p, &call).unwrap();
                for lane in 0..11 {
                    let one = |t: &Tensor| t.narrow(1, lane, 1).unwrap();
                    let (d, scale) = difference(&one(&fused.0), &one(&graph.0));
                    let allowed = if dtype == DType::F64 { 1e-9 } else { 2e-4 };
                    assert!(
                        d <= allowed * scale,
                        "{name} {dtype:?} lane {lane}: {d:e} of {scale:e}"
                    );
                }
                assert_close(&fused.1, &graph.1, 1e-6);
            }
        }
    }
}

#[test]
fn unfused_gradients_match_differences() {
    let mut r = Random(8);
    for (name, config) in variants(2) {
        // The capped share of a disc step is a constant of the graph by decision: take
        // pixels so fine that nothing is capped. So is the growth of small footprints.
        let size = if name.contains("disc") { 64 } else { 8 };
        let mut config = config;
        if !name.contains("two axis") && !name.contains("a_min") {
            config.spgr.ablations.a_min = AMin::Off;
        } else if name.contains("px") || name.contains("in") || name.contains("two axis") {
            continue;
        }
        let mut call = call(&config, size);
        call.per_view = 3;
        let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
        let middle = size * size / 2 + size / 2;
        let of_view = |v: usize| p.narrow(0, v * size * size + middle, 3).unwrap();
        let p = Tensor::cat(&[of_view(0), of_view(1)], 0).unwrap();
        let h = head(6, 4, 0.4, DType::F64, &mut r);
        let f = |x: &[Tensor]| {
            let (rows, gain) = spgr_reference::spgr(&x[0], &x[1], &call)?;
            let gain = gain.reshape((24, ()))?;
            Tensor::cat(&[rows, gain], 1)
        };
        eprintln!("{name}");
        check_gradients(&[h, p], &f, 25, 2e-5, &mut r);
    }
}

#[test]
fn gradient_is_finite_at_the_initial_point() {
    for preset in [Preset::Paper, Preset::Tuned] {
        let config = Config::re10k(preset, 2);
        let call = call(&config, 8);
        let p = parents(&call.cameras, &mut Random(9));
        let zero = Tensor::zeros((128, 4, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
        let h = Var::from_tensor(&zero).unwrap();
        let (rows, gain) = spgr_reference::spgr(h.as_tensor(), &p, &call).unwrap();
        let loss = (rows.sqr().unwrap().sum_all().unwrap() + gain.sum_all().unwrap()).unwrap();
        let g = host(loss.backward().unwrap().get(&h).unwrap());
        assert!(g.iter().all(|v| v.is_finite()));
        for lane in 0..HEAD_STRIDE {
            // ∂‖q‖² = 0 along a rotation: only that triple may vanish.
            let any = g.iter().skip(lane).step_by(HEAD_STRIDE).any(|v| *v != 0.0);
            assert!(any || (6..9).contains(&lane), "lane {lane} has no gradient");
        }
    }
}

/// √det(J Σ Jᵀ) in f64 from the child's own numbers, by the determinant.
fn area_by_determinant(row: &[f64], camera: &Camera, zoom: f64) -> f64 {
    let q = glam::DQuat::from_xyzw(row[4], row[5], row[6], row[3]).normalize();
    let r = camera.rotation().as_dmat3().transpose() * DMat3::from_quat(q);
    let s = DMat3::from_diagonal(DVec3::new(row[7], row[8], row[9]));
    let sigma = r * s * s * r.transpose();
    let p = camera.rotation().as_dmat3().transpose()
        * (DVec3::new(row[0], row[1], row[2]) - camera.position().as_dvec3());
    let k = camera.intrinsics();
    let (fx, fy) = (zoom * f64::from(k.fx), zoom * f64::from(k.fy));
    let j = [
        DVec3::new(fx / p.z, 0.0, -fx * p.x / (p.z * p.z)),
        DVec3::new(0.0, fy / p.z, -fy * p.y / (p.z * p.z)),
    ];
    let c = |a: usize, b: usize| j[a].dot(sigma * j[b]);
    (c(0, 0) * c(1, 1) - c(0, 1) * c(1, 0)).sqrt()
}

#[test]
fn cross_form_of_the_area_equals_the_determinant() {
    // The linear rule with equal logits divides by the area: α_k·A_k is the same for
    // all children of a parent, so the rule's areas can be read off the result.
    let mut config = Config::re10k(Preset::Paper, 2);
    config.spgr.ablations.a_min = AMin::Off;
    config.spgr.primary_view = PrimaryView::Source;
    let call = call(&config, 8);
    let mut r = Random(11);
    let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
    let mut h = host(&head(128, 4, 0.3, DType::F64, &mut r));
    h.chunks_mut(HEAD_STRIDE).for_each(|c| c[9] = 0.0);
    let (rows, _) = spgr(&cpu(h, &[128, 4, HEAD_STRIDE]), &p, &call).unwrap();
    let rows = host(&rows);
    for (n, children) in rows.chunks(44).enumerate() {
        let camera = &call.cameras[n / 64];
        let mass = |row: &[f64]| row[10] * (area_by_determinant(row, camera, 2.0) + 1e-8);
        let first = mass(&children[..11]);
        for row in children.chunks(11) {
            // The pose is f32, hence orthonormal to 1e-7 only.
            assert!((mass(row) / first - 1.0).abs() < 2e-6, "parent {n}");
        }
    }
}

#[test]
fn areas_of_discs_seen_edge_on_survive_single_precision() {
    let mut config = Config::re10k(Preset::Paper, 2);
    config.spgr.ablations.a_min = AMin::Off;
    let call = call(&config, 8);
    let mut r = Random(21);
    let camera = &call.cameras[0];
    let mut worst = 0f64;
    for _ in 0..200 {
        // A disc a thousandth as thick as wide, its normal 90° ± 0.1° from the ray.
        let edge = std::f32::consts::FRAC_PI_2 + r.uniform(-0.002, 0.002) as f32;
        let q = Quat::from_mat3(&camera.rotation())
            * Quat::from_rotation_z(r.uniform(0.0, 6.0) as f32)
            * Quat::from_rotation_x(edge);
        let at = camera.position() + camera.rotation() * Vec3::new(0.1, -0.1, 3.0);
        let row = [at.x, at.y, at.z, q.w, q.x, q.y, q.z, 0.5, 0.5, 0.0005, 0.8];
        let p = cpu(row.iter().map(|&v| f64::from(v)).collect(), &[1, 11]);
        let mut h = r.normals(44, 0.1);
        h.chunks_mut(11).for_each(|c| (c[6], c[7], c[8]) = (1e-3 * c[6], 0.0, 0.0));
        let h = cpu(h, &[1, 4, 11]);
        let single = |t: &Tensor| t.to_dtype(DType::F32).unwrap();
        let exact = column(&spgr(&h, &p, &call).unwrap().0, 10);
        let got = column(&spgr(&single(&h), &single(&p), &call).unwrap().0, 10);
        for (a, b) in got.iter().zip(&exact) {
            worst = worst.max((a / b - 1.0).abs());
        }
    }
    assert!(worst < 1e-3, "{worst}");
}

#[test]
fn footprints_are_at_least_a_min() {
    for mode in [AMinMode::Iso, AMinMode::TwoAxis] {
        let mut config = Config::re10k(Preset::Tuned, 2);
        config.spgr.ablations.a_min = AMin::TargetPx(1.5);
        config.spgr.ablations.a_min_mode = mode;
        let call = call(&config, 8);
        let mut r = Random(12);
        let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
        let h = head(128, 4, 0.3, DType::F64, &mut r);
        let mut off = call.clone();
        off.rules.a_min = 0.0;
        let (rows, before) =
            (host(&spgr(&h, &p, &call).unwrap().0), host(&spgr(&h, &p, &off).unwrap().0));
        let mut grown = 0;
        for (i, (row, before)) in rows.chunks(11).zip(before.chunks(11)).enumerate() {
            let camera = &call.cameras[i / 256];
            let (area, was) =
                (area_by_determinant(row, camera, 2.0), area_by_determinant(before, camera, 2.0));
            if was < 1.5 {
                grown += 1;
                assert!((area - 1.5).abs() < 1e-6, "{mode:?} {area} was {was}");
                let same = (7..10).filter(|&l| row[l] == before[l]).count();
                assert_eq!(same, if mode == AMinMode::TwoAxis { 1 } else { 0 });
            } else {
                assert!((area - was).abs() < 1e-9);
            }
        }
        assert!(grown > 20, "{grown}");
    }
}

#[test]
fn ray_residuals_do_not_move_the_projection_and_axis_ones_drift() {
    for dir in [DepthDir::Ray, DepthDir::Axis] {
        let mut config = Config::re10k(Preset::Paper, 2);
        config.spgr.primary_view = PrimaryView::Source;
        config.spgr.depth_dir = dir;
        let call = call(&config, 8);
        let mut r = Random(13);
        let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
        let mut h = host(&head(128, 4, 0.5, DType::F64, &mut r));
        let (with, _) = spgr(&cpu(h.clone(), &[128, 4, 11]), &p, &call).unwrap();
        let residuals: Vec<f64> = h.chunks(11).map(|c| 0.25 * c[2].tanh()).collect();
        h.chunks_mut(11).for_each(|c| c[2] = 0.0);
        let (without, _) = spgr(&cpu(h, &[128, 4, 11]), &p, &call).unwrap();
        let (with, without) = (host(&with), host(&without));
        let mut largest = 0f32;
        for (i, (a, b)) in with.chunks(11).zip(without.chunks(11)).enumerate() {
            let camera = &call.cameras[i / 256];
            let (a, b) = (camera.to_camera(mean(a)), camera.to_camera(mean(b)));
            let k = camera.intrinsics();
            let moved = k.project(a) - k.project(b);
            let dz = residuals[i] as f32;
            assert!((a.z - b.z - dz).abs() < 1e-5);
            // f·x_n·(z/(z + Δ) − 1): the drift formula.
            let drift = Vec2::new(k.fx * b.x, k.fy * b.y) / b.z * (b.z / (b.z + dz) - 1.0);
            let expected = if dir == DepthDir::Ray { Vec2::ZERO } else { drift };
            largest = largest.max(drift.length());
            assert!((moved - expected).length() < 2e-4, "{dir:?} {moved} {expected}");
        }
        assert!(largest > 0.2, "the test scene does not drift: {largest}");
    }
}

#[test]
fn children_sit_on_the_sub_pixel_grid() {
    for side in [2, 3, 4] {
        for slide in [Slide::ZConst, Slide::Disc] {
            let mut config = Config::re10k(Preset::Tuned, side);
            config.spgr.ablations.slide = slide;
            let call = call(&config, 8);
            let p = parents(&call.cameras, &mut Random(14));
            let k = side * side;
            let zero = Tensor::zeros((128, k, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
            let rows = host(&spgr(&zero, &p, &call).unwrap().0);
            let own = host(&p);
            for (i, row) in rows.chunks(11).enumerate() {
                let camera = &call.cameras[i / k / 64];
                let place = |v: &[f64]| camera.project(mean(v)).unwrap();
                let offset = place(row) - place(&own[i / k * 11..i / k * 11 + 3]);
                let cell = Vec2::new((i % k % side) as f32, (i % k / side) as f32);
                let expected = (cell + 0.5) / side as f32 - 0.5;
                // A disc step projects exactly only to first order.
                let allowed = if slide == Slide::Disc { 0.06 } else { 1e-4 };
                assert!(
                    (offset - expected).length() < allowed,
                    "{side} {slide:?} {offset} {expected}"
                );
            }
        }
    }
}

#[test]
fn learned_residuals_have_their_units_and_bounds() {
    let mut config = Config::re10k(Preset::Tuned, 2);
    config.spgr.ablations.a_min = AMin::Off;
    config.spgr.beta_z = 5.0;
    config.spgr.ablations.gain_space = GainSpace::Rgb;
    let mut call = call(&config, 8);
    let p = parents(&call.cameras, &mut Random(22));
    let own = host(&p);
    let run = |call: &Spgr, lane: usize, value: f32| {
        let mut h = vec![0f32; 128 * 4 * HEAD_STRIDE];
        h.chunks_mut(HEAD_STRIDE).for_each(|c| c[lane] = value);
        let h = Tensor::from_vec(h, (128, 4, HEAD_STRIDE), &Device::Cpu).unwrap();
        let (rows, gain) = spgr(&h, &p, call).unwrap();
        (host(&rows), host(&gain))
    };
    let (rest, _) = run(&call, 9, 0.0);
    let offset = |rows: &[f64], i: usize, call: &Spgr| {
        let camera = &call.cameras[i / 256];
        let at = |r: &[f64]| camera.project(mean(&r[11 * i..])).unwrap();
        at(rows).x - at(&rest).x
    };
    // û = 30: half a sub-pixel, ρ/r = ¼ px_in, where bounded; û/r = 15 where not.
    let bounded = run(&call, 0, 30.0).0;
    call.rules.offset_bound = None;
    let free = run(&call, 0, 30.0).0;
    // Δz → −∞: a tenth of the parent's depth. Δlog s → ∞: λ_s·e³. γ̃ → −∞: 1 − δ.
    let near = run(&call, 2, -30.0).0;
    let large = run(&call, 3, 30.0).0;
    let (_, gain) = run(&call, 10, -30.0);
    for i in 0..512 {
        assert!((offset(&bounded, i, &call) - 0.25).abs() < 1e-4);
        assert!((offset(&free, i, &call) - 15.0).abs() < 1e-3);
        let camera = &call.cameras[i / 256];
        let z = |r: &[f64]| camera.to_camera(mean(r)).z;
        assert!((z(&near[11 * i..]) / z(&own[i / 4 * 11..]) - 0.1).abs() < 1e-4);
        assert!((large[11 * i + 7] / own[i / 4 * 11 + 7] / (0.5 * 3f64.exp()) - 1.0).abs() < 1e-5);
        assert_eq!(large[11 * i + 8], rest[11 * i + 8]);
        // γ(½ + Σ) = ½ + γΣ + (γ − 1)/2.
        assert_eq!(gain[4 * i..4 * i + 4], [0.75, -0.125, -0.125, -0.125]);
    }
}

#[test]
fn disc_steps_stay_on_the_disc_and_reduce_to_the_flat_step() {
    let mut config = Config::re10k(Preset::Tuned, 2);
    config.spgr.ablations.slide = Slide::Disc;
    let call = call(&config, 8);
    let camera = &call.cameras[0];
    // Discs in the source view's frame: one turned 40° about its x axis, one facing
    // the camera along its axis, at the image centre.
    for angle in [0.7f32, 0.0] {
        let local = Quat::from_rotation_x(angle);
        let q = Quat::from_mat3(&camera.rotation()) * local;
        let at = camera.position() + camera.rotation() * Vec3::new(0.0, 0.0, 3.0);
        let row: Vec<f64> = [at.x, at.y, at.z, q.w, q.x, q.y, q.z, 0.6, 0.6, 1e-7, 0.5]
            .iter()
            .map(|&v| f64::from(v))
            .collect();
        let p = cpu(row, &[1, 11]);
        let zero = Tensor::zeros((1, 4, HEAD_STRIDE), DType::F64, &Device::Cpu).unwrap();
        let disc = host(&spgr(&zero, &p, &call).unwrap().0);
        let normal = q * Vec3::Z;
        for row in disc.chunks(11) {
            let step = mean(row) - at;
            assert!(step.length() > 0.05);
            assert!(step.dot(normal).abs() < 1e-5 * step.length(), "{angle} {}", step.dot(normal));
        }
        let mut flat = call.clone();
        flat.rules.slide = Slide::ZConst;
        let flat = host(&spgr(&zero, &p, &flat).unwrap().0);
        let far = disc
            .chunks(11)
            .zip(flat.chunks(11))
            .fold(0f32, |m, (a, b)| m.max((mean(a) - mean(b)).length()));
        assert!(if angle == 0.0 { far < 1e-5 } else { far > 0.05 }, "{angle} {far}");
    }
}

#[test]
fn disc_steps_of_needles_survive_single_precision() {
    let mut config = Config::re10k(Preset::Tuned, 2);
    config.spgr.ablations.slide = Slide::Disc;
    let call = call(&config, 8);
    let camera = &call.cameras[0];
    let mut r = Random(31);
    let mut worst = 0f64;
    for _ in 0..200 {
        let axis = Vec3::new(r.normal() as f32, r.normal() as f32, r.normal() as f32);
        let q = Quat::from_axis_angle(axis.normalize(), r.uniform(0.0, 3.0) as f32);
        let at = camera.position() + camera.rotation() * Vec3::new(0.1, -0.1, 3.0);
        // A needle a thousand times as long as thick.
        let row = [at.x, at.y, at.z, q.w, q.x, q.y, q.z, 0.5, 5e-4, 5e-4, 0.8];
        let p = cpu(row.iter().map(|&v| f64::from(v)).collect(), &[1, 11]);
        let zero = Tensor::zeros((1, 4, HEAD_STRIDE), DType::F64, &Device::Cpu).unwrap();
        let single = |t: &Tensor| t.to_dtype(DType::F32).unwrap();
        let exact = host(&spgr(&zero, &p, &call).unwrap().0);
        let got = host(&spgr(&single(&zero), &single(&p), &call).unwrap().0);
        for (a, b) in got.chunks(11).zip(exact.chunks(11)) {
            let step = (mean(b) - at).length();
            worst = worst.max(f64::from((mean(a) - mean(b)).length() / step));
        }
    }
    assert!(worst < 1e-5, "{worst}");
}

#[test]
fn rotations_compose_in_the_parents_axes() {
    let config = Config::re10k(Preset::Tuned, 1);
    let call = call(&config, 8);
    let mut r = Random(15);
    let p = parents(&call.cameras, &mut r).to_dtype(DType::F64).unwrap();
    // From rotations of radians down to where θ underflows in f32.
    for scale in [1.0, 1e-2, 1e-3, 1e-4, 1e-8, 0.0] {
        let mut h = vec![0.0; 128 * HEAD_STRIDE];
        for c in h.chunks_mut(HEAD_STRIDE) {
            c[6..9].copy_from_slice(&r.normals(3, scale));
        }
        for dtype in [DType::F64, DType::F32] {
            let t = cpu(h.clone(), &[128, 1, HEAD_STRIDE]).to_dtype(dtype).unwrap();
            let (rows, _) = spgr(&t, &p.to_dtype(dtype).unwrap(), &call).unwrap();
            let (rows, own) = (host(&rows), host(&p));
            for ((row, own), h) in rows.chunks(11).zip(own.chunks(11)).zip(h.chunks(11)) {
                let quat = |v: &[f64]| glam::DQuat::from_xyzw(v[4], v[5], v[6], v[3]);
                let turn = glam::DQuat::from_scaled_axis(DVec3::new(h[6], h[7], h[8]));
                // R(q_k) = R(q_p)·R(Δr): the turn acts first, in the parent's axes.
                let want = DMat3::from_quat(quat(own).normalize()) * DMat3::from_quat(turn);
                let got = DMat3::from_quat(quat(row));
                let error = (want - got).to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
                assert!(error < if dtype == DType::F64 { 1e-7 } else { 1e-6 }, "{scale} {error}");
            }
        }
    }
}

#[test]
fn nearest_visible_view_places_the_children() {
    let mut config = Config::re10k(Preset::Paper, 2);
    config.spgr.beta_z = 0.0;
    let mut call = call(&config, 8);
    // View 1 is one unit closer to points in both pictures.
    let posed = |c: &Camera, pose| Camera::new(c.intrinsics(), pose).unwrap();
    let forward = glam::Mat4::from_translation(Vec3::new(0.0, 0.0, 1.0));
    call.cameras[1] = posed(&call.cameras[1], forward);
    call.cameras[0] = posed(&call.cameras[0], glam::Mat4::IDENTITY);
    call.per_view = 1;
    // A point in both pictures, one in that of view 0 only, one in neither.
    let points = [[0.0, 0.0, 3.0], [1.0, 0.0, 2.2], [0.0, 0.0, -2.0]];
    let pitch = |call: &Spgr, at: [f64; 3]| {
        let row = [at[0], at[1], at[2], 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.5];
        let p = cpu(row.to_vec(), &[1, 11]);
        let zero = Tensor::zeros((1, 4, HEAD_STRIDE), DType::F64, &Device::Cpu).unwrap();
        let rows = host(&spgr(&zero, &p, call).unwrap().0);
        (rows[11] - rows[0]) * f64::from(call.cameras[0].intrinsics().fx)
    };
    for first in [0, 1] {
        call.first = first;
        assert!((pitch(&call, points[0]) - 0.5 * 2.0).abs() < 1e-6, "nearest is view 1");
        assert!((pitch(&call, points[1]) - 0.5 * 2.2).abs() < 1e-6, "only view 0 sees it");
        assert!((pitch(&call, points[2]) - 0.5 * 0.01).abs() < 1e-6, "guarded source view");
    }
    call.rules.primary_view = PrimaryView::Source;
    call.first = 0;
    assert!((pitch(&call, points[0]) - 0.5 * 3.0).abs() < 1e-6, "source view 0");
}

#[test]
fn hostile_parents_give_finite_children_or_an_error() {
    let mut r = Random(16);
    let specials =
        [0.0, -0.0, 1e-30, -1e-30, 1e30, -1e30, 1e38, f64::NAN, f64::INFINITY, -5.0, 1e-7, 1e5];
    for (name, config) in variants(2) {
        let mut call = call(&config, 8);
        call.per_view = 1;
        let (mut finite, mut refused) = (0, 0);
        for round in 0..120 {
            let mut row = host(&parents(&call.cameras, &mut r).narrow(0, 5, 1).unwrap());
            let mut h: Vec<f64> = r.normals(44, 1.0);
            if round > 0 {
                let at = (r.bits() % 11) as usize;
                row[at] = specials[(r.bits() % 12) as usize];
                let at = (r.bits() % 44) as usize;
                h[at] = specials[(r.bits() % 12) as usize];
            }
            let p = cpu(row, &[1, 11]).to_dtype(DType::F32).unwrap();
            let h = cpu(h, &[1, 4, 11]).to_dtype(DType::F32).unwrap();
            match spgr(&h, &p, &call) {
                Ok((rows, gain)) => {
                    finite += 1;
                    let all = [host(&rows), host(&gain)].concat();
                    assert!(all.iter().all(|v| v.is_finite()), "{name}");
                }
                Err(e) => {
                    refused += 1;
                    assert!(e.to_string().contains("parent 0"), "{name}: {e}");
                }
            }
            let mut buffers = (vec![0f32; 44], vec![0f32; 4 * call.rules.gain_channels()]);
            let _ = spgr_into(&h, &p, &call, &mut buffers.0, &mut buffers.1);
        }
        assert!(finite > 20 && refused > 5, "{name}: {finite} finite, {refused} refused");
    }
}

#[test]
fn misfits_are_refused_by_name() {
    let call = call(&Config::x2(), 8);
    let p = parents(&call.cameras, &mut Random(17));
    let h = Tensor::zeros((128, 9, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
    let error = spgr(&h, &p, &call).unwrap_err().to_string();
    assert!(error.contains("[N, 4, 11]"), "{error}");
    let big = Spgr { rules: Rules { positions: Positions::new(81), ..call.rules }, ..call.clone() };
    let h = Tensor::zeros((128, 81, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
    assert!(spgr(&h, &p, &big).unwrap_err().to_string().contains("64"));
    let h = Tensor::zeros((128, 4, HEAD_STRIDE), DType::F32, &Device::Cpu).unwrap();
    let error = spgr_into(&h, &p, &call, &mut [0.0; 3], &mut []).unwrap_err().to_string();
    assert!(error.contains("buffers"), "{error}");
}
