//! Memory layout of transformed tiles.
//!
//! A tile has POINTS × POINTS products per channel. They are sorted into 36 *groups*, one
//! for each pair of transformed weights (i, j); products of a group share their weight. One
//! group is a matrix `[channel][product of the group][tile]`, so that each group is one
//! matrix product over channels. In stride 1 every group has one product; in stride 2 the
//! groups of the middle tap have four, or sixteen where both axes use it.

use super::transforms::WEIGHTS;
use crate::cpu::simd::LANES;

/// Groups of products: pairs of transformed weights.
pub(super) const GROUPS: usize = WEIGHTS * WEIGHTS;

/// Maximum products of a tile.
const MAX_PRODUCTS: usize = 81;

/// One group of products.
#[derive(Clone, Copy)]
pub(super) struct Group {
    /// First float.
    pub start: usize,
    /// Floats of one channel.
    pub channel_stride: usize,
}

/// Layout of the transformed tiles of some channels.
pub(super) struct ProductLayout {
    channels: usize,
    /// Tiles, or numbers per product and channel.
    tiles: usize,
    /// First float of each product, row-major, in channel 0.
    starts: [usize; MAX_PRODUCTS],
    /// Floats from channel to channel, by the number of axes along which the product uses
    /// the last weight.
    channel_strides: [usize; 3],
    /// The groups, row-major by weights.
    pub groups: Vec<Group>,
    /// Floats of all groups.
    pub floats: usize,
}

impl ProductLayout {
    /// Lays out `channels` channels of `tiles` tiles for a transform with `points` products
    /// along an axis; `gap` unused floats follow each group.
    pub fn new(points: usize, channels: usize, tiles: usize, gap: usize) -> Self {
        // Products that share the last weight.
        let shared = points - (WEIGHTS - 1);
        let count = |weight: usize| if weight == WEIGHTS - 1 { shared } else { 1 };
        let mut groups = Vec::with_capacity(GROUPS);
        let mut floats = 0;
        for group in 0..GROUPS {
            let channel_stride = count(group / WEIGHTS) * count(group % WEIGHTS) * tiles;
            groups.push(Group { start: floats, channel_stride });
            floats += channels * channel_stride + gap;
        }
        let mut starts = [0; MAX_PRODUCTS];
        for (product, start) in starts.iter_mut().enumerate().take(points * points) {
            let axes = [product / points, product % points];
            let [i, j] = axes.map(|p| p.min(WEIGHTS - 1));
            let [p, q] = [axes[0] - i, axes[1] - j];
            *start = groups[i * WEIGHTS + j].start + (p * count(j) + q) * tiles;
        }
        let channel_strides = [1, shared, shared * shared].map(|n| n * tiles);
        Self { channels, tiles, starts, channel_strides, groups, floats }
    }

    /// Returns where the products of the tiles `first..first + LANES` of `channel` lie.
    #[inline(always)]
    pub fn vectors(&self, channel: usize, first: usize) -> ProductVectors<'_> {
        assert!(channel < self.channels && first + LANES <= self.tiles, "conv: no such tiles");
        let from = self.channel_strides.map(|stride| channel * stride + first);
        ProductVectors { starts: &self.starts, from }
    }
}

/// Places of the products of sixteen tiles of one channel.
pub(super) struct ProductVectors<'a> {
    starts: &'a [usize; MAX_PRODUCTS],
    from: [usize; 3],
}

impl ProductVectors<'_> {
    /// Returns the place of product (i, j) of a transform with `points` products along an
    /// axis. Sixteen floats from there on lie inside [`ProductLayout::floats`].
    #[inline(always)]
    pub fn place(&self, points: usize, i: usize, j: usize) -> usize {
        // With six points, all three strides are equal.
        let shared = usize::from(i >= WEIGHTS - 1) + usize::from(j >= WEIGHTS - 1);
        self.starts[i * points + j] + self.from[shared]
    }
}
