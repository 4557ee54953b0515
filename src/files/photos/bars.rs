//! Black bars at two opposite edges of a picture: of films, and of videos of another shape. They are no part of what the
//! camera saw, so they are masked. A bar at one edge stays: a dark wall or a sky at night may be one, and the centre of
//! the lens would not be that of the picture.

use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;

/// Largest mean and largest single value of a pixel's channels in a bar: a JPEG leaves noise in it.
const BLACK: [f64; 2] = [6.0, 40.0];
/// Least value of the brightest channel of a pixel that is not black.
const BRIGHT: u8 = 28;
/// Least share of such pixels in the first line behind a bar. What is black in a photograph has no straight edge from
/// one side to the other.
const EDGE: f64 = 0.6;
/// Lines between a bar and the picture that scaling has blended, or a JPEG, whose blocks have eight lines.
const BLENDED: usize = 8;
/// Share of the picture's side, and px, above which a bar counts: narrower ones are the frame that a removal of lens
/// distortion leaves, which is filled (`reconstruct/inputs/frame.rs`).
const LEAST: (f64, usize) = (0.01, 4);
/// Largest difference of the two bars, of the picture's side, and px.
const DIFFERENCE: (f64, usize) = (0.01, 3);
/// Widest bars of both sides together, of the picture's side.
const MOST: f64 = 0.8;

/// Widths of the bars of a picture, px, with the blended lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Bars {
    pub top: usize,
    pub bottom: usize,
    pub left: usize,
    pub right: usize,
}

impl Bars {
    /// The mask that leaves them out, and a line that says so; `None` without bars.
    pub fn mask(self, width: usize, height: usize) -> Option<(Mask, String)> {
        let Self { top, bottom, left, right } = self;
        let (columns, rows) = (left..width - right, top..height - bottom);
        let kept = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| columns.contains(&x) && rows.contains(&y))
            .collect();
        let mask = Mask::new(width, height, kept).filter(|mask| !mask.keeps_all())?;
        let sides = [(top, "top"), (bottom, "bottom"), (left, "left"), (right, "right")];
        let named = sides.into_iter().filter(|(px, _)| *px > 0);
        let named: Vec<&str> = named.map(|(_, side)| side).collect();
        let line = format!("black bars at its edges are left out: {}", named.join(", "));
        Some((mask, line))
    }
}

/// Finds the bars of a picture.
pub(super) fn bars(picture: &Rgb) -> Bars {
    let Rgb { width, height, ref data } = *picture;
    let pixel = |x: usize, y: usize| &data[3 * (y * width + x)..][..3];
    let row = |y: usize| Line::of((0..width).map(|x| pixel(x, y)));
    let [top, bottom] = ends(height, row);
    // Columns are judged between the bars above and below.
    let column = |x: usize| Line::of((top..height - bottom).map(|y| pixel(x, y)));
    let [left, right] = ends(width, column);
    Bars { top, bottom, left, right }
}

/// A row or a column of a picture.
struct Line {
    /// All of it is black.
    black: bool,
    /// Share of the pixels that are not.
    bright: f64,
}

impl Line {
    fn of<'p>(pixels: impl Iterator<Item = &'p [u8]>) -> Self {
        let (mut count, mut sum, mut most, mut bright) = (0_u32, 0.0, 0, 0_u32);
        for pixel in pixels {
            let brightest = pixel.iter().copied().max().unwrap_or(0);
            count += 1;
            sum += f64::from(brightest);
            most = most.max(brightest);
            bright += u32::from(brightest >= BRIGHT);
        }
        let count = f64::from(count.max(1));
        let black = sum / count <= BLACK[0] && f64::from(most) <= BLACK[1];
        Self { black, bright: f64::from(bright) / count }
    }
}

/// Widths of the bars at the first and the last of `count` lines.
fn ends(count: usize, line: impl Fn(usize) -> Line) -> [usize; 2] {
    let least = ((count as f64 * LEAST.0) as usize).max(LEAST.1);
    let most = (count as f64 * MOST) as usize;
    let width = |at: &dyn Fn(usize) -> usize| {
        let black = (0..most).take_while(|&i| line(at(i)).black).count();
        if black <= least || black >= most {
            return 0;
        }
        // The first bright line, behind blended ones.
        let behind = (black..=black + BLENDED).find(|&i| i < count && line(at(i)).bright >= EDGE);
        behind.map_or(0, |first| first.max(black + 1))
    };
    let [first, last] = [width(&|i| i), width(&|i| count - 1 - i)];
    let differ = ((count as f64 * DIFFERENCE.0) as usize).max(DIFFERENCE.1);
    let are_two = first > 0 && last > 0 && first.abs_diff(last) <= differ;
    if are_two && first + last <= most { [first, last] } else { [0, 0] }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture with a bright, uneven middle of `columns` by `rows`, else black with a little noise.
    fn picture(
        [width, height]: [usize; 2],
        columns: std::ops::Range<usize>,
        rows: std::ops::Range<usize>,
    ) -> Rgb {
        let value = |x: usize, y: usize| {
            let inside = columns.contains(&x) && rows.contains(&y);
            if inside { 60 + (7 * x + 13 * y) as u8 % 150 } else { ((x + y) % 5) as u8 }
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Rgb { width, height, data: pixels.flat_map(|(x, y)| [value(x, y); 3]).collect() }
    }

    #[test]
    fn bars_of_all_sides_are_found() {
        let size = [200, 120];
        assert_eq!(bars(&picture(size, 0..200, 0..120)), Bars::default());
        // One line beside the bar is left out with it.
        let letterbox = bars(&picture(size, 0..200, 20..101));
        assert_eq!(letterbox, Bars { top: 21, bottom: 20, ..Bars::default() });
        let padded = bars(&picture(size, 0..150, 0..120));
        assert_eq!(padded, Bars::default());
        assert_eq!(bars(&picture(size, 0..200, 10..90)), Bars::default());
        let both = bars(&picture(size, 30..170, 10..110));
        assert_eq!(both, Bars { top: 11, bottom: 11, left: 31, right: 31 });
        let (mask, line) = both.mask(200, 120).unwrap();
        assert_eq!(mask.count(), 138 * 98);
        assert!(line.contains(": top, bottom, left, right"), "{line}");
        assert_eq!(Bars::default().mask(200, 120), None);
        // A blended line between them.
        let mut blended = picture(size, 0..200, 20..100);
        blended.data[3 * 200 * 19..3 * 200 * 20].fill(20);
        assert_eq!(bars(&blended).top, 20);
    }

    #[test]
    fn dark_photographs_have_no_bars() {
        let size = [200, 120];
        // Too narrow; nothing but black; an object on black.
        assert_eq!(bars(&picture(size, 0..200, 2..118)), Bars::default());
        assert_eq!(bars(&picture(size, 0..0, 0..0)), Bars::default());
        let object = picture(size, 60..110, 30..90);
        assert_eq!(bars(&object), Bars::default());
        // A sky at night above uneven roofs, and a dark street.
        let mut roofs = picture(size, 0..200, 40..80);
        for x in 0..200 {
            for y in 40..40 + x % 50 {
                roofs.data[3 * (y * 200 + x)..][..3].fill(2);
            }
        }
        assert_eq!(bars(&roofs), Bars::default());
    }
}
