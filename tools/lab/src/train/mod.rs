//! Training: examples, losses, the optimizer, and a loop that can stop and resume at any step.
//!
//! A training is a function of its configuration ([`TrainConfig`]). The initial weights, the
//! examples and their order derive from seeds, and every kernel gives the same bytes for any number
//! of threads. A checkpoint therefore holds the parameters, the optimizer's state and the step. A
//! resumed training takes the same steps as an uninterrupted one (`tools/lab/tests/cli/train.rs`).
//! Several processes that share a training take these steps too ([`ranks`]), over MPI with the feature
//! `mpi` ([`peers`]).

pub mod augment;
pub mod checkpoint;
pub mod config;
pub mod files;
pub mod folders;
pub mod loading;
pub mod loss;
pub mod optimizer;
pub mod peers;
pub mod photos;
pub mod ranks;
pub mod run;
pub mod schedule;
pub mod source;
pub mod step;
pub mod validate;

pub use config::TrainConfig;

use thiserror::Error as ThisError;

/// Reasons for which a training cannot begin or continue.
#[derive(Debug, ThisError)]
pub enum Error {
    /// Reading or writing a file failed.
    #[error(transparent)]
    Io(#[from] subsplat::files::Error),
    /// The network failed: shapes or weights.
    #[error(transparent)]
    Model(#[from] candle_core::Error),
    /// A scene has no depth range.
    #[error(transparent)]
    DepthRange(#[from] subsplat::reconstruct::Error),
    /// The configured device cannot be opened.
    #[error(transparent)]
    Device(#[from] subsplat::network::ops::NoDevice),
    /// The model's configuration is invalid.
    #[error(transparent)]
    Config(#[from] subsplat::network::config::ConfigError),
    /// A text is not a training configuration.
    #[error("training configuration: {0}")]
    Parse(String),
    /// A value is out of its range.
    #[error("{key}: expected {expected}, got {got}")]
    Value {
        /// Configuration key, or the name of the input.
        key: String,
        /// Accepted values.
        expected: String,
        /// Value found.
        got: String,
    },
    /// Another process of a shared training failed.
    #[error("rank {rank} of {count}: {message}")]
    Rank {
        /// Number of the process.
        rank: usize,
        /// Number of processes.
        count: usize,
        /// Its error.
        message: String,
    },
    /// Loss or gradient were not finite in several consecutive steps.
    #[error(
        "step {step}: loss or gradient were not finite in {times} steps in a row; the last checkpoint is kept"
    )]
    Diverged {
        /// Number of the last step.
        step: u64,
        /// Number of consecutive steps.
        times: usize,
    },
}

impl Error {
    /// Builds an [`Error::Value`].
    fn value(key: impl ToString, expected: impl ToString, got: impl ToString) -> Self {
        Self::Value { key: key.to_string(), expected: expected.to_string(), got: got.to_string() }
    }
}

/// Result of this module's functions.
pub type Result<T> = std::result::Result<T, Error>;
