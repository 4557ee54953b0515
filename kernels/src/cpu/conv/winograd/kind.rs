//! The kinds of convolution that Winograd's algorithm supports here.

use super::transforms::{Stride1, Stride2, Stride2InputGrad, TILE, Transform};
use crate::cpu::conv::plan::Plan;
use crate::cpu::conv::sizes::Sizes;

/// A kind of 3×3 convolution; each has transforms of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::cpu::conv) enum Kind {
    /// Stride 1, forward or input gradient, any padding.
    Stride1,
    /// Stride 2, forward, any padding.
    Stride2,
    /// Input gradient of stride 2 with one zero of padding.
    Stride2InputGrad,
}

impl Kind {
    /// Returns the kind of `plan`, or `None` where no transform supports it.
    pub fn of(plan: &Plan) -> Option<Self> {
        let (ones, twos) = ([1; 3], [1, 2, 2]);
        let steps = [plan.src_step, plan.dst_step];
        let parts = (plan.passes.len(), plan.planes.len());
        // Nine taps with these spans are those of a 3×3 kernel.
        let kind = match (plan.span, parts) {
            ([0, 2, 2], (1, 1)) if steps == [ones; 2] => Self::Stride1,
            ([0, 1, 1], (1, 4)) if steps == [twos, ones] => Self::Stride2,
            ([0, 1, 1], (4, 1)) if steps == [ones, twos] && plan.origin == [0; 3] => {
                Self::Stride2InputGrad
            }
            _ => return None,
        };
        (plan.kernel_taps == 9).then_some(kind)
    }

    /// Returns a plan of stride 1 that reads the source places of `plan`'s tiles: every
    /// place between a tile's first and last one.
    pub fn reader(self, plan: &Plan) -> Plan {
        if self != Self::Stride2 {
            return plan.clone();
        }
        // A kernel of two taps reads one place beyond its tile.
        Plan::forward(&Sizes {
            in_channels: plan.src_channels,
            out_channels: plan.dst_channels,
            kernel: [1, 2, 2],
            stride: [1; 3],
            padding: plan.padding_before(),
            size: plan.src_size,
        })
    }

    /// Runs `task` with the transform of this kind.
    #[inline(always)]
    pub(super) fn run<T: TransformTask>(self, task: T) {
        match self {
            Self::Stride1 => task.run::<Stride1, 6, 6, 4>(),
            Self::Stride2 => task.run::<Stride2, 9, 9, 4>(),
            Self::Stride2InputGrad => task.run::<Stride2InputGrad, 5, 9, 8>(),
        }
    }
}

/// A task that is generic over the transform; [`Kind::run`] chooses the transform.
pub(super) trait TransformTask {
    fn run<T, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        T: Transform<IN, POINTS, OUT>;
}

/// Returns the number of tiles of one image.
pub(in crate::cpu::conv) fn tiles_per_image(plan: &Plan) -> usize {
    let [depth, height, width] = plan.grid();
    depth * height.div_ceil(TILE) * width.div_ceil(TILE)
}
