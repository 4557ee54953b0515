//! `subsplat compare` of a rasterizer case: our picture against the reference's.
//!
//! Pixels that the file marks as boundary are left out: there a decision (alpha below
//! 1/255, the stop, the cap, a tile's edge) hangs on rounding, and a flip is no error.

use super::raster_case::Case;
use anyhow::{Result, ensure};
use subsplat::abi::Convention;
use subsplat::cpu::Rasterizer;
use subsplat::model::compare::Row;

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

/// Renders the case and compares every output that the file holds. `relative` of a row
/// is the difference in the tensor's own measure: absolute for colours and alpha.
///
/// # Errors
/// A tensor is missing or has another shape; every pixel is marked as boundary.
pub fn compare(case: &Case) -> Result<Vec<Row>> {
    let k = case.camera.intrinsics;
    let pixels = [k.height, k.width];
    let boundary = case.array("boundary", &pixels)?;
    ensure!(boundary.contains(&0.0), "tensor `boundary`: expected a pixel to compare, got none");
    let got = Rasterizer::new().render(&case.splats(), &case.camera, &case.options);
    let colour = match case.options.convention {
        Convention::Standard => COLOUR_STANDARD,
        Convention::Mvsplat => COLOUR_MVSPLAT,
    };
    let depth = got.depth();
    let rgb = [k.height, k.width, 3];
    let outputs: [(&str, &[f32], &[usize], f32, Option<f32>); 4] = [
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
    }
}
