// Gradients of Σ sh_k Y_k(d) (wgsl/shared/sh.wgsl): cpu/raster/sh_bwd.rs. Reads the binding `sh`
// and writes `d_sh`. Slopes are derivatives of the polynomials; the radial part is removed at the
// end.

// Sums for one direction: the weight ∂L/∂RGB of the coefficients, their gradient per unit of Y,
// and the sums Σ s_k Y_k and Σ s_k ∇Y_k with s_k = ∂L/∂RGB · sh_k.
struct DirectionSums {
    weight: vec3<f32>,
    share: vec3<f32>,
    value: f32,
    slope: vec3<f32>,
}

var<private> direction_sums: DirectionSums;

// Adds function k with its value and slope. `at`: start of the parent's coefficients.
fn add_function(at: u32, k: u32, y: f32, slope: vec3<f32>) {
    let i = at + 3u * k;
    let s = dot(direction_sums.weight, vec3<f32>(sh[i], sh[i + 1u], sh[i + 2u]));
    direction_sums.value += s * y;
    direction_sums.slope += s * slope;
    let d = y * direction_sums.share;
    d_sh[i] += d.x;
    d_sh[i + 1u] += d.y;
    d_sh[i + 2u] += d.z;
}

fn add_degrees_0_to_3(at: u32, degree: u32, mvsplat: bool, d: vec3<f32>) {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    add_function(at, 0u, 0.2820948, vec3<f32>(0.0));
    if degree == 0u {
        return;
    }
    let c1 = 0.48860252;
    add_function(at, 1u, -c1 * y, vec3<f32>(0.0, -c1, 0.0));
    add_function(at, 2u, c1 * z, vec3<f32>(0.0, 0.0, c1));
    add_function(at, 3u, -c1 * x, vec3<f32>(-c1, 0.0, 0.0));
    if degree == 1u {
        return;
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    let a = 1.0925485;
    add_function(at, 4u, a * x * y, a * vec3<f32>(y, x, 0.0));
    add_function(at, 5u, -a * y * z, -a * vec3<f32>(0.0, z, y));
    add_function(at, 6u, 0.31539157 * (2.0 * zz - xx - yy), 0.63078314 * vec3<f32>(-x, -y, 2.0 * z));
    add_function(at, 7u, -a * x * z, -a * vec3<f32>(z, 0.0, x));
    add_function(at, 8u, 0.54627424 * (xx - yy), 1.0925485 * vec3<f32>(x, -y, 0.0));
    if degree == 2u {
        return;
    }
    let f = 0.5900436;
    let h = 0.4570458;
    let w = 4.0 * zz - xx - yy;
    let difference = 3.0 * (xx - yy);
    add_function(at, 9u, -f * y * (3.0 * xx - yy), -f * vec3<f32>(6.0 * x * y, difference, 0.0));
    add_function(at, 10u, 2.8906114 * x * y * z, 2.8906114 * vec3<f32>(y * z, x * z, x * y));
    add_function(at, 11u, -h * y * w, -h * vec3<f32>(-2.0 * x * y, w - 2.0 * yy, 8.0 * y * z));
    let plane = 2.0 * zz - 3.0 * xx - 3.0 * yy;
    add_function(at, 12u, 0.37317634 * z * plane, 0.37317634 * vec3<f32>(-6.0 * x * z, -6.0 * y * z, plane + 4.0 * zz));
    add_function(at, 13u, -h * x * w, -h * vec3<f32>(w - 2.0 * xx, -2.0 * x * y, 8.0 * x * z));
    if mvsplat {
        // z (z² - x²) of the direction before the permutation.
        add_function(at, 14u, 1.4453057 * x * (xx - yy), 1.4453057 * vec3<f32>(3.0 * xx - yy, -2.0 * x * y, 0.0));
    } else {
        add_function(at, 14u, 1.4453057 * z * (xx - yy), 1.4453057 * vec3<f32>(2.0 * x * z, -2.0 * y * z, xx - yy));
    }
    add_function(at, 15u, -f * x * (xx - 3.0 * yy), -f * vec3<f32>(difference, -6.0 * x * y, 0.0));
}

fn add_degree_4(at: u32, d: vec3<f32>) {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    let xy = x * y;
    let p = 3.0 * xx - yy;
    let q = xx - 3.0 * yy;
    let difference = 3.0 * (xx - yy);
    let a = 7.0 * zz - 1.0;
    let b = 7.0 * zz - 3.0;
    let e = 21.0 * zz - 3.0;
    add_function(at, 16u, 2.503343 * xy * (xx - yy), 2.503343 * vec3<f32>(y * p, x * q, 0.0));
    add_function(at, 17u, -1.7701308 * y * z * p, -1.7701308 * vec3<f32>(6.0 * xy * z, z * difference, y * p));
    add_function(at, 18u, 0.9461747 * xy * a, 0.9461747 * vec3<f32>(y * a, x * a, 14.0 * xy * z));
    add_function(at, 19u, -0.6690465 * y * z * b, -0.6690465 * vec3<f32>(0.0, z * b, y * e));
    add_function(at, 20u, 0.10578555 * (zz * (35.0 * zz - 30.0) + 3.0), 0.10578555 * vec3<f32>(0.0, 0.0, z * (140.0 * zz - 60.0)));
    add_function(at, 21u, -0.6690465 * x * z * b, -0.6690465 * vec3<f32>(z * b, 0.0, x * e));
    add_function(at, 22u, 0.47308734 * (xx - yy) * a, 0.47308734 * vec3<f32>(2.0 * x * a, -2.0 * y * a, 14.0 * z * (xx - yy)));
    add_function(at, 23u, -1.7701308 * x * z * q, -1.7701308 * vec3<f32>(z * difference, -6.0 * xy * z, x * q));
    add_function(at, 24u, 0.6258357 * (xx * q - yy * p), 2.5033428 * vec3<f32>(x * q, -y * p, 0.0));
}

// Computes `direction_sums` and adds to the gradient of the parent's coefficients. `towards`
// points from the eye to the splat. The slope is the derivative of the value with respect to
// `towards`.
fn radiance_gradient(at: u32, degree: u32, mvsplat: bool, towards: vec3<f32>, weight: vec3<f32>, share: vec3<f32>) {
    let norm = length(towards);
    var direction = vec3<f32>(0.0);
    if norm > 0.0 && finite(norm) {
        direction = towards / norm;
    }
    let d = select(direction, direction.zxy, mvsplat);
    direction_sums = DirectionSums(weight, share, 0.0, vec3<f32>(0.0));
    add_degrees_0_to_3(at, degree, mvsplat, d);
    if degree > 3u && !mvsplat {
        add_degree_4(at, d);
    }
    let slope = select(direction_sums.slope, direction_sums.slope.yzx, mvsplat);
    direction_sums.slope = (slope - dot(slope, direction) * direction) / max(norm, 1.1754944e-38);
}
