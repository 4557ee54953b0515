//! Bars at two opposite edges of a picture: black ones of films and of videos of another shape, and those of another
//! colour, with which programs fill a picture up. They are no part of what the camera saw, so they are masked. A bar at one
//! edge stays: a dark wall, a sky at night or a white one may be one, and the centre of the lens would not be that of the
//! picture. Both bars have one colour. The 210 pictures of `../shared/photos` and `../shared/demo`, which have white skies
//! and plain walls, have none.

use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;

/// Largest mean and largest single difference of a pixel's channels from the colour of a bar: a JPEG leaves noise in it.
const BLACK: [f64; 2] = [6.0, 40.0];
/// The same of a bar of another colour: walls and skies are less even.
const COLOURED: [f64; 2] = [1.5, 24.0];
/// Least difference of a channel of a pixel that does not belong to a bar.
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
    /// One of them is not black.
    pub coloured: bool,
}

impl Bars {
    /// The mask that leaves them out, and a line that says so; `None` without bars.
    pub fn mask(self, width: usize, height: usize) -> Option<(Mask, String)> {
        let Self { top, bottom, left, right, coloured } = self;
        let (columns, rows) = (left..width - right, top..height - bottom);
        let kept = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| columns.contains(&x) && rows.contains(&y))
            .collect();
        let mask = Mask::new(width, height, kept).filter(|mask| !mask.keeps_all())?;
        let sides = [(top, "top"), (bottom, "bottom"), (left, "left"), (right, "right")];
        let named = sides.into_iter().filter(|(px, _)| *px > 0);
        let named: Vec<&str> = named.map(|(_, side)| side).collect();
        let kind = if coloured { "bars of one colour" } else { "black bars" };
        let line = format!("{kind} at its edges are left out: {}", named.join(", "));
        Some((mask, line))
    }
}

/// Finds the bars of a picture.
pub(super) fn bars(picture: &Rgb) -> Bars {
    let Rgb { width, height, ref data } = *picture;
    let pixel = |x: usize, y: usize| &data[3 * (y * width + x)..][..3];
    let row = |y: usize, colour| Line::of((0..width).map(|x| pixel(x, y)), colour);
    let rows = Ends::of(height, &row, || mean((0..width).map(|x| pixel(x, 0))));
    let [top, bottom] = rows.widths;
    // Columns are judged between the bars above and below.
    let between = || top..height - bottom;
    let column = |x: usize, colour| Line::of(between().map(|y| pixel(x, y)), colour);
    let columns = Ends::of(width, &column, || mean(between().map(|y| pixel(0, y))));
    let [left, right] = columns.widths;
    Bars { top, bottom, left, right, coloured: rows.coloured || columns.coloured }
}

/// Mean colour of pixels.
fn mean<'p>(pixels: impl Iterator<Item = &'p [u8]>) -> [u8; 3] {
    let (mut sum, mut count) = ([0_u32; 3], 0);
    for pixel in pixels {
        (0..3).for_each(|c| sum[c] += u32::from(pixel[c]));
        count += 1;
    }
    sum.map(|v| u8::try_from((v + count / 2) / count.max(1)).unwrap_or(u8::MAX))
}

/// A row or a column of a picture beside a colour.
struct Line {
    /// All of it has the colour, within the limits of black, and of another colour.
    is_bar: [bool; 2],
    /// Share of the pixels that have another one.
    other: f64,
}

impl Line {
    fn of<'p>(pixels: impl Iterator<Item = &'p [u8]>, colour: [u8; 3]) -> Self {
        let (mut count, mut sum, mut most, mut other) = (0_u32, 0.0, 0, 0_u32);
        for pixel in pixels {
            let off = pixel.iter().zip(colour).map(|(v, c)| v.abs_diff(c)).max().unwrap_or(0);
            count += 1;
            sum += f64::from(off);
            most = most.max(off);
            other += u32::from(off >= BRIGHT);
        }
        let count = f64::from(count.max(1));
        let within = |[mean, single]: [f64; 2]| sum / count <= mean && f64::from(most) <= single;
        Self { is_bar: [BLACK, COLOURED].map(within), other: f64::from(other) / count }
    }
}

