//! Warnings of a reconstruction.

use super::{DepthBounds, Photo};
use crate::cameras::check::{Finding, PairReport, Verdict};
use crate::reconstruct::inputs::crop::{CropOptions, Cropped};
use crate::scene::mask::Mask;
use std::collections::BTreeSet;
use std::fmt;
use subsplat_kernels::camera::Size;

/// Share of a photograph that is cut, beyond which a warning says so: 44 % of a portrait of 3:4 in a
/// landscape of 4:3, or of 9:16 in a square.
const MUCH: f32 = 0.4;

/// A circumstance that may spoil the result. [`fmt::Display`] gives one sentence without a final
/// full stop.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Warning {
    /// The check of the poses found something.
    #[non_exhaustive]
    Poses {
        /// Index of the first photograph of the pair; the second one follows it.
        first: usize,
        /// The finding.
        finding: Finding,
    },
    /// Nothing but the distance between the cameras determined near or far.
    #[non_exhaustive]
    DepthRangeGuessed {
        /// Nearest depth candidate, world units.
        near: f32,
        /// Farthest depth candidate, world units.
        far: f32,
    },
    /// A quarter or more of the points that the photographs share lies before or behind the depth range.
    #[non_exhaustive]
    PointsOutsideRange {
        /// Nearest depth candidate, world units.
        near: f32,
        /// Farthest depth candidate, world units.
        far: f32,
        /// Depths between which 96 % of the points of the first such pair lie, world units.
        points: [f32; 2],
    },
    /// The input size was cut to multiples of the model's stride.
    #[non_exhaustive]
    InputSizeCut {
        /// The size that was requested.
        requested: Size,
        /// The size that is used.
        used: Size,
        /// The model's stride, px.
        stride: usize,
    },
    /// Masks leave out pixels of photographs.
    #[non_exhaustive]
    Masked {
        /// Number of photographs with a mask.
        photographs: usize,
        /// Share of their pixels that is left out, 0 to 1.
        share: f32,
    },
    /// A photograph is smaller than the target picture, and was enlarged.
    #[non_exhaustive]
    PhotographEnlarged {
        /// Size of the photograph.
        size: Size,
        /// Size after resizing.
        resized: Size,
    },
    /// The pictures have another shape than a photograph, of which more than 40 % is cut.
    #[non_exhaustive]
    PhotographCut {
        /// Size of the photograph.
        size: Size,
        /// Size of the picture.
        picture: Size,
        /// Share that no picture shows, 0 to 1.
        share: f32,
    },
    /// Black lines along the sides of photographs, as a removal of lens distortion leaves them, were filled with
    /// the pixels inside them.
    #[non_exhaustive]
    FrameFilled {
        /// Number of photographs.
        photographs: usize,
        /// Largest number of lines at a side, px.
        lines: usize,
    },
    /// The weights lack some or all of SubSplat's tensors, the heads that place children.
    #[non_exhaustive]
    UntrainedTensors {
        /// Number of missing tensors.
        count: usize,
        /// r: side of the children's grid.
        upscale: usize,
    },
    /// A photograph was brought to the exposure and white balance of another one.
    #[non_exhaustive]
    ExposureCorrected {
        /// Index of the photograph.
        photo: usize,
        /// Index of the photograph of middle brightness, which stays.
        reference: usize,
        /// Factor on each channel, red first.
        gain: [f32; 3],
        /// Offset of each channel, 8-bit levels.
        offset: [f32; 3],
    },
    /// The GPU failed or refused a call, and the CPU did the work.
    #[non_exhaustive]
    CpuInsteadOfGpu {
        /// The GPU's error.
        reason: String,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Poses { finding, .. } => f.write_str(&finding.sentence),
            Self::DepthRangeGuessed { near, far } => write!(
                f,
                "the nearest and the farthest distance of the scene, {near:.4} and {far:.4}, are \
                 guessed from the distance between the cameras, so that shapes may be wrong; give \
                 --near and --far if you know them"
            ),
            Self::PointsOutsideRange { near, far, points: [low, high] } => write!(
                f,
                "points that the photographs share are {low:.4} to {high:.4} away, and a quarter of them or more is outside \
                 of the range from {near:.4} to {far:.4} in which distances are searched: shapes will be wrong; --near \
                 and --far set it"
            ),
            Self::InputSizeCut { requested, used, stride } => write!(
                f,
                "the photographs are read at {used} instead of {requested}: both sides must be \
                 multiples of {stride} pixels"
            ),
            Self::Masked { photographs, share } => write!(
                f,
                "masks leave out {:.0} % of the pixels of {photographs} photographs (what is black in a mask file, or \
                 transparent, is left out){}",
                100.0 * share,
                if *share > 0.5 {
                    ": more than half; if it is the other part that should go, exchange black and white in the masks"
                } else {
                    ""
                }
            ),
            Self::PhotographEnlarged { size, resized } => write!(
                f,
                "a photograph of {size} is enlarged to {resized}: pictures of this size show no \
                 more detail than the photograph has"
            ),
            Self::PhotographCut { size, picture, share } => write!(
                f,
                "{:.0} % of a photograph of {size} is cut at its edges: pictures of {picture} have \
                 another shape",
                100.0 * share
            ),
            Self::FrameFilled { photographs, lines } => write!(
                f,
                "black lines along the sides of {photographs} photograph(s), up to {lines} pixels wide, are \
                 filled with the pixels beside them"
            ),
            Self::UntrainedTensors { count, upscale } => {
                write!(
                    f,
                    "these weights are not trained to divide a pixel into {upscale}x{upscale} splats \
                     ({count} tensors are missing)"
                )?;
                match upscale * upscale {
                    1 => f.write_str(": each pixel gives one splat"),
                    children => write!(
                        f,
                        ": each pixel is divided evenly into {children} splats, which adds no detail"
                    ),
                }
            }
            Self::ExposureCorrected { photo, reference, gain: [r, g, b], offset: [x, y, z] } => {
                write!(
                    f,
                    "brightness and colours of photograph {photo} (counted from 0) are matched to \
                     those of photograph {reference}: red, green and blue times {r:.2}, {g:.2} and \
                     {b:.2}, then {x:+.0}, {y:+.0} and {z:+.0} of 255"
                )
            }
            Self::CpuInsteadOfGpu { reason } => f.write_str(reason),
        }
    }
}

