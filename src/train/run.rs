//! The loop.

use super::checkpoint::{self, Progress};
use super::config::{Start, TrainConfig};
use super::files::Pictures;
use super::loading::Loader;
use super::optimizer::Optimizer;
use super::source::{Replay, Source};
use super::step::{Learner, Seconds, Terms};
use super::validate::{self, Found, Validator};
use super::{Error, Result};
use crate::io;
use crate::model::weights::{self, Weights};
use candle_core::Tensor;
use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Steps whose means are one line of the log.
const LOG_EVERY: u64 = 10;

/// What happens, for whoever shows it.
#[derive(Clone, Debug)]
pub enum Event {
    /// Before the first step.
    Begin {
        /// Steps done so far.
        step: u64,
        /// Numbers that are learnt.
        parameters: usize,
        /// The checkpoint that it goes on from.
        resumed: Option<PathBuf>,
        /// Tensors that the initial weights lack.
        untrained: usize,
        /// Harmless oddities of the data set, one line each.
        warnings: Vec<String>,
    },
    /// After each step.
    Step(StepReport),
    /// Loss or gradient of a step were not finite; nothing was changed.
    Skipped {
        /// Its number.
        step: u64,
    },
    /// A checkpoint was written.
    Saved(PathBuf),
    /// Held-out scenes were looked at.
    Validated {
        /// Steps done.
        step: u64,
        /// Of made-up scenes.
        rooms: Option<Found>,
        /// Of photographs.
        photos: Option<Found>,
    },
}

/// One step.
#[derive(Clone, Copy, Debug)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: u64,
    /// Means over its examples.
    pub terms: Terms,
    /// Norm of the gradient before the clip.
    pub norm: f64,
    /// Learning rate.
    pub rate: f64,
    /// By part.
    pub seconds: Seconds,
}

/// When to stop before the last step.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Minutes of this call.
    pub minutes: Option<f64>,
    /// Steps of this call.
    pub steps: Option<u64>,
}

/// A training that can take steps.
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
    /// Held so that no other process trains in the folder.
    _lock: File,
}

/// The source that `config` asks for.
fn source(config: &TrainConfig) -> Result<Arc<dyn Source>> {
    let (window, times) = (config.data.window, config.data.replay);
    Ok(match &config.data.files {
        Some(files) => Arc::new(Replay::new(Pictures::open(files, config)?, window, times)),
        None => Arc::new(Replay::new(validate::rooms(config, false)?, window, times)),
    })
}

/// The folder's lock, for as long as the file is open.
fn locked(folder: &Path) -> Result<File> {
    let path = folder.join("lock");
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|e| io::Error::io(&path, e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(Error::value(folder.display(), "a folder that nothing trains in", "one in use"))
        }
        // A file system without locks: nothing to go by.
        Err(TryLockError::Error(e)) if e.kind() == ErrorKind::Unsupported => Ok(file),
        Err(TryLockError::Error(e)) => Err(io::Error::io(&path, e).into()),
    }
}

/// Its last element is the small backbone's correction of the opacity logit.
const OPACITY_BIAS: &str = "small.head.1.bias";

