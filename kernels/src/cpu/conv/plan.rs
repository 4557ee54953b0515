//! Geometry of one convolution in one direction: which source place each tap reads.
//!
//! y from x and ∂L/∂x from ∂L/∂y have the same form here. The *source* is the tensor that
//! is read, the *destination* the tensor that is written. Both are seen from one *grid*:
//!
//! * Forward, stride s: output g reads source places s·g + tap − padding. The source is
//!   split into s *phases* per axis (source place = s·position + phase), so that each tap
//!   reads one phase at a constant shift from g. One pass computes all outputs.
//! * Input gradient, stride s: destination place s·g + phase depends on those taps that
//!   reach it, at constant shifts of ∂L/∂y. There is one pass per destination phase.
//!
//! A packed tile ([`super::packed_tile`]) stores each source phase as a plane of its own,
//! with halo and zero padding. An output at flat place p is then Σ w·tile[p + offset], where
//! the offset depends on the channel and the tap only. No im2col matrix exists.

use super::sizes::{Axes, Sizes};

/// The direction that a [`Plan`] computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Direction {
    /// y from x.
    Forward,
    /// ∂L/∂x from ∂L/∂y.
    InputGrad,
}

/// One axis of a tap: its place in the kernel, the source phase that it reads and its
/// shift within that phase.
#[derive(Clone, Copy)]
struct AxisTap {
    kernel: usize,
    phase: usize,
    shift: isize,
}

/// A tap of the kernel as a shift inside the packed tile.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tap {
    /// Row-major place in the kernel.
    pub kernel: usize,
    /// Index into [`Plan::planes`].
    pub plane: usize,
    /// Grid positions from the tile's origin.
    pub shift: Axes,
}

/// The taps that compute the destination places of one phase.
#[derive(Clone, Debug)]
pub(super) struct Pass {
    /// The pass writes destination places `dst_step·grid + phase`.
    pub phase: Axes,
    /// Taps in the order of summation.
    pub taps: Vec<Tap>,
}

/// Geometry of a convolution; see the module documentation.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    /// Forward or input gradient.
    pub direction: Direction,
    /// Channels of the source.
    pub src_channels: usize,
    /// Channels of the destination.
    pub dst_channels: usize,
    /// Spatial size of the source.
    pub src_size: Axes,
    /// Spatial size of the destination.
    pub dst_size: Axes,
    /// Source places per grid position.
    pub src_step: Axes,
    /// Destination places per grid position.
    pub dst_step: Axes,
    /// First grid position that a tile's buffer holds, relative to the tile's start.
    pub origin: [isize; 3],
    /// Grid positions that a tile's buffer holds beyond the tile's size (the halo).
    pub span: Axes,
    /// Source phases that taps read; each is one plane of a packed tile.
    pub planes: Vec<Axes>,
    /// One pass per destination phase.
    pub passes: Vec<Pass>,
    /// Places of the kernel: kd·kh·kw.
    pub kernel_taps: usize,
}

impl Plan {
    /// Plans y from x.
    pub fn forward(s: &Sizes) -> Self {
        let axes = std::array::from_fn(|a| {
            let step = s.stride[a].max(1) as isize;
            let tap = |kernel: usize| {
                let at = kernel as isize - s.padding[a] as isize;
                let shift = at.div_euclid(step);
                let phase = at.rem_euclid(step) as usize;
                AxisTap { kernel, phase, shift }
            };
            vec![(0..s.kernel[a]).map(tap).collect()]
        });
        let mut plan = Self::new(Direction::Forward, s.kernel, axes);
        (plan.src_channels, plan.dst_channels) = (s.in_channels, s.out_channels);
        (plan.src_size, plan.dst_size) = (s.size, s.out_size());
        plan.src_step = s.stride.map(|v| v.max(1));
        plan
    }

    /// Plans ∂L/∂x from ∂L/∂y. Each phase of x is a convolution of its own, with the taps
    /// that reach it.
    pub fn input_grad(s: &Sizes) -> Self {
        let axes = std::array::from_fn(|a| {
            let step = s.stride[a].max(1) as isize;
            let of_phase = |phase: isize| {
                let tap = |kernel: usize| {
                    let at = phase + s.padding[a] as isize - kernel as isize;
                    let reaches = at.rem_euclid(step) == 0;
                    reaches.then(|| AxisTap { kernel, phase: 0, shift: at.div_euclid(step) })
                };
                (0..s.kernel[a]).filter_map(tap).collect()
            };
            (0..step).map(of_phase).collect()
        });
        let mut plan = Self::new(Direction::InputGrad, s.kernel, axes);
        (plan.src_channels, plan.dst_channels) = (s.out_channels, s.in_channels);
        (plan.src_size, plan.dst_size) = (s.out_size(), s.size);
        plan.dst_step = s.stride.map(|v| v.max(1));
        plan
    }

