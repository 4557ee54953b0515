//! The dark frame of a photograph.
//!
//! Programs that remove lens distortion leave a few black pixels along the sides. Gaussians of such
//! pixels are black bars in new views, and the Gaussians at the ends of a scene spread them over what no
//! photograph shows. The frame is therefore replaced by the pixels inside it, before the crop.
//! `../shared/photos/fox` has one of 5 of 1080 px. There, at 256 → 512, new views gain 1.8 dB (21.21 to
//! 23.00 dB, two pairs, photographs with their frames as references).

use crate::scene::pictures::Rgb;

/// Most lines of a frame, share of the side across it. Wider bars are cut, not filled.
const WIDTH_SHARE: f32 = 0.01;
/// … and at least this number, px.
const WIDTH_MIN: usize = 4;
/// Largest value of any channel in the outermost line. JPEG leaves some noise in black.
const BLACK: u8 = 24;
/// Least mean value inside the frame. The edge of a dark photograph is no frame.
const INSIDE: f32 = 40.0;
/// The frame ends where a line has this share of the mean value inside. An interpolation leaves a ramp of
/// two or three lines.
const RAMP: f32 = 0.95;

/// A side of a picture: its lines, outermost first.
#[derive(Clone, Copy)]
enum Side {
    Left,
    Right,
    Top,
    Bottom,
}

impl Side {
    const ALL: [Self; 4] = [Self::Left, Self::Right, Self::Top, Self::Bottom];

    /// Lines of `picture`, and pixels of a line.
    fn lines(self, picture: &Rgb) -> (usize, usize) {
        match self {
            Self::Left | Self::Right => (picture.width, picture.height),
            Self::Top | Self::Bottom => (picture.height, picture.width),
        }
    }

    /// First byte of pixel `i` of line `line`.
    fn at(self, picture: &Rgb, line: usize, i: usize) -> usize {
        let Rgb { width, height, .. } = *picture;
        let (x, y) = match self {
            Self::Left => (line, i),
            Self::Right => (width - 1 - line, i),
            Self::Top => (i, line),
            Self::Bottom => (i, height - 1 - line),
        };
        3 * (y * width + x)
    }

    /// Number of lines of the frame; 0 without one.
    fn frame(self, picture: &Rgb) -> usize {
        let (lines, length) = self.lines(picture);
        let most = ((lines as f32 * WIDTH_SHARE) as usize).max(WIDTH_MIN);
        if lines <= 4 * most || length == 0 {
            return 0;
        }
        let line = |line| {
            (0..length).flat_map(move |i| {
                let at = self.at(picture, line, i);
                picture.data[at..at + 3].iter().copied()
            })
        };
        let mean = |at| line(at).map(f32::from).sum::<f32>() / (3 * length) as f32;
        let inside = mean(most);
        if inside < INSIDE || line(0).any(|v| v > BLACK) {
            return 0;
        }
        (1..most).find(|at| mean(*at) >= RAMP * inside).unwrap_or(most)
    }
}

/// Returns `picture` with its dark frame replaced by the pixels inside it, and the largest width of the frame,
/// px; `None` without a frame.
pub(super) fn filled(picture: &Rgb) -> Option<(Rgb, usize)> {
    let frames = Side::ALL.map(|side| side.frame(picture));
    if frames == [0; 4] {
        return None;
    }
    let mut filled = picture.clone();
    for (side, frame) in Side::ALL.into_iter().zip(frames) {
        let (_, length) = side.lines(picture);
        for i in 0..length {
            let from = side.at(picture, frame, i);
            for line in 0..frame {
                let to = side.at(picture, line, i);
                filled.data.copy_within(from..from + 3, to);
            }
        }
    }
    Some((filled, frames.into_iter().max().unwrap_or_default()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [600, 500];

    /// A gradient with `frame` black lines left, right, above and below, and the gradient alone.
    fn framed(frame: [usize; 4], level: u8) -> (Rgb, Rgb) {
        let [w, h] = SIZE;
        let mut whole = Rgb::black(w, h);
        for (i, p) in whole.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = ((i % w) / 60, (i / w) / 50);
            p.copy_from_slice(&[level + x as u8, level + y as u8, level]);
        }
        let mut framed = whole.clone();
        let [left, right, top, bottom] = frame;
        for (i, p) in framed.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % w, i / w);
            if x < left || x >= w - right || y < top || y >= h - bottom {
                p.fill(3);
            }
        }
        (framed, whole)
    }

    #[test]
    fn a_frame_is_replaced_by_the_pixels_inside() {
        for frame in [[5, 0, 0, 0], [0, 3, 0, 0], [0, 0, 2, 0], [0, 0, 0, 4], [4, 3, 2, 1]] {
            let (framed, whole) = framed(frame, 120);
            let (filled, lines) = filled(&framed).expect("a frame");
            assert_eq!(Some(lines), frame.into_iter().max());
            let worst = filled.data.iter().zip(&whole.data).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(worst <= Some(1), "{frame:?}: {worst:?}");
        }
    }

    /// The ramp of an interpolation belongs to the frame.
    #[test]
    fn a_ramp_belongs_to_the_frame() {
        let (mut picture, whole) = framed([2, 0, 0, 0], 120);
        let width = picture.width;
        for row in picture.data.chunks_exact_mut(3 * width) {
            row[6..9].iter_mut().for_each(|v| *v /= 3);
            row[9..12].iter_mut().for_each(|v| *v -= *v / 4);
        }
        assert_eq!(filled(&picture).expect("a frame"), (whole, 4));
    }

    #[test]
    fn pictures_without_a_frame_stay() {
        for (frame, level) in [([0; 4], 120), ([40, 0, 0, 0], 120), ([3; 4], 20)] {
            assert!(filled(&framed(frame, level).0).is_none(), "{frame:?}, {level}");
        }
        assert!(filled(&Rgb::black(64, 48)).is_none() && filled(&Rgb::black(2, 2)).is_none());
        // One bright spot at the side: what the photograph shows there is dark.
        let (mut spot, _) = framed([4, 0, 0, 0], 120);
        let row = 3 * spot.width * 200;
        spot.data[row..row + 3].fill(200);
        assert!(filled(&spot).is_none());
    }
}
