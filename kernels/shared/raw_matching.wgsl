// Raw matching channels of a plane sweep, from photographs alone. CPU version:
// src/cpu/matching.rs.

struct RawMatchingUniform {
    // (reference, source) rows.
    rows: u32,
    candidates: u32,
    // Of the quarter-resolution maps.
    height: u32,
    width: u32,
    // Smallest z of a source point, as a share of the reference depth; added to variances.
    z_min: f32,
    variance_floor: f32,
    pad0: f32,
    pad1: f32,
}

@group(0) @binding(0) var<uniform> call: RawMatchingUniform;

// Sums over blocks of valid samples s of reference r, at half resolution: 1, r, s, r^2, s^2, r s;
// the same at quarter resolution; the colour channel.
const PLANES: u32 = 13u;
const COLOUR_PLANE: u32 = 12u;
