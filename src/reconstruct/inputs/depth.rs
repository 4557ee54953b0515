//! near and far that a scene itself gives: its pose file; 1 and 100 for RealEstate10K, as
//! pixelSplat and MVSplat use them; quantiles of its sparse points; else the baseline of the
//! context views. `src/reconstruct/depth_range.rs` has the whole order of sources.
//!
//! Depth candidates are uniform in 1/depth between the two. A far end that is too far costs
//! little; a near end that is too near costs resolution everywhere.

use super::pair::{points_in_view, quantile};
use crate::files::scene::{Scene, Units};
use crate::files::{Error, Result};
use subsplat_kernels::camera::NearFar;

/// The depth range that a scene's files and cameras give, with its origin.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneDepthRange {
    /// Nearest depth, world units of camera z.
    pub near: f32,
    /// Farthest depth.
    pub far: f32,
    /// Where the numbers come from, for the user.
    pub reason: String,
    /// A number comes from nothing but the baseline: matched points know better.
    pub guessed: bool,
}

/// Fewer sparse points than this in the context views say nothing.
const POINTS_MIN: usize = 20;

/// Determines near and far for the context frames `context` of `scene`. The caller may fix
/// either end.
///
/// # Errors
/// A given value that is not above 0, or near not below far; a frame that the scene
/// does not have; nothing to derive them from (all eyes at one place).
pub fn depth_range(
    scene: &Scene,
    context: &[usize],
    near: Option<f32>,
    far: Option<f32>,
) -> Result<SceneDepthRange> {
    let derived = match (near, far) {
        (Some(near), Some(far)) => {
            SceneDepthRange { near, far, reason: "as given".to_owned(), guessed: false }
        }
        _ => {
            let d = derive(scene, context)?;
            let reason = match (near, far) {
                (Some(_), _) => format!("near as given, far {}", d.reason),
                (_, Some(_)) => format!("far as given, near {}", d.reason),
                _ => d.reason,
            };
            let (near, far) = (near.unwrap_or(d.near), far.unwrap_or(d.far));
            SceneDepthRange { near, far, reason, guessed: d.guessed }
        }
    };
    let SceneDepthRange { near, far, .. } = derived;
    if !NearFar::new(near, far).is_valid() {
        let got = format!("near {near}, far {far} ({})", derived.reason);
        return Err(Error::format(&scene.name, "0 < near < far", got));
    }
    Ok(derived)
}

fn derive(scene: &Scene, context: &[usize]) -> Result<SceneDepthRange> {
    if let Some(NearFar { near, far }) = scene.near_far {
        return Ok(SceneDepthRange {
            near,
            far,
            reason: "from the pose file".to_owned(),
            guessed: false,
        });
    }
    if scene.units == Units::RealEstate10k {
        let reason = "RealEstate10K's usual range".to_owned();
        let NearFar { near, far } = NearFar::RE10K;
        return Ok(SceneDepthRange { near, far, reason, guessed: false });
    }
    let mut cameras = Vec::with_capacity(context.len());
    for &i in context {
        let frame = scene.frames.get(i).ok_or_else(|| {
            let expected = format!("frame indices below {}", scene.frames.len());
            Error::format(&scene.name, expected, i.to_string())
        })?;
        cameras.push(&frame.camera);
    }
    if let Some(points) = &scene.points {
        let mut depths: Vec<f32> = cameras.iter().flat_map(|c| points_in_view(c, points)).collect();
        if depths.len() >= POINTS_MIN {
            // A margin for what has no point: a third nearer than the 2 % quantile,
            // twice as far as the 98 % one. Stray points lie outside the quantiles.
            let near = quantile(&mut depths, 0.02) / 1.5;
            let far = quantile(&mut depths, 0.98) * 2.0;
            let reason = format!("from {} depths of sparse points", depths.len());
            return Ok(SceneDepthRange { near, far, reason, guessed: false });
        }
    }
    let mut baseline = 0.0f32;
    for (i, a) in cameras.iter().enumerate() {
        for b in &cameras[i + 1..] {
            baseline = baseline.max(a.position().distance(b.position()));
        }
    }
    if !(baseline > 0.0 && baseline.is_finite()) {
        return Err(Error::format(
            &scene.name,
            "context views at different places, or near and far given",
            format!("a baseline of {baseline}"),
        ));
    }
    let reason = format!("half and 30 times the baseline of {baseline:.4}");
    Ok(SceneDepthRange { near: 0.5 * baseline, far: 30.0 * baseline, reason, guessed: true })
}
