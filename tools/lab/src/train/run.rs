//! The training loop: steps, checkpoints, validation and logs.

use super::checkpoint::{self, Progress};
use super::config::{Start, TrainConfig};
use super::files::Pictures;
use super::loading::{Loader, LoaderOptions};
use super::optimizer::Optimizer;
use super::ranks::{Alone, Division, Exchange, Peers, Ranks, agree};
use super::source::{Example, Replay, Source};
use super::step::{GroupSum, Learner, Seconds, StepScale, Terms};
use super::validate::{self, Found, Split, Validator};
use super::{Error, Result};
use candle_core::Tensor;
use std::fmt::Display;
use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use subsplat::files as io;
use subsplat::network::model::weights;
use subsplat::network::model::weights::Weights;
use subsplat::network::ops::Backend;
use subsplat_kernels::clock::Instant;

/// Number of steps averaged in one line of the log.
const LOG_EVERY: u64 = 10;

/// Progress event of a training.
#[derive(Clone, Debug)]
pub enum Event {
    /// Emitted before the first step.
    Begin {
        /// Completed steps.
        step: u64,
        /// Number of parameters.
        parameters: usize,
        /// Checkpoint from which the training continues.
        resumed: Option<PathBuf>,
        /// Number of tensors without initial weights.
        untrained: usize,
        /// Warnings of the data set, one line each.
        warnings: Vec<String>,
    },
    /// Emitted after each step.
    Step(StepReport),
    /// Loss or gradient of a step were not finite; the weights are unchanged.
    Skipped {
        /// Number of the step.
        step: u64,
    },
    /// A checkpoint was written.
    Saved(PathBuf),
    /// The model was evaluated on held-out scenes.
    Validated {
        /// Completed steps.
        step: u64,
        /// Scores on procedural scenes.
        rooms: Option<Found>,
        /// Scores on photographs.
        photos: Option<Found>,
    },
}

/// Measures of one step.
#[derive(Clone, Copy, Debug)]
pub struct StepReport {
    /// Completed steps, this one included.
    pub step: u64,
    /// Loss terms, means over the examples of the step.
    pub terms: Terms,
    /// Norm of the gradient before clipping.
    pub norm: f64,
    /// Learning rate.
    pub rate: f64,
    /// Seconds of each part.
    pub seconds: Seconds,
}

/// Limits of one call of [`Training::run`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits<'a> {
    /// Maximum duration, minutes.
    pub minutes: Option<f64>,
    /// Maximum number of steps.
    pub steps: Option<u64>,
    /// True asks for an end after the current step. The checkpoint is then written, and the final
    /// evaluation is left out.
    pub stop: Option<&'a AtomicBool>,
}

impl Limits<'_> {
    fn stopped(&self) -> bool {
        self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed))
    }
}

/// A training at a certain step.
pub struct Training {
    config: TrainConfig,
    folder: PathBuf,
    learner: Learner,
    optimizer: Optimizer,
    loader: Loader,
    progress: Progress,
    resumed: Option<PathBuf>,
    untrained: usize,
    warnings: Vec<String>,
    /// The other processes of the training; `None` for one process alone.
    exchange: Option<Exchange>,
    /// Wish of this process to end after the step.
    end: bool,
    division: Division,
    /// Lock of the folder against other trainings, which rank 0 holds.
    _lock: Option<File>,
}

/// Opens the source of examples that `config` specifies.
fn source(config: &TrainConfig) -> Result<Arc<dyn Source>> {
    let (window, times) = (config.data.window, config.data.replay);
    Ok(match &config.data.files {
        Some(files) => Arc::new(Replay::new(Pictures::open(files, config)?, window, times)),
        None => Arc::new(Replay::new(validate::rooms(config, Split::Training)?, window, times)),
    })
}

/// Locks the folder while the returned file is open.
fn lock_folder(folder: &Path) -> Result<File> {
    let path = folder.join("lock");
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|e| io::Error::io(&path, e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(Error::value(folder.display(), "a folder without another training", "one in use"))
        }
        // The file system has no locks.
        Err(TryLockError::Error(e)) if e.kind() == ErrorKind::Unsupported => Ok(file),
        Err(TryLockError::Error(e)) => Err(io::Error::io(&path, e).into()),
    }
}

