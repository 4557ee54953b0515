//! The optimisation of a scene on photographs in device memory: loss, gradients by the parameters,
//! and Adam's step.

pub(crate) mod loss;
pub(crate) mod optimiser;
pub(crate) mod steps;
