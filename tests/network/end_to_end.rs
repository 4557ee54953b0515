//! The whole path in numbers: photographs of procedural rooms through seeded networks
//! to splats, pictures and files, and back from files.

use subsplat_test_support::edit::Edit;
use subsplat_test_support::whole;

use candle_core::{Device, Tensor};
use glam::Vec3;
use subsplat::files::{SaveOptions, load_splats, save_splats};
use subsplat::network::config::{Backbone, Config, Preset, ShFrame, SpgrHead};
use subsplat::network::model::Views;
use subsplat::reconstruct::{Density, Photo, Reconstructor};
use subsplat::scene::metrics::psnr;
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar, Size};
use subsplat_kernels::layout::{
    Convention, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, ShBasis, ShDirection,
};
use whole::{options as options_of, *};

/// Sides of inputs, px: the smallest that both networks take and windows split.
const SIZE: (usize, usize) = (64, 64);

/// The model's options of rendering, with SH up to degree 3, the most that files hold.
fn options(model: &Reconstructor) -> RasterOptions {
    RasterOptions { sh_degree: 3, ..rules(model, NEAR_FAR.near) }
}

/// The model's rules to render at target resolution.
fn rules(model: &Reconstructor, near: f32) -> RasterOptions {
    let config = model.config();
    config.raster_options(config.upscale as f32, near, [0.0; 3])
}

fn cameras(result: &subsplat::reconstruct::Reconstruction) -> Vec<Camera> {
    result.inputs().iter().map(|c| c.target_camera).collect()
}

