//! The small backbone: results of its untrained start, and its switches.

use candle_core::{Device, Tensor};
use subsplat::network::config::{Backbone, Config, Preset, Small};
use subsplat::network::model::Views;
use subsplat::network::model::backbone::{DisparityMean, SmallBackbone};
use subsplat::network::model::subsplat::SubSplat;
use subsplat::network::model::weights::Weights;
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_lab::data::procedural::{Example, ExampleSpec};

const SIDE: usize = 128;

fn example(seed: u64) -> Example {
    example_of(seed, 0)
}

/// An example of two views and `targets` more.
fn example_of(seed: u64, targets: usize) -> Example {
    let mut spec = ExampleSpec::new(SIDE, SIDE, targets);
    spec.photographic = false;
    spec.cameras.crop = 0.0;
    Example::new(seed, &spec)
}

fn views(examples: &[Example]) -> Views {
    first_views(examples, 2)
}

/// The first `v` views of each example.
fn first_views(examples: &[Example], v: usize) -> Views {
    let mut pixels = Vec::new();
    for view in examples.iter().flat_map(|e| &e.views[..v]) {
        for c in 0..3 {
            pixels.extend(view.rgb.iter().skip(c).step_by(3).map(|v| v.clamp(0.0, 1.0)));
        }
    }
    let shape = (examples.len(), v, 3, SIDE, SIDE);
    let images = Tensor::from_vec(pixels, shape, &Device::Cpu).unwrap();
    let cameras = examples.iter().map(|e| e.cameras[..v].to_vec()).collect();
    let planes = examples.iter().map(|e| vec![NearFar::new(e.near, e.far); v]).collect();
    Views::new(images, cameras, planes).unwrap()
}

fn build(config: &Small) -> (SmallBackbone, Weights) {
    let weights = Weights::seeded(3).trainable();
    (SmallBackbone::new(config, weights.builder().pp("small")).unwrap(), weights)
}

/// The untrained start closes most branches: nudge every number, so that each counts.
fn lively(config: &Small) -> SmallBackbone {
    let (net, weights) = build(config);
    for (n, var) in weights.variables().values().enumerate() {
        let nudge: Vec<f32> =
            (0..var.elem_count()).map(|i| 0.05 * ((i + 7 * n) as f32 * 12.9898).sin()).collect();
        let nudge = Tensor::from_vec(nudge, var.shape(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + nudge).unwrap()).unwrap();
    }
    net
}

