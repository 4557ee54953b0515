//! Parents that repeat a surface which another photograph shows larger, of more photographs than one pass holds.
//!
//! Fifty photographs of 192×352 px have 3.4 million parents, of which the scene keeps a fifth. The shares by which it
//! chooses them are gradients of a picture of all: 250 bytes a parent. Beyond [`MOST`] parents, those go first whose
//! surface the largest number of other photographs shows at a larger scale: they would have the smallest shares.
//!
//! New views of fox from seventeen photographs (1.1 million parents, 256 → 512, `tools/lab/tried.md`): 29.23 dB / .870
//! with all parents, in 72 s and 1.2 GiB on two cores; 29.26 / .870 with a million and with 700,000, in 66 and 63 s
//! and 0.9 and 0.8 GiB. Fifty photographs (fox's twenty, repeated with shifted cameras): 163 s and 2.2 GiB, 148 s and
//! 1.6 GiB, 136 s and 1.5 GiB.

use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::mask::Mask;
use crate::scene::splats::Splats;
use glam::Vec3;
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{MEAN_OFFSET, OPACITY_OFFSET, SPLAT_STRIDE};

/// Most parents whose shares are computed in one pass: those of ten photographs of 256×256 px.
const MOST: usize = 700_000;
/// Largest difference of two depths of one surface, as a share of the depth: two steps of the plane sweep.
const SAME_SURFACE: f32 = 0.02;
/// Fewest parents of a parallel task.
const TASK: usize = 4096;

/// A photograph of the network's input size.
struct View<'a> {
    camera: &'a Camera,
    mask: Option<&'a Mask>,
    /// Camera z of each pixel's parent, world units; 0 where it is masked.
    depth: Vec<f32>,
}

impl View<'_> {
    /// Pixels per world unit at the depth `z`.
    fn scale(&self, z: f32) -> f32 {
        self.camera.intrinsics().fx / z
    }

    /// Scale at which this view shows the surface at `mean`; `None` where it shows another one, or none.
    fn scale_of(&self, mean: Vec3) -> Option<f32> {
        let px = self.camera.project(mean)?;
        let k = self.camera.intrinsics();
        let inside = px.x >= 0.0 && px.y >= 0.0 && px.x < k.width as f32 && px.y < k.height as f32;
        let z = self.camera.to_camera(mean).z;
        let own = *self.depth.get(px.y as usize * k.width + px.x as usize).filter(|_| inside)?;
        ((own - z).abs() < SAME_SURFACE * z).then(|| self.scale(z))
    }
}

/// Makes parents of `inputs`, one for each pixel, transparent where there are more than 700,000 and more than the
/// parents of `gaussians` Gaussians, r² each of r = `upscale`: a scene that may have all children keeps all parents.
pub fn hide_repeated(parents: &mut Splats, inputs: &[Cropped], gaussians: usize, upscale: usize) {
    hide_beyond(parents, inputs, MOST.max(gaussians / upscale.pow(2)));
}

/// Makes parents transparent where there are more than `most`: those whose surface most other photographs show larger.
/// Parents that are not one for each pixel stay as they are.
fn hide_beyond(parents: &mut Splats, inputs: &[Cropped], most: usize) {
    let pixels: usize = inputs.iter().map(|c| c.input.width * c.input.height).sum();
    if parents.len() != pixels || parents.len() <= most {
        return;
    }
    let mut rows = parents.rows.chunks_exact(SPLAT_STRIDE);
    let views: Vec<View<'_>> = inputs
        .iter()
        .map(|c| {
            let (camera, mask) = (&c.input_camera, c.input_mask.as_ref());
            let own = rows.by_ref().take(c.input.width * c.input.height);
            let depth = own.map(|row| camera.to_camera(Vec3::from_slice(&row[MEAN_OFFSET..])).z);
            let mut depth: Vec<f32> = depth.collect();
            let kept = mask.iter().flat_map(|mask| mask.kept());
            depth.iter_mut().zip(kept).filter(|(_, kept)| !**kept).for_each(|(z, _)| *z = 0.0);
            View { camera, mask, depth }
        })
        .collect();
    let larger = larger_elsewhere(&parents.rows, &views);
    // Numbers of parents that 0, 1, 2, … other photographs show larger.
    let mut numbers = vec![0; views.len()];
    larger.iter().flatten().for_each(|larger| numbers[usize::from(*larger)] += 1);
    let mut sum = 0;
    let fits = |number: &&usize| {
        sum += **number;
        sum <= most
    };
    let ranks = numbers.iter().take_while(fits).count().max(1);
    let rows = parents.rows.par_chunks_exact_mut(SPLAT_STRIDE);
    rows.zip(&larger).with_min_len(TASK).for_each(|(row, larger)| {
        if larger.is_none_or(|larger| usize::from(larger) >= ranks) {
            row[OPACITY_OFFSET] = 0.0;
        }
    });
}

