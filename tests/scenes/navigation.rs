//! Tests of the interactive camera: motion under the cursor, invariants, and validity for any
//! input.

use glam::{Mat4, Quat, Vec2, Vec3};
use std::f32::consts::PI;
use subsplat::scene::navigation::{Bounds, Mode, Navigator, Pace, Start, fitted, up_of};
use subsplat_kernels::camera::{Camera, Intrinsics};

const UP: Vec3 = Vec3::NEG_Y;

fn home() -> Camera {
    let k = Intrinsics { fx: 500.0, fy: 520.0, cx: 330.0, cy: 235.0, width: 640, height: 480 };
    // Pitched down slightly, without roll: x remains perpendicular to up.
    let turn = Quat::from_rotation_y(0.4) * Quat::from_rotation_x(-0.2);
    Camera::new(k, Mat4::from_rotation_translation(turn, Vec3::new(1.0, -2.0, 3.0))).unwrap()
}

fn start() -> Start {
    Start { home: home(), up: UP, distance: 5.0, radius: 2.0 }
}

/// Projects a world point into the navigator's camera, px.
fn projected(n: &Navigator, world: Vec3) -> Vec2 {
    n.camera().project(world).unwrap()
}

/// Returns a point on the optical axis of the home camera.
fn on_axis(depth: f32) -> Vec3 {
    home().world_from_camera().transform_point3(Vec3::new(0.0, 0.0, depth))
}

fn close(a: Vec3, b: Vec3) -> bool {
    a.distance(b) < 2e-5 * (1.0 + b.length())
}

#[test]
fn at_home_the_camera_is_the_first_camera() {
    let n = Navigator::new(start());
    let (got, want) = (n.camera(), home());
    assert_eq!(got.intrinsics(), want.intrinsics());
    assert!(
        (got.world_from_camera() - want.world_from_camera())
            .to_cols_array()
            .iter()
            .all(|v| v.abs() < 1e-6)
    );
    assert!(close(n.pivot(), on_axis(5.0)));
    assert_eq!(n.mode(), Mode::Orbit);
}

#[test]
fn orbit_rotates_around_the_pivot_and_keeps_the_horizon() {
    let mut n = Navigator::new(start());
    let pivot = n.pivot();
    for px in [Vec2::new(37.0, -20.0), Vec2::new(-260.0, 41.0), Vec2::new(5.0, 90.0)] {
        n.rotate(px);
        let c = n.camera();
        let k = c.intrinsics();
        assert!((projected(&n, pivot) - Vec2::new(k.cx, k.cy)).length() < 0.01);
        assert!((c.position().distance(pivot) - 5.0).abs() < 1e-4);
        assert!(c.rotation().x_axis.dot(UP).abs() < 1e-5, "roll");
    }
    // A drag over the height of the picture rotates by 180°.
    let mut n = Navigator::new(start());
    n.rotate(Vec2::new(480.0, 0.0));
    let (from, to) = (home().position() - pivot, n.camera().position() - pivot);
    assert!(close(from - from.dot(UP) * UP, -(to - to.dot(UP) * UP)));
    assert!((from.dot(UP) - to.dot(UP)).abs() < 1e-4);
}

#[test]
fn near_points_follow_the_cursor_in_orbit_and_the_view_in_flight() {
    let (near, far) = (on_axis(3.0), on_axis(9.0));
    for (px, axis) in [(Vec2::new(20.0, 0.0), Vec2::X), (Vec2::new(0.0, 20.0), Vec2::Y)] {
        let mut n = Navigator::new(start());
        let before = projected(&n, near);
        n.rotate(px);
        assert!((projected(&n, near) - before).dot(axis) > 3.0, "orbit, {px}");
        assert!((projected(&n, far) - before).dot(axis) < -3.0, "orbit, {px}");
        let mut n = Navigator::new(start());
        n.toggle();
        n.rotate(px);
        assert!((projected(&n, near) - before).dot(axis) < -3.0, "fly, {px}");
        assert!(close(n.camera().position(), home().position()));
    }
}

