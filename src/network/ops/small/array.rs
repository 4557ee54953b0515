//! The small backbone's operations, on either executor, and those of candle's tensors.

use super::{Candidates, MeanOver, Start};
use crate::network::ops::{Array, matching};
use candle_core::{Result, Tensor};
use subsplat_kernels::camera::{Camera, NearFar};

/// The operations that the small backbone alone uses.
///
/// Shapes are those of the functions of the same names in [`crate::network::ops::small`] and
/// [`crate::network::ops::matching`]. Errors are those of the executor, and shapes that do not fit.
pub trait SmallArray: Array {
    /// Scales the channels of each pixel to unit length.
    fn normalize_channels(&self) -> Result<Self>;

    /// Computes the raw matching channels of images `[B, V, 3, H, W]`.
    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self>;

    /// Computes self + gain·factor·scores, with the gain of [`super::add_scores`].
    fn add_scores(&self, scores: &Self, factor: &Tensor) -> Result<Self>;

    /// Computes expected candidate and mass around the mode.
    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]>;

    /// Repeats the edge pixels of `[B, C, h, w]` `padding` times on every side.
    fn replication_pad2d(&self, padding: usize) -> Result<Self>;

    /// Upsamples two maps by the masks `self`.
    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]>;

    /// Computes the heads' input from features `self`.
    fn head_input(&self, rgb: &Self, sides: [&Self; 2], share: f32) -> Result<Self>;

    /// Computes raw rows and opacity from the heads' output `self`.
    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]>;

    /// Computes distances along rays from candidate indices.
    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self>;

    /// Computes opacity factors from images `self` and distances.
    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self>;

    /// Computes the distances that most views support, from images `self`, then distances and
    /// confidences.
    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self>;
}

impl SmallArray for Tensor {
    fn normalize_channels(&self) -> Result<Self> {
        super::normalize_channels(self)
    }

    fn raw_matching(
        &self,
        cameras: &[Vec<Camera>],
        disparities: &[Vec<Vec<f32>>],
        rows: &[[usize; 2]],
    ) -> Result<Self> {
        matching::raw_matching(self, cameras, disparities, rows)
    }

    fn add_scores(&self, scores: &Self, factor: &Tensor) -> Result<Self> {
        super::add_scores(self, scores, factor)
    }

    fn expectation(&self, window: usize, mean: MeanOver) -> Result<[Self; 2]> {
        let (mean, mass) = super::expectation(self, window, mean)?;
        Ok([mean, mass])
    }

    fn replication_pad2d(&self, padding: usize) -> Result<Self> {
        self.pad_with_same(2, padding, padding)?.pad_with_same(3, padding, padding)
    }

    fn upsample_convex(&self, maps: [&Self; 2], start: &[f32]) -> Result<[Self; 2]> {
        super::upsample_convex(self, maps, start)
    }

    fn head_input(&self, rgb: &Self, [index, confidence]: [&Self; 2], share: f32) -> Result<Self> {
        super::head_input(self, rgb, index, confidence, share)
    }

    fn head_output(&self, confidence: &Self, rgb: &Self, start: Start) -> Result<[Self; 2]> {
        let (raw, density) = super::head_output(self, confidence, rgb, start)?;
        Ok([raw, density])
    }

    fn ray_distance(&self, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Self> {
        super::ray_distance(self, ranges, lengths)
    }

    fn cross_check(&self, cameras: &[Vec<Camera>], distances: &Self) -> Result<Self> {
        super::cross_check(self, cameras, distances)
    }

    fn depth_consensus(
        &self,
        cameras: &[Vec<Camera>],
        ranges: &[Vec<NearFar>],
        depths: [&Self; 2],
    ) -> Result<Self> {
        super::depth_consensus(self, cameras, ranges, depths)
    }
}
