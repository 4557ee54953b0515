// A function of one or two arrays, element by element, or a copy of one; each array has strides
// and an offset, so that this kernel also reorders, cuts, joins and repeats. CPU version:
// cpu/activation.rs and tensor operations.

// x, factor * x + offset, |x|, x^2, 1 / x, clamp(x), the four operations of two numbers, an
// activation, the square root, x where y is above a number and else another. Gradients: x times the
// slope of an activation at y, x with its sign changed where y < 0, x where y lies between two numbers
// and else 0.
const COPY: u32 = 0u;
const AFFINE: u32 = 1u;
const ABSOLUTE: u32 = 2u;
const SQUARE: u32 = 3u;
const RECIPROCAL: u32 = 4u;
const CLAMP: u32 = 5u;
const PLUS: u32 = 6u;
const MINUS: u32 = 7u;
const TIMES: u32 = 8u;
const OVER: u32 = 9u;
const ACTIVATION: u32 = 10u;
const SQUARE_ROOT: u32 = 11u;
const WHERE_ABOVE: u32 = 12u;
const SLOPE: u32 = 13u;
const SIGNED: u32 = 14u;
const WITHIN: u32 = 15u;

override FUNCTION: u32 = 0u;
override ACTIVATION_KIND: u32 = 0u;
// An activation function of the results.
override AFTER_KIND: u32 = 0u;

@group(0) @binding(0) var<uniform> call: ElementwiseUniform;
@group(0) @binding(1) var<storage, read> left: array<f32>;
@group(0) @binding(2) var<storage, read> right: array<f32>;
@group(0) @binding(3) var<storage, read_write> result: array<f32>;

fn value(i: u32, j: u32) -> f32 {
    let x = left[i];
    switch FUNCTION {
        case AFFINE: { return call.first * x + call.second; }
        case ABSOLUTE: { return abs(x); }
        case SQUARE: { return x * x; }
        case RECIPROCAL: { return 1.0 / x; }
        // These comparisons keep NaN.
        case CLAMP: {
            return select(select(x, call.second, x > call.second), call.first, x < call.first);
        }
        case PLUS: { return x + right[j]; }
        case MINUS: { return x - right[j]; }
        case TIMES: { return x * right[j]; }
        case OVER: { return x / right[j]; }
        case WHERE_ABOVE: { return select(call.second, x, right[j] > call.first); }
        case SLOPE: { return x * activation_slope(ACTIVATION_KIND, right[j]); }
        case SIGNED: { return select(x, -x, right[j] < 0.0); }
        case WITHIN: {
            return select(0.0, x, right[j] >= call.first && right[j] <= call.second);
        }
        case SQUARE_ROOT: { return sqrt(x); }
        case ACTIVATION: { return activation(ACTIVATION_KIND, x); }
        default: { return x; }
    }
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
    var rest = i;
    var at = vec3<u32>(call.left[1].w, call.right[1].w, call.result[1].w);
    for (var axis = 7u; axis > 7u - call.axes; axis--) {
        let block = (axis - 1u) / 4u;
        let lane = (axis - 1u) % 4u;
        let size = call.sizes[block][lane];
        let index = rest % size;
        rest /= size;
        at += index * vec3<u32>(
            call.left[block][lane],
            call.right[block][lane],
            call.result[block][lane],
        );
    }
    result[at.z] = activation(AFTER_KIND, value(at.x, at.y));
}
