//! Training, evaluation, data sets, generated rooms, and the paper's tables.

pub mod commands;
pub mod compare;
pub mod data;
pub mod eval;
pub mod lpips;
mod noise_floors;
pub mod train;
