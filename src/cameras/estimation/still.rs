//! Features that stand still in the picture while the camera moves: a logo, a clock, the frame of a film, a part of
//! what carries the camera. They agree with cameras that do not move.

use super::photo::PosePhoto;
use crate::cameras::matches::descriptors::DESCRIPTOR;
use crate::cameras::matches::features::Feature;
use std::collections::HashMap;

/// Largest distance of two features at one place of the picture, px of the working size.
const SAME_PLACE_PX: f32 = 0.75;
/// Least dot product of their descriptors. What moves behind an edge changes a part of them.
const SAME_THING: f32 = 0.8;
/// Least share of the other photographs that show a feature at its place. Far points stand still between two
/// photographs that were taken side by side, not in most of several.
const SHARE: f64 = 0.8;
/// Fewest photographs of one size that tell.
const PHOTOGRAPHS: usize = 3;
/// Share of a photograph's features above which they are no part of the picture: the camera itself stands still.
const MOST: f64 = 0.6;

/// Photographs without the features that stand still, and the share of these. `None` where none does, or where more
/// than 60 % of a photograph's features do.
pub(super) fn without_still(photos: &[PosePhoto]) -> Option<(Vec<PosePhoto>, f64)> {
    let places: Vec<Places> = photos.iter().map(Places::new).collect();
    let mut still: Vec<Vec<bool>> = Vec::with_capacity(photos.len());
    for (i, photo) in photos.iter().enumerate() {
        let is_same_size = |other: &PosePhoto| {
            let size = |p: &PosePhoto| (p.image.width(), p.image.height(), p.views.len());
            size(other) == size(photo)
        };
        let others = (0..photos.len()).filter(|&j| j != i && is_same_size(&photos[j]));
        let others: Vec<usize> = others.collect();
        let needed = (SHARE * others.len() as f64).ceil() as usize;
        let stands = |feature: usize| {
            let shown = others.iter().filter(|&&j| places[j].has(&photos[j], photo, feature));
            shown.take(needed).count() == needed
        };
        let enough = others.len() + 1 >= PHOTOGRAPHS;
        let of: Vec<bool> = (0..photo.feature_count()).map(|f| enough && stands(f)).collect();
        if share(&of) > MOST {
            return None;
        }
        still.push(of);
    }
    let all: Vec<bool> = still.iter().flatten().copied().collect();
    let share = share(&all);
    let kept = photos.iter().zip(&still).map(|(photo, still)| photo.without(still));
    (share > 0.0).then(|| (kept.collect(), share))
}

fn share(of: &[bool]) -> f64 {
    of.iter().filter(|still| **still).count() as f64 / of.len().max(1) as f64
}

/// The features of a photograph by their place: squares of a side of [`SAME_PLACE_PX`].
struct Places(HashMap<[i32; 2], Vec<usize>>);

impl Places {
    fn new(photo: &PosePhoto) -> Self {
        let mut places: HashMap<[i32; 2], Vec<usize>> = HashMap::new();
        for (i, point) in photo.features.points.iter().enumerate() {
            places.entry(square(point)).or_default().push(i);
        }
        Self(places)
    }

    /// Returns whether `own`, whose features these are, has feature `i` of `photo` at the same place.
    fn has(&self, own: &PosePhoto, photo: &PosePhoto, i: usize) -> bool {
        let point = &photo.features.points[i];
        let [x, y] = square(point);
        let near = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| [x + dx, y + dy]));
        near.filter_map(|square| self.0.get(&square)).flatten().any(|&j| {
            let other = &own.features.points[j];
            let is_near = (other.x - point.x).hypot(other.y - point.y) <= SAME_PLACE_PX;
            is_near && dot(photo, i, own, j) >= SAME_THING
        })
    }
}

fn square(point: &Feature) -> [i32; 2] {
    [point.x, point.y].map(|v| (v / SAME_PLACE_PX).floor() as i32)
}

/// Dot product of the descriptors of feature `i` of `a` and feature `j` of `b`.
fn dot(a: &PosePhoto, i: usize, b: &PosePhoto, j: usize) -> f32 {
    let a = &a.features.descriptors[i * DESCRIPTOR..(i + 1) * DESCRIPTOR];
    let b = &b.features.descriptors[j * DESCRIPTOR..(j + 1) * DESCRIPTOR];
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::estimation::Lens;

    const SIDE: usize = 256;

    /// Noise of squares of 4 px, white or black, seen `shift` px farther to the right; `stamp` px of the left side show
    /// other noise that stands still.
    fn photo(shift: usize, stamp: usize) -> PosePhoto {
        let noise = |x: usize, y: usize, seed: u32| {
            let square = (y / 4 * 1000 + x / 4) as u32;
            let mixed =
                (square ^ seed).wrapping_mul(0x9E37_79B1).rotate_left(13).wrapping_mul(0x85EB_CA6B);
            if mixed >> 31 == 0 { 40 } else { 210 }
        };
        let value = |i: usize| {
            let (x, y) = (i % SIDE, i / SIDE);
            if x < stamp { noise(x, y, 7) } else { noise(x + shift, y, 0) }
        };
        let rgb: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| [value(i); 3]).collect();
        PosePhoto::from_rgb8(&rgb, Lens::unknown(SIDE, SIDE), 600).unwrap()
    }

    #[test]
    fn a_stamp_is_left_out_and_the_rest_stays() {
        let photos: Vec<PosePhoto> = [0, 9, 22, 31].map(|shift| photo(shift, 64)).to_vec();
        let (moving, share) = without_still(&photos).unwrap();
        assert!((0.1..0.4).contains(&share), "{share}");
        let count = |of: &[PosePhoto], left: bool| {
            let points = of.iter().flat_map(|photo| &photo.features.points);
            points.filter(|p| if left { p.x < 56.0 } else { p.x > 72.0 }).count()
        };
        assert_eq!(count(&moving, false), count(&photos, false));
        let (before, after) = (count(&photos, true), count(&moving, true));
        assert!(after * 20 < before, "{after} of {before} features of the stamp stay");
        let [first, before] = [&moving[0], &photos[0]];
        assert_eq!(first.features.descriptors.len(), DESCRIPTOR * first.feature_count());
        let last = first.feature_count() - 1;
        let same =
            (0..before.feature_count()).find(|&i| before.position(i) == first.position(last));
        assert_eq!(first.bearings[last], before.bearings[same.unwrap()]);
        assert_eq!(first.colours[last], before.colours[same.unwrap()]);
    }

    #[test]
    fn nothing_is_left_out_without_a_stamp_or_evidence() {
        let moving: Vec<PosePhoto> = [0, 9, 22, 31].map(|shift| photo(shift, 0)).to_vec();
        assert!(without_still(&moving).is_none());
        // Two photographs do not tell a stamp from far things.
        assert!(without_still(&[photo(0, 64), photo(9, 64)]).is_none());
        // A camera that stands still.
        assert!(without_still(&[photo(5, 0), photo(5, 0), photo(5, 0)]).is_none());
    }
}
