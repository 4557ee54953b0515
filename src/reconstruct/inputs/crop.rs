//! From a photograph of any size to the network's input and the target picture.
//!
//! The evaluation protocol (MVSplat's crop shim; SubSplat's evaluation at r times the
//! input): resize with PIL's LANCZOS so that the picture covers the wanted size,
//! `round()`; crop the middle, the offset rounded down. Resizing to input and target
//! independently gives two crops whose origins disagree by up to half an input pixel,
//! so the high-resolution crop is made first, and the input is its reduction by the
//! integer r: pixel (i, j) of the input then covers exactly r × r pixels of the target.
//!
//! Intrinsics follow every step (fx by the resampled width over the photograph's, fy by
//! the height: the rounding makes them differ slightly). [`CropRule`] says what becomes
//! of the principal point, and of a dark frame (`frame.rs`).

use super::frame;
use crate::files::photos::resize::{Filter, Window, resize, resize_window};
use crate::files::{Error, Result};
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::Vec2;
use subsplat_kernels::camera::{Camera, CameraError, Intrinsics, Size};

/// Rule for the principal point of a crop, and for a photograph's dark frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CropRule {
    /// It moves with the pixels: exact for any camera. A dark frame, a few black pixels along the sides
    /// that a correction of lens distortion leaves, is filled with the pixels inside it.
    #[default]
    Exact,
    /// Its fraction of the width and height stays, as MVSplat's shim has it: what the
    /// public weights were trained and measured with. For a centred principal point it
    /// differs from `Exact` by the half pixel that an odd offset is rounded down by;
    /// for others it is wrong. A dark frame stays.
    Mvsplat,
}

/// From what the input is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LrFrom {
    /// From the high-resolution crop, reduced by r.
    #[default]
    HrCrop,
    /// From the photograph, as MVSplat's shim: misaligned with the target by up to half
    /// an input pixel.
    Independent,
}

/// Largest side of a picture, px: beyond every use, and no product of sides overflows.
const SIDE_MAX: usize = 1 << 15;

/// Options of a crop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CropOptions {
    /// Size of the network's input.
    pub input_size: Size,
    /// Size of the target. Any: r times the input's sides in the paper.
    pub target_size: Size,
    /// The input's sides are cut to multiples of this.
    pub stride: usize,
    /// Principal point.
    pub rule: CropRule,
    /// Source of the input.
    pub lr_from: LrFrom,
}

impl CropOptions {
    /// Square input of `side` pixels, exact intrinsics, input from the target's crop.
    pub fn square(side: usize, upscale: usize, stride: usize) -> Self {
        Self::new(Size::new(side, side), upscale, stride)
    }

    /// Input of `input_size` pixels, a target of `upscale` times its sides, exact intrinsics, input
    /// from the target's crop.
    pub fn new(input_size: Size, upscale: usize, stride: usize) -> Self {
        let Size { width: w, height: h } = input_size;
        Self {
            input_size,
            target_size: Size::new(w.saturating_mul(upscale), h.saturating_mul(upscale)),
            stride,
            rule: CropRule::default(),
            lr_from: LrFrom::default(),
        }
    }
}

/// Position of a picture in its photograph: photo px = origin + scale · picture px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotoWindow {
    /// Photograph pixels per picture pixel.
    pub scale: Vec2,
    /// Corner of the picture, photograph pixels.
    pub origin: Vec2,
}

impl PhotoWindow {
    /// Position in the picture to position in the photograph, px (centres at +0.5).
    pub fn to_photo(self, px: Vec2) -> Vec2 {
        self.origin + self.scale * px
    }
}

