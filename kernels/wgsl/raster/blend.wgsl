// Front-to-back compositing (3DGS, section 6 and equation 3). CPU version: cpu/raster/blend.rs.
// Per pixel α = min(cap, o·e^(−σ)); values below 1/255 are skipped. Blending stops
// before the splat that would reduce T to `stop` or less.
//
// One workgroup per tile. A thread processes four pixels of a column, which share the reads of a
// splat. On llvmpipe each lane reads by itself, and without AVX-512 waits at each number that it
// puts into a vector.
//
// Output: RGB over the background, 1 − T, Σ w·z. Channel c of pixel p is at p·step + c·channel,
// followed by H·W alphas and H·W depth sums; H is the number of rows of the call's band. For the
// backward pass, per pixel: the bits of T, and the end of the blended part of the sorted pairs.
//
// Splats may be divided into several calls, nearest first. A call that carries writes sums
// without background, and T in place of alpha, negative where blending has stopped.

@group(0) @binding(0) var<uniform> call: RasterUniform;
@group(0) @binding(1) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> ranges: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read_write> picture: array<f32>;
@group(0) @binding(6) var<storage, read_write> finals: array<vec2<u32>>;

const THREADS: u32 = 64u;
const ROWS: u32 = 4u;
// Splats between two barriers.
const SPLATS: u32 = 128u;

// Footprints, their last vec4 with z instead of the half-height.
var<workgroup> batch: array<vec4<f32>, 3u * SPLATS>;
// Pixels of the tile that still blend.
var<workgroup> blending_count: atomic<u32>;
var<workgroup> blending_count_read: u32;

fn count_true(flags: vec4<bool>) -> u32 {
    let ones = select(vec4<u32>(0u), vec4<u32>(1u), flags);
    return ones.x + ones.y + ones.z + ones.w;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = workgroup_number(workgroup, workgroups);
    if tile >= call.columns * call.rows {
        return;
    }
    let x = tile % call.columns * TILE_GPU + thread % TILE_GPU;
    let top = (call.top + tile / call.columns) * TILE_GPU + thread / TILE_GPU * ROWS;
    let lines = vec4<u32>(top) + vec4<u32>(0u, 1u, 2u, 3u);
    let inside = (lines < vec4<u32>(call.height)) & vec4<bool>(x < call.width);
    var is_blending = inside;
    let rows = band();
    let plane = call.width * rows.y;
    var t = vec4<f32>(1.0);
    var red = vec4<f32>(0.0);
    var green = vec4<f32>(0.0);
    var blue = vec4<f32>(0.0);
    var depth = vec4<f32>(0.0);
    if call.resumes != 0u {
        for (var r = 0u; r < ROWS; r++) {
            if inside[r] {
                let p = (lines[r] - rows.x) * call.width + x;
                let at = p * call.step;
                red[r] = picture[at];
                green[r] = picture[at + call.channel];
                blue[r] = picture[at + 2u * call.channel];
                depth[r] = picture[4u * plane + p];
                t[r] = abs(picture[3u * plane + p]);
                is_blending[r] = picture[3u * plane + p] > 0.0;
            }
        }
    }
    if thread == 0u {
        atomicStore(&blending_count, 0u);
    }
    workgroupBarrier();
    if any(is_blending) {
        atomicAdd(&blending_count, count_true(is_blending));
    }
    let first = ranges[2u * tile];
    let past = ranges[2u * tile + 1u];
    var end = vec4<u32>(first);
    for (var base = first; base < past; base += SPLATS) {
        workgroupBarrier();
        if thread == 0u {
            blending_count_read = atomicLoad(&blending_count);
        }
        if workgroupUniformLoad(&blending_count_read) == 0u {
            break;
        }
        let count = min(SPLATS, past - base);
        for (var s = thread; s < count; s += THREADS) {
            let i = owners[pairs[base + s]];
            batch[3u * s] = footprints[3u * i];
            let b = footprints[3u * i + 1u];
            batch[3u * s + 1u] = b;
            batch[3u * s + 2u] = vec4<f32>(footprints[3u * i + 2u].xyz, b.z);
        }
        workgroupBarrier();
        if any(is_blending) {
            for (var s = 0u; s < count; s++) {
                let a = batch[3u * s];
                let b = batch[3u * s + 1u].xy;
                // `exponent` of `whitened` for four pixels.
                let down = vec4<f32>(lines) - a.y;
                let d = ((f32(x) - a.x) + a.w * down) * a.z;
                let e = down * b.x;
                let power = b.y - d * d - e * e;
                let visible = is_blending & !(power < vec4<f32>(ALPHA_MIN_LOG2));
                if !any(visible) {
                    continue;
                }
                let alpha = min(exp2(power), vec4<f32>(call.alpha_max));
                let rest = t * (1.0 - alpha);
                let ends = visible & (rest <= vec4<f32>(call.stop));
                let blends = visible & !ends;
                let c = batch[3u * s + 2u];
                let w = alpha * t;
                red = select(red, red + w * c.x, blends);
                green = select(green, green + w * c.y, blends);
                blue = select(blue, blue + w * c.z, blends);
                depth = select(depth, depth + w * c.w, blends);
                t = select(t, rest, blends);
                end = select(end, vec4<u32>(base + s + 1u), blends);
                if any(ends) {
                    is_blending = is_blending & !ends;
                    atomicSub(&blending_count, count_true(ends));
                    if !any(is_blending) {
                        break;
                    }
                }
            }
        }
    }
    for (var r = 0u; r < ROWS; r++) {
        if !inside[r] {
            continue;
        }
        var rgb = vec3<f32>(red[r], green[r], blue[r]);
        var alpha = select(-t[r], t[r], is_blending[r]);
        if call.carries == 0u {
            rgb += t[r] * call.background.xyz;
            alpha = 1.0 - t[r];
        }
        let p = (lines[r] - rows.x) * call.width + x;
        let at = p * call.step;
        picture[at] = rgb.x;
        picture[at + call.channel] = rgb.y;
        picture[at + 2u * call.channel] = rgb.z;
        picture[3u * plane + p] = alpha;
        picture[4u * plane + p] = depth[r];
        finals[p] = vec2<u32>(bitcast<u32>(t[r]), end[r]);
    }
}
