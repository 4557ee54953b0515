//! `subsplat-lab paper`: the paper's tables and figures by one command, the paper's numbers beside.
//!
//! `tables.rs` lists them as data. Rows are scored by [`crate::eval`]; rows whose weights exist
//! nowhere are trained by [`crate::train`].

mod data;
mod models;
mod published;
mod sheet;
mod tables;
mod video;
mod write;

use super::args_paper::PaperArgs;
use crate::eval::{CaseResult, Evaluator, Method, Options, Score};
use anyhow::{Context, Result, bail, ensure};
use data::{GENERATED_INPUT, Opened, Sets};
use indicatif::ProgressBar;
use models::{Chosen, Models};
use published::Book;
use serde_json::{Value, json};
use sheet::Scene;
use std::io::Write;
use std::path::Path;
use std::process::Command;
use subsplat::files::photos::image::save_png;
use subsplat::files::write_atomic;
use subsplat::reconstruct::Reconstructor;
use subsplat_cli::commands::environment;
use subsplat_cli::report::{Answer, Progress, print_line};
pub use tables::TABLES;
use tables::{Data, INPUT, Kind, Row, Setting, Source, Table, slug};
use write::{Measured, Part};

/// Side of the targets of a training, px; the inputs have a half or a quarter of it.
const TRAINING_TARGET: usize = 128;
/// Scenes of which a figure shows pictures.
const SHEETS: usize = 4;

/// Runs the command.
pub fn paper(args: &PaperArgs, answer: Answer) -> Result<()> {
    // As in `train`: candle's own thread pool takes the cores from this crate's.
    environment::restart_with("CANDLE_NUM_THREADS", || "1".into());
    let book = Book::open()?;
    let tables = tables(&args.ids)?;
    let mut progress = Progress::new();
    let mut report = serde_json::Map::new();
    for table in tables {
        let out = args.out.join(table.id);
        std::fs::create_dir_all(&out).with_context(|| format!("folder {}", out.display()))?;
        let mut maker = Maker::new(args, table, &book, &out)?;
        let value = match table.kind {
            Kind::Video => maker.video(&mut progress, answer)?,
            _ => maker.table(&mut progress, answer)?,
        };
        report.insert(table.id.to_owned(), value);
    }
    let seconds = Value::Object(progress.seconds());
    answer.line(format!("{:.1} s", seconds["total"].as_f64().unwrap_or(0.0)));
    answer.finish(&json!({ "tables": report, "seconds": seconds }))
}

/// The tables of the arguments, in their order.
fn tables(ids: &[String]) -> Result<Vec<&'static Table>> {
    if ids.iter().any(|id| id == "all") {
        return Ok(TABLES.iter().collect());
    }
    let find = |id: &String| TABLES.iter().find(|t| t.id == id).with_context(|| id.clone());
    ids.iter().map(find).collect()
}

/// Work of one table.
struct Maker<'a> {
    args: &'a PaperArgs,
    table: &'static Table,
    book: &'a Book,
    sets: Sets<'a>,
    models: Models<'a>,
    out: &'a Path,
}

/// Rows that one model serves, or pictures of another program.
struct Job {
    /// Index of each row, and its method.
    rows: Vec<(usize, Method)>,
    chosen: Option<Chosen>,
    at_target_size: bool,
}

/// Numbers and pictures of a setting, which the jobs fill.
struct Results {
    /// Name of each row.
    names: Vec<String>,
    /// Numbers of each row.
    measured: Vec<Measured>,
    /// Pictures of the first cases.
    scenes: Vec<Scene>,
}

impl<'a> Maker<'a> {
    fn new(
        args: &'a PaperArgs,
        table: &'static Table,
        book: &'a Book,
        out: &'a Path,
    ) -> Result<Self> {
        for pred in &args.pred {
            ensure!(
                matches!(pred, Method::Other { .. }),
                "--pred: expected NAME=DIR, got `{}`",
                pred.name()
            );
        }
        let sets = Sets {
            root: args.data.as_deref(),
            input: args.input_size,
            scenes: args.limit,
            generated: args.out.join("generated"),
        };
        let models = Models {
            folder: args.ckpts.as_deref(),
            trained: args.out.join("models"),
            steps: args.steps,
            target: args.input_size.unwrap_or(TRAINING_TARGET),
        };
        Ok(Self { args, table, book, sets, models, out })
    }

    /// Opens the data of a setting. Costs are measured at the paper's sizes.
    fn open(&self, setting: &Setting, progress: &mut Progress) -> Result<Opened> {
        let generated = if self.table.kind.has_memory() { INPUT } else { GENERATED_INPUT };
        self.sets.open(setting, generated, progress)
    }

