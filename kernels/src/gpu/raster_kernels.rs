//! Sources and arguments of the rasterizer's kernels, in the order of a frame.

use crate::gpu::pipelines::Access::{Read, Uniform, Write};
use crate::gpu::pipelines::{Kernel, wgsl};

pub(crate) static PROJECT: Kernel = Kernel {
    name: "project",
    entry: "main",
    source: wgsl!(
        "shared/abi",
        "shared/grid",
        "shared/raster",
        "shared/sh",
        "shared/ewa",
        "project"
    ),
    bindings: &[Uniform, Read, Read, Read, Write, Write, Write, Write],
};

pub(crate) static SORT_COUNT: Kernel = Kernel {
    name: "sort_count",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/sort", "sort_count"),
    bindings: &[Uniform, Read, Read, Write],
};

pub(crate) static SORT_SCATTER: Kernel = Kernel {
    name: "sort_scatter",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/sort", "sort_scatter"),
    bindings: &[Uniform, Read, Read, Read, Read, Write, Write],
};

pub(crate) static SCAN_REDUCE: Kernel = Kernel {
    name: "scan_reduce",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/scan", "scan_reduce"),
    bindings: &[Read, Read, Read, Write],
};

pub(crate) static SCAN_WHOLE: Kernel = Kernel {
    name: "scan_whole",
    entry: "main",
    source: wgsl!("shared/abi", "shared/scan", "scan_whole"),
    bindings: &[Read, Write],
};

pub(crate) static SCAN_APPLY: Kernel = Kernel {
    name: "scan_apply",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/scan", "scan_apply"),
    bindings: &[Read, Read, Read, Read, Write],
};

pub(crate) static PLAN: Kernel = Kernel {
    name: "plan",
    entry: "main",
    source: wgsl!("shared/abi", "shared/raster", "plan"),
    bindings: &[Uniform, Read, Read, Write],
};

pub(crate) static PICK: Kernel = Kernel {
    name: "pick",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "pick"),
    bindings: &[Uniform, Read, Read, Read, Read, Write, Write, Write, Write],
};

pub(crate) static INTERSECT: Kernel = Kernel {
    name: "intersect",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "intersect"),
    bindings: &[Uniform, Read, Read, Read, Read, Read, Write, Write],
};

pub(crate) static RANGES: Kernel = Kernel {
    name: "ranges",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "ranges"),
    bindings: &[Uniform, Read, Read, Write],
};

pub(crate) static RASTERIZE: Kernel = Kernel {
    name: "rasterize",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "rasterize"),
    bindings: &[Uniform, Read, Read, Read, Read, Write, Write],
};

pub(crate) static RASTERIZE_BWD: Kernel = Kernel {
    name: "rasterize_bwd",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "rasterize_bwd"),
    bindings: &[Uniform, Read, Read, Read, Read, Read, Write, Write, Write],
};

pub(crate) static PAIR_SUMS: Kernel = Kernel {
    name: "pair_sums",
    entry: "main",
    source: wgsl!("shared/abi", "shared/grid", "shared/raster", "shared/moments", "pair_sums"),
    bindings: &[Uniform, Read, Read, Read, Read, Read, Write],
};

pub(crate) static PROJECT_BWD: Kernel = Kernel {
    name: "project_bwd",
    entry: "main",
    source: wgsl!(
        "shared/abi",
        "shared/grid",
        "shared/raster",
        "shared/ewa",
        "shared/moments",
        "project_bwd"
    ),
    bindings: &[Uniform, Read, Read, Read, Write],
};

pub(crate) static COLOUR_BWD: Kernel = Kernel {
    name: "colour_bwd",
    entry: "main",
    source: wgsl!(
        "shared/abi",
        "shared/grid",
        "shared/raster",
        "shared/sh",
        "shared/sh_bwd",
        "shared/moments",
        "colour_bwd"
    ),
    bindings: &[Uniform, Read, Read, Read, Read, Write, Write, Write],
};
