// Front-to-back compositing (3DGS, section 6 and equation 3). CPU version: src/cpu/rasterize.rs
// (blend). Per pixel α = min(cap, o·e^(−σ)); values below 1/255 are skipped. Blending stops
// before the splat that would reduce T to `stop` or less. One workgroup per tile, one thread per
// pixel.
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

var<workgroup> batch_a: array<vec4<f32>, 256>;
var<workgroup> batch_b: array<vec4<f32>, 256>;
var<workgroup> batch_c: array<vec4<f32>, 256>;
var<workgroup> blending_count: atomic<u32>;
var<workgroup> blending_count_read: u32;

@compute @workgroup_size(256)
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
    let y = (call.top + tile / call.columns) * TILE_GPU + thread / TILE_GPU;
    let pixel = vec2<f32>(f32(x), f32(y));
    var is_blending = x < call.width && y < call.height;
    let inside = is_blending;
    let rows = band();
    let p = (y - rows.x) * call.width + x;
    let plane = call.width * rows.y;
    let at = p * call.step;
    var t = 1.0;
    var sum = vec4<f32>(0.0);
    if inside && call.resumes != 0u {
        sum = vec4<f32>(picture[at], picture[at + call.channel], picture[at + 2u * call.channel], picture[4u * plane + p]);
        t = abs(picture[3u * plane + p]);
        is_blending = picture[3u * plane + p] > 0.0;
    }
    if thread == 0u {
        atomicStore(&blending_count, 256u);
    }
    workgroupBarrier();
    if !is_blending {
        atomicSub(&blending_count, 1u);
    }
    let first = ranges[2u * tile];
    let past = ranges[2u * tile + 1u];
    var end = first;
    for (var base = first; base < past; base += 256u) {
        workgroupBarrier();
        if thread == 0u {
            blending_count_read = atomicLoad(&blending_count);
        }
        if workgroupUniformLoad(&blending_count_read) == 0u {
            break;
        }
        if base + thread < past {
            let i = owners[pairs[base + thread]];
            batch_a[thread] = footprints[3u * i];
            batch_b[thread] = footprints[3u * i + 1u];
            batch_c[thread] = footprints[3u * i + 2u];
        }
        workgroupBarrier();
        if is_blending {
            let count = min(256u, past - base);
            for (var s = 0u; s < count; s++) {
                let b = batch_b[s];
                let power = exponent(b, whitened(batch_a[s], b, pixel));
                if power < ALPHA_MIN_LOG2 {
                    continue;
                }
                let alpha = min(exp2(power), call.alpha_max);
                let rest = t * (1.0 - alpha);
                if rest <= call.stop {
                    is_blending = false;
                    atomicSub(&blending_count, 1u);
                    break;
                }
                sum += alpha * t * vec4<f32>(batch_c[s].xyz, b.z);
                t = rest;
                end = base + s + 1u;
            }
        }
    }
    if !inside {
        return;
    }
    var rgb = sum.xyz;
    var alpha = select(-t, t, is_blending);
    if call.carries == 0u {
        rgb += t * call.background.xyz;
        alpha = 1.0 - t;
    }
    picture[at] = rgb.x;
    picture[at + call.channel] = rgb.y;
    picture[at + 2u * call.channel] = rgb.z;
    picture[3u * plane + p] = alpha;
    picture[4u * plane + p] = sum.w;
    finals[p] = vec2<u32>(bitcast<u32>(t), end);
}
