//! What the user sees while the program works, and at the end.

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use std::io::Write;
use std::time::{Duration, Instant};

/// Times stages, shows a bar for the ones that take a while, on stderr only.
pub struct Progress {
    started: Instant,
    stages: Vec<(String, f64)>,
}

impl Progress {
    /// Starts the clock.
    pub fn new() -> Self {
        Self { started: Instant::now(), stages: Vec::new() }
    }

    /// Runs `work` under a spinner named `name` and books its time.
    pub fn stage<T, E>(
        &mut self,
        name: &str,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let bar = ProgressBar::new_spinner();
        if let Ok(style) = ProgressStyle::with_template("{spinner} {prefix} {msg} [{elapsed}]") {
            bar.set_style(style);
        }
        bar.set_prefix(name.to_owned());
        bar.enable_steady_tick(Duration::from_millis(200));
        self.timed(name, &bar, work)
    }

    /// The same with a bar of `total` steps.
    pub fn steps<T, E>(
        &mut self,
        name: &str,
        total: usize,
        work: impl FnOnce(&ProgressBar) -> Result<T, E>,
    ) -> Result<T, E> {
        let bar = ProgressBar::new(total as u64);
        let template = "{prefix} {wide_bar} {pos}/{len} [{elapsed} < {eta}]";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
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
        let result = work(bar);
        bar.finish_and_clear();
        self.book(name, start.elapsed().as_secs_f64());
        result
    }

    /// Replaces the stage booked last by its `parts`.
    pub fn split_last(&mut self, parts: &[(&'static str, f64)]) {
        self.stages.pop();
        parts.iter().for_each(|(name, seconds)| self.book(name, *seconds));
    }

    /// Books `seconds` under `name`.
    fn book(&mut self, name: &str, seconds: f64) {
        self.stages.push((name.to_owned(), seconds));
    }

    /// `{stage: seconds, …, "total": seconds}`.
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

fn round(seconds: f64) -> f64 {
    (seconds * 1e3).round() / 1e3
}

/// Largest resident set so far, bytes; `None` where the system does not say
/// (anything but Linux).
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    let kib: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib * 1024)
}

/// A line for people, on stderr.
pub fn say(line: impl AsRef<str>) {
    // Nobody listening is no error.
    let _ = writeln!(std::io::stderr(), "{}", line.as_ref());
}

/// A warning for people, on stderr.
pub fn warn(line: impl AsRef<str>) {
    say(format!("warning: {}", line.as_ref()));
}

/// Where a command's answer goes: lines for people, or one JSON object, on stdout.
#[derive(Clone, Copy, Debug)]
pub struct Answer {
    json: bool,
}

impl Answer {
    /// `json`: the object is asked for, and lines go to stderr.
    pub fn new(json: bool) -> Self {
        Self { json }
    }

    /// A line of the answer.
    pub fn line(self, line: impl AsRef<str>) {
        if self.json {
            return say(line);
        }
        // `subsplat info … | head` closes the pipe early and means it.
        let _ = writeln!(std::io::stdout(), "{}", line.as_ref());
    }

    /// The whole answer; the last thing that a command does.
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

/// Bytes as people read them.
pub fn mebibytes(bytes: u64) -> String {
    format!("{:.0} MiB", bytes as f64 / f64::from(1 << 20))
}
