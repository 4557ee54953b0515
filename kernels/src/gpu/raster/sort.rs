//! A stable radix sort of 32-bit keys, 4 bits per pass.
//!
//! Splats are sorted by depth, then their (splat, tile) pairs by tile. Both sorts are stable, so the order is the CPU's.
//!
//! Counting, prefix sum and scatter are separate dispatches, so that no workgroup waits for
//! another. CPU version: cpu/raster/sort.rs. WGSL: wgsl/raster/sort_count.wgsl, wgsl/raster/scan_whole.wgsl,
//! wgsl/raster/sort_scatter.wgsl. Tests: tests/gpu/raster.rs.

use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster::constants::{GPU_BLOCK, PLAN_BLOCKS, PLAN_COUNT, PLAN_WORDS};
use crate::gpu::raster::kernels::{SCAN_WHOLE, SORT_COUNT, SORT_SCATTER};
use crate::gpu::uniforms::SortUniform;

/// Bits of a digit.
const DIGIT_BITS: u32 = 4;
/// Distance of uniforms in one buffer, bytes (WebGPU's alignment).
const UNIFORM_STRIDE: usize = 256;

/// Buffers of a sort. Every pass swaps the input and output buffers of keys and values. The
/// initial values are the indices 0, 1, …
pub(crate) struct Sort {
    /// Number of elements ([`plan_of`], or wgsl/raster/plan.wgsl).
    pub(crate) plan: Buffer,
    /// Workgroups of [`GPU_BLOCK`] elements.
    pub(crate) groups: Groups,
    pub(crate) keys: [Buffer; 2],
    pub(crate) values: [Buffer; 2],
    /// `[16, blocks]`, and the total.
    histogram: Buffer,
    /// One [`SortUniform`] per pass.
    passes: Buffer,
}

/// Returns the plan of `count` elements.
pub(crate) fn plan_of(count: usize) -> [u32; PLAN_WORDS] {
    let mut plan = [0; PLAN_WORDS];
    plan[PLAN_COUNT] = count as u32;
    plan[PLAN_BLOCKS] = count.div_ceil(GPU_BLOCK) as u32;
    plan
}

impl Sort {
    /// Allocates the buffers to sort at most `capacity` elements.
    pub(crate) fn new(
        gpu: &Gpu,
        plan: Buffer,
        groups: Groups,
        capacity: usize,
    ) -> Result<Self, GpuError> {
        let mut passes = [0u32; (u32::BITS / DIGIT_BITS) as usize * UNIFORM_STRIDE / 4];
        for (pass, words) in (0..).zip(passes.chunks_mut(UNIFORM_STRIDE / 4)) {
            let uniform = SortUniform { shift: pass * DIGIT_BITS, ..SortUniform::default() };
            let from: &[u32] = bytemuck::cast_slice(std::slice::from_ref(&uniform));
            for (to, from) in words.iter_mut().zip(from) {
                *to = *from;
            }
        }
        let array = |label| gpu.empty::<u32>(label, capacity);
        Ok(Self {
            plan,
            groups,
            keys: [array("sort keys")?, array("sort keys")?],
            values: [array("sort values")?, array("sort values")?],
            histogram: gpu.empty::<u32>("sort histogram", 16 * capacity.div_ceil(GPU_BLOCK) + 1)?,
            passes: gpu.upload("sort passes", &passes)?,
        })
    }

    /// Appends a sort by the lowest `bits` bits; the result is in `keys[0]` and `values[0]`.
    pub(crate) fn record(&mut self, commands: &mut Commands, bits: u32) -> Result<(), GpuError> {
        for pass in 0..bits.div_ceil(DIGIT_BITS) {
            let at = u64::from(pass) * UNIFORM_STRIDE as u64;
            let uniform = self.passes.part(at..at + size_of::<SortUniform>() as u64);
            let plan = Binding::from(&self.plan);
            let histogram = Binding::from(&self.histogram);
            let [keys, keys_out] = [0, 1].map(|i| Binding::from(&self.keys[i]));
            let [values, values_out] = [0, 1].map(|i| Binding::from(&self.values[i]));
            let count = [uniform.clone(), plan.clone(), keys.clone(), histogram.clone()];
            commands.run(&SORT_COUNT, &[], &count, self.groups.clone())?;
            let sums = [plan.clone(), histogram.clone()];
            commands.run(&SCAN_WHOLE, &[("PER_BLOCK", 16.0)], &sums, Groups::Of([1; 3]))?;
            let identity = pass == 0;
            let constants = [("IDENTITY_VALUES", f64::from(u8::from(identity)))];
            // The first pass does not read the values.
            let values = if identity { keys.clone() } else { values };
            let scatter = [uniform, plan, keys, values, histogram, keys_out, values_out];
            commands.run(&SORT_SCATTER, &constants, &scatter, self.groups.clone())?;
            self.keys.swap(0, 1);
            self.values.swap(0, 1);
        }
        Ok(())
    }
}

impl Gpu {
    /// Returns the indices of `keys` in ascending order; equal keys keep their order.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] for more keys than a binding holds; errors of the device.
    pub fn sort_order(&self, keys: &[u32]) -> Result<Vec<u32>, GpuError> {
        let count = keys.len();
        let plan = self.upload("sort plan", &plan_of(count))?;
        let mut sort = Sort::new(self, plan, Groups::of(count, GPU_BLOCK), count)?;
        sort.keys[0] = self.upload("sort keys", keys)?;
        let mut commands = self.commands("sort", false);
        sort.record(&mut commands, u32::BITS)?;
        let reading = commands.read::<u32>(&sort.values[0], count)?;
        commands.submit()?;
        reading.take(self)
    }
}
