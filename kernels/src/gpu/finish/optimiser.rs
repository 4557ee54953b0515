//! Gaussians under optimisation in device memory: the parameters that move, with Adam's moments,
//! and the numbers that follow from them.
//!
//! Elements lie side by side by Gaussian, `[E, N]`, so that neighbouring threads read neighbouring
//! words. A Gaussian with all parameters of a refinement without SH takes 56 bytes of gradients, 56
//! of values, 112 of moments, 60 of the numbers before, and its row twice.
//!
//! CPU version: [`crate::cpu::parameters`], [`crate::cpu::adam::SelectiveAdam`]; the optimiser of
//! the crate `subsplat` joins them. WGSL: wgsl/finish. Tests: src/finish/optimiser/tests.rs of the
//! crate `subsplat`.

use crate::gpu::buffers::{Binding, Buffer, Reading};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::raster::frame::{THREADS, bind};
use crate::gpu::raster::rasterize_bwd::PartGradients;
use crate::gpu::raster::scene::Scene;
use crate::gpu::uniforms::OptimiseUniform;
use crate::layout::parameters::Buffer::{Gain, Rows, Sh};
use crate::layout::parameters::{Form, GAIN_STRIDE, Move};
use crate::layout::{Geometry, Gradients, SPLAT_STRIDE, SplatSlices, sh_coefficients};
use std::ops::Range;

pub(crate) static DRAWN_ROWS: Kernel = Kernel {
    name: "drawn_rows",
    entry: "main",
    source: wgsl!(
        OptimiseUniform; "shared/grid", "shared/wide", "shared/parameters", "finish/drawn_rows"
    ),
};

pub(crate) static WATCH_PAIRS: Kernel =
    Kernel { name: "watch_pairs", entry: "main", source: wgsl!("finish/watch_pairs") };

pub(crate) static PARAMETER_GRADIENTS: Kernel = Kernel {
    name: "parameter_gradients",
    entry: "main",
    source: wgsl!(
        OptimiseUniform; "shared/grid", "shared/finite", "shared/wide", "shared/parameters",
        "finish/parameter_gradients"
    ),
};

pub(crate) static OPTIMISE: Kernel = Kernel {
    name: "optimise",
    entry: "main",
    source: wgsl!(
        OptimiseUniform; "shared/grid", "shared/wide", "shared/parameters", "finish/optimise"
    ),
};

/// Values of [`OptimiseUniform::range`].
pub(crate) const RANGE_INSIDE: u32 = 1;
pub(crate) const RANGE_OUTSIDE: u32 = 2;
/// Parameters of one call at most ([`OptimiseUniform::parameters`]).
pub(crate) const PARAMETERS_MAX: usize = 8;
/// Planes of the origin before the numbers: size of a pixel, and whether only the colours move.
const ORIGIN_FIRST: usize = 2;

/// Gaussians that an optimisation moves, and how.
#[derive(Clone, Copy, Debug)]
pub struct OptimisedSplats<'a> {
    /// The Gaussians before the first step: packed rows, and gains `[N, 4]`.
    pub splats: SplatSlices<'a>,
    /// Rows of the Gaussians that the values change, `[N, 11]`.
    pub origin_rows: &'a [f32],
    /// `[N]`: size of a pixel at each Gaussian, world units; empty where no mean moves.
    pub pixels: &'a [f32],
    /// `[N]` or empty: Gaussians of which only the colour offsets move.
    pub spared: &'a [bool],
    /// Factor of σ at the start.
    pub scale: f32,
    /// Parameters that move.
    pub moves: &'a [Move],
    /// Every Gaussian moves in a step, not only those with a gradient.
    pub all_move: bool,
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// Term added to the root of the second moment.
    pub epsilon: f32,
}

/// Gaussians that a step leaves out, by a hash of both.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LeftOut {
    /// Number of the step.
    pub step: u32,
    /// Gaussians with hashes below this are left out.
    pub limit: u32,
    /// Factor of the others' optical depth.
    pub denser: f32,
}

/// Gaussians that a picture is drawn from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Drawn {
    All,
    Without(LeftOut),
    Inside(Range<usize>),
    Outside(Range<usize>),
}

/// Constants of Adam's step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Factor of all rates.
    pub factor: f32,
    /// Bias corrections, divisors of the moments: 1 − βⁿ after n steps.
    pub corrections: [f32; 2],
}

