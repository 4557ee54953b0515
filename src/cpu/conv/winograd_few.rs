//! [`super::winograd`] for small pictures, of which one block of tiles would not pay for
//! reading all weights: vectors hold tiles of all pictures, and weights are transformed by
//! the job that multiplies by them, eight output channels at a time, in its cache. The
//! sums are those of [`super::winograd`], bit for bit.

use super::Buffers;
use super::forms::{Down, Form, GROUPS, Places, TILE, Unit, Up};
use super::plan::{Layout, Plan, pack};
use super::shift::{Block, ROWS, blocks};
use super::winograd::{Lanes, Outputs, Product, SLACK, Tiles, Transform, Way, scatter, transform};
use crate::cpu::disjoint::Disjoint;
use crate::cpu::fresh;
use crate::cpu::simd::{Kernel, LANES, Simd, Tier};
use rayon::prelude::*;
use std::marker::PhantomData;
use std::mem::{MaybeUninit, take};

/// Channels that a job transforms at least: one takes microseconds.
const LEAST: usize = 8;

/// Runs `plan` on pictures `x` of one slice into `y`, which is overwritten; `bias` is empty
/// or one value a channel written.
pub(super) fn run(
    tier: Tier,
    plan: &Plan,
    way: Way,
    x: &[f32],
    w: &[f32],
    bias: &[f32],
    y: &mut fresh::Block<f32>,
) {
    let call = Call { tier, plan, way, reader: way.reader(plan), x, w, bias };
    match way {
        Way::Unit => call.run::<Unit, 6, 6, 4>(y),
        Way::Down => call.run::<Down, 9, 9, 4>(y),
        Way::Up => call.run::<Up, 5, 9, 8>(y),
    }
}

struct Call<'a> {
    tier: Tier,
    plan: &'a Plan,
    way: Way,
    reader: Plan,
    x: &'a [f32],
    w: &'a [f32],
    bias: &'a [f32],
}

impl Call<'_> {
    fn run<F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        y: &mut fresh::Block<f32>,
    ) where
        F: Form<IN, POINTS, OUT>,
    {
        let plan = self.plan;
        let pixels: usize = plan.dst_size.iter().product();
        let images = y.len() / (plan.dst_channels * pixels);
        let [_, height, width] = plan.grid();
        let [down, across] = [height, width].map(|n| n.div_ceil(TILE));
        let picture = down * across;
        let tiles = Tiles { count: images * picture, across, picture };
        let length = tiles.count.next_multiple_of(LANES);
        let layout = self.reader.layout([1, down * F::READ, across * F::READ]);
        let lanes = tiles.places(&layout, F::READ);
        let own = Places::new(POINTS, 1, length, 0);
        // Off a power of two, lest all channels share one cache set.
        let stride = own.floats + LANES;
        // Apart from this thread's own, which its jobs use.
        let mut transformed = Buffers::with(|buffers| take(&mut buffers.tiles));
        let all = transformed.room(plan.src_channels * stride);
        let gather = all.par_chunks_exact_mut(stride).enumerate().with_min_len(LEAST);
        gather.for_each(|(channel, tiles)| {
            let (lanes, own, form) = (&lanes, &own, PhantomData::<F>);
            Buffers::with(|buffers| {
                let job = Gather { call: self, layout, lanes, own, channel, buffers, tiles, form };
                self.tier.run::<Gather<'_, F, IN, POINTS, OUT>>(job);
            });
        });
        let y = Disjoint::new(y);
        blocks(plan.dst_channels).par_iter().for_each(|block| {
            let (x, own, y, form) = (&*all, &own, &y, PhantomData::<F>);
            Buffers::with(|buffers| {
                let job = Multiply { call: self, tiles, x, stride, own, block, buffers, y, form };
                self.tier.run::<Multiply<'_, F, IN, POINTS, OUT>>(job);
            });
        });
        Buffers::with(|buffers| buffers.tiles = transformed);
    }
}

/// Transformed tiles of one channel of all pictures, `[product][tile]`.
struct Gather<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a>,
    layout: Layout,
    lanes: &'a [Lanes],
    own: &'a Places,
    channel: usize,
    buffers: &'a mut Buffers,
    tiles: &'a mut [f32],
    form: PhantomData<F>,
}

impl<F, const IN: usize, const POINTS: usize, const OUT: usize> Kernel
    for Gather<'_, F, IN, POINTS, OUT>
where
    F: Form<IN, POINTS, OUT>,
{
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Call { plan, ref reader, x, .. } = *self.call;
        let pixels: usize = plan.src_size.iter().product();
        let pictures = x.chunks_exact(pixels).skip(self.channel).step_by(plan.src_channels);
        let floats = pictures.len() * self.layout.channel;
        let patch = self.buffers.x.room(floats + SLACK);
        for (x, patch) in pictures.zip(patch.chunks_exact_mut(self.layout.channel)) {
            pack(reader, &self.layout, x, [0; 3], patch);
        }
        for (v, lanes) in self.lanes.iter().enumerate() {
            let pitch = self.layout.pitch();
            let points = transform::<S, F, IN, POINTS, OUT>(s, patch, lanes, pitch);
            scatter(s, &points, self.tiles, self.own, [0, v * LANES]);
        }
    }
}

/// A block of output channels of all pictures.
struct Multiply<'a, F, const IN: usize, const POINTS: usize, const OUT: usize> {
    call: &'a Call<'a>,
    tiles: Tiles,
    /// `[channel][product][tile]`.
    x: &'a [f32],
    /// Floats of a channel.
    stride: usize,
    own: &'a Places,
    block: &'a Block,
    buffers: &'a mut Buffers,
    y: &'a Disjoint<'a, MaybeUninit<f32>>,
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
        let (block, y) = (self.block, self.y);
        let channels = plan.src_channels;
        let Buffers { y: panel, products, .. } = self.buffers;
        let panel = panel.room(GROUPS * channels * block.pitch);
        Transform { plan, way, w, block, panel }.run(s);
        let (sources, stride) = (self.own, Some(self.stride));
        let length = self.tiles.count.next_multiple_of(LANES);
        let sums = &Places::new(POINTS, ROWS, length, 0);
        let product = Product { x: self.x, sources, sums, stride, part: block, panel, bias };
        let to = Outputs { plan, y, image: 0, depth: 0, corner: [0; 2], block: self.tiles };
        product.run::<S, F, IN, POINTS, OUT>(s, products, to);
    }
}
