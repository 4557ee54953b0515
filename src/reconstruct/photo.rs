//! A photograph with its camera.

use super::{Error, Result};
use crate::files::photos::image::LoadOptions;
use crate::files::photos::photograph::Photograph;
use crate::files::poses::scene::{Frame, LoadedFrame};
use crate::reconstruct::inputs::crop::{CropOptions, Cropped, crop_masked};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use std::path::Path;
use std::sync::Arc;
use subsplat_kernels::camera::{Camera, Size};

/// A photograph without lens distortion, and its pinhole camera. Clones share the pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    image: Arc<Rgb>,
    /// Pixels that count, of the picture's size.
    mask: Option<Arc<Mask>>,
    camera: Camera,
    /// The picture of which this is a view, as those of a panorama are.
    view_of: Option<Arc<Path>>,
}

impl Photo {
    /// Combines pixels (an [`Rgb`] or an `image::RgbImage`) with their camera.
    ///
    /// # Errors
    /// The buffer does not hold 3·W·H bytes; the camera has another picture size.
    pub fn new(image: impl Into<Rgb>, camera: Camera) -> Result<Self> {
        let image = image.into();
        let Rgb { width, height, data } = &image;
        let bytes = width.checked_mul(*height).and_then(|n| n.checked_mul(3));
        if bytes != Some(data.len()) {
            let expected = format!("3 bytes for each of {width}x{height} pixels");
            return Err(Error::argument("photograph", expected, format!("{} bytes", data.len())));
        }
        let k = camera.intrinsics();
        if (k.width, k.height) != (*width, *height) {
            let expected = format!("a camera of {width}x{height} pixels");
            let got = format!("one of {}x{}", k.width, k.height);
            return Err(Error::argument("photograph", expected, got));
        }
        Ok(Self { image: Arc::new(image), mask: None, camera, view_of: None })
    }

    /// The same photograph with a mask. Masked pixels make no Gaussians and have no weight in the optimisation, and
    /// no points are matched there.
    ///
    /// # Errors
    /// A mask of another size than the photograph's, or that keeps no pixel.
    pub fn with_mask(self, mask: Mask) -> Result<Self> {
        let expected =
            format!("one of {}x{} that keeps pixels", self.image.width, self.image.height);
        if !mask.fits(&self.image) {
            let got = format!("one of {}x{}", mask.width(), mask.height());
            return Err(Error::argument("mask", expected, got));
        }
        if mask.keeps_none() {
            return Err(Error::argument("mask", expected, "one that keeps none"));
        }
        Ok(Self { mask: (!mask.keeps_all()).then(|| Arc::new(mask)), ..self })
    }

    /// Decodes a frame's picture and removes its lens distortion.
    ///
    /// # Errors
    /// Those of [`Frame::load`].
    pub fn from_frame(frame: &Frame) -> Result<Self> {
        Self::from_frame_with(frame, &LoadOptions::default())
    }

    /// [`Photo::from_frame`] with options of the decoding.
    ///
    /// # Errors
    /// Those of [`Frame::load_with`].
    pub fn from_frame_with(frame: &Frame, options: &LoadOptions) -> Result<Self> {
        Ok(Self::from_loaded(frame.load_with(options)?))
    }

    /// Takes over picture, mask and camera of a frame. Its warnings are the caller's matter.
    pub fn from_loaded(frame: LoadedFrame) -> Self {
        let LoadedFrame { picture, mask, camera, view_of, .. } = frame;
        let (mask, view_of) = (mask.map(Arc::new), view_of.map(Arc::from));
        Self { image: Arc::new(picture), mask, camera, view_of }
    }

    /// The same pixels with the pose of another camera; the intrinsics stay.
    pub(super) fn with_pose_of(&self, camera: &Camera) -> Result<Self> {
        self.with_camera(Camera::new_unchecked(
            self.camera.intrinsics(),
            camera.world_from_camera(),
        ))
    }

    /// The same pixels with another camera of their size.
    pub fn with_camera(&self, camera: Camera) -> Result<Self> {
        let camera = Camera::new(camera.intrinsics(), camera.world_from_camera())?;
        Ok(Self { camera, ..self.clone() })
    }

    /// The size.
    pub fn size(&self) -> Size {
        Size::new(self.image.width, self.image.height)
    }

    /// The pixels.
    pub fn image(&self) -> &Rgb {
        &self.image
    }

    /// Pixels that count; `None` where all do.
    pub fn mask(&self) -> Option<&Mask> {
        self.mask.as_deref()
    }

    /// The picture of which this is a view; `None` for a whole photograph.
    pub(super) fn view_of(&self) -> Option<&Path> {
        self.view_of.as_deref()
    }

    /// Pinhole camera of these pixels.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Crops and resizes the photograph to the network's input and to the target picture.
    ///
    /// # Errors
    /// Those of [`crop_masked`].
    pub fn crop(&self, options: &CropOptions) -> Result<Cropped> {
        Ok(crop_masked(&self.image, self.mask(), &self.camera, options)?)
    }
}

/// Photographs of one place, with their cameras or without: the input of
/// [`Reconstructor::run`](super::Reconstructor::run). Slices, arrays and vectors convert into it.
#[derive(Debug)]
pub enum Photographs<'a> {
    /// Photographs with cameras.
    WithCameras(&'a [Photo]),
    /// Photographs whose cameras are estimated.
    WithoutCameras(Vec<Photograph>),
}

impl<'a> From<&'a [Photo]> for Photographs<'a> {
    fn from(photos: &'a [Photo]) -> Self {
        Self::WithCameras(photos)
    }
}

impl<'a> From<&'a Vec<Photo>> for Photographs<'a> {
    fn from(photos: &'a Vec<Photo>) -> Self {
        Self::WithCameras(photos)
    }
}

impl<'a, const N: usize> From<&'a [Photo; N]> for Photographs<'a> {
    fn from(photos: &'a [Photo; N]) -> Self {
        Self::WithCameras(photos)
    }
}

impl From<Vec<Photograph>> for Photographs<'_> {
    fn from(photographs: Vec<Photograph>) -> Self {
        Self::WithoutCameras(photographs)
    }
}

impl<const N: usize> From<[Photograph; N]> for Photographs<'_> {
    fn from(photographs: [Photograph; N]) -> Self {
        Self::WithoutCameras(photographs.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat4;
    use subsplat_kernels::camera::Intrinsics;

    #[test]
    fn pixels_and_camera_must_fit() {
        let camera =
            Camera::new(Intrinsics::from_fov_x(1.0, 4, 3), Mat4::IDENTITY).expect("a valid camera");
        assert!(Photo::new(Rgb::black(4, 3), camera).is_ok());
        assert!(Photo::new(image::RgbImage::new(4, 3), camera).is_ok());
        let cut = Rgb { data: vec![0; 35], ..Rgb::black(4, 3) };
        for (photo, words) in [
            (
                Photo::new(Rgb::black(3, 4), camera),
                "expected a camera of 3x4 pixels, got one of 4x3",
            ),
            (Photo::new(cut, camera), "4x3 pixels, got 35 bytes"),
        ] {
            let error = photo.unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
