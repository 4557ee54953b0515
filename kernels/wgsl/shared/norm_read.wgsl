// Mean and scale of a row, from the statistics of its parts.

// [rows, parts].
@group(0) @binding(2) var<storage, read> statistics: array<vec2<f32>>;

// Returns the mean of a row and 1 / sqrt(variance + epsilon). The parts' statistics are joined in
// order (Chan, Golub and LeVeque 1979).
fn mean_and_scale(row: u32) -> vec2<f32> {
    var mean = 0.0;
    var squares = 0.0;
    for (var part = 0u; part < call.parts; part++) {
        let own = statistics[row * call.parts + part];
        let before = f32(part * PART);
        let count = f32(min(call.length - part * PART, PART));
        let away = own.x - mean;
        mean += away * (count / (before + count));
        squares += own.y + away * away * (before * count / (before + count));
    }
    return vec2<f32>(mean, 1.0 / sqrt(squares / f32(call.length) + call.epsilon));
}
