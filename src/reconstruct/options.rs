//! Options of a reconstruction.

use super::{Density, DepthBounds, DepthRange, Error, InputSize, Result};
use crate::finish::{FitOptions, RefineOptions};
use std::time::Duration;
use subsplat_kernels::camera::{Camera, Size};

/// Options of [`Reconstructor::run`](super::Reconstructor::run). The defaults are those of the
/// program `subsplat run`.
///
/// ```
/// use subsplat::reconstruct::{Check, DepthRange, InputSize, Options};
/// let options = Options::default()
///     .with_input_size(320, 192)
///     .with_depth_range(DepthRange::Fixed { near: 0.5, far: 20.0 })
///     .with_check(Check::Refuse);
/// assert_eq!(options.input_size, InputSize::exact(320, 192));
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Options {
    /// Size of the network's input. Default: the area of 256×256 in the photographs' shape.
    pub input_size: InputSize,
    /// Size of the target pictures, which also is the size of the photographs that the fit and the
    /// refinement read. Default: [`TargetSize::Upscaled`].
    pub target_size: TargetSize,
    /// Number of Gaussians. Default: [`Density::Auto`].
    pub density: Density,
    /// Ends of the depth range that the caller fixes. Default: [`DepthRange::Auto`].
    pub depth_range: DepthRange,
    /// Depth range that a file suggests, used for the ends that `depth_range` leaves open.
    /// Default: none.
    pub depth_prior: Option<DepthBounds>,
    /// Cameras that the network receives. Default: [`Poses::Given`].
    pub poses: Poses,
    /// Check of the poses by matched points. Default: [`Check::Warn`].
    pub check: Check,
    /// Source of colour detail. Default: [`Detail::Photographs`].
    pub detail: Detail,
    /// Fit of the Gaussians to the photographs ([`crate::finish::fit()`]). Default: four steps.
    pub fit: FitOptions,
    /// Refinement of the Gaussians on the photographs ([`crate::finish::refine()`]). Default:
    /// [`Refine::Auto`].
    pub refine: Refine,
}

impl Options {
    /// Sets [`Options::input_size`] to these sides, px. Photographs of another shape lose what
    /// lies outside the middle.
    #[must_use]
    pub fn with_input_size(self, width: usize, height: usize) -> Self {
        Self { input_size: InputSize::exact(width, height), ..self }
    }

    /// Sets [`Options::input_size`] to about `pixels` in the photographs' shape.
    #[must_use]
    pub fn with_input_area(self, pixels: usize) -> Self {
        Self { input_size: InputSize::Area(pixels), ..self }
    }

    /// Sets [`Options::target_size`].
    #[must_use]
    pub fn with_target_size(self, target_size: TargetSize) -> Self {
        Self { target_size, ..self }
    }

    /// Sets [`Options::density`].
    #[must_use]
    pub fn with_density(self, density: Density) -> Self {
        Self { density, ..self }
    }

    /// Sets [`Options::depth_range`].
    #[must_use]
    pub fn with_depth_range(mut self, range: DepthRange) -> Self {
        self.depth_range = range;
        self
    }

    /// Sets [`Options::depth_prior`].
    #[must_use]
    pub fn with_depth_prior(mut self, prior: impl Into<Option<DepthBounds>>) -> Self {
        self.depth_prior = prior.into();
        self
    }

    /// Sets [`Options::poses`].
    #[must_use]
    pub fn with_poses(mut self, poses: Poses) -> Self {
        self.poses = poses;
        self
    }

    /// Sets [`Options::check`].
    #[must_use]
    pub fn with_check(mut self, check: Check) -> Self {
        self.check = check;
        self
    }

    /// Sets [`Options::detail`].
    #[must_use]
    pub fn with_detail(mut self, detail: Detail) -> Self {
        self.detail = detail;
        self
    }

    /// Sets [`Options::fit`]; [`FitOptions::off`] keeps the network's Gaussians, unless
    /// [`Options::refine`] names a number of steps.
    #[must_use]
    pub fn with_fit(mut self, fit: FitOptions) -> Self {
        self.fit = fit;
        self
    }

    /// Sets [`Options::refine`].
    #[must_use]
    pub fn with_refine(mut self, refine: Refine) -> Self {
        self.refine = refine;
        self
    }

    /// Size of the network's input for photographs of the sizes `photos` and a model of `stride`, px.
    pub fn input_size_for(&self, photos: &[Size], stride: usize) -> Size {
        match self.target_size {
            TargetSize::Exact(size) => self.input_size.resolve(&[size], stride),
            _ => self.input_size.resolve(photos, stride),
        }
    }