    /// Evaluates all settings, writes the files, and prints the table.
    fn table(&mut self, progress: &mut Progress, answer: Answer) -> Result<Value> {
        let mut parts = Vec::new();
        let mut sheets = 0;
        let mut generated = false;
        for setting in self.table.settings {
            let opened = self.open(setting, progress)?;
            generated |= opened.generated;
            opened.benchmark.notes().iter().for_each(|n| print_line(format!("note: {n}")));
            let (part, scenes) = self.part(setting, &opened, progress)?;
            for (i, scene) in scenes.iter().enumerate() {
                let name = format!("{}-{i}-{}.png", setting.slug(), slug(&scene.name));
                save_png(self.out.join(name), &scene.sheet())?;
                sheets += 1;
            }
            parts.push(part);
        }
        let notes = self.notes(&parts, generated);
        let id = self.table.id;
        let text = write::markdown(self.table, &parts, &notes);
        let files = [
            (format!("{id}.csv"), write::csv(self.table, &parts)),
            (format!("{id}.md"), text.clone()),
        ];
        for (name, content) in &files {
            write_atomic(self.out.join(name), |f| f.write_all(content.as_bytes()))?;
        }
        answer.line(text.trim_end());
        answer.line(format!("{id}.csv, {id}.md, {sheets} pictures in {}\n", self.out.display()));
        let rows: usize = parts.iter().map(|p| p.rows.len()).sum();
        Ok(json!({ "rows": rows, "pictures": sheets, "generated": generated, "notes": notes }))
    }

    fn notes(&self, parts: &[Part], generated: bool) -> Vec<String> {
        let mut notes = Vec::new();
        if generated {
            notes.push(
                "GENERATED SCENES stand in for data sets that --data does not have: our numbers are \
                 not comparable with the paper's."
                    .to_owned(),
            );
        }
        let trained = |row: &Row| matches!(row.source, Source::Trained(_));
        if self.table.rows.iter().any(trained) {
            notes.push(format!(
                "Rows without weights in --ckpts are trained here: SubSplat's heads on the frozen small \
                 backbone, preset paper, {} steps, {} seed{}; the paper trains all of MVSplat for 300,000 \
                 steps.",
                self.args.steps,
                self.args.seeds,
                if self.args.seeds == 1 { "" } else { "s" },
            ));
        }
        let upscales = || self.table.settings.iter().map(|s| s.upscale);
        let shipped = |row: &Row| match row.source {
            Source::Method(w, _) => upscales().any(|r| !self.models.has(w.name(), r)),
            Source::MethodAtTargetSize(w, _) => !self.models.has(w.name(), 1),
            Source::Imported | Source::Trained(_) => false,
        };
        if self.table.rows.iter().any(shipped) {
            notes.push(
                "Rows \"MVSplat\" and \"SubSplat\" without weights in --ckpts use the small backbone and \
                 the heads that ship."
                    .to_owned(),
            );
        }
        if self.table.kind.has_seconds() {
            notes.push(format!(
                "Seconds: from cropped inputs to one view on this machine's processor ({} threads), \
                 median over the scenes; the paper's on one A100.",
                rayon::current_num_threads()
            ));
        }
        if self.table.kind.has_memory() {
            notes.push(
                "GB: peak memory of `subsplat-lab eval` of one generated room by this method, in a process \
                 of its own; the paper's on one A100."
                    .to_owned(),
            );
        }
        if self.table.kind.has_scores() && self.args.lpips.is_none() {
            notes.push("LPIPS needs VGG16's weights (--lpips FILE).".to_owned());
        }
        let unmeasured = |(_, ours, paper): &(String, Measured, _)| {
            ours.psnr.is_empty() && ours.seconds.is_none() && published::Published::is_some(paper)
        };
        if parts.iter().any(|p| p.rows.iter().any(unmeasured)) {
            notes.push(match self.table.kind {
                Kind::Cost => "Time and memory of other systems are not measured here.".to_owned(),
                _ => "Rows without our numbers: pictures by --pred NAME=DIR.".to_owned(),
            });
        }
        notes.extend((!self.table.note.is_empty()).then(|| self.table.note.to_owned()));
        notes.extend(write::order(parts));
        notes
    }

