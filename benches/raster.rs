//! The rasterizer against a conventional one (`common/conventional/raster.rs`) on scenes of a
//! pixel-aligned network (`common/scene.rs`): forward, and the full backward pass.
//!
//! `-- --write DIR` writes the scenes for other programs instead: `NAME.ply`,
//! `NAME.cameras.json`, `NAME.safetensors` (one SH set per splat) and `NAME.shared.safetensors`
//! (one per parent of four). Tensors and metadata contain the camera.

mod common;

use anyhow::Result;
use common::conventional::project::{Gradients as PlainGradients, Options, Splats as Plain};
use common::conventional::raster::Rasterizer as Conventional;
use common::scene::{self, SCENES, Spec};
use common::{Bench, Contender, Threads, Work, agree};
use glam::{Mat4, Vec3};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use std::collections::HashMap;
use std::path::Path;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::files::poses::scene::Units;
use subsplat::files::{save_splats, write_atomic};
use subsplat::scene::levels::{CELL_PX, Levels};
use subsplat::scene::metrics::psnr;
use subsplat::scene::render::slices;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::{Gradients, Rasterizer, Rendered, SimdLevel, Stats};
#[cfg(feature = "gpu")]
use subsplat_kernels::gpu::{DeviceChoice, Gpu, Rasterizer as GpuRasterizer};
use subsplat_kernels::layout::RasterOptions;
use subsplat_test_support::oracle;

/// Half side of a splat's box in σ, for timing the baseline: the value of most programs.
const BOX: f32 = 3.0;
/// Half side of a box that cuts no pixel of alpha ≥ 1/255, for checking the baseline.
const EXACT_BOX: f32 = 3.34;
/// Minimum multiplications and additions of one splat at one pixel: exponent 9, 2^x 13, alpha and
/// transmittance 4, four sums 9.
const FLOPS_PER_PIXEL: f64 = 35.0;
/// The same for one projection: camera 15, J·W 12, rotation 30, M 36, covariance 15, conic and
/// extent 40.
const FLOPS_PER_SPLAT: f64 = 150.0;
/// Tolerance of pictures: all but three thousandths of the numbers within 5e-5. Elsewhere a
/// splat's threshold of 1/255 may flip, more often the more splats a pixel has.
const PICTURE: [f32; 3] = [5e-5, 0.2, 3e-3];
/// Tolerance of gradients: their f32 sums over many pixels cancel.
const GRADIENT: [f32; 3] = [2e-4, 0.2, 1e-3];
/// Distances of the camera in the group of the levels, relative to the scene's camera.
const DISTANCES: [f32; 4] = [1.0, 2.0, 4.0, 8.0];
/// Side of a picture that the naive oracle renders in seconds, px.
const NAIVE_SIDE: usize = 128;

fn main() -> Result<()> {
    let mut bench = Bench::new("raster")?;
    if let Some(folder) = bench.args.write.clone() {
        return write(&folder, &bench);
    }
    for spec in &SCENES {
        if bench.args.quick && !["8k-128", "131k-512"].contains(&spec.name) {
            continue;
        }
        let shared = || scene::shared(spec);
        let forms: [(&str, &dyn Fn() -> Splats); 2] =
            [("shared", &shared), ("own", &|| scene::unshared(&shared()))];
        for (form, splats) in forms {
            let names = ["forward", "backward"].map(|p| format!("{p} {} {form}", spec.name));
            // One SH set per splat measures memory rather than rasterization.
            let extra = form == "own" && spec.name != "131k-512" && spec.name != "524k-512";
            if extra || !names.iter().any(|n| bench.selects(n)) {
                continue;
            }
            let case = Case::new(spec, splats());
            let stats = case.check(&bench)?;
            if bench.selects(&names[0]) {
                forward(&mut bench, &names[0], &case, stats)?;
            }
            if bench.selects(&names[1]) {
                backward(&mut bench, &names[1], &case)?;
            }
        }
    }
    let spec = if bench.args.quick { "131k-512" } else { "524k-512" };
    for spec in SCENES.iter().filter(|s| s.name == spec) {
        levels(&mut bench, spec)?;
    }
    bench.finish()
}

