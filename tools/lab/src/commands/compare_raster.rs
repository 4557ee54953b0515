//! `subsplat-lab compare` of a rasterizer case: our picture and its gradients against those of
//! the reference, as far as the file holds them.
//!
//! Boundary pixels are left out, where the file marks them: there rounding may flip a
//! decision (alpha below 1/255, the end of blending, the cap on alpha, the edge of a tile).

use super::raster_case::Case;
use crate::compare::Row;
use anyhow::{Result, ensure};
use subsplat::scene::render::Renderer;
use subsplat_kernels::cpu::{Gradients, Rasterizer, Rendered, SimdLevel};
use subsplat_kernels::layout::{
    Convention, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};

/// Largest |difference| of RGB and alpha, `standard`: ten times the f32 floor.
const COLOUR_STANDARD: f32 = 3e-5;
/// The same, `mvsplat`, whose splats come as near as z = 0.2.
const COLOUR_MVSPLAT: f32 = 1e-4;
/// Largest relative difference of depths.
const DEPTH: f32 = 1e-4;
/// Smallest Σ w·z that a difference is divided by, world units: alpha = 1 − T has few
/// digits where almost nothing covers a pixel.
const DEPTH_SUM_MIN: f32 = 0.1;
/// Smallest depth that a difference is divided by, world units.
const DEPTH_MIN: f32 = 1e-3;

/// Largest error of a gradient, as [`gradient_error`] measures it: ten times the floor.
const GRADIENT: f32 = 5e-4;
/// The same where splats are a hundred times longer than wide.
const GRADIENT_NEEDLES: f32 = 2e-3;
/// The case that holds such splats.
const NEEDLES: &str = "needles";

/// The comparison of one case.
#[derive(Default)]
pub struct Comparison {
    /// The tensors that the file holds.
    pub rows: Vec<Row>,
    /// Optional tensors that it does not hold.
    pub absent: Vec<String>,
}

impl Comparison {
    /// Gives the values of an optional tensor, or notes its absence.
    fn take<'a>(
        &mut self,
        case: &'a Case,
        name: &str,
        shape: &[usize],
    ) -> Result<Option<&'a [f32]>> {
        let values = case.optional(name, shape)?;
        if values.is_none() {
            self.absent.push(name.to_owned());
        }
        Ok(values)
    }
}

/// One output of our rasterizer.
struct Output<'a> {
    name: &'static str,
    values: &'a [f32],
    shape: &'a [usize],
    /// Largest difference that passes.
    allowed: f32,
    /// The difference is divided by |reference|, or by this where that is smaller; `None`
    /// compares absolute differences.
    relative_to: Option<f32>,
}

/// Renders the case with the instructions of `level` and compares the outputs that the file
/// holds. `relative` of a row is the difference in the tensor's own measure: absolute for
/// colours and alpha.
///
/// # Errors
/// The file holds nothing to compare; a tensor has another shape; every pixel is marked as
/// boundary.
pub fn compare(case: &Case, level: SimdLevel) -> Result<Comparison> {
    let mut rasterizer = Rasterizer::new().with_simd_level(level);
    let got = rasterizer.render(&case.splats(), &case.camera, &case.options);
    let mut comparison = picture(case, &got)?;
    let references = gradient_references(case, &mut comparison)?;
    if let Some(upstream) = &references.upstream {
        let mut got = Gradients::default();
        rasterizer.backward(&case.splats(), &case.camera, &case.options, upstream, &mut got);
        gradients(case, &got, &references, &mut comparison);
    }
    finished(comparison)
}

/// Compares the outputs of `renderer`'s device as [`compare`] does.
///
/// # Errors
/// As [`compare`]; the device fails.
pub fn compare_on(case: &Case, renderer: &mut Renderer) -> Result<Comparison> {
    let splats = case.splats();
    let camera = &case.camera;
    let options = &case.options;
    let got = renderer.render_slices(&splats, camera, options)?;
    let mut comparison = picture(case, &got)?;
    let references = gradient_references(case, &mut comparison)?;
    if let Some(upstream) = &references.upstream {
        let got = renderer.backward(&splats, camera, options, upstream)?;
        gradients(case, &got, &references, &mut comparison);
    }
    finished(comparison)
}

fn finished(comparison: Comparison) -> Result<Comparison> {
    ensure!(
        !comparison.rows.is_empty(),
        "rasterizer case: expected a tensor to compare, got none of {}",
        comparison.absent.join(", ")
    );
    Ok(comparison)
}

