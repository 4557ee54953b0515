//! What the user sees while the program works, and at the end.

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
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

    /// Books `seconds` under `name`.
    pub fn book(&mut self, name: &str, seconds: f64) {
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
    eprintln!("{}", line.as_ref());
}

/// A warning for people, on stderr.
pub fn warn(line: impl AsRef<str>) {
    eprintln!("warning: {}", line.as_ref());
}

/// The one JSON object on stdout where `--json` asks for it.
pub fn finish(json: bool, report: &impl Serialize) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(report)?);
    }
    Ok(())
}

/// Bytes as people read them.
pub fn mebibytes(bytes: u64) -> String {
    format!("{:.0} MiB", bytes as f64 / f64::from(1 << 20))
}
