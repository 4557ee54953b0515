//! Options of a reconstruction.

use super::{Density, DepthBounds, DepthRange, Error, InputSize, Result, Surroundings};
use crate::finish::{FitOptions, RefineOptions};
use std::fmt;
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
    /// Cameras that the network receives. Default: [`Poses::Auto`].
    pub poses: Poses,
    /// Check of the poses by matched points. Default: [`Check::Warn`].
    pub check: Check,
    /// Correction of the network's depth; none where neither [`Options::fit`] nor [`Options::refine`]
    /// changes the Gaussians. Default: [`Matching::Photographs`].
    pub matching: Matching,
    /// Source of colour detail. Default: [`Detail::Photographs`].
    pub detail: Detail,
    /// Gaussians beyond the edges of the photographs. Default: [`Surroundings::Photographs`].
    pub surroundings: Surroundings,
    /// Fit of the Gaussians to the photographs ([`crate::finish::fit()`]). Default: four steps where the refinement
    /// needs them ([`RefineOptions::needs_fit`]), else none.
    pub fit: Option<FitOptions>,
    /// Refinement of the Gaussians on the photographs ([`crate::finish::refine()`]). Default:
    /// [`Refine::Auto`].
    pub refine: Refine,
    /// Length of the optimisation of the primaries before they are divided, as that of a scene which is
    /// refined so: for a scene that is refined later ([`Reconstruction::refine`](super::Reconstruction::refine)).
    /// Default: none, which stands for [`Options::refine`].
    pub parents: Option<Refine>,
}

impl Options {
    /// Sets [`Options::input_size`], [`Options::density`] and [`Options::refine`] by one level of quality.
    /// Setters that follow override single values.
    ///
    /// ```
    /// use subsplat::reconstruct::{InputSize, Options, Quality, Refine};
    /// let options = Options::default().with_quality(Quality::Best).with_refine(Refine::Off);
    /// assert_eq!(options.input_size, InputSize::AtMost(512 * 512));
    /// assert_eq!(Options::default().with_quality(Quality::Normal), Options::default());
    /// ```
    #[must_use]
    pub fn with_quality(mut self, quality: Quality) -> Self {
        let QualitySettings { input_size, density, refine } = quality.settings();
        self.input_size = input_size;
        self.density = density;
        self.refine = refine;
        self
    }

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

    /// Sets [`Options::matching`].
    #[must_use]
    pub fn with_matching(mut self, matching: Matching) -> Self {
        self.matching = matching;
        self
    }

    /// Sets [`Options::detail`].
    #[must_use]
    pub fn with_detail(mut self, detail: Detail) -> Self {
        self.detail = detail;
        self
    }

    /// Sets [`Options::surroundings`].
    #[must_use]
    pub fn with_surroundings(mut self, surroundings: Surroundings) -> Self {
        self.surroundings = surroundings;
        self
    }

    /// Sets [`Options::fit`]; [`FitOptions::off`] keeps the network's Gaussians, unless
    /// [`Options::refine`] names a number of steps.
    #[must_use]
    pub fn with_fit(mut self, fit: impl Into<Option<FitOptions>>) -> Self {
        self.fit = fit.into();
        self
    }

    /// Sets [`Options::refine`].
    #[must_use]
    pub fn with_refine(mut self, refine: Refine) -> Self {
        self.refine = refine;
        self
    }

    /// Sets [`Options::parents`].
    #[must_use]
    pub fn with_parents(mut self, parents: impl Into<Option<Refine>>) -> Self {
        self.parents = parents.into();
        self
    }

    /// Size of the network's input for photographs of the sizes `photos` and a model of `stride`, px,
    /// whose pixels have `upscale`² Gaussians.
    pub fn input_size_for(&self, photos: &[Size], stride: usize, upscale: usize) -> Size {
        let shapes = match &self.target_size {
            TargetSize::Exact(size) => std::slice::from_ref(size),
            _ => photos,
        };
        self.input_size.limited_to(shapes, upscale).resolve(shapes, stride)
    }

    /// Options of the refinement on which that of the primaries depends.
    pub(super) fn parents_options(&self, photographs: usize) -> RefineOptions {
        let refine = self.parents.unwrap_or(self.refine);
        refine.options_for(photographs, self.changes_sizes())
    }

