//! The rasterizer against references of other makers: the conformance cases of
//! `shared/fixtures/raster` (float64, both conventions; one case by gsplat), five of which
//! are committed in `tests/goldens/raster`, and an independent render of a real .ply
//! (`shared/fixtures/ref_render`).

use subsplat_test_support as common;
use subsplat_test_support::raster_case;

use common::{committed, raster_cases, shared};
use glam::{Mat4, Vec3};
use raster_case::{File, rows};
use std::path::Path;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Geometry, Rasterizer, SimdLevel, SplatSlices};
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};

/// Largest |got − expected| over pixels that are no boundary; `lanes` per pixel.
/// With `relative`, over max(|expected|, the number given).
fn worst(got: &[f32], expected: &[f32], boundary: &[f32], relative: Option<f32>) -> f32 {
    assert_eq!(got.len(), expected.len());
    let lanes = got.len() / boundary.len();
    let mut worst = 0.0f32;
    for (i, (g, e)) in got.iter().zip(expected).enumerate() {
        if boundary[i / lanes] == 0.0 {
            let scale = relative.map_or(1.0, |floor| e.abs().max(floor));
            let d = (g - e).abs() / scale;
            assert!(d.is_finite(), "value {i}: {g} {e}");
            worst = worst.max(d);
        }
    }
    worst
}

/// Every case in every level that the processor has.
fn check_case(name: &str) {
    for &level in SimdLevel::available() {
        check_case_in(name, level);
    }
}

fn check_case_in(name: &str, level: SimdLevel) {
    let Some(path) = shared(&format!("fixtures/raster/{name}.safetensors")) else { return };
    let file = File::read(&path);
    let (camera, options) = (file.camera(), file.options());
    let mvsplat = options.convention == Convention::Mvsplat;
    let n = file.get("opacities").len();
    let mut rasterizer = Rasterizer::new().with_simd_level(level);
    let got = file.with_splats(|splats| {
        assert_eq!(splats.children_per_parent(), file.meta::<usize>("children"));
        rasterizer.render(splats, &camera, &options)
    });

    let boundary = file.get("boundary");
    let share = boundary.iter().sum::<f32>() / boundary.len() as f32;
    // The README: 0 to 0.4 %, `saturated` 3 %.
    assert!(share <= if name == "saturated" { 0.031 } else { 0.004 }, "{name}: {share}");
    let tolerance = if mvsplat { 1e-4 } else { 3e-5 };
    let rgb = worst(&got.rgb, file.get("rgb"), boundary, None);
    let alpha = worst(&got.alpha, file.get("alpha"), boundary, None);
    // Where almost nothing covers a pixel, 1 − T has few digits left.
    let sum = worst(&got.depth_sum, file.get("depth_sum"), boundary, Some(0.1));
    let depth = worst(&got.depth(), file.get("depth"), boundary, Some(1e-3));
    eprintln!(
        "{name} {level:?}: rgb {rgb:.1e} alpha {alpha:.1e} depth_sum {sum:.1e} depth {depth:.1e}"
    );
    assert!(rgb < tolerance && alpha < tolerance, "{name} {level:?}: rgb {rgb} alpha {alpha}");
    assert!(sum < 1e-4 && depth < 1e-4, "{name} {level:?}: depth_sum {sum} depth {depth}");
    check_intermediates(name, &file, &rasterizer, mvsplat);
    assert_eq!(rasterizer.footprints().len(), n);
}

fn check_intermediates(name: &str, file: &File, rasterizer: &Rasterizer, mvsplat: bool) {
    let (mut compared, mut dropped) = (0, 0);
    let shift = if mvsplat { 0.0 } else { 0.5 };
    for (i, f) in rasterizer.footprints().iter().enumerate() {
        let uv = &file.get("means2d")[2 * i..2 * i + 2];
        let conic = &file.get("conics")[3 * i..3 * i + 3];
        if file.get("valid")[i] == 0.0 {
            assert!(!f.visible(), "{name} {i}: culled there, kept here");
            continue;
        }
        if !f.visible() {
            let uv = [uv[0] - shift, uv[1] - shift];
            assert!(!contributes(file, i, uv, conic, mvsplat), "{name} {i} dropped");
            dropped += 1;
            continue;
        }
        compared += 1;
        let close = |what: &str, got: f32, expected: f32, scale: f32, tolerance: f32| {
            let d = (got - expected).abs() / scale;
            assert!(d < tolerance, "{name} splat {i} {what}: {got} {expected}");
        };
        // f32 has 24 bits for a mean that may lie far off the picture.
        close("u", f.u + shift, uv[0], 50.0 + uv[0].abs(), 2e-5);
        close("v", f.v + shift, uv[1], 50.0 + uv[1].abs(), 2e-5);
        let z = file.get("view_z")[i];
        close("z", f.z, z, z, 2e-5);
        let size = conic[0].max(conic[2]);
        for (got, expected) in f.conic().into_iter().zip(conic) {
            close("conic", got, *expected, size, 2e-4);
        }
        for c in 0..3 {
            let expected = file.get("colors")[3 * i + c];
            close("colour", f.rgb[c], expected, expected.abs().max(1.0), 2e-5);
        }
    }
    eprintln!("{name}: {compared} footprints compared, {dropped} dropped as invisible");
    // Camera 2 of the decoder's three has nearly all splats outside its picture.
    let least = if name == "mvsplat_dgr_cam2" { 5 } else { file.get("opacities").len() / 3 };
    assert!(compared >= least, "{name}: only {compared} compared");
}

