//! Level of detail of the Gaussians in the window: far parts of a scene are drawn with fewer, merged
//! Gaussians ([`subsplat::scene::levels`]).
//!
//! A background thread makes the levels after the first picture, then the Gaussians of a selection for
//! the camera. Meanwhile the window draws those of the selection before, or all.

use anyhow::{Error, Result};
use std::sync::Arc;
use subsplat::scene::levels::{CELL_PX, Levels, Selection};
use subsplat::scene::render::slices;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu::{Gpu, Scene};

/// Factor of the cells' largest width for a selection made in advance: a camera that approaches keeps it
/// for a while.
const AHEAD: f32 = 0.8;
/// Gaussians that a selection may have in place of one, where all of its blocks are as fine.
const MORE: usize = 2;

/// Agreement of the drawn Gaussians with the camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fit {
    /// Those of the camera's selection: the picture depends on the camera only.
    Exact,
    /// As fine as the camera's selection, or finer: fewer selections during a movement.
    Fine,
}

/// Levels of one scene, and a selection of them in device memory.
pub struct Detail {
    splats: Arc<Splats>,
    levels: Option<Arc<Levels>>,
    drawn: Option<(Selection, Scene)>,
    /// True if a task is not finished.
    busy: bool,
}

/// Work that takes longer than a frame.
pub enum Task {
    /// Makes the levels.
    Levels(Arc<Splats>),
    /// Copies the Gaussians of a selection to the device.
    Draw(Arc<Splats>, Arc<Levels>, Selection),
}

/// Result of a task.
pub enum Outcome {
    Levels(Arc<Levels>),
    Drawn(Selection, Scene),
    /// The device has no memory for the selection, for example.
    Failed(Error),
}

impl Task {
    /// Runs the task.
    pub fn run(self, gpu: &Arc<Gpu>) -> Outcome {
        match self {
            Self::Levels(splats) => Outcome::Levels(Arc::new(Levels::new(&splats))),
            Self::Draw(splats, levels, selection) => {
                let upload = || -> Result<Scene> {
                    let chosen = levels.gather(&splats, &selection)?;
                    Ok(gpu.upload_splats(&slices(&chosen))?)
                };
                upload().map_or_else(Outcome::Failed, |scene| Outcome::Drawn(selection, scene))
            }
        }
    }
}

impl Detail {
    /// Starts without levels.
    pub fn new(splats: Splats) -> Self {
        Self { splats: Arc::new(splats), levels: None, drawn: None, busy: false }
    }

    /// Returns the selection for a camera; `None` where all Gaussians are drawn.
    fn wanted(&self, camera: &Camera) -> Option<Selection> {
        let wanted = self.levels.as_ref()?.select(camera, CELL_PX);
        (!wanted.is_whole()).then_some(wanted)
    }

    /// Returns the Gaussians to draw instead of all. [`Fit::Fine`] includes those of an older
    /// selection.
    pub fn scene(&self, camera: &Camera, fit: Fit) -> Option<&Scene> {
        let wanted = self.wanted(camera)?;
        let (drawn, scene) = self.drawn.as_ref()?;
        (fit == Fit::Fine || *drawn == wanted).then_some(scene)
    }

    /// Returns the work that is missing for a camera; `None` while other work goes on.
    pub fn missing(&mut self, camera: &Camera, fit: Fit) -> Option<Task> {
        if self.busy {
            return None;
        }
        let task = match &self.levels {
            None => Task::Levels(self.splats.clone()),
            Some(levels) => {
                let wanted = self.wanted(camera)?;
                let fits = |(drawn, _): &(Selection, Scene)| match fit {
                    Fit::Exact => *drawn == wanted,
                    Fit::Fine => drawn.covers(&wanted) && drawn.len() <= MORE * wanted.len(),
                };
                if self.drawn.as_ref().is_some_and(fits) {
                    return None;
                }
                let ahead = match fit {
                    Fit::Exact => None,
                    Fit::Fine => Some(levels.select(camera, AHEAD * CELL_PX)),
                };
                let fine =
                    |ahead: &Selection| !ahead.is_whole() && ahead.len() <= MORE * wanted.len();
                let selection = ahead.filter(fine).unwrap_or(wanted);
                Task::Draw(self.splats.clone(), levels.clone(), selection)
            }
        };
        self.busy = true;
        Some(task)
    }

    /// Takes the result of a task.
    ///
    /// # Errors
    /// The task failed. The levels then stay without effect.
    pub fn finish(&mut self, outcome: Outcome) -> Result<()> {
        match outcome {
            Outcome::Levels(levels) => self.levels = Some(levels),
            Outcome::Drawn(selection, scene) => self.drawn = Some((selection, scene)),
            Outcome::Failed(e) => {
                // No further task follows.
                self.drawn = None;
                return Err(e);
            }
        }
        self.busy = false;
        Ok(())
    }

