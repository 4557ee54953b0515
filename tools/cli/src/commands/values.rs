//! Parsers of argument values that need no file. clap reports their errors as wrong usage.

use super::args::{InputSizeArg, PictureSizeArg};
use subsplat::files::splats::spz::SpzVersion;
use subsplat::reconstruct::{FisheyeCurve, FisheyeLens, Projection};
use subsplat::scene::metrics::SSIM_WINDOW;
use subsplat::{Density, Refine};
use subsplat_kernels::camera::Intrinsics;
use subsplat_kernels::layout::CHILDREN_MAX;

/// Largest number of views of a path.
const PATH_MAX: usize = 100_000;
/// Largest number of threads; to start millions would hang the machine.
const THREADS_MAX: usize = 1024;
/// Largest r of `--upscale`, as of the configuration.
const UPSCALE_MAX: f32 = 8.0;

/// Parses a whole number from `least` to `most`.
fn whole(text: &str, least: usize, most: usize) -> Result<usize, String> {
    let number = text.trim().parse().ok().filter(|n| (least..=most).contains(n));
    number.ok_or_else(|| match most {
        usize::MAX => format!("expected a whole number of at least {least}"),
        _ => format!("expected a whole number from {least} to {most}"),
    })
}

/// Parses a number of views.
pub fn frames(text: &str) -> Result<usize, String> {
    whole(text, 1, PATH_MAX)
}

/// Parses a number of frames of a video.
pub fn taken(text: &str) -> Result<usize, String> {
    whole(text, 2, 100).map_err(|expected| format!("{expected} (10 to 60 do best)"))
}

/// Parses a number of threads.
pub fn threads(text: &str) -> Result<usize, String> {
    whole(text, 1, THREADS_MAX)
}

/// Parses r, the target's side over the input's.
pub fn upscale(text: &str) -> Result<f32, String> {
    let inside = |r: &f32| (1.0..=UPSCALE_MAX).contains(r);
    let ratio = text.trim().parse().ok().filter(inside);
    ratio.ok_or_else(|| format!("expected a number from 1 to {UPSCALE_MAX}"))
}

/// Parses a number of Gaussians: `auto`, a whole number, a share of all as `P%`, or the number for each
/// pixel of the network's input as `K/px`.
pub fn density(text: &str) -> Result<Density, String> {
    let text = text.trim();
    if text == "auto" {
        return Ok(Density::Auto);
    }
    if let Some(each) = text.strip_suffix("/px") {
        let each = whole(each, 1, CHILDREN_MAX).map(Density::Each);
        return each
            .map_err(|_| format!("expected a whole number of 1 to {CHILDREN_MAX} before /px"));
    }
    let Some(percent) = text.strip_suffix('%') else {
        let count = whole(text, 1, usize::MAX);
        let expected =
            |_| "expected auto, a whole number of at least 1, a share as 50%, or 3/px".to_owned();
        return count.map(Density::Count).map_err(expected);
    };
    match percent.trim().parse::<f32>() {
        Ok(100.0) => Ok(Density::Full),
        Ok(p) if p > 0.0 && p < 100.0 => Ok(Density::Share(p / 100.0)),
        _ => Err("expected a share above 0 % and of at most 100 %".to_owned()),
    }
}

/// Parses a number of Gaussians of a finished scene: a whole number, or a share of all as `P%`.
pub fn reduced(text: &str) -> Result<Density, String> {
    match density(text) {
        Ok(Density::Auto | Density::Each(_)) => {
            Err("expected a whole number of at least 1, or a share as 50%".to_owned())
        }
        other => other,
    }
}

/// Largest number of steps of `--refine`.
const REFINE_MAX: usize = 100_000;

/// Largest number of seconds of `--refine`.
const REFINE_SECONDS_MAX: usize = 86_400;

