use super::patch::{HIDDEN, PADDED, Patch};
use super::*;
use crate::scene::mask::Mask;
use glam::{DVec3, Mat4, Quat, Vec2, Vec3};
use subsplat_kernels::camera::Intrinsics;

const SIZE: usize = 72;

/// A smooth texture of a surface point, 0 to 1.
fn texture(p: DVec3) -> f64 {
    let wave = |a: f64, b: f64, c: f64| (a * p.x + b * p.y + c).sin();
    0.5 + 0.12
        * (wave(31.0, 7.0, 0.3)
            + wave(-11.0, 23.0, 1.0)
            + wave(57.0, -41.0, 2.0)
            + wave(5.0, 71.0, 0.7))
}

/// Cameras side by side, the second one turned a little.
fn cameras() -> [Camera; 2] {
    let k = Intrinsics { fx: 90.0, fy: 95.0, cx: 36.5, cy: 35.0, width: SIZE, height: SIZE };
    let pose =
        Mat4::from_rotation_translation(Quat::from_rotation_y(-0.04), Vec3::new(0.25, 0.03, 0.02));
    [Camera::new(k, Mat4::IDENTITY).unwrap(), Camera::new(k, pose).unwrap()]
}

/// Camera z of the plane n·p = 1 at each pixel, and the picture of its texture.
fn seen(camera: &Camera, normal: Vec3) -> (Vec<f32>, GrayImage) {
    let k = camera.intrinsics();
    let (mut depth, mut picture) = (Vec::new(), Vec::new());
    for i in 0..SIZE * SIZE {
        let px = Vec2::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5);
        let ray = camera.rotation() * k.unproject(px);
        let z = (1.0 - normal.dot(camera.position())) / normal.dot(ray);
        depth.push(z);
        picture.push(texture((camera.position() + z * ray).as_dvec3()) as f32);
    }
    (depth, GrayImage::new(SIZE, SIZE, picture).unwrap())
}

const NORMAL: Vec3 = Vec3::new(0.08, -0.05, 0.4);

fn views<'a>(
    pictures: &'a [GrayImage; 2],
    cameras: &'a [Camera; 2],
    depths: &'a [Vec<f32>; 2],
) -> [DenseView<'a>; 2] {
    [0, 1].map(|i| DenseView {
        picture: &pictures[i],
        camera: &cameras[i],
        depth: &depths[i],
        sources: if i == 0 { &[1] } else { &[0] },
    })
}

