//! Lists of the entries that fall on each cell, so that gradients of cells are sums in a
//! fixed order: what [`crate::cpu::plane_sweep`] and [`crate::cpu::attention_gather`] do
//! by counting sorts and blocks. Kernel: kernels/invert.wgsl.

use crate::abi::InvertUniform;
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::{Access, Kernel, wgsl};

const fn entry(entry: &'static str) -> Kernel {
    Kernel {
        name: "invert",
        entry,
        source: wgsl!("shared/abi", "shared/grid", "invert"),
        bindings: &[Access::Uniform, Access::Read, Access::Write, Access::Write, Access::Write],
    }
}

pub(crate) static COUNT: Kernel = entry("count");
pub(crate) static SCAN: Kernel = entry("scan");
pub(crate) static FILL: Kernel = entry("fill");
pub(crate) static ORDER: Kernel = entry("order");

/// Threads of a workgroup of `count` and `fill`.
const THREADS: usize = 64;

/// `starts` `[cells + 1]` and `list`: entries of cell c, in order, are
/// `list[starts[c]..starts[c + 1]]`.
pub(crate) struct Lists {
    pub(crate) starts: Buffer,
    pub(crate) list: Buffer,
}

impl Gpu {
    /// Adds to `commands` what makes the lists of `cells_of` `[entries]`, whose numbers
    /// are below `cells` or [`crate::abi::NONE`].
    ///
    /// # Errors
    /// Whatever the device refuses.
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
