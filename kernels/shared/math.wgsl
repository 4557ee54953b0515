// What WGSL lacks and a difference of near-equal numbers would lose.

// ln(1 + x), x > -1. Near 0 by the area hyperbolic tangent, ln(1 + x) = 2 artanh(s) with
// s = x / (2 + x): the first term left out is below 1e-8 of the result for |x| < 1/4.
fn ln_1p(x: f32) -> f32 {
    if abs(x) < 0.25 {
        let s = x / (2.0 + x);
        let q = s * s;
        return 2.0 * s * (1.0 + q * (1.0 / 3.0 + q * (0.2 + q * (1.0 / 7.0 + q / 9.0))));
    }
    return log(1.0 + x);
}

// e^x - 1. Near 0 by its series: the first term left out is below 2e-8 of the result for
// |x| < 1/2.
fn exp_m1(x: f32) -> f32 {
    if abs(x) < 0.5 {
        let c6 = 1.0 + x / 7.0 * (1.0 + x / 8.0);
        let c4 = 1.0 + x / 5.0 * (1.0 + x / 6.0 * c6);
        return x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * c4)));
    }
    return exp(x) - 1.0;
}
