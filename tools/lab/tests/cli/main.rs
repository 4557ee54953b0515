//! The program `subsplat-lab`, called as a user calls it.

mod compare_raster;
mod eval_cli;
mod paper;
mod program;
mod ranks;
mod train;
mod usage;
