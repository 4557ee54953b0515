// Functions that WGSL lacks, without cancellation between near-equal numbers.

// Returns ln(1 + x), x > -1. For |x| < 1/4: ln(1 + x) = 2 artanh(s) with s = x / (2 + x); the
// first omitted term is below 1e-8 of the result.
fn ln_1p(x: f32) -> f32 {
    if abs(x) < 0.25 {
        let s = x / (2.0 + x);
        let q = s * s;
        return 2.0 * s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q / 9.0))));
    }
    return log(1.0 + x);
}

// Returns e^x - 1. For |x| < 1/2 by the Taylor series; the first omitted term is below 2e-8 of
// the result.
fn exp_m1(x: f32) -> f32 {
    if abs(x) < 0.5 {
        let c6 = 1.0 + x / 7.0 * (1.0 + x / 8.0);
        let c4 = 1.0 + x / 5.0 * (1.0 + x / 6.0 * c6);
        return x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * c4)));
    }
    return exp(x) - 1.0;
}

// Returns the hyperbolic tangent. WGSL's tanh may overflow or lose small arguments.
fn tanh_of(x: f32) -> f32 {
    let e = exp_m1(-2.0 * abs(x));
    return sign(x) * (-e / (e + 2.0));
}

// Returns sine and cosine of x, radians; WGSL's functions may be off by 5e-4. Reduction by pi/2
// in three parts, then the polynomials of Cephes: error 1e-7 for |x| < 1000.
fn sin_cos(x: f32) -> vec2<f32> {
    let n = round(x * 0.636619772);
    let r = ((x - n * 1.5703125) - n * 4.837512969970703e-4) - n * 7.549789954891882e-8;
    let z = r * r;
    let s = r + r * z * (-1.6666654611e-1 + z * (8.3321608736e-3 - z * 1.9515295891e-4));
    let c = 1.0 - 0.5 * z
        + z * z * (4.166664568298827e-2 + z * (-1.388731625493765e-3 + z * 2.443315711809948e-5));
    let quarter = i32(n) & 3;
    let swapped = select(vec2<f32>(s, c), vec2<f32>(c, s), (quarter & 1) == 1);
    let signs = vec2<f32>(
        select(1.0, -1.0, quarter >= 2),
        select(1.0, -1.0, quarter == 1 || quarter == 2),
    );
    return swapped * signs;
}
