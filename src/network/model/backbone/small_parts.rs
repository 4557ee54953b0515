//! Parts of the small backbone: 3-D stem, U-Net, convex upsampling.

use crate::network::model::layers::{
    Activation, Conv2d, ConvShape, GroupNorm, LayerInit, default_init,
};
use crate::network::ops::small::SmallArray;
use crate::network::ops::{Array, ConvConfig};
use candle_core::{Result, Tensor};
use candle_nn::{Init, VarBuilder};

/// GELU(GroupNorm(conv x)).
pub(super) fn conv_norm_gelu<A: Array>(x: &A, layer: &(Conv2d, GroupNorm)) -> Result<A> {
    layer.1.forward_then(&layer.0.forward(x)?, Activation::Gelu)
}

/// Mean over 3×3 pixels of `[B, 1, h, w]`, edges repeated.
pub(super) fn local_mean<A: SmallArray>(x: &A) -> Result<A> {
    let box3 = x.new_tensor(vec![1.0 / 9.0; 9], &[1, 1, 3, 3])?;
    x.replication_pad2d(1)?.conv2d(&box3, None, ConvConfig { stride: 1, padding: 0 }, None)
}

/// Two 3×3×3 convolutions over (disparity, y, x): `[B, C, D, h, w]` to scores
/// `[B, D, h, w]`. PyTorch's Conv3d layout: `0.weight` `[S, C, 3, 3, 3]`, `1.weight`
/// `[1, S, 3, 3, 3]`.
#[derive(Clone, Debug)]
pub(super) struct Stem {
    weights: [Tensor; 2],
    biases: [Tensor; 2],
}

/// Untrained stem, hidden channel 0: weights of the raw scores, averaged over 3×3 pixels.
/// −|ΔRGB| has a quarter of the range of the others, hence 4; validity has weight 0.
const STEM_SCORES: [f32; 4] = [1.0, 4.0, 1.0, 0.0];
/// Untrained bias of hidden channel 0, which moves the scores into GELU's linear part.
const STEM_LIFT: f32 = 4.0;
/// Untrained gain of the second convolution, per score. With the skip's factor 4 the
/// probability of a clear match is about e⁶ times that of any other candidate.
const STEM_GAIN: f32 = 1.5;

impl Stem {
    pub(super) fn new(c: usize, s: usize, vb: VarBuilder) -> Result<Self> {
        let w0 = vb.get_with_hints((s, c, 3, 3, 3), "0.weight", default_init(c * 27))?;
        let w1 = vb.get_with_hints((1, s, 3, 3, 3), "1.weight", Init::Const(0.0))?;
        let b0 = vb.get_with_hints(s, "0.bias", Init::Const(0.0))?;
        let b1 = vb.get_with_hints(1, "1.bias", Init::Const(0.0))?;
        Ok(Self { weights: [w0, w1], biases: [b0, b1] })
    }

    pub(super) fn forward<A: Array>(&self, volume: &A) -> Result<A> {
        let on = |i: usize| -> Result<[A; 2]> {
            Ok([volume.parameter(&self.weights[i])?, volume.parameter(&self.biases[i])?])
        };
        let steps = ConvConfig { stride: 1, padding: 1 };
        let ([first, b0], [second, b1]) = (on(0)?, on(1)?);
        let hidden = volume.conv3d(&first, Some(&b0), steps, Some(Activation::Gelu))?;
        let scores = hidden.conv3d(&second, Some(&b1), steps, None)?;
        let [b, _, d, h, w] = scores.sizes()?;
        scores.reshape((b, d, h, w))
    }
}

/// Overwrites `values` with the stem's initial values that `candle_nn::Init` cannot express.
pub(crate) fn apply_small_initial_value(name: &str, shape: &[usize], values: &mut [f32]) {
    match (name, shape) {
        ("small.stem.0.weight", &[_, c, 3, 3, 3]) if c == STEM_SCORES.len() + 1 => {
            values[..c * 27].fill(0.0);
            for (k, factor) in STEM_SCORES.iter().enumerate() {
                // Middle candidate, all nine pixels.
                values[(k + 1) * 27 + 9..][..9].fill(factor / 9.0);
            }
        }
        ("small.stem.0.bias", &[_]) => values[0] = STEM_LIFT,
        ("small.stem.1.weight", &[1, _, 3, 3, 3]) => values[9..18].fill(STEM_GAIN / 9.0),
        _ => {}
    }
}

/// Convolution, GroupNorm and GELU, twice.
#[derive(Clone, Debug)]
struct Block([(Conv2d, GroupNorm); 2]);

