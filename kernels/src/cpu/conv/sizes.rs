//! Shapes of one convolution.

/// (depth, height, width).
pub type Axes = [usize; 3];

/// Shapes of one convolution: x `[B, C, D, H, W]`, w `[O, C, kd, kh, kw]`,
/// y `[B, O, D', H', W']`, zero padding. A 2-D convolution has D = kd = 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// C.
    pub in_channels: usize,
    /// O.
    pub out_channels: usize,
    /// kd, kh, kw.
    pub kernel: Axes,
    /// Step of the kernel along each axis.
    pub stride: Axes,
    /// Zeros added on both sides of each axis.
    pub padding: Axes,
    /// D, H, W.
    pub size: Axes,
}

impl Sizes {
    /// Describes a 2-D convolution: a volume of one slice. `kernel` and `size` are
    /// (height, width); `stride` and `padding` hold for both axes.
    pub fn conv2d(
        [in_channels, out_channels]: [usize; 2],
        kernel: [usize; 2],
        stride: usize,
        padding: usize,
        size: [usize; 2],
    ) -> Self {
        let volume = |depth, [h, w]: [usize; 2]| [depth, h, w];
        Self {
            in_channels,
            out_channels,
            kernel: volume(1, kernel),
            stride: volume(1, [stride; 2]),
            padding: volume(0, [padding; 2]),
            size: volume(1, size),
        }
    }

    /// Describes a 3-D convolution of stride 1 with `padding` zeros on every side.
    pub fn conv3d(
        [in_channels, out_channels]: [usize; 2],
        kernel: Axes,
        padding: usize,
        size: Axes,
    ) -> Self {
        let (stride, padding) = ([1; 3], [padding; 3]);
        Self { in_channels, out_channels, kernel, stride, padding, size }
    }

    /// Returns D', H', W'.
    pub fn out_size(&self) -> Axes {
        std::array::from_fn(|a| {
            let padded = self.size[a] + 2 * self.padding[a];
            (padded + 1).saturating_sub(self.kernel[a]).div_ceil(self.stride[a].max(1))
        })
    }

    /// Returns the taps of the kernel: kd·kh·kw.
    pub fn taps(&self) -> usize {
        self.kernel.iter().product()
    }

    /// Returns D·H·W.
    pub fn in_pixels(&self) -> usize {
        self.size.iter().product()
    }

    /// Returns D'·H'·W'.
    pub fn out_pixels(&self) -> usize {
        self.out_size().iter().product()
    }
}