fn flat(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

/// Share of all pixels whose distance is right within `tolerance`, relative.
fn right(config: &Small, tolerance: f32) -> f32 {
    let (net, _) = build(config);
    let (mut hits, mut all) = (0, 0);
    for seed in 0..4 {
        let e = example(seed);
        let (out, _) =
            net.forward(&views(std::slice::from_ref(&e)), DisparityMean::AroundMode).unwrap();
        let got = flat(&out.depths);
        for (v, view) in e.views[..2].iter().enumerate() {
            let k = e.cameras[v].intrinsics();
            for (i, z) in view.depth.iter().enumerate() {
                let px = glam::Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
                let distance = z * k.unproject(px).length();
                let error = (got[v * SIDE * SIDE + i] - distance).abs() / distance;
                hits += usize::from(error < tolerance);
                all += 1;
            }
        }
    }
    hits as f32 / all as f32
}

#[test]
fn untrained_it_is_a_plane_sweep() {
    let share = right(&Small::standard(), 0.15);
    let mut blind = Small::standard();
    blind.raw_matching = false;
    let without = right(&blind, 0.15);
    println!("within 15 %: {share:.3}; without the raw channels {without:.3}");
    assert!(share > 0.5, "{share}");
    assert!(without < share - 0.2, "the check does not see geometry: {without} and {share}");
}

/// Share of the pixels of the first view whose distance is within 15 % of the truth, compared with
/// the second view and with a picture of something else at a third place.
#[test]
fn a_source_that_shows_something_else_costs_little() {
    let (net, _) = build(&Small::standard());
    let (mut hits, mut all) = ([0usize; 2], 0);
    for seed in 0..4 {
        let (e, other) = (example(seed), example(100 + seed));
        let pair = views(std::slice::from_ref(&e));
        let foreign = views(std::slice::from_ref(&other));
        let foreign = foreign.images.narrow(1, 0, 1).unwrap();
        let images = Tensor::cat(&[&pair.images, &foreign], 1).unwrap();
        let [a, b] = [e.cameras[0], e.cameras[1]];
        let third = glam::Mat4::from_translation(1.5 * (b.position() - a.position()));
        let third = Camera::new(a.intrinsics(), third * a.world_from_camera()).unwrap();
        let planes = vec![vec![pair.near_far[0][0]; 3]];
        let three = Views::new(images, vec![vec![a, b, third]], planes).unwrap();
        for (hits, views) in hits.iter_mut().zip([&pair, &three]) {
            let (out, _) = net.forward(views, DisparityMean::AroundMode).unwrap();
            let got = flat(&out.depths);
            for (i, z) in e.views[0].depth.iter().enumerate() {
                let px = glam::Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
                let distance = z * a.intrinsics().unproject(px).length();
                *hits += usize::from((got[i] - distance).abs() / distance < 0.15);
            }
        }
        all += SIDE * SIDE;
    }
    let [alone, three] = hits.map(|h| h as f32 / all as f32);
    println!("within 15 %: {alone:.3}; with a source of something else {three:.3}");
    // 0.72 with sources weighed by their match, 0.68 with equal weights.
    assert!(three > 0.7 * alone, "{three} of {alone}");
}

/// Mean error of disparity of the first `v` views of four rooms, as a share of the range, with the
/// shipped weights.
fn disparity_error(depth_consensus: bool, v: usize) -> f32 {
    let weights = Weights::shipped(2).unwrap();
    let Backbone::Small(config) = &weights.config().unwrap().backbone else {
        panic!("the shipped backbone is the small one")
    };
    let config = Small { depth_consensus, ..config.clone() };
    let net = SmallBackbone::new(&config, weights.builder().pp("small")).unwrap();
    let (mut sum, mut all) = (0.0, 0);
    for seed in 0..4 {
        let e = example_of(seed, 1);
        let views = first_views(std::slice::from_ref(&e), v);
        let (out, _) = net.forward(&views, DisparityMean::AroundMode).unwrap();
        let mut got = flat(&out.depths).into_iter();
        for (view, camera) in e.views[..v].iter().zip(&e.cameras) {
            for (i, z) in view.depth.iter().enumerate() {
                let px = glam::Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
                let found = got.next().unwrap() / camera.intrinsics().unproject(px).length();
                sum += (1.0 / found - 1.0 / z).abs() / (1.0 / e.near - 1.0 / e.far);
                all += 1;
            }
        }
    }
    sum / all as f32
}

#[test]
fn three_views_take_the_depths_that_most_support() {
    assert_eq!(disparity_error(true, 2), disparity_error(false, 2));
    let [with, without] = [true, false].map(|on| disparity_error(on, 3));
    println!("error of disparity: {with:.4}; of each view by itself {without:.4}");
    assert!(with < without, "{with} and {without}");
}

#[test]
fn half_a_million_to_two_million_parameters() {
    let (_, weights) = build(&Small::standard());
    let count: usize = weights.variables().values().map(|v| v.elem_count()).sum();
    println!("{count} parameters");
    assert!((500_000..=2_000_000).contains(&count), "{count}");
}

#[test]
fn every_part_can_be_switched() {
    let parts: [fn(&mut Small); 10] = [
        |_| {},
        |c| c.raw_matching = false,
        |c| c.stem_channels = 0,
        |c| c.stem_skip = false,
        |c| c.mode_window = 0,
        |c| c.convex_upsampling = false,
        |c| c.confidence_opacity = false,
        |c| c.pixel_colour = false,
        |c| c.unet_channels = vec![32, 40],
        |c| c.cross_check = false,
    ];
    let v = views(&[example(5)]);
    let mut seen = Vec::new();
    for part in parts {
        let mut config = Small::standard();
        part(&mut config);
        let (net, weights) = build(&config);
        let (out, maps) = net.forward(&v, DisparityMean::AroundMode).unwrap();
        assert_eq!(out.depths.dims(), [1, 2, SIDE * SIDE, 1]);
        assert_eq!(out.raw.dims(), [1, 2, SIDE * SIDE, 9 + 75]);
        let mut values = flat(&out.depths);
        assert!(values.iter().all(|d| d.is_finite() && *d > 0.0));
        assert!(flat(&maps.confidence).iter().all(|c| (0.0..=1.0).contains(c)));
        assert!(flat(&out.densities).iter().all(|c| (0.0..=1.0).contains(c)));
        values.extend(flat(&out.densities));
        values.extend(flat(&out.raw.narrow(3, 9, 1).unwrap()));
        // The U-Net's corrections start at zero: its width shows in the tensors alone.
        values.push(weights.variables().values().map(|v| v.elem_count()).sum::<usize>() as f32);
        assert!(!seen.contains(&values), "a switch that changes nothing");
        seen.push(values);
    }
}

#[test]
fn a_batch_equals_its_parts() {
    let net = lively(&Small::standard());
    let (one, two) = (example(7), example(8));
    let both =
        net.forward(&views(&[one.clone(), two.clone()]), DisparityMean::AroundMode).unwrap().0;
    for (b, e) in [one, two].into_iter().enumerate() {
        let alone = net.forward(&views(&[e]), DisparityMean::AroundMode).unwrap().0;
        for (x, y) in [(&both.depths, &alone.depths), (&both.raw, &alone.raw)] {
            let (x, y) = (flat(&x.get(b).unwrap()), flat(&y.get(0).unwrap()));
            let worst = x.iter().zip(&y).map(|(x, y)| (x - y).abs() / (1.0 + y.abs()));
            assert!(worst.fold(0.0, f32::max) < 1e-4);
        }
    }
}

#[test]
fn the_depth_range_is_narrowed_unless_the_estimate_is_off() {
    let e = example(2);
    let mut v = views(std::slice::from_ref(&e));
    v.near_far[0].fill(NearFar::new(0.2 * e.near, 20.0 * e.far));
    let look = |config: &Config| {
        let weights = Weights::seeded(3);
        SubSplat::new(config, weights.builder()).unwrap().estimate_depth_range(&v).unwrap().near_far
    };
    let mut config = Config::small(Preset::Tuned, 2);
    let found = look(&config)[0][0];
    assert_eq!(look(&config)[0], [found; 2]);
    let wide = v.near_far[0][0];
    assert!(found.near > wide.near && found.far < wide.far, "{found:?}");
    let Backbone::Small(small) = &mut config.backbone else { panic!("another backbone") };
    small.estimate_depth_range = false;
    assert_eq!(look(&config), v.near_far);
    assert_eq!(look(&Config::re10k(Preset::Tuned, 2)), v.near_far);
}

#[test]
fn wrong_sizes_are_refused() {
    let (net, _) = build(&Small::standard());
    let e = example(9);
    let v = views(&[e]);
    let images = v.images.narrow(3, 0, 96).unwrap().narrow(4, 0, 80).unwrap();
    let cameras = vec![v.cameras[0].iter().map(|c| c.resized(80, 96).unwrap()).collect()];
    let narrow = Views::new(images.contiguous().unwrap(), cameras, v.near_far.clone()).unwrap();
    let error = net.forward(&narrow, DisparityMean::AroundMode).unwrap_err().to_string();
    assert!(error.contains("multiples of 32") && error.contains("96x80"), "{error}");
}
