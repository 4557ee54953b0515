//! One training over several processes: data-parallel ranks that exchange their gradients.
//!
//! The scenes of a step are in groups ([`TrainConfig::together`]), and group g, counted over all
//! steps, belongs to the rank g mod N. A rank computes the gradients of its groups and writes each to
//! a file in the folder `exchange` of the training. Then it reads the files of all other groups, adds
//! them in the order of the groups, and takes the optimizer's step on its own copy of the weights. One
//! process adds the same groups in the same order, so the weights of N ranks equal those of one
//! process bit for bit.
//!
//! The ranks need a folder that all of them see, and nothing else: no server, no order of start, no
//! network library. A rank reads and writes the gradients of all groups once a step, four bytes a
//! parameter.
//!
//! Each file names the step, the configuration and the weights that its gradients belong to, as one
//! hash. A file of an earlier or another training is therefore never added; the rank waits for the
//! right one, up to [`Ranks::wait`].

use super::optimizer::{Gradients, Optimizer};
use super::step::{GroupSum, Seconds, Terms};
use super::{Error, Result, TrainConfig};
use safetensors::{Dtype, SafeTensors};
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;
use subsplat::files as io;
use subsplat::files::weights::tensors::{TensorSpec, write_tensors};
use subsplat_kernels::clock::Instant;

/// Folder of the exchanged files, inside the training's.
const FOLDER: &str = "exchange";
/// Metadata key of the hash of step, configuration and weights.
const STATE_KEY: &str = "subsplat.train.state";
/// Metadata key of the wish to end after the step.
const END_KEY: &str = "subsplat.train.end";
/// Tensors of a file: summed gradients, parameters that received one, loss terms.
const TENSORS: [&str; 3] = ["gradients", "touched", "terms"];
/// Shortest and longest time between two looks for a file.
const POLL_INTERVALS: [Duration; 2] = [Duration::from_micros(500), Duration::from_millis(20)];
/// Longest time for which the first rank waits for the others at the end.
const END_WAIT: Duration = Duration::from_secs(20);

/// This process among those that share a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ranks {
    /// Number of this process, from 0. Rank 0 writes checkpoints, weights and logs.
    pub rank: usize,
    /// Number of processes.
    pub count: usize,
    /// Longest time for which a rank waits for another's gradients. It covers a validation, for
    /// which all other ranks wait.
    pub wait: Duration,
}

impl Ranks {
    /// Rank `rank` of `count`, which waits for half an hour.
    pub fn new(rank: usize, count: usize) -> Self {
        Self { rank, count, wait: Duration::from_secs(1800) }
    }

    /// One process alone.
    pub fn single() -> Self {
        Self::new(0, 1)
    }

    /// Returns the rank of a group, counted over all steps.
    fn owner(&self, group: u64) -> usize {
        (group % self.count as u64) as usize
    }

    /// Checks that every rank has a group in every step of `config`.
    ///
    /// # Errors
    /// A rank that is not below the number of ranks; more ranks than groups in a step.
    pub(super) fn check(&self, config: &TrainConfig) -> Result<()> {
        if self.rank >= self.count {
            let expected = format!("a number below {}", self.count);
            return Err(Error::value("rank", expected, self.rank));
        }
        let groups = config.accumulate * Division::of(config, *self).groups();
        if self.count > groups {
            let expected = format!("at most {groups}, the groups of `together` scenes in a step");
            return Err(Error::value("number of ranks", expected, self.count));
        }
        Ok(())
    }
}

/// Division of the examples among the ranks.
#[derive(Clone, Copy, Debug)]
pub struct Division {
    batch: usize,
    together: usize,
    ranks: Ranks,
}

impl Division {
    /// The division for rank `ranks.rank` of a training.
    pub fn of(config: &TrainConfig, ranks: Ranks) -> Self {
        Self { batch: config.batch.max(1), together: config.together.max(1), ranks }
    }

    /// Number of groups in a batch.
    fn groups(&self) -> usize {
        self.batch.div_ceil(self.together)
    }

    /// Returns whether this rank computes example `index`.
    pub(super) fn has(&self, index: u64) -> bool {
        let batch = self.batch as u64;
        let group = (index % batch) / self.together as u64;
        let all = (index / batch) * self.groups() as u64 + group;
        self.ranks.owner(all) == self.ranks.rank
    }

    /// Number of ranks.
    pub(super) fn count(&self) -> usize {
        self.ranks.count
    }
}

/// The files through which the ranks exchange the gradients of a step.
pub(super) struct Exchange {
    folder: PathBuf,
    ranks: Ranks,
    /// The configuration as JSON.
    config: String,
    step: u64,
    /// Hash of the step, the configuration and the weights.
    state: u64,
    /// True if a rank requests the end of the training after this step.
    ends: bool,
    /// Files of this rank for this step and the one before.
    written: [Vec<PathBuf>; 2],
}