/// Gradients of the loss of a photograph, in host memory.
#[derive(Clone, Copy, Debug)]
pub struct GivenGradients<'a> {
    /// By packed rows, gains `[N, 4]`, and SH sets `[N, D, 3]` where these move.
    pub all: &'a Gradients,
    /// By the rows of the picture across, with its weight.
    pub across: Option<(&'a Gradients, f32)>,
    /// Gaussians that the picture was not drawn from.
    pub left_out: Option<LeftOut>,
}

impl Gpu {
    /// Takes steps with given gradients, which are added for the photographs of a step. Returns
    /// rows, gains, and SH coefficients where these move.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] where an array exceeds a binding; [`GpuError::Argument`] for lengths
    /// that do not fit; errors of the device.
    pub fn optimise(
        &self,
        splats: &OptimisedSplats,
        steps: &[(Vec<GivenGradients>, Rates)],
    ) -> Result<[Vec<f32>; 3], GpuError> {
        let optimiser = Optimiser::new(self, splats)?;
        let rows = SPLAT_STRIDE * optimiser.n();
        for (photographs, rates) in steps {
            let mut commands = self.commands("refinement", false);
            for (i, given) in photographs.iter().enumerate() {
                let lengths = [
                    ("gradients", given.all.rows.len(), rows),
                    ("gradients across", given.across.map_or(rows, |(g, _)| g.rows.len()), rows),
                ];
                GpuError::check_lengths(PARAMETER_GRADIENTS.name, lengths)?;
                let all = PartGradients::upload(self, given.all)?;
                let across = match given.across {
                    Some((gradients, weight)) => {
                        Some((PartGradients::upload(self, gradients)?, weight))
                    }
                    None => None,
                };
                let across = across.as_ref().map(|(g, weight)| (g, *weight));
                let drawn = given.left_out.map_or(Drawn::All, Drawn::Without);
                optimiser.record_gradients(self, &mut commands, &drawn, &all, across, i > 0)?;
            }
            optimiser.record_step(self, &mut commands, *rates)?;
            commands.submit()?;
        }
        let mut commands = self.commands("refinement", false);
        let numbers = optimiser.read(&mut commands)?;
        commands.submit()?;
        numbers.take(self)
    }
}

/// State of the optimisation in device memory.
pub(crate) struct Optimiser {
    uniform: OptimiseUniform,
    /// Rates of the parameters, with their limits.
    rates: [[f32; 4]; PARAMETERS_MAX],
    pub(crate) scene: Scene,
    rows: Buffer,
    sh: Buffer,
    gain: Buffer,
    origin: Buffer,
    /// `[E, N]`.
    gradient: Buffer,
    /// `[E, N]`.
    values: Buffer,
    /// `[2, E, N]`.
    moments: Buffer,
    /// `[1]`: wgsl/finish/watch_pairs.wgsl.
    pub(crate) status: Buffer,
}

/// Pending read-back of the Gaussians' numbers.
pub(crate) struct NumbersReading {
    rows: Reading<f32>,
    gain: Reading<f32>,
    sh: Reading<f32>,
}

impl Optimiser {
    /// Copies the Gaussians to the device. Values and moments are those before the first step.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] where an array exceeds a binding; [`GpuError::Argument`] for lengths
    /// that do not fit or more parameters than [`PARAMETERS_MAX`]; errors of the device.
    pub(crate) fn new(gpu: &Gpu, splats: &OptimisedSplats) -> Result<Self, GpuError> {
        let OptimisedSplats { moves, pixels, spared, .. } = *splats;
        let SplatSlices { geometry, gain, .. } = splats.splats;
        let Geometry::Packed(rows) = geometry else {
            return Err(misfit("splats", "packed rows", "other geometry"));
        };
        let n = splats.splats.len();
        let optional = |length| if length == 0 { 0 } else { n };
        GpuError::check_lengths(
            OPTIMISE.name,
            [
                ("rows", splats.origin_rows.len(), SPLAT_STRIDE * n),
                ("gains", gain.len(), GAIN_STRIDE * n),
                ("sizes of pixels", pixels.len(), optional(pixels.len())),
                ("spared Gaussians", spared.len(), optional(spared.len())),
            ],
        )?;
        if moves.len() > PARAMETERS_MAX {
            return Err(misfit("parameters", PARAMETERS_MAX, moves.len()));
        }
        let scene = gpu.upload_splats(&splats.splats)?;
        let [part] = &scene.parts[..] else {
            let resource = "splats of a step";
            return Err(GpuError::TooSmall {
                resource,
                needed: scene.parts.len() as u64,
                limit: 1,
            });
        };
        let [rows_on_device, sh_on_device, gain_on_device] =
            [&part.rows, &part.sh, &part.gain].map(|part| part.buffer.clone());
        let (uniform, rates, origin) = Self::tables(splats);
        let elements = uniform.elements as usize;
        let empty = |label, floats| gpu.empty::<f32>(label, floats);
        let new = Self {
            uniform,
            rates,
            rows: rows_on_device,
            sh: sh_on_device,
            gain: gain_on_device,
            origin: gpu.upload("numbers before", &origin)?,
            gradient: empty("gradients by the parameters", elements * n)?,
            values: gpu.upload("values", &first_values(moves, rows, elements))?,
            moments: empty("moments", 2 * elements * n)?,
            status: empty("status", 1)?,
            scene,
        };
        let mut commands = gpu.commands("refinement", false);
        commands.clear(&new.moments);
        commands.clear(&new.status);
        commands.submit()?;
        Ok(new)
    }