/// Returns whether splat `i` of `file` clearly shows at some pixel, by its stored conic.
fn contributes(file: &File, i: usize, uv: [f32; 2], conic: &[f32], mvsplat: bool) -> bool {
    let size: [usize; 2] = [file.meta("width"), file.meta("height")];
    let det = conic[0] * conic[2] - conic[1] * conic[1];
    let (xx, xy, yy) = (conic[2] / det, -conic[1] / det, conic[0] / det);
    let mut opacity = file.get("opacities")[i];
    if file.meta("antialiased") {
        opacity *= (((xx - 0.3) * (yy - 0.3) - xy * xy).max(0.0) * det).sqrt();
    }
    let mid = 0.5 * (xx + yy);
    let radius = 3.0 * (mid + (mid * mid - 1.0 / det).max(0.1).sqrt()).sqrt();
    let tiles = |axis: usize| {
        if !mvsplat {
            return 0..size[axis];
        }
        let from = ((uv[axis] - radius.ceil()) / 16.0).max(0.0) as usize;
        let past = ((uv[axis] + radius.ceil() + 15.0) / 16.0).max(0.0) as usize;
        16 * from..(16 * past).min(size[axis])
    };
    tiles(1).any(|y| {
        tiles(0).any(|x| {
            let (dx, dy) = (x as f32 - uv[0], y as f32 - uv[1]);
            let sigma = 0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy;
            opacity * (-sigma).exp() > 1.002 / 255.0
        })
    })
}

