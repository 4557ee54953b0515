//! The choice of frames: pure functions over times, sharpness and motion.
//!
//! Motion is counted in steps ([`Step`]): one step is as much as two neighbouring photographs of a good series have
//! between them. Frames are taken at equal distances along that count, not in time, so that a camera that stands
//! still gives one frame, and each is the sharpest of those near its place.

use super::motion::Motion;
use std::ops::Range;

/// Motion of one step, shares of the longer side: an overlap of about 85 % (`OVERLAP` of
/// `reconstruct/inputs/pair.rs`), or that parallax.
const STEP: Motion = Motion { displacement: 0.12, parallax: 0.04 };
/// Motion from which a frame becomes the one that later frames are compared with, steps. Shaking hands stay below.
const ANCHOR: f64 = 0.15;
/// Steps between two frames without common points: fast, blurred motion.
const UNKNOWN: f64 = 1.0;
/// Smallest distance of neighbours, steps: by default, and where a number of frames is asked for.
const NEAREST: [f64; 2] = [0.3, 0.1];
/// Largest distance of neighbours that still share enough for the estimation of cameras, steps.
pub(super) const FARTHEST: f64 = 2.5;
/// Fewest and most frames by default. The estimation compares every two frames, and the network reads twelve
/// photographs.
const DEFAULT_FRAMES: (usize, usize) = (12, 36);
/// Part of the distance between two places over which the sharpest frame is looked for, on either side.
const SURROUNDINGS: f64 = 0.4;
/// Loss of relative sharpness of a frame at the end of its surroundings, against one at the place.
const OFF_PLACE: f64 = 0.25;
/// Candidates on either side with which a frame's sharpness is compared.
const NEIGHBOURS: usize = 5;
/// Shots below this duration between two shots of one place are a flash, s.
const FLASH: f64 = 0.35;
/// Shortest stretch without motion that is reported, s.
const STILL: f64 = 1.5;

/// Steps of a motion.
fn steps(motion: Motion) -> f64 {
    (motion.displacement / STEP.displacement).max(motion.parallax / STEP.parallax)
}

/// Steps from the first candidate of `range` to each: `measure` compares two candidates, the earlier one first.
///
/// Each frame is compared with the last one from which the camera moved on by [`ANCHOR`], so that neither noise nor
/// a shake adds up.
pub(super) fn progress(
    range: Range<usize>,
    mut measure: impl FnMut(usize, usize) -> Option<Motion>,
) -> Vec<f64> {
    let mut all = Vec::with_capacity(range.len());
    let Some(mut anchor) = range.clone().next() else { return all };
    let mut base = 0.0;
    all.push(base);
    for i in range.start + 1..range.end {
        let from_anchor = measure(anchor, i).map(steps);
        if let Some(moved) = from_anchor.filter(|moved| *moved < ANCHOR) {
            // As much as noise: the frame counts as standing at the anchor.
            all.push(base + if moved < 0.3 * ANCHOR { 0.0 } else { moved });
            continue;
        }
        let before = all.last().copied().unwrap_or(base);
        base = match from_anchor {
            Some(moved) => base + moved,
            None if anchor + 1 < i => before + measure(i - 1, i).map_or(UNKNOWN, steps),
            None => before + UNKNOWN,
        };
        base = base.max(before);
        anchor = i;
        all.push(base);
    }
    // A place is never before an earlier one.
    let mut most = 0.0f64;
    all.iter_mut().for_each(|p| {
        most = most.max(*p);
        *p = most;
    });
    all
}

