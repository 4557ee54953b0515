//! Readers and round trips as functions of bytes, for the fuzz targets.

pub mod targets;
