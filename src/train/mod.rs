//! Training: examples, losses, the optimizer, and a loop that can be stopped at any
//! moment.
//!
//! A training is a function of its configuration ([`TrainConfig`]): the weights' start,
//! the examples and their order come from seeds, and every kernel gives the same bytes
//! for any number of threads. So a checkpoint is the parameters, the optimizer's rows
//! and the number of the step; resuming gives the step that not stopping would have
//! given (`tests/train.rs`).

pub mod checkpoint;
pub mod config;
pub mod files;
pub mod loading;
pub mod loss;
pub mod optimizer;
pub mod photos;
pub mod run;
pub mod schedule;
pub mod source;
pub mod step;
pub mod validate;

pub use config::TrainConfig;

use thiserror::Error as ThisError;

/// Why a training could not begin or go on.
#[derive(Debug, ThisError)]
pub enum Error {
    /// A file.
    #[error(transparent)]
    Io(#[from] crate::io::Error),
    /// The network: shapes, weights.
    #[error(transparent)]
    Model(#[from] candle_core::Error),
    /// The model's configuration.
    #[error(transparent)]
    Config(#[from] crate::config::ConfigError),
    /// Text that is no training configuration.
    #[error("training configuration: {0}")]
    Parse(String),
    /// A value that cannot be.
    #[error("{what}: expected {expected}, got {got}")]
    Value {
        /// Key or thing.
        what: String,
        /// What would be accepted.
        expected: String,
        /// What came.
        got: String,
    },
    /// Loss or gradient were not finite several times in a row.
    #[error(
        "step {step}: loss or gradient not finite in {times} steps in a row; the last checkpoint stands"
    )]
    Diverged {
        /// The last of them.
        step: u64,
        /// How many.
        times: usize,
    },
}

impl Error {
    fn value(what: impl ToString, expected: impl ToString, got: impl ToString) -> Self {
        Self::Value { what: what.to_string(), expected: expected.to_string(), got: got.to_string() }
    }
}

/// Result of everything in this room.
pub type Result<T> = std::result::Result<T, Error>;
