//! MVSplat's 2-D U-Net (MVSplat 3.1, "Cost volume refinement"): that of latent diffusion,
//! with the norm after each convolution, one residual block per level, and attention
//! across the views of a scene at the lowest level. Rows are (v b).

use crate::network::model::layers::{Activation, Conv2d, ConvShape, GroupNorm, default_init};
use crate::network::model::trace::Trace;
use crate::network::ops::{Array, ConvConfig};
use candle_core::{Result, Tensor};
use candle_nn::VarBuilder;

/// Groups of every norm inside the U-Net, whatever its width.
const GROUPS: usize = 8;
/// Width of an attention head.
const HEAD: usize = 32;

/// The network: `channels` at every level, `levels` levels.
#[derive(Clone, Debug)]
pub struct UNet {
    stem: Conv2d,
    down: Vec<Down>,
    middle: [ResBlock; 2],
    up: Vec<Up>,
    out: (Conv2d, GroupNorm),
}

#[derive(Clone, Debug)]
struct Down {
    block: ResBlock,
    attention: Option<Attention>,
    shrink: Option<Conv2d>,
}

#[derive(Clone, Debug)]
struct Up {
    block: ResBlock,
    attention: Option<Attention>,
    grow: Option<Conv2d>,
}

impl UNet {
    /// Builds the network; `vb` is at the U-Net (`input_blocks.…`).
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(channels: usize, levels: usize, vb: VarBuilder) -> Result<Self> {
        let c = channels;
        let conv = |shape, vb| Conv2d::new(c, c, shape, vb);
        let mut down = Vec::new();
        for level in 0..levels {
            let lowest = level + 1 == levels;
            let vb_block = vb.pp(format!("input_blocks.{}", 1 + 2 * level));
            let vb_shrink = vb.pp(format!("input_blocks.{}.0.op", 2 + 2 * level));
            down.push(Down {
                block: ResBlock::new(c, c, vb_block.pp("0"))?,
                attention: lowest.then(|| Attention::new(c, vb_block.pp("1"))).transpose()?,
                shrink: (!lowest).then(|| conv(ConvShape::K3S2, vb_shrink)).transpose()?,
            });
        }
        let mut up = Vec::new();
        for i in 0..2 * levels {
            let lowest = i / 2 == 0;
            let top = i / 2 + 1 == levels;
            let vb = vb.pp(format!("output_blocks.{i}"));
            let grow = i % 2 == 1 && !top;
            let vb_grow = vb.pp(if lowest { "2.conv" } else { "1.conv" });
            up.push(Up {
                block: ResBlock::new(2 * c, c, vb.pp("0"))?,
                attention: lowest.then(|| Attention::new(c, vb.pp("1"))).transpose()?,
                grow: grow.then(|| conv(ConvShape::K3, vb_grow)).transpose()?,
            });
        }
        let middle = vb.pp("middle_block");
        Ok(Self {
            stem: conv(ConvShape::K3, vb.pp("input_blocks.0.0"))?,
            down,
            middle: [ResBlock::new(c, c, middle.pp("0"))?, ResBlock::new(c, c, middle.pp("2"))?],
            up,
            out: (conv(ConvShape::K3, vb.pp("out.0"))?, GroupNorm::new(GROUPS, c, vb.pp("out.1"))?),
        })
    }

    /// Returns the number of stages that a trace records.
    pub(super) fn steps(levels: usize) -> usize {
        4 * levels + 3
    }

    /// Maps `[V·B, C, h, w]` to the same shape; `trace` records stages under `name`.
    ///
    /// # Errors
    /// h or w is not a multiple of 2^(levels − 1).
    pub fn forward<A: Array>(
        &self,
        x: &A,
        views: usize,
        trace: &mut Trace<'_>,
        name: &str,
    ) -> Result<A> {
        let mut x = self.stem.forward(x)?;
        trace.put(&format!("{name}.input_blocks.0"), &x)?;
        let mut skips = vec![x.clone()];
        for down in &self.down {
            x = down.block.forward(&x)?;
            if let Some(attention) = &down.attention {
                x = attention.forward(&x, views)?;
            }
            trace.put(&format!("{name}.input_blocks.{}", skips.len()), &x)?;
            skips.push(x.clone());
            if let Some(shrink) = &down.shrink {
                x = shrink.forward(&x)?;
                trace.put(&format!("{name}.input_blocks.{}", skips.len()), &x)?;
                skips.push(x.clone());
            }
        }
        for (block, i) in self.middle.iter().zip([0, 2]) {
            x = block.forward(&x)?;
            trace.put(&format!("{name}.middle_block.{i}"), &x)?;
        }
        for (i, up) in self.up.iter().enumerate() {
            let joined = match skips.pop() {
                Some(skip) => x.cat_channels(&skip)?,
                None => x,
            };
            x = up.block.forward(&joined)?;
            if let Some(attention) = &up.attention {
                x = attention.forward(&x, views)?;
            }
            if let Some(grow) = &up.grow {
                x = grow.forward(&x.upsample_nearest2d(2)?)?;
            }
            trace.put(&format!("{name}.output_blocks.{i}"), &x)?;
        }
        let x = self.out.1.forward_then(&self.out.0.forward(&x)?, Activation::Silu)?;
        trace.put(&format!("{name}.out"), &x)?;
        Ok(x)
    }
}

