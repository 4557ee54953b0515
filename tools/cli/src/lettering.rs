//! Short labels in pictures: capital letters, digits, point and hyphen of 3×5 dots.

use subsplat::Rgb;

/// Height of a character, dots.
pub const HEIGHT: usize = 5;
/// Width of a character with the gap after it, dots.
pub const ADVANCE: usize = 4;

/// Rows of the digits, then of the letters, as octal digits of three dots each.
const GLYPHS: [u16; 36] = [
    0o75557, 0o26227, 0o71747, 0o71717, 0o55711, 0o74717, 0o74757, 0o71111, 0o75757, 0o75717,
    0o25755, 0o65656, 0o34443, 0o65556, 0o74647, 0o74644, 0o34553, 0o55755, 0o72227, 0o11152,
    0o55655, 0o44447, 0o57755, 0o65555, 0o25552, 0o65644, 0o25573, 0o65655, 0o34216, 0o72222,
    0o55557, 0o55552, 0o55775, 0o55255, 0o55222, 0o71247,
];
const POINT: u16 = 0o00002;
const HYPHEN: u16 = 0o00700;

fn glyph(c: char) -> u16 {
    match (c, c.to_digit(36)) {
        (_, Some(index)) => GLYPHS[index as usize],
        ('.', _) => POINT,
        ('-', _) => HYPHEN,
        _ => 0,
    }
}

/// Sets a pixel; one outside the picture is left out.
pub fn set_pixel(picture: &mut Rgb, x: usize, y: usize, rgb: [u8; 3]) {
    if x < picture.width && y < picture.height {
        let at = 3 * (y * picture.width + x);
        picture.data[at..at + 3].copy_from_slice(&rgb);
    }
}

/// Writes `text` in capitals, its upper left corner at (`left`, `top`), with dots of `scale` px a
/// side. Other characters than letters, digits, point and hyphen leave a gap.
pub fn write(
    picture: &mut Rgb,
    (left, top): (usize, usize),
    scale: usize,
    ink: [u8; 3],
    text: &str,
) {
    for (i, c) in text.chars().enumerate() {
        let glyph = glyph(c);
        for dot in (0..15).filter(|dot| glyph >> (14 - dot) & 1 == 1) {
            let x = left + scale * (ADVANCE * i + dot % 3);
            let y = top + scale * (dot / 3);
            for (dx, dy) in (0..scale).flat_map(|dx| (0..scale).map(move |dy| (dx, dy))) {
                set_pixel(picture, x + dx, y + dy, ink);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn characters_have_their_dots() {
        let mut picture = Rgb::black(24, 7);
        write(&mut picture, (1, 1), 1, [255; 3], "Hi.2-?");
        let row = |y: usize| -> String {
            let at = |x: usize| picture.data[3 * (y * 24 + x)];
            (0..24).map(|x| if at(x) > 0 { '#' } else { '.' }).collect()
        };
        assert_eq!(row(0), ".".repeat(24));
        assert_eq!(row(1), ".#.#.###.....###........");
        assert_eq!(row(3), ".###..#......###.###....");
        assert_eq!(row(5), ".#.#.###..#..###........");
        // Dots of two pixels; what does not fit is cut off.
        write(&mut picture, (20, 0), 2, [9; 3], "L");
        let at = |x: usize, y: usize| picture.data[3 * (y * 24 + x)];
        assert_eq!([at(20, 0), at(21, 6), at(22, 2)], [9, 9, 0]);
    }
}
