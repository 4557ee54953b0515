//! `subsplat compare` of a rasterizer case: our picture, and its gradients, against the
//! reference's.
//!
//! Pixels that the file marks as boundary are left out: there a decision (alpha below
//! 1/255, the stop, the cap, a tile's edge) hangs on rounding, and a flip is no error.

use super::raster_case::Case;
use anyhow::{Result, ensure};
use subsplat::abi::{
    Convention, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};
use subsplat::cpu::{Gradients, Rasterizer, Rendered, SimdLevel};
use subsplat::model::compare::Row;
use subsplat::render::Renderer;

/// Largest |difference| of RGB and alpha, `standard`: ten times the f32 floor.
const COLOUR_STANDARD: f32 = 3e-5;
/// The same, `mvsplat`, whose splats come as near as z = 0.2.
const COLOUR_MVSPLAT: f32 = 1e-4;
/// Largest relative difference of depths.
const DEPTH: f32 = 1e-4;
/// Least Σ w·z that a difference is divided by, world units: alpha = 1 − T has few
/// digits where almost nothing covers a pixel.
const DEPTH_SUM_LEAST: f32 = 0.1;
/// Least depth that a difference is divided by, world units.
const DEPTH_LEAST: f32 = 1e-3;

/// Largest error of a gradient, as [`gradient_error`] measures it: ten times the floor.
const GRADIENT: f32 = 5e-4;
/// The same where splats are a hundred times longer than wide.
const GRADIENT_NEEDLES: f32 = 2e-3;
/// The case that holds such splats.
const NEEDLES: &str = "needles";

/// Name, what came, its shape, what is allowed, and from which size on errors are relative.
type Output<'a> = (&'static str, &'a [f32], &'a [usize], f32, Option<f32>);

/// Renders the case with the instructions of `level` and compares every output that the file holds. `relative` of a row
/// is the difference in the tensor's own measure: absolute for colours and alpha.
///
/// # Errors
/// A tensor is missing or has another shape; every pixel is marked as boundary.
pub fn compare(case: &Case, level: SimdLevel) -> Result<Vec<Row>> {
    let mut rasterizer = Rasterizer::new().with_simd_level(level);
    let got = rasterizer.render(&case.splats(), &case.camera, &case.options);
    let mut rows = picture(case, &got)?;
    if case.has("v_rgb") {
        let (planes, mut got) = (upstream(case)?, Gradients::default());
        rasterizer.backward(&case.splats(), &case.camera, &case.options, &planes, &mut got);
        gradients(case, &got, &mut rows)?;
    }
    Ok(rows)
}

/// [`compare`] of what `renderer`'s device makes.
///
/// # Errors
/// As [`compare`]; the device fails.
pub fn compare_on(case: &Case, renderer: &mut Renderer) -> Result<Vec<Row>> {
    let (splats, camera, options) = (case.splats(), &case.camera, &case.options);
    let got = renderer.render_slices(&splats, camera, options)?;
    let mut rows = picture(case, &got)?;
    if case.has("v_rgb") {
        let got = renderer.backward(&splats, camera, options, &upstream(case)?)?;
        gradients(case, &got, &mut rows)?;
    }
    Ok(rows)
}

