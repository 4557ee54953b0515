//! A list of kernel calls that is submitted at once and timed by stage.

use crate::gpu::buffers::{Binding, Buffer, Reading};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::Kernel;
use crate::gpu::pipelines::{Constants, Pipeline};
use bytemuck::Pod;
use std::marker::PhantomData;
use std::sync::Arc;
use std::time::Duration;

/// Number of workgroups of a dispatch.
#[derive(Clone, Debug)]
pub(crate) enum Groups {
    /// Counts along x, y and z.
    Of([u32; 3]),
    /// Three u32 of a buffer at this byte offset, written by an earlier kernel.
    Indirect(Buffer, u64),
}

impl Groups {
    /// Returns workgroups of `size` threads for at least `count` threads. Counts above the limit
    /// of one dimension (WebGPU: 65,535) are spread over x and y; kernels compute the index with
    /// `workgroup_number` of wgsl/shared/grid.wgsl.
    pub(crate) fn of(count: usize, size: usize) -> Self {
        Self::Of(spread(count.div_ceil(size.max(1))))
    }

    fn buffer(&self) -> Option<Binding> {
        match self {
            Self::Of(_) => None,
            Self::Indirect(buffer, _) => Some(Binding::from(buffer)),
        }
    }
}

/// Maximum number of workgroups along one dimension of a dispatch (WebGPU's default limit).
pub(crate) const GROUPS_MAX: usize = 65_535;

/// Divides `groups` workgroups into x × y, with fewer than y surplus workgroups.
fn spread(groups: usize) -> [u32; 3] {
    let y = groups.div_ceil(GROUPS_MAX).max(1);
    [groups.div_ceil(y) as u32, y as u32, 1]
}

/// Encodes commands that read the bindings.
type Draw = Box<dyn FnOnce(&mut wgpu::CommandEncoder, &[Binding]) + Send + Sync>;

enum Step {
    Stage(&'static str),
    Run { pipeline: Arc<Pipeline>, bindings: Vec<Binding>, groups: Groups },
    Clear(Buffer),
    Copy { from: Buffer, to: Buffer, bytes: u64 },
    Draw(Vec<Binding>, Draw),
}

/// Kernel calls in order; [`Commands::submit`] sends them to the device.
pub(crate) struct Commands<'g> {
    gpu: &'g Gpu,
    name: &'static str,
    timed: bool,
    steps: Vec<Step>,
}

/// Calls that [`Gpu::resume`] continues.
#[derive(Default)]
pub(crate) struct Pending(Vec<Step>);

impl Pending {
    /// Returns the number of calls.
    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }
}

/// Maximum number of timed passes in one submit.
const STAGES_MAX: u32 = 64;

