//! The methods that are compared: the model, its parts, and baselines without a model.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use subsplat::files::photos::image::load;
use subsplat::reconstruct::inputs::crop::Cropped;
use subsplat::reconstruct::{Error, Result};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::Camera;

/// A method that gives a picture of a target view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Method {
    /// The model.
    Subsplat,
    /// The model with detail from the photographs ([`subsplat_kernels::cpu::detail`]).
    Detail,
    /// The model with detail, fitted to the photographs ([`subsplat::finish::fit()`]).
    Fit,
    /// Gaussians that `subsplat run` gives: parents at the depth at which the photographs agree, optimised on the
    /// photographs of the input's size; their children with detail, fitted and refined
    /// ([`subsplat::finish::refine()`]).
    Refine,
    /// [`Method::Refine`] without the Gaussians where no photograph shows the scene.
    Bare,
    /// [`Method::Refine`] without the match of depths between the photographs.
    Unmatched,
    /// [`Method::Fit`], refined on the photographs: the parents stay as predicted.
    Direct,
    /// [`Method::Refine`] on the two inputs nearest to the target alone.
    Pair,
    /// The Gaussians of [`Method::Detail`] at full density, without those of the least opacities: as
    /// many as [`super::Options::density`] allows.
    Opaque,
    /// The same without Gaussians chosen at random, the same ones in every run.
    Random,
    /// Its backbone's Gaussians, one a pixel, rendered at the target's size.
    Backbone,
    /// The same with the low-pass scaled to the input: r² times as many target px².
    Lowpass,
    /// The backbone's Gaussians rendered at the input's size, then enlarged bilinearly.
    Bilinear,
    /// The picture of [`Method::Refine`] for a target of the input's size, enlarged by Lanczos: the
    /// strongest picture without children.
    Enlarged,
    /// The picture of [`Method::Refine`] for a target of half the sides, enlarged by Lanczos.
    Half,
    /// K = r² equal children of each of the backbone's Gaussians, evenly over its pixel:
    /// SubSplat's split with untrained heads. The paper's Table D trains a backbone with K
    /// Gaussians a pixel instead (`gaussians_per_pixel` of its configuration); score its weights
    /// by [`Method::Backbone`].
    Uniform,
    /// The input whose camera is nearest to the target's, enlarged bilinearly.
    Copy,
    /// Mean of the inputs, enlarged bilinearly.
    Mean,
    /// PNG pictures of another program.
    Other {
        /// Name in the tables.
        name: String,
        /// Their folder; [`Method::other_picture`] states the layouts.
        folder: PathBuf,
    },
}

/// Names of the methods that need no files, in the order of the tables.
pub(crate) const NAMED: [(&str, Method); 18] = [
    ("subsplat", Method::Subsplat),
    ("detail", Method::Detail),
    ("fit", Method::Fit),
    ("refine", Method::Refine),
    ("bare", Method::Bare),
    ("unmatched", Method::Unmatched),
    ("direct", Method::Direct),
    ("pair", Method::Pair),
    ("opaque", Method::Opaque),
    ("random", Method::Random),
    ("backbone", Method::Backbone),
    ("lowpass", Method::Lowpass),
    ("bilinear", Method::Bilinear),
    ("enlarged", Method::Enlarged),
    ("half", Method::Half),
    ("uniform", Method::Uniform),
    ("copy", Method::Copy),
    ("mean", Method::Mean),
];

impl FromStr for Method {
    type Err = String;

    /// Parses a name, or `NAME=DIR` as [`Method::Other`].
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        if let Some((_, method)) = NAMED.iter().find(|(name, _)| *name == text) {
            return Ok(method.clone());
        }
        let names = NAMED.map(|(name, _)| name).join(", ");
        match text.split_once('=') {
            Some((name, folder)) if is_folder_name(name) && !folder.is_empty() => {
                if NAMED.iter().any(|(n, _)| *n == name) {
                    return Err(format!("expected a name other than {names}, got `{name}`"));
                }
                Ok(Self::Other { name: name.to_owned(), folder: folder.into() })
            }
            Some(_) => Err(format!(
                "expected NAME=DIR, NAME of letters, digits, `-`, `_`, `.` and `+`, got `{text}`"
            )),
            None => Err(format!("expected one of {names}, got `{text}`")),
        }
    }
}

/// Returns whether a name may be that of a folder.
fn is_folder_name(name: &str) -> bool {
    let letter = |c: char| c.is_alphanumeric() || "-_.+".contains(c);
    !name.is_empty() && name.chars().all(letter) && !name.starts_with('.')
}

impl Method {
    /// The name in the tables, and of the folder of its pictures.
    pub fn name(&self) -> &str {
        match self {
            Self::Other { name, .. } => name,
            named => NAMED.iter().find(|(_, m)| m == named).map_or("", |(name, _)| name),
        }
    }

    /// Returns whether it needs the model.
    pub fn needs_model(&self) -> bool {
        !matches!(self, Self::Copy | Self::Mean | Self::Other { .. })
    }