impl Warning {
    /// The warnings as sentences for a person: each sentence once, one for the corrections of exposure of
    /// three photographs or more, and one for the findings of a kind of three pairs or more.
    pub fn sentences(warnings: &[Self]) -> Vec<String> {
        let exposure = |w: &&Self| matches!(w, Self::ExposureCorrected { .. });
        let corrected = warnings.iter().filter(exposure).count();
        let mut sentences: Vec<String> = Vec::new();
        for warning in warnings {
            let sentence = match warning {
                Self::ExposureCorrected { reference, .. } if corrected > 2 => format!(
                    "brightness and colours of {corrected} photographs are matched to those of \
                     photograph {reference} (counted from 0)"
                ),
                Self::Poses { finding, .. } => of_pairs(warnings, finding),
                _ => warning.to_string(),
            };
            if !sentences.contains(&sentence) {
                sentences.push(sentence);
            }
        }
        sentences
    }

    /// All findings of the checked pairs.
    pub(super) fn of_reports(reports: &[PairReport]) -> Vec<Self> {
        let pair = |(first, report): (usize, &PairReport)| {
            let warning = move |finding: &Finding| Self::Poses { first, finding: finding.clone() };
            report.findings.iter().map(warning).collect::<Vec<_>>()
        };
        reports.iter().enumerate().flat_map(pair).collect()
    }

