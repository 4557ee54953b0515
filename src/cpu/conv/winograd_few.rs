//! [`super::winograd`] for small pictures, of which one block of tiles would not pay for
//! reading all weights: vectors hold tiles of all pictures, and weights are transformed by
//! the job that multiplies by them, eight output channels at a time, in its cache. The
//! sums are those of [`super::winograd`], bit for bit.

use super::Buffers;
use super::forms::{Form, GROUPS, Places, TILE};
use super::gather::{Gather, Tiles};
use super::plan::Plan;
use super::shift::{Block, ROWS, blocks};
use super::winograd::{Call, Formed, Outputs, Product, Transform, Way, group_step};
use crate::cpu::simd::{Kernel, LANES, Simd, SimdLevel};
use crate::cpu::uninit;
use rayon::prelude::*;
use std::marker::PhantomData;
use std::mem::take;

/// Channels that a job transforms at least: one takes microseconds.
const LEAST: usize = 8;

/// Runs `plan` on pictures `x` of one slice into `y`, which is overwritten; `bias` is empty
/// or one value a channel written.
pub(super) fn run(
    level: SimdLevel,
    plan: &Plan,
    way: Way,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    y: &mut uninit::UninitSlice<f32>,
) {
    way.give(&Call::new(level, plan, way, x, w, bias, y));
}

impl Formed for &Call<'_, [f32]> {
    fn with<F, const IN: usize, const POINTS: usize, const OUT: usize>(self)
    where
        F: Form<IN, POINTS, OUT>,
    {
        let plan = self.plan;
        let pixels: usize = plan.src_size.iter().product();
        let [_, height, width] = plan.grid();
        let [down, across] = [height, width].map(|n| n.div_ceil(TILE));
        let picture = down * across;
        let tiles = Tiles { count: self.images * picture, across, picture };
        let length = tiles.length();
        let apart = plan.src_channels * pixels;
        let gather = &Gather::new::<F, IN, POINTS, OUT>(&self.reader, tiles, [0; 3], apart);
        let own = &Places::new(POINTS, 1, length, 0);
        // Off a power of two, lest all channels share one cache set.
        let stride = own.floats + LANES;
        // Apart from this thread's own, which its jobs use.
        let mut transformed = Buffers::with(|buffers| take(&mut buffers.tiles));
        let all = transformed.room(plan.src_channels * stride);
        let each = all.par_chunks_exact_mut(stride).enumerate().with_min_len(LEAST);
        each.for_each(|(channel, tiles)| {
            let (x, form) = (&self.x[channel * pixels..], PhantomData::<F>);
            Buffers::with(|buffers| {
                let job = Read { gather, own, x, buffers, tiles, form };
                self.level.run::<Read<'_, F, IN, POINTS, OUT>>(job);
            });
        });
        let sums = &Places::new(POINTS, ROWS, length, 0);
        let to = &Outputs::new::<OUT>(plan, &self.y, tiles, 0, [0; 3]);
        blocks(plan.dst_channels).par_iter().for_each(|block| {
            let (x, form) = (&*all, PhantomData::<F>);
            Buffers::with(|buffers| {
                let job = Multiply { call: self, x, stride, own, sums, to, block, buffers, form };
                self.level.run::<Multiply<'_, F, IN, POINTS, OUT>>(job);
            });
        });
        Buffers::with(|buffers| buffers.tiles = transformed);
    }
}

/// Transformed tiles of one channel of all pictures, `[product][tile]`.
struct Read<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    gather: &'a Gather<'a>,
    own: &'a Places,
    /// From the channel's first picture on.
    x: &'a [f32],
    buffers: &'a mut Buffers,
    tiles: &'a mut [f32],
    form: PhantomData<F>,
}

impl<F, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for Read<'_, F, IN, POINTS, OUT>
where
    F: Form<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { gather, own, x, buffers, tiles, .. } = self;
        let (patch, rows) = (&mut buffers.x, &mut [[s.splat(0.0); POINTS]; IN]);
        gather.channel::<S, F, IN, POINTS, OUT>(s, x, patch, rows, tiles, (own, 0));
    }
}

/// A block of output channels of all pictures.
struct Multiply<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a, [f32]>,
    /// `[channel][product][tile]`.
    x: &'a [f32],
    /// Floats of a channel.
    stride: usize,
    own: &'a Places,
    sums: &'a Places,
    to: &'a Outputs<'a>,
    block: &'a Block,
    buffers: &'a mut Buffers,
    form: PhantomData<F>,
}

impl<F, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for Multiply<'_, F, IN, POINTS, OUT>
where
    F: Form<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Call { plan, way, w, bias, .. } = *self.call;
        let (block, sums) = (self.block, self.sums);
        let channels = plan.src_channels;
        let Buffers { y: panel, products, .. } = self.buffers;
        let panel = panel.room(GROUPS * group_step(channels));
        Transform { plan, way, w, block, panel }.run(s);
        let (sources, stride) = (self.own, Some(self.stride));
        let product = Product { x: self.x, sources, sums, stride, part: block, panel, bias };
        product.run::<S, F, IN, POINTS, OUT>(s, products, self.to);
    }
}
