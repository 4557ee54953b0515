//! `subsplat-lab train`: trains a model by its configuration, with progress for the user.

use super::args::TrainArgs;
use super::tensorboard::Board;
use crate::train::TrainConfig;
use crate::train::peers;
use crate::train::ranks::agree;
use crate::train::run::{Event, Limits, StepReport, Training};
use crate::train::step::Seconds;
use crate::train::validate::{Found, Validator};
use anyhow::Result;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use std::io::IsTerminal;
use std::time::{Duration, Instant};
use subsplat_cli::commands::environment;
use subsplat_cli::interrupt::Interrupt;
use subsplat_cli::report::{Answer, mebibytes, print_line, print_warning};

/// Time between two lines where stderr is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(20);
/// Number of lines between two profiles.
const PROFILE_EVERY: usize = 15;
/// Weight of the newest step in the printed means.
const NEW_WEIGHT: f64 = 0.05;

/// Runs the command.
pub fn train(args: &TrainArgs, answer: Answer) -> Result<()> {
    // Candle runs operations on large tensors in its own thread pool. Its idle threads spin, and
    // take the cores from this crate's: 40 steps took 28.8 s with the pool and 20.7 s without.
    environment::restart_with("CANDLE_NUM_THREADS", || "1".into());
    let mut peers = peers::connect()?;
    // Rank 0 keeps the records of a shared training.
    let first = peers.ranks().rank == 0;
    // A file that one rank cannot read or write ends all of them.
    let config = agree(&mut *peers, TrainConfig::load(&args.config))?;
    let interrupt = Interrupt::watch();
    let limits = Limits { minutes: args.minutes, steps: args.steps, stop: Some(interrupt.flag()) };
    let mut training = Training::open_shared(&config, &args.out, peers)?;
    let mut watch = Watch::new(&config, limits);
    let board = first.then(|| Board::create(&args.out)).transpose();
    let mut board = training.agree(board)?;
    let mut unwritten = None;
    let validator = if first {
        Validator::new(&config, args.validate.as_deref())
    } else {
        Validator::without_scenes(&config)
    };
    let validator = training.agree(validator)?;
    let outcome = training.run(limits, &validator, &mut |event| {
        if !first {
            return;
        }
        watch.handle(event);
        if let (None, Some(board)) = (&unwritten, &mut board) {
            unwritten = board.record(event).err();
        }
    });
    watch.bar.finish_and_clear();
    outcome?;
    if let Some(e) = unwritten {
        print_warning(format!("{e:#}: TensorBoard's file ends here"));
    }
    if let Some(warning) = training.warning() {
        print_warning(warning);
    }
    if !first {
        return Ok(());
    }
    let progress = training.progress();
    // The file is absent before the first checkpoint.
    let weights = Some(args.out.join("weights.safetensors")).filter(|file| file.is_file());
    let saved = weights.as_ref().map(|file| format!("; weights in {}", file.display()));
    let (done, steps) = (progress.step, config.steps);
    let stopped = interrupt.is_noted();
    let how = if stopped { "stopped by Ctrl-C, " } else { "" };
    print_line(format!("{how}{done} of {steps} steps done{}", saved.unwrap_or_default()));
    answer.finish(&json!({
        "step": progress.step,
        "steps": config.steps,
        "examples": progress.examples,
        "seconds": progress.seconds,
        "loss": watch.loss,
        "weights": weights,
        "stopped": stopped,
    }))
}

/// Progress for the user: a bar on a terminal, else a line from time to time.
struct Watch {
    bar: ProgressBar,
    terminal: bool,
    /// Steps of the configuration.
    steps: u64,
    /// Steps and minutes of this call.
    limits: [Option<f64>; 2],
    started: Instant,
    first: u64,
    shown: Instant,
    lines: usize,
    loss: f64,
    psnr: f64,
    profile: (Seconds, u64),
}

fn mean(old: f64, new: f64) -> f64 {
    if old.is_finite() { old + NEW_WEIGHT * (new - old) } else { new }
}