/// A photograph's input and target.
#[derive(Clone, Debug, PartialEq)]
pub struct Cropped {
    /// The network's input. Masked pixels are filled from those around.
    pub input: Rgb,
    /// Pixels of `input` that count: those of which more than half of the area does. `None` where all do.
    pub input_mask: Option<Mask>,
    /// Camera of `input`.
    pub input_camera: Camera,
    /// The photograph at the size of the target: what the rendered picture is compared with.
    pub target: Rgb,
    /// Pixels of `target` that count, as [`Cropped::input_mask`].
    pub target_mask: Option<Mask>,
    /// Camera of `target`.
    pub target_camera: Camera,
    /// Position of `target` in the photograph.
    pub window: PhotoWindow,
    /// Largest width of the photograph's dark frame, which was filled; px of the photograph, 0 without one.
    pub frame: usize,
}

impl Cropped {
    /// Returns target pixels per input pixel: the geometric mean of both axes.
    pub fn ratio(&self) -> f32 {
        let area = |p: &Rgb| (p.width * p.height).max(1) as f32;
        (area(&self.target) / area(&self.input)).sqrt()
    }

    /// Mean of the mean colours of `inputs` where their masks keep them, value / 255.
    pub fn mean_colour(inputs: &[Self]) -> [f32; 3] {
        Rgb::mean_colour_of_kept(inputs.iter().map(|c| (&c.input, c.input_mask.as_ref())))
    }

    /// The photograph at `size` instead of the target's, and its camera.
    ///
    /// # Errors
    /// A size that no camera can have.
    pub fn resized(&self, Size { width, height }: Size) -> Result<(Rgb, Camera)> {
        let k = self.target_camera.intrinsics().resized(width, height);
        let camera = with_intrinsics(&self.target_camera, k)?;
        Ok((resize(&self.target, width, height, Filter::Lanczos), camera))
    }

    /// The mask of the picture of [`Cropped::resized`]; `None` where all of its pixels count.
    pub fn resized_mask(&self, Size { width, height }: Size) -> Option<Mask> {
        let mask = self.target_mask.as_ref()?.resized(width, height);
        (!mask.keeps_all()).then_some(mask)
    }
}

/// Resize and crop of one picture: the resampled size, the window's corner in it, and
/// the window's size, px.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Plan {
    full: (usize, usize),
    origin: (usize, usize),
    size: (usize, usize),
}

/// Half the difference, rounded down (the window's offset).
fn middle(outer: usize, inner: usize) -> usize {
    (outer - inner) / 2
}

impl Plan {
    /// Cover `wanted` with the photograph, crop the middle, then the middle of that to
    /// `size`, both of which are multiples of `unit`, in whole units.
    fn new(
        photo: (usize, usize),
        wanted: (usize, usize),
        size: (usize, usize),
        unit: usize,
    ) -> Self {
        let (w, h) = photo;
        let scale = (wanted.0 as f64 / w as f64).max(wanted.1 as f64 / h as f64);
        // Python's round(), half to even, as the shim has it. The larger ratio times its
        // own side can fall a hair short of the wanted size.
        let side =
            |n: usize, least: usize| ((n as f64 * scale).round_ties_even() as usize).max(least);
        let full = (side(w, wanted.0), side(h, wanted.1));
        let offset = |full: usize, wanted: usize, size: usize| {
            middle(full, wanted) + unit * middle(wanted / unit, size / unit)
        };
        let origin = (offset(full.0, wanted.0, size.0), offset(full.1, wanted.1, size.1));
        Self { full, origin, size }
    }

    fn picture(&self, photo: &Rgb) -> Rgb {
        let pair = |v: (usize, usize)| [v.0, v.1];
        let (full, origin) = (pair(self.full), pair(self.origin));
        let window = Window { full, origin, size: pair(self.size) };
        resize_window(photo, &window, Filter::Lanczos)
    }

    fn intrinsics(&self, photo: &Intrinsics, rule: CropRule) -> Intrinsics {
        let scaled = photo.resized(self.full.0, self.full.1);
        let (left, top) = (self.origin.0 as f32, self.origin.1 as f32);
        let exact = scaled.cropped(left, top, self.size.0, self.size.1);
        match rule {
            CropRule::Exact => exact,
            CropRule::Mvsplat => {
                let [_, _, cx, cy] = photo.normalised();
                Intrinsics { cx: cx * self.size.0 as f32, cy: cy * self.size.1 as f32, ..exact }
            }
        }
    }

