//! The rasterizer on the GPU: the conformance cases of `shared/fixtures/raster`, random scenes
//! against the CPU, and the sort.

use subsplat_test_support as common;
use subsplat_test_support::gpu as adapter;
use subsplat_test_support::oracle;
use subsplat_test_support::raster_case;
use subsplat_test_support::raster_scene;

use adapter::gpu;
use common::shared;
use raster_case::File;
use raster_scene::{KINDS, Kind, Random, Scene};
use subsplat_kernels::cpu;
use subsplat_kernels::cpu::{Geometry, SplatSlices};
use subsplat_kernels::gpu::{GpuError, Rasterizer};
use subsplat_kernels::layout::{Convention, RasterOptions, Rendered};

/// Largest |difference| of colours and alphas between GPU and CPU outside the boundary: ten times
/// the f32 error of 2e-6, because WGSL allows larger errors in exp2 and log2.
const COLOUR: f32 = 3e-5;
/// The same for `mvsplat`, whose splats are as near as z = 0.2 and whose covariances are six
/// numbers, with f32 determinants on the GPU.
const COLOUR_MVSPLAT: f32 = 1e-4;
/// Largest relative difference of depths.
const DEPTH: f32 = 1e-4;
/// The same for needles whose covariance is six numbers: the GPU has no f64 for the determinant,
/// which cancels.
const DEPTH_COV6: f32 = 5e-4;

/// Returns the largest differences outside the boundary: of colour and alpha, and of depth sums
/// relative to them or to 0.1 (1 − T has few digits where almost nothing covers a pixel).
fn differences(got: &Rendered, expected: &Rendered, boundary: &[bool]) -> [f32; 2] {
    assert_eq!((got.width, got.height), (expected.width, expected.height));
    let worst = |got: &[f32], expected: &[f32], channels: usize, floor: Option<f32>| {
        assert_eq!(got.len(), expected.len());
        assert_eq!(got.len(), channels * boundary.len());
        let mut worst = 0.0f32;
        for (i, (g, e)) in got.iter().zip(expected).enumerate() {
            if !boundary[i / channels] {
                let d = (g - e).abs() / floor.map_or(1.0, |f| e.abs().max(f));
                worst = if d > worst || d.is_nan() { d } else { worst };
            }
        }
        worst
    };
    let rgb = worst(&got.rgb, &expected.rgb, 3, None);
    let alpha = worst(&got.alpha, &expected.alpha, 1, None);
    let depth = worst(&got.depth_sum, &expected.depth_sum, 1, Some(0.1));
    [if rgb > alpha || rgb.is_nan() { rgb } else { alpha }, depth]
}

fn check_case(name: &str) {
    let Some(gpu) = gpu() else { return };
    let Some(path) = shared(&format!("fixtures/raster/{name}.safetensors")) else { return };
    let file = File::read(&path);
    let (camera, options) = (file.camera(), file.options());
    let mvsplat = options.convention == Convention::Mvsplat;
    let mut rasterizer = Rasterizer::new(gpu);
    let got = file.with_splats(|splats| rasterizer.render(splats, &camera, &options)).unwrap();
    let expected = Rendered {
        rgb: file.get("rgb").to_vec(),
        alpha: file.get("alpha").to_vec(),
        depth_sum: file.get("depth_sum").to_vec(),
        ..got.clone()
    };
    let boundary: Vec<bool> = file.get("boundary").iter().map(|&b| b != 0.0).collect();
    let [colour, depth] = differences(&got, &expected, &boundary);
    eprintln!("{name}: colour {colour:.1e} depth_sum {depth:.1e} pairs {}", rasterizer.pairs());
    let allowed = if mvsplat { COLOUR_MVSPLAT } else { COLOUR };
    assert!(colour < allowed && depth < DEPTH, "{name}: colour {colour} depth {depth}");
    // A difference of twice the tolerance is detected.
    let mut off = got.clone();
    let pixel = boundary.iter().position(|b| !b).unwrap();
    off.rgb[3 * pixel] += 2.0 * allowed;
    assert!(differences(&off, &expected, &boundary)[0] > allowed);
}

