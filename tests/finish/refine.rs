//! The refinement of Gaussians on pictures: it finds displaced geometry again, and leaves a
//! set alone where it cannot make it better.

use glam::Mat4;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};
use subsplat::finish::{PhaseRun, RefineOptions, RefineReport, refine};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render;
use subsplat::{Camera, FinishError, RasterOptions, Renderer, Splats, TargetView};
use subsplat_kernels::layout::{OPACITY_OFFSET, QUAT_OFFSET, SPLAT_STRIDE};
use subsplat_test_support::fit_scene::{SIDE, cameras, pictures, plane};

fn refined(splats: &mut Splats, truth: &[Rgb], options: &RefineOptions) -> RefineReport {
    let cameras = cameras();
    let views: Vec<TargetView<'_>> =
        cameras.iter().zip(truth).map(|(camera, image)| TargetView { camera, image }).collect();
    let (raster, mut renderer) = (RasterOptions::default(), Renderer::default());
    refine(splats, &views, &raster, options, &mut renderer, &mut |_| ControlFlow::Continue(()))
        .unwrap()
}

/// The plane with its Gaussians displaced by up to `px` pixels, each in a direction of its own.
fn displaced(px: f32) -> Splats {
    let mut parts = plane(0.6, 0.9).into_parts();
    let pixel = 2.0 / SIDE as f32;
    for (i, row) in parts.rows.chunks_mut(SPLAT_STRIDE).enumerate() {
        let angle = i as f32 * 2.4;
        row[0] += px * pixel * angle.cos();
        row[1] += px * pixel * angle.sin();
    }
    Splats::try_from(parts).unwrap()
}

/// Mean squared difference of the pictures between the two cameras.
fn between(a: &Splats, b: &Splats) -> f32 {
    let middle = Camera::new(cameras()[0].intrinsics(), Mat4::IDENTITY).unwrap();
    let [a, b] = [a, b].map(|s| render(s, &middle, &RasterOptions::default()).rgb);
    a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / a.len() as f32
}

#[test]
fn displaced_gaussians_give_the_pictures_again() {
    let sharp = plane(0.6, 0.9);
    let truth = pictures(&sharp);
    let start = displaced(0.4);
    let mut splats = start.clone();
    let options = RefineOptions::default().with_steps(60);
    let report = refined(&mut splats, &truth, &options);
    assert!(report.after < 0.5 * report.before, "{report:?}");
    let (before, after) = (between(&start, &sharp), between(&splats, &sharp));
    assert!(after < 0.7 * before, "a new view: {after} of {before}");
    let means = |s: &Splats| s.rows().chunks(SPLAT_STRIDE).map(|r| r[2]).collect::<Vec<_>>();
    assert_ne!(means(&splats), means(&start));
    for row in splats.rows().chunks(SPLAT_STRIDE) {
        let quat = &row[QUAT_OFFSET..QUAT_OFFSET + 4];
        let length = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "{quat:?}");
    }
    assert_eq!((splats.sh(), splats.gain().len()), (start.sh(), 4 * start.len()));
    // The result does not depend on the number of threads.
    let mut again = start.clone();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(pool.install(|| refined(&mut again, &truth, &options)), report);
    assert!(again == splats);
}

#[test]
fn a_set_that_cannot_be_better_stays() {
    let sharp = plane(0.6, 0.9);
    let truth = pictures(&sharp);
    let mut splats = sharp.clone();
    // One step of Adam moves every parameter by its whole rate, away from the optimum.
    let report = refined(&mut splats, &truth, &RefineOptions::default().with_steps(1));
    assert!(splats == sharp && report.before == report.after, "{report:?}");
    let report = refined(&mut splats, &truth, &RefineOptions::default().with_steps(0));
    assert!(splats == sharp && report.steps == 0);
    refined(&mut splats, &[], &RefineOptions::default());
    assert!(splats == sharp);
}

