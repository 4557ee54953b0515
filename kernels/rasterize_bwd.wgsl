// Backward of rasterize.wgsl, a workgroup a tile. Twin: src/cpu/raster_bwd_tile.rs, whose
// recurrence this is: with q_i what the loss sees of splat i and B_i of what lies behind
// it, ∂L/∂ln α_i = w_i (q_i − B_i) and B_{i−1} = B_i + α_i (q_i − B_i).
//
// A thread has eight pixels, one above the other, and looks only at rows that a splat can
// meet; eight threads beside one another are an 8×8 quarter of the tile, so that they take
// the same rows. Each sums its pixels, then the tile's sums of a splat are added thread by
// thread: the same bytes each time, no float atomics, two barriers for SPLATS splats.
//
// In: what rasterize.wgsl left (T and the end of the list, per pixel), upstream [5, H, W];
// where splats come in several calls, farthest first, [6, H, W]: what a call leaves for the
// next is B in the plane of alpha and T in the last. H: the rows of the call's band.
// Out: per (splat, tile) pair, at the place where intersect.wgsl made it, ten sums over
// the tile's pixels: of v = ∂L/∂ln α times 1, d, s, d², ds, s² (whitened distances), and
// of w times the gradients of R, G, B, Σ w·z; per tile Σ T·∂L/∂RGB.
// One workgroup more than there are tiles: pairs behind the last tile have zeros.

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
// Splats between two barriers: what 16 KiB hold.
const SPLATS: u32 = 6u;
// Words of a thread's sums: odd, so that threads fall on different banks.
const PORTIONS: u32 = SPLATS * PAIR_SUMS + 1u;

// Per pixel: gradients of R, G, B, Σ w·z; T and B; the end of its list.
var<workgroup> gradient: array<vec4<f32>, 256>;
var<workgroup> state: array<vec2<f32>, 256>;
var<workgroup> ends: array<u32, 256>;
var<workgroup> last: atomic<u32>;
var<workgroup> last_seen: u32;
var<workgroup> batch: array<vec4<f32>, 3u * SPLATS>;
var<workgroup> portions: array<f32, THREADS * PORTIONS>;
// Twice, by turns: places of pairs, and the threads that have sums.
var<workgroup> places: array<u32, 2u * SPLATS>;
var<workgroup> masks: array<atomic<u32>, 2u * SPLATS>;

fn clear(place: u32) {
    for (var k = 0u; k < PAIR_SUMS; k++) {
        sums[PAIR_SUMS * place + k] = 0.0;
    }
}

// Reads the pixel into its place of the workgroup's memory; its T·∂L/∂RGB.
fn begin(slot: u32, x: u32, y: u32) -> vec3<f32> {
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
    // The background is what lies behind the last.
    state[slot] = vec2<f32>(t, dot(call.background.xyz, g.xyz) - upstream[3u * plane + p]);
    if call.resumes != 0u {
        state[slot] = vec2<f32>(upstream[5u * plane + p], upstream[3u * plane + p]);
    }
    ends[slot] = left.y;
    atomicMax(&last, left.y);
    return t * g.xyz;
}

// Leaves the pixel for a call of nearer splats.
fn leave(slot: u32, x: u32, y: u32) {
    if x < call.width && y < call.height {
        let rows = band();
        let p = (y - rows.x) * call.width + x;
        let plane = call.width * rows.y;
        upstream[5u * plane + p] = state[slot].x;
        upstream[3u * plane + p] = state[slot].y;
    }
}

// The part of rows 0..ROWS from `top` on that a splat can meet in column `x`.
fn rows_met(a: vec4<f32>, half: vec2<f32>, x: f32, top: f32) -> vec2<u32> {
    let wide = half + SPAN_SLACK_PX;
    if abs(x - a.x) > wide.x {
        return vec2<u32>(0u);
    }
    let most = f32(ROWS);
    let low = clamp(ceil(a.y - wide.y - top), 0.0, most);
    let high = clamp(floor(a.y + wide.y - top) + 1.0, low, most);
    return vec2<u32>(u32(low), u32(high));
}

