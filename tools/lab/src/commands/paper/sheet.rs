//! Pictures of a figure: the methods side by side, whole and as a window of the busiest part.

use crate::eval::busiest;
use subsplat::files::photos::resize::{Filter, resize};
use subsplat::scene::pictures::Rgb;
use subsplat_cli::lettering;

/// Side of a cell, px.
const CELL: usize = 256;
/// Gap between cells, px.
const GAP: usize = 6;
/// Dot of the labels, px.
const DOT: usize = 2;
/// Most characters of a line of a label.
const LETTERS: usize = CELL / (DOT * lettering::ADVANCE);
/// Lines of a label.
const LINES: usize = 2;
/// Height of a label, px.
const LABEL: usize = LINES * (DOT * (lettering::HEIGHT + 1)) + GAP;
/// Colour of labels and of the window's outline.
const INK: [u8; 3] = [255, 210, 60];
/// Share of the picture's side that a window shows.
const WINDOW_SHARE: usize = 4;

/// Pictures of one target.
pub struct Scene {
    /// Name of the scene.
    pub name: String,
    /// The input that is shown.
    pub input: Rgb,
    /// The photograph.
    pub truth: Rgb,
    /// Row, label and picture of each method.
    pub methods: Vec<(usize, String, Rgb)>,
}

impl Scene {
    /// Joins the pictures: above the whole pictures with their labels, below a window of each.
    pub fn sheet(&self) -> Rgb {
        let side = self.truth.width.min(self.truth.height);
        let (left, top, size, _) = busiest(&self.truth, (side / WINDOW_SHARE).max(1));
        let mut columns = vec![("input".to_owned(), &self.input, None)];
        let target = Some((left, top, size));
        let mut methods: Vec<_> = self.methods.iter().collect();
        methods.sort_by_key(|(row, ..)| *row);
        columns.extend(methods.iter().map(|(_, label, p)| (label.clone(), p, target)));
        columns.push(("photograph".to_owned(), &self.truth, target));
        let mut sheet = Rgb::black(columns.len() * (CELL + GAP), LABEL + 2 * CELL + GAP);
        for (i, (label, picture, window)) in columns.iter().enumerate() {
            let left = i * (CELL + GAP);
            for (line, text) in lines(label).iter().enumerate() {
                let y = line * DOT * (lettering::HEIGHT + 1) + DOT;
                lettering::write(&mut sheet, (left, y), DOT, INK, text);
            }
            let mut whole = scaled(picture);
            if let Some((x, y, size)) = window {
                let at = |v: usize| v * CELL / picture.width.max(1);
                outline(&mut whole, at(*x), at(*y), at(*size));
                if let Some(part) = picture.window(*x, *y, *size, *size) {
                    paste(&mut sheet, &enlarged(&part), (left, LABEL + CELL + GAP));
                }
            }
            paste(&mut sheet, &whole, (left, LABEL));
        }
        sheet
    }
}

/// Splits a label into lines that fit a cell.
fn lines(label: &str) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in label.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.is_empty() => *line = word.to_owned(),
            Some(line) if line.len() + 1 + word.len() <= LETTERS => *line += &format!(" {word}"),
            _ => lines.push(word.to_owned()),
        }
    }
    lines.truncate(LINES);
    lines
}

/// The picture with sides of a cell.
fn scaled(picture: &Rgb) -> Rgb {
    resize(picture, CELL, CELL, Filter::Lanczos)
}

/// A window with sides of a cell, its pixels as squares.
fn enlarged(part: &Rgb) -> Rgb {
    let mut cell = Rgb::black(CELL, CELL);
    for y in 0..CELL {
        for x in 0..CELL {
            let from = 3 * (y * part.height / CELL * part.width + x * part.width / CELL);
            let to = 3 * (y * CELL + x);
            cell.data[to..to + 3].copy_from_slice(&part.data[from..from + 3]);
        }
    }
    cell
}

fn outline(picture: &mut Rgb, left: usize, top: usize, side: usize) {
    for i in 0..=side {
        for (x, y) in [(i, 0), (i, side), (0, i), (side, i)] {
            lettering::set_pixel(picture, left + x, top + y, INK);
        }
    }
}

/// Copies `part` to a place of `sheet`, row by row.
pub fn paste(sheet: &mut Rgb, part: &Rgb, (left, top): (usize, usize)) {
    let width = part.width.min(sheet.width.saturating_sub(left));
    for y in 0..part.height.min(sheet.height.saturating_sub(top)) {
        let from = 3 * y * part.width;
        let to = 3 * ((top + y) * sheet.width + left);
        sheet.data[to..to + 3 * width].copy_from_slice(&part.data[from..from + 3 * width]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheets_hold_each_picture_and_its_window() {
        let truth = {
            let mut truth = Rgb::black(160, 160);
            // Detail in the lower right corner alone.
            for (y, x) in (120..160).flat_map(|y| (120..160).map(move |x| (y, x))) {
                truth.data[3 * (y * 160 + x)] = if (x + y) % 2 == 0 { 255 } else { 0 };
            }
            truth
        };
        let mut green = Rgb::black(160, 160);
        green.data.chunks_exact_mut(3).for_each(|p| p[1] = 200);
        let methods = vec![(0, "a method of a long long name, which is cut".to_owned(), green)];
        let scene = Scene { name: "s".to_owned(), input: Rgb::black(80, 80), truth, methods };
        let sheet = scene.sheet();
        assert_eq!((sheet.width, sheet.height), (3 * (CELL + GAP), LABEL + 2 * CELL + GAP));
        let at = |x: usize, y: usize| {
            let i = 3 * (y * sheet.width + x);
            [sheet.data[i], sheet.data[i + 1], sheet.data[i + 2]]
        };
        let second = CELL + GAP;
        assert_eq!(at(second + 10, LABEL + 10), [0, 200, 0]);
        assert_eq!(at(second + 10, LABEL + CELL + GAP + 10), [0, 200, 0]);
        // The window of the photograph shows the corner; the input has none.
        let bright = |left: usize| {
            let xs = (0..CELL).step_by(3).map(|x| at(left + x, LABEL + CELL + GAP + 200)[0]);
            xs.filter(|v| *v == 255).count()
        };
        assert!(bright(2 * second) > 20, "{}", bright(2 * second));
        assert_eq!(bright(0), 0);
        assert_eq!(lines("+ feature aggregation (SubSplat) 25.12").len(), 2);
    }
}