macro_rules! cases {
    ($($name:ident),* $(,)?) => { $(#[test] fn $name() { check_case(stringify!($name)); })* };
}

cases!(
    antialiased,
    behind_camera,
    gain,
    mvsplat_dgr_cam0,
    mvsplat_dgr_cam1,
    mvsplat_dgr_cam2,
    mvsplat_tiles,
    needles,
    odd_size,
    saturated,
    sh0_32,
    sh1,
    sh2,
    sh3,
    sh4,
);

/// Every kind of scene with every option of projection.
#[test]
fn random_scenes_match_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let mut rasterizer = Rasterizer::new(gpu);
    let mut worst_seen = [0.0f32; 2];
    for (seed, kind) in (1u64..).zip(KINDS) {
        for variant in 0..6 {
            let (scene, options) = Scene::variant(kind, seed, variant);
            let boundary = oracle::render(&scene.for_oracle(), &scene.camera, &options).boundary;
            let found = scene.with_slices(|splats| {
                let got = rasterizer.render(&splats, &scene.camera, &options).unwrap();
                let expected = cpu::Rasterizer::new().render(&splats, &scene.camera, &options);
                assert!(expected.alpha.iter().any(|&a| a > 0.1) || kind != Kind::Plain);
                differences(&got, &expected, &boundary)
            });
            worst_seen = [worst_seen[0].max(found[0]), worst_seen[1].max(found[1])];
            // Needles whose covariance is six numbers have an f32 determinant.
            let [colour, depth] =
                if scene.cov6.is_empty() { [COLOUR, DEPTH] } else { [COLOUR_MVSPLAT, DEPTH_COV6] };
            assert!(found[0] < colour && found[1] < depth, "{kind:?} {variant}: {found:?}");
        }
    }
    eprintln!("largest: colour {:.1e}, depth {:.1e}", worst_seen[0], worst_seen[1]);
}

/// Several blocks of the prefix sum. In a crowded picture thresholds may flip, so a few pixels
/// may differ by a splat's least contribution.
#[test]
fn a_crowded_scene_matches_the_cpu() {
    let Some(gpu) = gpu() else { return };
    let scene = Scene::new(Kind::Plain, 11, 3000, 1, 1);
    assert!(scene.len() > 4 * 2048);
    let options = RasterOptions::default();
    scene.with_slices(|splats| {
        let got = Rasterizer::new(gpu.clone()).render(&splats, &scene.camera, &options).unwrap();
        let expected = cpu::Rasterizer::new().render(&splats, &scene.camera, &options);
        let pairs = || got.rgb.iter().zip(&expected.rgb).map(|(a, b)| (a - b).abs());
        let off = pairs().filter(|&d| !(d < COLOUR)).count();
        assert!(off <= got.rgb.len() / 100, "{off} of {} numbers", got.rgb.len());
        assert!(pairs().all(|d| d < 0.02));
    });
}

/// The capacity for pairs grows where it is too small, and no pixel depends on it.
#[test]
fn the_capacity_for_pairs_grows() {
    let Some(gpu) = gpu() else { return };
    let scene = Scene::new(Kind::Plain, 5, 40, 1, 1);
    let options = RasterOptions::default();
    scene.with_slices(|splats| {
        let mut large = Rasterizer::new(gpu.clone());
        let expected = large.render(&splats, &scene.camera, &options).unwrap();
        assert!(large.pairs() > 100, "{} pairs", large.pairs());
        let mut small = Rasterizer::new(gpu.clone()).with_capacity(3);
        let got = small.render(&splats, &scene.camera, &options).unwrap();
        assert!(got == expected, "the picture depends on the capacity");
        let planes = small.render_planes(&splats, &scene.camera, &options).unwrap();
        let n = expected.alpha.len();
        for (p, rgb) in expected.rgb.chunks(3).enumerate() {
            assert_eq!([0, 1, 2].map(|c| planes[c * n + p]), [rgb[0], rgb[1], rgb[2]]);
        }
        assert!(planes[3 * n..4 * n] == expected.alpha && planes[4 * n..] == expected.depth_sum);
    });
}

/// A scene without splats renders as background.
#[test]
fn an_empty_scene_is_background() {
    let Some(gpu) = gpu() else { return };
    let camera = Scene::new(Kind::Plain, 1, 1, 0, 0).camera;
    let options = RasterOptions { background: [0.25, 0.5, 1.0], ..RasterOptions::default() };
    let none = SplatSlices { geometry: Geometry::Packed(&[]), sh: &[], gain: &[], sh_degree: 0 };
    let got = Rasterizer::new(gpu.clone()).render(&none, &camera, &options).unwrap();
    assert!(got.rgb.chunks(3).all(|p| p == [0.25, 0.5, 1.0]));
    assert!(got.alpha.iter().chain(&got.depth_sum).all(|&v| v == 0.0));
    let odd = SplatSlices { gain: &[0.0; 3], ..none };
    let error = Rasterizer::new(gpu).render(&odd, &camera, &options).err();
    assert!(matches!(error, Some(GpuError::Argument { argument: "splats", .. })), "{error:?}");
}

/// The sort is stable, at lengths around a thread's, a block's and many blocks'.
#[test]
fn the_order_is_that_of_a_stable_sort() {
    let Some(gpu) = gpu() else { return };
    let mut random = Random(3);
    // The last length has more counters than one workgroup sums at a time: 16 per 2048 keys.
    for count in [0, 1, 7, 8, 9, 255, 2047, 2048, 2049, 70_001, 300_000] {
        let kinds: [fn(f32) -> u32; 3] = [
            |r| r.to_bits(),
            |r| (r * 5.0) as u32,
            |r| if r > 0.5 { u32::MAX } else { (r * 1e9) as u32 },
        ];
        for kind in kinds {
            let keys: Vec<u32> = (0..count).map(|_| kind(random.range(0.0, 1.0))).collect();
            let mut expected: Vec<u32> = (0..count as u32).collect();
            expected.sort_by_key(|&i| keys[i as usize]);
            assert!(gpu.sort_order(&keys).unwrap() == expected, "{count} keys");
        }
    }
}

/// A texture on an application's own device holds the bytes of the picture that is read back.
#[test]
fn a_texture_of_another_device_shows_the_picture() {
    if gpu().is_some() {
        draw_to_texture(128 << 20);
    }
}

/// The same where a binding holds one of the picture's three rows of tiles.
#[test]
fn a_texture_is_drawn_in_bands() {
    if gpu().is_some() {
        draw_to_texture(24 << 10);
    }
}

fn draw_to_texture(binding: u64) {
    use subsplat_kernels::gpu::{Gpu, wgpu};
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter =
        pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))
            .unwrap();
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        required_limits: wgpu::Limits {
            max_storage_buffer_binding_size: binding,
            ..wgpu::Limits::default()
        },
        ..wgpu::DeviceDescriptor::default()
    }))
    .unwrap();
    let gpu = Gpu::from_device(device.clone(), queue.clone());
    let scene = Scene::new(Kind::Plain, 9, 30, 2, 4);
    let camera = scene.camera.resized(64, 48).unwrap();
    let options = RasterOptions { background: [0.3, 0.2, 0.1], ..RasterOptions::default() };
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let texture = |width, height| {
        device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        })
    };
    let target = texture(64, 48);
    let view = target.create_view(&wgpu::TextureViewDescriptor::default());
    let uploaded = scene.with_slices(|s| gpu.upload_splats(&s)).unwrap();
    // The capacity is so small that the first frame is drawn twice.
    let mut rasterizer = Rasterizer::new(gpu.clone()).with_capacity(3);
    for _ in 0..3 {
        rasterizer.draw(&uploaded, &camera, &options, &view).unwrap();
    }
    let read = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 4 * 64 * 48,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    let layout =
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(256), rows_per_image: None };
    let to = wgpu::TexelCopyBufferInfo { buffer: &read, layout };
    encoder.copy_texture_to_buffer(target.as_image_copy(), to, target.size());
    queue.submit([encoder.finish()]);
    read.slice(..).map_async(wgpu::MapMode::Read, |r| r.unwrap());
    device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
    let bytes = read.slice(..).get_mapped_range().unwrap().to_vec();
    let expected = rasterizer.render_scene(&uploaded, &camera, &options).unwrap();
    assert!(expected.alpha.iter().any(|&a| a > 0.5));
    for (p, rgba) in bytes.chunks(4).enumerate() {
        let want = [0, 1, 2].map(|c| expected.rgb[3 * p + c]);
        for (got, want) in rgba.iter().zip(want.iter().chain([&expected.alpha[p]])) {
            let want = want.clamp(0.0, 1.0) * 255.0;
            // Half a step of rounding, and a tie may be rounded either way.
            assert!((f32::from(*got) - want).abs() < 0.51, "pixel {p}: {got} {want}");
        }
    }
    let small = texture(32, 48).create_view(&wgpu::TextureViewDescriptor::default());
    let error = rasterizer.draw(&uploaded, &camera, &options, &small).err();
    assert!(matches!(error, Some(GpuError::Argument { .. })), "{error:?}");
}