    /// The mask of the window as a picture of `size`.
    fn mask(&self, photo: &Mask, size: (usize, usize)) -> Mask {
        let PhotoWindow { scale, origin } = self.window((photo.width(), photo.height()));
        let extent = Vec2::new(self.size.0 as f32, self.size.1 as f32) * scale;
        let [origin, extent] = [origin, extent].map(|v| v.as_dvec2().to_array());
        photo.part(origin, extent, size.0, size.1)
    }

    fn window(&self, photo: (usize, usize)) -> PhotoWindow {
        let full = Vec2::new(self.full.0 as f32, self.full.1 as f32);
        let scale = Vec2::new(photo.0 as f32, photo.1 as f32) / full;
        let origin = Vec2::new(self.origin.0 as f32, self.origin.1 as f32) * scale;
        PhotoWindow { scale, origin }
    }
}

/// Input and target of one pinhole photograph.
///
/// # Errors
/// A size below one stride or above what a picture may have; a target without pixels; a camera
/// that is not the photograph's, or whose focal lengths leave the range of f32.
pub fn crop(photo: &Rgb, camera: &Camera, options: &CropOptions) -> Result<Cropped> {
    crop_masked(photo, None, camera, options)
}

/// [`crop`] of a photograph with a mask of its pixels.
///
/// # Errors
/// Those of [`crop`]; a mask of another size than the photograph's, or that keeps nothing of the crop.
pub fn crop_masked(
    photo: &Rgb,
    mask: Option<&Mask>,
    camera: &Camera,
    options: &CropOptions,
) -> Result<Cropped> {
    let k = &camera.intrinsics();
    let bad = |expected: String, got: String| Err(Error::format("crop", expected, got));
    let stride = options.stride.max(1);
    let Size { width: w, height: h } = options.input_size;
    let Size { width: target_w, height: target_h } = options.target_size;
    if (k.width, k.height) != (photo.width, photo.height) || photo.data.is_empty() {
        let got = format!("one for {}x{}", k.width, k.height);
        return bad(format!("a camera for {}x{} pixels", photo.width, photo.height), got);
    }
    let input_sides = stride..=SIDE_MAX;
    let target_sides = 1..=SIDE_MAX;
    if ![w, h].iter().all(|side| input_sides.contains(side)) {
        let expected = format!("input sides of {stride} to {SIDE_MAX} pixels");
        return bad(expected, format!("{w}x{h}"));
    }
    if ![target_w, target_h].iter().all(|side| target_sides.contains(side)) {
        let expected = format!("target sides of 1 to {SIDE_MAX} pixels (the input is {w}x{h})");
        return bad(expected, format!("{target_w}x{target_h}"));
    }
    if let Some(mask) = mask.filter(|mask| !mask.fits(photo)) {
        let expected = format!("a mask of {}x{} pixels", photo.width, photo.height);
        return bad(expected, format!("{}x{}", mask.width(), mask.height()));
    }
    let unmasked = mask.map(|mask| mask.filled(photo));
    let photo = unmasked.as_ref().unwrap_or(photo);
    let filled = (options.rule == CropRule::Exact).then(|| frame::filled(photo)).flatten();
    let (photo, frame) = filled.as_ref().map_or((photo, 0), |(filled, lines)| (filled, *lines));
    let input_size = (w - w % stride, h - h % stride);
    let size = (photo.width, photo.height);
    // The target loses the same share as the input. At whole upscales the window lies in whole
    // pixels of the input, as in MVSplat.
    let cut = |target: usize, whole: usize, cut: usize| (target * cut + whole / 2) / whole;
    let target_size = (cut(target_w, w, input_size.0), cut(target_h, h, input_size.1));
    let r = target_w / w;
    let unit = if (target_w, target_h) == (w * r, h * r) { r } else { 1 };
    let plan = Plan::new(size, (target_w, target_h), target_size, unit);
    let target = plan.picture(photo);
    let target_k = plan.intrinsics(k, options.rule);
    let (input, input_k, input_plan) = match options.lr_from {
        LrFrom::HrCrop => {
            let reduced = resize(&target, input_size.0, input_size.1, Filter::Lanczos);
            (reduced, target_k.resized(input_size.0, input_size.1), plan)
        }
        LrFrom::Independent => {
            let plan = Plan::new(size, (w, h), input_size, 1);
            (plan.picture(photo), plan.intrinsics(k, options.rule), plan)
        }
    };
    let input_mask = mask.map(|mask| input_plan.mask(mask, input_size));
    let target_mask = mask.map(|mask| plan.mask(mask, target_size));
    if [&input_mask, &target_mask].into_iter().flatten().any(Mask::keeps_none) {
        let expected = "a photograph with pixels that are not masked in the part that is used";
        return bad(expected.to_owned(), "a mask over all of it".to_owned());
    }
    Ok(Cropped {
        input,
        input_mask: input_mask.filter(|mask| !mask.keeps_all()),
        input_camera: with_intrinsics(camera, input_k)?,
        target,
        target_mask: target_mask.filter(|mask| !mask.keeps_all()),
        target_camera: with_intrinsics(camera, target_k)?,
        window: plan.window(size),
        frame,
    })
}