    /// Reads another program's picture of a target. The first that exists is read:
    /// `SCENE/PAIR/NNNNNN.png` (this program's own layout), `SCENE/color/NNNNNN.png`
    /// (MVSplat's), `SCENE/NNNNNN.png` or `SCENE/NAME.png`. PAIR are the inputs' frames (`0_8`),
    /// NNNNNN is the target's frame and NAME its name.
    ///
    /// # Errors
    /// No such picture; a broken one; another size than `size`.
    pub fn other_picture(
        folder: &Path,
        (scene, pair): (&str, &str),
        (frame, name): (usize, &str),
        size: (usize, usize),
    ) -> Result<Rgb> {
        let number = format!("{frame:06}.png");
        let scene = folder.join(scene);
        let places = [
            scene.join(pair).join(&number),
            scene.join("color").join(&number),
            scene.join(&number),
            scene.join(format!("{name}.png")),
        ];
        let Some(file) = places.iter().find(|p| p.is_file()) else {
            let first = places[0].display().to_string();
            let expected = "a picture (or color/, or beside, or by name)";
            return Err(Error::argument(first, expected, "none"));
        };
        let picture = load(file)?;
        if (picture.width, picture.height) != size {
            let got = format!("{}x{}", picture.width, picture.height);
            let expected = format!("{}x{}", size.0, size.1);
            return Err(Error::argument(file.display().to_string(), expected, got));
        }
        Ok(picture)
    }
}

/// Enlarges the input whose camera is nearest to `target` to `size`.
pub(crate) fn nearest(inputs: &[Cropped], target: &Camera, size: (usize, usize)) -> Vec<f32> {
    let distance = |c: &&Cropped| c.input_camera.position().distance(target.position());
    let nearest = inputs.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.map_or_else(Vec::new, |c| {
        enlarged(&c.input.to_unit(), (c.input.width, c.input.height), size)
    })
}

/// Averages the inputs, and enlarges the mean to `size`.
pub(crate) fn mean(inputs: &[Cropped], size: (usize, usize)) -> Vec<f32> {
    let Some(first) = inputs.first() else { return Vec::new() };
    let mut sum = vec![0.0f32; first.input.data.len()];
    for c in inputs {
        sum.iter_mut().zip(&c.input.data).for_each(|(s, v)| *s += f32::from(*v) / 255.0);
    }
    sum.iter_mut().for_each(|s| *s /= inputs.len() as f32);
    enlarged(&sum, (first.input.width, first.input.height), size)
}

/// Enlarges `[h, w, 3]` to a picture of `to` (width, height) bilinearly: pixel centres at +0.5,
/// borders repeated (PyTorch's `interpolate` with `align_corners=False`).
pub(crate) fn enlarged(
    picture: &[f32],
    (w, h): (usize, usize),
    (to_w, to_h): (usize, usize),
) -> Vec<f32> {
    let taps = |side: usize, to: usize| -> Vec<(usize, usize, f32)> {
        let tap = |i: usize| {
            let at = ((i as f32 + 0.5) * side as f32 / to as f32 - 0.5).max(0.0);
            let low = (at as usize).min(side - 1);
            (low, (low + 1).min(side - 1), at - low as f32)
        };
        (0..to).map(tap).collect()
    };
    if w == 0 || h == 0 || picture.len() != 3 * w * h {
        return Vec::new();
    }
    let (columns, rows) = (taps(w, to_w), taps(h, to_h));
    let mut out = Vec::with_capacity(3 * to_w * to_h);
    for &(top, bottom, fy) in &rows {
        for &(left, right, fx) in &columns {
            for c in 0..3 {
                let at = |x: usize, y: usize| picture[3 * (y * w + x) + c];
                let upper = at(left, top) + fx * (at(right, top) - at(left, top));
                let lower = at(left, bottom) + fx * (at(right, bottom) - at(left, bottom));
                out.push(upper + fy * (lower - upper));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for (name, method) in NAMED {
            assert_eq!(name.parse::<Method>().unwrap(), method);
            assert_eq!(method.name(), name);
        }
        let other: Method = "PixelSplat-v1=some/folder=x".parse().unwrap();
        assert_eq!(other.name(), "PixelSplat-v1");
        assert!(
            matches!(&other, Method::Other { folder, .. } if folder == Path::new("some/folder=x"))
        );
        for bad in ["", "nearest", "a/b=c", "=c", "a=", "..=c", "copy=c", "a b=c"] {
            assert!(bad.parse::<Method>().unwrap_err().contains("expected"), "{bad}");
        }
    }

    /// PyTorch: interpolate([0, 1], scale 2, bilinear, align_corners=False) is
    /// [0, ¼, ¾, 1].
    #[test]
    fn enlarging_is_pytorchs() {
        let pair = [[0.0f32; 3], [1.0; 3]].concat();
        let wide = enlarged(&pair, (2, 1), (4, 2));
        let row: Vec<f32> = wide.iter().step_by(3).copied().collect();
        assert_eq!(row, [0.0, 0.25, 0.75, 1.0, 0.0, 0.25, 0.75, 1.0]);
        assert_eq!(enlarged(&pair, (2, 1), (2, 1)), pair);
        let tall = enlarged(&pair, (1, 2), (4, 8));
        let column: Vec<f32> = tall.iter().step_by(12).copied().collect();
        assert_eq!(column, [0.0, 0.0, 0.125, 0.375, 0.625, 0.875, 1.0, 1.0]);
    }
}