/// Compares the outputs of the forward pass.
fn picture(case: &Case, got: &Rendered) -> Result<Comparison> {
    let k = case.camera.intrinsics();
    let pixels = [k.height, k.width];
    let mut comparison = Comparison::default();
    let boundary = comparison.take(case, "boundary", &pixels)?;
    ensure!(
        boundary.is_none_or(|b| b.contains(&0.0)),
        "tensor `boundary`: expected a pixel to compare, got none"
    );
    let colour = match case.options.convention {
        Convention::Standard => COLOUR_STANDARD,
        Convention::Mvsplat => COLOUR_MVSPLAT,
    };
    let depth = got.depth();
    let rgb = [k.height, k.width, 3];
    let output = |name, values, shape, allowed, relative_to| Output {
        name,
        values,
        shape,
        allowed,
        relative_to,
    };
    let outputs = [
        output("rgb", &got.rgb[..], &rgb[..], colour, None),
        output("alpha", &got.alpha, &pixels, colour, None),
        output("depth_sum", &got.depth_sum, &pixels, DEPTH, Some(DEPTH_SUM_MIN)),
        output("depth", &depth, &pixels, DEPTH, Some(DEPTH_MIN)),
    ];
    for Output { name, values, shape, allowed, relative_to } in outputs {
        let Some(reference) = comparison.take(case, name, shape)? else { continue };
        let channels = shape.get(2).copied().unwrap_or(1);
        let inner = |i: usize| {
            boundary.is_none_or(|b| b.get(i / channels).is_some_and(|&pixel| pixel == 0.0))
        };
        let pairs = values.iter().zip(reference).enumerate().filter(|(i, _)| inner(*i));
        let (mut max_abs, mut relative) = (0.0, 0.0);
        for (_, (ours, reference)) in pairs {
            let d = (ours - reference).abs();
            max_abs = worst(max_abs, d);
            let size = relative_to.map_or(1.0, |least| reference.abs().max(least));
            relative = worst(relative, d / size);
        }
        comparison.rows.push(row(name, max_abs, relative, allowed));
    }
    Ok(comparison)
}

/// A gradient of the file.
struct GradientReference<'a> {
    name: &'static str,
    values: &'a [f32],
    /// Numbers of one splat, or of one parent's SH; the background is one row.
    width: usize,
}

/// The gradients that a case holds.
struct GradientReferences<'a> {
    /// ∂L/∂(rgb, alpha, depth), planes `[5, H, W]`; `None` where there is nothing to compare.
    upstream: Option<Vec<f32>>,
    gradients: Vec<GradientReference<'a>>,
}

/// Collects the gradients of the file and those of the picture that they follow from.
fn gradient_references<'a>(
    case: &'a Case,
    comparison: &mut Comparison,
) -> Result<GradientReferences<'a>> {
    let splats = case.splats();
    let (n, p) = (splats.len(), splats.parents());
    let coefficients = splats.sh.len() / (3 * p.max(1));
    let mut shapes: Vec<(&str, Vec<usize>)> = match case.options.convention {
        Convention::Standard => vec![
            ("grad.means", vec![n, 3]),
            ("grad.quats", vec![n, 4]),
            ("grad.scales", vec![n, 3]),
            ("grad.opacities", vec![n]),
        ],
        Convention::Mvsplat => {
            vec![("grad.means", vec![n, 3]), ("grad.cov6", vec![n, 6]), ("grad.opacities", vec![n])]
        }
    };
    shapes.push(("grad.sh", vec![p, coefficients, 3]));
    if !splats.gain.is_empty() {
        shapes.push(("grad.gain", vec![n]));
    }
    shapes.push(("grad.background", vec![3]));
    let mut gradients = Vec::new();
    for (name, shape) in shapes {
        let width = match shape.as_slice() {
            [3] => 3,
            [_, rest @ ..] => rest.iter().product(),
            [] => 1,
        };
        if let Some(values) = comparison.take(case, name, &shape)? {
            gradients.push(GradientReference { name, values, width });
        }
    }
    let k = case.camera.intrinsics();
    let pixels = k.height * k.width;
    let v_rgb = comparison.take(case, "v_rgb", &[k.height, k.width, 3])?;
    let v_alpha = comparison.take(case, "v_alpha", &[k.height, k.width])?;
    let Some(first) = gradients.first() else {
        return Ok(GradientReferences { upstream: None, gradients });
    };
    ensure!(
        v_rgb.is_some() || v_alpha.is_some(),
        "tensor `{}`: expected v_rgb or v_alpha beside it, got neither",
        first.name
    );
    let mut planes = vec![0.0; 5 * pixels];
    for (c, plane) in planes.chunks_exact_mut(pixels).take(3).enumerate() {
        let values = v_rgb.unwrap_or_default().iter().skip(c).step_by(3);
        plane.iter_mut().zip(values).for_each(|(to, v)| *to = *v);
    }
    let values = v_alpha.unwrap_or_default();
    planes.iter_mut().skip(3 * pixels).zip(values).for_each(|(to, v)| *to = *v);
    Ok(GradientReferences { upstream: Some(planes), gradients })
}