/// Tensor whose last element is the small backbone's offset of the opacity logit.
const OPACITY_BIAS: &str = "small.head.1.bias";

/// Returns the initial weights of `config`, trainable.
fn initial_weights(config: &TrainConfig) -> Result<Weights> {
    Ok(match &config.init {
        Start::Scratch => Weights::seeded(config.seed),
        Start::Weights { path, opacity } => {
            let mut tensors = Weights::load(path)?.tensors().clone();
            if let Some(bias) = tensors.get_mut(OPACITY_BIAS).filter(|_| *opacity != 0.0) {
                let mut values = bias.flatten_all()?.to_vec1::<f32>()?;
                values.iter_mut().rev().take(1).for_each(|last| *last += opacity);
                *bias = Tensor::from_vec(values, bias.shape(), bias.device())?;
            }
            Weights::from_tensors(tensors).allow_missing("", config.seed)
        }
    }
    .trainable())
}

impl Training {
    /// Starts a training in `folder`, or continues from its newest checkpoint, with the examples of
    /// `config`.
    ///
    /// # Errors
    /// An invalid configuration; weights or a checkpoint that do not fit; a folder that cannot be
    /// created or is in use.
    pub fn open(config: &TrainConfig, folder: &Path) -> Result<Self> {
        Self::open_shared(config, folder, Box::new(Alone))
    }

    /// [`Training::open`] as one of several processes that share the training. All of them receive
    /// the same configuration and the same folder, and begin with the same checkpoint.
    ///
    /// # Errors
    /// As [`Training::open`]; more ranks than groups of scenes in a step; another rank that cannot
    /// open the training.
    pub fn open_shared(
        config: &TrainConfig,
        folder: &Path,
        mut peers: Box<dyn Peers>,
    ) -> Result<Self> {
        let ranks = peers.ranks();
        let opened = source(config).and_then(|source| Self::with(config, folder, source, ranks));
        let mut training = agree(&mut *peers, opened)?;
        if ranks.count > 1 {
            training.exchange = Some(Exchange::new(config, peers)?);
        }
        Ok(training)
    }

    /// Opens the training of one rank, without its connection to the others.
    fn with(
        config: &TrainConfig,
        folder: &Path,
        source: Arc<dyn Source>,
        ranks: Ranks,
    ) -> Result<Self> {
        config.check()?;
        ranks.check(config)?;
        std::fs::create_dir_all(folder).map_err(|e| io::Error::io(folder, e))?;
        let lock = if ranks.rank == 0 { Some(lock_folder(folder)?) } else { None };
        let warnings = source.warnings();
        let newest = checkpoint::steps(folder).last().map(|s| checkpoint::path(folder, *s));
        let weights = match newest {
            // The checkpoint holds every tensor.
            Some(_) => Weights::seeded(config.seed).trainable(),
            None => initial_weights(config)?,
        };
        let learner = Learner::new(config, &weights)?;
        let untrained = weights.initialised().len();
        let mut optimizer = Optimizer::new(config.optimizer.clone(), weights.variables())?;
        let mut progress = Progress::default();
        if let Some(path) = &newest {
            let old = checkpoint::load(path)?;
            if old.config.model_config()? != config.model_config()? {
                return Err(Error::value(path.display(), "the same model", "another model"));
            }
            optimizer.restore(old.state)?;
            progress = old.progress;
        }
        if let Some(executor) = learner.executor() {
            optimizer.set_device(executor, learner.backend())?;
        }
        let division = Division::of(config, ranks);
        let data = &config.data;
        let options = LoaderOptions {
            augmentation: data.augment,
            seed: config.seed,
            workers: data.workers,
            ahead: data.ahead,
            division,
        };
        let loader = Loader::start(source, options, progress.examples)?;
        Ok(Self {
            config: config.clone(),
            folder: folder.to_owned(),
            learner,
            optimizer,
            loader,
            progress,
            resumed: newest,
            untrained,
            warnings,
            exchange: None,
            end: false,
            division,
            _lock: lock,
        })
    }

