//! Loss of a rendered picture against a photograph, in device memory: the mean squared difference,
//! and the weighted dissimilarity (1 − SSIM)/2, with the gradient by the picture.
//!
//! A photograph takes 4 bytes a pixel: R, G, B and the mask. The gradient takes two kernels,
//! because each is a pass over squares of 16×16 in workgroup memory, and the second one reads the
//! derivatives of windows of other squares.
//!
//! CPU version: [`crate::cpu::dssim`], and the losses of `src/finish` of the crate `subsplat`.
//! WGSL: wgsl/finish/dssim_windows.wgsl, wgsl/finish/loss_gradient.wgsl,
//! wgsl/finish/picture_error.wgsl. Tests: tests/gpu/loss.rs.

use crate::cpu::dssim::Window;
use crate::gpu::buffers::{Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::raster::frame::bind;
use crate::gpu::raster::layers::PICTURE_CHANNELS;
use crate::gpu::uniforms::LossUniform;

pub(crate) static DSSIM_WINDOWS: Kernel = Kernel {
    name: "dssim_windows",
    entry: "main",
    source: wgsl!(
        LossUniform; "shared/grid", "shared/loss", "shared/sum", "finish/dssim_windows"
    ),
};

pub(crate) static LOSS_GRADIENT: Kernel = Kernel {
    name: "loss_gradient",
    entry: "main",
    source: wgsl!(LossUniform; "shared/grid", "shared/loss", "finish/loss_gradient"),
};

pub(crate) static PICTURE_ERROR: Kernel = Kernel {
    name: "picture_error",
    entry: "main",
    source: wgsl!(
        LossUniform; "shared/grid", "shared/loss", "shared/sum", "finish/picture_error"
    ),
};

/// Side of the window of SSIM, px.
pub const LOSS_TAPS: usize = 11;
/// Side of a workgroup's square, windows or pixels.
const SIDE: usize = 16;
/// Pixels of a workgroup of [`PICTURE_ERROR`].
const PIXELS: usize = 1024;
/// Floats of its sums.
const SUMS: usize = 4;

/// Rules of a loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossRules {
    /// Weight of (1 − SSIM)/2.
    pub dssim: f64,
    /// Window and constants of SSIM.
    pub window: Window<LOSS_TAPS>,
    /// Coverage up to which a pixel does not count under [`PixelWeights::Covered`].
    pub coverage_min: f32,
}

/// Weights of a picture's pixels that the mask keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelWeights {
    /// All the same.
    Equal,
    /// By their coverage, alpha.
    Covered,
}

/// A photograph in device memory.
#[derive(Clone, Debug)]
pub struct TargetPicture {
    /// `[H, W]`: R, G, B and the mask as bytes.
    truth: Buffer,
    width: usize,
    height: usize,
    /// Pixels that the mask keeps.
    counted: usize,
}

/// Sums of a loss over a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureLoss {
    /// The loss.
    pub value: f64,
    /// Weighted mean of the squared differences; 0 where no pixel has a weight.
    pub error: f64,
    /// Mean weight of the pixels that the mask keeps.
    pub covered: f64,
}

/// Pending read-back of a loss.
pub(crate) struct LossReading {
    sums: Reading<f32>,
    scores: Option<Reading<f32>>,
    /// Windows of the three channels.
    windows: usize,
    pixels: usize,
    counted: usize,
    dssim: f64,
}

impl Gpu {
    /// Copies a photograph to the device: `image` `[H, W, 3]`, and the pixels that count, `[H, W]`;
    /// `None` where all do.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for other lengths; errors of the device.
    pub fn target_picture(
        &self,
        image: &[u8],
        kept: Option<&[bool]>,
        [width, height]: [usize; 2],
    ) -> Result<TargetPicture, GpuError> {
        let pixels = width * height;
        let lengths = [
            ("image", image.len(), 3 * pixels),
            ("mask", kept.map_or(pixels, <[bool]>::len), pixels),
        ];
        GpuError::check_lengths(LOSS_GRADIENT.name, lengths)?;
        let (colours, _) = image.as_chunks::<3>();
        let byte = |i: usize| if kept.is_none_or(|kept| kept[i]) { u8::MAX } else { 0 };
        let packed = |(i, [r, g, b]): (usize, &[u8; 3])| u32::from_le_bytes([*r, *g, *b, byte(i)]);
        let packed: Vec<u32> = colours.iter().enumerate().map(packed).collect();
        let counted = kept.map_or(pixels, |kept| kept.iter().filter(|kept| **kept).count());
        let truth = self.upload("a photograph", &packed)?;
        Ok(TargetPicture { truth, width, height, counted })
    }

    /// Returns the loss of rendered planes `[5, H, W]` and its gradient, of the same shape.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for planes of another size; errors of the device.
    pub fn picture_loss(
        &self,
        planes: &[f32],
        target: &TargetPicture,
        rules: &LossRules,
        weights: PixelWeights,
    ) -> Result<(PictureLoss, Vec<f32>), GpuError> {
        let numbers = PICTURE_CHANNELS * target.pixels();
        GpuError::check_lengths(LOSS_GRADIENT.name, [("planes", planes.len(), numbers)])?;
        let picture = self.upload("the picture", planes)?;
        let mut commands = self.commands("loss", false);
        let gradient = target.record_gradient(self, &mut commands, &picture, rules, weights)?;
        let loss = target.record_loss(self, &mut commands, &picture, rules, weights)?;
        let gradient = commands.read::<f32>(&gradient, numbers)?;
        commands.submit()?;
        Ok((loss.take(self)?, gradient.take(self)?))
    }
}