    /// The uniform of all calls, the parameters' rates, and the origin.
    fn tables(splats: &OptimisedSplats) -> (OptimiseUniform, [[f32; 4]; PARAMETERS_MAX], Vec<f32>) {
        let n = splats.splats.len();
        let SplatSlices { sh, gain, sh_degree, .. } = splats.splats;
        let sh_stride = 3 * sh_coefficients(sh_degree);
        let mut origin = vec![0.0; ORIGIN_FIRST * n];
        origin.iter_mut().zip(splats.pixels).for_each(|(to, pixel)| *to = *pixel);
        let spared = origin[n..].iter_mut().zip(splats.spared);
        spared.for_each(|(to, spared)| *to = f32::from(u8::from(*spared)));
        let mut uniform = OptimiseUniform {
            count: n as u32,
            moves: splats.moves.len() as u32,
            sh_stride: sh_stride as u32,
            all_move: u32::from(splats.all_move),
            scale: splats.scale,
            first_decay: splats.betas[0],
            second_decay: splats.betas[1],
            epsilon: splats.epsilon,
            ..OptimiseUniform::default()
        };
        let mut rates = [[0.0; 4]; PARAMETERS_MAX];
        for (m, Move { parameter, rate, limits }) in splats.moves.iter().enumerate() {
            let plane = (origin.len() / n.max(1)) as u32;
            uniform.elements += parameter.elements() as u32;
            uniform.parameters[m] =
                [parameter.buffer as u32, parameter.first as u32, parameter.form as u32, plane];
            let [least, largest] = limits.unwrap_or([f32::MIN, f32::MAX]);
            rates[m] = [*rate, least, largest, 0.0];
            let (numbers, stride) = match parameter.buffer {
                Rows => (splats.origin_rows, SPLAT_STRIDE),
                Gain => (gain, GAIN_STRIDE),
                Sh => (sh, sh_stride),
            };
            // A logit needs no number from before.
            let count = if parameter.form == Form::Logit { 0 } else { parameter.numbers() };
            for number in parameter.first..parameter.first + count {
                origin.extend(numbers[number..].iter().step_by(stride));
            }
        }
        (uniform, rates, origin)
    }

    fn n(&self) -> usize {
        self.scene.len
    }

    /// The uniform of a call about the Gaussians of a picture.
    fn uniform_of(&self, drawn: &Drawn) -> OptimiseUniform {
        let ranged = |range: u32, of: &Range<usize>| {
            let (first, past) = (of.start as u32, of.end as u32);
            OptimiseUniform { range, first, past, ..self.uniform }
        };
        match drawn {
            Drawn::All => self.uniform,
            Drawn::Without(LeftOut { step, limit, denser }) => {
                OptimiseUniform { step: *step, limit: *limit, denser: *denser, ..self.uniform }
            }
            Drawn::Inside(of) => ranged(RANGE_INSIDE, of),
            Drawn::Outside(of) => ranged(RANGE_OUTSIDE, of),
        }
    }

    /// The scene of the Gaussians `drawn`. Appends the call that makes its rows.
    pub(crate) fn record_scene(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        drawn: &Drawn,
    ) -> Result<Scene, GpuError> {
        let mut scene = self.scene.clone();
        if *drawn == Drawn::All {
            return Ok(scene);
        }
        let rows = gpu.empty::<f32>("drawn splats", SPLAT_STRIDE * self.n())?;
        let call = gpu.uniform(&self.uniform_of(drawn))?;
        let bindings = bind([&call, &self.rows, &rows]);
        commands.run(&DRAWN_ROWS, &[], &bindings, Groups::of(self.n(), THREADS))?;
        scene.parts.iter_mut().for_each(|part| part.rows = Binding::from(&rows));
        Ok(scene)
    }