    /// Returns the progress.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// Returns the kernels of the configured device.
    pub fn backend(&self) -> &Backend {
        self.learner.backend()
    }

    /// Returns why the CPU took over work of the configured GPU; `None` where it did not.
    pub fn warning(&self) -> Option<String> {
        self.learner.warning()
    }

    /// Returns the optimizer, which holds all weights.
    pub fn optimizer(&self) -> &Optimizer {
        &self.optimizer
    }

    /// Takes one step: gradients of `batch` × `accumulate` examples, then the optimizer.
    ///
    /// Returns `None` if loss or gradient were not finite; the weights are then unchanged.
    ///
    /// # Errors
    /// An error of the source or the network, of this or another rank; too many
    /// consecutive steps that were not finite.
    pub fn step(&mut self) -> Result<Option<StepReport>> {
        let begin = Instant::now();
        let step = self.progress.step;
        let mut seconds = Seconds::default();
        let mut gradients = self.optimizer.gradients();
        let mut terms = Terms::default();
        let scale = StepScale { share: 1.0 / self.config.examples_per_step() as f64, step };
        if let Some(exchange) = &mut self.exchange {
            exchange.begin(step, &self.optimizer);
        }
        for round in 0..self.config.accumulate {
            let own = self.own_groups(scale, &mut seconds);
            let sums = match &mut self.exchange {
                Some(exchange) => exchange.round(own, self.end, &self.optimizer)?,
                None => vec![own?],
            };
            let mut sums: Vec<_> = sums.into_iter().map(Vec::into_iter).collect();
            let mut of_round = Terms::default();
            // In the order of the groups: the sums do not depend on their processes.
            for group in 0..self.division.groups() {
                let owner = self.division.owner(step, round, group);
                let sum = sums.get_mut(owner).and_then(Iterator::next);
                let sum =
                    sum.ok_or_else(|| Error::value("step", "a result of every scene", "none"))?;
                let share = self.division.scenes(group) as f64 / self.config.batch as f64;
                sum.add_to(&mut gradients, &mut of_round, &mut seconds, share);
            }
            terms.add(&of_round, 1.0 / self.config.accumulate as f64);
        }
        let config = &self.config;
        let start = Instant::now();
        let norm = self.optimizer.norm(&gradients)?;
        let rate = config.schedule.rate(step, config.steps);
        let finite = terms.loss.is_finite() && norm.is_finite();
        if finite {
            self.optimizer.step(&gradients, norm, rate, step)?;
        }
        seconds.optimizer += start.elapsed().as_secs_f64();
        self.progress.step += 1;
        self.progress.examples = self.loader.position();
        self.progress.seconds += begin.elapsed().as_secs_f64();
        self.progress.bad = if finite { 0 } else { self.progress.bad + 1 };
        if self.progress.bad >= config.checkpoint.bad_steps {
            return Err(Error::Diverged { step, times: self.progress.bad });
        }
        let report = StepReport { step: self.progress.step, terms, norm, rate, seconds };
        Ok(finite.then_some(report))
    }

    /// Takes the examples of a batch, and computes the groups of this rank in their order.
    fn own_groups(&mut self, scale: StepScale, seconds: &mut Seconds) -> Result<Vec<GroupSum>> {
        let start = Instant::now();
        let take = |_| self.loader.take();
        let examples = (0..self.config.batch).map(take).collect::<Result<Vec<_>>>()?;
        seconds.data += start.elapsed().as_secs_f64();
        // A group has one rank, so the examples of a group are all here or all elsewhere.
        let groups = examples.chunks(self.config.together.max(1));
        let groups: Vec<Vec<&Example>> = groups
            .map(|group| group.iter().flatten().collect::<Vec<_>>())
            .filter(|group| !group.is_empty())
            .collect();
        self.learner.group_sums(&groups, scale, &self.optimizer)
    }

    /// Returns the value of `own` if all ranks of the training have one. All ranks call it at the same
    /// point.
    ///
    /// # Errors
    /// The error of `own`; otherwise that of the first rank that failed.
    pub fn agree<T, E: Display + From<Error>>(
        &mut self,
        own: std::result::Result<T, E>,
    ) -> std::result::Result<T, E> {
        match &mut self.exchange {
            Some(exchange) => exchange.agree(own),
            None => own,
        }
    }

