//! Tests of `check_pair` on ray-traced scenes of exactly known geometry.

use glam::{Mat4, Quat, Vec3};
use subsplat::cameras::check::{CheckOptions, GrayImage, PairReport, Verdict, check_pair};
use subsplat_kernels::camera::{Camera, Intrinsics};

const W: usize = 480;
const H: usize = 360;

fn intrinsics() -> Intrinsics {
    Intrinsics { fx: 420.0, fy: 430.0, cx: 250.0, cy: 170.0, width: W, height: H }
}

fn posed(yaw: f32, pitch: f32, eye: Vec3) -> Camera {
    let turn = Quat::from_rotation_y(yaw) * Quat::from_rotation_x(pitch);
    Camera::new(intrinsics(), Mat4::from_rotation_translation(turn, eye)).unwrap()
}

/// Returns smooth noise of four octaves from a hash of the lattice, about 0 to 1.
fn texture(u: f32, v: f32, seed: u32) -> f32 {
    let lattice = |x: i32, y: i32| {
        let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77);
        h = (h ^ seed ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
        h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
        ((h ^ (h >> 15)) >> 8) as f32 / (1u32 << 24) as f32
    };
    let octave = |s: f32| {
        let (x, y) = (u * s, v * s);
        let (i, j) = (x.floor(), y.floor());
        let ease = |t: f32| t * t * (3.0 - 2.0 * t);
        let (a, b) = (ease(x - i), ease(y - j));
        let (i, j) = (i as i32, j as i32);
        let top = lattice(i, j) * (1.0 - a) + lattice(i + 1, j) * a;
        let bottom = lattice(i, j + 1) * (1.0 - a) + lattice(i + 1, j + 1) * a;
        top * (1.0 - b) + bottom * b
    };
    0.4 * octave(3.0) + 0.3 * octave(7.0) + 0.2 * octave(15.0) + 0.1 * octave(29.0)
}

/// Returns the colour at the first hit of a ray: a wall at z = 6, a floor at y = 1.5, a box's front
/// at z = 4.
fn trace(eye: Vec3, ray: Vec3) -> f32 {
    let mut nearest = (f32::INFINITY, 0.5);
    let mut hit = |t: f32, inside: bool, value: f32| {
        if t > 0.0 && inside && t < nearest.0 {
            nearest = (t, value);
        }
    };
    let t = (6.0 - eye.z) / ray.z;
    let p = eye + ray * t;
    hit(t, true, texture(p.x, p.y, 1));
    let t = (1.5 - eye.y) / ray.y;
    let p = eye + ray * t;
    hit(t, true, texture(p.x, p.z, 2));
    let t = (4.0 - eye.z) / ray.z;
    let p = eye + ray * t;
    hit(t, p.x.abs() < 1.0 && p.y.abs() < 0.8, texture(p.x, p.y, 3));
    nearest.1
}

fn render(camera: &Camera) -> GrayImage {
    let value = |i: usize| {
        let taps = (0..9).map(|s| {
            let x = (i % W) as f32 + ((s % 3) as f32 + 0.5) / 3.0;
            let y = (i / W) as f32 + ((s / 3) as f32 + 0.5) / 3.0;
            let ray = camera.rotation() * camera.intrinsics().unproject(glam::Vec2::new(x, y));
            trace(camera.position(), ray)
        });
        taps.sum::<f32>() / 9.0
    };
    GrayImage::new(W, H, (0..W * H).map(value).collect()).unwrap()
}

fn check_rendered(a: &Camera, b: &Camera) -> PairReport {
    check_pair(&render(a), a, &render(b), b, &CheckOptions::default())
}

