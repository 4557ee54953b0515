//! The error type of the crate's high-level calls.

use super::PoseError;
use crate::cameras::estimation::{PosePhotoError, PoseRefusal};
use crate::files as io;
use crate::network::config::ConfigError;
use crate::scene::metrics::MetricsError;
use crate::scene::render::DeviceError;
use crate::scene::splats::SplatsError;
use subsplat_kernels::camera::CameraError;
use thiserror::Error;

/// Any error of the crate that an application meets.
///
/// Every specific error converts into it, so that an application needs one type for `?`.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Error {
    /// A file or a picture was rejected, or could not be written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The network rejected a shape, a weight or a number.
    #[error(transparent)]
    Model(#[from] candle_core::Error),
    /// A configuration is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A camera is invalid.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Buffers of splats do not fit one another.
    #[error(transparent)]
    Splats(#[from] SplatsError),
    /// A device cannot be opened, or failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The poses do not fit the photographs, and [`Check::Refuse`](super::Check::Refuse) was set.
    #[error(transparent)]
    Poses(#[from] PoseError),
    /// A photograph is no input of the estimation of poses.
    #[error(transparent)]
    PosePhoto(#[from] PosePhotoError),
    /// The photographs alone do not determine their cameras.
    #[error(
        "{photographs}: the photographs do not tell where their cameras were: {reason}{}",
        noted(warnings)
    )]
    NoPoses {
        /// The photographs.
        photographs: String,
        /// The reason.
        reason: PoseRefusal,
        /// Warnings about the photographs, one line each.
        warnings: Vec<String>,
    },
    /// A picture cannot be scored.
    #[error("{place}: {source}")]
    Score {
        /// Case, target and method.
        place: String,
        /// The reason.
        source: MetricsError,
    },
    /// An argument is out of range.
    #[error("{what}: expected {expected}, got {got}")]
    Argument {
        /// Name of the argument.
        what: String,
        /// Values that are accepted.
        expected: String,
        /// The value that was passed.
        got: String,
    },
    /// The progress callback returned [`ControlFlow::Break`](std::ops::ControlFlow::Break).
    #[error("cancelled")]
    Cancelled,
}

/// Result of the crate's high-level calls.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An [`Error::Argument`].
    pub fn argument(
        what: impl Into<String>,
        expected: impl Into<String>,
        got: impl Into<String>,
    ) -> Self {
        Self::Argument { what: what.into(), expected: expected.into(), got: got.into() }
    }
}

/// The first of `warnings` as an addition to a message.
fn noted(warnings: &[String]) -> String {
    match warnings {
        [] => String::new(),
        [one] => format!(" ({one})"),
        [first, rest @ ..] => format!(" ({first}; and {} more warnings)", rest.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::error::Error as _;

    #[test]
    fn errors_keep_their_source() {
        let missing = std::io::Error::from(std::io::ErrorKind::NotFound);
        let error = Error::from(io::Error::io("a.png", missing));
        assert!(error.to_string().starts_with("a.png: "), "{error}");
        assert!(error.source().is_some_and(|s| s.is::<std::io::Error>()));
        assert!(Error::Cancelled.source().is_none());
    }
}
