//! The rasterizer's gradients as the conformance cases of `shared/fixtures/raster` measure
//! them.

use crate::raster_case::File;
use subsplat_kernels::cpu::Gradients;
use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
};

/// `[5, H, W]` from the gradients of rgb `[H, W, 3]` and alpha `[H, W]`; depth gets none.
pub fn planes(v_rgb: &[f32], v_alpha: &[f32]) -> Vec<f32> {
    let n = v_alpha.len();
    let mut out = vec![0.0; 5 * n];
    for p in 0..n {
        for c in 0..3 {
            out[c * n + p] = v_rgb[3 * p + c];
        }
        out[3 * n + p] = v_alpha[p];
    }
    out
}

/// Largest error over rows of `lanes` numbers, as the README measures it:
/// max|difference| / (max|row| + median of max|row| over non-zero rows).
pub fn worst_row(got: &[f32], expected: &[f32], lanes: usize) -> f32 {
    assert_eq!(got.len(), expected.len());
    let most = |row: &[f32]| row.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let mut sizes: Vec<f32> = expected.chunks(lanes).map(most).filter(|&m| m > 0.0).collect();
    assert!(!sizes.is_empty(), "nothing to compare with");
    sizes.sort_by(f32::total_cmp);
    let median = sizes[sizes.len() / 2];
    let mut worst = 0.0f32;
    for (g, e) in got.chunks(lanes).zip(expected.chunks(lanes)) {
        let difference = g.iter().zip(e).fold(0.0f32, |m, (g, e)| {
            assert!(g.is_finite(), "{g} for {e}");
            m.max((g - e).abs())
        });
        worst = worst.max(difference / (most(e) + median));
    }
    worst
}

/// Numbers `from..from + N` of every packed row.
pub fn part(rows: &[f32], from: usize, lanes: usize) -> Vec<f32> {
    rows.chunks_exact(SPLAT_STRIDE).flat_map(|r| r[from..from + lanes].to_vec()).collect()
}

/// Name, numbers and numbers a row of every gradient of `g`, of P parents.
pub fn named(g: &Gradients, parents: usize) -> Vec<(&'static str, Vec<f32>, usize)> {
    let mut all = if g.rows.is_empty() {
        vec![
            ("means", g.means.clone(), 3),
            ("cov6", g.cov6.clone(), 6),
            ("opacities", g.opacities.clone(), 1),
        ]
    } else {
        vec![
            ("means", part(&g.rows, MEAN_OFFSET, 3), 3),
            ("quats", part(&g.rows, QUAT_OFFSET, 4), 4),
            ("scales", part(&g.rows, SCALE_OFFSET, 3), 3),
            ("opacities", part(&g.rows, OPACITY_OFFSET, 1), 1),
        ]
    };
    all.push(("sh", g.sh.clone(), g.sh.len() / parents));
    if !g.gain.is_empty() {
        all.push(("gain", g.gain.clone(), 1));
    }
    all.push(("background", g.background.to_vec(), 3));
    all
}

/// Every gradient of a case within the README's tolerance.
pub fn check(name: &str, file: &File, got: &Gradients, parents: usize) {
    let tolerance = if name == "needles" { 2e-3 } else { 5e-4 };
    let mut report = String::new();
    for (what, got, lanes) in named(got, parents) {
        let expected = file.get(&format!("grad.{what}"));
        let e = worst_row(&got, expected, lanes);
        report += &format!(" {what} {e:.1e}");
        assert!(e < tolerance, "{name} {what}: {e}");
        // A number that is off is seen.
        let mut off = got;
        off[expected.len() / 2] +=
            10.0 * tolerance * expected.iter().fold(0.0, |m, v| v.abs().max(m));
        assert!(worst_row(&off, expected, lanes) > tolerance, "{name} {what}: anything passes");
    }
    eprintln!("{name}:{report}");
}