/// Times frames with and without level of detail, the camera at several times the distance of the middle
/// Gaussian. Moving Gaussians to the selection is apart: a viewer does it once for many frames.
fn levels(bench: &mut Bench, spec: &Spec) -> Result<()> {
    let name = |far: f32| format!("levels x{far} {}", spec.name);
    if !DISTANCES.iter().any(|far| bench.selects(&name(*far))) {
        return Ok(());
    }
    let case = Case::new(spec, scene::shared(spec));
    let start = std::time::Instant::now();
    let levels = bench.on_all(|| Levels::new(&case.splats));
    let made = format!("{} merged, made in {:.2?}", levels.coarse_len(), start.elapsed());
    let forward = case.camera.rotation().z_axis;
    let eye = case.camera.position();
    let mut depths: Vec<f32> =
        case.splats.means().map(|m| (Vec3::from_array(m) - eye).dot(forward)).collect();
    let middle = *depths.select_nth_unstable_by(case.splats.len() / 2, f32::total_cmp).1;
    for far in DISTANCES {
        if !bench.selects(&name(far)) {
            continue;
        }
        let back = Mat4::from_translation(-forward * (middle * (far - 1.0)));
        let pose = back * case.camera.world_from_camera();
        let camera = Camera::new(case.camera.intrinsics(), pose)?;
        let gather = || levels.gather(&case.splats, &levels.select(&camera, CELL_PX));
        let chosen = gather()?;
        let [whole, fewer] = [&case.splats, &chosen]
            .map(|s| Rasterizer::new().render(&slices(s), &camera, &case.options));
        let psnr = psnr(&fewer.rgb, &whole.rgb, spec.side, spec.side)?;
        let draw = |splats: &'_ Splats, out: &mut (Rasterizer, Rendered)| {
            out.0.render_into(&slices(splats), &camera, &case.options, &mut out.1);
        };
        let mut outs = [(); 2].map(|()| (Rasterizer::new(), Rendered::default()));
        let [all, few] = &mut outs;
        let contenders = vec![
            Contender::new("all Gaussians", Threads::All, || {
                draw(&case.splats, all);
                Ok(())
            }),
            Contender::new("those of the levels", Threads::All, || {
                draw(&chosen, few);
                Ok(())
            }),
            Contender::new("selecting and copying those", Threads::All, || {
                std::hint::black_box(gather()?);
                Ok(())
            }),
        ];
        let share = 100.0 * chosen.len() as f64 / case.splats.len() as f64;
        let note = format!("{share:.1} % of {}, {psnr:.1} dB; {made}", case.splats.len());
        bench.group(&name(far), contenders, &note)?;
    }
    Ok(())
}

/// A scene with its camera.
struct Case {
    splats: Splats,
    camera: Camera,
    options: RasterOptions,
    naive: bool,
}

impl Case {
    fn new(spec: &Spec, splats: Splats) -> Self {
        let options = RasterOptions { background: [0.2, 0.1, 0.3], ..RasterOptions::default() };
        let naive = spec.side <= NAIVE_SIDE;
        Self { splats, camera: scene::camera(spec.side), options, naive }
    }

