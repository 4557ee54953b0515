// Sums of samples over blocks of one quarter-resolution pixel. CPU version:
// cpu/matching.rs.

// [pictures, 2 height, 2 width], [pictures, 3, height, width].
@group(0) @binding(1) var<storage, read> half_grey: array<f32>;
@group(0) @binding(2) var<storage, read> quarter_rgb: array<f32>;
// Reference and source picture of each row.
@group(0) @binding(3) var<storage, read> pictures: array<vec2<u32>>;
// Per row, at half and at quarter resolution: three columns of the homography, then the shift;
// homogeneous source pixel = homography (u, v, 1) + disparity shift.
@group(0) @binding(4) var<storage, read> warps: array<vec4<f32>>;
// [rows, candidates].
@group(0) @binding(5) var<storage, read> disparities: array<f32>;
// [rows, candidates, PLANES, height, width].
@group(0) @binding(6) var<storage, read_write> sums: array<f32>;

// Bilinear sample of a picture: four indices, shares of the right and lower ones, validity.
struct Sample {
    cells: vec4<u32>,
    share: vec2<f32>,
    valid: bool,
}

// Returns the sample for pixel (x, y) of a picture of this size; `level` is 0 for half
// resolution, 1 for quarter resolution.
fn sample(row: u32, level: u32, pixel: vec2<u32>, disparity: f32, extent: vec2<u32>) -> Sample {
    let w = (row * 2u + level) * 4u;
    let base = warps[w + 1u].xyz * (f32(pixel.y) + 0.5) + warps[w + 2u].xyz
        + warps[w + 3u].xyz * disparity;
    let p = base + warps[w].xyz * (f32(pixel.x) + 0.5);
    let at = p.xy / p.z;
    let size = vec2<f32>(extent);
    var result: Sample;
    result.valid = p.z > call.z_min && all(at >= vec2<f32>()) && all(at <= size);
    let place = clamp(select(vec2<f32>(), at - 0.5, result.valid), vec2<f32>(), size - 1.0);
    let corner = vec2<u32>(place);
    result.share = place - vec2<f32>(corner);
    let step = select(vec2<u32>(), vec2<u32>(1u, extent.x), corner + 1u < extent);
    let first = corner.y * extent.x + corner.x;
    result.cells = vec4<u32>(first, first + step.x, first + step.y, first + step.x + step.y);
    return result;
}

fn blend(s: Sample, values: vec4<f32>) -> f32 {
    let rows = mix(values.xz, values.yw, s.share.x);
    return select(0.0, mix(rows.x, rows.y, s.share.y), s.valid);
}

// Adds one sample to sums 1, r, s, r^2 (left) and s^2, r s (right).
fn add(left: ptr<function, vec4<f32>>, right: ptr<function, vec2<f32>>, r: f32, s: f32) {
    *left += vec4<f32>(1.0, r, s, r * r);
    *right += vec2<f32>(s * s, r * s);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    let plane = call.height * call.width;
    if i >= call.rows * call.candidates * plane {
        return;
    }
    let pixel = vec2<u32>(i % call.width, i % plane / call.width);
    let row = i / plane / call.candidates;
    let disparity = disparities[i / plane];
    let reference = pictures[row].x;
    let source = pictures[row].y;
    var left: vec4<f32>;
    var right: vec2<f32>;
    let fine = 2u * vec2<u32>(call.width, call.height);
    for (var j = 0u; j < 4u; j++) {
        let own = 2u * pixel + vec2<u32>(j % 2u, j / 2u);
        let s = sample(row, 0u, own, disparity, fine);
        if s.valid {
            let c = s.cells + source * 4u * plane;
            let values = vec4<f32>(
                half_grey[c.x],
                half_grey[c.y],
                half_grey[c.z],
                half_grey[c.w],
            );
            let r = half_grey[reference * 4u * plane + own.y * fine.x + own.x];
            add(&left, &right, r, blend(s, values));
        }
    }
    let base = i / plane * PLANES * plane + i % plane;
    for (var p = 0u; p < 4u; p++) {
        sums[base + p * plane] = left[p];
    }
    sums[base + 4u * plane] = right.x;
    sums[base + 5u * plane] = right.y;
    left = vec4<f32>();
    right = vec2<f32>();
    let s = sample(row, 1u, pixel, disparity, vec2<u32>(call.width, call.height));
    var colour = 0.75;
    var grey = vec2<f32>();
    if s.valid {
        colour = 0.0;
        for (var k = 0u; k < 3u; k++) {
            let c = s.cells + (source * 3u + k) * plane;
            let values = vec4<f32>(
                quarter_rgb[c.x],
                quarter_rgb[c.y],
                quarter_rgb[c.z],
                quarter_rgb[c.w],
            );
            let theirs = blend(s, values);
            let own = quarter_rgb[(reference * 3u + k) * plane + i % plane];
            colour += abs(theirs - own);
            grey += vec2<f32>(own, theirs) / 3.0;
        }
        add(&left, &right, grey.x, grey.y);
    }
    for (var p = 0u; p < 4u; p++) {
        sums[base + (6u + p) * plane] = left[p];
    }
    sums[base + 10u * plane] = right.x;
    sums[base + 11u * plane] = right.y;
    sums[base + COLOUR_PLANE * plane] = -colour / 3.0;
}