/// Two planes, one for each camera, the second at a wrong depth. Pictures of both together can be
/// right only if the second moves; a picture of the second alone says where to.
#[test]
fn the_other_photographs_gaussians_are_drawn_alone() {
    let (near, far) = (plane(0.6, 0.9).into_parts(), plane(0.6, 0.9).into_parts());
    let mut both = near;
    for row in far.rows.chunks(SPLAT_STRIDE) {
        // Along the second camera's ray, a tenth behind the plane: its own picture stays.
        let mut row = row.to_vec();
        row[0] = 0.1 + 1.1 * (row[0] - 0.1);
        row[1] *= 1.1;
        row[2] *= 1.1;
        both.rows.extend(row);
    }
    both.sh.extend(far.sh);
    let start = Splats::try_from(both).unwrap();
    let truth = pictures(&plane(0.6, 0.9));
    let change = |across: f32| {
        let mut splats = start.clone();
        let options = RefineOptions::default().with_steps(40).with_across(across).with_groups(true);
        refined(&mut splats, &truth, &options);
        let half = splats.len() / 2 * SPLAT_STRIDE;
        let rows = splats.rows()[half..].chunks(SPLAT_STRIDE);
        let before = start.rows()[half..].chunks(SPLAT_STRIDE);
        let moved = rows.zip(before).map(|(a, b)| (a[0] - b[0]).abs() + (a[1] - b[1]).abs());
        moved.sum::<f32>() / splats.len() as f32
    };
    let (without, with) = (change(0.0), change(1.0));
    assert!(with > 1.5 * without && with > 0.0, "{with} and {without}");
}

#[test]
fn a_cancelled_refinement_changes_nothing() {
    let truth = pictures(&plane(0.6, 0.9));
    let (mut splats, cameras) = (displaced(0.4), cameras());
    let before = splats.clone();
    let views = [TargetView { camera: &cameras[0], image: &truth[0] }];
    let (raster, options) = (RasterOptions::default(), RefineOptions::default());
    let mut stop = |phase: &PhaseRun<'_>| match phase.steps() {
        2 => ControlFlow::Break(()),
        _ => ControlFlow::Continue(()),
    };
    let result =
        refine(&mut splats, &views, &raster, &options, &mut Renderer::default(), &mut stop);
    assert!(matches!(result, Err(FinishError::Cancelled)));
    assert!(splats == before);
}

#[test]
fn an_ended_refinement_keeps_its_steps() {
    let truth = pictures(&plane(0.6, 0.9));
    let (start, cameras) = (displaced(0.4), cameras());
    let view = |(camera, image)| TargetView { camera, image };
    let views: Vec<_> = cameras.iter().zip(&truth).map(view).collect();
    let (raster, options) = (RasterOptions::default(), RefineOptions::default().with_steps(60));
    let mut renderer = Renderer::default();
    let mut changes = Vec::new();
    let mut last = start.clone();
    let mut splats = start.clone();
    let mut end = |phase: &PhaseRun<'_>| {
        if phase.steps() >= 30 {
            phase.end();
        }
        let now = phase.splats();
        let change = now.rows().iter().zip(last.rows()).map(|(a, b)| (a - b).abs()).sum::<f32>();
        changes.push(change);
        last = now;
        ControlFlow::Continue(())
    };
    let report = refine(&mut splats, &views, &raster, &options, &mut renderer, &mut end).unwrap();
    // Eight more steps, whose rates fall.
    assert!(report.steps == 38 && report.after < report.before, "{report:?}");
    assert!(changes[37] < 0.2 * changes[29], "{changes:?}");
    assert!(splats == last);
}

#[test]
fn a_picture_of_another_size_is_refused() {
    let (splats, cameras) = (plane(1.1, 0.3), cameras());
    let image = Rgb { width: 2, height: 1, data: vec![0; 6] };
    let views = [TargetView { camera: &cameras[0], image: &image }];
    let options = RefineOptions::default();
    let error = PhaseRun::new(&splats, &views, &RasterOptions::default(), &options).err().unwrap();
    assert_eq!(error.to_string(), "view 0: expected a picture of 48x48, got 2x1");
}

/// A pixel without Gaussians has no gradient, and numbers that are not finite change nothing.
#[test]
fn gaussians_that_no_picture_shows_stay() {
    let truth = pictures(&plane(0.6, 0.9));
    let mut parts = displaced(0.4).into_parts();
    // Behind both cameras.
    parts.rows[2] = -2.0;
    let start = Splats::try_from(parts).unwrap();
    let mut splats = start.clone();
    refined(&mut splats, &truth, &RefineOptions::default().with_steps(60));
    assert!(splats.rows()[11..] != start.rows()[11..], "nothing changed");
    assert_eq!(splats.rows()[..10], start.rows()[..10]);
}

