//! The photographs that a scene is to give: their loss, and what they tell about the Gaussians.

use super::FinishError;
use super::loss::{Scored, dssim, mse};
use super::phase::LossWeights;
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use crate::scene::splats::Splats;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
#[cfg(feature = "gpu")]
use subsplat_kernels::gpu::{Gpu, GpuError, TargetPicture};
use subsplat_kernels::layout::{MEAN_OFFSET, SCALE_OFFSET, SPLAT_STRIDE};

/// A picture that the Gaussians are to give.
#[derive(Clone, Copy, Debug)]
pub struct TargetView<'a> {
    /// The picture's camera.
    pub camera: &'a Camera,
    /// The picture, of the camera's size.
    pub image: &'a Rgb,
}

/// A picture that the Gaussians are to give where its mask keeps it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MaskedView<'a> {
    pub camera: &'a Camera,
    /// The picture, of the camera's size.
    pub image: &'a Rgb,
    /// Pixels of `image` that count, of its size; `None` where all do.
    pub mask: Option<&'a Mask>,
}

impl<'a> From<TargetView<'a>> for MaskedView<'a> {
    fn from(TargetView { camera, image }: TargetView<'a>) -> Self {
        Self { camera, image, mask: None }
    }
}

impl MaskedView<'_> {
    /// Number of pixels that count.
    pub fn pixels(&self) -> usize {
        self.mask.map_or(self.image.width * self.image.height, Mask::count)
    }
}

/// `views` without masks.
pub(super) fn whole<'a>(views: &[TargetView<'a>]) -> Vec<MaskedView<'a>> {
    views.iter().map(|view| MaskedView::from(*view)).collect()
}

/// Coverage up to which a picture of some of the Gaussians does not count; above it, the weight of a
/// pixel grows linearly to 1.
pub(super) const COVERAGE_MIN: f32 = 0.7;

/// A view with its truth, which each loss converts to planes: those of fifty photographs of 0.27 megapixels are 160 MB.
pub(super) struct Target<'a> {
    pub camera: &'a Camera,
    /// The picture.
    image: &'a Rgb,
    /// Pixels that count.
    mask: Option<&'a Mask>,
    weights: LossWeights,
}

impl<'a> Target<'a> {
    /// Refuses a picture of another size than its camera. `index` names the view.
    pub fn check(index: usize, view: &MaskedView<'_>) -> Result<(), FinishError> {
        let k = view.camera.intrinsics();
        let size = (k.width, k.height);
        let of_mask = view.mask.map(|mask| (mask.width(), mask.height()));
        let sizes = [Some((view.image.width, view.image.height)), of_mask];
        if let Some((w, h)) = sizes.into_iter().flatten().find(|found| *found != size) {
            let (expected, got) = (format!("{}x{}", k.width, k.height), format!("{w}x{h}"));
            return Err(FinishError::Size { view: index, expected, got });
        }
        Ok(())
    }

    /// The target of a view.
    ///
    /// # Errors
    /// Those of [`Target::check`].
    pub fn new(
        index: usize,
        view: &MaskedView<'a>,
        weights: LossWeights,
    ) -> Result<Self, FinishError> {
        Self::check(index, view)?;
        Ok(Self { camera: view.camera, image: view.image, mask: view.mask, weights })
    }

    /// Copies the picture and its mask to a GPU.
    ///
    /// # Errors
    /// Errors of the device.
    #[cfg(feature = "gpu")]
    pub fn picture(&self, gpu: &Gpu) -> Result<TargetPicture, GpuError> {
        let Rgb { width, height, data } = self.image;
        gpu.target_picture(data, self.mask.map(Mask::kept), [*width, *height])
    }

    /// The picture as planes `[3, H, W]`.
    fn truth(&self) -> Vec<f32> {
        self.image.to_planes()
    }

    /// The loss of rendered planes `[5, H, W]`, with its gradient by R, G and B.
    pub fn loss(&self, planes: &[f32]) -> Scored {
        self.loss_to(planes, self.truth())
    }

