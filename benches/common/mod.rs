//! A small harness: contenders for one job, checked before they are timed, take turns in
//! one process, so that other load on the machine falls on all of them alike. Reported
//! are medians and minima, ratios to the group's first contender, and, where a job says
//! what it must move and compute at least, bandwidth beside that of a plain copy and
//! arithmetic beside a loop of multiply-adds, both measured in the same run.
//!
//! `cargo bench --bench raster -- [NAME …] [--quick] [--seconds S] [--threads N]
//! [--json FILE] [--write DIR] [--onnxruntime]`; a group runs where its name contains every NAME.

#[allow(dead_code, reason = "each bench uses a part")]
pub mod conventional;
#[allow(dead_code, reason = "each bench uses a part")]
pub mod inputs;
mod machine;
#[allow(dead_code, reason = "each bench uses a part")]
pub mod scene;

use anyhow::{Context, Result, bail, ensure};
use machine::Machine;
use rayon::{ThreadPool, ThreadPoolBuilder};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Fewest and most turns of a contender.
const TURNS: (usize, usize) = (3, 200);
/// Seconds below which runs before each turn do not count.
const QUICK_S: f64 = 0.05;
/// Seconds of such runs: the system spreads threads that have slept over the cores only
/// after some milliseconds, and on two cores a call of one millisecond never saw the second.
const WARM_S: f64 = 0.03;

/// What the command line says.
#[derive(Default)]
pub struct Args {
    pub names: Vec<String>,
    /// Fewer and smaller cases.
    pub quick: bool,
    seconds: Option<f64>,
    threads: Option<usize>,
    json: Option<PathBuf>,
    /// Folder to write scenes to, instead of timing.
    #[allow(dead_code, reason = "only scenes are written")]
    pub write: Option<PathBuf>,
    /// Run onnxruntime beside ours.
    #[allow(dead_code, reason = "only the network has such a rival")]
    pub onnxruntime: bool,
}

impl Args {
    fn parse() -> Result<Self> {
        let mut out = Self::default();
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            let mut value = || words.next().with_context(|| format!("{word}: expected a value"));
            match word.as_str() {
                // What `cargo bench` itself adds.
                "--bench" => {}
                "--quick" => out.quick = true,
                "--onnxruntime" => out.onnxruntime = true,
                "--seconds" => out.seconds = Some(value()?.parse().context("--seconds")?),
                "--threads" => out.threads = Some(value()?.parse().context("--threads")?),
                "--json" => out.json = Some(value()?.into()),
                "--write" => out.write = Some(value()?.into()),
                other if other.starts_with('-') => bail!("unknown option {other}"),
                name => out.names.push(name.to_owned()),
            }
        }
        Ok(out)
    }
}

/// On how many threads a contender runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Threads {
    /// One.
    #[allow(dead_code, reason = "each bench uses a part")]
    One,
    /// All that the machine has, or `--threads`.
    All,
}

/// What one call must at least move between memory and caches, and compute.
#[derive(Clone, Copy, Debug, Default)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: f64,
    /// Multiplications and additions.
    pub flops: f64,
}

/// One way to do a group's job.
pub struct Contender<'a> {
    name: String,
    threads: Threads,
    /// Seconds, where it measures them itself.
    run: Box<dyn FnMut() -> Result<Option<f64>> + Send + 'a>,
    elsewhere: bool,
    work: Option<Work>,
}

impl<'a> Contender<'a> {
    /// A contender named `name`.
    pub fn new(
        name: impl Into<String>,
        threads: Threads,
        mut run: impl FnMut() -> Result<()> + Send + 'a,
    ) -> Self {
        let run = Box::new(move || run().map(|()| None));
        Self { name: name.into(), threads, run, elsewhere: false, work: None }
    }

    /// A contender in another process, which says how many seconds it took.
    #[allow(dead_code, reason = "each bench uses a part")]
    pub fn elsewhere(
        name: impl Into<String>,
        mut run: impl FnMut() -> Result<f64> + Send + 'a,
    ) -> Self {
        let run = Box::new(move || run().map(Some));
        Self { name: name.into(), threads: Threads::All, run, elsewhere: true, work: None }
    }

    /// With its least work.
    #[allow(dead_code, reason = "each bench uses a part")]
    pub fn with_work(mut self, work: Work) -> Self {
        self.work = Some(work);
        self
    }
}

/// Times of one contender, seconds.
#[derive(Default)]
struct Times {
    wall: Vec<f64>,
    /// CPU time of the whole process over all turns, where the system tells.
    cpu: Option<f64>,
}

impl Times {
    fn median(&self) -> f64 {
        let mut sorted = self.wall.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }

