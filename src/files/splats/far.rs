//! Splats far from the origin of their world, as in the coordinates of a survey (UTM).
//!
//! An f32 has steps of half a unit at five millions. Where a file has more digits, the middle of the splats becomes the
//! origin, in whole units, as the readers of cameras do it (`poses/assemble.rs`).

use crate::scene::render::{comment_of_origin, comments_without_camera, origin_of_comments};
use crate::scene::splats::Splats;
use glam::DVec3;
use subsplat_kernels::layout::SPLAT_STRIDE;

/// Distance of the splats' middle from the origin, in units of their spread, from which on the middle becomes the
/// origin: that of cameras. At this distance an f32 is wrong by 1.2e-5 of the spread.
const FAR: f64 = 200.0;
/// Most splats of which middle and spread are taken.
const SAMPLE: usize = 1 << 16;
/// Share of the splats within the spread. The others may be rows that were never written, or a sky.
const SPREAD_SHARE: f64 = 0.95;

/// The middle of `places` in whole units where it is [`FAR`] from the origin; `None` for a scene near the origin.
fn far_middle(places: impl ExactSizeIterator<Item = DVec3>) -> Option<DVec3> {
    let step = places.len().div_ceil(SAMPLE).max(1);
    let at: Vec<DVec3> = places.step_by(step).filter(|place| place.is_finite()).collect();
    let middle = DVec3::from([0, 1, 2].map(|axis| {
        let values = at.iter().map(|place| place[axis]).collect();
        quantile(values, 0.5)
    }));
    let spread = quantile(at.iter().map(|place| place.distance(middle)).collect(), SPREAD_SHARE);
    // One splat, or several at one place, have no spread.
    let unit = if spread > 0.0 { spread } else { FAR };
    (middle.length() > FAR * unit).then(|| middle.round())
}

/// The value at a share of the sorted values; 0 without values.
fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// Moves splats whose places lie far from the origin, and sets the comment of their new origin. `places` are the
/// means of `splats` with all digits of the file. Returns a note where it moves them.
pub(super) fn move_to_origin(
    splats: &mut Splats,
    places: &[DVec3],
    comments: &mut Vec<String>,
) -> Option<String> {
    let origin = far_middle(places.iter().copied())?;
    for (row, place) in splats.rows.chunks_exact_mut(SPLAT_STRIDE).zip(places) {
        row[..3].copy_from_slice(&(*place - origin).as_vec3().to_array());
    }
    let of_world = origin_of_comments(comments) + origin;
    *comments = comments_without_camera(comments);
    comments.extend(comment_of_origin(of_world));
    let [x, y, z] = origin.to_array();
    Some(format!(
        "the splats lie far from the origin of their world, where 32-bit numbers are too coarse: the coordinates of \
         this scene are relative to ({x}, {y}, {z})"
    ))
}

/// A note where splats whose file has 32-bit positions lie far from the origin.
pub(super) fn note_of_lost_digits(splats: &Splats) -> Option<String> {
    let rows = splats.rows.chunks_exact(SPLAT_STRIDE);
    let middle =
        far_middle(rows.map(|row| DVec3::new(row[0].into(), row[1].into(), row[2].into())))?;
    let [x, y, z] = middle.to_array();
    Some(format!(
        "the splats lie far from the origin of their world, around ({x}, {y}, {z}), and the file has their positions \
         as 32-bit numbers, which are too coarse there: write it again with the origin in the scene"
    ))
}