#[cfg(test)]
impl Cropped {
    /// A whole photograph at its own size.
    pub(crate) fn of_whole(picture: Rgb, camera: Camera) -> Self {
        Self {
            input: picture.clone(),
            input_mask: None,
            input_camera: camera,
            target: picture,
            target_mask: None,
            target_camera: camera,
            window: PhotoWindow { scale: Vec2::ONE, origin: Vec2::ZERO },
            frame: 0,
        }
    }
}

fn with_intrinsics(camera: &Camera, k: Intrinsics) -> Result<Camera> {
    let refused = |e: CameraError| Error::format("crop", "a valid resized camera", e.to_string());
    camera.with_intrinsics(k).map_err(refused)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Mat4, Vec3};

    fn photo(width: usize, height: usize) -> (Rgb, Camera) {
        let mut photo = Rgb::black(width, height);
        for (i, p) in photo.data.chunks_exact_mut(3).enumerate() {
            let (x, y) = (i % width, i / width);
            p.copy_from_slice(&[(255 * x / width) as u8, (255 * y / height) as u8, 90]);
        }
        let (w, h) = (width as f32, height as f32);
        let k = Intrinsics { fx: 0.9 * w, fy: 0.8 * w, cx: 0.53 * w, cy: 0.47 * h, width, height };
        (photo, Camera::new(k, Mat4::IDENTITY).unwrap())
    }

    #[test]
    fn a_pixel_of_the_crop_sees_the_same_ray_as_the_photograph() {
        for (w, h) in [(576, 320), (320, 576), (1920, 1080), (100, 90)] {
            let (picture, camera) = photo(w, h);
            for r in [1, 2, 4] {
                let options = CropOptions::new(Size::new(64, 48), r, 16);
                let c = crop(&picture, &camera, &options).unwrap();
                let p = Vec3::new(0.05, -0.07, 1.0);
                let in_photo = camera.project(p).unwrap();
                let in_target = c.target_camera.project(p).unwrap();
                assert!((c.window.to_photo(in_target) - in_photo).length() < 1e-2);
                let in_input = c.input_camera.project(p).unwrap();
                assert!((in_input * r as f32 - in_target).length() < 1e-3);
                assert_eq!((c.input.width, c.input.height), (64, 48));
                assert_eq!((c.target.width, c.target.height), (64 * r, 48 * r));
                // The ramp's colour at the target's middle is the photograph's there.
                let at = Vec2::new(32.0 * r as f32, 24.0 * r as f32);
                let there = c.window.to_photo(at + 0.5);
                let got = &c.target.data[3 * (24 * r * 64 * r + 32 * r)..][..2];
                let want = [255.0 * there.x / w as f32, 255.0 * there.y / h as f32];
                for (g, w) in got.iter().zip(want) {
                    assert!((f32::from(*g) - w).abs() < 2.5, "{g} {w} at r {r}");
                }
                let enlarged = (64 * r) as f32 / w as f32 > 1.0 || (48 * r) as f32 / h as f32 > 1.0;
                assert_eq!(c.window.scale.min_element() < 1.0, enlarged, "{:?}", c.window);
            }
        }
    }

    #[test]
    fn sizes_are_cut_to_the_stride_around_the_same_middle() {
        let (picture, camera) = photo(640, 480);
        let options = CropOptions::new(Size::new(100, 75), 2, 16);
        let c = crop(&picture, &camera, &options).unwrap();
        assert_eq!((c.input.width, c.input.height), (96, 64));
        let middle = c.window.to_photo(Vec2::new(96.0, 64.0));
        assert!((middle - Vec2::new(320.0, 240.0)).length() < 4.0, "{middle}");
    }

    #[test]
    fn targets_have_any_size() {
        let (picture, camera) = photo(640, 480);
        let options = CropOptions {
            target_size: Size::new(150, 110),
            ..CropOptions::new(Size::new(96, 64), 1, 32)
        };
        let c = crop(&picture, &camera, &options).unwrap();
        assert_eq!((c.input.width, c.input.height), (96, 64));
        assert_eq!((c.target.width, c.target.height), (150, 110));
        assert!((c.ratio() - (150.0f32 * 110.0 / (96.0 * 64.0)).sqrt()).abs() < 1e-6);
        let p = Vec3::new(0.05, -0.07, 1.0);
        let (in_input, in_target) =
            (c.input_camera.project(p).unwrap(), c.target_camera.project(p).unwrap());
        let scale = Vec2::new(150.0 / 96.0, 110.0 / 64.0);
        assert!((in_input * scale - in_target).length() < 1e-3);
        let in_photo = camera.project(p).unwrap();
        assert!((c.window.to_photo(in_target) - in_photo).length() < 1e-2);
        // A stride that cuts the input cuts the same share of the target.
        let cut = CropOptions { input_size: Size::new(100, 64), ..options };
        let c = crop(&picture, &camera, &cut).unwrap();
        assert_eq!((c.input.width, c.target.width, c.target.height), (96, 144, 110));
    }

    #[test]
    fn mvsplat_rule_keeps_the_fraction_and_differs_by_half_a_pixel_when_centred() {
        let (picture, camera) = photo(640, 360);
        let centred = Intrinsics { cx: 320.0, cy: 180.0, ..camera.intrinsics() };
        let camera = camera.with_intrinsics(centred).unwrap();
        let mut options = CropOptions::square(256, 1, 16);
        let exact = crop(&picture, &camera, &options).unwrap().input_camera.intrinsics();
        options.rule = CropRule::Mvsplat;
        let theirs = crop(&picture, &camera, &options).unwrap().input_camera.intrinsics();
        // 640x360 becomes 455x256, cropped from column 99.
        assert_eq!((theirs.cx, theirs.cy), (128.0, 128.0));
        assert!((exact.cx - 128.5).abs() < 1e-4 && exact.cy == 128.0);
        assert!((theirs.fx / camera.intrinsics().fx - 455.0 / 640.0).abs() < 1e-6);
        assert_eq!(theirs.fx, exact.fx);
    }

    #[test]
    fn independent_is_the_shim_and_hr_crop_is_aligned() {
        let (picture, camera) = photo(1280, 720);
        let mut options = CropOptions::square(256, 2, 16);
        let aligned = crop(&picture, &camera, &options).unwrap();
        options.lr_from = LrFrom::Independent;
        let shim = crop(&picture, &camera, &options).unwrap();
        options.target_size = options.input_size;
        options.lr_from = LrFrom::HrCrop;
        let native = crop(&picture, &camera, &options).unwrap();
        assert_eq!(shim.input, native.input);
        assert_ne!(shim.input, aligned.input);
        assert_eq!(shim.target, aligned.target);
    }

    /// The mask is cropped and resized with the picture, and what is masked does not mix into kept pixels.
    #[test]
    fn masks_are_cropped_with_their_pictures() {
        for (w, h, lr_from) in
            [(576, 320, LrFrom::HrCrop), (100, 90, LrFrom::HrCrop), (333, 500, LrFrom::Independent)]
        {
            let (mut picture, camera) = photo(w, h);
            // A disc in the middle is masked; the rest is grey.
            let radius = 0.2 * w as f32;
            let distance = |p: Vec2| (p - 0.5 * Vec2::new(w as f32, h as f32)).length();
            let at = |i: usize| Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
            let kept: Vec<bool> = (0..w * h).map(|i| distance(at(i)) > radius).collect();
            for (pixel, kept) in picture.data.chunks_exact_mut(3).zip(&kept) {
                pixel.fill(if *kept { 120 } else { 0 });
            }
            let mask = Mask::new(w, h, kept).unwrap();
            let options = CropOptions { lr_from, ..CropOptions::new(Size::new(64, 48), 2, 16) };
            let c = crop_masked(&picture, Some(&mask), &camera, &options).unwrap();
            let of = |picture: &Rgb, own: &Camera, found: &Mask| {
                assert!(found.fits(picture) && picture.data.iter().all(|v| *v == 120));
                let (k, whole) = (own.intrinsics(), camera.intrinsics());
                for (i, kept) in found.kept().iter().enumerate() {
                    let px = Vec2::new((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5);
                    let there = whole.project(k.unproject(px));
                    let side = whole.fx / k.fx;
                    let edge = distance(there) - radius;
                    assert!(edge.abs() < 1.0 + 0.6 * side || *kept == (edge > 0.0), "{i} {there}");
                }
                assert!(found.count() > 100 && !found.keeps_all());
            };
            of(&c.input, &c.input_camera, c.input_mask.as_ref().unwrap());
            of(&c.target, &c.target_camera, c.target_mask.as_ref().unwrap());
            let size = Size::new(96, 72);
            let (resized, resized_camera) = c.resized(size).unwrap();
            of(&resized, &resized_camera, &c.resized_mask(size).unwrap());
            assert_eq!(Cropped::mean_colour(&[c]), [120.0 / 255.0; 3]);
            // Without masked pixels nothing changes.
            let all = Mask::new(w, h, vec![true; w * h]).unwrap();
            let same = crop_masked(&picture, Some(&all), &camera, &options).unwrap();
            assert_eq!(same, crop(&picture, &camera, &options).unwrap());
            // A mask over the part that is used, and one of another size.
            let none = Mask::new(w, h, vec![false; w * h]).unwrap();
            let small = Mask::new(2, 2, vec![true; 4]).unwrap();
            for (mask, words) in [(none, "over all of it"), (small, "got 2x2")] {
                let error = crop_masked(&picture, Some(&mask), &camera, &options).unwrap_err();
                assert!(error.to_string().contains(words), "{error}");
            }
        }
    }

    #[test]
    fn bad_sizes_are_refused() {
        let (picture, camera) = photo(64, 64);
        for (side, r, named) in [
            (0, 2, "input sides"),
            (8, 2, "input sides"),
            (1 << 20, 2, "input sides"),
            (256, 0, "target sides"),
            (256, usize::MAX, "target sides"),
        ] {
            let e = crop(&picture, &camera, &CropOptions::square(side, r, 16)).unwrap_err();
            assert!(e.to_string().contains(named), "{e}");
        }
        let other = camera.resized(32, 32).unwrap();
        assert!(crop(&picture, &other, &CropOptions::square(16, 1, 16)).is_err());
    }
}