    /// Returns whether the Gaussians may be changed where [`Options::refine`] names no number of steps.
    fn changes_sizes(&self) -> bool {
        self.fit.is_none_or(|fit| fit.steps > 0)
    }

    /// Options of the fit for a number of photographs.
    pub(super) fn fit_options(&self, photographs: usize) -> FitOptions {
        let needs = || self.refine_options(photographs).needs_fit(photographs);
        self.fit.unwrap_or_else(|| if needs() { FitOptions::default() } else { FitOptions::off() })
    }

    /// Returns whether the Gaussians are to stay the network's.
    fn keeps_the_networks(&self) -> bool {
        !self.changes_sizes() && self.refine_options(2).steps == 0
    }

    /// Returns whether depth is matched.
    pub(super) fn matches_depth(&self) -> bool {
        self.matching == Matching::Photographs && !self.keeps_the_networks()
    }

    /// Returns whether Gaussians are added where no photograph shows the scene.
    pub(super) fn has_surroundings(&self) -> bool {
        let wanted = self.surroundings == Surroundings::Photographs;
        wanted && self.density.has_room() && !self.keeps_the_networks()
    }

    /// Options of the refinement for a number of photographs.
    pub(super) fn refine_options(&self, photographs: usize) -> RefineOptions {
        self.refine.options_for(photographs, self.changes_sizes())
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

/// Quality of a scene: time and memory against sharpness, in one word. [`Quality::settings`] is the
/// table; [`Options::with_quality`] applies it.
///
/// | level | input | Gaussians, at most | [`Refine::Each`] |
/// |---|---|---|---|
/// | `Fast` | 192² | 150,000 | 4 |
/// | `Normal` | 256² | [`Density::Auto`] | 8 |
/// | `High` | up to 512² | [`Density::Auto`] | 8 |
/// | `Best` | up to 512² | [`Density::Auto`] | 16 |
///
/// PSNR in dB / SSIM of new views, PSNR at the inputs' own cameras, CPU-seconds and memory, one run each on two cores
/// of an EPYC with AVX-512. Pairs of `../shared/photos/fox`: `subsplat run fox --context 17,19 --target 18 --size
/// 576x1024 --upscale 2 --quality LEVEL`, then 3,7 with 5, then 10,16 with 12,13,14; they overlap by 96, 90 and 75 %.
/// `examples/room`: `--context 0,1 --target 2,3,4 --size 512 --upscale 2`; its photographs are too small for a larger
/// input.
///
/// | | fox 17,19 | fox 3,7 | fox 10,16 | room |
/// |---|---|---|---|---|
/// | `Fast` | 32.21 / .892, 35.1; 7 s, 0.3 GiB | 29.32 / .872, 34.4; 7 s | 24.50 / .800, 34.0; 8 s | 31.45 / .893, 36.8; 4 s, 0.2 GiB |
/// | `Normal` | 32.66 / .899, 37.8; 16 s, 0.5 GiB | 29.68 / .865, 37.5; 16 s | 24.78 / .789, 37.0; 16 s | 32.30 / .907, 38.3; 9 s, 0.4 GiB |
/// | `High` | 32.46 / .897, 38.7; 23 s, 0.8 GiB | 29.59 / .860, 38.0; 23 s | 23.98 / .773, 38.3; 25 s | as `Normal` |
/// | `Best` | 32.36 / .894, 39.9; 37 s, 0.8 GiB | 29.38 / .853, 40.0; 37 s | 23.76 / .761, 41.0; 39 s | 32.38 / .909, 38.5; 17 s, 0.4 GiB |
///
/// A higher level therefore comes closer to the photographs at their own cameras, and is sharper there. New views of
/// two photographs do not gain: a larger input finds less depth that is right (the paper's table 2 in
/// `tools/lab/tried.md`). At `--size 1080x1920` these pairs have 32.33, 29.00 and 24.21 dB with `Normal` (sharpness at
/// the inputs .77 to .79) and 32.00, 29.84 and 23.03 with `High` (.84 to .87).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Quality {
    /// A draft: a smaller input, fewer Gaussians, and half of the steps.
    Fast,
    /// The defaults of [`Options`].
    #[default]
    Normal,
    /// A larger input, as far as the photographs have the pixels.
    High,
    /// [`Quality::High`] with twice the steps of the refinement.
    Best,
}

/// The options that a [`Quality`] sets.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct QualitySettings {
    /// [`Options::input_size`].
    pub input_size: InputSize,
    /// [`Options::density`].
    pub density: Density,
    /// [`Options::refine`].
    pub refine: Refine,
}