    /// [`Target::loss`] with another `truth`. Masked pixels have no weight: the truth is the rendered picture there,
    /// and their gradient is 0. A window of SSIM that they share with others counts as a whole.
    fn loss_to(&self, planes: &[f32], mut truth: Vec<f32>) -> Scored {
        let Some(mask) = self.mask else { return self.loss_of_all(planes, &truth) };
        let kept = mask.kept();
        let masked = || (0..3 * kept.len()).filter(|i| !kept[i % kept.len()]);
        masked().for_each(|i| truth[i] = planes[i]);
        let mut loss = self.loss_of_all(planes, &truth);
        masked().for_each(|i| loss.gradient[i] = 0.0);
        loss.scaled(kept.len() as f64 / mask.count().max(1) as f64)
    }

    /// The loss of all pixels.
    fn loss_of_all(&self, planes: &[f32], truth: &[f32]) -> Scored {
        let k = self.camera.intrinsics();
        let rgb = &planes[..truth.len()];
        let mut loss = mse(rgb, truth);
        if self.weights.dssim > 0.0 {
            loss.add(&dssim(rgb, truth, k.width, k.height), self.weights.dssim);
        }
        loss
    }

    /// [`Target::loss`] where Gaussians cover the picture.
    pub fn loss_where_covered(&self, planes: &[f32]) -> Scored {
        let mut truth = self.truth();
        let pixels = truth.len() / 3;
        for (i, weight) in coverage_weights(planes, pixels).enumerate() {
            for j in [i, i + pixels, i + 2 * pixels] {
                truth[j] = planes[j] + weight * (truth[j] - planes[j]);
            }
        }
        self.loss_to(planes, truth)
    }

    /// Mean squared difference of rendered planes `[5, H, W]`.
    pub fn error(&self, planes: &[f32]) -> f64 {
        let truth = self.truth();
        let Some(mask) = self.mask else {
            return mse(&planes[..truth.len()], &truth).value;
        };
        let pixels = mask.kept().iter().cycle().zip(planes.iter().zip(&truth));
        let squares = pixels.filter(|(kept, _)| **kept).map(|(_, (a, b))| f64::from(a - b).powi(2));
        squares.sum::<f64>() / (3 * mask.count()).max(1) as f64
    }

    /// Mean squared difference of planes `[5, H, W]` where Gaussians cover the picture, 0 where they
    /// cover nothing, and the share of the picture that they cover.
    pub fn error_where_covered(&self, planes: &[f32]) -> [f64; 2] {
        let truth = self.truth();
        let pixels = truth.len() / 3;
        let (mut sum, mut weights) = (0.0, 0.0);
        let counted = self.mask.map_or(pixels, Mask::count);
        let is_kept = |i: usize| self.mask.is_none_or(|mask| mask.kept()[i]);
        let covered = coverage_weights(planes, pixels).enumerate().filter(|(i, _)| is_kept(*i));
        for (i, weight) in covered {
            let elements = [i, i + pixels, i + 2 * pixels];
            let squares = elements.map(|j| f64::from(planes[j] - truth[j]).powi(2));
            sum += f64::from(weight) * squares.iter().sum::<f64>();
            weights += 3.0 * f64::from(weight);
        }
        let error = if weights > 0.0 { sum / weights } else { 0.0 };
        [error, weights / (3 * counted).max(1) as f64]
    }
}

/// Weight of each pixel of planes `[5, H, W]` by its coverage, 0 to 1.
fn coverage_weights(planes: &[f32], pixels: usize) -> impl Iterator<Item = f32> + '_ {
    let weight = |alpha: &f32| ((alpha - COVERAGE_MIN) / (1.0 - COVERAGE_MIN)).clamp(0.0, 1.0);
    planes[3 * pixels..4 * pixels].iter().map(weight)
}