/// Compares the gradients of Σ rgb·v_rgb + Σ alpha·v_alpha.
fn gradients(
    case: &Case,
    got: &Gradients,
    references: &GradientReferences,
    comparison: &mut Comparison,
) {
    let allowed = if case.name == NEEDLES { GRADIENT_NEEDLES } else { GRADIENT };
    let packed = case.options.convention == Convention::Standard;
    let column = |from: usize, count: usize| -> Vec<f32> {
        let rows = got.rows.chunks_exact(SPLAT_STRIDE);
        rows.flat_map(|r| r.iter().skip(from).take(count)).copied().collect()
    };
    for GradientReference { name, values, width } in &references.gradients {
        let ours = match *name {
            "grad.means" if packed => column(MEAN_OFFSET, 3),
            "grad.quats" => column(QUAT_OFFSET, 4),
            "grad.scales" => column(SCALE_OFFSET, 3),
            "grad.opacities" if packed => column(OPACITY_OFFSET, 1),
            "grad.means" => got.means.clone(),
            "grad.cov6" => got.cov6.clone(),
            "grad.opacities" => got.opacities.clone(),
            "grad.sh" => got.sh.clone(),
            "grad.gain" => got.gain.clone(),
            _ => got.background.to_vec(),
        };
        let (max_abs, relative) = gradient_error(&ours, values, *width);
        comparison.rows.push(row(name, max_abs, relative, allowed));
    }
}

/// Largest |difference|, and the largest over rows of `width` numbers of
/// max|difference| / (max|row| + median of max|row| over the rows that are not zero).
fn gradient_error(ours: &[f32], theirs: &[f32], width: usize) -> (f32, f32) {
    let size = |row: &[f32]| row.iter().map(|v| v.abs()).fold(0.0, worst);
    let mut sizes: Vec<f32> = theirs.chunks(width).map(size).filter(|&s| s > 0.0).collect();
    sizes.sort_by(f32::total_cmp);
    let median = sizes.get(sizes.len() / 2).copied().unwrap_or_default();
    let (mut max_abs, mut relative) = (0.0, 0.0);
    if ours.len() != theirs.len() {
        return (f32::INFINITY, f32::INFINITY);
    }
    for (ours, theirs) in ours.chunks(width).zip(theirs.chunks(width)) {
        let d = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, worst);
        max_abs = worst(max_abs, d);
        if d != 0.0 {
            relative = worst(relative, d / (size(theirs) + median));
        }
    }
    (max_abs, relative)
}

/// The larger; NaN wins, which `max` would drop.
fn worst(m: f32, v: f32) -> f32 {
    if v > m || v.is_nan() { v } else { m }
}

fn row(name: &str, max_abs: f32, relative: f32, allowed: f32) -> Row {
    let ok = relative <= allowed;
    Row { tensor: name.to_owned(), max_abs, relative, allowed, ok, note: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_never_passes() {
        let d = [0.0, f32::NAN, 1e-9].into_iter().fold(0.0, worst);
        assert!(!row("rgb", d, d, 1.0).ok);
        assert!(row("rgb", 0.5, 0.5, 1.0).ok);
        assert!(!row("rgb", 0.5, 1.5, 1.0).ok);
        assert!(gradient_error(&[1.0, f32::NAN], &[1.0, 2.0], 1).1.is_nan());
    }

    #[test]
    fn gradients_are_measured_against_their_row_and_the_median() {
        // Rows of sizes 4 and 2; zeros do not count: the median is 4 of [2, 4].
        let theirs = [4.0, -1.0, 0.0, 0.0, 1.0, 2.0];
        let mut ours = theirs;
        assert_eq!(gradient_error(&ours, &theirs, 2), (0.0, 0.0));
        ours[5] += 0.5;
        assert_eq!(gradient_error(&ours, &theirs, 2), (0.5, 0.5 / 6.0));
        // A gradient where none should be.
        ours[2] = 1.0;
        assert_eq!(gradient_error(&ours, &theirs, 2), (1.0, 0.25));
        // All zeros there: any difference is too much.
        assert_eq!(gradient_error(&[0.1], &[0.0], 1), (0.1, f32::INFINITY));
    }
}
