//! Cameras of photographs: estimated where there are none, checked where there are some.

pub mod check;
pub mod dense;
pub mod estimation;
pub mod matches;