    /// Writes a checkpoint, and the averaged weights as `weights.safetensors`.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn save(&self) -> Result<PathBuf> {
        let state = self.optimizer.state()?;
        let metadata = (&self.progress, &self.config);
        let path = checkpoint::save(&self.folder, metadata, &state, self.config.checkpoint.keep)?;
        self.save_weights()?;
        Ok(path)
    }

    /// Writes the averaged weights.
    fn save_weights(&self) -> Result<()> {
        let file = self.folder.join("weights.safetensors");
        Ok(weights::save(&file, &self.optimizer.averaged()?, &self.config.model_config()?)?)
    }

    /// Takes steps until the last step of the configuration or a limit. It writes checkpoints,
    /// `log.csv` and `validation.csv`, evaluates the scenes of `validator`, and calls
    /// `report_event` with each event.
    ///
    /// # Errors
    /// As [`Training::step`] and [`Training::save`].
    pub fn run(
        &mut self,
        limits: Limits<'_>,
        validator: &Validator,
        report_event: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        let outcome = self.run_rank(limits, validator, report_event);
        self.agree(outcome)
    }

    /// [`Training::run`] of this rank.
    fn run_rank(
        &mut self,
        limits: Limits<'_>,
        validator: &Validator,
        report_event: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        report_event(&Event::Begin {
            step: self.progress.step,
            parameters: self.optimizer.parameters(),
            resumed: self.resumed.clone(),
            untrained: self.untrained,
            warnings: self.warnings.clone(),
        });
        let mut log = match self.division.ranks().rank {
            0 => Some(Log::open(&self.folder, self.progress.step)?),
            _ => None,
        };
        let begin = Instant::now();
        let minutes = |since: Instant| since.elapsed().as_secs_f64() / 60.0;
        let (mut saved, mut validated) = (Instant::now(), Instant::now());
        let mut validated_step = None;
        let mut done = 0;
        let reached = |done: u64| {
            limits.steps.is_some_and(|n| done >= n)
                || limits.minutes.is_some_and(|m| minutes(begin) >= m)
                || limits.stopped()
        };
        loop {
            // The ranks end together: each knows after a step whether one of them wished it.
            let ends = match &self.exchange {
                Some(exchange) => exchange.ends() || limits.steps == Some(0),
                None => reached(done),
            };
            if ends || self.progress.step >= self.config.steps {
                break;
            }
            self.end = reached(done + 1);
            let taken = self.step();
            if taken.is_err() && self.exchange.is_some() && log.is_some() && done > 0 {
                // A rank failed; the steps so far are complete.
                report_event(&Event::Saved(self.save()?));
            }
            match taken? {
                Some(report) => {
                    if let Some(log) = &mut log {
                        log.step(&report, self.progress.seconds)?;
                    }
                    report_event(&Event::Step(report));
                }
                None => report_event(&Event::Skipped { step: self.progress.step }),
            }
            done += 1;
            let Some(log) = &mut log else { continue };
            if minutes(saved) >= self.config.checkpoint.minutes {
                report_event(&Event::Saved(self.save()?));
                saved = Instant::now();
            }
            let due = match self.config.validate.steps {
                0 => minutes(validated) >= self.config.validate.minutes,
                every => self.progress.step.is_multiple_of(every),
            };
            if due && !limits.stopped() {
                self.validate(validator, log, report_event)?;
                validated = Instant::now();
                validated_step = Some(self.progress.step);
            }
        }
        if let Some(log) = &mut log {
            if done > 0 {
                report_event(&Event::Saved(self.save()?));
                if !limits.stopped() && validated_step != Some(self.progress.step) {
                    self.validate(validator, log, report_event)?;
                }
            } else if self.resumed.is_some() {
                // The training may have stopped between its checkpoint and its weights.
                self.save_weights()?;
            }
        }
        Ok(())
    }

    /// Evaluates the averaged weights and logs the scores.
    fn validate(
        &self,
        validator: &Validator,
        log: &mut Log,
        report_event: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        let step = self.progress.step;
        let sheet = self.folder.join(format!("sheet-{step:08}"));
        let [rooms, photos] = validator.evaluate(self.optimizer.averaged()?, Some(&sheet))?;
        for (name, found) in [("rooms", &rooms), ("photos", &photos)] {
            if let Some(found) = found {
                log.validation(step, name, self.progress.seconds, found)?;
            }
        }
        report_event(&Event::Validated { step, rooms, photos });
        Ok(())
    }
}