#[test]
fn the_camera_is_never_upside_down() {
    for mode in [Mode::Orbit, Mode::Fly] {
        for sign in [1.0, -1.0] {
            let mut n = Navigator::new(start());
            if mode == Mode::Fly {
                n.toggle();
            }
            for _ in 0..40 {
                n.rotate(Vec2::new(3.0, sign * 100.0));
            }
            let r = n.camera().rotation();
            assert!(r.y_axis.dot(UP) < 0.0, "head up");
            let elevation = r.z_axis.dot(UP).asin();
            assert!((elevation + sign * 89.0 * PI / 180.0).abs() < 0.01, "{elevation}");
            // The limit is reversible.
            n.rotate(Vec2::new(0.0, -sign * 240.0));
            let elevation = n.camera().rotation().z_axis.dot(UP).asin();
            assert!((elevation - sign * 1.0 * PI / 180.0).abs() < 0.01, "{elevation}");
        }
    }
    // A home camera pitched beyond the limit is unchanged.
    let down = Mat4::from_rotation_translation(Quat::from_rotation_x(-0.5 * PI), Vec3::ZERO);
    let home = Camera::new(home().intrinsics(), down).unwrap();
    let mut n = Navigator::new(Start { home, ..start() });
    n.rotate(Vec2::new(0.0, 50.0));
    assert!(n.camera().rotation().z_axis.dot(Vec3::Y) > 0.9999);
    n.rotate(Vec2::new(0.0, -480.0 / 6.0));
    assert!((n.camera().rotation().z_axis.dot(Vec3::Y).asin() - PI / 3.0).abs() < 0.01);
}

#[test]
fn a_pan_moves_points_at_the_pivots_depth_with_the_cursor() {
    let mut n = Navigator::new(start());
    let (point, other) = (n.pivot() + 0.3 * home().rotation().x_axis, n.pivot());
    let px = Vec2::new(41.0, -17.0);
    let (before, middle) = (projected(&n, point), projected(&n, other));
    n.pan(px);
    assert!((projected(&n, point) - before - px).length() < 0.01);
    assert!((projected(&n, other) - middle - px).length() < 0.01);
    assert!(close(n.camera().rotation().z_axis, home().rotation().z_axis));
}

#[test]
fn the_wheel_approaches_the_pivot_without_passing_it() {
    let mut n = Navigator::new(start());
    let pivot = n.pivot();
    n.wheel(1.0);
    assert!(close(n.pivot(), pivot));
    assert!((n.camera().position().distance(pivot) - 4.5).abs() < 1e-4);
    n.wheel(-1.0);
    assert!(close(n.camera().position(), home().position()));
    // Radius 2: from a thousandth of it to a thousand times it.
    for (steps, end) in [(1e4, 2e-3), (-1e4, 2e3)] {
        n.wheel(steps);
        assert!((n.camera().position().distance(n.pivot()) / end - 1.0).abs() < 0.2, "{steps}");
        assert!(n.pivot().distance(pivot) < 1e-2);
    }
}

#[test]
fn flight_depends_on_time_and_not_on_frames() {
    let fly = |n: &mut Navigator, along: [f32; 3], seconds: f32, fast| {
        let from = n.camera().position();
        n.fly(along, seconds, fast);
        n.camera().position() - from
    };
    let axes = home().rotation();
    let mut n = Navigator::new(start());
    let ahead = fly(&mut n, [0.0, 0.0, 1.0], 0.5, Pace::Normal);
    // 0.4 radii a second.
    assert!(close(ahead, 0.4 * axes.z_axis), "{ahead}");
    let twice = fly(&mut n, [0.0, 0.0, 1.0], 0.25, Pace::Normal)
        + fly(&mut n, [0.0, 0.0, 1.0], 0.25, Pace::Normal);
    assert!(close(twice, ahead));
    assert!(close(fly(&mut n, [0.0, 0.0, -1.0], 0.5, Pace::Fast), -4.0 * ahead));
    assert!(close(fly(&mut n, [1.0, 0.0, 0.0], 0.5, Pace::Normal), 0.4 * axes.x_axis));
    assert!(close(fly(&mut n, [0.0, 1.0, 0.0], 0.5, Pace::Normal), 0.4 * UP));
    assert!(
        (fly(&mut n, [1.0, 0.0, 1.0], 0.5, Pace::Normal).length() - 0.4).abs() < 1e-5,
        "aslant"
    );
    assert_eq!(fly(&mut n, [0.0; 3], 9.0, Pace::Fast), Vec3::ZERO);
    // The wheel changes the speed, and home restores the initial speed.
    n.toggle();
    let eye = n.camera().position();
    n.wheel(2.0);
    assert_eq!(n.camera().position(), eye);
    let faster = fly(&mut n, [0.0, 0.0, 1.0], 0.5, Pace::Normal);
    assert!((faster.length() / 0.4 - 1.25 * 1.25).abs() < 1e-4);
    n.reset();
    assert!(close(fly(&mut n, [0.0, 0.0, 1.0], 0.5, Pace::Normal), ahead));
}

