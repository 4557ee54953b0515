//! One pass over all frames of a video, small and grey: their sharpness, possible cuts, and the sharpest frame of
//! each short stretch of time as a candidate. Memory is bounded: of long videos the stretches become longer.

use super::motion::Thumbnail;
use super::process::Pnm;

/// Longer side of the frames that are read, px: blur of a thousandth of a picture still shows.
pub(super) const READ_SIDE: usize = 640;
/// Length of a stretch of which the sharpest frame is kept, s: hands shake several times a second.
const STRETCH: f64 = 0.1;
/// Most candidates. 60 kB each.
const CANDIDATES_MAX: usize = 400;
/// Sides of the grid of means by which following frames are compared.
const GRID: [usize; 2] = [16, 12];
/// Correlation of these means below which a cut is suspected.
const CUT_CORRELATION: f64 = 0.6;
/// Deviation of the means below which a frame shows nothing, and difference of the means of two such frames.
const FLAT: f64 = 2.0;
const FLAT_STEP: f64 = 12.0;

/// A frame that may be taken.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    /// Number of the frame in the video, from 0.
    pub index: usize,
    /// Time from the start of the video, s.
    pub time: f64,
    /// Sharpness; comparable between frames of the same content.
    pub sharpness: f64,
    /// The frame, small.
    pub thumbnail: Thumbnail,
    /// A cut is suspected between the candidate before and this one.
    pub after_cut: bool,
}

/// Means of a grid of cells, for the comparison of following frames.
struct Means {
    size: [usize; 2],
    cells: Vec<f64>,
}

/// The pass over the frames.
#[derive(Default)]
pub(super) struct Scan {
    /// Number of frames so far.
    pub frames: usize,
    /// Time of the last frame, s.
    pub end: f64,
    candidates: Vec<Candidate>,
    /// The sharpest frame of the last stretch, and the stretch's number.
    open: Option<(u64, Candidate)>,
    doublings: i32,
    before: Option<Means>,
}

impl Scan {
    /// Adds the next frame, of `time` s.
    pub fn push(&mut self, frame: &Pnm, time: f64) {
        // Times of damaged files go back.
        let time = if time.is_finite() { time.max(self.end) } else { self.end };
        let thumbnail = halved(frame);
        let means = Means::of(&thumbnail);
        let after_cut = self.before.as_ref().is_some_and(|before| before.is_cut(&means));
        let candidate = Candidate {
            index: self.frames,
            time,
            sharpness: sharpness(frame),
            thumbnail,
            after_cut,
        };
        (self.before, self.end) = (Some(means), time);
        self.frames += 1;
        let stretch = (time / self.stretch()) as u64;
        match &mut self.open {
            Some((number, best)) if *number == stretch && !after_cut => {
                if candidate.sharpness > best.sharpness {
                    *best = Candidate { after_cut: best.after_cut, ..candidate };
                }
            }
            open => {
                let complete = open.replace((stretch, candidate));
                self.candidates.extend(complete.map(|(_, candidate)| candidate));
                if self.candidates.len() >= CANDIDATES_MAX {
                    self.thin_out();
                }
            }
        }
    }

    /// The candidates, in the order of time.
    pub fn finish(mut self) -> Vec<Candidate> {
        self.candidates.extend(self.open.map(|(_, candidate)| candidate));
        self.candidates
    }

    fn stretch(&self) -> f64 {
        STRETCH * 2f64.powi(self.doublings)
    }

    /// Doubles the length of the stretches: of two neighbours the sharper one stays.
    fn thin_out(&mut self) {
        self.doublings += 1;
        let across_cuts =
            self.candidates.iter().filter(|c| c.after_cut).count() > CANDIDATES_MAX / 4;
        let mut kept: Vec<Candidate> = Vec::with_capacity(CANDIDATES_MAX);
        let mut single = false;
        for candidate in self.candidates.drain(..) {
            match kept.last_mut() {
                Some(last) if single && (across_cuts || !candidate.after_cut) => {
                    if candidate.sharpness > last.sharpness {
                        *last = Candidate { after_cut: last.after_cut, ..candidate };
                    }
                    single = false;
                }
                _ => {
                    kept.push(candidate);
                    single = true;
                }
            }
        }
        self.candidates = kept;
    }
}