/// Parses the length of a refinement: `auto`, `off`, steps, seconds with an `s`, or minutes with an `m`.
pub fn refine(text: &str) -> Result<Refine, String> {
    let text = text.trim();
    let seconds = |n: usize| Refine::Seconds(n as u32);
    let length = match text {
        "auto" => return Ok(Refine::Auto),
        "off" => return Ok(Refine::Off),
        _ => {
            if let Some(n) = text.strip_suffix('s') {
                whole(n, 1, REFINE_SECONDS_MAX).map(seconds)
            } else if let Some(n) = text.strip_suffix('m') {
                whole(n, 1, REFINE_SECONDS_MAX / 60).map(|n| seconds(60 * n))
            } else {
                whole(text, 0, REFINE_MAX).map(Refine::Steps)
            }
        }
    };
    length.map_err(|e| format!("expected auto, off, steps, 20s or 2m: {}", &e["expected ".len()..]))
}

/// Parses frames a second; a GIF counts hundredths of a second.
pub fn rate(text: &str) -> Result<u32, String> {
    whole(text, 1, 100).map(|n| n as u32)
}

/// Parses an SH degree.
pub fn sh_degree(text: &str) -> Result<usize, String> {
    whole(text, 0, 4)
}

/// Parses the SH degree of a file.
pub fn file_sh_degree(text: &str) -> Result<usize, String> {
    whole(text, 0, 3)
}

/// Parses the version of a written .spz.
pub fn spz_version(text: &str) -> Result<SpzVersion, String> {
    Ok(if whole(text, 3, 4)? == 3 { SpzVersion::V3 } else { SpzVersion::V4 })
}

/// Parses a number above 0.
pub fn at_least_one(text: &str) -> Result<usize, String> {
    whole(text, 1, usize::MAX)
}

/// Parses a finite number within `range`, which `expected` describes.
fn real(text: &str, range: impl Fn(f32) -> bool, expected: &str) -> Result<f32, String> {
    let number: Option<f32> = text.trim().parse().ok();
    number.filter(|v| v.is_finite() && range(*v)).ok_or_else(|| format!("expected {expected}"))
}

/// Parses a finite number above 0.
pub fn positive(text: &str) -> Result<f32, String> {
    real(text, |v| v > 0.0, "a finite number above 0")
}

/// Parses a number of minutes above 0.
pub fn minutes(text: &str) -> Result<f64, String> {
    positive(text).map(f64::from)
}

/// Parses a field of view, degrees.
pub fn fov(text: &str) -> Result<f32, String> {
    real(text, |v| v > 0.0 && v < 180.0, "degrees above 0 and below 180")
}

/// Parses the lens of photographs: `pinhole`, `panorama`, or `fisheye` with an angle, degrees, and a curve.
pub fn projection(text: &str) -> Result<Projection, String> {
    let expected = || {
        "expected pinhole, panorama or fisheye[:DEGREES][:equidistant|equisolid|stereographic], with 20 to 300 \
         degrees"
            .to_owned()
    };
    let mut words = text.split(':');
    match (words.next(), text.contains(':')) {
        (Some("pinhole"), false) => return Ok(Projection::Pinhole),
        (Some("panorama"), false) => return Ok(Projection::Panorama),
        (Some("fisheye"), _) => {}
        _ => return Err(expected()),
    }
    let mut lens = FisheyeLens::default();
    for (i, word) in words.enumerate() {
        match (word, word.parse::<f64>()) {
            (_, Ok(degrees)) if i == 0 && (20.0..=300.0).contains(&degrees) => {
                lens.angle = degrees.to_radians();
            }
            ("equidistant", _) if i < 2 => lens.curve = FisheyeCurve::Equidistant,
            ("equisolid", _) if i < 2 => lens.curve = FisheyeCurve::Equisolid,
            ("stereographic", _) if i < 2 => lens.curve = FisheyeCurve::Stereographic,
            _ => return Err(expected()),
        }
    }
    Ok(Projection::Fisheye(lens))
}

/// Parses a least opacity.
pub fn opacity(text: &str) -> Result<f32, String> {
    real(text, |v| (0.0..1.0).contains(&v), "0 to below 1")
}

