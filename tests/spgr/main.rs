//! SPGR: children of primaries, forward and backward.

mod redistribute;
mod spgr;
mod spgr_backward;
mod spgr_project;
mod split_coverage;
