// Samples and softmax weights of one parent, which one workgroup processes, for the attention
// gather and its gradients.

@group(0) @binding(1) var<storage, read> maps: array<f32>;
@group(0) @binding(2) var<storage, read> query: array<f32>;
@group(0) @binding(3) var<storage, read> points: array<f32>;
// Height, width and first cell of each level.
@group(0) @binding(4) var<storage, read> levels: array<u32>;

// Per sample: cells of the four corners (x fastest) and their weights, 0 outside the map.
var<workgroup> cells: array<vec4<u32>, GATHER_SAMPLES_MAX>;
var<workgroup> corners: array<vec4<f32>, GATHER_SAMPLES_MAX>;
var<workgroup> states: array<u32, GATHER_SAMPLES_MAX>;
// [samples, G]: logits, then softmax weights.
var<workgroup> weights: array<f32, GATHER_WEIGHTS_MAX>;

// States of a sample: excluded from the softmax; included with a value of 0; sampled.
const EXCLUDED: u32 = 0u;
const ZERO_VALUE: u32 = 1u;
const SAMPLED: u32 = 2u;
const GATHER_THREADS: u32 = 64u;

// Returns the view of sample j.
fn view_of(j: u32) -> u32 {
    return j / (call.levels * call.points);
}

// Returns the level of sample j.
fn level_of(j: u32) -> u32 {
    return j / call.points % call.levels;
}

// Returns the offset in `points` of the point of sample j of parent n.
fn point_of(n: u32, j: u32) -> u32 {
    let own = select(0u, level_of(j) * call.points, call.points_per_level != 0u);
    return n * call.views * call.points_width + view_of(j) * call.points_width
        + 2u * (own + j % call.points);
}

// Returns the position of sample j in the map of its level, column and row.
fn position(n: u32, j: u32) -> vec2<f32> {
    let at = point_of(n, j);
    let size = vec2<f32>(f32(levels[3u * level_of(j) + 1u]), f32(levels[3u * level_of(j)]));
    return vec2<f32>(points[at], points[at + 1u]) * size - call.half_pixel;
}

// Computes state, corners and weights of sample j.
fn locate_sample(n: u32, j: u32) {
    let at = point_of(n, j);
    let rx = points[at];
    let ry = points[at + 1u];
    cells[j] = vec4<u32>();
    corners[j] = vec4<f32>();
    // A NaN point is outside.
    if !(rx > 0.0 && rx < 1.0 && ry > 0.0 && ry < 1.0) {
        states[j] = select(ZERO_VALUE, EXCLUDED, call.renormalise != 0u);
        return;
    }
    states[j] = SAMPLED;
    let level = 3u * level_of(j);
    let height = i32(levels[level]);
    let width = i32(levels[level + 1u]);
    let first = i32(levels[level + 2u]) + i32(view_of(j)) * height * width;
    let p = position(n, j);
    let corner = floor(p);
    let f = p - corner;
    let x = i32(corner.x);
    let y = i32(corner.y);
    let wx = vec2<f32>(1.0 - f.x, f.x);
    let wy = vec2<f32>(1.0 - f.y, f.y);
    for (var i = 0; i < 4; i++) {
        let cx = x + (i & 1);
        let cy = y + (i >> 1u);
        if cx >= 0 && cy >= 0 && cx < width && cy < height {
            cells[j][i] = u32(first + cy * width + cx);
            corners[j][i] = wx[i & 1] * wy[i >> 1u];
        }
    }
}

// Returns q·k of sample j in group g, bilinear.
fn key_dot(n: u32, j: u32, g: u32) -> f32 {
    let group_dim = call.dim / call.groups;
    let query_start = n * query_width() + g * group_dim;
    let row = cells[j] * call.stride + call.key + g * group_dim;
    let w = corners[j];
    var sum = 0.0;
    for (var c = 0u; c < group_dim; c++) {
        let k = vec4<f32>(maps[row.x + c], maps[row.y + c], maps[row.z + c], maps[row.w + c]);
        sum += query[query_start + c] * dot(w, k);
    }
    return sum;
}

// Returns the dropout factor of weight i = j·G + g of parent n.
fn dropout_factor(n: u32, i: u32) -> f32 {
    if call.drops == 0u {
        return 1.0;
    }
    let rows = wide_product(call.first_parent + n, sample_count() * call.groups);
    let bits = splitmix(wide_add(rows, vec2<u32>(i, 0u)))
        ^ vec2<u32>(call.seed_low, call.seed_high);
    let u = wide_shift(splitmix(bits), 11u);
    let dropped = wide_less(u, vec2<u32>(call.dropped_low, call.dropped_high));
    return select(call.kept_factor, 0.0, dropped);
}

// Returns the gate of the view of sample j.
fn gate(n: u32, j: u32) -> f32 {
    return query[(n + 1u) * query_width() - call.views + view_of(j)];
}

// Computes the samples and softmax weights of parent n. All threads must call this function, and
// a barrier must follow.
fn attention_weights(n: u32, thread: u32) {
    let samples = sample_count();
    for (var j = thread; j < samples; j += GATHER_THREADS) {
        locate_sample(n, j);
    }
    workgroupBarrier();
    let bias = n * query_width() + query_channels();
    for (var i = thread; i < samples * call.groups; i += GATHER_THREADS) {
        var logit = query[bias + i];
        let j = i / call.groups;
        if call.has_key != 0u && states[j] == SAMPLED {
            logit += call.logit_scale * key_dot(n, j, i % call.groups);
        }
        weights[i] = logit;
    }
    workgroupBarrier();
    for (var g = thread; g < call.groups; g += GATHER_THREADS) {
        softmax(g, samples);
    }
}

// Computes the softmax over the samples that are not masked; all weights are 0 where every sample
// is masked.
fn softmax(g: u32, samples: u32) {
    var top = 0.0;
    var any = false;
    for (var j = 0u; j < samples; j++) {
        let logit = weights[j * call.groups + g];
        if states[j] != EXCLUDED {
            top = select(logit, max(top, logit), any);
            any = true;
        }
    }
    var sum = 0.0;
    for (var j = 0u; j < samples; j++) {
        let i = j * call.groups + g;
        var w = 0.0;
        if states[j] != EXCLUDED {
            w = exp(weights[i] - top);
        }
        weights[i] = w;
        sum += w;
    }
    let inverse = select(0.0, 1.0 / sum, any);
    for (var j = 0u; j < samples; j++) {
        weights[j * call.groups + g] *= inverse;
    }
}
