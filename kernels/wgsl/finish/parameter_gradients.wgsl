// Gradients of the loss of a photograph by the parameters that move, from those by the Gaussians' numbers.
// CPU version: cpu/parameters.rs (gradients), and `Optimiser::gather` of the crate subsplat.
//
// Input: rows [N, 11]; gradients by the rows, by SH sets [N, D, 3] and by gains [N, 4]; by the rows of the
// picture across, which count by the weight `call.across` where it is not 0; origin: size of a pixel at each
// Gaussian [N], 1 where only the colours move [N], then the numbers before the phase. Output: gradient
// [E, N], added to the one before where `call.adds` is 1. Those of a Gaussian that are not all finite
// count as 0. One thread per Gaussian.

@group(0) @binding(0) var<uniform> call: OptimiseUniform;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> d_rows: array<f32>;
@group(0) @binding(3) var<storage, read> d_sh: array<f32>;
@group(0) @binding(4) var<storage, read> d_gain: array<f32>;
@group(0) @binding(5) var<storage, read> d_across: array<f32>;
@group(0) @binding(6) var<storage, read> origin: array<f32>;
@group(0) @binding(7) var<storage, read_write> gradient: array<f32>;

// Returns the slope of the drawn opacity of Gaussian i by its own: 1 - α' = (1 - α)^d, d = `denser`.
fn slope_of_drawn(i: u32) -> f32 {
    if call.denser == 0.0 {
        return 1.0;
    }
    if is_left_out(i) {
        return 0.0;
    }
    let free = 1.0 - rows[i * SPLAT_STRIDE + OPACITY_OFFSET];
    return call.denser * pow(free, call.denser) / free;
}

// Returns the gradient by element e of a parameter, from `by`, that by the element's number.
fn chain(form: u32, i: u32, number: u32, by: f32) -> f32 {
    let value = rows[i * SPLAT_STRIDE + number];
    switch form {
        case FORM_LOGIT: { return by * slope_of_drawn(i) * value * (1.0 - value); }
        case FORM_FACTOR: { return by * value; }
        case FORM_PIXEL_OFFSET: { return by * origin[i]; }
        default: { return by; }
    }
}

// Returns the gradient by element e of a parameter of the rows, from gradients `d_rows` or `d_across`.
fn by_rows(form: u32, i: u32, number: u32, across: bool) -> f32 {
    let at = i * SPLAT_STRIDE + number;
    if form != FORM_COMMON_FACTOR {
        return chain(form, i, number, select(d_rows[at], d_across[at], across));
    }
    var sum = 0.0;
    for (var k = 0u; k < 3u; k++) {
        sum += select(d_rows[at + k], d_across[at + k], across) * rows[at + k];
    }
    return sum;
}

// Returns the gradient by element e of a parameter: buffer, first number, form.
fn element(parameter: vec4<u32>, i: u32, e: u32) -> f32 {
    let number = parameter.y + e;
    switch parameter.x {
        case BUFFER_GAIN: { return d_gain[4u * i + number]; }
        case BUFFER_SH: { return moving(i, d_sh[i * call.sh_stride + number]); }
        default: {
            var g = by_rows(parameter.z, i, number, false);
            if call.across != 0.0 {
                g += call.across * by_rows(parameter.z, i, number, true);
            }
            return moving(i, g);
        }
    }
}

// Returns a gradient of Gaussian i, or 0 where only its colour offsets move.
fn moving(i: u32, g: f32) -> f32 {
    return select(g, 0.0, origin[call.count + i] != 0.0);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = workgroup_number(workgroup, workgroups) * 64u + thread;
    if i >= call.count {
        return;
    }
    var own: array<f32, PARAMETERS_MAX * ELEMENTS_MAX>;
    var all_finite = true;
    var count = 0u;
    for (var m = 0u; m < call.moves; m++) {
        let parameter = call.parameters[m];
        for (var e = 0u; e < elements_of(parameter.z); e++) {
            own[count] = element(parameter, i, e);
            all_finite = all_finite && finite(own[count]);
            count++;
        }
    }
    for (var e = 0u; e < count; e++) {
        let at = e * call.count + i;
        var g = select(0.0, own[e], all_finite);
        if call.adds != 0u {
            g += gradient[at];
        }
        gradient[at] = g;
    }
}