/// A lost device returns one error, without a panic: for rendering, for drawing to a texture, for
/// uploads, and in the backward pass of an earlier frame.
#[test]
fn a_lost_device_is_an_error() {
    use subsplat_kernels::gpu::{DeviceChoice, Gpu, wgpu};
    if gpu().is_none() {
        return;
    }
    let own = Gpu::open(&DeviceChoice::Gpu).unwrap().unwrap();
    let scene = Scene::new(Kind::Plain, 9, 30, 2, 4);
    let mut rasterizer = Rasterizer::new(own.clone());
    let (camera, options) = (scene.camera, RasterOptions::default());
    let (width, height) = (camera.intrinsics().width, camera.intrinsics().height);
    let target = own.device().create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d {
            width: width as u32,
            height: height as u32,
            depth_or_array_layers: 1,
        },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    });
    let target = target.create_view(&wgpu::TextureViewDescriptor::default());
    let uploaded = scene.with_slices(|s| own.upload_splats(&s)).unwrap();
    rasterizer.draw(&uploaded, &camera, &options, &target).unwrap();
    let frame = scene.with_slices(|s| rasterizer.frame(&s, &camera, &options));
    let (_, mut frame) = frame.unwrap();
    // A read-back of the pair count is pending.
    rasterizer.draw(&uploaded, &camera, &options, &target).unwrap();
    own.device().destroy();
    own.device().poll(wgpu::PollType::Poll).ok();
    for _ in 0..2 {
        let errors = [
            ("draw", rasterizer.draw(&uploaded, &camera, &options, &target).err()),
            ("backward", frame.backward(&vec![0.0; 5 * width * height]).err()),
            ("render", rasterizer.render_scene(&uploaded, &camera, &options).err()),
            ("upload", scene.with_slices(|s| own.upload_splats(&s)).err()),
            ("check", own.check().err()),
        ];
        for (what, error) in errors {
            assert!(matches!(error, Some(GpuError::Lost { .. })), "{what}: {error:?}");
        }
    }
}