impl Quality {
    /// All levels, the fastest first.
    pub const ALL: [Self; 4] = [Self::Fast, Self::Normal, Self::High, Self::Best];

    /// Returns the options of this level.
    pub fn settings(self) -> QualitySettings {
        let Options { input_size, density, refine, .. } = Options::default();
        let normal = QualitySettings { input_size, density, refine };
        match self {
            Self::Fast => QualitySettings {
                input_size: InputSize::Area(192 * 192),
                density: Density::Count(150_000),
                refine: Refine::Each(4),
                ..normal
            },
            Self::Normal => normal,
            Self::High => QualitySettings { input_size: InputSize::AtMost(512 * 512), ..normal },
            Self::Best => QualitySettings {
                input_size: InputSize::AtMost(512 * 512),
                refine: Refine::Each(16),
                ..normal
            },
        }
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
    /// The largest pictures of the input's shape that enlarge no photograph, of at most this number of
    /// pixels; [`TargetSize::Upscaled`] where that is larger.
    Photographs(usize),
}

impl TargetSize {
    /// The size for an input of `input_size`, a model of `upscale`, and photographs of the sizes
    /// `photos`, px. A factor that is not finite gives 0 or a side that is too large, which
    /// [`Reconstructor::run`](super::Reconstructor::run) refuses.
    pub fn resolve(self, input_size: Size, upscale: usize, photos: &[Size]) -> Size {
        let Size { width, height } = input_size;
        match self {
            Self::Photographs(area) => {
                let (w, h) = (width.max(1) as f64, height.max(1) as f64);
                let covers = |p: &Size| (p.width as f64 / w).min(p.height as f64 / h);
                let most = (area as f64 / (w * h)).sqrt();
                let factor = photos.iter().map(covers).fold(most, f64::min).max(upscale as f64);
                Size::new((factor * w) as usize, (factor * h) as usize)
            }
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
    /// [`Refine::Each`] of 8: 16 steps for two photographs, 40 for three, 75 for four, 24 a photograph for more, 240 at
    /// most. A refinement of two photographs takes 322 bytes a Gaussian.
    #[default]
    Auto,
    /// None.
    Off,
    /// This number of steps for each of two photographs, three times as many for each of five or more, in between
    /// for three and four, and at most those of ten; none where [`Options::fit`] is off.
    Each(usize),
    /// At most this number of steps.
    Steps(usize),
    /// Steps for about this number of seconds, at most 48 for each photograph, because more of them fit the photographs
    /// and not new views. The result then depends on the machine. Refused where there is no clock (WebAssembly without
    /// an operating system).
    Seconds(u32),
}

/// [`Refine::Each`] of [`Refine::Auto`].
const AUTO_STEPS: usize = 8;

/// Largest factor of the steps of more than two photographs. Each of them is compared with Gaussians of several
/// photographs, whose geometry more steps bring together: new views of five photographs at 128 → 256 have 23.56
/// dB after 40 steps, 23.83 after 80 and 23.93 after 120 (the scenes that chose the constants of
/// [`crate::cameras::dense`]); of three 18.09, 18.17 and 18.22 dB after 24, 48 and 72; of the pairs of these scenes
/// 18.79 dB after 16 steps and 18.80 after 40.
///
/// Five photographs of eight scenes, every eighth frame held out (`subsplat-lab eval --contexts 5 --holdout 8 --upscale 2
/// --input-size 128 --adjust-poses=auto --refine N`): 24.09 dB / .825 after 120 steps, 24.16 / .825 after 240, 24.12 /
/// .824 after 480. After 240, no scene is more than 0.1 dB below the best of the three; after 120, three scenes are
/// by 0.1 to 0.3, in half of the time. After 480, re10k_5aca87f falls from 22.5 to 22.1, though its photographs come closer
/// and closer; rates that are halved there give 22.2 in it and 24.09 on average.
const FACTOR_MAX: usize = 3;

/// Photographs from which on the factor is [`FACTOR_MAX`].
const PHOTOGRAPHS_OF_MAX: usize = 5;

/// Photographs whose steps [`Refine::Auto`] and [`Refine::Each`] allow in all. Seventeen photographs of
/// `../shared/photos/fox`, 256 → 512, three others as targets (`run --refine N`): 28.07 dB / .865 after 64 steps,
/// 29.29 / .872 after 204, 29.43 / .867 after 408; the last ones take 100 s on two cores of an EPYC.
const PHOTOGRAPHS_MAX: usize = 10;

/// Most steps of [`Refine::Seconds`] for each photograph: 48 are best of 24, 48 and 96 for five photographs (see
/// [`FACTOR_MAX`]), on the scenes that chose the constants and on the others. Seventeen photographs of `fox` as above have
/// 29.43 dB / .867 after 24 steps each, 29.39 dB / .862 after 48 and 29.32 / .855 after 141, which are ten minutes.
///
/// Photographs that are held out in turn do not tell the number. Of five photographs one of the inner three was left out and
/// drawn from the four others (eight scenes, 22 runs). From 24 to 96 steps each, new views change by more than 0.1 dB in
/// four scenes; in three of these the photographs that were left out change the other way on average.
const TIMED_STEPS: usize = 48;

/// Steps of `each` and a number of photographs. The factor rises evenly from 1 of two photographs.
fn steps_of(each: usize, photographs: usize) -> usize {
    let further = photographs.clamp(2, PHOTOGRAPHS_OF_MAX) - 2;
    let thirds = (PHOTOGRAPHS_OF_MAX - 2) + (FACTOR_MAX - 1) * further;
    let steps = each.saturating_mul(thirds * photographs.min(PHOTOGRAPHS_MAX));
    steps.div_ceil(PHOTOGRAPHS_OF_MAX - 2)
}

/// As `--refine` of the programs reads it.
impl fmt::Display for Refine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Off => f.write_str("off"),
            Self::Each(steps) => write!(f, "{steps} a photograph"),
            Self::Steps(steps) => write!(f, "{steps}"),
            Self::Seconds(seconds) => write!(f, "{seconds}s"),
        }
    }
}

