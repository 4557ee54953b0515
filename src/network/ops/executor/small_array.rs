//! [`SmallArray`] for arrays in device memory: each operation, and the rule of its gradient.

use super::TapeArray;
use super::rules::camera_floats;
use crate::network::ops::activation::Activation;
use crate::network::ops::array::Array;
use crate::network::ops::matching;
use crate::network::ops::small::{
    Candidates, MeanOver, SCORE_GAIN, SmallArray, Start, consensus_tolerances,
};
use candle_core::{DType, Result, Tensor};
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::cpu::small::{cross_check, depth_consensus};
use subsplat_kernels::gpu::{CrossCheckCall, DepthConsensusCall, HeadOutputCall, RawMatchingCall};

impl SmallArray for TapeArray {
    fn normalize_channels(&self) -> Result<Self> {
        // The added 1e-8 is that of `cpu::small::unit`.
        let [b, _, h, w] = self.sizes()?;
        let sum = self.sqr()?.sum(1)?.affine(1.0, 1e-8)?;
        self.div(&sum.sqrt()?.reshape((b, 1, h, w))?)
    }

    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self> {
        let [_, v, _, h, w] = self.sizes()?;
        let warps = matching::warp_floats(cameras, rows, [h / 4, w / 4], v);
        let candidates = rows.iter().flat_map(|[i, _]| &disparities[i / v][i % v]);
        let call = RawMatchingCall {
            rows: &rows.iter().map(|row| row.map(|i| i as u32)).collect::<Vec<_>>(),
            warps: &warps,
            disparities: &candidates.copied().collect::<Vec<_>>(),
            z_min: matching::Z_MIN,
            variance_floor: matching::VARIANCE_FLOOR,
        };
        self.of(self.array.raw_matching(call))
    }

    fn add_scores(&self, scores: &Self, factor: &Tensor) -> Result<Self> {
        let gain = f64::from(SCORE_GAIN);
        if factor.track_op() {
            let dims = vec![1; scores.dims().len()];
            let factor = self.executor.parameter(factor)?.reshape(dims)?;
            return self.add(&scores.affine(gain, 0.0)?.mul(&factor)?);
        }
        let factor = f64::from(factor.sum_all()?.to_dtype(DType::F32)?.to_scalar::<f32>()?);
        self.add(&scores.affine(gain * factor, 0.0)?)
    }

    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]> {
        let [b, _, h, w] = self.sizes()?;
        let window_alone = mean == MeanOver::Window;
        let result = self.array.expectation(window, window_alone);
        let both = self.recorded_alone("expectation", result, |x, _| {
            let x = x.clone();
            move |dy| x.expectation_backward(window, window_alone, dy)
        })?;
        both.halves(&[b, 1, h, w])
    }

    fn replication_pad2d(&self, padding: usize) -> Result<Self> {
        let [_, _, h, w] = self.sizes()?;
        let indices = |n: usize| {
            let at = |i: usize| i.saturating_sub(padding).min(n - 1) as u32;
            (0..n + 2 * padding).map(at).collect::<Vec<_>>()
        };
        self.index_select(&indices(h), 2)?.index_select(&indices(w), 3)
    }

    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]> {
        let start: Vec<f32> = start.iter().map(|share| share.ln()).collect();
        let [b, _, h, w] = self.sizes()?;
        let arrays = maps.map(|map| &map.array);
        let result = self.array.upsample_convex(arrays, &start);
        let inputs = [self, maps[0], maps[1]];
        let both = self.recorded("convex upsampling", result, inputs, |want, _| {
            let x = self.array.clone();
            let maps = arrays.map(Clone::clone);
            move |dy| {
                let maps = [&maps[0], &maps[1]];
                let [of_x, first, second] = x.upsample_convex_backward(maps, &start, dy)?;
                let all = [(want[0], of_x), (want[1], first), (want[2], second)];
                Ok(all.map(|(want, gradient)| want.then_some(gradient)))
            }
        })?;
        both.halves(&[b, 1, 4 * h, 4 * w])
    }

    fn head_input(&self, rgb: &Self, [index, confidence]: [&Self; 2], share: f32) -> Result<Self> {
        let [_, _, h, w] = rgb.sizes()?;
        let features = self.upsample_bilinear2d([h, w], None)?;
        let index = index.affine(f64::from(share), 0.0)?;
        let confidence = confidence.activate(Activation::Sigmoid)?;
        Self::cat(&[&features, rgb, &index, &confidence], 1)
    }

    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]> {
        let Start { row, colour, confident } = start;
        let call = HeadOutputCall { start: &row, colour, confident };
        let result = self.array.head_output(&confidence.array, &rgb.array, call);
        let [rows, opacity] = self.executor.checked(result)?;
        let raw = row.len();
        let rows = self.recorded_alone("head output", Ok(rows), |x, _| {
            let (b, h, w) = (x.dims()[0], x.dims()[2], x.dims()[3]);
            move |dy| {
                let channels = dy.permuted(&[0, 2, 1])?.reshape(&[b, raw, h, w])?;
                channels.narrow_backward(1, 0, raw + 1)
            }
        })?;
        if self.node.is_none() && confidence.node.is_none() {
            return Ok([rows, self.of(Ok(opacity))?]);
        }
        // The opacity's formula in operations with gradients.
        let residual = self.narrow(1, raw, 1)?;
        let opacity = if confident {
            confidence.add(&residual)?.activate(Activation::Sigmoid)?.sqr()?
        } else {
            residual.affine(1.0, 2.0)?.activate(Activation::Sigmoid)?
        };
        Ok([rows, opacity])
    }

    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self> {
        let rows = ranges.len();
        let per_row = |f: fn(&Candidates) -> f32| {
            self.new_tensor(ranges.iter().map(f).collect(), &[rows, 1, 1, 1])
        };
        let disparity = self.mul(&per_row(|r| r.step)?)?.add(&per_row(|r| r.low)?)?;
        self.new_tensor(lengths, self.dims())?.div(&disparity)
    }

    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self> {
        let call = CrossCheckCall {
            views: cameras.first().map_or(0, Vec::len),
            cameras: &camera_floats(cameras),
            least: cross_check::MIN_FACTOR,
            colour: cross_check::COLOUR,
            behind: cross_check::BEHIND,
        };
        self.of(self.array.cross_check(&distances.array, call))
    }

    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self> {
        let call = DepthConsensusCall {
            views: cameras.first().map_or(0, Vec::len),
            cameras: &camera_floats(cameras),
            tolerances: &consensus_tolerances(cameras, ranges)?,
            own_weight: depth_consensus::OWN_WEIGHT,
            colour: depth_consensus::COLOUR,
            reach: depth_consensus::REACH,
            least_weight: depth_consensus::LEAST_WEIGHT,
            on_ray: depth_consensus::ON_RAY,
            steps: depth_consensus::STEPS,
        };
        self.of(self.array.depth_consensus(depths.map(|d| &d.array), call))
    }
}