fn run(views: &[DenseView<'_>]) -> Vec<DenseMatch> {
    let range = NearFar { near: 1.0, far: 6.0 };
    match_depth(views, range, &mut |_| ControlFlow::Continue(())).unwrap()
}

/// A picture of a place that no other photograph shows.
fn noise(seed: u64) -> GrayImage {
    let value =
        |i: u64| (subsplat_kernels::layout::random::mix(seed + i) >> 40) as f32 / 2f32.powi(24);
    GrayImage::new(SIZE, SIZE, (0..(SIZE * SIZE) as u64).map(value).collect()).unwrap()
}

/// Relative error of the depths after the match, sorted, of the pixels that `of` takes.
fn errors(
    found: &DenseMatch,
    first: &[f32],
    truth: &[f32],
    of: impl Fn(usize) -> bool,
) -> Vec<f32> {
    let pixels = (0..truth.len()).filter(|i| of(*i));
    let mut all: Vec<f32> =
        pixels.map(|i| (found.factor[i] * first[i] / truth[i] - 1.0).abs()).collect();
    all.sort_by(f32::total_cmp);
    all
}

#[test]
fn the_depth_of_a_tilted_plane_is_found() {
    let cameras = cameras();
    let [(a, pa), (b, pb)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let (truth, pictures) = ([a, b], [pa, pb]);
    // Off by up to 12 %, more than two pixels.
    let wrong = |truth: &[f32]| -> Vec<f32> {
        let error = |i: usize| 1.0 + 0.12 * ((i % SIZE) as f32 / 9.0).sin();
        truth.iter().enumerate().map(|(i, z)| z * error(i)).collect()
    };
    let first = [wrong(&truth[0]), wrong(&truth[1])];
    let found = run(&views(&pictures, &cameras, &first));
    for v in 0..2 {
        let certain = &found[v].certain;
        let share = certain.iter().filter(|c| **c).count() as f32 / certain.len() as f32;
        let errors = errors(&found[v], &first[v], &truth[v], |i| certain[i]);
        let at = |share: f32| errors[(share * errors.len() as f32) as usize];
        assert!(share > 0.7, "{share}");
        assert!(at(0.5) < 0.004 && at(0.95) < 0.015, "{} {}", at(0.5), at(0.95));
    }
    // The first view reaches beyond the second one at its left edge.
    let shown = |i: usize| {
        let px = Vec2::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5);
        let p = cameras[0].intrinsics().unproject(px) * truth[0][i];
        cameras[1].project(p).is_some_and(|q| q.x > -1.0 && q.y > -1.0 && q.x < 73.0 && q.y < 73.0)
    };
    let hidden = (0..SIZE * SIZE).filter(|i| !shown(*i));
    let (mut count, mut wrong) = (0, 0);
    for i in hidden {
        count += 1;
        wrong += usize::from(found[0].certain[i]);
    }
    assert!(count > 100 && wrong == 0, "{wrong} of {count}");
}

#[test]
fn sources_that_show_other_places_do_not_disturb() {
    let [a, b] = cameras();
    let [(da, pa), (db, pb)] = [&a, &b].map(|camera| seen(camera, NORMAL));
    let others = [noise(1 << 20), noise(1 << 40)];
    let first: Vec<f32> = da.iter().map(|z| 1.08 * z).collect();
    let view = |picture, camera, depth, sources| DenseView { picture, camera, depth, sources };
    let views = [
        view(&pa, &a, &first, &[1, 2, 3]),
        view(&pb, &b, &db, &[0]),
        view(&others[0], &b, &db, &[0]),
        view(&others[1], &b, &db, &[0]),
    ];
    let found = run(&views);
    let certain = &found[0].certain;
    let share = certain.iter().filter(|c| **c).count() as f32 / certain.len() as f32;
    let errors = errors(&found[0], &first, &da, |i| certain[i]);
    let at = |share: f32| errors[(share * errors.len() as f32) as usize];
    assert!(share > 0.6, "{share}");
    assert!(at(0.5) < 0.005 && at(0.85) < 0.015, "{} {}", at(0.5), at(0.85));
}

#[test]
fn pictures_of_other_places_change_nothing() {
    let cameras = cameras();
    let [(a, _), (b, _)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let first = [a, b];
    let found = run(&views(&[noise(1 << 20), noise(1 << 40)], &cameras, &first));
    for one in &found {
        let share = one.certain.iter().filter(|c| **c).count() as f32 / one.certain.len() as f32;
        assert!(share < 0.08, "{share}");
    }
    // An even surface has no certain depth either.
    let even = || GrayImage::new(SIZE, SIZE, vec![0.5; SIZE * SIZE]).unwrap();
    let found = run(&views(&[even(), even()], &cameras, &first));
    assert!(found.iter().all(|one| one.factor.iter().all(|f| *f == 1.0)));
}

#[test]
fn broken_depths_stay_and_a_break_ends() {
    let cameras = cameras();
    let [(a, pa), (b, pb)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let pictures = [pa, pb];
    let mut first = [a, b];
    first[0][5] = f32::NAN;
    first[0][6] = -1.0;
    first[0][7] = 0.0;
    let found = run(&views(&pictures, &cameras, &first));
    assert!(found[0].factor.iter().all(|f| f.is_finite() && *f > 0.0));
    let short = [first[0].clone(), first[1][..10].to_vec()];
    let found = run(&views(&pictures, &cameras, &short));
    assert_eq!(
        (found[1].factor.as_slice(), found[1].certain.as_slice()),
        (&[1.0; 10][..], &[false; 10][..])
    );
    let views = views(&pictures, &cameras, &first);
    let range = NearFar { near: 1.0, far: 6.0 };
    assert!(match_depth(&views, range, &mut |_| ControlFlow::Break(())).is_none());
}

/// Depth is not matched at masked pixels, nor with those of the other photograph.
#[test]
fn masked_pixels_match_nothing() {
    let cameras = cameras();
    let [(a, pa), (b, pb)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let truth = [a, b];
    let wrong = |truth: &[f32]| truth.iter().map(|z| 1.05 * z).collect::<Vec<f32>>();
    let first = [wrong(&truth[0]), wrong(&truth[1])];
    // Something else stands before the second camera.
    let inside = |x: f32, y: f32| x > 20.0 && x < 50.0 && y > 15.0 && y < 45.0;
    let masked: Vec<bool> = (0..SIZE * SIZE)
        .map(|i| inside((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5))
        .collect();
    let pixels = pb.pixels().iter().zip(&masked).enumerate();
    let pixels = pixels.map(|(i, (v, masked))| if *masked { (i % 3) as f32 / 2.0 } else { *v });
    let pb = GrayImage::new(SIZE, SIZE, pixels.collect()).unwrap();
    let kept = masked.iter().map(|masked| !masked).collect();
    let pb = pb.masked(Mask::new(SIZE, SIZE, kept).unwrap());
    let found = run(&views(&[pa, pb], &cameras, &first));
    let there = |i: usize| {
        let px = Vec2::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5);
        cameras[1].project(cameras[0].intrinsics().unproject(px) * truth[0][i])
    };
    let mut counts = [0; 2];
    for (i, masked) in masked.iter().enumerate() {
        assert!(!(*masked && found[1].certain[i]), "{i}");
        if there(i).is_some_and(|p| inside(p.x, p.y)) {
            counts[0] += 1;
            counts[1] += usize::from(found[0].certain[i]);
        }
    }
    assert!(counts[0] > 500 && 20 * counts[1] < counts[0], "{counts:?}");
    for v in 0..2 {
        let errors = errors(&found[v], &first[v], &truth[v], |i| found[v].certain[i]);
        assert!(errors.len() > 1500, "{}", errors.len());
        let at = |share: f32| errors[(share * errors.len() as f32) as usize];
        assert!(at(0.5) < 0.004 && at(0.95) < 0.02, "{} {}", at(0.5), at(0.95));
    }
}

#[test]
fn threads_do_not_change_the_result() {
    let cameras = cameras();
    let [(a, pa), (b, pb)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let (pictures, first) = ([pa, pb], [a, b]);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&views(&pictures, &cameras, &first)))
    };
    assert_eq!(with(1), with(3));
}

/// The definition in f64: samples on the plane in space, projected by the camera, bilinear values, weighted
/// correlation.
fn difference(
    picture: &GrayImage,
    cameras: &[Camera; 2],
    source: &GrayImage,
    [x, y]: [usize; 2],
    inverse: f64,
    slopes: [f64; 2],
) -> f64 {
    let weights = Patch::weights(picture, x, y);
    let mut samples = Vec::new();
    for (i, weight) in weights.iter().enumerate() {
        let (dx, dy) = (2.0 * (i % 5) as f64 - 4.0, 2.0 * (i / 5) as f64 - 4.0);
        if *weight == 0.0 {
            continue;
        }
        let z = 1.0 / (inverse + slopes[0] * dx + slopes[1] * dy);
        let px = Vec2::new((x as f64 + 0.5 + dx) as f32, (y as f64 + 0.5 + dy) as f32);
        let point = cameras[0].intrinsics().unproject(px) * z as f32;
        let Some(at) = cameras[1].project(point) else { continue };
        let (u, v) = (f64::from(at.x) - 0.5, f64::from(at.y) - 0.5);
        let last = (SIZE - 1) as f64;
        if !(0.0..=last).contains(&u) || !(0.0..=last).contains(&v) {
            continue;
        }
        let value = |x: f64, y: f64| {
            f64::from(source.row((y as usize).min(SIZE - 1))[(x as usize).min(SIZE - 1)])
        };
        let (fx, fy) = (u - u.floor(), v - v.floor());
        let (x0, y0) = (u.floor(), v.floor());
        let upper = value(x0, y0) * (1.0 - fx) + value(x0 + 1.0, y0) * fx;
        let lower = value(x0, y0 + 1.0) * (1.0 - fx) + value(x0 + 1.0, y0 + 1.0) * fx;
        let own = picture.row((y as f64 + dy) as usize)[(x as f64 + dx) as usize];
        samples.push((f64::from(*weight), f64::from(own), upper * (1.0 - fy) + lower * fy));
    }
    let all: f64 = weights.iter().copied().map(f64::from).sum();
    let weight: f64 = samples.iter().map(|s| s.0).sum();
    if weight <= 0.5 * all {
        return f64::from(HIDDEN);
    }
    let mean = |f: &dyn Fn(&(f64, f64, f64)) -> f64| {
        samples.iter().map(|s| s.0 * f(s)).sum::<f64>() / weight
    };
    let (a, b) = (mean(&|s| s.1), mean(&|s| s.2));
    let floor = 4e-5;
    let (va, vb) = (mean(&|s| (s.1 - a).powi(2)) + floor, mean(&|s| (s.2 - b).powi(2)) + floor);
    1.0 - mean(&|s| (s.1 - a) * (s.2 - b)) / (va * vb).sqrt()
}

#[test]
fn the_difference_is_that_of_its_definition() {
    const { assert!(PADDED >= patch::SAMPLES) };
    let cameras = cameras();
    let [(depth, picture), (_, source)] = [0, 1].map(|i| seen(&cameras[i], NORMAL));
    let warp = Warp::new(&cameras[0], &cameras[1]);
    let (mut shown, mut hidden) = (0, 0);
    for i in (0..SIZE * SIZE).step_by(37) {
        let (x, y) = (i % SIZE, i / SIZE);
        for (factor, slopes) in [(1.0, [0.0, 0.0]), (1.07, [0.002, -0.003]), (0.4, [0.0, 0.001])] {
            let inverse = factor / depth[i];
            let patch = Patch::new(&picture, x, y, &Patch::weights(&picture, x, y));
            let found = patch.difference(&warp, &source, inverse, slopes);
            let expected = difference(
                &picture,
                &cameras,
                &source,
                [x, y],
                f64::from(inverse),
                slopes.map(f64::from),
            );
            assert!(
                (f64::from(found) - expected).abs() < 2e-3,
                "{x} {y} {factor}: {found} {expected}"
            );
            let count = if found == HIDDEN { &mut hidden } else { &mut shown };
            *count += 1;
        }
    }
    assert!(shown > 200 && hidden > 10, "{shown} {hidden}");
}
