//! The formula of `tools/witness/formula.py` in Rust. The Python file states it.

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// `count` numbers in (0, 1).
fn uniform(seed: u64, name: &str, count: usize) -> impl Iterator<Item = f64> + use<> {
    let hash = name
        .bytes()
        .fold(0xCBF2_9CE4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01B3));
    let key = hash ^ mix(seed);
    (1..=count as u64).map(move |i| {
        let word = mix(key.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15)));
        ((word >> 40) as f64 + 0.5) / f64::from(1 << 24)
    })
}

/// The elements of weight `name`.
pub fn weight(seed: u64, name: &str, shape: &[usize]) -> Vec<f32> {
    let fan_in: usize = shape.iter().skip(1).product();
    let scale = (3.0 / fan_in as f64).sqrt();
    let value = |u: f64| match shape.len() {
        2.. => u * scale,
        1 if name.ends_with(".weight") => 1.0 + u / 4.0,
        1 if name.ends_with(".bias") => u / 10.0,
        _ => u / 4.0,
    };
    let count = shape.iter().product();
    uniform(seed, name, count).map(|p| value(2.0 * p - 1.0) as f32).collect()
}

/// The elements of input `name`, uniform in (low, high).
pub fn drawn(seed: u64, name: &str, count: usize, [low, high]: [f64; 2]) -> Vec<f32> {
    uniform(seed, name, count).map(|p| (low + (high - low) * p) as f32).collect()
}
