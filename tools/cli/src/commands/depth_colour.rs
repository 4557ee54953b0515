//! Depth as a colour picture with a legend, to be looked at: near is red, far is blue.
//!
//! The 16-bit picture beside it holds the numbers. Colours are Google's Turbo (polynomial of Mikhailov,
//! 2019), which keeps order in brightness at both ends and shows small steps.

use crate::lettering::{HEIGHT, set_pixel, write};
use subsplat::scene::pictures::{Depth, Rgb};

/// Ends of the scale: quantiles of the depths that exist.
const ENDS: [f64; 2] = [0.02, 0.98];
/// Labels of the legend.
const LABELS: usize = 5;
/// Width of the legend and of its bar, px at scale 1.
const LEGEND: usize = 46;
const BAR: usize = 8;
const MARGIN: usize = 4;
/// Colour where no depth exists.
const NONE: [u8; 3] = [128, 128, 128];
const PAPER: [u8; 3] = [255, 255, 255];
const INK: [u8; 3] = [0, 0, 0];

/// Draws depth in colours, with a legend of `LABELS` values at the right.
pub fn colour_depth(depth: &Depth) -> Rgb {
    let exists = |d: &f32| d.is_finite() && *d > 0.0;
    let mut sorted: Vec<f32> = depth.data.iter().copied().filter(exists).collect();
    sorted.sort_by(f32::total_cmp);
    let at = |q: f64| {
        let index = q * sorted.len().saturating_sub(1) as f64;
        sorted.get(index.round() as usize).copied().unwrap_or(1.0)
    };
    let [near, far] = ENDS.map(at);
    // A scene of one depth has a scale, too.
    let far = far.max(near * 1.001);
    let scale = (depth.height / 160).max(1);
    let legend = LEGEND * scale;
    let mut out = Rgb::black(depth.width + legend, depth.height);
    out.data.fill(PAPER[0]);
    for y in 0..depth.height {
        for x in 0..depth.width {
            let d = depth.data[y * depth.width + x];
            let rgb = if exists(&d) { turbo((far - d) / (far - near)) } else { NONE };
            set_pixel(&mut out, x, y, rgb);
        }
    }
    let (margin, text) = (MARGIN * scale, HEIGHT * scale);
    let top = margin + text / 2;
    let rows = depth.height.saturating_sub(2 * margin + text).max(1);
    for y in 0..rows {
        let share = y as f32 / (rows.max(2) - 1) as f32;
        for x in 0..BAR * scale {
            set_pixel(&mut out, depth.width + margin + x, top + y, turbo(1.0 - share));
        }
    }
    for label in 0..LABELS {
        let share = label as f32 / (LABELS - 1) as f32;
        let y = top + (share * (rows - 1) as f32).round() as usize;
        let left = depth.width + 2 * margin + BAR * scale;
        write(
            &mut out,
            (left, y.saturating_sub(text / 2)),
            scale,
            INK,
            &number(near + share * (far - near)),
        );
    }
    out
}

/// A number of three significant digits, of at most seven characters.
fn number(v: f32) -> String {
    let digits = (2 - v.abs().max(1e-3).log10().floor() as i32).clamp(0, 5) as usize;
    format!("{v:.digits$}")
}

/// The Turbo colour of a share from 0 (blue) to 1 (red).
fn turbo(share: f32) -> [u8; 3] {
    const RED: [f32; 6] =
        [0.135_721_39, 4.615_392_7, -42.660_32, 132.131_07, -152.942_4, 59.286_38];
    const GREEN: [f32; 6] =
        [0.091_402_61, 2.194_188_4, 4.842_966_6, -14.185_033, 4.277_298_5, 2.829_566];
    const BLUE: [f32; 6] = [0.106_673_3, 12.641_946, -60.582_05, 110.362_77, -89.903_11, 27.348_25];
    // The first colours are nearly black.
    let x = 0.06 + 0.94 * share.clamp(0.0, 1.0);
    [RED, GREEN, BLUE].map(|c| {
        let v = c.iter().rev().fold(0.0, |sum, c| sum * x + c);
        (v.clamp(0.0, 1.0) * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_red_far_is_blue_and_the_legend_agrees() {
        let (w, h) = (64, 80);
        let data = (0..w * h).map(|i| if i % w == 0 { 0.0 } else { 1.0 + (i % w) as f32 / 16.0 });
        let picture = colour_depth(&Depth { width: w, height: h, data: data.collect() });
        assert_eq!((picture.width, picture.height), (w + LEGEND, h));
        let at = |x: usize, y: usize| -> [u8; 3] {
            let at = 3 * (y * picture.width + x);
            [picture.data[at], picture.data[at + 1], picture.data[at + 2]]
        };
        assert_eq!(at(0, 40), NONE);
        let (near, far) = (at(1, 40), at(w - 1, 40));
        assert!(
            near[0] > 100 && near[2] < 40 && far[2] > far[0] && far[2] > far[1],
            "{near:?} {far:?}"
        );
        // The bar: near at the top, far at the bottom.
        let bar = w + MARGIN;
        assert_eq!(at(bar, MARGIN + 2), near);
        assert_eq!(at(bar, h - MARGIN - 4), far);
        // The top label is the near end, 1.125: 1, point, 1 in ink.
        let left = w + 2 * MARGIN + BAR;
        let row = |y: usize| -> String {
            (0..15).map(|x| if at(left + x, MARGIN + y) == INK { '#' } else { '.' }).collect()
        };
        assert_eq!(row(0), ".#.......#..###");
        assert_eq!(row(4), "###..#..###.###");
    }

    #[test]
    fn pictures_without_depth_and_of_one_depth() {
        for v in [0.0, 3.0] {
            let picture = colour_depth(&Depth { width: 8, height: 6, data: vec![v; 48] });
            assert_eq!(picture.data.len(), 3 * 6 * (8 + LEGEND));
        }
        for (v, text) in [(0.01234, "0.0123"), (9.876, "9.88"), (123.4, "123"), (54321.0, "54321")]
        {
            assert_eq!(number(v), text);
        }
    }
}
