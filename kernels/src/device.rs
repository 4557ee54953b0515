//! The choice of a device: the CPU kernels or an adapter that wgpu finds.
//!
//! `--device` of every program is parsed into a [`DeviceChoice`]; [`crate::backend::Backend`]
//! opens it for the network and for the renderer.

use std::convert::Infallible;
use std::fmt;
use std::str::FromStr;

/// A device as users name it: `auto`, `cpu`, `gpu`, or a part of an adapter's name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best hardware GPU; the CPU kernels where there is none. Never a software adapter,
    /// because the CPU kernels are faster than an emulated GPU.
    #[default]
    Auto,
    /// The CPU kernels.
    Cpu,
    /// The best adapter, software adapters included; an error where there is none.
    Gpu,
    /// The first adapter whose name contains this text, ignoring case.
    Named(String),
}

impl FromStr for DeviceChoice {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text.to_ascii_lowercase().as_str() {
            "auto" => Self::Auto,
            "cpu" => Self::Cpu,
            "gpu" => Self::Gpu,
            _ => Self::Named(text.to_owned()),
        })
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("a GPU that is not a software adapter"),
            Self::Cpu => f.write_str("the CPU"),
            Self::Gpu => f.write_str("any adapter"),
            Self::Named(name) => write!(f, "an adapter whose name contains \"{name}\""),
        }
    }
}
