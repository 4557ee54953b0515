//! The rasterizer: pictures and gradients against oracles, fixtures and a conventional one.

mod baseline;
mod coverage;
mod levels;
mod raster;
mod raster_bwd;
mod raster_bwd_oracle;
mod raster_op;
mod raster_oracle;
mod separate;
