//! MVSplat's multi-view transformer (MVSplat 3.1, "Multi-view feature extraction"; after
//! UniMatch): windowed self- and cross-attention on 1/4 features.
//!
//! Rows are (v b). Between the projections the tokens of a layer are in window order, so
//! that each window is a run of consecutive rows.

use super::{bv_rows, vb_rows};
use crate::network::config::Mvsplat as Settings;
use crate::network::model::layers::{LayerNorm, Linear, gelu};
use crate::network::model::trace::Trace;
use crate::network::ops::Array;
use crate::network::ops::attention::Labels;
use candle_core::{Result, bail};
use candle_nn::VarBuilder;

/// Tokens per block of the feed-forward block with gradients. Its hidden layer is 8 × as
/// wide as the tokens: 16 MiB per block.
const FFN_ROWS: usize = 4096;

/// The network.
#[derive(Clone, Debug)]
pub struct Transformer {
    layers: Vec<Layer>,
    splits: usize,
}

#[derive(Clone, Debug)]
struct Layer {
    self_attn: SubLayer,
    cross_attn: SubLayer,
}

impl Transformer {
    /// Builds the layers, each self-attention and then cross-attention.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(s: &Settings, vb: VarBuilder) -> Result<Self> {
        let width = s.cnn_channels[2];
        let layers = (0..s.transformer_layers).map(|i| {
            let vb = vb.pp(format!("layers.{i}"));
            Ok(Layer {
                self_attn: SubLayer::new(width, None, vb.pp("self_attn"))?,
                cross_attn: SubLayer::new(
                    width,
                    Some(2 * width * s.ffn_expansion),
                    vb.pp("cross_attn_ffn"),
                )?,
            })
        });
        Ok(Self { layers: layers.collect::<Result<_>>()?, splits: s.window_splits })
    }

    /// Maps `[B, V, C, h, w]` to the same shape. `sources` `[B][V][S]`: the views that each view
    /// attends to ([`crate::network::model::Views::sources`]).
    ///
    /// # Errors
    /// h or w is not a multiple of the window splits.
    pub fn forward<A: Array>(
        &self,
        cnn: &A,
        sources: &[Vec<Vec<usize>>],
        trace: &mut Trace<'_>,
    ) -> Result<A> {
        let [_, v, c, h, w] = cnn.sizes()?;
        let s = self.splits;
        if h % s != 0 || w % s != 0 {
            bail!("transformer: expected a map that splits into {s}x{s} windows, got {h}x{w}");
        }
        let positions = position_encoding(c, [h, w], s);
        let x = cnn.add(&cnn.new_tensor(positions, &[1, 1, c, h, w])?)?;
        trace.put("transformer.pos_added", &x)?;
        let mut x = vb_rows(&x)?.channels_last()?;
        for (i, layer) in self.layers.iter().enumerate() {
            // A single window has no seams to shift.
            let roll = if i % 2 == 1 && s > 1 { Roll::Half } else { Roll::None };
            let windows = Windows::new([h, w], s, roll);
            let input = x.index_select(&windows.raster(), 1)?;
            let updated = layer.self_attn.forward(&input, &[&input], &windows)?;
            let back = windows.inverse();
            trace.put_with(&format!("transformer.layer{i}.self_attn_vb"), || {
                updated.index_select(&back, 1)
            })?;
            x = layer.cross(&updated, &input, sources, &windows)?.index_select(&back, 1)?;
            trace.put(&format!("transformer.layer{i}.out_vb"), &x)?;
        }
        let rows = x.dims()[0];
        let x = bv_rows(&x.channels_last()?.reshape((rows, c, h, w))?, v)?;
        trace.put("transformer.features", &x)?;
        Ok(x)
    }
}