/// The files `log.csv` and `validation.csv`, to which lines are appended.
struct Log {
    steps: File,
    validations: File,
    folder: PathBuf,
    terms: Terms,
    seconds: Seconds,
    count: u64,
}

/// Opens a CSV file for appending and writes `header` to a new one.
///
/// Rows of steps after `step` are removed: a killed process wrote them, and the training repeats
/// those steps. An incomplete last row is also removed.
fn open_csv(path: &Path, header: &str, step: u64) -> Result<File> {
    let old = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(e) if e.kind() == ErrorKind::NotFound => String::new(),
        Err(e) => return Err(io::Error::io(path, e).into()),
    };
    let mut rows = old.split_inclusive('\n').filter(|row| row.ends_with('\n'));
    let mut kept = rows.next().map_or_else(|| format!("{header}\n"), str::to_owned);
    let done = |row: &&str| {
        let of = row.split(',').next().and_then(|n| n.parse::<u64>().ok());
        of.is_none_or(|n| n <= step)
    };
    kept.extend(rows.filter(done));
    if kept != old {
        io::write_atomic(path, |f| f.write_all(kept.as_bytes()))?;
    }
    Ok(File::options().append(true).open(path).map_err(|e| io::Error::io(path, e))?)
}

impl Log {
    /// Opens the logs of a training with `step` completed steps.
    fn open(folder: &Path, step: u64) -> Result<Self> {
        let parts: Vec<&str> = Seconds::default().parts().map(|p| p.0).to_vec();
        let header = format!(
            "step,seconds,rate,loss,psnr,dssim,lpips,cross_entropy,disparity,confidence,norm,{}",
            parts.join(",")
        );
        Ok(Self {
            steps: open_csv(&folder.join("log.csv"), &header, step)?,
            validations: open_csv(
                &folder.join("validation.csv"),
                "step,seconds,what,psnr,ssim,disparity,within_one,copy_psnr",
                step,
            )?,
            folder: folder.to_owned(),
            terms: Terms::default(),
            seconds: Seconds::default(),
            count: 0,
        })
    }

    /// Adds a step, and writes a line of means every [`LOG_EVERY`] steps.
    fn step(&mut self, report: &StepReport, seconds: f64) -> Result<()> {
        self.terms.add(&report.terms, 1.0);
        self.seconds.add(&report.seconds);
        self.count += 1;
        if !report.step.is_multiple_of(LOG_EVERY) {
            return Ok(());
        }
        let mut t = Terms::default();
        t.add(&self.terms, 1.0 / self.count as f64);
        let mut line = format!("{},{seconds:.1},{:.4e},{:.5}", report.step, report.rate, t.loss);
        let values = [t.psnr(), t.dssim, t.lpips, t.cross_entropy, t.disparity, t.confidence];
        for v in values {
            line += &if v.is_finite() { format!(",{v:.5}") } else { ",".to_owned() };
        }
        line += &format!(",{:.4}", report.norm);
        for (_, s) in self.seconds.parts() {
            line += &format!(",{:.4}", s / self.count as f64);
        }
        (self.terms, self.seconds, self.count) = (Terms::default(), Seconds::default(), 0);
        writeln!(self.steps, "{line}").map_err(|e| io::Error::io(&self.folder, e).into())
    }

    /// Writes the scores on the scenes called `name`.
    fn validation(&mut self, step: u64, name: &str, seconds: f64, f: &Found) -> Result<()> {
        let line = format!(
            "{step},{seconds:.1},{name},{:.3},{:.4},{:.3},{:.4},{:.3}",
            f.psnr, f.ssim, f.disparity, f.within_one, f.copy_psnr
        );
        writeln!(self.validations, "{line}").map_err(|e| io::Error::io(&self.folder, e).into())
    }
}