impl TargetPicture {
    fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Windows of SSIM along x and y; 0 where the picture is smaller than one.
    fn windows(&self) -> [usize; 2] {
        let [x, y] = [self.width, self.height].map(|side| (side + 1).saturating_sub(LOSS_TAPS));
        if x == 0 || y == 0 { [0; 2] } else { [x, y] }
    }

    fn uniform(&self, rules: &LossRules, weights: PixelWeights) -> LossUniform {
        let [x, y] = self.windows();
        // Masked pixels have no weight: the others have theirs.
        let scale = self.pixels() as f64 / self.counted.max(1) as f64;
        let mut taps = [[0.0; 4]; 3];
        taps.as_flattened_mut().iter_mut().zip(rules.window.taps).for_each(|(to, tap)| *to = tap);
        let of_windows = -0.5 * rules.dssim / (3 * x * y).max(1) as f64;
        LossUniform {
            width: self.width as u32,
            height: self.height as u32,
            windows_x: x as u32,
            windows_y: y as u32,
            covered: u32::from(weights == PixelWeights::Covered),
            dssim: u32::from(rules.dssim > 0.0 && x > 0),
            coverage_min: rules.coverage_min,
            squares_factor: (scale * 2.0 / (3 * self.pixels()).max(1) as f64) as f32,
            dssim_factor: (scale * of_windows) as f32,
            light_term: rules.window.c[0],
            structure_term: rules.window.c[1],
            covariance: rules.window.covariance,
            taps,
            ..LossUniform::default()
        }
    }

    /// Appends the gradient of the loss by `picture` `[5, H, W]`; returns it, of the same shape.
    pub(crate) fn record_gradient(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        picture: &Buffer,
        rules: &LossRules,
        weights: PixelWeights,
    ) -> Result<Buffer, GpuError> {
        let call = self.uniform(rules, weights);
        commands.stage("loss");
        let (maps, _) = self.record_windows(gpu, commands, picture, &call)?;
        let gradient =
            gpu.empty::<f32>("gradients of the picture", PICTURE_CHANNELS * self.pixels())?;
        let call = gpu.uniform(&call)?;
        let bindings = bind([&call, picture, &self.truth, &maps, &gradient]);
        let squares = 3 * self.width.div_ceil(SIDE) * self.height.div_ceil(SIDE);
        commands.run(&LOSS_GRADIENT, &[], &bindings, Groups::of(squares, 1))?;
        Ok(gradient)
    }

    /// Appends the loss of `picture` `[5, H, W]`, and its read-back.
    pub(crate) fn record_loss(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        picture: &Buffer,
        rules: &LossRules,
        weights: PixelWeights,
    ) -> Result<LossReading, GpuError> {
        let call = LossUniform { scores: 1, ..self.uniform(rules, weights) };
        commands.stage("loss");
        let (_, scores) = self.record_windows(gpu, commands, picture, &call)?;
        let groups = self.pixels().div_ceil(PIXELS);
        let sums = gpu.empty::<f32>("sums of the loss", SUMS * groups)?;
        let [x, y] = self.windows();
        let squares = 3 * x.div_ceil(SIDE) * y.div_ceil(SIDE);
        let scored = call.dssim != 0;
        let call = gpu.uniform(&call)?;
        let bindings = bind([&call, picture, &self.truth, &sums]);
        commands.run(&PICTURE_ERROR, &[], &bindings, Groups::of(groups, 1))?;
        Ok(LossReading {
            sums: commands.read(&sums, SUMS * groups)?,
            scores: if scored { Some(commands.read(&scores, squares)?) } else { None },
            windows: 3 * x * y,
            pixels: self.pixels(),
            counted: self.counted,
            dssim: rules.dssim,
        })
    }

    /// Appends SSIM of all windows where the loss has it. Returns its derivatives `[3, 3, h, w]`,
    /// and its sums, one of each workgroup.
    fn record_windows(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        picture: &Buffer,
        call: &LossUniform,
    ) -> Result<(Buffer, Buffer), GpuError> {
        let [x, y] = if call.dssim != 0 { self.windows() } else { [0; 2] };
        let squares = 3 * x.div_ceil(SIDE) * y.div_ceil(SIDE);
        let maps = gpu.empty::<f32>("derivatives of SSIM", 9 * x * y)?;
        let scores = gpu.empty::<f32>("sums of SSIM", squares)?;
        let call = gpu.uniform(call)?;
        let bindings = bind([&call, picture, &self.truth, &maps, &scores]);
        commands.run(&DSSIM_WINDOWS, &[], &bindings, Groups::of(squares, 1))?;
        Ok((maps, scores))
    }
}

impl LossReading {
    /// Waits for the device and returns the loss.
    pub(crate) fn take(self, gpu: &Gpu) -> Result<PictureLoss, GpuError> {
        let mut sums = [0.0f64; SUMS];
        for part in self.sums.take(gpu)?.chunks_exact(SUMS) {
            sums.iter_mut().zip(part).for_each(|(sum, v)| *sum += f64::from(*v));
        }
        let [weighted, weights, squares, _] = sums;
        let counted = self.counted.max(1) as f64;
        let mut value = squares / (3.0 * counted);
        if let Some(scores) = self.scores {
            let score: f64 = scores.take(gpu)?.into_iter().map(f64::from).sum();
            let scale = self.pixels as f64 / counted;
            value += scale * self.dssim * 0.5 * (1.0 - score / self.windows as f64);
        }
        let error = if weights > 0.0 { weighted / (3.0 * weights) } else { 0.0 };
        Ok(PictureLoss { value, error, covered: weights / counted })
    }
}
