// Raw matching channels of a plane sweep, from photographs alone. CPU version:
// cpu/matching.rs.

@group(0) @binding(0) var<uniform> call: RawMatchingUniform;

// Sums over blocks of valid samples s of reference r, at half resolution: 1, r, s, r^2, s^2, r s;
// the same at quarter resolution; the colour channel.
const PLANES: u32 = 13u;
const COLOUR_PLANE: u32 = 12u;