impl Layer {
    /// Cross-attention of every view to the layer's input (`input`) of its sources, all views at
    /// once. Rows are (v b).
    fn cross<A: Array>(
        &self,
        x: &A,
        input: &A,
        sources: &[Vec<Vec<usize>>],
        w: &Windows,
    ) -> Result<A> {
        let scenes = sources.len();
        let views = sources.first().map_or(0, Vec::len);
        let count = sources.first().and_then(|s| s.first()).map_or(0, Vec::len);
        // Target t of a view is its source t, in ascending order.
        let targets = (0..count).map(|t| {
            let row = |r: usize| sources[r % scenes][r / scenes][t] * scenes + r % scenes;
            let rows: Vec<u32> = (0..views * scenes).map(|r| row(r) as u32).collect();
            input.index_select(&rows, 0)
        });
        let targets = targets.collect::<Result<Vec<_>>>()?;
        self.cross_attn.forward(x, &targets.iter().collect::<Vec<_>>(), w)
    }
}

/// x + norm1(merge(attention)), or with a feed-forward block
/// x + norm2(mlp([x ; norm1(merge(attention))])).
#[derive(Clone, Debug)]
struct SubLayer {
    q_proj: Linear,
    k_proj: Linear,
    v_proj: Linear,
    merge: Linear,
    norm1: LayerNorm,
    ffn: Option<(Linear, Linear, LayerNorm)>,
}

impl SubLayer {
    fn new(width: usize, hidden: Option<usize>, vb: VarBuilder) -> Result<Self> {
        let square = |name: &str| Linear::new_no_bias(width, width, vb.pp(name));
        let ffn = match hidden {
            Some(hidden) => Some((
                Linear::new_no_bias(2 * width, hidden, vb.pp("mlp.0"))?,
                Linear::new_no_bias(hidden, width, vb.pp("mlp.2"))?,
                LayerNorm::new(width, vb.pp("norm2"))?,
            )),
            None => None,
        };
        Ok(Self {
            q_proj: square("q_proj")?,
            k_proj: square("k_proj")?,
            v_proj: square("v_proj")?,
            merge: square("merge")?,
            norm1: LayerNorm::new(width, vb.pp("norm1"))?,
            ffn,
        })
    }

    /// `x` and each of `targets` `[V·B, tokens, C]` in window order.
    fn forward<A: Array>(&self, x: &A, targets: &[&A], windows: &Windows) -> Result<A> {
        let [rows, tokens, c] = x.sizes()?;
        let n = windows.count();
        let m = targets.len();
        let len = tokens / n;
        // Keys of a window: position-major, target-minor.
        let gather = |proj: &Linear| -> Result<A> {
            let all = targets.iter().map(|t| proj.forward(*t)?.reshape((rows * n, len, 1, c)));
            let all = all.collect::<Result<Vec<_>>>()?;
            A::cat(&all.iter().collect::<Vec<_>>(), 2)?.reshape((rows * n, len * m, c))
        };
        let q = self.q_proj.forward(x)?.reshape((rows * n, len, c))?;
        let (k, v) = (gather(&self.k_proj)?, gather(&self.v_proj)?);
        let scale = 1.0 / (c as f32).sqrt();
        let message = q.attention(&k, &v, scale, windows.labels(m))?;
        let message = self.merge.forward(&message)?.reshape((rows, tokens, c))?;
        match &self.ffn {
            None => self.norm1.forward_onto(x, &message),
            Some(ffn) => {
                let x = x.reshape((rows * tokens, c))?;
                let message = self.norm1.forward(&message)?.reshape((rows * tokens, c))?;
                feed_forward(ffn, &x, &message)?.reshape((rows, tokens, c))
            }
        }
    }
}

/// One fused pass, or single ops if a gradient is needed.
fn feed_forward<A: Array>(
    (up, down, norm): &(Linear, Linear, LayerNorm),
    x: &A,
    message: &A,
) -> Result<A> {
    let on = |parameter| x.parameter(parameter);
    let weights = [on(up.weight())?, on(down.weight())?];
    let [scale, shift] = norm.parameters();
    let affine = [on(scale)?, on(shift)?];
    let mut all = [x, message].into_iter().chain(&weights).chain(&affine);
    if !all.any(A::track_op) {
        return x.feed_forward(message, weights.each_ref(), affine.each_ref());
    }
    let rows = x.dims()[0];
    let blocks = (0..rows).step_by(FFN_ROWS).map(|start| {
        let n = FFN_ROWS.min(rows - start);
        let (x, message) = (x.narrow(0, start, n)?, message.narrow(0, start, n)?);
        let hidden = gelu(&up.forward(&A::cat(&[&x, &message], 1)?)?)?;
        norm.forward_onto(&x, &down.forward(&hidden)?)
    });
    A::cat(&blocks.collect::<Result<Vec<_>>>()?.iter().collect::<Vec<_>>(), 0)
}

