// softmax(scale q k^T + mask) v without a matrix of logits (Milakov and Gimelshein 2018, online
// softmax). CPU version: cpu/attention.rs.
//
// A workgroup computes 32 queries of one row, in steps of 32 keys. Eight threads share a query:
// each has four of the step's keys, and four channels of every 32 of the values.

@group(0) @binding(0) var<uniform> call: AttentionUniform;
// [rows, queries, width], [rows, keys, width], [rows, keys, value_width].
@group(0) @binding(1) var<storage, read> q: array<f32>;
@group(0) @binding(2) var<storage, read> k: array<f32>;
@group(0) @binding(3) var<storage, read> v: array<f32>;
// [windows, queries], then [windows, keys].
@group(0) @binding(4) var<storage, read> labels: array<u32>;
// [rows, queries, value_width].
@group(0) @binding(5) var<storage, read_write> result: array<f32>;

const SIDE: u32 = 32u;
// Largest value_width / 32.
const BLOCKS: u32 = 8u;
const LOWEST: f32 = -3.0e38;

// 32 channels of the queries, of the keys or values; the step's weights.
var<workgroup> left: array<f32, 1024>;
var<workgroup> right: array<f32, 1024>;
var<workgroup> weights: array<f32, 1024>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tiles = (call.queries + SIDE - 1u) / SIDE;
    let number = workgroup_number(workgroup, workgroups);
    let row = number / tiles;
    if row >= call.rows {
        return;
    }
    let first_query = number % tiles * SIDE;
    let line = thread / 8u;
    let own = thread % 8u * 4u;
    let query = first_query + line;
    var window = 0u;
    var label = 0u;
    if call.windows > 0u {
        window = row % call.windows;
        label = labels[window * call.queries + min(query, call.queries - 1u)];
    }
    let key_labels = call.windows * call.queries + window * call.keys;
    var most = LOWEST;
    var sum = 0.0;
    var values: array<vec4<f32>, BLOCKS>;
    for (var first = 0u; first < call.keys; first += SIDE) {
        // Logits of the query with four keys.
        var logits = vec4<f32>();
        for (var channel = 0u; channel < call.width; channel += SIDE) {
            for (var j = 0u; j < 4u; j++) {
                let c = channel + own + j;
                let query_inside = query < call.queries && c < call.width;
                let key = first + line;
                let key_inside = key < call.keys && c < call.width;
                let a = q[select(0u, (row * call.queries + query) * call.width + c, query_inside)];
                let b = k[select(0u, (row * call.keys + key) * call.width + c, key_inside)];
                left[line * SIDE + own + j] = select(0.0, a, query_inside);
                right[(own + j) * SIDE + line] = select(0.0, b, key_inside);
            }
            workgroupBarrier();
            for (var c = 0u; c < SIDE; c++) {
                let at = c * SIDE + own;
                logits += left[line * SIDE + c]
                    * vec4<f32>(right[at], right[at + 1u], right[at + 2u], right[at + 3u]);
            }
            workgroupBarrier();
        }
        for (var j = 0u; j < 4u; j++) {
            let key = first + own + j;
            var logit = logits[j] * call.scale;
            if key >= call.keys {
                logit = LOWEST;
            } else if call.windows > 0u && labels[key_labels + key] != label {
                logit += call.penalty;
            }
            weights[line * SIDE + own + j] = logit;
        }
        workgroupBarrier();
        var step_most = most;
        for (var i = 0u; i < SIDE; i++) {
            step_most = max(step_most, weights[line * SIDE + i]);
        }
        workgroupBarrier();
        for (var j = 0u; j < 4u; j++) {
            let at = line * SIDE + own + j;
            weights[at] = select(0.0, exp(weights[at] - step_most), first + own + j < call.keys);
        }
        workgroupBarrier();
        let shrink = exp(most - step_most);
        most = step_most;
        var step_sum = 0.0;
        for (var i = 0u; i < SIDE; i++) {
            step_sum += weights[line * SIDE + i];
        }
        sum = sum * shrink + step_sum;
        for (var block = 0u; block * SIDE < call.value_width; block++) {
            for (var j = 0u; j < 4u; j++) {
                let c = block * SIDE + own + j;
                let key = first + line;
                let inside = key < call.keys && c < call.value_width;
                let at = select(0u, (row * call.keys + key) * call.value_width + c, inside);
                right[line * SIDE + own + j] = select(0.0, v[at], inside);
            }
            workgroupBarrier();
            var step_value = vec4<f32>();
            for (var i = 0u; i < SIDE; i++) {
                let at = i * SIDE + own;
                step_value += weights[line * SIDE + i]
                    * vec4<f32>(right[at], right[at + 1u], right[at + 2u], right[at + 3u]);
            }
            values[block] = values[block] * shrink + step_value;
            workgroupBarrier();
        }
    }
    if query >= call.queries {
        return;
    }
    for (var block = 0u; block * SIDE < call.value_width; block++) {
        for (var j = 0u; j < 4u; j++) {
            let c = block * SIDE + own + j;
            if c < call.value_width {
                result[(row * call.queries + query) * call.value_width + c] =
                    values[block][j] / sum;
            }
        }
    }
}