/// Averages squares of two by two pixels.
fn halved(frame: &Pnm) -> Thumbnail {
    let (width, height) = (frame.width / 2, frame.height / 2);
    if width == 0 || height == 0 {
        let Pnm { width, height, data } = frame.clone();
        return Thumbnail { width, height, data };
    }
    let mut data = Vec::with_capacity(width * height);
    for rows in frame.data.chunks_exact(2 * frame.width) {
        let (top, bottom) = rows.split_at(frame.width);
        let squares = top.chunks_exact(2).zip(bottom.chunks_exact(2));
        data.extend(squares.map(|(a, b)| {
            let sum = [a[0], a[1], b[0], b[1]].map(u16::from).iter().sum::<u16>();
            ((sum + 2) / 4) as u8
        }));
    }
    Thumbnail { width, height, data }
}

/// Sharpness of a frame: the mean square of its Laplacian over the variance of its values, so that a change of the
/// exposure changes little. (Pech-Pacheco et al. 2000 take the variance of the Laplacian.)
fn sharpness(frame: &Pnm) -> f64 {
    let (w, h) = (frame.width, frame.height);
    if w < 3 || h < 3 {
        return 0.0;
    }
    let (mut squares, mut sum, mut sum_squares) = (0u64, 0u64, 0u64);
    for y in 1..h - 1 {
        let row = |y: usize| &frame.data[y * w..(y + 1) * w];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        for x in 1..w - 1 {
            let value = |v: u8| i32::from(v);
            let around =
                value(above[x]) + value(below[x]) + value(here[x - 1]) + value(here[x + 1]);
            let laplacian = around - 4 * value(here[x]);
            squares += u64::from(laplacian.unsigned_abs().pow(2));
            sum += u64::from(here[x]);
            sum_squares += u64::from(here[x]).pow(2);
        }
    }
    let count = ((w - 2) * (h - 2)) as f64;
    let mean = sum as f64 / count;
    let variance = sum_squares as f64 / count - mean * mean;
    // One grey level of noise: a dark, empty frame is not sharp.
    squares as f64 / count / (variance + 1.0)
}

impl Means {
    fn of(image: &Thumbnail) -> Self {
        let [columns, rows] = GRID;
        let Thumbnail { width, height, data } = image;
        let mut sums = vec![(0.0, 0.0f64); columns * rows];
        for (y, row) in data.chunks_exact(*width).enumerate() {
            let cells = &mut sums[y * rows / height * columns..][..columns];
            for (x, value) in row.iter().enumerate() {
                let cell = &mut cells[x * columns / width];
                cell.0 += f64::from(*value);
                cell.1 += 1.0;
            }
        }
        let cells = sums.iter().map(|(sum, count)| sum / count.max(1.0)).collect();
        Self { size: [*width, *height], cells }
    }

    fn mean(&self) -> f64 {
        self.cells.iter().sum::<f64>() / self.cells.len() as f64
    }