/// Offset of the windows, as in Swin transformers.
#[derive(Clone, Copy)]
enum Roll {
    None,
    /// Half a window on both axes.
    Half,
}

/// splits × splits windows of an h × w map.
struct Windows {
    size: [usize; 2],
    splits: usize,
    shift: [usize; 2],
}

impl Windows {
    fn new(size: [usize; 2], splits: usize, roll: Roll) -> Self {
        let shift = size.map(|n| match roll {
            Roll::None => 0,
            Roll::Half => n / splits / 2,
        });
        Self { size, splits, shift }
    }

    fn count(&self) -> usize {
        self.splits * self.splits
    }

    /// Rolled coordinates (row, column) in window order: windows row-major, tokens row-major
    /// inside each.
    fn rolled(&self) -> impl Iterator<Item = [usize; 2]> + use<> {
        let s = self.splits;
        let [wh, ww] = self.size.map(|n| n / self.splits);
        (0..s * s).flat_map(move |win| {
            (0..wh * ww).map(move |i| [win / s * wh + i / ww, win % s * ww + i % ww])
        })
    }

    /// Raster index of the token at each position of the window order.
    fn raster(&self) -> Vec<u32> {
        let ([h, w], [sh, sw]) = (self.size, self.shift);
        self.rolled().map(|[y, x]| ((y + sh) % h * w + (x + sw) % w) as u32).collect()
    }

    /// Position in the window order of each token.
    fn inverse(&self) -> Vec<u32> {
        let mut inverse = vec![0u32; self.size[0] * self.size[1]];
        for (position, &token) in self.raster().iter().enumerate() {
            inverse[token as usize] = position as u32;
        }
        inverse
    }

    /// Labels that exclude attention between regions that were no neighbours before the
    /// roll. With `m` targets the key labels are target-major, although the keys are
    /// target-minor. MVSplat's code has this misalignment for three views and more, and its
    /// weights are trained with it.
    fn labels(&self, m: usize) -> Option<Labels> {
        if self.shift == [0, 0] {
            return None;
        }
        let region = |axis: usize, i: usize| -> u8 {
            let n = self.size[axis];
            u8::from(i >= n - n / self.splits) + u8::from(i >= n - self.shift[axis])
        };
        let queries: Vec<u8> =
            self.rolled().map(|[y, x]| 3 * region(0, y) + region(1, x)).collect();
        let len = queries.len() / self.count();
        let keys = queries.chunks_exact(len).flat_map(|window| window.repeat(m)).collect();
        Some(Labels { windows: self.count(), queries, keys })
    }
}

/// Sine and cosine of the position inside each window (1 to n, scaled to 2π), `[C, h, w]`:
/// half of the channels from y, half from x.
fn position_encoding(c: usize, size: [usize; 2], splits: usize) -> Vec<f32> {
    let [h, w] = size;
    let half = c / 2;
    let value = |k: usize, i: usize, n: usize| -> f32 {
        let position = (i % n + 1) as f64 / (n as f64 + 1e-6) * std::f64::consts::TAU;
        let angle = position / 10_000f64.powf((2 * (k / 2)) as f64 / half as f64);
        (if k.is_multiple_of(2) { angle.sin() } else { angle.cos() }) as f32
    };
    let mut out = Vec::with_capacity(c * h * w);
    for k in 0..c {
        for y in 0..h {
            for x in 0..w {
                out.push(if k < half {
                    value(k, y, h / splits)
                } else {
                    value(k - half, x, w / splits)
                });
            }
        }
    }
    out
}
