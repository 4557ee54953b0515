//! One training over several processes: data-parallel ranks that exchange their gradients.
//!
//! The scenes of a step are in groups ([`TrainConfig::together`]), and group g, counted over all
//! steps, belongs to the rank g mod N. A rank computes the gradients of its groups and sends them to
//! all others ([`Peers`]). Every rank adds all groups in their order, and takes the optimizer's step
//! on its own copy of the weights. One process adds the same groups in the same order, so the weights
//! of N ranks equal those of one process bit for bit. A sum by `MPI_Allreduce` would depend on the
//! number of ranks, because float sums depend on their order.
//!
//! Each message names the configuration, the step and the weights that its gradients belong to, as
//! one hash. Ranks that differ in it end with an error instead of a wrong sum. A rank that fails sends
//! the text of its error instead of gradients, so that all ranks end with one error.

use super::optimizer::{Gradients, Optimizer};
use super::step::{GroupSum, Seconds, Terms};
use super::{Error, Result, TrainConfig};
use std::fmt::Display;
use std::hash::{DefaultHasher, Hash, Hasher};

/// This process among those that share a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ranks {
    /// Number of this process, from 0. Rank 0 writes checkpoints, weights and logs.
    pub rank: usize,
    /// Number of processes.
    pub count: usize,
}

