//! Output for the user: progress bars, lines, and the answer of a command.

use anyhow::Context;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use serde::Serialize;
use std::io::{IsTerminal, Write};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};
use subsplat::reconstruct::StageTime;

/// Time before the first line about a stage where there are no bars, and between two of them.
const LINES_FIRST: Duration = Duration::from_secs(4);
const LINES_EVERY: Duration = Duration::from_secs(6);

/// Set by `--quiet`.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Leaves out bars and lines that are neither warnings nor errors.
pub fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Steps of a bar that shows a fraction.
const FRACTION_STEPS: u64 = 1000;

/// Measures the stages of a command, and shows a bar for each on stderr.
pub struct Progress {
    started: Instant,
    stages: Vec<(String, f64)>,
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}

impl Progress {
    /// Starts the measurement.
    pub fn new() -> Self {
        Self { started: Instant::now(), stages: Vec::new() }
    }

    /// Runs `work` under a spinner named `name`, and records its time.
    pub fn stage<T, E>(
        &mut self,
        name: &str,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let bar = ProgressBar::new_spinner();
        hide_if_quiet(&bar);
        if let Ok(style) = ProgressStyle::with_template("{spinner} {prefix} {msg} [{elapsed}]") {
            bar.set_style(style);
        }
        bar.set_prefix(name.to_owned());
        bar.enable_steady_tick(Duration::from_millis(200));
        self.timed(name, &bar, work)
    }

    /// Runs `work` under a bar of `total` steps, and records its time.
    pub fn steps<T, E>(
        &mut self,
        name: &str,
        total: usize,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let bar = ProgressBar::new(total as u64);
        hide_if_quiet(&bar);
        set_style(&bar, "{prefix} {wide_bar} {pos}/{len} [{elapsed}{left}]");
        bar.set_prefix(name.to_owned());
        self.timed(name, &bar, work)
    }

    /// Runs `work` under a bar that [`show_fraction`] moves, and records its time.
    pub fn fraction<T, E>(
        &mut self,
        name: &str,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let bar = ProgressBar::new(FRACTION_STEPS);
        hide_if_quiet(&bar);
        set_style(&bar, "{prefix}: {msg} {wide_bar} {percent} % [{elapsed}{left}]");
        bar.set_prefix(name.to_owned());
        self.timed(name, &bar, work)
    }

    fn timed<T, E>(
        &mut self,
        name: &str,
        bar: &ProgressBar,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let start = Instant::now();
        let result = with_lines(bar, work);
        bar.finish_and_clear();
        self.record(name, start.elapsed().as_secs_f64());
        result
    }

    /// Replaces the last stage by its `parts`.
    pub fn split_last(&mut self, parts: &[StageTime]) {
        self.stages.pop();
        parts.iter().for_each(|part| self.record(part.stage.name(), part.seconds));
    }

    fn record(&mut self, name: &str, seconds: f64) {
        self.stages.push((name.to_owned(), seconds));
    }

    /// The times as `{stage: seconds, …, "total": seconds}`.
    pub fn seconds(&self) -> serde_json::Map<String, serde_json::Value> {
        let mut map = serde_json::Map::new();
        for (name, seconds) in &self.stages {
            let so_far = map.get(name).and_then(serde_json::Value::as_f64).unwrap_or(0.0);
            map.insert(name.clone(), round(so_far + seconds).into());
        }
        map.insert("total".to_owned(), round(self.started.elapsed().as_secs_f64()).into());
        map
    }
}

/// Gives `bar` the form `template`, whose `{left}` is the time for the rest.
fn set_style(bar: &ProgressBar, template: &str) {
    let left = |state: &ProgressState, to: &mut dyn std::fmt::Write| {
        if let Some(left) = time_left(state.elapsed(), state.pos(), state.len().unwrap_or_default())
        {
            // A `String` takes all that is written.
            let _ = write!(to, ", about {} s left", left.as_secs());
        }
    };
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style.with_key("left", left));
    }
}

fn hide_if_quiet(bar: &ProgressBar) {
    if is_quiet() {
        bar.set_draw_target(ProgressDrawTarget::hidden());
    }
}

/// Runs `work`. Where stderr is no terminal, and so shows no bars, it gets a line about `bar` every few seconds.
fn with_lines<T>(bar: &ProgressBar, work: impl FnOnce(&ProgressBar) -> T) -> T {
    if is_quiet() || std::io::stderr().is_terminal() {
        return work(bar);
    }
    std::thread::scope(|scope| {
        let (end, ended) = mpsc::channel::<()>();
        let watched = bar.clone();
        scope.spawn(move || {
            let mut wait = LINES_FIRST;
            // The sender is dropped at the end of the work.
            while ended.recv_timeout(wait) == Err(mpsc::RecvTimeoutError::Timeout) {
                print_line(state_of(&watched));
                wait = LINES_EVERY;
            }
        });
        let result = work(bar);
        drop(end);
        result
    })
}