/// Parses three numbers, separated by commas or white space.
pub fn triple(text: &str) -> Result<[f32; 3], String> {
    let numbers: Result<Vec<f32>, _> = text
        .split(|c: char| c == ',' || c.is_whitespace())
        .filter(|w| !w.is_empty())
        .map(str::parse)
        .collect();
    let three = numbers.ok().and_then(|v| <[f32; 3]>::try_from(v).ok());
    three
        .filter(|v| v.iter().all(|v| v.is_finite()))
        .ok_or_else(|| "expected three numbers with commas between them".to_owned())
}

/// Parses a colour of three numbers in [0, 1].
pub fn colour(text: &str) -> Result<[f32; 3], String> {
    let colour = triple(text)?;
    let inside = colour.iter().all(|v| (0.0..=1.0).contains(v));
    inside.then_some(colour).ok_or_else(|| "expected three numbers in [0, 1]".to_owned())
}

/// Parses the size of the network's input, `N` or `WxH`, px.
pub fn input_size(text: &str) -> Result<InputSizeArg, String> {
    let (width, height) = size(text)?;
    let side = !text.contains(['x', 'X', '×']);
    Ok(if side { InputSizeArg::Side(width) } else { InputSizeArg::Sides(width, height) })
}

/// Parses width and height of `N` or `WxH`, px.
pub fn size(text: &str) -> Result<(usize, usize), String> {
    let side = |s: &str| whole(s, 1, Intrinsics::SIDE_MAX);
    let sides = match text.split_once(['x', 'X', '×']) {
        Some((w, h)) => side(w).and_then(|w| Ok((w, side(h)?))),
        None => side(text).map(|n| (n, n)),
    };
    let most = Intrinsics::SIDE_MAX;
    sides.map_err(|_| format!("expected N or WxH, 1 to {most} pixels a side"))
}

/// Parses [`size`] from 11 px on, the window of SSIM, which compares pictures with photographs; or `photo`.
pub fn picture_size(text: &str) -> Result<PictureSizeArg, String> {
    match (text, size(text)) {
        ("photo", _) => Ok(PictureSizeArg::Photo),
        (_, Ok((width, height))) if width.min(height) >= SSIM_WINDOW => {
            Ok(PictureSizeArg::Sides(width, height))
        }
        _ => {
            let (least, most) = (SSIM_WINDOW, Intrinsics::SIDE_MAX);
            Err(format!("expected N or WxH, {least} to {most} pixels a side, or `photo`"))
        }
    }
}

/// The conflict of a near and a far end, if there is one.
pub fn depth_conflict(near: Option<f32>, far: Option<f32>) -> Option<String> {
    let (near, far) = near.zip(far)?;
    (near >= far).then(|| format!("--near {near}: expected less than --far {far}"))
}

