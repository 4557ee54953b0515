//! PlayCanvas' SOG: 8-bit pictures of numbers, one pixel a Gaussian, and `meta.json`; in a zip
//! (`.sog`) or in a folder. A scene of 16,384 Gaussians with SH of degree 3 takes 49 bytes per
//! Gaussian, 58 as .spz 3. Reads versions 1 and 2, writes the zip of version 2.
//!
//! | picture | channels | version 2 | version 1 |
//! |---|---|---|---|
//! | `means_l`, `means_u` | RGB, low and high byte | sign(x)·ln(\|x\| + 1), uniform in [mins, maxs] | the same |
//! | `quats` | RGB, A | three smallest of wxyz in ±1/√2; A = 252 + index of the largest | the same |
//! | `scales` | RGB | ln σ, index into `codebook` | ln σ, uniform in [mins, maxs] |
//! | `sh0` | RGB, A | `f_dc`, index into `codebook`; opacity | uniform in [mins, maxs]; A is a logit |
//! | `shN_labels` | RG, low and high byte | row of the palette | the same |
//! | `shN_centroids` | RGB, 64 rows of the palette a line | SH, index into `codebook` | uniform in [mins, maxs] |
//!
//! Axes are those of the .ply that was compressed, as PlayCanvas' programs read and write them,
//! although their document says y-up. Version 1 has no `version` and no `count`.
//! Source: developer.playcanvas.com, "The SOG Format"; the readers of splat-transform, which say
//! that the codebook of scales holds logarithms and that index 0 of a quaternion is w.

mod cluster;
mod container;
mod read;
mod write;

pub(super) use read::{decode, decode_unpacked};
pub use read::{is_meta, parse_sog};
pub(super) use write::{check, write};

/// Description of the pictures.
pub(super) const META: &str = "meta.json";
/// Degree of the SH that the format holds.
pub(super) const SH_DEGREE_MAX: usize = 3;
/// Rows of the palette in a line of its picture.
const PALETTE_LINE: usize = 64;
/// Value of the quaternions' alpha where w is the largest.
const LARGEST_W: u8 = 252;
/// Indices of the stored components, by the index of the largest.
const OTHERS: [[usize; 3]; 4] = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]];