#[test]
fn the_mode_changes_without_a_jump_and_reset_restores_home() {
    let mut n = Navigator::new(start());
    n.rotate(Vec2::new(50.0, 30.0));
    n.wheel(3.0);
    n.pan(Vec2::new(7.0, 9.0));
    let before = n.camera();
    n.toggle();
    assert_eq!((n.camera(), n.mode()), (before, Mode::Fly));
    n.rotate(Vec2::new(-20.0, 10.0));
    n.fly([0.3, 0.2, 1.0], 1.0, Pace::Normal);
    let before = n.camera();
    n.toggle();
    assert_eq!((n.camera(), n.mode()), (before, Mode::Orbit));
    n.reset();
    assert_eq!(n.camera(), Navigator::new(start()).camera());
    assert!(close(n.pivot(), on_axis(5.0)));
}

#[test]
fn a_window_of_any_shape_contains_the_whole_picture() {
    let k = home().intrinsics();
    let corners = [(0.0, 0.0), (640.0, 0.0), (0.0, 480.0), (640.0, 480.0)];
    for (width, height) in [(640, 480), (1920, 480), (300, 1000), (64, 48), (1, 1)] {
        let mut n = Navigator::new(start());
        n.resize(width, height);
        let c = n.camera();
        assert_eq!((c.intrinsics().width, c.intrinsics().height), (width, height));
        assert!(Camera::new(c.intrinsics(), c.world_from_camera()).is_ok());
        assert!((c.intrinsics().fx / c.intrinsics().fy - k.fx / k.fy).abs() < 1e-5);
        let mut touched = false;
        for (x, y) in corners {
            let at = c.intrinsics().project(k.unproject(Vec2::new(x, y)));
            let (w, h) = (width as f32, height as f32);
            assert!(at.x > -1e-3 * w && at.x < 1.001 * w, "{width}x{height}: {at}");
            assert!(at.y > -1e-3 * h && at.y < 1.001 * h, "{width}x{height}: {at}");
            touched |= at.x.abs() < 1e-3 * w || at.y.abs() < 1e-3 * h;
        }
        assert!(touched, "{width}x{height}: smaller than necessary");
        // A minimised window has no pixels.
        n.resize(0, 7);
        assert_eq!(n.camera(), c);
    }
    assert_eq!(fitted(&k, 640, 480), k);
}

#[test]
fn bounds_exclude_outliers_and_fit_the_view() {
    let mut points: Vec<[f32; 3]> = (0..1000)
        .map(|i| {
            let t = i as f32 / 999.0;
            [
                4.0 * t - 1.0,
                2.0 * ((37 * i) % 1000) as f32 / 999.0,
                5.0 + ((611 * i) % 1000) as f32 / 999.0,
            ]
        })
        .collect();
    points.extend([[1e9, -1e9, 1e9], [f32::NAN, 0.0, 0.0], [0.0, f32::INFINITY, 0.0]]);
    let b = Bounds::of(points.iter().copied()).unwrap();
    assert!(b.low.distance(Vec3::new(-0.92, 0.04, 5.02)) < 0.02, "{}", b.low);
    assert!(b.high.distance(Vec3::new(2.92, 1.96, 5.98)) < 0.03, "{}", b.high);
    assert!(close(b.middle(), 0.5 * (b.low + b.high)));
    assert!((b.radius() - 0.5 * b.low.distance(b.high)).abs() < 1e-5);
    assert!(b.camera(0.9, 0).is_err() && b.camera(f32::NAN, 200).is_err());
    let c = b.camera(0.9, 200).unwrap();
    for i in 0..8 {
        let pick =
            |bit: usize, axis: usize| if i >> bit & 1 == 0 { b.low[axis] } else { b.high[axis] };
        let px = c.project(Vec3::new(pick(0, 0), pick(1, 1), pick(2, 2))).unwrap();
        assert!(px.min_element() > -0.1 && px.max_element() < 200.1, "{px}");
    }
    assert_eq!(Bounds::of(std::iter::empty()), None);
    assert_eq!(Bounds::of([[f32::NAN; 3]].into_iter()), None);
    let one = Bounds::of([[1.0, 2.0, 3.0]].into_iter()).unwrap();
    assert!(one.radius() > 0.0 && one.low == one.high);
    let c = one.camera(0.9, 64).unwrap();
    assert!((c.project(one.middle()).unwrap() - Vec2::splat(32.0)).length() < 1e-3);
}