/// Returns the gradient of a loss by planes `[5, H, W]`: alpha and Σ w·z have no loss.
pub(super) fn by_planes(loss: Scored, planes: &[f32]) -> Vec<f32> {
    let mut gradient = loss.gradient;
    gradient.resize(planes.len(), 0.0);
    gradient
}

/// Size of a pixel at each Gaussian, in the photograph where it is smallest, world units.
pub(super) fn pixel_sizes(splats: &Splats, views: &[MaskedView<'_>]) -> Vec<f32> {
    let size = |mean: Vec3, camera: &Camera| {
        mean.distance(camera.position()) / camera.intrinsics().fx.max(camera.intrinsics().fy)
    };
    let rows = splats.rows.par_chunks_exact(SPLAT_STRIDE);
    rows.map(|row| {
        let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
        views.iter().map(|v| size(mean, v.camera)).fold(f32::INFINITY, f32::min)
    })
    .collect()
}

/// Marks the Gaussians that reach beyond the photographs: none of them shows all of 3σ. The part
/// that a photograph shows would shrink and move it, and leave a black strip at the edge of new views.
/// Of five photographs this costs 0.04 dB, because the others show such Gaussians from elsewhere.
pub(super) fn beyond(splats: &Splats, views: &[MaskedView<'_>]) -> Vec<bool> {
    let shown = |row: &[f32], camera: &Camera| {
        let mean = Vec3::from_slice(&row[MEAN_OFFSET..]);
        let Some(p) = camera.project(mean) else { return false };
        let k = camera.intrinsics();
        let sigma = row[SCALE_OFFSET..SCALE_OFFSET + 3].iter().fold(0.0f32, |m, s| m.max(*s));
        let reach = 3.0 * sigma * k.fx.max(k.fy) / camera.to_camera(mean).z;
        let size = Vec2::new(k.width as f32, k.height as f32);
        p.cmpge(Vec2::splat(reach)).all() && p.cmple(size - reach).all()
    };
    let rows = splats.rows.par_chunks_exact(SPLAT_STRIDE);
    rows.map(|row| !views.iter().any(|v| shown(row, v.camera))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;
    use subsplat_kernels::camera::Intrinsics;

    const SIZE: [usize; 2] = [24, 18];

    /// A camera, a picture and a mask of about two thirds of it.
    fn view() -> (Camera, Rgb, Mask) {
        let [w, h] = SIZE;
        let camera = Camera::new(Intrinsics::from_fov_x(1.0, w, h), Mat4::IDENTITY).unwrap();
        let value = |i: usize| (subsplat_kernels::layout::random::mix(i as u64) >> 56) as u8;
        let image = Rgb { width: w, height: h, data: (0..3 * w * h).map(value).collect() };
        let kept = (0..w * h).map(|i| (i % w + i / w) % 9 > 2).collect();
        (camera, image, Mask::new(w, h, kept).unwrap())
    }

    /// Rendered planes `[5, H, W]`.
    fn planes() -> Vec<f32> {
        let value = |i: u64| (subsplat_kernels::layout::random::mix(i + 9000) >> 40) as f32;
        (0..(5 * SIZE[0] * SIZE[1]) as u64).map(|i| value(i) / 2f32.powi(24)).collect()
    }

    fn target<'a>(
        camera: &'a Camera,
        image: &'a Rgb,
        mask: Option<&'a Mask>,
        dssim: f64,
    ) -> Target<'a> {
        let weights = LossWeights { dssim, across: 1.0 };
        Target::new(0, &MaskedView { camera, image, mask }, weights).unwrap()
    }

    #[test]
    fn masked_pixels_have_no_weight() {
        let (camera, image, mask) = view();
        let (pixels, planes) = (SIZE[0] * SIZE[1], planes());
        let mut other_image = image.clone();
        for (pixel, kept) in other_image.data.chunks_exact_mut(3).zip(mask.kept()) {
            if !kept {
                pixel.fill(7);
            }
        }
        for dssim in [0.0, 0.2] {
            let own = target(&camera, &image, Some(&mask), dssim);
            let other = target(&camera, &other_image, Some(&mask), dssim);
            for covered in [false, true] {
                let loss = |target: &Target<'_>| match covered {
                    false => target.loss(&planes),
                    true => target.loss_where_covered(&planes),
                };
                let scored = loss(&own);
                assert_eq!(scored, loss(&other), "what is masked does not matter");
                for (i, g) in scored.gradient.iter().enumerate() {
                    assert!(mask.kept()[i % pixels] || *g == 0.0, "{i}: {g}");
                }
                assert!(scored.gradient.iter().any(|g| *g != 0.0));
            }
        }
        // The difference alone is the mean over the pixels that count.
        let own = target(&camera, &image, Some(&mask), 0.0);
        let kept = |i: usize| mask.kept()[i % pixels];
        let truth = own.truth();
        let difference = |i: usize| f64::from(planes[i] - truth[i]);
        let mean = (0..3 * pixels).filter(|i| kept(*i)).map(|i| difference(i).powi(2)).sum::<f64>()
            / (3 * mask.count()) as f64;
        assert!((own.error(&planes) / mean - 1.0).abs() < 1e-9);
        let scored = own.loss(&planes);
        assert!((scored.value / mean - 1.0).abs() < 1e-6);
        for i in (0..3 * pixels).filter(|i| kept(*i)) {
            let slope = 2.0 * difference(i) / (3 * mask.count()) as f64;
            assert!((f64::from(scored.gradient[i]) - slope).abs() < 1e-7);
        }
    }

    /// The gradient of kept pixels is the derivative of the loss in which the truth of masked ones stays.
    #[test]
    fn gradients_of_kept_pixels_are_derivatives() {
        let (camera, image, mask) = view();
        let own = target(&camera, &image, Some(&mask), 0.2);
        let (pixels, planes) = (SIZE[0] * SIZE[1], planes());
        let scored = own.loss(&planes);
        for i in (0..3 * pixels).step_by(37).filter(|i| mask.kept()[i % pixels]) {
            let at = |step: f32| {
                let mut moved = planes.clone();
                moved[i] += step;
                own.loss(&moved).value
            };
            let slope = (at(4e-3) - at(-4e-3)) / 8e-3;
            let got = f64::from(scored.gradient[i]);
            assert!((got - slope).abs() < 2e-2 * slope.abs().max(5e-4), "{i}: {got} {slope}");
        }
    }

    #[test]
    fn errors_count_kept_pixels_alone() {
        let (camera, image, mask) = view();
        let pixels = SIZE[0] * SIZE[1];
        let mut planes = planes();
        planes[3 * pixels..4 * pixels].fill(1.0);
        let masked = target(&camera, &image, Some(&mask), 0.0);
        let [error, covered] = masked.error_where_covered(&planes);
        assert!((error / masked.error(&planes) - 1.0).abs() < 1e-6 && (covered - 1.0).abs() < 1e-6);
        // A mask that keeps all changes nothing.
        let all = Mask::new(SIZE[0], SIZE[1], vec![true; pixels]).unwrap();
        let (whole, all) =
            (target(&camera, &image, None, 0.2), target(&camera, &image, Some(&all), 0.2));
        assert_eq!(whole.loss(&planes), all.loss(&planes));
        assert_eq!(whole.error_where_covered(&planes), all.error_where_covered(&planes));
        assert!((whole.error(&planes) / all.error(&planes) - 1.0).abs() < 1e-9);
        // Another size is an error.
        let small = Mask::new(2, 2, vec![true; 4]).unwrap();
        let view = MaskedView { camera: &camera, image: &image, mask: Some(&small) };
        let error = Target::check(3, &view).unwrap_err().to_string();
        assert_eq!(error, "view 3: expected a picture of 24x18, got 2x2");
    }
}
