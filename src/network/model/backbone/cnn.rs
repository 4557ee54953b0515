//! MVSplat's CNN (MVSplat 3.1, "Multi-view feature extraction"): a ResNet to 1/4
//! resolution with parameter-free InstanceNorm.
//!
//! In: `[N, 3, H, W]` RGB in [0, 1], rows in any order. Out: [`CnnOutput`].

use crate::network::model::layers::{
    Activation, Conv2d, ConvShape, LayerInit, default_init, instance_norm, instance_norm_relu,
};
use crate::network::model::trace::Trace;
use crate::network::ops::Array;
use candle_core::Result;
use candle_nn::{Init, VarBuilder};

/// Mean and standard deviation of ImageNet's colours, with which the CNN alone normalises
/// its input.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const STD: [f32; 3] = [0.229, 0.224, 0.225];

/// Feature maps of the CNN.
#[derive(Clone, Debug)]
pub struct CnnOutput<A> {
    /// `[N, C₁, H/2, W/2]`: output of the first stage.
    pub half: A,
    /// `[N, C₃, H/4, W/4]`: output of the CNN.
    pub quarter: A,
}

/// The network.
#[derive(Clone, Debug)]
pub struct Cnn {
    conv1: Conv2d,
    stages: Vec<[Residual; 2]>,
    conv2: Conv2d,
}

impl Cnn {
    /// Builds the CNN; `channels` of the three stages.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn new(channels: [usize; 3], vb: VarBuilder) -> Result<Self> {
        let mut c_in = channels[0];
        let mut stages = Vec::new();
        // The third stage keeps 1/4 resolution: UniMatch's `num_output_scales = 0`.
        for (i, (c, stride)) in channels.into_iter().zip([1, 2, 1]).enumerate() {
            let vb = vb.pp(format!("layer{}", i + 1));
            let first = Residual::new(c_in, c, stride, vb.pp("0"))?;
            stages.push([first, Residual::new(c, c, 1, vb.pp("1"))?]);
            c_in = c;
        }
        Ok(Self {
            conv1: Conv2d::new_no_bias(3, channels[0], ConvShape::K7S2, vb.pp("conv1"))?,
            stages,
            conv2: Conv2d::new(c_in, c_in, ConvShape::K1, vb.pp("conv2"))?,
        })
    }

    /// Maps `[N, 3, H, W]` to both feature maps.
    ///
    /// # Errors
    /// Those of candle.
    pub fn forward<A: Array>(&self, images: &A, trace: &mut Trace<'_>) -> Result<CnnOutput<A>> {
        let row = |v: [f32; 3]| images.new_tensor(v.to_vec(), &[1, 3, 1, 1]);
        let x = images.sub(&row(MEAN)?)?.div(&row(STD)?)?;
        trace.put("cnn.normalized_image", &x)?;
        let x = self.conv1.forward(&x)?;
        trace.put("cnn.conv1", &x)?;
        let mut x = instance_norm_relu(&x)?;
        let mut half = None;
        for (i, stage) in self.stages.iter().enumerate() {
            x = stage[1].forward(&stage[0].forward(&x)?)?;
            trace.put(&format!("cnn.layer{}", i + 1), &x)?;
            half.get_or_insert_with(|| x.clone());
        }
        let quarter = self.conv2.forward(&x)?;
        trace.put("cnn.out_bv", &quarter)?;
        Ok(CnnOutput { half: half.unwrap_or(x), quarter })
    }
}

/// ReLU(skip(x) + branch(x)); the branch has a ReLU at its end, too.
#[derive(Clone, Debug)]
struct Residual {
    conv1: Conv2d,
    conv2: Conv2d,
    downsample: Option<Conv2d>,
}

impl Residual {
    fn new(c_in: usize, c: usize, stride: usize, vb: VarBuilder) -> Result<Self> {
        let downsample = if stride == 1 && c_in == c {
            None
        } else {
            // The InstanceNorm after it cancels the bias, but checkpoints hold one.
            let stdev = (2.0 / c as f64).sqrt();
            let weight = Init::Randn { mean: 0.0, stdev };
            let init = LayerInit { weight, bias: Some(default_init(c_in)) };
            let shape = ConvShape::K1.stride(stride);
            Some(Conv2d::with(c_in, c, shape, init, vb.pp("downsample.0"))?)
        };
        Ok(Self {
            conv1: Conv2d::new_no_bias(c_in, c, ConvShape::K3.stride(stride), vb.pp("conv1"))?,
            conv2: Conv2d::new_no_bias(c, c, ConvShape::K3, vb.pp("conv2"))?,
            downsample,
        })
    }

    fn forward<A: Array>(&self, x: &A) -> Result<A> {
        let y = instance_norm_relu(&self.conv1.forward(x)?)?;
        let y = instance_norm_relu(&self.conv2.forward(&y)?)?;
        let skip = match &self.downsample {
            Some(conv) => instance_norm(&conv.forward(x)?)?,
            None => x.clone(),
        };
        skip.add_activation(&y, Activation::Relu)
    }
}
