//! Inputs of the benches other than scenes: random maps, queries, head records.

use super::scene::{normal, unit};
use candle_core::{Device, Result, Tensor};
use subsplat::network::ops::attention_gather::{Gather, Level};
use subsplat::network::ops::plane_sweep::{Sweep, pair, relative_pose};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::SampleConvention;

/// Returns normally distributed numbers of a given shape.
pub fn tensor(shape: &[usize], scale: f32, stream: u64) -> Result<Tensor> {
    let n: usize = shape.iter().product();
    let data: Vec<f32> = (0..n as u64).map(|i| scale * normal(stream, i)).collect();
    Tensor::from_vec(data, shape, &Device::Cpu)
}

/// A call of the attention gather in the reference configuration: one sample in each of two
/// views, one level, keys and values of E channels.
pub struct Attention {
    pub gather: Gather,
    /// `[2·h·w, 2E]`.
    pub maps: Tensor,
    /// `[N, E]`.
    pub query: Tensor,
    /// `[N, 2]`.
    pub bias: Tensor,
    /// `[N, 2]`.
    pub gate: Tensor,
    /// `[N, 2, 1, 2]`.
    pub points: Tensor,
}

impl Attention {
    /// One query per pixel of two pictures `side` px wide; maps at a quarter of the resolution.
    /// The sample of a query in each view lies at its own pixel plus a parallax.
    pub fn new(side: usize, dim: usize) -> Result<Self> {
        let map = side / 4;
        let n = 2 * side * side;
        let points = (0..2 * n).flat_map(|i| {
            let (pixel, view) = (i / 2 % (side * side), i % 2);
            let parallax = if i / 2 / (side * side) == view { 0.0 } else { 0.03 };
            let at = |k: usize| (k as f32 + 0.5) / side as f32;
            let noise = |k: u64| 0.01 * (unit(22, 2 * i as u64 + k) - 0.5);
            let x = at(pixel % side) + parallax + noise(0);
            let y = at(pixel / side) + noise(1);
            [x, y].map(|v| v.clamp(1e-3, 1.0 - 1e-3))
        });
        let points = Tensor::from_vec(points.collect::<Vec<_>>(), (n, 2, 1, 2), &Device::Cpu)?;
        let gather = Gather {
            levels: vec![Level { height: map, width: map, first_cell: 0 }],
            views: 2,
            points: 1,
            points_per_level: false,
            dim,
            groups: 1,
            stride: 2 * dim,
            key: Some(0),
            value: dim,
            logit_scale: (dim as f64).sqrt().recip(),
            renormalise: true,
            sample_convention: SampleConvention::HalfPixel,
            drop: None,
            point_gradient: true,
        };
        Ok(Self {
            maps: tensor(&[2 * map * map, 2 * dim], 1.0, 20)?,
            query: tensor(&[n, dim], 1.0, 21)?,
            bias: tensor(&[n, 2], 0.5, 23)?,
            gate: tensor(&[n, 2], 0.2, 24)?.affine(1.0, 1.0)?,
            points,
            gather,
        })
    }

    /// Returns the query rows of the op: (query, bias, gate).
    pub fn packed_query(&self) -> Result<Tensor> {
        Tensor::cat(&[&self.query, &self.bias, &self.gate], 1)
    }
}

/// Returns a sweep between two `views` with features `side` px wide. Each view is the source of
/// the other. Depths are evenly spaced in disparity from 1.5 to 12.
pub fn sweep(views: &[Camera; 2], side: usize, channels: usize, depths: usize) -> Result<Sweep> {
    let cameras = views.map(|c| c.resized(side, side).expect("a valid size"));
    let to = |i: usize, j: usize| {
        let pose = relative_pose(&cameras[i], &cameras[j]);
        pair(&cameras[i].intrinsics(), &cameras[j].intrinsics(), pose, j)
    };
    let disparity = |k: usize| {
        let share = k as f32 / (depths - 1).max(1) as f32;
        1.0 / 12.0 + share * (1.0 / 1.5 - 1.0 / 12.0)
    };
    let depths: Vec<f32> = (0..depths).map(|k| 1.0 / disparity(k)).collect();
    Ok(Sweep {
        pairs: vec![vec![to(0, 1)?], vec![to(1, 0)?]],
        depths: vec![depths; 2],
        centre: 0.5,
        min_z: 1e-3,
        scale: 1.0 / (channels as f32).sqrt(),
        channels,
        size: [side, side],
    })
}