    /// Appends the note of a frame with more pairs than its buffers hold.
    pub(crate) fn watch(&self, commands: &mut Commands, plan: &Buffer) -> Result<(), GpuError> {
        commands.run(&WATCH_PAIRS, &[], &bind([plan, &self.status]), Groups::Of([1; 3]))
    }

    /// Appends the gradients of a photograph by the parameters, from those by its Gaussians
    /// `drawn`, and by those of the picture across with their weight. With `adds` they are added to
    /// those before.
    pub(crate) fn record_gradients(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        drawn: &Drawn,
        all: &PartGradients,
        across: Option<(&PartGradients, f32)>,
        adds: bool,
    ) -> Result<(), GpuError> {
        let call = OptimiseUniform {
            adds: u32::from(adds),
            across: across.map_or(0.0, |(_, weight)| weight),
            ..self.uniform_of(drawn)
        };
        let call = gpu.uniform(&call)?;
        let d_across = across.map_or(&all.rows, |(across, _)| &across.rows);
        let bindings = bind([
            &call,
            &self.rows,
            &all.rows,
            &all.sh,
            &all.gain,
            d_across,
            &self.origin,
            &self.gradient,
        ]);
        commands.stage("gradients by the parameters");
        commands.run(&PARAMETER_GRADIENTS, &[], &bindings, Groups::of(self.n(), THREADS))
    }

    /// Appends Adam's step with the gradients so far.
    pub(crate) fn record_step(
        &self,
        gpu: &Gpu,
        commands: &mut Commands,
        Rates { factor, corrections }: Rates,
    ) -> Result<(), GpuError> {
        let call = OptimiseUniform {
            rates: self.rates.map(|[rate, least, largest, _]| [factor * rate, least, largest, 0.0]),
            first_correction: corrections[0],
            second_correction: corrections[1],
            ..self.uniform
        };
        let call = gpu.uniform(&call)?;
        let bindings = bind([
            &call,
            &self.status,
            &self.gradient,
            &self.origin,
            &self.values,
            &self.moments,
            &self.rows,
            &self.gain,
            &self.sh,
        ]);
        commands.stage("Adam");
        commands.run(&OPTIMISE, &[], &bindings, Groups::of(self.n(), THREADS))
    }

    /// Appends the read-back of the Gaussians' numbers; `sh` only where it can have moved.
    pub(crate) fn read(&self, commands: &mut Commands) -> Result<NumbersReading, GpuError> {
        let moves = &self.uniform.parameters[..self.uniform.moves as usize];
        let sets = if moves.iter().any(|p| p[0] == Sh as u32) { self.n() } else { 0 };
        Ok(NumbersReading {
            rows: commands.read(&self.rows, SPLAT_STRIDE * self.n())?,
            gain: commands.read(&self.gain, GAIN_STRIDE * self.n())?,
            sh: commands.read(&self.sh, self.uniform.sh_stride as usize * sets)?,
        })
    }
}

impl NumbersReading {
    /// Waits for the device and returns rows, gains, and SH coefficients where these move.
    pub(crate) fn take(self, gpu: &Gpu) -> Result<[Vec<f32>; 3], GpuError> {
        Ok([self.rows.take(gpu)?, self.gain.take(gpu)?, self.sh.take(gpu)?])
    }
}

/// Values before the first step, `[E, N]`: 0, or the logit of a number of `rows`.
fn first_values(moves: &[Move], rows: &[f32], elements: usize) -> Vec<f32> {
    let n = rows.len() / SPLAT_STRIDE;
    let mut values = vec![0.0; elements * n];
    let mut at = 0;
    for Move { parameter, .. } in moves {
        if parameter.form == Form::Logit {
            let numbers = rows[parameter.first..].iter().step_by(SPLAT_STRIDE);
            let to = values[at * n..].iter_mut().zip(numbers);
            to.for_each(|(to, number)| *to = parameter.form.first_value(*number));
        }
        at += parameter.elements();
    }
    values
}

fn misfit(
    argument: &'static str,
    expected: impl std::fmt::Display,
    got: impl std::fmt::Display,
) -> GpuError {
    let (expected, got) = (expected.to_string(), got.to_string());
    GpuError::Argument { kernel: OPTIMISE.name, argument, expected, got }
}
