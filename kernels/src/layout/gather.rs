//! Sizes and options of an attention gather ([`crate::cpu::attention_gather`]).

use serde::{Deserialize, Serialize};

/// One feature level of the packed maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Level {
    /// Rows of one view's map.
    pub height: usize,
    /// Columns of one view's map.
    pub width: usize,
    /// First cell of view 0; view v starts `v · height · width` later.
    pub first_cell: usize,
}

/// Dropout of attention weights in training; a pure function of its fields and the index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drop {
    /// p: probability that a weight becomes 0; the others are divided by 1 − p.
    pub probability: f64,
    /// Seed of the stage and step.
    pub seed: u64,
    /// Index in the scene of the call's first parent.
    pub first_parent: usize,
}

/// Pixel grid of the feature maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleConvention {
    /// x_ℓ = R·W_ℓ − ½ (`grid_sample`, `align_corners = false`).
    HalfPixel,
    /// x_ℓ = R·W_ℓ (MVSplat's cost volume).
    Integer,
}

/// Sizes and options of one call.
#[derive(Clone, Debug, PartialEq)]
pub struct Gather {
    /// Feature levels in the order of the packed maps.
    pub levels: Vec<Level>,
    /// V, context views.
    pub views: usize,
    /// M: points per view and level.
    pub points: usize,
    /// Every level has points of its own: `[N, V, L·M, 2]`.
    pub points_per_level: bool,
    /// E, channels of a value.
    pub dim: usize,
    /// G, attention groups; a divisor of E.
    pub groups: usize,
    /// Floats of one cell's row.
    pub stride: usize,
    /// First key channel in a row; `None` has no dot product.
    pub key: Option<usize>,
    /// First value channel in a row.
    pub value: usize,
    /// Factor of the dot product.
    pub logit_scale: f64,
    /// Leaves samples outside (0, 1)² out of the softmax; else they are zeros in it.
    pub renormalise: bool,
    /// Column of a map at a normalised coordinate.
    pub sample_convention: SampleConvention,
    /// Dropout, in training.
    pub drop: Option<Drop>,
    /// The backward pass computes the gradient with respect to the points.
    pub point_gradient: bool,
}

impl SampleConvention {
    /// Returns the px subtracted from R·W, where R is a normalised coordinate.
    pub fn shift(self) -> f64 {
        match self {
            Self::HalfPixel => 0.5,
            Self::Integer => 0.0,
        }
    }
}

impl Gather {
    /// Returns the samples per parent, V·L·M.
    pub fn samples(&self) -> usize {
        self.views * self.levels.len() * self.points
    }

    /// Returns the floats of q in a query row.
    pub fn query_channels(&self) -> usize {
        if self.key.is_some() { self.dim } else { 0 }
    }

    /// Returns Q, the floats of a query row.
    pub fn query_width(&self) -> usize {
        self.query_channels() + self.samples() * self.groups + self.views
    }

    /// Returns the points per parent and view in the points tensor.
    pub fn points_width(&self) -> usize {
        self.points * if self.points_per_level { self.levels.len() } else { 1 }
    }

    /// Returns the cells of all levels and views.
    pub fn cells(&self) -> usize {
        self.levels.iter().map(|l| self.views * l.height * l.width).sum()
    }
}
