//! The window: it passes events to the navigator and frames to the canvas, and makes children in
//! the background.

use super::Plan;
use super::canvas::{Canvas, Frame};
use super::controls::{Controls, Drag, KeyAction};
use super::detail::{Detail, Fit, Outcome};
use super::pictures::save_next;
use super::source::{Made, Photographs, Source};
use crate::commands::args::view::KEYS;
use crate::report::{print_line, print_warning};
use anyhow::{Context, Result};
use glam::Vec2;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use subsplat::files::photos::image::save_png;
use subsplat::scene::navigation::{Mode, Navigator, Pace};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::render::slices;
use subsplat_kernels::gpu::{Gpu, Scene};
use subsplat_kernels::layout::RasterOptions;
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::{KeyEvent, StartCause, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::keyboard::PhysicalKey;
use winit::window::{Window, WindowId};

/// Largest default size of the window, px.
const SIZE_MAX: (usize, usize) = (1280, 960);
/// Frames after a change: the first one shows it. The second one has buffers for all splats,
/// which the first one requested.
const SETTLE: u32 = 2;
/// Delay before the next attempt where the window has no texture for a frame.
const RETRY: Duration = Duration::from_millis(50);
/// Shortest time between two titles during an animation.
const TITLE_EVERY: Duration = Duration::from_millis(250);
/// Duration of a movement in the first frame of an animation, seconds.
const STEP_DEFAULT: f32 = 1.0 / 60.0;
/// Longest duration of a movement in one frame, seconds.
const STEP_MAX: f32 = 0.25;
/// Weight of a new frame's time in the mean.
const NEW_WEIGHT: f32 = 0.1;

/// Statistics of the window.
pub struct Done {
    pub name: String,
    pub gaussians: usize,
    /// Gaussians of the last frame.
    pub drawn: usize,
    pub upscale: Option<usize>,
    pub adapter: String,
    pub frames: usize,
    pub fps: Option<f32>,
    pub size: (usize, usize),
    pub saved: Vec<PathBuf>,
}

/// A message of the background thread.
pub enum Message {
    /// A stage begins.
    Stage(&'static str),
    /// r×r children per pixel are ready. Further, refined ones may follow.
    Made(usize, Ready),
    /// The work on r×r children per pixel has ended, or failed.
    Done(usize, Result<(), String>),
    /// A task for the level of detail of the scene of this number has ended.
    Detail(usize, Outcome),
}

/// Splats in device memory.
pub struct Ready {
    scene: Scene,
    options: RasterOptions,
    detail: Detail,
    /// Unlike that of any other scene.
    number: usize,
}

/// Opens a window and shows `source` until the user or the plan ends it.
pub fn run(events: EventLoop<Message>, plan: Plan, source: Source) -> Result<Done> {
    let mut viewer = Viewer::new(plan, source, events.create_proxy());
    events.set_control_flow(ControlFlow::Wait);
    events.run_app(&mut viewer).context("window")?;
    viewer.outcome?;
    let canvas = viewer.canvas.context("window: closed before it opened")?;
    let shown = viewer.ready.get(&viewer.current);
    Ok(Done {
        gaussians: shown.map_or(0, |r| r.scene.len()),
        drawn: viewer.splats,
        upscale: (viewer.current > 0).then_some(viewer.current),
        adapter: canvas.gpu().adapter().to_string(),
        frames: viewer.drawn,
        fps: viewer.rate.fps(),
        size: canvas.size(),
        saved: viewer.saved,
        name: viewer.name,
    })
}

/// Mean time between frames of an animation.
#[derive(Default)]
struct Rate {
    last: Option<Instant>,
    /// True if the first frame is over, in which kernels are compiled.
    warm: bool,
    mean: Option<f32>,
}

impl Rate {
    /// Begins a frame, which `follows` the last one in an animation; returns the duration of its
    /// movement, seconds.
    fn begin(&mut self, now: Instant, follows: bool) -> f32 {
        let since = self.last.replace(now).filter(|_| follows);
        let Some(seconds) = since.map(|last| (now - last).as_secs_f32()) else {
            return STEP_DEFAULT;
        };
        if std::mem::replace(&mut self.warm, true) {
            self.mean = Some(self.mean.map_or(seconds, |m| m + NEW_WEIGHT * (seconds - m)));
        }
        seconds.min(STEP_MAX)
    }

    fn fps(&self) -> Option<f32> {
        self.mean.filter(|m| *m > 0.0).map(|m| 1.0 / m)
    }
}

struct Viewer {
    plan: Plan,
    name: String,
    photographs: Option<Arc<Photographs>>,
    proxy: EventLoopProxy<Message>,
    /// The source's splats, before the device is open.
    first: Option<Made>,
    canvas: Option<Canvas>,
    navigator: Navigator,
    controls: Controls,
    /// By r; the key of a finished scene is 0.
    ready: BTreeMap<usize, Ready>,
    /// r of the splats that are shown.
    current: usize,
    /// r of the splats that were shown before.
    before: usize,
    /// r that the user requested last.
    requested: usize,
    /// r that the background thread works on, and its stage.
    busy: Option<(usize, &'static str)>,
    /// Frames to draw without a further change.
    due: u32,
    /// True if an animation runs.
    running: bool,
    /// True if the next frame is to be saved.
    picture: bool,
    drawn: usize,
    /// True if far parts are drawn with fewer Gaussians.
    levels: bool,
    /// Gaussians of the last frame.
    splats: usize,
    rate: Rate,
    title: (String, Option<Instant>),
    saved: Vec<PathBuf>,
    outcome: Result<()>,
}

impl Viewer {
    fn new(plan: Plan, source: Source, proxy: EventLoopProxy<Message>) -> Self {
        let current = source.made.upscale.unwrap_or(0);
        Self {
            levels: plan.levels,
            splats: 0,
            plan,
            name: source.name,
            photographs: source.photographs.map(Arc::new),
            proxy,
            first: Some(source.made),
            canvas: None,
            navigator: Navigator::new(source.start),
            controls: Controls::default(),
            ready: BTreeMap::new(),
            current,
            before: current,
            requested: current,
            busy: None,
            due: SETTLE,
            running: false,
            picture: false,
            drawn: 0,
            rate: Rate::default(),
            title: (String::new(), None),
            saved: Vec::new(),
            outcome: Ok(()),
        }
    }

    fn open(&mut self, events: &ActiveEventLoop) -> Result<()> {
        let (width, height) = self.plan.size.unwrap_or_else(|| {
            let k = self.navigator.camera().intrinsics();
            let sides = [(SIZE_MAX.0, k.width), (SIZE_MAX.1, k.height)];
            let scale = sides.map(|(most, side)| most as f32 / side as f32);
            let scale = scale.into_iter().fold(1.0, f32::min);
            let side = |v: usize| ((v as f32 * scale) as usize).max(1);
            (side(k.width), side(k.height))
        });
        let size = PhysicalSize::new(width as u32, height as u32);
        let attributes = Window::default_attributes().with_title(&self.name).with_inner_size(size);
        let window = events.create_window(attributes).context("window")?;
        let canvas = Canvas::open(Arc::new(window), &self.plan.device)?;
        print_line(format!("drawing on {}", canvas.gpu().adapter()));
        if let Some(made) = self.first.take() {
            self.ready.insert(self.current, upload(canvas.gpu(), made)?);
        }
        self.canvas = Some(canvas);
        self.change();
        if self.photographs.as_ref().is_some_and(|p| p.is_unrefined()) {
            self.make_requested();
        }
        Ok(())
    }

    /// Draws the frames after a change.
    fn change(&mut self) {
        self.due = SETTLE;
        self.redraw();
    }

    fn redraw(&self) {
        if let Some(canvas) = &self.canvas {
            canvas.window().request_redraw();
        }
    }

    /// True if another frame follows without an event.
    fn goes_on(&self) -> bool {
        self.due > 0 || self.picture || self.controls.moving() || self.plan.frames.is_some()
    }

    fn frame(&mut self, events: &ActiveEventLoop) -> Result<()> {
        let Some(canvas) = &mut self.canvas else { return Ok(()) };
        let Some(ready) = self.ready.get_mut(&self.current) else { return Ok(()) };
        let seconds = self.rate.begin(Instant::now(), self.running);
        if self.controls.moving() {
            let (along, fast) = self.controls.motion();
            self.navigator.fly(along, seconds, if fast { Pace::Fast } else { Pace::Normal });
            self.due = SETTLE;
        }
        let last = self.plan.frames.is_some_and(|n| self.drawn + 1 >= n);
        let capture = self.picture || (last && self.plan.save.is_some());
        let navigator = &mut self.navigator;
        let mut camera = |width, height| {
            navigator.resize(width, height);
            navigator.camera()
        };
        let (width, height) = canvas.size();
        let now = camera(width, height);
        // A picture that is saved depends on the camera only.
        let exact = self.levels && (self.picture || self.plan.frames.is_some());
        if exact && let Err(e) = ready.detail.complete(&now, canvas.gpu()) {
            print_warning(format!("far splats cannot be merged: {e:#}; all splats are drawn"));
        }
        let fit = if exact { Fit::Exact } else { Fit::Fine };
        let coarser = self.levels.then(|| ready.detail.scene(&now, fit)).flatten();
        let scene = coarser.unwrap_or(&ready.scene);
        self.splats = scene.len();
        let frame = match canvas.draw(scene, &ready.options, camera, capture) {
            Ok(frame) => frame,
            Err(e) if self.before != self.current && !canvas.is_lost() => {
                print_warning(format!(
                    "the scene at x{} cannot be drawn: {e:#}; x{} is shown again",
                    self.current, self.before
                ));
                self.ready.remove(&self.current);
                (self.current, self.requested) = (self.before, self.before);
                self.change();
                return Ok(());
            }
            Err(e) => return Err(e),
        };
        let Frame::Shown(picture) = frame else {
            self.running = false;
            events.set_control_flow(ControlFlow::WaitUntil(Instant::now() + RETRY));
            return Ok(());
        };
        self.before = self.current;
        self.drawn += 1;
        self.due = self.due.saturating_sub(1);
        self.keep(picture, last)?;
        if last {
            events.exit();
            return Ok(());
        }
        self.running = self.goes_on();
        if self.running {
            self.redraw();
        }
        self.continue_detail();
        self.update_title();
        Ok(())
    }

    /// Starts the next task for the level of detail, unless the scene is about to change.
    fn continue_detail(&mut self) {
        let (true, None, Some(canvas)) = (self.levels, self.busy, &self.canvas) else { return };
        let Some(ready) = self.ready.get_mut(&self.current) else { return };
        let camera = self.navigator.camera();
        let Some(task) = ready.detail.missing(&camera, Fit::Fine) else { return };
        let number = ready.number;
        let gpu = canvas.gpu().clone();
        let proxy = self.proxy.clone();
        // A closed event loop needs no message.
        let work = move || drop(proxy.send_event(Message::Detail(number, task.run(&gpu))));
        if let Err(e) = std::thread::Builder::new().name("levels".to_owned()).spawn(work) {
            self.finish_detail(number, Outcome::Failed(e.into()));
        }
    }

    /// Takes the result of a task for the level of detail. A scene that was replaced needs none.
    fn finish_detail(&mut self, number: usize, outcome: Outcome) {
        let Some(ready) = self.ready.values_mut().find(|r| r.number == number) else { return };
        match ready.detail.finish(outcome) {
            Ok(()) => self.change(),
            Err(e) => {
                print_warning(format!("far splats cannot be merged: {e:#}; all splats are drawn"))
            }
        }
    }

    /// Saves a frame where it was requested.
    fn keep(&mut self, picture: Option<Rgb>, last: bool) -> Result<()> {
        let Some(picture) = picture else { return Ok(()) };
        if std::mem::take(&mut self.picture) {
            match save_next(&self.plan.out, &self.name, &picture) {
                Ok(path) => {
                    print_line(format!("saved {}", path.display()));
                    self.saved.push(path);
                }
                Err(e) => print_warning(format!("{e:#}")),
            }
        }
        if let Some(path) = self.plan.save.clone().filter(|_| last) {
            save_png(&path, &picture)?;
            self.saved.push(path);
        }
        Ok(())
    }

    /// Updates the title, at most once per [`TITLE_EVERY`] during an animation.
    fn update_title(&mut self) {
        let Some(canvas) = &self.canvas else { return };
        let all = self.ready.get(&self.current).map_or(0, |r| r.scene.len());
        let splats = match self.splats {
            drawn if drawn == all || drawn == 0 => all.to_string(),
            drawn => format!("{drawn} of {all}"),
        };
        let fps = self.rate.fps().map_or(String::new(), |fps| {
            let digits = usize::from(fps < 10.0);
            format!(", {fps:.digits$} fps")
        });
        let mode = match self.navigator.mode() {
            Mode::Orbit => "orbit",
            Mode::Fly => "fly",
        };
        let upscale =
            if self.current > 0 { format!(" (x{})", self.current) } else { String::new() };
        let busy = self.busy.map_or(String::new(), |(r, stage)| format!(", x{r}: {stage} …"));
        let title = format!("{}: {splats} splats{upscale}{fps}, {mode}{busy}", self.name);
        let soon = self.title.1.is_some_and(|t| self.running && t.elapsed() < TITLE_EVERY);
        if title != self.title.0 && !soon {
            canvas.window().set_title(&title);
            self.title = (title, Some(Instant::now()));
        }
    }

    fn perform(&mut self, action: KeyAction, events: &ActiveEventLoop) {
        match action {
            KeyAction::Toggle => self.navigator.toggle(),
            KeyAction::Reset => {
                self.navigator.reset();
                self.change();
            }
            KeyAction::Upscale(r) if self.photographs.is_none() => {
                print_line(format!(
                    "x{r}: {} is a finished scene, whose resolution is fixed; open its photographs to \
                     change it",
                    self.name
                ));
            }
            KeyAction::Upscale(r) => {
                self.requested = r;
                self.show_requested();
            }
            KeyAction::Levels => {
                self.levels = !self.levels;
                self.change();
            }
            KeyAction::Save => {
                self.picture = true;
                self.redraw();
            }
            KeyAction::Help => print_line(KEYS),
            KeyAction::Quit => events.exit(),
        }
        self.update_title();
    }

    /// Shows the requested splats, or starts to make them; one background thread runs at a time.
    fn show_requested(&mut self) {
        if self.ready.contains_key(&self.requested) {
            if self.current != self.requested {
                self.current = self.requested;
                self.change();
            }
            return;
        }
        self.make_requested();
    }

    /// Starts the background thread for the requested splats, unless it runs already.
    fn make_requested(&mut self) {
        let (None, Some(photographs), Some(canvas)) =
            (self.busy, self.photographs.clone(), &self.canvas)
        else {
            return;
        };
        let r = self.requested;
        let gpu = canvas.gpu().clone();
        let proxy = self.proxy.clone();
        self.busy = Some((r, "beginning"));
        // A closed event loop needs no message.
        let work = move || {
            let mut stage = |name| drop(proxy.send_event(Message::Stage(name)));
            let mut show = |made: Made| {
                drop(proxy.send_event(Message::Made(r, upload(&gpu, made)?)));
                Ok(())
            };
            let done = photographs.make(r, &mut stage, &mut show);
            drop(proxy.send_event(Message::Done(r, done.map_err(|e| format!("{e:#}")))));
        };
        if let Err(e) = std::thread::Builder::new().name(format!("x{r}")).spawn(work) {
            print_warning(format!("the scene at x{r} cannot be made: no thread: {e}"));
            (self.busy, self.requested) = (None, self.current);
        }
    }

    fn event(&mut self, event: WindowEvent, events: &ActiveEventLoop) -> Result<()> {
        match event {
            WindowEvent::CloseRequested => events.exit(),
            WindowEvent::RedrawRequested => self.frame(events)?,
            WindowEvent::Resized(size) => {
                if let Some(canvas) = &mut self.canvas {
                    canvas.resize(size.width, size.height)?;
                }
                self.change();
            }
            WindowEvent::Focused(false) => self.controls.release(),
            WindowEvent::ModifiersChanged(m) => self.controls.shift(m.state().shift_key()),
            WindowEvent::KeyboardInput { event, .. } => self.key(&event, events),
            WindowEvent::MouseInput { button, state, .. } => self.controls.button(button, state),
            WindowEvent::MouseWheel { delta, .. } => {
                self.navigator.wheel(Controls::wheel(delta));
                self.change();
            }
            WindowEvent::CursorMoved { position, .. } => {
                let at = Vec2::new(position.x as f32, position.y as f32);
                match self.controls.cursor(at) {
                    Some(Drag::Turn(px)) => self.navigator.rotate(px),
                    Some(Drag::Pan(px)) => self.navigator.pan(px),
                    None => return Ok(()),
                }
                self.change();
            }
            _ => {}
        }
        Ok(())
    }

    fn key(&mut self, event: &KeyEvent, events: &ActiveEventLoop) {
        let PhysicalKey::Code(code) = event.physical_key else { return };
        if let Some(action) = self.controls.key(code, event.state, event.repeat) {
            self.perform(action, events);
        } else if self.controls.moving() && !self.running {
            self.redraw();
        }
    }

    /// Ends the window at an error.
    fn or_end(&mut self, done: Result<()>, events: &ActiveEventLoop) {
        if let Err(e) = done {
            self.outcome = Err(e);
            events.exit();
        }
    }
}

fn upload(gpu: &Gpu, made: Made) -> Result<Ready> {
    static NUMBER: AtomicUsize = AtomicUsize::new(0);
    let scene = gpu.upload_splats(&slices(&made.splats))?;
    let options = RasterOptions { sh_basis: made.splats.sh_basis(), ..made.options };
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    Ok(Ready { scene, options, detail: Detail::new(made.splats), number })
}

impl ApplicationHandler<Message> for Viewer {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.canvas.is_none() {
            let opened = self.open(events);
            self.or_end(opened, events);
        }
    }

    fn new_events(&mut self, events: &ActiveEventLoop, cause: StartCause) {
        if let StartCause::ResumeTimeReached { .. } = cause {
            events.set_control_flow(ControlFlow::Wait);
            self.redraw();
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let done = self.event(event, events);
        self.or_end(done, events);
    }

    fn user_event(&mut self, _: &ActiveEventLoop, message: Message) {
        match message {
            Message::Stage(name) => self.busy = self.busy.map(|(r, _)| (r, name)),
            Message::Made(r, ready) => {
                self.ready.insert(r, ready);
                if r == self.requested {
                    self.current = r;
                }
                self.change();
            }
            Message::Done(r, done) => {
                self.busy = None;
                if let Err(e) = done {
                    print_warning(format!("x{r}: {e}"));
                    if self.requested == r {
                        self.requested = self.current;
                    }
                }
                self.show_requested();
                // The level of detail waited for the work.
                self.redraw();
            }
            Message::Detail(number, outcome) => self.finish_detail(number, outcome),
        }
        self.update_title();
    }
}
