//! Lists of the entries of each cell, so that gradients of cells are sums in a fixed order.
//!
//! The CPU kernels use counting sorts and blocks instead ([`crate::cpu::plane_sweep`],
//! [`crate::cpu::attention_gather`]). WGSL: wgsl/network/invert.wgsl.

use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::InvertUniform;

const fn entry(entry: &'static str) -> Kernel {
    Kernel { name: "invert", entry, source: wgsl!(InvertUniform; "shared/grid", "network/invert") }
}

pub(crate) static COUNT: Kernel = entry("count");
pub(crate) static SCAN: Kernel = entry("scan");
pub(crate) static FILL: Kernel = entry("fill");
pub(crate) static ORDER: Kernel = entry("order");

/// Index of no cell, in the lists.
pub(crate) const NONE: u32 = u32::MAX;
/// Threads of a workgroup of `count` and `fill`.
const THREADS: usize = 64;

/// Arrays `starts` `[cells + 1]` and `list`. The entries of cell c, in ascending order, are
/// `list[starts[c]..starts[c + 1]]`.
pub(crate) struct Lists {
    pub(crate) starts: Buffer,
    pub(crate) list: Buffer,
}

impl Gpu {
    /// Appends the construction of the lists of `cells_of` `[entries]`. Each element is below
    /// `cells` or [`NONE`].
    ///
    /// # Errors
    /// Errors of the device.
    pub(crate) fn invert(
        &self,
        commands: &mut Commands,
        cells_of: &Buffer,
        entries: usize,
        cells: usize,
    ) -> Result<Lists, GpuError> {
        let uniform =
            InvertUniform { entries: entries as u32, cells: cells as u32, ..Default::default() };
        let uniform = self.uniform(&uniform)?;
        let starts = self.empty::<u32>("starts of lists", cells + 1)?;
        let cursors = self.empty::<u32>("ends of lists", cells)?;
        let list = self.empty::<u32>("lists", entries)?;
        let bindings = [&uniform, cells_of, &starts, &cursors, &list].map(Binding::from);
        commands.clear(&starts);
        commands.run(&COUNT, &[], &bindings, Groups::of(entries, THREADS))?;
        commands.run(&SCAN, &[], &bindings, Groups::of(1, 1))?;
        commands.run(&FILL, &[], &bindings, Groups::of(entries, THREADS))?;
        commands.run(&ORDER, &[], &bindings, Groups::of(cells, 1))?;
        Ok(Lists { starts, list })
    }
}