    /// Returns whether the next frame may show another place.
    fn is_cut(&self, next: &Self) -> bool {
        if self.size != next.size {
            return true;
        }
        let [a, b] = [self.mean(), next.mean()];
        let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
        for (x, y) in self.cells.iter().zip(&next.cells) {
            let (x, y) = (x - a, y - b);
            aa += x * x;
            bb += y * y;
            ab += x * y;
        }
        let flat = FLAT * FLAT * self.cells.len() as f64;
        match (aa < flat, bb < flat) {
            (true, true) => (a - b).abs() > FLAT_STEP,
            (true, false) | (false, true) => true,
            (false, false) => ab < CUT_CORRELATION * (aa * bb).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A frame of waves that are shifted by `shift` and blurred over `blur` px along x.
    fn frame(shift: f64, blur: usize, place: f64) -> Pnm {
        let (width, height) = (64, 48);
        let at = |x: f64, y: usize| {
            let y = y as f64;
            128.0 + 50.0 * (0.9 * x + place * y).sin() + 40.0 * (0.11 * x * place + 0.2 * y).cos()
        };
        let value = |i: usize| {
            let (x, y) = (i % width, i / width);
            let blurred = (0..blur).map(|k| at(x as f64 + shift + k as f64, y));
            (blurred.sum::<f64>() / blur as f64) as u8
        };
        Pnm { width, height, data: (0..width * height).map(value).collect() }
    }

    #[test]
    fn the_sharpest_frame_of_each_stretch_stays() {
        let mut scan = Scan::default();
        for i in 0..30 {
            let blur = if i % 3 == 1 { 1 } else { 3 };
            scan.push(&frame(0.1 * i as f64, blur, 1.0), i as f64 / 30.0);
        }
        assert_eq!(scan.frames, 30);
        let all = scan.finish();
        assert!((10..=11).contains(&all.len()), "{}", all.len());
        assert!(all[..9].iter().all(|c| c.index % 3 == 1 && !c.after_cut));
        assert!((all[3].time - all[3].index as f64 / 30.0).abs() < 1e-9);
    }

    #[test]
    fn exposure_changes_the_sharpness_little_and_blur_much() {
        let sharp = frame(0.0, 1, 1.0);
        let darker = Pnm { data: sharp.data.iter().map(|v| v / 2).collect(), ..sharp.clone() };
        let [a, b, blurred] = [sharp, darker, frame(0.0, 3, 1.0)].map(|f| sharpness(&f));
        assert!((a / b - 1.0).abs() < 0.1 && blurred < 0.85 * a, "{a} {b} {blurred}");
        assert_eq!(sharpness(&Pnm { width: 2, height: 1, data: vec![0, 9] }), 0.0);
    }

    #[test]
    fn cuts_end_a_stretch_and_survive_thinning() {
        let mut scan = Scan::default();
        // Times that go back, and times that are missing.
        for (i, time) in [0.0, 0.01, f64::NAN, 0.005].into_iter().enumerate() {
            scan.push(&frame(0.0, 1, if i < 2 { 1.0 } else { -3.0 }), time);
        }
        let all = scan.finish();
        assert_eq!(all.iter().map(|c| c.after_cut).collect::<Vec<_>>(), [false, true]);
        let mut scan = Scan::default();
        let frames = [frame(0.0, 1, 1.0), frame(0.0, 1, -3.0)];
        for i in 0..3 * CANDIDATES_MAX {
            scan.push(&frames[usize::from(i >= 500)], i as f64 * STRETCH);
            assert!(scan.candidates.len() < CANDIDATES_MAX);
        }
        let all = scan.finish();
        assert!(all.len() > CANDIDATES_MAX / 4);
        let cuts: Vec<f64> = all.iter().filter(|c| c.after_cut).map(|c| c.time).collect();
        assert!(cuts.len() == 1 && (cuts[0] - 50.0).abs() < 2.0, "{cuts:?}");
    }

    #[test]
    fn black_frames_are_a_shot_of_their_own() {
        let black = Pnm { width: 64, height: 48, data: vec![16; 64 * 48] };
        let mut scan = Scan::default();
        for (i, frame) in [&black, &black, &frame(0.0, 1, 1.0)].into_iter().enumerate() {
            scan.push(frame, i as f64);
        }
        let cuts: Vec<bool> = scan.finish().iter().map(|c| c.after_cut).collect();
        assert_eq!(cuts, [false, false, true]);
    }
}
