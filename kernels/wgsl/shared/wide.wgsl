// 64-bit integers as (low, high) words, and the finaliser of SplitMix64. The dropped attention
// weights equal those of the CPU exactly.

fn wide_add(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2<u32>(low, a.y + b.y + select(0u, 1u, low < a.x));
}

// Returns a·b of two words, from 16-bit halves.
fn wide_product(a: u32, b: u32) -> vec2<u32> {
    let a0 = a & 0xffffu;
    let a1 = a >> 16u;
    let b0 = b & 0xffffu;
    let b1 = b >> 16u;
    let low = a0 * b0;
    let mid = a1 * b0 + (low >> 16u);
    let cross = a0 * b1 + (mid & 0xffffu);
    return vec2<u32>((cross << 16u) | (low & 0xffffu), a1 * b1 + (mid >> 16u) + (cross >> 16u));
}

// Returns a·b modulo 2^64.
fn wide_times(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = wide_product(a.x, b.x);
    return vec2<u32>(low.x, low.y + a.x * b.y + a.y * b.x);
}

// Returns a >> n, 0 < n < 32.
fn wide_shift(a: vec2<u32>, n: u32) -> vec2<u32> {
    return vec2<u32>((a.x >> n) | (a.y << (32u - n)), a.y >> n);
}

fn wide_less(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.y < b.y || (a.y == b.y && a.x < b.x);
}

fn splitmix(seed: vec2<u32>) -> vec2<u32> {
    var z = wide_add(seed, vec2<u32>(0x7F4A7C15u, 0x9E3779B9u));
    z = wide_times(z ^ wide_shift(z, 30u), vec2<u32>(0x1CE4E5B9u, 0xBF58476Du));
    z = wide_times(z ^ wide_shift(z, 27u), vec2<u32>(0x133111EBu, 0x94D049BBu));
    return z ^ wide_shift(z, 31u);
}
