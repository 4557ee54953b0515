// Samples and softmax weights of one parent, which is one workgroup's, for the attention
// gather and its gradients.

@group(0) @binding(1) var<storage, read> maps: array<f32>;
@group(0) @binding(2) var<storage, read> query: array<f32>;
@group(0) @binding(3) var<storage, read> points: array<f32>;
// Height, width and first cell of each level.
@group(0) @binding(4) var<storage, read> levels: array<u32>;

// Of each sample: cells of its corners (x fastest) and their weights, 0 outside.
var<workgroup> cells: array<vec4<u32>, GATHER_SAMPLES_MAX>;
var<workgroup> corners: array<vec4<f32>, GATHER_SAMPLES_MAX>;
var<workgroup> states: array<u32, GATHER_SAMPLES_MAX>;
// [samples, G]: logits, then softmax weights.
var<workgroup> weights: array<f32, GATHER_WEIGHTS_MAX>;

// States of a sample: not in the softmax; in it with a value of 0; sampled.
const MASKED: u32 = 0u;
const BLANK: u32 = 1u;
const LIVE: u32 = 2u;
const GATHER_THREADS: u32 = 64u;

// View and level of sample j.
fn view_of(j: u32) -> u32 {
    return j / (call.levels * call.points);
}

fn level_of(j: u32) -> u32 {
    return j / call.points % call.levels;
}

// Float of the points at which the point of sample j of parent n lies.
fn point_of(n: u32, j: u32) -> u32 {
    let own = select(0u, level_of(j) * call.points, call.points_per_level != 0u);
    return n * call.views * call.points_width + view_of(j) * call.points_width
        + 2u * (own + j % call.points);
}

// Position of sample j in its level's map, column and row.
fn position(n: u32, j: u32) -> vec2<f32> {
    let at = point_of(n, j);
    let size = vec2<f32>(f32(levels[3u * level_of(j) + 1u]), f32(levels[3u * level_of(j)]));
    return vec2<f32>(points[at], points[at + 1u]) * size - call.half_pixel;
}

fn place(n: u32, j: u32) {
    let at = point_of(n, j);
    let rx = points[at];
    let ry = points[at + 1u];
    cells[j] = vec4<u32>();
    corners[j] = vec4<f32>();
    // A point that is no number is outside.
    if !(rx > 0.0 && rx < 1.0 && ry > 0.0 && ry < 1.0) {
        states[j] = select(BLANK, MASKED, call.renormalise != 0u);
        return;
    }
    states[j] = LIVE;
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

// q·k of sample j in group g, bilinear.
fn along_key(n: u32, j: u32, g: u32) -> f32 {
    let wide = call.dim / call.groups;
    let begin = n * query_width() + g * wide;
    let row = cells[j] * call.stride + call.key + g * wide;
    let w = corners[j];
    var sum = 0.0;
    for (var c = 0u; c < wide; c++) {
        let k = vec4<f32>(maps[row.x + c], maps[row.y + c], maps[row.z + c], maps[row.w + c]);
        sum += query[begin + c] * dot(w, k);
    }
    return sum;
}

// Factor of weight i = j·G + g of parent n after dropping.
fn kept(n: u32, i: u32) -> f32 {
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

fn gate(n: u32, j: u32) -> f32 {
    return query[(n + 1u) * query_width() - call.views + view_of(j)];
}

// Samples and softmax weights of parent n; call from all threads, before a barrier.
fn attend(n: u32, lane: u32) {
    let samples = sample_count();
    for (var j = lane; j < samples; j += GATHER_THREADS) {
        place(n, j);
    }
    workgroupBarrier();
    let bias = n * query_width() + query_channels();
    for (var i = lane; i < samples * call.groups; i += GATHER_THREADS) {
        var logit = query[bias + i];
        let j = i / call.groups;
        if call.has_key != 0u && states[j] == LIVE {
            logit += call.logit_scale * along_key(n, j, i % call.groups);
        }
        weights[i] = logit;
    }
    workgroupBarrier();
    for (var g = lane; g < call.groups; g += GATHER_THREADS) {
        softmax(g, samples);
    }
}

// Over the samples that are not masked; all weights 0 where there is none.
fn softmax(g: u32, samples: u32) {
    var top = 0.0;
    var any = false;
    for (var j = 0u; j < samples; j++) {
        let logit = weights[j * call.groups + g];
        if states[j] != MASKED {
            top = select(logit, max(top, logit), any);
            any = true;
        }
    }
    var sum = 0.0;
    for (var j = 0u; j < samples; j++) {
        let i = j * call.groups + g;
        var w = 0.0;
        if states[j] != MASKED {
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
