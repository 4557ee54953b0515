//! How good a model is on photographs that it was not shown: PSNR, SSIM, LPIPS and
//! sharpness by the protocol of MVSplat's and SubSplat's tables, with baselines in the
//! same run.
//!
//! ```no_run
//! use subsplat::config::{Config, Preset};
//! use subsplat::eval::{Benchmark, Evaluator, Method, Options};
//! use subsplat::pipeline::Reconstructor;
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = Reconstructor::untrained(&Config::small(Preset::Tuned, 2), 0)?;
//! let photos = Benchmark::open("photos".as_ref(), None)?;
//! let options = Options { methods: vec![Method::Subsplat, Method::Copy], ..Options::new(2) };
//! let scores = Evaluator::new(options).run(Some(model.model()), &photos)?;
//! println!("{:?} dB", scores.mean("subsplat").map(|s| s.psnr));
//! # Ok(())
//! # }
//! ```
//!
//! * [`Benchmark`]: which views are inputs and which are truth: pixelSplat's chunks with
//!   an evaluation index, or scenes with `protocol.json` (or an index).
//! * [`Evaluator`]: every [`Method`]'s pictures of the same targets, scored.
//! * [`Scores`]: per target; mean over a case's targets; mean over cases. A case is one
//!   set of inputs; an index has one a scene, a protocol.json may have several.
//!
//! Sizes: inputs are `input_size`, targets r times that, cut out of the photograph as
//! [`crate::data::crop`] says. Where a photograph of a case is too small for such a
//! target, the case's input is halved until it is large enough (at most until the target
//! has the size that the input should have had), so that no score is taken against
//! enlarged pixels.

mod cases;
mod evaluator;
mod methods;
mod page;
mod score;
mod tables;

pub use cases::{Benchmark, Case, Loaded};
pub use evaluator::{CaseResult, Evaluator, Options, TargetPictures};
pub use methods::Method;
pub use page::{Sheet, page};
pub use score::{CaseScores, Score, Scores, TargetScores};
pub use tables::{means_csv, report, targets_csv};

use crate::metrics::MetricsError;
use crate::{io, pipeline};
use thiserror::Error;

/// Why something could not be evaluated.
#[derive(Debug, Error)]
pub enum Error {
    /// A file, or what it holds.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The model, or what it was asked for.
    #[error(transparent)]
    Pipeline(#[from] pipeline::Error),
    /// A picture that cannot be scored.
    #[error("{place}: {source}")]
    Metrics {
        /// Case, target and method.
        place: String,
        /// What is wrong with it.
        source: MetricsError,
    },
    /// What the caller asked for.
    #[error("{what}: expected {expected}, got {got}")]
    Request {
        /// Which part of it.
        what: String,
        /// What would be accepted.
        expected: String,
        /// What came.
        got: String,
    },
}

/// Result of everything in this room.
pub type Result<T> = std::result::Result<T, Error>;

pub(crate) fn bad<T>(
    what: impl Into<String>,
    expected: impl Into<String>,
    got: impl Into<String>,
) -> Result<T> {
    Err(Error::Request { what: what.into(), expected: expected.into(), got: got.into() })
}
