// Activation functions. CPU version: cpu/activation.rs.

const ACTIVATION_NONE: u32 = 0u;
const ACTIVATION_RELU: u32 = 1u;
const ACTIVATION_SILU: u32 = 2u;
const ACTIVATION_GELU: u32 = 3u;
const ACTIVATION_SIGMOID: u32 = 4u;

// Returns 1 / (1 + e^-x).
fn sigmoid(x: f32) -> f32 {
    let e = exp(-abs(x));
    return select(e, 1.0, x >= 0.0) / (1.0 + e);
}

// Returns the error function to 4 units in the last place: an odd rational approximation on
// |x| <= 4, 1 beyond.
fn erf(argument: f32) -> f32 {
    let x = clamp(argument, -4.0, 4.0);
    let z = x * x;
    var p = z * -2.7261423e-10 + 2.7706814e-8;
    p = p * z - 2.101024e-6;
    p = p * z - 5.6925064e-5;
    p = p * z - 7.3499063e-4;
    p = p * z - 2.9546e-3;
    p = p * z - 1.6096034e-2;
    var q = z * -1.4566072e-5 - 2.1337406e-4;
    q = q * z - 1.682827e-3;
    q = q * z - 7.373329e-3;
    q = q * z - 1.4264739e-2;
    return x * p / q;
}

// Returns the activation `kind` of x.
fn activation(kind: u32, x: f32) -> f32 {
    switch kind {
        case ACTIVATION_RELU: { return select(x, 0.0, x < 0.0); }
        case ACTIVATION_SILU: { return x * sigmoid(x); }
        case ACTIVATION_GELU: { return 0.5 * x * (1.0 + erf(x * 0.7071067811865476)); }
        case ACTIVATION_SIGMOID: { return sigmoid(x); }
        default: { return x; }
    }
}

// Returns the derivative of the activation `kind` at x.
fn activation_slope(kind: u32, x: f32) -> f32 {
    switch kind {
        case ACTIVATION_RELU: { return select(0.0, 1.0, x > 0.0); }
        case ACTIVATION_SILU: {
            let s = sigmoid(x);
            return s * (1.0 + x * (1.0 - s));
        }
        case ACTIVATION_GELU: {
            // The density of the normal distribution.
            let density = 0.3989422804014327 * exp(-0.5 * x * x);
            return 0.5 * (1.0 + erf(x * 0.7071067811865476)) + x * density;
        }
        case ACTIVATION_SIGMOID: {
            let s = sigmoid(x);
            return s * (1.0 - s);
        }
        default: { return 1.0; }
    }
}