#[test]
fn known_geometry_is_measured() {
    let a = posed(0.05, 0.02, Vec3::new(-0.4, 0.0, 0.0));
    let b = posed(-0.10, 0.0, Vec3::new(0.4, -0.1, 0.2));
    let report = check_rendered(&a, &b);
    assert_eq!(report.verdict, Verdict::Ok, "{:?}", report.findings);
    let epipolar = report.epipolar.unwrap();
    println!("rendered: {} matches, {epipolar:?}", report.matches);
    assert!(epipolar.median_px.unwrap() < 0.5);
    assert!(report.consistent_matches > 100 && epipolar.inlier_share > 0.8);
    assert!(epipolar.in_front_share > 0.99);
    assert!((report.baseline - a.position().distance(b.position())).abs() < 1e-4);
    assert!((report.rotation_deg - 8.7).abs() < 0.1, "{}", report.rotation_deg);
    let depth = report.depth.unwrap();
    // The floor begins at z = 3.3 at the lower edge of the picture; the wall is at 6.
    assert!((3.0..4.5).contains(&depth.quantiles[0]), "{depth:?}");
    assert!((5.6..6.5).contains(&depth.quantiles[4]), "{depth:?}");
    // Share of the first picture's rays whose surface point the second camera sees.
    let [first, second] = report.overlap.unwrap();
    for (measured, from, to) in [(first, &a, &b), (second, &b, &a)] {
        let truth = true_overlap(from, to);
        assert!((measured - truth).abs() < 0.06, "{measured} {truth}");
    }
    assert!(report.points.iter().filter(|p| p.consistent).all(|p| p.a[0] < W as f32));
}

/// Computes the overlap by ray tracing, without occlusion.
fn true_overlap(from: &Camera, to: &Camera) -> f32 {
    let mut visible = 0;
    for i in 0..(W / 4) * (H / 4) {
        let px = glam::Vec2::new((i % (W / 4) * 4) as f32, (i / (W / 4) * 4) as f32);
        let ray = from.rotation() * from.intrinsics().unproject(px);
        let eye = from.position();
        let mut t = (6.0 - eye.z) / ray.z;
        let floor = (1.5 - eye.y) / ray.y;
        t = if floor > 0.0 { t.min(floor) } else { t };
        let face = eye + ray * ((4.0 - eye.z) / ray.z);
        if face.x.abs() < 1.0 && face.y.abs() < 0.8 {
            t = t.min((4.0 - eye.z) / ray.z);
        }
        let inside = to
            .project(eye + ray * t)
            .is_some_and(|p| p.x >= 0.0 && p.y >= 0.0 && p.x <= W as f32 && p.y <= H as f32);
        visible += usize::from(inside);
    }
    visible as f32 / ((W / 4) * (H / 4)) as f32
}

#[test]
fn pairs_without_depth_are_refused() {
    let a = posed(0.0, 0.0, Vec3::ZERO);
    let b = posed(0.05, 0.0, Vec3::new(0.5, 0.0, 0.0));
    let (first, second) = (render(&a), render(&b));
    let options = CheckOptions::default();

    let report = check_pair(&first, &a, &first, &b, &options);
    assert!(report.has("same_photograph") && report.verdict == Verdict::Bad);

    let report = check_pair(&first, &a, &second, &a, &options);
    assert!(report.has("same_camera") && report.verdict == Verdict::Bad, "{:?}", report.findings);
    assert!(report.epipolar.is_none_or(|e| e.median_px.is_none()));
    assert!(serde_json::to_string(&report).is_ok());

    let near = posed(0.05, 0.0, Vec3::new(0.02, 0.0, 0.0));
    let report = check_rendered(&a, &near);
    assert!(report.has("small_baseline"), "{:?}", report.findings);
    assert_eq!(report.verdict, Verdict::Warning);
}

/// A wrong rotation can cancel the parallax of most points. The baseline is then not the fault.
#[test]
fn a_wrong_rotation_is_no_small_baseline() {
    let a = posed(0.0, 0.0, Vec3::ZERO);
    let eye = Vec3::new(0.3, 0.0, 0.0);
    let (first, second) = (render(&a), render(&posed(0.0, 0.0, eye)));
    let options = CheckOptions::default();
    let mut doubtful = 0;
    for i in 0..12 {
        let turned = posed(0.01 * i as f32, 0.0, eye);
        let report = check_pair(&first, &a, &second, &turned, &options);
        println!("{i} {:?} {:?}", report.depth, report.findings);
        assert!(!report.has("small_baseline"), "{:?}", report.findings);
        doubtful += usize::from(report.has("rotation_doubtful"));
        if report.has("rotation_doubtful") {
            assert_eq!(report.verdict, Verdict::Warning);
            assert!(!report.has("poses_imprecise") && !report.has("poses_wrong"));
        }
    }
    assert!(doubtful > 0);
}

