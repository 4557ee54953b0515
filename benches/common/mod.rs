//! A small benchmark harness. Contenders for one task are checked and then timed alternately in
//! one process, so that other load on the machine affects all of them. The report has medians,
//! minima, and ratios to the group's first contender. Where the minimum work is known, it also
//! has the bandwidth relative to a plain copy and the arithmetic rate relative to a loop of
//! multiply-adds, both measured in the same run and at the same SIMD level.
//!
//! `cargo bench --bench raster -- [NAME …] [--quick] [--seconds S] [--threads N] [--simd LEVEL|all]
//! [--json FILE] [--write DIR] [--onnxruntime]`; a group runs where its name contains every NAME.

#![allow(dead_code, reason = "each bench uses a part")]

pub mod conventional;
pub mod inputs;
mod machine;
pub mod scene;

use anyhow::{Context, Result, bail, ensure};
pub use machine::Machine;
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};
use subsplat_kernels::cpu::SimdLevel;

/// Minimum and maximum number of runs of a contender.
const RUNS: (usize, usize) = (3, 200);
/// Duration of a run, seconds, below which it is preceded by untimed runs.
const SHORT_RUN_S: f64 = 0.05;
/// Total duration of the untimed runs, seconds. The system distributes waking threads over the
/// cores only after some milliseconds; on two cores a call of one millisecond used one core only.
const WARM_UP_S: f64 = 0.03;

/// Command line arguments.
#[derive(Default)]
pub struct Args {
    pub names: Vec<String>,
    /// Fewer and smaller cases.
    pub quick: bool,
    seconds: Option<f64>,
    threads: Option<usize>,
    json: Option<PathBuf>,
    /// Folder to write scenes to, instead of timing.
    pub write: Option<PathBuf>,
    /// Also run onnxruntime.
    pub onnxruntime: bool,
}

impl Args {
    fn parse() -> Result<Self> {
        let mut out = Self::default();
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            let mut value = || words.next().with_context(|| format!("{word}: expected a value"));
            match word.as_str() {
                // Arguments that `cargo bench` adds.
                "--bench" => {}
                "--quick" => out.quick = true,
                "--onnxruntime" => out.onnxruntime = true,
                "--seconds" => out.seconds = Some(value()?.parse().context("--seconds")?),
                "--threads" => out.threads = Some(value()?.parse().context("--threads")?),
                "--json" => out.json = Some(value()?.into()),
                "--write" => out.write = Some(value()?.into()),
                "--simd" => run_at(&value()?)?,
                other if other.starts_with('-') => bail!("unknown option {other}"),
                name => out.names.push(name.to_owned()),
            }
        }
        SimdLevel::requested()?;
        Ok(out)
    }
}

/// Returns where `name` is the SIMD level of this process. Else runs this program again with
/// the same arguments at that level, or at each level one after the other where `name` is `all`,
/// and ends with its exit code: a process reads the variable `SUBSPLAT_SIMD` once.
///
/// # Errors
/// A level that does not exist or that this processor lacks; a program that does not start.
fn run_at(name: &str) -> Result<()> {
    let here: Vec<&str> = SimdLevel::available().iter().map(|level| level.name()).collect();
    ensure!(
        name == "all" || here.contains(&name),
        "--simd: expected all, or one that this processor runs ({}), got {name}",
        here.join(", ")
    );
    if name == SimdLevel::best().name() {
        return Ok(());
    }
    for level in here.into_iter().filter(|level| name == "all" || *level == name) {
        let mut again = Command::new(std::env::current_exe()?);
        let words = std::env::args_os().skip(1);
        let words = words.map(|word| if word == "all" { level.into() } else { word });
        let status = again.args(words).env("SUBSPLAT_SIMD", level).status()?;
        if name != "all" || !status.success() {
            std::process::exit(status.code().unwrap_or(1));
        }
    }
    std::process::exit(0)
}

/// Number of threads of a contender.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Threads {
    /// One.
    One,
    /// All threads of the machine, or `--threads`.
    All,
}

/// Minimum work of one call.
#[derive(Clone, Copy, Debug, Default)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: f64,
    /// Multiplications and additions.
    pub flops: f64,
}

/// One implementation of a group's task.
pub struct Contender<'a> {
    name: String,
    threads: Threads,
    /// Runs once; returns seconds where it measures them itself.
    run: Box<dyn FnMut() -> Result<Option<f64>> + Send + 'a>,
    in_other_process: bool,
    work: Option<Work>,
}

impl<'a> Contender<'a> {
    /// Creates a contender.
    pub fn new(
        name: impl Into<String>,
        threads: Threads,
        mut run: impl FnMut() -> Result<()> + Send + 'a,
    ) -> Self {
        let run = Box::new(move || run().map(|()| None));
        Self { name: name.into(), threads, run, in_other_process: false, work: None }
    }