/// Indices of the frames to take, of candidates with `progress` and `sharpness`: as many as `asked` at most, else as
/// the motion needs.
pub(super) fn choose(progress: &[f64], sharpness: &[f64], asked: Option<usize>) -> Vec<usize> {
    let Some(total) = progress.last().copied() else { return Vec::new() };
    let wanted = asked.unwrap_or({
        let (fewest, most) = DEFAULT_FRAMES;
        (total.round() as usize).saturating_add(1).clamp(fewest, most)
    });
    let nearest = NEAREST[usize::from(asked.is_some())];
    let count = wanted.min((total / nearest) as usize + 1).min(progress.len()).max(1);
    let gap = total / (count - 1).max(1) as f64;
    let relative = relative_sharpness(sharpness);
    let mut chosen: Vec<usize> = Vec::with_capacity(count);
    for k in 0..count {
        let place = if count == 1 { 0.0 } else { k as f64 * gap };
        let reach = SURROUNDINGS * gap;
        let first = chosen.last().map_or(0, |last| last + 1);
        let score = |i: &usize| {
            let off = (progress[*i] - place) / reach.max(1e-9);
            relative[*i] - OFF_PLACE * off * off
        };
        let near = (first..progress.len()).filter(|i| (progress[*i] - place).abs() <= reach + 1e-9);
        // The first of equal ones.
        let best = near.rev().max_by(|a, b| score(a).total_cmp(&score(b)));
        // Of a jump, the nearest frame that no other place has.
        let jump = || {
            let left = (first..progress.len()).filter(|i| (progress[*i] - place).abs() <= gap);
            left.min_by(|a, b| {
                (progress[*a] - place).abs().total_cmp(&(progress[*b] - place).abs())
            })
        };
        chosen.extend(best.or_else(jump));
    }
    chosen
}

/// Sharpness over the median of the neighbours in time, at most 2.
fn relative_sharpness(sharpness: &[f64]) -> Vec<f64> {
    let relative = |i: usize| {
        let around = i.saturating_sub(NEIGHBOURS)..(i + NEIGHBOURS + 1).min(sharpness.len());
        let mut near = sharpness[around].to_vec();
        near.sort_by(f64::total_cmp);
        (sharpness[i] / near[near.len() / 2].max(1e-9)).min(2.0)
    };
    (0..sharpness.len()).map(relative).collect()
}

/// Divides candidates into shots at the `cuts` (whether a cut lies before each) that `linked` does not refute: it
/// returns whether two candidates show one place. A flash between two parts of a shot is left out of it.
pub(super) fn shots(
    cuts: &[bool],
    times: &[f64],
    mut linked: impl FnMut(usize, usize) -> bool,
) -> Vec<Vec<usize>> {
    let mut parts: Vec<Vec<usize>> = Vec::new();
    for (i, cut) in cuts.iter().enumerate() {
        match parts.last_mut() {
            Some(part) if !cut || linked(i - 1, i) => part.push(i),
            _ => parts.push(vec![i]),
        }
    }
    let mut shots: Vec<Vec<usize>> = Vec::new();
    let mut parts = parts.into_iter().peekable();
    while let Some(part) = parts.next() {
        let short = |part: &[usize], next: usize| times[next] - times[part[0]] < FLASH;
        if let (Some(before), Some(after)) = (shots.last_mut(), parts.peek())
            && short(&part, after[0])
            && let (Some(last), Some(next)) = (before.last(), after.first())
            && linked(*last, *next)
        {
            before.extend(parts.next().unwrap_or_default());
        } else {
            shots.push(part);
        }
    }
    shots
}

