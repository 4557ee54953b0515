//! `subsplat view`: a window that shows a scene. `source` provides the splats, `canvas` draws
//! them, `controls` interprets keys and mouse, and `window` joins the three. The camera moves by
//! [`subsplat::scene::navigation`].
//!
//! A change draws two frames: the first measures the number of pairs, and the second has buffers
//! for them. A background thread makes and uploads the children for another r. The device has the
//! adapter's binding limits, not WebGPU's defaults. `detail` replaces far parts of a scene by fewer
//! Gaussians.

mod canvas;
mod controls;
mod detail;
mod pictures;
mod source;
mod window;

use super::args::view::{LevelsArg, ViewArgs};
use super::memory;
use crate::report::{Answer, Progress, print_line};
use anyhow::{Context, Result, bail};
use serde_json::json;
use std::convert::Infallible;
use std::path::PathBuf;
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::DeviceChoice;
use winit::event_loop::EventLoop;

/// The arguments of the window, checked.
pub struct Plan {
    /// Initial size, px; `None` for the first camera's.
    size: Option<(usize, usize)>,
    device: DeviceChoice,
    /// Number of frames to draw; `None` until the user closes the window.
    frames: Option<usize>,
    /// File for the last of `frames`.
    save: Option<PathBuf>,
    /// Folder for pictures.
    out: PathBuf,
    /// True if far parts are drawn with fewer Gaussians.
    levels: bool,
}

/// Runs the command.
pub fn view(args: &ViewArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    let plan = plan(args)?;
    // Display and adapter are checked before minutes of work.
    let events = EventLoop::with_user_event().build().map_err(no_display)?;
    adapter(&plan.device)?;
    let source = source::open(args, &mut progress)?;
    if plan.frames.is_none() {
        print_line("H shows the keys");
    }
    let done = window::run(events, plan, source)?;
    let saved: Vec<String> = done.saved.iter().map(|p| p.display().to_string()).collect();
    answer.line(format!(
        "{}: {} splats, {} pictures on {}{}",
        done.name,
        done.gaussians,
        done.frames,
        done.adapter,
        done.fps.map_or(String::new(), |fps| format!(", {fps:.1} a second"))
    ));
    answer.finish(&json!({
        "scene": done.name,
        "gaussians": done.gaussians,
        "drawn": done.drawn,
        "upscale": done.upscale,
        "device": done.adapter,
        "frames": done.frames,
        "frames_per_second": done.fps,
        "size": [done.size.0, done.size.1],
        "files": saved,
        "seconds": progress.seconds(),
    }))
}

/// Checks the arguments.
fn plan(args: &ViewArgs) -> Result<Plan> {
    let size = args.size;
    size.map_or(Ok(()), |size| memory::check_picture("--size", size))?;
    source::check(args)?;
    let device = args.device.parse().unwrap_or_else(|e: Infallible| match e {});
    if device == DeviceChoice::Cpu {
        // `ViewArgs::conflict` reports it first.
        bail!("--device: expected auto, gpu or an adapter's name, got cpu");
    }
    let frames = args.frames;
    let save = args.save.clone();
    let out = args.out.clone();
    let levels = args.levels == LevelsArg::Auto;
    Ok(Plan { size, device, frames, save, out, levels })
}

/// Rejects a choice without an adapter.
fn adapter(choice: &DeviceChoice) -> Result<()> {
    let found = gpu::choose(choice, &gpu::adapters())?;
    found.map(|_| ()).with_context(|| format!("no GPU: expected {choice}, found none"))
}

/// Extracts the system's message, without the position in winit's source before it.
fn no_display(error: winit::error::EventLoopError) -> anyhow::Error {
    let text = error.to_string();
    let words = match text.strip_prefix("os error at ") {
        Some(rest) => rest.split_once(": ").map_or(rest, |(_, words)| words),
        None => &text,
    };
    anyhow::anyhow!("no display for a window: {}", words.trim_end_matches('.'))
}