impl Refine {
    /// Options for a number of photographs, whose Gaussians are `fitted` or not.
    pub fn options_for(self, photographs: usize, fitted: bool) -> RefineOptions {
        match self {
            Self::Auto | Self::Each(_) if !fitted => Self::Off,
            refine => refine,
        }
        .options(photographs)
    }

    /// The limit of time, if there is one.
    pub(crate) fn time(self) -> Option<Duration> {
        match self {
            Self::Seconds(seconds) => Some(Duration::from_secs(seconds.into())),
            Self::Auto | Self::Each(_) | Self::Off | Self::Steps(_) => None,
        }
    }

    /// Options of [`crate::finish::refine()`] for a number of photographs.
    fn options(self, photographs: usize) -> RefineOptions {
        let options = RefineOptions::default().with_groups(true);
        match self {
            Self::Auto => options.with_steps(steps_of(AUTO_STEPS, photographs)),
            Self::Each(each) => options.with_steps(steps_of(each, photographs)),
            Self::Off => options.with_steps(0),
            Self::Steps(steps) => options.with_steps(steps),
            Self::Seconds(_) => {
                let steps = TIMED_STEPS.saturating_mul(photographs);
                RefineOptions { time: self.time(), ..options.with_steps(steps) }
            }
        }
    }
}

/// Cameras that the network receives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Poses {
    /// [`Poses::Adjusted`] where the [`Check`] finds points clearly farther from the lines that the cameras predict
    /// than from their own, and nothing worse; else [`Poses::Given`].
    #[default]
    Auto,
    /// Those of the photographs.
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