    /// Runs the missing work for a camera at once.
    ///
    /// # Errors
    /// As [`Detail::finish`].
    pub fn complete(&mut self, camera: &Camera, gpu: &Arc<Gpu>) -> Result<()> {
        while let Some(task) = self.missing(camera, Fit::Exact) {
            self.finish(task.run(gpu))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Mat4, Vec3};
    use subsplat_kernels::camera::Intrinsics;
    use subsplat_kernels::gpu::{DeviceChoice, Rasterizer};
    use subsplat_kernels::layout::{RasterOptions, ShBasis};

    const SIDE: usize = 64;

    /// A wall of 64×64 Gaussians at z = 1, and a camera `distance` before it.
    fn wall() -> Splats {
        let at = |i: usize| i as f32 / SIDE as f32 - 0.5;
        let row = |i: usize| {
            [at(i % SIDE), at(i / SIDE), 1.0, 1.0, 0.0, 0.0, 0.0, 0.01, 0.01, 0.001, 0.8]
        };
        let rows = (0..SIDE * SIDE).flat_map(row).collect();
        let sh = (0..3 * SIDE * SIDE).map(|i| (i % 300) as f32 / 300.0 - 0.5).collect();
        Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap()
    }

    fn camera(distance: f32) -> Camera {
        let f = SIDE as f32;
        let c = 0.5 * SIDE as f32;
        let k = Intrinsics { fx: f, fy: f, cx: c, cy: c, width: SIDE, height: SIDE };
        Camera::new(k, Mat4::from_translation(Vec3::Z * (1.0 - distance))).unwrap()
    }

    #[test]
    fn a_far_camera_draws_fewer_and_a_near_one_all() {
        let Some(gpu) = Gpu::open(&DeviceChoice::Gpu).unwrap() else {
            assert!(std::env::var("SUBSPLAT_GPU").as_deref() != Ok("require"), "no GPU");
            return;
        };
        let splats = wall();
        let far = camera(8.0);
        let near = camera(0.5);
        let mut detail = Detail::new(splats.clone());
        // The first task makes the levels; no second one begins before it is finished.
        assert!(detail.scene(&far, Fit::Exact).is_none());
        let task = detail.missing(&far, Fit::Fine).unwrap();
        assert!(matches!(task, Task::Levels(_)) && detail.missing(&far, Fit::Fine).is_none());
        detail.finish(task.run(&gpu)).unwrap();
        // The camera near the wall shows all of it.
        assert!(
            detail.missing(&near, Fit::Fine).is_none() && detail.scene(&near, Fit::Fine).is_none()
        );
        detail.complete(&far, &gpu).unwrap();
        let scene = detail.scene(&far, Fit::Exact).unwrap();
        let count = scene.len();
        assert!(2 * count < splats.len(), "{count}");
        let mut rasterizer = Rasterizer::new(gpu.clone());
        let options = RasterOptions { sh_basis: ShBasis::Standard, ..RasterOptions::default() };
        let fewer = rasterizer.render_scene(scene, &far, &options).unwrap();
        let all = rasterizer.render(&slices(&splats), &far, &options).unwrap();
        let likeness = subsplat::scene::metrics::psnr(&fewer.rgb, &all.rgb, SIDE, SIDE).unwrap();
        assert!(likeness >= 35.0, "{likeness:.1} dB");
        assert!(detail.missing(&far, Fit::Fine).is_none());
        // A camera that approaches needs finer Gaussians; the older ones are drawn meanwhile.
        let nearer = camera(4.0);
        let task = detail.missing(&nearer, Fit::Fine).unwrap();
        assert_eq!(detail.scene(&nearer, Fit::Fine).unwrap().len(), count);
        assert!(detail.scene(&nearer, Fit::Exact).is_none());
        detail.finish(task.run(&gpu)).unwrap();
        assert!(detail.scene(&nearer, Fit::Fine).unwrap().len() > count);
        assert!(detail.missing(&nearer, Fit::Fine).is_none());
        // A failure ends the tasks, and all Gaussians are drawn.
        let task = detail.missing(&far, Fit::Exact).unwrap();
        drop(task);
        assert!(detail.finish(Outcome::Failed(Error::msg("no memory"))).is_err());
        assert!(
            detail.scene(&far, Fit::Exact).is_none() && detail.missing(&far, Fit::Exact).is_none()
        );
    }
}
