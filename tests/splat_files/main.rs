//! Files of Gaussians: round trips, fixtures of other projects, hostile bytes.

mod hostile_splats;
mod splat_files;
mod splat_fixtures;