    /// Combines the taps of three axes; `axes[a][phase]` holds the taps of destination
    /// phase `phase` along axis a. The callers fill in channels, sizes and steps.
    fn new(direction: Direction, kernel: Axes, axes: [Vec<Vec<AxisTap>>; 3]) -> Self {
        let shifts = |a: usize| axes[a].iter().flatten().map(|t: &AxisTap| t.shift);
        let origin = std::array::from_fn(|a| shifts(a).min().unwrap_or(0));
        let span = std::array::from_fn(|a| {
            let last = shifts(a).max().unwrap_or(0);
            (last - origin[a]).unsigned_abs()
        });
        let mut planes: Vec<Axes> = Vec::new();
        let mut passes = Vec::new();
        for (depth_phase, depth) in axes[0].iter().enumerate() {
            for (height_phase, height) in axes[1].iter().enumerate() {
                for (width_phase, width) in axes[2].iter().enumerate() {
                    let mut taps = Vec::new();
                    for d in depth {
                        for h in height {
                            for w in width {
                                let phase = [d.phase, h.phase, w.phase];
                                let found = planes.iter().position(|p| *p == phase);
                                let plane = found.unwrap_or_else(|| {
                                    planes.push(phase);
                                    planes.len() - 1
                                });
                                let row = (d.kernel * kernel[1] + h.kernel) * kernel[2];
                                let shift = [d, h, w].map(|t| t.shift);
                                taps.push(Tap {
                                    kernel: row + w.kernel,
                                    plane,
                                    shift: std::array::from_fn(|a| {
                                        (shift[a] - origin[a]).unsigned_abs()
                                    }),
                                });
                            }
                        }
                    }
                    passes.push(Pass { phase: [depth_phase, height_phase, width_phase], taps });
                }
            }
        }
        Self {
            direction,
            src_channels: 0,
            dst_channels: 0,
            src_size: [0; 3],
            dst_size: [0; 3],
            src_step: [1; 3],
            dst_step: [1; 3],
            origin,
            span,
            planes,
            passes,
            kernel_taps: kernel.iter().product(),
        }
    }

    /// Returns how many places before the source's first one the first output reads: the
    /// zero padding in front.
    pub fn padding_before(&self) -> Axes {
        let taps = self.passes.iter().flat_map(|p| &p.taps);
        let place = |a: usize, t: &Tap| {
            let at = (self.origin[a] + t.shift[a] as isize) * self.src_step[a] as isize;
            at + self.planes[t.plane][a] as isize
        };
        std::array::from_fn(|a| {
            let first = taps.clone().map(|t| place(a, t)).min().unwrap_or(0);
            first.min(0).unsigned_abs()
        })
    }

    /// Returns the grid's size: the number of outputs of the largest phase.
    pub fn grid(&self) -> Axes {
        std::array::from_fn(|a| self.dst_size[a].div_ceil(self.dst_step[a]))
    }

    /// Returns the number of taps of all passes.
    pub fn all_taps(&self) -> usize {
        self.passes.iter().map(|p| p.taps.len()).sum()
    }

    /// Returns the places of one source channel.
    pub fn src_pixels(&self) -> usize {
        self.src_size.iter().product()
    }

    /// Returns the places of one destination channel.
    pub fn dst_pixels(&self) -> usize {
        self.dst_size.iter().product()
    }

    /// Returns the products of the definition, for `images` images.
    pub fn products(&self, images: usize) -> usize {
        let outputs = match self.direction {
            Direction::Forward => self.dst_pixels(),
            Direction::InputGrad => self.src_pixels(),
        };
        images * self.src_channels * self.dst_channels * outputs * self.kernel_taps
    }

    /// Returns the index in the weights `[O·C, taps]` of the kernel that maps source channel
    /// `src` to destination channel `dst`.
    #[inline(always)]
    pub fn kernel_index(&self, src: usize, dst: usize) -> usize {
        match self.direction {
            Direction::Forward => dst * self.src_channels + src,
            Direction::InputGrad => src * self.dst_channels + dst,
        }
    }
}