/// For each parent, the number of other views that show its surface larger, of equal ones those before its own;
/// `None` where its pixel is masked.
fn larger_elsewhere(rows: &[f32], views: &[View<'_>]) -> Vec<Option<u16>> {
    let mut all = Vec::with_capacity(rows.len() / SPLAT_STRIDE);
    let mut rest = rows;
    for (view, own) in views.iter().enumerate() {
        let (rows, after) = rest.split_at(own.depth.len() * SPLAT_STRIDE);
        rest = after;
        let of_parent = |(i, row): (usize, &[f32])| {
            if own.mask.is_some_and(|mask| !mask.kept()[i]) {
                return None;
            }
            let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
            let scale = own.scale(own.depth[i]);
            let larger = |(other, view_of): (usize, &View<'_>)| {
                other != view
                    && view_of
                        .scale_of(mean)
                        .is_some_and(|s| s > scale || (s == scale && other < view))
            };
            let count = views.iter().enumerate().filter(|one| larger(*one)).count();
            Some(u16::try_from(count).unwrap_or(u16::MAX))
        };
        let rows = rows.par_chunks_exact(SPLAT_STRIDE).enumerate().with_min_len(TASK);
        all.par_extend(rows.map(of_parent));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::pictures::Rgb;
    use glam::{Mat4, Vec2};
    use subsplat_kernels::camera::Intrinsics;
    use subsplat_kernels::layout::ShBasis;

    const SIDE: usize = 16;

    /// A photograph of a wall at z = 0 from this distance.
    fn photograph(distance: f32) -> Cropped {
        let k = Intrinsics::from_fov_x(1.0, SIDE, SIDE);
        let pose = Mat4::from_translation(Vec3::new(0.0, 0.0, -distance));
        Cropped::of_whole(Rgb::black(SIDE, SIDE), Camera::new(k, pose).unwrap())
    }

    /// The wall's parents, at a depth times `factor`.
    fn parents(inputs: &[Cropped], factor: f32) -> Splats {
        let mut rows = Vec::new();
        for c in inputs {
            let (k, origin) = (c.input_camera.intrinsics(), c.input_camera.position());
            for i in 0..SIDE * SIDE {
                let px = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
                let m = origin - k.unproject(px) * origin.z * factor;
                rows.extend([m.x, m.y, m.z, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.9]);
            }
        }
        let sh = vec![0.0; rows.len() / SPLAT_STRIDE * 3];
        Splats::new(rows, sh, Vec::new(), 0, ShBasis::default()).unwrap()
    }

    /// Visible parents of each photograph.
    fn visible(splats: &Splats) -> Vec<usize> {
        let opaque = |row: &&[f32]| row[OPACITY_OFFSET] > 0.0;
        let of_view = |rows: &[f32]| rows.chunks_exact(SPLAT_STRIDE).filter(opaque).count();
        splats.rows.chunks_exact(SIDE * SIDE * SPLAT_STRIDE).map(of_view).collect()
    }

    #[test]
    fn what_other_photographs_show_larger_goes_first() {
        const ALL: usize = SIDE * SIDE;
        // From 4, 2 and 1: the nearer one shows a half of the side of the one before.
        let inputs = [photograph(4.0), photograph(2.0), photograph(1.0)];
        let at = |most: usize| {
            let mut splats = parents(&inputs, 1.0);
            hide_beyond(&mut splats, &inputs, most);
            visible(&splats)
        };
        assert_eq!(at(3 * ALL), [ALL; 3]);
        // Shown larger by none: all of the nearest, three quarters of the others.
        let none = [ALL * 3 / 4, ALL * 3 / 4, ALL];
        assert_eq!(at(ALL), none);
        assert_eq!(at(none.iter().sum()), none);
        // By one at most: of the farthest, not the sixteenth that both others show.
        assert_eq!(at(3 * ALL - 1), [ALL * 15 / 16, ALL, ALL]);
    }

    #[test]
    fn another_surface_and_masked_pixels_hide_nothing() {
        const ALL: usize = SIDE * SIDE;
        let mut inputs = [photograph(2.0), photograph(2.0)];
        let mut splats = parents(&inputs, 1.0);
        hide_beyond(&mut splats, &inputs, 1);
        assert_eq!(visible(&splats), [ALL, 0], "of equal ones the first stay");
        // 5 % behind the wall.
        let (mut first, second) = (parents(&inputs, 1.0), parents(&inputs, 1.05));
        first.rows.splice(ALL * SPLAT_STRIDE.., second.rows[ALL * SPLAT_STRIDE..].to_vec());
        hide_beyond(&mut first, &inputs, 1);
        assert_eq!(visible(&first), [ALL, ALL]);
        let left_half = (0..ALL).map(|i| i % SIDE < SIDE / 2).collect();
        inputs[0].input_mask = Mask::new(SIDE, SIDE, left_half);
        let mut splats = parents(&inputs, 1.0);
        hide_beyond(&mut splats, &inputs, 1);
        assert_eq!(visible(&splats), [ALL / 2, ALL / 2]);
    }
}
