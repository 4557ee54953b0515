//! Where examples come from.

pub mod procedural;