    /// Creates a contender in another process, which reports its seconds.
    pub fn in_other_process(
        name: impl Into<String>,
        mut run: impl FnMut() -> Result<f64> + Send + 'a,
    ) -> Self {
        let run = Box::new(move || run().map(Some));
        Self { name: name.into(), threads: Threads::All, run, in_other_process: true, work: None }
    }

    /// Adds the minimum work.
    pub fn with_work(mut self, work: Work) -> Self {
        self.work = Some(work);
        self
    }
}

/// Times of one contender, seconds.
#[derive(Default)]
struct Times {
    wall: Vec<f64>,
    /// CPU time of the whole process over all runs, where the system reports it.
    cpu: Option<f64>,
}

impl Times {
    fn median(&self) -> f64 {
        let mut sorted = self.wall.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }

    fn minimum(&self) -> f64 {
        self.wall.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

/// A run of one bench program.
pub struct Bench {
    /// The command line.
    pub args: Args,
    name: &'static str,
    one: ThreadPool,
    all: ThreadPool,
    machine: Option<Machine>,
    groups: Vec<Value>,
}

impl Bench {
    /// Reads the command line and starts the thread pools.
    ///
    /// # Errors
    /// A wrong command line; threads that the system refuses.
    pub fn new(name: &'static str) -> Result<Self> {
        let args = Args::parse()?;
        ensure!(
            !cfg!(debug_assertions),
            "benches are built without debug assertions: run `cargo bench --bench {name}`"
        );
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let pool = |n: usize| ThreadPoolBuilder::new().num_threads(n).build();
        let (one, all) = (pool(1)?, pool(args.threads.unwrap_or(cores))?);
        Ok(Self { args, name, one, all, machine: None, groups: Vec::new() })
    }

    /// Returns the number of threads of [`Threads::All`].
    pub fn threads(&self) -> usize {
        self.all.current_num_threads()
    }

    /// Returns whether the command line selects a group of this name.
    pub fn selects(&self, group: &str) -> bool {
        self.args.names.iter().all(|n| group.contains(n.as_str()))
    }

    /// Runs `work` on all threads.
    pub fn on_all<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.all.install(work)
    }

    /// Runs `work` on the pool of one thread.
    pub fn on_one<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.one.install(work)
    }

    fn pool(&self, threads: Threads) -> &ThreadPool {
        match threads {
            Threads::One => &self.one,
            Threads::All => &self.all,
        }
    }

    /// Returns the machine's rates at this SIMD level, measured at the first call.
    pub fn machine(&mut self) -> &Machine {
        let (one, all, quick) = (&self.one, &self.all, self.args.quick);
        self.machine.get_or_insert_with(|| Machine::measure(one, all, quick))
    }

    /// Times `contenders` alternately and prints a table; ratios are relative to the first one.
    ///
    /// # Errors
    /// Errors of the contenders.
    pub fn group(&mut self, name: &str, mut contenders: Vec<Contender>, note: &str) -> Result<()> {
        self.machine();
        let seconds = self.args.seconds.unwrap_or(if self.args.quick { 2.0 } else { 10.0 });
        let share = seconds / contenders.len() as f64;
        let mut times: Vec<Times> = contenders.iter().map(|_| Times::default()).collect();
        let mut busy = true;
        while busy {
            busy = false;
            for (contender, times) in contenders.iter_mut().zip(&mut times) {
                let spent: f64 = times.wall.iter().sum();
                let turns = times.wall.len();
                if turns >= RUNS.0 && (spent > share || turns >= RUNS.1) {
                    continue;
                }
                busy = true;
                let pool = self.pool(contender.threads);
                let run = &mut contender.run;
                // Short runs are timed as within a longer computation: with data in the caches
                // and running threads.
                let quick = times.wall.last().is_none_or(|t| *t < SHORT_RUN_S);
                let warm = if quick && !contender.in_other_process { WARM_UP_S } else { 0.0 };
                let timed = || {
                    let start = Instant::now();
                    while start.elapsed().as_secs_f64() < warm {
                        run()?;
                    }
                    let cpu = cpu_seconds();
                    let start = Instant::now();
                    let reported = run()?;
                    let wall = reported.unwrap_or(start.elapsed().as_secs_f64());
                    anyhow::Ok((wall, cpu_seconds().zip(cpu).map(|(after, before)| after - before)))
                };
                let (wall, used) = pool.install(timed).with_context(|| contender.name.clone())?;
                times.wall.push(wall);
                times.cpu = used.map(|used| used + times.cpu.unwrap_or(0.0));
            }
        }
        self.report(name, &contenders, &times, note);
        Ok(())
    }