/// Bars at the first and the last of several lines.
#[derive(Default)]
struct Ends {
    /// Widths in lines.
    widths: [usize; 2],
    /// They are not black.
    coloured: bool,
}

impl Ends {
    /// Those of `count` lines that are black, else those with the `colour` of the first line.
    fn of(
        count: usize,
        line: &dyn Fn(usize, [u8; 3]) -> Line,
        colour: impl Fn() -> [u8; 3],
    ) -> Self {
        let black = ends(count, BLACK_BAR, |i| line(i, [0; 3]));
        if black != [0, 0] {
            return Self { widths: black, coloured: false };
        }
        let colour = colour();
        let widths = ends(count, COLOURED_BAR, |i| line(i, colour));
        Self { widths, coloured: widths != [0, 0] }
    }
}

/// Places in [`Line::is_bar`].
const BLACK_BAR: usize = 0;
const COLOURED_BAR: usize = 1;

/// Widths of the bars of a kind at the first and the last of `count` lines.
fn ends(count: usize, kind: usize, line: impl Fn(usize) -> Line) -> [usize; 2] {
    let least = ((count as f64 * LEAST.0) as usize).max(LEAST.1);
    let most = (count as f64 * MOST) as usize;
    let width = |at: &dyn Fn(usize) -> usize| {
        let own = (0..most).take_while(|&i| line(at(i)).is_bar[kind]).count();
        if own <= least || own >= most {
            return 0;
        }
        // The first line of the picture, behind blended ones.
        let behind = (own..=own + BLENDED).find(|&i| i < count && line(at(i)).other >= EDGE);
        behind.map_or(0, |first| first.max(own + 1))
    };
    let first = width(&|i| i);
    let last = if first > 0 { width(&|i| count - 1 - i) } else { 0 };
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
        assert_eq!(both, Bars { top: 11, bottom: 11, left: 31, right: 31, coloured: false });
        let (mask, line) = both.mask(200, 120).unwrap();
        assert_eq!(mask.count(), 138 * 98);
        assert!(line.contains(": top, bottom, left, right"), "{line}");
        assert_eq!(Bars::default().mask(200, 120), None);
        // A blended line between them.
        let mut blended = picture(size, 0..200, 20..100);
        blended.data[3 * 200 * 19..3 * 200 * 20].fill(20);
        assert_eq!(bars(&blended).top, 20);
    }

    /// [`picture`] with the values of `outside` in place of its black.
    fn surrounded(
        size: [usize; 2],
        columns: std::ops::Range<usize>,
        rows: std::ops::Range<usize>,
        outside: impl Fn(usize, usize) -> u8,
    ) -> Rgb {
        let mut made = picture(size, columns.clone(), rows.clone());
        for (i, pixel) in made.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % size[0], i / size[0]);
            if !(columns.contains(&x) && rows.contains(&y)) {
                pixel.fill(outside(x, y));
            }
        }
        made
    }

    #[test]
    fn bars_of_another_colour_are_found() {
        let size = [200, 120];
        for colour in [255, 230, 40] {
            let letterbox = bars(&surrounded(size, 0..200, 20..100, |x, _| {
                (colour - u8::from(x % 3 == 0)).max(1)
            }));
            let expected = Bars { top: 21, bottom: 21, coloured: true, ..Bars::default() };
            assert_eq!(letterbox.top, letterbox.bottom, "{colour}");
            assert!(letterbox.top >= 20 && letterbox.coloured, "{colour} {letterbox:?}");
            assert_eq!(letterbox.left, expected.left);
        }
        let frame = bars(&surrounded(size, 30..170, 10..110, |_, _| 255));
        assert_eq!(frame, Bars { top: 11, bottom: 11, left: 31, right: 31, coloured: true });
        assert!(frame.mask(200, 120).unwrap().1.starts_with("bars of one colour"));
        // One edge, two colours, an uneven sky, and an object before white.
        let none = [
            surrounded(size, 0..200, 20..120, |_, _| 255),
            surrounded(size, 0..200, 20..100, |_, y| if y < 60 { 255 } else { 190 }),
            surrounded(size, 0..200, 20..100, |x, y| 235 + ((x + y) % 20) as u8),
            surrounded(size, 60..110, 30..90, |_, _| 255),
        ];
        none.iter().for_each(|picture| assert_eq!(bars(picture), Bars::default()));
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
