//! Metrics, evaluation and the parts of training.

mod eval;
mod lpips;
mod train_mvsplat;
mod train_parts;