    /// Evaluates all rows in one setting. Returns the pictures of the first scenes too.
    fn part(
        &self,
        setting: &'static Setting,
        opened: &Opened,
        progress: &mut Progress,
    ) -> Result<(Part, Vec<Scene>)> {
        let mut names: Vec<String> = self.table.rows.iter().map(|r| r.name.to_owned()).collect();
        let known = names.len();
        names.extend(self.further_preds().map(|m| m.name().to_owned()));
        let measured = vec![Measured::default(); names.len()];
        let mut results = Results { names, measured, scenes: Vec::new() };
        for job in self.jobs(setting, known)? {
            let model = job.chosen.as_ref().map(|c| c.load(job.upscale(setting))).transpose()?;
            let label = format!("{} {}", self.table.id, setting.label);
            progress.steps(&label, opened.benchmark.cases().len(), |bar| {
                self.evaluate(&job, model.as_ref(), (setting, opened), &mut results, bar)
            })?;
        }
        if self.table.kind.has_memory() {
            self.measure_memory(setting, opened.input, &mut results.measured, progress)?;
        }
        let Results { names, measured, scenes } = results;
        let rows = names.into_iter().zip(measured).map(|(name, ours)| {
            let paper = self.book.find(self.table.id, &name, setting.label);
            (name, ours, paper)
        });
        let part = Part {
            label: setting.label,
            data: opened.name.clone(),
            scenes: scene_count(opened),
            rows: rows.collect(),
        };
        Ok((part, scenes))
    }

    /// Predictions of `--pred` that are no row of the table.
    fn further_preds(&self) -> impl Iterator<Item = &Method> {
        let row = |m: &&Method| self.table.rows.iter().any(|r| slug(r.name) == slug(m.name()));
        self.args.pred.iter().filter(move |m| !row(m))
    }

    /// The evaluations of a setting: one for each model.
    fn jobs(&self, setting: &Setting, known: usize) -> Result<Vec<Job>> {
        let mut jobs: Vec<Job> = Vec::new();
        for (i, row) in self.table.rows.iter().enumerate() {
            let at_target_size = matches!(row.source, Source::MethodAtTargetSize(..));
            let upscale = if at_target_size { 1 } else { setting.upscale };
            let seeds = match row.source {
                Source::Trained(variant) if !self.models.has(variant.name, upscale) => {
                    self.args.seeds
                }
                _ => 1,
            };
            for seed in 0..seeds {
                let method = match row.source {
                    Source::Imported => match self.pred(row.name, setting) {
                        Some(method) => method,
                        None => continue,
                    },
                    Source::Method(_, name) | Source::MethodAtTargetSize(_, name) => {
                        name.parse().map_err(|e: String| anyhow::anyhow!(e))?
                    }
                    Source::Trained(_) => Method::Subsplat,
                };
                let chosen = self.models.choose(&row.source, upscale, seed)?;
                let same = |j: &&mut Job| j.chosen == chosen && j.at_target_size == at_target_size;
                match jobs.iter_mut().find(same) {
                    // One method may be two rows.
                    Some(job) if !job.rows.iter().any(|(_, m)| *m == method) => {
                        job.rows.push((i, method));
                    }
                    _ => jobs.push(Job { rows: vec![(i, method)], chosen, at_target_size }),
                }
            }
        }
        let further = self
            .further_preds()
            .enumerate()
            .filter_map(|(i, method)| self.pred(method.name(), setting).map(|m| (known + i, m)));
        let rows: Vec<_> = further.collect();
        if !rows.is_empty() {
            jobs.push(Job { rows, chosen: None, at_target_size: false });
        }
        Ok(jobs)
    }

    /// The pictures of a row in `--pred`: its folder's subfolder for the setting, if there is one.
    fn pred(&self, row: &str, setting: &Setting) -> Option<Method> {
        let given = self.args.pred.iter().find(|m| slug(m.name()) == slug(row))?;
        let Method::Other { name, folder } = given else { return None };
        let own = folder.join(setting.slug());
        let folder = if own.is_dir() {
            own
        } else if self.table.settings.iter().any(|s| folder.join(s.slug()).is_dir()) {
            // A folder of other settings has nothing for this one.
            return None;
        } else {
            folder.clone()
        };
        Some(Method::Other { name: name.clone(), folder })
    }

