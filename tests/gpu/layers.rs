//! Frames with more splats, pairs or pixels than a binding holds, in bands and layers. The bytes
//! equal those of a device with large bindings.

use subsplat_test_support::gpu as adapter;
use subsplat_test_support::raster_scene;

use adapter::{gpu, limited};
use raster_scene::{Kind, Random, Scene};
use std::sync::Arc;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu::{FOOTPRINT_STRIDE, Gpu, GpuError, PAIR_SUMS, Rasterizer};
use subsplat_kernels::layout::{Convention, RasterOptions, ShDirection, SplatSlices};

/// Size of a binding, bytes: 1,365 footprints, 16,384 pairs forward and 1,638 backward, and one
/// row of tiles of [`WIDTH`] pixels.
const BINDING: u64 = 64 << 10;
const WIDTH: usize = 160;
const HEIGHT: usize = 105;

fn camera(scene: &Scene, width: usize, height: usize) -> Camera {
    scene.camera.resized(width, height).unwrap()
}

/// Checks that picture, planes and gradients on `small` equal those on any GPU. Returns the
/// number of pairs, and whether the last forward and backward pass in_layers layers (`None` without
/// timestamps).
fn check(
    small: &Arc<Gpu>,
    splats: &SplatSlices,
    camera: &Camera,
    options: &RasterOptions,
) -> (usize, [Option<bool>; 2]) {
    let pixels = camera.intrinsics().width * camera.intrinsics().height;
    let mut random = Random(99);
    let upstream: Vec<f32> = (0..5 * pixels).map(|_| random.range(-1.0, 1.0)).collect();
    let mut whole = Rasterizer::new(gpu().unwrap());
    let mut layered = Rasterizer::new(small.clone()).with_stage_times();
    let expected = whole.render(splats, camera, options).unwrap();
    assert!(expected.alpha.iter().any(|&a| a > 0.5));
    // Two frames: the second one starts with the capacity of the first.
    for _ in 0..2 {
        let got = layered.render(splats, camera, options).unwrap();
        assert!(got == expected, "layers change the bytes");
        assert!(layered.pairs() >= whole.pairs());
    }
    let expected = whole.render_planes(splats, camera, options).unwrap();
    let (planes, mut frame) = layered.frame(splats, camera, options).unwrap();
    assert!(planes == expected, "layers change the planes");
    let expected = whole.backward(splats, camera, options, &upstream).unwrap();
    let sound = expected.rows.iter().chain(&expected.cov6).any(|&v| v != 0.0);
    assert!(sound && expected.background.iter().any(|&v| v != 0.0));
    let in_layers = |times: &[(&str, std::time::Duration)]| {
        small.has_timestamps().then(|| times.iter().any(|(stage, _)| *stage == "pick"))
    };
    for _ in 0..2 {
        let got = frame.backward(&upstream).unwrap();
        assert!(got == expected, "layers change the gradients");
    }
    (whole.pairs(), [in_layers(layered.stage_times()), in_layers(frame.stage_times())])
}

/// More splats, pixels and pairs than a binding holds; also with covariances, with a third of the
/// splats behind the camera, and with a convention that cuts splats at tiles.
#[test]
fn layers_render_the_same_bytes() {
    let Some(small) = limited(BINDING) else { return };
    for (seed, kind) in [(1, Kind::Plain), (2, Kind::Behind)] {
        let scene = Scene::new(kind, seed, 1500, 1, 4);
        let scene = if seed == 2 { scene.with_covariances() } else { scene };
        assert!(scene.len() * 4 * FOOTPRINT_STRIDE > 4 * BINDING as usize);
        let options = RasterOptions {
            background: [0.2, 0.5, 0.7],
            sh_direction: [ShDirection::Child, ShDirection::Parent][seed as usize - 1],
            near: 0.2,
            ..RasterOptions::new([Convention::Standard, Convention::Mvsplat][seed as usize - 1])
        };
        let camera = camera(&scene, WIDTH, HEIGHT);
        let (pairs, in_layers) = scene.with_slices(|s| check(&small, &s, &camera, &options));
        eprintln!("{kind:?}: {} splats, {pairs} pairs", scene.len());
        assert!(in_layers.iter().all(|t| *t != Some(false)), "{in_layers:?}");
    }
}

