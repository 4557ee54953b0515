//! Panoramas of pose files: a picture with [`Distortion::Equirectangular`] becomes several frames, pinhole views
//! in directions that all panoramas of the scene share ([`crate::files::photos::views`]).

use super::assemble::{Draft, Lens};
use super::rotations::orthonormal;
use crate::files::photos::distortion::Distortion;
use crate::files::photos::image::Probe;
use crate::files::photos::views::{Cut, has_panorama_shape, panorama_cut, shared_axes, view_label};
use crate::files::{Error, Result};
use glam::{DMat3, DMat4, DVec3};
use std::path::Path;

/// A view of a picture, as a frame has it.
#[derive(Clone, Debug)]
pub(super) struct DraftView {
    /// The view.
    pub cut: Cut,
    /// End of the frame's name.
    pub label: String,
}

/// A frame of a pose file with the header of its picture.
pub(super) type Entry = (Draft, Option<Result<Probe>>);

/// Puts the views of each panorama in its place. Other entries stay as they are. A panorama of another shape than
/// two to one becomes an entry that is refused.
pub(super) fn expanded(path: &Path, entries: Vec<Entry>) -> Vec<Entry> {
    let poses: Vec<(DMat3, DVec3)> =
        entries.iter().filter(|(draft, _)| is_panorama(draft)).map(|(d, _)| pose(d)).collect();
    if poses.is_empty() {
        return entries;
    }
    let axes = shared_axes(&poses);
    let mut all = Vec::new();
    for (draft, stored) in entries {
        match stored {
            Some(Ok(stored)) if is_panorama(&draft) => {
                all.extend(views(path, draft, &stored, &axes));
            }
            stored => all.push((draft, stored)),
        }
    }
    all
}

/// Returns whether an entry that can be used is a panorama.
fn is_panorama(draft: &Draft) -> bool {
    let finite = draft.world_from_camera.is_finite();
    draft.refused.is_none() && finite && draft.distortion == Distortion::Equirectangular
}

fn pose(draft: &Draft) -> (DMat3, DVec3) {
    let pose = orthonormal(draft.world_from_camera).pose;
    (DMat3::from_mat4(pose), pose.w_axis.truncate())
}

fn views(path: &Path, draft: Draft, stored: &Probe, axes: &[DMat3]) -> Vec<Entry> {
    let Probe { width, height, .. } = *stored;
    if !has_panorama_shape(width, height) {
        let expected = "a panorama of 360x180 degrees, twice as wide as high";
        let error = Error::format(path, expected, format!("{width}x{height}")).at(&draft.place);
        return vec![(Draft::refused(draft.file, error), None)];
    }
    let (rotation, position) = pose(&draft);
    let view = |(i, world_from_view): (usize, &DMat3)| {
        let cut = panorama_cut(width, height, rotation.transpose() * *world_from_view);
        let k = cut.view;
        let place = DMat4::from_mat3_translation(*world_from_view, position);
        let lens = Lens::Pixels([k.fx, k.fy, k.cx, k.cy].map(f64::from));
        let of_view = Draft {
            image: draft.image.clone(),
            pixels: draft.pixels,
            size: Some((width, height)),
            timestamp: draft.timestamp,
            mask: draft.mask.clone(),
            view: Some(DraftView { cut, label: view_label(i) }),
            ..Draft::new(draft.place.clone(), draft.file.clone(), lens, place)
        };
        (of_view, Some(Ok(*stored)))
    };
    axes.iter().enumerate().map(view).collect()
}
