// Rows of a normalisation: parts of a row, and the statistics of each part.

struct NormUniform {
    rows: u32,
    // Numbers of a row.
    length: u32,
    // Consecutive numbers of one channel.
    run: u32,
    // Rows of one picture: row r holds the channels (r % groups) * length / run and following.
    groups: u32,
    // Parts of a row.
    parts: u32,
    // 1 if there are factors and summands of the channels.
    has_affine: u32,
    epsilon: f32,
    // Parts of a channel's numbers in the backward pass, else 0.
    channel_parts: u32,
}

@group(0) @binding(0) var<uniform> call: NormUniform;
@group(0) @binding(1) var<storage, read> x: array<f32>;

// Numbers of a part.
const PART: u32 = 8192u;
const THREADS: u32 = 256u;
