//! Separate arrays against packed rows: the same bytes, forward and backward.

use subsplat_kernels::cpu::{Geometry, Gradients, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{
    Convention, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, ShDirection,
};
use subsplat_test_support::raster_scene::{KINDS, Scene};

/// Floats `from..from + lanes` of each row.
fn column(rows: &[f32], from: usize, lanes: usize) -> Vec<f32> {
    rows.chunks(SPLAT_STRIDE).flat_map(|row| &row[from..from + lanes]).copied().collect()
}

#[test]
fn separate_arrays_give_the_bytes_of_packed_rows() {
    for (seed, kind) in KINDS.into_iter().enumerate() {
        for convention in [Convention::Standard, Convention::Mvsplat] {
            let scene = Scene::new(kind, 60 + seed as u64, 30, seed % 5, [0, 1, 4][seed % 3]);
            let options = RasterOptions::new(convention);
            for sh_direction in [ShDirection::Child, ShDirection::Parent] {
                same_bytes(&scene, &RasterOptions { sh_direction, ..options });
            }
        }
    }
}

fn same_bytes(scene: &Scene, options: &RasterOptions) {
    let upstream = scene.upstream(options, 5);
    scene.with_slices(|packed| {
        let take = |from, lanes| column(&scene.rows, from, lanes);
        let (means, quats) = (take(0, 3), take(QUAT_OFFSET, 4));
        let (scales, opacities) = (take(SCALE_OFFSET, 3), take(OPACITY_OFFSET, 1));
        let geometry = Geometry::Separate {
            means: &means,
            quats: &quats,
            scales: &scales,
            opacities: &opacities,
        };
        let separate = SplatSlices { geometry, ..packed };
        assert!(separate.is_consistent() && separate.len() == packed.len());
        let [a, b] =
            [packed, separate].map(|s| Rasterizer::new().render(&s, &scene.camera, options));
        assert!(a == b && a.alpha.iter().any(|alpha| *alpha > 0.1));
        let [a, b] = [packed, separate].map(|s| {
            let mut out = Gradients::default();
            Rasterizer::new().backward(&s, &scene.camera, options, &upstream, &mut out);
            out
        });
        let take = |from, lanes| column(&a.rows, from, lanes);
        assert!(a.rows.iter().any(|v| *v != 0.0) && b.rows.is_empty());
        assert!(take(0, 3) == b.means && take(QUAT_OFFSET, 4) == b.quats);
        assert!(take(SCALE_OFFSET, 3) == b.scales && take(OPACITY_OFFSET, 1) == b.opacities);
        assert!(a.sh == b.sh && a.gain == b.gain && a.background == b.background);
        let short = Geometry::Separate {
            means: &means,
            quats: &quats[4..],
            scales: &scales,
            opacities: &opacities,
        };
        assert!(!SplatSlices { geometry: short, ..packed }.is_consistent());
    });
}