/// A bar as a line: `reconstructing: refining the splats, 40 %, 12 s, about 18 s left`.
fn state_of(bar: &ProgressBar) -> String {
    let seconds = |d: Duration| format!("{} s", d.as_secs());
    let message = Some(bar.message()).filter(|m| !m.is_empty()).map(|m| format!(": {m}"));
    let mut line = format!("{}{}", bar.prefix(), message.unwrap_or_default());
    if let Some(length) = bar.length().filter(|n| *n > 0) {
        let percent = 100 * bar.position() / length;
        line = format!("{line}, {percent} %, {}", seconds(bar.elapsed()));
        if let Some(left) = time_left(bar.elapsed(), bar.position(), length) {
            line = format!("{line}, about {} left", seconds(left));
        }
    } else {
        line = format!("{line}, {}", seconds(bar.elapsed()));
    }
    line
}

/// Time for the rest of a work of `length` parts at its mean rate; `None` before the first part is done. The bar's own
/// estimate weighs the last parts, and grows without bound while a long part goes on.
fn time_left(elapsed: Duration, done: u64, length: u64) -> Option<Duration> {
    let rest = length.saturating_sub(done) as f64;
    (done > 0).then(|| elapsed.mul_f64(rest / done as f64))
}

/// Moves the bar of [`Progress::fraction`] to a state of the library.
pub fn show_fraction(bar: &ProgressBar, progress: subsplat::Progress) -> ControlFlow<()> {
    bar.set_message(progress.stage.description());
    bar.set_position((progress.fraction * FRACTION_STEPS as f32) as u64);
    ControlFlow::Continue(())
}

fn round(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}

/// Reads the largest resident set so far, bytes (Windows: working set); `None` on other systems than these three.
pub fn peak_memory_bytes() -> Option<u64> {
    peak_memory()
}

#[cfg(windows)]
fn peak_memory() -> Option<u64> {
    let memory = winsafe::HPROCESS::GetCurrentProcess().GetProcessMemoryInfo().ok()?;
    u64::try_from(memory.PeakWorkingSetSize).ok()
}

#[cfg(target_os = "macos")]
fn peak_memory() -> Option<u64> {
    use nix::sys::resource::{UsageWho, getrusage};
    // Bytes here, and kilobytes on other systems.
    u64::try_from(getrusage(UsageWho::RUSAGE_SELF).ok()?.max_rss()).ok()
}

#[cfg(not(any(windows, target_os = "macos")))]
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}

/// Prints a line on stderr, but for `--quiet`.
pub fn print_line(line: impl std::fmt::Display) {
    if !is_quiet() {
        print(line);
    }
}

/// Prints a warning on stderr.
pub fn print_warning(line: impl std::fmt::Display) {
    print(format!("warning: {line}"));
}

fn print(line: impl std::fmt::Display) {
    // A closed stderr is no error.
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// The answer of a command on stdout: lines, or one JSON object.
#[derive(Clone, Copy, Debug)]
pub struct Answer {
    json: bool,
}

impl Answer {
    /// `json`: the answer is one object on stdout, and lines go to stderr.
    pub fn new(json: bool) -> Self {
        Self { json }
    }

    /// Prints a line of the answer.
    pub fn line(self, line: impl std::fmt::Display) {
        if self.json {
            return print_line(line);
        }
        // A closed pipe is no error: `subsplat info … | head` closes it early.
        let _ = writeln!(std::io::stdout(), "{line}");
    }

    /// Prints the object. A command calls this at its end.
    ///
    /// # Errors
    /// Stdout is closed or full.
    pub fn finish(self, report: &impl Serialize) -> anyhow::Result<()> {
        if self.json {
            let text = serde_json::to_string(report)?;
            writeln!(std::io::stdout(), "{text}").context("stdout")?;
        }
        Ok(())
    }
}

/// Formats bytes as MiB.
pub fn mebibytes(bytes: u64) -> String {
    format!("{:.0} MiB", bytes as f64 / f64::from(1 << 20))
}

/// Escapes text for HTML, in elements and in attributes with double quotes.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rest_takes_as_long_a_part_as_what_is_done() {
        let seconds = Duration::from_secs;
        assert_eq!(time_left(seconds(58), 1, 4), Some(seconds(174)));
        assert_eq!(time_left(seconds(58), 2, 4), Some(seconds(58)));
        assert_eq!(time_left(seconds(58), 4, 4), Some(Duration::ZERO));
        assert_eq!(time_left(seconds(58), 0, 4), None);
        let bar = ProgressBar::hidden();
        bar.set_length(1000);
        bar.set_prefix("scene");
        bar.set_message("matching");
        assert_eq!(state_of(&bar), "scene: matching, 0 %, 0 s");
        bar.set_position(500);
        assert_eq!(state_of(&bar), "scene: matching, 50 %, 0 s, about 0 s left");
    }
}