    fn plain(&self) -> Plain<'_> {
        let s = &self.splats;
        Plain { rows: s.rows(), sh: s.sh(), gain: s.gain(), sh_degree: s.sh_degree() }
    }

    fn plain_options(&self, box_sigmas: f32) -> Options {
        Options {
            near: self.options.near,
            lowpass: self.options.lowpass,
            antialiased: false,
            background: self.options.background,
            box_sigmas,
        }
    }

    /// Returns the gradients of picture and alpha for the backward passes.
    fn seeds(&self) -> (Vec<f32>, Vec<f32>) {
        let pixels = (self.camera.intrinsics().width * self.camera.intrinsics().height) as u64;
        let seeds = |stream: u64, n: u64| (0..n).map(|i| scene::normal(stream, i)).collect();
        (seeds(50, 3 * pixels), seeds(51, pixels))
    }

    /// Compares the picture with the baseline's, and a small one with the naive oracle's.
    fn check(&self, bench: &Bench) -> Result<Stats> {
        let mut ours = Rasterizer::new();
        let got = bench.on_all(|| ours.render(&slices(&self.splats), &self.camera, &self.options));
        let mut plain = Conventional::default();
        plain.forward(&self.plain(), &self.camera, self.plain_options(EXACT_BOX));
        agree("rgb", &got.rgb, &plain.frame.rgb, PICTURE)?;
        agree("alpha", &got.alpha, &plain.frame.alpha, PICTURE)?;
        agree("depth_sum", &got.depth_sum, &plain.frame.depth_sum, PICTURE)?;
        if self.naive {
            let naive = self.naive();
            let rgb: Vec<f32> = naive.rgb.iter().map(|&v| v as f32).collect();
            agree("rgb of the oracle", &got.rgb, &rgb, PICTURE)?;
        }
        Ok(ours.stats())
    }

    fn naive(&self) -> oracle::Picture {
        let s = &self.splats;
        let one = |i: usize| {
            let (gain, residual) = s.gain_of(i);
            oracle::Splat {
                mean: s.mean(i),
                shape: oracle::Shape::Quat(s.quat_wxyz(i), s.scale(i)),
                opacity: s.opacity(i),
                sh: s.sh_of(i).chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
                gain,
                residual,
                parent_mean: [0.0; 3],
            }
        };
        let splats: Vec<oracle::Splat> = (0..s.len()).map(one).collect();
        oracle::render(&splats, &self.camera, &self.options)
    }

    /// Returns the minimum work of a forward pass, from the rasterizer's counts.
    fn work(&self, stats: Stats) -> Work {
        let s = &self.splats;
        let (n, pairs) = (s.len() as f64, stats.pairs as f64);
        let pixels = (self.camera.intrinsics().width * self.camera.intrinsics().height) as f64;
        let input = 4.0 * (s.rows().len() + s.sh().len() + s.gain().len()) as f64;
        // A 64-byte record per splat, written and read per tile; sort keys and values, written
        // and read three times; lists, written and read; RGB, alpha, depth.
        let bytes = input + 64.0 * (n + pairs) + 48.0 * n + 8.0 * pairs + 20.0 * pixels;
        let sh = 2.0 * s.sh().len() as f64 + 40.0 * s.parents() as f64;
        let flops = 16.0 * FLOPS_PER_PIXEL * stats.items as f64 + FLOPS_PER_SPLAT * n + sh;
        Work { bytes, flops }
    }
}

fn forward(bench: &mut Bench, name: &str, case: &Case, stats: Stats) -> Result<()> {
    let mut plain = Conventional::default();
    let mut contenders = vec![Contender::new("conventional, scalar", Threads::One, move || {
        plain.forward(&case.plain(), &case.camera, case.plain_options(BOX));
        Ok(())
    })];
    let one = SimdLevel::available().iter().map(|&level| (Threads::One, level));
    for (threads, level) in one.chain([(Threads::All, SimdLevel::best())]) {
        let (mut ours, mut out) = (Rasterizer::new().with_simd_level(level), Rendered::default());
        let run = move || {
            ours.render_into(&slices(&case.splats), &case.camera, &case.options, &mut out);
            Ok(())
        };
        let name = format!("subsplat, {}", level.name());
        let contender = Contender::new(name, threads, run);
        contenders.push(contender.with_work(case.work(stats)));
    }
    if case.naive && !bench.args.quick {
        contenders.push(Contender::new("naive oracle, f64", Threads::One, || {
            std::hint::black_box(case.naive());
            Ok(())
        }));
    }
    let mut stages = String::new();
    #[cfg(feature = "gpu")]
    if let Ok(Some(gpu)) = Gpu::open(&DeviceChoice::Gpu) {
        let name = format!("subsplat, {}", gpu.adapter().name);
        let mut ours = GpuRasterizer::new(gpu).with_stage_times();
        let got = ours.render(&slices(&case.splats), &case.camera, &case.options)?;
        let expected = Rasterizer::new().render(&slices(&case.splats), &case.camera, &case.options);
        agree("rgb of the GPU", &got.rgb, &expected.rgb, PICTURE)?;
        stages = stages_of(ours.pairs(), ours.stage_times());
        contenders.push(Contender::new(name, Threads::All, move || {
            ours.render(&slices(&case.splats), &case.camera, &case.options)?;
            Ok(())
        }));
    }
    let note = format!(
        "{} of {} splats visible, {} (splat, tile) pairs, {} block items, {:.0} MiB held{stages}",
        stats.visible,
        case.splats.len(),
        stats.pairs,
        stats.items,
        stats.bytes as f64 / f64::from(1 << 20)
    );
    bench.group(name, contenders, &note)
}