impl Ranks {
    /// Rank `rank` of `count`.
    pub fn new(rank: usize, count: usize) -> Self {
        Self { rank, count }
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
    /// More ranks than groups in a step.
    pub(super) fn check(&self, config: &TrainConfig) -> Result<()> {
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
    accumulate: usize,
    ranks: Ranks,
}

impl Division {
    /// The division for rank `ranks.rank` of a training.
    pub fn of(config: &TrainConfig, ranks: Ranks) -> Self {
        let [batch, together, accumulate] =
            [config.batch, config.together, config.accumulate].map(|n| n.max(1));
        Self { batch, together, accumulate, ranks }
    }

    /// Number of groups in a batch.
    pub(super) fn groups(&self) -> usize {
        self.batch.div_ceil(self.together)
    }

    /// Returns the number of scenes in group `group` of a batch.
    pub(super) fn scenes(&self, group: usize) -> usize {
        self.together.min(self.batch.saturating_sub(group * self.together))
    }

    /// Returns the rank of group `group` of batch `round` of step `step`.
    pub(super) fn owner(&self, step: u64, round: usize, group: usize) -> usize {
        let batches = step * self.accumulate as u64 + round as u64;
        self.ranks.owner(batches * self.groups() as u64 + group as u64)
    }

    /// Returns whether this rank computes example `index`.
    pub(super) fn has(&self, index: u64) -> bool {
        let batch = self.batch as u64;
        let group = (index % batch) / self.together as u64;
        let all = (index / batch) * self.groups() as u64 + group;
        self.ranks.owner(all) == self.ranks.rank
    }

    /// This process among all.
    pub(super) fn ranks(&self) -> Ranks {
        self.ranks
    }
}

/// The connection of a rank to the others.
pub trait Peers {
    /// This process among all.
    fn ranks(&self) -> Ranks;

    /// Sends `own` to all ranks, and returns the messages of all in the order of the ranks, `own`
    /// among them. All ranks call it the same number of times.
    ///
    /// # Errors
    /// A transport that failed.
    fn exchange(&mut self, own: Vec<u8>) -> Result<Vec<Vec<u8>>>;
}

/// One process alone.
pub struct Alone;

impl Peers for Alone {
    fn ranks(&self) -> Ranks {
        Ranks::single()
    }

    fn exchange(&mut self, own: Vec<u8>) -> Result<Vec<Vec<u8>>> {
        Ok(vec![own])
    }
}

/// First byte of a message: the rank failed, and the rest is the text of its error.
const FAILED: u8 = 0;
/// First byte of a message: the rank has what it sends.
const FINE: u8 = 1;

/// Returns the contents of all messages, or the first failure among them.
fn contents(messages: &[Vec<u8>]) -> Result<Vec<&[u8]>> {
    let mut contents = Vec::with_capacity(messages.len());
    for (rank, message) in messages.iter().enumerate() {
        let text = match message.split_first() {
            Some((&FINE, content)) => {
                contents.push(content);
                continue;
            }
            Some((_, text)) => String::from_utf8_lossy(text).into_owned(),
            None => "its message is empty".to_owned(),
        };
        return Err(Error::Rank { rank, count: messages.len(), message: text });
    }
    Ok(contents)
}

/// Returns the value of `own` if all ranks have one. All ranks call it at the same point.
///
/// # Errors
/// The error of `own`; otherwise that of the first rank that failed.
pub fn agree<T, E: Display + From<Error>>(
    peers: &mut dyn Peers,
    own: std::result::Result<T, E>,
) -> std::result::Result<T, E> {
    if peers.ranks().count == 1 {
        return own;
    }
    let message = match &own {
        Ok(_) => vec![FINE],
        Err(e) => failure(e),
    };
    let all = peers.exchange(message);
    let value = own?;
    contents(&all?)?;
    Ok(value)
}

/// Returns the message of a rank that failed.
fn failure(error: &impl Display) -> Vec<u8> {
    // With all causes, as programs print an error.
    [&[FAILED], format!("{error:#}").as_bytes()].concat()
}

/// The exchange of gradients between the ranks.
pub(super) struct Exchange {
    peers: Box<dyn Peers>,
    /// The configuration as JSON.
    config: String,
    /// Hash of the step, the configuration and the weights.
    state: u64,
    /// True if a rank requests the end of the training after this step.
    ends: bool,
    /// True if all ranks know that one of them failed.
    failed: bool,
}

impl Exchange {
    /// Starts the exchange of a training.
    ///
    /// # Errors
    /// A configuration that cannot be serialised.
    pub(super) fn new(config: &TrainConfig, peers: Box<dyn Peers>) -> Result<Self> {
        let config = config.to_json()?;
        Ok(Self { peers, config, state: 0, ends: false, failed: false })
    }

    /// Begins a step.
    pub(super) fn begin(&mut self, step: u64, optimizer: &Optimizer) {
        let mut hasher = DefaultHasher::new();
        (step, &self.config).hash(&mut hasher);
        optimizer.hash_values(&mut hasher);
        self.state = hasher.finish();
    }

    /// Returns whether a rank wished to end after the last step.
    pub(super) fn ends(&self) -> bool {
        self.ends
    }

    /// Sends the gradients of this rank's groups of a batch, and returns those of all ranks: one list
    /// a rank, each in the order of the groups. `end` requests the end of the training after this
    /// step.
    ///
    /// # Errors
    /// The error of `own`; a rank that failed or has another configuration, step or weights.
    pub(super) fn round(
        &mut self,
        own: Result<Vec<GroupSum>>,
        end: bool,
        optimizer: &Optimizer,
    ) -> Result<Vec<Vec<GroupSum>>> {
        let message = match &own {
            Ok(groups) => self.message(groups, end),
            Err(e) => failure(e),
        };
        let all = self.peers.exchange(message);
        // Until all messages are read and agree.
        self.failed = true;
        let mut own = Some(own?);
        let all = all?;
        let contents = contents(&all)?;
        let Ranks { rank: this, count } = self.peers.ranks();
        let mut first = None;
        let mut sums = Vec::with_capacity(count);
        for (rank, content) in contents.into_iter().enumerate() {
            let read = Part::read(content, optimizer).ok_or_else(|| Error::Rank {
                rank,
                count,
                message: "its gradients are those of another number of parameters".to_owned(),
            })?;
            if *first.get_or_insert(read.state) != read.state {
                let message = "expected the configuration, the program, the step and the weights \
                               of rank 0, found others";
                return Err(Error::Rank { rank, count, message: message.to_owned() });
            }
            self.ends |= read.end;
            // Its own groups keep their seconds.
            let own = if rank == this { own.take() } else { None };
            sums.push(own.unwrap_or(read.groups));
        }
        self.failed = false;
        Ok(sums)
    }

    /// Returns the message with the groups of a batch.
    fn message(&self, groups: &[GroupSum], end: bool) -> Vec<u8> {
        let mut bytes = vec![FINE];
        bytes.extend(self.state.to_le_bytes());
        bytes.push(u8::from(end));
        for group in groups {
            let (gradients, touched) = group.gradients.parts();
            bytes.reserve(4 * gradients.len() + touched.len() + 8 * Terms::COUNT);
            bytes.extend(gradients.iter().flat_map(|g| g.to_le_bytes()));
            bytes.extend(touched.iter().map(|t| u8::from(*t)));
            bytes.extend(group.terms.to_array().iter().flat_map(|t| t.to_le_bytes()));
        }
        bytes
    }

    /// [`agree`] of the ranks of this exchange.
    ///
    /// # Errors
    /// Those of [`agree`].
    pub(super) fn agree<T, E: Display + From<Error>>(
        &mut self,
        own: std::result::Result<T, E>,
    ) -> std::result::Result<T, E> {
        if self.failed {
            return own;
        }
        let agreed = agree(&mut *self.peers, own);
        self.failed |= agreed.is_err();
        agreed
    }
}

/// The contents of a message.
struct Part {
    state: u64,
    end: bool,
    groups: Vec<GroupSum>,
}

impl Part {
    /// Reads a message without its first byte; `None` where its length does not fit `optimizer`.
    fn read(bytes: &[u8], optimizer: &Optimizer) -> Option<Self> {
        let (state, rest) = bytes.split_first_chunk::<8>()?;
        let (end, mut rest) = rest.split_first()?;
        let mut groups = Vec::new();
        let zero = optimizer.gradients();
        let (gradients, touched) = zero.parts();
        while !rest.is_empty() {
            let (floats, after) = rest.split_at_checked(4 * gradients.len())?;
            let (flags, after) = after.split_at_checked(touched.len())?;
            let (terms, after) = after.split_at_checked(8 * Terms::COUNT)?;
            let sum = floats.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            let touched = flags.iter().map(|t| *t != 0).collect();
            let mut values = [0.0; Terms::COUNT];
            for (value, b) in values.iter_mut().zip(terms.as_chunks().0) {
                *value = f64::from_le_bytes(*b);
            }
            let gradients = Gradients::from_parts(sum, touched, optimizer)?;
            let terms = Terms::from_array(values);
            groups.push(GroupSum { gradients, terms, seconds: Seconds::default() });
            rest = after;
        }
        Some(Self { state: u64::from_le_bytes(*state), end: *end != 0, groups })
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
            let all: Vec<Division> =
                (0..count).map(|rank| Division::of(&config, Ranks::new(rank, count))).collect();
            let sizes: usize = (0..all[0].groups()).map(|group| all[0].scenes(group)).sum();
            assert_eq!(sizes, batch);
            for step in 0..5u64 {
                let mut members = vec![0; count];
                for i in 0..batch * accumulate {
                    let index = step * (batch * accumulate) as u64 + i as u64;
                    let owners: Vec<usize> = (0..count).filter(|r| all[*r].has(index)).collect();
                    let owner = all[0].owner(step, i / batch, i % batch / together);
                    assert_eq!(owners, [owner]);
                    members[owner] += 1;
                }
                assert!(members.iter().all(|n| *n > 0), "{batch} {together} {count}: {members:?}");
            }
        }
    }

    #[test]
    fn more_ranks_than_groups_are_refused() {
        let config = TrainConfig { batch: 4, together: 2, accumulate: 1, ..TrainConfig::default() };
        let refused =
            |rank, count| Ranks::new(rank, count).check(&config).map_err(|e| e.to_string());
        assert_eq!(refused(1, 2), Ok(()));
        assert!(refused(0, 3).unwrap_err().contains("expected at most 2"));
    }
}
