//! Sources of the rasterizer's kernels, in the order of a frame.

use crate::gpu::kernel::{Kernel, wgsl};

pub(crate) static PROJECT: Kernel = Kernel {
    name: "project",
    entry: "main",
    source: wgsl!(
        RasterUniform; "shared/grid", "shared/finite", "shared/raster", "shared/sh", "shared/ewa",
        "raster/project"
    ),
};

pub(crate) static SORT_COUNT: Kernel = Kernel {
    name: "sort_count",
    entry: "main",
    source: wgsl!(SortUniform; "shared/grid", "shared/sort", "raster/sort_count"),
};

pub(crate) static SORT_SCATTER: Kernel = Kernel {
    name: "sort_scatter",
    entry: "main",
    source: wgsl!(SortUniform; "shared/grid", "shared/sort", "raster/sort_scatter"),
};

pub(crate) static SCAN_REDUCE: Kernel = Kernel {
    name: "scan_reduce",
    entry: "main",
    source: wgsl!("shared/grid", "shared/scan", "raster/scan_reduce"),
};

pub(crate) static SCAN_WHOLE: Kernel =
    Kernel { name: "scan_whole", entry: "main", source: wgsl!("shared/scan", "raster/scan_whole") };

pub(crate) static SCAN_APPLY: Kernel = Kernel {
    name: "scan_apply",
    entry: "main",
    source: wgsl!("shared/grid", "shared/scan", "raster/scan_apply"),
};

pub(crate) static PLAN: Kernel = Kernel {
    name: "plan",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/raster", "raster/plan"),
};

pub(crate) static PICK: Kernel = Kernel {
    name: "pick",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/grid", "shared/raster", "raster/pick"),
};

pub(crate) static INTERSECT: Kernel = Kernel {
    name: "intersect",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/grid", "shared/raster", "raster/intersect"),
};

pub(crate) static RANGES: Kernel = Kernel {
    name: "ranges",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/grid", "shared/raster", "raster/ranges"),
};

pub(crate) static BLEND: Kernel = Kernel {
    name: "blend",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/grid", "shared/raster", "raster/blend"),
};

pub(crate) static BLEND_BWD: Kernel = Kernel {
    name: "blend_bwd",
    entry: "main",
    source: wgsl!(RasterUniform; "shared/grid", "shared/raster", "raster/blend_bwd"),
};

pub(crate) static PAIR_SUMS: Kernel = Kernel {
    name: "pair_sums",
    entry: "main",
    source: wgsl!(
        RasterUniform; "shared/grid", "shared/raster", "shared/moments", "raster/pair_sums"
    ),
};

pub(crate) static PROJECT_BWD: Kernel = Kernel {
    name: "project_bwd",
    entry: "main",
    source: wgsl!(
        RasterUniform; "shared/grid", "shared/raster", "shared/ewa", "shared/moments",
        "raster/project_bwd"
    ),
};

pub(crate) static COLOUR_BWD: Kernel = Kernel {
    name: "colour_bwd",
    entry: "main",
    source: wgsl!(
        RasterUniform; "shared/grid", "shared/finite", "shared/raster", "shared/sh", "shared/sh_bwd",
        "shared/moments", "raster/colour_bwd"
    ),
};