/// The networks and conventions that a file has to carry over: MVSplat's colours in
/// its own basis, in the standard one, and the small network.
fn file_cases() -> [(&'static str, Config); 3] {
    let mut own = light(plain(true, Preset::Tuned, 2));
    if let Backbone::Mvsplat(b) = &mut own.backbone {
        b.primaries.sh_frame = ShFrame::Mvsplat;
    }
    [
        ("mvsplat, own basis", own),
        ("mvsplat, standard basis", light(plain(true, Preset::Tuned, 2))),
        ("small", plain(false, Preset::Tuned, 2)),
    ]
}

#[test]
fn files_render_as_the_splats_they_were_made_from() {
    let folder = tempfile::tempdir().unwrap();
    let shoot = shoot(3, 2, 160, 144);
    for (i, (name, config)) in file_cases().into_iter().enumerate() {
        let world = shoot.moved(motion(i));
        let model = lively(&config);
        let mut result = run(&model, &world.photos, SIZE, true);
        amplify_view_dependence(result.splats_mut(), 4.0);
        let splats = result.splats();
        assert_eq!((splats.children_per_parent(), splats.gain_channels()), (4, 4));
        assert_eq!(splats.sh_basis() == ShBasis::Mvsplat, i == 0);
        let mut views = cameras(&result);
        views.push(world.targets[0].resized(128, 128).unwrap());
        for convention in [Convention::Standard, Convention::Mvsplat] {
            let near = match convention {
                Convention::Standard => RasterOptions::new(convention).near,
                Convention::Mvsplat => NEAR_FAR.near,
            };
            let options = RasterOptions { convention, near, ..options(&model) };
            for extension in ["ply", "glb"] {
                let path = folder.path().join(format!("scene.{extension}"));
                save_splats(&path, splats, &SaveOptions::default()).unwrap();
                let back = load_splats(&path).unwrap();
                let worst = views
                    .iter()
                    .map(|c| compare(splats, &back, c, &options))
                    .fold(f64::INFINITY, f64::min);
                eprintln!("{name}, {convention:?}, .{extension}: {worst:.1} dB");
                // 50 dB is required; only rounding may differ.
                assert!(worst >= 100.0, "{name} {convention:?} {extension}: {worst:.1} dB");
            }
            // Possible omissions of a writer: the comparison must detect each.
            for (what, wrong) in forgetful(splats) {
                let worst = views
                    .iter()
                    .map(|c| compare(splats, &wrong, c, &options))
                    .fold(f64::INFINITY, f64::min);
                eprintln!("{name}, {convention:?}, {what}: {worst:.1} dB");
                assert!(worst < 70.0, "{name}: {what} passes at {worst:.1} dB");
            }
        }
    }
}

/// The same splats without their gain, residual, view dependence or basis.
fn forgetful(splats: &Splats) -> Vec<(&'static str, Splats)> {
    let gain = |f: &dyn Fn(&mut [f32])| {
        let mut wrong = splats.clone();
        wrong.edit(|p| p.gain.chunks_exact_mut(4).for_each(f));
        wrong
    };
    let basis = match splats.sh_basis() {
        ShBasis::Standard => ShBasis::Mvsplat,
        ShBasis::Mvsplat => ShBasis::Standard,
    };
    let mut flat = splats.clone();
    amplify_view_dependence(&mut flat, 0.0);
    let mut rebased = splats.clone();
    rebased.edit(|p| p.sh_basis = basis);
    vec![
        ("no gain", gain(&|g| g[0] = 1.0)),
        ("no residual", gain(&|g| g[1..].fill(0.0))),
        ("no view dependence", flat),
        ("another basis", rebased),
    ]
}

/// Largest distance of the means of `b` from those of `a` moved by `motion`, in units
/// of their distance from the first camera's eye.
fn mean_shift(a: &Splats, b: &Splats, motion: glam::Mat4, eye: Vec3) -> f32 {
    let each = (0..a.len()).map(|i| {
        let (p, q) = (Vec3::from(a.mean(i)), Vec3::from(b.mean(i)));
        (motion.transform_point3(p) - q).length() / (p - eye).length()
    });
    each.fold(0.0, f32::max)
}

#[test]
fn tuned_pictures_do_not_depend_on_the_world_frame() {
    let shoot = shoot(5, 2, 128, 128);
    for (mvsplat, seed) in [(true, 0), (false, 1)] {
        let mut config = light(plain(mvsplat, Preset::Tuned, 2));
        let mut results = Vec::new();
        for preset in ["tuned", "world coordinates"] {
            if preset == "world coordinates" {
                // The embeddings of `paper`: the test must detect them.
                config.embed = plain(mvsplat, Preset::Paper, 2).embed;
            }
            let model = lively(&config);
            let m = motion(seed);
            let mut a = run(&model, &shoot.photos, SIZE, false);
            let mut b = run(&model, &shoot.moved(m).photos, SIZE, false);
            // Linear in the coefficients, so that it does not matter who turns first.
            amplify_view_dependence(a.splats_mut(), 8.0);
            amplify_view_dependence(b.splats_mut(), 8.0);
            let shift = mean_shift(a.splats(), b.splats(), m, shoot.photos[0].camera().position());
            let options = options(&model);
            let worst = cameras(&a).into_iter().zip(cameras(&b)).map(|(ca, cb)| {
                decibels(&render(a.splats(), &ca, &options), &render(b.splats(), &cb, &options))
            });
            results.push((shift, worst.fold(f64::INFINITY, f64::min)));
        }
        eprintln!("mvsplat {mvsplat}: {results:?}");
        let [(shift, worst), (_, blind)] = results[..] else { unreachable!() };
        assert!(shift < 1e-3, "means shift by {shift:.1e} of their distance");
        assert!(worst > 60.0, "{worst:.1} dB");
        assert!(blind < 50.0, "world coordinates pass at {blind:.1} dB");
    }
}

#[test]
fn paper_pictures_turn_with_the_world_but_for_mvsplats_colour_quirk() {
    let shoot = shoot(5, 2, 128, 128);
    for mvsplat in [true, false] {
        let config = light(plain(mvsplat, Preset::Paper, 2));
        let m = motion(2);
        let model = Reconstructor::untrained(&config, 7).unwrap();
        let mut a = run(&model, &shoot.photos, SIZE, false);
        let mut b = run(&model, &shoot.moved(m).photos, SIZE, false);
        amplify_view_dependence(a.splats_mut(), 8.0);
        amplify_view_dependence(b.splats_mut(), 8.0);
        let full = options(&model);
        let constant = RasterOptions { sh_degree: 0, ..full };
        for (ca, cb) in cameras(&a).into_iter().zip(cameras(&b)) {
            let pair = |o: &RasterOptions| (render(a.splats(), &ca, o), render(b.splats(), &cb, o));
            let (flat_a, flat_b) = pair(&constant);
            let (full_a, full_b) = pair(&full);
            let alpha = mean_difference(&flat_a.alpha, &flat_b.alpha);
            let (flat, full) = (decibels(&flat_a, &flat_b), decibels(&full_a, &full_b));
            eprintln!("mvsplat {mvsplat}: alpha {alpha:.1e}, degree 0 {flat:.1}, all {full:.1} dB");
            assert!(alpha < 1e-3, "alpha differs by {alpha:.1e}");
            assert!(flat > 60.0, "{flat:.1} dB");
            // MVSplat turns coefficients in e3nn's basis and evaluates them in INRIA's,
            // and its view-dependent colour is tied to the world.
            assert_eq!(full > 60.0, !mvsplat, "{full:.1} dB");
        }
    }
}

/// The primaries themselves, rendered natively.
fn native(config: &Config) -> Config {
    let mut config = config.clone();
    config.spgr.enabled = false;
    config
}

#[test]
fn untrained_children_of_mvsplat_keep_the_native_coverage() {
    let shoot = shoot(8, 2, 256, 256);
    // Seeded weights give σ = 1.5 input px, which covers everything whatever happens to
    // it; with a fifth of the range the bare parents leave gaps. (Below that the least
    // footprint 1/K binds and children cover up to 0.02 more than their parents.)
    for scale_max in [15.0, 3.0] {
        let configs = [1, 2, 4].map(|upscale| {
            let mut config = plain(true, Preset::Tuned, upscale);
            if let Backbone::Mvsplat(b) = &mut config.backbone {
                b.primaries.scale_max = scale_max;
            }
            config
        });
        let (model, parents) = reconstruct(&native(&configs[0]), &shoot.photos, SIZE, false);
        let views: Vec<Camera> = parents.inputs().iter().map(|c| c.input_camera).collect();
        let options = options(&model);
        for config in &configs[1..] {
            let upscale = config.upscale;
            let (_, children) = reconstruct(config, &shoot.photos, SIZE, false);
            assert_eq!(children.splats().len(), parents.splats().len() * upscale * upscale);
            for camera in &views {
                let large = camera.resized(upscale * SIZE.0, upscale * SIZE.1).unwrap();
                let alpha = |s: &Splats, c: &Camera| mean(&render(s, c, &options).alpha);
                let (want, got) =
                    (alpha(parents.splats(), camera), alpha(children.splats(), &large));
                let bare = alpha(parents.splats(), &large);
                eprintln!("x{upscale}: alpha {got:.4}, native {want:.4}, bare parents {bare:.4}");
                assert!((got - want).abs() < 0.01, "x{upscale}: {got:.4} against {want:.4}");
                assert_eq!(bare < want - 0.1, scale_max < 15.0, "{bare:.4} {want:.4}");
            }
        }
    }
}

#[test]
fn the_only_child_is_its_parent() {
    let shoot = shoot(2, 2, 64, 64);
    for mvsplat in [true, false] {
        let config = light(plain(mvsplat, Preset::Tuned, 1));
        let (model, child) = reconstruct(&config, &shoot.photos, SIZE, false);
        let (_, parent) = reconstruct(&native(&config), &shoot.photos, SIZE, false);
        let (c, p) = (child.splats(), parent.splats());
        assert_eq!((c.len(), c.sh()), (p.len(), p.sh()));
        assert!(c.gain().iter().all(|g| *g == 1.0));
        for (a, b) in c.rows().chunks_exact(SPLAT_STRIDE).zip(p.rows().chunks_exact(SPLAT_STRIDE)) {
            // Mean and scales are copied; quaternion and opacity are normalised and sent
            // through a logarithm, which rounds.
            assert_eq!(a[..QUAT_OFFSET], b[..QUAT_OFFSET]);
            assert_eq!(a[SCALE_OFFSET..SCALE_OFFSET + 3], b[SCALE_OFFSET..SCALE_OFFSET + 3]);
            for (a, b) in a.iter().zip(b) {
                assert!((a - b).abs() < 2e-6, "{a} {b}");
            }
        }
        let options = options(&model);
        for camera in cameras(&child) {
            let db = compare(p, c, &camera, &options);
            assert!(db > 80.0, "{db:.1} dB");
        }
    }
}

/// Each child with coefficients of its own: K = 1, γ·h and δ/C₀ in the constant term.
fn materialised(splats: &Splats) -> Splats {
    let mut sh = Vec::new();
    for i in 0..splats.len() {
        let (gamma, delta) = splats.gain_of(i);
        let start = sh.len();
        sh.extend(splats.sh_of(i).iter().map(|h| gamma * h));
        for (v, d) in sh[start..start + 3].iter_mut().zip(delta) {
            *v += d / subsplat_kernels::sh::C0 as f32;
        }
    }
    Splats::new(splats.rows().to_vec(), sh, Vec::new(), splats.sh_degree(), splats.sh_basis())
        .unwrap()
}

/// Angles at `eye` between children and the mean of their siblings, one a child.
fn sibling_angles(splats: &Splats, eye: Vec3) -> Vec<f32> {
    let k = splats.children_per_parent();
    let family = |p: usize| {
        let means = (p * k..(p + 1) * k).map(|i| Vec3::from(splats.mean(i)) - eye);
        let middle = means.clone().sum::<Vec3>() / k as f32;
        means.map(move |m| middle.angle_between(m)).collect::<Vec<_>>()
    };
    (0..splats.parents()).flat_map(family).collect()
}

/// Largest possible change of splat `i`'s colour when its direction turns by `angle`:
/// that times |γ|·Σ_l |h_l|·√((2l + 1)·l(l + 1)/4π), the steepest slope of a function
/// with coefficients h (addition theorem).
fn colour_bound(splats: &Splats, i: usize, angle: f32) -> f32 {
    let sh = splats.sh_of(i);
    let slope = |c: usize, l: usize| {
        let squares = (l * l..(l + 1) * (l + 1)).map(|j| sh[3 * j + c].powi(2)).sum::<f32>();
        let factor = ((2 * l + 1) * l * (l + 1)) as f32 / (4.0 * std::f32::consts::PI);
        (squares * factor).sqrt()
    };
    let channel = |c: usize| (1..=3).map(|l| slope(c, l)).sum::<f32>();
    angle * splats.gain_of(i).0.abs() * (0..3).map(channel).fold(0.0, f32::max)
}

#[test]
fn shared_coefficients_render_as_separate_ones() {
    let shoot = shoot(4, 2, 160, 160);
    let model = lively(&plain(false, Preset::Tuned, 2));
    let mut result = run(&model, &shoot.photos, SIZE, true);
    amplify_view_dependence(result.splats_mut(), 4.0);
    let (compact, own) = (result.splats(), materialised(result.splats()));
    let options = options(&model);
    for (v, camera) in cameras(&result).into_iter().enumerate() {
        let exact = render(compact, &camera, &options);
        let db = decibels(&exact, &render(&own, &camera, &options));
        assert!(db > 110.0, "{db:.1} dB");
        // One direction per parent: bounded by the angles that children span.
        let parent = RasterOptions { sh_direction: ShDirection::Parent, ..options };
        let shared = render(compact, &camera, &parent);
        let angles = sibling_angles(compact, camera.position());
        let bounds = angles.iter().enumerate().map(|(i, angle)| colour_bound(compact, i, *angle));
        let bound = bounds.fold(0.0, f32::max);
        let pairs = exact.rgb.iter().zip(&shared.rgb);
        let worst = pairs.fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        // In the view they come from, children stay in their parent's pixel, whose
        // diagonal is √2 input pixels.
        let half = angles.len() / 2;
        let angle = angles[v * half..(v + 1) * half].iter().fold(0f32, |m, a| m.max(*a));
        let pixel = 2.0 / camera.intrinsics().fx;
        eprintln!("{db:.0} dB; {:.2} pixels, colour {worst:.1e} of {bound:.1e}", angle / pixel);
        assert!(worst > 0.0 && worst <= bound + 1e-5, "{worst:.2e}, at most {bound:.2e}");
        assert!(angle < pixel * 2f32.sqrt(), "{angle:.2e} rad, an input pixel is {pixel:.2e}");
    }
    // Children of the plain split lie √2/4 input pixels from their parent: 1.6e-3 rad
    // for 256 pixels over 60°.
    let (_, plain) = reconstruct(&plain(false, Preset::Tuned, 2), &shoot.photos, SIZE, false);
    let camera = plain.inputs()[0].input_camera;
    let angles = sibling_angles(plain.splats(), camera.position());
    let angle = angles[..angles.len() / 2].iter().fold(0f32, |m, a| m.max(*a));
    assert!(angle < 0.36 / camera.intrinsics().fx, "{angle:.2e} rad");
}

/// Pictures and cameras as the network takes them, one scene after another.
fn batch(model: &Reconstructor, shoots: &[Shoot], size: (usize, usize)) -> Views {
    let (mut images, mut cameras) = (Vec::new(), Vec::new());
    for shoot in shoots {
        let options = model.crop_options(Size::new(size.0, size.1));
        let inputs = shoot.photos.iter().map(|p| p.crop(&options).unwrap()).collect::<Vec<_>>();
        let planes: Vec<f32> = inputs.iter().flat_map(|c| c.input.to_planes()).collect();
        let shape = (1, inputs.len(), 3, size.1, size.0);
        images.push(Tensor::from_vec(planes, shape, &Device::Cpu).unwrap());
        cameras.push(inputs.iter().map(|c| c.input_camera).collect::<Vec<_>>());
    }
    let ranges = cameras.iter().map(|c| vec![NEAR_FAR; c.len()]).collect();
    Views::new(Tensor::cat(&images, 0).unwrap(), cameras, ranges).unwrap()
}

/// Largest difference over the largest value.
fn relative(a: &Tensor, b: &Tensor) -> f32 {
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let (a, b) = (flat(a), flat(b));
    assert_eq!(a.len(), b.len());
    let largest = b.iter().fold(0f32, |m, v| m.max(v.abs()));
    a.iter().zip(&b).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / largest
}

#[test]
fn a_batch_equals_its_scenes() {
    let shoots = [shoot(1, 2, 64, 64), shoot(6, 2, 64, 64)];
    for mvsplat in [true, false] {
        let model = lively(&light(plain(mvsplat, Preset::Tuned, 2)));
        let views = batch(&model, &shoots, SIZE);
        let both = model.model().encode(&views).unwrap();
        let scenes = model.model().forward(&views, &mut |_| {}).unwrap();
        assert_eq!(scenes.len(), 2);
        let mut depths = Vec::new();
        for (b, (shoot, scene)) in shoots.iter().zip(&scenes).enumerate() {
            let one = run(&model, &shoot.photos, SIZE, false);
            assert_eq!(scene.children.to_splats().unwrap(), *one.splats());
            // The encoder itself takes both at once, in other blocks of its products.
            let alone = model.model().encode(&views.scene(b).unwrap()).unwrap();
            for (name, both, alone) in [
                ("depth", &both.depths, &alone.depths),
                ("opacity", &both.densities, &alone.densities),
                ("raw", &both.raw, &alone.raw),
            ] {
                let d = relative(&both.narrow(0, b, 1).unwrap(), alone);
                assert!(d < 1e-4, "mvsplat {mvsplat}, scene {b}, {name}: {d:.1e}");
            }
            depths.push(alone.depths);
        }
        assert!(relative(&depths[0], &depths[1]) > 1e-2, "the scenes must differ");
    }
}

/// The path without children in memory gives the picture of the path with them, with
/// SPGR on and off, in both presets' conventions.
#[test]
fn straight_to_the_picture_is_the_same_picture() {
    let shoots = [shoot(1, 2, 64, 64)];
    for (mvsplat, preset) in [(true, Preset::Paper), (true, Preset::Tuned), (false, Preset::Tuned)]
    {
        let config = light(plain(mvsplat, preset, 2));
        for config in [native(&config), config] {
            let model = lively(&config);
            let views = batch(&model, &shoots, SIZE);
            let options = rules(&model, NEAR_FAR.near);
            let camera = views.cameras[0][0].resized(2 * SIZE.0, 2 * SIZE.1).unwrap();
            let direct = model.model().render(&views, &camera, &options).unwrap();
            let scenes = model.model().forward(&views, &mut |_| {}).unwrap();
            assert_eq!(direct.len(), scenes.len());
            for (direct, scene) in direct.iter().zip(&scenes) {
                assert_eq!(direct.dims(), [5, 2 * SIZE.1, 2 * SIZE.0]);
                let splats = scene.children.to_splats().unwrap();
                let options = RasterOptions { sh_basis: splats.sh_basis(), ..options };
                let picture = render(&splats, &camera, &options);
                assert!(
                    mean(&picture.alpha) > 0.1,
                    "{mvsplat} {preset:?} {}",
                    mean(&picture.alpha)
                );
                let flat = direct.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let plane = picture.alpha.len();
                let rgb = |i: usize| picture.rgb[i % plane * 3 + i / plane];
                let want = (0..3 * plane).map(rgb).chain(picture.alpha.iter().copied());
                let (mut worst, mut flips) = (0f32, 0);
                for (a, b) in flat.iter().zip(want) {
                    let d = (a - b).abs();
                    // Rounding decides now and then whether a splat of 1/255 counts.
                    flips += usize::from(d > 1e-4);
                    worst = worst.max(d);
                }
                assert!(worst < 0.02 && flips * 500 < plane, "{worst} {flips}");
            }
        }
    }
}

/// Three photographs share the Gaussians of two and a half, whatever the heads are.
#[test]
fn heads_of_every_kind_share_their_gaussians() {
    for (head, r, spgr) in [
        (SpgrHead::Mlp2, 4, true),
        (SpgrHead::Polynomial, 4, true),
        (SpgrHead::Polynomial, 1, true),
        (SpgrHead::Mlp2, 2, false),
    ] {
        let mut config = light(plain(false, Preset::Tuned, r));
        (config.spgr.head, config.spgr.enabled) = (head, spgr);
        let model = lively(&config);
        let shoot = shoot(9, 3, 64, 64);
        let options = options_of((64, 64), NEAR_FAR, false).with_density(Density::Auto);
        let result = model.run(&shoot.photos, &options).unwrap();
        let counts = result.children_counts();
        let expected: &[u8] = match (head, r) {
            (SpgrHead::Polynomial, 4) => &[0, 1, 4, 16],
            (_, 4) => &[0, 1, 16],
            _ => &[0, 1],
        };
        assert!(counts.iter().all(|s| expected.contains(s)), "{head:?} x{r} {spgr}");
        let count: usize = counts.iter().map(|k| usize::from(*k)).sum();
        let full = 3 * 64 * 64 * usize::from(expected[expected.len() - 1]);
        assert_eq!((counts.len(), count), (3 * 64 * 64, result.splats().len()));
        assert!(0 < count && count <= full * 5 / 6, "{head:?} x{r} {spgr}: {count} of {full}");
    }
}

/// Every pixel has the number of Gaussians that is asked for, or the error names the number.
#[test]
fn a_number_for_each_pixel_is_kept() {
    let mut config = light(plain(false, Preset::Tuned, 2));
    config.spgr.head = SpgrHead::Polynomial;
    let model = lively(&config);
    let shoot = shoot(9, 2, 64, 64);
    let run = |children: usize| {
        let options = options_of((64, 64), NEAR_FAR, false);
        model.run(&shoot.photos, &options.with_density(Density::Each(children)))
    };
    let three = run(3).unwrap();
    assert_eq!(three.children_counts(), vec![3; 2 * 64 * 64]);
    assert_eq!(three.splats().len(), 3 * 2 * 64 * 64);
    for wrong in [0, 65, 300] {
        let error = run(wrong).unwrap_err().to_string();
        assert!(error.contains("1 to 64") && error.contains(&wrong.to_string()), "{error}");
    }
}

#[test]
fn any_number_of_views_any_shape_any_depth_range() {
    for mvsplat in [true, false] {
        let config = light(plain(mvsplat, Preset::Tuned, 2));
        let model = lively(&config);
        let size = if mvsplat { (96, 64) } else { (128, 64) };
        for (views, near_far) in
            [(3, NEAR_FAR), (2, NearFar::new(0.05, 3.0)), (3, NearFar::new(5.0, 400.0))]
        {
            let shoot = shoot(9, views, 2 * size.0, 2 * size.1);
            let result = model.run(&shoot.photos, &options_of(size, near_far, false)).unwrap();
            assert_eq!(result.splats().len(), 4 * views * size.0 * size.1);
            assert!(result.splats().rows().iter().all(|v| v.is_finite()));
            // Candidates are distances along the unit ray; camera z is shorter by its
            // slope.
            let slope = shoot.photos[0].camera().intrinsics().unproject(glam::Vec2::ZERO).length();
            for depth in result.depths() {
                assert_eq!((depth.width, depth.height), size);
                let range = near_far.near / slope * 0.99..near_far.far * 1.01;
                assert!(depth.data.iter().all(|z| range.contains(z)), "{near_far:?}");
            }
            let options = rules(&model, near_far.near);
            for c in result.inputs() {
                let picture = render(result.splats(), &c.target_camera, &options);
                assert_eq!((picture.width, picture.height), (2 * size.0, 2 * size.1));
                assert!(mean(&picture.alpha) > 0.3, "{}", mean(&picture.alpha));
            }
        }
    }
}

#[test]
fn without_spgr_the_primaries_are_rendered() {
    let shoots = [shoot(1, 2, 64, 64)];
    for mvsplat in [true, false] {
        let model = lively(&native(&light(plain(mvsplat, Preset::Tuned, 2))));
        let views = batch(&model, &shoots, SIZE);
        let output = model.model().encode(&views).unwrap();
        let p = model.model().primaries(&views, &output).unwrap();
        let scene = model.model().forward(&views, &mut |_| {}).unwrap();
        let splats = scene[0].children.to_splats().unwrap();
        assert_eq!((splats.children_per_parent(), splats.sh_basis()), (1, p.sh_basis));
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (means, quats, scales) = (flat(&p.means), flat(&p.quats_wxyz), flat(&p.scales));
        let (opacities, sh) = (flat(&p.opacities), flat(&p.sh));
        let d = splats.sh_coefficients();
        for i in 0..splats.len() {
            assert_eq!(splats.mean(i), means[3 * i..3 * i + 3]);
            assert_eq!(splats.quat_wxyz(i), quats[4 * i..4 * i + 4]);
            assert_eq!(splats.scale(i), scales[3 * i..3 * i + 3]);
            assert_eq!((splats.opacity(i), splats.gain_of(i)), (opacities[i], (1.0, [0.0; 3])));
            let colour_major = &sh[3 * d * i..3 * d * (i + 1)];
            for (j, rgb) in splats.sh_of(i).chunks_exact(3).enumerate() {
                assert_eq!(rgb, [0, 1, 2].map(|c| colour_major[c * d + j]));
            }
        }
    }
}

/// A wall of texture finer than the network's pixels, straight ahead of cameras side
/// by side.
fn wall(side: usize) -> Shoot {
    let wave = |x: f32, y: f32| {
        let mut v = [0.5f32; 3];
        for k in 0..40 {
            let t = k as f32;
            let (a, f) = (2.4 * t, 4.0 * 1.09f32.powi(k));
            let phase = 1.7 * t + f * (a.cos() * x + a.sin() * y);
            v[k as usize % 3] += 0.035 * phase.sin();
            v.iter_mut().for_each(|v| *v += 0.03 * phase.sin());
        }
        v.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
    };
    let photos = [-0.1f32, 0.1].map(|eye| {
        let k = Intrinsics::from_fov_x(1.0, side, side);
        let camera =
            Camera::new(k, glam::Mat4::from_translation(Vec3::new(eye, 0.0, 0.0))).unwrap();
        let pixel = |i: usize| {
            let px = glam::Vec2::new((i % side) as f32 + 0.5, (i / side) as f32 + 0.5);
            let at = camera.position() + 2.0 * k.unproject(px);
            wave(at.x, at.y)
        };
        let data = (0..side * side).flat_map(pixel).collect();
        Photo::new(Rgb { width: side, height: side, data }, camera).unwrap()
    });
    Shoot { photos: photos.to_vec(), targets: Vec::new() }
}

#[test]
fn detail_from_the_photograph_sharpens_the_view_it_came_from() {
    let side = 128;
    let scores = |photo: usize, upscale: usize| {
        let config = plain(false, Preset::Tuned, upscale);
        let shoot = wall(photo);
        let each = [false, true].map(|detail| {
            let (model, result) = reconstruct(&config, &shoot.photos, (side, side), detail);
            let options = options(&model);
            let c = &result.inputs()[0];
            let picture = render(result.splats(), &c.target_camera, &options);
            let truth: Vec<f32> = c.target.data.iter().map(|&v| f32::from(v) / 255.0).collect();
            let db = psnr(&picture.rgb, &truth, picture.width, picture.height).unwrap();
            (db, mean(&picture.alpha), picture)
        });
        let [off, on] = &each;
        eprintln!(
            "photograph {photo}, x{upscale}: {:.2} dB, with detail {:.2} (alpha {:.3})",
            off.0, on.0, off.1
        );
        each
    };
    for upscale in [2, 4] {
        let [off, on] = scores(upscale * side, upscale);
        assert!(on.0 > off.0 + 1.0, "x{upscale}: {:.2} to {:.2} dB", off.0, on.0);
    }
    // A photograph of the input's size holds nothing more: the same picture.
    let [off, on] = scores(side, 2);
    assert_eq!(off.2, on.2);
}
