//! Counts of the work of convolutions and matrix products, for rooflines of whole networks
//! (`cargo bench --bench network -- stages`).
//!
//! Each call counts the multiplications and additions of its definition, also where Winograd's
//! algorithm needs fewer, and its operands as if each were read or written once.

use std::sync::atomic::{AtomicU64, Ordering};

static FLOPS: AtomicU64 = AtomicU64::new(0);
static BYTES: AtomicU64 = AtomicU64::new(0);

/// Adds a call with `products` multiply-adds on `floats` operands.
pub(super) fn add(products: usize, floats: usize) {
    FLOPS.fetch_add(2 * products as u64, Ordering::Relaxed);
    BYTES.fetch_add(4 * floats as u64, Ordering::Relaxed);
}

/// Work of all calls of this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counts {
    /// Multiplications and additions.
    pub flops: u64,
    /// Bytes of operands.
    pub bytes: u64,
}

/// Returns the counts up to now.
pub fn counts() -> Counts {
    let [flops, bytes] = [&FLOPS, &BYTES].map(|count| count.load(Ordering::Relaxed));
    Counts { flops, bytes }
}