#[test]
fn cameras_without_common_content_are_refused() {
    let a = posed(0.0, 0.0, Vec3::ZERO);
    let away = posed(std::f32::consts::PI, 0.0, Vec3::new(0.5, 0.0, 0.0));
    let wall = GrayImage::new(W, H, vec![0.5; W * H]).unwrap();
    let report = check_pair(&render(&a), &a, &wall, &away, &CheckOptions::default());
    assert!(report.has("no_overlap") && report.verdict == Verdict::Bad, "{:?}", report.findings);
    // Half a field of view apart, both directed at texture: a small overlap.
    let aside = posed(0.68, 0.0, Vec3::new(0.3, 0.0, 0.0));
    let report = check_rendered(&a, &aside);
    assert!(report.has("little_overlap"), "{:?} {:?}", report.overlap, report.findings);
    assert_eq!(report.verdict, Verdict::Warning);
}

#[test]
fn implausible_sizes_intrinsics_and_exposures_are_reported() {
    let a = posed(0.0, 0.0, Vec3::ZERO);
    let b = posed(0.03, 0.0, Vec3::new(0.5, 0.0, 0.0));
    let (first, second) = (render(&a), render(&b));
    let options = CheckOptions::default();

    // Intrinsics of twice the size fit after scaling; of another aspect they do not.
    let report = check_pair(&first, &a.resized(2 * W, 2 * H).unwrap(), &second, &b, &options);
    assert_eq!((report.verdict, report.has("size_differs")), (Verdict::Warning, true));
    let report = check_pair(&first, &a.resized(W, W).unwrap(), &second, &b, &options);
    assert_eq!((report.verdict, report.has("size_differs")), (Verdict::Bad, true));

    let normalised = |c: &Camera| {
        let [fx, fy, cx, cy] = c.intrinsics().normalised();
        c.with_intrinsics(Intrinsics { fx, fy, cx, cy, ..c.intrinsics() }).unwrap()
    };
    let report = check_pair(&first, &normalised(&a), &second, &normalised(&b), &options);
    assert!(report.has("intrinsics_normalised") && report.verdict == Verdict::Bad);
    assert_eq!(report.readings.first().map(|r| r.name.as_str()), Some("normalised"));

    let odd = |f: f32, c: f32| {
        let k = a.intrinsics();
        let k = Intrinsics { fx: f * k.fx, fy: f * k.fy, cx: c * k.cx, cy: c * k.cy, ..k };
        check_pair(&first, &a.with_intrinsics(k).unwrap(), &second, &b, &options)
    };
    assert!(odd(10.0, 1.0).has("field_of_view") && odd(0.2, 1.0).has("field_of_view"));
    assert!(odd(0.5, 0.5).has("principal_point"));

    let dark: Vec<f32> = second.pixels().iter().map(|v| 0.6 * v).collect();
    let dark = GrayImage::new(W, H, dark).unwrap();
    let report = check_pair(&first, &a, &dark, &b, &options);
    assert!(report.has("brightness") && report.verdict == Verdict::Warning);
    assert!(report.brightness_difference < -0.12);

    // One pixel, and no texture at all: few matches, no panic.
    let dot = GrayImage::new(1, 1, vec![0.5]).unwrap();
    let flat = GrayImage::new(W, H, vec![0.5; W * H]).unwrap();
    for (x, y) in [(&dot, &flat), (&flat, &dot), (&first, &flat)] {
        let report = check_pair(x, &a, y, &b, &options);
        assert!(report.has("few_matches"));
    }
}

#[test]
fn a_photograph_rolled_with_its_camera_is_matched() {
    let a = posed(0.0, 0.0, Vec3::ZERO);
    let mut b = posed(-0.05, 0.0, Vec3::new(0.6, 0.0, 0.0));
    b = Camera::new(b.intrinsics(), b.world_from_camera() * Mat4::from_rotation_z(1.4)).unwrap();
    let report = check_rendered(&a, &b);
    println!("rolled: {} of {} matches", report.consistent_matches, report.matches);
    assert!(report.consistent_matches > 100, "{:?}", report.findings);
    assert_eq!(report.verdict, Verdict::Ok, "{:?}", report.findings);
}