/// Correction of the depth that the network predicts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Matching {
    /// Each pixel moves to the depth at which patches of the photographs agree
    /// ([`crate::cameras::dense`]). A network with several Gaussians a pixel keeps its own depth.
    #[default]
    Photographs,
    /// The network's own depth.
    Off,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_quality_is_the_default_and_levels_differ() {
        assert_eq!(Options::default().with_quality(Quality::Normal), Options::default());
        let levels = Quality::ALL.map(Quality::settings);
        for (i, a) in levels.iter().enumerate() {
            assert!(levels[..i].iter().all(|b| a != b), "{a:?}");
            let options = Options::default().with_quality(Quality::ALL[i]);
            let set = QualitySettings {
                input_size: options.input_size,
                density: options.density,
                refine: options.refine,
            };
            assert_eq!(set, *a);
        }
        // The level does not touch what it does not name.
        let adjusted = Options::default().with_poses(Poses::Adjusted);
        assert_eq!(adjusted.with_quality(Quality::High).poses, Poses::Adjusted);
    }

    #[test]
    fn a_refinement_of_three_photographs_needs_no_fit() {
        let steps = |options: Options, photographs: usize| options.fit_options(photographs).steps;
        assert_eq!([2, 3, 9].map(|n| steps(Options::default(), n)), [4, 0, 0]);
        let few = || Options::default().with_refine(Refine::Steps(29));
        assert_eq!([steps(few(), 3), steps(few().with_refine(Refine::Steps(30)), 3)], [4, 0]);
        assert_eq!(steps(few().with_refine(Refine::Off), 3), 4);
        assert_eq!(steps(few().with_refine(Refine::Seconds(60)), 3), 4);
        // A fit that was asked for stays.
        let asked = |n: usize| Options::default().with_fit(FitOptions::default().with_steps(n));
        assert_eq!([steps(asked(7), 5), steps(asked(0), 2)], [7, 0]);
        // Without a fit that was asked for, the Gaussians stay the network's.
        assert_eq!(asked(0).refine_options(3).steps, 0);
        assert!(
            Options::default().refine_options(3).steps >= 30
                && !asked(0).with_refine(Refine::Auto).matches_depth()
        );
    }

    #[test]
    fn a_larger_input_ends_at_the_pixels_of_the_photographs() {
        let high = Options::default().with_quality(Quality::High);
        let side = |options: &Options, side: usize, upscale: usize| {
            let size = options.input_size_for(&[Size::new(side, side); 2], 32, upscale);
            assert_eq!(size.width, size.height);
            size.width
        };
        assert_eq!([4000, 800, 300].map(|s| side(&high, s, 2)), [512, 416, 256]);
        assert_eq!(side(&high, 1200, 4), 288);
        assert_eq!(side(&Options::default().with_quality(Quality::Fast), 4000, 2), 192);
        // Pictures of a fixed size count in place of the photographs.
        let small = high.with_target_size(TargetSize::Exact(Size::new(640, 640)));
        assert_eq!(side(&small, 4000, 2), 320);
    }

    #[test]
    fn pictures_of_the_photographs_size() {
        let size = |photos: &[(usize, usize)]| {
            let photos: Vec<Size> = photos.iter().map(|(w, h)| Size::new(*w, *h)).collect();
            let size = TargetSize::Photographs(4_000_000).resolve(Size::new(288, 224), 2, &photos);
            (size.width, size.height)
        };
        // Two megapixels of another shape; a smaller second photograph; twelve megapixels; small ones.
        assert_eq!(size(&[(1920, 1080); 2]), (1388, 1080));
        assert_eq!(size(&[(4032, 3024), (1152, 896)]), (1152, 896));
        let (w, h) = size(&[(4032, 3024); 2]);
        assert!((3_980_000..=4_000_000).contains(&(w * h)), "{w}x{h}");
        assert_eq!(size(&[(400, 300); 2]), (576, 448));
    }

    #[test]
    fn steps_of_a_refinement() {
        let steps =
            |refine: Refine, photographs, fitted| refine.options_for(photographs, fitted).steps;
        let counts = [1, 2, 3, 4, 5, 10, 20, 50];
        let expected = [8, 16, 40, 75, 120, 240, 240, 240];
        assert_eq!(counts.map(|n| steps(Refine::Auto, n, true)), expected);
        assert_eq!([2, 8, 20].map(|n| steps(Refine::Each(4), n, true)), [8, 96, 120]);
        assert_eq!([2, 17].map(|n| steps(Refine::Seconds(600), n, true)), [96, 816]);
        assert_eq!([Refine::Auto, Refine::Each(4)].map(|r| steps(r, 2, false)), [0, 0]);
        assert_eq!((steps(Refine::Steps(3), 2, false), steps(Refine::Off, 2, true)), (3, 0));
    }
}
