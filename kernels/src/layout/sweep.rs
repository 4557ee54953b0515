//! Sizes and options of a plane sweep ([`crate::cpu::plane_sweep`]).

/// Maps a reference pixel at a depth to a source pixel.
///
/// X = R·(K_r⁻¹·(x, y, 1))·depth + t in source camera coordinates, (u, v) = (fx·X + cx·Z,
/// fy·Y + cy·Z)/max(Z, min_z). The order of operations is MVSplat's, so that rounding is too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Index of the source view's features.
    pub source: usize,
    /// K_r⁻¹ as (1/fx, 1/fy, −cx/fx, −cy/fy), feature pixels.
    pub inverse: [f32; 4],
    /// R, row-major: reference camera to source camera.
    pub rotation: [f32; 9],
    /// The reference camera's centre in the source camera's frame, world units.
    pub t: [f32; 3],
    /// fx, fy, cx, cy of the projection, feature pixels.
    pub k: [f32; 4],
}

/// Sizes and options of one sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// `[R]`: for each reference view, its pairs with source views.
    pub pairs: Vec<Vec<Pair>>,
    /// `[R][D]`: candidate depths (camera z of the reference), world units.
    pub depths: Vec<Vec<f32>>,
    /// Coordinate of the centre of pixel 0: 0 (MVSplat) or ½ (`camera.rs`).
    pub centre: f32,
    /// Smallest divisor z.
    pub min_z: f32,
    /// Factor of the correlation (MVSplat: 1/√C).
    pub scale: f32,
    /// C, channels of a feature.
    pub channels: usize,
    /// h, w of both feature maps.
    pub size: [usize; 2],
}

impl Sweep {
    /// Returns D, the number of depth candidates.
    pub fn candidates(&self) -> usize {
        self.depths.first().map_or(0, Vec::len)
    }
}