@compute @workgroup_size(32)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = workgroup_number(workgroup, workgroups);
    let tiles = call.columns * call.rows;
    if tile > tiles {
        return;
    }
    let first = ranges[2u * tile];
    let past = ranges[2u * tile + 1u];
    if tile == tiles {
        for (var i = first + lane; i < past; i += THREADS) {
            clear(pairs[i]);
        }
        return;
    }
    // Column and first row of the thread, within the tile.
    let column = (lane / 8u) % 2u * 8u + lane % 8u;
    let line = lane / 16u * ROWS;
    let x = tile % call.columns * TILE_GPU + column;
    let top = (call.top + tile / call.columns) * TILE_GPU + line;
    if lane == 0u {
        atomicStore(&last, first);
    }
    if lane < 2u * SPLATS {
        atomicStore(&masks[lane], 0u);
    }
    workgroupBarrier();
    var seen = vec3<f32>(0.0);
    for (var r = 0u; r < ROWS; r++) {
        seen += begin(ROWS * lane + r, x, top + r);
    }
    portions[3u * lane] = seen.x;
    portions[3u * lane + 1u] = seen.y;
    portions[3u * lane + 2u] = seen.z;
    workgroupBarrier();
    if lane == 0u {
        last_seen = atomicLoad(&last);
        var all = vec3<f32>(0.0);
        for (var i = 0u; i < 3u * THREADS; i += 3u) {
            all += vec3<f32>(portions[i], portions[i + 1u], portions[i + 2u]);
        }
        behind[tile] = vec4<f32>(all, 0.0);
    }
    var end = min(workgroupUniformLoad(&last_seen), past);
    for (var i = end + lane; i < past; i += THREADS) {
        clear(pairs[i]);
    }
    var turn = 0u;
    while end > first {
        let count = min(SPLATS, end - first);
        if lane < count {
            let place = pairs[end - 1u - lane];
            let i = owners[place];
            places[turn + lane] = place;
            batch[3u * lane] = footprints[3u * i];
            batch[3u * lane + 1u] = footprints[3u * i + 1u];
            batch[3u * lane + 2u] = footprints[3u * i + 2u];
        }
        workgroupBarrier();
        for (var s = 0u; s < count; s++) {
            let a = batch[3u * s];
            let b = batch[3u * s + 1u];
            let c = batch[3u * s + 2u];
            let met = rows_met(a, vec2<f32>(b.w, c.w), f32(x), f32(top));
            if met.x >= met.y {
                continue;
            }
            let place = end - 1u - s;
            var v_low = vec3<f32>(0.0);
            var v_high = vec3<f32>(0.0);
            var w_sum = vec4<f32>(0.0);
            for (var r = met.x; r < met.y; r++) {
                let slot = ROWS * lane + r;
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
                let more = dot(g, vec4<f32>(c.xyz, b.z)) - left.y;
                state[slot] = vec2<f32>(t, left.y + alpha * more);
                // A capped alpha does not move.
                let v = select(0.0, w * more, alpha < call.alpha_max);
                v_low += v * vec3<f32>(1.0, d);
                v_high += v * vec3<f32>(d.x * d, d.y * d.y);
                w_sum += w * g;
            }
            let at = PORTIONS * lane + PAIR_SUMS * s;
            portions[at] = v_low.x;
            portions[at + 1u] = v_low.y;
            portions[at + 2u] = v_low.z;
            portions[at + 3u] = v_high.x;
            portions[at + 4u] = v_high.y;
            portions[at + 5u] = v_high.z;
            portions[at + 6u] = w_sum.x;
            portions[at + 7u] = w_sum.y;
            portions[at + 8u] = w_sum.z;
            portions[at + 9u] = w_sum.w;
            atomicOr(&masks[turn + s], 1u << lane);
        }
        workgroupBarrier();
        for (var k = lane; k < PAIR_SUMS * count; k += THREADS) {
            let s = k / PAIR_SUMS;
            var sum = 0.0;
            for (var left = atomicLoad(&masks[turn + s]); left != 0u; left &= left - 1u) {
                sum += portions[PORTIONS * firstTrailingBit(left) + k];
            }
            sums[PAIR_SUMS * places[turn + s] + k % PAIR_SUMS] = sum;
        }
        // The other turn's masks were read before the last barrier.
        turn = SPLATS - turn;
        if lane < SPLATS {
            atomicStore(&masks[turn + lane], 0u);
        }
        end -= count;
    }
    if call.carries != 0u {
        for (var r = 0u; r < ROWS; r++) {
            leave(ROWS * lane + r, x, top + r);
        }
    }
}