/// Stretches without motion, from and to in s, the longest of all.
pub(super) fn longest_still(progress: &[f64], times: &[f64]) -> Option<[f64; 2]> {
    let mut longest: Option<[f64; 2]> = None;
    let mut start = 0;
    for i in 1..=progress.len() {
        if i < progress.len() && progress[i] - progress[start] < 0.5 * ANCHOR {
            continue;
        }
        let (from, to) = (times[start], times[i - 1]);
        if to - from >= STILL && longest.is_none_or(|[a, b]| to - from > b - a) {
            longest = Some([from, to]);
        }
        start = i;
    }
    longest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Measures candidates that stand at `places`, steps; `None` beyond three steps.
    fn measured(places: &[f64]) -> Vec<f64> {
        progress(0..places.len(), |a, b| {
            let moved = (places[b] - places[a]).abs();
            (moved < 3.0)
                .then_some(Motion { displacement: moved * STEP.displacement, parallax: 0.0 })
        })
    }

    #[test]
    fn parallax_counts_as_much_as_displacement() {
        let step = |displacement, parallax| steps(Motion { displacement, parallax });
        assert_eq!(step(0.12, 0.0), 1.0);
        assert_eq!(step(0.0, 0.08), 2.0);
    }

    #[test]
    fn noise_and_shakes_do_not_add_up_and_slow_motion_does() {
        let shake: Vec<f64> = (0..100).map(|i| 0.1 * (i as f64).sin()).collect();
        assert!(*measured(&shake).last().unwrap() < 0.2);
        let slow: Vec<f64> = (0..101).map(|i| 0.05 * i as f64).collect();
        let total = *measured(&slow).last().unwrap();
        assert!((total - 5.0).abs() < 0.1, "{total}");
        // A jump beyond all common points counts one step.
        assert_eq!(measured(&[0.0, 10.0, 10.0]), [0.0, UNKNOWN, UNKNOWN]);
        assert!(measured(&[]).is_empty());
    }

    #[test]
    fn frames_are_even_in_motion_and_not_in_time() {
        // A stand of 50, a walk of 100 candidates, a stand of 50.
        let places: Vec<f64> = (0..200).map(|i| 0.1 * (i - 50).clamp(0, 100) as f64).collect();
        let p = measured(&places);
        let chosen = choose(&p, &vec![1.0; 200], Some(11));
        assert_eq!(chosen.len(), 11);
        let stands = chosen.iter().filter(|i| **i < 50 || **i > 150).count();
        assert!(stands <= 2, "{chosen:?}");
        for pair in chosen.windows(2) {
            assert!((0.5..1.6).contains(&(places[pair[1]] - places[pair[0]])), "{chosen:?}");
        }
        // By default as many as the steps say, within limits.
        assert_eq!(choose(&p, &vec![1.0; 200], None).len(), 12);
        let long: Vec<f64> = (0..400).map(|i| 0.5 * i as f64).collect();
        assert_eq!(choose(&long, &vec![1.0; 400], None).len(), 36);
        assert_eq!(
            longest_still(&p, &(0..200).map(f64::from).collect::<Vec<_>>()),
            Some([0.0, 50.0])
        );
    }

    #[test]
    fn the_sharpest_of_the_surroundings_is_taken() {
        let places: Vec<f64> = (0..100).map(|i| 0.1 * i as f64).collect();
        let sharpness: Vec<f64> = (0..100).map(|i| if i % 5 == 3 { 5.0 } else { 1.0 }).collect();
        let chosen = choose(&places, &sharpness, Some(10));
        assert_eq!(chosen.len(), 10);
        assert!(chosen.iter().all(|i| i % 5 == 3), "{chosen:?}");
        // The level of the sharpness alone, as of a textured part of the scene, moves nothing.
        let textured: Vec<f64> = (0..100).map(|i| if i < 50 { 1.0 } else { 9.0 }).collect();
        let even = choose(&places, &vec![1.0; 100], Some(10));
        let far = choose(&places, &textured, Some(10))
            .iter()
            .zip(&even)
            .filter(|(a, b)| a.abs_diff(**b) > 3)
            .count();
        assert!(far <= 1);
    }

    #[test]
    fn little_motion_gives_few_frames_and_none_gives_one() {
        let creep: Vec<f64> = (0..100).map(|i| 0.012 * i as f64).collect();
        assert_eq!(choose(&creep, &[1.0; 100], None).len(), 4);
        assert_eq!(choose(&creep, &[1.0; 100], Some(40)).len(), 12);
        assert_eq!(choose(&[0.0; 30], &[1.0; 30], Some(10)).len(), 1);
        assert_eq!(choose(&[0.0], &[1.0], None), [0]);
        assert!(choose(&[], &[], None).is_empty());
        // Frames far apart: each is taken once.
        assert_eq!(choose(&[0.0, 5.0, 10.0], &[1.0; 3], Some(10)), [0, 1, 2]);
    }

    #[test]
    fn cuts_divide_and_refuted_ones_and_flashes_do_not() {
        let times: Vec<f64> = (0..8).map(|i| 0.1 * f64::from(i)).collect();
        let place = [0, 0, 0, 9, 0, 0, 7, 7];
        let linked = |a: usize, b: usize| place[a] == place[b];
        let cuts = [false, true, false, true, true, false, true, false];
        assert_eq!(shots(&cuts, &times, linked), [vec![0, 1, 2, 4, 5], vec![6, 7]]);
        // The same pause is a shot where it is long.
        let slow: Vec<f64> = (0..8).map(f64::from).collect();
        assert_eq!(shots(&cuts, &slow, linked).len(), 4);
        assert!(shots(&[], &[], linked).is_empty());
    }
}