impl Exchange {
    /// Creates the folder for the exchange and removes files that this rank left there.
    ///
    /// # Errors
    /// A folder that cannot be created.
    pub(super) fn open(folder: &Path, config: &TrainConfig, ranks: Ranks) -> Result<Self> {
        let folder = folder.join(FOLDER);
        std::fs::create_dir_all(&folder).map_err(|e| io::Error::io(&folder, e))?;
        let own = format!("-rank-{}.", ranks.rank);
        for entry in std::fs::read_dir(&folder).map_err(|e| io::Error::io(&folder, e))?.flatten() {
            if entry.file_name().to_string_lossy().contains(&own) {
                // A file of another state is never added.
                let _ = std::fs::remove_file(entry.path());
            }
        }
        let written = [Vec::new(), Vec::new()];
        Ok(Self {
            folder,
            ranks,
            config: config.to_json()?,
            step: 0,
            state: 0,
            ends: false,
            written,
        })
    }

    /// Begins the exchange of a step. All ranks have ended the step before the last one.
    pub(super) fn begin(&mut self, step: u64, optimizer: &Optimizer) {
        let mut hasher = DefaultHasher::new();
        (step, &self.config).hash(&mut hasher);
        optimizer.hash_values(&mut hasher);
        (self.step, self.state) = (step, hasher.finish());
        let [now, before] = &mut self.written;
        for path in before.drain(..) {
            // A file that cannot be removed does no harm.
            let _ = std::fs::remove_file(path);
        }
        std::mem::swap(now, before);
    }

    /// Returns whether a rank wished to end after the last step.
    pub(super) fn ends(&self) -> bool {
        self.ends
    }

    /// Rank of a group of this step, of `groups` groups a step.
    fn owner(&self, group: usize, groups: usize) -> usize {
        self.ranks.owner(self.step * groups as u64 + group as u64)
    }

    fn path(&self, group: usize, owner: usize) -> PathBuf {
        self.folder.join(format!("{:08}-{group:04}-rank-{owner}.safetensors", self.step))
    }

