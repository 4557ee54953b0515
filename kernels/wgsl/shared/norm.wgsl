// Rows of a normalisation: parts of a row, and the statistics of each part.

@group(0) @binding(0) var<uniform> call: NormUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;

// Numbers of a part.
const PART: u32 = 8192u;
const THREADS: u32 = 256u;