macro_rules! cases {
    ($($name:ident)*) => { $( #[test] fn $name() { check_case(stringify!($name)); } )* };
}

cases! {
    sh0_32 sh1 sh2 sh3 sh4 antialiased odd_size saturated needles behind_camera gain
    mvsplat_dgr_cam0 mvsplat_dgr_cam1 mvsplat_dgr_cam2 mvsplat_tiles
}

#[test]
fn every_fixture_has_a_test() {
    for path in raster_cases() {
        let stem = path.file_stem().unwrap().to_str().unwrap();
        assert!(include_str!("raster.rs").contains(stem), "no test for {stem}");
    }
}

#[test]
fn committed_cases_are_the_references() {
    for path in raster_cases() {
        let name = format!("fixtures/raster/{}", path.file_name().unwrap().to_str().unwrap());
        if let Some(copy) = committed(&name) {
            assert!(std::fs::read(copy).unwrap() == std::fs::read(path).unwrap(), "{name}");
        }
    }
}

/// gsplat's own picture, through brush.
#[test]
fn brush_tiny() {
    let Some(path) = shared("fixtures/raster/brush_tiny.safetensors") else { return };
    let file = File::read(&path);
    let (width, height) = (123, 82);
    let k = Intrinsics { fx: 61.5, fy: 61.5, cx: 61.5, cy: 41.0, width, height };
    let pose = Mat4::from_translation(Vec3::new(0.123, 0.456, -8.0));
    let camera = Camera::new(k, pose).unwrap();
    let scales: Vec<f32> = file.get("scales").iter().map(|s| s.exp()).collect();
    let opacities: Vec<f32> =
        file.get("opacities").iter().map(|o| 1.0 / (1.0 + (-o).exp())).collect();
    let packed = rows(file.get("means"), file.get("quats"), &scales, &opacities);
    let splats = SplatSlices {
        geometry: Geometry::Packed(&packed),
        sh: file.get("coeffs"),
        gain: &[],
        sh_degree: 3,
    };
    let mut rasterizer = Rasterizer::new();
    let got = rasterizer.render(&splats, &camera, &RasterOptions::default());
    let out = file.get("out_img");
    let mut covered = 0;
    for p in 0..width * height {
        for c in 0..3 {
            let (g, e) = (got.rgb[3 * p + c], out[4 * p + c]);
            assert!((g - e).abs() < 3e-5, "pixel {p} channel {c}: {g} {e}");
        }
        let (g, e) = (got.alpha[p], out[4 * p + 3]);
        assert!((g - e).abs() < 3e-5, "pixel {p} alpha: {g} {e}");
        covered += usize::from(e > 0.1);
    }
    assert!(covered > 500, "{covered}");
    for (i, f) in rasterizer.footprints().iter().enumerate().filter(|(_, f)| f.visible()) {
        assert!((f.u + 0.5 - file.get("xys")[2 * i]).abs() < 1e-3);
        assert!((f.v + 0.5 - file.get("xys")[2 * i + 1]).abs() < 1e-3);
        assert!((f.z - file.get("depths")[i]).abs() < 1e-4);
        for c in 0..3 {
            assert!((f.conic()[c] - file.get("conics")[3 * i + c]).abs() < 1e-4);
        }
    }
}

/// INRIA .ply as splats, for this test only (the reader proper is `subsplat::files`).
fn read_ply(path: &Path) -> Splats {
    let bytes = std::fs::read(path).unwrap();
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = std::str::from_utf8(&bytes[..at]).unwrap();
    let names: Vec<&str> =
        header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let (mut packed, mut sh) = (Vec::new(), Vec::new());
    for row in bytes[at..].chunks_exact(4 * names.len()) {
        let v = |i: usize| f32::from_le_bytes(row[4 * i..4 * i + 4].try_into().unwrap());
        let [x, rot, scale] = [column("x"), column("rot_0"), column("scale_0")];
        packed.extend((0..3).map(|i| v(x + i)));
        packed.extend((0..4).map(|i| v(rot + i)));
        packed.extend((0..3).map(|i| v(scale + i).exp()));
        packed.push(1.0 / (1.0 + (-v(column("opacity"))).exp()));
        sh.extend((0..3).map(|c| v(column("f_dc_0") + c)));
        for k in 0..15 {
            sh.extend((0..3).map(|c| v(column("f_rest_0") + 15 * c + k)));
        }
    }
    Splats::new(packed, sh, Vec::new(), 3, ShBasis::Standard).unwrap()
}

fn cameras(path: &Path) -> Vec<Camera> {
    let json: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let camera = |f: &serde_json::Value| {
        let number = |key: &str| f[key].as_f64().unwrap() as f32;
        let k = Intrinsics {
            fx: number("fx"),
            fy: number("fy"),
            cx: number("cx"),
            cy: number("cy"),
            width: number("width") as usize,
            height: number("height") as usize,
        };
        let cell = |i: usize| f["c2w"][i / 4][i % 4].as_f64().unwrap() as f32;
        let pose = Mat4::from_cols_array(&std::array::from_fn(cell)).transpose();
        Camera::new(k, pose).unwrap()
    };
    json["frames"].as_array().unwrap().iter().map(camera).collect()
}

fn psnr(a: impl Iterator<Item = f32>, b: impl Iterator<Item = f32>) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for (a, b) in a.zip(b) {
        sum += (f64::from(a) - f64::from(b)).powi(2);
        n += 1.0;
    }
    -10.0 * (sum / n).log10()
}

/// A real scene, rendered by an independent program (classic EWA, alpha cap 0.99,
/// 3-σ radius, Jacobian clamp ±1.3 tan). Both our conventions, with the standard SH
/// basis, agree to more than the required 60 dB: `standard` to 84 dB, `mvsplat`,
/// which differs by the visible tile cut, to 75 dB.
#[test]
fn ref_render() {
    let scene = "photos/re10k_5aca87f95a9412c6";
    let (Some(scene), Some(reference)) = (shared(scene), shared("fixtures/ref_render")) else {
        return;
    };
    let splats = read_ply(&scene.join("5aca87f95a9412c6.globalsplat16k.ply"));
    let cameras = cameras(&scene.join("cameras.json"));
    let npy = std::fs::read(reference.join("5aca87f95a9412c6_view04_rgb_f32.npy")).unwrap();
    let expected = common::npy::floats(&npy);
    for (convention, least) in [(Convention::Mvsplat, 70.0), (Convention::Standard, 80.0)] {
        let options = RasterOptions::new(convention);
        let picture = subsplat::scene::render(&splats, &cameras[4], &options);
        let clipped = picture.rgb.iter().map(|v| v.clamp(0.0, 1.0));
        let db = psnr(clipped, expected.iter().map(|v| v.clamp(0.0, 1.0)));
        eprintln!("ref_render {convention:?}: {db:.2} dB");
        assert!(db >= least, "{convention:?}: {db} dB");
    }
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(reference.join("expected.json")).unwrap()).unwrap();
    let mut off = 0.0f64;
    for (i, camera) in cameras.iter().enumerate() {
        let photo = image::open(scene.join(format!("images/{i:03}.png"))).unwrap().to_rgb8();
        let options = RasterOptions::new(Convention::Mvsplat);
        let picture = subsplat::scene::render(&splats, camera, &options);
        let db = psnr(
            picture.rgb.iter().map(|v| v.clamp(0.0, 1.0)),
            photo.as_raw().iter().map(|&v| f32::from(v) / 255.0),
        );
        let expected = json["psnr_vs_photo"][i.to_string()].as_f64().unwrap();
        off = off.max((db - expected).abs());
        assert!((db - expected).abs() < 0.05, "view {i}: {db} dB, expected {expected}");
    }
    eprintln!("ref_render: PSNR against 12 photographs within {off:.4} dB");
}
