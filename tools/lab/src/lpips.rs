//! LPIPS, version 0.1 with VGG16: a perceptual distance of images (Zhang et al.,
//! "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018).
//!
//! Images in [0, 1] become x ↦ 2x − 1 and then (x − shift)/scale; VGG16's features
//! after the last ReLU of its five blocks are divided by their length over the
//! channels; d = Σ_blocks mean_pixels Σ_c w_c (a_c − b_c)². Parameter names are those of
//! the `lpips` package: `net.slice{1..5}.{n}`, n being torchvision's index of the
//! convolution, and `lin{0..4}.model.1.weight`. The package's dropout before the linear
//! weights is inactive outside its own training and absent here. Tests: `tools/lab/tests/scores/lpips.rs`.

use candle_core::{Device, Error, Result, Tensor, bail};
use candle_nn::{Init, VarBuilder};
use std::path::Path;
use subsplat::network::model::architecture::LPIPS_BLOCKS;
use subsplat::network::model::layers::{Conv2d, ConvShape};
use subsplat::network::model::weights::Weights;
use subsplat::network::ops::activation::{Activation, activation};

/// Means and standard deviations of ImageNet's images in [−1, 1], as in the `lpips`
/// package.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the length of a feature.
const EPSILON: f64 = 1e-10;
/// Lower bound of the squared length under the root, whose slope at 0 is infinite. The
/// root of it, 10⁻¹⁵, is negligible beside [`EPSILON`].
const MIN_SQUARED_LENGTH: f64 = 1e-30;
/// Smallest side of an image, px: four halvings leave one pixel.
pub const MIN_SIDE: usize = 16;

/// The distance, with its weights. Gradients flow into both pictures.
#[derive(Clone, Debug)]
pub struct Lpips {
    blocks: Vec<Vec<Conv2d>>,
    /// `[1, C]` for each block.
    linear: Vec<Tensor>,
    /// `[1, 3, 1, 1]`.
    shift: Tensor,
    scale: Tensor,
}

impl Lpips {
    /// `vb` is at the root of the names.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(vb: VarBuilder) -> Result<Self> {
        let (mut blocks, mut linear) = (Vec::new(), Vec::new());
        let mut c_in = 3;
        for (i, (indices, channels)) in LPIPS_BLOCKS.into_iter().enumerate() {
            let slice = vb.pp("net").pp(format!("slice{}", i + 1));
            let mut block = Vec::with_capacity(indices.len());
            for index in indices {
                block.push(Conv2d::new(c_in, channels, ConvShape::K3, slice.pp(index))?);
                c_in = channels;
            }
            blocks.push(block);
            let shape = (1, channels, 1, 1);
            let lin = vb.pp(format!("lin{i}")).pp("model.1");
            // Untrained: every channel counts alike.
            let weight = lin.get_with_hints(shape, "weight", Init::Const(1.0))?;
            linear.push(weight.reshape((1, channels))?);
        }
        let three = |v: [f32; 3]| Tensor::from_slice(&v, (1, 3, 1, 1), &Device::Cpu);
        Ok(Self { blocks, linear, shift: three(SHIFT)?, scale: three(SCALE)? })
    }

    /// Reads a weight file (`subsplat-convert` makes one from torchvision's VGG16 and the
    /// `lpips` package's linear weights).
    ///
    /// # Errors
    /// The file is not a weight file; a tensor is missing or has another shape.
    pub fn load(path: &Path) -> Result<Self> {
        let weights = Weights::load(path).map_err(Error::wrap)?;
        Self::new(weights.builder()).map_err(|e| Error::msg(format!("{}: {e}", path.display())))
    }

    /// Returns the distance of two images `[height, width, 3]`, values as in
    /// [`Lpips::forward`].
    ///
    /// # Errors
    /// As [`Lpips::forward`].
    pub fn distance(&self, a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64> {
        let picture = |p: &[f32]| {
            Tensor::from_slice(p, (1, height, width, 3), &Device::Cpu)?
                .permute((0, 3, 1, 2))?
                .contiguous()
        };
        Ok(f64::from(self.forward(&picture(a)?, &picture(b)?)?.get(0)?.to_scalar::<f32>()?))
    }

    /// Returns the distances `[N]` of the images `a` and `b`, `[N, 3, H, W]` in [0, 1].
    /// Values outside [0, 1] are not clamped.
    ///
    /// # Errors
    /// Shapes differ or are not `[N, 3, H, W]`; a side is below [`MIN_SIDE`].
    pub fn forward(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        self.layers(a, b)?.sum(1)
    }

    /// Returns the distance of each block, `[N, 5]`; [`Lpips::forward`] is their sum.
    ///
    /// # Errors
    /// As [`Lpips::forward`].
    pub fn layers(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        let (_, c, h, w) = a.dims4()?;
        if a.dims() != b.dims() || c != 3 {
            let (a, b) = (a.dims(), b.dims());
            bail!("lpips: expected two images [N, 3, H, W] of one shape, got {a:?} and {b:?}");
        }
        if h.min(w) < MIN_SIDE {
            bail!("lpips: expected images of at least {MIN_SIDE} pixels a side, got {w}x{h}");
        }
        let (a, b) = (self.features(a)?, self.features(b)?);
        let distance = |((a, b), weight): ((&Tensor, &Tensor), &Tensor)| {
            let each = (a - b)?.sqr()?.flatten_from(2)?.mean(2)?;
            each.broadcast_mul(weight)?.sum(1)
        };
        let each = a.iter().zip(&b).zip(&self.linear).map(distance).collect::<Result<Vec<_>>>()?;
        Tensor::stack(&each, 1)
    }

    /// Features after each block, of unit length over the channels.
    fn features(&self, picture: &Tensor) -> Result<Vec<Tensor>> {
        let centred = picture.affine(2.0, -1.0)?.broadcast_sub(&self.shift)?;
        let mut x = centred.broadcast_div(&self.scale)?;
        let mut features = Vec::with_capacity(self.blocks.len());
        for (i, block) in self.blocks.iter().enumerate() {
            if i > 0 {
                x = halved(&x)?;
            }
            for conv in block {
                x = activation(&conv.forward(&x)?, Activation::Relu)?;
            }
            features.push(unit(&x)?);
        }
        Ok(features)
    }
}

/// Maximum of each 2×2 pixels, without an odd row or column at the end, as in PyTorch.
/// (The gradient of candle's own pooling is a quarter of the true one.)
fn halved(x: &Tensor) -> Result<Tensor> {
    let (n, c, h, w) = x.dims4()?;
    let (h, w) = (h / 2, w / 2);
    let larger = |pairs: Tensor| pairs.narrow(2, 0, 1)?.maximum(&pairs.narrow(2, 1, 1)?);
    let even = x.narrow(2, 0, 2 * h)?.narrow(3, 0, 2 * w)?.contiguous()?;
    let rows = larger(even.reshape((n * c, h, 2, 2 * w))?)?;
    larger(rows.reshape((n * c * h, w, 2))?)?.reshape((n, c, h, w))
}

/// `x` divided by its length over the channels.
fn unit(x: &Tensor) -> Result<Tensor> {
    let length = x.sqr()?.sum_keepdim(1)?.maximum(MIN_SQUARED_LENGTH)?.sqrt()?;
    x.broadcast_div(&(length + EPSILON)?)
}
