use crate::network::ops::{borrowed, output, slice, tensor_like};
use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor, bail,
};
use std::sync::{Arc, Mutex, PoisonError};
use subsplat_kernels::cpu::resize::Resize;
use subsplat_kernels::cpu::small::heads as cpu;
use subsplat_kernels::cpu::small::heads::{BESIDE, Candidates, Input, Output};

const INPUT: &str = "head input";
const OUTPUT: &str = "head output";
const DISTANCE: &str = "ray distance";

fn expect(op: &str, what: &str, x: &Tensor, shape: &[usize]) -> Result<()> {
    if x.dims() != shape {
        bail!("{op} {what}: expected {shape:?}, got {:?}", x.dims());
    }
    Ok(())
}

/// `[B, C + 5, H, W]`: `features` `[B, C, h, w]` upsampled (bilinear, corners aligned),
/// `rgb` `[B, 3, H, W]` (a constant to gradients), `index`·`share`, σ(`confidence`),
/// both `[B, 1, H, W]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn head_input(
    features: &Tensor,
    rgb: &Tensor,
    index: &Tensor,
    confidence: &Tensor,
    share: f32,
) -> Result<Tensor> {
    let (b, c, fh, fw) = features.dims4()?;
    let (_, _, h, w) = rgb.dims4()?;
    expect(INPUT, "picture", rgb, &[b, 3, h, w])?;
    expect(INPUT, "index", index, &[b, 1, h, w])?;
    expect(INPUT, "confidence", confidence, &[b, 1, h, w])?;
    if [b, c, fh, fw, h, w].contains(&0) {
        bail!("{INPUT}: expected sizes of at least 1, got {:?}, {:?}", features.dims(), rgb.dims());
    }
    let input = Input { channels: c, resize: Resize { from: [fh, fw], to: [h, w] }, share };
    let op = Before { input, rgb: rgb.contiguous()?.detach() };
    features.contiguous()?.apply_op3(&index.contiguous()?, &confidence.contiguous()?, op)
}

struct Before {
    input: Input,
    rgb: Tensor,
}

impl CustomOp3 for Before {
    fn name(&self) -> &'static str {
        INPUT
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let features = slice::<f32>(INPUT, "features", s1, l1)?;
        let index = slice::<f32>(INPUT, "index", s2, l2)?;
        let confidence = slice::<f32>(INPUT, "confidence", s3, l3)?;
        let [h, w] = self.input.resize.to;
        let shape = (l1.dims()[0], self.input.channels + BESIDE, h, w);
        let mut y = vec![0.0; shape.0 * shape.1 * h * w];
        borrowed(INPUT, [&self.rgb], |[rgb]: [&[f32]; 1]| {
            self.input.forward(features, rgb, [index, confidence], &mut y);
        })?;
        output(y, shape)
    }

    fn bwd(
        &self,
        features: &Tensor,
        index: &Tensor,
        confidence: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let run = |[confidence, dy]: [&[f32]; 2]| self.input.backward(confidence, dy);
        let (df, di, dc) = borrowed(INPUT, [confidence, &dy], run)?;
        Ok((
            Some(tensor_like(df, features)?),
            Some(tensor_like(di, index)?),
            Some(tensor_like(dc, confidence)?),
        ))
    }
}

/// Initial values of the raw rows, and the formula of the opacity.
#[derive(Clone, Debug, PartialEq)]
pub struct Start {
    /// `[R]`: added to every raw row.
    pub row: Vec<f32>,
    /// Where the pixel's own colour is added: its three places in a row, and factor and
    /// offset of the colour in [0, 1].
    pub colour: Option<([usize; 3], f32, f32)>,
    /// Opacity is σ(confidence + residual)²; else σ(residual + 2).
    pub confident: bool,
}

/// (raw rows `[B, H·W, R]`, opacity `[B, 1, H, W]`) from the heads' convolution `x`
/// `[B, R + 1, H, W]` (opacity's residual last), `confidence` `[B, 1, H, W]` (a logit)
/// and `rgb` `[B, 3, H, W]` (a constant to gradients).
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn head_output(
    x: &Tensor,
    confidence: &Tensor,
    rgb: &Tensor,
    start: Start,
) -> Result<(Tensor, Tensor)> {
    let (b, _, h, w) = x.dims4()?;
    let r = start.row.len();
    expect(OUTPUT, "channels", x, &[b, r + 1, h, w])?;
    expect(OUTPUT, "picture", rgb, &[b, 3, h, w])?;
    expect(OUTPUT, "confidence", confidence, &[b, 1, h, w])?;
    let inside = start.colour.is_none_or(|(places, ..)| places.iter().all(|p| *p < r));
    if b * h * w * r == 0 || !inside {
        bail!("{OUTPUT}: expected sizes of at least 1 and places below {r}, got {:?}", x.dims());
    }
    let Start { row, colour, confident } = start;
    let sizes = Arc::new(Output { raw: r, size: [h, w], start: row, colour, confident });
    let x = x.contiguous()?;
    let slot = Slot::default();
    let opacity = Opacity { sizes: sizes.clone(), slot: slot.clone() };
    let opacity = x.apply_op2(&confidence.contiguous()?, opacity)?;
    let raw = Raw { sizes, x: x.detach(), rgb: rgb.contiguous()?.detach(), slot };
    Ok((opacity.apply_op1(raw)?, opacity))
}