    /// Options of the refinement for a number of photographs and of Gaussians.
    pub(super) fn refine_options(&self, photographs: usize, gaussians: usize) -> RefineOptions {
        self.refine.options_for(photographs, gaussians, self.fit.steps > 0)
    }

    /// The depth range before any photograph is read: [`Options::depth_range`], then
    /// [`Options::depth_prior`], then a guess from the distances between the cameras. A program
    /// can reject wrong options early by this call.
    ///
    /// # Errors
    /// Fewer than two cameras; not 0 < near < far; cameras at one place and no other source.
    pub fn initial_depth_range(&self, cameras: &[Camera]) -> Result<DepthBounds> {
        if cameras.len() < 2 {
            let got = cameras.len().to_string();
            return Err(Error::argument("photographs", "at least 2", got));
        }
        DepthBounds::initial(cameras, self.depth_range, self.depth_prior.as_ref())
    }
}

/// Size of the target pictures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub enum TargetSize {
    /// The input's sides times the model's upscale r, of which each pixel has r² children.
    #[default]
    Upscaled,
    /// The input's sides times this number, rounded.
    Times(f32),
    /// These sides, px. The input has their shape where [`Options::input_size`] leaves it open.
    Exact(Size),
}

impl TargetSize {
    /// The size for an input of `input_size` and a model of `upscale`. A factor that is not finite
    /// gives 0 or a side that is too large, which
    /// [`Reconstructor::run`](super::Reconstructor::run) refuses.
    pub fn resolve(self, input_size: Size, upscale: usize) -> Size {
        let Size { width, height } = input_size;
        match self {
            Self::Upscaled => {
                Size::new(width.saturating_mul(upscale), height.saturating_mul(upscale))
            }
            Self::Times(factor) => {
                let side = |side: usize| (side as f32 * factor).round() as usize;
                Size::new(side(width), side(height))
            }
            Self::Exact(size) => size,
        }
    }
}

/// Length of the refinement of Gaussians on their photographs ([`crate::finish::refine()`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refine {
    /// Eight steps a photograph, 64 at most; none where [`Options::fit`] is off, and none of more
    /// than 1.5 million Gaussians, for which a refinement takes more memory than the network.
    #[default]
    Auto,
    /// None.
    Off,
    /// At most this number of steps.
    Steps(usize),
    /// Steps for about this number of seconds. The result then depends on the machine. Refused where
    /// there is no clock (WebAssembly without an operating system).
    Seconds(u32),
}

/// Most Gaussians that [`Refine::Auto`] refines. The buffers of a refinement of two
/// photographs take 322 bytes a Gaussian.
const AUTO_GAUSSIANS_MAX: usize = 3 << 19;

impl Refine {
    /// Options for a number of photographs and of Gaussians, which are `fitted` or not.
    pub fn options_for(self, photographs: usize, gaussians: usize, fitted: bool) -> RefineOptions {
        match self {
            Self::Auto if !fitted || gaussians > AUTO_GAUSSIANS_MAX => Self::Off,
            refine => refine,
        }
        .options(photographs)
    }

    /// The limit of time, if there is one.
    pub(crate) fn time(self) -> Option<Duration> {
        match self {
            Self::Seconds(seconds) => Some(Duration::from_secs(seconds.into())),
            Self::Auto | Self::Off | Self::Steps(_) => None,
        }
    }

    /// Options of [`crate::finish::refine()`] for a number of photographs.
    fn options(self, photographs: usize) -> RefineOptions {
        let options = RefineOptions::default().with_groups(true);
        match self {
            Self::Auto => options.with_steps((8 * photographs).min(64)),
            Self::Off => options.with_steps(0),
            Self::Steps(steps) => options.with_steps(steps),
            Self::Seconds(_) => {
                RefineOptions { time: self.time(), ..options.with_steps(usize::MAX) }
            }
        }
    }
}

/// Cameras that the network receives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Poses {
    /// Those of the photographs.
    #[default]
    Given,
    /// Those of the photographs after [`crate::cameras::estimation::adjust_poses`], for cameras that are nearly right,
    /// such as a headset's. Cameras that fit the photographs stay.
    Adjusted,
}

/// Check of the poses by points matched between consecutive photographs ([`crate::cameras::check`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Check {
    /// No points are matched, neither for the check nor for the depth range.
    Off,
    /// Every finding becomes a [`Warning::Poses`](super::Warning::Poses).
    #[default]
    Warn,
    /// Poses that are judged bad give [`Error::Poses`](super::Error::Poses); other findings
    /// become warnings.
    Refuse,
}

/// Source of colour detail below the size of an input pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Detail {
    /// Photographs that are larger than the network's input add, at each child, their
    /// difference from the mean of the parent's pixel.
    #[default]
    Photographs,
    /// Colours come from the network alone.
    Off,
}
