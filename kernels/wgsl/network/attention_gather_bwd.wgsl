// Gradients of the attention gather with respect to query and points, and the factors of the
// gradient of the maps. CPU version: cpu/attention_gather/backward.rs. Arguments except the
// last four: wgsl/shared/gather_samples.wgsl.
//
// Input: gradient of the output [N, E]. Output: rows [N, Q + P] of query and points; the cell of
// each corner of each sample [N, S, 4], or NONE; factors [N, S, 4 + 2G]: the weights of the
// corners, then per group the factors of q in the key channels and of the gradient in the value
// channels. One workgroup per parent.

@group(0) @binding(5) var<storage, read> grad: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_rows: array<f32>;
@group(0) @binding(7) var<storage, read_write> cells_of: array<u32>;
@group(0) @binding(8) var<storage, read_write> factors: array<f32>;

// [samples, G]: the product of gradient and sampled value, then the gradient of the logit.
var<workgroup> along: array<f32, GATHER_WEIGHTS_MAX>;

fn corners_of(row: vec4<u32>) -> vec4<f32> {
    return vec4<f32>(maps[row.x], maps[row.y], maps[row.z], maps[row.w]);
}

// Returns gradient · value of sample j in group g.
fn value_dot(n: u32, j: u32, g: u32) -> f32 {
    let group_dim = call.dim / call.groups;
    let row = cells[j] * call.stride + call.value + g * group_dim;
    var sum = 0.0;
    for (var c = 0u; c < group_dim; c++) {
        sum += grad[n * call.dim + g * group_dim + c] * dot(corners[j], corners_of(row + c));
    }
    return sum;
}

// Returns the gradient of the gate of view v, before logits_bwd replaces `along`.
fn gates_bwd(n: u32, v: u32) -> f32 {
    let per_view = call.levels * call.points * call.groups;
    var sum = 0.0;
    for (var i = v * per_view; i < (v + 1u) * per_view; i++) {
        sum += weights[i] * along[i];
    }
    return sum;
}

// Replaces `along` by the gradients of the logits of group g.
fn logits_bwd(n: u32, g: u32) {
    var mean = 0.0;
    for (var j = 0u; j < sample_count(); j++) {
        let i = j * call.groups + g;
        along[i] *= gate(n, j);
        mean += weights[i] * along[i];
    }
    for (var j = 0u; j < sample_count(); j++) {
        let i = j * call.groups + g;
        along[i] = weights[i] * (along[i] - mean);
    }
}

// Returns the gradient of the corner weights of sample j; logits_bwd must run before.
fn corners_bwd(n: u32, j: u32) -> vec4<f32> {
    let group_dim = call.dim / call.groups;
    var sum = vec4<f32>();
    for (var c = 0u; c < call.dim; c++) {
        let i = j * call.groups + c / group_dim;
        let by = weights[i] * gate(n, j) * dropout_factor(n, i) * grad[n * call.dim + c];
        sum += by * corners_of(cells[j] * call.stride + call.value + c);
        if call.has_key != 0u {
            let by = along[i] * call.logit_scale * query[n * query_width() + c];
            sum += by * corners_of(cells[j] * call.stride + call.key + c);
        }
    }
    return sum;
}

// Returns the gradient of the point of sample j through the bilinear weights.
fn point_bwd(n: u32, j: u32) -> vec2<f32> {
    if states[j] != SAMPLED {
        return vec2<f32>();
    }
    let p = position(n, j);
    let corner = floor(p);
    let f = p - corner;
    let size = vec2<f32>(f32(levels[3u * level_of(j) + 1u]), f32(levels[3u * level_of(j)]));
    let d = corners_bwd(n, j);
    var sum = vec2<f32>();
    for (var i = 0u; i < 4u; i++) {
        let side = vec2<f32>(f32(i & 1u), f32(i >> 1u));
        let at = corner + side;
        if all(at >= vec2<f32>()) && all(at < size) {
            let w = select(1.0 - f, f, side == vec2<f32>(1.0));
            sum += d[i] * (2.0 * side - 1.0) * w.yx;
        }
    }
    return sum * size;
}

// Returns the gradient of point q of V·(M or L·M), summed over the levels that share the point.
fn points_bwd(n: u32, q: u32) -> vec2<f32> {
    let per_view = call.points_width / 2u;
    let v = q / per_view;
    let own = q % per_view;
    if call.points_per_level != 0u {
        return point_bwd(n, v * call.levels * call.points + own);
    }
    var sum = vec2<f32>();
    for (var l = 0u; l < call.levels; l++) {
        sum += point_bwd(n, (v * call.levels + l) * call.points + own);
    }
    return sum;
}

fn query_bwd(c: u32) -> f32 {
    let g = c / (call.dim / call.groups);
    var sum = 0.0;
    for (var j = 0u; j < sample_count(); j++) {
        if states[j] == SAMPLED {
            let k = corners_of(cells[j] * call.stride + call.key + c);
            sum += along[j * call.groups + g] * call.logit_scale * dot(corners[j], k);
        }
    }
    return sum;
}

fn store_factors(n: u32, thread: u32) {
    let stride = 4u + 2u * call.groups;
    for (var i = thread; i < 4u * sample_count(); i += GATHER_THREADS) {
        let at = n * sample_count() + i / 4u;
        let w = corners[i / 4u][i % 4u];
        let used = states[i / 4u] == SAMPLED && w != 0.0;
        factors[at * stride + i % 4u] = w;
        cells_of[4u * at + i % 4u] = select(NONE, cells[i / 4u][i % 4u], used);
    }
    for (var i = thread; i < sample_count() * call.groups; i += GATHER_THREADS) {
        let j = i / call.groups;
        let at = (n * sample_count() + j) * stride + 4u + 2u * (i % call.groups);
        factors[at] = along[i] * call.logit_scale;
        factors[at + 1u] = weights[i] * gate(n, j) * dropout_factor(n, i);
    }
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = workgroup_number(workgroup, workgroups);
    if n >= call.parents {
        return;
    }
    attention_weights(n, thread);
    workgroupBarrier();
    let logits = sample_count() * call.groups;
    for (var i = thread; i < logits; i += GATHER_THREADS) {
        var v = 0.0;
        if states[i / call.groups] == SAMPLED {
            v = dropout_factor(n, i) * value_dot(n, i / call.groups, i % call.groups);
        }
        along[i] = v;
    }
    workgroupBarrier();
    let points_floats = call.views * call.points_width;
    let to = n * (query_width() + points_floats);
    for (var v = thread; v < call.views; v += GATHER_THREADS) {
        d_rows[to + query_width() - call.views + v] = gates_bwd(n, v);
    }
    workgroupBarrier();
    for (var g = thread; g < call.groups; g += GATHER_THREADS) {
        logits_bwd(n, g);
    }
    workgroupBarrier();
    for (var i = thread; i < logits; i += GATHER_THREADS) {
        d_rows[to + query_channels() + i] = along[i];
    }
    for (var c = thread; c < query_channels(); c += GATHER_THREADS) {
        d_rows[to + c] = query_bwd(c);
    }
    for (var q = thread; q < points_floats / 2u; q += GATHER_THREADS) {
        var d = vec2<f32>();
        if call.point_gradient != 0u {
            d = points_bwd(n, q);
        }
        d_rows[to + query_width() + 2u * q] = d.x;
        d_rows[to + query_width() + 2u * q + 1u] = d.y;
    }
    store_factors(n, thread);
}