/// Parses a part of several: `0/4`.
pub fn part(text: &str) -> Result<(usize, usize), String> {
    let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    let inside = |(i, n): &(usize, usize)| i < n;
    numbers.filter(inside).ok_or_else(|| format!("expected I/N with I from 0 to N-1, got `{text}`"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lenses_of_photographs() {
        assert_eq!(projection("pinhole"), Ok(Projection::Pinhole));
        assert_eq!(projection("panorama"), Ok(Projection::Panorama));
        let fisheye = |degrees: f64, curve| {
            Ok(Projection::Fisheye(FisheyeLens { angle: degrees.to_radians(), curve }))
        };
        assert_eq!(projection("fisheye"), fisheye(180.0, FisheyeCurve::Equidistant));
        assert_eq!(projection("fisheye:190"), fisheye(190.0, FisheyeCurve::Equidistant));
        assert_eq!(projection("fisheye:equisolid"), fisheye(180.0, FisheyeCurve::Equisolid));
        let both = projection("fisheye:150.5:stereographic");
        assert_eq!(both, fisheye(150.5, FisheyeCurve::Stereographic));
        let wrong = [
            "",
            "lens",
            "panorama:180",
            "pinhole:",
            "fisheye:",
            "fisheye:5",
            "fisheye:400",
            "fisheye:NaN",
            "fisheye:equisolid:180",
            "fisheye:180:equisolid:1",
        ];
        for text in wrong {
            assert!(projection(text).unwrap_err().contains("stereographic"), "{text}");
        }
    }

    #[test]
    fn numbers_of_gaussians() {
        assert_eq!((density("auto"), density("100%")), (Ok(Density::Auto), Ok(Density::Full)));
        assert_eq!(density(" 25 %"), Ok(Density::Share(0.25)));
        assert_eq!(
            (density("3/px"), density("1 /px")),
            (Ok(Density::Each(3)), Ok(Density::Each(1)))
        );
        assert!(density("0/px").is_err() && density("65/px").unwrap_err().contains("64"));
        assert!(reduced("3/px").is_err());
        assert_eq!(density("100000"), Ok(Density::Count(100_000)));
        for bad in ["", "0", "-3", "1.5", "0%", "101%", "NaN%", "%", "many"] {
            assert!(density(bad).unwrap_err().starts_with("expected a"), "{bad}");
        }
    }

    #[test]
    fn lengths_of_a_refinement() {
        assert_eq!(refine("auto"), Ok(Refine::Auto));
        assert_eq!(refine(" off"), Ok(Refine::Off));
        assert_eq!(refine("40"), Ok(Refine::Steps(40)));
        assert_eq!(refine("20s"), Ok(Refine::Seconds(20)));
        assert_eq!(refine("2m"), Ok(Refine::Seconds(120)));
        for length in ["auto", "off", "40", "20s"] {
            assert_eq!(refine(length).unwrap().to_string(), length);
        }
        for bad in ["", "s", "0s", "m", "-3", "1.5s", "100001", "86401s", "1441m", "fast"] {
            assert!(
                refine(bad).unwrap_err().starts_with("expected auto, off, steps, 20s or 2m"),
                "{bad}"
            );
        }
    }

    #[test]
    fn sizes() {
        assert_eq!(size("256"), Ok((256, 256)));
        assert_eq!(size("320x192"), Ok((320, 192)));
        assert_eq!(input_size("256"), Ok(InputSizeArg::Side(256)));
        assert_eq!(input_size("256x256"), Ok(InputSizeArg::Sides(256, 256)));
        for bad in ["", "0", "12x", "x12", "3x0", "-3", "1e9", "99999999999999999999", "32769"] {
            assert!(size(bad).unwrap_err().contains("N or WxH"), "{bad}");
        }
        assert_eq!(picture_size("11x40"), Ok(PictureSizeArg::Sides(11, 40)));
        for bad in ["10", "40x10", "photos"] {
            assert!(picture_size(bad).unwrap_err().contains("11 to 32768"), "{bad}");
        }
    }

    #[test]
    fn numbers_have_their_bounds() {
        assert_eq!((upscale("1"), upscale("1.5"), sh_degree("0")), (Ok(1.0), Ok(1.5), Ok(0)));
        for bad in ["0", "0.99", "8.1", "9", "NaN", "inf", "two"] {
            assert_eq!(upscale(bad), Err("expected a number from 1 to 8".to_owned()), "{bad}");
        }
        assert!(upscale("8").is_ok() && sh_degree("5").is_err());
        assert!(frames("0").is_err() && frames("100000").is_ok() && frames("100001").is_err());
        assert!(at_least_one("0").is_err() && at_least_one("7").is_ok());
        assert_eq!((fov("179.9"), opacity("0")), (Ok(179.9), Ok(0.0)));
        assert!(["0", "180", "nan", "x"].iter().all(|t| fov(t).is_err()));
        assert!(["-0.1", "1", "nan"].iter().all(|t| opacity(t).is_err()));
        assert!(["0", "-1", "nan", "inf"].iter().all(|t| positive(t).is_err()));
        assert_eq!(colour("0,0.5 1"), Ok([0.0, 0.5, 1.0]));
        assert!(colour("0,1.1,0").is_err() && colour("0,1").is_err());
        assert!(triple("nan,0,0").is_err() && triple("-3,0,7").is_ok());
        assert!(depth_conflict(Some(2.0), Some(2.0)).is_some());
        assert!(depth_conflict(Some(1.0), Some(2.0)).or(depth_conflict(Some(1.0), None)).is_none());
    }
}