    /// Writes the gradients of a group of this rank. `end` requests the end of the training after this step.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub(super) fn publish(&mut self, group: usize, sum: &GroupSum, end: bool) -> Result<()> {
        let path = self.path(group, self.ranks.rank);
        let (gradients, touched) = sum.gradients.parts();
        let terms = sum.terms.to_array();
        let spec = |(name, dtype, len): (&str, Dtype, usize)| TensorSpec {
            name: name.to_owned(),
            dtype,
            shape: vec![len],
        };
        let lengths = [gradients.len(), touched.len(), terms.len()];
        let dtypes = [Dtype::F32, Dtype::U8, Dtype::F64];
        let specs: Vec<TensorSpec> =
            (0..3).map(|i| spec((TENSORS[i], dtypes[i], lengths[i]))).collect();
        let metadata = BTreeMap::from([
            (STATE_KEY.to_owned(), format!("{:016x}", self.state)),
            (END_KEY.to_owned(), end.to_string()),
        ]);
        write_tensors(&path, &specs, &metadata, |i| {
            Ok(match i {
                0 => gradients.iter().flat_map(|g| g.to_le_bytes()).collect(),
                1 => touched.iter().map(|t| u8::from(*t)).collect(),
                _ => terms.iter().flat_map(|t| t.to_le_bytes()).collect(),
            })
        })?;
        self.written[0].push(path);
        self.ends |= end;
        Ok(())
    }

    /// Waits for the gradients of a group of another rank, of `groups` groups a step.
    ///
    /// # Errors
    /// No such file within [`Ranks::wait`]; a file that cannot be read.
    pub(super) fn receive(
        &mut self,
        group: usize,
        groups: usize,
        optimizer: &Optimizer,
    ) -> Result<GroupSum> {
        let owner = self.owner(group, groups);
        let path = self.path(group, owner);
        let begin = Instant::now();
        let mut pause = POLL_INTERVALS[0];
        let mut other = false;
        loop {
            match std::fs::read(&path) {
                Ok(bytes) => match self.parse(&path, &bytes, optimizer)? {
                    Some(sum) => return Ok(sum),
                    None => other = true,
                },
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                Err(e) => return Err(io::Error::io(&path, e).into()),
            }
            if begin.elapsed() > self.ranks.wait {
                break;
            }
            std::thread::sleep(pause);
            pause = (2 * pause).min(POLL_INTERVALS[1]);
        }
        let Self { ranks: Ranks { count, wait, .. }, step, .. } = self;
        let expected = format!(
            "its gradients of step {} within {} s in {}",
            *step + 1,
            wait.as_secs_f64(),
            path.display()
        );
        let got = if other {
            "those of another configuration, step or state of the weights"
        } else {
            "none: the process does not run, or does not see this folder"
        };
        Err(Error::value(format!("rank {owner} of {count}"), expected, got))
    }

    /// The contents of a file; `None` where they belong to another state.
    fn parse(
        &mut self,
        path: &Path,
        bytes: &[u8],
        optimizer: &Optimizer,
    ) -> Result<Option<GroupSum>> {
        let bad = |got: String| io::Error::format(path, "a rank's gradients", got);
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| bad(e.to_string()))?;
        let text = |key: &str| header.metadata().as_ref().and_then(|m| m.get(key)).cloned();
        if text(STATE_KEY).is_none_or(|state| state != format!("{:016x}", self.state)) {
            return Ok(None);
        }
        let file = SafeTensors::deserialize(bytes).map_err(|e| bad(e.to_string()))?;
        let part = |i: usize| file.tensor(TENSORS[i]).map_err(|e| bad(e.to_string()));
        let (gradients, touched, terms) = (part(0)?, part(1)?, part(2)?);
        let floats = gradients.data().chunks_exact(4);
        let sum: Vec<f32> = floats.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        let touched: Vec<bool> = touched.data().iter().map(|t| *t != 0).collect();
        let mut values = [0.0; Terms::COUNT];
        for (value, b) in values.iter_mut().zip(terms.data().chunks_exact(8)) {
            *value = f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]);
        }
        let gradients = Gradients::from_parts(sum, touched, optimizer)
            .ok_or_else(|| bad("those of another number of parameters".to_owned()))?;
        self.ends |= text(END_KEY).as_deref() == Some("true");
        let terms = Terms::from_array(values);
        let seconds = Seconds::default();
        Ok(Some(GroupSum { gradients, terms, seconds }))
    }

    /// Ends the exchange. The first rank removes the folder when the others have ended too.
    pub(super) fn close(&mut self) {
        let mark = |rank: usize| self.folder.join(format!("end-rank-{rank}."));
        if self.ranks.rank > 0 {
            // Without the mark the folder stays, which does no harm.
            let _ = std::fs::write(mark(self.ranks.rank), []);
            return;
        }
        let begin = Instant::now();
        while !(1..self.ranks.count).all(|rank| mark(rank).is_file()) {
            if begin.elapsed() > END_WAIT.min(self.ranks.wait) {
                return;
            }
            std::thread::sleep(POLL_INTERVALS[1]);
        }
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every group of every step has one rank, and every rank a group in every step.
    #[test]
    fn the_ranks_share_the_groups_of_each_step() {
        for (batch, together, accumulate, count) in
            [(4, 1, 1, 2), (3, 1, 2, 4), (5, 2, 1, 3), (12, 3, 1, 4), (2, 2, 3, 3)]
        {
            let config = TrainConfig { batch, together, accumulate, ..TrainConfig::default() };
            let all: Vec<Ranks> = (0..count).map(|rank| Ranks::new(rank, count)).collect();
            let groups = Division::of(&config, all[0]).groups();
            for step in 0..5 {
                let mut members = vec![0; count];
                for i in 0..batch * accumulate {
                    let index = (step * batch * accumulate + i) as u64;
                    let owners: Vec<usize> =
                        (0..count).filter(|r| Division::of(&config, all[*r]).has(index)).collect();
                    let group = i / batch * groups + i % batch / together;
                    let mut exchange = exchange(&config, all[0]);
                    exchange.step = step as u64;
                    assert_eq!(owners, [exchange.owner(group, accumulate * groups)]);
                    members[owners[0]] += 1;
                }
                assert!(members.iter().all(|n| *n > 0), "{batch} {together} {count}: {members:?}");
            }
        }
    }

    fn exchange(config: &TrainConfig, ranks: Ranks) -> Exchange {
        Exchange {
            folder: PathBuf::new(),
            ranks,
            config: config.to_json().unwrap(),
            step: 0,
            state: 0,
            ends: false,
            written: [Vec::new(), Vec::new()],
        }
    }

    #[test]
    fn more_ranks_than_groups_are_refused() {
        let config = TrainConfig { batch: 4, together: 2, accumulate: 1, ..TrainConfig::default() };
        let refused =
            |rank, count| Ranks::new(rank, count).check(&config).map_err(|e| e.to_string());
        assert_eq!(refused(1, 2), Ok(()));
        assert!(refused(0, 3).unwrap_err().contains("expected at most 2"));
        assert!(refused(2, 2).unwrap_err().contains("expected a number below 2"));
    }
}