impl Watch {
    fn new(config: &TrainConfig, limits: Limits<'_>) -> Self {
        let bar = ProgressBar::new(config.steps);
        let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} [{elapsed}]");
        if let Ok(style) = style {
            bar.set_style(style);
        }
        Self {
            bar,
            terminal: std::io::stderr().is_terminal(),
            steps: config.steps,
            limits: [limits.steps.map(|n| n as f64), limits.minutes],
            started: Instant::now(),
            first: 0,
            shown: Instant::now(),
            lines: 0,
            loss: f64::NAN,
            psnr: f64::NAN,
            profile: (Seconds::default(), 0),
        }
    }

    fn handle(&mut self, event: &Event) {
        match event {
            Event::Begin { step, parameters, resumed, untrained, warnings } => {
                warnings.iter().for_each(print_warning);
                self.first = *step;
                self.started = Instant::now();
                match resumed {
                    Some(path) => self.print(&format!("continuing from {}", path.display())),
                    None if *untrained > 0 => {
                        self.print(&format!(
                            "{untrained} tensors start with random values of the seed"
                        ));
                    }
                    None => {}
                }
                self.print(&format!("{parameters} parameters, step {step} of {}", self.steps));
            }
            Event::Step(report) => self.step(report),
            Event::Skipped { step } => {
                print_warning(format!("step {step}: loss or gradient not finite, skipped"));
            }
            Event::Saved(path) => self.print(&format!("saved {}", path.display())),
            Event::Validated { step, rooms, photos } => {
                for (set, found) in [("held-out rooms", rooms), ("photographs", photos)] {
                    if let Some(found) = found {
                        self.print(&validation_line(*step, set, found));
                    }
                }
            }
        }
    }

    fn print(&self, line: &str) {
        self.bar.suspend(|| print_line(line));
    }

    fn step(&mut self, report: &StepReport) {
        self.loss = mean(self.loss, report.terms.loss);
        if report.terms.mse.is_finite() {
            self.psnr = mean(self.psnr, report.terms.psnr());
        }
        self.profile.0.add(&report.seconds);
        self.profile.1 += 1;
        if self.terminal {
            self.bar.set_position(report.step);
            self.bar.set_message(self.line(report));
            return;
        }
        if self.shown.elapsed() < LINE_EVERY && report.step > self.first + 1 {
            return;
        }
        self.shown = Instant::now();
        print_line(format!("step {} {}", report.step, self.line(report)));
        self.lines += 1;
        if self.lines.is_multiple_of(PROFILE_EVERY) {
            self.print_profile();
        }
    }

    /// Formats loss, PSNR, learning rate, speed, memory and remaining time.
    fn line(&self, report: &StepReport) -> String {
        let done = (report.step - self.first).max(1) as f64;
        let passed = self.started.elapsed().as_secs_f64();
        let each = passed / done;
        let steps = self.steps.saturating_sub(report.step) as f64;
        let left = seconds_left((steps, each), (done, passed), self.limits);
        let mut line = format!("loss {:.4}", self.loss);
        if self.psnr.is_finite() {
            line += &format!(" psnr {:.2}", self.psnr);
        }
        let t = &report.terms;
        if t.disparity.is_finite() {
            line += &format!(" ce {:.3} disp {:.3}", t.cross_entropy, t.disparity);
        }
        line += &format!(" norm {:.2} lr {:.2e} {each:.2} s/step", report.norm, report.rate);
        if let Some(bytes) = resident_bytes() {
            line += &format!(" {}", mebibytes(bytes));
        }
        line + &format!(" left {}", duration(left))
    }

    /// Prints the mean time of each part of a step since the last profile.
    fn print_profile(&mut self) {
        let (seconds, steps) = std::mem::take(&mut self.profile);
        let parts = seconds.parts();
        let share = |s: f64| s / steps.max(1) as f64;
        let list: Vec<String> =
            parts.iter().map(|(name, s)| format!("{name} {:.3}", share(*s))).collect();
        print_line(format!("  seconds a step: {}", list.join(", ")));
    }
}

fn validation_line(step: u64, set: &str, found: &Found) -> String {
    let mut line = format!(
        "step {step}, {set}: PSNR {:.2} dB (nearer input {:.2}), SSIM {:.4}",
        found.psnr, found.copy_psnr, found.ssim
    );
    if found.within_one > 0.0 {
        line += &format!(
            ", depth off by {:.2} candidates, {:.1} % within 1",
            found.disparity,
            100.0 * found.within_one
        );
    }
    line
}

/// Seconds until the last of `steps` steps of `each` seconds, or until a limit of this call, which
/// has `done` steps in `passed` seconds. `limits`: steps and minutes.
fn seconds_left(
    (steps, each): (f64, f64),
    (done, passed): (f64, f64),
    [limit, minutes]: [Option<f64>; 2],
) -> f64 {
    let steps = limit.map_or(steps, |limit| steps.min(limit - done));
    let left = each * steps;
    minutes.map_or(left, |m| left.min(60.0 * m - passed)).max(0.0)
}

/// Formats a duration: `50 s`, `12 min`, `3 h 07 min`.
fn duration(seconds: f64) -> String {
    let minutes = (seconds / 60.0).ceil() as u64;
    match minutes {
        0 | 1 => format!("{:.0} s", seconds.ceil()),
        2..60 => format!("{minutes} min"),
        _ => format!("{} h {:02} min", minutes / 60, minutes % 60),
    }
}

/// Reads the resident memory of this process, bytes; `None` elsewhere than on Linux.
fn resident_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|l| l.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_is_that_of_the_nearest_limit() {
        let call = (10.0, 20.0);
        assert_eq!(seconds_left((90.0, 2.0), call, [None, None]), 180.0);
        assert_eq!(seconds_left((90.0, 2.0), call, [Some(15.0), None]), 10.0);
        assert_eq!(seconds_left((90.0, 2.0), call, [Some(15.0), Some(0.4)]), 4.0);
        assert_eq!(seconds_left((90.0, 2.0), call, [None, Some(2.0)]), 100.0);
        // The last step ends after the limit.
        assert_eq!(seconds_left((90.0, 2.0), call, [None, Some(0.3)]), 0.0);
    }

    #[test]
    fn durations_have_their_unit() {
        let cases = [
            (0.0, "0 s"),
            (59.2, "60 s"),
            (60.5, "2 min"),
            (3541.0, "1 h 00 min"),
            (11_220.0, "3 h 07 min"),
        ];
        for (seconds, text) in cases {
            assert_eq!(duration(seconds), text);
        }
    }
}