/// Gradient of the raw rows. candle's operations have one result each; this one has two. The input of
/// [`Raw`] is the result of [`Opacity`], so the backward pass of `Raw` runs first. It stores its
/// gradient here, and the backward pass of `Opacity` computes the gradient of both.
type Slot = Arc<Mutex<Option<Tensor>>>;

struct Opacity {
    sizes: Arc<Output>,
    slot: Slot,
}

impl CustomOp2 for Opacity {
    fn name(&self) -> &'static str {
        OUTPUT
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = slice::<f32>(OUTPUT, "x", s1, l1)?;
        let confidence = slice::<f32>(OUTPUT, "confidence", s2, l2)?;
        let mut y = vec![0.0; confidence.len()];
        self.sizes.opacity(x, confidence, &mut y);
        output(y, l2.shape().clone())
    }

    fn bwd(
        &self,
        x: &Tensor,
        confidence: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let raw = self.slot.lock().unwrap_or_else(PoisonError::into_inner).take();
        let (dx, dc) = match raw {
            Some(raw) => {
                let run = |[x, c, dy, raw]: [&[f32]; 4]| self.sizes.backward(x, c, dy, Some(raw));
                borrowed(OUTPUT, [x, confidence, &dy, &raw], run)?
            }
            None => {
                let run = |[x, c, dy]: [&[f32]; 3]| self.sizes.backward(x, c, dy, None);
                borrowed(OUTPUT, [x, confidence, &dy], run)?
            }
        };
        Ok((Some(tensor_like(dx, x)?), Some(tensor_like(dc, confidence)?)))
    }
}

struct Raw {
    sizes: Arc<Output>,
    x: Tensor,
    rgb: Tensor,
    slot: Slot,
}

impl CustomOp1 for Raw {
    fn name(&self) -> &'static str {
        OUTPUT
    }

    fn cpu_fwd(&self, _s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let (b, _, h, w) = l.shape().dims4()?;
        let mut raw = vec![0.0; b * h * w * self.sizes.raw];
        borrowed(OUTPUT, [&self.x, &self.rgb], |[x, rgb]: [&[f32]; 2]| {
            self.sizes.raw(x, rgb, &mut raw);
        })?;
        output(raw, (b, h * w, self.sizes.raw))
    }

    fn bwd(&self, opacity: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        *self.slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(dy);
        opacity.zeros_like().map(Some)
    }
}

/// Distance along the unit ray of candidate indices `[B, 1, H, W]`:
/// length / (low + step·index), with `ranges` for each of B and `lengths` `[B, H, W]` of the
/// rays at camera z = 1.
///
/// # Errors
/// Lengths that do not fit; a dtype other than f32.
pub fn ray_distance(index: &Tensor, ranges: Vec<Candidates>, lengths: Vec<f32>) -> Result<Tensor> {
    if index.dims().first() != Some(&ranges.len()) || lengths.len() != index.elem_count() {
        bail!(
            "{DISTANCE}: expected a range for each of {:?} and a length for each pixel, got {} and \
             {}",
            index.dims(),
            ranges.len(),
            lengths.len()
        );
    }
    index.contiguous()?.apply_op1(Distance { ranges, lengths })
}

struct Distance {
    ranges: Vec<Candidates>,
    lengths: Vec<f32>,
}

impl CustomOp1 for Distance {
    fn name(&self) -> &'static str {
        DISTANCE
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let index = slice::<f32>(DISTANCE, "index", s, l)?;
        let mut out = vec![0.0; index.len()];
        cpu::distance(&self.ranges, &self.lengths, index, &mut out);
        output(out, l.shape().clone())
    }

    fn bwd(&self, index: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let run = |[index, dy]: [&[f32]; 2]| {
            cpu::distance_backward(&self.ranges, &self.lengths, index, dy)
        };
        tensor_like(borrowed(DISTANCE, [index, &dy], run)?, index).map(Some)
    }
}
