// Gradient of the loss of a photograph by the rendered picture: mean squared difference, and the
// weighted dissimilarity (1 - SSIM)/2. CPU version: cpu/dssim.rs (the transpose of a windowed mean);
// the loss of `Target` in the optimiser of the crate subsplat.
//
// Input: picture and truth as in wgsl/shared/loss.wgsl; maps [3, 3, h, w] of
// wgsl/finish/dssim_windows.wgsl, read where `call.dssim` is 1. Output: gradient [5, H, W]; alpha and the
// sum of w·z have none, nor have masked pixels. One workgroup for 16×16 pixels of a channel.

@group(0) @binding(0) var<uniform> call: LossUniform;
@group(0) @binding(1) var<storage, read> picture: array<f32>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read> maps: array<f32>;
@group(0) @binding(4) var<storage, read_write> gradient: array<f32>;

const THREADS: u32 = 256u;
// Pixels along a side of the workgroup's square, and windows that contain them.
const SIDE: u32 = 16u;
const SPAN: u32 = SIDE + LOSS_TAPS - 1u;

// [3, SPAN, SPAN]: derivatives by the windows' means; 0 where there is no window.
var<workgroup> near: array<f32, 3u * SPAN * SPAN>;
// [3, SPAN, SIDE]: the same after the pass along rows.
var<workgroup> across: array<f32, 3u * SPAN * SIDE>;

// Returns an element of a map; `x` and `y` wrap around for windows before the first.
fn derivative(map: u32, channel: u32, x: u32, y: u32) -> f32 {
    if x >= call.windows_x || y >= call.windows_y {
        return 0.0;
    }
    return maps[((3u * channel + map) * call.windows_y + y) * call.windows_x + x];
}

// Sums `map` over the windows of a column that contain the pixel.
fn sum_of(map: u32, row: u32, column: u32) -> f32 {
    var sum = 0.0;
    for (var k = 0u; k < LOSS_TAPS; k++) {
        sum += tap(LOSS_TAPS - 1u - k) * across[(map * SPAN + row + k) * SIDE + column];
    }
    return sum;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let number = workgroup_number(workgroup, workgroups);
    let columns = (call.width + SIDE - 1u) / SIDE;
    let squares = columns * ((call.height + SIDE - 1u) / SIDE);
    let channel = number / squares;
    if channel >= 3u {
        return;
    }
    let left = number % squares % columns * SIDE;
    let top = number % squares / columns * SIDE;
    if call.dssim != 0u {
        for (var k = thread; k < 3u * SPAN * SPAN; k += THREADS) {
            let x = left + k % SPAN - (LOSS_TAPS - 1u);
            let y = top + k / SPAN % SPAN - (LOSS_TAPS - 1u);
            near[k] = derivative(k / (SPAN * SPAN), channel, x, y);
        }
        workgroupBarrier();
        for (var k = thread; k < 3u * SPAN * SIDE; k += THREADS) {
            let first = k / SIDE * SPAN + k % SIDE;
            var sum = 0.0;
            for (var j = 0u; j < LOSS_TAPS; j++) {
                sum += tap(LOSS_TAPS - 1u - j) * near[first + j];
            }
            across[k] = sum;
        }
        workgroupBarrier();
    }
    let column = thread % SIDE;
    let row = thread / SIDE;
    if left + column >= call.width || top + row >= call.height {
        return;
    }
    let p = (top + row) * call.width + left + column;
    let pixels = call.width * call.height;
    let target_pixel = truth_of(p);
    let x = picture[channel * pixels + p];
    let t = seen_of(x, target_pixel[channel], weight_of(p, target_pixel.w));
    var g = call.squares_factor * (x - t);
    if call.dssim != 0u {
        let by_x = sum_of(0u, row, column);
        let by_xx = sum_of(1u, row, column);
        let by_xt = sum_of(2u, row, column);
        g += call.dssim_factor * (by_x + 2.0 * x * by_xx + t * by_xt);
    }
    gradient[channel * pixels + p] = select(0.0, g, target_pixel.w > 0.0);
    if channel == 0u {
        gradient[3u * pixels + p] = 0.0;
        gradient[4u * pixels + p] = 0.0;
    }
}