    fn least(&self) -> f64 {
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

    /// Threads of [`Threads::All`].
    #[allow(dead_code, reason = "each bench uses a part")]
    pub fn threads(&self) -> usize {
        self.all.current_num_threads()
    }

    /// Whether the command line asks for a group of this name.
    pub fn wants(&self, group: &str) -> bool {
        self.args.names.iter().all(|n| group.contains(n.as_str()))
    }

    /// Runs `work` on all threads.
    #[allow(dead_code, reason = "each bench uses a part")]
    pub fn on_all<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.all.install(work)
    }

    /// `work` on the pool of one thread.
    #[allow(dead_code, reason = "each bench uses a part")]
    pub fn on_one<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.one.install(work)
    }

    fn pool(&self, threads: Threads) -> &ThreadPool {
        match threads {
            Threads::One => &self.one,
            Threads::All => &self.all,
        }
    }

    /// Times `contenders` in turns and prints a table; ratios are to the first one.
    ///
    /// # Errors
    /// Those of the contenders.
    pub fn group(&mut self, name: &str, mut contenders: Vec<Contender>, note: &str) -> Result<()> {
        if self.machine.is_none() {
            self.machine = Some(Machine::measure(&self.one, &self.all, self.args.quick));
        }
        let seconds = self.args.seconds.unwrap_or(if self.args.quick { 2.0 } else { 10.0 });
        let share = seconds / contenders.len() as f64;
        let mut times: Vec<Times> = contenders.iter().map(|_| Times::default()).collect();
        let mut busy = true;
        while busy {
            busy = false;
            for (contender, times) in contenders.iter_mut().zip(&mut times) {
                let spent: f64 = times.wall.iter().sum();
                let turns = times.wall.len();
                if turns >= TURNS.0 && (spent > share || turns >= TURNS.1) {
                    continue;
                }
                busy = true;
                let pool = self.pool(contender.threads);
                let run = &mut contender.run;
                // What is quick is timed as within a longer computation: its data in the
                // caches, its threads awake.
                let quick = times.wall.last().is_none_or(|t| *t < QUICK_S);
                let warm = if quick && !contender.elsewhere { WARM_S } else { 0.0 };
                let timed = || {
                    let start = Instant::now();
                    while start.elapsed().as_secs_f64() < warm {
                        run()?;
                    }
                    let cpu = cpu_seconds();
                    let start = Instant::now();
                    let told = run()?;
                    let wall = told.unwrap_or(start.elapsed().as_secs_f64());
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
            "least ms",
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
            let (median, least) = (times.median(), times.least());
            let cpu = times.cpu.map(|cpu| 1e3 * cpu / times.wall.len() as f64);
            let rate = contender.work.map(|w| [1e-9 * w.bytes / least, 1e-9 * w.flops / least]);
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
                1e3 * least,
                cpu.map_or(String::new(), |cpu| format!("{cpu:.0}")),
                base / median,
                part(0),
                part(1),
            );
            rows.push(json!({
                "contender": contender.name,
                "threads": threads,
                "median_ms": 1e3 * median,
                "least_ms": 1e3 * least,
                "cpu_ms": cpu,
                "turns": times.wall.len(),
                "speed_to_first": base / median,
                "gb_s": rate.map(|r| r[0]),
                "gflop_s": rate.map(|r| r[1]),
            }));
        }
        self.groups.push(json!({ "group": name, "note": note, "rows": rows }));
    }

    /// Writes `--json`.
    ///
    /// # Errors
    /// The file cannot be written; no group had the names that were asked for.
    pub fn finish(self) -> Result<()> {
        ensure!(!self.groups.is_empty(), "no group has all of {:?} in its name", self.args.names);
        let Some(path) = &self.args.json else { return Ok(()) };
        let report = json!({
            "bench": self.name,
            "threads": self.all.current_num_threads(),
            "machine": self.machine.map(|m| json!({ "copy_gb_s": m.copy, "fma_gflop_s": m.fma })),
            "groups": self.groups,
        });
        let text = serde_json::to_vec_pretty(&report)?;
        subsplat::io::write_atomic(path, |f| std::io::Write::write_all(f, &text))?;
        Ok(())
    }
}

/// CPU time of this process so far; `None` where the system does not say (anything
/// but Linux). Ticks of 10 ms.
fn cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The second field is a name in parentheses that may hold blanks.
    let after = stat.rsplit_once(')')?.1;
    let ticks: Vec<f64> =
        after.split_whitespace().skip(11).take(2).filter_map(|t| t.parse().ok()).collect();
    Some(Duration::from_millis(10).as_secs_f64() * ticks.iter().sum::<f64>())
}

/// Refuses results that differ: more than `share` of the numbers by more than `tight`,
/// or any by more than `loose`, all relative to the largest number expected. A share
/// above 0 is for decisions (alpha below 1/255, the stop) that hang on rounding.
///
/// # Errors
/// Says which number differs most.
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