    fn report(&mut self, name: &str, contenders: &[Contender], times: &[Times], note: &str) {
        let Some(machine) = &self.machine else { return };
        println!("\n{name}{}{note}", if note.is_empty() { "" } else { ": " });
        println!(
            "  {:<30} {:>7} {:>10} {:>10} {:>9} {:>8}  {:>7} {:>6}  {:>8} {:>6}",
            "contender",
            "threads",
            "median ms",
            "minimum ms",
            "cpu ms",
            "speed",
            "GB/s",
            "of",
            "GFLOP/s",
            "of"
        );
        let base = times.first().map_or(f64::NAN, Times::median);
        let mut rows = Vec::new();
        for (contender, times) in contenders.iter().zip(times) {
            let all = contender.threads == Threads::All;
            let threads = self.pool(contender.threads).current_num_threads();
            let (median, minimum) = (times.median(), times.minimum());
            let cpu = times.cpu.map(|cpu| 1e3 * cpu / times.wall.len() as f64);
            let rate = contender.work.map(|w| [1e-9 * w.bytes / minimum, 1e-9 * w.flops / minimum]);
            let most = [machine.copy[usize::from(all)], machine.fma[usize::from(all)]];
            let part = |i: usize| match rate {
                Some(rate) if rate[i] > 0.0 => {
                    format!("{:>8.1} {:>5.0}%", rate[i], 100.0 * rate[i] / most[i])
                }
                _ => format!("{:>8} {:>6}", "", ""),
            };
            println!(
                "  {:<30} {threads:>7} {:>10.3} {:>10.3} {:>9} {:>7.2}x {} {}",
                contender.name,
                1e3 * median,
                1e3 * minimum,
                cpu.map_or(String::new(), |cpu| format!("{cpu:.0}")),
                base / median,
                part(0),
                part(1),
            );
            rows.push(json!({
                "contender": contender.name,
                "threads": threads,
                "median_ms": 1e3 * median,
                "least_ms": 1e3 * minimum,
                "cpu_ms": cpu,
                "turns": times.wall.len(),
                "speed_to_first": base / median,
                "gb_s": rate.map(|r| r[0]),
                "gflop_s": rate.map(|r| r[1]),
            }));
        }
        self.groups.push(json!({ "group": name, "note": note, "rows": rows }));
    }

    /// Adds a group whose rows the bench program measured and printed itself.
    pub fn add_group(&mut self, name: &str, rows: Vec<Value>) {
        self.groups.push(json!({ "group": name, "rows": rows }));
    }

    /// Writes `--json`.
    ///
    /// # Errors
    /// The file cannot be written; no group has the requested names.
    pub fn finish(self) -> Result<()> {
        ensure!(!self.groups.is_empty(), "no group has all of {:?} in its name", self.args.names);
        let Some(path) = &self.args.json else { return Ok(()) };
        let report = json!({
            "bench": self.name,
            "threads": self.all.current_num_threads(),
            "simd": SimdLevel::best().name(),
            "machine": self.machine.map(|m| json!({ "copy_gb_s": m.copy, "fma_gflop_s": m.fma })),
            "groups": self.groups,
        });
        let text = serde_json::to_vec_pretty(&report)?;
        subsplat::files::write_atomic(path, |f| std::io::Write::write_all(f, &text))?;
        Ok(())
    }
}

/// Returns the CPU time of this process in steps of 10 ms; `None` except on Linux.
fn cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The second field is a name in parentheses that may contain spaces.
    let after = stat.rsplit_once(')')?.1;
    let ticks: Vec<f64> =
        after.split_whitespace().skip(11).take(2).filter_map(|t| t.parse().ok()).collect();
    Some(Duration::from_millis(10).as_secs_f64() * ticks.iter().sum::<f64>())
}

/// Compares results: at most a fraction `share` of the numbers may differ by more than `tight`,
/// and none by more than `loose`, relative to the largest number expected. A `share` above 0 is
/// for decisions that depend on rounding (alpha below 1/255, the end of blending).
///
/// # Errors
/// Names the number with the largest difference.
pub fn agree(
    what: &str,
    got: &[f32],
    expected: &[f32],
    [tight, loose, share]: [f32; 3],
) -> Result<()> {
    ensure!(got.len() == expected.len(), "{what}: {} numbers, not {}", got.len(), expected.len());
    let size = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let (mut off, mut worst) = (0, (0, 0.0f32));
    for (i, (g, e)) in got.iter().zip(expected).enumerate() {
        let d = (g - e).abs() / size;
        ensure!(d.is_finite(), "{what}: number {i} is {g}, expected {e}");
        off += usize::from(d > tight);
        if d > worst.1 {
            worst = (i, d);
        }
    }
    let (i, d) = worst;
    ensure!(
        d <= loose && off as f32 <= share * got.len() as f32,
        "{what}: {off} of {} numbers differ, most number {i} by {d:e}: {} and not {}",
        got.len(),
        got[i],
        expected[i]
    );
    Ok(())
}