/// Gaussians whose 3σ reach beyond both photographs get other colours only: a photograph that shows a
/// part of one would shrink it, and leave a black strip at the edge of new views.
#[test]
fn gaussians_at_the_edge_of_both_photographs_keep_their_geometry() {
    let (truth, start) = (pictures(&plane(0.6, 0.9)), displaced(0.4));
    let mut splats = start.clone();
    refined(&mut splats, &truth, &RefineOptions::default().with_steps(60));
    let rows =
        |s: &Splats| s.rows().chunks(SPLAT_STRIDE).map(<[f32]>::to_vec).collect::<Vec<Vec<f32>>>();
    let (before, after) = (rows(&start), rows(&splats));
    // The first camera's picture begins 2.4 px left of the plane, more than 3 · 0.6 px, and at its top.
    let (left, top) = (24 * SIDE, 24);
    assert_ne!(after[left], before[left]);
    assert_eq!(after[top][..10], before[top][..10]);
    assert_ne!(splats.gain()[4 * top..][..4], [1.0, 0.0, 0.0, 0.0]);
    // Of three photographs they are refined as all others.
    let (cameras, truth) = (cameras(), [&truth[0], &truth[1], &truth[0]]);
    let order = [cameras[0], cameras[1], cameras[0]];
    let views: Vec<TargetView<'_>> =
        order.iter().zip(truth).map(|(camera, image)| TargetView { camera, image }).collect();
    let (raster, options) = (RasterOptions::default(), RefineOptions::default().with_steps(60));
    let mut go_on = |_: &PhaseRun<'_>| ControlFlow::Continue(());
    let mut splats = start.clone();
    let mut renderer = Renderer::default();
    refine(&mut splats, &views, &raster, &options, &mut renderer, &mut go_on).unwrap();
    assert_ne!(rows(&splats)[top][..10], before[top][..10]);
}

/// Two photographs whose Gaussians hardly show in each other's stay as they are.
#[test]
fn two_photographs_with_little_in_common_are_not_refined() {
    let truth = pictures(&plane(0.6, 0.9));
    let copy = displaced(0.4).into_parts();
    // The rows of the plane that each photograph has made.
    let start = |rows: usize| {
        let mut parts = displaced(0.4).into_parts();
        let second = parts.rows.len();
        parts.rows.extend_from_slice(&copy.rows);
        parts.sh.extend_from_slice(&copy.sh);
        for (i, row) in parts.rows.chunks_mut(SPLAT_STRIDE).enumerate() {
            let kept = if i * SPLAT_STRIDE < second {
                i / SIDE < rows
            } else {
                i / SIDE - SIDE >= SIDE - rows
            };
            if !kept {
                row[OPACITY_OFFSET] = 1e-3;
            }
        }
        Splats::try_from(parts).unwrap()
    };
    let run = |rows: usize| {
        let (start, options) = (start(rows), RefineOptions::default().with_groups(true));
        let mut splats = start.clone();
        (refined(&mut splats, &truth, &options), splats == start)
    };
    let (report, same) = run(SIDE / 6);
    assert!(same && report.steps == 0 && report.after == report.before, "{report:?}");
    let (report, same) = run(SIDE / 2);
    assert!(!same && report.after < report.before, "{report:?}");
}

#[test]
fn steps_end_where_the_error_no_longer_falls() {
    let truth = pictures(&plane(0.6, 0.9));
    let mut splats = displaced(0.4);
    let report = refined(&mut splats, &truth, &RefineOptions::default().with_steps(4000));
    assert!(report.steps < 4000 && report.steps.is_multiple_of(8), "{report:?}");
    assert!(report.after < report.before, "{report:?}");
}

#[test]
fn a_time_limit_ends_the_steps_and_their_rates() {
    let truth = pictures(&plane(0.6, 0.9));
    let mut splats = displaced(0.4);
    let options = RefineOptions::default().with_time(Duration::from_secs(2));
    let begun = Instant::now();
    let report = refined(&mut splats, &truth, &options);
    assert!(report.steps > 0 && report.after < report.before, "{report:?}");
    // Fifteen times the limit, whatever else the machine does.
    assert!(begun.elapsed() < Duration::from_secs(30));
    // The number of steps limits them too, and the rates then fall over it.
    let mut options = RefineOptions::default().with_time(Duration::from_secs(3600));
    options.steps = 12;
    let mut limited = displaced(0.4);
    assert_eq!(refined(&mut limited, &truth, &options).steps, 12);
    let mut of_steps = displaced(0.4);
    refined(&mut of_steps, &truth, &RefineOptions::default().with_steps(12));
    assert!(limited == of_steps);
}