#[test]
fn up_is_the_common_vertical_of_the_cameras() {
    // Both are pitched down by 0.3 from opposite sides; their mean is the vertical.
    let camera = |about: f32| {
        let turn = Quat::from_rotation_y(about) * Quat::from_rotation_x(-0.3);
        Camera::new(home().intrinsics(), Mat4::from_quat(turn)).unwrap()
    };
    let both = [camera(0.2), camera(0.2 + PI)];
    assert!(up_of(both.iter()).distance(UP) < 1e-6);
    assert!((up_of(both[..1].iter()).dot(UP) - 0.3f32.cos()).abs() < 1e-6);
    assert_eq!(up_of(std::iter::empty()), UP);
}

#[test]
fn any_input_gives_a_valid_camera() {
    for (up, distance, radius) in [
        (Vec3::ZERO, f32::NAN, f32::NAN),
        (Vec3::NAN, -1.0, 0.0),
        (Vec3::splat(f32::INFINITY), 0.0, f32::INFINITY),
        (Vec3::new(0.0, -7.0, 0.0), 1e-30, 1e-30),
    ] {
        let mut n = Navigator::new(Start { home: home(), up, distance, radius });
        n.rotate(Vec2::new(10.0, 20.0));
        n.wheel(2.0);
        n.fly([1.0, 1.0, 1.0], 0.1, Pace::Fast);
        let c = n.camera();
        assert!(
            Camera::new(c.intrinsics(), c.world_from_camera()).is_ok(),
            "{up} {distance} {radius}"
        );
        assert!((c.rotation().transpose() * c.rotation()).abs_diff_eq(glam::Mat3::IDENTITY, 1e-5));
    }
    // Inputs that are not finite have no effect.
    let mut n = Navigator::new(start());
    let before = n.camera();
    for bad in [f32::NAN, f32::INFINITY] {
        n.rotate(Vec2::new(bad, 1.0));
        n.pan(Vec2::new(1.0, bad));
        n.fly([bad, 0.0, 0.0], 0.1, Pace::Normal);
        n.fly([1.0, 0.0, 0.0], bad, Pace::Normal);
    }
    n.wheel(f32::NAN);
    n.resize(0, 100);
    n.resize(100, 1_000_000);
    assert_eq!(n.camera(), before);
    // After many inputs the pose is still rigid and without roll.
    let mut n = Navigator::new(start());
    let mut seed = 1u32;
    let mut draw = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 8) as f32 / (1 << 24) as f32 - 0.5
    };
    for i in 0..20_000 {
        n.rotate(Vec2::new(200.0 * draw(), 200.0 * draw()));
        n.pan(Vec2::new(20.0 * draw(), 20.0 * draw()));
        n.wheel(draw());
        n.fly([draw(), draw(), draw()], 0.01, Pace::Normal);
        if i % 100 == 0 {
            n.toggle();
        }
    }
    let c = n.camera();
    assert!((c.rotation().transpose() * c.rotation()).abs_diff_eq(glam::Mat3::IDENTITY, 1e-5));
    assert!(c.rotation().x_axis.dot(UP).abs() < 1e-3, "{}", c.rotation().x_axis);
    assert!(c.world_from_camera().is_finite());
}
