//! Attention gathers that tests of the CPU, the GPU and the aggregation share.

use candle_core::{DType, Tensor};
use subsplat_kernels::layout::{Gather, Level, SampleConvention};

/// The elements of a tensor in f64.
pub fn host(t: &Tensor) -> Vec<f64> {
    t.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// `torch.grid_sample` (bilinear, zeros, align_corners = false) of one view of a map
/// of `stride` channels at R in [0, 1]², all channels.
pub fn grid_sample(maps: &[f64], g: &Gather, l: usize, v: usize, at: [f64; 2]) -> Vec<f64> {
    let level = g.levels[l];
    let shift = g.sample_convention.shift();
    let (x, y) = (at[0] * level.width as f64 - shift, at[1] * level.height as f64 - shift);
    let mut out = vec![0.0; g.stride];
    for row in 0..level.height {
        for column in 0..level.width {
            let w = (1.0 - (x - column as f64).abs()).max(0.0)
                * (1.0 - (y - row as f64).abs()).max(0.0);
            let cell = level.first_cell + (v * level.height + row) * level.width + column;
            for (o, m) in out.iter_mut().zip(&maps[cell * g.stride..]) {
                *o += w * m;
            }
        }
    }
    out
}

/// One dot-product sample per view of one level, E = 8.
pub fn base() -> Gather {
    Gather {
        levels: vec![Level { height: 5, width: 7, first_cell: 0 }],
        views: 2,
        points: 1,
        points_per_level: false,
        dim: 8,
        groups: 1,
        stride: 16,
        key: Some(0),
        value: 8,
        logit_scale: 0.4,
        renormalise: true,
        sample_convention: SampleConvention::HalfPixel,
        drop: None,
        point_gradient: true,
    }
}
