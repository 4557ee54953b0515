//! A refinement step ([`subsplat::finish::refine()`]) on one photograph beside the forward and backward pass
//! of the rasterizer alone, on the rasterizer's scenes (`common/scene.rs`). A step adds the loss
//! with its gradient and Adam's step of all Gaussians. The photograph is the scene's own picture
//! with other colours. Where there is a GPU, `refinement step on GPU` is a step in its memory, and the row before it the
//! passes of its rasterizer, with the picture and the gradients in host memory. `-- curve FOLDER…` prints the score of new views over the seconds of a refinement
//! instead (`refine/curve.rs`).

mod common;
#[path = "refine/curve.rs"]
mod curve;

use anyhow::{Context, Result, ensure};
use common::scene::{self, SCENES};
use common::{Bench, Contender, Threads};
use subsplat::finish::{PhaseRun, RefineOptions, TargetView};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render::{Renderer, render, slices};
use subsplat_kernels::cpu::Rasterizer;
use subsplat_kernels::gpu::wgpu::PollType;
use subsplat_kernels::gpu::{DeviceChoice, Gpu, Rasterizer as GpuRasterizer};
use subsplat_kernels::layout::{Gradients, RasterOptions};

/// Scenes of the report: 131,072 Gaussians at 256², and 524,288 at 512².
const NAMES: [&str; 2] = ["131k-256", "524k-512"];

fn main() -> Result<()> {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
    if let Some((first, rest)) = words.split_first()
        && first == "curve"
    {
        return curve::print(rest);
    }
    let mut bench = Bench::new("refine")?;
    for spec in SCENES.iter().filter(|s| NAMES.contains(&s.name)) {
        let name = format!("step {}", spec.name);
        if !bench.selects(&name) || (bench.args.quick && spec.side > 256) {
            continue;
        }
        let (splats, camera) = (scene::shared(spec), scene::camera(spec.side));
        let raster = RasterOptions { background: [0.2, 0.1, 0.3], ..RasterOptions::default() };
        let picture = bench.on_all(|| render(&splats, &camera, &raster));
        let other: Vec<f32> = picture.rgb.iter().map(|v| 0.8 * v + 0.05).collect();
        let image = Rgb::from_unit(&other, spec.side, spec.side).context("a picture")?;
        let views = [TargetView { camera: &camera, image: &image }];
        let options = RefineOptions::default().with_steps(usize::MAX);
        let mut checked = PhaseRun::new(&splats, &views, &raster, &options)?;
        let mut renderer = Renderer::default();
        bench.on_all(|| {
            let before = checked.error(&mut renderer);
            (0..8).for_each(|_| checked.step(&mut renderer));
            let after = checked.error(&mut renderer);
            ensure!(after < before, "eight steps raise the error from {before} to {after}");
            Ok(())
        })?;
        // The timed steps hardly change the Gaussians: hundreds of them at full rates would make
        // another scene.
        let mut slow = options;
        for rate in [
            &mut slow.mean_rate,
            &mut slow.rotation_rate,
            &mut slow.scale_rate,
            &mut slow.opacity_rate,
            &mut slow.colour_rate,
        ] {
            *rate *= 1e-6;
        }
        let upstream = vec![1e-3; 5 * spec.side * spec.side];
        let mut contenders = Vec::new();
        for threads in [Threads::One, Threads::All] {
            let (mut rasterizer, mut gradients) = (Rasterizer::new(), Gradients::default());
            let (splats, camera, raster, upstream) = (&splats, &camera, &raster, &upstream);
            contenders.push(Contender::new("rasterizer, both passes", threads, move || {
                rasterizer.backward(&slices(splats), camera, raster, upstream, &mut gradients);
                Ok(())
            }));
        }
        for threads in [Threads::One, Threads::All] {
            let mut phase = PhaseRun::new(&splats, &views, &raster, &slow)?;
            let mut renderer = Renderer::default();
            contenders.push(Contender::new("refinement step", threads, move || {
                phase.step(&mut renderer);
                Ok(())
            }));
        }
        if let Ok(Some(gpu)) = Gpu::open(&DeviceChoice::Gpu) {
            let mut rasterizer = GpuRasterizer::new(gpu.clone());
            let (splats, camera, raster, upstream) = (&splats, &camera, &raster, &upstream);
            contenders.push(Contender::new(
                "GPU rasterizer, both passes",
                Threads::All,
                move || {
                    rasterizer.backward(&slices(splats), camera, raster, upstream)?;
                    Ok(())
                },
            ));
            let mut phase = PhaseRun::new(splats, &views, raster, &slow)?;
            let mut renderer = Renderer::with_gpu(gpu.clone());
            contenders.push(Contender::new("refinement step on GPU", Threads::All, move || {
                phase.step(&mut renderer);
                // A step returns before the device has completed it.
                gpu.device().poll(PollType::wait_indefinitely())?;
                Ok(())
            }));
        }
        bench.group(&name, contenders, "means, quaternions, scales, opacities, colour offsets")?;
    }
    bench.finish()
}
