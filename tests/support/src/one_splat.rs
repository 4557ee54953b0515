//! The smallest finished scene.

use std::path::Path;
use subsplat::files::{SaveOptions, save_splats};
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::ShBasis;

/// A finished scene of one grey Gaussian before a camera at the origin.
pub fn save_one_splat(path: &Path) {
    let row = vec![0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.9];
    let splats = Splats::new(row, vec![0.0; 3], Vec::new(), 0, ShBasis::Standard).unwrap();
    save_splats(path, &splats, &SaveOptions::default()).unwrap();
}
