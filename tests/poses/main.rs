//! Tests of poses from photographs alone: pairs, many photographs, and what must be refused.

mod adjusted;
mod loose;
mod many;
mod pairs;
mod refused;
