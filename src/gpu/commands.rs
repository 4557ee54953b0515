//! A list of kernel calls that goes to the device in one submit, timed by stage.

use crate::gpu::buffers::{Binding, Buffer, Reading};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Constants, Kernel, Pipeline};
use bytemuck::Pod;
use std::marker::PhantomData;
use std::sync::Arc;
use std::time::Duration;

/// How many workgroups a call takes.
#[derive(Clone, Debug)]
pub(crate) enum Groups {
    /// Along x, y and z.
    Of([u32; 3]),
    /// Three u32 of a buffer, at this byte: a kernel before it says how many.
    Indirect(Buffer, u64),
}

impl Groups {
    /// Enough workgroups of `size` threads for `count` threads, spread over x and y where
    /// one dimension does not hold them (WebGPU: 65,535); kernels number them with
    /// `workgroup_number` of kernels/shared/grid.wgsl.
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

/// Most workgroups along one dimension of a dispatch (WebGPU's default limit).
pub(crate) const GROUPS_MAX: usize = 65_535;

/// `groups` workgroups as x × y, with as few to spare as whole rows allow.
fn spread(groups: usize) -> [u32; 3] {
    let y = groups.div_ceil(GROUPS_MAX).max(1);
    [groups.div_ceil(y) as u32, y as u32, 1]
}

/// Encodes something that reads these.
type Draw = Box<dyn FnOnce(&mut wgpu::CommandEncoder, &[Binding])>;

enum Step {
    Stage(&'static str),
    Run { pipeline: Arc<Pipeline>, bindings: Vec<Binding>, groups: Groups },
    Clear(Buffer),
    Copy { from: Buffer, to: Buffer, bytes: u64 },
    Draw(Vec<Binding>, Draw),
}

/// Kernel calls in order; nothing reaches the device before [`Commands::submit`].
pub(crate) struct Commands<'g> {
    gpu: &'g Gpu,
    name: &'static str,
    timed: bool,
    steps: Vec<Step>,
}

/// Stages whose time is taken, in one submit.
const STAGES_MAX: u32 = 64;

impl Gpu {
    /// An empty list of calls; with `timed`, each stage's time is taken where the device
    /// has timestamps.
    pub(crate) fn commands(&self, name: &'static str, timed: bool) -> Commands<'_> {
        let timed = timed && self.has_timestamps();
        Commands { gpu: self, name, timed, steps: Vec::new() }
    }
}

impl Commands<'_> {
    /// What follows is timed under `name`.
    pub(crate) fn stage(&mut self, name: &'static str) {
        self.steps.push(Step::Stage(name));
    }

    /// Calls `kernel`.
    ///
    /// # Errors
    /// The kernel does not compile, or takes another number of arguments; an argument is
    /// above the binding limit.
    pub(crate) fn run(
        &mut self,
        kernel: &'static Kernel,
        constants: Constants,
        bindings: &[Binding],
        groups: Groups,
    ) -> Result<(), GpuError> {
        if bindings.len() != kernel.bindings.len() {
            return Err(GpuError::Argument {
                kernel: kernel.name,
                what: "arguments",
                expected: kernel.bindings.len().to_string(),
                got: bindings.len().to_string(),
            });
        }
        if let Groups::Of([x, y, z]) = groups
            && x.max(y).max(z) as usize > GROUPS_MAX
        {
            let (needed, limit) = (u64::from(x.max(y).max(z)), GROUPS_MAX as u64);
            return Err(GpuError::TooSmall { what: "a dispatch, workgroups", needed, limit });
        }
        let pipeline = self.gpu.pipeline(kernel, constants)?;
        self.steps.push(Step::Run { pipeline, bindings: bindings.to_vec(), groups });
        Ok(())
    }

    /// Fills `buffer` with zeros.
    pub(crate) fn clear(&mut self, buffer: &Buffer) {
        self.steps.push(Step::Clear(buffer.clone()));
    }

    /// The first `count` values of `buffer`, as they are at this point.
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

    /// Something else than a kernel call, a render pass say, that reads `bindings`.
    pub(crate) fn draw(
        &mut self,
        bindings: Vec<Binding>,
        f: impl FnOnce(&mut wgpu::CommandEncoder, &[Binding]) + 'static,
    ) {
        self.steps.push(Step::Draw(bindings, Box::new(f)));
    }

    /// Hands all to the device in one submit, and does not wait for it.
    ///
    /// # Errors
    /// What the device refuses; the device lost.
    pub(crate) fn submit(self) -> Result<Submitted, GpuError> {
        let Self { gpu, name, timed, steps } = self;
        gpu.checked(name, || {
            let mut clock = if timed { Some(Clock::new(gpu)?) } else { None };
            let label = Some(name);
            let mut encoder =
                gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label });
            let mut stage = name;
            // Held until the submit: a buffer that went back to the pool earlier could be
            // overwritten by an upload that comes before it.
            let mut held: Vec<Binding> = Vec::new();
            let mut steps = steps.into_iter().peekable();
            while let Some(step) = steps.next() {
                match step {
                    Step::Stage(name) => stage = name,
                    Step::Clear(buffer) => {
                        encoder.clear_buffer(buffer.raw(), 0, None);
                        held.push(Binding::from(&buffer));
                    }
                    Step::Copy { from, to, bytes } => {
                        encoder.copy_buffer_to_buffer(from.raw(), 0, to.raw(), 0, bytes);
                        held.extend([&from, &to].map(Binding::from));
                    }
                    Step::Draw(bindings, draw) => {
                        draw(&mut encoder, &bindings);
                        held.extend(bindings);
                    }
                    Step::Run { pipeline, bindings, groups } => {
                        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                            label: Some(stage),
                            timestamp_writes: clock.as_mut().and_then(|c| c.next(stage)),
                        });
                        encode(gpu, &mut pass, &pipeline, &bindings, &groups);
                        held.extend(bindings);
                        held.extend(groups.buffer());
                        while let Some(Step::Run { .. }) = steps.peek() {
                            if let Some(Step::Run { pipeline, bindings, groups }) = steps.next() {
                                encode(gpu, &mut pass, &pipeline, &bindings, &groups);
                                held.extend(bindings);
                                held.extend(groups.buffer());
                            }
                        }
                    }
                }
            }
            let clock = clock.map(|c| c.finish(gpu, &mut encoder)).transpose()?;
            gpu.queue.submit([encoder.finish()]);
            drop(held);
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

/// Timestamps at the beginning and end of each pass.
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
        let place = 2 * self.stages.len() as u32;
        if place >= 2 * STAGES_MAX {
            return None;
        }
        self.stages.push(stage);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(place),
            end_of_pass_write_index: Some(place + 1),
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

/// Calls that are with the device.
pub(crate) struct Submitted {
    clock: Option<(Vec<&'static str>, Reading<u64>)>,
}

impl Submitted {
    /// Time on the device by stage, in order; empty where it was not taken. Waits.
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
