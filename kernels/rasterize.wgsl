// Front-to-back compositing, a workgroup a tile, a thread a pixel (3DGS section 6, eq. 3).
// Twin: src/cpu/rasterize.rs (blend there). Per pixel: α = min(cap, o·e^(−σ)), skipped
// below 1/255; blending stops before the splat that would take T to `stop` or below.
//
// Out: RGB over the background, 1 − T, Σ w·z: channel c of pixel p at p·step + c·channel,
// then H·W alphas and H·W depth sums; H the rows of the call's band. For the way back, per
// pixel: the bits of T, and the place in the sorted pairs behind the last splat that was
// blended.
//
// Splats may come in several calls, nearest first: one that carries leaves sums without
// background and T in place of alpha, below 0 where blending has stopped.

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
var<workgroup> live: atomic<u32>;
var<workgroup> live_seen: u32;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = workgroup_number(workgroup, workgroups);
    if tile >= call.columns * call.rows {
        return;
    }
    let x = tile % call.columns * TILE_GPU + lane % TILE_GPU;
    let y = (call.top + tile / call.columns) * TILE_GPU + lane / TILE_GPU;
    let pixel = vec2<f32>(f32(x), f32(y));
    var goes = x < call.width && y < call.height;
    let inside = goes;
    let rows = band();
    let p = (y - rows.x) * call.width + x;
    let plane = call.width * rows.y;
    let at = p * call.step;
    var t = 1.0;
    var sum = vec4<f32>(0.0);
    if inside && call.resumes != 0u {
        sum = vec4<f32>(picture[at], picture[at + call.channel], picture[at + 2u * call.channel], picture[4u * plane + p]);
        t = abs(picture[3u * plane + p]);
        goes = picture[3u * plane + p] > 0.0;
    }
    if lane == 0u {
        atomicStore(&live, 256u);
    }
    workgroupBarrier();
    if !goes {
        atomicSub(&live, 1u);
    }
    let first = ranges[2u * tile];
    let past = ranges[2u * tile + 1u];
    var end = first;
    for (var base = first; base < past; base += 256u) {
        workgroupBarrier();
        if lane == 0u {
            live_seen = atomicLoad(&live);
        }
        if workgroupUniformLoad(&live_seen) == 0u {
            break;
        }
        if base + lane < past {
            let i = owners[pairs[base + lane]];
            batch_a[lane] = footprints[3u * i];
            batch_b[lane] = footprints[3u * i + 1u];
            batch_c[lane] = footprints[3u * i + 2u];
        }
        workgroupBarrier();
        if goes {
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
                    goes = false;
                    atomicSub(&live, 1u);
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
    var alpha = select(-t, t, goes);
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