    /// Sizes that were cut, photographs that were enlarged, those that lose more than [`MUCH`], and frames that
    /// were filled; each warning once.
    pub(super) fn of_crops(
        photos: &[Photo],
        inputs: &[Cropped],
        cut_shares: &[f32],
        options: &CropOptions,
    ) -> Vec<Self> {
        let mut warnings = Vec::new();
        let mut add = |warning: Self| {
            if !warnings.contains(&warning) {
                warnings.push(warning);
            }
        };
        let (requested, stride) = (options.input_size, options.stride);
        for c in inputs {
            let used = Size::new(c.input.width, c.input.height);
            if used != requested {
                add(Self::InputSizeCut { requested, used, stride });
            }
        }
        for (photo, c) in photos.iter().zip(inputs) {
            let scale = c.window.scale;
            if scale.min_element() < 1.0 {
                let size = photo.size();
                let side = |side: usize, scale: f32| (side as f32 / scale).round() as usize;
                let resized = Size::new(side(size.width, scale.x), side(size.height, scale.y));
                add(Self::PhotographEnlarged { size, resized });
            }
        }
        for ((photo, c), &share) in photos.iter().zip(inputs).zip(cut_shares) {
            if share > MUCH {
                let picture = Size::new(c.target.width, c.target.height);
                add(Self::PhotographCut { size: photo.size(), picture, share });
            }
        }
        let frames: Vec<usize> =
            inputs.iter().map(|c| c.frame).filter(|lines| *lines > 0).collect();
        if let Some(&lines) = frames.iter().max() {
            add(Self::FrameFilled { photographs: frames.len(), lines });
        }
        warnings
    }

    /// A line about the masks of `photos`, where they leave out a pixel of 200 or more. The edge of a straightened
    /// photograph leaves out less.
    pub(super) fn of_masks(photos: &[Photo]) -> Option<Self> {
        let masks: Vec<&Mask> = photos.iter().filter_map(Photo::mask).collect();
        let pixels: usize = masks.iter().map(|mask| mask.width() * mask.height()).sum();
        let masked = pixels - masks.iter().map(|mask| mask.count()).sum::<usize>();
        let share = masked as f32 / pixels.max(1) as f32;
        (share >= 0.005).then_some(Self::Masked { photographs: masks.len(), share })
    }

    /// A warning where a quarter or more of the points of most pairs with some lies before or behind `bounds`.
    pub(super) fn of_points(bounds: &DepthBounds, reports: &[PairReport]) -> Option<Self> {
        let DepthBounds { near, far, .. } = *bounds;
        let usable = reports.iter().filter(|report| report.verdict != Verdict::Bad);
        let depths: Vec<[f32; 5]> = usable.filter_map(|r| Some(r.depth?.quantiles)).collect();
        let mut outside = depths.iter().filter(|[_, low, _, high, _]| *low < near || *high > far);
        let count = outside.clone().count();
        let [low, .., high] = *outside.next().filter(|_| 2 * count > depths.len())?;
        Some(Self::PointsOutsideRange { near, far, points: [low, high] })
    }

    /// A warning where nothing but the baseline determined an end of `bounds`.
    pub(super) fn of_bounds(bounds: &DepthBounds) -> Option<Self> {
        let DepthBounds { near, far, source } = bounds;
        source.is_guess().then_some(Self::DepthRangeGuessed { near: *near, far: *far })
    }
}

