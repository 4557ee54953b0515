//! Sizes and rules of one attention gather ([`crate::cpu::attention_gather`]).

/// Where one level's cells lie in the packed maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Level {
    /// Rows of one view's map.
    pub height: usize,
    /// Columns of one view's map.
    pub width: usize,
    /// First cell of view 0; view v starts `v · height · width` later.
    pub first_cell: usize,
}

/// Dropping of attention weights while training, a pure function of its numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drop {
    /// Probability that a weight becomes 0; the others grow by 1/(1 − p).
    pub probability: f64,
    /// Seed of the stage and step.
    pub seed: u64,
    /// Index of parent 0 of this call in the scene.
    pub first_parent: usize,
}

/// Everything of one call that is not a tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Gather {
    /// Feature levels, as the maps are packed.
    pub levels: Vec<Level>,
    /// V.
    pub views: usize,
    /// M: points per view and level.
    pub points: usize,
    /// Whether every level has points of its own (`[N, V, L·M, 2]`).
    pub points_per_level: bool,
    /// E.
    pub dim: usize,
    /// G, a divisor of E.
    pub groups: usize,
    /// Floats of one cell's row.
    pub stride: usize,
    /// First key channel in a row, or no dot product at all.
    pub key: Option<usize>,
    /// First value channel in a row.
    pub value: usize,
    /// Factor of the dot product.
    pub logit_scale: f64,
    /// Samples outside (0, 1)² leave the softmax; else they stay in it as zeros.
    pub renormalise: bool,
    /// Column x of a map is at R·W − ½ rather than R·W.
    pub half_pixel: bool,
    /// Dropping, while training.
    pub drop: Option<Drop>,
    /// Whether the gradient with respect to the points is wanted.
    pub point_gradient: bool,
}

impl Gather {
    /// Samples per parent, V·L·M.
    pub fn samples(&self) -> usize {
        self.views * self.levels.len() * self.points
    }

    /// Floats of q in a query row.
    pub fn query_channels(&self) -> usize {
        if self.key.is_some() { self.dim } else { 0 }
    }

    /// Q: floats of a query row.
    pub fn query_width(&self) -> usize {
        self.query_channels() + self.samples() * self.groups + self.views
    }

    /// Points per view in the points tensor.
    pub fn points_width(&self) -> usize {
        self.points * if self.points_per_level { self.levels.len() } else { 1 }
    }

    /// Cells of all levels and views.
    pub fn cells(&self) -> usize {
        self.levels.iter().map(|l| self.views * l.height * l.width).sum()
    }
}

/// Most samples per parent, V·L·M, that the GPU's kernel holds.
pub const GATHER_SAMPLES_MAX: usize = 128;
/// Most samples × groups per parent that it holds.
pub const GATHER_WEIGHTS_MAX: usize = 1024;
