//! The score of photographs that the scene is not made from, over the time of its refinement.

use anyhow::Result;
use serde::Serialize;
use std::time::{Duration, Instant};
use subsplat::SceneSoFar;
use subsplat::reconstruct::Stage;
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::scene::render::Renderer;
use subsplat::scene::score::psnr_of_kept;

/// Most photographs of a score.
pub const PHOTOGRAPHS: usize = 4;
/// Least time between two scores, in times of the last score itself: a score takes a twentieth of the refinement.
const BETWEEN: u32 = 20;
/// Factor of the times of two scores, at least: their number grows with the logarithm of the time.
const GROWTH: f32 = 1.4;

/// A score during the refinement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Point {
    /// Since the first step, without the time of the scores.
    pub seconds: f32,
    /// Steps so far.
    pub steps: usize,
    /// Mean over the photographs, dB.
    pub psnr: f64,
}

/// Scores so far.
pub struct Curve {
    views: Vec<Cropped>,
    points: Vec<Point>,
    begun: Option<Instant>,
    /// Time of the scores.
    scoring: Duration,
    /// Time of the next score, since the first step without that of the scores.
    next: Duration,
}

impl Curve {
    /// A curve of the photographs `views`, at the target's size; without any, it stays empty.
    pub fn new(views: Vec<Cropped>) -> Self {
        let (scoring, next) = (Duration::ZERO, Duration::ZERO);
        Self { views, points: Vec::new(), begun: None, scoring, next }
    }

    /// The scores.
    pub fn into_points(self) -> Vec<Point> {
        self.points
    }

    /// Scores a scene that is being refined, where it is time to.
    ///
    /// # Errors
    /// A photograph of another size than its camera.
    pub fn follow(&mut self, scene: &SceneSoFar<'_>) -> Result<()> {
        if self.views.is_empty() || scene.stage() != Stage::Refine {
            return Ok(());
        }
        let now = Instant::now();
        let begun = *self.begun.get_or_insert(now);
        let so_far = now.duration_since(begun).saturating_sub(self.scoring);
        if so_far < self.next {
            return Ok(());
        }
        let psnr = self.score(scene)?;
        self.points.push(Point { seconds: so_far.as_secs_f32(), steps: scene.steps(), psnr });
        let took = now.elapsed();
        self.scoring += took;
        self.next = so_far.mul_f32(GROWTH).max(so_far + BETWEEN * took);
        Ok(())
    }

    fn score(&self, scene: &SceneSoFar<'_>) -> Result<f64> {
        let (splats, options) = (scene.splats(), scene.raster_options());
        let mut renderer = Renderer::default();
        let mut sum = 0.0;
        for view in &self.views {
            let picture = renderer.render(&splats, &view.target_camera, &options);
            let size = (picture.width, picture.height);
            let (truth, mask) = (view.target.to_unit(), view.target_mask.as_ref());
            sum += psnr_of_kept(&picture.rgb, &truth, size, mask)?;
        }
        Ok(sum / self.views.len() as f64)
    }
}
