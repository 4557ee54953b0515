//! Optimises the Gaussians of a scene on its photographs, after the network has predicted them, and
//! makes a finished scene smaller.
//!
//! An optimisation is one or more phases (`phase`), each a value that says which parameters move
//! (`parameters`), on which photographs and losses, and when it ends. One optimiser takes the steps of
//! all phases (`optimiser`), and one loop runs them (`phase_run`):
//!
//! 1. [`fit()`]: sizes, opacities and colours, on all photographs at once, four steps;
//! 2. [`refine()`]: means, shapes, opacities and colours, on one photograph after the other, some dozens of
//!    steps. Parents that the photographs hardly show are removed first.
//!
//! Where the renderer has a GPU, the steps are taken in its memory (`on_device`).
//!
//! [`reduce()`] merges Gaussians of a finished scene until their number is as wanted.

mod dropout;
mod fit;
pub mod loss;
pub mod merge;
#[cfg_attr(not(feature = "gpu"), path = "on_device_absent.rs")]
mod on_device;
mod optimiser;
mod parameters;
mod phase;
mod phase_run;
mod reduce;
mod refine;
mod removal;
mod targets;

pub use fit::{FitOptions, FitReport, fit};
pub use phase_run::PhaseRun;
pub use reduce::reduce;
pub use refine::{RefineOptions, RefineReport, refine};
pub use targets::TargetView;

#[cfg(feature = "network")]
pub(crate) use fit::fit_masked;
#[cfg(feature = "network")]
pub(crate) use phase_run::check_time;
#[cfg(feature = "network")]
pub(crate) use refine::refine_groups;
#[cfg(feature = "network")]
pub use removal::Groups;
#[cfg(feature = "network")]
pub(crate) use removal::{LEAST_SHARE, families, hidden, shares, shares_of_marked, shown};
#[cfg(feature = "network")]
pub(crate) use targets::MaskedView;

use thiserror::Error;

/// Reason for which an optimisation on photographs ends without a result; the Gaussians are as before.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FinishError {
    /// A picture does not have its camera's size.
    #[error("view {view}: expected a picture of {expected}, got {got}")]
    Size {
        /// Index of the view.
        view: usize,
        /// Size of the camera, px.
        expected: String,
        /// Size of the picture, px.
        got: String,
    },
    /// A time limits the steps where there is no clock.
    #[error(
        "a limit of time needs a clock, and WebAssembly without an operating system has none: give a \
         number of steps instead"
    )]
    NoClock,
    /// The callback ended the optimisation.
    #[error("cancelled")]
    Cancelled,
}