/// skip(x) + SiLU(GN(conv(SiLU(GN(conv(x)))))).
#[derive(Clone, Debug)]
struct ResBlock {
    conv1: Conv2d,
    norm1: GroupNorm,
    conv2: Conv2d,
    norm2: GroupNorm,
    skip: Option<Conv2d>,
}

impl ResBlock {
    fn new(c_in: usize, c: usize, vb: VarBuilder) -> Result<Self> {
        let (a, b) = (vb.pp("in_layers"), vb.pp("out_layers"));
        let skip = if c_in == c {
            None
        } else {
            Some(Conv2d::new(c_in, c, ConvShape::K1, vb.pp("skip_connection"))?)
        };
        Ok(Self {
            conv1: Conv2d::new(c_in, c, ConvShape::K3, a.pp("0"))?,
            norm1: GroupNorm::new(GROUPS, c, a.pp("1"))?,
            conv2: Conv2d::new(c, c, ConvShape::K3, b.pp("0"))?,
            norm2: GroupNorm::new_zero(GROUPS, c, b.pp("1"))?,
            skip,
        })
    }

    fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let h = self.norm1.forward_then(&self.conv1.forward(x)?, Activation::Silu)?;
        let h = self.conv2.forward(&h)?;
        let skip = match &self.skip {
            Some(skip) => &skip.forward(x)?,
            None => x,
        };
        self.norm2.forward_onto(skip, &h, Some(Activation::Silu))
    }
}

/// x + GN(proj(attention(qkv(x)))). The tokens of all views of a scene form one sequence,
/// view-major; the projections and the norm apply to each view alone.
#[derive(Clone, Debug)]
struct Attention {
    /// `[3·C, C, 1, 1]`, `[3·C]`: per head q, k, v.
    qkv: (Tensor, Tensor),
    /// `[C, C, 1, 1]`, `[C]`.
    proj_out: (Tensor, Tensor),
    norm: GroupNorm,
    channels: usize,
}

impl Attention {
    fn new(c: usize, vb: VarBuilder) -> Result<Self> {
        let conv1d = |out: usize, vb: VarBuilder| -> Result<(Tensor, Tensor)> {
            let weight = vb.get_with_hints((out, c, 1), "weight", default_init(c))?;
            Ok((weight.unsqueeze(3)?, vb.get_with_hints(out, "bias", default_init(c))?))
        };
        Ok(Self {
            qkv: conv1d(3 * c, vb.pp("qkv"))?,
            proj_out: conv1d(c, vb.pp("proj_out"))?,
            norm: GroupNorm::new_zero(GROUPS, c, vb.pp("norm"))?,
            channels: c,
        })
    }

    fn forward<A: Array>(&self, x: &A, views: usize) -> Result<A> {
        let [rows, c, h, w] = x.sizes()?;
        let scenes = rows / views;
        let heads = self.channels / HEAD;
        let n = h * w;
        let layer = |x: &A, (weight, bias): &(Tensor, Tensor)| {
            let (weight, bias) = (x.parameter(weight)?, x.parameter(bias)?);
            x.conv2d(&weight, Some(&bias), ConvConfig { stride: 1, padding: 0 }, None)
        };
        let qkv = layer(x, &self.qkv)?.reshape(vec![views, scenes, heads, 3, HEAD, n])?;
        let part = |i: usize| -> Result<A> {
            let x = qkv.narrow(3, i, 1)?.permute(&[1, 2, 0, 5, 4, 3])?;
            x.reshape((scenes * heads, views * n, HEAD))
        };
        // MVSplat's code scales q and k by HEAD^(−1/4) each.
        let scale = 1.0 / (HEAD as f32).sqrt();
        let y = part(0)?.attention(&part(1)?, &part(2)?, scale, None)?;
        let y = y.reshape((scenes, heads, views, n, HEAD))?.permute(&[2, 0, 1, 4, 3])?;
        let y = layer(&y.reshape((rows, c, h, w))?, &self.proj_out)?;
        self.norm.forward_onto(x, &y, None)
    }
}