/// Splats and pixels fit a binding, pairs do not: first only in the backward pass, then in both
/// passes.
#[test]
fn pairs_that_do_not_fit_take_layers() {
    const BINDING: u64 = 128 << 10;
    let Some(small) = limited(BINDING) else { return };
    for (parents, layers) in [(100, [false, true]), (650, [true, true])] {
        let scene = Scene::new(Kind::Saturated, 7, parents, 0, 0);
        // Saturated pixels stop early, so that blending has stopped in some pixels of a layer and
        // not in others.
        let camera = camera(&scene, WIDTH, 32);
        let options = RasterOptions::default();
        let (pairs, in_layers) = scene.with_slices(|s| check(&small, &s, &camera, &options));
        let fits = |words: usize| pairs * words * 4 <= BINDING as usize;
        assert!(scene.len() * 4 * FOOTPRINT_STRIDE < BINDING as usize);
        eprintln!("{} splats, {pairs} pairs", scene.len());
        assert_eq!([!fits(1), !fits(PAIR_SUMS)], layers, "{pairs} pairs");
        for (in_layers, expected) in in_layers.into_iter().zip(layers) {
            assert!(in_layers.is_none_or(|t| t == expected), "{parents}: {in_layers:?}");
        }
    }
}

/// Errors name the sizes that division cannot reduce, with the limit.
#[test]
fn errors_name_the_exceeded_limit() {
    let Some(small) = limited(4 << 10) else { return };
    let scene = Scene::new(Kind::Plain, 3, 300, 0, 0);
    let mut rasterizer = Rasterizer::new(small);
    let options = RasterOptions::default();
    let render = |rasterizer: &mut Rasterizer, camera: &Camera| {
        scene.with_slices(|s| rasterizer.render(&s, camera, &options)).err()
    };
    let error = render(&mut rasterizer, &camera(&scene, 8, 6));
    let named = GpuError::TooSmall { resource: "splats", needed: 1200, limit: 1024 };
    assert_eq!(error, Some(named));
    let error = render(&mut rasterizer, &camera(&scene, 64, 48));
    assert!(
        matches!(error, Some(GpuError::TooSmall { resource: "a row of tiles, floats", .. })),
        "{error:?}"
    );
}

/// Sizes are those of the adapter; all other limits are WebGPU's defaults.
#[test]
fn devices_have_the_sizes_of_their_adapter() {
    use subsplat_kernels::gpu::wgpu::Limits;
    use subsplat_kernels::gpu::{DeviceChoice, find_for, instance};
    let Some(gpu) = gpu() else { return };
    let adapter = find_for(&instance(), &DeviceChoice::Gpu, None).unwrap().unwrap();
    let (own, usual) = (adapter.limits(), Limits::default());
    let sizes = |limits: &Limits| (limits.max_storage_buffer_binding_size, limits.max_buffer_size);
    let most = |own: u64, usual: u64| own.min(1 << 30).max(usual);
    let (binding, buffer) = sizes(&own);
    let (usual_binding, usual_buffer) = sizes(&usual);
    let expected = (most(binding, usual_binding), most(buffer, usual_buffer));
    eprintln!("adapter {:?}, device {:?}", sizes(&own), sizes(gpu.limits()));
    assert_eq!(sizes(gpu.limits()), expected);
    let (max_storage_buffer_binding_size, max_buffer_size) = expected;
    let max_texture_dimension_2d = own.max_texture_dimension_2d;
    let all = Limits {
        max_storage_buffer_binding_size,
        max_buffer_size,
        max_texture_dimension_2d,
        ..usual
    };
    assert_eq!(*gpu.limits(), all);
}
