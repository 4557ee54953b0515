// Attributes of parents: the parameters of a call, and the packed rows.

struct AttributesUniform {
    // Rows of R (world from camera) with the position as the fourth column; rows of the matrix that
    // turns quaternions. Of the frame, then rows of R alone of the source view.
    frame: array<vec4<f32>, 3>,
    turn: array<vec4<f32>, 4>,
    source: array<vec4<f32>, 3>,
    parents: u32,
    // 1: positions and quaternions are those of the frame, else the world's.
    framed: u32,
    // 1: positions are (x / z, y / z, ln z).
    ray: u32,
    // 1: scales are logarithms of pixels.
    log_px: u32,
    // 1: opacities are logits.
    logit: u32,
    log_focal: f32,
    logit_low: f32,
    z_min: f32,
    slope_max: f32,
    scale_min: f32,
    pad0: u32,
    pad1: u32,
}

@group(0) @binding(0) var<uniform> call: AttributesUniform;
// [parents, SPLAT_STRIDE].
@group(0) @binding(1) var<storage, read> rows: array<f32>;