impl Gpu {
    /// Creates an empty list of calls. With `timed`, each stage is timed where the device has
    /// timestamps.
    pub(crate) fn commands(&self, name: &'static str, timed: bool) -> Commands<'_> {
        let timed = timed && self.has_timestamps();
        Commands { gpu: self, name, timed, steps: Vec::new() }
    }

    /// Continues a list of calls.
    pub(crate) fn resume(&self, name: &'static str, pending: Pending) -> Commands<'_> {
        Commands { gpu: self, name, timed: false, steps: pending.0 }
    }
}

impl Commands<'_> {
    /// Returns the calls for a later [`Gpu::resume`].
    pub(crate) fn suspend(self) -> Pending {
        Pending(self.steps)
    }

    /// Times the following calls under `name`.
    pub(crate) fn stage(&mut self, name: &'static str) {
        self.steps.push(Step::Stage(name));
    }

    /// Appends a call of `kernel`.
    ///
    /// # Errors
    /// The kernel does not compile, has another number of arguments, or a count exceeds the
    /// dispatch limit.
    pub(crate) fn run(
        &mut self,
        kernel: &'static Kernel,
        constants: Constants,
        bindings: &[Binding],
        groups: Groups,
    ) -> Result<(), GpuError> {
        if let Groups::Of([x, y, z]) = groups
            && x.max(y).max(z) as usize > GROUPS_MAX
        {
            let needed = u64::from(x.max(y).max(z));
            let limit = GROUPS_MAX as u64;
            return Err(GpuError::TooSmall { resource: "a dispatch, workgroups", needed, limit });
        }
        let pipeline = self.gpu.pipeline(kernel, constants)?;
        if bindings.len() != pipeline.arguments {
            return Err(GpuError::Argument {
                kernel: kernel.name,
                argument: "arguments",
                expected: pipeline.arguments.to_string(),
                got: bindings.len().to_string(),
            });
        }
        self.steps.push(Step::Run { pipeline, bindings: bindings.to_vec(), groups });
        Ok(())
    }

    /// Appends a command that fills `buffer` with zeros.
    pub(crate) fn clear(&mut self, buffer: &Buffer) {
        self.steps.push(Step::Clear(buffer.clone()));
    }

    /// Appends a copy of the first `count` values of `buffer` to host-readable memory.
    ///
    /// # Errors
    /// Out of memory.
    pub(crate) fn read<T: Pod>(
        &mut self,
        buffer: &Buffer,
        count: usize,
    ) -> Result<Reading<T>, GpuError> {
        let bytes = (size_of::<T>() * count) as u64;
        let staging = self.gpu.staging(bytes)?;
        if count > 0 {
            let (from, to) = (buffer.clone(), staging.clone());
            self.steps.push(Step::Copy { from, to, bytes: bytes.next_multiple_of(4) });
        }
        Ok(Reading { staging, count, kind: PhantomData })
    }

    /// Appends other commands, such as a render pass, that read `bindings`.
    pub(crate) fn draw(
        &mut self,
        bindings: Vec<Binding>,
        f: impl FnOnce(&mut wgpu::CommandEncoder, &[Binding]) + Send + Sync + 'static,
    ) {
        self.steps.push(Step::Draw(bindings, Box::new(f)));
    }

    /// Submits all calls to the device at once, without waiting for them.
    ///
    /// # Errors
    /// Errors of the device, such as [`GpuError::Refused`] and [`GpuError::Lost`].
    pub(crate) fn submit(self) -> Result<Submitted, GpuError> {
        let Self { gpu, name, timed, steps } = self;
        gpu.checked(name, || {
            let mut clock = if timed { Some(Clock::new(gpu)?) } else { None };
            let label = Some(name);
            let mut encoder =
                gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label });
            let mut stage = name;
            // Buffers stay referenced until the submit. An upload that comes before the submit
            // could otherwise overwrite a buffer that has returned to the pool.
            let mut referenced: Vec<Binding> = Vec::new();
            let mut steps = steps.into_iter().peekable();
            while let Some(step) = steps.next() {
                match step {
                    Step::Stage(name) => stage = name,
                    Step::Clear(buffer) => {
                        encoder.clear_buffer(buffer.raw(), 0, None);
                        referenced.push(Binding::from(&buffer));
                    }
                    Step::Copy { from, to, bytes } => {
                        encoder.copy_buffer_to_buffer(from.raw(), 0, to.raw(), 0, bytes);
                        referenced.extend([&from, &to].map(Binding::from));
                    }
                    Step::Draw(bindings, draw) => {
                        draw(&mut encoder, &bindings);
                        referenced.extend(bindings);
                    }
                    Step::Run { pipeline, bindings, groups } => {
                        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                            label: Some(stage),
                            timestamp_writes: clock.as_mut().and_then(|c| c.next(stage)),
                        });
                        encode(gpu, &mut pass, &pipeline, &bindings, &groups);
                        referenced.extend(bindings);
                        referenced.extend(groups.buffer());
                        while let Some(Step::Run { .. }) = steps.peek() {
                            if let Some(Step::Run { pipeline, bindings, groups }) = steps.next() {
                                encode(gpu, &mut pass, &pipeline, &bindings, &groups);
                                referenced.extend(bindings);
                                referenced.extend(groups.buffer());
                            }
                        }
                    }
                }
            }
            let clock = clock.map(|c| c.finish(gpu, &mut encoder)).transpose()?;
            gpu.queue.submit([encoder.finish()]);
            drop(referenced);
            Ok(Submitted { clock })
        })
    }
}

