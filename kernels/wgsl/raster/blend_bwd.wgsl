// Backward pass of blend.wgsl. CPU version: cpu/raster/blend_bwd.rs, with the same
// recurrence: q_i is the derivative of the loss with respect to the weight w_i of splat i, and
// B_i that of everything behind splat i. Then ∂L/∂ln α_i = w_i (q_i − B_i) and B_{i−1} = B_i +
// α_i (q_i − B_i).
//
// One workgroup per tile. A thread processes eight pixels of a column and skips rows that a splat
// cannot intersect. Eight adjacent threads cover an 8×8 quarter of the tile, so that they process
// the same rows. Each thread sums over its pixels; the sums of a tile are then added in the order
// of the threads. Results are reproducible without float atomics; there are two barriers per
// SPLATS splats.
//
// Input: T and end of the list per pixel from blend.wgsl; upstream [5, H, W], H the rows of
// the call's band. Where splats are divided into several calls, farthest first, upstream is [6,
// H, W]: a call writes B to the plane of alpha and T to the last plane for the next call. Output:
// ten sums per (splat, tile) pair over the tile's pixels, at the index that intersect.wgsl
// assigned. They are the sums of v = ∂L/∂ln α times 1, d, s, d², ds, s² (whitened distances), and
// of w times the gradients of R, G, B, Σ w·z. Per tile: Σ T·∂L/∂RGB. One surplus workgroup writes
// zeros for the pairs of the surplus tile.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> finals: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> upstream: array<f32>;
@group(0) @binding(7) var<storage, read_write> sums: array<f32>;
@group(0) @binding(8) var<storage, read_write> behind: array<vec4<f32>>;

const THREADS: u32 = 32u;
const ROWS: u32 = 8u;
// Splats between two barriers: the number that 16 KiB hold.
const SPLATS: u32 = 6u;
// Stride of a thread's sums, words: odd, so that threads access different banks.
const SUMS_STRIDE: u32 = SPLATS * PAIR_SUMS + 1u;

// Per pixel: gradients of R, G, B, Σ w·z; T and B; the end of the pixel's list.
var<workgroup> gradient: array<vec4<f32>, 256>;
var<workgroup> state: array<vec2<f32>, 256>;
var<workgroup> ends: array<u32, 256>;
var<workgroup> last: atomic<u32>;
var<workgroup> last_read: u32;
// Per splat: mean and half sizes, which decide the rows; the rest of the footprint; colour and z.
var<workgroup> batch: array<vec4<f32>, 3u * SPLATS>;
var<workgroup> thread_sums: array<f32, THREADS * SUMS_STRIDE>;
// Double buffers: indices of pairs, and masks of the threads that have sums.
var<workgroup> places: array<u32, 2u * SPLATS>;
var<workgroup> masks: array<atomic<u32>, 2u * SPLATS>;

fn clear(place: u32) {
    for (var k = 0u; k < PAIR_SUMS; k++) {
        sums[PAIR_SUMS * place + k] = 0.0;
    }
}

// Loads the pixel into workgroup memory; returns its T·∂L/∂RGB.
fn load_pixel(slot: u32, x: u32, y: u32) -> vec3<f32> {
    ends[slot] = 0u;
    if x >= call.width || y >= call.height {
        return vec3<f32>(0.0);
    }
    let rows = band();
    let p = (y - rows.x) * call.width + x;
    let plane = call.width * rows.y;
    let g = vec4<f32>(
        upstream[p],
        upstream[plane + p],
        upstream[2u * plane + p],
        upstream[4u * plane + p],
    );
    let left = finals[p];
    let t = bitcast<f32>(left.x);
    gradient[slot] = g;
    // The background lies behind the last splat.
    state[slot] = vec2<f32>(t, dot(call.background.xyz, g.xyz) - upstream[3u * plane + p]);
    if call.resumes != 0u {
        state[slot] = vec2<f32>(upstream[5u * plane + p], upstream[3u * plane + p]);
    }
    ends[slot] = left.y;
    atomicMax(&last, left.y);
    return t * g.xyz;
}

// Stores the state of the pixel for the call of the nearer splats.
fn store_pixel(slot: u32, x: u32, y: u32) {
    if x < call.width && y < call.height {
        let rows = band();
        let p = (y - rows.x) * call.width + x;
        let plane = call.width * rows.y;
        upstream[5u * plane + p] = state[slot].x;
        upstream[3u * plane + p] = state[slot].y;
    }
}