fn picture(case: &Case, got: &Rendered) -> Result<Vec<Row>> {
    let k = case.camera.intrinsics;
    let pixels = [k.height, k.width];
    let boundary = case.array("boundary", &pixels)?;
    ensure!(boundary.contains(&0.0), "tensor `boundary`: expected a pixel to compare, got none");
    let colour = match case.options.convention {
        Convention::Standard => COLOUR_STANDARD,
        Convention::Mvsplat => COLOUR_MVSPLAT,
    };
    let depth = got.depth();
    let rgb = [k.height, k.width, 3];
    let outputs: [Output; 4] = [
        ("rgb", &got.rgb, &rgb, colour, None),
        ("alpha", &got.alpha, &pixels, colour, None),
        ("depth_sum", &got.depth_sum, &pixels, DEPTH, Some(DEPTH_SUM_LEAST)),
        ("depth", &depth, &pixels, DEPTH, Some(DEPTH_LEAST)),
    ];
    let mut rows = Vec::new();
    for (name, ours, shape, allowed, least) in outputs {
        let theirs = case.array(name, shape)?;
        let lanes = shape.get(2).copied().unwrap_or(1);
        let inner = |i: usize| boundary.get(i / lanes).is_some_and(|&b| b == 0.0);
        let pairs = ours.iter().zip(theirs).enumerate().filter(|(i, _)| inner(*i));
        let (mut max_abs, mut relative) = (0.0, 0.0);
        for (_, (ours, theirs)) in pairs {
            let d = (ours - theirs).abs();
            max_abs = worst(max_abs, d);
            relative = worst(relative, least.map_or(d, |least| d / theirs.abs().max(least)));
        }
        rows.push(row(name, max_abs, relative, allowed));
    }
    Ok(rows)
}

/// The case's gradients of the picture as planes `[5, H, W]`.
fn upstream(case: &Case) -> Result<Vec<f32>> {
    let k = case.camera.intrinsics;
    let v_rgb = case.array("v_rgb", &[k.height, k.width, 3])?;
    let v_alpha = case.array("v_alpha", &[k.height, k.width])?;
    let mut planes: Vec<f32> = Vec::with_capacity(5 * v_alpha.len());
    for c in 0..3 {
        planes.extend(v_rgb.iter().skip(c).step_by(3));
    }
    planes.extend(v_alpha);
    planes.resize(5 * v_alpha.len(), 0.0);
    Ok(planes)
}

/// Compares the gradients of Σ rgb·v_rgb + Σ alpha·v_alpha.
fn gradients(case: &Case, got: &Gradients, rows: &mut Vec<Row>) -> Result<()> {
    let splats = case.splats();
    let allowed = if case.name == NEEDLES { GRADIENT_NEEDLES } else { GRADIENT };
    let lanes = |from: usize, count: usize| -> Vec<f32> {
        got.rows
            .chunks_exact(SPLAT_STRIDE)
            .flat_map(|r| r.iter().skip(from).take(count))
            .copied()
            .collect()
    };
    let (n, p) = (splats.len(), splats.parents());
    let coefficients = got.sh.len() / (3 * p.max(1));
    let mut all: Vec<(&str, Vec<f32>, Vec<usize>)> = match case.options.convention {
        Convention::Standard => vec![
            ("grad.means", lanes(MEAN_OFFSET, 3), vec![n, 3]),
            ("grad.quats", lanes(QUAT_OFFSET, 4), vec![n, 4]),
            ("grad.scales", lanes(SCALE_OFFSET, 3), vec![n, 3]),
            ("grad.opacities", lanes(OPACITY_OFFSET, 1), vec![n]),
        ],
        Convention::Mvsplat => vec![
            ("grad.means", got.means.clone(), vec![n, 3]),
            ("grad.cov6", got.cov6.clone(), vec![n, 6]),
            ("grad.opacities", got.opacities.clone(), vec![n]),
        ],
    };
    all.push(("grad.sh", got.sh.clone(), vec![p, coefficients, 3]));
    if !splats.gain.is_empty() {
        all.push(("grad.gain", got.gain.clone(), vec![n]));
    }
    all.push(("grad.background", got.background.to_vec(), vec![3]));
    for (name, ours, shape) in all {
        let theirs = case.array(name, &shape)?;
        // One splat's, or one parent's, numbers; the background is one row.
        let width = match shape.as_slice() {
            [3] => 3,
            [_, rest @ ..] => rest.iter().product(),
            [] => 1,
        };
        let (max_abs, relative) = gradient_error(&ours, theirs, width);
        rows.push(row(name, max_abs, relative, allowed));
    }
    Ok(())
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