    /// Scores the rows of a job.
    fn evaluate(
        &self,
        job: &Job,
        model: Option<&Reconstructor>,
        (setting, opened): (&Setting, &Opened),
        results: &mut Results,
        bar: &ProgressBar,
    ) -> Result<()> {
        let upscale = job.upscale(setting);
        let side = opened.input * setting.upscale / upscale;
        let options = Options {
            input_size: Some((side, side)),
            methods: job.rows.iter().map(|(_, m)| m.clone()).collect(),
            ..Options::new(upscale as f32)
        };
        let mut evaluator = Evaluator::new(options);
        if let Some(file) = &self.args.lpips {
            evaluator = evaluator.with_lpips(file)?;
        }
        let mut scores = vec![Vec::new(); job.rows.len()];
        let mut seconds = vec![Vec::new(); job.rows.len()];
        let mut sides = None;
        for (n, case) in opened.benchmark.cases().iter().enumerate() {
            let result = opened
                .benchmark
                .load(case)
                .and_then(|loaded| evaluator.case(model, case, loaded))
                .with_context(|| format!("scene {} ({})", case.scene, case.pair()))?;
            let [(input, _), (target, _)] = result.scores.sizes;
            sides = sides.or(Some([input, target]));
            for i in 0..job.rows.len() {
                scores[i].extend(result.scores.mean(i));
                seconds[i].push(result.seconds[i]);
            }
            if n < SHEETS {
                results.keep_pictures(n, job, result);
            }
            bar.inc(1);
        }
        for (i, (row, method)) in job.rows.iter().enumerate() {
            let ours = &mut results.measured[*row];
            ours.sides = sides;
            if let Some(mean) = Score::mean(&scores[i]) {
                ours.psnr.push(mean.psnr);
                ours.ssim.push(mean.ssim);
                ours.lpips.extend(mean.lpips);
            }
            if self.table.kind.has_seconds() && !matches!(method, Method::Other { .. }) {
                seconds[i].sort_by(f64::total_cmp);
                ours.seconds = seconds[i].get(seconds[i].len() / 2).copied();
            }
        }
        Ok(())
    }

    /// Measures the peak memory of each row with a model, by `subsplat-lab eval` in a process of its own.
    fn measure_memory(
        &self,
        setting: &Setting,
        input: usize,
        measured: &mut [Measured],
        progress: &mut Progress,
    ) -> Result<()> {
        let scenes = self.sets.scenes(Data::Re10k, input * setting.upscale, progress)?;
        let scene = scenes.join("scene_000");
        for (row, ours) in self.table.rows.iter().zip(measured) {
            let (weights, method, upscale) = match row.source {
                Source::Method(weights, method) => (weights, method, setting.upscale),
                Source::MethodAtTargetSize(weights, method) => (weights, method, 1),
                Source::Imported | Source::Trained(_) => continue,
            };
            let source = Source::Method(weights, method);
            let chosen = self.models.choose(&source, upscale, 0)?;
            let side = input * setting.upscale / upscale;
            let mut child = Command::new(std::env::current_exe().context("this program's file")?);
            child.args(["--json", "--threads", &rayon::current_num_threads().to_string(), "eval"]);
            child.arg(&scene).args(["--methods", method, "--upscale", &upscale.to_string()]);
            child.args(["--input-size", &side.to_string()]);
            if let Some(file) = chosen.as_ref().and_then(Chosen::file) {
                child.arg("--weights").arg(file);
            }
            let output = child.output().context("starting this program to measure its memory")?;
            if !output.status.success() {
                let text = String::from_utf8_lossy(&output.stderr);
                bail!("memory of {}: {}", row.name, text.lines().last().unwrap_or("no message"));
            }
            let report: Value = serde_json::from_slice(&output.stdout)
                .with_context(|| format!("memory of {}: the report of eval", row.name))?;
            ours.bytes = report["peak_memory_bytes"].as_u64();
        }
        Ok(())
    }
}

impl Results {
    /// Adds a case's pictures of the middle target to its scene. Of several seeds, those of the first.
    fn keep_pictures(&mut self, case: usize, job: &Job, result: CaseResult) {
        let middle = result.pictures.len() / 2;
        let Some(pictures) = result.pictures.into_iter().nth(middle) else { return };
        if self.scenes.len() == case {
            let input = result.inputs.into_iter().next();
            self.scenes.push(Scene {
                name: result.scores.scene.clone(),
                input: input.unwrap_or_else(|| pictures.truth.clone()),
                truth: pictures.truth,
                methods: Vec::new(),
            });
        }
        let scores = result.scores.targets.get(middle).map(|t| t.scores.as_slice());
        let rows = job.rows.iter().zip(pictures.methods).zip(scores.unwrap_or_default());
        for (((row, _), picture), score) in rows {
            if self.measured[*row].psnr.is_empty() {
                let label = format!("{} {:.2}", self.names[*row], score.psnr);
                self.scenes[case].methods.push((*row, label, picture));
            }
        }
    }
}

impl Job {
    fn upscale(&self, setting: &Setting) -> usize {
        if self.at_target_size { 1 } else { setting.upscale }
    }
}

/// Number of scenes of the data.
fn scene_count(opened: &Opened) -> usize {
    let mut names: Vec<&str> = opened.benchmark.cases().iter().map(|c| c.scene.as_str()).collect();
    names.dedup();
    names.len()
}
