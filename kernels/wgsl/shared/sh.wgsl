// Colour of a splat from one direction, Σ sh_k Y_k(d): cpu/raster/sh.rs. Reads the binding `sh`; the
// coefficients [D, 3] of a set begin at `at`.

fn coefficient(at: u32, k: u32) -> vec3<f32> {
    let i = at + 3u * k;
    return vec3<f32>(sh[i], sh[i + 1u], sh[i + 2u]);
}

fn radiance(at: u32, degree: u32, mvsplat: bool, direction: vec3<f32>) -> vec3<f32> {
    // MVSplat's rasterizer evaluates the standard functions at (z, x, y).
    let d = select(direction, direction.zxy, mvsplat);
    let x = d.x;
    let y = d.y;
    let z = d.z;
    var sum = 0.2820948 * coefficient(at, 0u);
    if degree == 0u {
        return sum;
    }
    sum -= 0.48860252 * y * coefficient(at, 1u);
    sum += 0.48860252 * z * coefficient(at, 2u);
    sum -= 0.48860252 * x * coefficient(at, 3u);
    if degree == 1u {
        return sum;
    }
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    let xy = x * y;
    let yz = y * z;
    let xz = x * z;
    sum += 1.0925485 * xy * coefficient(at, 4u);
    sum -= 1.0925485 * yz * coefficient(at, 5u);
    sum += 0.31539157 * (2.0 * zz - xx - yy) * coefficient(at, 6u);
    sum -= 1.0925485 * xz * coefficient(at, 7u);
    sum += 0.54627424 * (xx - yy) * coefficient(at, 8u);
    if degree == 2u {
        return sum;
    }
    sum -= 0.5900436 * y * (3.0 * xx - yy) * coefficient(at, 9u);
    sum += 2.8906114 * xy * z * coefficient(at, 10u);
    sum -= 0.4570458 * y * (4.0 * zz - xx - yy) * coefficient(at, 11u);
    sum += 0.37317634 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(at, 12u);
    sum -= 0.4570458 * x * (4.0 * zz - xx - yy) * coefficient(at, 13u);
    // MVSplat's function 14 is z (z² - x²) of the direction before the permutation.
        let f14 = select(z * (xx - yy), direction.z * (direction.z * direction.z - direction.x * direction.x), mvsplat);
    sum += 1.4453057 * f14 * coefficient(at, 14u);
    sum -= 0.5900436 * x * (xx - 3.0 * yy) * coefficient(at, 15u);
    if degree == 3u || mvsplat {
        return sum;
    }
    sum += 2.503343 * xy * (xx - yy) * coefficient(at, 16u);
    sum -= 1.7701308 * yz * (3.0 * xx - yy) * coefficient(at, 17u);
    sum += 0.9461747 * xy * (7.0 * zz - 1.0) * coefficient(at, 18u);
    sum -= 0.6690465 * yz * (7.0 * zz - 3.0) * coefficient(at, 19u);
    sum += 0.10578555 * (zz * (35.0 * zz - 30.0) + 3.0) * coefficient(at, 20u);
    sum -= 0.6690465 * xz * (7.0 * zz - 3.0) * coefficient(at, 21u);
    sum += 0.47308734 * (xx - yy) * (7.0 * zz - 1.0) * coefficient(at, 22u);
    sum -= 1.7701308 * xz * (xx - 3.0 * yy) * coefficient(at, 23u);
    sum += 0.6258357 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * coefficient(at, 24u);
    return sum;
}
