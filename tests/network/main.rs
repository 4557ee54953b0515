//! The network: each module against its oracle or reference.

mod aggregation;
mod attention_gather;
mod backbone;
mod encoder_gradients;
mod end_to_end;
mod operators;
mod parity;
mod plane_sweep;
mod primaries;
mod reconstruction;
mod shipped_weights;
mod small;
mod trunk;
mod trunk_parts;