fn encode(
    gpu: &Gpu,
    pass: &mut wgpu::ComputePass,
    pipeline: &Pipeline,
    bindings: &[Binding],
    groups: &Groups,
) {
    let entries: Vec<_> = (0..)
        .zip(bindings)
        .map(|(binding, b)| wgpu::BindGroupEntry { binding, resource: b.resource() })
        .collect();
    let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some(&pipeline.label),
        layout: &pipeline.layout,
        entries: &entries,
    });
    pass.set_pipeline(&pipeline.raw);
    pass.set_bind_group(0, &group, &[]);
    match groups {
        Groups::Of([0, ..] | [_, 0, _] | [_, _, 0]) => {}
        Groups::Of([x, y, z]) => pass.dispatch_workgroups(*x, *y, *z),
        Groups::Indirect(buffer, offset) => {
            pass.dispatch_workgroups_indirect(buffer.raw(), *offset);
        }
    }
}

/// Timestamp queries at the beginning and end of each pass.
struct Clock {
    queries: wgpu::QuerySet,
    stages: Vec<&'static str>,
}

impl Clock {
    fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("stages"),
            ty: wgpu::QueryType::Timestamp,
            count: 2 * STAGES_MAX,
        });
        Ok(Self { queries, stages: Vec::new() })
    }

    fn next(&mut self, stage: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let index = 2 * self.stages.len() as u32;
        if index >= 2 * STAGES_MAX {
            return None;
        }
        self.stages.push(stage);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(index),
            end_of_pass_write_index: Some(index + 1),
        })
    }

    fn finish(
        self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
    ) -> Result<(Vec<&'static str>, Reading<u64>), GpuError> {
        let count = 2 * self.stages.len();
        let bytes = 8 * count as u64;
        let staging = gpu.staging(bytes)?;
        if count > 0 {
            let resolved = gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: bytes,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            encoder.resolve_query_set(&self.queries, 0..count as u32, &resolved, 0);
            encoder.copy_buffer_to_buffer(&resolved, 0, staging.raw(), 0, bytes);
        }
        Ok((self.stages, Reading { staging, count, kind: PhantomData }))
    }
}

/// Calls that the device executes.
pub(crate) struct Submitted {
    clock: Option<(Vec<&'static str>, Reading<u64>)>,
}

impl Submitted {
    /// Waits and returns the time of each stage on the device, in order; empty for untimed
    /// commands.
    ///
    /// # Errors
    /// The device lost.
    pub(crate) fn times(self, gpu: &Gpu) -> Result<Vec<(&'static str, Duration)>, GpuError> {
        let Some((stages, reading)) = self.clock else { return Ok(Vec::new()) };
        let ticks = reading.take(gpu)?;
        let period = f64::from(gpu.queue.get_timestamp_period());
        let mut times: Vec<(&'static str, Duration)> = Vec::new();
        for (stage, pair) in stages.into_iter().zip(ticks.chunks_exact(2)) {
            let nanoseconds = pair[1].saturating_sub(pair[0]) as f64 * period;
            let time = Duration::from_nanos(nanoseconds as u64);
            match times.iter_mut().find(|(name, _)| *name == stage) {
                Some((_, sum)) => *sum += time,
                None => times.push((stage, time)),
            }
        }
        Ok(times)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workgroups_spread_over_two_dimensions() {
        for groups in [0, 1, 7, GROUPS_MAX, GROUPS_MAX + 1, 3 * GROUPS_MAX - 5, 1_000_000] {
            let [x, y, z] = spread(groups);
            assert!(x as usize <= GROUPS_MAX && y as usize <= GROUPS_MAX && z == 1);
            let all = x as usize * y as usize;
            assert!(all >= groups && all < groups + y as usize, "{groups}: {x} x {y}");
        }
    }
}
