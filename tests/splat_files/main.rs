//! Files of Gaussians: round trips, fixtures of other projects, hostile bytes, rows that are left out.

mod foreign;
mod hostile_splats;
mod left_out;
mod properties;
mod sog;
mod splat_files;
mod splat_fixtures;
mod unusual;
