//! Custom operations of candle: checks of shape, dtype and layout, then a kernel.

mod rasterize;

pub use rasterize::rasterize;
