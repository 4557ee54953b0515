// SSIM of the windows of a picture, and its derivatives by the windows' means (Wang et al. 2004).
// CPU version: cpu/dssim.rs (means and `row`), with the same order of summation within a window.
//
// Input: picture and truth as in wgsl/shared/loss.wgsl. Output: maps [3, 3, h, w], h and w the windows
// along y and x: of each channel the derivatives of SSIM by the means of x, x² and x·t; where
// `call.scores` is 1, sums of SSIM, one of each workgroup. One workgroup for 16×16 windows of a channel.

@group(0) @binding(0) var<uniform> call: LossUniform;
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
@group(0) @binding(4) var<storage, read_write> scores: array<f32>;

const THREADS: u32 = 256u;
// Windows along a side of the workgroup's square, and pixels that they cover.
const SIDE: u32 = 16u;
const SPAN: u32 = SIDE + LOSS_TAPS - 1u;

var<workgroup> own: array<f32, SPAN * SPAN>;
var<workgroup> seen: array<f32, SPAN * SPAN>;
// [5, SPAN, SIDE]: means along rows of x, t, x², t² and x·t.
var<workgroup> across: array<f32, 5u * SPAN * SIDE>;

fn load(slot: u32, x: u32, y: u32, channel: u32) {
    own[slot] = 0.0;
    seen[slot] = 0.0;
    if x < call.width && y < call.height {
        let p = y * call.width + x;
        let target_pixel = truth_of(p);
        let value = picture[channel * call.width * call.height + p];
        own[slot] = value;
        seen[slot] = seen_of(value, target_pixel[channel], weight_of(p, target_pixel.w));
    }
}

fn mean_along_row(slot: u32, row: u32, column: u32) {
    var x_sum = 0.0;
    var t_sum = 0.0;
    var xx_sum = 0.0;
    var tt_sum = 0.0;
    var xt_sum = 0.0;
    for (var k = 0u; k < LOSS_TAPS; k++) {
        let x = own[row * SPAN + column + k];
        let t = seen[row * SPAN + column + k];
        let weight = tap(k);
        x_sum += weight * x;
        t_sum += weight * t;
        xx_sum += weight * (x * x);
        tt_sum += weight * (t * t);
        xt_sum += weight * (x * t);
    }
    across[slot] = x_sum;
    across[SPAN * SIDE + slot] = t_sum;
    across[2u * SPAN * SIDE + slot] = xx_sum;
    across[3u * SPAN * SIDE + slot] = tt_sum;
    across[4u * SPAN * SIDE + slot] = xt_sum;
}

fn mean_along_column(map: u32, row: u32, column: u32) -> f32 {
    var sum = 0.0;
    for (var k = 0u; k < LOSS_TAPS; k++) {
        sum += tap(k) * across[(map * SPAN + row + k) * SIDE + column];
    }
    return sum;
}

// Writes the derivatives of window `at` of a channel; returns its SSIM.
fn window(row: u32, column: u32, channel: u32, at: u32) -> f32 {
    let ux = mean_along_column(0u, row, column);
    let ut = mean_along_column(1u, row, column);
    let mxx = mean_along_column(2u, row, column);
    let mtt = mean_along_column(3u, row, column);
    let mxt = mean_along_column(4u, row, column);
    let cov = call.covariance;
    let variances = cov * (mxx - ux * ux + mtt - ut * ut) + call.structure_term;
    let covariance = 2.0 * cov * (mxt - ux * ut) + call.structure_term;
    let light = 2.0 * ux * ut + call.light_term;
    let lights = ux * ux + ut * ut + call.light_term;
    let s = light * covariance / (lights * variances);
    let by_light = 2.0 * ut / light - 2.0 * ux / lights;
    let by_structure = 2.0 * cov * (ux / variances - ut / covariance);
    let windows = call.windows_x * call.windows_y;
    let first = 3u * channel * windows + at;
    maps[first] = s * (by_light + by_structure);
    maps[first + windows] = -s * cov / variances;
    maps[first + 2u * windows] = 2.0 * s * cov / covariance;
    return s;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let columns = (call.windows_x + SIDE - 1u) / SIDE;
    let squares = columns * ((call.windows_y + SIDE - 1u) / SIDE);
    let channel = number / squares;
    if channel >= 3u {
        return;
    }
    let square = number % squares;
    let left = square % columns * SIDE;
    let top = square / columns * SIDE;
    for (var k = thread; k < SPAN * SPAN; k += THREADS) {
        load(k, left + k % SPAN, top + k / SPAN, channel);
    }
    workgroupBarrier();
    for (var k = thread; k < SPAN * SIDE; k += THREADS) {
        mean_along_row(k, k / SIDE, k % SIDE);
    }
    workgroupBarrier();
    let column = thread % SIDE;
    let row = thread / SIDE;
    let x = left + column;
    let y = top + row;
    var score = 0.0;
    if x < call.windows_x && y < call.windows_y {
        score = window(row, column, channel, y * call.windows_x + x);
    }
    if call.scores != 0u {
        let sum = total_in_memory(score, thread);
        if thread == 0u {
            scores[number] = sum;
        }
    }
}
