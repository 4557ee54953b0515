// Attributes of parents: the parameters of a call, and the packed rows.

@group(0) @binding(0) var<uniform> call: AttributesUniform;
// [parents, SPLAT_STRIDE].
@group(0) @binding(1) var<storage, read> rows: array<f32>;
