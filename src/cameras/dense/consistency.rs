//! Pixels whose depth is certain, and the depth of the others.

use super::planes::{Field, Plane};
use super::{DenseView, warps};
use crate::cameras::matches::GrayImage;
use rayon::prelude::*;

/// Largest difference of a patch that agrees ([`Plane::difference`]).
const DIFFERENCE_MAX: f32 = 0.25;
/// Largest distance of a pixel from its image after the way to another photograph and back, px.
const RETURN_MAX: f32 = 1.0;
/// Pixels on either side from which one without a certain depth takes its change.
const REACH: isize = 6;
/// Variance of their weights by distance, px².
const DISTANCE_VARIANCE: f32 = 9.0;
/// Difference of brightness that lowers their weight by a factor of e.
const BRIGHTNESS_SCALE: f32 = 0.05;
/// Weight of no change.
const NO_CHANGE: f32 = 0.02;
/// Fewest pixels of a parallel task.
const TASK: usize = 256;

/// Marks the pixels of photograph `view` whose depth is certain: the patch agrees with the sources, and the
/// plane of one of them leads back to the pixel.
pub(super) fn certain(view: usize, views: &[DenseView<'_>], fields: &[Field]) -> Vec<bool> {
    let (field, width) = (&fields[view], views[view].picture.width());
    let ways: Vec<_> = warps(view, views)
        .into_iter()
        .filter(|(source, _)| !fields[*source].is_empty())
        .map(|(source, there)| {
            let back = super::Warp::new(views[source].camera, views[view].camera);
            (there, back, &fields[source], views[source].picture)
        })
        .collect();
    let is_certain = |(i, plane): (usize, &Plane)| {
        let at = [(i % width) as f32 + 0.5, (i / width) as f32 + 0.5];
        plane.difference <= DIFFERENCE_MAX
            && is_kept(views[view].picture, i)
            && ways.iter().any(|(there, back, field, picture)| {
                let Some([x, y]) = there.project(at, plane.inverse) else { return false };
                let inside = x >= 0.0 && y >= 0.0;
                if !inside || x >= picture.width() as f32 || y >= picture.height() as f32 {
                    return false;
                }
                let pixel = y as usize * picture.width() + x as usize;
                if !is_kept(picture, pixel) {
                    return false;
                }
                let other = &field[pixel];
                let offset = [x - x.floor() - 0.5, y - y.floor() - 0.5];
                let inverse =
                    other.inverse + other.slopes[0] * offset[0] + other.slopes[1] * offset[1];
                back.project([x, y], inverse)
                    .is_some_and(|[bx, by]| (bx - at[0]).hypot(by - at[1]) < RETURN_MAX)
            })
    };
    field.par_iter().enumerate().with_min_len(TASK).map(is_certain).collect()
}

/// Returns whether pixel `i` of a picture is not masked.
fn is_kept(picture: &GrayImage, i: usize) -> bool {
    picture.mask().is_none_or(|mask| mask.kept()[i])
}

/// `factors` where the depth is certain; elsewhere the mean of their logarithms nearby, by weights that fall
/// with distance and difference of brightness, and 1 far from all of them.
pub(super) fn spread(picture: &GrayImage, factors: &[f32], certain: &[bool]) -> Vec<f32> {
    let (width, height) = (picture.width(), picture.height());
    let pixels = picture.pixels();
    let at = |i: usize| {
        if certain[i] {
            return factors[i];
        }
        let (x, y) = (i % width, i / width);
        let (mut sum, mut weights) = (0.0, NO_CHANGE);
        let span = |at: usize, end: usize| {
            at.saturating_sub(REACH as usize)..(at + REACH as usize + 1).min(end)
        };
        for row in span(y, height) {
            for column in span(x, width) {
                let j = row * width + column;
                if certain[j] {
                    let distance = [column.abs_diff(x), row.abs_diff(y)].map(|d| (d * d) as f32);
                    let distance = (distance[0] + distance[1]) / (2.0 * DISTANCE_VARIANCE);
                    let brightness = (pixels[j] - pixels[i]).abs() / BRIGHTNESS_SCALE;
                    let weight = (-distance - brightness).exp();
                    sum += weight * factors[j].ln();
                    weights += weight;
                }
            }
        }
        (sum / weights).exp()
    };
    (0..certain.len()).into_par_iter().with_min_len(TASK).map(at).collect()
}
