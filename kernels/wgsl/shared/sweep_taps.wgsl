// Projection of a candidate of the plane sweep into the source view, and its bilinear taps.

@group(0) @binding(1) var<storage, read> reference: array<f32>;
@group(0) @binding(2) var<storage, read> source: array<f32>;
// SWEEP_PAIR_STRIDE floats of a pair: K_r^-1 (4), rotation rows (9), t (3), K (4).
@group(0) @binding(3) var<storage, read> pairs: array<f32>;
// Rows + 1 numbers: the pairs of row r are pair_starts[r] .. pair_starts[r + 1]. Then the source row of
// each pair.
@group(0) @binding(4) var<storage, read> pair_starts: array<u32>;
// [R, D].
@group(0) @binding(5) var<storage, read> depths: array<f32>;

// Cells of the four taps of a sample (x fastest) and their weights, 0 outside the map.
struct Taps {
    cells: vec4<u32>,
    weights: vec4<f32>,
}

// Returns the source row of a pair.
fn source_row(pair: u32) -> u32 {
    return pair_starts[call.rows + 1u + pair];
}

// Returns the factor of each pair's term in the correlation of row r.
fn pair_factor(r: u32) -> f32 {
    return call.scale / f32(max(pair_starts[r + 1u] - pair_starts[r], 1u));
}

// Returns the source index coordinates of reference pixel (x, y) at this depth.
fn project(pair: u32, x: u32, y: u32, depth: f32) -> vec2<f32> {
    let p = pair * SWEEP_PAIR_STRIDE;
    let ray = vec2<f32>(
        pairs[p] * (f32(x) + call.centre) + pairs[p + 2u],
        pairs[p + 1u] * (f32(y) + call.centre) + pairs[p + 3u],
    );
    let r = p + 4u;
    let px = (pairs[r] * ray.x + pairs[r + 1u] * ray.y + pairs[r + 2u]) * depth + pairs[r + 9u];
    let py =
        (pairs[r + 3u] * ray.x + pairs[r + 4u] * ray.y + pairs[r + 5u]) * depth + pairs[r + 10u];
    let pz =
        (pairs[r + 6u] * ray.x + pairs[r + 7u] * ray.y + pairs[r + 8u]) * depth + pairs[r + 11u];
    let z = max(pz, call.min_z);
    let k = r + 12u;
    let at = vec2<f32>(
        pairs[k] * px + pairs[k + 2u] * pz,
        pairs[k + 1u] * py + pairs[k + 3u] * pz,
    );
    return at / z - call.centre;
}

// Returns the bilinear taps at `at`; all weights are 0 where the four cells lie outside.
fn taps(at: vec2<f32>) -> Taps {
    var t = Taps(vec4<u32>(), vec4<f32>());
    let size = vec2<f32>(f32(call.width), f32(call.height));
    // NaN is outside, too.
    if !(at.x > -1.0 && at.y > -1.0 && at.x < size.x && at.y < size.y) {
        return t;
    }
    let corner = floor(at);
    let f = at - corner;
    let wx = vec2<f32>(1.0 - f.x, f.x);
    let wy = vec2<f32>(1.0 - f.y, f.y);
    for (var i = 0; i < 4; i++) {
        let x = i32(corner.x) + (i & 1);
        let y = i32(corner.y) + (i >> 1u);
        if x >= 0 && y >= 0 && x < i32(call.width) && y < i32(call.height) {
            t.cells[i] = u32(y) * call.width + u32(x);
            t.weights[i] = wx[i & 1] * wy[i >> 1u];
        }
    }
    return t;
}