/// Formats the time of each stage on the device for a group's note.
#[cfg(feature = "gpu")]
fn stages_of(pairs: usize, times: &[(&'static str, std::time::Duration)]) -> String {
    let each = |(stage, time): &(&str, std::time::Duration)| {
        format!(", {stage} {:.1} ms", 1e3 * time.as_secs_f64())
    };
    format!("; GPU: {pairs} pairs{}", times.iter().map(each).collect::<String>())
}

fn backward(bench: &mut Bench, name: &str, case: &Case) -> Result<()> {
    let seeds = case.seeds();
    check_gradients(bench, case, &seeds)?;
    let (v_rgb, v_alpha) = &seeds;
    let options = case.plain_options(BOX);
    let forward = |plain: &mut Conventional| plain.forward(&case.plain(), &case.camera, options);
    let backward = |plain: &Conventional| {
        let g = plain.backward(&case.plain(), &case.camera, options, v_rgb, v_alpha);
        std::hint::black_box(g);
    };
    let mut plain = [false, true].map(Conventional::new);
    plain.iter_mut().for_each(forward);
    let [recomputes, stores] = &plain;
    let mut both = Conventional::default();
    let planes = &planes(&seeds);
    let mut kept: [(Frames, Vec<f32>); 2] = Default::default();
    let (mut one, mut all) = (Frames::default(), Frames::default());
    let (mut drawn_one, mut drawn_all) = (Frames::default(), Frames::default());
    let mut contenders = vec![
        Contender::new("conventional, backward alone", Threads::One, || {
            backward(recomputes);
            Ok(())
        }),
        Contender::new("conventional, stores the blended splats", Threads::One, || {
            backward(stores);
            Ok(())
        }),
        Contender::new("conventional, both passes", Threads::One, || {
            forward(&mut both);
            backward(&both);
            Ok(())
        }),
    ];
    for ((frames, picture), threads) in kept.iter_mut().zip([Threads::One, Threads::All]) {
        let slices = slices(&case.splats);
        let mut frame = frames.rasterizer.frame(slices, &case.camera, &case.options, picture);
        let gradients = &mut frames.gradients;
        contenders.push(Contender::new("subsplat, backward alone", threads, move || {
            frame.backward(planes, gradients);
            Ok(())
        }));
    }
    for (threads, frames) in [(Threads::One, &mut one), (Threads::All, &mut all)] {
        contenders.push(Contender::new("subsplat, both passes", threads, move || {
            let slices = slices(&case.splats);
            let (camera, options) = (&case.camera, &case.options);
            frames.rasterizer.backward(&slices, camera, options, planes, &mut frames.gradients);
            Ok(())
        }));
    }
    // What a call of `subsplat.torch.rasterization` with its backward pass does.
    for (threads, frames) in [(Threads::One, &mut drawn_one), (Threads::All, &mut drawn_all)] {
        let mut picture = Rendered::default();
        contenders.push(Contender::new("subsplat, picture, then gradients", threads, move || {
            let slices = slices(&case.splats);
            let (camera, options) = (&case.camera, &case.options);
            let Frames { rasterizer, gradients } = &mut *frames;
            rasterizer.render_into(&slices, camera, options, &mut picture);
            rasterizer.backward_of_last(&slices, camera, options, planes, gradients);
            Ok(())
        }));
    }
    let mut note = "gradients of all inputs".to_owned();
    #[cfg(feature = "gpu")]
    if let Ok(Some(gpu)) = Gpu::open(&DeviceChoice::Gpu) {
        let name = format!("subsplat, {}, both passes", gpu.adapter().name);
        let mut ours = GpuRasterizer::new(gpu).with_stage_times();
        let slices = slices(&case.splats);
        let (camera, options) = (&case.camera, &case.options);
        let mut frame = ours.frame(&slices, camera, options)?.1;
        let got = frame.backward(planes)?;
        let mut cpu = Frames::default();
        bench.on_all(|| {
            cpu.rasterizer.backward(&slices, camera, options, planes, &mut cpu.gradients);
        });
        let g = &cpu.gradients;
        agree_all("GPU, ", &got, [&g.rows, &g.sh, &g.gain, &g.background])?;
        let times = [ours.stage_times(), frame.stage_times()].concat();
        note.push_str(&stages_of(ours.pairs(), &times));
        contenders.push(Contender::new(name, Threads::All, move || {
            std::hint::black_box(ours.backward(&slices, camera, options, planes)?);
            Ok(())
        }));
    }
    bench.group(name, contenders, &note)
}

/// A rasterizer with the buffers of its results.
#[derive(Default)]
struct Frames {
    rasterizer: Rasterizer,
    gradients: Gradients,
}

/// Returns `[5, H, W]` from the gradients of RGB `[H, W, 3]` and alpha `[H, W]`.
fn planes((v_rgb, v_alpha): &(Vec<f32>, Vec<f32>)) -> Vec<f32> {
    let mut planes: Vec<f32> = Vec::with_capacity(5 * v_alpha.len());
    for c in 0..3 {
        planes.extend(v_rgb.iter().skip(c).step_by(3));
    }
    planes.extend(v_alpha);
    planes.resize(5 * v_alpha.len(), 0.0);
    planes
}

/// Compares the gradients with the baseline's, column by column.
fn check_gradients(bench: &Bench, case: &Case, seeds: &(Vec<f32>, Vec<f32>)) -> Result<()> {
    let mut plain = Conventional::default();
    let options = case.plain_options(EXACT_BOX);
    plain.forward(&case.plain(), &case.camera, options);
    let expected: PlainGradients =
        plain.backward(&case.plain(), &case.camera, options, &seeds.0, &seeds.1);
    let mut ours = Frames::default();
    bench.on_all(|| {
        let (slices, planes) = (slices(&case.splats), planes(seeds));
        let out = &mut ours.gradients;
        ours.rasterizer.backward(&slices, &case.camera, &case.options, &planes, out);
    });
    let e = &expected;
    agree_all("", &ours.gradients, [&e.rows, &e.sh, &e.gain, &e.background])
}

/// Compares gradients with those of rows, SH, gain and background.
fn agree_all(whose: &str, got: &Gradients, [rows, sh, gain, back]: [&[f32]; 4]) -> Result<()> {
    for lane in 0..11 {
        let column = |rows: &[f32]| rows.iter().skip(lane).step_by(11).copied().collect::<Vec<_>>();
        let what = format!("{whose}gradient of column {lane}");
        agree(&what, &column(&got.rows), &column(rows), GRADIENT)?;
    }
    agree(&format!("{whose}gradient of sh"), &got.sh, sh, GRADIENT)?;
    agree(&format!("{whose}gradient of the background"), &got.background, back, GRADIENT)?;
    if !gain.is_empty() {
        agree(&format!("{whose}gradient of gain"), &got.gain, gain, GRADIENT)?;
    }
    Ok(())
}

fn write(folder: &Path, bench: &Bench) -> Result<()> {
    std::fs::create_dir_all(folder)?;
    let mut written = Vec::new();
    for spec in SCENES.iter().filter(|s| bench.selects(s.name)) {
        let at = |ending: &str| folder.join(format!("{}.{ending}", spec.name));
        let (splats, camera) = (scene::shared(spec), scene::camera(spec.side));
        save_splats(at("ply"), &splats, &Default::default())?;
        let file = format!("{}.png", spec.name);
        let camera_only = NamedCamera::new(file, camera);
        let cameras = CameraFile {
            cameras: vec![camera_only],
            units: Units::Unknown,
            near_far: None,
            ..Default::default()
        };
        save_cameras_json(at("cameras.json"), &cameras)?;
        write_tensors(&at("shared.safetensors"), &splats, &camera)?;
        write_tensors(&at("safetensors"), &scene::unshared(&splats), &camera)?;
        written.push(spec.name);
    }
    println!("{}: {}", folder.display(), written.join(", "));
    Ok(())
}

/// Tensors and metadata under the names of the conformance cases.
fn write_tensors(path: &Path, splats: &Splats, camera: &Camera) -> Result<()> {
    let (n, p, d) = (splats.len(), splats.parents(), splats.sh_coefficients());
    let column = |from: usize, lanes: usize| -> Vec<f32> {
        splats.rows().chunks_exact(11).flat_map(|r| r[from..from + lanes].iter().copied()).collect()
    };
    let k = camera.intrinsics();
    let pose = camera.world_from_camera().transpose().to_cols_array().to_vec();
    let mut tensors = vec![
        ("means", vec![n, 3], column(0, 3)),
        ("quats", vec![n, 4], column(3, 4)),
        ("scales", vec![n, 3], column(7, 3)),
        ("opacities", vec![n], column(10, 1)),
        ("sh", vec![p, d, 3], splats.sh().to_vec()),
        ("intrinsics", vec![4], vec![k.fx, k.fy, k.cx, k.cy]),
        ("world_from_camera", vec![4, 4], pose.clone()),
        ("background", vec![3], vec![0.0; 3]),
    ];
    if !splats.gain().is_empty() {
        tensors.push(("gain", vec![n], splats.gain().to_vec()));
    }
    let list = |v: &[f32]| v.iter().map(f32::to_string).collect::<Vec<_>>().join(",");
    let metadata = [
        ("width", k.width.to_string()),
        ("height", k.height.to_string()),
        ("intrinsics", list(&[k.fx, k.fy, k.cx, k.cy])),
        ("world_from_camera", list(&pose)),
        ("children", (n / p).to_string()),
        ("sh_degree", splats.sh_degree().to_string()),
        ("near", "0.01".to_owned()),
        ("lowpass", "0.3".to_owned()),
        ("axes", "OpenCV: x right, y down, z forward; quaternions wxyz; sigma".to_owned()),
        ("maker", "cargo bench --bench raster -- --write".to_owned()),
    ];
    let metadata: HashMap<String, String> =
        metadata.into_iter().map(|(k, v)| (k.to_owned(), v)).collect();
    let bytes: Vec<(&str, Vec<usize>, Vec<u8>)> = tensors
        .into_iter()
        .map(|(name, shape, data)| {
            (name, shape, data.iter().flat_map(|v| v.to_le_bytes()).collect())
        })
        .collect();
    let views: Result<Vec<_>, _> = bytes
        .iter()
        .map(|(name, shape, data)| Ok((*name, TensorView::new(Dtype::F32, shape.clone(), data)?)))
        .collect::<Result<_, safetensors::SafeTensorError>>();
    let file = safetensors::serialize(views?, Some(metadata))?;
    write_atomic(path, |f| std::io::Write::write_all(f, &file))?;
    Ok(())
}