// Returns the rows of 0..ROWS from `top` on that a splat can intersect in column `x`.
fn intersected_rows(mean: vec2<f32>, half: vec2<f32>, x: f32, top: f32) -> vec2<u32> {
    let reach = half + SPAN_SLACK_PX;
    if abs(x - mean.x) > reach.x {
        return vec2<u32>(0u);
    }
    let row_count = f32(ROWS);
    let low = clamp(ceil(mean.y - reach.y - top), 0.0, row_count);
    let high = clamp(floor(mean.y + reach.y - top) + 1.0, low, row_count);
    return vec2<u32>(u32(low), u32(high));
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = workgroup_number(workgroup, workgroups);
    let tiles = call.columns * call.rows;
    if tile > tiles {
        return;
    }
    let first = ranges[2u * tile];
    let past = ranges[2u * tile + 1u];
    if tile == tiles {
        for (var i = first + thread; i < past; i += THREADS) {
            clear(pairs[i]);
        }
        return;
    }
    // Column and first row of the thread, within the tile.
    let column = (thread / 8u) % 2u * 8u + thread % 8u;
    let line = thread / 16u * ROWS;
    let x = tile % call.columns * TILE_GPU + column;
    let top = (call.top + tile / call.columns) * TILE_GPU + line;
    if thread == 0u {
        atomicStore(&last, first);
    }
    if thread < 2u * SPLATS {
        atomicStore(&masks[thread], 0u);
    }
    workgroupBarrier();
    var background_sum = vec3<f32>(0.0);
    for (var r = 0u; r < ROWS; r++) {
        background_sum += load_pixel(ROWS * thread + r, x, top + r);
    }
    thread_sums[3u * thread] = background_sum.x;
    thread_sums[3u * thread + 1u] = background_sum.y;
    thread_sums[3u * thread + 2u] = background_sum.z;
    workgroupBarrier();
    if thread == 0u {
        last_read = atomicLoad(&last);
        var all = vec3<f32>(0.0);
        for (var i = 0u; i < 3u * THREADS; i += 3u) {
            all += vec3<f32>(thread_sums[i], thread_sums[i + 1u], thread_sums[i + 2u]);
        }
        behind[tile] = vec4<f32>(all, 0.0);
    }
    var end = min(workgroupUniformLoad(&last_read), past);
    for (var i = end + thread; i < past; i += THREADS) {
        clear(pairs[i]);
    }
    var buffer = 0u;
    while end > first {
        let count = min(SPLATS, end - first);
        if thread < count {
            let place = pairs[end - 1u - thread];
            let i = owners[place];
            places[buffer + thread] = place;
            let a = footprints[3u * i];
            let b = footprints[3u * i + 1u];
            let c = footprints[3u * i + 2u];
            batch[3u * thread] = vec4<f32>(a.xy, b.w, c.w);
            batch[3u * thread + 1u] = vec4<f32>(a.zw, b.xy);
            batch[3u * thread + 2u] = vec4<f32>(c.xyz, b.z);
        }
        workgroupBarrier();
        for (var s = 0u; s < count; s++) {
            let place_size = batch[3u * s];
            let rows = intersected_rows(place_size.xy, place_size.zw, f32(x), f32(top));
            if rows.x >= rows.y {
                continue;
            }
            let shape = batch[3u * s + 1u];
            let a = vec4<f32>(place_size.xy, shape.xy);
            let b = vec4<f32>(shape.zw, 0.0, 0.0);
            let colour_z = batch[3u * s + 2u];
            let place = end - 1u - s;
            var v_low = vec3<f32>(0.0);
            var v_high = vec3<f32>(0.0);
            var w_sum = vec4<f32>(0.0);
            for (var r = rows.x; r < rows.y; r++) {
                let slot = ROWS * thread + r;
                let d = whitened(a, b, vec2<f32>(f32(x), f32(top + r)));
                let power = exponent(b, d);
                if power < ALPHA_MIN_LOG2 || place >= ends[slot] {
                    continue;
                }
                let alpha = min(exp2(power), call.alpha_max);
                let g = gradient[slot];
                let left = state[slot];
                let t = left.x / (1.0 - alpha);
                let w = alpha * t;
                let difference = dot(g, colour_z) - left.y;
                state[slot] = vec2<f32>(t, left.y + alpha * difference);
                // A capped alpha is constant.
                let v = select(0.0, w * difference, alpha < call.alpha_max);
                v_low += v * vec3<f32>(1.0, d);
                v_high += v * vec3<f32>(d.x * d, d.y * d.y);
                w_sum += w * g;
            }
            let at = SUMS_STRIDE * thread + PAIR_SUMS * s;
            thread_sums[at] = v_low.x;
            thread_sums[at + 1u] = v_low.y;
            thread_sums[at + 2u] = v_low.z;
            thread_sums[at + 3u] = v_high.x;
            thread_sums[at + 4u] = v_high.y;
            thread_sums[at + 5u] = v_high.z;
            thread_sums[at + 6u] = w_sum.x;
            thread_sums[at + 7u] = w_sum.y;
            thread_sums[at + 8u] = w_sum.z;
            thread_sums[at + 9u] = w_sum.w;
            atomicOr(&masks[buffer + s], 1u << thread);
        }
        workgroupBarrier();
        for (var k = thread; k < PAIR_SUMS * count; k += THREADS) {
            let s = k / PAIR_SUMS;
            var sum = 0.0;
            for (var left = atomicLoad(&masks[buffer + s]); left != 0u; left &= left - 1u) {
                sum += thread_sums[SUMS_STRIDE * firstTrailingBit(left) + k];
            }
            sums[PAIR_SUMS * places[buffer + s] + k % PAIR_SUMS] = sum;
        }
        // The masks of the other buffer were read before the last barrier.
        buffer = SPLATS - buffer;
        if thread < SPLATS {
            atomicStore(&masks[buffer + thread], 0u);
        }
        end -= count;
    }
    if call.carries != 0u {
        for (var r = 0u; r < ROWS; r++) {
            store_pixel(ROWS * thread + r, x, top + r);
        }
    }
}
