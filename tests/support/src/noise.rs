//! A picture of noise.

use subsplat::scene::pictures::Rgb;

/// The generator of tools/make_resize_golden.py.
pub fn noise(width: usize, height: usize) -> Rgb {
    let mut state = 12345u32;
    let data = (0..width * height * 3)
        .map(|i| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let value = (state >> 24) as u8;
            match (i / 3 % 7, value) {
                (0, 128..) => 255,
                (0, _) => 0,
                _ => value,
            }
        })
        .collect();
    Rgb { width, height, data }
}