/// Three photographs show a surface from enough sides for colours by direction, and contradict Gaussians that
/// make up for each other's errors.
#[test]
fn three_photographs_move_sh_and_leave_gaussians_out_of_steps() {
    let (cameras, truth) = (cameras(), pictures(&plane(0.6, 0.9)));
    let parts = displaced(0.4).into_parts();
    let count = parts.rows.len() / SPLAT_STRIDE;
    let start =
        Splats::new(parts.rows, vec![0.1; 12 * count], Vec::new(), 1, parts.sh_basis).unwrap();
    let run = |photographs: usize, dropout: f32| {
        let views: Vec<TargetView<'_>> = [0, 1, 0][..photographs]
            .iter()
            .map(|&i| TargetView { camera: &cameras[i], image: &truth[i] })
            .collect();
        let mut options = RefineOptions::default().with_steps(12);
        options.dropout = dropout;
        let (mut splats, mut renderer) = (start.clone(), Renderer::default());
        let mut go_on = |_: &PhaseRun<'_>| ControlFlow::Continue(());
        let raster = RasterOptions::default();
        let report =
            refine(&mut splats, &views, &raster, &options, &mut renderer, &mut go_on).unwrap();
        assert!(report.after < report.before, "{report:?}");
        splats
    };
    let [two, two_dropped] = [0.0, 0.5].map(|dropout| run(2, dropout));
    assert!(two == two_dropped && two.sh() == start.sh());
    let [three, three_dropped] = [0.0, 0.5].map(|dropout| run(3, dropout));
    assert!(three.rows() != three_dropped.rows() && three.sh() != start.sh());
    assert!(three_dropped == run(3, 0.5));
    // The constant term stays: δ moves in its place.
    let constant =
        |s: &Splats| s.sh().chunks(12).flat_map(|set| set[..3].to_vec()).collect::<Vec<_>>();
    assert_eq!(constant(&three), constant(&start));
}

/// Three planes for three photographs, the third one behind the others. The third shows nothing,
/// and of two photographs nothing is removed.
#[test]
fn parents_that_no_photograph_shows_are_removed() {
    let (cameras, truth) = (cameras(), pictures(&plane(0.6, 0.9)));
    let mut parts = displaced(0.4).into_parts();
    // The first plane lets half of the second one through.
    for row in parts.rows.chunks_mut(SPLAT_STRIDE) {
        row[OPACITY_OFFSET] = 0.5;
    }
    let size = parts.rows.len();
    for depth in [1.0, 1.5] {
        let copy = displaced(0.4).into_parts();
        parts.rows.extend(copy.rows.chunks(SPLAT_STRIDE).flat_map(|row| {
            let mut row = row.to_vec();
            row[2] *= depth;
            row
        }));
        parts.sh.extend(copy.sh);
        parts.gain.extend(copy.gain);
    }
    let start = Splats::try_from(parts).unwrap();
    let order = [0, 1, 0];
    let run = |views: usize, share: f32| {
        let views: Vec<TargetView<'_>> = order[..views]
            .iter()
            .map(|&i| TargetView { camera: &cameras[i], image: &truth[i] })
            .collect();
        let options = RefineOptions::default().with_steps(90).with_groups(true);
        let options = options.with_least_share(share);
        let (mut splats, mut renderer) = (start.clone(), Renderer::default());
        let mut go_on = |_: &PhaseRun<'_>| ControlFlow::Continue(());
        let raster = RasterOptions::default();
        let report =
            refine(&mut splats, &views, &raster, &options, &mut renderer, &mut go_on).unwrap();
        (report, splats)
    };
    let (report, splats) = run(3, 0.5);
    assert!(report.after < report.before, "{report:?}");
    assert_eq!(report.removed, start.len() - splats.len());
    let behind = |s: &Splats| s.rows().chunks(SPLAT_STRIDE).filter(|r| r[2] > 2.5).count();
    let behind = (behind(&start), behind(&splats));
    assert_eq!(behind.0, size / SPLAT_STRIDE);
    let front = (start.len() - behind.0, splats.len() - behind.1);
    let kept = [behind, front].map(|(all, kept)| kept as f32 / all as f32);
    assert!(kept[0] < 0.1 && kept[1] > 0.5, "{kept:?}");
    let buffers = (splats.rows().len(), splats.sh().len(), splats.gain().len());
    let per_parent = start.sh().len() / start.parents();
    let parents = splats.len() / start.children_per_parent();
    assert_eq!(buffers, (SPLAT_STRIDE * splats.len(), per_parent * parents, 4 * splats.len()));
    assert_eq!(run(3, 0.0).1.len(), start.len());
    assert_eq!(run(2, 0.5).1.len(), start.len());
}
