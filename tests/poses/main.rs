//! Tests of poses from photographs alone: pairs, many photographs, and what must be refused.

mod adjusted;
mod bent_lens;
mod estimated_photos;
mod many;
mod pairs;
mod panoramas;
mod refused;
mod zoom;
