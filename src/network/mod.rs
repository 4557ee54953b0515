//! The network: its configuration, its operations on candle's tensors and on a GPU, and the model.
//!
//! This module carries no promise between versions. Applications use
//! [`Reconstructor`](crate::Reconstructor).

pub mod config;
pub mod model;
pub mod ops;

pub use candle_core;
