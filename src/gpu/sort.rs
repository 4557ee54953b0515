//! A stable radix sort of 32-bit keys, 4 bits a pass: count, sum, scatter as dispatches of
//! their own, so that no workgroup waits for another. Equal keys keep their order.
//! Twin: src/cpu/sort.rs. Kernels: kernels/sort_count.wgsl, scan_whole.wgsl,
//! sort_scatter.wgsl.

use crate::abi::{GPU_BLOCK, PLAN_BLOCKS, PLAN_COUNT, PLAN_WORDS, SortUniform};
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::raster_kernels::{SCAN_WHOLE, SORT_COUNT, SORT_SCATTER};

/// Bits of a digit.
const DIGIT_BITS: u32 = 4;
/// Bytes from one uniform to the next in one buffer (WebGPU's alignment).
const UNIFORM_STRIDE: usize = 256;

/// What a sort works with. Keys and values change sides with every pass.
pub(crate) struct Sort {
    /// How many elements there are ([`plan_of`], or kernels/plan.wgsl).
    pub(crate) plan: Buffer,
    /// Workgroups of [`GPU_BLOCK`] elements.
    pub(crate) groups: Groups,
    pub(crate) keys: [Buffer; 2],
    pub(crate) values: [Buffer; 2],
    /// Values are their own places; `values[0]` need not be filled.
    pub(crate) fresh: bool,
    /// `[16, blocks]`, and one more.
    histogram: Buffer,
    /// One [`SortUniform`] per pass.
    passes: Buffer,
}

/// A plan of `count` elements, known beforehand.
pub(crate) fn plan_of(count: usize) -> [u32; PLAN_WORDS] {
    let mut plan = [0; PLAN_WORDS];
    plan[PLAN_COUNT] = count as u32;
    plan[PLAN_BLOCKS] = count.div_ceil(GPU_BLOCK) as u32;
    plan
}

impl Sort {
    /// Room to sort `room` elements.
    pub(crate) fn new(
        gpu: &Gpu,
        plan: Buffer,
        groups: Groups,
        room: usize,
        fresh: bool,
    ) -> Result<Self, GpuError> {
        let mut passes = [0u32; (u32::BITS / DIGIT_BITS) as usize * UNIFORM_STRIDE / 4];
        for (pass, words) in (0..).zip(passes.chunks_mut(UNIFORM_STRIDE / 4)) {
            let uniform = SortUniform { shift: pass * DIGIT_BITS, ..SortUniform::default() };
            let from: &[u32] = bytemuck::cast_slice(std::slice::from_ref(&uniform));
            for (to, from) in words.iter_mut().zip(from) {
                *to = *from;
            }
        }
        let array = |what| gpu.empty::<u32>(what, room);
        Ok(Self {
            plan,
            groups,
            keys: [array("sort keys")?, array("sort keys")?],
            values: [array("sort values")?, array("sort values")?],
            fresh,
            histogram: gpu.empty::<u32>("sort histogram", 16 * room.div_ceil(GPU_BLOCK) + 1)?,
            passes: gpu.upload("sort passes", &passes)?,
        })
    }

    /// Sorts by the lowest `bits` bits; the result is `keys[0]` and `values[0]`.
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
            let fresh = self.fresh && pass == 0;
            let constants = [("FRESH", f64::from(u8::from(fresh)))];
            // A fresh pass does not read the values.
            let values = if fresh { keys.clone() } else { values };
            let scatter = [uniform, plan, keys, values, histogram, keys_out, values_out];
            commands.run(&SORT_SCATTER, &constants, &scatter, self.groups.clone())?;
            self.keys.swap(0, 1);
            self.values.swap(0, 1);
        }
        Ok(())
    }
}

impl Gpu {
    /// Places of `keys` in ascending order, equal keys in their own order.
    ///
    /// # Errors
    /// More keys than a binding holds; anything the device refuses.
    pub fn sort_order(&self, keys: &[u32]) -> Result<Vec<u32>, GpuError> {
        let count = keys.len();
        let plan = self.upload("sort plan", &plan_of(count))?;
        let mut sort = Sort::new(self, plan, Groups::of(count, GPU_BLOCK), count, true)?;
        sort.keys[0] = self.upload("sort keys", keys)?;
        let mut commands = self.commands("sort", false);
        sort.record(&mut commands, u32::BITS)?;
        let reading = commands.read::<u32>(&sort.values[0], count)?;
        commands.submit()?;
        reading.take(self)
    }
}
