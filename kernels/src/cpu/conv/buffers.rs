//! Working memory that each thread keeps between calls, so that calls do not request
//! megabytes of new pages from the operating system.

use crate::cpu::simd::LANES;
use std::cell::{Cell, RefCell};

/// Maximum floats of weight memory that a thread keeps. Longer blocks return to the
/// allocator, which keeps them in programs that use `subsplat_cli::pages`.
const MAX_KEPT_WEIGHTS: usize = 1 << 20;

thread_local! {
    static BUFFERS: RefCell<Buffers> = RefCell::default();
    static WEIGHTS: Cell<Vec<f32>> = Cell::default();
}

/// Takes this thread's memory for reordered or transformed weights. The memory holds
/// leftover numbers and may be empty.
pub(super) fn take_weight_memory() -> Vec<f32> {
    WEIGHTS.take()
}

/// Gives memory of [`take_weight_memory`] back to this thread.
pub(super) fn return_weight_memory(memory: Vec<f32>) {
    if memory.capacity() < MAX_KEPT_WEIGHTS {
        WEIGHTS.set(memory);
    }
}

/// Working memory of one job.
#[derive(Default)]
pub(super) struct Buffers {
    /// A packed tile.
    pub packed: Buffer,
    /// Sums before they are written, transposed gradients, or the weights of one block.
    pub scratch: Buffer,
    /// Transformed tiles of the source.
    pub tiles: Buffer,
    /// Transformed tiles of ∂L/∂y.
    pub gradients: Buffer,
    /// Products of transformed tiles.
    pub products: Buffer,
}

impl Buffers {
    /// Runs `f` with this thread's buffers. A nested call gets empty ones.
    pub fn with<R>(f: impl FnOnce(&mut Self) -> R) -> R {
        let mut own = BUFFERS.take();
        let result = f(&mut own);
        BUFFERS.set(own);
        result
    }
}

/// Sixteen floats that fill one cache line.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
struct CacheLine([f32; LANES]);

/// Floats that begin at a cache line, so that no aligned vector crosses two lines.
#[derive(Default)]
pub(super) struct Buffer(Vec<CacheLine>);

impl Buffer {
    /// Returns `n` floats. They hold the numbers of the last use.
    pub fn floats(&mut self, n: usize) -> &mut [f32] {
        if self.0.len() * LANES < n {
            self.0.resize(n.div_ceil(LANES), CacheLine::default());
        }
        let lines: &mut [CacheLine] = &mut self.0;
        let floats = lines.len() * LANES;
        // SAFETY: a `CacheLine` consists of 16 floats without padding.
        let all = unsafe { std::slice::from_raw_parts_mut(lines.as_mut_ptr().cast(), floats) };
        &mut all[..n]
    }
}