impl Block {
    fn new(c: usize, o: usize, vb: VarBuilder) -> Result<Self> {
        let layer = |i: usize, c: usize| -> Result<(Conv2d, GroupNorm)> {
            let vb = vb.pp(i);
            let conv = Conv2d::new(c, o, ConvShape::K3, vb.pp("conv"))?;
            Ok((conv, GroupNorm::new(8, o, vb.pp("norm"))?))
        };
        Ok(Self([layer(0, c)?, layer(1, o)?]))
    }

    fn forward<A: Array>(&self, x: &A) -> Result<A> {
        conv_norm_gelu(&conv_norm_gelu(x, &self.0[0])?, &self.0[1])
    }
}

/// U-Net from 1/4 resolution downwards, with one block a level on either side.
#[derive(Clone, Debug)]
pub(super) struct Unet {
    down: Vec<Block>,
    shrink: Vec<Conv2d>,
    up: Vec<Block>,
}

impl Unet {
    pub(super) fn new(c_in: usize, channels: &[usize], vb: VarBuilder) -> Result<Self> {
        let (mut down, mut shrink, mut up) = (Vec::new(), Vec::new(), Vec::new());
        for (l, &c) in channels.iter().enumerate() {
            let from = if l == 0 { c_in } else { c };
            down.push(Block::new(from, c, vb.pp("down").pp(l))?);
            if let Some(&next) = channels.get(l + 1) {
                shrink.push(Conv2d::new(c, next, ConvShape::K3S2, vb.pp("shrink").pp(l))?);
                up.push(Block::new(c + next, c, vb.pp("up").pp(l))?);
            }
        }
        Ok(Self { down, shrink, up })
    }

    /// Maps `[B, c_in, h, w]` to `[B, channels[0], h, w]`.
    pub(super) fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let mut skips = Vec::new();
        let mut x = self.down[0].forward(x)?;
        for (shrink, block) in self.shrink.iter().zip(&self.down[1..]) {
            let next = block.forward(&shrink.forward(&x)?)?;
            skips.push(std::mem::replace(&mut x, next));
        }
        for (block, skip) in self.up.iter().zip(&skips).rev() {
            x = block.forward(&skip.cat_upsampled(&x, 2)?)?;
        }
        Ok(x)
    }
}

/// ×4 upsampling in which each fine pixel is a learned convex combination of the 3×3
/// coarse pixels around it (RAFT, 3.3). Untrained: bilinear.
#[derive(Clone, Debug)]
pub(super) struct ConvexUpsampling {
    hidden: Conv2d,
    mask: Conv2d,
}

/// Smallest share of a neighbour in an untrained mask, which contains the share's logarithm.
const MIN_SHARE: f32 = 1e-3;

impl ConvexUpsampling {
    pub(super) fn new(c: usize, vb: VarBuilder) -> Result<Self> {
        Ok(Self {
            hidden: Conv2d::new(c + 48, 64, ConvShape::K3, vb.pp("0"))?,
            mask: Conv2d::with(64, 144, ConvShape::K1, LayerInit::ZERO, vb.pp("1"))?,
        })
    }

    /// Upsamples `maps`, each `[B, 1, h, w]`, to `[B, 1, 4h, 4w]`. The mask comes from
    /// `deep` `[B, C, h, w]` and the image `rgb` `[B, 3, 4h, 4w]`.
    pub(super) fn apply<A: SmallArray>(&self, deep: &A, rgb: &A, maps: [&A; 2]) -> Result<[A; 2]> {
        let [b, _, h, w] = deep.sizes()?;
        // The image's 4×4 blocks as channels.
        let blocks = rgb.reshape(vec![b, 3, h, 4, w, 4])?.permute(&[0, 1, 3, 5, 2, 4])?;
        let blocks = blocks.reshape((b, 48, h, w))?.affine(1.0, -0.5)?;
        let hidden = self.hidden.forward_then(&deep.cat_channels(&blocks)?, Activation::Gelu)?;
        self.mask.forward(&hidden)?.upsample_convex(maps, &bilinear_shares())
    }
}

/// Shares `[16, 9]` of the 3×3 coarse pixels in bilinear ×4 upsampling, at least
/// [`MIN_SHARE`].
fn bilinear_shares() -> Vec<f32> {
    let axis = |i: usize| {
        let o = (i as f32 + 0.5) / 4.0 - 0.5;
        [(-o).max(0.0), 1.0 - o.abs(), o.max(0.0)]
    };
    let mut shares = Vec::with_capacity(144);
    for i in 0..16 {
        let (wy, wx) = (axis(i / 4), axis(i % 4));
        shares.extend((0..9).map(|k| (wy[k / 3] * wx[k % 3]).max(MIN_SHARE)));
    }
    shares
}