/// The weights that `config` begins with, trainable.
fn start(config: &TrainConfig) -> Result<Weights> {
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
    /// Begins in `folder`, or goes on from its newest checkpoint, with the examples that
    /// `config` asks for.
    ///
    /// # Errors
    /// A configuration that does not check; weights or a checkpoint that do not fit; a
    /// folder that cannot be made.
    pub fn open(config: &TrainConfig, folder: &Path) -> Result<Self> {
        Self::with_source(config, folder, source(config)?)
    }

    /// [`Training::open`] with examples of another source.
    ///
    /// # Errors
    /// As [`Training::open`].
    pub fn with_source(
        config: &TrainConfig,
        folder: &Path,
        source: Arc<dyn Source>,
    ) -> Result<Self> {
        config.check()?;
        std::fs::create_dir_all(folder).map_err(|e| io::Error::io(folder, e))?;
        let lock = locked(folder)?;
        let warnings = source.warnings();
        let newest = checkpoint::steps(folder).last().map(|s| checkpoint::path(folder, *s));
        let weights = match newest {
            // The checkpoint holds every tensor.
            Some(_) => Weights::seeded(config.seed).trainable(),
            None => start(config)?,
        };
        let learner = Learner::new(config, &weights)?;
        let untrained = weights.initialised().len();
        let mut optimizer = Optimizer::new(config.optimizer, weights.variables())?;
        let mut progress = Progress::default();
        if let Some(path) = &newest {
            let old = checkpoint::load(path)?;
            if old.config.model_config()? != config.model_config()? {
                return Err(Error::value(path.display(), "the same model", "another model"));
            }
            optimizer.restore(old.state)?;
            progress = old.progress;
        }
        let data = &config.data;
        let loader = Loader::start(
            source,
            (data.augment, config.seed),
            (data.workers, data.ahead),
            progress.examples,
        )?;
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
            _lock: lock,
        })
    }

    /// How far it is.
    pub fn progress(&self) -> &Progress {
        &self.progress
    }

    /// The optimizer, with all weights.
    pub fn optimizer(&self) -> &Optimizer {
        &self.optimizer
    }

    /// One step: gradients of `batch` × `accumulate` examples, then the optimizer.
    /// `None`: loss or gradient were not finite and nothing was changed.
    ///
    /// # Errors
    /// A source or the network fails; too many steps in a row were not finite.
    pub fn step(&mut self) -> Result<Option<StepReport>> {
        let begin = Instant::now();
        let config = &self.config;
        let step = self.progress.step;
        let mut seconds = Seconds::default();
        let mut gradients = self.optimizer.gradients();
        let mut terms = Terms::default();
        let share = 1.0 / config.examples_per_step() as f64;
        for _ in 0..config.accumulate {
            let start = Instant::now();
            let examples =
                (0..config.batch).map(|_| self.loader.take()).collect::<Result<Vec<_>>>()?;
            seconds.data += start.elapsed().as_secs_f64();
            let found = self.learner.accumulate(
                &examples,
                (share, step),
                &self.optimizer,
                &mut gradients,
                &mut seconds,
            )?;
            terms.add(&found, 1.0 / config.accumulate as f64);
        }
        let start = Instant::now();
        let norm = gradients.norm();
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

    /// Writes a checkpoint, and the averaged weights as `weights.safetensors`.
    ///
    /// # Errors
    /// The folder is missing or full.
    pub fn save(&self) -> Result<PathBuf> {
        let state = self.optimizer.state()?;
        let about = (&self.progress, &self.config);
        let path = checkpoint::save(&self.folder, about, &state, self.config.checkpoint.keep)?;
        self.save_weights()?;
        Ok(path)
    }

    fn save_weights(&self) -> Result<()> {
        let file = self.folder.join("weights.safetensors");
        Ok(weights::save(&file, &self.optimizer.averaged()?, &self.config.model_config()?)?)
    }

    /// Steps until the configuration's last one or a limit, with checkpoints, looks at
    /// what `validator` holds, and `log.csv`.
    ///
    /// # Errors
    /// As [`Training::step`] and [`Training::save`].
    pub fn run(
        &mut self,
        limits: Limits,
        validator: &Validator,
        tell: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        tell(&Event::Begin {
            step: self.progress.step,
            parameters: self.optimizer.parameters(),
            resumed: self.resumed.clone(),
            untrained: self.untrained,
            warnings: self.warnings.clone(),
        });
        let mut log = Log::open(&self.folder, self.progress.step)?;
        let begin = Instant::now();
        let minutes = |since: Instant| since.elapsed().as_secs_f64() / 60.0;
        let (mut saved, mut looked) = (Instant::now(), Instant::now());
        let mut done = 0;
        while self.progress.step < self.config.steps
            && limits.steps.is_none_or(|n| done < n)
            && limits.minutes.is_none_or(|m| minutes(begin) < m)
        {
            match self.step()? {
                Some(report) => {
                    log.step(&report, self.progress.seconds)?;
                    tell(&Event::Step(report));
                }
                None => tell(&Event::Skipped { step: self.progress.step }),
            }
            done += 1;
            if minutes(saved) >= self.config.checkpoint.minutes {
                tell(&Event::Saved(self.save()?));
                saved = Instant::now();
            }
            if minutes(looked) >= self.config.validate.minutes {
                self.look(validator, &mut log, tell)?;
                looked = Instant::now();
            }
        }
        if done > 0 {
            tell(&Event::Saved(self.save()?));
            self.look(validator, &mut log, tell)?;
        } else if self.resumed.is_some() {
            // What was stopped after its checkpoint has older ones, or none.
            self.save_weights()?;
        }
        Ok(())
    }

    fn look(
        &self,
        validator: &Validator,
        log: &mut Log,
        tell: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        let step = self.progress.step;
        let sheet = self.folder.join(format!("sheet-{step:08}"));
        let [rooms, photos] = validator.look(self.optimizer.averaged()?, Some(&sheet))?;
        for (what, found) in [("rooms", &rooms), ("photos", &photos)] {
            if let Some(found) = found {
                log.validated((step, what), self.progress.seconds, found)?;
            }
        }
        tell(&Event::Validated { step, rooms, photos });
        Ok(())
    }
}

/// `log.csv` and `validation.csv`: appended to, one line at a time.
struct Log {
    steps: File,
    looks: File,
    folder: PathBuf,
    terms: Terms,
    seconds: Seconds,
    count: u64,
}

/// A file to append to, with `header` where it is new. Rows of steps after `step`, which
/// were lost with the process that took them and will be taken again, are removed, and so
/// is a row that was cut off.
fn appended(path: &Path, header: &str, step: u64) -> Result<File> {
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
    /// Of a training that has done `step` steps.
    fn open(folder: &Path, step: u64) -> Result<Self> {
        let parts: Vec<&str> = Seconds::default().parts().map(|p| p.0).to_vec();
        let header = format!(
            "step,seconds,rate,loss,psnr,dssim,lpips,cross_entropy,disparity,confidence,norm,{}",
            parts.join(",")
        );
        Ok(Self {
            steps: appended(&folder.join("log.csv"), &header, step)?,
            looks: appended(
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

    fn validated(&mut self, (step, what): (u64, &str), seconds: f64, f: &Found) -> Result<()> {
        let line = format!(
            "{step},{seconds:.1},{what},{:.3},{:.4},{:.3},{:.4},{:.3}",
            f.psnr, f.ssim, f.disparity, f.within_one, f.copy_psnr
        );
        writeln!(self.looks, "{line}").map_err(|e| io::Error::io(&self.folder, e).into())
    }
}