/// The sentence of `finding`. Where three pairs or more of `warnings` have a finding of its kind, in
/// different words or numbers: the sentence of the first of them, with the number of pairs.
fn of_pairs(warnings: &[Warning], finding: &Finding) -> String {
    let alike = |w: &Warning| match w {
        Warning::Poses { first, finding: f } if f.code == finding.code => {
            Some((*first, f.sentence.clone()))
        }
        _ => None,
    };
    let found: Vec<(usize, String)> = warnings.iter().filter_map(alike).collect();
    let pairs: BTreeSet<usize> = found.iter().map(|f| f.0).collect();
    let differ = found.iter().any(|f| f.1 != finding.sentence);
    match (found.first(), pairs.len()) {
        (Some((first, sentence)), 3..) if differ => format!(
            "{sentence} (found in {} pairs of photographs; the numbers are those of photographs \
             {first} and {}, counted from 0)",
            pairs.len(),
            first + 1
        ),
        _ => finding.sentence.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::check::DepthReport;
    use crate::reconstruct::DepthSource;

    #[test]
    fn equal_findings_of_many_pairs_are_one_sentence() {
        let pair = |first: usize, code: &str, number: usize| Warning::Poses {
            first,
            finding: Finding {
                severity: Verdict::Warning,
                code: code.to_owned(),
                sentence: format!("{code}: {number} px"),
            },
        };
        let near = |first| pair(first, "small_baseline", first);
        let other = pair(4, "brightness", 1);
        let many = Warning::sentences(&[near(4), other.clone(), near(5), near(8)]);
        let joined = "small_baseline: 4 px (found in 3 pairs of photographs; the numbers are those \
                      of photographs 4 and 5, counted from 0)";
        assert_eq!(many, [joined, "brightness: 1 px"]);
        // Two pairs, and two findings of one pair, keep their numbers.
        let two = Warning::sentences(&[near(4), pair(5, "small_baseline", 7), other, near(5)]);
        let apart = ["small_baseline: 4 px", "small_baseline: 7 px", "brightness: 1 px"];
        assert_eq!(two[..3], apart);
        assert_eq!(two[3..], ["small_baseline: 5 px"]);
        // Sentences without any difference need no number.
        let equal = [0, 1, 2].map(|first| pair(first, "same_photograph", 0));
        assert_eq!(Warning::sentences(&equal), ["same_photograph: 0 px"]);
    }

    #[test]
    fn a_range_without_the_points_is_said() {
        let report = |median: f32, verdict| PairReport {
            depth: Some(DepthReport {
                quantiles: [0.5 * median, 0.8 * median, median, 1.2 * median, 2.0 * median],
                near: 0.4 * median,
                far: 3.0 * median,
                baseline_over_depth: 0.1,
                parallax_px: 9.0,
            }),
            verdict,
            ..PairReport::default()
        };
        let good = |median| report(median, Verdict::Ok);
        let bounds = DepthBounds::new(20.0, 50.0, DepthSource::Fixed);
        let of = |reports: &[PairReport]| Warning::of_points(&bounds, reports);
        let found = of(&[good(3.0), good(4.0), good(30.0)]).unwrap();
        let text = found.to_string();
        assert!(text.contains("1.5000 to 6.0000 away") && text.contains("20.0000"), "{text}");
        assert!(of(&[good(80.0)]).is_some());
        // A quarter is nearer.
        assert!(of(&[good(24.0)]).is_some());
        for reports in [&[][..], &[good(30.0)], &[good(3.0), good(30.0)]] {
            assert_eq!(of(reports), None);
        }
        assert_eq!(of(&[report(3.0, Verdict::Bad), PairReport::default()]), None);
    }

    #[test]
    fn many_corrections_of_exposure_are_one_sentence() {
        let exposure = |photo| Warning::ExposureCorrected {
            photo,
            reference: 9,
            gain: [1.0; 3],
            offset: [photo as f32; 3],
        };
        let range = Warning::DepthRangeGuessed { near: 1.0, far: 2.0 };
        let two = Warning::sentences(&[exposure(0), range.clone(), exposure(1)]);
        assert_eq!(two.len(), 3);
        assert!(two[0].contains("photograph 0") && two[2].contains("+1"), "{two:?}");
        let many = [exposure(0), exposure(1), range.clone(), exposure(2), range];
        let sentences = Warning::sentences(&many);
        assert_eq!(sentences.len(), 2, "{sentences:?}");
        assert!(sentences[0].contains("of 3 photographs") && sentences[0].contains("photograph 9"));
    }
}
